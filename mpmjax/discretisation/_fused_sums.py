"""Sums that pay as one pass: averages at the nodes, and the resistance of particles to a displacement of the nodes.

Both are made of `scatter` and `gather`. On CPUs the native library has each in one call; written with the sums that
they are, they are the reference and what other devices run.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative, saved_for_backward
from mpmjax.discretisation._native_sums import basis_attributes, call_average
from mpmjax.discretisation._stencil import Basis, Stencil, in_section, in_space
from mpmjax.discretisation._sums import Group, gather, gather_sum, given_rows, scatter, scatter_change, scatter_sum


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
        return _means(scatter(stencil, columns, gradients, size), least)
    groups, rows = given_rows(stencil, columns, gradients)
    basis = stencil.basis
    return average_sum(stencil.xi, least, rows, basis=basis, groups=groups, size=size)


def _means(sums: Array, least: Array) -> tuple[Array, Array]:
    """The whole weights, (n,), and the averages, (n, k)."""
    some = sums[:, -1] > least
    whole = jnp.where(some, sums[:, -1], 0)
    return whole, jnp.where(some[:, None], sums[:, :-1] / jnp.where(some, whole, 1)[:, None], 0)


@partial(
    custom_derivative,
    kernel="average",
    results=lambda xi, least, rows, size, **__: tuple(
        jax.ShapeDtypeStruct(shape, xi.dtype) for shape in ((size,), (size, rows[0].shape[1] - 1))
    ),
    call=call_average,
)
def average_sum(xi: Array, least: Array, rows: Sequence[Array], **params: Any) -> tuple[Array, Array]:
    """The whole weights and the averages, of columns of which the last is the weight."""
    return _means(scatter_sum(xi, None, rows, **params), least)


@average_sum.defjvp
def _(primals: tuple, tangents: tuple, **params: Any) -> tuple[tuple[Array, Array], Any]:
    """dM and (d(Σ) − a dM) / M; the threshold is not differentiated. Averages are saved for reverse mode here, where
    the rule takes them: named afterwards they would be others, and these computed again."""
    (xi, _, rows), (dxi, _, changes) = primals, tangents
    whole, means = saved_for_backward(average_sum(*primals, **params), sums=True)
    change = scatter_change(xi, dxi, rows, changes, **params)
    if change is None:
        return (whole, means), (None, None)
    some = whole > 0
    d_whole = jnp.where(some, change[:, -1], 0)
    d_means = (change[:, :-1] - means * d_whole[:, None]) / jnp.where(some, whole, 1)[:, None]
    return (whole, means), (d_whole, jnp.where(some[:, None], d_means, 0))


def resist(stencil: Stencil, upper: Float[Array, "t p"], u: NodeVector) -> NodeVector:
    """Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and G_p,b = Σ_j g_jp,b u_j, shape (n, d).

    Args:
        stencil: stencil of the particles.
        upper: the upper triangle of each symmetric matrix K_p, row by row, shape (d²(d² + 1)/2, p). Its rows and
            columns are the components of G_p, the direction b first; of bodies of revolution those in space.
        u: what is gathered, shape (n, d).
    """
    if stencil.radius is not None:
        slopes = in_space(stencil.radius, *gather(stencil, u))
        return scatter(stencil, *in_section(stencil.radius, _flux(upper, slopes)), len(u))
    if stencil.own_derivatives is not None:
        return scatter(stencil, None, _flux(upper, gather(stencil, u)[1]), len(u))
    upper, scaled = without_flat(stencil, upper), stencil.slope**2 * u
    return resist_sum(stencil.xi, upper, scaled, basis=stencil.basis)


def without_flat(stencil: Stencil, upper: Float[Array, "t p"]) -> Float[Array, "t p"]:
    """The matrices without the components of G_p in which particles have no gradient."""
    if stencil.flat is None:
        return upper
    d = stencil.dim
    row, column = np.triu_indices(d * d)
    return jnp.where(stencil.flat[row // d] | stencil.flat[column // d], 0, upper)


def _flux(upper: Array, slopes: Array) -> Array:
    return la.matmul(la.symmetric(upper), slopes.reshape(len(slopes) ** 2, 1, -1)).reshape(slopes.shape)


@partial(
    custom_derivative,
    kernel="resist",
    results=lambda xi, upper, u, basis: u,
    call=lambda call, *args, basis: call(args, basis_attributes(basis)),
)
def resist_sum(xi: Array, upper: Array, u: Array, *, basis: Basis) -> Array:
    """`resist` with gradients in spacings, dx² times as much, from the fields of a stencil."""
    groups = (Group(basis.gradient),)
    (slopes,) = gather_sum(xi, None, u, basis=basis, groups=groups)
    return scatter_sum(xi, None, [_flux(upper, slopes)], basis=basis, groups=groups, size=len(u))


@resist_sum.defjvp
def _(primals: tuple, tangents: tuple, *, basis: Basis) -> tuple[Array, Any]:
    """By u the sum itself, linear in it; by the rest, which no iteration needs, gather's and scatter's."""
    (*args, u), (*changes, du) = primals, tangents
    change = None if du is None else resist_sum(*args, du, basis=basis)
    if any(a is not None for a in changes):
        part = eqx.filter_jvp(lambda *args: resist_sum.function(*args, u, basis=basis), args, changes)[1]
        change = part if change is None else change + part
    return resist_sum(*primals, basis=basis), change


@resist_sum.deftranspose
def _(cotangent: Array, args: tuple, *, basis: Basis) -> tuple:
    """In u it is symmetric."""
    return None, None, resist_sum(*args[:-1], cotangent, basis=basis)
