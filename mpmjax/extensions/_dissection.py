"""Nested dissection: the factor of a matrix that couples near nodes of a box, and the order of its elimination."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular

from mpmjax._types import Array, Float

_SMALLEST = 60  # nodes; fewer are not worth a cut


class Level(NamedTuple):
    """Fronts that are not coupled with each other: numbers that are eliminated together, and those that feel it. Where
    fronts of a level differ in size, they are filled up with the number past the last."""

    eliminated: np.ndarray  # the numbers that are eliminated, shape (fronts, s)
    border: np.ndarray
    """The numbers coupled with them and with what was eliminated before, and that come after, shape (fronts, b)."""
    places: np.ndarray | None
    """Where both stand in the borders of fronts 2k and 2k + 1 of the level before, b of that level where they are not
    there, shape (fronts, 2, s + b). None at the first level."""


class Dissection(eqx.Module):
    """The box is cut by a separator of `reach` planes across its longest axis into two parts that are not coupled; they
    are eliminated first, each in the same way, and the separator last (A. George, SIAM J. Numer. Anal. 10 (1973) 345,
    doi 10.1137/0710032). It is cut as often as makes the factor, and what is left of the matrix between two levels of
    cuts, smallest. The factor is about half as large as that of a band matrix with the same couplings.

    The numbers of a node's materials stand together, node by node.
    """

    shape: tuple[int, ...] = eqx.field(static=True)  # number of nodes along each axis
    reach: int = eqx.field(static=True)  # largest distance of two nodes that are coupled, in spacings along an axis
    materials: int = eqx.field(static=True, default=1)  # how many numbers a node has

    @property
    def size(self) -> int:
        """How many numbers there are."""
        return math.prod(self.shape) * self.materials

    @property
    def levels(self) -> tuple[Level, ...]:
        """In the order of elimination; the last has one front and no border."""
        return _levels(self.shape, self.reach, self.materials)

    @property
    def entries(self) -> int:
        """How many numbers the factor has."""
        return self.materials**2 * _best(self.shape, self.reach)[0]


class DissectedFactor(eqx.Module):
    """S = L Lᵀ by blocks, front by front (I. S. Duff, J. K. Reid, ACM Trans. Math. Softw. 9 (1983) 302, doi
    10.1145/356044.356047). With o what a front eliminates, b its border, and F what is left of S when it is reached,

        F_oo = L_oo L_ooᵀ,    X = L_oo⁻¹,    Y = F_bo Xᵀ,    F_bb ← F_bb − Y Yᵀ.

    X and not F_oo⁻¹ is kept: the product with the latter loses as many digits again as F_oo has in its condition.
    """

    inverse: tuple[Float[Array, "_ _ _"], ...]  # X of each level's fronts, shape (f, o, o)
    below: tuple[Float[Array, "_ _ _"], ...]  # Y, shape (f, b, o)
    dissection: Dissection

    def solve(self, r: Float[Array, "m"]) -> Float[Array, "m"]:
        """S⁻¹ r."""
        z, halves = jnp.pad(r, (0, 1)), []  # L⁻¹ r of each level
        steps = list(zip(self.dissection.levels, self.inverse, self.below, strict=True))
        for level, X, Y in steps:
            halves.append(jnp.einsum("fpo,fo->fp", X, z[level.eliminated]))
            z = z.at[level.border].add(-jnp.einsum("fbo,fo->fb", Y, halves[-1]))
        for (level, X, Y), half in zip(reversed(steps), reversed(halves), strict=True):
            rest = half - jnp.einsum("fb,fbo->fo", z[level.border], Y)
            z = z.at[level.eliminated].set(jnp.einsum("fp,fpo->fo", rest, X))
        return z[:-1]


def dissected_factor(dissection: Dissection, entries: Callable[[Array, Array], Float[Array, "i j"]]) -> DissectedFactor:
    """The factor, NaN if S is not positive definite.

    Args:
        dissection: the order.
        entries: the entries of S in these rows and columns, of which some are past the last one.
    """
    inverse, below, left = [], [], None  # what the fronts of a level take from the rest of S, shape (f, b, b)
    for level in dissection.levels:
        eliminated = level.eliminated.shape[1]

        def columns(numbers: Array, eliminated: int = eliminated) -> Array:
            """S in the columns of a front, and the identity in those past the last."""
            F = entries(numbers, numbers[:eliminated])
            return F + jnp.eye(*F.shape, dtype=F.dtype) * (numbers[:eliminated] >= dissection.size).astype(F.dtype)

        def front(one: tuple[Array, Array, Array], eliminated: int = eliminated) -> tuple[Array, Array]:
            """S in those columns and in those of the border, with what the two fronts before took."""
            numbers, pair, places = one
            F = columns(numbers, eliminated)
            rest = jnp.zeros((), F.dtype)
            for taken, place in zip(pair, places, strict=True):
                rows = jnp.pad(taken, (0, 1))[place]
                F, rest = F + rows[:, place[:eliminated]], rest + rows[eliminated:, place[eliminated:]]
            return F, rest

        numbers = jnp.asarray(np.concatenate([level.eliminated, level.border], axis=1))
        if left is None or level.places is None:
            F, rest = jax.lax.map(columns, numbers), jnp.zeros(())
        else:
            pairs = left.reshape(-1, 2, *left.shape[1:])
            F, rest = jax.lax.map(front, (numbers, pairs, jnp.asarray(level.places)))
        L = jnp.linalg.cholesky(F[:, :eliminated])
        X = solve_triangular(L, jnp.broadcast_to(jnp.eye(eliminated, dtype=F.dtype), L.shape), lower=True)
        Y = jnp.einsum("fbo,fpo->fbp", F[:, eliminated:], X)
        inverse.append(X)
        below.append(Y)
        left = rest - jnp.einsum("fbo,fco->fbc", Y, Y)
    return DissectedFactor(tuple(inverse), tuple(below), dissection)


_Front = tuple[np.ndarray, np.ndarray]
"""A box, its first node and the one past its last, shape (2, d), and the separator that cuts it; twice the box if
nothing does."""


def _count(box: np.ndarray) -> int:
    return math.prod((box[1] - box[0]).tolist())


def _wide(box: np.ndarray, shape: tuple[int, ...], reach: int) -> np.ndarray:
    """The box with its border."""
    return np.clip(np.stack([box[0] - reach, box[1] + reach]), 0, shape)


def _cuts(shape: tuple[int, ...], reach: int) -> list[list[list[_Front]]]:
    """The fronts of each level from the whole box on, when it is cut never, once, twice and so on."""
    cuts, above, boxes = [], [], [np.array([np.zeros(len(shape), int), shape])]
    while True:
        cuts.append([*above, [(box, box) for box in boxes]])
        sides = np.array([box[1] - box[0] for box in boxes])
        axis = int(np.argmax(sides[-1]))
        if sides[:, axis].min() < reach + 2 or math.prod(sides[-1].tolist()) <= _SMALLEST:
            return cuts
        level, parts = [], []
        for box, side in zip(boxes, sides[:, axis], strict=True):
            separator, below, beyond = box.copy(), box.copy(), box.copy()
            first = box[0, axis] + (side - reach) // 2
            separator[:, axis], below[1, axis], beyond[0, axis] = (first, first + reach), first, first + reach
            level.append((box, separator))
            parts += [below, beyond]
        above, boxes = [*above, level], parts


def _counts(shape: tuple[int, ...], level: list[_Front], reach: int) -> tuple[int, int]:
    """The most nodes that a front of a level eliminates, and the most of its border."""
    border = max(_count(_wide(box, shape, reach)) - _count(box) for box, _ in level)
    return max(_count(separator) for _, separator in level), border


@functools.lru_cache(maxsize=64)
def _best(shape: tuple[int, ...], reach: int) -> tuple[int, list[list[_Front]]]:
    """How many numbers the smallest factor has with one number a node, and its fronts."""

    def sizes(cuts: list[list[_Front]]) -> tuple[int, int]:
        """Numbers of the factor, and the most that are left between two levels."""
        each = [(len(level), *_counts(shape, level, reach)) for level in cuts]
        return sum(f * s * (s + b) for f, s, b in each), max(f * b * b for f, _, b in each)

    cuts = min(_cuts(shape, reach), key=lambda cuts: sum(sizes(cuts)))
    return sizes(cuts)[0], cuts


@functools.lru_cache(maxsize=64)
def _levels(shape: tuple[int, ...], reach: int, materials: int) -> tuple[Level, ...]:
    numbers = np.arange(math.prod(shape) * materials).reshape(*shape, materials)

    def inside(box: np.ndarray) -> np.ndarray:
        return numbers[tuple(map(slice, *box))].reshape(-1)

    levels: list[Level] = []
    for level in reversed(_best(shape, reach)[1]):
        most, widest = (materials * count for count in _counts(shape, level, reach))
        eliminated = np.full((len(level), most), numbers.size)
        border = np.full((len(level), widest), numbers.size)
        for k, (box, separator) in enumerate(level):
            one, around = inside(separator), np.setdiff1d(inside(_wide(box, shape, reach)), inside(box))
            eliminated[k, : len(one)], border[k, : len(around)] = one, around
        places = None
        if levels:
            both, before = np.concatenate([eliminated, border], axis=1), levels[-1].border
            places = np.full((len(level), 2, both.shape[1]), before.shape[1])
            for k, part in np.ndindex(places.shape[:2]):
                among = before[2 * k + part]  # sorted
                place = np.minimum(np.searchsorted(among, both[k]), len(among) - 1)
                there = (among[place] == both[k]) & (both[k] < numbers.size)
                places[k, part, there] = place[there]
        levels.append(Level(eliminated, border, places))
    return tuple(levels)
