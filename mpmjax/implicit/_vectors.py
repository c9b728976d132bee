"""What an iteration does with vectors, in two passes.

Besides H v the conjugate residual method needs the rest of the product with M + χH, with an inner product, and two sums
of two vectors each, with a norm. Written in JAX these are some eight passes over the window, of which a body may fill a
small part. On CPUs the native library does them in two, in place, and passes over numbers that are known to stay zero.
"""

from functools import reduce
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray

from mpmjax._types import Array, Bool, Float, NodeScalar, Scalar
from mpmjax.native import differentiable, native_primitive

_TOGETHER = 64
"""Numbers that are passed over together, as in native/vectors.h."""


class Combined(NamedTuple):
    """Two combinations of vectors, and the square of the second's norm."""

    first: Float[Array, "m"]
    second: Float[Array, "m"]
    square: Float[Array, ""]


class Product(NamedTuple):
    """The image of a vector, and its inner product with the vector."""

    image: Float[Array, "m"]
    """W⁻¹A v."""
    square: Float[Array, ""]
    """vᵀA v."""


def active_blocks(*may_differ_from_zero: Bool[Array, "m"]) -> Bool[Array, "k"]:
    """Whether any of 64 numbers that follow each other may differ from zero, for each such block, shape (⌈m/64⌉,)."""
    some = reduce(jnp.logical_or, may_differ_from_zero)
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


def product(
    force: Float[Array, "m"],
    v: Float[Array, "m"],
    mass: NodeScalar,
    factor: Scalar,
    free: Bool[Array, "m"],
    weight: Float[Array, "m"],
    active: Bool[Array, "k"],
) -> Product:
    """W⁻¹A v and vᵀA v, with (A v)_i = m_i v_i + χ f_i where i is free, and v_i elsewhere.

    Args:
        force: f = H v, shape (m,).
        v: v, shape (m,).
        mass: nodal masses, shape (n,), each that of m/n components.
        factor: χ.
        free: what is free, shape (m,).
        weight: the diagonal of W, shape (m,).
        active: `active_blocks`. In others v is zero and nothing free.
    """
    return Product(*_product_p.bind(force, v, mass, jnp.asarray(factor, v.dtype), free, weight, active, batched=0))


def _product(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # there is no loop
    force, v, mass, factor, free, weight, _ = args
    image = jnp.where(free, jnp.repeat(mass, len(v) // max(1, len(mass))) * v + factor * force, v)
    return [image / weight, (v * image).sum()]


def _image_and_number(*args: ShapedArray) -> list[tuple]:
    return [(args[0].shape[-1],), ()]


def _results(*args: ShapedArray) -> list[tuple]:
    size = args[0].shape[-1]
    return [(size,), (size,), ()]


def _fits(avals: Any, batched: int) -> bool:
    del batched
    floats = [aval.dtype for aval in avals if aval.dtype != np.bool_]
    return floats[0] in (np.float32, np.float64) and set(floats) == {floats[0]}


_combine_p = tuple(
    differentiable(native_primitive(f"vectors_combine_{k}", _combine, _results, _fits, {k: 0, 2 + k: 1}), _combine)
    for k in (0, 1)
)
_product_p = differentiable(native_primitive("vectors_product", _product, _image_and_number, _fits, {0: 0}), _product)
