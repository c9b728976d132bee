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
    """S = L D Lᵀ by blocks, front by front (I. S. Duff, J. K. Reid, ACM Trans. Math. Softw. 9 (1983) 302, doi
    10.1145/356044.356047). With o a front's own numbers, b its border, and F what is left of S when it is reached,

        G = F_oo⁻¹,    E = F_bo G,    F_bb ← F_bb − E F_ob.
    """

    inverse: tuple[Float[Array, "_ _ _"], ...]
    """G of each level's fronts, shape (f, o, o)."""
    below: tuple[Float[Array, "_ _ _"], ...]
    """E, shape (f, b, o)."""
    dissection: Dissection

    def solve(self, r: Float[Array, "m"]) -> Float[Array, "m"]:
        """S⁻¹ r."""
        z = jnp.pad(r, (0, 1))
        steps = list(zip(self.dissection.levels, self.inverse, self.below, strict=True))
        for level, _, E in steps:
            z = z.at[level.border].add(-jnp.einsum("fbo,fo->fb", E, z[level.own]))
        for level, G, E in reversed(steps):
            own = jnp.einsum("fpo,fo->fp", G, z[level.own]) - jnp.einsum("fb,fbo->fo", z[level.border], E)
            z = z.at[level.own].set(own)
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
        inverse.append(jnp.einsum("fop,foq->fpq", X, X))
        below.append(jnp.einsum("fbo,fop->fbp", Y, X))
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
