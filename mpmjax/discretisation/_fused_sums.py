"""Sums that pay as one pass: averages at the nodes, and the resistance of particles to a displacement of the nodes.

Both are made of `scatter` and `gather`. On CPUs the native library has each in one call; written with the sums that
they are, they are the reference and what other devices run.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._jax import instantiate_zeros
from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.autodiff import sums_saved_for_backward
from mpmjax.discretisation._basis import Basis
from mpmjax.discretisation._native_sums import native_average, native_resist, sums_fit
from mpmjax.discretisation._stencil import Stencil
from mpmjax.discretisation._sums import (
    Group,
    gather,
    gather_sum,
    given_rows,
    is_zero,
    scatter,
    scatter_change,
    scatter_sum,
    sum_of_changes,
)
from mpmjax.native import NativeFunction


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
    least, columns = jnp.asarray(least, weight.dtype), jnp.concatenate([value, weight[None]])
    if stencil.own_derivatives is not None:
        whole, means = _means(scatter(stencil, columns, gradients, size), least)
        return whole, means
    groups, rows = given_rows(stencil, columns, gradients)
    whole, means = _average_sum(
        stencil.first, stencil.offset, least, *rows, basis=stencil.basis, groups=groups, size=size
    )
    return whole, means


def _means(sums: Array, least: Array) -> list[Array]:
    """The whole weights, (n,), and the averages, (n, k)."""
    some = sums[:, -1] > least
    whole = jnp.where(some, sums[:, -1], 0)
    return [whole, jnp.where(some[:, None], sums[:, :-1] / jnp.where(some, whole, 1)[:, None], 0)]


def _average(first: Array, t: Array, least: Array, *rows: Array, **params: Any) -> list[Array]:
    return _means(scatter_sum(first, t, *rows, **params)[0], least)


def _average_jvp(primals: tuple, tangents: tuple, *, batched: int, **params: Any) -> tuple[list[Array], list[Any]]:
    """The quotient rule on the differentials of the sums; the threshold is not differentiated. Averages are saved for
    reverse mode here, where the rule takes them: named afterwards they would be others, and these computed again."""
    first, t, _, *rows = primals
    out = sums_saved_for_backward(_average_sum(*primals, batched=batched, **params))
    changes = scatter_change(first, t, tangents[1], rows, tangents[3:], batched=batched, **params)
    return out, sum_of_changes(out, [_divided(*change, *out) for change in changes])


def _divided(change: Array, whole: Array, means: Array) -> list[Array]:
    """dM and (d(Σ) − a dM) / M, (n,) and (n, k), from the differentials of the sums, (n, k + 1)."""
    some = whole > 0
    d_whole = jnp.where(some, change[..., -1], 0)
    d_means = (change[..., :-1] - means * d_whole[..., None]) / jnp.where(some, whole, 1)[..., None]
    return [d_whole, jnp.where(some[..., None], d_means, 0)]


_average_sum = NativeFunction(
    "average",
    _average,
    lambda *args, size, **_: [(size,), (size, args[3].shape[-2] - 1)],
    sums_fit,
    like=1,
    native=native_average,
)
_average_sum.jvp = _average_jvp


def resist(stencil: Stencil, upper: Float[Array, "t p"], u: NodeVector) -> NodeVector:
    """Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and G_p,b = Σ_j g_jp,b u_j, shape (n, d).

    Args:
        stencil: stencil of the particles.
        upper: the upper triangle of each symmetric matrix K_p, row by row, shape (d²(d² + 1)/2, p). Its rows and
            columns are the components of G_p, the direction b first.
        u: what is gathered, shape (n, d).
    """
    if stencil.own_derivatives is not None:
        return scatter(stencil, None, _flux(upper, gather(stencil, u)[1]), len(u))
    scaled = stencil.slope**2 * u
    return resist_unscaled(stencil.basis, stencil.first, stencil.offset, without_flat(stencil, upper), scaled)


def without_flat(stencil: Stencil, upper: Float[Array, "t p"]) -> Float[Array, "t p"]:
    """The matrices without the components of G_p in which particles have no gradient."""
    if stencil.flat is None:
        return upper
    d = stencil.dim
    row, column = np.triu_indices(d * d)
    return jnp.where(stencil.flat[row // d] | stencil.flat[column // d], 0, upper)


def resist_unscaled(basis: Basis, first: Array, t: Array, upper: Float[Array, "t p"], u: NodeVector) -> NodeVector:
    """`resist` with gradients in spacings, dx² times as much, from the fields of a stencil."""
    return _resist_sum(first, t, upper, u, basis=basis)[0]


def _flux(upper: Array, slopes: Array) -> Array:
    return la.matmul(la.symmetric(upper), slopes.reshape(len(slopes) ** 2, 1, -1)).reshape(slopes.shape)


def _resist(first: Array, t: Array, upper: Array, u: Array, *, basis: Basis) -> list[Array]:
    groups = (Group(basis.gradient),)
    (slopes,) = gather_sum(first, t, u, basis=basis, groups=groups)
    return scatter_sum(first, t, _flux(upper, slopes), basis=basis, groups=groups, size=len(u))


def _resist_jvp(primals: tuple, tangents: tuple, *, batched: int, **params: Any) -> tuple[list[Array], list[Any]]:
    """By u the sum itself, linear in it; by the rest, which no iteration needs, gather's and scatter's."""
    first, *others, u = primals
    *changes, du = tangents[1:]
    out, parts = _resist_sum(*primals, batched=batched, **params), []
    if not is_zero(du):
        parts.append(_resist_sum(first, *others, du, batched=batched, **params))
    if not all(map(is_zero, changes)):
        apart = _resist_sum.of_members(batched, **params)
        along = tuple(map(instantiate_zeros, changes))
        parts.append(jax.jvp(lambda *others: apart(first, *others, u), tuple(others), along)[1])
    return out, sum_of_changes(out, parts)


def _resist_transpose(cotangents: list, *args: Any, **params: Any) -> list:
    """In u it is symmetric."""
    return [None, None, None, *_resist_sum(*args[:-1], instantiate_zeros(cotangents[0]), **params)]


_resist_sum = NativeFunction(
    "resist", _resist, lambda *args, **_: [args[-1].shape[-2:]], sums_fit, like=1, native=native_resist
)
_resist_sum.jvp, _resist_sum.transpose = _resist_jvp, _resist_transpose
