"""What an integrator is, and the motion of the nodes that it returns."""

from abc import abstractmethod
from typing import ClassVar

import equinox as eqx
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
    """The displacement at an inner stage over Δt [m/s], shape (n, d); None without one."""
    resisted: NodeVector | None = None
    """The velocity that viscosity resists over the step [m/s], shape (n, d); None without viscosity, or if it is
    explicit."""

    @property
    def carrier(self) -> NodeVector:
        """The velocity with which positions and deformation move [m/s], shape (n, d)."""
        return self.velocity if self.mean is None else self.mean

    def slowed(self, loss: NodeVector) -> "NodeMotion":
        """With the velocity changed by an impulse that acts evenly over the step, and the mean by half of that."""
        return NodeMotion(
            self.velocity + loss, None if self.mean is None else self.mean + loss / 2, self.inner, self.resisted
        )


class AbstractIntegrator(eqx.Module):
    """How the velocity of the nodes is updated in a step.

    An integrator of one's own needs `advance` and `elastic_impulse`; the rest has defaults that are right for any.
    Boundaries, contact, friction, transfers, reports and derivatives are the same for all integrators.
    """

    is_explicit: ClassVar[bool] = False
    """Whether there is nothing to solve. Advice on faults and `work_precision` use it."""
    needs_separate_force: ClassVar[bool] = True
    """Whether v^n and the force are needed apart. An integrator whose v^{n+1} is `nodes.explicit_velocity()` wherever
    nothing is prescribed may set it to False: P2G then sums momentum and force in one where it can, at half the cost,
    `nodes.velocity` and `nodes.force` raise, and `elastic_impulse` is not asked for."""
    explicit_viscosity: ClassVar[bool] = True
    """Whether `nodes.force` holds the viscous stress of the particles' stored velocity gradients. With False `advance`
    must treat viscosity, and return the velocity that it resists in `NodeMotion.resisted`."""
    body_force_at: ClassVar[float] = 0.0
    """When body forces are taken, as a fraction of the step: 0 is its start, ½ its middle."""
    keeps_admissible: ClassVar[bool] = False
    """Whether the solve ends at a deformation that the law allows, as Newton's line search makes sure of."""

    @abstractmethod
    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The motion of the nodes over the step, and the report of the solve (`no_solve` if there is none).

        Components outside of `nodes.projection` must move with `nodes.prescribed`.

        Args:
            nodes: the nodes at the start of the step, with the boundaries.
            guess: where an implicit solve starts [m/s], shape (n, d).
        """

    @abstractmethod
    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """The impulse over the step [kg m/s], shape (n, d), of the elastic force and of what else the integrator adds,
        equal to m (v^{n+1} − v^n − Δt g) where nothing is prescribed. Explicit viscosity is a part of it, being one of
        `nodes.force`; implicit viscosity, which resists `NodeMotion.resisted`, is added elsewhere."""

    def stability_factor(self) -> Scalar | None:
        """c, such that a step is stable where c (Δt² Λ A/ρ0 + Δt Λ_v B/ρ0) ≤ 4 (see `stable_dt`): 1 for the explicit
        step, 0 or less for no bound on the step at all. Default: None, no bound is known, and `stable_dt` raises."""
        return None

    def limit_name(self) -> str:
        """What messages call the bound on the step."""
        return f"limit of {type(self).__name__}"

    def initial_guess(self, nodes: Nodes) -> NodeVector:
        """Where an implicit solve starts [m/s], shape (n, d). Default: v^n, or v* where v^n is not known."""
        return nodes.velocity if nodes.separate else nodes.explicit_velocity()

    def reporting(self, slot: Scalar) -> "AbstractIntegrator":
        """This integrator with tangent and adjoint solves that report through a slot. Default: itself, for there are
        none."""
        del slot
        return self

    def unconverged_advice(self) -> tuple[str, ...]:
        """What helps a solve that does not converge, besides a smaller step and more iterations: imperative clauses,
        which start in lower case. Default: nothing."""
        return ()


class AbstractImplicitIntegrator(AbstractIntegrator):
    """An integrator that solves with the elastic Hessian, and treats viscosity implicitly."""

    explicit_viscosity: ClassVar[bool] = False

    hessian: eqx.AbstractVar[AbstractHessian]
    """How H acts."""
    preconditioner: eqx.AbstractVar[AbstractPreconditioner]
    """Preconditioner of the linear solves."""
    adjoint_solver: eqx.AbstractVar[lx.AbstractLinearSolver]
    """Linear solver of the tangent and adjoint systems."""
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
