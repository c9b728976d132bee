"""Forces on boundaries: with gravity and body forces they are the change of momentum, linear and angular, in every
integrator and description; each boundary has its own part."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, LAWS, TRANSFERS, assert_close, block, explicit_limit, ids, slow, thorough
from test_body_force import Wind
from test_budget import BOUNDARIES as OF_BUDGETS, MOVED

import mpmjax as mpm

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12)),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Newton(TIGHT, 1e-12)),
}
BOUNDARIES = {name: boundary for name, boundary in OF_BUDGETS.items() if boundary} | {
    "walls and planes": (
        mpm.SymmetryPlane(0, 0.0),
        mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf)),
        mpm.SlipBox((-np.inf, -np.inf), (0.3, np.inf)),
    ),
    "a corner of contact": (
        mpm.SymmetryPlane(0, 0.0),
        mpm.ContactPlane(1, 0.0, friction=0.4),
        mpm.SeparatingBox((-1.0, -1.0), (0.2, 1.0), friction=0.2),
        mpm.StickyCollider(mpm.geometry.Capsule((0.0, 0.3), (0.1, 0.3), 0.06), MOVED),
    ),
    "between planes": (mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, 0.3, keep="below"), mpm.SymmetryPlane(1, 0.0)),
    "a clamp and a plane": (mpm.ClampPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0)),
}
WIND = Wind(jnp.ones(2), 3.0, 2.0)
HELD = ("walls", "planes", "grip", "walls and planes", "between planes", "a clamp and a plane")
"""What the total description knows."""


def shaken(dim=2, **scene):
    """A block that is shaken and strained, in a scene that computes the forces on its boundaries."""
    scene, particles = block(dim, gravity=(1.0, -9.81, 2.0)[:dim], boundary_forces=True, **scene)
    scene = mpm.attach(scene, particles)
    particles = mpm.prepare(scene, particles)
    rng = np.random.default_rng(3)
    strain = 0.05 * rng.normal(size=particles.F.shape)
    v = jnp.asarray(rng.normal(size=particles.v.shape))
    particles = dataclasses.replace(particles, v=v, deformations=(particles.F + strain,))
    if particles.C is None:
        return scene, particles
    return scene, dataclasses.replace(particles, C=jnp.asarray(rng.normal(size=particles.C.shape)))


def stepped(scene, particles, method, number=0.3):
    """The particles after a step, the step [s], and what the boundaries received."""
    dt = number * explicit_limit(scene)
    after, info = mpm.step(scene, particles, 0.0, dt, method=method)
    return after, dt, info.boundaries


def pulled(scene, particles, method, dt):
    """The impulses of gravity and body force on particles."""
    pull = np.broadcast_to(scene.gravity, particles.x.shape)
    if scene.body_force is not None:
        part = method.body_force_at
        pull = pull + scene.body_force.acceleration(particles.x + part * dt * particles.v, part * dt)
    return dt * np.asarray(particles.mass)[:, None] * np.asarray(pull)


def assert_sums_to_change(scene, particles, method):
    """The linear impulses are what gravity and body force give, minus the change of the particles' momentum."""
    after, dt, received = stepped(scene, particles, method)
    mass = np.asarray(particles.mass)
    lost = pulled(scene, particles, method, dt).sum(axis=0) - mass @ np.asarray(after.v - particles.v)
    assert received.impulse.shape == (len(scene.boundary), particles.dim)
    scale = np.abs(np.asarray(received.impulse)).max()
    np.testing.assert_allclose(received.impulse.sum(axis=0), lost, rtol=0, atol=1e-10 * scale)
    return received


RICH = ("colliders", "a corner of contact")


