"""The resistance of particles to a displacement of the nodes: a gather, a matrix for each particle, and a scatter.

An iteration of an implicit solve is hardly more. On CPUs the native library does the three in one pass over the
particles; written with the sums that they are, they are the reference and what other devices run.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
from jax.core import ShapedArray
from jax.interpreters import ad

from mpmjax import linalg as la
from mpmjax._types import Array, Float, NodeVector
from mpmjax.discretisation._placed import Factored, bound, define_jvp, define_placed
from mpmjax.discretisation._transfer_sums import gather_p, scatter_p
from mpmjax.native import members, native_primitive, sums_fit


def resist(stencil: Factored, upper: Float[Array, "t p"], u: NodeVector) -> NodeVector:
    """Σ_p Σ_b g_ip,b r_p,b with r_p = K_p G_p and G_p,b = Σ_j g_jp,b u_j, shape (n, d).

    Args:
        stencil: stencil of the particles.
        upper: the upper triangle of each symmetric matrix K_p, row by row, shape (d²(d² + 1)/2, p). Its rows and
            columns are the components of G_p, the direction b first.
        u: what is gathered, shape (n, d).
    """
    return bound(_resist_p, stencil, upper, u, batched=0)[0]


def _resist(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # the sums know
    *factors, upper, u = args
    _, slopes = gather_p.bind(*factors, u, batched=0)
    flux = la.matmul(la.symmetric(upper), slopes.reshape(len(slopes) ** 2, 1, -1))
    return scatter_p.bind(*factors, flux.reshape(slopes.shape), valued=False, size=len(u), batched=0)


def _like_nodes(*args: ShapedArray) -> list[tuple]:
    return [args[-1].shape[-2:]]


_resist_p = native_primitive("stencil_resist", _resist, _like_nodes, sums_fit, placed=False)
define_placed(_resist_p, _resist, _like_nodes)


def _jvp(
    take: Callable[[], list[Array]], primals: tuple, tangents: tuple, *, batched: int
) -> tuple[list[Array], list[Any]]:
    """JVP: by u the sum itself, linear in it; by the rest, which no iteration needs, gather's and scatter's."""
    index, *others, u = primals
    *changes, du = tangents[1:]
    out = take()
    parts = [[ad.Zero(jax.typeof(out[0]))]]
    if type(du) is not ad.Zero:
        parts.append(_resist_p.bind(index, *others, du, batched=batched))
    if any(type(t) is not ad.Zero for t in changes):
        written = members(_resist, batched)
        along = tuple(map(ad.instantiate_zeros, changes))
        parts.append(jax.jvp(lambda *others: written(index, *others, u), tuple(others), along)[1])
    return out, [reduce(ad.add_tangents, part) for part in zip(*parts, strict=True)]


def _transpose(cotangents: list, *args: Any, batched: int) -> list:
    """In u it is symmetric."""
    back = _resist_p.bind(*args[:-1], ad.instantiate_zeros(cotangents[0]), batched=batched)
    return [*(None for _ in args[:-1]), *back]


define_jvp(_resist_p, _jvp)
ad.primitive_transposes[_resist_p] = _transpose
