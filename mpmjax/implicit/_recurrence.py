"""The recurrence of the conjugate residual method (derivation, eq. 19): what it carries, its step, and its loop."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, Scalar
from mpmjax.discretisation import Places, resist
from mpmjax.implicit._vectors import product


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
        """W⁻¹A u and uᵀA u (see `product` of vectors)."""
        moved = jnp.where(self.free, u, 0).reshape(len(self.mass), -1)
        force = resist(self, self.upper, moved).reshape(-1)
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

    def norm(self, a: Array) -> Float[Array, ""]:
        """‖a‖ in the norm of W."""
        return jnp.sqrt(self.dot(a, a))


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
