"""The two sums that cross between particles and grid: `collect` and `spread`, each other's transpose.

Weights and gradients of a stencil are products of one factor an axis, so both sums are factorised: what is summed along
the last axis, with its weights and with its slopes, meets one factor for each axis before it, and a gradient costs
hardly more than a value.

Each is a JAX primitive, linear in all but the stencil. Its transpose is the other one, to every order, where JAX itself
would transpose each read of a node to an addition of whole grids; with respect to the stencil it is differentiated as
written. Another back end replaces them here, and nothing else.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mpmjax._kernel import Stencil
from mpmjax._types import Array, Float

_ROW = 4
"""Most columns of the rows that are added to nodes. A CPU adds one, two or four numbers as one vector; three take it
three times as long as four, being added one by one."""


def collect(stencil: Stencil, nodes: Float[Array, "n c"]) -> tuple[Float[Array, "c p"], Float[Array, "d c p"]]:
    """The sums over each particle's nodes Σ_i w_ip f_i, and Σ_i g_ip f_i for each direction of the gradient.

    Args:
        stencil: stencil of the particles.
        nodes: f_i, shape (n, c).
    """
    value, *slopes = _collect_p.bind(*_factors(stencil), nodes, batched=0)
    return value, jnp.stack(slopes)


def spread(
    stencil: Stencil, value: Float[Array, "c p"] | None, slopes: Float[Array, "d c p"] | None, size: int
) -> Float[Array, "n c"]:
    """The sums at the nodes Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b): `collect`'s transpose.

    What goes to a node that does not exist is dropped.

    Args:
        stencil: stencil of the particles.
        value: a_p, shape (c, p), or None for zero.
        slopes: a_p,b for each direction b, shape (d, c, p), or None for zero.
        size: number of nodes n.
    """
    given = [*([] if value is None else [value]), *([] if slopes is None else slopes)]
    return _spread_p.bind(*_factors(stencil), *given, valued=value is not None, size=size, batched=0)[0]


def _factors(stencil: Stencil) -> tuple[Array, Array, Array]:
    return stencil.shares, stencil.weights, stencil.slopes


def _collect(shares: Array, weights: Array, slopes: Array, nodes: Array, *, unroll: bool) -> list[Array]:
    """Value and slopes, each (c, p)."""
    d, s, p = shares.shape

    def summed(axis: int, first: Array) -> list[Array]:
        """Over this axis and those after it, from a first node: the value, then a slope an axis, each (p, c)."""
        if axis == d - 1:
            rows = [nodes.at[first + share].get(mode="clip", wrap_negative_indices=False) for share in shares[axis]]
            return [_total([f[:, None] * r for f, r in zip(fs[axis], rows, strict=True)]) for fs in (weights, slopes)]

        @jax.checkpoint
        def add(totals: list[Array], along: tuple[Array, Array, Array]) -> tuple[list[Array], None]:
            share, w, g = along
            value, *rest = summed(axis + 1, first + share)
            w, g = w[:, None], g[:, None]
            terms = [w * value, g * value, *(w * r for r in rest)]
            return [total + term for total, term in zip(totals, terms, strict=True)], None

        zeros = [jnp.zeros((p, nodes.shape[1]), nodes.dtype)] * (d - axis + 1)
        return jax.lax.scan(add, zeros, (shares[axis], weights[axis], slopes[axis]), unroll=s if unroll else 1)[0]

    return [rows.T for rows in summed(0, jnp.zeros((p,), shares.dtype))]


def _spread(
    shares: Array, weights: Array, slopes: Array, *given: Array, valued: bool, size: int, unroll: bool
) -> list[Array]:
    """The nodes' sums, (n, c)."""
    d, s, p = shares.shape
    c = given[0].shape[0]

    def add(axis: int, first: Array, value: Array | None, rest: list[Array], nodes: Array) -> Array:
        """What the nodes along this axis and those after it receive, from a first node."""

        def at(nodes: Array, along: tuple[Array, Array, Array]) -> tuple[Array, None]:
            share, w, g = along
            w, g = w[:, None], g[:, None]
            row = _total([*([] if value is None else [w * value]), *(g * r for r in rest[:1])])
            if axis < d - 1:
                return add(axis + 1, first + share, row, [w * r for r in rest[1:]], nodes), None
            return nodes.at[first + share].add(row, mode="drop", wrap_negative_indices=False), None

        along = shares[axis], weights[axis], slopes[axis]
        if axis < d - 1:
            return jax.lax.scan(jax.checkpoint(at), nodes, along, unroll=s if unroll else 1)[0]
        for i in range(s):
            nodes, _ = at(nodes, jax.tree.map(lambda a, i=i: a[i], along))
        return nodes

    blocks = []
    for start in range(0, c, _ROW):
        block = [a[start : start + _ROW] for a in given]
        width = block[0].shape[0]
        padded = 1 << (width - 1).bit_length()
        rows = [jnp.pad(b, ((0, padded - width), (0, 0))).T for b in block]
        value, rest = (rows[0], rows[1:]) if valued else (None, rows)
        nodes = jnp.zeros((size, padded), given[0].dtype)
        blocks.append(add(0, jnp.zeros((p,), shares.dtype), value, rest, nodes)[:, :width])
    return [jnp.concatenate(blocks, axis=1)]


