"""The implicit midpoint rule."""

from typing import ClassVar

import equinox as eqx
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.checks import require_fields
from mpmjax.implicit import (
    AbstractHessian,
    AbstractPreconditioner,
    AbstractSolution,
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    Guess,
    Linearised,
    SolveInfo,
)
from mpmjax.stepping._integrator import AbstractImplicitIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class ImplicitMidpoint(AbstractImplicitIntegrator):
    """The implicit midpoint rule: M (v^{n+1} − v^n) = Δt f(½Δt v̄) + Δt M g with v̄ = ½(v^n + v^{n+1})
    (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed. 2006, II.1).

    Positions and deformation move with v̄; body forces are taken at the middle of the step. `Linearised()` solves
    (M + ¼Δt²H) v̄ = M v^n + ½Δt (f + M g), at the cost of `SemiImplicit`; `Newton()` solves the nonlinear equation.

    Second order in time with either, except for one linear solve with a projected Hessian, which solves another
    equation. Stable at every Δt: a mode of any frequency has |λ| = 1, so that only the transfers dissipate energy. A
    mode that Δt does not resolve is not damped but slowed down: its period is at least 2Δt.

    *When it breaks*: as `SemiImplicit`. One linear solve fails at large strains in a step, and under compression at
    twice the Δt at which β = 1 does. The line search of Newton's method keeps the middle of the step admissible, not
    its end. Unresolved oscillations (from an impact, or a start under load at a large Δt) go on; `TRBDF2` damps them.

    *Good values*: a Δt that resolves the motion of interest, tens of steps a period, whatever the explicit limit.

    Args:
        solution: `Linearised()` for one linear solve, `Newton()`, or one of your own.
        hessian: the Hessian H of the elastic energy. Default: by the analytic stress differential.
        preconditioner: preconditioner of the linear solves. Default: the diagonal of M + χH.
        adjoint_solver: linear solver of the tangent and adjoint systems, any symmetric one of lineax. The
            gradient's error is up to some hundred times its tolerance, by default 1e-8 in float64, 1e-6 in float32.
        guess: where the solve starts. Default: the velocity of the nodes v^n.
    """

    solution: AbstractSolution = Linearised()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    body_force_at: ClassVar[float] = 0.5

    def __check_init__(self):
        require_fields(self)

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v0, half = nodes.admitted_velocity(), nodes.dt / 2
        mean, info = self.solve_stage(nodes, guess, v0 + half * nodes.acceleration, half)
        return NodeMotion(2 * mean - v0, mean, resisted=mean if nodes.potential.viscous else None), info

    def solved_by(self) -> AbstractSolution:
        return self.solution

    def stages(self, nodes: Nodes, motion: NodeMotion) -> tuple[tuple[Scalar, NodeVector], ...]:
        """One, at ½Δt v̄."""
        return ((1, nodes.dt / 2 * motion.carrier),)

    def force_at(self) -> Scalar:
        """½."""
        return 0.5

    def stability_factor(self) -> Scalar:
        return 0.0
