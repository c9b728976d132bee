"""The implicit stage of backward Euler and of the integrators of second order.

It is M (v − a) = c (f(u + c v) − D v), where f(u) is the elastic force at a nodal displacement u and −D v the viscous
force. One linear solve takes f(u) = f(0) − H u; Newton's method solves the nonlinear equation.
"""

from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.implicit import (
    Linearised,
    LinearProblem,
    Newton,
    NewtonProblem,
    SolveInfo,
    damped,
    solve,
)
from mpmjax.stepping._integrator import AbstractImplicitIntegrator
from mpmjax.stepping._nodes import Nodes


class Stage(eqx.Module):
    """The equation M (v − a) = c (f(u + c v) − D v) for a velocity v."""

    inertial: NodeVector
    """a [m/s], shape (n, d): the velocity without internal forces."""
    stage_dt: Float[Array, ""]
    """c [s], the duration of the stage."""
    initial_displacement: NodeVector | None = None
    """u [m], shape (n, d); None for zero."""

    def solve(
        self, nodes: Nodes, guess: NodeVector, method: AbstractImplicitIntegrator, solution: Linearised | Newton
    ) -> tuple[NodeVector, SolveInfo]:
        """The velocity v [m/s], shape (n, d), and the report of the solve."""
        system = {
            "mass": nodes.mass,
            "projection": nodes.projection,
            "prescribed": nodes.prescribed,
            "preconditioner": method.preconditioner,
        }
        match solution:
            case Linearised():
                action = method.hessian.at_current(nodes.potential, guess)
                u = self.initial_displacement
                force = nodes.force if u is None else nodes.force - action(u)
                problem = LinearProblem(
                    factor=self.stage_dt**2,
                    hessian=damped(action, nodes.potential, 1 / self.stage_dt),
                    rhs=nodes.mass[:, None] * self.inertial + self.stage_dt * force,
                    **system,
                )
            case Newton():
                problem = NewtonProblem(
                    inertial=self.inertial,
                    stage_dt=self.stage_dt,
                    initial_displacement=self.initial_displacement,
                    spacing=nodes.spacing,
                    potential=nodes.potential,
                    hessian=method.hessian,
                    **system,
                )
        return solve(problem, guess, solution, method.adjoint_solver)


def stage_force(
    nodes: Nodes, method: AbstractImplicitIntegrator, solution: Linearised | Newton, *stages: tuple[Scalar, NodeVector]
) -> NodeVector:
    """Σ q f(u) [N], shape (n, d): the elastic forces of stages, for pairs of a weight q and a displacement u [m]."""
    match solution:
        case Linearised():
            mean = reduce(jnp.add, (q * u for q, u in stages))
            return sum(q for q, _ in stages) * nodes.force - method.hessian.at_current(nodes.potential, mean)(mean)
        case Newton():
            return reduce(jnp.add, (q * nodes.potential.force(u) for q, u in stages))
