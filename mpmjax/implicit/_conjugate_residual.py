"""The conjugate residual method."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import require, require_fields, require_positive, require_tolerance
from mpmjax.discretisation import Basis, basis_attributes, resist_unscaled, sums_fit, without_flat
from mpmjax.implicit._hessian import ParticleStiffness
from mpmjax.implicit._linear_solve import (
    NEARLY_CONVERGED,
    AbstractInnerProduct,
    AbstractInnerProductSolver,
    DiagonalInnerProduct,
    default_rtol,
)
from mpmjax.implicit._operator import ImplicitOperator, rest_of_product, vectors_fit
from mpmjax.native import NativeFunction, call_library

NEGLIGIBLE_CHANGE = 1e-3
"""Largest relative change of the solution by one more correction, where rounding hides the tolerance."""

_REACH = 64.0  # the recurrence's own residual means nothing below so many units of rounding of the one it started from
_BLOCK_SIZE = 64  # as in native/vectors.h
_Combination = tuple[Array, Scalar, Array]


class ConjugateResidual(AbstractInnerProductSolver):
    """The conjugate residual method for a symmetric operator A, definite or not (E. Stiefel, Comment. Math. Helv. 29
    (1955) 157, doi 10.1007/BF02564277; the recurrence is derivation, eq. 19).

    It works on E = W⁻¹A in the inner product ⟨a, b⟩ = aᵀ W b, in which E is self-adjoint (derivation, eq. 18). With W
    the mass, E is the matrix I + βΔt²M⁻¹H of eq. 6, which is not symmetric in the plain inner product. The norm ‖r‖ of
    the residual r = W⁻¹(b − A x) never grows.

    It stops when ‖r‖ ≤ rtol ‖W⁻¹b‖ for the *true* residual. If rounding prevents that, the recurrence is restarted with
    the true residual as right-hand side until a restart no longer halves it. The result is then accepted if the last
    correction, which estimates the error, changed x by at most a thousandth in the norm of W. (A test of the residual
    would not do: in an ill-conditioned system it can be down to rounding while x is far off.) The residual that is
    returned shows how closely the tolerance was met.

    Options of `compute` (all optional):

    - `inner_product`: the inner product of W, an `AbstractInnerProduct`. Default: W = I.
    - `y0`: the initial guess. Default: zeros.
    - `rtol`: the relative tolerance where the solver has none. Default: that of the precision.

    Statistics returned:

    - `num_steps`: applications of E in the recurrence.
    - `residual`: the true ‖r‖/‖W⁻¹b‖.
    - `spectral_radius`: an estimate of ‖E‖.
    - `indefinite`: whether rᵀA r < 0 beyond rounding was met. A is then not positive definite; the converse does not
      hold.
    - `nearly_converged`: whether it did not converge, but came within ten times `rtol`.

    *When it breaks*: with an indefinite A the recurrence stops where rᵀA r = 0. The result is then
    `RESULTS.breakdown`.

    Args:
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32; 1e-6 there as an adjoint solver.
        increment_rtol: stop also when an increment is small, ‖α_k p_k‖² ≤ increment_rtol² ‖x‖² (the
            alternative named after eq. 20 of the derivation). Default: not used. It says nothing of the residual.
        max_steps: largest number of steps of the recurrence.
    """

    rtol: Scalar | None = None
    increment_rtol: Scalar | None = None
    max_steps: int = eqx.field(static=True, default=1000)

    def __check_init__(self):
        require_fields(self)
        if self.rtol is not None:
            require_tolerance("ConjugateResidual's rtol", self.rtol)
        if self.increment_rtol is not None:
            require_positive("ConjugateResidual's increment_rtol", self.increment_rtol)
        require(self.max_steps >= 1, f"ConjugateResidual's max_steps must be at least 1, got {self.max_steps}.")

    def init(self, operator: Any, options: dict[str, Any]) -> Any:
        if not isinstance(operator, ImplicitOperator) and not lx.is_symmetric(operator):
            raise ValueError("ConjugateResidual needs a symmetric operator; tag it lineax.symmetric_tag if it is one.")
        if "preconditioner" in options:
            raise ValueError(
                "ConjugateResidual takes no preconditioner, which is an approximate inverse of the operator, but an "
                "inner product: options={'inner_product': W}, W an approximation of the operator itself."
            )
        return operator

    def compute(self, state: Any, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        flat, unravel = ravel_pytree(vector)
        rtol = options.get("rtol", default_rtol(flat.dtype)) if self.rtol is None else self.rtol
        x = jnp.zeros_like(flat) if options.get("y0") is None else ravel_pytree(options["y0"])[0]
        inner = options.get("inner_product")
        ours = state if isinstance(state, ImplicitOperator) else None

        def multiply(u: Array) -> Array:
            return ravel_pytree(state.mv(unravel(u)))[0]

        if isinstance(inner, AbstractInnerProduct) and not isinstance(inner, DiagonalInnerProduct):
            space = _PairSpace(multiply, lambda r: ravel_pytree(inner.solve(unravel(r)))[0])
            b, x = space.pair(flat), jnp.stack([x, ravel_pytree(inner.apply(unravel(x)))[0]])
        else:
            weight = jnp.ones_like(flat) if inner is None else ravel_pytree(inner.weight)[0]
            support = jnp.ones(flat.shape, bool) if ours is None else ours.projection.free.reshape(-1)
            active, b = active_blocks(support, flat != 0, x != 0), flat / weight

            def product(u: Array) -> Sequence[Array]:
                if ours is not None:
                    return ours.product(u, weight, active)
                image = multiply(u)
                return image / weight, (u * image).sum()

            space = _DiagonalSpace(product, weight, active)
        if ours and isinstance(space, _DiagonalSpace) and ours.is_particle_matrices and self.increment_rtol is None:
            end = solve_particle_matrices(ours, space, b, x, rtol, self.max_steps)
        else:
            end = conjugate_residual(space, b, x, rtol, self.max_steps, self.increment_rtol)
        result, stats = _outcome(end, rtol, self.max_steps)
        return unravel(end.x.reshape(-1, flat.size)[0]), result, stats

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


class Iterate(NamedTuple):
    """An iterate in the letters of the derivation, eq. 19, and the state of its iteration. Norms are those of W."""

    x: Array
    rr: Float[Array, ""]
    """‖r‖²; of the true residual at the end."""
    k: Int[Array, ""]
    """Steps taken."""
    radius: Float[Array, ""]
    """Largest Rayleigh quotient |rᵀA r|/‖r‖²."""
    breakdown: Bool[Array, ""]
    """Whether rᵀA r = 0 to rounding was met."""
    indefinite: Bool[Array, ""]
    """Whether rᵀA r < 0 beyond rounding was met."""
    correction: Float[Array, ""]
    """Change of x since the last restart but one, which estimates its error; infinite if there was none."""
    stalled: Bool[Array, ""]
    """Whether the true residual has not halved between the last two restarts."""
    b_norm: Float[Array, ""]
    """‖W⁻¹b‖."""
    x_norm: Any
    """‖x‖; None before the end."""
    small_increment: Bool[Array, ""] | bool = False
    """Whether the last increment was within `increment_rtol`."""
    r: Any = None  # None, as the rest, where the library has iterated
    p: Any = None
    q: Any = None
    qq: Any = None
    """‖q‖²."""
    gamma: Any = None
    restart_rr: Any = None
    """‖r‖² at the last restart."""
    done: Any = None


class _DiagonalSpace(NamedTuple):
    """Vectors with a diagonal W. They are zero outside of the active blocks, which are skipped."""

    product: Callable[[Array], Sequence[Array]]
    """E u and uᵀA u of u."""
    weight: Float[Array, "m"]
    """W."""
    active: Bool[Array, "k"]
    """See `active_blocks`."""

    def dot(self, a: Array, c: Array) -> Float[Array, ""]:
        """aᵀ W c."""
        return (self.weight * a * c).sum()

    def combine(self, one: _Combination, other: _Combination, *, onto: int) -> list[Array]:
        """From (a, s, b) and (c, t, d): a + s b, c + t d and ‖c + t d‖².

        Args:
            one: a, s and b.
            other: c, t and d.
            onto: the vectors that are not needed any more, whose memory results may take: 0 for a and c, 1 for b and d.
        """
        (a, s, b), (c, t, d) = one, other
        return combine_onto[onto](a, b, c, d, jnp.stack([s, t]), self.weight, self.active)


class _PairSpace(NamedTuple):
    """Vectors as pairs (v, W v), shape (2, m), with any W: a step then takes W⁻¹ once, and W never."""

    multiply: Callable[[Array], Array]
    """A v of v."""
    solve: Callable[[Array], Array]
    """W⁻¹ r of r."""

    def pair(self, r: Array) -> Array:
        """W⁻¹ r as a pair."""
        return jnp.stack([self.solve(r), r])

    def product(self, u: Array) -> tuple[Array, Float[Array, ""]]:
        image = self.pair(self.multiply(u[0]))
        return image, self.dot(u, image)

    def dot(self, a: Array, c: Array) -> Float[Array, ""]:
        return (a[1] * c[0]).sum()

    def combine(self, one: _Combination, other: _Combination, *, onto: int) -> list[Array]:
        del onto
        (a, s, b), (c, t, d) = one, other
        z = c + t * d
        return [a + s * b, z, self.dot(z, z)]


def conjugate_residual(
    space: _DiagonalSpace | _PairSpace,
    b: Array,
    x: Array,
    rtol: Scalar,
    max_steps: Scalar,
    increment_rtol: Scalar | None = None,
) -> Iterate:
    """The solution of E x = b.

    Args:
        space: E and the inner product.
        b: W⁻¹ times the right-hand side.
        x: the initial guess.
        rtol: the bound on ‖r‖/‖b‖.
        max_steps: the bound on the steps of the recurrence.
        increment_rtol: the bound on ‖α p‖/‖x‖; None without one.
    """
    # Differences from the derivation:
    #
    # 1. E is applied at the head of the loop, which saves the last application.
    # 2. A step takes three sums over the vectors: ‖s‖² follows from ‖q‖², as the q are orthogonal.
    # 3. The recurrence's residual drifts from the true one, by ε‖E‖‖x‖ a step. Where it meets the tolerance, or is too
    #    small to be trusted, the true residual is computed. If that is not small enough, the recurrence restarts from
    #    it, until a restart no longer halves it.
    eps, max_steps = jnp.finfo(b.dtype).eps, jnp.asarray(max_steps)
    b_norm = jnp.sqrt(space.dot(b, b))

    def in_progress(c: Iterate) -> Bool[Array, ""]:
        steps_left = c.k.astype(max_steps.dtype) < max_steps
        return (jnp.sqrt(c.rr) > rtol * b_norm) & ~c.small_increment & ~c.breakdown & steps_left

    def cond_fun(c: Iterate) -> Bool[Array, ""]:
        return ~c.done & in_progress(c) & (c.rr > (_REACH * eps) ** 2 * c.restart_rr)

    def body_fun(c: Iterate) -> Iterate:
        s, gamma = space.product(c.r)
        beta = gamma / c.gamma
        p, q, qq = space.combine((c.r, beta, c.p), (s, beta, c.q), onto=1)
        rounding = eps * jnp.sqrt(c.rr * (qq + beta**2 * c.qq))  # of γ: ε‖r‖‖s‖
        breakdown = jnp.abs(gamma) <= rounding
        alpha = jnp.where(breakdown, 0, gamma / jnp.where(breakdown, 1, qq))
        x, r, rr = space.combine((c.x, alpha, p), (c.r, -alpha, q), onto=0)
        small_increment = c.small_increment
        if increment_rtol is not None:
            small = alpha**2 * space.dot(p, p) <= increment_rtol**2 * space.dot(x, x)
            small_increment = ~breakdown & small
        radius, indefinite = jnp.maximum(c.radius, jnp.abs(gamma) / c.rr), c.indefinite | (gamma < -rounding)
        c = c._replace(x=x, r=r, p=p, q=q, rr=rr, qq=qq, gamma=gamma, k=c.k + 1, radius=radius)
        return c._replace(small_increment=small_increment, breakdown=breakdown, indefinite=indefinite)

    def restart(c: Iterate) -> Iterate:
        r = b - space.product(c.x)[0]
        rr = space.dot(r, r)
        # an infinite γ makes the first β zero, so that p and q begin as r and s
        start = c._replace(r=r, p=zeros, q=zeros, rr=rr, qq=zero, gamma=infinite, restart_rr=rr)
        stalled = rr > c.restart_rr / 4
        start = start._replace(stalled=stalled, done=stalled | ~in_progress(start))
        end = jax.lax.while_loop(cond_fun, body_fun, start)
        moved = end.x - c.x
        return end._replace(correction=jnp.where(end.done, c.correction, jnp.sqrt(space.dot(moved, moved))))

    zeros, zero, no = jnp.zeros_like(b), jnp.zeros_like(b_norm), jnp.zeros(b_norm.shape, bool)
    infinite, k = jnp.full_like(b_norm, jnp.inf), jnp.zeros(b_norm.shape, jnp.int32)
    start = Iterate(x, infinite, k, zero, no, no, infinite, no, b_norm, None, no)
    start = start._replace(r=zeros, p=zeros, q=zeros, qq=zero, gamma=infinite, restart_rr=infinite, done=no)
    end = jax.lax.while_loop(lambda c: ~c.done, restart, start)
    return end._replace(x_norm=jnp.sqrt(space.dot(end.x, end.x)))


def _outcome(end: Iterate, rtol: Scalar, max_steps: int) -> tuple[lx.RESULTS, dict[str, Any]]:
    """The result and statistics of `ConjugateResidual.compute`."""
    residual, tolerance = jnp.sqrt(end.rr), rtol * end.b_norm
    ended_early, finite = end.k < max_steps, jnp.isfinite(residual)
    negligible = end.correction <= NEGLIGIBLE_CHANGE * end.x_norm
    exact = end.stalled & ~end.breakdown & ended_early & negligible
    converged = ((residual <= tolerance) | exact | end.small_increment) & finite
    result = lx.RESULTS.where(ended_early, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
    result = lx.RESULTS.where(end.breakdown, lx.RESULTS.breakdown, result)
    result = lx.RESULTS.where(finite, result, lx.RESULTS.nonfinite_input)
    result = lx.RESULTS.where(converged, lx.RESULTS.successful, result)
    return result, {
        "num_steps": end.k,
        "max_steps": max_steps,
        "residual": residual / jnp.where(end.b_norm == 0, 1, end.b_norm),
        "spectral_radius": end.radius,
        "indefinite": end.indefinite,
        "nearly_converged": ~converged & (residual <= NEARLY_CONVERGED * tolerance),
    }


def active_blocks(*may_differ_from_zero: Bool[Array, "m"]) -> Bool[Array, "k"]:
    """Whether a block of 64 consecutive numbers may differ from zero, shape (⌈m/64⌉,). Others are skipped."""
    some = reduce(jnp.logical_or, may_differ_from_zero)
    return jnp.pad(some, (0, -len(some) % _BLOCK_SIZE)).reshape(-1, _BLOCK_SIZE).any(axis=1)


def solve_particle_matrices(
    operator: ImplicitOperator, space: _DiagonalSpace, b: Array, x: Array, rtol: Scalar, max_steps: Scalar
) -> Iterate:
    """`conjugate_residual` with an operator that `is_particle_matrices`, as a primitive.

    On CPUs the native library runs it as a whole, and in a batch each member by itself. A loop of JAX goes on for all
    members until the last one is done, and selects whole vectors in every step.
    """
    floor = (_REACH * jnp.finfo(b.dtype).eps) ** 2
    limits = jnp.stack([jnp.asarray(number, b.dtype) for number in (rtol, max_steps, floor)])
    hessian, free = operator.hessian, operator.projection.free.reshape(-1)
    assert isinstance(hessian, ParticleStiffness)
    stencil = hessian.stencil
    factor = jnp.asarray(operator.factor * stencil.slope**2, b.dtype)
    args = without_flat(stencil, hessian.upper), operator.mass, factor, free, space.weight, space.active, x, b, limits
    x, (rr, k, radius, breakdown, indefinite, correction, stalled, b_norm, x_norm) = _native_solve(
        stencil.first, stencil.offset, *args, basis=stencil.basis
    )
    flags = breakdown > 0, indefinite > 0
    return Iterate(x, rr, k.astype(jnp.int32), radius, *flags, correction, stalled > 0, b_norm, x_norm)


def _solve(first: Array, t: Array, *args: Array, basis: Basis) -> list[Array]:
    """`solve_particle_matrices`, written in JAX."""
    upper, mass, factor, free, weight, active, x, b, limits = args

    def product(u: Array) -> list[Array]:
        moved = jnp.where(free, u, 0).reshape(len(mass), -1)
        force = resist_unscaled(basis, first, t, upper, moved).reshape(-1)
        return rest_of_product(force, u, mass, factor, free, weight, active)

    end = conjugate_residual(_DiagonalSpace(product, weight, active), b, x, limits[0], limits[1])
    return [end.x, jnp.stack([a.astype(b.dtype) for a in end[1:10]])]


def _call_solve(first: Array, t: Array, *args: Array, basis: Basis, batched: int) -> list[Array]:
    """By the library, with memory for six vectors. Members of a batch, which run one after the other in a thread, take
    their own."""
    results = _native_solve.results(first, t, *args, basis=basis, batched=batched)
    memory = (*first.shape[:batched], 0 if batched else 6 * args[-3].shape[-1])
    aliases = {2 + len(args) - 3: 0}
    told = basis_attributes(basis)
    return call_library("solve", [first, t, *args], [*results, (memory, t.dtype)], told, aliases)[:2]


# The derivative is that of the loop in JAX, and never taken: solves are not differentiated through their iterations.
_native_solve = NativeFunction(
    "solve",
    _solve,
    lambda *args, basis: [args[-3].shape[-1:], (9,)],
    sums_fit,
    like=1,
    native=_call_solve,
    differentiable=True,
)


def _combine(*args: Array) -> list[Array]:
    a, b, c, d, scales, weight, _ = args
    y, z = a + scales[0] * b, c + scales[1] * d
    return [y, z, (weight * z * z).sum()]


combine_onto = tuple(
    NativeFunction(
        "combine",
        _combine,
        lambda *args: [args[0].shape[-1:], args[0].shape[-1:], ()],
        vectors_fit,
        aliases={onto: 0, 2 + onto: 1},
        differentiable=True,
    )
    for onto in (0, 1)
)
"""Two sums of two vectors with a norm. In JAX these are some four passes over the window, of which a body may fill a
small part; natively it is one, in place, that skips inactive blocks."""
