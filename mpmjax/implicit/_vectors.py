"""The vectors of an iteration, combined in one pass.

Two sums of two vectors each and a norm are half of what the conjugate residual method does with vectors. Written in JAX
they are three passes over the window, of which a body may fill a small part. On CPUs the native library does them in
one, in place, and passes over numbers that are known to stay zero.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad

from mpmjax._types import Array, Bool, Float, Scalar
from mpmjax.native import members, native_primitive

_TOGETHER = 64
"""Numbers that are passed over together, as in native/vectors.h."""


class Combined(NamedTuple):
    """Two combinations of vectors, and the square of the second's norm."""

    first: Float[Array, "m"]
    second: Float[Array, "m"]
    square: Float[Array, ""]


def active_blocks(*may_differ_from_zero: Bool[Array, "m"]) -> Bool[Array, "k"]:
    """Whether any of 64 numbers that follow each other may differ from zero, for each such block, shape (⌈m/64⌉,)."""
    some = jnp.stack(may_differ_from_zero).any(axis=0)
    return jnp.pad(some, (0, -len(some) % _TOGETHER)).reshape(-1, _TOGETHER).any(axis=1)


def combine(
    one: tuple[Array, Scalar, Array],
    other: tuple[Array, Scalar, Array],
    weight: Float[Array, "m"],
    active: Bool[Array, "k"],
    *,
    onto: int,
) -> Combined:
    """From (a, s, b) and (c, t, d): y = a + s b, z = c + t d, and Σ w z².

    Args:
        one: a, s and b; vectors have shape (m,).
        other: c, t and d.
        weight: w, shape (m,).
        active: `active_blocks`. In others all four vectors are zero.
        onto: the vectors that are not needed any more, whose memory results may take: 0 for a and c, 1 for b and d.
    """
    (a, s, b), (c, t, d) = one, other
    return Combined(*_combine_p[onto].bind(a, b, c, d, jnp.stack([s, t]), weight, active, batched=0))


def _combine(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # there is no loop
    a, b, c, d, scales, weight, _ = args
    y, z = a + scales[0] * b, c + scales[1] * d
    return [y, z, (weight * z * z).sum()]


def _results(*args: ShapedArray) -> list[tuple]:
    size = args[0].shape[-1]
    return [(size,), (size,), ()]


def _fits(avals: Any, batched: int) -> bool:
    del batched
    return avals[0].dtype in (np.float32, np.float64) and all(aval.dtype == avals[0].dtype for aval in avals[:6])


def _differentiable(primitive: Primitive) -> Primitive:
    """With the derivative of what is written in JAX. Solves are never differentiated through their iterations."""

    def jvp(primals: tuple, tangents: tuple, *, batched: int) -> tuple[list[Array], list[Array]]:
        *floats, active = primals
        written = members(_combine, batched)
        along = tuple(map(ad.instantiate_zeros, tangents[:-1]))
        return jax.jvp(lambda *floats: written(*floats, active), tuple(floats), along)

    ad.primitive_jvps[primitive] = jvp
    return primitive


_combine_p = tuple(
    _differentiable(native_primitive(f"vectors_combine_{k}", _combine, _results, _fits, {k: 0, 2 + k: 1}))
    for k in (0, 1)
)
