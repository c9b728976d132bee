"""The ways to update the grid's velocity in a step.

A method says how the nodes move (`move`) and what impulse the elastic force gives them meanwhile (`elastic_impulse`);
walls, contact, friction, transfers, reports and derivatives are the same for all. Three constants say what it wants of
P2G: body forces `centred` in the step, whether it `needs_force` apart from the momentum that makes, and whether its
viscosity is `lagged`, that of the particles' stored velocity gradients. Backward Euler and the methods of second order
are made of stages M (v − a) = c (f(u + c v) − D v), f(u) the elastic force at the nodal displacement u and D v that of
viscosity: each is one linear solve, with f(u) = f(0) − H u, or Newton's method.
"""

from functools import reduce
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.checks import require_between, require_fields
from mpmjax.implicit import (
    AbstractHessian,
    AbstractPreconditioner,
    AnalyticHessian,
    ConjugateResidual,
    DiagonalPreconditioner,
    Guess,
    Linearised,
    LinearProblem,
    Newton,
    NewtonProblem,
    Reporting,
    SolveInfo,
    damped,
    no_solve,
    solve,
)
from mpmjax.stepping._nodes import Nodes


class NodeMotion(eqx.Module):
    """How the nodes move in a step."""

    velocity: NodeVector
    """v^{n+1} [m/s], shape (n, d)."""
    mean: NodeVector | None = None
    """The velocity with which positions and deformation move over the step [m/s], shape (n, d); None where it is
    v^{n+1}."""
    inner: NodeVector | None = None
    """The same up to an inner stage, the displacement there over Δt; None without one."""
    resisted: NodeVector | None = None
    """The velocity that viscosity resists over the step [m/s], shape (n, d); None where the solve has no viscosity."""

    @property
    def carrier(self) -> NodeVector:
        """The velocity with which positions and deformation move [m/s], shape (n, d)."""
        return self.velocity if self.mean is None else self.mean

    def slowed(self, loss: NodeVector) -> "NodeMotion":
        """Changed by an impulse that acts evenly over the step: half of it counts for the mean."""
        return NodeMotion(
            self.velocity + loss, None if self.mean is None else self.mean + loss / 2, self.inner, self.resisted
        )


