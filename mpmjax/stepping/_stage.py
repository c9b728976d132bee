"""The stage that backward Euler and the integrators of second order are made of.

M (v − a) = c (f(u + c v) − D v), f(u) the elastic force at the nodal displacement u and D v that of viscosity: one
linear solve, with f(u) = f(0) − H u, Newton's method, or another `AbstractSolution`.
"""

import equinox as eqx

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.implicit import AbstractSolution, SolveInfo, StageEquation, solve
from mpmjax.stepping._integrator import AbstractImplicitIntegrator
from mpmjax.stepping._nodes import Nodes


class Stage(eqx.Module):
    """M (v − a) = c (f(u + c v) − D v)."""

    inertial: NodeVector
    """a [m/s]."""
    stage_dt: Float[Array, ""]
    """c [s]."""
    initial_displacement: NodeVector | None = None
    """u [m]; None for zero."""

    def solve(
        self, nodes: Nodes, guess: NodeVector, method: AbstractImplicitIntegrator, solution: AbstractSolution
    ) -> tuple[NodeVector, SolveInfo]:
        """The velocity and the solve's report."""
        equation = StageEquation(
            mass=nodes.mass,
            inertial=self.inertial,
            stage_dt=self.stage_dt,
            initial_displacement=self.initial_displacement,
            force=nodes.force,
            spacing=nodes.spacing,
            potential=nodes.potential,
            hessian=method.hessian,
            projection=nodes.projection,
            prescribed=nodes.prescribed,
            preconditioner=method.preconditioner,
        )
        return solve(solution.problem(equation), guess, solution, method.adjoint_solver)


def stage_force(
    nodes: Nodes, method: AbstractImplicitIntegrator, solution: AbstractSolution, *stages: tuple[Scalar, NodeVector]
) -> NodeVector:
    """Σ q f(u) [N], the elastic forces at nodal displacements u with their weights q, as the stages take them."""
    return solution.stage_force(nodes.potential, method.hessian, nodes.force, *stages)
