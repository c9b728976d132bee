"""The recurrence of the conjugate residual method (derivation, eq. 19): what it carries, its step, and its loop.

Where the operator is M + χH with one matrix for each particle, the loop is a JAX primitive. On CPUs the native library
runs it as a whole, and in a batch each member by itself: a loop of JAX goes on for all members until the last one is
done, and selects whole vectors in every step.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, Scalar
from mpmjax.discretisation import resist_by
from mpmjax.implicit._vectors import combine, differentiable, product
from mpmjax.native import native_primitive, sums_fit


class ParticleMatrices(eqx.Module):
    """A = M + χH on free components and the identity on others, H with one matrix for each particle."""

    factors: tuple[Array, Array, Array]
    """Terms of the flat node index, weights and their derivatives of the particles' stencil, each (d, s, p)."""
    upper: Float[Array, "t p"]
    """See `resist`."""
    mass: NodeScalar
    factor: Scalar
    """χ."""
    free: Bool[Array, "m"]

    def product(self, u: Array, weight: Array, active: Bool[Array, "k"]) -> tuple[Array, Float[Array, ""]]:
        """W⁻¹A u and uᵀA u (see `product` of vectors)."""
        moved = jnp.where(self.free, u, 0).reshape(len(self.mass), -1)
        force = resist_by(self.factors, self.upper, moved).reshape(-1)
        return product(force, u, self.mass, self.factor, self.free, weight, active)


class Limits(eqx.Module):
    """What ends the recurrence."""

    tolerance: Scalar
    """‖r‖ at which it is done."""
    floor: Scalar
    """‖r‖² below which the recurrence's own residual means nothing."""
    steps: Scalar | Int[Array, ""]
    """The most steps."""
    increment_rtol: Scalar | None = None
    """‖α p‖/‖x‖ at which it is done too."""


class Recurrence(eqx.Module):
    """The state of the iteration, in the letters of the derivation."""

    x: Array
    r: Array
    p: Array
    q: Array
    rr: Float[Array, ""]
    """‖r‖²."""
    qq: Float[Array, ""]
    """‖q‖²."""
    gamma: Float[Array, ""]
    """rᵀA r; infinite where the recurrence starts, which makes β zero."""
    k: Int[Array, ""]
    """Steps taken."""
    radius: Float[Array, ""]
    """Largest Rayleigh quotient rᵀA r/‖r‖² so far."""
    small_increment: Bool[Array, ""]
    """Whether the last increment was within `increment_rtol`."""
    breakdown: Bool[Array, ""]
    """Whether rᵀA r = 0 to rounding was met."""
    indefinite: Bool[Array, ""]
    """Whether rᵀA r < 0 beyond rounding was met."""

    @classmethod
    def begun(cls, x: Array, r: Array, rr: Float[Array, ""]) -> "Recurrence":
        """The state before the first step, at x with the residual r."""
        zero, no = jnp.zeros_like(rr), jnp.zeros(rr.shape, bool)
        nothing, infinite = jnp.zeros_like(r), jnp.full_like(rr, jnp.inf)
        return cls(x, r, nothing, nothing, rr, zero, infinite, jnp.zeros(rr.shape, jnp.int32), zero, no, no, no)


class Passes(NamedTuple):
    """What the recurrence does with vectors."""

    product: Callable[[Array], tuple[Array, Float[Array, ""]]]
    """E u and uᵀA u of u."""
    combined: Callable[..., tuple[Array, Array, Float[Array, ""]]]
    """Two combinations of vectors, and the square of the second's norm (see `combine` of vectors)."""
    dot: Callable[[Array, Array], Float[Array, ""]]
    """aᵀ W c of a and c."""


def recur(passes: Passes, limits: Limits, c: Recurrence) -> Recurrence:
    """The state at the end of the recurrence."""
    steps = jnp.asarray(limits.steps)

    def goes_on(c: Recurrence) -> Bool[Array, ""]:
        above = (jnp.sqrt(c.rr) > limits.tolerance) & (c.rr > limits.floor)
        return above & ~c.small_increment & ~c.breakdown & (c.k.astype(steps.dtype) < steps)

    return jax.lax.while_loop(goes_on, partial(_step, passes, limits), c)


