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

from collections.abc import Sequence
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float
from mpmjax.autodiff import custom_derivative, is_unknown, materialised, saved_for_backward
from mpmjax.discretisation._native_sums import Rows, call_gather, call_pull, call_scatter
from mpmjax.discretisation._stencil import Basis, Stencil, Term, differentiated
from mpmjax.discretisation._written_sums import Factors, written_gather, written_pull, written_scatter


class Group(NamedTuple):
    """Terms that share an array."""

    terms: tuple[Term, ...]
    moved: bool = False  # whether they are differentiated along dt


Groups = tuple[Group, ...]


def gather(
    stencil: Stencil, nodes: Float[Array, "n c"], *, saved: bool = False
) -> tuple[Float[Array, "c p"], Float[Array, "d c p"]]:
    """Sums over the nodes of each particle: Σ_i w_ip f_i, and Σ_i g_ip f_i for each direction of the gradient.

    Args:
        stencil: stencil of the particles.
        nodes: f_i, shape (n, c).
        saved: whether they are `saved_for_backward`, from which JAX can transpose nothing.
    """
    basis = stencil.basis
    if stencil.own_derivatives is None:
        groups = Group(basis.value), Group(basis.gradient)
        out = gather_sum(stencil.first, stencil.offset, None, nodes, basis=basis, groups=groups)
        (value,), gradients = materialised(saved_for_backward(out, sums=True)) if saved else out
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
    return scatter_sum(stencil.first, stencil.offset, None, rows, basis=stencil.basis, groups=groups, size=size)


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


# The sums, with dt where groups are moved and else None.


def _moved(groups: Groups, moved: bool = True) -> Groups:
    return tuple(group._replace(moved=moved) for group in groups)


def _plain(groups: Groups) -> Groups:
    """The groups with ∂T/∂t in place of moved terms."""
    return tuple(Group(differentiated(group.terms) if group.moved else group.terms) for group in groups)


def _times(groups: Groups, rows: Rows, dt: Any) -> list[Array]:
    """Amounts for the `_plain` groups: a ⊗ dt, dt_b a of all terms for the first axis, the second, ..."""
    return [jnp.concatenate([a * by for by in dt]) if group.moved else a for group, a in zip(groups, rows, strict=True)]


def _along(groups: Groups, out: Sequence[Array], dt: Any) -> list[Array]:
    """Σ_b dt_b a_b of what the `_plain` groups are given, the transpose of `_times`."""

    def inner(a: Array) -> Any:
        return sum(part * by for part, by in zip(jnp.split(a, len(dt)), dt, strict=True))

    return [inner(a) if group.moved else a for group, a in zip(groups, out, strict=True)]


def _factors(basis: Basis, first: Array, t: Array, groups: Groups) -> Factors:
    return Factors.of(basis, first, t, [term for group in groups for term in group.terms])


@partial(
    custom_derivative,
    kernel="scatter",
    results=lambda _, t, dt, rows, size, **__: jax.ShapeDtypeStruct((size, max(a.shape[1] for a in rows)), t.dtype),
    call=call_scatter,
    unrolls=True,
)
def scatter_sum(
    first: Array, t: Array, dt: Any, rows: Rows, *, basis: Basis, groups: Groups, size: int, unroll: bool = False
) -> Array:
    """∂B/∂f, (n, c), of what particles give to each group."""
    plain = _plain(groups)
    pairs = [(group.terms, row) for group, row in zip(plain, _times(groups, rows, dt), strict=True)]
    return written_scatter(_factors(basis, first, t, plain), pairs, size, unroll)


@partial(
    custom_derivative,
    kernel="gather",
    results=lambda _, t, dt, nodes, groups, **__: [
        jax.ShapeDtypeStruct((len(group.terms), nodes.shape[1], t.shape[1]), t.dtype) for group in groups
    ],
    call=call_gather,
    unrolls=True,
)
def gather_sum(
    first: Array, t: Array, dt: Any, nodes: Array, *, basis: Basis, groups: Groups, unroll: bool = False
) -> list[Array]:
    """∂B/∂a, (terms, c, p) for each group."""
    plain = _plain(groups)
    terms = [term for group in plain for term in group.terms]
    of = written_gather(_factors(basis, first, t, plain), terms, nodes, unroll)
    return _along(groups, [jnp.stack([of[term] for term in group.terms]) for group in plain], dt)


@partial(custom_derivative, kernel="pull", call=call_pull)
def pull_sum(
    first: Array, t: Array, nodes: Array, rows: Rows, *, basis: Basis, groups: Groups, gathered: bool
) -> tuple[Array, list[Array]]:
    """∂B/∂t, (d, p), and if `gathered` ∂B/∂a of each group."""
    moved = _plain(_moved(groups))
    pairs = [
        [(some.terms[b * len(a) : (b + 1) * len(a)], a) for some, a in zip(moved, rows, strict=True)]
        for b in range(len(t))
    ]
    by_t = written_pull(_factors(basis, first, t, moved), pairs, nodes)
    return by_t, gather_sum.function(first, t, None, nodes, basis=basis, groups=groups) if gathered else []


# Forward mode. Of a sum of moved groups it is that of the same sum of plain ones.


def _total(parts: Sequence[Any]) -> Any:
    """The sum of parts of a change; the other parts are zero."""
    return jax.tree.map(lambda *each: reduce(jnp.add, each), *parts)


