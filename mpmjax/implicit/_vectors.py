"""Passes over the vectors of a linear solve.

Besides H v the conjugate residual method needs the rest of the product with M + χH, an inner product, and two sums of
two vectors each, with a norm. Written in JAX these are some eight passes over the window, of which a body may fill a
small part. On CPUs the native library does them in two, in place, and skips blocks that are known to stay zero.
"""

from functools import reduce
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray

from mpmjax._types import Array, Bool, Float, NodeScalar, Scalar
from mpmjax.discretisation import Places, resist
from mpmjax.native import differentiable, native_primitive

_BLOCK_SIZE = 64  # as in native/vectors.h


def active_blocks(*may_differ_from_zero: Bool[Array, "m"]) -> Bool[Array, "k"]:
    """Whether a block of 64 consecutive numbers may differ from zero, shape (⌈m/64⌉,). Others are skipped."""
    some = reduce(jnp.logical_or, may_differ_from_zero)
    return jnp.pad(some, (0, -len(some) % _BLOCK_SIZE)).reshape(-1, _BLOCK_SIZE).any(axis=1)


def combine(
    one: tuple[Array, Scalar, Array],
    other: tuple[Array, Scalar, Array],
    weight: Float[Array, "m"],
    active: Bool[Array, "k"],
    *,
    onto: int,
) -> tuple[Array, Array, Float[Array, ""]]:
    """From (a, s, b) and (c, t, d): y = a + s b, z = c + t d, and Σ w z².

    Args:
        one: a, s and b; vectors have shape (m,).
        other: c, t and d.
        weight: w, shape (m,).
        active: `active_blocks`. All four vectors are zero elsewhere.
        onto: the vectors that are not needed any more, whose memory results may take: 0 for a and c, 1 for b and d.
    """
    (a, s, b), (c, t, d) = one, other
    y, z, square = _combine_p[onto].bind(a, b, c, d, jnp.stack([s, t]), weight, active, batched=0)
    return y, z, square


def product(
    force: Float[Array, "m"],
    v: Float[Array, "m"],
    mass: NodeScalar,
    factor: Scalar,
    free: Bool[Array, "m"],
    weight: Float[Array, "m"],
    active: Bool[Array, "k"],
) -> tuple[Array, Float[Array, ""]]:
    """W⁻¹A v and vᵀA v, with (A v)_i = m_i v_i + χ f_i where i is free, and v_i elsewhere.

    Args:
        force: f = H v, shape (m,).
        v: v, shape (m,).
        mass: nodal masses, shape (n,), each of m/n components.
        factor: χ.
        free: whether a component is free, shape (m,).
        weight: the diagonal of W, shape (m,).
        active: `active_blocks`. Elsewhere v is zero and nothing is free.
    """
    factor = jnp.asarray(factor, v.dtype)
    image, square = _product_p.bind(force, v, mass, factor, free, weight, active, batched=0)
    return image, square


class ParticleMatrices(eqx.Module):
    """A = M + χH on free components and the identity on others, H with one matrix for each particle."""

    factors: tuple[Array, Array, Array]
    """Terms of the flat node index, weights and their derivatives of the particles' stencil, each (d, s, p)."""
    places: Places | None
    """`Stencil.places`, from which native sums find the factors; None if it has none."""
    upper: Float[Array, "t p"]
    """See `resist`."""
    mass: NodeScalar
    factor: Scalar
    """χ."""
    free: Bool[Array, "m"]

    def product(self, u: Array, weight: Array, active: Bool[Array, "k"]) -> tuple[Array, Float[Array, ""]]:
        """W⁻¹A u and uᵀA u (see `product`)."""
        moved = jnp.where(self.free, u, 0).reshape(len(self.mass), -1)
        force = resist(self, self.upper, moved).reshape(-1)
        return product(force, u, self.mass, self.factor, self.free, weight, active)


def _combine(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # there is no loop
    a, b, c, d, scales, weight, _ = args
    y, z = a + scales[0] * b, c + scales[1] * d
    return [y, z, (weight * z * z).sum()]


def _product(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # there is no loop
    force, v, mass, factor, free, weight, _ = args
    image = jnp.where(free, jnp.repeat(mass, len(v) // max(1, len(mass))) * v + factor * force, v)
    return [image / weight, (v * image).sum()]


def _combine_shapes(*args: ShapedArray) -> list[tuple]:
    size = args[0].shape[-1]
    return [(size,), (size,), ()]


def _fits(avals: Any, batched: int) -> bool:
    del batched
    floats = [aval.dtype for aval in avals if aval.dtype != np.bool_]
    return floats[0] in (np.float32, np.float64) and set(floats) == {floats[0]}


_combine_p = tuple(
    differentiable(
        native_primitive(f"vectors_combine_{k}", _combine, _combine_shapes, _fits, {k: 0, 2 + k: 1}), _combine
    )
    for k in (0, 1)
)
_product_p = differentiable(
    native_primitive("vectors_product", _product, lambda *args: _combine_shapes(*args)[1:], _fits, {0: 0}), _product
)
