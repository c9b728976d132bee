"""Rigid bodies that move freely: Newton's and Euler's equations, what holds them, contact, derivatives, bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import TRANSFERS, assert_close, assert_files_hold, ids, thorough
from test_bodies import METHODS

import mpmjax as mpm
from mpmjax.extensions._rigid import RigidImage
from mpmjax.geometry import moment, rigid_body, spinning

RIGID = mpm.Rigid(1e6)


def thrown(d=2, *, spin=None, v=None, sides=None, cells=20, dx=0.1, seed=None, **scene):
    """A block of a rigid material that flies with a velocity and spins, in a window with room."""
    sides = (0.4, 0.3, 0.2)[:d] if sides is None else sides
    grid = mpm.Grid((cells,) * d, dx, origin=(-cells // 2,) * d)
    particles = mpm.fill(mpm.Box(tuple(-s / 2 for s in sides), tuple(s / 2 for s in sides)), grid, density=1e3)
    spin = jnp.asarray([3.0] if d == 2 else [1.0, 3.0, 0.5]) if spin is None else jnp.asarray(spin)
    v = jnp.zeros(d) if v is None else jnp.asarray(v)
    particles = dataclasses.replace(particles, v=v + spinning(spin, particles.x - particles.x.mean(axis=0)))
    return mpm.Scene(grid, RIGID, **scene), particles


def body_of(particles, rows=slice(None)):
    return rigid_body(particles.x[rows], particles.v[rows], particles.mass[rows], particles.volume[rows])


def spin_momentum(particles, rows=slice(None)):
    """Angular momentum about the origin."""
    body = body_of(particles, rows)
    return moment(body.centre[None], body.mass * body.velocity[None])[0] + body.inertia @ body.spin


@pytest.mark.parametrize("d", [2, 3])
def test_inertia_is_that_of_the_block(d):
    """M (a² + b²)/12 about each axis: the cells of the particles count."""
    _, particles = thrown(d)
    body, (a, b, *c) = body_of(particles), (0.4, 0.3, 0.2)[:d]
    if d == 2:
        expected = [[(a**2 + b**2) / 12]]
    else:
        expected = np.diag([b**2 + c[0] ** 2, a**2 + c[0] ** 2, a**2 + b**2]) / 12
    assert_close(body.inertia, float(body.mass) * np.asarray(expected))
    assert_close(body.root().T @ body.root() * body.mass, body.inertia)
    assert_close(body.spin, [3.0] if d == 2 else [1.0, 3.0, 0.5])


@pytest.mark.parametrize(
    ("method", "transfer"),
    [("explicit", "apic"), *thorough(("backward_euler", "pic"), ("implicit_midpoint", "flip"), ("trbdf2", "apic"))],
)
def test_a_block_that_is_thrown_moves_as_newton_and_euler_say(method, transfer):
    """In two dimensions exactly: the centre on its parabola of the integrator, the spin constant, the shape turned by
    ω t after more than ten turns."""
    method, transfer = METHODS[method], TRANSFERS[transfer]
    scene, particles = thrown(spin=[20.0], v=(0.08, 0.2), gravity=(0.0, -0.1), transfer=transfer)
    dt, steps = 4e-3, 1000
    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=method)
    body, t = body_of(run.final), steps * dt
    lag = dt / 2 * (0.0 if method.body_force_at else 1.0)
    assert_close(body.velocity, [0.08, 0.2 - 0.1 * t], 1e-9)
    assert_close(body.spin, [20.0], 1e-9)
    assert_close(body.centre, [0.08 * t, 0.2 * t - 0.05 * t * (t + 2 * lag)], 1e-9)
    c, s = np.cos(20 * t), np.sin(20 * t)
    R = np.array([[c, -s], [s, c]])
    assert_close(body.arms, np.asarray(particles.x) @ R.T, 0, 1e-9)
    assert_close(run.final.F, np.broadcast_to(R, (particles.count, 2, 2)), 0, 1e-9)


@pytest.mark.thorough
def test_a_block_that_tumbles_keeps_energy_and_angular_momentum():
    """In three dimensions, about no principal axis, to rounding; and its motion is of second order."""
    found = []
    for dt in (0.02, 0.01, 0.005):
        scene, particles = thrown(3)
        run = mpm.simulate(scene, particles, t1=4.0, dt=dt)
        start, end = body_of(particles), body_of(run.final)
        assert_close(end.inertia @ end.spin, start.inertia @ start.spin, 1e-11)
        assert float(end.spin @ end.inertia @ end.spin) == pytest.approx(
            float(start.spin @ start.inertia @ start.spin), rel=1e-11
        )
        assert_close(np.linalg.norm(end.arms, axis=1), np.linalg.norm(start.arms, axis=1), 1e-11)
        found.append(np.asarray(end.arms))
    ratio = np.linalg.norm(found[1] - found[0]) / np.linalg.norm(found[2] - found[1])
    assert 3.7 < ratio < 4.3


@pytest.mark.parametrize(
    ("d", "method"),
    [(2, "explicit"), *thorough((3, "explicit"), *((2, name) for name in METHODS if name != "explicit"))],
)
def test_a_torque_makes_it_turn(method, d):
    """ω = T t/I about a principal axis, and nothing else."""
    sides = (0.4, 0.3) if d == 2 else (0.4, 0.4, 0.2)
    scene, particles = thrown(d, spin=[0.0] if d == 2 else [0.0, 0.0, 0.0], sides=sides)
    at = [(0.15, 0.1), (-0.15, 0.1), (0.0, -0.1)] if d == 2 else [(0.15, 0.1, 0.0), (-0.15, 0.1, 0.0), (0.0, -0.1, 0.0)]
    torque = mpm.Couple(mpm.PointsAt(at), 5.0 if d == 2 else (0.0, 0.0, 5.0))
    scene = mpm.attach(mpm.Scene(scene.grid, RIGID, loads=torque), particles)
    run = mpm.simulate(scene, particles, t1=0.2, dt=0.01, method=METHODS[method])
    body = body_of(run.final)
    expected = 5.0 * 0.2 / float(body_of(particles).inertia[-1, -1])
    assert_close(body.spin, [expected] if d == 2 else [0, 0, expected], 1e-9, 1e-9)
    assert_close(body.velocity, np.zeros(d), 0, 1e-10)


def pressed(*, friction=0.3, d=2, offset=0.13, speed=1.0, **settings):
    """A rigid block that falls on an elastic one off its middle, sliding and spinning."""
    dx = 0.1
    grid = mpm.Grid((13, 11, 11)[:d], dx, origin=(-4,) * d)
    wide = mpm.Box((0.0,) * d, (0.5,) * (d - 1) + (0.2,))
    lower = mpm.fill(wide, grid, density=1e3)
    upper = mpm.fill(mpm.Box((0.0,) * (d - 1) + (0.2,), (0.3,) * (d - 1) + (0.4,)), grid, density=3e3)
    x = upper.x.at[:, 0].add(offset).at[:, -1].add(-0.005)
    v = upper.v.at[:, -1].set(-speed).at[:, 0].set(speed)
    particles = mpm.join(lower, dataclasses.replace(upper, x=x, v=v))
    scene = mpm.Scene(
        grid, (mpm.NeoHookean(1e4, 0.3), mpm.Rigid(1e6)), bodies=mpm.Bodies(friction), **settings
    )  # fmt: skip
    return scene, particles


@pytest.mark.parametrize(
    ("d", "method"), [(2, "explicit"), *thorough((2, "semi_implicit"), (3, "explicit"), (3, "trbdf2"))]
)
def test_what_falls_on_a_soft_block_keeps_momentum(method, d):
    """Linear, and in explicit steps angular, to rounding, while they push and rub; it starts to turn."""
    method = METHODS[method]
    scene, particles = pressed(d=d)
    dt = 5e-4 if method.is_explicit else 4e-3
    rows = slice(particles.sizes[0], None)

    def all_of(p):
        soft = slice(0, particles.sizes[0])
        x, v, C, m = p.x[soft], p.v[soft], p.C[soft], p.mass[soft]
        own = (C - jnp.swapaxes(C, 1, 2)) * 0.1**2 / 4
        turning = own[:, 1, 0, None] if d == 2 else jnp.stack([own[:, 2, 1], own[:, 0, 2], own[:, 1, 0]], axis=1)
        return (m[:, None] * (moment(x, v) + turning)).sum(axis=0) + spin_momentum(p, rows)

    first = new = mpm.prepare(scene, particles)
    for n in range(2):
        new, info = mpm.step(scene, new, n * dt, dt, method=method)
        assert info.solve.converged
        assert info.contact.violations == 0
    before, after = ((particles.mass[:, None] * p.v).sum(axis=0) for p in (first, new))
    assert_close(after, before, 1e-12 if method.is_explicit else 1e-8)
    if method.is_explicit:
        assert_close(all_of(new), all_of(first), 1e-11, 1e-13)
    change = body_of(new, rows).velocity - body_of(first, rows).velocity
    assert change[-1] > 1e-3
    assert change[0] < -1e-4
    assert np.abs(body_of(new, rows).spin).max() > 1e-3
    R = new.deformations[1][0]
    assert_close(new.x[rows] - new.x[rows].mean(axis=0), (first.x[rows] - first.x[rows].mean(axis=0)) @ R.T, 0, 1e-14)


def weighed(force=-50.0, density=2e3, *, method="semi_implicit", steps=40, plate=None, offset=0.0):
    """A rigid plate with a force on it, on a soft block that stands on a plane, between planes at its sides."""
    grid = mpm.Grid((12, 13), 0.1, origin=(-4, -3))
    foam = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.4)), grid, density=1e2)
    top = mpm.fill(mpm.Box((0.0, 0.4), (0.4, 0.6)), grid, density=1.0)
    top = dataclasses.replace(top, mass=top.mass * density)
    particles = mpm.join(foam, top)
    walls = mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, 0.4, keep="below"), mpm.SymmetryPlane(1, 0.0)
    load = mpm.PointLoad(mpm.PointsAt(((0.125 + offset, 0.575),)), (0.0, force))
    plate = mpm.Rigid(1e7) if plate is None else plate
    scene = mpm.Scene(
        grid, (mpm.NeoHookean(1e5, 0.0), plate), boundary=walls, loads=load, bodies=mpm.Bodies(), boundary_forces=True,
        gravity=(0.0, -9.81),
    )  # fmt: skip
    scene = eqx.tree_at(lambda s: s.loads, scene, mpm.attach(scene, mpm.join(foam, top)).loads)
    return mpm.simulate(scene, particles, t1=steps * 0.05, dt=0.05, method=METHODS[method], save_every=steps), particles


@pytest.mark.thorough
def test_a_plate_with_a_force_on_it_presses_with_its_weight_and_the_force():
    """At rest the plane below has the force, the plate's weight and the block's; the block's stress between is the
    force and weight over its width. The plate reaches the planes at its sides, which hold it upright."""
    run, particles = weighed()
    weight = 9.81 * float(particles.mass.sum())
    force = np.asarray(run.boundary_forces().force)[-1]
    assert force[2, 1] == pytest.approx(-weight - 50.0, rel=1e-6)
    law, F = mpm.NeoHookean(1e5, 0.0), jnp.moveaxis(run.final.deformations[0], 0, -1)
    stress = np.asarray(law.stress(F)[1, 1])  # per undeformed area
    plate_mass = float(particles.mass[len(stress) :].sum())
    foam_mass = float(particles.mass[: len(stress)].sum())
    expected = -(50.0 + 9.81 * (plate_mass + foam_mass / 2)) / 0.4
    assert stress.mean() == pytest.approx(expected, rel=0.03)  # the push acts at nodes, not where the faces are
    plate = np.asarray(run.final.x - particles.x)[len(stress) :]
    assert plate[:, 1].max() < -1e-3
    assert np.ptp(plate, axis=0).max() < 1e-12


@pytest.mark.parametrize(("d", "reach"), [(2, 0.6), pytest.param(3, 0.6, marks=pytest.mark.thorough), (2, 0.25)])
def test_a_grip_that_turns_carries_it_along(d, reach):
    """To where the motion takes it, though a grip's nodes move along chords, whether it holds all of it or an end."""
    scene, particles = thrown(d, spin=[0.0] * (1 if d == 2 else 3))
    corner = tuple(float(c) for c in np.asarray(particles.x).max(axis=0))
    region = mpm.Ball((0.0,) * d, reach) if reach > 0.5 else mpm.Ball(corner, reach)
    times, turned = (0.0, 1.0), (0.0, 2.0) if d == 2 else ((0.0, 0.0, 0.0), (0.3, 2.0, 0.0))
    motion = mpm.RigidMotion(times, ((0.0,) * d, (0.2,) + (0.0,) * (d - 1)), turned, (0.0,) * d)
    scene = mpm.Scene(scene.grid, RIGID, boundary=mpm.Grip(region, motion))
    run = mpm.simulate(scene, particles, t1=0.5, dt=0.05)
    assert_close(run.final.x, motion.place(particles.x, 0.5), 0, 1e-8)


