"""The Cholesky factor of a symmetric positive definite band matrix, block by block."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from mpmjax._types import Array, Float


class BandCholesky(eqx.Module):
    """L of S = L Lᵀ for a block tridiagonal S: L has the blocks L_k on its diagonal and C_k below them, in row k,

        L_k L_kᵀ = S_kk − C_k C_kᵀ,    C_k = S_k,k−1 L_k−1⁻ᵀ.

    It takes (10/3) K b³ operations for K blocks of size b, and 8 K b² for each solution.
    """

    inverse: Float[Array, "k b b"]
    """L_k⁻¹."""
    below: Float[Array, "k b b"]
    """C_k; the first is zero."""

    def solve(self, r: Float[Array, "k b"]) -> Float[Array, "k b"]:
        """S⁻¹ r."""

        def forward(y: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            inverse, below, right = row
            y = inverse @ (right - below @ y)
            return y, y

        def backward(rest: Array, row: tuple[Array, Array, Array]) -> tuple[Array, Array]:
            inverse, below, y = row
            z = inverse.T @ (y - rest)
            return below.T @ z, z

        start = jnp.zeros_like(r[0])
        y = jax.lax.scan(forward, start, (self.inverse, self.below, r))[1]
        return jax.lax.scan(backward, start, (self.inverse, self.below, y), reverse=True)[1]


def band_cholesky(diagonal: Float[Array, "k b b"], below: Float[Array, "k b b"]) -> BandCholesky:
    """The factor, NaN if S is not positive definite.

    Args:
        diagonal: S_kk.
        below: S_k,k−1; the first is not used.
    """
    identity = jnp.eye(diagonal.shape[-1], dtype=diagonal.dtype)

    def step(before: Array, row: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        own, under = row
        C = under @ before.T
        inverse = solve_triangular(jnp.linalg.cholesky(own - C @ C.T), identity, lower=True)
        return inverse, (inverse, C)

    return BandCholesky(*jax.lax.scan(step, jnp.zeros_like(diagonal[0]), (diagonal, below))[1])
