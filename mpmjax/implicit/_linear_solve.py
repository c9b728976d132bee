"""One linear solve by any symmetric solver of lineax, with the quality of its solution."""

import abc
import math
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector
from mpmjax.checks import require_that
from mpmjax.implicit._inner_product import AbstractInnerProduct
from mpmjax.implicit._operator import AbstractSymmetricOperator

_State = TypeVar("_State")
_DEFAULT_RTOL = {4: 1e-5, 8: 1e-8}  # by bytes a number

NEARLY_CONVERGED = 10.0
"""A solve that ends within this many times its tolerance is accepted, and counted as less accurate. The error is
proportional to the residual, so seven of eight digits are left, or four of the five of float32."""


def default_rtol(dtype: Any) -> float:
    """The default relative tolerance: 1e-8 in float64, 1e-5 in float32."""
    return _DEFAULT_RTOL[jnp.dtype(dtype).itemsize]


class LinearSolution(eqx.Module):
    """The solution of a linear system A x = b in an inner product W, with its cost and quality."""

    value: NodeVector
    iterations: Int[Array, ""]
    """Iterations of the solver; 0 if it states none."""
    residual: Float[Array, ""]
    """True relative residual ‖b − A x‖/‖b‖ in the norm of W⁻¹."""
    converged: Bool[Array, ""]
    """Whether the residual is within the solver's tolerance, or at the limit of the precision."""
    nearly_converged: Bool[Array, ""]
    """Whether it is not, but within ten times the tolerance."""
    indefinite: Bool[Array, ""]
    """Whether a direction of negative curvature was met."""
    spectral_radius: Float[Array, ""]
    """A lower estimate of ‖W⁻¹A‖; 1 if the solver gives none."""


class AbstractInnerProductSolver(lx.AbstractLinearSolver[_State], Generic[_State]):
    """A symmetric solver that takes an inner product itself.

    `compute` takes the options `inner_product`, an `AbstractInnerProduct`, and `support`, `product` and `matrices`,
    those of the operator. Its result is successful if it converged. Its statistics have the other fields of
    `LinearSolution` except `value`, with `num_steps` for `iterations`.
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
    operator: AbstractSymmetricOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None = None,
    *,
    rtol: float | None = None,
) -> LinearSolution:
    """Solve A x = b.

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
    options = {"inner_product": inner, "support": operator.support(), "product": operator.product}
    options["matrices"] = operator.matrices()
    options |= {} if guess is None else {"y0": guess}
    options |= {} if rtol is None else {"rtol": rtol}
    x, result, stats = solver.compute(solver.init(operator, options), rhs, options)
    return LinearSolution(
        value=x,
        iterations=stats["num_steps"],
        residual=stats["residual"],
        converged=result == lx.RESULTS.successful,
        nearly_converged=stats["nearly_converged"],
        indefinite=stats["indefinite"],
        spectral_radius=stats["spectral_radius"],
    )


def _solve_scaled(
    solver: lx.AbstractLinearSolver,
    operator: AbstractSymmetricOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None,
) -> LinearSolution:
    b = inner.solve_factor(rhs)
    size = jnp.sqrt((b**2).sum())
    size = jnp.where(size == 0, 1, size)
    b = b / size
    options = {} if guess is None else {"y0": inner.solve_factor(inner.apply(guess)) / size}
    scaled = ScaledOperator(operator, inner)
    y, result, stats = solver.compute(_initialised(solver, scaled, options), b, options)
    if jnp.shape(y) != b.shape:
        raise ValueError(
            f"{_name(solver)}.compute must return a solution of the right-hand side's shape, {b.shape}, got "
            f"{jnp.shape(y)}."
        )
    Ay = scaled.mv(y)
    residual, tolerance = jnp.sqrt(((b - Ay) ** 2).sum()), _tolerance(solver, b)
    converged = (result == lx.RESULTS.successful) & (residual <= tolerance)
    return LinearSolution(
        value=size * inner.solve_factor_transpose(y),
        iterations=jnp.asarray(stats.get("num_steps", 0), dtype=jnp.int32),
        residual=residual,
        converged=converged,
        nearly_converged=~converged & (residual <= NEARLY_CONVERGED * tolerance),
        indefinite=(y * Ay).sum() < 0,
        spectral_radius=jnp.ones_like(residual),
    )


class ScaledOperator(AbstractSymmetricOperator):
    """L⁻¹A L⁻ᵀ for an operator A and the inner product of W = L Lᵀ."""

    operator: AbstractSymmetricOperator
    inner: AbstractInnerProduct

    def is_positive_semidefinite(self) -> bool:
        return self.operator.is_positive_semidefinite()

    def mv(self, vector: Array) -> Array:
        return self.inner.solve_factor(self.operator.mv(self.inner.solve_factor_transpose(vector)))

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return self.operator.in_structure()


def _initialised(solver: lx.AbstractLinearSolver, operator: ScaledOperator, options: dict[str, Any]) -> Any:
    try:
        return solver.init(operator, options)
    except ValueError as error:
        if operator.is_positive_semidefinite():
            kind = "positive definite, without other structure. Take a solver of such matrices, as ConjugateResidual()"
        else:
            kind = (
                "may be indefinite. Take a solver of such matrices, as ConjugateResidual(); or make it positive "
                "definite with AnalyticHessian(projected=True), which for the adjoint_solver of Newton's method is no "
                "way out, as its derivatives are those of the true Hessian"
            )
        raise ValueError(
            f"{_name(solver)} refuses the matrix M + χH of an implicit step: {str(error).rstrip('.')}. The matrix is "
            f"symmetric and {kind}."
        ) from error


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


def _name(solver: lx.AbstractLinearSolver) -> str:
    return type(solver).__name__