def test_a_grip_that_turns_it_gets_its_angular_momentum():
    """By which it is turned from rest."""
    scene, particles = thrown(spin=[0.0])
    motion = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0), (0.0, 0.0)), (0.0, 2.0), (0.0, 0.0))
    grip = mpm.Grip(mpm.Ball((0.2, 0.1), 0.25), motion)
    scene = mpm.Scene(scene.grid, RIGID, boundary=grip, boundary_forces=True)
    new, info = mpm.step(scene, particles, 0.0, 0.05)
    assert_close(body_of(new).spin, [2.0], 1e-9)
    assert_close(info.boundaries.angular[0], -spin_momentum(new), 1e-9)


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.thorough)])
@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in ("explicit", "implicit_midpoint")}, "explicit"))
@pytest.mark.parametrize("wall", ["plane", "slip"])
def test_a_plane_or_a_wall_that_it_reaches_is_told_what_holds_it(wall, method, d):
    """It stops the spin of a body, which slides on upright. It gets the weight and the angular momentum."""
    scene, particles = thrown(d, v=(0.0, 0.1, 0.2)[:d], cells=14)
    particles = dataclasses.replace(particles, x=particles.x + jnp.array([0.23, 0.03, 0.01])[:d])
    held = mpm.SymmetryPlane(0, 0.0) if wall == "plane" else mpm.SlipBox((0.0,) + (-np.inf,) * (d - 1), (np.inf,) * d)
    gravity = jnp.array([-2.0, -1.0, -0.5])[:d]
    scene = mpm.Scene(scene.grid, RIGID, gravity=gravity, boundary=held, boundary_forces=True)
    new, info = mpm.step(scene, particles, 0.0, 0.01, method=method)
    given, weight, before = info.boundaries, 0.01 * particles.mass.sum() * gravity, body_of(particles)
    normal = jnp.eye(d)[0]
    assert_close(given.impulse[0], normal * weight, 1e-9)
    assert_close(body_of(new).velocity, (1 - normal) * (before.velocity + 0.01 * gravity), 1e-12)
    about = before.centre if method == METHODS["explicit"] else (before.centre + body_of(new).centre) / 2
    assert scene.boundary[0].pivot(0.0) is None, "torques are about the origin"
    turned = spin_momentum(particles) - spin_momentum(new) + moment(about[None], weight[None])[0]
    assert_close(given.angular[0], turned, 1e-9)


