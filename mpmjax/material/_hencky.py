"""Hencky's elasticity: linear in the logarithmic strain."""

import jax
import jax.numpy as jnp

from mpmjax import _linalg as la
from mpmjax._isotropic import Logarithm
from mpmjax._types import Array, Bool, Float, Matrix
from mpmjax.material._base import AbstractIsotropic, MatrixTangent, PrincipalTangent

_log = Logarithm()


class Hencky(AbstractIsotropic):
    """Hencky's elasticity (H. Hencky, Z. Tech. Phys. 9 (1928) 215; J. C. Simo, Comput. Methods Appl. Mech. Eng. 99
    (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Ψ = μ ε : ε + λ/2 (tr ε)² with the logarithmic strain ε = ½ log FᵀF, P = F⁻ᵀ (2μ ε + λ tr(ε) I).

    The law of plasticity at large strains: a return map is as in small strains, and tr ε = ln J keeps changes of shape
    and of volume apart.

    *When it breaks*: it needs J > 0. The force in a stretched fibre falls beyond a stretch of e: not a law for rubber.
    Each particle needs an eigenvalue problem, and an implicit step the matrix of its stress differential: dearer than
    the other laws. The strain has two derivatives: first derivatives pass through implicit steps, second ones through
    explicit steps only, and more are refused.
    *Good values*: as for fixed corotated.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
    """

    def energy(self, F: Matrix) -> Array:
        """Ψ = μ ε : ε + λ/2 (tr ε)²."""
        strain = logarithmic_strain(F)
        return self.shear_modulus * la.double_dot(strain, strain) + self.lame_lambda / 2 * la.trace(strain) ** 2

    def stress(self, F: Matrix) -> Matrix:
        """P = F⁻ᵀ (2μ ε + λ tr(ε) I)."""
        strain = logarithmic_strain(F)
        kirchhoff = 2 * self.shear_modulus * strain + self.lame_lambda * la.trace(strain) * la.identity_like(F)
        return la.matmul(la.cofactor(F), kirchhoff) / la.determinant(F)

    def tangent(self, F: Matrix) -> MatrixTangent:
        """The stress's derivative in each of the d² directions."""
        return MatrixTangent(la.matrix_of(lambda dF: jax.jvp(self.stress, (F,), (dF,))[1], F))

    def principal_tangent(self, s: Float[Array, "d *p"]) -> PrincipalTangent:
        """With τ_i = 2μ ln s_i + λ ln J: scaling (2μ δ_ij + λ)/(s_i s_j) − δ_ij τ_i/s_i², twist
        (τ_i/s_i + τ_j/s_j)/(s_i + s_j), flip (2μ s_j ln(s_i/s_j)/(s_i − s_j) − τ_j)/(s_i s_j)."""
        mu, lam = self.shear_modulus, self.lame_lambda * jnp.ones_like(s[0])
        log_s = jnp.log(s)
        tau = 2 * mu * log_s + lam * log_s.sum(axis=0)

        def scaling(i: int, j: int) -> Array:
            return ((2 * mu - tau[i] + lam) if i == j else lam) / (s[i] * s[j])

        def twist(i: int, j: int) -> Array:
            return (tau[i] / s[i] + tau[j] / s[j]) / (s[i] + s[j])

        def flip(i: int, j: int) -> Array:
            return (2 * mu * s[j] * _log.slope(s[j], s[i]) - tau[j]) / (s[i] * s[j])

        return PrincipalTangent.of(s, twist, flip, scaling)

    def admits(self, F: Matrix) -> Bool[Array, "p"]:
        """J > 0."""
        return la.determinant(F) > 0


def logarithmic_strain(F: Matrix) -> Matrix:
    """ε = ½ log FᵀF, shape (d, d, *p)."""
    return _log(la.matmul(la.transpose(F), F)) / 2
