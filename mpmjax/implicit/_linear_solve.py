"""One linear solve by any symmetric solver of lineax, and the report of solves."""

import abc
import math
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector
from mpmjax.checks import require_that
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._preconditioner import AbstractInnerProduct

_State = TypeVar("_State")
_DEFAULT_RTOL = {4: 1e-5, 8: 1e-8}  # by bytes a number

NEARLY_CONVERGED = 10.0
"""A solve that ends within this many times its tolerance is accepted, and counted as less accurate. The error is
proportional to the residual, so seven of eight digits are left, or four of the five of float32."""


def default_rtol(dtype: Any) -> float:
    """The default relative tolerance: 1e-8 in float64, 1e-5 in float32."""
    return _DEFAULT_RTOL[jnp.dtype(dtype).itemsize]


class SolveInfo(eqx.Module):
    """Cost and quality of the solution of one step's equations."""

    iterations: Int[Array, "*f"]
    """Iterations of the linear solver, summed over Newton steps; 0 if the solver states none."""
    newton: Int[Array, "*f"]
    """Newton steps."""
    line_search: Int[Array, "*f"]
    """Halvings of a Newton step by the line search."""
    residual: Float[Array, "*f"]
    """True relative residual at the end. For one linear solve it is in the norm of the inverse preconditioner; for
    Newton's method in that of the inverse mass, and relative to the momentum of the balanced forces if their sum
    vanishes."""
    converged: Bool[Array, "*f"]
    """Whether the residual is within the solver's tolerance, or at the limit of the precision."""
    nearly_converged: Bool[Array, "*f"]
    """Whether it is not, but within ten times the tolerance."""
    indefinite: Bool[Array, "*f"]
    """Whether the solver met a direction of negative curvature. M + χH is then indefinite, and may be near singular."""
    report: Float[Array, "*f"]
    """Zero. Its tangent is the relative residual of the tangent solves that did not converge (see `Reporting`)."""

    def followed_by(self, later: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves of one equation, and the quality of the later one."""
        return SolveInfo(
            iterations=self.iterations + later.iterations,
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            residual=later.residual,
            converged=later.converged,
            nearly_converged=later.nearly_converged,
            indefinite=self.indefinite | later.indefinite,
            report=self.report + later.report,
        )

    def together_with(self, other: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves that are both needed, and the quality of the worse one."""
        both = self.followed_by(other)
        converged = self.converged & other.converged
        usable = (self.converged | self.nearly_converged) & (other.converged | other.nearly_converged)
        worst = jnp.maximum(self.residual, other.residual), converged, usable & ~converged
        return eqx.tree_at(lambda info: (info.residual, info.converged, info.nearly_converged), both, worst)


def no_solve(dtype: Any) -> SolveInfo:
    """The report of an update without a solve."""
    count, zero, no = jnp.zeros((), jnp.int32), jnp.zeros((), dtype), jnp.zeros((), bool)
    return SolveInfo(count, count, count, residual=zero, converged=~no, nearly_converged=no, indefinite=no, report=zero)


class AbstractInnerProductSolver(lx.AbstractLinearSolver[_State], Generic[_State]):
    """A symmetric solver that takes an inner product itself.

    `compute` takes the option `inner_product`, an `AbstractInnerProduct`. Its result is successful if it converged. Its
    statistics are `num_steps`, `residual`, `nearly_converged` and `indefinite` (see `SolveInfo`), and
    `spectral_radius`, a lower estimate of ‖W⁻¹A‖.
    """

    @abc.abstractmethod
    def compute(self, state: _State, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Solve A x = vector. See `lineax.AbstractLinearSolver.compute`."""


def derivative_rtol(dtype: Any) -> float:
    """The default relative tolerance of tangent and adjoint solves: 1e-8 in float64, 1e-6 in float32. In float32 it is
    smaller than that of a step: in slow motion of stiff bodies the stiff parts of the right-hand side cancel, and the
    derivative's error is some hundred times the tolerance."""
    return min(default_rtol(dtype), 1e-6)


def solve_linear(
    solver: lx.AbstractLinearSolver,
    operator: ImplicitOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None = None,
    *,
    rtol: float | None = None,
) -> tuple[NodeVector, SolveInfo, Float[Array, ""]]:
    """Solve A x = b: x, the report, and a lower estimate of ‖W⁻¹A‖, 1 if the solver gives none.

    A solver that does not take an inner product is given the scaled system L⁻¹A L⁻ᵀ y = L⁻¹b/‖b‖ with W = L Lᵀ and
    x = ‖b‖ L⁻ᵀ y. It is symmetric and preconditioned, and its right-hand side has norm one, so that an absolute
    tolerance has no unit. The residual is computed here: a solution counts as converged only if that is within the
    tolerance too.

    Args:
        solver: a `lineax.AbstractLinearSolver` for symmetric operators.
        operator: A.
        rhs: b.
        inner: the inner product of W.
        guess: where an iterative solver starts. Default: zero.
        rtol: the relative tolerance of a solver that takes an inner product and has none of its own. Default: that of
            the precision.

    Raises:
        ValueError: the solver refuses the operator, or returns no vector.
    """
    if not isinstance(solver, AbstractInnerProductSolver):
        return _solve_scaled(solver, operator, rhs, inner.factored(), guess)
    options: dict[str, Any] = {"inner_product": inner}
    options |= {} if guess is None else {"y0": guess}
    options |= {} if rtol is None else {"rtol": rtol}
    x, result, stats = solver.compute(solver.init(operator, options), rhs, options)
    converged = result == lx.RESULTS.successful
    info = _info(stats["num_steps"], stats["residual"], converged, stats["nearly_converged"], stats["indefinite"])
    return x, info, stats["spectral_radius"]


def _info(iterations: Array, residual: Array, converged: Array, nearly: Array, indefinite: Array) -> SolveInfo:
    """The report of one linear solve."""
    none, zero = jnp.zeros((), jnp.int32), jnp.zeros_like(residual)
    return SolveInfo(iterations, none, none, residual, converged, nearly, indefinite, zero)


def _solve_scaled(
    solver: lx.AbstractLinearSolver,
    operator: ImplicitOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None,
) -> tuple[NodeVector, SolveInfo, Float[Array, ""]]:
    name, definite = type(solver).__name__, lx.is_positive_semidefinite(operator)
    b = inner.solve_factor(rhs)
    size = jnp.sqrt((b**2).sum())
    size = jnp.where(size == 0, 1, size)
    b = b / size
    options = {} if guess is None else {"y0": inner.solve_factor(inner.apply(guess)) / size}
    scaled = lx.FunctionLinearOperator(
        lambda y: inner.solve_factor(operator.mv(inner.solve_factor_transpose(y))),
        operator.in_structure(),
        (lx.symmetric_tag, lx.positive_semidefinite_tag) if definite else lx.symmetric_tag,
    )
    try:
        state = solver.init(scaled, options)
    except ValueError as error:
        kind = "positive definite, without other structure. Take a solver of such matrices, as ConjugateResidual()"
        if not definite:
            kind = (
                "may be indefinite. Take a solver of such matrices, as ConjugateResidual(); or make it positive "
                "definite with AnalyticHessian(projected=True), which for the adjoint_solver of Newton's method is no "
                "way out, as its derivatives are those of the true Hessian"
            )
        raise ValueError(
            f"{name} refuses the matrix M + χH of an implicit step: {str(error).rstrip('.')}. The matrix is symmetric "
            f"and {kind}."
        ) from error
    y, result, stats = solver.compute(state, b, options)
    if jnp.shape(y) != b.shape:
        raise ValueError(
            f"{name}.compute must return a solution of the right-hand side's shape, {b.shape}, got {jnp.shape(y)}."
        )
    Ay = scaled.mv(y)
    residual, tolerance = jnp.sqrt(((b - Ay) ** 2).sum()), _tolerance(solver, b)
    converged = (result == lx.RESULTS.successful) & (residual <= tolerance)
    nearly = ~converged & (residual <= NEARLY_CONVERGED * tolerance)
    iterations = jnp.asarray(stats.get("num_steps", 0), dtype=jnp.int32)
    info = _info(iterations, residual, converged, nearly, (y * Ay).sum() < 0)
    return size * inner.solve_factor_transpose(y), info, jnp.ones_like(residual)


def require_solver(name: str, solver: lx.AbstractLinearSolver) -> None:
    """Check a linear solver.

    Raises:
        ValueError: an absolute tolerance that is not above zero.
    """
    if (atol := getattr(solver, "atol", None)) is not None:
        require_that(
            f"{name} must have an atol above zero, as it compares residuals component by component and those of empty "
            "nodes are zero (right-hand sides are scaled to norm one, so that it may be as large as rtol)",
            lambda a: a > 0,
            atol,
        )


def _tolerance(solver: lx.AbstractLinearSolver, b: Array) -> Any:
    """The relative residual of a solver's tolerances: `rtol`, plus `atol` in each component of a right-hand side of
    norm one; that of the precision for a solver without them."""
    rtol, atol = getattr(solver, "rtol", None), getattr(solver, "atol", None)
    if rtol is None and atol is None:
        return default_rtol(b.dtype)
    return (0 if rtol is None else rtol) + math.sqrt(b.size) * (0 if atol is None else atol)
