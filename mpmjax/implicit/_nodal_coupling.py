"""How a sum of squares of nodal sums couples the nodes of a box."""

import itertools
import math
from collections.abc import Callable
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, NodeVector


class NodeBox(eqx.Module):
    """A box of nodes in a window, which may be anywhere in it."""

    window: tuple[int, ...] = eqx.field(static=True)
    """Number of the window's nodes along each axis."""
    shape: tuple[int, ...] = eqx.field(static=True)
    """Number of the box's nodes along each axis."""
    corner: Int[Array, "d"]
    """The box's first node along each axis."""

    @staticmethod
    def around(some: Bool[Array, "n"], window: tuple[int, ...], shape: tuple[int, ...]) -> "NodeBox":
        """The box that begins where something is, as far as the window goes."""
        lattice, axes = some.reshape(window), range(len(window))
        first = [jnp.argmax(lattice.any(axis=tuple(b for b in axes if b != a))) for a in axes]
        room = jnp.asarray(np.subtract(window, shape))
        return NodeBox(window, shape, jnp.minimum(jnp.stack(first), room))

    def inside(self, field: Float[Array, "*a n"], spare: int = 0) -> Float[Array, "*a m"]:
        """A field of nodes (..., n) in the box and so many nodes around it, zero beyond the window."""
        front = field.shape[:-1]
        lattice = field.reshape(*front, *self.window)
        lattice = jnp.pad(lattice, [(0, 0)] * len(front) + [(spare, spare)] * len(self.window))
        sizes = [length + 2 * spare for length in self.shape]
        return jax.lax.dynamic_slice(lattice, self._start(front), (*front, *sizes)).reshape(*front, -1)

    def outside(self, field: Float[Array, "*a m"]) -> Float[Array, "*a n"]:
        """A field of the box's nodes (..., m) in the window, zero beyond the box."""
        front = field.shape[:-1]
        lattice = jnp.zeros((*front, *self.window), field.dtype)
        own = field.reshape(*front, *self.shape)
        return jax.lax.dynamic_update_slice(lattice, own, self._start(front)).reshape(*front, -1)

    def _start(self, front: tuple[int, ...]) -> tuple[Array, ...]:
        return (*(jnp.zeros_like(self.corner[0]) for _ in front), *self.corner)


class NodalCoupling(eqx.Module):
    """S = B P⁻¹ Bᵀ + diagonal, by the distance of the nodes that it couples.

    B takes a vector at the nodes to some numbers at each, and sees what is up to `half` nodes away.
    """

    by_distance: Float[Array, "a b s m"]
    """S_ij for each number of node i and of node j = i + δ, by δ from −2 half to 2 half along each axis."""
    half: int = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    """Number of the nodes along each axis."""

    @property
    def diagonal(self) -> Float[Array, "a m"]:
        """The diagonal of S."""
        a = np.arange(len(self.by_distance))
        return self.by_distance[a, a, self.by_distance.shape[2] // 2]

    def plus(self, diagonal: Float[Array, "a m"]) -> "NodalCoupling":
        """S with this added to its diagonal."""
        a = np.arange(len(diagonal))
        added = self.by_distance.at[a, a, self.by_distance.shape[2] // 2].add(diagonal)
        return NodalCoupling(added, self.half, self.shape)

    def entries(self, rows: Int[Array, "i"], columns: Int[Array, "j"]) -> Float[Array, "i j"]:
        """The entries in these rows and columns, zero past the last. The numbers of a node stand together."""
        count, span, reach = len(self.by_distance), 4 * self.half + 1, 2 * self.half
        size = math.prod(self.shape) * count
        (i, a), (j, b) = (jnp.divmod(numbers, count) for numbers in (rows, columns))
        inside = (rows < size)[:, None] & (columns < size)
        distance = jnp.zeros(inside.shape, i.dtype)
        for one, other in zip(*(jnp.unravel_index(k, self.shape) for k in (i, j)), strict=True):
            apart = other - one[:, None]
            inside &= jnp.abs(apart) <= reach
            distance = span * distance + apart + reach
        return jnp.where(inside, self.by_distance[a[:, None], b, distance, i[:, None]], 0)


def nodal_coupling(
    transpose: Callable[[Float[Array, "a n"]], NodeVector],
    weight: NodeVector,
    some: Bool[Array, "a m"],
    box: NodeBox,
    half: int,
) -> NodalCoupling:
    """B P⁻¹ Bᵀ.

    Bᵀ of fields that are one at every (2 half + 1)-th node along each axis has each of its entries by itself. Each node
    of the vectors then couples all pairs of nodes that see it.

    Args:
        transpose: Bᵀ.
        weight: the diagonal of P, shape (n, d).
        some: which numbers in the box count; the others' rows and columns are zero.
        box: the nodes that S couples.
        half: how many nodes away B sees.
    """
    d, period, count = weight.shape[1], 2 * half + 1, len(some)
    offsets = np.array(list(itertools.product(range(-half, half + 1), repeat=d)))  # of a vector's node from B's
    places = period ** np.arange(d)[::-1]

    def colours(shape: tuple[int, ...], shift: np.ndarray) -> np.ndarray:
        along = [(np.arange(length) + s) % period * p for length, s, p in zip(shape, shift, places, strict=True)]
        return reduce(np.add, np.ix_(*along)).reshape(-1)

    own = jnp.asarray(colours(box.shape, np.zeros(d, int)))

    def column(which: tuple[Array, Array]) -> Float[Array, "d k"]:
        material, colour = which
        q = (own == colour) & (jnp.arange(count) == material)[:, None] & some
        return box.inside(transpose(box.outside(q.astype(weight.dtype))).T, half)

    materials, numbers = (jnp.asarray(a) for a in np.divmod(np.arange(count * period**d), period**d))
    columns = jax.lax.map(column, (materials, numbers)).reshape(count, period**d, d, -1)
    wide = tuple(length + 2 * half for length in box.shape)
    seen = jnp.asarray(np.stack([colours(wide, -half - offset) for offset in offsets]))
    entries = jnp.take_along_axis(columns, seen[None, :, None], axis=1)  # of each vector's node, by offset
    lattices = entries.reshape(count, period**d, d, *wide)
    scale = box.inside(1 / weight.T, half).reshape(d, *wide)

    def add(total: Array, which: tuple[Array, Array]) -> tuple[Array, None]:
        number, offset = which
        one = jax.lax.dynamic_index_in_dim(lattices, number, 1, keepdims=False) * scale

        def cut(field: Array) -> Array:
            front = field.ndim - d
            start = (*(jnp.zeros_like(number) for _ in range(front)), *(half + offset))
            return jax.lax.dynamic_slice(field, start, (*field.shape[:front], *box.shape))

        one, other = cut(one), cut(lattices[:, ::-1])
        pairs = reduce(jnp.add, (one[:, None, None, k] * other[None, :, :, k] for k in range(d)))
        pairs = pairs.reshape(count, count, *(period,) * d, *box.shape)
        start = (*(jnp.zeros_like(number),) * 2, *(half + offset), *(jnp.zeros_like(number) for _ in range(d)))
        before = jax.lax.dynamic_slice(total, start, pairs.shape)
        return jax.lax.dynamic_update_slice(total, before + pairs, start), None

    nothing = jnp.zeros((count, count, *(4 * half + 1,) * d, *box.shape), weight.dtype)
    every = jnp.arange(len(offsets)), jnp.asarray(offsets, dtype=jnp.arange(0).dtype)
    total = jax.lax.scan(add, nothing, every)[0]
    return NodalCoupling(total.reshape(count, count, (4 * half + 1) ** d, -1), half, box.shape)
