"""The factor of a symmetric positive definite matrix in the order of a nested dissection."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from mpmjax._types import Array, Float
from mpmjax.implicit._dissection import Dissection, Level


class DissectedFactor(eqx.Module):
    """S = L Lᵀ by blocks, front by front (I. S. Duff, J. K. Reid, ACM Trans. Math. Softw. 9 (1983) 302, doi
    10.1145/356044.356047). With o a front's own numbers, b its border, and F what is left of S when it is reached,

        F_oo = L_oo L_ooᵀ,    X = L_oo⁻¹,    Y = F_bo Xᵀ,    F_bb ← F_bb − Y Yᵀ.

    X and not F_oo⁻¹ is kept: the product with the latter loses as many digits again as F_oo has in its condition.
    """

    inverse: tuple[Float[Array, "_ _ _"], ...]
    """X of each level's fronts, shape (f, o, o)."""
    below: tuple[Float[Array, "_ _ _"], ...]
    """Y, shape (f, b, o)."""
    dissection: Dissection

    def solve(self, r: Float[Array, "m"]) -> Float[Array, "m"]:
        """S⁻¹ r."""
        z, halves = jnp.pad(r, (0, 1)), []  # L⁻¹ r of each level
        steps = list(zip(self.dissection.levels, self.inverse, self.below, strict=True))
        for level, X, Y in steps:
            halves.append(jnp.einsum("fpo,fo->fp", X, z[level.own]))
            z = z.at[level.border].add(-jnp.einsum("fbo,fo->fb", Y, halves[-1]))
        for (level, X, Y), half in zip(reversed(steps), reversed(halves), strict=True):
            rest = half - jnp.einsum("fb,fbo->fo", z[level.border], Y)
            z = z.at[level.own].set(jnp.einsum("fp,fpo->fo", rest, X))
        return z[:-1]


def dissected_factor(dissection: Dissection, entries: Callable[[Array, Array], Float[Array, "i j"]]) -> DissectedFactor:
    """The factor, NaN if S is not positive definite.

    Args:
        dissection: the order.
        entries: the entries of S in these rows and columns, of which some are past the last one.
    """
    inverse, below, left = [], [], None
    for level in dissection.levels:
        own = level.own.shape[1]
        F, rest = _assembled(dissection.size, level, entries, left)
        L = jnp.linalg.cholesky(F[:, :own])
        X = solve_triangular(L, jnp.broadcast_to(jnp.eye(own, dtype=F.dtype), L.shape), lower=True)
        Y = jnp.einsum("fbo,fpo->fbp", F[:, own:], X)
        inverse.append(X)
        below.append(Y)
        left = rest - jnp.einsum("fbo,fco->fbc", Y, Y)
    return DissectedFactor(tuple(inverse), tuple(below), dissection)


def _assembled(
    size: int, level: Level, entries: Callable[[Array, Array], Array], left: Array | None
) -> tuple[Float[Array, "f m o"], Array]:
    """What is left of S in the columns of each front, whose numbers past the last are those of the identity, and what
    the fronts before take from the border, shape (f, b, b), or a zero.

    Args:
        size: how many numbers S has.
        level: the fronts.
        entries: the entries of S.
        left: what those before take, shape (2f, b, b); None at the first level.
    """
    own = level.own.shape[1]

    def columns(numbers: Array) -> Array:
        F = entries(numbers, numbers[:own])
        return F + jnp.eye(*F.shape, dtype=F.dtype) * (numbers[:own] >= size).astype(F.dtype)

    def front(one: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        numbers, pair, places = one
        F = columns(numbers)
        rest = jnp.zeros((), F.dtype)
        for taken, place in zip(pair, places, strict=True):
            rows = jnp.pad(taken, (0, 1))[place]
            F = F + rows[:, place[:own]]
            rest = rest + rows[own:, place[own:]]
        return F, rest

    numbers = jnp.asarray(np.concatenate([level.own, level.border], axis=1))
    if left is None or level.places is None:
        F = jax.lax.map(columns, numbers)
        return F, jnp.zeros((), F.dtype)
    return jax.lax.map(front, (numbers, left.reshape(-1, 2, *left.shape[1:]), jnp.asarray(level.places)))