def test_guides_hold_it():
    """It falls sideways alone, upright, where it may do nothing else."""
    scene, particles = thrown(spin=[3.0], v=(0.1, 0.2))
    scene = mpm.Scene(scene.grid, mpm.Rigid(1e6, (True, False), turns=False), gravity=(1.0, -1.0))
    particles, _ = mpm.step(scene, particles, 0.0, 0.01)
    assert_close(particles.v, np.broadcast_to([0.11, 0.0], particles.v.shape))
    assert_close(particles.F, np.broadcast_to(np.eye(2), particles.F.shape))


@pytest.mark.parametrize(
    ("free", "turns", "held", "name"),
    [
        ((True, False), False, False, "explicit"),
        *thorough(
            ((True, False), True, False, "implicit_midpoint"),
            ((True, False), False, True, "semi_implicit"),
            ((False, True, True), False, False, "explicit"),
            ((False, True, False), True, False, "semi_implicit"),
            (None, False, False, "implicit_midpoint"),
        ),
    ],
)
def test_guides_are_told_what_they_hold(free, turns, held, name):
    """With gravity and what a wall holds, force and torque on them are what is lost of both momenta."""
    d = 2 if free is None else len(free)
    forbidden = ~np.asarray(free or (True,) * d)
    v = jnp.array([0.2, 0.1, -0.3])[:d]
    if name == "implicit_midpoint":  # in which what is stopped stops before the step
        v = jnp.where(forbidden, 0, v)
    scene, particles = thrown(d, v=v, cells=14)
    particles = dataclasses.replace(particles, x=particles.x + jnp.array([0.03, 0.23, 0.01])[:d])
    wall = mpm.SlipBox((-np.inf, 0.0, -np.inf)[:d], (np.inf,) * d) if held else ()
    gravity = jnp.array([-2.0, -1.0, -0.5])[:d]
    law = mpm.Rigid(1e6, free, turns)
    scene = mpm.Scene(scene.grid, law, gravity=gravity, boundary=wall, boundary_forces=True)
    new, info = mpm.step(scene, particles, 0.0, 0.01, method=METHODS[name])
    weight, before, after = 0.01 * particles.mass.sum() * gravity, body_of(particles), body_of(new)
    assert info.boundaries.impulse.shape == (1 + held, d)
    lost = before.mass * (before.velocity - after.velocity) + weight
    late, moved = METHODS[name].force_at() or 0.0, after.centre - before.centre  # the share of the step of its forces
    turned = spin_momentum(particles) - spin_momentum(new)
    turned = turned + moment((before.centre + late * moved)[None], weight[None])[0]
    carried = before.mass * ((1 - late) * after.velocity + late * before.velocity)  # along `moved` unless θ = 1
    turned = turned + moment(moved[None], carried[None])[0]
    scale = 0.1 * float(before.mass)
    assert_close(info.boundaries.impulse.sum(axis=0), lost, 0, 1e-9 * scale)
    assert_close(info.boundaries.angular.sum(axis=0), turned, 0, 1e-9 * scale)
    along = np.asarray(info.boundaries.impulse[-1])
    assert (np.abs(along[forbidden]) > 0.04 * scale).all()
    assert (np.abs(along[~forbidden]) < 1e-9 * scale).all()


