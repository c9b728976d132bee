"""The recurrence of the conjugate residual method, begun anew from the true residual until that meets the tolerance.

Where the operator is M + χH with one matrix for each particle, this is a JAX primitive. On CPUs the native library runs
it as a whole, and in a batch each member by itself: a loop of JAX goes on for all members until the last one is done,
and selects whole vectors in every step.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.discretisation import bound, define_placed
from mpmjax.implicit._recurrence import Limits, ParticleMatrices, Passes, Recurrence, recur
from mpmjax.implicit._vectors import combine
from mpmjax.native import differentiable, native_primitive, sums_fit

_REACH = 64.0  # the recurrence's own residual means nothing below so many units of rounding of the one it started from


class Ends(eqx.Module):
    """What ends a solve."""

    rtol: Scalar
    """‖r‖/‖W⁻¹b‖ at which it is done."""
    steps: Scalar
    """The most steps of the recurrence."""
    increment_rtol: Scalar | None = None
    """‖α p‖/‖x‖ at which it is done too."""


class Found(eqx.Module):
    """What a solve has found. Norms are those of W."""

    x: Array
    rr: Float[Array, ""]
    """‖r‖²."""
    k: Int[Array, ""]
    """Steps taken."""
    radius: Float[Array, ""]
    """Largest Rayleigh quotient rᵀA r/‖r‖²."""
    small_increment: Bool[Array, ""]
    """Whether the last increment was within `increment_rtol`."""
    breakdown: Bool[Array, ""]
    """Whether rᵀA r = 0 to rounding was met."""
    indefinite: Bool[Array, ""]
    """Whether rᵀA r < 0 beyond rounding was met."""
    correction: Float[Array, ""]
    """Change of x by the last recurrence, which estimates its error; infinite if there was none."""
    stalled: Bool[Array, ""]
    """Whether the true residual has not halved between the last two restarts."""
    b_norm: Float[Array, ""]
    """‖W⁻¹b‖."""
    x_norm: Float[Array, ""]
    """‖x‖; zero until the end."""


class _Restarts(eqx.Module):
    """The state between two restarts of the recurrence."""

    found: Found
    restart_rr: Float[Array, ""]
    """‖r‖² at the last restart, of the true residual."""
    done: Bool[Array, ""]


def restarted(passes: Passes, ends: Ends, b: Array, x: Array) -> Found:
    """The end of a solve.

    Args:
        passes: what it does with vectors.
        ends: what ends it.
        b: W⁻¹ times the right-hand side.
        x: where it starts.
    """
    b_norm = passes.norm(b)
    zero, no = jnp.zeros_like(b_norm), jnp.zeros(b_norm.shape, bool)
    infinite = jnp.full_like(b_norm, jnp.inf)
    begun = Found(x, infinite, zero.astype(jnp.int32), zero, no, no, no, infinite, no, b_norm, zero)
    start = _Restarts(begun, infinite, no)
    found = jax.lax.while_loop(lambda c: ~c.done, partial(_restart, passes, ends, b), start).found
    return replace(found, x_norm=passes.norm(found.x))


def _restart(passes: Passes, ends: Ends, b: Array, c: _Restarts) -> _Restarts:
    """Run the recurrence from the true residual, until its own residual meets the tolerance or is too small to be
    trusted."""
    found, tolerance, steps = c.found, ends.rtol * c.found.b_norm, jnp.asarray(ends.steps)
    r = b - passes.product(found.x)[0]
    rr, k = passes.dot(r, r), found.k.astype(steps.dtype)
    stalled = rr > c.restart_rr / 4
    goes_on = (jnp.sqrt(rr) > tolerance) & ~found.small_increment & ~found.breakdown & (k < steps)
    done = stalled | ~goes_on
    limits = Limits(
        tolerance=tolerance,
        floor=(_REACH * jnp.finfo(rr.dtype).eps) ** 2 * rr,
        steps=jnp.where(done, 0, steps - k),
        increment_rtol=ends.increment_rtol,
    )
    end = recur(passes, limits, Recurrence.begun(found.x, r, rr))
    found = Found(
        x=end.x,
        rr=end.rr,
        k=found.k + end.k,
        radius=jnp.maximum(found.radius, end.radius),
        small_increment=found.small_increment | end.small_increment,
        breakdown=found.breakdown | end.breakdown,
        indefinite=found.indefinite | end.indefinite,
        correction=jnp.where(done, found.correction, passes.norm(end.x - found.x)),
        stalled=stalled,
        b_norm=found.b_norm,
        x_norm=found.x_norm,
    )
    return _Restarts(found, rr, done)


def restarted_by_matrices(
    matrices: ParticleMatrices, weight: Float[Array, "m"], active: Bool[Array, "k"], ends: Ends, b: Array, x: Array
) -> Found:
    """The same for these matrices and a diagonal W.

    Args:
        matrices: A.
        weight: the diagonal of W, shape (m,).
        active: `active_blocks`. In others x and b are zero.
        ends: what ends it, without an `increment_rtol`.
        b: W⁻¹ times the right-hand side.
        x: where it starts.
    """
    dtype = b.dtype
    floor = (_REACH * jnp.finfo(dtype).eps) ** 2
    numbers = jnp.stack([jnp.asarray(number, dtype) for number in (ends.rtol, ends.steps, floor)])
    factor = jnp.asarray(matrices.factor, dtype)
    given = matrices.upper, matrices.mass, factor, matrices.free, weight, active, x, b, numbers
    x, (rr, k, radius, breakdown, indefinite, correction, stalled, b_norm, x_norm) = bound(
        _solve_p, matrices, *given, batched=0
    )
    return Found(
        x=x,
        rr=rr,
        k=k.astype(jnp.int32),
        radius=radius,
        small_increment=jnp.zeros(rr.shape, bool),
        breakdown=breakdown > 0,
        indefinite=indefinite > 0,
        correction=correction,
        stalled=stalled > 0,
        b_norm=b_norm,
        x_norm=x_norm,
    )


def _solve(*args: Array, unroll: bool = False) -> list[Array]:
    del unroll  # the sums know
    index, weights, derivatives, upper, mass, factor, free, weight, active, x, b, numbers = args
    matrices = ParticleMatrices((index, weights, derivatives), None, upper, mass, factor, free)
    passes = Passes(
        product=lambda u: matrices.product(u, weight, active),
        combined=lambda one, other, onto: combine(one, other, weight, active, onto=onto),
        dot=lambda a, c: (weight * a * c).sum(),
    )
    rtol, steps, _ = numbers
    c = restarted(passes, Ends(rtol, steps), b, x)
    told = c.rr, c.k, c.radius, c.breakdown, c.indefinite, c.correction, c.stalled, c.b_norm, c.x_norm
    return [c.x, jnp.stack([a.astype(b.dtype) for a in told])]


def _vector_and_numbers(*args: ShapedArray) -> list[tuple]:
    return [args[-3].shape[-1:], (9,)]


def _vectors(*args: ShapedArray) -> tuple:
    """Six vectors to work in. Members of a batch, which run one after the other in a thread, take their own."""
    *batch, size = args[-3].shape
    return (0 if batch else 6 * size,)


def _fits(avals: Any, batched: int) -> bool:
    return sums_fit([aval for aval in avals if aval.dtype != np.bool_], batched)


# The derivative of what is written in JAX: solves are never differentiated through their iterations.
_solve_p = differentiable(
    native_primitive("matrices_solve", _solve, _vector_and_numbers, _fits, {9: 0}, workspace=_vectors, placed=False),
    _solve,
)
define_placed(_solve_p, _solve, _vector_and_numbers, workspace=_vectors, fits=_fits, aliases={10: 0})
