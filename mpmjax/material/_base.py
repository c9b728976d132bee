"""Elastic laws of the deformation gradient.

A law is its energy density Ψ(F). Its derivatives default to automatic differentiation; laws with closed forms override
them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle
from mpmjax.checks import require_fields, require_moduli
from mpmjax.material._law import AbstractElastic
from mpmjax.material._tangent import AbstractTangent, MatrixTangent, PrincipalTangent, projected_tangent

_STRETCHES = (1.25, 0.8, 1.0)
"""Where a law is asked whether it is isotropic: they differ and keep the volume, whose energy may hide the rest."""
_ANISOTROPIC = 1e-4
"""Relative change of the energy by a rotation from which a law is anisotropic, well above rounding in float32."""


class AbstractMaterial(AbstractElastic):
    """A hyperelastic law, given by its energy density Ψ(F).

    A law needs `energy(F)` alone [J/m³ of undeformed volume], shape (p,), and then works with every method, Hessian and
    description, and under every derivative: the stress is the energy's gradient, the stress differential the stress's
    derivative. A law that has closed forms overrides these methods; `mpmjax.verification.check_law` compares them with
    the defaults.

        class Quadratic(mpm.AbstractMaterial):
            stiffness: float

            def energy(self, F):
                C = mpm.linalg.matmul(mpm.linalg.transpose(F), F)
                E = (C - mpm.linalg.identity_like(F)) / 2
                return self.stiffness * mpm.linalg.double_dot(E, E)

    Matrices are component first, (d, d, p), and so an energy is written with the functions of `mpmjax.linalg`
    (`determinant`, `double_dot`, `matmul`, ...): those of `jax.numpy.linalg` take the last two axes, which are not the
    matrix. Two dimensions are plane strain, one is uniaxial strain.

    Parameters are fields, each one number or one for each particle, shape (p,), or a tuple of such. Each is a leaf that
    can be differentiated and batched.

    *When it breaks*: implicit steps take second derivatives of Ψ, and gradients through them third ones, which must be
    finite wherever the body goes, F = I first of all. Polynomials of F, invariants and functions of them have these
    derivatives. What is written in eigenvalues or singular values has not, where stretches coincide; the functions of
    `mpmjax.linalg` (`rotation`, `Logarithm`) have. Roots such as ‖F − R‖ have a kink at rest.
    """

    def tangent(self, F: Matrix) -> AbstractTangent:
        """The stress differential ∂²Ψ/∂F∂F at F, a symmetric map. Default: its matrix, by the derivative of the stress
        in each of the d² directions."""
        return MatrixTangent(la.matrix_of(lambda dF: jax.jvp(self.stress, (F,), (dF,))[1], F))

    def principal_tangent(self, s: Float[Array, "d *p"]) -> PrincipalTangent:
        """The eigenstructure of the stress differential at signed principal stretches, which `stable_dt` and
        `AnalyticHessian(projected=True)` need.

        Default: of the stress differential A at F = diag(s), twist A_ijij − A_ijji, flip A_ijij + A_ijji, scaling
        A_iijj. No quotient is formed, so it is as finite as A is, at repeated stretches too.

        *When it breaks*: an anisotropic law has no such eigenstructure. Where a rotation of the material changes the
        energy, by a ten-thousandth of itself or more at one deformation that keeps the volume, the default is NaN, and
        `stable_dt` and the projected Hessian refuse the law. Give such a law its step as a number, and
        `AnalyticHessian()` or `JvpHessian()`.

        Args:
            s: signed principal stretches [-], shape (d, *p).
        """
        F = la.diagonal(s)
        A, d = la.matrix_of(self.tangent(F), F), len(s)
        A = jnp.where(is_isotropic(self, F), A, jnp.nan)

        def entry(i: int, j: int, k: int, l: int) -> Array:  # noqa: E741
            return A[i * d + j, k * d + l]

        return PrincipalTangent.of(
            s,
            twist=lambda i, j: (entry(i, j, i, j) + entry(j, i, j, i)) / 2 - entry(i, j, j, i),
            flip=lambda i, j: (entry(i, j, i, j) + entry(j, i, j, i)) / 2 + entry(i, j, j, i),
            scaling=lambda i, j: entry(i, i, j, j),
        )

    def projected_tangent(self, F: Matrix) -> MatrixTangent:
        """The stress differential with its negative eigenvalues set to zero (see `projected_tangent`).

        *When it breaks*: the law must be isotropic; where it has no `principal_tangent` of its own and is not, a
        `RuntimeError` says so.
        """
        if type(self).principal_tangent is AbstractMaterial.principal_tangent:
            name = type(self).__name__
            F = eqx.error_if(
                F,
                ~is_isotropic(self, F),
                f"{name} is not isotropic, and the projected Hessian needs a law that is: take AnalyticHessian() "
                f"without projection or JvpHessian(), or write {name}'s energy in invariants of FᵀF.",
            )
        return projected_tangent(self, F)

    def tangent_eigenvalues(self, F: Matrix, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """All of them: in the principal frame the map is d x d on the diagonal and 2 x 2 on (L_ij, L_ji) for each
        pair."""
        del dim
        _, s, _ = la.principal_frame(F)
        tangent = self.principal_tangent(s)
        d = s.shape[0]
        if total:
            pull, tau = jnp.ones_like(s), jnp.zeros_like(s)
        else:
            P = self.stress(la.diagonal(s))
            pull, tau = s, s * jnp.stack([P[i, i] for i in range(d)])
        scaling = tangent.scaling * pull[:, None] * pull + la.diagonal(tau)
        values = [*la.symmetric_eigen(scaling)[0]]
        for (i, j), twist, flip in zip(la.pairs(d), tangent.twist, tangent.flip, strict=True):
            near, far = (flip + twist) / 2 * pull[j] ** 2, (flip + twist) / 2 * pull[i] ** 2
            across = (flip - twist) / 2 * pull[i] * pull[j] + (tau[i] + tau[j]) / 2
            centre, radius = (near + far) / 2, jnp.hypot((near - far) / 2, across)
            values += [centre - radius, centre + radius]
        return jnp.stack(values)

    def inadmissible(self, or_else: str) -> tuple[str, str]:
        what, _ = super().inadmissible(or_else)
        return what, f"Reduce dt{or_else}, or use FixedCorotated, which allows inversion."


def is_isotropic(law: AbstractMaterial, like: Matrix) -> Bool[Array, "*p"]:
    """Whether a law's energy does not change as the material is rotated before a deformation, or space after it: at one
    deformation, so that the answer is that of the law's parameters. True where the energy is not finite.

    Args:
        law: the law.
        like: any matrices, shape (d, d, *p).
    """
    d = len(like)
    if d == 1:
        return jnp.ones(like.shape[2:], bool)
    stretch = np.diag(_STRETCHES[:d])

    def turn(angle: float) -> np.ndarray:
        """A rotation about no axis of symmetry."""
        W = np.array([[0, -1, 0.7], [1, 0, -0.4], [-0.7, 0.4, 0]])[:d, :d] * np.tan(angle / 2)
        return np.linalg.solve(np.eye(d) - W, np.eye(d) + W)

    def energy(F: np.ndarray) -> Array:
        column = jnp.asarray(F, like.dtype).reshape(d, d, *[1] * (like.ndim - 2))
        return law.energy(jnp.broadcast_to(column, like.shape))

    one, other = energy(stretch), energy(turn(0.5) @ stretch @ turn(0.8).T)
    size = jnp.maximum(jnp.abs(one), jnp.abs(other))
    return ~(jnp.abs(one - other) > _ANISOTROPIC * size)


class AbstractIsotropic(AbstractMaterial):
    """A law given by Young's modulus and Poisson's ratio: at small strains δP = 2μ ε + λ tr(ε) I."""

    youngs_modulus: PerParticle
    """E [Pa]."""
    poisson_ratio: PerParticle
    """ν [-]."""

    def __check_init__(self):
        require_fields(self)
        require_moduli(type(self).__name__, self.youngs_modulus, self.poisson_ratio)

    @property
    def shear_modulus(self) -> PerParticle:
        """μ = E / (2 (1 + ν)) [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> PerParticle:
        """λ = E ν / ((1 + ν)(1 − 2ν)) [Pa]."""
        return self.youngs_modulus * self.poisson_ratio / ((1 + self.poisson_ratio) * (1 - 2 * self.poisson_ratio))

    @property
    def bulk_modulus(self) -> PerParticle:
        """K = E / (3 (1 − 2ν)) [Pa], that of three dimensions."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))
