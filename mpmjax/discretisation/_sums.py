"""The sums between particles and nodes: three that are closed under differentiation.

Each weight, and each component of a gradient of a weight, is a product of one polynomial along each axis, of the
particle's offset t. A *term* names one polynomial for each axis, T_i(t) is its value at node i, and

    B(t; a, f) = Σ_p Σ_i Σ_T T_i(t_p) (a_p,T · f_i)

is linear in what particles give, a, and in what nodes have, f. The sums are its partial derivatives,

    scatter = ∂B/∂f,    gather = ∂B/∂a,    pull = ∂B/∂t.

∂T/∂t_b is the term with the polynomial along axis b replaced by its derivative. So derivatives of all orders and in
both modes are sums of these kinds. Along dt, a *moved* term stands for Σ_b dt_b ∂T/∂t_b:

    derivative of    by a or f        by t                              transpose of that by t
    scatter(t; a)    scatter(t; da)   scatter(t; a), moved along dt     pull(t; a, f̄)
    gather(t; f)     gather(t; df)    gather(t; f), moved along dt      pull(t; ā, f)
    pull(t; a, f)    pull             pull of the terms ∂T/∂t, a ⊗ dt   scatter, gather moved along the cotangent

Terms come in groups, each with one array of what particles give or are given, (terms, c, p): the value, and the
components of the gradient. Offsets and gradients are in spacings; `gather` and `scatter` scale them.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mpmjax._jax import Zero, add_tangents, instantiate_zeros, is_undefined_primal
from mpmjax._types import Array, Float
from mpmjax.autodiff import sums_saved_for_backward
from mpmjax.discretisation._basis import Basis, Term, differentiated
from mpmjax.discretisation._native_sums import native_gather, native_pull, native_scatter, sums_fit
from mpmjax.discretisation._stencil import Stencil
from mpmjax.discretisation._written_sums import Factors, written_gather, written_pull, written_scatter
from mpmjax.native import NativeFunction, materialised


class Group(NamedTuple):
    """Terms that share an array."""

    terms: tuple[Term, ...]
    moved: bool = False
    """Whether they are differentiated along dt."""


Groups = tuple[Group, ...]


def gather(
    stencil: Stencil, nodes: Float[Array, "n c"], *, saved: bool = False
) -> tuple[Float[Array, "c p"], Float[Array, "d c p"]]:
    """Sums over the nodes of each particle: Σ_i w_ip f_i, and Σ_i g_ip f_i for each direction of the gradient.

    Args:
        stencil: stencil of the particles.
        nodes: f_i, shape (n, c).
        saved: whether they are `sums_saved_for_backward`, from which JAX can transpose nothing.
    """
    basis = stencil.basis
    if stencil.own_derivatives is None:
        groups = Group(basis.value), Group(basis.gradient)
        out = gather_sum(stencil.first, stencil.offset, nodes, basis=basis, groups=groups)
        (value,), gradients = materialised(sums_saved_for_backward(out)) if saved else out
        gradients = gradients * stencil.slope
    else:
        of = written_gather(_own_factors(stencil), (*basis.value, *basis.gradient), nodes, unroll=False)
        value, gradients = of[basis.value[0]], jnp.stack([of[term] for term in basis.gradient])
    return value, gradients if stencil.flat is None else jnp.where(stencil.flat[:, None], 0, gradients)


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
    groups, rows = given_rows(stencil, value, gradients)
    if stencil.own_derivatives is not None:
        pairs = [(group.terms, row) for group, row in zip(groups, rows, strict=True)]
        return written_scatter(_own_factors(stencil), pairs, size, unroll=False)
    return scatter_sum(stencil.first, stencil.offset, *rows, basis=stencil.basis, groups=groups, size=size)[0]


def given_rows(stencil: Stencil, value: Array | None, gradients: Array | None) -> tuple[Groups, list[Array]]:
    """The groups of a scatter and their arrays, (terms, c, p), with gradients in spacings."""
    groups, rows = [], []
    if value is not None:
        groups, rows = [Group(stencil.basis.value)], [value[None]]
    if gradients is not None:
        scaled = gradients if stencil.own_derivatives is not None else gradients * stencil.slope
        groups.append(Group(stencil.basis.gradient))
        rows.append(scaled if stencil.flat is None else jnp.where(stencil.flat[:, None], 0, scaled))
    return tuple(groups), rows


def _own_factors(stencil: Stencil) -> Factors:
    pairs = zip(stencil.weights, stencil.weight_derivatives, strict=True)
    return Factors(stencil.basis.index_terms(stencil.first), tuple({(0, 0): w, (1, 0): g} for w, g in pairs))


# The sums as written in JAX, of one member of a batch. Arguments: first nodes, t, dt where groups are moved, and then
# f, what particles give, or both.


def _split(groups: Groups, args: Sequence[Any]) -> tuple[Any, Sequence[Any]]:
    """dt, None where no group is moved, and what comes after it."""
    return (args[0], args[1:]) if any(group.moved for group in groups) else (None, args)


def _moved(groups: Groups, moved: bool = True) -> Groups:
    return tuple(group._replace(moved=moved) for group in groups)


def _plain(groups: Groups) -> Groups:
    """The groups with ∂T/∂t in place of moved terms."""
    return tuple(Group(differentiated(group.terms) if group.moved else group.terms) for group in groups)


def _times(groups: Groups, rows: Sequence[Array], dt: Any) -> list[Array]:
    """Amounts for the `_plain` groups: a ⊗ dt, dt_b a of all terms for the first axis, the second, ..."""

    def outer(a: Array) -> Array:
        return jnp.concatenate([a * dt[..., b, None, None, :] for b in range(dt.shape[-2])], axis=-3)

    return [outer(a) if group.moved else a for group, a in zip(groups, rows, strict=True)]


def _along(groups: Groups, out: Sequence[Array], dt: Any) -> list[Array]:
    """Σ_b dt_b a_b of what the `_plain` groups are given, the transpose of `_times`."""

    def inner(a: Array) -> Any:
        parts = jnp.split(a, dt.shape[-2], axis=-3)
        return sum(part * dt[..., b, None, None, :] for b, part in enumerate(parts))

    return [inner(a) if group.moved else a for group, a in zip(groups, out, strict=True)]


def _factors(basis: Basis, first: Array, t: Array, groups: Groups) -> Factors:
    return Factors.of(basis, first, t, [term for group in groups for term in group.terms])


def _scatter(
    first: Array, t: Array, *rest: Array, basis: Basis, groups: Groups, size: int, unroll: bool
) -> list[Array]:
    dt, rows = _split(groups, rest)
    plain = _plain(groups)
    pairs = [(group.terms, row) for group, row in zip(plain, _times(groups, rows, dt), strict=True)]
    return [written_scatter(_factors(basis, first, t, plain), pairs, size, unroll)]


def _gather(first: Array, t: Array, *rest: Array, basis: Basis, groups: Groups, unroll: bool) -> list[Array]:
    dt, (nodes,) = _split(groups, rest)
    plain = _plain(groups)
    terms = [term for group in plain for term in group.terms]
    of = written_gather(_factors(basis, first, t, plain), terms, nodes, unroll)
    return _along(groups, [jnp.stack([of[term] for term in group.terms]) for group in plain], dt)


def _pull(
    first: Array, t: Array, nodes: Array, *rows: Array, basis: Basis, groups: Groups, gathered: bool
) -> list[Array]:
    moved = _plain(_moved(groups))
    pairs = [
        [(some.terms[b * len(a) : (b + 1) * len(a)], a) for some, a in zip(moved, rows, strict=True)]
        for b in range(len(t))
    ]
    by_t = written_pull(_factors(basis, first, t, moved), pairs, nodes)
    return [by_t, *(_gather(first, t, nodes, basis=basis, groups=groups, unroll=False) if gathered else [])]


def _node_shape(*args: Any, groups: Groups, size: int, **_: Any) -> list[tuple]:
    start = 2 + any(group.moved for group in groups)  # after dt
    return [(size, max(a.shape[-2] for a in args[start:]))]


def _particle_shapes(*args: Any, groups: Groups, **_: Any) -> list[tuple]:
    return [(len(group.terms), args[-1].shape[-1], args[0].shape[-1]) for group in groups]


def _pull_shapes(*args: Any, groups: Groups, gathered: bool, **_: Any) -> list[tuple]:
    return [args[1].shape[-2:], *(_particle_shapes(*args[:3], groups=groups) if gathered else [])]


scatter_sum = NativeFunction("scatter", _scatter, _node_shape, sums_fit, like=1, native=native_scatter, unrolls=True)
gather_sum = NativeFunction("gather", _gather, _particle_shapes, sums_fit, like=1, native=native_gather, unrolls=True)
pull_sum = NativeFunction("pull", _pull, _pull_shapes, sums_fit, like=1, native=native_pull)


# Forward mode.


def is_zero(tangent: Any) -> bool:
    """Whether a tangent or cotangent is zero as a matter of form."""
    return type(tangent) is Zero


def sum_of_changes(out: list[Array], parts: Sequence[Sequence[Array]]) -> list[Any]:
    """The tangents of results, of some parts or none."""
    zeros = [Zero(jax.typeof(o).to_tangent_aval()) for o in out]
    return [reduce(add_tangents, part, zero) for zero, *part in zip(zeros, *parts, strict=True)]


def _jvp_of(function: Callable[..., list[Array]], primals: tuple, tangents: tuple) -> tuple[list[Array], list[Array]]:
    """The forward rule of a sum by that of others."""
    return jax.jvp(function, primals, tuple(map(instantiate_zeros, tangents)))


def scatter_change(
    first: Array, t: Array, dt: Any, rows: Sequence[Array], changes: Sequence[Any], groups: Groups, **params: Any
) -> list[list[Array]]:
    """The differential of a scatter of groups that are not moved, as its only part; none if nothing changes."""
    some = [(group, da) for group, da in zip(groups, changes, strict=True) if not is_zero(da)]
    every, amounts = tuple(group for group, _ in some), [da for _, da in some]
    if not is_zero(dt):
        every, amounts = (*_moved(groups), *every), [dt, *rows, *amounts]
    if not every:
        return []
    (change,) = scatter_sum(first, t, *amounts, groups=every, **params)
    lacking = max(a.shape[-2] for a in rows) - change.shape[-1]  # columns that nothing which changes has
    return [[jnp.pad(change, [(0, 0)] * (change.ndim - 1) + [(0, lacking)])]]


def _scatter_jvp(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple:
    first, t, *rest = primals
    dt, rows = _split(groups, rest)
    if dt is not None:

        def plain(first: Array, t: Array, dt: Array, *rows: Array) -> list[Array]:
            return scatter_sum(first, t, *_times(groups, rows, dt), groups=_plain(groups), **params)

        return _jvp_of(plain, primals, tangents)
    out = scatter_sum(*primals, groups=groups, **params)
    return out, sum_of_changes(out, scatter_change(first, t, tangents[1], rows, tangents[2:], groups, **params))


def _gather_jvp(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple:
    if any(group.moved for group in groups):

        def plain(first: Array, t: Array, dt: Array, nodes: Array) -> list[Array]:
            return _along(groups, gather_sum(first, t, nodes, groups=_plain(groups), **params), dt)

        return _jvp_of(plain, primals, tangents)
    first, t, nodes = primals
    _, dt, df = tangents
    out = gather_sum(*primals, groups=groups, **params)
    parts = [] if is_zero(df) else [gather_sum(first, t, df, groups=groups, **params)]
    if not is_zero(dt):
        parts.append(gather_sum(first, t, dt, nodes, groups=_moved(groups), **params))
    return out, sum_of_changes(out, parts)


def _pull_jvp(primals: tuple, tangents: tuple, *, groups: Groups, gathered: bool, **params: Any) -> tuple:
    if gathered:

        def apart(first: Array, t: Array, nodes: Array, *rows: Array) -> list[Array]:
            by_t = pull_sum(first, t, nodes, *rows, groups=groups, gathered=False, **params)
            return [*by_t, *gather_sum(first, t, nodes, groups=groups, **params)]

        return _jvp_of(apart, primals, tangents)
    first, t, nodes, *rows = primals
    _, dt, df, *changes = tangents
    params["gathered"] = False
    out = pull_sum(*primals, groups=groups, **params)
    parts = [] if is_zero(df) else [pull_sum(first, t, df, *rows, groups=groups, **params)]
    if not all(map(is_zero, changes)):
        parts.append(pull_sum(first, t, nodes, *map(instantiate_zeros, changes), groups=groups, **params))
    if not is_zero(dt):
        moved = _moved(groups)
        parts.append(pull_sum(first, t, nodes, *_times(moved, rows, dt), groups=_plain(moved), **params))
    return out, sum_of_changes(out, parts)


scatter_sum.jvp, gather_sum.jvp, pull_sum.jvp = _scatter_jvp, _gather_jvp, _pull_jvp


# Reverse mode.


def _of_undefined(rows: Sequence[Any], out: Sequence[Array]) -> list:
    """Gathered rows for those that are asked for, in the columns that these have."""
    remaining = iter(out)
    return [next(remaining)[..., : a.aval.shape[-2], :] if is_undefined_primal(a) else None for a in rows]


def _scatter_transpose(
    cotangents: list, first: Array, t: Array, *rest: Any, groups: Groups, size: int, **params: Any
) -> list:
    """By dt the pull of what is moved, by what is given the gather: in one pass where both are asked for."""
    del size
    nodes, (dt, rows) = instantiate_zeros(cotangents[0]), _split(groups, rest)
    pairs = list(zip(groups, rows, strict=True))
    wanted = tuple(group for group, a in pairs if is_undefined_primal(a))
    if dt is None or not is_undefined_primal(dt):
        along: list[Any] = [dt] if any(group.moved for group in wanted) else []
        out = gather_sum(first, t, *along, nodes, groups=wanted, **params)
        return [None, None, *([] if dt is None else [None]), *_of_undefined(rows, out)]
    pulled = _moved(tuple(group for group, _ in pairs if group.moved), False)
    amounts = [a for group, a in pairs if group.moved]
    together = bool(wanted) and set(wanted) <= set(pulled)
    by_t, *out = pull_sum(first, t, nodes, *amounts, groups=pulled, gathered=together, **params)
    if together:
        out = [out[pulled.index(group)] for group in wanted]
    elif wanted:
        out = gather_sum(first, t, nodes, groups=wanted, **params)
    return [None, None, by_t, *_of_undefined(rows, out)]


def _gather_transpose(cotangents: list, first: Array, t: Array, *rest: Any, groups: Groups, **params: Any) -> list:
    """By f the scatter, by dt the pull."""
    dt, (nodes,) = _split(groups, rest)
    some = [(group, a) for group, a in zip(groups, cotangents, strict=True) if not is_zero(a)]
    rows, every = [a for _, a in some], tuple(group for group, _ in some)
    if not is_undefined_primal(nodes):
        by_t = pull_sum(first, t, nodes, *rows, groups=_moved(every, False), gathered=False, **params)
        return [None, None, *by_t, None]
    args = first, t, *([dt] if any(group.moved for group in every) else []), *rows
    size = nodes.aval.shape[-2]
    back = scatter_sum(*args, groups=every, size=size, **params) if every else [Zero(nodes.aval)]
    return [None, None, *([] if dt is None else [None]), *back]


def _pull_transpose(
    cotangents: list, first: Array, t: Array, nodes: Any, *rows: Any, groups: Groups, gathered: bool, **params: Any
) -> list:
    """By f the scatter, by what is given the gather, both moved along the cotangent."""
    assert not gathered  # the forward rule takes both apart
    dt, moved = instantiate_zeros(cotangents[0]), _moved(groups)
    if is_undefined_primal(nodes):
        back = scatter_sum(first, t, dt, *rows, groups=moved, size=nodes.aval.shape[-2], **params)
        return [None, None, *back, *(None for _ in rows)]
    wanted = tuple(group for group, a in zip(moved, rows, strict=True) if is_undefined_primal(a))
    return [None, None, None, *_of_undefined(rows, gather_sum(first, t, dt, nodes, groups=wanted, **params))]


scatter_sum.transpose, gather_sum.transpose, pull_sum.transpose = _scatter_transpose, _gather_transpose, _pull_transpose
