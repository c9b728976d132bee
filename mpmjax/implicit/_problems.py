"""The nodal problems of the implicit updates: linear ones, and those that Newton's method solves.

A problem is an equation residual(v) = 0 for a velocity v of the nodes, the new one or that of a stage, with a symmetric
Jacobian.
"""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, Scalar
from mpmjax.implicit._hessian import Hessian, ImplicitOperator, damped
from mpmjax.implicit._metric import Metric
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._projection import Projection


class SolveInfo(eqx.Module):
    """What the solution of one step's system cost, and how good it is."""

    iterations: Int[Array, "*f"]
    """Conjugate-residual iterations, over all Newton steps."""
    newton: Int[Array, "*f"]
    """Newton steps."""
    line_search: Int[Array, "*f"]
    """Halvings of a Newton step by the line search."""
    residual: Float[Array, "*f"]
    """True relative residual at the end: of one linear solve in the norm of the inverse metric, of Newton's method in
    that of the inverse mass, and there relative to the momentum that the forces balance where their sum vanishes."""
    converged: Bool[Array, "*f"]
    """Whether the solver's tolerance, or the precision's own limit, was met."""
    short: Bool[Array, "*f"]
    """Whether neither was, but ten times the tolerance."""
    indefinite: Bool[Array, "*f"]
    """Whether the solver met a direction of negative curvature: M + cH is indefinite, and the step may be near a
    singular one."""
    report: Float[Array, "*f"]
    """Zero. Its tangent is the relative residual of the tangent solves that did not converge (see `Reporting`)."""

    def plus(self, later: "SolveInfo") -> "SolveInfo":
        """The cost of both solves and the quality of the later one."""
        return SolveInfo(
            iterations=self.iterations + later.iterations,
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            residual=later.residual,
            converged=later.converged,
            short=later.short,
            indefinite=self.indefinite | later.indefinite,
            report=self.report + later.report,
        )

    def beside(self, other: "SolveInfo") -> "SolveInfo":
        """The cost of both solves and the quality of the worse one."""
        both = self.plus(other)
        converged = self.converged & other.converged
        short = (self.converged | self.short) & (other.converged | other.short) & ~converged
        worst = jnp.maximum(self.residual, other.residual), converged, short
        return eqx.tree_at(lambda info: (info.residual, info.converged, info.short), both, worst)


def no_solve(dtype: Any) -> SolveInfo:
    """The report of an update that solves nothing."""
    zero = jnp.asarray(0, dtype=jnp.int32)
    no, none = jnp.asarray(False), jnp.asarray(0, dtype=dtype)
    return SolveInfo(zero, zero, zero, none, converged=~no, short=no, indefinite=no, report=none)


class AbstractProblem(eqx.Module):
    """An equation for the nodes' velocity. What is held takes the value of `prescribed`."""

    projection: eqx.AbstractVar[Projection]
    prescribed: eqx.AbstractVar[NodeVector]

    @abc.abstractmethod
    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """The momentum [kg m/s] by which each node misses its equation; on held nodes, the impulse that holds them."""

    @abc.abstractmethod
    def operator(self, v: NodeVector) -> ImplicitOperator:
        """The derivative of the momentum residual at v, constrained."""

    def residual(self, v: NodeVector) -> NodeVector:
        """The equation that is solved: the momentum residual of what is free, the error of what is prescribed."""
        return self.projection.combine(self.momentum_residual(v), v - self.prescribed)

    def apply_dirichlet(self, guess: NodeVector) -> NodeVector:
        """The guess with what is prescribed."""
        return self.projection.combine(guess, self.prescribed)


class LinearProblem(AbstractProblem):
    """(M + c H) v = b (reference, eq. 6 times m_i)."""

    mass: NodeScalar
    factor: Scalar
    hessian: Any
    rhs: NodeVector
    projection: Projection
    prescribed: NodeVector
    metric: Metric = eqx.field(static=True, default=Metric.MASS)

    def operator(self, v: NodeVector) -> ImplicitOperator:
        """Q (M + c H) Q + I − Q."""
        del v
        return ImplicitOperator(self.mass, self.factor, self.hessian, self.projection, self.metric)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """(M + c H) v − b."""
        return self.operator(v).unconstrained(v) - self.rhs


class NewtonProblem(AbstractProblem):
    """M (v − ṽ) − c f(u + c v) = 0: a stage of length c that starts at the displacement u. Backward Euler (reference,
    eq. 2) has c = Δt, u = 0, ṽ = v^n + Δt g.

    It is the gradient of the incremental potential E(v) = ½ ‖v − ṽ‖²_M + Φ(u + c v), of which a step that a wall or
    the line search accepts is a descent. Viscosity adds c D v to the one and ½ c v·D v to the other.
    """

    mass: NodeScalar
    inertial: NodeVector
    """ṽ [m/s]."""
    length: Float[Array, ""]
    """c [s]."""
    displaced: NodeVector | None
    """u [m]; None for zero."""
    spacing: Float[Array, ""]
    potential: ElasticPotential
    hessian: Hessian
    projection: Projection
    prescribed: NodeVector
    metric: Metric = eqx.field(static=True, default=Metric.MASS)

    def displacement(self, v: NodeVector) -> NodeVector:
        """u + c v [m]."""
        return self.length * v if self.displaced is None else self.displaced + self.length * v

    def undisplaced(self) -> NodeVector:
        """The velocity at which nothing is displaced, −u/c."""
        return jnp.zeros_like(self.inertial) if self.displaced is None else -self.displaced / self.length

    def operator(self, v: NodeVector) -> ImplicitOperator:
        """M + c D + c² H at the displacement, projected: the momentum residual's derivative, with the true H."""
        return self._operator(self.hessian.exact(), v)

    def model(self, v: NodeVector) -> ImplicitOperator:
        """What a Newton step from v solves: the operator, or with a projected Hessian a positive definite stand-in."""
        return self._operator(self.hessian, v)

    def _operator(self, hessian: Hessian, v: NodeVector) -> ImplicitOperator:
        action = damped(hessian.at(self.potential, self.displacement(v)), self.potential, 1 / self.length)
        return ImplicitOperator(self.mass, self.length**2, action, self.projection, self.metric)

    def momentum_residual(self, v: NodeVector) -> NodeVector:
        """M (v − ṽ) − c (f(u + c v) − D v)."""
        force = self.potential.force(self.displacement(v))
        if self.potential.viscous:
            force = force - self.potential.damping_force(v)
        return self.mass[:, None] * (v - self.inertial) - self.length * force

    def unit_strain(self) -> Float[Array, ""]:
        """The velocity dx/c [m/s] that strains a cell by one in the stage.

        Deformation gradients are of order one, and are rounded as such, however small the strains: so ε times this,
        times the operator's diagonal, is the rounding of the momentum residual, and times itself that of the potential.
        """
        return self.spacing / self.length

    def merit(self, v: NodeVector) -> Float[Array, ""]:
        """E(v) [J], without the constant of what is held; NaN where a law is not defined."""
        free = self.projection.free
        inertia = 0.5 * jnp.where(free, self.mass[:, None] * (v - self.inertial) ** 2, 0).sum()
        if self.potential.viscous:
            inertia = inertia + self.length / 2 * self.potential.power(v)
        return inertia + self.potential.admissible_energy(self.displacement(v))
