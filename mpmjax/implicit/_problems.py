"""The nodal problems of implicit integrators: linear ones, and nonlinear ones for Newton's method."""

import abc

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeScalar, NodeVector, Scalar
from mpmjax.implicit._hessian import AbstractHessian
from mpmjax.implicit._hessian_action import AbstractHessianAction, damped
from mpmjax.implicit._operator import ImplicitOperator
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._preconditioner import AbstractPreconditioner, MassPreconditioner
from mpmjax.implicit._projection import Projection


class AbstractProblem(eqx.Module):
    """An equation residual(v) = 0 with a symmetric Jacobian, for the nodes' velocity v [m/s] in a step or stage, shape
    (n, d). Held components of v have the value of `prescribed`; where it is None they are at rest."""

    projection: eqx.AbstractVar[Projection]
    prescribed: eqx.AbstractVar[NodeVector | None]
    preconditioner: eqx.AbstractVar[AbstractPreconditioner]

    @abc.abstractmethod
    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """The residual of momentum at each node [kg m/s], shape (n, d); in held components, the impulse that holds."""

    @abc.abstractmethod
    def operator(self, v: NodeVector) -> ImplicitOperator:
        """The derivative of `residual` at v."""

    def residual(self, v: NodeVector) -> NodeVector:
        """The momentum residual in free components, and v − prescribed in held ones."""
        return self.projection.combine(self.momentum_residual(v), v if self.prescribed is None else v - self.prescribed)

    def apply_dirichlet(self, guess: NodeVector) -> NodeVector:
        """The guess, with the prescribed values in held components."""
        return self.projection.combine(guess, 0 if self.prescribed is None else self.prescribed)


class LinearProblem(AbstractProblem):
    """(M + χ H) v = b (derivation, eq. 17)."""

    mass: NodeScalar
    """Nodal masses m_i [kg], shape (n,)."""
    factor: Scalar
    """χ [s²]."""
    hessian: AbstractHessianAction
    """H [N/m]."""
    rhs: NodeVector
    """b [kg m/s]."""
    projection: Projection
    prescribed: NodeVector | None
    preconditioner: AbstractPreconditioner = MassPreconditioner()

    def operator(self, v: NodeVector) -> ImplicitOperator:
        del v
        return ImplicitOperator(self.mass, self.factor, self.hessian, self.projection)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        return self.operator(v).unconstrained(v) - self.rhs


class NewtonProblem(AbstractProblem):
    """M (v − a) − Δt_s f(u + Δt_s v) = 0 (derivation, eq. 22), a stage of length Δt_s that starts at the displacement
    u. Backward Euler has Δt_s = Δt, u = 0, a = v^n + Δt g.

    The left side is the gradient of the incremental potential 𝓔(v) = ½ ‖v − a‖²_M + Φ(u + Δt_s v) (eq. 23), which the
    line search decreases in every step. Viscosity adds Δt_s D v to the equation and ½ Δt_s v·D v to the potential.
    """

    mass: NodeScalar
    """Nodal masses m_i [kg], shape (n,)."""
    inertial: NodeVector
    """a [m/s], the velocity of the stage without the force at its own end."""
    stage_dt: Float[Array, ""]
    """Δt_s [s], the length of the stage."""
    initial_displacement: NodeVector | None
    """u [m]; None for zero."""
    spacing: Float[Array, ""]
    """Grid spacing dx [m]."""
    potential: ElasticPotential
    hessian: AbstractHessian
    projection: Projection
    prescribed: NodeVector | None
    preconditioner: AbstractPreconditioner = MassPreconditioner()

    def displacement(self, v: NodeVector) -> NodeVector:
        """u + Δt_s v [m]."""
        moved = self.stage_dt * v
        return moved if self.initial_displacement is None else self.initial_displacement + moved

    def undisplaced_velocity(self) -> NodeVector:
        """The velocity at which nothing is displaced, −u/Δt_s [m/s]."""
        if self.initial_displacement is None:
            return jnp.zeros_like(self.inertial)
        return -self.initial_displacement / self.stage_dt

    def operator(self, v: NodeVector) -> ImplicitOperator:
        return self._operator(self.hessian.exact(), v)

    def newton_operator(self, v: NodeVector) -> ImplicitOperator:
        """The matrix of a Newton step from v: the operator, approximated if the Hessian is approximate."""
        return self._operator(self.hessian, v)

    def _operator(self, hessian: AbstractHessian, v: NodeVector) -> ImplicitOperator:
        """M + Δt_s D + Δt_s² H."""
        action = damped(hessian.at(self.potential, self.displacement(v)), self.potential, 1 / self.stage_dt)
        return ImplicitOperator(self.mass, self.stage_dt**2, action, self.projection)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        force = self.potential.force(self.displacement(v))
        if self.potential.viscous:
            force = force - self.potential.viscous_resistance(v)
        return self.mass[:, None] * (v - self.inertial) - self.stage_dt * force

    def unit_strain_velocity(self) -> Float[Array, ""]:
        """The velocity dx/Δt_s [m/s] that strains a cell by one in the stage.

        Deformation gradients are of order one, and rounded to ε, at the smallest strains too. With w this velocity and
        A the diagonal of the operator, ε A w is the rounding of the momentum residual and ε A w² that of the potential.
        """
        return self.spacing / self.stage_dt

    def incremental_potential(self, v: NodeVector) -> Float[Array, ""]:
        """𝓔(v) [J] up to a constant, that of held components; NaN if a law does not admit the deformation."""
        free = self.projection.free
        inertia = 0.5 * jnp.where(free, self.mass[:, None] * (v - self.inertial) ** 2, 0).sum()
        if self.potential.viscous:
            inertia = inertia + self.stage_dt / 2 * self.potential.power(v)
        return inertia + self.potential.admissible_energy(self.displacement(v))
