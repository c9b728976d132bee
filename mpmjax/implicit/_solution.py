"""Ways to solve the equation of an implicit stage, and what they report."""

import abc
from dataclasses import replace
from functools import reduce
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, NodeVector, Scalar
from mpmjax.checks import require_fields
from mpmjax.implicit._conjugate_residual import ConjugateResidual
from mpmjax.implicit._hessian import AbstractHessian
from mpmjax.implicit._linear_solve import require_solver, solve_linear
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._stage_problem import StageProblem


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


class AbstractSolution(eqx.Module):
    """A way to solve the equation of a stage. A subclass must have `__call__`."""

    linearises: ClassVar[bool] = False
    """Whether the elastic force is f(0) − H u in place of that of the law."""

    def problem(self, stage: StageProblem) -> StageProblem:
        """The problem that is solved in the place of a stage's. Derivatives are those of its exact solution. Default:
        the stage's, linearised if the solution `linearises`."""
        return stage.linearised() if self.linearises else stage

    def stage_force(
        self,
        potential: ElasticPotential,
        hessian: AbstractHessian,
        force: NodeVector,
        *stages: tuple[Scalar, NodeVector],
    ) -> NodeVector:
        """Σ q f(u) [N], shape (n, d), with the elastic forces of `problem`.

        Args:
            potential: the potential of the law's force f.
            hessian: the Hessian of a linearised force.
            force: f(0) [N], shape (n, d).
            stages: the weights q [-] and displacements u [m], shape (n, d).
        """
        if not self.linearises:
            return exact_force(potential, *stages)
        mean = reduce(jnp.add, (q * u for q, u in stages))
        return sum(q for q, _ in stages) * force - hessian.at_step_start(potential)(mean)

    @abc.abstractmethod
    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution [m/s], shape (n, d), and the report of the solve.

        Args:
            problem: the problem that `problem` returned.
            guess: where an iteration starts [m/s], shape (n, d).
        """


def exact_force(potential: ElasticPotential, *stages: tuple[Scalar, NodeVector]) -> NodeVector:
    """Σ q f(u) [N], shape (n, d), the elastic forces of the law.

    Args:
        potential: the potential of f.
        stages: the weights q [-] and displacements u [m], shape (n, d).
    """
    return reduce(jnp.add, (q * potential.force(u) for q, u in stages))


class Linearised(AbstractSolution):
    """One linear solve with the force f(0) − H u, linear in the displacement u of the step.

    Args:
        solver: linear solver, any symmetric one of lineax. Default: `ConjugateResidual` with default tolerances.
    """

    solver: lx.AbstractLinearSolver = ConjugateResidual()
    linearises: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        require_solver("Linearised's solver", self.solver)

    def __call__(self, problem: StageProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        operator = problem.operator(guess).precomputed()
        combine = problem.projection.combine
        rhs, lift = problem.rhs, None
        if problem.prescribed is not None:
            lift, at_rest = combine(0, problem.prescribed), rhs
            # walls at rest, the common case, spare one application of H
            rhs = jax.lax.cond((lift != 0).any(), lambda: at_rest - operator.unconstrained(lift), lambda: at_rest)
        rhs = combine(rhs, 0)
        inner = problem.preconditioner.inner_product(operator)
        solution = solve_linear(self.solver, operator, rhs, inner, combine(guess, 0))
        info = replace(
            no_solve(guess.dtype),
            iterations=solution.iterations,
            residual=solution.residual,
            converged=solution.converged,
            nearly_converged=solution.nearly_converged,
            indefinite=solution.indefinite,
        )
        return solution.value if lift is None else solution.value + lift, info
