"""Solutions of nodal problems, with one derivative rule for all of them.

The derivative of the solution v of residual(v) = 0 is that of the implicit function theorem (derivation, eq. 30), and
in reverse mode its transpose (eq. 31): one more solve with the same operator. Iterations are never differentiated.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, NodeVector, Scalar
from mpmjax.autodiff import ruled, saved_for_backward, without_derivative
from mpmjax.implicit._linear_solve import derivative_rtol, solve_linear
from mpmjax.implicit._solution import AbstractSolution, SolveInfo
from mpmjax.implicit._stage_problem import StageProblem


class Reporting(eqx.Module):
    """The solver of tangent and adjoint systems, with a report of the solves that did not converge.

    These solves run inside of a derivative, so they can report only by derivatives of zeros: the tangent of `report` in
    forward mode, and the cotangent of `slot` in reverse mode. Either is the sum of the relative residuals of solves
    that did not converge, infinite if one is not finite. Such a solve gives NaN, and solves after it are not counted,
    so the sum is the residual of the first.
    """

    solver: lx.AbstractLinearSolver
    slot: Scalar
    """Zero."""


def solve(
    problem: StageProblem,
    guess: NodeVector,
    find: AbstractSolution,
    adjoint: lx.AbstractLinearSolver | Reporting,
) -> tuple[NodeVector, SolveInfo]:
    """The solution of a problem, differentiable with respect to it in forward and reverse mode, to any order.

    Args:
        problem: the problem.
        guess: where the search starts [m/s], shape (n, d). Result and derivative depend on it only within the
            tolerance.
        find: how the solution is found.
        adjoint: solver of the tangent and adjoint systems. A solve that ends beyond ten times its tolerance gives NaN,
            so that a wrong gradient cannot pass for a right one.
    """
    if not isinstance(adjoint, Reporting):
        adjoint = Reporting(adjoint, jnp.zeros((), guess.dtype))
    return _solve(problem, adjoint.slot, *without_derivative((guess, find, adjoint.solver)))


@ruled
def _solve(
    problem: StageProblem, slot: Array, guess: NodeVector, find: Any, adjoint: lx.AbstractLinearSolver
) -> tuple[NodeVector, SolveInfo]:
    del slot, adjoint
    return find(problem, guess)


@_solve.defjvp
def _solve_jvp(primals: Any, tangents: Any) -> Any:
    problem, slot, guess, find, adjoint = primals
    d_problem, d_slot = tangents[:2]
    v, info = saved_for_backward(_solve(problem, slot, guess, find, adjoint))
    d_residual = eqx.filter_jvp(lambda q: q.residual(v), (problem,), (d_problem,))[1]
    if d_residual is None:  # it does not depend on what is differentiated
        d_residual = jnp.zeros_like(v)
    operator = problem.operator(v)
    matrix, preconditioner = without_derivative((operator, problem.preconditioner))
    matrix = matrix.precomputed()
    inner = preconditioner.inner_product(matrix)

    def solve_symmetric(matvec: Any, b: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        del matvec  # the precomputed operator is the same map and faster
        solution = solve_linear(adjoint, matrix, b[0], inner, rtol=derivative_rtol(b[0].dtype))
        solved, finite = solution.converged | solution.nearly_converged, jnp.isfinite(b[0]).all()
        residual = jnp.where(jnp.isfinite(solution.residual), solution.residual, jnp.inf)
        return jnp.where(solved, solution.value, jnp.nan), jnp.where(finite & ~solved, residual, 0)

    combine = problem.projection.combine
    rhs, lift = combine(-d_residual, 0), None
    if problem.prescribed is not None or problem.projection.normals:  # else it stays at rest
        lift = combine(0, -d_residual)
        rhs = combine(rhs - operator.unconstrained(lift), 0)
    # The second component reports the tangent solve: zero, or the residual of a solve that failed. It goes with the
    # first through one custom_linear_solve, so that the transposed solve reports likewise.
    d_slot = rhs[:0].sum() + (0 if d_slot is None else d_slot)  # a zero that keeps d_slot linear in the tangents

    def matvec(x: tuple[NodeVector, Array]) -> tuple[NodeVector, Array]:
        y = operator.mv(x[0])
        return y, x[1] + y[:0].sum()  # as above, of the next order's tangents

    dv, d_report = jax.lax.custom_linear_solve(matvec, (rhs, d_slot), solve_symmetric, symmetric=True)
    d_info = eqx.tree_at(lambda i: i.report, jax.tree.map(lambda _: None, info), d_report, is_leaf=lambda a: a is None)
    return (v, info), (dv if lift is None else dv + lift, d_info)
