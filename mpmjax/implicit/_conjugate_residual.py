"""The conjugate residual method."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import require, require_fields, require_positive, require_tolerance

_DEFAULT_RTOL = {4: 1e-5, 8: 1e-8}  # by bytes a number
_REACH = 64.0  # the recurrence's own residual means nothing below so many units of rounding of the one it started from
SETTLED = 1e-3
"""Largest share of the solution by which one more correction may change it, where rounding hides the tolerance."""
SHORT = 10.0
"""A solve that ends within so many times its tolerance has a solution, less accurate than was asked for: the error is
proportional to the residual, so that of eight digits seven are left, of float32's five four."""


def default_rtol(dtype: Any) -> float:
    """1e-8 in float64, 1e-5 in float32."""
    return _DEFAULT_RTOL[jnp.dtype(dtype).itemsize]


class ConjugateResidual(lx.AbstractLinearSolver[lx.AbstractLinearOperator]):
    """Conjugate residuals for a symmetric operator A, definite or not (E. Stiefel, Comment. Math. Helv. 29 (1955) 157,
    doi 10.1007/BF02564277; the recurrences are those of the reference, section 2.1).

    It works on E = W⁻¹A in the inner product ⟨a, b⟩ = aᵀ W b of a positive diagonal *metric* W, in which E is
    self-adjoint; with W the mass this is the reference's algorithm, which in the plain inner product would not be
    conjugate residuals at all, E = I + βΔt²M⁻¹H not being symmetric. The norm ‖r‖ of the residual r = W⁻¹(b − A x)
    never grows.

    Stops when ‖r‖ ≤ rtol ‖W⁻¹b‖ for the *true* residual. Where rounding forbids that, the recurrence is repeated with
    the true residual as right-hand side until this does not halve it any more. The result then counts as a solution if
    the last correction, which is an estimate of the error, changed x by no more than a thousandth in the norm of W. The
    size of the residual would not do: of an ill-conditioned system it can be down to its own rounding while x is far
    off. The residual that is returned says how far the tolerance was met.

    Options of `compute` (both optional):

    - `metric`: W, of the vector's structure. Default: ones.
    - `y0`: the initial guess. Default: zeros.

    Statistics returned: `num_steps` (applications of E in the recurrence), `residual` (the true ‖r‖/‖W⁻¹b‖),
    `spectral_radius` (the estimate of ‖E‖), `indefinite` (whether rᵀA r < 0 was met, beyond rounding: A then is not
    positive definite; the converse does not hold), `short` (whether it did not converge, but came within ten times
    `rtol`).

    *When it breaks*: on an indefinite A the recurrence stops where rᵀA r = 0; the result is then
    `RESULTS.breakdown`, never silence.

    Args:
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32.
        increment_rtol: stop also when an increment is small, ‖α_k p_k‖² ≤ increment_rtol² ‖x‖² (the reference's test,
            made relative). Default: not used. It says nothing of the residual.
        max_steps: most steps of the recurrence.
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

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        """The operator, which must be symmetric."""
        del options
        if not lx.is_symmetric(operator):
            raise ValueError("ConjugateResidual needs a symmetric operator; tag it lineax.symmetric_tag if it is one.")
        return operator

    # The recurrence is the reference's, with the application of E moved to the head of the loop, which saves the last
    # one. Around it is a loop that this method's textbook form lacks: the recurrence's residual drifts from the true
    # one (by ε‖E‖‖x‖ a step), so when the recurrence is content, or at the end of its reach, the true residual is
    # computed, and if that is not small enough the recurrence starts anew from it. Three sums over the vector are all
    # that an iteration takes: ‖s‖ follows from ‖q‖, the q being orthogonal.
    def compute(
        self, state: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
    ) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Solve A x = vector. See `lineax.AbstractLinearSolver.compute`."""
        b, unravel = ravel_pytree(vector)
        metric = options.get("metric")
        w = jnp.ones_like(b) if metric is None else ravel_pytree(metric)[0]
        y0 = options.get("y0")
        x = jnp.zeros_like(b) if y0 is None else ravel_pytree(y0)[0]
        rtol = default_rtol(b.dtype) if self.rtol is None else self.rtol
        eps = jnp.finfo(b.dtype).eps

        def E(u: Array) -> Array:  # noqa: N802
            return ravel_pytree(state.mv(unravel(u)))[0] / w

        def dot(a: Array, c: Array) -> Float[Array, ""]:
            return (w * a * c).sum()

        def length(a: Array) -> Float[Array, ""]:
            return jnp.sqrt(dot(a, a))

        b = b / w
        b_norm = length(b)

        def goes_on(c: _Recurrence) -> Array:
            return (jnp.sqrt(c.rr) > rtol * b_norm) & ~c.settled & ~c.breakdown & (c.k < self.max_steps)

        def step(c: _Recurrence) -> _Recurrence:
            s = E(c.r)
            gamma = dot(c.r, s)
            beta = gamma / c.gamma
            p = c.r + beta * c.p
            q = s + beta * c.q
            qq = dot(q, q)
            noise = eps * jnp.sqrt(c.rr * (qq + beta**2 * c.qq))  # of γ: ε‖r‖‖s‖
            breakdown = jnp.abs(gamma) <= noise
            alpha = jnp.where(breakdown, 0, gamma / jnp.where(breakdown, 1, qq))
            x = c.x + alpha * p
            r = c.r - alpha * q
            settled = c.settled
            if self.increment_rtol is not None:
                settled = ~breakdown & (alpha**2 * dot(p, p) <= self.increment_rtol**2 * dot(x, x))
            return replace(
                c,
                x=x,
                r=r,
                p=p,
                q=q,
                rr=dot(r, r),
                qq=qq,
                gamma=gamma,
                radius=jnp.maximum(c.radius, jnp.abs(gamma) / c.rr),
                k=c.k + 1,
                settled=settled,
                breakdown=breakdown,
                indefinite=c.indefinite | (gamma < -noise),
            )

        def restart(c: _Recurrence) -> _Recurrence:
            r = b - E(c.x)
            rr = dot(r, r)
            moved, stalled = length(c.x - c.before), rr > c.true / 4
            c = replace(c, r=r, rr=rr, gamma=far, before=c.x, moved=moved, true=rr, stalled=stalled)
            c = replace(c, done=c.stalled | ~goes_on(c))
            return jax.lax.while_loop(lambda c: goes_on(c) & ~c.done & (c.rr > (_REACH * eps) ** 2 * c.true), step, c)

        no, none, far = jnp.asarray(False), jnp.zeros_like(b_norm), jnp.full_like(b_norm, jnp.inf)
        start = _Recurrence(
            x=x,
            r=b,
            p=jnp.zeros_like(b),
            q=jnp.zeros_like(b),
            rr=far,
            qq=none,
            gamma=far,
            before=x,
            moved=far,
            radius=none,
            k=jnp.asarray(0, dtype=jnp.int32),
            true=far,
            stalled=no,
            done=no,
            settled=no,
            breakdown=no,
            indefinite=no,
        )
        c = jax.lax.while_loop(lambda c: ~c.done, restart, start)
        residual = jnp.sqrt(c.rr)
        exact = c.stalled & ~c.breakdown & (c.k < self.max_steps) & (c.moved <= SETTLED * length(c.x))
        converged = ((residual <= rtol * b_norm) | exact | c.settled) & jnp.isfinite(residual)
        result = lx.RESULTS.where(c.k < self.max_steps, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
        result = lx.RESULTS.where(c.breakdown, lx.RESULTS.breakdown, result)
        result = lx.RESULTS.where(jnp.isfinite(residual), result, lx.RESULTS.nonfinite_input)
        result = lx.RESULTS.where(converged, lx.RESULTS.successful, result)
        stats = {
            "num_steps": c.k,
            "max_steps": self.max_steps,
            "residual": residual / jnp.where(b_norm == 0, 1, b_norm),
            "spectral_radius": c.radius,
            "indefinite": c.indefinite,
            "short": ~converged & (residual <= SHORT * rtol * b_norm),
        }
        return unravel(c.x), result, stats

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """The operator is symmetric."""
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """The operator is real."""
        return state, options

    def assume_full_rank(self) -> bool:
        """It is."""
        return True


class Reporting(eqx.Module):
    """The solver of tangent and adjoint systems, with a way to hear of those that did not converge.

    Their residuals cannot be returned: they are computed where only derivatives are. So they are themselves given out
    as derivatives, of zeros: the tangent of a solve's `report` in forward mode, the cotangent of `slot` in reverse mode
    is the sum of the relative residuals of the solves that did not converge, infinite where one is not finite. As such
    a solve gives NaN, and what is solved after it is not counted, that is the residual of the first.
    """

    solver: ConjugateResidual
    slot: Scalar
    """Zero."""


class _Recurrence(eqx.Module):
    """The state of the iteration, in the letters of the reference."""

    x: Array
    r: Array
    p: Array
    q: Array
    rr: Array
    """‖r‖²."""
    qq: Array
    """‖q‖²."""
    gamma: Array
    """rᵀA r; infinite where the recurrence starts anew, which makes β zero."""
    before: Array
    """x at the last restart."""
    moved: Array
    """By how much x was corrected before the last restart, in the norm of W."""
    radius: Array
    k: Array
    true: Array
    """‖r‖² at the last restart, of the true residual."""
    stalled: Array
    """Whether the true residual has not halved since the restart before."""
    done: Array
    settled: Array
    breakdown: Array
    indefinite: Array
