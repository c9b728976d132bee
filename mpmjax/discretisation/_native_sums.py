"""The sums between particles and nodes by the native library: what it is given, and for which sums it has kernels.

Its kernels sum a value and a gradient, of first nodes and offsets. All arrays have `batched` leading axes.
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
        and len(basis.knots) in (2, 3, 4)
        and max(len(basis.weights[0]), len(basis.slopes[0])) <= 9  # as in native/problems.h
    )


def basis_attributes(basis: Basis) -> dict[str, Any]:
    """A basis as the library is told it, with as many coefficients for each polynomial."""
    coefficients = np.zeros((2, len(basis.knots), max(len(basis.weights[0]), len(basis.slopes[0]))))
    for family, rows in enumerate((basis.weights, basis.slopes)):
        coefficients[family, :, : len(rows[0])] = rows
    return {
        "shape": np.array(basis.shape, np.int64),
        "periodic": np.array(basis.periodic, np.int64),
        "knots": np.array(basis.knots),
        "weights": coefficients[0].ravel(),
        "slopes": coefficients[1].ravel(),
    }


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
        some = {g.terms: a for g, a in zip(groups, rows, strict=True) if g.moved == moved}
        amounts, valued = _given(basis, some)
        operands = [first, t, *(along if moved else ()), *amounts]
        told = basis_attributes(basis) | {"differential": moved, "valued": valued}
        total += call_library("scatter", operands, [(shape, t.dtype)], told)
    return [total[0] + total[1]] if len(total) == 2 else total


def native_gather(
    first: Array, t: Array, *rest: Array, basis: Basis, groups: Sequence[Any], batched: int
) -> list[Array]:
    """`gather` by the library: what is moved and what is not in a call each."""
    *along, nodes = rest
    out = {}
    for moved in {group.moved for group in groups}:
        operands = [first, t, *(along if moved else ()), nodes]
        told = basis_attributes(basis) | {"differential": moved}
        value, gradients = call_library("gather", operands, _gathered(first, nodes), told)
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
    results = [(t.shape, t.dtype), *(_gathered(first, f) if gathered else [])]
    told = basis_attributes(basis) | {"valued": valued}
    by_t, *out = call_library("pull", [first, t, f, *amounts], results, told)
    of = {basis.value: jnp.expand_dims(out[0], -3), basis.gradient: out[1]} if gathered else {}
    return [by_t, *(of[some] for some in terms if gathered)]


def native_average(
    first: Array, t: Array, least: Array, *rows: Array, basis: Basis, groups: Sequence[Any], size: int, batched: int
) -> list[Array]:
    """`average` by the library."""
    amounts, _ = _given(basis, dict(zip((group.terms for group in groups), rows, strict=True)))
    batch, columns = first.shape[:batched], rows[0].shape[-2]
    shapes = (size,), (size, columns - 1), (size, columns)  # the last one holds the sums before they are divided
    results = [((*batch, *s), t.dtype) for s in shapes]
    return call_library("average", [first, t, least, *amounts], results, basis_attributes(basis))[:2]


def native_resist(first: Array, t: Array, upper: Array, u: Array, *, basis: Basis, batched: int) -> list[Array]:
    """`resist` by the library."""
    del batched
    return call_library("resist", [first, t, upper, u], [(u.shape, u.dtype)], basis_attributes(basis))
