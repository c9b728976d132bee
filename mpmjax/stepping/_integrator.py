"""The abstract integrator, the motion of the nodes that it returns, and the explicit step."""

from abc import abstractmethod
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import NodeVector, Scalar
from mpmjax.implicit import SolveInfo, no_solve
from mpmjax.stepping._nodes import Nodes


class NodeMotion(eqx.Module):
    """The motion of the nodes over a step."""

    velocity: NodeVector  # v^{n+1} [m/s], shape (n, d)
    mean: NodeVector | None = None
    """The velocity with which positions and deformation move [m/s], shape (n, d); None if it is v^{n+1}."""
    inner: NodeVector | None = None  # the displacement at an inner stage over Δt [m/s], shape (n, d); None without one
    resisted: NodeVector | None = None
    """The velocity in the viscous force [m/s], shape (n, d); None without viscosity, or with explicit viscosity."""
    friction: NodeVector | None = None
    """The part of `velocity` that comes from friction in inner stages [m/s], shape (n, d); None without any."""

    @property
    def carrier(self) -> NodeVector:
        """The velocity with which positions and deformation move [m/s], shape (n, d)."""
        return self.velocity if self.mean is None else self.mean


class AbstractIntegrator(eqx.Module):
    """The update of the nodes' velocity in a step.

    A subclass must have `advance` and `elastic_impulse`; the defaults of the rest are right for any. Boundaries,
    contact, friction, transfers, reports and derivatives are the same for all integrators.
    """

    is_explicit: ClassVar[bool] = False
    """Whether the update solves no system, and takes the force at the start of the step."""
    needs_separate_force: ClassVar[bool] = True
    """Whether v^n and the force are needed separately. An integrator whose v^{n+1} is `nodes.explicit_velocity()`
    wherever nothing is prescribed may set it to False. P2G then sums momentum and force together where it can, at half
    the cost; `nodes.velocity` and `nodes.force` raise, and `elastic_impulse` is not called."""
    explicit_viscosity: ClassVar[bool] = True
    """Whether `nodes.force` includes the viscous stress, at the particles' stored velocity gradients. If False,
    `advance` must treat viscosity and return the velocity in its force as `NodeMotion.resisted`."""
    linearises: ClassVar[bool] = False
    """Whether the elastic force that moves the nodes is f(0) − H u, and not that of the law."""
    body_force_at: ClassVar[float] = 0.0
    """The time at which body forces are evaluated, as a fraction of the step: 0 at its start, ½ in its middle."""
    keeps_admissible: ClassVar[bool] = False
    """Whether the solve ends at an admissible deformation, as the line search of Newton's method ensures."""

    @abstractmethod
    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The motion of the nodes over the step, and the report of the solve (`no_solve` if there is none).

        Components outside of the range of `nodes.projection` must have the velocity `nodes.prescribed`.

        Args:
            nodes: the nodes at the start of the step, with the boundaries.
            guess: where an implicit solve starts [m/s], shape (n, d).
        """

    @abstractmethod
    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """The impulse over the step [kg m/s], shape (n, d), of the elastic force and of any force that the integrator
        adds. It equals m (v^{n+1} − v^n − Δt g) where nothing is prescribed.

        It includes explicit viscosity, which is part of `nodes.force`. The impulse of implicit viscosity is added
        elsewhere, from `NodeMotion.resisted`.
        """

    def exact_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """`elastic_impulse` with the forces of the law. Default: `elastic_impulse`. It is asked of one that
        `linearises`."""
        return self.elastic_impulse(nodes, motion)

    def stability_factor(self) -> Scalar | None:
        """The number c for which a step is stable if c (Δt² Λ A/ρ0 + Δt Λ_v B/ρ0) ≤ 4 (see `stable_dt`). It is 1 for
        the explicit step, and 0 or less if every step is stable. Default: None, for which `stable_dt` raises."""
        return None

    def force_at(self) -> Scalar | None:
        """The share θ of the step's displacement at which forces are evaluated, on the mean over the step, so that the
        forces of a step are those at t_n + θΔt; None for forces at its start. Default: None of an explicit method, 1 of
        any other."""
        return None if self.is_explicit else 1.0

    def mean_displacement(self, nodes: Nodes, motion: NodeMotion) -> NodeVector | None:
        """The displacement of the nodes at which a force that is linear in it has its mean over the step [m], shape
        (n, d): contact is judged and gives its impulse there. None for zero. Default: None of an explicit method,
        `force_at` of the step's displacement of any other."""
        share = self.force_at()
        return None if share is None else share * nodes.dt * motion.carrier

    def with_friction(self, motion: NodeMotion, change: NodeVector) -> NodeMotion:
        """The motion with v^{n+1} changed by friction [m/s]. Default: the mean velocity by half of it, as by an impulse
        that acts evenly over the step."""
        mean = None if motion.mean is None else motion.mean + change / 2
        return replace(motion, velocity=motion.velocity + change, mean=mean)

    def limit_name(self) -> str:
        """The name of the bound on the step in messages."""
        return f"limit of {type(self).__name__}"

    def initial_guess(self, nodes: Nodes) -> NodeVector:
        """The initial guess of an implicit solve [m/s], shape (n, d). Default: v^n, or v* if v^n is not known."""
        return nodes.v

    def reporting(self, slot: Scalar) -> "AbstractIntegrator":
        """This integrator, with tangent and adjoint solves that report through a slot (see `Reporting`). Default: the
        integrator itself, without such solves."""
        return self

    def unconverged_advice(self) -> tuple[str, ...]:
        """The remedy for a solve that does not converge, besides a smaller step and more iterations: imperative
        clauses that start in lower case. Default: none."""
        return ()


class Explicit(AbstractIntegrator):
    """Symplectic Euler: v^{n+1} = v* = v^n + Δt (g + f/m) (derivation, eq. 4). Positions move with v^{n+1}.

    First order in time, and second if velocities start half a step before positions; second order in space with APIC
    and FLIP. It conserves linear momentum, and with APIC angular momentum too.

    *When it breaks*: above a Δt of about 0.4 to 1 times dx/c, depending on dimension, kernel and transfer. c is the
    pressure-wave speed of the *current* tangent, which stretching and compression raise. `stable_dt` gives the limit.
    """

    is_explicit: ClassVar[bool] = True
    needs_separate_force: ClassVar[bool] = False

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v = nodes.explicit_velocity()
        if nodes.conditions.holds:
            v = nodes.projection.combine(v, nodes.prescribed)
        return NodeMotion(v), no_solve(v.dtype)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(0) [kg m/s], on nodes that have mass."""
        return jnp.where(nodes.occupied, nodes.dt * nodes.force, 0)

    def stability_factor(self) -> Scalar:
        return 1.0

    def limit_name(self) -> str:
        return "explicit limit"