def test_a_collider_beside_guides_gets_its_own_force():
    """As a collider and as a boundary; the guides get what else there is."""
    scene, particles = thrown(v=(0.0, -1.0), cells=14)
    floor = mpm.SeparatingCollider(mpm.HalfSpace((0.0, -0.155), (0.1, 1.0)), friction=0.4)
    scene = mpm.Scene(scene.grid, mpm.Rigid(1e5, (False, True), turns=False), boundary=floor, boundary_forces=True)
    for n in range(16):
        particles, info = mpm.step(scene, particles, n * 1e-3, 1e-3)
    assert info.boundaries.impulse[0, 1] < -1e-3 * float(particles.mass.sum())
    assert_close(info.colliders.impulse, info.boundaries.impulse[:1], 1e-12)
    assert_close(info.colliders.angular, info.boundaries.angular[:1], 1e-12)


@pytest.mark.thorough
def test_in_one_dimension_it_only_moves():
    """There is nothing to turn."""
    scene, particles = thrown(1, v=(0.1,), gravity=(-1.0,))
    particles, _ = mpm.step(scene, particles, 0.0, 0.01)
    assert_close(particles.v, np.full(particles.v.shape, 0.09))


@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in ("explicit", "implicit_midpoint")}, "explicit"))
def test_what_falls_on_a_floor_gets_its_force(method):
    """The change of momentum is that by gravity and the floor's push and friction; a spinning block is driven along by
    the floor against its spin, until it rolls."""
    scene, particles = thrown(spin=[-4.0], v=(0.0, -1.0), cells=14)
    floor = mpm.SeparatingBox((-np.inf, -0.155), (np.inf, np.inf), friction=0.4)
    scene = mpm.Scene(scene.grid, mpm.Rigid(1e5), gravity=(0.0, -9.81), boundary=floor, boundary_forces=True)
    new, impulse, dt = particles, 0.0, 1e-3
    steps = 16 if method.is_explicit else 7  # whose contact is stiffer
    for n in range(steps):
        new, info = mpm.step(scene, new, n * dt, dt, method=method)
        impulse = impulse + np.asarray(info.boundaries.impulse[0])
    mass = float(particles.mass.sum())
    change = np.asarray((particles.mass[:, None] * (new.v - particles.v)).sum(axis=0))
    assert_close(change, -impulse + steps * dt * mass * np.array([0.0, -9.81]), 1e-9)
    assert -impulse[1] > 0.1 * mass
    assert -impulse[0] > 0.01 * mass
    assert_close(new.x[0] - new.x[-1], new.F[0] @ (particles.x[0] - particles.x[-1]), 1e-12)


