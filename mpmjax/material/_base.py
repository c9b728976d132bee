"""Base classes of laws, and what a law's stress differential is given as.

A law is its energy density Ψ(F). Its derivatives default to automatic differentiation; laws with closed forms override
them.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle
from mpmjax.checks import require, require_fields, require_moduli

_STRETCHES = (1.25, 0.8, 1.0)
"""Where a law is asked whether it is isotropic: they differ and keep the volume, whose energy may hide the rest."""
_ANISOTROPIC = 1e-4
"""Relative change of the energy by a rotation from which a law is anisotropic, well above rounding in float32."""


class AbstractTangent(eqx.Module):
    """The stress differential at one deformation: the linear map δF ↦ δP = ∂²Ψ/∂F∂F : δF (derivation, eq. 8).

    It holds everything that does not depend on δF, so that a solver that applies it many times computes that once.
    """

    @abc.abstractmethod
    def __call__(self, dF: Matrix) -> Matrix:
        """δP [Pa] for δF [-], both of shape (d, d, p)."""


class MatrixTangent(AbstractTangent):
    """The stress differential as a d² x d² matrix for each particle."""

    matrix: Float[Array, "m m *p"]
    """∂²Ψ/∂F∂F [Pa], on the d² components of δF in C order, shape (d², d², *p)."""

    def __call__(self, dF: Matrix) -> Matrix:
        return la.matmul(self.matrix, dF.reshape(-1, 1, *dF.shape[2:])).reshape(dF.shape)


class PrincipalTangent(eqx.Module):
    """The eigenstructure of an isotropic law's ∂²Ψ/∂F∂F at F = U diag(s) Vᵀ (B. Smith, F. de Goes, T. Kim, ACM Trans.
    Graph. 38 (2019) 3, doi 10.1145/3241041).

    With e_ij the unit matrices, U (e_ij − e_ji) Vᵀ/√2 is an eigenvector of eigenvalue `twist`, U (e_ij + e_ji) Vᵀ/√2
    one of eigenvalue `flip`, and the d remaining eigenvectors are U diag(q) Vᵀ with q those of `scaling`.
    """

    twist: Float[Array, "c *p"]
    """(∂Ψ/∂s_i + ∂Ψ/∂s_j)/(s_i + s_j) [Pa] for the pairs i < j, in the order (0, 1), (0, 2), (1, 2), shape
    (d (d − 1)/2, *p)."""
    flip: Float[Array, "c *p"]
    """(∂Ψ/∂s_i − ∂Ψ/∂s_j)/(s_i − s_j) [Pa] for the same pairs."""
    scaling: Matrix
    """∂²Ψ/∂s_i∂s_j [Pa], shape (d, d, *p)."""

    @classmethod
    def of(
        cls,
        s: Float[Array, "d *p"],
        twist: Callable[[int, int], Array],
        flip: Callable[[int, int], Array],
        scaling: Callable[[int, int], Array],
    ) -> "PrincipalTangent":
        """From functions of the indices i, j: twist and flip of each pair i < j, and each entry of the scaling.

        Args:
            s: signed principal stretches [-], shape (d, *p).
            twist: the twist of a pair [Pa], shape (*p).
            flip: the flip of a pair [Pa], shape (*p).
            scaling: ∂²Ψ/∂s_i∂s_j [Pa], shape (*p).
        """
        d, none = s.shape[0], jnp.zeros((0, *s.shape[1:]), s.dtype)

        def over_pairs(entry: Callable[[int, int], Array]) -> Array:
            return jnp.stack([entry(i, j) for i, j in la.pairs(d)]) if d > 1 else none

        entries = [[scaling(i, j) for j in range(d)] for i in range(d)]
        return cls(over_pairs(twist), over_pairs(flip), la.assemble(entries))


class AbstractMaterial(eqx.Module):
    """A hyperelastic law, given by its energy density Ψ(F).

    A law needs `energy` alone, and then works with every method, Hessian and description, and under every derivative:
    the stress is the energy's gradient, the stress differential the stress's derivative. A law that has closed forms
    overrides these methods; `mpmjax.verification.check_law` compares them with the defaults.

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

    @abc.abstractmethod
    def energy(self, F: Matrix) -> Array:
        """Ψ(F) [J/m³ of undeformed volume], shape (p,).

        Args:
            F: deformation gradient [-], shape (d, d, p).
        """

    def stress(self, F: Matrix) -> Matrix:
        """The first Piola-Kirchhoff stress P = ∂Ψ/∂F [Pa], shape (d, d, p). Default: the energy's gradient."""
        return jax.grad(lambda F: _density(self, F).sum())(F)

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

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        """Whether the law is defined at F, shape (p,). Default: where its energy is finite."""
        return jnp.isfinite(_density(self, F))


def _density(law: AbstractMaterial, F: Matrix) -> Array:
    """A law's energy, which must have the shape of one number a particle."""
    energy = law.energy(F)
    require(
        jnp.shape(energy) == F.shape[2:],
        f"{type(law).__name__}'s energy must be one number a particle, shape {F.shape[2:]} for F of shape {F.shape}, "
        f"got shape {jnp.shape(energy)}: F is component first, as the functions of mpmjax.linalg expect it and those "
        "of jax.numpy.linalg do not.",
    )
    return energy


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


class AbstractInelastic(eqx.Module):
    """A law with a history: elastic within a step, and returned to what it admits at the step's end.

    F is the elastic part F_E of the deformation. A step strains it by the elastic law in force, and the return map then
    takes out of it what does not stay elastic: plastic flow, the opening of sand, a fluid's expansion. Implicit solves
    see the elastic law alone.

    The history is what a particle remembers besides F_E: a pytree of the law's own, of arrays of shape (p,).
    """

    @abc.abstractmethod
    def initial_history(self, F: Matrix) -> Any:
        """The history of particles that have never yielded, leaves of shape (p,).

        Args:
            F: F_E [-], shape (d, d, p).
        """

    @abc.abstractmethod
    def elastic(self, history: Any) -> AbstractMaterial:
        """The elastic law at a history."""

    @abc.abstractmethod
    def return_map(self, F: Matrix, history: Any) -> tuple[Matrix, Any]:
        """The admissible F_E for a trial one, and the history after it.

        Args:
            F: the trial F_E [-], shape (d, d, p).
            history: the history before the step.
        """


Law = AbstractMaterial | AbstractInelastic


class AbstractVolumetric(eqx.Module):
    """Marks a law that depends on J = det F alone: it gets J in the place of F, shape (1, 1, p), and its particles
    store no more."""


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
