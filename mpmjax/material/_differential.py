"""The stress differential: the derivative of a law's stress, as a linear map and by its eigenstructure."""

import abc
from collections.abc import Callable
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix
from mpmjax.autodiff import custom_derivative

Entry = Callable[[int, int], Array]  # a number a particle, of directions i and j

_STRETCHES = (1.25, 0.8, 1.0)
"""Where a law is asked whether it is isotropic: they differ and keep the volume, whose energy may hide the rest."""
_ANISOTROPIC = 1e-4
"""Relative change of the energy by a rotation from which a law is anisotropic, well above rounding in float32."""


class AbstractDifferential(eqx.Module):
    """The stress differential at one deformation: the linear map δF ↦ δP = ∂²Ψ/∂F∂F : δF (derivation, eq. 8).

    It holds everything that does not depend on δF, so that a solver that applies it many times computes that once.
    """

    @abc.abstractmethod
    def __call__(self, dF: Deformation) -> Deformation:
        """δP [Pa] for δF [-], both of shape (d, d, p); for laws of J alone δ(dΨ/dJ) for δJ, both of shape (p,)."""

    def pushed_forward(self, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"] | None:
        """The upper triangle of the symmetric matrix of G ↦ w (∂²Ψ/∂F∂F : (G A)) Aᵀ, row by row, in closed form, shape
        (d²(d² + 1)/2, *p). Rows and columns are the components G_ab, b before a. Default: None, and the map is applied
        to the d² unit matrices instead, which takes several times as long. It is never differentiated."""
        return None


class MatrixDifferential(AbstractDifferential):
    """The stress differential as a d² x d² matrix for each particle."""

    matrix: Float[Array, "m m *p"]  # ∂²Ψ/∂F∂F [Pa], on the d² components of δF in C order, shape (d², d², *p)

    def __call__(self, dF: Matrix) -> Matrix:
        return la.matmul(self.matrix, dF.reshape(-1, 1, *dF.shape[2:])).reshape(dF.shape)


class VolumetricDifferential(AbstractDifferential):
    """The stress differential of a law of J alone: δJ ↦ d²Ψ/dJ² δJ."""

    stiffness: Float[Array, "*p"]  # d²Ψ/dJ² [Pa], shape (p,)

    def __call__(self, dF: Array) -> Array:
        return self.stiffness * dF


class PrincipalDifferential(eqx.Module):
    """The eigenstructure of an isotropic law's ∂²Ψ/∂F∂F at F = U diag(s) Vᵀ (B. Smith, F. de Goes, T. Kim, ACM Trans.
    Graph. 38 (2019) 3, doi 10.1145/3241041).

    With e_ij the unit matrices, U (e_ij − e_ji) Vᵀ/√2 is an eigenvector of eigenvalue `twist`, U (e_ij + e_ji) Vᵀ/√2
    one of eigenvalue `flip`, and the d remaining eigenvectors are U diag(q) Vᵀ with q those of `scaling`.
    """

    twist: Float[Array, "c *p"]
    """(∂Ψ/∂s_i + ∂Ψ/∂s_j)/(s_i + s_j) [Pa] for the pairs i < j, (0, 1), (0, 2), (1, 2), shape (d (d − 1)/2, *p)."""
    flip: Float[Array, "c *p"]  # (∂Ψ/∂s_i − ∂Ψ/∂s_j)/(s_i − s_j) [Pa] for the same pairs
    scaling: Matrix  # ∂²Ψ/∂s_i∂s_j [Pa], shape (d, d, *p)

    @classmethod
    def of(cls, s: Float[Array, "d *p"], twist: Entry, flip: Entry, scaling: Entry) -> "PrincipalDifferential":
        """From functions of i and j at signed principal stretches s [-]: twist and flip if i < j, scaling [Pa]."""
        d, none = s.shape[0], jnp.zeros((0, *s.shape[1:]), s.dtype)

        def over_pairs(entry: Entry) -> Array:
            return jnp.stack([entry(i, j) for i, j in la.pairs(d)]) if d > 1 else none

        entries = [[scaling(i, j) for j in range(d)] for i in range(d)]
        return cls(over_pairs(twist), over_pairs(flip), la.assemble(entries))

    @classmethod
    def of_kirchhoff(
        cls, s: Float[Array, "d *p"], tau: Float[Array, "d *p"], growth: Entry, slope: Entry
    ) -> "PrincipalDifferential":
        """From the principal Kirchhoff stresses τ_i = s_i ∂Ψ/∂s_i [Pa], ∂τ_i/∂ln s_j and (τ_i − τ_j)/(s_i − s_j) [Pa]:
        twist (τ_i/s_i + τ_j/s_j)/(s_i + s_j), flip (s_j (τ_i − τ_j)/(s_i − s_j) − τ_j)/(s_i s_j), scaling
        (∂τ_i/∂ln s_j − δ_ij τ_i)/(s_i s_j)."""
        return cls.of(
            s,
            twist=lambda i, j: (tau[i] / s[i] + tau[j] / s[j]) / (s[i] + s[j]),
            flip=lambda i, j: (s[j] * slope(i, j) - tau[j]) / (s[i] * s[j]),
            scaling=lambda i, j: (growth(i, j) - (tau[i] if i == j else 0)) / (s[i] * s[j]),
        )


class IsotropicDifferential(AbstractDifferential):
    """The stress differential as the derivative of an isotropic law's stress."""

    law: Any  # a law of F with `stress` and a closed form of `principal_differential`
    F: Matrix

    def __call__(self, dF: Matrix) -> Matrix:
        return jax.jvp(self.law.stress, (self.F,), (dF,))[1]

    def pushed_forward(self, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"]:
        """By the law's `principal_differential`. With F = U diag(s) Vᵀ and R = A V, and of the eigenstructure the
        scaling S_ij and for each pair h and g, half the sum of flip and twist and half their difference, the matrix is
            K_(ba)(dc) = w (Σ_ij S_ij U_ai R_bi U_cj R_dj + Σ_i≠j U_ai R_bj (h_ij U_ci R_dj + g_ij U_cj R_di)).
        """
        d, (U, s, V) = len(A), la.principal_frame(self.F)
        at = jax.tree.map(lambda part: weight * part, self.law.principal_differential(s))
        # barriers: factors, products of two components, are computed before the sums, and no component repeats them
        U, V, at = jax.lax.optimization_barrier((U, V, at))
        R, none = la.matmul(A, V), jnp.zeros_like(s[0])
        mixed = jnp.stack([R[:, None, i] * U[None, :, i] for i in range(d)])  # R_bi U_ai
        left, right = (jnp.stack([B[:, None, i] * B[None, :, i] for i in range(d)]) for B in (U, R))

        def over_pairs(entry: Array) -> Matrix:
            """The symmetric matrix of a number for each pair."""
            place = {pair: entry[k] for k, pair in enumerate(la.pairs(d))}
            return la.assemble([[place.get((min(i, j), max(i, j)), none) for j in range(d)] for i in range(d)])

        def summed(coefficients: Matrix, terms: Float[Array, "d a b *p"]) -> Float[Array, "d a b *p"]:
            """Σ_j c_ij M_j."""
            return (coefficients[:, :, None, None] * terms).sum(axis=1)

        scaled = summed(at.scaling, mixed)
        straight = summed(over_pairs((at.flip + at.twist) / 2), right)
        crossed = summed(over_pairs((at.flip - at.twist) / 2), mixed)
        mixed, left, scaled, straight, crossed = jax.lax.optimization_barrier((mixed, left, scaled, straight, crossed))

        def row(b: int, a: int) -> Array:
            """The row of G_ab, from the diagonal on."""
            terms = [
                scaled[i, b, a] * mixed[i]
                + straight[i, b][:, None] * left[i, a]
                + mixed[i, :, a][:, None] * crossed[i, b]
                for i in range(d)
            ]
            return reduce(jnp.add, terms).reshape(d * d, *s.shape[1:])[b * d + a :]

        return jnp.concatenate([row(b, a) for b in range(d) for a in range(d)])


@custom_derivative
def projected_matrix(law: Any, F: Matrix) -> Float[Array, "m m *p"]:
    """A⁺, A being ∂²Ψ/∂F∂F of an isotropic law at F, with its negative eigenvalues set to zero. In closed form: no
    eigenvalue problem larger than d x d is solved.

    Its first derivative with respect to F and the law's parameters is exact, at repeated stretches too: with E the
    eigenvectors of A and λ its eigenvalues, δA⁺ = E (K ∘ Eᵀ δA E) Eᵀ, K_kl = (λ_k⁺ − λ_l⁺)/(λ_k − λ_l) (J. L. Daleckii,
    S. G. Krein; N. J. Higham, Functions of Matrices, SIAM 2008, theorem 3.11, doi 10.1137/1.9780898717778), the limit
    of K being 1 where both are positive and 0 where both are negative.
    """
    values, modes = _spectrum(law, F)
    return _in_modes(modes, la.diagonal(jnp.maximum(values, 0)))


@projected_matrix.defjvp
def _projected_matrix_jvp(primals: tuple[Any, Matrix], tangents: tuple[Any, Matrix | None]) -> tuple[Array, Array]:
    values, modes = _spectrum(*primals)

    def in_frame(law: Any, F: Matrix) -> Array:
        """Eᵀ A E, the frame held fixed."""
        images = jax.vmap(law.stress_differential(F))(modes.reshape(-1, *F.shape)).reshape(modes.shape)
        return la.matmul(modes, jnp.swapaxes(images, 0, 1))

    change = eqx.filter_jvp(in_frame, primals, tangents)[1]
    positive, size = jnp.maximum(values, 0), jnp.abs(values)
    total = size[:, None] + size
    # for every pair of signs the quotient of differences is this one of sums, which cancels nowhere
    K = jnp.where(total == 0, 0.5, (positive[:, None] + positive) / jnp.where(total == 0, 1, total))
    return _in_modes(modes, la.diagonal(positive)), _in_modes(modes, K * change)


def _spectrum(law: Any, F: Matrix) -> tuple[Float[Array, "m *p"], Float[Array, "m m *p"]]:
    """Eigenvalues λ_k of ∂²Ψ/∂F∂F and its eigenvectors E_ka, a over components in C order."""
    U, s, V = la.principal_frame(F)
    tangent = law.principal_differential(s)
    scalings, Q = la.symmetric_eigen(tangent.scaling)
    d, modes = F.shape[0], la.principal_modes(U, V)
    modes = modes.reshape(d * d, d * d, *F.shape[2:])
    modes = jnp.concatenate([la.matmul(la.transpose(Q), modes[:d]), modes[d:]])
    return jnp.concatenate([scalings, tangent.twist, tangent.flip]), modes


def _in_modes(modes: Float[Array, "m m *p"], core: Float[Array, "m m *p"]) -> Float[Array, "m m *p"]:
    """Σ_kl E_ka core_kl E_lb."""
    return la.matmul(jnp.swapaxes(modes, 0, 1), la.matmul(core, modes))


def is_isotropic(law: Any, like: Matrix) -> Bool[Array, "*p"]:
    """Whether rotations of the material before a deformation, and of space after it, leave a law's energy as it is: at
    one deformation of F's shape, so that the answer is that of the law's parameters. True where it is not finite."""
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
