"""One linear solve for each stage."""

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector
from mpmjax.checks import require_fields
from mpmjax.implicit._conjugate_residual import ConjugateResidual
from mpmjax.implicit._linear_solve import require_solver, solve_linear
from mpmjax.implicit._problems import LinearProblem
from mpmjax.implicit._solve_info import SolveInfo


class Linearised(eqx.Module):
    """One linear solve with the force f(0) − H u, linear in the displacement u of the step.

    Args:
        solver: linear solver, any symmetric one of lineax. Default: `ConjugateResidual` with default tolerances.
    """

    solver: lx.AbstractLinearSolver = ConjugateResidual()

    def __check_init__(self):
        require_fields(self)
        require_solver("Linearised's solver", self.solver)

    def __call__(self, problem: LinearProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution [m/s], shape (n, d), and the report of the solve.

        Args:
            problem: the problem.
            guess: where the solve starts [m/s], shape (n, d).
        """
        operator = problem.operator(guess).precomputed()
        split = problem.projection.combine
        lift = split(0, problem.prescribed)
        rhs = split(problem.rhs - operator.unconstrained(lift), 0)
        inner = problem.preconditioner.inner_product(operator)
        solution = solve_linear(self.solver, operator, rhs, inner, split(guess, 0))
        none = jnp.asarray(0, dtype=jnp.int32)
        info = SolveInfo(
            iterations=solution.iterations,
            newton=none,
            line_search=none,
            residual=solution.residual,
            converged=solution.converged,
            nearly_converged=solution.nearly_converged,
            indefinite=solution.indefinite,
            report=jnp.zeros_like(solution.residual),
        )
        return solution.value + lift, info
