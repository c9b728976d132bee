"""The two sums between particles and grid: `gather` and `scatter`, each the transpose of the other.

Weights and gradients of a stencil are products of one factor for each axis, so both sums are factorised: partial sums
along the last axis are multiplied by one factor for each axis before it. A gradient then costs little more than a
value.

Both are partial derivatives of one multilinear form,

    B(factors; a, f) = Σ_ip f_i · (w_ip a_p + Σ_b g_ip,b a_p,b),    scatter = ∂B/∂f,  gather = ∂B/∂a,

and the pull is the third, ∂B/∂factors. They are JAX primitives so that each is the derivative of the others. JAX itself
would transpose every read of a node to an addition of whole grids. On CPUs the native library replaces these sums and
nothing else; as written here they are the reference, and what other devices run.
"""

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad

from mpmjax._types import Array, Float
from mpmjax.discretisation._placed import bound, define_jvp, define_placed
from mpmjax.discretisation._stencil import Stencil
from mpmjax.native import members, native_primitive, sums_fit

_ROW = 4
"""Largest number of columns that are added to the nodes at once. A CPU adds one, two or four numbers as one vector;
three take it three times as long as four, being added one by one."""


def gather(stencil: Stencil, nodes: Float[Array, "n c"]) -> tuple[Float[Array, "c p"], Float[Array, "d c p"]]:
    """Sums over the nodes of each particle: Σ_i w_ip f_i, and Σ_i g_ip f_i for each direction of the gradient.

    Args:
        stencil: stencil of the particles.
        nodes: f_i, shape (n, c).
    """
    value, gradients = bound(gather_p, stencil, nodes, batched=0)
    return value, gradients


def scatter(
    stencil: Stencil, value: Float[Array, "c p"] | None, gradients: Float[Array, "d k p"] | None, size: int
) -> Float[Array, "n c"]:
    """Sums at the nodes Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b), the transpose of `gather`.

    Terms at nodes outside of the window are dropped.

    Args:
        stencil: stencil of the particles.
        value: a_p, shape (c, p), or None for zero.
        gradients: a_p,b for each direction b, shape (d, k, p), or None for zero. Where it has fewer columns than the
            value, k < c, it is zero in those that come after.
        size: number of nodes n.
    """
    rows = [a for a in (value, gradients) if a is not None]
    return bound(scatter_p, stencil, *rows, valued=value is not None, size=size, batched=0)[0]


# The sums themselves, of rows (p, c): `_narrow` takes what a particle gives one axis further in, to one node along it;
# `_widen` what it is given one axis further out.


def _narrow(value: Array | None, gradients: list[Array], w: Array, g: Array) -> tuple[Array, list[Array]]:
    parts = [*([] if value is None else [w[:, None] * value]), *(g[:, None] * gradient for gradient in gradients[:1])]
    return reduce(jnp.add, parts), [w[:, None] * gradient for gradient in gradients[1:]]


def _widen(value: Array, gradients: list[Array], w: Array, g: Array) -> list[Array]:
    return [w[:, None] * value, g[:, None] * value, *(w[:, None] * gradient for gradient in gradients)]


def _along(axis: int, factors: tuple[Array, ...], step: Callable[..., tuple], start: Any, unroll: bool) -> Any:
    """`lax.scan` over the nodes along an axis, unrolled along the last one, or with `unroll` along all.

    A loop over a few kernels is the fastest on a CPU, a single kernel on a GPU.
    """
    each = tuple(factor[axis] for factor in factors)
    return jax.lax.scan(step, start, each, unroll=each[0].shape[0] if unroll or axis == len(factors[0]) - 1 else 1)


