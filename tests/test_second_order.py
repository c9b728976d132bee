"""`ImplicitMidpoint` and `TRBDF2`: their steps, how they damp, what they conserve."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, VISCOUS, assert_close, block, explicit_limit, ids, thorough
from numpy_oracle import grid_update
from test_implicit import jolted

import mpmjax as mpm
from mpmjax._types import Array
from mpmjax.implicit import ImplicitOperator, Projection
from mpmjax.stepping import NodeMotion, reaction

SOLVER = mpm.implicit.ConjugateResidual(rtol=1e-14)
NEWTON = mpm.implicit.Newton(SOLVER, rtol=1e-13)
METHODS = {
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(SOLVER)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Linearised(SOLVER)),
    "trbdf2 with ρ∞ = 0.7": mpm.TRBDF2(0.7, mpm.implicit.Linearised(SOLVER)),
}
BY_NEWTON = {"implicit_midpoint": mpm.ImplicitMidpoint(NEWTON), "trbdf2": mpm.TRBDF2(0.0, NEWTON)}
GRIP = mpm.Grip(mpm.Box((-1.0, -1.0), (1.0, 0.05)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.4, -0.7))))


@eqx.filter_jit
def move(method, nodes):
    """The nodes' motion and the solves' report."""
    return method.advance(nodes, nodes.velocity)


def trapezoidal(A, y, h):
    """One trapezoidal step of y' = A y."""
    eye = np.eye(len(A))
    return np.linalg.solve(eye - h / 2 * A, y + h / 2 * A @ y)


