"""Contact: walls that push but do not pull, and Coulomb friction."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, explicit_limit, ids
from numpy_oracle import grid_update

import mpmjax as mpm
from mpmjax._contact import SWEEPS

TIGHT = mpm.ConjugateResidual(rtol=1e-13)
METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit(solver=TIGHT)}
TIMES = {"explicit": 0.2, "semi_implicit": 2.0}  # of dx / c
DX, G = 0.1, 9.81


def on_a_floor(friction=0.0, angle=0.0, velocity=(0.0, 0.0), height=0.0, stiffness=1e5):
    """A block 4 x 2 cells on the floor y = 0, or above it, gravity tilted by an angle."""
    grid = mpm.Grid((40, 9), DX, origin=(-8, -3))
    block = mpm.fill(mpm.Box((0.0, height), (0.4, 0.2 + height)), grid, density=1e3, velocity=velocity)
    floor = mpm.SeparatingBox((-jnp.inf, 0.0), (jnp.inf, jnp.inf), friction=friction)
    law = mpm.FixedCorotated(stiffness, 0.3)
    return mpm.Scene(grid, law, gravity=(G * np.sin(angle), -G * np.cos(angle)), boundary=floor), block


def slid(name, steps, **case):
    """A run on the floor, with the mean velocity along it and away from it, and the lowest point, after each step."""
    scene, particles = on_a_floor(**case)
    dt = TIMES[name] * explicit_limit(scene)

    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=METHODS[name], observe=_watch)
    return run, dt


def _watch(scene, particles):
    del scene
    return jnp.concatenate([particles.v.mean(axis=0), particles.x.min(axis=0)])


@pytest.mark.parametrize("method", **ids(METHODS | {"backward_euler": mpm.BackwardEuler(rtol=1e-12, solver=TIGHT)}))
def test_a_wall_pushes_never_pulls_and_is_not_entered(method):
    """v·n ≥ 0, reaction ≥ 0, and their product is zero; the reactions are what changes the momentum."""
    scene, particles = on_a_floor(velocity=(0.3, -1.0))
    spin = 8.0 * jnp.stack([-particles.x[:, 1], particles.x[:, 0] - 0.2], axis=1)  # one end lifts off, the other lands
    particles = eqx.tree_at(lambda p: p.v, particles, particles.v + spin)
    dt = 0.5 * explicit_limit(scene)
    step = grid_update(scene, particles, dt, method)
    nodes, v, impulse = step.nodes, np.asarray(step.velocity), np.asarray(step.reaction)
    wall, occupied = np.asarray(nodes.conditions.side[:, 1]) == 1, np.asarray(nodes.mass) > 0
    held = wall & (v[:, 1] == 0) & occupied
    impulse = np.where(held[:, None] & [False, True], impulse, 0)
    assert int(step.info.contact.sweeps) <= SWEEPS
    assert int(step.info.contact.violations) == 0
    assert (v[wall & occupied, 1] == 0).any()
    assert (v[wall & occupied, 1] > 0.1).any()
    assert v[wall, 1].min() >= 0
    assert impulse[:, 1].min() >= 0
    assert impulse[:, 1].max() > 0
    assert (impulse[v[:, 1] > 0, 1] == 0).all()
    mass = np.asarray(particles.mass)
    change = mass @ np.asarray(step.particles.v - particles.v) - mass.sum() * dt * np.array([0, -G])
    assert_close(change, impulse.sum(axis=0), 1e-11)


@pytest.mark.parametrize("name", METHODS)
def test_a_wall_lets_go_freely(name):
    """A block that is pulled off the floor leaves as if there were none: no adhesion."""
    scene, particles = on_a_floor(velocity=(0.0, 0.5))
    run = {"steps": 20, "dt": TIMES[name] * explicit_limit(scene), "method": METHODS[name]}
    scene = eqx.tree_at(lambda s: s.gravity, scene, (0.0, 1.0))
    with_floor = mpm.rollout(scene, particles, **run)
    without = mpm.rollout(eqx.tree_at(lambda s: s.boundary[0].lower, scene, (-jnp.inf, -1e3)), particles, **run)
    for field in ("x", "v", "F", "C"):
        assert_close(getattr(with_floor, field), getattr(without, field), 1e-12)


@pytest.mark.parametrize("name", METHODS)
def test_a_block_rests_on_the_floor(name):
    """It carries its weight, does not sink and no condition is left violated."""
    run, dt = slid(name, 200)
    assert int(run.tally.violations) == 0
    assert int(run.tally.sweeps) <= SWEEPS * int(run.tally.steps)
    static = 1e3 * G * 0.2**2 / 2 / 1.35e5  # settling of the top under its own weight, uniaxial
    assert float(run.observed[:, 3].min()) > DX / 4 - 3 * static
    assert float(jnp.abs(run.observed[-1, 1])) < 0.02 * G * 200 * dt


@pytest.mark.parametrize("name", METHODS)
def test_a_block_bounces(name):
    """It comes back up, the slower the more the method damps, and nothing sticks."""
    run, _ = slid(name, 150, velocity=(0.0, -1.0), height=0.1)
    up = np.asarray(run.observed[:, 1])
    assert up.min() < -1.0
    assert up.max() > {"explicit": 0.5, "semi_implicit": 0.05}[name]
    assert float(run.observed[:, 3].min()) > 0
    assert int(run.tally.violations) == 0


@pytest.mark.parametrize("name", METHODS)
def test_a_sliding_block_decelerates_at_mu_g(name):
    """Δv_x = −μ (g t + Δv_y), exactly: while all of the foot slides, friction takes μ times the normal impulse."""
    mu, steps = 0.3, {"explicit": 100, "semi_implicit": 25}[name]
    run, dt = slid(name, steps, friction=mu, velocity=(3.0, 0.0))
    v = np.asarray(run.observed[:, :2])
    t = dt * np.arange(steps + 1)
    assert v[-1, 0] < 3.0 - 0.8 * mu * G * t[-1]
    assert_close(v[:, 0], 3.0 - mu * (G * t + v[:, 1]), 1e-9)


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize(("slope", "sticks"), [(0.25, True), (0.8, False)])
def test_a_block_sticks_below_the_angle_of_friction_and_slides_above(name, slope, sticks):
    """tan θ against μ = 0.4: the mean velocity stays at rest, or grows as g sin θ t − μ (g cos θ t + v_y)."""
    mu, steps, angle = 0.4, {"explicit": 200, "semi_implicit": 40}[name], np.arctan(slope)
    run, dt = slid(name, steps, friction=mu, angle=angle)
    t = dt * np.arange(steps + 1)
    v = np.asarray(run.observed[:, :2])
    drive = G * np.sin(angle) * t[-1]
    if sticks:
        assert np.abs(v[-steps // 4 :, 0].mean()) < 0.03 * drive
    else:
        sliding = G * np.sin(angle) * t - mu * (G * np.cos(angle) * t + v[:, 1])
        assert np.abs(v[:, 0] - sliding).max() < 0.02 * drive
