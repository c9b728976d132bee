"""The stress differential of an isotropic law, and its matrix by the principal frame."""

from functools import reduce
from typing import Any

import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix
from mpmjax.material._tangent import AbstractTangent


class IsotropicTangent(AbstractTangent):
    """The stress differential as the derivative of an isotropic law's stress."""

    law: Any
    """A law of F with `stress` and a closed form of `principal_tangent`."""
    F: Matrix

    def __call__(self, dF: Matrix) -> Matrix:
        return jax.jvp(self.law.stress, (self.F,), (dF,))[1]

    def pushed_forward(self, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"]:
        return isotropic_matrix(self.law, self.F, A, weight)


def isotropic_matrix(law: Any, F: Matrix, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"]:
    """`AbstractTangent.pushed_forward` by the law's `principal_tangent`.

    With F = U diag(s) Vᵀ and R = A V, and of the eigenstructure the scaling S_ij and for each pair h and g, half the
    sum of flip and twist and half their difference, the matrix is

        K_(ba)(dc) = w (Σ_ij S_ij U_ai R_bi U_cj R_dj + Σ_i≠j U_ai R_bj (h_ij U_ci R_dj + g_ij U_cj R_di)).

    Its factors, products of two components, are computed before the sums, so that no component repeats them.

    Args:
        law: a law of F with `principal_tangent`.
        F: deformation gradient [-], shape (d, d, *p).
        A: as there.
        weight: w, as there.
    """
    d, (U, s, V) = len(F), la.principal_frame(F)
    at = jax.tree.map(lambda part: weight * part, law.principal_tangent(s))
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
        """The row of G_ab."""
        terms = [
            scaled[i, b, a] * mixed[i] + straight[i, b][:, None] * left[i, a] + mixed[i, :, a][:, None] * crossed[i, b]
            for i in range(d)
        ]
        return reduce(jnp.add, terms).reshape(d * d, *s.shape[1:])

    return jnp.concatenate([row(b, a)[b * d + a :] for b in range(d) for a in range(d)])
