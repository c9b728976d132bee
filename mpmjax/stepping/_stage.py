"""The stage that backward Euler and the integrators of second order are made of.

M (v − a) = c (f(u + c v) − D v), f(u) the elastic force at the nodal displacement u and D v that of viscosity: one
linear solve, with f(u) = f(0) − H u, or Newton's method.
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
    """M (v − a) = c (f(u + c v) − D v)."""

    inertial: NodeVector
    """a [m/s]."""
    stage_dt: Float[Array, ""]
    """c [s]."""
    displaced: NodeVector | None = None
    """u [m]; None for zero."""

    def solve(
        self, nodes: Nodes, guess: NodeVector, method: AbstractImplicitIntegrator, solution: Linearised | Newton
    ) -> tuple[NodeVector, SolveInfo]:
        """The velocity and the solve's report."""
        system = {
            "mass": nodes.mass,
            "projection": nodes.projection,
            "prescribed": nodes.prescribed,
            "metric": method.metric,
        }
        match solution:
            case Linearised():
                action = method.hessian.at_current(nodes.potential, guess)
                force = nodes.force if self.displaced is None else nodes.force - action(self.displaced)
                problem = LinearProblem(
                    factor=self.stage_dt**2,
                    hessian=damped(action, nodes.potential, 1 / self.stage_dt),
                    rhs=nodes.mass[:, None] * self.inertial + self.stage_dt * force,
                    **system,
                )
            case Newton():
                problem = NewtonProblem(
                    inertial=self.inertial,
                    length=self.stage_dt,
                    displaced=self.displaced,
                    spacing=nodes.spacing,
                    potential=nodes.potential,
                    hessian=method.hessian,
                    **system,
                )
        return solve(problem, guess, solution, method.adjoint_solver)


def stage_force(
    nodes: Nodes, method: AbstractImplicitIntegrator, solution: Linearised | Newton, *stages: tuple[Scalar, NodeVector]
) -> NodeVector:
    """Σ q f(u) [N], the elastic forces at nodal displacements u with their weights q, as the stages take them."""
    match solution:
        case Linearised():
            mean = reduce(jnp.add, (q * u for q, u in stages))
            return sum(q for q, _ in stages) * nodes.force - method.hessian.at_current(nodes.potential, mean)(mean)
        case Newton():
            return reduce(jnp.add, (q * nodes.potential.force(u) for q, u in stages))