def test_compiled_the_nodes_of_a_body_that_rubs_move_as_they_do_uncompiled():
    """XLA may write a layer's nodes over the two from which it computes them, before it has read them for all."""
    draw = np.random.default_rng(1).normal
    field, normal, arms = (
        jnp.asarray(draw(size=(162, 2))),
        jnp.asarray(draw(size=(81, 2))),
        jnp.asarray(draw(size=(81, 2))),
    )
    image = RigidImage(layer=0, layers=2, arms=arms, per_root=jnp.ones((1, 1)))

    def rub(field):
        layers = image.vector(2 * field).reshape(2, 81, 2)
        slip = layers[0] - layers[1]
        slip = slip - normal * (normal * slip).sum(axis=1, keepdims=True)
        return jnp.zeros_like(layers).at[0].set(slip).at[1].set(-slip)

    with jax.disable_jit():
        plain = rub(field)
    assert_close(jax.jit(rub)(field), plain, 1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in ("explicit", "semi_implicit")}, "explicit"))
def test_derivatives_of_its_motion_are_those_of_differences(method):
    """By its mass, the forces on it, friction and the stiffness of what it falls on."""
    scene, particles = pressed()
    at = mpm.PointsAt(((0.205, 0.22), (0.405, 0.37)))
    loads = mpm.PointLoad(at, (30.0, -50.0)), mpm.Couple(at, 10.0)
    scene = mpm.Scene(scene.grid, scene.material, bodies=scene.bodies, loads=loads)
    scene, dt = mpm.attach(scene, particles), 5e-4 if method.is_explicit else 4e-3

    def end(numbers):
        heavier, pushed, turned, friction, stiffer = numbers
        own = eqx.tree_at(lambda s: s.loads[0].total, scene, (30.0 * pushed, -50.0 * pushed))
        own = eqx.tree_at(lambda s: s.loads[1].total, own, 10.0 * turned)
        own = eqx.tree_at(lambda s: s.bodies.friction, own, friction)
        own = eqx.tree_at(lambda s: s.material[0].youngs_modulus, own, 1e4 * stiffer)
        mass = particles.mass.at[particles.sizes[0] :].multiply(heavier)
        new = mpm.rollout(own, dataclasses.replace(particles, mass=mass), steps=3, dt=dt, method=method)
        return (new.x * jnp.sin(jnp.arange(new.x.size)).reshape(new.x.shape)).sum() + (new.v**2).sum()

    both, point, h = jax.jit(jax.value_and_grad(end)), jnp.array([1.0, 1.0, 1.0, 0.1, 1.0]), 1e-4
    differences = [(both(point.at[k].add(h))[0] - both(point.at[k].add(-h))[0]) / (2 * h) for k in range(len(point))]
    assert np.abs(np.asarray(differences)).min() > 1e-7
    for one, other in zip(both(point)[1], differences, strict=True):
        assert_close(one, other, 2e-5)


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_single_precision_stays_single(d):
    """And keeps momentum to its rounding, while bodies push and rub."""
    scene, particles = pressed(d=d)
    new = particles = jax.tree.map(lambda a: a.astype(jnp.float32), particles)
    for n in range(3):
        new, _ = mpm.step(scene, new, n * 5e-4, 5e-4)
    assert {str(leaf.dtype) for leaf in jax.tree.leaves(new)} == {"float32"}
    change = (particles.mass[:, None] * (new.v - particles.v)).sum(axis=0)
    assert_close(change, jnp.zeros(d), 0, 1e-6 * float((particles.mass[:, None] * abs(particles.v)).sum()))
    upper = slice(particles.sizes[0], None)
    assert np.abs(np.asarray(new.v - particles.v)[upper]).max() > 1e-4


