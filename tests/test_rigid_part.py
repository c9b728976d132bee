"""Rigid parts: one velocity for all of their nodes, that of their common momentum; exact in every solve."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, TRANSFERS, assert_close, block, ids, thorough
from test_boundary_forces import METHODS, assert_sums_to_change, shaken

import mpmjax as mpm

SIDE = 0.3
EVERYWHERE = {d: mpm.Box((-1.0,) * d, (1.0,) * d) for d in (2, 3)}
PUSH = {2: (30.0, -20.0), 3: (30.0, 10.0, -20.0)}


def above(height, d):
    """All of space above a height."""
    return mpm.Box((-1.0,) * (d - 1) + (height,), (1.0,) * d)


def floor(kind, d):
    """A wall below a body."""
    return kind((-np.inf,) * (d - 1) + (0.0,), (np.inf,) * d)


@pytest.mark.parametrize("d", [2, *thorough(3)])
@pytest.mark.parametrize("method", **ids(METHODS, ("explicit", "implicit_midpoint")))
def test_a_rigid_body_moves_as_its_force_over_its_mass(method, d):
    """Pushed off its middle, with particles that start at different velocities: at once the mean, then F/m."""
    push = mpm.PointLoad(mpm.PointsAt(((0.05,) * (d - 1) + (0.25,),)), PUSH[d])
    scene, particles = block(d, boundary=mpm.RigidPart(EVERYWHERE[d]), description=mpm.TotalLagrangian(), loads=push)
    scene, mass = mpm.attach(scene, particles), float(particles.mass.sum())
    v = jnp.asarray(np.random.default_rng(0).normal(size=particles.v.shape))
    particles = dataclasses.replace(particles, v=v)
    start, dt = np.asarray(mpm.momentum(particles)) / mass, 0.01
    for n in range(3):
        particles, info = mpm.step(scene, particles, n * dt, dt, method=method)
        assert info.solve.converged
    expected = start + 3 * dt * np.array(PUSH[d]) / mass
    assert_close(particles.v, jnp.broadcast_to(expected, v.shape), 1e-9)
    assert_close(particles.F, jnp.broadcast_to(jnp.eye(d), (particles.count, d, d)), 1e-9)


def weighed(load, d):
    """A block that a heavy plate, which may only move up and down, presses on a plane."""
    grid, side = mpm.Grid((9,) * (d - 1) + (13,), 0.1, origin=(-3,) * d), (SIDE,) * (d - 1)
    foam = mpm.fill(mpm.Box((0.0,) * d, (SIDE,) * d), grid, density=1e2)
    plate = mpm.fill(mpm.Box((0.0,) * (d - 1) + (SIDE,), (*side, 2 * SIDE)), grid, density=1e4)
    particles = dataclasses.replace(mpm.join(foam, plate), counts=None)
    boundary = (
        mpm.SymmetryPlane(d - 1, 0.0),
        *(mpm.SymmetryPlane(axis, 0.0) for axis in range(d - 1)),
        mpm.RigidPart(above(SIDE, d), (False,) * (d - 1) + (True,)),
    )
    top = mpm.PointLoad(mpm.PointsAt(((0.1,) * (d - 1) + (0.55,),)), (0.0,) * (d - 1) + (load,))
    scene = mpm.Scene(
        grid, mpm.NeoHookean(1e5, 0.2), boundary=boundary, loads=top, boundary_forces=True,
        gravity=(0.0,) * (d - 1) + (-9.81,), description=mpm.TotalLagrangian(),
    )  # fmt: skip
    scene = mpm.attach(scene, particles)
    return mpm.simulate(scene, particles, t1=3e2, dt=1e2, method=METHODS["backward_euler"], save_every=1), particles


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_a_plate_that_is_pushed_presses_with_its_weight_and_its_force(d):
    """At rest, after steps so long that nothing vibrates: the plane below has all of it, to the solver's tolerance; the
    plate has gone down, upright, as one."""
    run, particles = weighed(-500.0, d)
    force = np.asarray(run.boundary_forces().force)[-1]
    weight = 9.81 * float(particles.mass.sum())
    assert force[0, -1] == pytest.approx(-weight - 500.0, rel=1e-6)
    sunk = np.asarray(run.final.x - particles.x)[np.asarray(particles.x[:, -1]) > SIDE + 0.15]
    assert sunk[:, -1].max() < -1e-3
    assert np.ptp(sunk, axis=0).max() < 1e-9


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_the_sinking_of_a_plate_can_be_differentiated(d):
    """By the force on it, against central differences."""

    def sunk(load):
        return weighed(load, d)[0].final.x[-1, -1]

    (_, slope), (above, _), (below, _) = map(jax.value_and_grad(sunk), (-500.0, -499.0, -501.0))
    assert float(slope) == pytest.approx(float(above - below) / 2, rel=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize(("turn", "d"), [*((turn, 2) for turn in range(len(METHODS))), (0, 3), (4, 3)])
def test_forces_on_boundaries_and_rigid_parts_sum_to_the_change_of_momentum(turn, d):
    """Of a rigid part that may move freely they have no sum; every method, with the transfers in turn."""
    method, transfer = [*METHODS.values()][turn], [*TRANSFERS.values()][turn % len(TRANSFERS)]
    boundary = floor(mpm.StickyBox, d), mpm.RigidPart(above(0.15, d))
    scene, particles = shaken(d, boundary=boundary, description=mpm.TotalLagrangian(), transfer=transfer)
    received = np.asarray(assert_sums_to_change(scene, particles, method).impulse)
    assert np.abs(received[1]).max() < 1e-9 * np.abs(received[0]).max()


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("wall", [mpm.StickyBox, mpm.SlipBox])
def test_what_holds_a_node_of_a_rigid_part_holds_all_of_it(wall, d):
    """A body that is rigid and touches a wall with its lowest nodes does not move, and the wall has its weight; sliding
    along a plane it falls sideways as one."""
    boundary, gravity = (mpm.RigidPart(EVERYWHERE[d]), floor(wall, d)), np.array((1.0, 0.5, -9.81)[-d:])
    scene, particles = block(
        d, boundary=boundary, description=mpm.TotalLagrangian(), gravity=tuple(gravity), boundary_forces=True
    )
    after, info = mpm.step(scene, particles, 0.0, 0.01)
    along, slides = gravity * (np.arange(d) < d - 1), wall is mpm.SlipBox
    assert_close(after.v, jnp.broadcast_to(0.01 * slides * along, after.v.shape), 1e-12, 1e-14)
    force = np.asarray(info.boundaries.impulse[1]) / 0.01
    expected = float(particles.mass.sum()) * (gravity - slides * along)
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_the_budget_of_a_rigid_part_closes(d):
    """Energy and momentum of a shaken block, half of which is rigid."""
    part = mpm.RigidPart(above(0.15, d), (False,) * (d - 1) + (True,))
    scene, particles = shaken(d, boundary=part, description=mpm.TotalLagrangian())
    _, budget = mpm.budget(scene, particles, steps=3, dt=1e-3, method=METHODS["implicit_midpoint"])
    for terms, scale in ((budget.energy, budget.energy.kinetic), (budget.momentum, budget.momentum.change)):
        np.testing.assert_allclose(terms.change, terms.explained, rtol=0, atol=1e-9 * np.abs(scale).max())


def test_a_rigid_part_needs_the_total_description():
    with pytest.raises(ValueError, match="nodes that stay with the body: use the total description"):
        mpm.Scene(mpm.Grid((9, 9), 0.1), LAWS["fixed_corotated"], boundary=mpm.RigidPart(EVERYWHERE[2]))