def _step(passes: Passes, limits: Limits, c: Recurrence) -> Recurrence:
    eps = jnp.finfo(c.rr.dtype).eps
    s, gamma = passes.product(c.r)
    beta = gamma / c.gamma
    p, q, qq = passes.combined((c.r, beta, c.p), (s, beta, c.q), onto=1)
    rounding = eps * jnp.sqrt(c.rr * (qq + beta**2 * c.qq))  # of γ: ε‖r‖‖s‖
    breakdown = jnp.abs(gamma) <= rounding
    alpha = jnp.where(breakdown, 0, gamma / jnp.where(breakdown, 1, qq))
    x, r, rr = passes.combined((c.x, alpha, p), (c.r, -alpha, q), onto=0)
    small_increment = c.small_increment
    if limits.increment_rtol is not None:
        small = alpha**2 * passes.dot(p, p) <= limits.increment_rtol**2 * passes.dot(x, x)
        small_increment = ~breakdown & small
    return Recurrence(
        x=x,
        r=r,
        p=p,
        q=q,
        rr=rr,
        qq=qq,
        gamma=gamma,
        k=c.k + 1,
        radius=jnp.maximum(c.radius, jnp.abs(gamma) / c.rr),
        small_increment=small_increment,
        breakdown=breakdown,
        indefinite=c.indefinite | (gamma < -rounding),
    )


def recur_by_matrices(
    matrices: ParticleMatrices,
    weight: Float[Array, "m"],
    active: Bool[Array, "k"],
    limits: Limits,
    c: Recurrence,
) -> Recurrence:
    """The same for these matrices and a diagonal W. Of the vectors only x is returned; the others are as they were.

    Args:
        matrices: A.
        weight: the diagonal of W, shape (m,).
        active: `active_blocks`. In others x and r are zero.
        limits: what ends it, without an `increment_rtol`.
        c: the state before the first step.
    """
    numbers = (limits.tolerance, limits.floor, limits.steps, c.rr)
    numbers = jnp.stack([jnp.asarray(number, c.rr.dtype) for number in numbers])
    factor = jnp.asarray(matrices.factor, c.rr.dtype)
    given = matrices.upper, matrices.mass, factor, matrices.free, weight, active, c.x, c.r, numbers
    x, (rr, k, radius, breakdown, indefinite) = _recur_p.bind(*matrices.factors, *given, batched=0)
    return eqx.tree_at(
        lambda c: (c.x, c.rr, c.k, c.radius, c.breakdown, c.indefinite),
        c,
        (x, rr, k.astype(jnp.int32), radius, breakdown > 0, indefinite > 0),
    )


def _recur(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # the sums know
    index, weights, derivatives, upper, mass, factor, free, weight, active, x, r, numbers = args
    matrices = ParticleMatrices((index, weights, derivatives), upper, mass, factor, free)
    passes = Passes(
        product=lambda u: matrices.product(u, weight, active),
        combined=lambda one, other, onto: combine(one, other, weight, active, onto=onto),
        dot=lambda a, c: (weight * a * c).sum(),
    )
    tolerance, floor, steps, rr = numbers
    c = recur(passes, Limits(tolerance, floor, steps), Recurrence.begun(x, r, rr))
    return [c.x, jnp.stack([a.astype(rr.dtype) for a in (c.rr, c.k, c.radius, c.breakdown, c.indefinite)])]


def _vector_and_numbers(*args: ShapedArray) -> list[tuple]:
    return [args[-3].shape[-1:], (5,)]


def _fits(avals: Any, batched: int) -> bool:
    return sums_fit([aval for aval in avals if aval.dtype != np.bool_], batched)


_recur_p = differentiable(native_primitive("solve_recur", _recur, _vector_and_numbers, _fits, {9: 0}), _recur)
