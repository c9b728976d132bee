"""The sums between particles and nodes written in JAX: the reference, and what devices without native sums run.

Terms are products of one polynomial along each axis, so sums are factorised: a scatter takes what a particle gives one
axis further in, to one node along it, for all terms at once; a gather takes what it is given one axis further out.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float
from mpmjax.discretisation._stencil import Basis, Kind, Term

_ROW = 4
"""Largest number of columns that are added to the nodes at once. A CPU adds one, two or four numbers as one vector;
three take it three times as long as four, being added one by one."""


class Factors(NamedTuple):
    """Factors of terms, stored: XLA would else compute it again in each of the sums' loops."""

    shares: Array  # terms of the flat node index, shape (d, s, p)
    along: tuple[dict[Kind, Array], ...]  # the polynomials of each kind along each axis, shape (s, p)

    @classmethod
    def of(cls, basis: Basis, xi: Array, terms: Sequence[Term]) -> "Factors":
        """Factors of some terms."""
        kinds, t = [dict.fromkeys(along) for along in zip(*terms, strict=True)], basis.offset(xi)
        along = ({kind: basis.polynomials(kind, t[a]) for kind in some} for a, some in enumerate(kinds))
        return cls(basis.index_terms(xi), tuple(along))


Pairs = Sequence[tuple[tuple[Term, ...], Array]]  # groups of terms and what particles give to each, (terms, c, p)
Given = dict[Term, Float[Array, "p c"]]
"""Amounts that particles give to each term, as rows; of terms without the axes that are done."""


def given_to(groups: Pairs, columns: slice) -> Given:
    """Some columns of what particles give to groups of terms, (terms, c, p) each: zero in columns that they lack."""
    width = columns.stop - columns.start
    amounts: Given = {}
    for terms, arrays in groups:
        for term, a in zip(terms, arrays, strict=True):
            block = a[columns]
            row = jnp.pad(block, ((0, width - len(block)), (0, 0))).T
            amounts[term] = amounts[term] + row if term in amounts else row
    return amounts


def written_scatter(factors: Factors, groups: Pairs, size: int, unroll: bool) -> Array:
    """∂B/∂f: the nodes' sums, (n, c)."""
    _, _, p = factors.shares.shape
    columns = max(a.shape[1] for _, a in groups)

    def add(axis: int, first: Array, amounts: Given, nodes: Array) -> Array:
        """The nodes with the sums along this axis and those after it added, from a first node."""
        if axis == len(factors.shares):
            return nodes.at[first].add(amounts[()], mode="drop", wrap_negative_indices=False)

        def step(nodes: Array, factor: tuple[Array, dict[Kind, Array]]) -> tuple[Array, None]:
            share, polynomials = factor
            return add(axis + 1, first + share, _narrow(amounts, polynomials), nodes), None

        return _along(axis, factors, step, nodes, unroll)[0]

    blocks = []
    for start in range(0, columns, _ROW):
        width = min(columns - start, _ROW)
        padded = 1 << (width - 1).bit_length()
        nodes = jnp.zeros((size, padded), groups[0][1].dtype)
        amounts = given_to(groups, slice(start, start + padded))
        blocks.append(add(0, jnp.zeros((p,), factors.shares.dtype), amounts, nodes)[:, :width])
    return jnp.concatenate(blocks, axis=1)


def written_gather(
    factors: Factors, terms: Sequence[Term], nodes: Float[Array, "n c"], unroll: bool
) -> dict[Term, Array]:
    """∂B/∂a: for each term what the nodes give, (c, p)."""
    d, _, p = factors.shares.shape

    def summed(axis: int, first: Array) -> dict[Term, Array]:
        """The sums over this axis and those after it, from a first node, for each end that terms have from it on."""
        if axis == d:
            return {(): nodes.at[first].get(mode="clip", wrap_negative_indices=False)}
        ends = dict.fromkeys(term[axis:] for term in terms)

        def add(totals: dict, factor: tuple[Array, dict[Kind, Array]]) -> tuple[dict, None]:
            share, polynomials = factor
            inner = summed(axis + 1, first + share)
            return {end: totals[end] + polynomials[end[0]][:, None] * inner[end[1:]] for end in ends}, None

        zeros = dict.fromkeys(ends, jnp.zeros((p, nodes.shape[1]), nodes.dtype))
        return _along(axis, factors, add, zeros, unroll)[0]

    return {term: rows.T for term, rows in summed(0, jnp.zeros((p,), factors.shares.dtype)).items()}


def written_pull(factors: Factors, groups: Sequence[Pairs], nodes: Array) -> Array:
    """Σ_i f_i · (what a scatter of each list of groups would add to node i), (lists, p)."""
    d, _, p = factors.shares.shape
    whole = [given_to(one, slice(0, nodes.shape[1])) for one in groups]

    def summed(axis: int, first: Array, amounts: list[Given]) -> list[Array]:
        if axis == d:
            f = nodes.at[first].get(mode="clip", wrap_negative_indices=False)
            return [(one[()] * f).sum(axis=1) for one in amounts]

        def add(totals: list[Array], factor: tuple[Array, dict[Kind, Array]]) -> tuple[list[Array], None]:
            share, polynomials = factor
            out = summed(axis + 1, first + share, [_narrow(one, polynomials) for one in amounts])
            return [total + a for total, a in zip(totals, out, strict=True)], None

        zeros = [jnp.zeros((p,), nodes.dtype)] * len(amounts)
        return _along(axis, factors, add, zeros, unroll=False)[0]  # one kernel would be very long

    return jnp.stack(summed(0, jnp.zeros((p,), factors.shares.dtype), whole))


def _narrow(amounts: Given, polynomials: dict[Kind, Array]) -> Given:
    """Amounts that particles give to one node along an axis, to each end that terms have after it."""
    parts: dict[Term, list[Array]] = {}
    for (kind, *end), row in amounts.items():
        parts.setdefault(tuple(end), []).append(polynomials[kind][:, None] * row)
    return {end: reduce(jnp.add, rows) for end, rows in parts.items()}


def _along(axis: int, factors: Factors, step: Callable[..., tuple], start: Any, unroll: bool) -> Any:
    """`lax.scan` over the nodes along an axis, unrolled along the last one, or with `unroll` along all.

    A loop over a few kernels is the fastest on a CPU, a single kernel on a GPU.
    """
    each = factors.shares[axis], factors.along[axis]
    last = axis == len(factors.shares) - 1
    return jax.lax.scan(step, start, each, unroll=each[0].shape[0] if unroll or last else 1)
