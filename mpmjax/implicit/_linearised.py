"""One linear solve for each stage."""

from functools import reduce
from typing import ClassVar

import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.checks import require_fields
from mpmjax.implicit._conjugate_residual import ConjugateResidual
from mpmjax.implicit._hessian import AbstractHessian
from mpmjax.implicit._linear_solve import require_solver, solve_linear
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._problems import LinearProblem
from mpmjax.implicit._solution import AbstractSolution, StageEquation
from mpmjax.implicit._solve_info import SolveInfo


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

    def problem(self, stage: StageEquation) -> LinearProblem:
        return stage.linear()

    def stage_force(
        self,
        potential: ElasticPotential,
        hessian: AbstractHessian,
        force: NodeVector,
        *stages: tuple[Scalar, NodeVector],
    ) -> NodeVector:
        """Σ q f(0) − H Σ q u [N]."""
        mean = reduce(jnp.add, (q * u for q, u in stages))
        return sum(q for q, _ in stages) * force - hessian.at_step_start(potential)(mean)

    def __call__(self, problem: LinearProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution [m/s], shape (n, d), and the report of the solve.

        Args:
            problem: the problem.
            guess: where the solve starts [m/s], shape (n, d).
        """
        operator = problem.operator(guess).precomputed()
        combine = problem.projection.combine
        rhs, lift = problem.rhs, None
        if problem.prescribed is not None:
            lift, at_rest = combine(0, problem.prescribed), rhs
            rhs = jax.lax.cond((lift != 0).any(), lambda: at_rest - operator.unconstrained(lift), lambda: at_rest)
        rhs = combine(rhs, 0)
        inner = problem.preconditioner.inner_product(operator)
        solution = solve_linear(self.solver, operator, rhs, inner, combine(guess, 0))
        zero_count = jnp.asarray(0, dtype=jnp.int32)
        info = SolveInfo(
            iterations=solution.iterations,
            newton=zero_count,
            line_search=zero_count,
            residual=solution.residual,
            converged=solution.converged,
            nearly_converged=solution.nearly_converged,
            indefinite=solution.indefinite,
            report=jnp.zeros_like(solution.residual),
        )
        return solution.value if lift is None else solution.value + lift, info
