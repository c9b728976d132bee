"""The implicit stage of backward Euler and of the integrators of second order.

It is M (v − a) = Δt_s (f(u + Δt_s v) − D v) (derivation, eq. 22 and section 10), where f(u) is the elastic force at a
nodal displacement u and −D v the viscous force. One linear solve takes f(u) = f(0) − H u; Newton's method, or another
`AbstractSolution`, solves the nonlinear equation.
"""

import equinox as eqx

from mpmjax._types import Array, Float, NodeVector
from mpmjax.implicit import SolveInfo, StageEquation, solve
from mpmjax.stepping._integrator import AbstractImplicitIntegrator
from mpmjax.stepping._nodes import Nodes


class Stage(eqx.Module):
    """The equation M (v − a) = Δt_s (f(u + Δt_s v) − D v) for a velocity v."""

    inertial: NodeVector
    """a [m/s], the velocity of the stage without the force at its own end, shape (n, d)."""
    stage_dt: Float[Array, ""]
    """Δt_s [s], the length of the stage."""
    initial_displacement: NodeVector | None = None
    """u [m], shape (n, d); None for zero."""

    def solve(
        self, nodes: Nodes, guess: NodeVector, method: AbstractImplicitIntegrator
    ) -> tuple[NodeVector, SolveInfo]:
        """The velocity v [m/s], shape (n, d), and the report of the solve."""
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
            prescribed=nodes.prescribed if nodes.moves_held else None,
            preconditioner=method.preconditioner,
        )
        solution = method.solved_by()
        return solve(solution.problem(equation), guess, solution, method.adjoint_solver)
