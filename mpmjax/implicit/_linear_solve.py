"""One linear solve by any symmetric solver of lineax, and what is known of its solution."""

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
"""A solve that ends within so many times its tolerance has a solution, less accurate than was asked for: the error is
proportional to the residual, so that of eight digits seven are left, of float32's five four."""


def default_rtol(dtype: Any) -> float:
    """1e-8 in float64, 1e-5 in float32."""
    return _DEFAULT_RTOL[jnp.dtype(dtype).itemsize]


class LinearSolution(eqx.Module):
    """The solution of a linear system A x = b in an inner product W, and what is known of it."""

    value: NodeVector
    iterations: Int[Array, ""]
    """Iterations of the solver; 0 of one that states none."""
    residual: Float[Array, ""]
    """True relative residual ‖b − A x‖/‖b‖ in the norm of W⁻¹."""
    converged: Bool[Array, ""]
    """Whether the solver's tolerance, or the precision's own limit, was met."""
    nearly_converged: Bool[Array, ""]
    """Whether neither was, but ten times the tolerance."""
    indefinite: Bool[Array, ""]
    """Whether a direction of negative curvature was met."""
    spectral_radius: Float[Array, ""]
    """Estimate from below of ‖W⁻¹A‖; 1 where nothing is known of it."""


class AbstractInnerProductSolver(lx.AbstractLinearSolver[_State], Generic[_State]):
    """A symmetric solver that works in an inner product itself, and says more of its solution than others do.

    It takes the option `inner_product`, an `AbstractInnerProduct`; the fields of `LinearSolution` but `value`, with
    `num_steps` for its iterations, are statistics of what `compute` returns. `converged` is its result.
    """

    @abc.abstractmethod
    def compute(self, state: _State, vector: Any, options: dict[str, Any]) -> tuple[Any, lx.RESULTS, dict[str, Any]]:
        """Solve A x = vector. See `lineax.AbstractLinearSolver.compute`."""


def solve_linear(
    solver: lx.AbstractLinearSolver,
    operator: AbstractSymmetricOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None = None,
) -> LinearSolution:
    """Solve A x = b.

    A solver that does not take an inner product is given the scaled system L⁻¹A L⁻ᵀ y = L⁻¹b/‖b‖, W = L Lᵀ, of which
    x = ‖b‖ L⁻ᵀ y: symmetric, preconditioned, and with a right-hand side of norm one, so that an absolute tolerance is a
    number without a unit. Its residual is computed here, and must bear out its result.

    Args:
        solver: a `lineax.AbstractLinearSolver` for symmetric operators.
        operator: A.
        rhs: b.
        inner: the inner product of W.
        guess: where an iteration starts; zero by default. A direct solver has no use for it.

    Raises:
        ValueError: the solver refuses the operator, or returns no vector.
    """
    if not isinstance(solver, AbstractInnerProductSolver):
        return _solve_scaled(solver, operator, rhs, inner, guess)
    options = {"inner_product": inner} if guess is None else {"inner_product": inner, "y0": guess}
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
    """L⁻¹A L⁻ᵀ, with A an operator and W = L Lᵀ an inner product."""

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
            known = "positive definite, without other structure. Take a solver of such matrices, as ConjugateResidual()"
        else:
            known = (
                "may be indefinite. Take a solver of such matrices, as ConjugateResidual(); or make it positive "
                "definite with AnalyticHessian(projected=True), which for the adjoint_solver of Newton's method is no "
                "way out, as its derivatives are those of the true Hessian"
            )
        raise ValueError(
            f"{_name(solver)} refuses the matrix M + cH of an implicit step: {str(error).rstrip('.')}. The matrix is "
            f"symmetric and {known}."
        ) from error


def require_solver(name: str, solver: lx.AbstractLinearSolver) -> None:
    """An absolute tolerance must be above zero.

    Raises:
        ValueError: it is not.
    """
    if (atol := getattr(solver, "atol", None)) is not None:
        require_that(
            f"{name} must have an atol above zero, as it compares residuals component by component and those of empty "
            "nodes are zero (right-hand sides are scaled to norm one, so that it may be as large as rtol)",
            lambda a: a > 0,
            atol,
        )


def _tolerance(solver: lx.AbstractLinearSolver, b: Array) -> Any:
    """The relative residual that a solver promises: `rtol`, and `atol` in each component of a right-hand side of norm
    one, where it has them; that of the precision for one that states none."""
    rtol, atol = getattr(solver, "rtol", None), getattr(solver, "atol", None)
    if rtol is None and atol is None:
        return default_rtol(b.dtype)
    return (0 if rtol is None else rtol) + math.sqrt(b.size) * (0 if atol is None else atol)


def _name(solver: lx.AbstractLinearSolver) -> str:
    return type(solver).__name__