def _total(terms: list[Array]) -> Array:
    return sum(terms[1:], start=terms[0])


_collect_p, _spread_p = Primitive("stencil_collect"), Primitive("stencil_spread")


def _register(primitive: Primitive, function: Callable[..., list[Array]]) -> None:
    """What JAX asks of a primitive of shares, weights, slopes and what it is linear in, but for its transpose."""

    def run(*args: Array, batched: int, unroll: bool = False, **params: Any) -> list[Array]:
        members = partial(function, unroll=unroll, **params)
        for _ in range(batched):
            members = jax.vmap(members)
        return members(*args)

    def shapes(*args: Any, **params: Any) -> list[Any]:
        return [jax.core.ShapedArray(o.shape, o.dtype) for o in jax.eval_shape(partial(run, **params), *args)]

    def batch(args: tuple, axes: tuple, *, batched: int, **params: Any) -> tuple[list[Array], list[int]]:
        size = next(a.shape[x] for a, x in zip(args, axes, strict=True) if x is not batching.not_mapped)
        args = tuple(batching.bdim_at_front(a, x, size) for a, x in zip(args, axes, strict=True))
        out = primitive.bind(*args, batched=batched + 1, **params)
        return out, [0] * len(out)

    def jvp(primals: tuple, tangents: tuple, **params: Any) -> tuple[list[Array], list[Any]]:
        shares, weights, slopes, *values = primals
        dfactors, dvalues = tangents[1:3], tangents[3:]
        out = primitive.bind(*primals, **params)
        parts = [[ad.Zero.from_primal_value(o) for o in out]]
        if not all(type(t) is ad.Zero for t in dvalues):
            parts.append(primitive.bind(shares, weights, slopes, *map(ad.instantiate_zeros, dvalues), **params))
        if not all(type(t) is ad.Zero for t in dfactors):
            of_stencil = lambda w, g: run(shares, w, g, *values, **params)  # noqa: E731
            parts.append(jax.jvp(of_stencil, (weights, slopes), tuple(map(ad.instantiate_zeros, dfactors)))[1])
        return out, [reduce(ad.add_tangents, each) for each in zip(*parts, strict=True)]

    primitive.multiple_results = True
    primitive.def_impl(run)
    primitive.def_abstract_eval(shapes)
    batching.primitive_batchers[primitive] = batch
    ad.primitive_jvps[primitive] = jvp
    mlir.register_lowering(primitive, mlir.lower_fun(partial(run, unroll=True), multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(run, multiple_results=True), platform="cpu")


def _transpose_collect(cotangents: list, *args: Any, batched: int) -> tuple:
    *factors, nodes = args
    valued = type(cotangents[0]) is not ad.Zero
    slopes = [] if all(type(t) is ad.Zero for t in cotangents[1:]) else cotangents[1:]
    given = map(ad.instantiate_zeros, [*cotangents[: 1 if valued else 0], *slopes])
    out = _spread_p.bind(*factors, *given, valued=valued, size=nodes.aval.shape[-2], batched=batched)
    return None, None, None, *out


def _transpose_spread(cotangents: list, *args: Any, valued: bool, size: int, batched: int) -> tuple:
    del size
    factors, given = args[:3], args[3:]
    out = _collect_p.bind(*factors, ad.instantiate_zeros(cotangents[0]), batched=batched)
    out = out[: len(given)] if valued else out[1:]
    return None, None, None, *(o if ad.is_undefined_primal(a) else None for o, a in zip(out, given, strict=True))


_register(_collect_p, _collect)
_register(_spread_p, _spread)
ad.primitive_transposes[_collect_p] = _transpose_collect
ad.primitive_transposes[_spread_p] = _transpose_spread