def first_order_step(method, A, y, h):
    """One step of y' = A y by the method's definition for first-order systems."""
    if isinstance(method, mpm.ImplicitMidpoint):
        return trapezoidal(A, y, h)
    gamma, q0, q1, q2 = (float(a) for a in method.weights())
    inner = trapezoidal(A, y, gamma * h)
    return np.linalg.solve(np.eye(len(A)) - q2 * h * A, y + h * (q0 * A @ y + q1 * A @ inner))


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "updated"))
@pytest.mark.parametrize("method", **ids(METHODS, ("implicit_midpoint", "trbdf2")))
def test_a_step_is_that_of_the_first_order_system(method, description):
    """(u, v)' = (v, M⁻¹(f − H u) + g) of the nodes, with a grip that moves evenly, as dense matrices."""
    scene, particles = jolted(description=description, gravity=(1.0, -9.81), boundary=GRIP)
    dt = 3 * explicit_limit(scene)
    nodes = grid_update(scene, particles, dt, mpm.Explicit()).nodes
    motion, info = move(method, nodes)
    assert info.converged
    action = method.hessian.at(nodes.potential, None)
    everything = ImplicitOperator(0 * nodes.mass, jnp.asarray(1.0), action, Projection(jnp.ones_like(nodes.free)))
    H = np.asarray(eqx.filter_jit(ImplicitOperator.as_matrix)(everything))
    free = np.asarray(nodes.free).ravel()
    m = np.repeat(np.asarray(nodes.mass), 2)[free]
    held = np.asarray(nodes.conditions.velocity).ravel()
    pull = (np.asarray(nodes.force).ravel()[free]) / m + np.tile([1.0, -9.81], len(nodes.mass))[free]
    n = free.sum()
    A = np.zeros((2 * n + 2, 2 * n + 2))  # of u, v, time and one
    A[:n, n : 2 * n] = np.eye(n)
    A[n : 2 * n, :n] = -H[np.ix_(free, free)] / m[:, None]
    A[n : 2 * n, -2] = -(H[np.ix_(free, ~free)] @ held[~free]) / m
    A[n : 2 * n, -1] = pull
    A[-2, -1] = 1
    y = np.concatenate([np.zeros(n), np.asarray(nodes.velocity).ravel()[free], [0.0, 1.0]])
    expected = first_order_step(method, A, y, dt)
    assert_close(dt * np.asarray(motion.mean).ravel()[free], expected[:n], 1e-10)
    assert_close(np.asarray(motion.velocity).ravel()[free], expected[n : 2 * n], 1e-10)
    for v in (motion.velocity, motion.mean):
        np.testing.assert_allclose(np.asarray(v).ravel()[~free], held[~free], rtol=1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize("method", **ids(BY_NEWTON))
def test_newton_solves_the_stages_themselves(method):
    """M (v^{n+1} − v^n) = Δt Σ q f(u) + Δt M g on free components, at 3 dx/c of a block that is well strained: one
    linear solve misses it."""
    scene, particles = jolted(speed=3.0, gravity=(1.0, -9.81), boundary=GRIP)
    dt = 3 * explicit_limit(scene)
    nodes = grid_update(scene, particles, dt, mpm.Explicit()).nodes
    motion, info = move(method, nodes)
    assert info.converged
    assert info.newton > 2
    momentum = nodes.mass[:, None] * (motion.velocity - nodes.velocity)
    free = np.asarray(nodes.free)
    missed = np.asarray(reaction(nodes, motion, method.elastic_impulse(nodes, motion)))[free]
    assert np.abs(missed).max() < 1e-10 * np.abs(momentum).max()
    linearised = eqx.tree_at(lambda m: m.solution, method, mpm.implicit.Linearised(SOLVER))
    once, _ = move(linearised, nodes)
    missed = np.asarray(reaction(nodes, once, method.elastic_impulse(nodes, once)))[free]
    assert np.abs(missed).max() > 1e-3 * np.abs(momentum).max()


@pytest.mark.thorough
def test_an_unconverged_first_stage_is_reported():
    """By its own residual, from the stages' equations, though the second stage, which starts nearer, has converged."""
    scene, particles = jolted(speed=1.0, gravity=(1.0, -9.81))
    nodes = grid_update(scene, particles, 20 * explicit_limit(scene), mpm.Explicit()).nodes
    guess = 1e4 * nodes.explicit_velocity()

    @eqx.filter_jit
    def stages(rtol):
        """The report, and the relative residual of either stage."""
        solution = mpm.implicit.Linearised(mpm.implicit.ConjugateResidual(rtol=rtol, max_steps=25))
        method = mpm.TRBDF2(
            0.0, solution, preconditioner=mpm.implicit.MassPreconditioner()
        )  # whose norm is taken below
        motion, info = method.advance(nodes, guess)
        _, q0, q1, q2 = method.weights()
        dt, v0, v, g = nodes.dt, nodes.velocity, motion.velocity, nodes.acceleration
        middle, c, pull = motion.inner / q2 - v0, q2 * dt, nodes.per_mass(nodes.force)
        action = method.hessian.at(nodes.potential, None)
        a = v0 + c * (pull + 2 * g)
        b = v0 + dt * (q0 * pull + q1 * (middle - a) / c + g)

        def missed(v, inertial, u):
            known = nodes.mass[:, None] * inertial + c * (nodes.force - action(u))
            left = nodes.mass[:, None] * v + c**2 * action(v) - known
            norms = [jnp.sqrt((nodes.per_mass(r) * r).sum()) for r in (left, known)]
            return norms[0] / norms[1]

        return info, missed(middle, a, c * v0), missed(v, b, dt * (q0 * v0 + q1 * middle))

    info, first, second = stages(jnp.asarray(1e-14))
    assert first > 100 * second
    np.testing.assert_allclose(info.residual, first, rtol=1e-6)
    rtol = 10 * second
    info, first, second = stages(rtol)
    assert second <= 1.001 * rtol < first / 10
    np.testing.assert_allclose(info.residual, first, rtol=1e-6)
    assert not info.converged


@pytest.mark.thorough
def test_free_nodes_feel_nothing_but_force_gravity_and_viscosity():
    """M (v^{n+1} − v^n) = the elastic impulse + that of viscosity + Δt M g on them, so that what walls and grips give
    is nothing: viscosity resists the velocity with which each method says it does."""
    scene, particles = jolted(speed=3.0, material=VISCOUS["viscous_solid"], gravity=(1.0, -9.81), boundary=GRIP)
    nodes = grid_update(scene, particles, explicit_limit(jolted()[0]), mpm.SemiImplicit()).nodes
    free = np.asarray(nodes.free)
    for method in (mpm.SemiImplicit(0.6, solver=SOLVER), mpm.BackwardEuler(NEWTON), *METHODS.values()):
        motion, info = move(method, nodes)
        elastic = method.elastic_impulse(nodes, motion)
        viscous = -nodes.dt * nodes.potential.viscous_resistance(motion.resisted)
        each = elastic, reaction(nodes, motion, elastic), viscous
        elastic, missed, viscous = (np.asarray(a)[free] for a in each)
        assert info.converged
        assert np.abs(viscous).max() > 0.05 * np.abs(elastic).max()
        assert np.abs(missed).max() < 1e-10 * np.abs(viscous).max()


@pytest.mark.parametrize("rho", [0.0, 0.3, 1.0])
def test_weights_are_those_of_a_method_of_second_order(rho):
    """Σq = 1, q_1 γ + q_2 = ½, both stages with one matrix; |R(∞)| = |q_1 − q_0|/q_2 = ρ∞."""
    gamma, q0, q1, q2 = (float(a) for a in mpm.TRBDF2(rho).weights())
    np.testing.assert_allclose([q0 + q1 + q2, q1 * gamma + q2, 2 * q2 / gamma], [1, 0.5, 1], rtol=1e-15)
    np.testing.assert_allclose((q1 - q0) / q2, rho, atol=1e-15)
    if rho == 0:
        np.testing.assert_allclose([gamma, q0, q2], [2 - np.sqrt(2), np.sqrt(2) / 4, 1 - np.sqrt(0.5)], rtol=1e-15)


@pytest.mark.parametrize("bad", [-0.1, 1.1, np.nan])
def test_rho_must_lie_between_zero_and_one(bad):
    with pytest.raises(ValueError, match="TRBDF2's rho"):
        mpm.TRBDF2(bad)


@pytest.mark.thorough
def test_midpoint_by_newton_keeps_the_angular_momentum_of_the_nodes():
    """Σ m (x + Δt v̄) × v^{n+1} = Σ m x × v^n for a free body: the rule keeps quadratic invariants, and the potential
    knows no rotation of the nodes. To 1e-12 of momentum times half the block's side at 2 dx/c, where one linear solve
    misses it by more than 1e-3."""
    scene, particles = jolted(speed=2.0)
    dt = 2 * explicit_limit(scene)
    before = grid_update(scene, particles, dt, mpm.Explicit())
    nodes, x = before.nodes, np.asarray(before.position)

    def turn(x, v):
        return float((np.asarray(nodes.mass) * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0])).sum())

    def change(method):
        motion, _ = move(method, nodes)
        return turn(x + dt * np.asarray(motion.mean), np.asarray(motion.velocity)) - turn(x, np.asarray(nodes.velocity))

    size = float((np.asarray(nodes.mass) * np.linalg.norm(nodes.velocity, axis=1)).sum()) * 0.15
    assert abs(change(BY_NEWTON["implicit_midpoint"])) < 1e-12 * size
    assert abs(change(METHODS["implicit_midpoint"])) > 1e-3 * size


