"""Hencky's elasticity, linear in the logarithmic strain, and the strain of the laws that yield on it."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle
from mpmjax.linalg import Logarithm, PowerLessOne
from mpmjax.material._base import AbstractIsotropic
from mpmjax.material._tangent import IsotropicTangent, PrincipalTangent

_log = Logarithm()


class Hencky(AbstractIsotropic):
    """Hencky's elasticity (H. Hencky, Z. Tech. Phys. 9 (1928) 215; J. C. Simo, Comput. Methods Appl. Mech. Eng. 99
    (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Ψ = μ ε : ε + λ/2 (tr ε)² with the logarithmic strain ε = ½ log FᵀF, P = F⁻ᵀ (2μ ε + λ tr(ε) I).

    In fewer than three dimensions the total strain in the 3 − d directions normal to F is zero. Its elastic part ε_t is
    not zero once a law has yielded: then μ (3 − d) ε_t² is added to the energy, and (3 − d) ε_t to the trace.

    Laws that yield at large strains are built on it: their return maps have the form of small strains, and tr ε = ln J
    separates changes of volume from changes of shape.

    *When it breaks*: it needs J > 0. The force in a stretched fibre falls beyond a stretch of e: not a law for rubber.
    Each particle needs an eigenvalue problem.
    *Good values*: as for fixed corotated.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        transverse_strain: ε_t [-], the elastic logarithmic strain in each of the 3 − d directions normal to F. None
            (default, and always in 3-D): zero.
    """

    transverse_strain: PerParticle | None = None

    def energy(self, F: Matrix) -> Array:
        """Ψ = μ (ε : ε + (3 − d) ε_t²) + λ/2 (tr ε + (3 − d) ε_t)²."""
        strain = logarithmic_strain(F)
        squares = la.double_dot(strain, strain)
        if self.transverse_strain is not None:
            squares = squares + _missing(F) * self.transverse_strain**2
        return self.shear_modulus * squares + self.lame_lambda / 2 * self._dilation(la.trace(strain), F) ** 2

    def stress(self, F: Matrix) -> Matrix:
        """P = F⁻ᵀ (2μ ε + λ (tr ε + (3 − d) ε_t) I)."""
        strain = logarithmic_strain(F)
        dilation = self._dilation(la.trace(strain), F)
        kirchhoff = 2 * self.shear_modulus * strain + self.lame_lambda * dilation * la.identity_like(F)
        return la.matmul(la.cofactor(F), kirchhoff) / la.determinant(F)

    def tangent(self, F: Matrix) -> IsotropicTangent:
        return IsotropicTangent(self, F)

    def principal_tangent(self, s: Float[Array, "d *p"]) -> PrincipalTangent:
        """With τ_i = 2μ ln s_i + λ (ln J + (3 − d) ε_t): scaling (2μ δ_ij + λ)/(s_i s_j) − δ_ij τ_i/s_i², twist
        (τ_i/s_i + τ_j/s_j)/(s_i + s_j), flip (2μ s_j ln(s_i/s_j)/(s_i − s_j) − τ_j)/(s_i s_j)."""
        mu, lam = self.shear_modulus, self.lame_lambda * jnp.ones_like(s[0])
        log_s = jnp.log(s)
        tau = 2 * mu * log_s + lam * self._dilation(log_s.sum(axis=0), s)

        def scaling(i: int, j: int) -> Array:
            return ((2 * mu - tau[i] + lam) if i == j else lam) / (s[i] * s[j])

        def twist(i: int, j: int) -> Array:
            return (tau[i] / s[i] + tau[j] / s[j]) / (s[i] + s[j])

        def flip(i: int, j: int) -> Array:
            return (2 * mu * s[j] * _log.slope(s[j], s[i]) - tau[j]) / (s[i] * s[j])

        return PrincipalTangent.of(s, twist, flip, scaling)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        """J > 0."""
        return la.determinant(F) > 0

    def _dilation(self, trace: Array, like: Array) -> Array:
        """tr ε + (3 − d) ε_t [-]; the first axis of `like` is d."""
        return trace if self.transverse_strain is None else trace + _missing(like) * self.transverse_strain


class ElasticStrain(eqx.Module):
    """The elastic logarithmic strain in three dimensions, whatever d is, as mean and deviator: ε = m I + e.

    The laws that yield on Hencky's elasticity are isotropic: their return maps turn no principal direction, scale the
    deviator and set the mean, ε ← k e + m′ I. With F = R exp ε that is F ← F exp((k − 1) ε + c I) = F eᶜ C^((k−1)/2),
    where C = FᵀF and c = m′ − k m: a function of C, whose derivative needs no eigenvectors.
    """

    F: Matrix
    """F_E [-], shape (d, d, p)."""
    transverse: Array | None
    """ε_t [-], shape (p,); None in 3-D."""
    mean: Array
    """m = (tr ε + (3 − d) ε_t)/3 [-], shape (p,)."""
    deviation: Array
    """‖e‖ [-], shape (p,). Where it is zero its derivative is zero."""

    @classmethod
    def of(cls, F: Matrix, transverse: Array | None) -> "ElasticStrain":
        """The strain of an elastic deformation.

        Args:
            F: F_E [-], shape (d, d, p).
            transverse: ε_t [-], shape (p,); None in 3-D.
        """
        strain = logarithmic_strain(F)
        trace = la.trace(strain)
        mean = (trace if transverse is None else trace + _missing(F) * transverse) / 3
        e = strain - mean * la.identity_like(F)
        squares = la.double_dot(e, e)
        if transverse is not None:
            squares = squares + _missing(F) * (transverse - mean) ** 2
        deviates = squares > 0
        return cls(F, transverse, mean, jnp.where(deviates, jnp.sqrt(jnp.where(deviates, squares, 1)), 0))

    def returned(self, ratio: Array, mean: Array) -> tuple[Matrix, Array | None]:
        """F_E and ε_t at the strain k e + m′ I. Where k = 1 and m′ = m they are unchanged to the last bit.

        Args:
            ratio: k [-], shape (p,).
            mean: m′ [-], shape (p,).
        """
        shift = mean - ratio * self.mean
        change = PowerLessOne((ratio - 1) / 2, shift)(la.matmul(la.transpose(self.F), self.F))
        transverse = None if self.transverse is None else ratio * self.transverse + shift
        return self.F + la.matmul(self.F, change), transverse


def no_transverse_strain(F: Matrix) -> Array | None:
    """ε_t [-] of particles that have never yielded: zero, shape (p,), or None in 3-D."""
    return None if F.shape[0] == 3 else jnp.zeros(F.shape[2:], F.dtype)


def _missing(like: Array) -> int:
    """3 − d, the number of directions that have a transverse strain; an array's first axis is d."""
    if like.shape[0] == 3:
        raise ValueError("In 3-D no direction is transverse: Hencky's transverse_strain must be None.")
    return 3 - like.shape[0]


def logarithmic_strain(F: Matrix) -> Matrix:
    """ε = ½ log FᵀF, shape (d, d, *p)."""
    return _log(la.matmul(la.transpose(F), F)) / 2
