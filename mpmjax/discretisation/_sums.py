"""The sums between particles and nodes: three that are closed under differentiation.

Each weight, and each component of a gradient of a weight, is a product of one polynomial along each axis, of the
particle's place ξ. A *term* names one polynomial for each axis, T_i(ξ) is its value at node i, and

    B(ξ; a, f) = Σ_p Σ_i Σ_T T_i(ξ_p) (a_p,T · f_i)

is linear in what particles give, a, and in what nodes have, f. The sums are its partial derivatives,

    scatter = ∂B/∂f,    gather = ∂B/∂a,    pull = ∂B/∂ξ.

∂T/∂ξ_b is the term with the polynomial along axis b replaced by its derivative. So derivatives of all orders and in
both modes are sums of these kinds. Along dξ, a *moved* term stands for Σ_b dξ_b ∂T/∂ξ_b:

    derivative of    by a or f        by ξ                              transpose of that by ξ
    scatter(ξ; a)    scatter(ξ; da)   scatter(ξ; a), moved along dξ     pull(ξ; a, f̄)
    gather(ξ; f)     gather(ξ; df)    gather(ξ; f), moved along dξ      pull(ξ; ā, f)
    pull(ξ; a, f)    pull             pull of the terms ∂T/∂ξ, a ⊗ dξ   scatter, gather moved along the cotangent

Terms come in groups, each with one array of what particles give or are given, (terms, c, p): the value, and the
components of the gradient. Places and gradients are in spacings; `gather` and `scatter` scale them.
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
    moved: bool = False  # whether they are differentiated along dξ


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
        out = gather_sum(stencil.xi, None, nodes, basis=basis, groups=groups)
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
    return scatter_sum(stencil.xi, None, rows, basis=stencil.basis, groups=groups, size=size)


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
    return Factors(stencil.basis.index_terms(stencil.xi), tuple({(0, 0): w, (1, 0): g} for w, g in pairs))


# The sums, with dξ where groups are moved and else None.


def _moved(groups: Groups, moved: bool = True) -> Groups:
    return tuple(group._replace(moved=moved) for group in groups)


def _plain(groups: Groups) -> Groups:
    """The groups with ∂T/∂ξ in place of moved terms."""
    return tuple(Group(differentiated(group.terms) if group.moved else group.terms) for group in groups)


def _times(groups: Groups, rows: Rows, dxi: Any) -> list[Array]:
    """Amounts for the `_plain` groups: a ⊗ dξ, dξ_b a of all terms for the first axis, the second, ..."""
    return [
        jnp.concatenate([a * by for by in dxi]) if group.moved else a for group, a in zip(groups, rows, strict=True)
    ]


def _along(groups: Groups, out: Sequence[Array], dxi: Any) -> list[Array]:
    """Σ_b dξ_b a_b of what the `_plain` groups are given, the transpose of `_times`."""

    def inner(a: Array) -> Any:
        return sum(part * by for part, by in zip(jnp.split(a, len(dxi)), dxi, strict=True))

    return [inner(a) if group.moved else a for group, a in zip(groups, out, strict=True)]


def _factors(basis: Basis, xi: Array, groups: Groups) -> Factors:
    return Factors.of(basis, xi, [term for group in groups for term in group.terms])


@partial(
    custom_derivative,
    kernel="scatter",
    results=lambda xi, dxi, rows, size, **__: jax.ShapeDtypeStruct((size, max(a.shape[1] for a in rows)), xi.dtype),
    call=call_scatter,
    unrolls=True,
)
def scatter_sum(
    xi: Array, dxi: Any, rows: Rows, *, basis: Basis, groups: Groups, size: int, unroll: bool = False
) -> Array:
    """∂B/∂f, (n, c), of what particles give to each group."""
    plain = _plain(groups)
    pairs = [(group.terms, row) for group, row in zip(plain, _times(groups, rows, dxi), strict=True)]
    return written_scatter(_factors(basis, xi, plain), pairs, size, unroll)


@partial(
    custom_derivative,
    kernel="gather",
    results=lambda xi, dxi, nodes, groups, **__: [
        jax.ShapeDtypeStruct((len(group.terms), nodes.shape[1], xi.shape[1]), xi.dtype) for group in groups
    ],
    call=call_gather,
    unrolls=True,
)
def gather_sum(xi: Array, dxi: Any, nodes: Array, *, basis: Basis, groups: Groups, unroll: bool = False) -> list[Array]:
    """∂B/∂a, (terms, c, p) for each group."""
    plain = _plain(groups)
    terms = [term for group in plain for term in group.terms]
    of = written_gather(_factors(basis, xi, plain), terms, nodes, unroll)
    return _along(groups, [jnp.stack([of[term] for term in group.terms]) for group in plain], dxi)


@partial(
    custom_derivative,
    kernel="pull",
    results=lambda xi, nodes, _, groups, gathered, **__: (
        xi,
        [jax.ShapeDtypeStruct((len(g.terms), nodes.shape[1], xi.shape[1]), xi.dtype) for g in groups if gathered],
    ),
    call=call_pull,
)
def pull_sum(
    xi: Array, nodes: Array, rows: Rows, *, basis: Basis, groups: Groups, gathered: bool
) -> tuple[Array, list[Array]]:
    """∂B/∂ξ, (d, p), and if `gathered` ∂B/∂a of each group."""
    moved = _plain(_moved(groups))
    pairs = [
        [(some.terms[b * len(a) : (b + 1) * len(a)], a) for some, a in zip(moved, rows, strict=True)]
        for b in range(len(xi))
    ]
    by_xi = written_pull(_factors(basis, xi, moved), pairs, nodes)
    return by_xi, gather_sum.function(xi, None, nodes, basis=basis, groups=groups) if gathered else []


# Forward mode. Of a sum of moved groups it is that of the same sum of plain ones.


def _total(parts: Sequence[Any]) -> Any:
    """The sum of parts of a change; the other parts are zero."""
    return jax.tree.map(lambda *each: reduce(jnp.add, each), *parts)


def scatter_change(
    xi: Array, dxi: Any, rows: Rows, changes: Sequence[Any], groups: Groups, **params: Any
) -> Array | None:
    """The differential of a scatter of groups that are not moved, None if nothing changes."""
    some = [(group, da) for group, da in zip(groups, changes, strict=True) if da is not None]
    every, amounts = tuple(group for group, _ in some), [da for _, da in some]
    if dxi is not None:
        every, amounts = (*_moved(groups), *every), [*rows, *amounts]
    if not every:
        return None
    change = scatter_sum(xi, dxi, amounts, groups=every, **params)
    lacking = max(a.shape[1] for a in rows) - change.shape[1]  # columns that nothing which changes has
    return jnp.pad(change, ((0, 0), (0, lacking)))


@scatter_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple[Array, Any]:
    if primals[1] is not None:

        def plain(xi: Array, dxi: Array, rows: Rows) -> Array:
            return scatter_sum(xi, None, _times(groups, rows, dxi), groups=_plain(groups), **params)

        return eqx.filter_jvp(plain, primals, tangents)
    (xi, _, rows), (dxi, _, changes) = primals, tangents
    change = scatter_change(xi, dxi, rows, changes, groups, **params)
    return scatter_sum(*primals, groups=groups, **params), change


@gather_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, **params: Any) -> tuple[list[Array], Any]:
    if primals[1] is not None:

        def plain(xi: Array, dxi: Array, nodes: Array) -> list[Array]:
            return _along(groups, gather_sum(xi, None, nodes, groups=_plain(groups), **params), dxi)

        return eqx.filter_jvp(plain, primals, tangents)
    (xi, _, nodes), (dxi, _, df) = primals, tangents
    parts = [] if df is None else [gather_sum(xi, None, df, groups=groups, **params)]
    if dxi is not None:
        parts.append(gather_sum(xi, dxi, nodes, groups=_moved(groups), **params))
    return gather_sum(*primals, groups=groups, **params), _total(parts)


@pull_sum.defjvp
def _(primals: tuple, tangents: tuple, *, groups: Groups, gathered: bool, **params: Any) -> tuple:
    if gathered:

        def apart(xi: Array, nodes: Array, rows: Rows) -> tuple[Array, list[Array]]:
            by_xi, _ = pull_sum(xi, nodes, rows, groups=groups, gathered=False, **params)
            return by_xi, gather_sum(xi, None, nodes, groups=groups, **params)

        return eqx.filter_jvp(apart, primals, tangents)
    (xi, nodes, rows), (dxi, df, changes) = primals, tangents
    pull = partial(pull_sum, xi, gathered=False, **params)
    parts = [] if df is None else [pull(df, rows, groups=groups)]
    some = [(group, da) for group, da in zip(groups, changes, strict=True) if da is not None]
    if some:
        parts.append(pull(nodes, [da for _, da in some], groups=tuple(group for group, _ in some)))
    if dxi is not None:
        moved = _moved(groups)
        parts.append(pull(nodes, _times(moved, rows, dxi), groups=_plain(moved)))
    return pull(nodes, rows, groups=groups), _total(parts)


# Reverse mode.


def _of_unknown(rows: Sequence[Any], out: Sequence[Array]) -> list:
    """Gathered rows for those that are asked for, in the columns that these have."""
    remaining = iter(out)
    return [next(remaining)[:, : a.shape[1]] if is_unknown(a) else None for a in rows]


@scatter_sum.deftranspose
def _(nodes: Array, args: tuple, *, groups: Groups, size: int, **params: Any) -> tuple:
    """By dξ the pull of what is moved, by what is given the gather: in one pass where both are asked for."""
    xi, dxi, rows = args
    pairs = list(zip(groups, rows, strict=True))
    wanted = tuple(group for group, a in pairs if is_unknown(a))
    if not is_unknown(dxi):
        along = dxi if any(group.moved for group in wanted) else None
        return None, None, _of_unknown(rows, gather_sum(xi, along, nodes, groups=wanted, **params))
    pulled = _moved(tuple(group for group, _ in pairs if group.moved), False)
    amounts = [a for group, a in pairs if group.moved]
    together = bool(wanted) and set(wanted) <= set(pulled)
    by_xi, out = pull_sum(xi, nodes, amounts, groups=pulled, gathered=together, **params)
    if together:
        out = [out[pulled.index(group)] for group in wanted]
    elif wanted:
        out = gather_sum(xi, None, nodes, groups=wanted, **params)
    return None, by_xi, _of_unknown(rows, out)


@gather_sum.deftranspose
def _(cotangents: list, args: tuple, *, groups: Groups, **params: Any) -> tuple:
    """By f the scatter, by dξ the pull."""
    xi, dxi, nodes = args
    some = [(group, a) for group, a in zip(groups, cotangents, strict=True) if a is not None]
    rows, every = [a for _, a in some], tuple(group for group, _ in some)
    if not is_unknown(nodes):
        by_xi, _ = pull_sum(xi, nodes, rows, groups=_moved(every, False), gathered=False, **params)
        return None, by_xi, None
    along = dxi if any(group.moved for group in every) else None
    return None, None, scatter_sum(xi, along, rows, groups=every, size=nodes.shape[0], **params)


@pull_sum.deftranspose
def _(cotangents: tuple, args: tuple, *, groups: Groups, gathered: bool, **params: Any) -> tuple:
    """By f the scatter, by what is given the gather, both moved along the cotangent."""
    assert not gathered  # the forward rule takes both apart
    (dxi, _), (xi, nodes, rows), moved = cotangents, args, _moved(groups)
    if is_unknown(nodes):
        back = scatter_sum(xi, dxi, rows, groups=moved, size=nodes.shape[0], **params)
        return None, back, [None] * len(rows)
    wanted = tuple(group for group, a in zip(moved, rows, strict=True) if is_unknown(a))
    return None, None, _of_unknown(rows, gather_sum(xi, dxi, nodes, groups=wanted, **params))
