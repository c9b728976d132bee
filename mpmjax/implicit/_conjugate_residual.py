"""The conjugate residual method."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.checks import require, require_fields, require_positive, require_tolerance
from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._linear_solve import NEARLY_CONVERGED, AbstractInnerProductSolver, default_rtol
from mpmjax.implicit._recurrence import Limits, ParticleMatrices, Passes, Recurrence, recur, recur_by_matrices
from mpmjax.implicit._vectors import active_blocks, combine

NEGLIGIBLE_CHANGE = 1e-3
"""Largest relative change of the solution by one more correction, where rounding hides the tolerance."""
_REACH = 64.0  # the recurrence's own residual means nothing below so many units of rounding of the one it started from


class ConjugateResidual(AbstractInnerProductSolver[lx.AbstractLinearOperator]):
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
    - `support`: where A is not the identity, booleans of the vector's structure. What is zero elsewhere stays zero
      there, and is passed over. Default: everywhere.
    - `product`: for a diagonal W, the operator's `product` (see `AbstractSymmetricOperator`), which may be faster than
      its `mv` and sums. Default: these.
    - `matrices`: for a diagonal W, the operator as one matrix for each particle (see `ParticleMatrices`), with which
      the recurrence is one call of the native library. Default: that it is not of this kind.

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
        rtol: relative tolerance. Default: 1e-8 in float64, 1e-5 in float32.
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

    def init(self, operator: lx.AbstractLinearOperator, options: dict[str, Any]) -> lx.AbstractLinearOperator:
        if not lx.is_symmetric(operator):
            raise ValueError("ConjugateResidual needs a symmetric operator; tag it lineax.symmetric_tag if it is one.")
        if "preconditioner" in options:
            raise ValueError(
                "ConjugateResidual takes no preconditioner, which is an approximate inverse of the operator, but an "
                "inner product: options={'inner_product': W}, W an approximation of the operator itself."
            )
        return operator

    # The recurrence is the derivation's, with the application of E moved to the head of the loop, which saves the last
    # one. Around it is a loop that this method's textbook form lacks: the recurrence's residual drifts from the true
    # one (by ε‖E‖‖x‖ a step). So when the recurrence's residual meets the tolerance, or is too small to be trusted, the
    # true residual is computed, and if that is not small enough the recurrence starts anew from it. Three sums over the
    # vector are all that an iteration takes: ‖s‖ follows from ‖q‖, the q being orthogonal.
    def compute(
        self, state: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
    ) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        system = _system(self, state, vector, options)
        y0 = options.get("y0")
        x = jnp.zeros_like(system.b) if y0 is None else system.started(ravel_pytree(y0)[0])
        c = jax.lax.while_loop(lambda c: ~c.done, partial(_restart, system), _start(x, system.b.dtype))
        result, stats = _outcome(system, c)
        return system.unravel(system.plain(c.x)), result, stats

    def transpose(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def conj(self, state: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        return state, options

    def assume_full_rank(self) -> bool:
        return True


class _System(eqx.Module):
    """E x = b in the inner product of W, on flat vectors, with its tolerances."""

    operator: lx.AbstractLinearOperator
    inner: AbstractInnerProduct
    unravel: Callable[[Array], Any] = eqx.field(static=True)
    b: Float[Array, "*pair m"]
    """W⁻¹ times the right-hand side."""
    b_norm: Float[Array, ""]
    rtol: Scalar
    increment_rtol: Scalar | None
    max_steps: int = eqx.field(static=True)

    def apply(self, u: Array) -> Array:
        """E u."""
        return self.inner.solve(ravel_pytree(self.operator.mv(self.unravel(u)))[0])

    def product(self, u: Array) -> tuple[Array, Float[Array, ""]]:
        """E u, and uᵀA u."""
        image = self.apply(u)
        return image, self.dot(u, image)

    def dot(self, a: Array, c: Array) -> Float[Array, ""]:
        """aᵀ W c."""
        return (self.inner.apply(a) * c).sum()

    def norm(self, a: Array) -> Float[Array, ""]:
        """‖a‖ in the norm of W."""
        return jnp.sqrt(self.dot(a, a))

    def started(self, x: Array) -> Array:
        """A plain vector as those of the recurrence."""
        return x

    def plain(self, x: Array) -> Array:
        """And back."""
        return x

    def combined(
        self, one: tuple[Array, Scalar, Array], other: tuple[Array, Scalar, Array], *, onto: int
    ) -> tuple[Array, Array, Float[Array, ""]]:
        """From (a, s, b) and (c, t, d): a + s b, c + t d, and the square of the latter's norm (see `combine`)."""
        del onto
        (a, s, b), (c, t, d) = one, other
        second = c + t * d
        return a + s * b, second, self.dot(second, second)

    def recur(self, limits: Limits, c: Recurrence) -> Recurrence:
        """The state at the end of the recurrence."""
        return recur(Passes(self.product, self.combined, self.dot), limits, c)

    @property
    def eps(self) -> Any:
        """The rounding unit."""
        return jnp.finfo(self.b.dtype).eps


