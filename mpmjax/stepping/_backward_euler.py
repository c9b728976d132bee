"""Backward Euler."""

from typing import ClassVar

import equinox as eqx
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.checks import require_fields
from mpmjax.implicit import (
    AbstractHessian,
    AbstractPreconditioner,
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    Guess,
    Newton,
    SolveInfo,
)
from mpmjax.stepping._integrator import AbstractImplicitIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes
from mpmjax.stepping._stage import Stage


class BackwardEuler(AbstractImplicitIntegrator):
    """Backward Euler: M (v^{n+1} − v^n) = Δt f(Δt v^{n+1}) + Δt M g (derivation, eq. 2), by Newton's method.

    First order in time, strongly damping; no linearisation error, so it holds where one linear solve does not.

    *When it breaks*: where the incremental potential has several stationary points (steps that compress material to a
    fraction of itself make H indefinite), Newton finds one of them, not always the one a smaller step would lead to.

    Args:
        solution: `Newton()`, with its tolerances.
        hessian: how H acts. Default: by the analytic stress differential.
        preconditioner: of the linear solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves, any symmetric one. Default: `ConjugateResidual`.
        guess: where Newton starts.
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
        v, info = Stage(nodes.inertial_velocity(), nodes.dt).solve(nodes, guess, self, self.solution)
        return NodeMotion(v, resisted=v if nodes.potential.viscous else None), info

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(Δt v) [kg m/s]."""
        return nodes.dt * nodes.potential.force(nodes.dt * motion.velocity)

    def stability_factor(self) -> Scalar:
        return 0.0
