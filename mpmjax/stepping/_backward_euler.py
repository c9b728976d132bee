"""Backward Euler."""

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
    Newton,
    SolveInfo,
)
from mpmjax.stepping._integrator import AbstractImplicitIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes


class BackwardEuler(AbstractImplicitIntegrator):
    """Backward Euler by Newton's method: M (v^{n+1} − v^n) = Δt f(Δt v^{n+1}) + Δt M g (derivation, eq. 2).

    First order in time, and strongly damping. It has no linearisation error, so it holds at large strains in a step,
    where one linear solve does not.

    *When it breaks*: steps that compress material to a fraction of itself make H indefinite. The incremental potential
    then has several stationary points, and Newton's method finds one of them, which is not always the one that smaller
    steps lead to.

    Args:
        solution: Newton's method, with its linear solver and tolerances.
        hessian: the Hessian H of the elastic energy. Default: by the analytic stress differential.
        preconditioner: preconditioner of the linear solves. Default: the diagonal of M + χH.
        adjoint_solver: linear solver of the tangent and adjoint systems, any symmetric one of lineax. The
            gradient's error is up to some hundred times its tolerance, by default 1e-8 in float64, 1e-6 in float32.
        guess: where Newton's method starts. Default: the velocity of the nodes v^n.
    """

    solution: Newton = Newton()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    keeps_admissible: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v, info = self.solve_stage(nodes, guess, nodes.inertial_velocity(), nodes.dt)
        return NodeMotion(v, resisted=v if nodes.potential.viscous else None), info

    def solved_by(self) -> AbstractSolution:
        return self.solution

    def stages(self, nodes: Nodes, motion: NodeMotion) -> tuple[tuple[Scalar, NodeVector], ...]:
        """One, at Δt v^{n+1}."""
        return ((1, nodes.dt * motion.velocity),)

    def stability_factor(self) -> Scalar:
        return 0.0
