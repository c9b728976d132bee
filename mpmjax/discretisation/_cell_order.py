"""The order of particles by their cells, and arrays brought into it."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad

from mpmjax._types import Array, Bool, Float, Int, ParticleVector, components, particle_first
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import BSpline
from mpmjax.discretisation._stencil import first_nodes, index_factors
from mpmjax.native import native_primitive

Order = Int[Array, "p"]
"""The number of the particle that comes first, second, ..."""


def cells_of(kernel: BSpline, grid: Grid, window: Int[Array, "d"], x: ParticleVector) -> Int[Array, "p"]:
    """The C-order index of the first node of each particle's stencil, shape (p,): particles with the same one share all
    nodes. Without meaning outside of the window."""
    first = first_nodes(kernel, window, components(x) / grid.spacing)
    return index_factors(kernel, grid, first)[:, 0].sum(axis=0, dtype=jnp.int32)


def by_cell(cells: Int[Array, "p"]) -> Order:
    """The numbers of the particles cell after cell, and in a cell in their order, shape (p,)."""
    return _order_p.bind(cells, batched=0)[0]


def rearranged(wanted: Bool[Array, ""], order: Order, a: Float[Array, "p ..."]) -> Float[Array, "p ..."]:
    """An array in another order, a[order], where that is wanted, else as it is.

    On CPUs this is done in place, so that in a loop what is not wanted costs nothing; of a `jax.lax.cond` XLA copies
    what either branch returns. It is done component by component, as a step has its arrays: XLA would transpose them.
    """
    rows = components(a).reshape(-1, len(a))
    moved = _rearrange_p.bind(wanted, order, rows, batched=0)[0]
    return particle_first(moved.reshape(*a.shape[1:], len(a)))


def _sorted(cells: Array, *, unroll: bool) -> list[Array]:
    del unroll  # there is no loop
    return [jnp.argsort(cells, stable=True).astype(cells.dtype)]


def _rearranged(wanted: Array, order: Array, rows: Array, *, inverse: bool, unroll: bool = False) -> list[Array]:
    del unroll  # there is no loop
    moved = rows.at[:, order].set(rows, mode="drop") if inverse else rows.at[:, order].get(mode="clip")
    return [jnp.where(wanted, moved, rows)]


_order_p = native_primitive(
    "particle_order",
    _sorted,
    lambda cells: [cells.shape[-1:]],
    lambda avals, batched: avals[0].dtype == np.int32,
    like=0,
)


def _rearrange_primitive(inverse: bool) -> Primitive:
    def like_rows(wanted: ShapedArray, order: ShapedArray, rows: ShapedArray) -> list[tuple]:
        return [rows.shape[wanted.ndim :]]

    def fits(avals: Any, batched: int) -> bool:
        del batched
        return avals[1].dtype == np.int32 and avals[2].dtype in (np.float32, np.float64)

    return native_primitive(
        "particle_rearrange", partial(_rearranged, inverse=inverse), like_rows, fits, {2: 0}, like=2, inverse=inverse
    )


_rearrange_p, _restore_p = map(_rearrange_primitive, (False, True))


def _differentiate(primitive: Primitive, transpose: Primitive) -> None:
    """Define the derivative by the rows, in which it is linear, and its transpose, the other order."""

    def jvp(primals: tuple, tangents: tuple, *, batched: int) -> tuple[list[Array], list[Any]]:
        wanted, order, rows = primals
        out = primitive.bind(wanted, order, rows, batched=batched)
        if type(tangents[2]) is ad.Zero:
            return out, [ad.Zero(jax.typeof(o)) for o in out]
        return out, primitive.bind(wanted, order, tangents[2], batched=batched)

    def transposed(cotangents: list, wanted: Any, order: Any, rows: Any, *, batched: int) -> list:
        del rows
        back = transpose.bind(wanted, order, ad.instantiate_zeros(cotangents[0]), batched=batched)
        return [None, None, *back]

    ad.primitive_jvps[primitive] = jvp
    ad.primitive_transposes[primitive] = transposed


_differentiate(_rearrange_p, _restore_p)
_differentiate(_restore_p, _rearrange_p)
