"""The equation of an implicit stage, and what a way to solve it is."""

import abc
from functools import reduce
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeScalar, NodeVector, Scalar
from mpmjax.implicit._hessian import AbstractHessian
from mpmjax.implicit._hessian_action import damped
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.implicit._preconditioner import AbstractPreconditioner
from mpmjax.implicit._problems import AbstractProblem, LinearProblem, NewtonProblem
from mpmjax.implicit._projection import Projection
from mpmjax.implicit._solve_info import SolveInfo


class StageEquation(eqx.Module):
    """M (v − a) = Δt_s (f(u + Δt_s v) − D v), with f(u) the elastic force at nodal displacements u and −D v the viscous
    force (derivation, eq. 22 and section 10)."""

    mass: NodeScalar
    """Nodal masses m_i [kg], shape (n,)."""
    inertial: NodeVector
    """a [m/s], the velocity of the stage without the force at its own end, shape (n, d)."""
    stage_dt: Float[Array, ""]
    """Δt_s [s], the length of the stage."""
    initial_displacement: NodeVector | None
    """u [m], shape (n, d); None for zero."""
    force: NodeVector
    """f(0) [N], shape (n, d)."""
    spacing: Float[Array, ""]
    """Grid spacing dx [m]."""
    potential: ElasticPotential
    """Whose force f is."""
    hessian: AbstractHessian
    """How its Hessian acts."""
    projection: Projection
    """The projection on what is free."""
    prescribed: NodeVector | None
    """The velocity of what is held [m/s], shape (n, d); None if it is at rest."""
    preconditioner: AbstractPreconditioner

    def linear(self) -> LinearProblem:
        """The problem with f(u) = f(0) − H u."""
        action = self.hessian.at_step_start(self.potential)
        u = self.initial_displacement
        force = self.force if u is None else self.force - action(u)
        return LinearProblem(
            mass=self.mass,
            factor=self.stage_dt**2,
            hessian=damped(action, self.potential, 1 / self.stage_dt),
            rhs=self.mass[:, None] * self.inertial + self.stage_dt * force,
            projection=self.projection,
            prescribed=self.prescribed,
            preconditioner=self.preconditioner,
        )

    def nonlinear(self) -> NewtonProblem:
        """The problem as it is."""
        return NewtonProblem(
            mass=self.mass,
            inertial=self.inertial,
            stage_dt=self.stage_dt,
            initial_displacement=self.initial_displacement,
            spacing=self.spacing,
            potential=self.potential,
            hessian=self.hessian,
            projection=self.projection,
            prescribed=self.prescribed,
            preconditioner=self.preconditioner,
        )


class AbstractSolution(eqx.Module):
    """How the equation of a stage is solved."""

    linearises: ClassVar[bool] = False
    """Whether `stage_force` has other forces than the law."""

    @abc.abstractmethod
    def problem(self, stage: StageEquation) -> AbstractProblem:
        """The problem that is solved in the place of the stage's equation: `stage.linear()`, `stage.nonlinear()` or one
        of one's own. Derivatives are those of its exact solution."""

    @abc.abstractmethod
    def stage_force(
        self,
        potential: ElasticPotential,
        hessian: AbstractHessian,
        force: NodeVector,
        *stages: tuple[Scalar, NodeVector],
    ) -> NodeVector:
        """Σ q f(u) [N], shape (n, d), the elastic forces as the problem has them.

        Args:
            potential: whose force f is.
            hessian: how its Hessian acts.
            force: f(0) [N], shape (n, d).
            stages: the weights q [-] and displacements u [m], shape (n, d).
        """

    @abc.abstractmethod
    def __call__(self, problem: Any, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """The solution of a problem that `problem` made, and what it took.

        Args:
            problem: the problem.
            guess: where an iteration starts [m/s], shape (n, d).
        """


def exact_force(potential: ElasticPotential, *stages: tuple[Scalar, NodeVector]) -> NodeVector:
    """Σ q f(u) [N], shape (n, d), the elastic forces of the law.

    Args:
        potential: whose force f is.
        stages: the weights q [-] and displacements u [m], shape (n, d).
    """
    return reduce(jnp.add, (q * potential.force(u) for q, u in stages))
