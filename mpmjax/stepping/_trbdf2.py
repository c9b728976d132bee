"""TR-BDF2, and its relatives by ρ∞."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.checks import require_between, require_fields
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


class TRBDF2(AbstractImplicitIntegrator):
    """TR-BDF2: a trapezoidal stage from 0 to γΔt, then a stage from 0, γΔt and Δt. For y' = G(y),

        y_γ = y_0 + ½γΔt (G_0 + G_γ),    y_1 = y_0 + Δt (q_0 G_0 + q_1 G_γ + q_2 G_1)

    (derivation, eqs. 25 and 26; R. E. Bank et al., IEEE Trans. CAD 4 (1985) 436, doi 10.1109/TCAD.1985.1270142; with
    ρ∞: G. Noh, K.-J. Bathe, Comput. Struct. 212 (2019) 299, doi 10.1016/j.compstruc.2018.11.001).

    Second order in time and stable at every Δt. A mode that Δt does not resolve is multiplied by ρ∞ in each step. With
    ρ∞ = 0, which is TR-BDF2, it vanishes at once (the method is L-stable); with ρ∞ = 1 the method is two trapezoidal
    steps of Δt/2. The order, ρ∞ and one matrix for both stages, M + (½γΔt)²H, determine γ and q. A step takes two
    solves, each of them easier than that of `ImplicitMidpoint`: ½γ is 0.29 (ρ∞ = 0) to 0.25.

    It is for motion to be followed in time in which unresolved frequencies would ring, as in contact and stiff starts.

    *When it breaks*: as `ImplicitMidpoint`. Friction acts after both stages, so what it should hold creeps: a block of
    1e6 Pa, 0.3 m long and pushed by 0.12 g on a floor of μ = 0.15, by 2.4 mm/s in steps of 0.01 s. `SemiImplicit` and
    `BackwardEuler` hold it.

    Args:
        rho: ρ∞, from 0 to 1.
        solution: `Linearised()` for one linear solve a stage, `Newton()`, or one of your own.
        hessian: the Hessian H of the elastic energy. Default: by the analytic stress differential.
        preconditioner: preconditioner of the linear solves. Default: the diagonal of M + χH.
        adjoint_solver: linear solver of the tangent and adjoint systems, any symmetric one of lineax. The
            gradient's error is up to some hundred times its tolerance, by default 1e-8 in float64, 1e-6 in float32.
        guess: where the solve of the first stage starts; that of the second starts at the result of the first.
    """

    rho: Scalar = 0.0
    solution: AbstractSolution = Linearised()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    body_force_at: ClassVar[float] = 0.5

    def __check_init__(self):
        require_fields(self)
        require_between("TRBDF2's rho", self.rho, 0, 1)

    def weights(self) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """γ, q_0, q_1, q_2: γ solves (1 − ρ∞)γ² − 4γ + 2 = 0, q_2 = ½γ, q_1 = (½ − q_2)/γ, q_0 = 1 − q_1 − q_2."""
        gamma = 2 / (2 + jnp.sqrt(2 + 2 * jnp.asarray(self.rho)))
        q1 = (1 / gamma - 1) / 2
        return gamma, 1 - q1 - gamma / 2, q1, gamma / 2

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        _, q0, q1, q2 = self.weights()
        dt, g, v0 = nodes.dt, nodes.acceleration, nodes.admitted_velocity()
        length = q2 * dt  # Δt_s = ½γΔt
        viscous = nodes.potential.viscous
        pull = nodes.per_mass(nodes.force - nodes.potential.viscous_resistance(v0) if viscous else nodes.force)
        inertial = v0 + length * (pull + 2 * g)
        middle, first = self.solve_stage(nodes, guess, inertial, length, length * v0)
        later_pull = (middle - inertial) / length  # f_γ/m, viscosity's with it, by the stage's own equation
        inertial = v0 + dt * (q0 * pull + q1 * later_pull + g)
        v, second = self.solve_stage(nodes, middle, inertial, length, dt * (q0 * v0 + q1 * middle))
        inner, mean = q2 * (v0 + middle), q0 * v0 + q1 * middle + q2 * v
        return NodeMotion(v, mean, inner, mean if viscous else None), first.together_with(second)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt (q_0 f_0 + q_1 f_γ + q_2 f_1) [kg m/s]."""
        return nodes.dt * self.weights()[1] * nodes.force + super().elastic_impulse(nodes, motion)

    def solved_by(self) -> AbstractSolution:
        return self.solution

    def exact_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector | None:
        later = super().exact_impulse(nodes, motion)
        return None if later is None else nodes.dt * self.weights()[1] * nodes.force + later

    def stages(self, nodes: Nodes, motion: NodeMotion) -> tuple[tuple[Scalar, NodeVector], ...]:
        """The stages at γΔt and Δt."""
        _, _, q1, q2 = self.weights()
        inner = motion.carrier if motion.inner is None else motion.inner
        return (q1, nodes.dt * inner), (q2, nodes.dt * motion.carrier)

    def force_at(self) -> Scalar:
        """½."""
        return 0.5

    def mean_displacement(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """q_1 u_γ + q_2 u_1 [m]."""
        _, _, q1, q2 = self.weights()
        inner = motion.carrier if motion.inner is None else motion.inner
        return nodes.dt * (q1 * inner + q2 * motion.carrier)

    def stability_factor(self) -> Scalar:
        return 0.0
