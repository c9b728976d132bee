"""One step, and the three ways to update the grid's velocity in it."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._checks import canonical, require_between, require_positive
from mpmjax._conjugate_residual import ConjugateResidual
from mpmjax._contact import (
    ActiveSet,
    ContactInfo,
    count_violations,
    find_active_set,
    held_images,
    holding,
    no_contact,
    touches,
    untouched,
    with_friction,
)
from mpmjax._guess import Guess
from mpmjax._hessian import AnalyticHessian, Hessian
from mpmjax._implicit import LinearProblem, Newton, NewtonProblem, SolveInfo, SolveOnce, no_solve, solve
from mpmjax._kernel import Stencil
from mpmjax._nodes import Nodes, particles_to_grid
from mpmjax._particles import Particles
from mpmjax._scene import Scene, is_prepared, prepare
from mpmjax._transfer import g2p
from mpmjax._types import Array, Int, Mask, NodeVector, Scalar, components, particle_first


class StepInfo(eqx.Module):
    """What one step reports."""

    solve: SolveInfo
    contact: ContactInfo
    outside: Int[Array, "*f"]
    """Particles whose stencil left the grid's window."""


class Explicit(eqx.Module):
    """Symplectic Euler: v^{n+1} = v* (reference, eq. 4); positions then move with v^{n+1}.

    Second order in space with APIC and FLIP, first order in time. Conserves linear and, with APIC, angular momentum.

    *When it breaks*: above Δt of about 0.4 to 1 times dx/c, depending on dimension, kernel and transfer
    (c the pressure-wave speed of the *current* tangent, which stretching and compression raise): see `stable_dt`.
    """

    def velocity(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """v^{n+1} and the solve's report."""
        del guess
        v = jnp.where(nodes.free, nodes.explicit_velocity(), nodes.conditions.velocity)
        return v, no_solve(v.dtype)

    def elastic_impulse(self, nodes: Nodes, v: NodeVector) -> NodeVector:
        """Δt f(0) [kg m/s], on nodes that have mass."""
        del v
        return jnp.where(nodes.occupied, nodes.dt * nodes.force, 0)

    def start(self, nodes: Nodes) -> NodeVector:
        """Nothing is iterated."""
        return nodes.velocity


class SemiImplicit(eqx.Module):
    """The semi-implicit update: (M + βΔt²H) v^{n+1} = M v*, force and H at the start of the step (reference, eqs. 3,
    6).

    First order in time. On a mode of frequency ω the amplification is (1 + βz)^(−½) with z = (ωΔt)² while
    z < 4/(1−β)²: stable for every Δt if β ≥ ½, else for z ≤ 4/(1−2β). β = 0 is the explicit step; β = 1 one Newton step
    of backward Euler. β = ½ is *not* the trapezoidal rule, positions moving with v^{n+1}: for β > 0 motion is damped,
    by a quarter in one period of a standing wave at the explicit limit. A method for slow, driven and overdamped
    motion.
    *When it breaks*: large strains within one step (the system is linearised once), and where compression makes H
    indefinite and Δt brings M + βΔt²H near singular: `AnalyticHessian(projected=True)` holds there.
    *Good values*: β = 1 with Δt up to some hundred times the explicit limit for quasi-static pulls.

    Args:
        beta: β, from 0 to 1.
        hessian: how H acts. Default: by the analytic stress differential.
        solver: conjugate residuals of the forward solve.
        adjoint_solver: of the tangent and adjoint solves, whose tolerance bounds the gradient's. Default: default
            tolerances.
        guess: where the solve starts.
    """

    beta: Scalar = 1.0
    hessian: Hessian = AnalyticHessian()
    solver: ConjugateResidual = ConjugateResidual()
    adjoint_solver: ConjugateResidual = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)

    def __check_init__(self):
        require_between("SemiImplicit's beta", self.beta, 0, 1)

    def velocity(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """v^{n+1} and the solve's report."""
        return solve(self._problem(nodes), guess, SolveOnce(self.solver), self.adjoint_solver)

    def _problem(self, nodes: Nodes) -> LinearProblem:
        predictor = nodes.explicit_velocity()
        return LinearProblem(
            mass=nodes.mass,
            factor=self.beta * nodes.dt**2,
            hessian=self.hessian.at_rest(nodes.potential, predictor),
            rhs=nodes.mass[:, None] * predictor,
            free=nodes.free,
            prescribed=nodes.conditions.velocity,
        )

    def elastic_impulse(self, nodes: Nodes, v: NodeVector) -> NodeVector:
        """Δt f(0) − βΔt² H v [kg m/s]."""
        action = self.hessian.at_rest(nodes.potential, v)
        return nodes.dt * nodes.force - self.beta * nodes.dt**2 * action(v)

    def start(self, nodes: Nodes) -> NodeVector:
        """The chosen guess."""
        return self.guess.velocity(nodes.velocity, nodes.explicit_velocity())


class BackwardEuler(eqx.Module):
    """Backward Euler: M (v^{n+1} − v^n) = Δt f(x^n + Δt v^{n+1}) + Δt M g (reference, eq. 2), by Newton's method.

    First order in time, strongly damping; no linearisation error, so it holds where one linear solve does not.

    *When it breaks*: where the incremental potential has several stationary points (steps that compress material to a
    fraction of itself make H indefinite), Newton finds one of them, not always the one a smaller step would lead to.

    Args:
        rtol: Newton's relative tolerance. Default: 1e-8 in float64, 1e-5 in float32.
        max_newton: most Newton steps.
        hessian: how H acts. Default: by the analytic stress differential.
        solver: conjugate residuals within a Newton step; a loose tolerance suffices.
        adjoint_solver: of the tangent and adjoint solves. Default: default tolerances.
        guess: where Newton starts.
    """

    rtol: Scalar | None = None
    max_newton: int = eqx.field(static=True, default=30)
    hessian: Hessian = AnalyticHessian()
    solver: ConjugateResidual = ConjugateResidual(rtol=1e-3)
    adjoint_solver: ConjugateResidual = ConjugateResidual()
    guess: Guess = eqx.field(static=True, default=Guess.GRID_VELOCITY)

    def __check_init__(self):
        if self.rtol is not None:
            require_positive("BackwardEuler's rtol", self.rtol)

    def velocity(self, nodes: Nodes, guess: NodeVector) -> tuple[NodeVector, SolveInfo]:
        """v^{n+1} and the solve's report."""
        newton = Newton(self.solver, self.rtol, self.max_newton)
        return solve(self._problem(nodes), guess, newton, self.adjoint_solver)

    def _problem(self, nodes: Nodes) -> NewtonProblem:
        return NewtonProblem(
            mass=nodes.mass,
            inertial=nodes.inertial_velocity(),
            dt=nodes.dt,
            spacing=nodes.spacing,
            potential=nodes.potential,
            hessian=self.hessian,
            free=nodes.free,
            prescribed=nodes.conditions.velocity,
        )

    def elastic_impulse(self, nodes: Nodes, v: NodeVector) -> NodeVector:
        """Δt f(Δt v) [kg m/s]."""
        return nodes.dt * nodes.potential.force(nodes.dt * v)

    def start(self, nodes: Nodes) -> NodeVector:
        """The chosen guess."""
        return self.guess.velocity(nodes.velocity, nodes.explicit_velocity())


Method = Explicit | SemiImplicit | BackwardEuler


class GridUpdate(eqx.Module):
    """The nodes' new velocity and where it came from."""

    before: NodeVector
    """v_i^n [m/s], shape (n, d), mirrored where a contact plane holds."""
    velocity: NodeVector
    """v_i^{n+1} [m/s], shape (n, d), mirrored likewise."""
    reaction: NodeVector
    """The impulse of walls and grips [kg m/s], shape (n, d); on free components what the solve left."""
    friction: NodeVector | None
    """The impulse of friction [kg m/s], shape (n, d), where there are walls that may be left."""
    free: Mask
    """The components in which no boundary had a part, shape (n, d)."""
    solve: SolveInfo
    contact: ContactInfo


def advance(
    scene: Scene, particles: Particles, t: Scalar, dt: Scalar, method: Method, stencil: Stencil | None = None
) -> tuple[Particles, StepInfo]:
    """One step, without checks or compilation: `step` is its public form.

    Args:
        scene: the scene, its floats arrays of the particles' dtype.
        particles: prepared particles.
        t: time at the start of the step [s].
        dt: step [s].
        method: update of the grid velocity.
        stencil: that of the reference positions, if the description is total and it was computed before.
    """
    stencil = scene.stencil(particles) if stencil is None else stencil
    nodes = particles_to_grid(scene, particles, t, dt, stencil)
    new = update(nodes, method)
    outside = (~stencil.inside).sum().astype(jnp.int32)
    return grid_to_particles(scene, particles, nodes, new), StepInfo(new.solve, new.contact, outside)


def update(nodes: Nodes, method: Method) -> GridUpdate:
    """The nodes' new velocity, boundaries and contact included."""
    with jax.named_scope("update"):
        if not touches(nodes):
            v, info = method.velocity(nodes, method.start(nodes))
            return GridUpdate(nodes.velocity, v, imbalance(nodes, method, v), None, nodes.free, info, no_contact())

        def with_held(nodes: Nodes, method: Method, active: ActiveSet, guess: NodeVector) -> tuple:
            v, info = method.velocity(holding(nodes, active), guess)
            v = held_images(nodes, active).unfold(v)
            return v, imbalance(nodes, method, v), info

        frozen = jax.lax.stop_gradient((nodes, method))
        guess = frozen[1].start(frozen[0])
        active, guess, cost, sweeps = find_active_set(frozen[0], guess, lambda a, v: with_held(*frozen, a, v))
        v, reaction, info = with_held(nodes, method, active, guess)
        violations = count_violations(nodes, active, v, reaction)
        slowed = with_friction(nodes, active, v, reaction)
        friction = nodes.mass[:, None] * (slowed - v)
        before = held_images(nodes, active).unfold(holding(nodes, active).velocity)
        contact = ContactInfo(sweeps, violations)
        return GridUpdate(before, slowed, reaction, friction, untouched(nodes, active), cost.plus(info), contact)


def imbalance(nodes: Nodes, method: Method, v: NodeVector) -> NodeVector:
    """The impulse [kg m/s] that is missing for nodes to move at v: that of walls and grips."""
    return nodes.mass[:, None] * (v - nodes.inertial_velocity()) - method.elastic_impulse(nodes, v)


def grid_to_particles(scene: Scene, particles: Particles, nodes: Nodes, new: GridUpdate) -> Particles:
    """G2P: the particles moved and deformed by the nodes' new velocity, x ← x + Δt Σ w v_i, F ← F + Δt Σ v_i hᵀ."""
    potential, dt = nodes.potential, nodes.dt
    before, after = potential.mirror.unfold(new.before), potential.mirror.unfold(new.velocity)
    with jax.named_scope("g2p"):
        moved, v, C = g2p(scene.transfer, potential.stencil, components(particles.v), before, after)
        F = potential.F + dt * potential.strain(new.velocity)
    return Particles(
        x=particle_first(components(particles.x) + dt * moved),
        v=particle_first(v),
        mass=particles.mass,
        volume=particles.volume,
        F=particle_first(F),
        C=None if C is None else particle_first(C),
        X=particles.X,
    )


def step(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    dt: Scalar,
    *,
    method: Method = Explicit(),
) -> tuple[Particles, StepInfo]:
    """One step of the Material Point Method, from t to t + dt.

    P2G, the grid velocity's update by `method`, G2P, x ← x + Δt Σ_i w_ip v_i, F ← F + Δt Σ_i v_i h_ipᵀ.

    Args:
        scene: the scene.
        particles: particles; what the scene needs and they lack is added (see `prepare`).
        t: time at the start of the step [s].
        dt: step [s].
        method: `Explicit()`, `SemiImplicit(...)` or `BackwardEuler(...)`.

    Returns:
        the particles after the step, and a `StepInfo`. Nothing is raised for what only the numbers show: `StepInfo`
        says whether the solve converged and whether particles left the window, and `simulate` acts on it.

    Raises:
        ValueError: from `prepare`, or a dt that is not positive.
    """
    require_positive("dt [s]", dt)
    scene, t, dt, method = canonical((scene, t, dt, method), particles.x.dtype)
    particles = particles if is_prepared(scene, particles) else prepare(scene, particles)
    return _step(scene, particles, t, dt, method)


@eqx.filter_jit
def _step(scene: Any, particles: Any, t: Any, dt: Any, method: Any) -> Any:
    return advance(scene, particles, t, dt, method)
