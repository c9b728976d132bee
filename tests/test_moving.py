"""Grips that turn, and planes of symmetry that move."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, LAWS, TRANSFERS, assert_close, block, explicit_limit, ids, slow, thorough
from test_boundary_forces import METHODS, assert_sums_to_change, shaken

import mpmjax as mpm

SIDE = 0.3
TURN = mpm.RigidMotion((0.0, 0.1), ((0.0, 0.0), (0.02, 0.01)), (0.0, 0.8), (0.1, 0.3))
TURN_3D = mpm.RigidMotion((0.0, 0.1), ((0.0,) * 3, (0.02, 0.01, 0.0)), ((0.0,) * 3, (0.1, 0.3, 0.8)), (0.1, 0.3, 0.2))


@pytest.mark.thorough
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "total"))
@pytest.mark.parametrize("motion", **ids({"2d": TURN, "3d": TURN_3D}, "2d"))
def test_a_grip_that_turns_holds_as_a_sticky_body_does(motion, description):
    """In motion, force and torque; its particles follow the circle exactly."""
    d = motion.dim
    region = mpm.Box((-1.0,) * (d - 1) + (0.15,), (1.0,) * d)
    ends = []
    for holder in (mpm.Grip(region, motion), mpm.StickyCollider(region, motion)):
        scene, particles = block(d, boundary=holder, boundary_forces=True, description=description)
        run = mpm.simulate(scene, particles, t1=0.01, dt=1e-3, save_every=5)
        ends.append((run.final.x, run.final.v, *run.boundary_forces()[1:]))
    for a, b in zip(*ends, strict=True):
        assert_close(a, b, 1e-12, 1e-9)
    deep = np.asarray(particles.x[:, -1]) > 0.25  # where every node is held
    assert_close(ends[0][0][deep], motion.place(particles.x, 0.01)[deep], 1e-4 if not scene.total else 1e-6)


def up(d, way, *, time=1.0, sideways=0.0):
    """An even motion along the last axis, in a time, and along all others."""
    return mpm.Motion((0.0, time), ((0.0,) * d, (sideways,) * (d - 1) + (way,)))


def wall_and_body(kind, d):
    """A wall above which a body is, and the grip or collider that it is."""
    way, low, high = up(d, 0.6, sideways=0.3), (-np.inf,) * (d - 1) + (0.1,), (np.inf,) * d
    if kind == "sticky":
        return mpm.StickyBox(low, high, way), mpm.Grip(mpm.Box((-9.0,) * d, (9.0,) * (d - 1) + (0.1,)), way)
    space = mpm.HalfSpace((0.0,) * (d - 1) + (0.1,), (0.0,) * (d - 1) + (1.0,))
    return mpm.SlipBox(low, high, way), mpm.SlipCollider(space, way)


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("description", DESCRIPTIONS.values(), ids=DESCRIPTIONS)
@pytest.mark.parametrize("kind", ["sticky", "slip"])
def test_walls_that_move_are_grips_or_colliders_of_a_half_space(kind, description, d):
    """In motion and force, over steps in which the wall passes a node."""
    ends = []
    for wall in wall_and_body(kind, d):
        scene, particles = block(d, boundary=wall, boundary_forces=True, description=description)
        particles = dataclasses.replace(particles, v=particles.v.at[:, -1].add(0.6))
        run = mpm.simulate(scene, particles, t1=0.2, dt=2e-3, save_every=20)
        ends.append((run.final.x, run.final.v, run.boundary_forces().force))
    for a, b in zip(*ends, strict=True):
        assert_close(a, b, 1e-9)


PLANES = {d: mpm.SymmetryPlane(d - 1, 0.0, motion=up(d, 0.6)) for d in (2, 3)}
MOVING = {
    "explicit": (mpm.Explicit(), mpm.APIC()),
    "flip": (mpm.Explicit(), mpm.FLIP(0.95)),
    "semi_implicit": (METHODS["semi_implicit"], mpm.APIC()),
    "backward_euler": (METHODS["backward_euler"], mpm.PIC()),
    "implicit_midpoint": (METHODS["implicit_midpoint"], mpm.APIC()),
    "trbdf2": (METHODS["trbdf2"], mpm.FLIP(0.95)),
}


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
@pytest.mark.parametrize(
    ("name", "d"),
    [
        ("explicit", 2),
        *thorough(*((name, 2) for name in MOVING if name != "explicit"), ("flip", 3)),
        *slow(("trbdf2", 3)),
    ],
)
def test_a_plane_that_moves_is_one_at_rest_seen_by_somebody_who_moves(name, d, description):
    """A shaken block on a plane that moves evenly, against the same at rest: positions, velocities and forces."""
    assert_seen_alike(name, mpm.SymmetryPlane(d - 1, 0.0), PLANES[d], jnp.zeros(d).at[-1].set(0.6), description)


def assert_seen_alike(name, still, moves, V, description):
    """A block on a plane at rest, and on the same plane at the velocity V, move and push alike."""
    (method, transfer), d, found = MOVING[name], len(V), []
    for plane, drift in ((still, 0 * V), (moves, V)):
        scene, particles = shaken(d, boundary=plane, transfer=transfer, description=description)
        dt = 0.3 * explicit_limit(scene)
        particles = dataclasses.replace(particles, v=particles.v + drift)
        for n in range(4):
            particles, info = mpm.step(scene, particles, n * dt, dt, method=method)
        found.append((particles.x - 4 * dt * drift, particles.v - drift, info.boundaries.impulse))
    for a, b in zip(*found, strict=True):
        assert_close(a, b, 1e-9)


@pytest.mark.parametrize("name", **ids({name: name for name in MOVING}, "explicit"))
def test_a_clamp_that_moves_is_one_at_rest_seen_by_somebody_who_moves(name):
    """Along it too."""
    V, motion = jnp.asarray([0.2, 0.6]), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.2, 0.6)))
    still, moves = (mpm.ClampPlane(1, 0.0, motion=way) for way in (None, motion))
    assert_seen_alike(name, still, moves, V, mpm.TotalLagrangian())


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_a_block_between_clamps_that_turn_together_turns_as_a_rigid_body(d):
    """On nodes and half-way between; neither is pushed nor twisted."""
    turn = (0.3,) if d == 2 else ((0.1, 0.3, 0.2),)
    motion = mpm.RigidMotion((0.0, 3e3), ((0.0,) * d, (0.02,) * d), (0 * np.asarray(turn[0]), *turn), (0.1,) * d)
    grid = mpm.Grid((9,) * d, 0.1, origin=(-3,) * d)
    box = mpm.Box((0.0,) * d, (0.3,) * (d - 1) + (0.25,))
    clamps = (mpm.ClampPlane(d - 1, 0.0, motion=motion), mpm.ClampPlane(d - 1, 0.25, "below", motion))
    choices = {"description": mpm.TotalLagrangian(), "boundary_forces": True}
    scene = mpm.Scene(grid, LAWS["neo_hookean"], boundary=clamps, **choices)
    particles = mpm.fill(box, grid, density=1e3)
    run = mpm.simulate(scene, particles, t1=3e3, dt=1e3, method=METHODS["backward_euler"], save_every=3)
    assert_close(run.final.x, motion.place(particles.x, 3e3), 1e-9)
    _, force, torque = run.boundary_forces()
    np.testing.assert_allclose(force, 0, atol=1e-5 * 1e4 * 0.3 ** (d - 1))
    np.testing.assert_allclose(torque, 0, atol=1e-5 * 1e4 * 0.3**d)


def test_a_budget_refuses_planes_that_move():
    for plane in (PLANES[2], mpm.ClampPlane(1, 0.0, motion=PLANES[2].motion)):
        scene, particles = block(2, boundary=plane, description=mpm.TotalLagrangian())
        with pytest.raises(ValueError, match="does not know the work of a SymmetryPlane or ClampPlane that moves"):
            mpm.budget(scene, particles, steps=1, dt=1e-3)


def test_a_clamp_moves_in_the_total_description_only():
    with pytest.raises(ValueError, match="moves in the total description only"):
        block(2, boundary=mpm.ClampPlane(1, 0.0, motion=up(2, 0.6)))


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_a_block_is_compressed_evenly_between_planes_that_move_apart_from_each_other(d):
    """In the total description; by one long step of a linear solve, to its tolerance; each plane is pressed by the
    stress of that strain times its side."""
    planes = [
        mpm.SymmetryPlane(axis, at, keep, motion=up(d, way, time=1e3) if axis == d - 1 else None)
        for axis in range(d)
        for at, keep, way in ((0.0, "above", 0.001), (SIDE, "below", -0.002))
    ]
    scene, particles = block(d, boundary=planes, boundary_forces=True, description=mpm.TotalLagrangian())
    after, info = mpm.step(scene, particles, 0.0, 1e3, method=METHODS["backward_euler"])
    stretch = 1 - 0.003 / SIDE
    assert_close(after.x[:, -1], 0.001 + stretch * particles.x[:, -1], 1e-9)
    assert_close(after.F[:, -1, -1], jnp.full(particles.count, stretch), 1e-9)
    P = np.asarray(LAWS["fixed_corotated"].stress(jnp.diag(jnp.ones(d).at[-1].set(stretch))[..., None])[..., 0])
    force = np.asarray(info.boundaries.impulse / 1e3)
    for axis in range(d):
        alone = np.zeros(2 * d)
        alone[2 * axis : 2 * axis + 2] = 1, -1
        assert_close(force[:, axis], SIDE ** (d - 1) * P[axis, axis] * alone, 1e-7)


@pytest.mark.parametrize(
    ("transfer", "d"), [*thorough(*((name, 2) for name in TRANSFERS if name != "pic"), ("apic", 3)), *slow(("pic", 2))]
)
def test_forces_on_planes_that_move_sum_to_the_change_of_momentum(transfer, d):
    """In a corner of two, with a wall, in both descriptions."""
    boundary = (
        PLANES[d],
        mpm.SymmetryPlane(0, 0.0, motion=mpm.Motion((0.0, 1.0), ((0.0,) * d, (-0.4,) + (0.0,) * (d - 1)))),
        mpm.StickyBox((-np.inf,) * d, (0.3,) + (np.inf,) * (d - 1)),
    )
    for description in DESCRIPTIONS.values():
        for method in (METHODS["explicit"], METHODS["implicit_midpoint"]):
            assert_sums_to_change(
                *shaken(d, boundary=boundary, transfer=TRANSFERS[transfer], description=description), method
            )


@pytest.mark.parametrize(
    ("description", "d"), [*thorough(("total", 2), ("updated", 3)), *slow(("updated", 2), ("total", 3))]
)
def test_the_motion_of_a_plane_can_be_differentiated(description, d):
    """Against central differences, through a rollout; and a run with a plane that moves goes on from its end."""
    described = {"boundary": PLANES[d], "description": DESCRIPTIONS[description]}
    scene, particles = block(d, **described, gravity=(0.0,) * (d - 1) + (-9.81,))

    def end(way):
        own = eqx.tree_at(lambda s: s.boundary[0].motion.displacement[1][-1], scene, way)
        return (mpm.simulate(own, particles, t1=0.02, dt=2e-3).final.x ** 2).sum()

    (_, slope), (above, _), (below, _) = map(jax.value_and_grad(end), (0.6, 0.601, 0.599))
    assert float(slope) == pytest.approx(float(above - below) / 2e-3, rel=1e-5)
    whole = mpm.simulate(scene, particles, t1=0.02, dt=2e-3).final
    half = mpm.simulate(scene, particles, t1=0.01, dt=2e-3).final
    assert_close(mpm.simulate(scene, half, t1=0.02, dt=2e-3, start=5).final.x, whole.x, 1e-12)


def test_planes_that_cannot_move_as_asked_say_so():
    """Two across one axis in the updated description, and a window that follows."""
    still = mpm.SymmetryPlane(1, SIDE, keep="below")
    with pytest.raises(ValueError, match="all of them must move alike"):
        block(2, boundary=(PLANES[2], still))
    block(2, boundary=(PLANES[2], still), description=mpm.TotalLagrangian())
    with pytest.raises(ValueError, match="cannot follow the particles"):
        mpm.Scene(mpm.Grid((9, 9), 0.1, follow=True), LAWS["fixed_corotated"], boundary=PLANES[2])


def half_bar(e, plane, method, total):
    """A bar that a plane at the height 0 bounces or holds, all but the plane lowered by e: with the plane at e,
    lowered by e as a whole."""
    grid = mpm.Grid((14,), 0.1, origin=(-5,))
    x = 0.1 * (jnp.arange(6.0)[:, None] / 2 + 0.25) - e
    v = jnp.linspace(-0.05, -0.03, 6)[:, None]
    body = mpm.Particles(x=x, v=v, mass=jnp.full(6, 0.05), volume=jnp.full(6, 0.05))
    push = mpm.SeparatingCollider(mpm.HalfSpace((0.31 - e,), (-1.0,)))
    boundary = (plane,) if total else (plane, push)
    scene = mpm.Scene(
        grid,
        mpm.FixedCorotated(1.0, 0.3),
        boundary=boundary,
        gravity=(-0.3,),
        description=mpm.TotalLagrangian() if total else mpm.UpdatedLagrangian(),
    )
    final = mpm.rollout(scene, body, steps=12, dt=0.03, method=method)
    return jnp.stack([final.x.mean(), final.v.mean(), final.F.min()])


@pytest.mark.parametrize(
    ("kind", "name", "total"),
    [
        ("contact", "explicit", False),
        *thorough(
            ("contact", "implicit_midpoint", False),
            ("symmetry", "explicit", False),
            ("symmetry", "semi_implicit", True),
        ),
        *slow(("contact", "backward_euler", False), ("contact", "trbdf2", False)),
    ],
)
def test_the_place_of_a_mirrored_plane_has_the_derivative_of_what_moves_the_other_way(kind, name, total):
    """A plane raised by e above the body, with the grid that goes with it, is the plane where it was under all else
    lowered by e, seen from e above."""
    plane, method = {"contact": mpm.ContactPlane, "symmetry": mpm.SymmetryPlane}[kind], METHODS[name]

    def after(raised, lowered):
        return half_bar(lowered, plane(0, raised), method, total)

    def twice(raised, lowered):
        there = after(raised, lowered)
        return there, there

    step, both = 1e-6, jax.jit(jax.jacrev(twice, has_aux=True))
    difference = np.asarray(both(0.0, step)[1] - both(0.0, -step)[1]) / (2 * step) + np.array([1.0, 0.0, 0.0])
    assert np.abs(difference).min() > 1e-2
    assert_close(both(0.0, 0.0)[0], difference, 1e-5)


def test_between_planes_across_one_axis_there_is_no_derivative_by_their_places():
    """Which is said; others have theirs."""
    grid, body = mpm.Grid((8,), 0.1, origin=(-2,)), mpm.fill(mpm.Box((0.0,), (0.2,)), mpm.Grid((8,), 0.1), density=1.0)

    def after(place, modulus):
        planes = mpm.SymmetryPlane(0, place), mpm.SymmetryPlane(0, 0.2, "below")
        scene = mpm.Scene(grid, mpm.FixedCorotated(modulus, 0.3), boundary=planes, gravity=(-1.0,))
        return mpm.rollout(scene, body, steps=3, dt=0.01).x.sum()

    with pytest.raises(ValueError, match="2 mirrored planes across one axis"):
        jax.grad(after)(0.0, 1.0)
    assert float(jax.grad(after, argnums=1)(0.0, 1.0)) != 0
