"""The conjugate residual method."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import lineax as lx
from jax.flatten_util import ravel_pytree

from mpmjax._types import Array, Bool, Float, Scalar
from mpmjax.checks import require, require_fields, require_positive, require_tolerance
from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._linear_solve import NEARLY_CONVERGED, AbstractInnerProductSolver, default_rtol
from mpmjax.implicit._recurrence import ParticleMatrices, Passes
from mpmjax.implicit._restarts import Ends, Found, restarted, restarted_by_matrices
from mpmjax.implicit._vectors import active_blocks, combine

NEGLIGIBLE_CHANGE = 1e-3
"""Largest relative change of the solution by one more correction, where rounding hides the tolerance."""


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
      the whole iteration is one call of the native library. Default: that it is not of this kind.
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
        found = system.solve(x)
        result, stats = _outcome(system, found)
        return system.unravel(system.plain(found.x)), result, stats

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
    ends: Ends

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

    def solve(self, x: Array) -> Found:
        """The end of the iteration, which starts at x."""
        return restarted(Passes(self.product, self.combined, self.dot), self.ends, self.b, x)


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

    def solve(self, x: Array) -> Found:
        if self.matrices is None or self.ends.increment_rtol is not None:
            return super().solve(x)
        return restarted_by_matrices(self.matrices, self.weight, self.active, self.ends, self.b, x)

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


def _system(
    solver: ConjugateResidual, operator: lx.AbstractLinearOperator, vector: Any, options: dict[str, Any]
) -> _System:
    flat, unravel = ravel_pytree(vector)
    inner: AbstractInnerProduct | None = options.get("inner_product")
    inner = DiagonalInnerProduct(jnp.ones_like(flat)) if inner is None else inner.flattened(unravel)
    b = jnp.stack([inner.solve(flat), flat]) if inner.paired else inner.solve(flat)
    rtol = options.get("rtol", default_rtol(flat.dtype)) if solver.rtol is None else solver.rtol
    given = operator, inner, unravel, b, Ends(rtol, solver.max_steps, solver.increment_rtol)
    if inner.paired:
        return _PairedSystem(*given)
    if isinstance(inner, DiagonalInnerProduct):
        found = options.get("product"), options.get("matrices")
        return _DiagonalSystem(*given, inner.weight, _active(flat, options), *found)
    return _System(*given)


def _active(rhs: Array, options: dict[str, Any]) -> Bool[Array, "k"]:
    """Where a vector of a solve with a diagonal W may be different from zero, as `active_blocks` has it."""
    support, y0 = options.get("support"), options.get("y0")
    inside = jnp.ones(rhs.shape, bool) if support is None else ravel_pytree(support)[0]
    return active_blocks(inside, rhs != 0, *([] if y0 is None else [ravel_pytree(y0)[0] != 0]))


def _outcome(system: _System, found: Found) -> tuple[lx.RESULTS, dict[str, Any]]:
    """The result and statistics at the end of the iteration."""
    residual, rtol, most = jnp.sqrt(found.rr), system.ends.rtol, system.ends.steps
    negligible = found.correction <= NEGLIGIBLE_CHANGE * found.x_norm
    exact = found.stalled & ~found.breakdown & (found.k < most) & negligible
    converged = ((residual <= rtol * found.b_norm) | exact | found.small_increment) & jnp.isfinite(residual)
    result = lx.RESULTS.where(found.k < most, lx.RESULTS.stagnation, lx.RESULTS.max_steps_reached)
    result = lx.RESULTS.where(found.breakdown, lx.RESULTS.breakdown, result)
    result = lx.RESULTS.where(jnp.isfinite(residual), result, lx.RESULTS.nonfinite_input)
    result = lx.RESULTS.where(converged, lx.RESULTS.successful, result)
    return result, {
        "num_steps": found.k,
        "max_steps": most,
        "residual": residual / jnp.where(found.b_norm == 0, 1, found.b_norm),
        "spectral_radius": found.radius,
        "indefinite": found.indefinite,
        "nearly_converged": ~converged & (residual <= NEARLY_CONVERGED * rtol * found.b_norm),
    }
