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
from mpmjax.stepping._stage import Stage, stage_force


class ImplicitMidpoint(AbstractImplicitIntegrator):
    """The implicit midpoint rule: M (v^{n+1} − v^n) = Δt f(½Δt v̄) + Δt M g with v̄ = ½(v^n + v^{n+1}), positions and
    deformation moving with v̄.

    By one linear solve, (M + ¼Δt²H) v̄ = M v^n + ½Δt (f + M g), at the cost of `SemiImplicit`; or by Newton's method.
    Second order in time either way, but for one solve with a projected Hessian, which is another equation. On a mode of
    any frequency |λ| = 1 at every Δt: stable, and nothing is dissipated but by the transfers; a mode that Δt does not
    resolve is slowed down, at most to a period of 2Δt, and not damped. Body forces are taken at the middle of the step.
    *When it breaks*: as the semi-implicit step: one solve at large strains in a step; compression, at twice the Δt at
    which β = 1 does. Newton's line search keeps the middle of the step admissible, not its end. What rings unresolved
    (an impact, a start under load at a large Δt) rings on: `TRBDF2` damps it.
    *Good values*: Δt that resolves the motion of interest, tens of steps a period, whatever the explicit limit.
    (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed. 2006, II.1.)

    Args:
        solution: `Linearised()`, one linear solve; `Newton()`; or one of your own.
        hessian: how H acts. Default: by the analytic stress differential.
        preconditioner: of the linear solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves, any symmetric one. Default: `ConjugateResidual`.
        guess: where the solve starts.
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
        stage = Stage(v0 + half * nodes.acceleration, half)
        mean, info = stage.solve(nodes, guess, self, self.solution)
        return NodeMotion(2 * mean - v0, mean, resisted=mean if nodes.potential.viscous else None), info

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(½Δt v̄) [kg m/s]."""
        return nodes.dt * stage_force(nodes, self, self.solution, (1, nodes.dt / 2 * motion.carrier))

    def stability_factor(self) -> Scalar:
        return 0.0