def scatter_change(
    first: Array, t: Array, dt: Any, rows: Rows, changes: Sequence[Any], groups: Groups, **params: Any
) -> Array | None:
    """The differential of a scatter of groups that are not moved, None if nothing changes."""
    some = [(group, da) for group, da in zip(groups, changes, strict=True) if da is not None]
    every, amounts = tuple(group for group, _ in some), [da for _, da in some]
    if dt is not None:
        every, amounts = (*_moved(groups), *every), [*rows, *amounts]
    if not every:
        return None
    change = scatter_sum(first, t, dt, amounts, groups=every, **params)
    lacking = max(a.shape[1] for a in rows) - change.shape[1]  # columns that nothing which changes has
    return jnp.pad(change, ((0, 0), (0, lacking)))


@scatter_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple[Array, Any]:
    if primals[2] is not None:

        def plain(first: Array, t: Array, dt: Array, rows: Rows) -> Array:
            return scatter_sum(first, t, None, _times(groups, rows, dt), groups=_plain(groups), **params)

        return eqx.filter_jvp(plain, primals, tangents)
    (first, t, _, rows), (_, dt, _, changes) = primals, tangents
    change = scatter_change(first, t, dt, rows, changes, groups, **params)
    return scatter_sum(*primals, groups=groups, **params), change


@gather_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple[list[Array], Any]:
    if primals[2] is not None:

        def plain(first: Array, t: Array, dt: Array, nodes: Array) -> list[Array]:
            return _along(groups, gather_sum(first, t, None, nodes, groups=_plain(groups), **params), dt)

        return eqx.filter_jvp(plain, primals, tangents)
    (first, t, _, nodes), (_, dt, _, df) = primals, tangents
    parts = [] if df is None else [gather_sum(first, t, None, df, groups=groups, **params)]
    if dt is not None:
        parts.append(gather_sum(first, t, dt, nodes, groups=_moved(groups), **params))
    return gather_sum(*primals, groups=groups, **params), _total(parts)


@pull_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, gathered: bool, **params: Any) -> tuple:
    if gathered:

        def apart(first: Array, t: Array, nodes: Array, rows: Rows) -> tuple[Array, list[Array]]:
            by_t, _ = pull_sum(first, t, nodes, rows, groups=groups, gathered=False, **params)
            return by_t, gather_sum(first, t, None, nodes, groups=groups, **params)

        return eqx.filter_jvp(apart, primals, tangents)
    (first, t, nodes, rows), (_, dt, df, changes) = primals, tangents
    pull = partial(pull_sum, first, t, gathered=False, **params)
    parts = [] if df is None else [pull(df, rows, groups=groups)]
    some = [(group, da) for group, da in zip(groups, changes, strict=True) if da is not None]
    if some:
        parts.append(pull(nodes, [da for _, da in some], groups=tuple(group for group, _ in some)))
    if dt is not None:
        moved = _moved(groups)
        parts.append(pull(nodes, _times(moved, rows, dt), groups=_plain(moved)))
    return pull(nodes, rows, groups=groups), _total(parts)


# Reverse mode.


def _of_unknown(rows: Sequence[Any], out: Sequence[Array]) -> list:
    """Gathered rows for those that are asked for, in the columns that these have."""
    remaining = iter(out)
    return [next(remaining)[:, : a.shape[1]] if is_unknown(a) else None for a in rows]


@scatter_sum.deftranspose
def _(nodes: Array, args: tuple, *, groups: Groups, size: int, **params: Any) -> tuple:
    """By dt the pull of what is moved, by what is given the gather: in one pass where both are asked for."""
    first, t, dt, rows = args
    pairs = list(zip(groups, rows, strict=True))
    wanted = tuple(group for group, a in pairs if is_unknown(a))
    if not is_unknown(dt):
        along = dt if any(group.moved for group in wanted) else None
        return None, None, None, _of_unknown(rows, gather_sum(first, t, along, nodes, groups=wanted, **params))
    pulled = _moved(tuple(group for group, _ in pairs if group.moved), False)
    amounts = [a for group, a in pairs if group.moved]
    together = bool(wanted) and set(wanted) <= set(pulled)
    by_t, out = pull_sum(first, t, nodes, amounts, groups=pulled, gathered=together, **params)
    if together:
        out = [out[pulled.index(group)] for group in wanted]
    elif wanted:
        out = gather_sum(first, t, None, nodes, groups=wanted, **params)
    return None, None, by_t, _of_unknown(rows, out)


@gather_sum.deftranspose
def _(cotangents: list, args: tuple, *, groups: Groups, **params: Any) -> tuple:
    """By f the scatter, by dt the pull."""
    first, t, dt, nodes = args
    some = [(group, a) for group, a in zip(groups, cotangents, strict=True) if a is not None]
    rows, every = [a for _, a in some], tuple(group for group, _ in some)
    if not is_unknown(nodes):
        by_t, _ = pull_sum(first, t, nodes, rows, groups=_moved(every, False), gathered=False, **params)
        return None, None, by_t, None
    along = dt if any(group.moved for group in every) else None
    return None, None, None, scatter_sum(first, t, along, rows, groups=every, size=nodes.shape[0], **params)


@pull_sum.deftranspose
def _(cotangents: tuple, args: tuple, *, groups: Groups, gathered: bool, **params: Any) -> tuple:
    """By f the scatter, by what is given the gather, both moved along the cotangent."""
    assert not gathered  # the forward rule takes both apart
    (dt, _), (first, t, nodes, rows), moved = cotangents, args, _moved(groups)
    if is_unknown(nodes):
        back = scatter_sum(first, t, dt, rows, groups=moved, size=nodes.shape[0], **params)
        return None, None, back, [None] * len(rows)
    wanted = tuple(group for group, a in zip(moved, rows, strict=True) if is_unknown(a))
    return None, None, None, _of_unknown(rows, gather_sum(first, t, dt, nodes, groups=wanted, **params))