@pytest.mark.parametrize(
    ("held", "method"),
    [
        *((held, "explicit") for held in RICH),
        *thorough(*((held, "explicit") for held in BOUNDARIES if held not in RICH)),
        *thorough(*((held, "semi_implicit") for held in BOUNDARIES)),
        *thorough(*((held, "implicit_midpoint") for held in RICH)),
        *slow(*((held, "implicit_midpoint") for held in BOUNDARIES if held not in RICH)),
        *slow(*((held, name) for held in BOUNDARIES for name in ("backward_euler", "trbdf2"))),
    ],
)
def test_forces_on_boundaries_sum_to_the_change_of_momentum(held, method):
    """Every integrator, every kind of boundary, with a body force."""
    boundary = BOUNDARIES[held]
    received = assert_sums_to_change(*shaken(boundary=boundary, body_force=WIND), METHODS[method])
    assert (np.abs(np.asarray(received.impulse)).max(axis=1) > 0).sum() >= (len(boundary) + 1) // 2


OTHERS = [  # every transfer and description with every kind of boundary that both know, integrators in turn
    pytest.param(
        BOUNDARIES[held],
        TRANSFERS[transfer],
        DESCRIPTIONS[description],
        list(METHODS)[turn % len(METHODS)],
        id=f"{held}-{transfer}-{description}",
        # thorough: each boundary in each description, each of which meets each transfer
        marks=pytest.mark.slow if (turn // 6 + turn // 3 % 2 + turn) % 3 else pytest.mark.thorough,
    )
    for turn, (held, description, transfer) in enumerate(itertools.product(HELD, DESCRIPTIONS, TRANSFERS))
]


@pytest.mark.parametrize(("boundary", "transfer", "description", "method"), OTHERS)
def test_they_do_in_the_total_description_and_with_every_transfer(boundary, transfer, description, method):
    scene, particles = shaken(boundary=boundary, transfer=transfer, description=description)
    assert_sums_to_change(scene, particles, METHODS[method])


def angular_momentum(scene, particles):
    """Σ x × m v with that of the affine motion, about the origin, as a skew matrix."""
    C = np.asarray(particles.C) * np.asarray(scene.stencil(particles).moment).T[:, None, :]
    mass = np.asarray(particles.mass)[:, None, None]
    if scene.total:
        C = C @ np.asarray(particles.F).swapaxes(1, 2)
    x, v = np.asarray(particles.x), np.asarray(particles.v)
    both = (mass * (v[:, :, None] * x[:, None, :] + C)).sum(axis=0)
    return axial(both)


def axial(moment):
    """x × f from Σ f xᵀ."""
    d = len(moment)
    turn = moment - moment.T
    return np.array([turn[1, 0]]) if d == 2 else np.array([turn[2, 1], turn[0, 2], turn[1, 0]])


def torque_about_origin(scene, received, t=0.0):
    """The sum of the angular impulses, each brought from its boundary's pivot to the origin."""
    total = 0
    for boundary, impulse, angular in zip(scene.boundary, received.impulse, received.angular, strict=True):
        pivot = boundary.pivot(t)
        arm = 0 if pivot is None else axial(np.outer(np.asarray(impulse), np.asarray(pivot)))
        total = total + np.asarray(angular) + arm
    return total


@pytest.mark.parametrize("boundary", **ids(BOUNDARIES, ("colliders", "a corner of contact")))
def test_torques_on_boundaries_sum_to_the_change_of_angular_momentum(boundary):
    """With APIC, which loses none, in an explicit step, whose stresses have no moment."""
    scene, particles = shaken(boundary=boundary, body_force=WIND)
    after, dt, received = stepped(scene, particles, METHODS["explicit"])
    pull = pulled(scene, particles, METHODS["explicit"], dt)
    gained = angular_momentum(scene, after) - angular_momentum(scene, particles)
    given = axial((pull[:, :, None] * np.asarray(particles.x)[:, None, :]).sum(axis=0))
    scale = np.abs(np.asarray(received.impulse)).max() * 0.3
    np.testing.assert_allclose(torque_about_origin(scene, received), given - gained, rtol=0, atol=1e-10 * scale)


@pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
def test_what_a_collider_that_is_hit_receives_is_what_it_gives_the_faces(method):
    """At a symmetry plane that its normal is not along: the same as `StepInfo.colliders`."""
    slope = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.03), (0.3, 1.0)))
    scene, particles = shaken(boundary=(mpm.SymmetryPlane(0, 0.0), slope))
    _, info = mpm.step(scene, particles, 0.0, 0.3 * explicit_limit(scene), method=method)
    assert np.abs(np.asarray(info.boundaries.impulse[1])).min() > 0
    assert_close(info.boundaries.impulse[1:], info.colliders.impulse, 1e-12)
    assert_close(info.boundaries.angular[1:], info.colliders.angular, 1e-12)
    push = np.asarray(info.boundaries.impulse[1])
    assert push[0] == pytest.approx(0.3 * push[1], rel=1e-12)


