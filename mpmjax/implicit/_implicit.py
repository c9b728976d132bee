"""How the nodal problems of the implicit updates are solved, and one derivative rule for all of them.

Whatever iteration finds the solution v of residual(v) = 0, its derivative is that of the implicit function theorem,
J δv = −δ(residual): one more solve with the same operator, forward or backward, so that no iteration is ever
differentiated.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, NodeVector
from mpmjax.autodiff import ruled
from mpmjax.checks import require_fields
from mpmjax.implicit._conjugate_residual import ConjugateResidual, Reporting
from mpmjax.implicit._newton import Newton
from mpmjax.implicit._problems import AbstractProblem, LinearProblem, SolveInfo


class Linearised(eqx.Module):
    """One linear solve: the force is f(0) − H u in the whole step.

    Args:
        solver: of the linear system. Default: default tolerances.
    """

    solver: ConjugateResidual = ConjugateResidual()

    def __check_init__(self):
        require_fields(self)

    def __call__(self, problem: LinearProblem, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution, started from a guess."""
        operator = problem.operator(guess).assembled()
        split = problem.projection.combine
        lift = split(0, problem.prescribed)
        rhs = split(problem.rhs - operator.unconstrained(lift), 0)
        options = {"metric": operator.metric(), "y0": split(guess, 0)}
        v, result, stats = self.solver.compute(self.solver.init(operator, options), rhs, options)
        info = SolveInfo(
            iterations=stats["num_steps"],
            newton=jnp.asarray(0, dtype=jnp.int32),
            line_search=jnp.asarray(0, dtype=jnp.int32),
            residual=stats["residual"],
            converged=result == lx.RESULTS.successful,
            short=stats["short"],
            indefinite=stats["indefinite"],
            report=jnp.zeros_like(stats["residual"]),
        )
        return v + lift, info


def solve(
    problem: AbstractProblem, guess: NodeVector, find: Linearised | Newton, adjoint: ConjugateResidual | Reporting
) -> tuple[NodeVector, SolveInfo]:
    """The solution of a problem, differentiable with respect to it in forward and reverse mode, to any order.

    Args:
        problem: the problem.
        guess: where the iteration starts; the result does not depend on it beyond the tolerance, nor its derivative.
        find: the iteration.
        adjoint: solver of the tangent and adjoint systems. What ends beyond ten times its tolerance gives NaN
            derivatives, so that a wrong gradient cannot pass for a right one.
    """
    if not isinstance(adjoint, Reporting):
        adjoint = Reporting(adjoint, jnp.zeros((), guess.dtype))
    return _solve(problem, adjoint.slot, *jax.lax.stop_gradient((guess, find, adjoint.solver)))


@ruled
def _solve(
    problem: AbstractProblem, slot: Array, guess: NodeVector, find: Any, adjoint: ConjugateResidual
) -> tuple[NodeVector, SolveInfo]:
    del slot, adjoint
    return find(problem, guess)


@_solve.defjvp
def _solve_jvp(primals: Any, tangents: Any) -> Any:
    problem, slot, guess, find, adjoint = primals
    d_problem, d_slot = tangents[:2]
    v, info = _solve(problem, slot, guess, find, adjoint)
    d_residual = eqx.filter_jvp(lambda q: q.residual(v), (problem,), (d_problem,))[1]
    operator = problem.operator(v)
    assembled = jax.lax.stop_gradient(operator).assembled()
    options = {"metric": assembled.metric()}

    def solve_symmetric(matvec: Any, b: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        del matvec  # the same operator, slower
        x, result, stats = adjoint.compute(adjoint.init(assembled, options), b[0], options)
        solved, known = (result == lx.RESULTS.successful) | stats["short"], jnp.isfinite(b[0]).all()
        residual = jnp.where(jnp.isfinite(stats["residual"]), stats["residual"], jnp.inf)
        return jnp.where(solved, x, jnp.nan), jnp.where(known & ~solved, residual, 0)

    split = problem.projection.combine
    lift = split(0, -d_residual)
    rhs = split(-d_residual - operator.unconstrained(lift), 0)
    d_slot = rhs[:0].sum() + (0 if d_slot is None else d_slot)  # linear in tangents also where nobody listens

    def matvec(x: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        y = operator.mv(x[0])
        return y, x[1] + y[:0].sum()  # as above, of the next order's tangents

    dv, d_report = jax.lax.custom_linear_solve(matvec, (rhs, d_slot), solve_symmetric, symmetric=True)
    d_info = eqx.tree_at(lambda i: i.report, jax.tree.map(lambda _: None, info), d_report, is_leaf=lambda a: a is None)
    return (v, info), (dv + lift, d_info)