def test_a_motion_counts_half_of_what_slows_it():
    """Where positions move with the mean velocity; all of it where they move with the new one."""
    one = jnp.ones((3, 2))
    assert (mpm.Explicit().with_friction(NodeMotion(one), -one).carrier == 0).all()
    slowed = mpm.ImplicitMidpoint().with_friction(NodeMotion(one, one), -one)
    assert (slowed.carrier == 0.5).all()
    assert (slowed.velocity == 0).all()
    at_end = mpm.TRBDF2(0.3).with_friction(NodeMotion(one, one), -one)
    np.testing.assert_allclose(at_end.carrier, 1 - mpm.TRBDF2(0.3).weights()[3], rtol=1e-14)


class Kick(eqx.Module):
    """Contacts in an inner stage that change all velocities at its end."""

    by: Array

    def change(self, share):
        return None

    def friction(self, method, v, u, share):
        return self.by


@pytest.mark.parametrize("method", [METHODS["trbdf2"], METHODS["implicit_midpoint"], mpm.SemiImplicit(0.6, SOLVER)])
def test_free_nodes_feel_what_a_step_tells_of_viscosity_and_of_an_inner_stage(method):
    """Beside gravity and the elastic impulse. TR-BDF2 keeps a part of what rubs at its first stage."""
    scene, particles = block(1, side=2, gravity=(-9.81,), material=VISCOUS["viscous_solid"])
    particles = replace(particles, v=particles.x)
    nodes = grid_update(scene, particles, 3 * explicit_limit(block(1)[0]), mpm.Explicit()).nodes
    kick = jnp.where(nodes.occupied, jnp.linspace(0.2, 0.5, len(nodes.mass))[:, None], 0)

    @jax.jit
    def missing(nodes, kick):
        motion, _ = method.advance(replace(nodes, inner=Kick(kick)), nodes.velocity)
        kept = 0 * kick if motion.friction is None else motion.friction
        told = replace(motion, velocity=motion.velocity - kept)
        return kept, reaction(nodes, told, method.elastic_impulse(nodes, motion))

    kept, left = missing(nodes, kick)
    assert np.abs(left).max() < 1e-11 * float(nodes.mass.max())
    if isinstance(method, mpm.TRBDF2):
        assert_close(kept, method.weights()[2] / method.weights()[3] * kick, 1e-13)


FLOORS = {
    "wall": mpm.SeparatingBox((-np.inf, 0.0), (np.inf, np.inf), friction=0.15),
    "plane": mpm.ContactPlane(1, 0.0, friction=0.15),
    "collider": mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), friction=0.15),
}


@pytest.mark.parametrize("floor", thorough(*FLOORS))
def test_a_block_rests_below_the_limit_of_friction_and_slides_above(floor):
    """TR-BDF2 in steps of 7 dx/c, pushed by 0.12 and by 0.2 of its weight at μ = 0.15: creep in mm/s, and friction over
    weight. With friction after the last stage alone the first is 20."""
    grid = mpm.Grid((24, 12), 0.05, origin=(-4, -4))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.15)), grid, density=1e3)
    method, each = mpm.TRBDF2(), {"steps": 30, "dt": 0.01}

    def creep_and_friction(push):
        scene = mpm.Scene(grid, mpm.NeoHookean(1e6, 0.3), gravity=(push * 9.81, -9.81), boundary=FLOORS[floor])
        before = mpm.rollout(scene, mpm.prepare(scene, block), method=method, **each)
        after = mpm.rollout(scene, before, method=method, **each)
        moved, gained = (float((b - a)[:, 0].mean()) for a, b in ((before.x, after.x), (before.v, after.v)))
        return moved / 0.3 * 1e3, push - gained / 0.3 / 9.81

    assert abs(creep_and_friction(0.12)[0]) < 0.5
    assert creep_and_friction(0.2)[1] == pytest.approx(0.15, rel=1e-2)
