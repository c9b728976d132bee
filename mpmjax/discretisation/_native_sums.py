"""The sums between particles and nodes as kernels of back ends: what they are given.

Kernels sum a value and a gradient, of places ξ. All arrays have the leading axes of a batch.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.discretisation._stencil import Basis

Rows = Sequence[Array]  # values and gradients, (..., c, p), a group each
Call = Callable[..., list[Array]]
"""A kernel as a function of operands, attributes, and results if they are not those of the sum (see
`custom_derivative`)."""


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


def _have_kernels(basis: Basis, groups: Sequence[Any]) -> bool:
    """Whether terms are those of the value and of the gradient, each once."""
    terms = [(group.terms, group.moved) for group in groups]
    return len(set(terms)) == len(terms) and all(some in (basis.value, basis.gradient) for some, _ in terms)


def _given(basis: Basis, amounts: dict[Any, Array]) -> list[Array | None]:
    """Value and gradients as kernels are given them. The value has no fewer columns."""
    value = amounts.get(basis.value)
    return [None if value is None else value[..., 0, :, :], amounts.get(basis.gradient)]


def call_scatter(
    call: Call, xi: Array, dxi: Any, rows: Rows, *, basis: Basis, groups: Sequence[Any], size: int
) -> Array | None:
    """`scatter_sum`: what is moved and what is not in a call each."""
    if not _have_kernels(basis, groups):
        return None
    total = []
    for moved in dict.fromkeys(group.moved for group in groups):
        some = {g.terms: a for g, a in zip(groups, rows, strict=True) if g.moved == moved}
        total += call([xi, dxi if moved else None, *_given(basis, some)], basis_attributes(basis))
    return sum(total[1:], total[0])


def call_gather(
    call: Call, xi: Array, dxi: Any, nodes: Array, *, basis: Basis, groups: Sequence[Any]
) -> list[Array] | None:
    """`gather_sum`: what is moved and what is not in a call each."""
    if not _have_kernels(basis, groups):
        return None
    out = {}
    for moved in {group.moved for group in groups}:
        operands = [xi, dxi if moved else None, nodes]
        value, gradients = call(operands, basis_attributes(basis), results=_value_and_gradients(xi, nodes))
        out[basis.value, moved], out[basis.gradient, moved] = jnp.expand_dims(value, -3), gradients
    return [out[group.terms, group.moved] for group in groups]


def _value_and_gradients(xi: Array, nodes: Array) -> list[jax.ShapeDtypeStruct]:
    d, p, columns = *xi.shape[-2:], nodes.shape[-1]
    return [jax.ShapeDtypeStruct(shape, nodes.dtype) for shape in ((columns, p), (d, columns, p))]


def call_pull(
    call: Call, xi: Array, nodes: Array, rows: Rows, *, basis: Basis, groups: Sequence[Any], gathered: bool
) -> tuple[Array, list[Array]] | None:
    """`pull_sum`, and with `gathered` the gather of the nodes."""
    if not _have_kernels(basis, groups):
        return None
    terms = [group.terms for group in groups]
    operands = [xi, nodes, *_given(basis, dict(zip(terms, rows, strict=True)))]
    results = [jax.ShapeDtypeStruct(xi.shape[-2:], xi.dtype), *(_value_and_gradients(xi, nodes) if gathered else [])]
    by_xi, *out = call(operands, basis_attributes(basis), results=results)
    of = {basis.value: jnp.expand_dims(out[0], -3), basis.gradient: out[1]} if gathered else {}
    return by_xi, [of[some] for some in terms if gathered]


def call_average(
    call: Call, xi: Array, least: Array, rows: Rows, *, basis: Basis, groups: Sequence[Any], size: int
) -> list[Array]:
    """`average_sum`."""
    amounts = _given(basis, dict(zip((group.terms for group in groups), rows, strict=True)))
    columns = rows[0].shape[-2]
    shapes = (size,), (size, columns - 1), (size, columns)  # the last one holds the sums before they are divided
    results = [jax.ShapeDtypeStruct(shape, xi.dtype) for shape in shapes]
    return call([xi, least, *amounts], basis_attributes(basis), results=results)[:2]


def call_p2g(
    call: Call,
    stencil: Any,
    least: Array,
    mass: Array,
    v: Array,
    C: Any,
    impulse: Any,
    push: Any,
    *,
    basis: Basis,
    size: int,
) -> list[Array] | None:
    """`p2g_sum`, but for stencils with gradients of their own or without any."""
    if stencil.own_derivatives is not None or stencil.flat is not None or (C is None and impulse is None):
        return None
    factor, A, B = (jnp.zeros_like(least), None, None) if impulse is None else impulse
    A, q, r = (None, *A) if isinstance(A, tuple) else (A, None, None)
    operands = [stencil.xi, least, stencil.slope, factor, mass, v, push, C, A, B, q, r]
    d = v.shape[-2]
    shapes = (size,), (size, d), (size, d + 1)  # the last one holds the sums before they are divided
    results = [jax.ShapeDtypeStruct(shape, v.dtype) for shape in shapes]
    return call(operands, basis_attributes(basis), results=results)[:2]


def call_g2p(
    call: Call, stencil: Any, nodes: Array, dt: Array, x: Array, F: Any, *, basis: Basis
) -> list[Array] | None:
    """`g2p_sum`, but for stencils with gradients of their own or without any. Particles are moved in place."""
    if stencil.own_derivatives is not None or stencil.flat is not None:
        return None
    operands = [stencil.xi, nodes, stencil.slope, dt, x, F]
    return call(operands, basis_attributes(basis), aliases={4: 2} if F is None else {4: 2, 5: 3})
