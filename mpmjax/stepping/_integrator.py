"""What an integrator is, and the motion of the nodes that it returns."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.implicit import AbstractHessian, AbstractPreconditioner, Guess, Reporting, SolveInfo, require_solver
from mpmjax.stepping._nodes import Nodes


class NodeMotion(eqx.Module):
    """How the nodes move in a step."""

    velocity: NodeVector
    """v^{n+1} [m/s], shape (n, d)."""
    mean: NodeVector | None = None
    """The velocity with which positions and deformation move over the step [m/s], shape (n, d); None where it is
    v^{n+1}."""
    inner: NodeVector | None = None
    """The same up to an inner stage, the displacement there over Δt; None without one."""
    resisted: NodeVector | None = None
    """The velocity that viscosity resists over the step [m/s], shape (n, d); None where the solve has no viscosity."""

    @property
    def carrier(self) -> NodeVector:
        """The velocity with which positions and deformation move [m/s], shape (n, d)."""
        return self.velocity if self.mean is None else self.mean

    def slowed(self, loss: NodeVector) -> "NodeMotion":
        """Changed by an impulse that acts evenly over the step: half of it counts for the mean."""
        return NodeMotion(
            self.velocity + loss, None if self.mean is None else self.mean + loss / 2, self.inner, self.resisted
        )


class AbstractIntegrator(eqx.Module):
    """How the velocity of the nodes is updated in a step.

    Boundaries, contact, friction, transfers, reports and derivatives are the same for all integrators.
    """

    centred: ClassVar[bool] = False
    """Whether body forces are those at the middle of the step."""
    needs_force: ClassVar[bool] = True
    """Whether the force is wanted apart from the momentum that it makes."""
    lagged: ClassVar[bool] = False
    """Whether viscosity is explicit, that of the particles' stored velocity gradients."""

    @abstractmethod
    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solve's report.

        Args:
            nodes: what P2G brought, with what the boundaries hold.
            guess: where an implicit solve starts [m/s], shape (n, d).
        """

    @abstractmethod
    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """The impulse of the elastic force over the step [kg m/s], shape (n, d)."""

    def initial_guess(self, nodes: Nodes) -> NodeVector:
        """Where an implicit solve starts [m/s], shape (n, d). Default: v^n."""
        return nodes.velocity

    def reporting(self, slot: Scalar) -> "AbstractIntegrator":
        """The same integrator, its tangent and adjoint solves reporting through a slot. Default: there are none."""
        del slot
        return self

    def unconverged_advice(self) -> tuple[str, ...]:
        """What helps a solve that does not converge, besides a smaller step and more iterations: imperative clauses,
        which start in lower case. Default: nothing."""
        return ()


class AbstractImplicitIntegrator(AbstractIntegrator):
    """An integrator that solves with the elastic Hessian."""

    hessian: eqx.AbstractVar[AbstractHessian]
    """How H acts."""
    preconditioner: eqx.AbstractVar[AbstractPreconditioner]
    """That of the solves."""
    adjoint_solver: eqx.AbstractVar[lx.AbstractLinearSolver]
    """That of the tangent and adjoint solves."""
    guess: eqx.AbstractVar[Guess]
    """Where the solve starts."""

    def __check_init__(self):
        require_solver(f"{type(self).__name__}'s adjoint_solver", self.adjoint_solver)

    def initial_guess(self, nodes: Nodes) -> NodeVector:
        return self.guess.velocity(nodes.velocity, nodes.explicit_velocity())

    def reporting(self, slot: Scalar) -> "AbstractImplicitIntegrator":
        return eqx.tree_at(lambda m: m.adjoint_solver, self, Reporting(self.adjoint_solver, slot))

    def unconverged_advice(self) -> tuple[str, ...]:
        advice = self.preconditioner.advice
        return () if advice is None else (advice,)


def viscous_impulse(nodes: Nodes, motion: NodeMotion) -> NodeVector | None:
    """−Δt D v [kg m/s] of the velocity that it resisted, or what P2G knew of it; None without viscosity, and where P2G
    joined it to the elastic force."""
    if motion.resisted is not None:
        return -nodes.dt * nodes.potential.damping_force(motion.resisted)
    return None if nodes.viscous is None else jnp.where(nodes.occupied, nodes.dt * nodes.viscous, 0)