class Explicit(eqx.Module):
    """Symplectic Euler: v^{n+1} = v* (reference, eq. 4); positions then move with v^{n+1}.

    Second order in space with APIC and FLIP, first order in time. Conserves linear and, with APIC, angular momentum.

    *When it breaks*: above Δt of about 0.4 to 1 times dx/c, depending on dimension, kernel and transfer
    (c the pressure-wave speed of the *current* tangent, which stretching and compression raise): see `stable_dt`.
    """

    guess: ClassVar[Guess] = Guess.GRID_VELOCITY
    centred: ClassVar[bool] = False
    needs_force: ClassVar[bool] = False
    lagged: ClassVar[bool] = True

    def move(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solve's report."""
        del guess
        v = nodes.projection.combine(nodes.explicit_velocity(), nodes.prescribed)
        return NodeMotion(v), no_solve(v.dtype)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(0) [kg m/s], on nodes that have mass."""
        del motion
        return jnp.where(nodes.occupied, nodes.dt * nodes.force, 0)


class SemiImplicit(eqx.Module):
    """The semi-implicit update: (M + βΔt²H) v^{n+1} = M v*, force and H at the start of the step (reference, eqs. 3,
    6); with viscosity (M + βΔt D + βΔt²H) v^{n+1} = M v* − (1 − β) Δt D v^n.

    First order in time. On a mode of frequency ω the amplification is (1 + βz)^(−½) with z = (ωΔt)² while
    z < 4/(1−β)²: stable for every Δt if β ≥ ½, else for z ≤ 4/(1−2β). β = 0 is the explicit step; β = 1 one Newton step
    of backward Euler. β = ½ is *not* the trapezoidal rule, positions moving with v^{n+1}: for β > 0 motion is damped,
    by a quarter in one period of a standing wave at the explicit limit. A method for slow, driven and overdamped
    motion; `ImplicitMidpoint` costs as much and follows motion in time.
    *When it breaks*: large strains within one step (the system is linearised once), and where compression makes H
    indefinite and Δt brings M + βΔt²H near singular: `AnalyticHessian(projected=True)` holds there.
    *Good values*: β = 1 with Δt up to some hundred times the explicit limit for quasi-static pulls.

    Args:
        beta: β, from 0 to 1.
        hessian: how H acts. Default: by the analytic stress differential.
        solver: conjugate residuals of the forward solve.
        preconditioner: of the solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves, whose tolerance bounds the gradient's. Default: default
            tolerances.
        guess: where the solve starts.
    """

    beta: Scalar = 1.0
    hessian: AbstractHessian = AnalyticHessian()
    solver: lx.AbstractLinearSolver = ConjugateResidual()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    centred: ClassVar[bool] = False
    needs_force: ClassVar[bool] = True
    lagged: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)
        require_between("SemiImplicit's beta", self.beta, 0, 1)

    def move(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solve's report."""
        predictor, v0, beta = nodes.explicit_velocity(), nodes.admitted_velocity(), self.beta
        viscous = nodes.potential.viscous
        impulse = nodes.mass[:, None] * predictor
        problem = LinearProblem(
            mass=nodes.mass,
            factor=beta * nodes.dt**2,
            hessian=damped(self.hessian.at_current(nodes.potential, predictor), nodes.potential, 1 / nodes.dt),
            rhs=impulse - (1 - beta) * nodes.dt * nodes.potential.damping_force(v0) if viscous else impulse,
            projection=nodes.projection,
            prescribed=nodes.prescribed,
            preconditioner=self.preconditioner,
        )
        v, info = solve(problem, guess, Linearised(self.solver), self.adjoint_solver)
        return NodeMotion(v, resisted=(1 - beta) * v0 + beta * v if viscous else None), info

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(0) − βΔt² H v [kg m/s]."""
        action = self.hessian.at_current(nodes.potential, motion.velocity)
        return nodes.dt * nodes.force - self.beta * nodes.dt**2 * action(motion.velocity)


class BackwardEuler(eqx.Module):
    """Backward Euler: M (v^{n+1} − v^n) = Δt f(Δt v^{n+1}) + Δt M g (reference, eq. 2), by Newton's method.

    First order in time, strongly damping; no linearisation error, so it holds where one linear solve does not.

    *When it breaks*: where the incremental potential has several stationary points (steps that compress material to a
    fraction of itself make H indefinite), Newton finds one of them, not always the one a smaller step would lead to.

    Args:
        solution: `Newton()`, with its tolerances.
        hessian: how H acts. Default: by the analytic stress differential.
        preconditioner: of the linear solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves. Default: default tolerances.
        guess: where Newton starts.
    """

    solution: Newton = Newton()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    centred: ClassVar[bool] = False
    needs_force: ClassVar[bool] = True
    lagged: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)

    def move(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solve's report."""
        v, info = _Stage(nodes.inertial_velocity(), nodes.dt).solve(nodes, guess, self)
        return NodeMotion(v, resisted=v if nodes.potential.viscous else None), info

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(Δt v) [kg m/s]."""
        return nodes.dt * nodes.potential.force(nodes.dt * motion.velocity)


class ImplicitMidpoint(eqx.Module):
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
        solution: `Linearised()`, one linear solve, or `Newton()`.
        hessian: how H acts. Default: by the analytic stress differential.
        preconditioner: of the linear solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves. Default: default tolerances.
        guess: where the solve starts.
    """

    solution: Linearised | Newton = Linearised()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    centred: ClassVar[bool] = True
    needs_force: ClassVar[bool] = True
    lagged: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)

    def move(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solve's report."""
        v0, half = nodes.admitted_velocity(), nodes.dt / 2
        stage = _Stage(v0 + half * nodes.acceleration, half)
        mean, info = stage.solve(nodes, guess, self)
        return NodeMotion(2 * mean - v0, mean, resisted=mean if nodes.potential.viscous else None), info

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt f(½Δt v̄) [kg m/s]."""
        return nodes.dt * _force(nodes, self, (1, nodes.dt / 2 * motion.carrier))


class TRBDF2(eqx.Module):
    """A trapezoidal stage to γΔt, then a step with what is known at 0, γΔt and Δt: for y' = F(y),

        y_γ = y_0 + ½γΔt (F_0 + F_γ),    y_1 = y_0 + Δt (q_0 F_0 + q_1 F_γ + q_2 F_1).

    Second order in time, stable at every Δt, and a mode that Δt does not resolve is multiplied by ρ∞ in each step:
    with ρ∞ = 0, TR-BDF2, it is gone at once (L-stable); with 1 the method is two trapezoidal steps of Δt/2. γ and q are
    fixed by the order, by ρ∞ and by both stages having the same matrix, M + (½γΔt)²H: two solves a step, each of them
    easier than that of `ImplicitMidpoint`, ½γ being 0.29 (ρ∞ = 0) to 0.25.
    (R. E. Bank et al., IEEE Trans. CAD 4 (1985) 436, doi 10.1109/TCAD.1985.1270142; with ρ∞: G. Noh, K.-J. Bathe,
    Comput. Struct. 212 (2019) 299, doi 10.1016/j.compstruc.2018.11.001.)

    For motion to be followed in time in which unresolved frequencies would ring: contact, stiff starts.
    *When it breaks*: as `ImplicitMidpoint`.

    Args:
        rho: ρ∞, from 0 to 1.
        solution: `Linearised()`, one linear solve a stage, or `Newton()`.
        hessian: how H acts. Default: by the analytic stress differential.
        preconditioner: of the linear solves. Default: the diagonal of M + cH.
        adjoint_solver: of the tangent and adjoint solves. Default: default tolerances.
        guess: where the first stage's solve starts; the second's does where the first ended.
    """

    rho: Scalar = 0.0
    solution: Linearised | Newton = Linearised()
    hessian: AbstractHessian = AnalyticHessian()
    preconditioner: AbstractPreconditioner = DiagonalPreconditioner()
    adjoint_solver: lx.AbstractLinearSolver = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)
    centred: ClassVar[bool] = True
    needs_force: ClassVar[bool] = True
    lagged: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)
        require_between("TRBDF2's rho", self.rho, 0, 1)

    def weights(self) -> tuple[Scalar, Scalar, Scalar, Scalar]:
        """γ, q_0, q_1, q_2: γ solves (1 − ρ∞)γ² − 4γ + 2 = 0, q_2 = ½γ, q_1 = (½ − q_2)/γ, q_0 = 1 − q_1 − q_2."""
        gamma = 2 / (2 + jnp.sqrt(2 + 2 * jnp.asarray(self.rho)))
        q1 = (1 / gamma - 1) / 2
        return gamma, 1 - q1 - gamma / 2, q1, gamma / 2

    def move(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeMotion, SolveInfo]:
        """The nodes' motion and the solves' report."""
        _, q0, q1, q2 = self.weights()
        dt, g, v0 = nodes.dt, nodes.acceleration, nodes.admitted_velocity()
        c = q2 * dt  # = ½γΔt
        viscous = nodes.potential.viscous
        pull = nodes.per_mass(nodes.force - nodes.potential.damping_force(v0) if viscous else nodes.force)
        trapezoidal = _Stage(v0 + c * (pull + 2 * g), c, c * v0)
        middle, first = trapezoidal.solve(nodes, guess, self)
        later_pull = (middle - trapezoidal.inertial) / c  # f_γ/m, viscosity's with it, by the stage's own equation
        last = _Stage(v0 + dt * (q0 * pull + q1 * later_pull + g), c, dt * (q0 * v0 + q1 * middle))
        v, second = last.solve(nodes, middle, self)
        inner, mean = q2 * (v0 + middle), q0 * v0 + q1 * middle + q2 * v
        return NodeMotion(v, mean, inner, mean if viscous else None), first.together_with(second)

    def elastic_impulse(self, nodes: Nodes, motion: NodeMotion) -> NodeVector:
        """Δt (q_0 f_0 + q_1 f_γ + q_2 f_1) [kg m/s]."""
        _, q0, q1, q2 = self.weights()
        inner = motion.carrier if motion.inner is None else motion.inner
        stages = (q1, nodes.dt * inner), (q2, nodes.dt * motion.carrier)
        return nodes.dt * (q0 * nodes.force + _force(nodes, self, *stages))


Method = Explicit | SemiImplicit | BackwardEuler | ImplicitMidpoint | TRBDF2


def reporting(method: Method, slot: Scalar) -> Method:
    """The method with tangent and adjoint solves that report through a slot."""
    if isinstance(method, Explicit):
        return method
    return eqx.tree_at(lambda m: m.adjoint_solver, method, Reporting(method.adjoint_solver, slot))


def viscous_impulse(nodes: Nodes, motion: NodeMotion) -> NodeVector | None:
    """−Δt D v [kg m/s] of the velocity that it resisted, or what P2G knew of it; None without viscosity, and where P2G
    joined it to the elastic force."""
    if motion.resisted is not None:
        return -nodes.dt * nodes.potential.damping_force(motion.resisted)
    return None if nodes.viscous is None else jnp.where(nodes.occupied, nodes.dt * nodes.viscous, 0)


class _Stage(eqx.Module):
    """M (v − a) = c (f(u + c v) − D v)."""

    inertial: NodeVector
    """a [m/s]."""
    stage_dt: Float[Array, ""]
    """c [s]."""
    initial_displacement: NodeVector | None = None
    """u [m]; None for zero."""

    def solve(
        self, nodes: Nodes, guess: NodeVector, method: BackwardEuler | ImplicitMidpoint | TRBDF2
    ) -> tuple[NodeVector, SolveInfo]:
        """The velocity and the solve's report."""
        system = {
            "mass": nodes.mass,
            "projection": nodes.projection,
            "prescribed": nodes.prescribed,
            "preconditioner": method.preconditioner,
        }
        match method.solution:
            case Linearised():
                action = method.hessian.at_current(nodes.potential, guess)
                force = (
                    nodes.force
                    if self.initial_displacement is None
                    else nodes.force - action(self.initial_displacement)
                )
                problem = LinearProblem(
                    factor=self.stage_dt**2,
                    hessian=damped(action, nodes.potential, 1 / self.stage_dt),
                    rhs=nodes.mass[:, None] * self.inertial + self.stage_dt * force,
                    **system,
                )
            case Newton():
                problem = NewtonProblem(
                    inertial=self.inertial,
                    stage_dt=self.stage_dt,
                    initial_displacement=self.initial_displacement,
                    spacing=nodes.spacing,
                    potential=nodes.potential,
                    hessian=method.hessian,
                    **system,
                )
        return solve(problem, guess, method.solution, method.adjoint_solver)


def _force(nodes: Nodes, method: ImplicitMidpoint | TRBDF2, *stages: tuple[Scalar, NodeVector]) -> NodeVector:
    """Σ q f(u) [N], the elastic forces at nodal displacements u with their weights q, as the stages take them."""
    match method.solution:
        case Linearised():
            mean = reduce(jnp.add, (q * u for q, u in stages))
            return sum(q for q, _ in stages) * nodes.force - method.hessian.at_current(nodes.potential, mean)(mean)
        case Newton():
            return reduce(jnp.add, (q * nodes.potential.force(u) for q, u in stages))