def _gather(*args: Array, unroll: bool) -> list[Array]:
    """∂B/∂a: the value (c, p), and the gradients (d, c, p)."""
    *factors, nodes = args
    d, _, p = factors[0].shape

    def summed(axis: int, first: Array) -> list[Array]:
        """The sums over this axis and those after it, from a first node: the value, then a gradient for each axis."""
        if axis == d:
            return [nodes.at[first].get(mode="clip", wrap_negative_indices=False)]

        def add(totals: list[Array], factor: tuple[Array, ...]) -> tuple[list[Array], None]:
            share, w, g = factor
            value, *gradients = summed(axis + 1, first + share)
            return [t + a for t, a in zip(totals, _widen(value, gradients, w, g), strict=True)], None

        zeros = [jnp.zeros((p, nodes.shape[1]), nodes.dtype)] * (d - axis + 1)
        return _along(axis, tuple(factors), add, zeros, unroll)[0]

    value, *gradients = (rows.T for rows in summed(0, jnp.zeros((p,), factors[0].dtype)))
    return [value, jnp.stack(gradients)]


def written_scatter(*args: Array, valued: bool, size: int, unroll: bool) -> list[Array]:
    """∂B/∂f: the nodes' sums, (n, c)."""
    factors, rows = args[:3], args[3:]
    columns, p = rows[0].shape[-2:]
    d = len(factors[0])

    def add(axis: int, first: Array, value: Array | None, gradients: list[Array], nodes: Array) -> Array:
        """The nodes with the sums along this axis and those after it added, from a first node."""
        if axis == d:
            return nodes.at[first].add(value, mode="drop", wrap_negative_indices=False)

        def step(nodes: Array, factor: tuple[Array, ...]) -> tuple[Array, None]:
            share, w, g = factor
            return add(axis + 1, first + share, *_narrow(value, gradients, w, g), nodes), None

        return _along(axis, factors, step, nodes, unroll)[0]

    blocks = []
    for start in range(0, columns, _ROW):
        width = min(columns - start, _ROW)
        padded = 1 << (width - 1).bit_length()
        value, gradients = _rows(rows, valued, start, padded)
        nodes = jnp.zeros((size, padded), rows[0].dtype)
        blocks.append(add(0, jnp.zeros((p,), factors[0].dtype), value, gradients, nodes)[:, :width])
    return [jnp.concatenate(blocks, axis=1)]


def _rows(arrays: Sequence[Array], valued: bool, start: int, width: int) -> tuple[Array | None, list[Array]]:
    """So many columns of the value and the gradients, as rows (p, width): zero in columns that they do not have."""

    def rows(a: Array) -> Array:
        block = a[start : start + width]
        return jnp.pad(block, ((0, width - len(block)), (0, 0))).T

    return rows(arrays[0]) if valued else None, [rows(a) for part in arrays[valued:] for a in part]


def _pull(*args: Array, valued: bool, unroll: bool) -> list[Array]:
    """∂B/∂factors at f and a: by the weights and by their derivatives, each (d, s, p)."""
    del unroll  # one kernel would be very long
    factors, nodes, rows = args[:3], args[3], args[4:]
    d, _, p = factors[0].shape

    def pulled(axis: int, first: Array, value: Array | None, gradients: list[Array]) -> tuple[list[Array], list]:
        """The gathered sums over this axis and those after it, and the derivatives with respect to their factors."""
        if axis == d:
            return [nodes.at[first].get(mode="clip", wrap_negative_indices=False)], []

        def step(carry: tuple[list[Array], list], factor: tuple[Array, ...]) -> tuple[Any, Any]:
            share, w, g = factor
            weighted, inner = pulled(axis + 1, first + share, *_narrow(value, gradients, w, g))
            by_weight = [a * f for a, f in zip([value, *gradients[1:]], weighted, strict=False) if a is not None]
            by_gradient = [a * weighted[0] for a in gradients[:1]]
            here = tuple(
                reduce(jnp.add, by, jnp.zeros_like(weighted[0])).sum(axis=1) for by in (by_weight, by_gradient)
            )
            return jax.tree.map(jnp.add, carry, (_widen(weighted[0], weighted[1:], w, g), inner)), here

        zeros = [jnp.zeros((p, nodes.shape[1]), nodes.dtype)] * (d - axis + 1)
        inner = [(jnp.zeros_like(w), jnp.zeros_like(w)) for w in factors[1][axis + 1 :]]
        (totals, inner), here = _along(axis, factors, step, (zeros, inner), unroll=False)
        return totals, [here, *inner]

    value, gradients = _rows(rows, valued, 0, nodes.shape[1])
    by_axis = pulled(0, jnp.zeros((p,), factors[0].dtype), value, gradients)[1]
    weights, derivatives = zip(*by_axis, strict=True)
    return [jnp.stack(weights), jnp.stack(derivatives)]


