"""Nested dissection: the factor of a matrix that couples near nodes of a box, and the order of its elimination."""

import functools
import itertools
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

    eliminated: np.ndarray
    """The numbers that are eliminated, shape (fronts, s)."""
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

    shape: tuple[int, ...] = eqx.field(static=True)
    """Number of nodes along each axis."""
    reach: int = eqx.field(static=True)
    """Largest distance of two nodes that are coupled, in spacings along an axis."""
    materials: int = eqx.field(static=True, default=1)
    """How many numbers a node has."""

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
        return self.materials**2 * _entries(_best(self.shape, self.reach), self.reach)[0]


class DissectedFactor(eqx.Module):
    """S = L Lᵀ by blocks, front by front (I. S. Duff, J. K. Reid, ACM Trans. Math. Softw. 9 (1983) 302, doi
    10.1145/356044.356047). With o what a front eliminates, b its border, and F what is left of S when it is reached,

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
    inverse, below, left = [], [], None
    for level in dissection.levels:
        eliminated = level.eliminated.shape[1]
        F, rest = _assembled(dissection.size, level, entries, left)
        L = jnp.linalg.cholesky(F[:, :eliminated])
        X = solve_triangular(L, jnp.broadcast_to(jnp.eye(eliminated, dtype=F.dtype), L.shape), lower=True)
        Y = jnp.einsum("fbo,fpo->fbp", F[:, eliminated:], X)
        inverse.append(X)
        below.append(Y)
        left = rest - jnp.einsum("fbo,fco->fbc", Y, Y)
    return DissectedFactor(tuple(inverse), tuple(below), dissection)


def _assembled(
    size: int, level: Level, entries: Callable[[Array, Array], Array], left: Array | None
) -> tuple[Float[Array, "f m o"], Array]:
    """The rest of S in the columns of each front, whose numbers past the last are those of the identity, and what
    the fronts before take from the border, shape (f, b, b), or a zero.

    Args:
        size: how many numbers S has.
        level: the fronts.
        entries: the entries of S.
        left: what those before take, shape (2f, b, b); None at the first level.
    """
    eliminated = level.eliminated.shape[1]

    def columns(numbers: Array) -> Array:
        F = entries(numbers, numbers[:eliminated])
        return F + jnp.eye(*F.shape, dtype=F.dtype) * (numbers[:eliminated] >= size).astype(F.dtype)

    def front(one: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        numbers, pair, places = one
        F = columns(numbers)
        rest = jnp.zeros((), F.dtype)
        for taken, place in zip(pair, places, strict=True):
            rows = jnp.pad(taken, (0, 1))[place]
            F = F + rows[:, place[:eliminated]]
            rest = rest + rows[eliminated:, place[eliminated:]]
        return F, rest

    numbers = jnp.asarray(np.concatenate([level.eliminated, level.border], axis=1))
    if left is None or level.places is None:
        F = jax.lax.map(columns, numbers)
        return F, jnp.zeros((), F.dtype)
    return jax.lax.map(front, (numbers, left.reshape(-1, 2, *left.shape[1:]), jnp.asarray(level.places)))


class _Box(NamedTuple):
    """A box of nodes, its border, and the separator that cuts it; the whole box if nothing does."""

    low: tuple[int, ...]
    high: tuple[int, ...]
    lattice: tuple[int, ...]
    cut: tuple[int, int] | None = None
    """The axis, and the separator's first plane."""

    @property
    def sides(self) -> tuple[int, ...]:
        return tuple(high - low for low, high in zip(self.low, self.high, strict=True))

    def wide(self, reach: int) -> "_Box":
        """The box with its border."""
        low = tuple(max(at - reach, 0) for at in self.low)
        return _Box(low, tuple(min(at + reach, n) for at, n in zip(self.high, self.lattice, strict=True)), self.lattice)

    def halved(self, axis: int, reach: int) -> "_Box":
        """The box, cut in the middle of an axis by a separator of `reach` planes."""
        return self._replace(cut=(axis, self.low[axis] + (self.sides[axis] - reach) // 2))

    def part(self, axis: int, low: int, high: int) -> "_Box":
        """The part between two planes."""
        first, last = ((*end[:axis], at, *end[axis + 1 :]) for end, at in ((self.low, low), (self.high, high)))
        return _Box(first, last, self.lattice)

    def eliminated(self, reach: int) -> "_Box":
        """The separator; the whole box if it is not cut."""
        return self if self.cut is None else self.part(self.cut[0], self.cut[1], self.cut[1] + reach)

    def parts(self, reach: int) -> tuple["_Box", "_Box"]:
        """The two subdomains."""
        assert self.cut is not None
        axis, at = self.cut
        return self.part(axis, self.low[axis], at), self.part(axis, at + reach, self.high[axis])

    def numbers(self, numbers: np.ndarray) -> np.ndarray:
        return numbers[tuple(map(slice, self.low, self.high))].reshape(-1)


def _cuts(shape: tuple[int, ...], reach: int) -> list[list[list[_Box]]]:
    """The boxes from the whole one on, when they are cut never, once, twice and so on."""
    cuts, above, boxes = [], [], [_Box((0,) * len(shape), shape, shape)]
    while True:
        cuts.append([*above, boxes])
        axis = int(np.argmax(boxes[-1].sides))
        if min(box.sides[axis] for box in boxes) < reach + 2 or math.prod(boxes[-1].sides) <= _SMALLEST:
            return cuts
        halved = [box.halved(axis, reach) for box in boxes]
        above, boxes = [*above, halved], list(itertools.chain(*(box.parts(reach) for box in halved)))


def _counts(boxes: list[_Box], reach: int) -> tuple[int, int]:
    """The most nodes that a front of a level eliminates, and the most of its border."""
    eliminated = max(math.prod(box.eliminated(reach).sides) for box in boxes)
    return eliminated, max(math.prod(box.wide(reach).sides) - math.prod(box.sides) for box in boxes)


def _entries(cuts: list[list[_Box]], reach: int) -> tuple[int, int]:
    """How many numbers the factor has with one number a node, and the most that are left between two levels."""
    sizes = [(len(boxes), *_counts(boxes, reach)) for boxes in cuts]
    return sum(f * s * (s + b) for f, s, b in sizes), max(f * b * b for f, _, b in sizes)


@functools.lru_cache(maxsize=64)
def _best(shape: tuple[int, ...], reach: int) -> list[list[_Box]]:
    return min(_cuts(shape, reach), key=lambda cuts: sum(_entries(cuts, reach)))


@functools.lru_cache(maxsize=64)
def _levels(shape: tuple[int, ...], reach: int, materials: int) -> tuple[Level, ...]:
    numbers = np.arange(math.prod(shape) * materials).reshape(*shape, materials)
    levels: list[Level] = []
    for boxes in reversed(_best(shape, reach)):
        most, widest = (materials * count for count in _counts(boxes, reach))
        eliminated = np.full((len(boxes), most), numbers.size)
        border = np.full((len(boxes), widest), numbers.size)
        for k, box in enumerate(boxes):
            one = box.eliminated(reach).numbers(numbers)
            around = np.setdiff1d(box.wide(reach).numbers(numbers), box.numbers(numbers))
            eliminated[k, : len(one)], border[k, : len(around)] = one, around
        places = None
        if levels:
            both, before = np.concatenate([eliminated, border], axis=1), levels[-1].border
            places = np.stack(
                [[_places(row, before[2 * k + part], numbers.size) for part in (0, 1)] for k, row in enumerate(both)]
            )
        levels.append(Level(eliminated, border, places))
    return tuple(levels)


def _places(numbers: np.ndarray, among: np.ndarray, past: int) -> np.ndarray:
    """Where each number stands in a sorted list; the list's length where it does not, or is past the last."""
    place = np.minimum(np.searchsorted(among, numbers), len(among) - 1)
    return np.where((among[place] == numbers) & (numbers < past), place, len(among))