def test_its_energy_is_that_of_a_rigid_body():
    """½ M V² + ½ ω·Iω, with no part of the grid's, also before the first step and of a transfer without C."""
    scene, particles = thrown(3, v=(0.1, 0.2, 0.3))
    body = body_of(particles)
    new, _ = mpm.step(scene, particles, 0.0, 1e-9)
    expected = body.mass * (body.velocity**2).sum() / 2 + body.spin @ body.inertia @ body.spin / 2
    assert float(mpm.energy(scene, new).kinetic) == pytest.approx(float(expected), rel=1e-8)
    for transfer in (mpm.APIC(), mpm.FLIP()):
        at_start = mpm.energy(mpm.Scene(scene.grid, RIGID, transfer=transfer), particles)
        assert float(at_start.kinetic) == pytest.approx(float(expected), rel=1e-12)


@pytest.mark.thorough
def test_a_run_comes_back_from_its_file(tmp_path):
    scene, particles = pressed()
    at = mpm.PointsAt(((0.205, 0.22), (0.405, 0.37)))
    material = scene.material[0], mpm.Rigid(1e6, free=(True, True), turns=False)
    scene = mpm.Scene(scene.grid, material, bodies=scene.bodies, loads=mpm.Couple(at, 10.0))
    assert_files_hold(tmp_path / "run.h5", mpm.simulate(mpm.attach(scene, particles), particles, t1=1e-3, dt=5e-4))


