"""The semi-implicit step."""

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.checks import require_between, require_fields
from mpmjax.implicit import (
    AbstractHessian,
    AbstractPreconditioner,
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    Guess,
    Linearised,
    SolveInfo,
    require_solver,
)
from mpmjax.stepping._integrator import AbstractImplicitIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class SemiImplicit(AbstractImplicitIntegrator):
    """The semi-implicit update by one linear solve: (M + βΔt²H) v^{n+1} = M v* (derivation, eq. 17).

    Force and H are those at F^n. With viscosity the system is
    (M + βΔt D + βΔt²H) v^{n+1} = M v* − (1 − β) Δt D v^n (eq. 29).

    First order in time. A mode of frequency ω is amplified by (1 + βz)^(−½), z = (ωΔt)², as long as z < 4/(1−β)². So
    the update is stable at every Δt if β ≥ ½, and for z ≤ 4/(1−2β) otherwise. β = 0 is the explicit step, and β = 1 one
    Newton step of backward Euler. β = ½ is *not* the trapezoidal rule, since positions move with v^{n+1}. Every β > 0
    damps motion: a standing wave at the explicit limit, by a quarter in one period. The method suits slow, driven and
    overdamped motion; `ImplicitMidpoint` costs as much and follows motion in time.

    *When it breaks*: at large strains within one step, since the system is linearised once; and where compression makes
    H indefinite and Δt brings M + βΔt²H near singular. `AnalyticHessian(projected=True)` holds in the latter case.

    *Good values*: for quasi-static pulls, β = 1 with Δt up to some hundred times the explicit limit.

    Args:
        beta: β, from 0 to 1.
        hessian: the Hessian H of the elastic energy. Default: by the analytic stress differential.
        solver: linear solver of the update, any symmetric one of lineax.
        preconditioner: preconditioner of the linear solves. Default: the diagonal of M + χH.
        adjoint_solver: linear solver of the tangent and adjoint systems, any symmetric one of lineax. The
            gradient's error is up to some hundred times its tolerance, by default 1e-8 in float64, 1e-6 in float32.
        guess: where the solve starts. Default: the velocity of the nodes v^n.
    """

    beta: Scalar = 1.0
    hessian: AbstractHessian = AnalyticHessian()
    solver: lx.AbstractLinearSolver = ConjugateResidual()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)

    def __check_init__(self):
        require_fields(self)
        require_solver("SemiImplicit's solver", self.solver)
        require_between("SemiImplicit's beta", self.beta, 0, 1)

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v0, beta = nodes.admitted_velocity(), self.beta
        inertial, viscous = nodes.inertial_velocity(), nodes.potential.viscous
        if viscous:
            inertial = inertial - (1 - beta) * nodes.dt * nodes.per_mass(nodes.potential.viscous_resistance(v0))
        v, info = self.solve_stage(nodes, guess, inertial, nodes.dt, theta=beta)
        return NodeMotion(v, resisted=(1 - beta) * v0 + beta * v if viscous else None), info

    def solved_by(self) -> Linearised:
        return Linearised(self.solver)

    def stages(self, nodes: Nodes, motion: NodeMotion) -> tuple[tuple[Scalar, NodeVector], ...]:
        """One, at βΔt v^{n+1}."""
        return ((1, self.beta * nodes.dt * motion.velocity),)

    def force_at(self) -> Scalar:
        """β."""
        return self.beta

    def stability_factor(self) -> Scalar:
        return 1 - 2 * jnp.asarray(self.beta)

    def limit_name(self) -> str:
        return "limit of SemiImplicit with beta < 1/2"