@pytest.mark.parametrize("method", **ids(METHODS, (), ("explicit", "semi_implicit")))
def test_forces_and_torques_sum_in_three_dimensions(method):
    """Walls, a plane, a contact plane and a collider that turns; torques in an explicit step."""
    ball = mpm.RigidMotion((0.0, 1.0), ((0.0,) * 3, (0.4, 0.3, 0.2)), ((0.0,) * 3, (1.0, 3.0, 2.0)), (0.3, 0.3, 0.3))
    boundary = (
        mpm.SymmetryPlane(0, 0.0),
        mpm.StickyBox((-np.inf, -np.inf, 0.0), (np.inf,) * 3),
        mpm.ContactPlane(1, 0.0, friction=0.3),
        mpm.SeparatingCollider(mpm.Ball((0.3, 0.3, 0.3), 0.15), ball, friction=0.3),
    )
    scene, particles = shaken(3, boundary=boundary)
    assert_sums_to_change(scene, particles, method)
    if not isinstance(method, mpm.Explicit):
        return
    after, dt, received = stepped(scene, particles, method)
    weight = dt * np.asarray(particles.mass)[:, None] * np.asarray(scene.gravity)
    gained = angular_momentum(scene, after) - angular_momentum(scene, particles)
    gravity = axial((weight[:, :, None] * np.asarray(particles.x)[:, None, :]).sum(axis=0))
    assert_close(torque_about_origin(scene, received), gravity - gained, 1e-10)


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "updated"))
def test_each_plane_has_the_stress_of_what_it_bounds(description):
    """A block strained evenly between planes, at rest: each plane is pressed by the normal stress times its side's
    length, at its side's middle, to rounding."""
    side, planes = 0.3, (mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, 0.3, keep="below"), mpm.SymmetryPlane(1, 0.0))
    scene, particles = block(2, boundary=planes, boundary_forces=True, description=description)
    particles = mpm.prepare(scene, particles)
    F = jnp.diag(jnp.asarray([0.95, 1.0]))
    particles = dataclasses.replace(particles, deformations=(jnp.broadcast_to(F, particles.F.shape),))
    P = np.asarray(LAWS["fixed_corotated"].stress(F[..., None])[..., 0])
    stress = P if scene.total else P @ np.asarray(F).T  # on the sides of what the particles fill
    _, dt, received = stepped(scene, particles, mpm.Explicit(), 1e-3)
    force, torque = np.asarray(received.impulse / dt), np.asarray(received.angular / dt)[:, 0]
    expected = side * np.array([[stress[0, 0], 0], [-stress[0, 0], 0], [0, stress[1, 1]]])
    np.testing.assert_allclose(force, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    if not scene.total:  # where x is where F has moved it
        lever = np.array([-side / 2 * force[0, 0], -side / 2 * force[1, 0], side / 2 * force[2, 1]])
        assert_close(torque, lever, 1e-11)


def test_torques_in_the_total_description_are_about_the_moved_body():
    """A block that has been turned by a right angle hangs by the nodes of what was its lower end: force and torque are
    those of its weight and of the change of its momentum, where it is now."""
    boundary = (mpm.StickyBox((-np.inf, 0.1), (np.inf, np.inf)),)
    scene, particles = block(
        2, boundary=boundary, boundary_forces=True, description=mpm.TotalLagrangian(), gravity=(0.0, -9.81)
    )
    particles = mpm.prepare(scene, particles)
    turn = jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    deformations = (jnp.broadcast_to(turn, particles.F.shape),)
    particles = dataclasses.replace(particles, x=particles.X @ turn.T + 0.7, deformations=deformations)
    after, dt, received = stepped(scene, particles, mpm.Explicit())
    weight = dt * np.asarray(particles.mass)[:, None] * np.asarray(scene.gravity)
    change = angular_momentum(scene, after) - angular_momentum(scene, particles)
    gravity = axial((weight[:, :, None] * np.asarray(particles.x)[:, None, :]).sum(axis=0))
    assert_close(received.angular.sum(axis=0), gravity - change, 1e-9)


PRESSED = mpm.NeoHookean(1e5, 0.3)
SPEED, EDGE = 0.01, 0.1


def pressed(method, dt, steps=8):
    """A run of a cell pressed at a constant speed between a wall and a plate that starts with it, and the force on the
    plate as a function of time [N]: all nodes are held, so that it is exact."""
    grid = mpm.Grid((4, 4), EDGE, origin=(-1, -1))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (EDGE, EDGE)), grid, particles_per_cell=4, density=1e3)
    plate = mpm.StickyCollider(
        mpm.HalfSpace((0.0, EDGE), (0.0, -1.0)), mpm.Motion((0.0, 9.0), ((0.0, 0.0), (0.0, -9 * SPEED)))
    )
    walls = mpm.SlipBox((0.0, 0.0), (EDGE, np.inf))
    options = {"kernel": mpm.BSpline(1), "description": mpm.TotalLagrangian(), "boundary_forces": True}
    scene = mpm.Scene(grid, PRESSED, boundary=(walls, plate), **options)

    def force(t):
        stretch = 1 - SPEED * jnp.asarray(t) / EDGE
        F = jnp.stack([jnp.ones_like(stretch), 0 * stretch, 0 * stretch, stretch]).reshape(2, 2, -1)
        return -EDGE * PRESSED.stress(F)[1, 1]

    return mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=method, save_every=1), force


