"""The sums between particles and nodes by the native library: what it is given, and for which sums it has kernels.

Its kernels sum a value and a gradient, of first nodes and offsets, or of factors: the polynomials' values. A pull is by
the factors, of which the chain rule makes that by t. All arrays have `batched` leading axes.
"""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from mpmjax._jax import ShapedArray
from mpmjax._types import Array
from mpmjax.discretisation._basis import Basis
from mpmjax.native import call_library


def sums_fit(*avals: ShapedArray, basis: Basis, batched: int, groups: Sequence[Any] = (), **_: Any) -> bool:
    """Whether the library has a kernel for these sums."""
    del batched
    first, t, *others = avals
    terms = [(group.terms, group.moved) for group in groups]
    return (
        first.dtype == np.int32
        and t.dtype in (np.float32, np.float64)
        and all(aval.dtype in (t.dtype, np.bool_) for aval in others)
        and all(some in (basis.value, basis.gradient) for some, _ in terms)
        and len(set(terms)) == len(terms)
    )


def stencil_operands(basis: Basis, first: Array, t: Array, *along: Array) -> tuple[list[Array], dict[str, bool]]:
    """A stencil as the library takes it, and attributes that say how: first nodes and offsets where it knows their
    polynomials, else factors; and the changes of these along dt."""
    s, batch = len(basis.knots), first.shape[:-2]
    if not along and not any(basis.periodic) and len(basis.weights[0]) <= s + 1:
        table = np.zeros((2, s, s + 2), t.dtype)
        table[:, :, 0] = basis.knots
        for family, rows in enumerate((basis.weights, basis.slopes)):
            table[family, :, 1 : 1 + len(rows[0])] = rows
        fixed = np.array(basis.strides, np.int32), table
        strides, polynomials = (jnp.broadcast_to(jnp.asarray(a), (*batch, *a.shape)) for a in fixed)
        return [first, strides, t, polynomials], {"placed": True}
    return _factors(basis, first, t, *along), {"placed": False}


def _factors(basis: Basis, first: Array, t: Array, *along: Array) -> list[Array]:
    changes = [basis.polynomials((family, 1), t) * dt[..., None, :] for dt in along for family in (0, 1)]
    return [basis.index_terms(first), basis.polynomials((0, 0), t), basis.polynomials((1, 0), t), *changes]


def _given(basis: Basis, amounts: dict[Any, Array]) -> tuple[list[Array], bool]:
    """Value and gradients as the library is given them, and whether there is a value. It has no fewer columns."""
    value, gradients = amounts.get(basis.value), amounts.get(basis.gradient)
    rows = [] if value is None else [value[..., 0, :, :]]
    return rows + ([] if gradients is None else [gradients]), value is not None


def native_scatter(
    first: Array, t: Array, *rest: Array, basis: Basis, groups: Sequence[Any], size: int, batched: int
) -> list[Array]:
    """`scatter` by the library: what is moved and what is not in a call each."""
    moving = any(group.moved for group in groups)
    along, rows = rest[:moving], rest[moving:]
    shape = *first.shape[:batched], size, max(a.shape[-2] for a in rows)
    total = []
    for moved in dict.fromkeys(group.moved for group in groups):
        stencil, told = stencil_operands(basis, first, t, *(along if moved else ()))
        some = {g.terms: a for g, a in zip(groups, rows, strict=True) if g.moved == moved}
        amounts, valued = _given(basis, some)
        told |= {"differential": moved, "valued": valued}
        total += call_library("scatter", [*stencil, *amounts], [(shape, t.dtype)], told)
    return [total[0] + total[1]] if len(total) == 2 else total


def native_gather(
    first: Array, t: Array, *rest: Array, basis: Basis, groups: Sequence[Any], batched: int
) -> list[Array]:
    """`gather` by the library: what is moved and what is not in a call each."""
    *along, nodes = rest
    out = {}
    for moved in {group.moved for group in groups}:
        stencil, told = stencil_operands(basis, first, t, *(along if moved else ()))
        results = _gathered(first, nodes)
        value, gradients = call_library("gather", [*stencil, nodes], results, told | {"differential": moved})
        out[basis.value, moved], out[basis.gradient, moved] = jnp.expand_dims(value, -3), gradients
    return [out[group.terms, group.moved] for group in groups]


def _gathered(first: Array, nodes: Array) -> list[tuple]:
    """Shapes and dtypes of a value and its gradients."""
    (*batch, d, p), columns = first.shape, nodes.shape[-1]
    return [((*batch, columns, p), nodes.dtype), ((*batch, d, columns, p), nodes.dtype)]


def native_pull(
    first: Array, t: Array, f: Array, *rows: Array, basis: Basis, groups: Sequence[Any], gathered: bool, batched: int
) -> list[Array]:
    """`pull` by the library, and with `gathered` the gather of the nodes."""
    terms = [group.terms for group in groups]
    amounts, valued = _given(basis, dict(zip(terms, rows, strict=True)))
    factors = _factors(basis, first, t)
    results = [(factors[1].shape, t.dtype)] * 2 + _gathered(first, f) * gathered
    by_weights, by_slopes, *out = call_library("pull", [*factors, f, *amounts], results, {"valued": valued})
    by_t = by_weights * basis.polynomials((0, 1), t) + by_slopes * basis.polynomials((1, 1), t)
    of = {basis.value: jnp.expand_dims(out[0], -3), basis.gradient: out[1]} if gathered else {}
    return [by_t.sum(axis=-2), *(of[some] for some in terms if gathered)]


def native_average(
    first: Array, t: Array, least: Array, *rows: Array, basis: Basis, groups: Sequence[Any], size: int, batched: int
) -> list[Array]:
    """`average` by the library."""
    stencil, told = stencil_operands(basis, first, t)
    amounts, _ = _given(basis, dict(zip((group.terms for group in groups), rows, strict=True)))
    batch, columns = first.shape[:batched], rows[0].shape[-2]
    shapes = (size,), (size, columns - 1), (size, columns)  # the last one holds the sums before they are divided
    return call_library("average", [*stencil, least, *amounts], [((*batch, *s), t.dtype) for s in shapes], told)[:2]


def native_resist(first: Array, t: Array, upper: Array, u: Array, *, basis: Basis, batched: int) -> list[Array]:
    """`resist` by the library."""
    del batched
    stencil, told = stencil_operands(basis, first, t)
    return call_library("resist", [*stencil, upper, u], [(u.shape, u.dtype)], told)