class _DiagonalSystem(_System):
    """The same for a diagonal W. Where no vector is different from zero, none becomes so, and all are passed over."""

    weight: Float[Array, "m"]
    """W."""
    active: Bool[Array, "k"]
    """Where vectors may be different from zero (see `active_blocks`)."""
    fused: Callable[..., tuple[Array, Float[Array, ""]]] | None
    """The operator's `product`, if it was given."""
    matrices: ParticleMatrices | None
    """The operator's `matrices`, likewise."""

    def recur(self, limits: Limits, c: Recurrence) -> Recurrence:
        if self.matrices is None or limits.increment_rtol is not None:
            return super().recur(limits, c)
        return recur_by_matrices(self.matrices, self.weight, self.active, limits, c)

    def product(self, u: Array) -> tuple[Array, Float[Array, ""]]:
        if self.fused is None:
            return super().product(u)
        image, square = self.fused(self.unravel(u), self.unravel(self.weight), self.active)
        return image.reshape(-1), square

    def combined(
        self, one: tuple[Array, Scalar, Array], other: tuple[Array, Scalar, Array], *, onto: int
    ) -> tuple[Array, Array, Float[Array, ""]]:
        return combine(one, other, self.weight, self.active, onto=onto)


class _PairedSystem(_System):
    """The same on pairs (v, W v), shape (2, m), for a W that is dear to apply: a step takes W⁻¹ once, and W never."""

    def apply(self, u: Array) -> Array:
        image = ravel_pytree(self.operator.mv(self.unravel(u[0])))[0]
        return jnp.stack([self.inner.solve(image), image])

    def dot(self, a: Array, c: Array) -> Float[Array, ""]:
        return (a[1] * c[0]).sum()

    def started(self, x: Array) -> Array:
        return jnp.stack([x, self.inner.apply(x)])

    def plain(self, x: Array) -> Array:
        return x[0]


class _Restarts(eqx.Module):
    """The state between two restarts of the recurrence."""

    x: Array
    rr: Float[Array, ""]
    """‖r‖²."""
    k: Int[Array, ""]
    """Steps taken."""
    radius: Float[Array, ""]
    """Largest Rayleigh quotient rᵀA r/‖r‖² so far."""
    restart_rr: Float[Array, ""]
    """‖r‖² at the last restart, of the true residual."""
    correction: Float[Array, ""]
    """Change of x between the last two restarts, in the norm of W."""
    stalled: Bool[Array, ""]
    """Whether the true residual has not halved between the last two restarts."""
    small_increment: Bool[Array, ""]
    """Whether the last increment was within `increment_rtol`."""
    breakdown: Bool[Array, ""]
    """Whether rᵀA r = 0 to rounding was met."""
    indefinite: Bool[Array, ""]
    """Whether rᵀA r < 0 beyond rounding was met."""
    done: Bool[Array, ""]


