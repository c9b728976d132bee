"""Averages at the nodes: velocity is momentum over mass."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.interpreters import ad

from mpmjax._types import Array, Float, Scalar
from mpmjax.autodiff import sums_saved_for_backward
from mpmjax.discretisation._placed import bound, define_jvp, define_placed
from mpmjax.discretisation._stencil import Stencil
from mpmjax.discretisation._transfer_sums import scatter_tangent, written_scatter
from mpmjax.native import differentiable, native_primitive, sums_fit


def average(
    stencil: Stencil,
    weight: Float[Array, "p"],
    value: Float[Array, "k p"],
    gradients: Float[Array, "d k p"] | None,
    least: Scalar,
    size: int,
) -> tuple[Float[Array, "n"], Float[Array, "n k"]]:
    """Whole weights at the nodes, M_i = Σ_p w_ip m_p, and the averages Σ_p (w_ip a_p + Σ_b g_ip,b a_p,b) / M_i.

    Where a whole weight is not more than the least, both are zero. On CPUs nodes that no particle reaches cost nothing
    but being set to zero.

    Args:
        stencil: stencil of the particles.
        weight: m_p, shape (p,).
        value: a_p, which has the factor m_p already, shape (k, p).
        gradients: a_p,b for each direction b, shape (d, k, p), or None for zero.
        least: the least whole weight, not negative.
        size: number of nodes n.
    """
    columns = [jnp.concatenate([value, weight[None]])] + ([] if gradients is None else [gradients])
    whole, means = bound(_average_p, stencil, jnp.asarray(least, weight.dtype), *columns, size=size, batched=0)
    return whole, means


def _average(*args: Array, size: int, unroll: bool) -> list[Array]:
    """The whole weights, (n,), and the averages, (n, k)."""
    *factors, least = args[:4]
    sums = written_scatter(*factors, *args[4:], valued=True, size=size, unroll=unroll)[0]
    some = sums[:, -1] > least
    whole = jnp.where(some, sums[:, -1], 0)
    return [whole, jnp.where(some[:, None], sums[:, :-1] / jnp.where(some, whole, 1)[:, None], 0)]


def _jvp(
    take: Callable[[], list[Array]], primals: tuple, tangents: tuple, *, size: int, batched: int
) -> tuple[list[Array], list[Any]]:
    """The quotient rule on the differentials of the sums; the threshold is not differentiated. The averages are
    `kept_sums` here, where the rule takes them: named afterwards they would be others, and these computed again."""
    out = sums_saved_for_backward(take())
    sums, changes = ((*values[:3], *values[4:]) for values in (primals, tangents))
    change = scatter_tangent(sums, changes, valued=True, size=size, batched=batched)
    if change is None:
        return out, [ad.Zero(jax.typeof(o)) for o in out]
    return out, _divided_p.bind(change, *out, batched=batched)


def _divided(change: Array, whole: Array, means: Array, unroll: bool = False) -> list[Array]:
    """dM and (d(Σ) − a dM) / M, (n,) and (n, k), from the differentials of the sums, (n, k + 1)."""
    del unroll  # there is no loop
    some = whole > 0
    d_whole = jnp.where(some, change[:, -1], 0)
    d_means = (change[:, :-1] - means * d_whole[:, None]) / jnp.where(some, whole, 1)[:, None]
    return [d_whole, jnp.where(some[:, None], d_means, 0)]


def _slope(whole: Array, means: Array, by_means: Array, *by_whole: Array, unroll: bool = False) -> list[Array]:
    """The transpose of `_divided`: slopes by the sums, (n, k + 1), from those by averages, and by whole weights if they
    are not zero."""
    del unroll  # there is no loop
    some = whole > 0
    by_value = jnp.where(some[:, None], by_means, 0) / jnp.where(some, whole, 1)[:, None]
    by_weight = sum((jnp.where(some, by, 0) for by in by_whole), -(by_value * means).sum(axis=1))
    return [jnp.concatenate([by_value, by_weight[:, None]], axis=1)]


def _transpose_divided(cotangents: list, change: Any, whole: Array, means: Array, *, batched: int) -> list:
    del change
    by_whole = [] if type(cotangents[0]) is ad.Zero else [cotangents[0]]
    by_means = ad.instantiate_zeros(cotangents[1])
    return [*_slope_p.bind(whole, means, by_means, *by_whole, batched=batched), None, None]


def _shapes(*args: ShapedArray, size: int) -> list[tuple]:
    return [(size,), (size, args[4].shape[-2] - 1)]


def _sums(*args: ShapedArray, size: int) -> tuple:
    """The native sums are made here before they are divided."""
    return size, args[4].shape[-2]


def _like_averages(change: ShapedArray, whole: ShapedArray, means: ShapedArray) -> list[tuple]:
    del change
    return [whole.shape[-1:], means.shape[-2:]]


def _like_sums(whole: ShapedArray, means: ShapedArray, *others: ShapedArray) -> list[tuple]:
    del whole, others
    return [(*means.shape[-2:-1], means.shape[-1] + 1)]


def _nodes_fit(avals: Any, batched: int) -> bool:
    del batched
    return avals[0].dtype in (np.float32, np.float64) and len({aval.dtype for aval in avals}) == 1


_average_p = native_primitive("stencil_average", _average, _shapes, sums_fit, workspace=_sums, placed=False)
define_placed(_average_p, _average, _shapes, workspace=_sums)
define_jvp(_average_p, _jvp)
_divided_p = differentiable(native_primitive("nodes_divided", _divided, _like_averages, lambda *_: False), _divided)
_slope_p = differentiable(native_primitive("nodes_slope", _slope, _like_sums, _nodes_fit, like=0), _slope)
ad.primitive_transposes[_divided_p] = _transpose_divided
