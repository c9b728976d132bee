"""The implicit integrators: the semi-implicit step, backward Euler, the midpoint rule, TR-BDF2."""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Annotated, ClassVar

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import NodeVector, Scalar
from mpmjax.autodiff import without_derivative
from mpmjax.checks import between, require_fields
from mpmjax.implicit import (
    AbstractHessian,
    AbstractPreconditioner,
    AbstractStageSolver,
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    Guess,
    Linearised,
    Newton,
    Reporting,
    SolveInfo,
    StageProblem,
    require_solver,
    solve,
    solve_linearised,
)
from mpmjax.stepping._integrator import AbstractIntegrator, NodeMotion
from mpmjax.stepping._nodes import Nodes

Stages = tuple[tuple[Scalar, NodeVector | None], ...]
"""Weights q [-] and displacements u [m], shape (n, d), of an impulse Δt Σ q f(u); None for u = 0."""


class AbstractImplicitIntegrator(AbstractIntegrator):
    """An integrator that solves with the elastic Hessian, and treats viscosity implicitly. A subclass must have
    `advance`, `solution` or `solved_by`, and `stages`. The defaults are those of a method that is stable at every step.

    Args:
        hessian: the Hessian H of the elastic energy. Default: by the analytic stress differential.
        preconditioner: preconditioner of the linear solves. Default: the diagonal of M + χH.
        adjoint_solver: linear solver of the tangent and adjoint systems, any symmetric one of lineax. The
            gradient's error is up to some hundred times its tolerance, by default 1e-8 in float64, 1e-6 in float32.
        guess: where the (first) solve starts. Default: the velocity of the nodes v^n.
    """

    explicit_viscosity: ClassVar[bool] = False

    hessian: AbstractHessian = eqx.field(default=AnalyticHessian(), kw_only=True)
    preconditioner: AbstractPreconditioner = eqx.field(default=DiagonalPreconditioner(), kw_only=True)
    adjoint_solver: Annotated[lx.AbstractLinearSolver, require_solver] = eqx.field(
        default=ConjugateResidual(), kw_only=True
    )
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY, kw_only=True)

    __check_init__ = require_fields

    def solved_by(self) -> Callable[[StageProblem, NodeVector], tuple[NodeVector, SolveInfo]]:
        """How the equation of a stage is solved, as an `AbstractStageSolver` does. Default: by the field `solution`."""
        return self.solution  # pyright: ignore[reportAttributeAccessIssue]

    @property
    def linearises(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether stages have the elastic force f(0) − H u in place of that of the law."""
        return getattr(self.solved_by(), "linearises", False)

    @abstractmethod
    def stages(self, nodes: Nodes, motion: NodeMotion) -> Stages:
        """The stages in which the elastic force acts."""

    def solve_stage(
        self,
        nodes: Nodes,
        guess: NodeVector,
        inertial: NodeVector,
        stage_dt: Scalar,
        initial_displacement: NodeVector | None = None,
        theta: Scalar = 1.0,
    ) -> tuple[NodeVector, SolveInfo]:
        """The solution v [m/s], shape (n, d), of M (v − a) = Δt_s (f(u + θΔt_s v) − θ D v), a `StageProblem`, and the
        report of the solve. One linear solve takes f(u) = f(0) − H u; Newton's method solves the nonlinear equation.

        Args:
            nodes: the nodes.
            guess: where the solve starts [m/s], shape (n, d).
            inertial: a, the velocity of the stage without the force at its own end [m/s], shape (n, d).
            stage_dt: Δt_s, the length of the stage [s].
            initial_displacement: u at the start of the stage [m], shape (n, d); None for zero.
            theta: θ, the share of the stage's displacement at which its force is evaluated [-].
        """
        force, action = nodes.force, None
        if self.linearises:
            action = self.hessian.at(nodes.potential, None)
            force = force if initial_displacement is None else force - action(initial_displacement)
        problem = StageProblem(
            mass=nodes.mass,
            inertial=inertial,
            stage_dt=jnp.asarray(stage_dt),
            initial_displacement=initial_displacement,
            force=force,
            spacing=nodes.spacing,
            potential=nodes.potential,
            hessian=self.hessian,
            projection=nodes.projection,
            prescribed=nodes.prescribed if nodes.conditions.moves else None,
            preconditioner=self.preconditioner,
            theta=theta,
            action=action,
        )
        adjoint, slot = self.adjoint_solver, jnp.zeros((), guess.dtype)
        if isinstance(adjoint, Reporting):
            adjoint, slot = adjoint.solver, adjoint.slot
        return solve(problem, slot, *without_derivative((guess, self.solved_by(), adjoint)))

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion, stages: Stages | None = None) -> NodeVector:
        """Δt Σ q f(u) [kg m/s] of the motion's stages or of others, with the forces that the solution takes."""
        stages = self.stages(nodes, motion) if stages is None else stages
        if not self.linearises:
            return self.exact_impulse(nodes, motion, stages)
        mean = reduce(jnp.add, (q * u for q, u in stages if u is not None))
        return nodes.dt * (sum(q for q, _ in stages) * nodes.force - self.hessian.at(nodes.potential, None)(mean))

    def exact_impulse(self, nodes: Nodes, motion: NodeMotion, stages: Stages | None = None) -> NodeVector:
        stages = self.stages(nodes, motion) if stages is None else stages
        forces = (q * (nodes.force if u is None else nodes.potential.force(u)) for q, u in stages)
        return nodes.dt * reduce(jnp.add, forces)

    def mean_displacement(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Σ q u [m] of the motion's stages."""
        return reduce(jnp.add, (q * u for q, u in self.stages(nodes, motion) if u is not None))

    def stability_factor(self) -> Scalar:
        return 0.0

    def initial_guess(self, nodes: Nodes) -> NodeVector:
        match self.guess:
            case Guess.GRID_VELOCITY:
                return nodes.velocity
            case Guess.EXPLICIT:
                return nodes.explicit_velocity()
            case Guess.ZERO:
                return jnp.zeros_like(nodes.velocity)

    def reporting(self, slot: Scalar) -> "AbstractImplicitIntegrator":
        return eqx.tree_at(lambda m: m.adjoint_solver, self, Reporting(self.adjoint_solver, slot))

    def unconverged_advice(self) -> tuple[str, ...]:
        advice = self.preconditioner.advice
        return () if advice is None else (advice,)


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
        solver: linear solver of the update, any symmetric one of lineax.
        hessian, preconditioner, adjoint_solver, guess: see `AbstractImplicitIntegrator`.
    """

    linearises: ClassVar[bool] = True  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]
    beta: Annotated[Scalar, between(0, 1)] = 1.0
    solver: Annotated[lx.AbstractLinearSolver, require_solver] = ConjugateResidual()

    def solved_by(self) -> Callable[[StageProblem, NodeVector], tuple[NodeVector, SolveInfo]]:
        return eqx.Partial(solve_linearised, self.solver)

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v0, beta = nodes.admitted_velocity(), self.beta
        inertial, viscous = nodes.inertial_velocity(), nodes.potential.viscous
        if viscous:
            inertial = inertial - (1 - beta) * nodes.dt * nodes.per_mass(nodes.potential.viscous_resistance(v0))
        v, info = self.solve_stage(nodes, guess, inertial, nodes.dt, theta=beta)
        return NodeMotion(v, resisted=(1 - beta) * v0 + beta * v if viscous else None), info

    def stages(self, nodes: Nodes, motion: NodeMotion) -> Stages:
        return ((1, self.beta * nodes.dt * motion.velocity),)

    def force_at(self) -> Scalar:
        return self.beta

    def stability_factor(self) -> Scalar:
        return 1 - 2 * jnp.asarray(self.beta)

    def limit_name(self) -> str:
        return "limit of SemiImplicit with beta < 1/2"


class BackwardEuler(AbstractImplicitIntegrator):
    """Backward Euler by Newton's method: M (v^{n+1} − v^n) = Δt f(Δt v^{n+1}) + Δt M g (derivation, eq. 2).

    First order in time, and strongly damping. It has no linearisation error, so it holds at large strains in a step,
    where one linear solve does not.

    *When it breaks*: steps that compress material to a fraction of itself make H indefinite. The incremental potential
    then has several stationary points, and Newton's method finds one of them, which is not always the one that smaller
    steps lead to.

    Args:
        solution: Newton's method, with its linear solver and tolerances.
        hessian, preconditioner, adjoint_solver, guess: see `AbstractImplicitIntegrator`.
    """

    solution: Newton = Newton()
    keeps_admissible: ClassVar[bool] = True

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v, info = self.solve_stage(nodes, guess, nodes.inertial_velocity(), nodes.dt)
        return NodeMotion(v, resisted=v if nodes.potential.viscous else None), info

    def stages(self, nodes: Nodes, motion: NodeMotion) -> Stages:
        return ((1, nodes.dt * motion.velocity),)


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
    Where a wall's push oscillates so does what its friction can hold: near the limit a block creeps (pushed by 0.12 g
    in steps of 7 dx/c, by 4 mm/s at μ = 0.15 and not at all at 0.3).

    *Good values*: a Δt that resolves the motion of interest, tens of steps a period, whatever the explicit limit.

    Args:
        solution: `Linearised()` for one linear solve, `Newton()`, or one of your own.
        hessian, preconditioner, adjoint_solver, guess: see `AbstractImplicitIntegrator`.
    """

    solution: AbstractStageSolver = Linearised()
    body_force_at: ClassVar[float] = 0.5

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        v0, half = nodes.admitted_velocity(), nodes.dt / 2
        mean, info = self.solve_stage(nodes, guess, v0 + half * nodes.acceleration, half)
        return NodeMotion(2 * mean - v0, mean, resisted=mean if nodes.potential.viscous else None), info

    def stages(self, nodes: Nodes, motion: NodeMotion) -> Stages:
        return ((1, nodes.dt / 2 * motion.carrier),)

    def force_at(self) -> Scalar:
        return 0.5


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

    Contact's friction acts at the end of each stage, that of the first one as a part of G_γ, so that the second begins
    from what sticks and a body at rest stays there. Over the step it takes at most μ times the push of the step.

    *When it breaks*: as `ImplicitMidpoint`. Near ρ∞ = 1 what a wall's friction can hold oscillates as its push does.

    Args:
        rho: ρ∞, from 0 to 1.
        solution: `Linearised()` for one linear solve a stage, `Newton()`, or one of your own. The second solve starts
            at the result of the first.
        hessian, preconditioner, adjoint_solver, guess: see `AbstractImplicitIntegrator`.
    """

    rho: Annotated[Scalar, between(0, 1)] = 0.0
    solution: AbstractStageSolver = Linearised()
    body_force_at: ClassVar[float] = 0.5

    def weights(self) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """γ, q_0, q_1, q_2: γ solves (1 − ρ∞)γ² − 4γ + 2 = 0, q_2 = ½γ, q_1 = (½ − q_2)/γ, q_0 = 1 − q_1 − q_2."""
        gamma = 2 / (2 + jnp.sqrt(2 + 2 * jnp.asarray(self.rho)))
        q1 = (1 / gamma - 1) / 2
        return gamma, 1 - q1 - gamma / 2, q1, gamma / 2

    def advance(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        gamma, q0, q1, q2 = self.weights()
        dt, g, v0 = nodes.dt, nodes.acceleration, nodes.admitted_velocity()
        length = q2 * dt  # Δt_s = ½γΔt
        viscous = nodes.potential.viscous
        # G_0 is that of the start: no force is evaluated for it
        pull = nodes.per_mass(nodes.force - nodes.potential.viscous_resistance(v0) if viscous else nodes.force)
        inertial = v0 + length * (pull + 2 * g)
        if nodes.inner is not None and (change := nodes.inner.change(gamma)) is not None:
            inertial = inertial + 2 * length * nodes.per_mass(change)
        middle, first = self.solve_stage(nodes, guess, inertial, length, length * v0)
        inner, solved, friction = q2 * (v0 + middle), middle, None
        if nodes.inner is not None:
            change = nodes.inner.friction(self, middle, dt * inner, 2 * q2)
            middle, friction = middle + change, q1 / q2 * change
        later_pull = (middle - inertial) / length  # f_γ/m, with viscosity and friction, by the stage's own equation
        inertial = v0 + dt * (q0 * pull + q1 * later_pull + g)
        v, second = self.solve_stage(nodes, middle, inertial, length, dt * (q0 * v0 + q1 * middle))
        mean, resisted = (q0 * v0 + q1 * u + q2 * v for u in (middle, solved))
        return NodeMotion(v, mean, inner, resisted if viscous else None, friction), first.together_with(second)

    def with_friction(self, motion: NodeMotion, change: NodeVector) -> NodeMotion:
        """The mean takes q_2 of the change, as of the velocity at the step's end."""
        mean = motion.carrier + self.weights()[3] * change
        return replace(motion, velocity=motion.velocity + change, mean=mean)

    def stages(self, nodes: Nodes, motion: NodeMotion) -> Stages:
        _, q0, q1, q2 = self.weights()
        inner = motion.carrier if motion.inner is None else motion.inner
        return (q0, None), (q1, nodes.dt * inner), (q2, nodes.dt * motion.carrier)

    def force_at(self) -> Scalar:
        return 0.5