@pytest.mark.parametrize(
    ("method", "dt", "rtol"),
    [
        pytest.param(
            mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12)),
            0.1,
            1e-9,
            id="backward_euler",
            marks=pytest.mark.thorough,
        ),
        pytest.param(mpm.SemiImplicit(), 0.05, 1e-3, id="semi_implicit", marks=pytest.mark.thorough),
        pytest.param(mpm.SemiImplicit(0.5), 0.05, 1e-3, id="beta=0.5", marks=pytest.mark.thorough),
        pytest.param(mpm.Explicit(), 1e-3, 1e-9, id="explicit"),
        pytest.param(mpm.ImplicitMidpoint(), 0.05, 1e-3, id="midpoint", marks=pytest.mark.thorough),
        pytest.param(mpm.TRBDF2(), 0.05, 1e-3, id="trbdf2", marks=pytest.mark.thorough),
    ],
)
def test_a_force_stands_at_its_own_time(method, dt, rtol):
    """That of a plate that presses at a constant speed, as a collider's, as a boundary's and as an observation."""
    run, force = pressed(method, dt)
    of_plate, of_boundaries = run.forces(), run.boundary_forces()
    for times, found in ((of_plate.times, of_plate.force[:, 0]), (of_boundaries.times, of_boundaries.force[:, 1])):
        error = np.abs(found[1:, 1] - force(times[1:])).max()  # the first step sets all in motion
        assert error < rtol * float(force(times[-1])[0])
    at = np.array([3.0, 4.25, 7.9]) * dt
    seen = mpm.fitting.Force(at, np.stack([0 * at, force(at)], axis=1), boundary=1)
    assert_close(seen.predict(None, run), seen.data, 1e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("method", [METHODS["backward_euler"]])
def test_the_material_has_no_moment_at_the_time_of_its_force(method):
    """A strained block without inertia, held and turned at once: the torques on what holds it have no sum, wherever
    the step has moved it."""
    rest = mpm.Motion((0.0, 1.0), ((0.0, 0.0),) * 2)
    grips = (mpm.Grip(mpm.Box((-1.0, -1.0), (1.0, 0.1)), rest), mpm.Grip(mpm.Box((-1.0, 0.25), (1.0, 1.0)), MOVED))
    scene, particles = block(2, boundary=grips, boundary_forces=True)
    particles = mpm.prepare(scene, dataclasses.replace(particles, mass=1e-9 * particles.mass))
    _, dt, received = stepped(scene, particles, method, 3.0)
    np.testing.assert_allclose(received.impulse.sum(axis=0), 0, atol=1e-6 * np.abs(received.impulse).max())
    moment = torque_about_origin(scene, received, dt)
    assert np.abs(moment).max() < 1e-6 * np.abs(np.asarray(received.impulse)).max() * 0.3


@pytest.mark.thorough
def test_forces_on_boundaries_against_time(tmp_path):
    """As those on colliders: between frames, in observed runs, in files, resumed, in batches and with derivatives. A
    scene that does not ask for them has none."""
    wall, plane = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf)), mpm.SymmetryPlane(0, 0.0)
    scene, particles = block(2, boundary=(plane, wall), boundary_forces=True, gravity=(0.0, -9.81))
    settings = {"dt": 2e-3, "method": mpm.SemiImplicit(), "save_every": 5}
    run = mpm.simulate(scene, particles, t1=4e-2, **settings)
    times, force, torque = run.boundary_forces()
    assert times.shape == (4,)
    assert force.shape == (4, 2, 2)
    assert torque.shape == (4, 2, 1)
    gained = np.diff([mpm.momentum(run.frame(i)) for i in range(5)], axis=0) / 1e-2
    weight = float(particles.mass.sum()) * np.array([0.0, -9.81])
    assert_close(force.sum(axis=1), weight - gained, 1e-6)
    assert np.abs(force[:, 0, 1]).max() < 1e-12 * np.abs(force).max()  # a plane is frictionless
    saved, recorded = tmp_path / "saved.h5", tmp_path / "recorded.h5"
    mpm.save(saved, mpm.simulate(scene, particles, t1=2e-2, **settings))
    mpm.record(recorded, scene, particles, t1=2e-2, **settings)
    for path in (saved, recorded):
        mpm.record(path, scene, particles, t1=4e-2, resume=True, **settings)
        for a, b in zip(mpm.load(path).boundary_forces(), run.boundary_forces(), strict=True):
            assert np.array_equal(a, b)
    observed = mpm.simulate(scene, particles, t1=4e-2, observe=lambda scene, particles: particles.x[0, 0], **settings)
    assert_close(observed.boundary_forces().force, force, 1e-12)

    def pull(g):
        own = eqx.tree_at(lambda s: s.gravity, scene, (0.0, g))
        return mpm.simulate(own, particles, t1=1e-2, **settings).boundary_forces().force[0, 1, 1]

    fine = mpm.simulate(scene, particles, t1=1e-2, **settings | {"save_every": 1}).boundary_forces()
    seen = mpm.fitting.Force(fine.times, fine.force[:, 1], boundary=1)
    experiment = mpm.Experiment(scene, particles, t1=1e-2, dt=2e-3, method=mpm.SemiImplicit(), observations=seen)
    assert_close(experiment.predictions(experiment.run())[0], fine.force[:, 1], 1e-9)
    weights = jnp.asarray([-9.81, -9.8, -9.82])
    (value, above, below), slopes = jax.jit(jax.vmap(jax.value_and_grad(pull)))(weights)
    assert float(slopes[0]) == pytest.approx(float(above - below) / 0.02, rel=1e-5)
    assert_close(value, force[0, 1, 1], 1e-12)
    plain = mpm.Scene(scene.grid, scene.material, boundary=scene.boundary)
    with pytest.raises(ValueError, match="boundary_forces=True"):
        mpm.simulate(plain, particles, t1=1e-2, **settings).boundary_forces()
    with pytest.raises(ValueError, match="on which the scene computes no force"):
        mpm.Experiment(plain, particles, t1=1e-2, dt=2e-3, observations=seen)
    with pytest.raises(ValueError, match="needs a boundary at least"):
        mpm.Scene(scene.grid, scene.material, boundary_forces=True)