SOFT = mpm.NeoHookean(1e4, 0.3)
GRID = mpm.Grid((9, 9), 0.1)
BAD = {
    "no modulus": (lambda: mpm.Rigid(0.0), "modulus"),
    "other directions": (lambda: mpm.Scene(GRID, mpm.Rigid(1e6, (True, True, False))), "must be 2 bools"),
    "nodes that it shares": (lambda: mpm.Scene(GRID, (SOFT, RIGID)), "one material alone"),
    "a body that it shares": (
        lambda: mpm.Scene(GRID, (SOFT, RIGID, SOFT), bodies=mpm.Bodies(0.0, (0, 1, 1))),
        "one material alone",
    ),
    "the total description": (lambda: mpm.Scene(GRID, RIGID, description=mpm.TotalLagrangian()), "RigidPart"),
    "a contact plane": (lambda: mpm.Scene(GRID, RIGID, boundary=mpm.ContactPlane(0, 0.1)), "SeparatingBox"),
    "a plane that moves": (
        lambda: mpm.Scene(
            GRID, RIGID, boundary=mpm.SymmetryPlane(0, 0.1, motion=mpm.Motion((0.0, 1.0), ((0.0, 0.0), (1.0, 0.0))))
        ),
        "plane at rest",
    ),
    "a couple in one dimension": (
        lambda: mpm.Scene(mpm.Grid((9,), 0.1), SOFT, loads=mpm.Couple(mpm.PointsAt(((0.1,), (0.2,))), 1.0)),
        "two or three dimensions",
    ),
    "a couple of another dimension": (
        lambda: mpm.Scene(GRID, SOFT, loads=mpm.Couple(mpm.PointsAt(((0.1, 0.1), (0.2, 0.1))), (1.0, 2.0, 3.0))),
        "a number in 2-D",
    ),
    "one particle": (
        lambda: mpm.prepare(
            mpm.Scene(GRID, RIGID), mpm.Particles(*map(jnp.asarray, ([[0.4, 0.4]], [[0.0, 0.0]], [1.0], [1e-3])))
        ),
        "at one point",
    ),
    "a viscosity": (lambda: mpm.Viscous(RIGID, 1.0), "nothing that flows"),
    "a budget": (lambda: mpm.budget(*thrown(), steps=1, dt=1e-3), "how a Rigid body moves"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rigid_bodies_are_refused(case):
    make, words = BAD[case]
    with pytest.raises(ValueError, match=words):
        make()
