"""One linear solve by any symmetric solver of lineax, preconditioned: inner products, the report of solves."""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector
from mpmjax.checks import require_that
from mpmjax.implicit._operator import ImplicitOperator

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


class AbstractInnerProduct(eqx.Module):
    """The inner product ⟨a, b⟩ = aᵀ W b with a symmetric positive definite W = L Lᵀ.

    W is a preconditioner of a symmetric A: W⁻¹A is self-adjoint in this inner product, and the number of iterations
    grows with the spread of its eigenvalues. `ConjugateResidual` works on W⁻¹A. Any other solver is given L⁻¹A L⁻ᵀ,
    which has the same eigenvalues and is symmetric in the plain inner product.

    The W of an `ImplicitOperator` must commute with its projection Q, W = Q W Q + (I − Q) W (I − Q), so that residuals
    and steps have no part in held components.
    """

    @abc.abstractmethod
    def apply(self, v: Any) -> Any:
        """W v."""

    @abc.abstractmethod
    def solve_factor(self, r: Any) -> Any:
        """L⁻¹ r."""

    @abc.abstractmethod
    def solve_factor_transpose(self, v: Any) -> Any:
        """L⁻ᵀ v."""

    def solve(self, r: Any) -> Any:
        """W⁻¹ r."""
        return self.solve_factor_transpose(self.solve_factor(r))

    def factored(self) -> "AbstractInnerProduct":
        """The inner product for solvers that need L: this one, if it has the factor."""
        return self


class DiagonalInnerProduct(AbstractInnerProduct):
    """The inner product of a diagonal W.

    Args:
        weight: the positive diagonal, of the structure of a vector.
    """

    weight: Any

    def apply(self, v: Any) -> Any:
        return jax.tree.map(jnp.multiply, self.weight, v)

    def solve_factor(self, r: Any) -> Any:
        return jax.tree.map(lambda r, w: r / jnp.sqrt(w), r, self.weight)

    def solve_factor_transpose(self, v: Any) -> Any:
        return self.solve_factor(v)

    def solve(self, r: Any) -> Any:
        return jax.tree.map(jnp.divide, r, self.weight)


class AbstractPreconditioner(eqx.Module):
    """A symmetric positive definite approximation W of M + χH that is easily inverted.

    The number of iterations grows with the spread of the eigenvalues of W⁻¹(M + χH). The tolerance of a solve is that
    of its residual in the norm of W⁻¹. Subclass it for a preconditioner of your own.
    """

    advice: ClassVar[str | None] = None
    """The remedy where solves do not converge, as words that follow "or"; None if nothing better is known."""

    @abc.abstractmethod
    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        """The inner product of W. W must commute with the operator's projection; for a diagonal,
        `operator.projection.commuting_weight` makes it so."""


class DiagonalPreconditioner(AbstractPreconditioner):
    """M + χ diag(H) without negative parts of H. The default.

    The saving depends on the scene. In bodies of halves, layers and inclusions at contrasts of 10 to 10 000, in two and
    three dimensions, it took between an eighth and three fifths of the iterations of `MassPreconditioner` at a hundred
    times the explicit limit, and between a third and all of them at twenty times. In homogeneous bodies it took between
    a third of them and a fifth more.
    """

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.diagonal()))


class MassPreconditioner(AbstractPreconditioner):
    """M: W⁻¹A is then the matrix of eq. 6 of the derivation."""

    advice: ClassVar[str | None] = "take preconditioner=DiagonalPreconditioner(), which needs fewer iterations"

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.nodal_mass()))


class AbstractInnerProductSolver(lx.AbstractLinearSolver[Any]):
    """A symmetric solver that takes an inner product itself.

    `init` is given an `ImplicitOperator`, `compute` the option `inner_product`, an `AbstractInnerProduct`. Its result
    is successful if it converged. Its statistics are `num_steps`, `residual`, `nearly_converged` and `indefinite` (see
    `SolveInfo`), and `spectral_radius`, a lower estimate of ‖W⁻¹A‖.
    """


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
    if isinstance(solver, AbstractInnerProductSolver):
        options: dict[str, Any] = {"inner_product": inner}
        options |= {} if guess is None else {"y0": guess}
        options |= {} if rtol is None else {"rtol": rtol}
        state: Any = solver.init(operator, options)  # pyright: ignore[reportArgumentType]
        x, result, stats = solver.compute(state, rhs, options)
        iterations, residual, radius = stats["num_steps"], stats["residual"], stats["spectral_radius"]
        quality = result == lx.RESULTS.successful, stats["nearly_converged"], stats["indefinite"]
    else:
        x, iterations, residual, quality = _solve_scaled(solver, operator, rhs, inner.factored(), guess)
        radius = jnp.ones_like(residual)
    none = jnp.zeros((), jnp.int32)
    return x, SolveInfo(iterations, none, none, residual, *quality, report=jnp.zeros_like(residual)), radius


def _solve_scaled(
    solver: lx.AbstractLinearSolver,
    operator: ImplicitOperator,
    rhs: NodeVector,
    inner: AbstractInnerProduct,
    guess: NodeVector | None,
) -> tuple[NodeVector, Array, Array, tuple[Array, Array, Array]]:
    """x, the iterations, the relative residual; whether the solve converged, did nearly, and met an indefinite A."""
    name, definite = type(solver).__name__, operator.hessian.is_positive_semidefinite()
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
    residual = jnp.sqrt(((b - Ay) ** 2).sum())
    rtol, atol = getattr(solver, "rtol", None), getattr(solver, "atol", None)
    if rtol is None and atol is None:
        tolerance = default_rtol(b.dtype)
    else:  # atol is of each component of a right-hand side of norm one
        tolerance = (0 if rtol is None else rtol) + math.sqrt(b.size) * (0 if atol is None else atol)
    converged = (result == lx.RESULTS.successful) & (residual <= tolerance)
    nearly = ~converged & (residual <= NEARLY_CONVERGED * tolerance)
    iterations = jnp.asarray(stats.get("num_steps", 0), dtype=jnp.int32)
    return size * inner.solve_factor_transpose(y), iterations, residual, (converged, nearly, (y * Ay).sum() < 0)


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