def _by_factors(function: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
    """The differential of a sum with respect to its factors. Arguments: index factors, weights, weight derivatives, the
    differentials of both, then the other arguments of the sum."""

    def differential(*args: Array, **params: Any) -> list[Array]:
        index_factors, rest = args[0], args[5:]
        return jax.jvp(lambda *factors: function(index_factors, *factors, *rest, **params), args[1:3], args[3:5])[1]

    return differential


# What makes them primitives. Arguments are the factors, and then what the sum is of.


def _particle_rows(index_factors: ShapedArray, *others: ShapedArray) -> list[tuple]:
    d, _, p = index_factors.shape[-3:]
    columns = others[-1].shape[-1]
    return [(columns, p), (d, columns, p)]


def _node_rows(*args: ShapedArray, valued: bool, size: int, first: int) -> list[tuple]:
    """The result's rows, of a sum whose nodal values begin with the argument of this number."""
    del valued
    return [(size, args[first].shape[-2])]


def _factor_rows(index_factors: ShapedArray, *others: ShapedArray, valued: bool) -> list[tuple]:
    del others, valued
    return [index_factors.shape[-3:]] * 2


_sum_primitive = partial(native_primitive, fits=sums_fit)
_by_factors_primitive = partial(_sum_primitive, placed=False)
gather_p = _by_factors_primitive("stencil_gather", _gather, _particle_rows, differential=False)
scatter_p = _by_factors_primitive("stencil_scatter", written_scatter, partial(_node_rows, first=3), differential=False)
pull_p = _sum_primitive("stencil_pull", _pull, _factor_rows)
define_placed(gather_p, _gather, _particle_rows, differential=False)
define_placed(scatter_p, written_scatter, partial(_node_rows, first=3), differential=False)
_gather_by_factors_p = _by_factors_primitive(
    "stencil_gather_by_factors", _by_factors(_gather), _particle_rows, differential=True
)
_scatter_by_factors_p = _by_factors_primitive(
    "stencil_scatter_by_factors", _by_factors(written_scatter), partial(_node_rows, first=5), differential=True
)


# Two sums of one scatter, together where both are asked for: reverse mode then passes over the particles once.


def _scatter_differential(*args: Array, valued: bool, size: int, batched: int = 0, unroll: bool = False) -> list[Array]:
    """The differential of a scatter by the factors and by what is given. Arguments: the factors, the differentials of
    weights and weight derivatives, what is given, its differentials."""
    del unroll
    factors, changes, rest = args[:3], args[3:5], args[5:]
    values, moved = rest[: len(rest) // 2], rest[len(rest) // 2 :]
    params = {"valued": valued, "size": size, "batched": batched}
    (by_given,), (by_factors,) = (
        scatter_p.bind(*factors, *moved, **params),
        _scatter_by_factors_p.bind(*factors, *changes, *values, **params),
    )
    return [by_given + by_factors]


def _pull_and_gather(*args: Array, valued: bool, batched: int = 0, unroll: bool = False) -> list[Array]:
    """The transpose of `_scatter_differential`: the pull, and the gather of its nodes."""
    del unroll
    return [*pull_p.bind(*args, valued=valued, batched=batched), *gather_p.bind(*args[:4], batched=batched)]


def _pulled_and_gathered(*args: ShapedArray, valued: bool) -> list[tuple]:
    return _factor_rows(*args, valued=valued) + _particle_rows(*args[:4])


_scatter_differential_p = _sum_primitive(
    "stencil_scatter_differential",
    _scatter_differential,
    partial(_node_rows, first=5),
    fits=lambda avals, batched: False,
)
_pull_and_gather_p = _sum_primitive("stencil_pull_and_gather", _pull_and_gather, _pulled_and_gathered)


def _instantiated(tangents: Sequence[Any]) -> list[Array]:
    """The tangents as arrays; none if all are zero."""
    return [*map(ad.instantiate_zeros, tangents)] if any(type(t) is not ad.Zero for t in tangents) else []


def _tangents(
    primals: tuple,
    tangents: tuple,
    params: dict[str, Any],
    primitive: Primitive,
    by_factors: Primitive,
    differential: Primitive | None,
) -> list[Array]:
    """The differentials of a sum's results; none if nothing changes."""
    factors, rest, parts = primals[:3], primals[3:], []
    changes, moved = map(_instantiated, (tangents[1:3], tangents[3:]))
    if changes and moved and differential is not None:
        return differential.bind(*factors, *changes, *rest, *moved, **params)
    if moved:
        parts.append(primitive.bind(*factors, *moved, **params))
    if changes:
        parts.append(by_factors.bind(*factors, *changes, *rest, **params))
    return [reduce(jnp.add, part) for part in zip(*parts, strict=True)]


def scatter_tangent(primals: tuple, tangents: tuple, **params: Any) -> Array | None:
    """The differential of a scatter's result; None if nothing changes."""
    tangent = _tangents(primals, tangents, params, scatter_p, _scatter_by_factors_p, _scatter_differential_p)
    return tangent[0] if tangent else None


def _differentiate(
    primitive: Primitive,
    by_factors: Primitive,
    function: Callable[..., list[Array]],
    differential: Primitive | None = None,
) -> None:
    """Define the forward rules. The differential with respect to the factors is a primitive so that it has a transpose
    of its own; its own differential, which only second derivatives need, is that of the sum as written. `differential`
    is that with respect to all arguments."""

    def jvp(
        take: Callable[[], list[Array]], primals: tuple, tangents: tuple, **params: Any
    ) -> tuple[list[Array], list[Any]]:
        out = take()
        changes = _tangents(primals, tangents, params, primitive, by_factors, differential)
        return out, changes or [ad.Zero(jax.typeof(o)) for o in out]

    def jvp_by_factors(primals: tuple, tangents: tuple, *, batched: int, **params: Any) -> tuple:
        written = members(partial(_by_factors(function), unroll=False, **params), batched)
        rest = tuple(map(ad.instantiate_zeros, tangents[1:]))
        return jax.jvp(lambda *floats: written(primals[0], *floats), primals[1:], rest)

    define_jvp(primitive, jvp)
    ad.primitive_jvps[by_factors] = jvp_by_factors


def _jvp_of(parts: Callable[..., list[Array]]) -> Callable[..., tuple]:
    """The forward rule of sums that are taken together, by the rules of each."""

    def jvp(primals: tuple, tangents: tuple, **params: Any) -> tuple:
        rest = tuple(map(ad.instantiate_zeros, tangents[1:]))
        return jax.jvp(lambda *floats: parts(primals[0], *floats, **params), primals[1:], rest)

    return jvp


def _jvp_pull(primals: tuple, tangents: tuple, *, valued: bool, batched: int) -> tuple[list[Array], list[Any]]:
    """The pull is linear in f, and in a: its differential is a pull for each, and that of the sum as written by the
    factors."""
    factors, nodes, rows = primals[:3], primals[3], primals[4:]
    params = {"valued": valued, "batched": batched}
    out = pull_p.bind(*primals, **params)
    parts = [[ad.Zero(jax.typeof(o)) for o in out]]
    if type(tangents[3]) is not ad.Zero:
        parts.append(pull_p.bind(*factors, tangents[3], *rows, **params))
    if moved := _instantiated(tangents[4:]):
        parts.append(pull_p.bind(*factors, nodes, *moved, **params))
    if along := _instantiated(tangents[1:3]):
        written = members(partial(_pull, valued=valued, unroll=False), batched)
        parts.append(jax.jvp(lambda w, g: written(factors[0], w, g, *primals[3:]), factors[1:], tuple(along))[1])
    return out, [reduce(ad.add_tangents, part) for part in zip(*parts, strict=True)]


_differentiate(gather_p, _gather_by_factors_p, _gather)
_differentiate(scatter_p, _scatter_by_factors_p, written_scatter, _scatter_differential_p)
ad.primitive_jvps[pull_p] = _jvp_pull
ad.primitive_jvps[_scatter_differential_p] = _jvp_of(_scatter_differential)
ad.primitive_jvps[_pull_and_gather_p] = _jvp_of(_pull_and_gather)


def _given(cotangents: list) -> tuple[list[Array], bool]:
    """The cotangents of a gather as arguments of a scatter: value and gradients, or one of them if the other is zero;
    and whether there is a value."""
    valued = type(cotangents[0]) is not ad.Zero
    parts = [t for t in cotangents if type(t) is not ad.Zero] or cotangents[1:]
    return list(map(ad.instantiate_zeros, parts)), valued


def _of_undefined(results: Any, args: Any) -> list:
    return [f if ad.is_undefined_primal(a) else None for f, a in zip(results, args, strict=True)]


def _of_given(results: list[Array], args: Any, valued: bool) -> list:
    """The gathered value and gradients as cotangents of what is given, in the columns that it has."""
    parts = zip(results if valued else results[1:], args, strict=False)
    return [f[..., : a.aval.shape[-2], :] if ad.is_undefined_primal(a) else None for f, a in parts]


def _transpose_gather(cotangents: list, *args: Any, batched: int) -> list:
    rows, valued = _given(cotangents)
    size = args[3].aval.shape[-2]
    return [None, None, None, *scatter_p.bind(*args[:3], *rows, valued=valued, size=size, batched=batched)]


def _transpose_scatter(cotangents: list, *args: Any, valued: bool, size: int, batched: int) -> list:
    del size
    gathered = gather_p.bind(*args[:3], ad.instantiate_zeros(cotangents[0]), batched=batched)
    return [None, None, None, *_of_given(gathered, args[3:], valued)]


def _transpose_gather_by_factors(cotangents: list, *args: Any, batched: int) -> list:
    rows, valued = _given(cotangents)
    pulled = pull_p.bind(*args[:3], args[5], *rows, valued=valued, batched=batched)
    return [None, None, None, *_of_undefined(pulled, args[3:5]), None]


def _transpose_scatter_by_factors(cotangents: list, *args: Any, valued: bool, size: int, batched: int) -> list:
    del size
    nodes = ad.instantiate_zeros(cotangents[0])
    pulled = pull_p.bind(*args[:3], nodes, *args[5:], valued=valued, batched=batched)
    return [None, None, None, *_of_undefined(pulled, args[3:5]), *(None for _ in args[5:])]


def _transpose_scatter_differential(cotangents: list, *args: Any, valued: bool, size: int, batched: int) -> list:
    del size
    nodes, rest = ad.instantiate_zeros(cotangents[0]), args[5:]
    values, moved = rest[: len(rest) // 2], rest[len(rest) // 2 :]
    results = _pull_and_gather_p.bind(*args[:3], nodes, *values, valued=valued, batched=batched)
    by_changes, gathered = _of_undefined(results[:2], args[3:5]), results[2:]
    return [None, None, None, *by_changes, *(None for _ in values), *_of_given(gathered, moved, valued)]


def _transpose_pull(cotangents: list, *args: Any, valued: bool, batched: int) -> list:
    """Transpose with respect to f: the scatter's differential by the factors; with respect to a: the gather's."""
    factors, changes = args[:3], map(ad.instantiate_zeros, cotangents)
    if ad.is_undefined_primal(args[3]):
        params = {"valued": valued, "size": args[3].aval.shape[-2], "batched": batched}
        results = _scatter_by_factors_p.bind(*factors, *changes, *args[4:], **params)
        return [None, None, None, *results, *(None for _ in args[4:])]
    results = _gather_by_factors_p.bind(*factors, *changes, args[3], batched=batched)
    return [None, None, None, None, *_of_given(results, args[4:], valued)]


ad.primitive_transposes[gather_p] = _transpose_gather
ad.primitive_transposes[scatter_p] = _transpose_scatter
ad.primitive_transposes[_gather_by_factors_p] = _transpose_gather_by_factors
ad.primitive_transposes[_scatter_by_factors_p] = _transpose_scatter_by_factors
ad.primitive_transposes[_scatter_differential_p] = _transpose_scatter_differential
ad.primitive_transposes[pull_p] = _transpose_pull
