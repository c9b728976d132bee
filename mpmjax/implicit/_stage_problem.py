"""The equation of an implicit stage, and where its solve starts."""

import enum

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeScalar, NodeVector, Scalar
from mpmjax.implicit._hessian import AbstractHessian, AbstractHessianAction, damped
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._preconditioner import AbstractPreconditioner
from mpmjax.implicit._projection import Projection


class Guess(enum.Enum):
    """The initial guess of an implicit solve.

    v*, the result of an explicit step, is far off at a hundred times the explicit limit.
    """

    GRID_VELOCITY = "grid velocity"
    """v^n, the velocity of the nodes before the step. The default."""
    EXPLICIT = "explicit"
    """v*, the explicitly updated velocity (derivation, eq. 4)."""
    ZERO = "zero"
    """Zero velocity."""

    def velocity(self, before: NodeVector, explicit: NodeVector) -> NodeVector:
        """The guess [m/s], shape (n, d), from v^n and v*."""
        match self:
            case Guess.GRID_VELOCITY:
                return before
            case Guess.EXPLICIT:
                return explicit
            case Guess.ZERO:
                return jnp.zeros_like(before)


class StageProblem(eqx.Module):
    """M (v − a) = Δt_s (f(u + θΔt_s v) − θ D v), an equation for the velocity v of the nodes [m/s], shape (n, d), in a
    stage of length Δt_s. f(u) is the elastic force at a nodal displacement u and −D v the viscous force.

    Stages have θ = 1 (derivation, eq. 22 and section 10); backward Euler is one with Δt_s = Δt, u = 0 and
    a = v^n + Δt g. The semi-implicit step has θ = β (eq. 3). Held components of v have the value of `prescribed`.

    The equation is M (v − a) − Δt_s f(u + θΔt_s v) = 0, the left side being the gradient of the incremental potential
    𝓔(v) = ½ ‖v − a‖²_M + Φ(u + θΔt_s v)/θ (eq. 23). Viscosity adds θΔt_s D v to it and ½ θΔt_s v·D v to the potential.
    With `linearised`, f(u) is f(0) − H u and the equation (M + χ H) v = b with χ = θΔt_s² (eq. 17).
    """

    mass: NodeScalar
    """Nodal masses m_i [kg], shape (n,)."""
    inertial: NodeVector
    """a [m/s], the velocity of the stage without the force at its own end, shape (n, d)."""
    stage_dt: Float[Array, ""]
    """Δt_s [s], the length of the stage."""
    initial_displacement: NodeVector | None
    """u [m], shape (n, d); None for zero."""
    force: NodeVector
    """f(0) [N], shape (n, d); in a linearised problem f(0) − H u."""
    spacing: Float[Array, ""]
    """Grid spacing dx [m]."""
    potential: ElasticPotential
    """Φ, with f = −∂Φ/∂u."""
    hessian: AbstractHessian
    """H = ∂²Φ/∂u∂u [N/m], exactly or approximately."""
    projection: Projection
    """The projection on free components."""
    prescribed: NodeVector | None
    """The velocity of held components [m/s], shape (n, d); None if they are at rest."""
    preconditioner: AbstractPreconditioner
    theta: Scalar = 1.0
    """θ [-], the share of the stage's displacement at which its force is evaluated."""
    action: AbstractHessianAction | None = None
    """H at the start of the step in a linearised problem; None in others."""

    def linearised(self) -> "StageProblem":
        """The problem with f(u) = f(0) − H u."""
        action, u = self.hessian.at_step_start(self.potential), self.initial_displacement
        force = self.force if u is None else self.force - action(u)
        return eqx.tree_at(lambda p: (p.force, p.action), self, (force, action), is_leaf=lambda leaf: leaf is None)

    @property
    def rhs(self) -> NodeVector:
        """b = M a + Δt_s (f(0) − H u) [kg m/s] of a linearised problem, shape (n, d)."""
        return self.mass[:, None] * self.inertial + self.stage_dt * self.force

    def operator(self, v: NodeVector) -> ImplicitOperator:
        """The derivative of `residual` at v."""
        return self._operator(self.hessian.exact(), v)

    def newton_operator(self, v: NodeVector) -> ImplicitOperator:
        """The matrix of a Newton step from v: the operator, approximated if the Hessian is approximate."""
        return self._operator(self.hessian, v)

    def _operator(self, hessian: AbstractHessian, v: NodeVector) -> ImplicitOperator:
        """M + θΔt_s D + θΔt_s² H."""
        action = hessian.at(self.potential, self.displacement(v)) if self.action is None else self.action
        action = damped(action, self.potential, 1 / self.stage_dt)
        return ImplicitOperator(self.mass, self.theta * self.stage_dt**2, action, self.projection)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """The residual of momentum at each node [kg m/s], shape (n, d); in held components, the impulse that holds."""
        if self.action is not None:
            return self.operator(v).unconstrained(v) - self.rhs
        force = self.potential.force(self.displacement(v))
        if self.potential.viscous:
            force = force - self.theta * self.potential.viscous_resistance(v)
        return self.mass[:, None] * (v - self.inertial) - self.stage_dt * force

    def residual(self, v: NodeVector) -> NodeVector:
        """The momentum residual in free components, and v − prescribed in held ones. Its Jacobian is symmetric."""
        return self.projection.combine(self.momentum_residual(v), v if self.prescribed is None else v - self.prescribed)

    def apply_dirichlet(self, guess: NodeVector) -> NodeVector:
        """The guess, with the prescribed values in held components."""
        return self.projection.combine(guess, 0 if self.prescribed is None else self.prescribed)

    def displacement(self, v: NodeVector) -> NodeVector:
        """u + θΔt_s v [m]."""
        moved = self.theta * self.stage_dt * v
        return moved if self.initial_displacement is None else self.initial_displacement + moved

    def undisplaced_velocity(self) -> NodeVector:
        """The velocity at which no node is displaced, −u/(θΔt_s) [m/s]."""
        if self.initial_displacement is None:
            return jnp.zeros_like(self.inertial)
        return -self.initial_displacement / (self.theta * self.stage_dt)

    def unit_strain_velocity(self) -> Float[Array, ""]:
        """The velocity dx/(θΔt_s) [m/s] that strains a cell by one in the stage.

        Deformation gradients are of order one, and rounded to ε, at the smallest strains too. With w this velocity and
        A the diagonal of the operator, ε A w is the rounding of the momentum residual and ε A w² that of the potential.
        """
        return self.spacing / (self.theta * self.stage_dt)

    def incremental_potential(self, v: NodeVector) -> Float[Array, ""]:
        """𝓔(v) [J] up to a constant, that of held components; NaN if a law does not admit the deformation."""
        free = self.projection.free
        inertia = 0.5 * jnp.where(free, self.mass[:, None] * (v - self.inertial) ** 2, 0).sum()
        if self.potential.viscous:
            inertia = inertia + self.theta * self.stage_dt / 2 * self.potential.power(v)
        return inertia + self.potential.admissible_energy(self.displacement(v)) / self.theta