def _system(
    solver: ConjugateResidual, operator: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
) -> _System:
    flat, unravel = ravel_pytree(vector)
    inner: AbstractInnerProduct | None = options.get("inner_product")
    inner = DiagonalInnerProduct(jnp.ones_like(flat)) if inner is None else inner.flattened(unravel)
    b = jnp.stack([inner.solve(flat), flat]) if inner.paired else inner.solve(flat)
    rtol = default_rtol(flat.dtype) if solver.rtol is None else solver.rtol
    given = operator, inner, unravel, b, b.ravel()[0], rtol, solver.increment_rtol, solver.max_steps
    if inner.paired:
        system = _PairedSystem(*given)
    elif isinstance(inner, DiagonalInnerProduct):
        found = options.get("product"), options.get("matrices")
        system = _DiagonalSystem(*given, inner.weight, _active(flat, options), *found)
    else:
        system = _System(*given)
    return replace(system, b_norm=system.norm(b))


def _active(rhs: Array, options: dict[str, Any]) -> Bool[Array, "k"]:
    """Where a vector of a solve with a diagonal W may be different from zero, as `active_blocks` has it."""
    support, y0 = options.get("support"), options.get("y0")
    inside = jnp.ones(rhs.shape, bool) if support is None else ravel_pytree(support)[0]
    return active_blocks(inside, rhs != 0, *([] if y0 is None else [ravel_pytree(y0)[0] != 0]))


def _start(x: Array, dtype: Any) -> _Restarts:
    zero, infinite, no = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype), jnp.asarray(False)
    return _Restarts(
        x=x,
        rr=infinite,
        k=jnp.asarray(0, dtype=jnp.int32),
        radius=zero,
        restart_rr=infinite,
        correction=infinite,
        stalled=no,
        small_increment=no,
        breakdown=no,
        indefinite=no,
        done=no,
    )


def _goes_on(system: _System, c: _Restarts) -> Bool[Array, ""]:
    above = jnp.sqrt(c.rr) > system.rtol * system.b_norm
    return above & ~c.small_increment & ~c.breakdown & (c.k < system.max_steps)


def _restart(system: _System, c: _Restarts) -> _Restarts:
    """Run the recurrence from the true residual, until its own residual meets the tolerance or is too small to be
    trusted."""
    r = system.b - system.product(c.x)[0]
    rr = system.dot(r, r)
    c = replace(c, rr=rr, restart_rr=rr, stalled=rr > c.restart_rr / 4)
    done = c.stalled | ~_goes_on(system, c)
    limits = Limits(
        tolerance=system.rtol * system.b_norm,
        floor=(_REACH * system.eps) ** 2 * rr,
        steps=jnp.where(done, 0, system.max_steps - c.k),
        increment_rtol=system.increment_rtol,
    )
    end = system.recur(limits, Recurrence.begun(c.x, r, rr))
    return replace(
        c,
        x=end.x,
        rr=end.rr,
        k=c.k + end.k,
        radius=jnp.maximum(c.radius, end.radius),
        small_increment=c.small_increment | end.small_increment,
        breakdown=c.breakdown | end.breakdown,
        indefinite=c.indefinite | end.indefinite,
        correction=jnp.where(done, c.correction, system.norm(end.x - c.x)),
        done=done,
    )


def _outcome(system: _System, c: _Restarts) -> tuple[lx.RESULTS, dict[str, Any]]:
    """The result and statistics at the end of the iteration."""
    residual, tolerance = jnp.sqrt(c.rr), system.rtol * system.b_norm
    negligible = c.correction <= NEGLIGIBLE_CHANGE * system.norm(c.x)
    exact = c.stalled & ~c.breakdown & (c.k < system.max_steps) & negligible
    converged = ((residual <= tolerance) | exact | c.small_increment) & jnp.isfinite(residual)
    result = lx.RESULTS.where(c.k < system.max_steps, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
    result = lx.RESULTS.where(c.breakdown, lx.RESULTS.breakdown, result)
    result = lx.RESULTS.where(jnp.isfinite(residual), result, lx.RESULTS.nonfinite_input)
    result = lx.RESULTS.where(converged, lx.RESULTS.successful, result)
    return result, {
        "num_steps": c.k,
        "max_steps": system.max_steps,
        "residual": residual / jnp.where(system.b_norm == 0, 1, system.b_norm),
        "spectral_radius": c.radius,
        "indefinite": c.indefinite,
        "nearly_converged": ~converged & (residual <= NEARLY_CONVERGED * system.rtol * system.b_norm),
    }
