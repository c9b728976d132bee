"""Contact: walls that push but do not pull, and Coulomb friction."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import QUICK, assert_close, explicit_limit, ids, slow, thorough
from numpy_oracle import grid_update

import mpmjax as mpm
from mpmjax.boundary._contact import (
    AbstractContact,
    ConstrainedNodes,
    constrain,
    count_places,
    friction_change,
    friction_share,
)
from mpmjax.boundary._plane_contact import column_weight
from mpmjax.boundary._surface_contact import SurfaceContact
from mpmjax.checks._values import canonical
from mpmjax.implicit import Projection, no_solve
from mpmjax.potential import Mirror
from mpmjax.stepping import NodeMotion, start_nodes, update
from mpmjax.stepping._grid_update import SWEEPS, StageContact

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit(solver=TIGHT)}
BACKWARD_EULER = mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12))
OTHERS = {
    "backward_euler": BACKWARD_EULER,
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Linearised(TIGHT)),
}
TIMES = {"explicit": 0.2, "semi_implicit": 2.0}  # of dx / c
DX, G = 0.1, 9.81
LAW = mpm.FixedCorotated(1e5, 0.3)
FLOORS = {
    "plain": lambda friction: mpm.SeparatingBox((-jnp.inf, 0.0), (jnp.inf, jnp.inf), friction=friction),
    "mirrored": lambda friction: mpm.ContactPlane(1, 0.0, friction=friction),
}
EACH_FLOOR = pytest.mark.parametrize("floor", FLOORS)


def on_a_floor(floor, friction=0.0, angle=0.0, velocity=(0.0, 0.0), height=0.0, stiffness=1e5):
    """A block 4 x 2 cells on the floor y = 0, or above it, gravity tilted by an angle."""
    grid = mpm.Grid((40, 9), DX, origin=(-8, -3))
    block = mpm.fill(mpm.Box((0.0, height), (0.4, 0.2 + height)), grid, density=1e3, velocity=velocity)
    law = mpm.FixedCorotated(stiffness, 0.3)
    gravity = (G * np.sin(angle), -G * np.cos(angle))
    return mpm.Scene(grid, law, gravity=gravity, boundary=FLOORS[floor](friction)), block


def slid(name, steps, floor, **case):
    """A run on the floor, with the mean velocity along it and away from it, and the lowest point, after each step."""
    scene, particles = on_a_floor(floor, **case)
    dt = TIMES[name] * explicit_limit(scene)

    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=METHODS[name], observe=_watch)
    return run, dt


def _watch(scene, particles):
    del scene
    return jnp.concatenate([particles.v.mean(axis=0), particles.x.min(axis=0)])


def tumbling(floor, method, steps=1):
    """A step of a block that lands with one end and lifts off with the other."""
    scene, particles = on_a_floor(floor, velocity=(0.3, -1.0), height=-0.005 * DX if floor == "plain" else 0.0)
    spin = 8.0 * jnp.stack([-particles.x[:, 1], particles.x[:, 0] - 0.2], axis=1)
    particles = eqx.tree_at(lambda p: p.v, particles, particles.v + spin)
    return scene, particles, grid_update(scene, particles, 0.5 * explicit_limit(scene), method)


EACH_METHOD = pytest.mark.parametrize("method", **ids(METHODS | OTHERS, "semi_implicit", QUICK))
NAMES = pytest.mark.parametrize("name", ["explicit", pytest.param("semi_implicit", marks=pytest.mark.slow)])


def judged(step, method):
    """For each contact of faces: the gaps that the springs feel, and the pushes where they are below zero."""
    nodes = step.nodes
    felt = method.mean_displacement(nodes, step.update.motion)
    nothing_held = ConstrainedNodes(nodes, (), Mirror(()), nodes, felt)
    for contact in nodes.contacts:
        gap = contact.spring_gap(nothing_held)
        yield contact, np.asarray(gap), contact.spring_impulse(nothing_held, gap < 0)


@pytest.mark.parametrize("method", **ids(METHODS | OTHERS, "explicit", QUICK))
def test_a_plain_wall_pushes_never_pulls_and_is_not_entered(method):
    """What the walls give is what springs give that push where gaps are below zero, and nothing where they are not:
    some of the foot is pushed, some has left."""
    _, _, step = tumbling("plain", method)
    assert int(step.info.contact.violations) == 0
    assert int(step.info.contact.sweeps) <= SWEEPS
    (_, sides, _), (contact, gap, given) = judged(step, method)
    assert sides.min() > 0
    foot = np.asarray(contact.near)
    assert (gap[foot] < 0).any()
    assert (gap[foot] > 1e-4 * DX).any()
    assert gap.min() > -0.02 * DX
    impulse = np.asarray(step.reaction)
    assert impulse[:, 1].sum() > 0
    assert np.abs(impulse - np.asarray(given)).max() < 1e-8 * np.abs(given).max()


@EACH_METHOD
def test_a_mirrored_wall_pushes_never_pulls_and_is_not_entered(method):
    """The same, column by column: held nodes before and on the wall have B times the velocity of the first one inside,
    on the wall zero to the last bit."""
    _, _, step = tumbling("mirrored", method)
    shape, B = (40, 9), np.arange(-3.0, 1.0)  # nodes by column; the plane is the fourth
    mass = np.asarray(step.nodes.mass).reshape(shape)
    v, impulse = (np.asarray(a[:, 1]).reshape(shape) for a in (step.velocity, step.reaction))
    along = np.asarray(step.velocity[:, 0]).reshape(shape)
    push = ((1 - B) * impulse[:, :4]).sum(axis=1)
    held = np.abs(push) > 1e-9 * np.abs(push).max()
    assert int(step.info.contact.violations) == 0
    assert held.any()
    assert push.min() > -1e-9 * push.max()
    assert (v[held, 3] == 0).all()
    np.testing.assert_allclose(v[held, :4], B * v[held, 4:5], rtol=1e-14)
    np.testing.assert_array_equal(along[held, :3], np.broadcast_to(along[held, 4:5], (held.sum(), 3)))
    first, second = (mass[:, 4] + (B**k * mass[:, :4]).sum(axis=1) for k in (1, 2))
    share = mass[:, :4] * (1 - B * (first / np.where(second == 0, 1, second))[:, None])
    leaving = (share * (v[:, :4] - B * v[:, 4:5])).sum(axis=1)
    assert (leaving[~held] >= 0).all()
    assert (leaving[~held] > 0).any()


@pytest.mark.thorough
@pytest.mark.parametrize("method", [METHODS["semi_implicit"], BACKWARD_EULER], ids=["semi_implicit", "backward_euler"])
def test_what_a_guess_holds_and_the_wall_would_have_to_pull_is_released(method):
    """A compressed bar flies off a plane, at twenty times the explicit limit: v* drives its foot into the wall, the
    solution does not; it leaves with the momentum it had."""
    grid = mpm.Grid((40,), DX, origin=(-8,))
    bar = mpm.fill(mpm.Box((0.0,), (0.8,)), grid, particles_per_cell=2, density=1e3, velocity=(1.0,))
    bar = eqx.tree_at(lambda b: b.F, mpm.prepare(mpm.Scene(grid, LAW), bar), 0.97 * jnp.ones((bar.count, 1, 1)))
    scene = mpm.Scene(grid, LAW, boundary=mpm.ContactPlane(0, 0.0))
    after, info = mpm.step(scene, bar, 0.0, 20 * explicit_limit(scene), method=method)
    assert int(info.contact.sweeps) > 0
    assert int(info.contact.violations) == 0
    assert_close(after.v.mean(), np.asarray(1.0), 1e-10)


@pytest.mark.thorough
@EACH_FLOOR
@EACH_METHOD
def test_walls_account_for_the_change_of_momentum(method, floor):
    """Gravity's impulse and the walls' are all that a step adds."""
    _, particles, step = tumbling(floor, method)
    mass = np.asarray(particles.mass)
    change = mass @ np.asarray(step.particles.v - particles.v)
    gravity = mass.sum() * np.asarray(step.nodes.dt) * np.array([0, -G])
    assert_close(change - gravity, np.asarray(step.reaction.sum(axis=0)), 1e-10)
    assert step.reaction[:, 1].sum() > 0


@pytest.mark.thorough
@EACH_FLOOR
@pytest.mark.parametrize("name", METHODS)
def test_a_wall_lets_go_freely(name, floor):
    """A block that is pulled off the floor leaves as if there were none: no adhesion."""
    scene, particles = on_a_floor(floor, velocity=(0.0, 0.5))
    run = {"steps": 20, "dt": TIMES[name] * explicit_limit(scene), "method": METHODS[name]}
    scene = eqx.tree_at(lambda s: s.gravity, scene, (0.0, 1.0))
    with_floor = mpm.rollout(scene, particles, **run)
    without = mpm.rollout(eqx.tree_at(lambda s: s.boundary, scene, ()), particles, **run)
    for field in ("x", "v", "F", "C"):
        assert_close(getattr(with_floor, field), getattr(without, field), 1e-12, atol=1e-12 * 0.5 / DX)


@pytest.mark.thorough
@EACH_FLOOR
@pytest.mark.parametrize("name", METHODS)
def test_a_block_rests_on_the_floor(name, floor):
    """It carries its weight, does not sink and no condition is left violated."""
    run, dt = slid(name, 200, floor)
    assert int(run.statistics.violations) == 0
    assert int(run.statistics.sweeps) <= SWEEPS * int(run.statistics.steps)
    static = 1e3 * G * 0.2**2 / 2 / 1.35e5  # settling of the top under its own weight, uniaxial
    assert float(run.observed[:, 3].min()) > DX / 4 - 3 * static
    assert float(jnp.abs(run.observed[-1, 1])) < 0.02 * G * 200 * dt


@pytest.mark.thorough
@pytest.mark.parametrize("floor", ["plain", "mirrored"])
@NAMES
def test_a_block_bounces(name, floor):
    """It comes back up, the slower the more the method damps, and nothing sticks."""
    run, _ = slid(name, 150, floor, velocity=(0.0, -1.0), height=0.1)
    up = np.asarray(run.observed[:, 1])
    assert up.min() < -1.0
    assert up.max() > {"explicit": 0.5, "semi_implicit": 0.05}[name]
    assert float(run.observed[:, 3].min()) > 0
    assert int(run.statistics.violations) == 0


@pytest.mark.parametrize("floor", ["mirrored", *thorough("plain")])
@NAMES
def test_a_sliding_block_decelerates_at_mu_g(name, floor):
    """Δv_x = −μ (g t + Δv_y), exactly: while all of the foot slides, friction takes μ times the normal impulse."""
    mu, steps = 0.3, {"explicit": 100, "semi_implicit": 25}[name]
    run, dt = slid(name, steps, floor, friction=mu, velocity=(3.0, 0.0))
    v = np.asarray(run.observed[:, :2])
    t = dt * np.arange(steps + 1)
    assert v[-1, 0] < 3.0 - 0.8 * mu * G * t[-1]
    assert_close(v[:, 0], 3.0 - mu * (G * t + v[:, 1]), 1e-9)


@pytest.mark.slow
@EACH_FLOOR
@pytest.mark.parametrize("name", ["implicit_midpoint", "trbdf2"])
def test_methods_of_second_order_slide_with_the_mean_velocity(name, floor):
    """Δv_x = −μ (g Δt + Δv_y) in each step whose active set is settled, and the midpoint rule moves the block's centre
    with the mean of the velocities before and after. An edge of the foot stays unsettled in a step or two: held it is
    pulled, released it enters."""
    mu, steps = 0.3, 25
    scene, particles = on_a_floor(floor, friction=mu, velocity=(3.0, 0.0))
    dt = 2 * explicit_limit(scene)
    settled, mean = [], [[particles.v.mean(axis=0), particles.x.mean(axis=0)]]
    for k in range(steps):
        particles, info = mpm.step(scene, particles, k * dt, dt, method=OTHERS[name])
        settled.append(int(info.contact.violations) == 0)
        mean.append([particles.v.mean(axis=0), particles.x.mean(axis=0)])
    v, x = np.moveaxis(np.asarray(mean), 1, 0)
    change = np.diff(v, axis=0)
    assert sum(settled) >= steps - 2
    assert v[-1, 0] < 3.0 - 0.8 * mu * G * steps * dt
    assert_close(change[settled, 0], -mu * (G * dt + change[settled, 1]), 1e-9)
    if name == "implicit_midpoint":
        missed = np.diff(x[:, 0]) - dt * (v[1:, 0] + v[:-1, 0]) / 2
        assert np.abs(missed).max() < 1e-9 * dt * np.abs(change[:, 0]).max()


@pytest.mark.thorough
@EACH_FLOOR
@NAMES
@pytest.mark.parametrize(("slope", "sticks"), [(0.25, True), (0.8, False)])
def test_a_block_sticks_below_the_angle_of_friction_and_slides_above(name, slope, sticks, floor):
    """tan θ against μ = 0.4: the mean velocity stays at rest, or grows as g sin θ t − μ (g cos θ t + v_y)."""
    mu, steps, angle = 0.4, {"explicit": 200, "semi_implicit": 40}[name], np.arctan(slope)
    run, dt = slid(name, steps, floor, friction=mu, angle=angle)
    t = dt * np.arange(steps + 1)
    v = np.asarray(run.observed[:, :2])
    drive = G * np.sin(angle) * t[-1]
    if sticks:
        assert np.abs(v[-steps // 4 :, 0].mean()) < 0.03 * drive
    else:
        sliding = G * np.sin(angle) * t - mu * (G * np.cos(angle) * t + v[:, 1])
        assert np.abs(v[:, 0] - sliding).max() < 0.02 * drive


@pytest.mark.thorough
def test_a_block_slides_down_with_the_acceleration_of_a_rigid_one():
    """g (sin θ − μ cos θ), to a thousandth, once the damped bouncing of its soft foot has died down."""
    mu, angle, steps = 0.4, np.arctan(0.8), 60
    run, dt = slid("semi_implicit", steps, "mirrored", friction=mu, angle=angle)
    v, half = np.asarray(run.observed[:, 0]), steps // 2
    acceleration = (v[-1] - v[half]) / (dt * (steps - half))
    assert abs(acceleration / (G * (np.sin(angle) - mu * np.cos(angle))) - 1) < 1e-3


CORNER = {
    "2-D": (2, (mpm.ContactPlane(0, 0.0), mpm.ContactPlane(1, 0.05))),
    "with a symmetry plane": (2, (mpm.SymmetryPlane(0, 0.0), mpm.ContactPlane(1, 0.05))),
    "3-D": (3, (mpm.ContactPlane(0, 0.1, "below"), mpm.ContactPlane(1, 0.05), mpm.ContactPlane(2, 0.0))),
}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("case", "name"),
    [
        ("2-D", "explicit"),
        ("2-D", "semi_implicit"),
        ("with a symmetry plane", "explicit"),
        ("3-D", "explicit"),
        pytest.param("3-D", "semi_implicit", marks=pytest.mark.slow),
    ],
)
def test_a_body_pressed_into_a_corner_feels_symmetry_planes(case, name):
    """Planes that meet hold each other's columns too: to rounding, over three steps (one in 3-D)."""
    d, planes = CORNER[case]
    lower = [p.position if p.keep == "above" else p.position - 2 * DX for p in planes]
    grid = mpm.Grid((10,) * d, DX, origin=(-4,) * d)
    body = mpm.fill(mpm.Box(lower, [a + 2 * DX for a in lower]), grid, particles_per_cell=2**d, density=1e3)
    wobble = 0.3 * jnp.sin(20 * body.x[:, ::-1] + jnp.arange(d, dtype=float))
    body = eqx.tree_at(lambda b: b.v, body, wobble + jnp.asarray([-2.0 if p.keep == "above" else 2.0 for p in planes]))
    symmetric = [mpm.SymmetryPlane(p.axis, p.position, p.keep) for p in planes]
    law, run = mpm.FixedCorotated(1e5, 0.3), {"steps": 3 if d == 2 else 1, "dt": 2e-3, "method": METHODS[name]}
    held, mirrored = (mpm.rollout(mpm.Scene(grid, law, boundary=b), body, **run) for b in (planes, symmetric))
    for field in ("x", "v", "F", "C"):
        assert_close(getattr(held, field), getattr(mirrored, field), 1e-11)


EDGES = {  # y = 0 with the coefficient 0.2 and z = 0 with 0.3
    "boxes": tuple(
        mpm.SeparatingBox([0.0 if k == axis else -np.inf for k in range(3)], (np.inf,) * 3, friction=friction)
        for axis, friction in ((1, 0.2), (2, 0.3))
    ),
    "planes": (mpm.ContactPlane(1, 0.0, friction=0.2), mpm.ContactPlane(2, 0.0, friction=0.3)),
    "colliders": tuple(
        mpm.SeparatingCollider(mpm.HalfSpace((0.0,) * 3, normal), friction=friction)
        for normal, friction in (((0.0, 1.0, 0.0), 0.2), ((0.0, 0.0, 1.0), 0.3))
    ),
}
EDGES["box and plane"] = EDGES["boxes"][0], EDGES["planes"][1]


@pytest.mark.parametrize(
    ("walls", "law", "name"),
    [
        ("box and plane", "solid", "explicit"),
        *thorough(*((walls, "solid", "semi_implicit") for walls in EDGES), ("boxes", "solid", "trbdf2")),
        *thorough(("planes", "solid", "explicit"), ("colliders", "solid", "explicit")),
        *thorough(("boxes", "fluid", "explicit"), ("planes", "fluid", "semi_implicit")),
    ],
)
def test_along_the_edge_of_two_walls_friction_is_that_of_both(walls, law, name):
    """Δv_x = −Σ μ_k (g_k t + Δv_k) within 2 %, the sum being that of both pushes: what moves across one wall turns the
    other's friction by little. In either order of walls of both kinds, to rounding."""
    grid, weight, steps = mpm.Grid((12, 8, 8), 0.1, origin=(-3, -3, -3)), jnp.asarray([0.0, -6.0, -10.0]), 8
    body = mpm.fill(mpm.Box((0.0,) * 3, (0.3, 0.2, 0.2)), grid, density=1e3, velocity=(5.0, 0.0, 0.0))
    laws, changes = {"solid": mpm.NeoHookean(1e5, 0.3), "fluid": mpm.Fluid(1e5)}, []
    turned = [EDGES[walls][::-1]] if (walls, name) == ("box and plane", "semi_implicit") else []
    for boundary in (EDGES[walls], *turned):
        scene = mpm.Scene(grid, laws[law], gravity=weight, boundary=boundary)
        end = mpm.rollout(scene, body, steps=steps, dt=4e-3, method=(METHODS | OTHERS)[name])
        changes.append(np.asarray((end.v - body.v).mean(axis=0)))
    push = changes[0][1:] - steps * 4e-3 * np.asarray(weight)[1:]
    assert push.min() > 0.05
    assert_close(-changes[0][0], 0.2 * push[0] + 0.3 * push[1], 2e-2)
    assert_close(changes[-1], changes[0], 1e-10)


class Rubs(AbstractContact):
    """Takes a part of the velocity, by a matrix."""

    part: Any

    def gap_velocity(self, held, v):
        raise NotImplementedError

    normal_impulse = gap_velocity

    def friction(self, held, active, residual):
        return lambda v: -v @ self.part


@pytest.mark.parametrize("d", [2, 3])
def test_of_more_boundaries_than_directions_friction_is_the_mean_of_two_orders(d):
    """The scene's and the reverse, of three in 2-D; in 3-D of all six. Two contacts of one boundary count as one, and
    keep their order."""
    parts = 0.4 * np.random.default_rng(0).random((4, d, d))
    contacts, v = tuple(map(Rubs, parts)), np.random.default_rng(1).normal(size=(5, d))
    nodes = SimpleNamespace(tied=(), loose=None, brought_by=(0, 1, 1, 2), contacts=contacts)
    held = ConstrainedNodes(nodes, (jnp.ones(5, bool),) * 4, Mirror(()), nodes)
    rubbed, changes = held.friction(jnp.asarray(v), jnp.zeros_like(v))
    orders = [(0, 1, 2, 3), (3, 1, 2, 0)]
    orders += [(0, 3, 1, 2), (1, 2, 0, 3), (1, 2, 3, 0), (3, 0, 1, 2)] if d == 3 else []
    wanted = np.zeros((4, 5, d))
    for order in orders:
        left = v
        for k in order:
            wanted[k] -= left @ parts[k] / len(orders)
            left = left - left @ parts[k]
    assert_close(jnp.stack(changes), wanted, 1e-14)
    assert_close(rubbed, v + wanted.sum(axis=0), 1e-14)


class Searching(mpm.Explicit):
    """An explicit step that looks for its active set, where its guess is right at once too."""

    is_explicit = False

    def force_at(self):
        return None


@pytest.mark.thorough
@pytest.mark.parametrize("number", [1, 2])
def test_whatever_columns_are_held_mirroring_twice_is_mirroring_once(number):
    """Random velocities at one plane, or at two that meet: no held node copies a node that is held itself. At one, an
    explicit step's guess of the active set is right at once: what a column that is held needs decides both ways."""
    planes = (mpm.ContactPlane(0, 0.0), mpm.ContactPlane(1, 0.05))[:number]
    grid = mpm.Grid((10, 10), DX, origin=(-4, -4))
    body = mpm.fill(mpm.Box((0.0, 0.05), (0.3, 0.35)), grid, density=1e3)
    scene = canonical(mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), boundary=planes), float)
    method, rng = Searching(), np.random.default_rng(0)

    @eqx.filter_jit
    def try_out(x, v, field):
        start = mpm.prepare(scene, eqx.tree_at(lambda b: (b.x, b.v), body, (x, v)))
        nodes = start_nodes(scene, start, jnp.zeros(()), jnp.asarray(1e-3), scene.stencil(start))
        new = update(nodes, method)
        active, sweeps = new.constrained.active, new.contact.sweeps
        held_on_plane = active[0].reshape(-1)  # at the first plane's node along its axis, the fourth
        held = constrain(nodes, active)
        loose = (held.nodes.free[:, 0].reshape(grid.shape)[4] & held_on_plane).any()
        images = held.images
        once = images.unfold(field)
        return active, sweeps, loose, once, images.unfold(once)

    partly = 0
    for _ in range(40):
        x = np.maximum(body.x + 0.3 * DX * rng.normal(size=body.x.shape), [1e-3, 0.051])
        v, field = rng.normal(size=body.v.shape), rng.normal(size=(grid.size, 2))
        columns, sweeps, loose, once, twice = try_out(*map(jnp.asarray, (x, v, field)))
        partly += all(0 < held.sum() < 6 for held in columns)
        np.testing.assert_array_equal(once, twice)
        assert not loose
        assert sweeps == 0 or number == 2
    assert partly > 10


BLOCK_GRID = mpm.Grid((10, 9), DX, origin=(-4, -3))


def in_a_block():
    return mpm.fill(mpm.Box((-0.1, 0.0), (0.3, 0.2)), BLOCK_GRID, density=1e3)


def in_touch(boundary, height=0.0, dt=1e-3, rising=0.0):
    """The nodes of a block on a boundary, or above it, of which nothing is held yet, at the start of a step."""
    block = in_a_block()
    scene = canonical(mpm.Scene(BLOCK_GRID, LAW, boundary=boundary), float)
    x, v = block.x + jnp.asarray([0.0, height]), block.v.at[:, 1].set(rising)
    start = mpm.prepare(scene, dataclasses.replace(block, x=x, v=v))
    return start_nodes(scene, start, jnp.zeros(()), jnp.asarray(dt), scene.stencil(start))


@pytest.mark.thorough
def test_a_verdict_is_given_beyond_rounding_only():
    """Of the columns that are held, those that pull by more than 1.5e-8 of their mass times the largest velocity, the
    root of the machine precision; of those that are not, those that enter by more than 1.5e-8 of it. What a solver
    leaves does not count."""
    nodes = in_touch(FLOORS["mirrored"](0.0))
    (contact,) = nodes.contacts
    mass = np.asarray(nodes.mass)
    met = (np.arange(10 * 9) % 9 == 3) & (mass > 0)  # columns by their node on the plane
    (wall,) = contact.walls
    weight = np.broadcast_to(wall.column(column_weight(wall, nodes.mass)), (1, 10, 9, 1)).reshape(-1)

    def found(held, share):
        """How many pull where all are held, or enter where none is, by a share of the largest velocity, 3 m/s."""
        along = np.where(met[:, None], 3 * share * np.array([0.0, 1.0]), 0)
        fast = np.zeros_like(along)
        fast[-1, 0] = 3.0
        active = (jnp.full(contact.shut.shape, held),)
        v = fast if held else fast + along * (weight / np.where(met, mass, 1))[:, None]
        momentum_residual = weight[:, None] * along if held else 0 * along
        sets = constrain(nodes, active).violations(jnp.asarray(v), jnp.asarray(momentum_residual))
        return int(count_places(nodes, *sets))

    assert met.sum() > 3
    for held in (True, False):
        assert found(held, 1.0) == found(held, -1.4e-8) == 0
        assert found(held, -1.6e-8) == met.sum()


@pytest.mark.thorough
def test_there_is_no_friction_where_a_wall_would_have_to_pull():
    """In a set that did not settle: friction takes speed, and never gives it."""
    slope = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), friction=0.3)
    for boundary in (FLOORS["plain"](0.3), FLOORS["mirrored"](0.3), slope):
        for up in (-1.0, 1.0):
            nodes = in_touch(boundary, -up * 0.02 * DX if boundary.pushes else 0.0)
            nothing_held = ConstrainedNodes(nodes, (), Mirror(()), nodes)
            places = [contact.likely_held(nothing_held) for contact in nodes.contacts]
            held = constrain(nodes, tuple(jnp.ones_like(place) for place in places))
            v = jnp.zeros_like(nodes.velocity).at[:, 0].set(1.0)
            momentum_residual = up * nodes.mass[:, None] * jnp.asarray([0.0, 1.0])
            slowed = held.friction(v, momentum_residual)[0][:, 0]
            assert slowed.max() == 1
            assert (slowed.min() == 1) == (up < 0)


PLACES = {"plain": "near", "mirrored": "shut"}  # the places of contact that may be held


@EACH_FLOOR
def test_friction_after_a_stage_is_that_of_a_step_as_long(floor):
    """TR-BDF2's first, by the mean of the forces at its ends, with nodes that a plane moves where they follow, whatever
    its solution has there. Where the nodes would have to be pulled there is none."""
    fields, share = jnp.asarray(np.random.default_rng(0).normal(size=(2, 10 * 9, 2))), 0.6

    @jax.jit
    def rubbed(fields, rise, height):
        nodes, short = (in_touch(FLOORS[floor](0.3), height, dt) for dt in (1e-3, share * 1e-3))
        shut = [tuple(getattr(c, PLACES[floor]) for c in n.contacts) for n in (nodes, short)]
        held, step = map(constrain, (nodes, short), shut)
        v, u = jnp.stack([jnp.asarray(20.0), rise]) + 0.1 * fields[0], 1e-4 * fields[1]
        change = StageContact(held).friction(OTHERS["trbdf2"], v, u, share)
        v, u = map(held.images.unfold, (v, u))
        _, resistance = jax.jvp(nodes.potential.force, (0 * u,), (u,))
        inertia = nodes.mass[:, None] * (v - nodes.velocity - short.dt * nodes.acceleration)
        missing = inertia - short.dt * (nodes.force + resistance / 2)
        step = dataclasses.replace(step, displacement=u / 2)
        wanted = step.friction(v, step.without_spring_impulses(missing))[0] - v
        return change, jnp.where(held.nodes.occupied, wanted, 0)

    change, wanted = rubbed(fields, -2.0, -0.02 * DX)
    assert np.abs(wanted).max() > 1e-3
    assert_close(change, wanted, 1e-9)
    assert not np.any(rubbed(fields, 2.0, 0.02 * DX if floor == "plain" else -0.02 * DX))


def test_a_collider_that_moves_rubs_on_what_does_not_move_with_it():
    """And pushes no face that is more than a spacing before or behind its surface; one that comes nearer at w by
    1 + ρ w²/(λ + 2μ) as stiffly."""
    motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.4, 0.5)))
    floor = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), motion, friction=0.3)

    @jax.jit
    def rubbed(speed, height, rising=0.0):
        nodes = in_touch(floor, height, rising=rising)
        held = constrain(nodes, tuple(contact.near for contact in nodes.contacts))
        v = jnp.zeros_like(nodes.velocity).at[:, 0].set(speed)
        (contact,) = nodes.contacts
        return held.friction(v, 0 * v)[0][:, 0] - speed, contact.near[0], contact.stiffness[0]

    (faster, *_), (same, *_) = rubbed(0.0, -0.02 * DX), rubbed(0.4, -0.02 * DX)
    assert faster.max() > 1e-3
    assert faster.min() == 0
    assert np.abs(same).max() < 1e-14
    gap = (np.asarray(in_a_block().x)[:, 1] - 0.25 * DX) - 1.3 * DX
    np.testing.assert_array_equal(rubbed(0.0, -1.3 * DX)[1], np.abs(gap) < DX)
    leaving, modulus = rubbed(0.0, -0.02 * DX, 5.0)[2], LAW.lame_lambda + 2 * LAW.shear_modulus
    for rising in (0.5, 0.0, -5.0):
        stiffness = rubbed(0.0, -0.02 * DX, rising)[2]
        assert_close(stiffness, (1 + 1e3 * (0.5 - rising) ** 2 / modulus) * leaving, 1e-12)


@pytest.mark.parametrize(("low", "high"), [(-9.0, 0.2 - 0.01 * DX), *thorough((0.01 * DX, 9.0))])
def test_either_of_two_opposite_walls_rubs(low, high):
    """With μ times the push of its springs. The bound of stable steps knows that both push what is near to both."""
    mu, one = 0.3, jnp.ones(in_a_block().count)

    @jax.jit
    def slowed(low, high):
        nodes = in_touch(mpm.SeparatingBox((-np.inf, low), (np.inf, high), friction=mu))
        shut = tuple(contact.near & (contact.gap < 0) for contact in nodes.contacts)
        held = constrain(nodes, shut)
        v = jnp.zeros_like(nodes.velocity).at[:, 0].set(9.0)
        push = sum(c.spring_impulse(held, each)[:, 1].sum() for c, each in zip(nodes.contacts, shut, strict=True))
        rate = SurfaceContact.stability_rate(nodes.contacts, nodes.mass, one, 0 * one)
        return nodes.mass @ (held.friction(v, 0 * v)[0] - v), push, rate, nodes.contacts[1].near.sum(axis=0)

    (lost, across), push, rate, walls = slowed(low, high)
    assert abs(push) > 0
    assert across == 0
    assert_close(-lost, mu * abs(push), 1e-12)
    *_, both, number = slowed(0.03, 0.17)
    assert_close(both / rate, np.asarray(number), 1e-12)
    assert (walls.max(), number.min(), number.max()) == (1, 1, 2)


class Rubbed(Searching):
    """A step in which an inner stage has rubbed already."""

    change: jax.Array

    def advance(self, nodes, guess):
        motion, info = super().advance(nodes, guess)
        return dataclasses.replace(motion, velocity=motion.velocity + self.change, friction=self.change), info


def test_friction_over_a_step_is_mu_times_its_push_whatever_an_inner_stage_took():
    @jax.jit
    def rubbed(part):
        nodes = in_touch(FLOORS["mirrored"](0.3), rising=-0.1)
        nodes = eqx.tree_at(lambda n: n.v, nodes, nodes.velocity.at[:, 0].add(5.0))
        change = jnp.where(nodes.occupied, jnp.stack([-part, 0 * part]), 0)
        new = update(nodes, Rubbed(change))
        return new.motion.velocity, sum(new.friction)

    (v, friction), none = rubbed(0.01), rubbed(0.0)
    assert -5 < friction[:, 0].min() < -1e-3
    assert_close(v, none[0], 1e-13)
    assert_close(friction, none[1], 1e-13)


class Stubborn(mpm.Explicit):
    """Nodes that a plane would have to pull where it holds them, and that enter it where it does not."""

    is_explicit = False  # what an explicit step holds is known at its start

    def advance(self, nodes, guess):
        del guess
        return NodeMotion(jnp.zeros_like(nodes.velocity).at[:, 1].set(-1.0)), no_solve(float)


@pytest.mark.thorough
def test_an_active_set_that_does_not_settle_is_given_up_after_five_sweeps():
    """And what is still wrong is reported."""
    nodes = in_touch(FLOORS["mirrored"](0.0))
    pulled = eqx.tree_at(lambda n: n.v, nodes, jnp.ones_like(nodes.velocity))
    new = update(pulled, Stubborn())
    assert new.contact.sweeps == SWEEPS == 4
    columns = (np.arange(10 * 9) % 9 == 3) & (np.asarray(nodes.mass) > 0)  # by their node on the plane
    assert int(new.contact.violations) == int(columns.sum()) > 3


@pytest.mark.thorough
def test_flip_at_a_contact_plane_that_holds_is_flip_at_a_symmetry_plane():
    """It takes the change of the nodes' velocity from what it was as mirrored."""
    scene, particles = on_a_floor("mirrored", velocity=(0.3, -1.0))
    shaken = 0.2 * jnp.asarray(np.random.default_rng(0).normal(size=particles.v.shape))
    particles = eqx.tree_at(lambda q: q.v, particles, particles.v + shaken)
    planes = scene.boundary[0], mpm.SymmetryPlane(1, 0.0)
    ends = [
        mpm.step(mpm.Scene(scene.grid, LAW, boundary=plane, transfer=mpm.FLIP(1.0)), particles, 0.0, 1e-3)[0]
        for plane in planes
    ]
    for field in ("x", "v", "F"):
        assert_close(getattr(ends[0], field), getattr(ends[1], field), 1e-12)


@pytest.mark.thorough
@NAMES
def test_a_ceiling_is_a_floor_upside_down(name):
    """Off the lattice's symmetry and with friction: keep="below" mirrors keep="above"."""
    outcome = []
    for sign, keep in ((1, "above"), (-1, "below")):
        grid = mpm.Grid((12, 13), DX, origin=(-3, -6))
        block = mpm.fill(mpm.Box((0.0, min(0, sign * 0.2)), (0.4, max(0, sign * 0.2))), grid, density=1e3)
        tilt = jnp.stack([0.5 + block.x[:, 1] * sign, sign * (2 * block.x[:, 0] - 1.0)], axis=1)
        block = eqx.tree_at(lambda b: b.v, block, tilt)
        plane = mpm.ContactPlane(1, 0.0, keep, friction=0.2)
        scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), boundary=plane)
        dt = TIMES[name] * explicit_limit(scene)
        final = mpm.rollout(scene, block, steps=6, dt=dt, method=METHODS[name])
        order = np.lexsort(np.asarray(block.x * jnp.array([1.0, sign])).round(6).T)
        outcome.append(
            np.asarray(jnp.concatenate([final.x, final.v], axis=1) * jnp.array([1.0, sign, 1.0, sign]))[order]
        )
    assert_close(*outcome, 1e-11)


@pytest.mark.slow
def test_explicit_and_semi_implicit_contact_agree_as_the_step_shrinks():
    """A block that lands and slides: their difference halves with the step."""
    differences = []
    for steps in (40, 80, 160):
        scene, particles = on_a_floor("mirrored", friction=0.3, velocity=(0.5, -0.5))
        run = {"steps": steps, "dt": 4.0 * explicit_limit(scene) / steps}
        a, b = (mpm.rollout(scene, particles, method=method, **run) for method in METHODS.values())
        differences.append(float(jnp.abs(a.x - b.x).max()))
    assert np.all(np.divide(differences[:-1], differences[1:]) > 1.7), differences
    assert differences[-1] < 0.02 * DX


@pytest.mark.thorough
@NAMES
def test_the_gradient_through_contact_is_that_of_the_active_set(name):
    """Against central differences, in stiffness, friction, pull and velocity, while the block slides in contact."""
    scene, particles = on_a_floor("mirrored", friction=0.3)
    dt = TIMES[name] * explicit_limit(scene)

    @jax.jit
    def outcome(q):
        changed = eqx.tree_at(
            lambda s: (s.material.youngs_modulus, s.boundary[0].friction, s.gravity), scene, (1e5 * q[0], q[1], q[2:4])
        )
        start = eqx.tree_at(lambda p: p.v, particles, particles.v + q[4:6])
        final = mpm.rollout(changed, start, steps=8, dt=dt, method=METHODS[name])
        return ((final.x - particles.x) ** 2).sum() + (final.v**2).sum()

    at, h = jnp.array([1.0, 0.3, 0.5, -9.81, 1.0, -0.4]), 1e-5
    gradient = np.asarray(jax.jit(jax.grad(outcome))(at))
    differences = [float(outcome(at + h * e) - outcome(at - h * e)) / (2 * h) for e in jnp.eye(6)]
    np.testing.assert_allclose(gradient, differences, rtol=1e-6)
    assert np.abs(gradient).min() > 1e-6


def test_the_derivative_of_friction_is_that_of_sticking_or_of_sliding():
    """d(s + Δs)/ds of the slip: 0 where it is stopped, at rest too, and at the kink on the side of sticking; where it
    is not, I − (limit/m)(I − s sᵀ/s²)/‖s‖ and by the limit −s/(m ‖s‖); I where nothing pushes or has mass."""

    def left(s, limit, mass=2.0):
        return s - friction_share(s[None], jnp.asarray([mass]), limit[None])[0] * s

    slope = jax.jit(jax.jacfwd(left, argnums=(0, 1)))
    s, whole = jnp.array([3.0, 4.0]), np.eye(2)
    for stuck, limit in ((0 * s, 0.1), (s, 11.0), (s, 10.0)):
        assert not any(np.any(part) for part in (left(stuck, jnp.asarray(limit)), *slope(stuck, jnp.asarray(limit))))
    for limit in (9.0, 0.0):
        by_slip, by_limit = slope(s, jnp.asarray(limit))
        assert_close(by_slip, whole - limit / 2 / 5 * (whole - np.outer(s, s) / 25), 1e-14)
        assert_close(by_limit, -s / 10, 1e-14)
    assert_close(slope(0 * s, jnp.asarray(0.0))[0], whole)
    assert_close(slope(0 * s, jnp.asarray(1.0), 0.0)[0], whole)
    assert not jax.jit(jax.hessian(left))(0 * s, jnp.asarray(0.1)).any()


ROUGH = {
    "box": lambda d: mpm.SeparatingBox((-np.inf,) * (d - 1) + (3e-4,), (np.inf,) * d, friction=0.3),
    "plane": lambda d: mpm.ContactPlane(d - 1, 0.0, friction=0.3),
    "collider": lambda d: mpm.SeparatingCollider(
        mpm.HalfSpace((0.0,) * (d - 1) + (3e-4,), (0.0,) * (d - 1) + (1.0,)), friction=0.3
    ),
}
STICKING = [
    ("box", "explicit", LAW, 2),
    *thorough(("plane", "explicit", LAW, 2), ("collider", "explicit", LAW, 3), ("plane", "semi_implicit", LAW, 3)),
    *thorough(*(("box", name, mpm.Rigid(1e5), 2) for name in METHODS)),
    *thorough(("box", "implicit_midpoint", mpm.Fluid(1e5), 2)),
    *slow(("collider", "implicit_midpoint", mpm.Fluid(1e5), 2)),
]


@pytest.mark.parametrize(("wall", "name", "law", "d"), STICKING)
def test_what_friction_holds_at_rest_has_the_derivative_of_sticking(wall, name, law, d):
    """Of the mean velocity along a rough floor after a step by that before it, which is exactly zero."""
    grid = mpm.Grid((9,) * d, DX, origin=(-3,) * d)
    block = mpm.fill(mpm.Box((0.0,) * d, (0.2,) * d), grid, density=1e3)
    scene = mpm.Scene(grid, law, gravity=(0.0,) * (d - 1) + (-G,), boundary=ROUGH[wall](d))
    block = mpm.prepare(scene, block)

    def after(v):
        pushed = eqx.tree_at(lambda b: b.v, block, block.v.at[:, 0].add(v))
        return mpm.step(scene, pushed, 0.0, 1e-4, method=(METHODS | OTHERS)[name])[0].v[:, 0].mean()

    both, h = jax.jit(lambda v: jax.jvp(after, (v,), (1.0,))), 1e-9
    slope, difference = float(both(0.0)[1]), float(both(h)[0] - both(-h)[0]) / (2 * h)
    assert slope < 0.8
    assert slope == pytest.approx(difference, rel=1e-5)


def nodes_held(fixed, normal=None):
    """The projection and mass, 2 kg, of some nodes.

    Args:
        fixed: components that a boundary prescribes, shape (n, d).
        normal: normals that colliders hold, shape (n, d).
    """
    free, normals = ~jnp.asarray(fixed), () if normal is None else (jnp.asarray(normal),)
    return Projection(free, normals), jnp.full(len(free), 2.0)


V = jnp.asarray([[0.3, 0.4, -1.0]] * 3)
Z = jnp.asarray([0.0, 0.0, 1.0])
X_IS_HELD = [[False] * 3, [True, False, False], [False] * 3]
LIMITS = jnp.asarray([0.05, 0.05, 5.0])


def test_friction_on_a_wall_stops_slip_and_nothing_that_is_held():
    """−min(1, limit/(m ‖s‖)) s at a free node, at one whose x is prescribed, and at one that sticks."""
    change = friction_change(*nodes_held(X_IS_HELD), Z, 0.0, LIMITS)(V)
    share = 0.05 / 2 / 0.5
    np.testing.assert_allclose(change, [[-share * 0.3, -share * 0.4, 0], [0, -share * 0.4, 0], [-0.3, -0.4, 0]])


def test_friction_on_a_wall_takes_what_a_collider_holds_off_the_slip():
    """With the collider's normal oblique, along the wall, and along the wall's own."""
    normal = np.array([[0.48, 0.36, 0.8], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    change = np.asarray(friction_change(*nodes_held([[False] * 3] * 3, normal), Z, 0.0, LIMITS)(V))
    along = np.array([0.8, 0.6, 0])
    slip = np.array([0.3, 0.4, 0]) - along * (along @ [0.3, 0.4, 0])
    wanted = -0.05 / 2 / np.linalg.norm(slip) * slip
    np.testing.assert_allclose(change, [wanted, wanted, [-0.3, -0.4, 0]], atol=1e-15)


def test_friction_on_a_surface_stops_slip_and_nothing_that_is_held():
    """A surface that pushes along z and moves, oblique where x is held: the slip is relative to it, and has no part in
    what is held."""
    up = jnp.asarray([[0.0, 0.0, 3e-3], [3.0, 0.0, 4.0], [0.0, 0.0, 3.0]])
    moving = jnp.asarray([[-0.3, 0.0, 7.0]] * 3)
    change = friction_change(*nodes_held(X_IS_HELD), up, moving, LIMITS)(V)
    share = 0.05 / 2 / np.hypot(0.6, 0.4)
    np.testing.assert_allclose(change, [[-share * 0.6, -share * 0.4, 0], [0, -0.05 / 2, 0], [-0.6, -0.4, 0]])
    # Beside a collider, whose normal is at right angles to the surface's, or oblique to it; and where it does not push.
    normal = np.array([[0.8, 0.6, 0.0], [0.48, 0.36, 0.8], [0.8, 0.6, 0.0]])
    change = friction_change(*nodes_held([[False] * 3] * 3, normal), up.at[2].set(0), moving, LIMITS)(V)
    for k in (0, 1):
        along = np.cross(normal[k], up[k])
        slip = along * (along @ (V[k] - moving[k])) / np.linalg.norm(along)
        np.testing.assert_allclose(change[k], -0.05 / 2 * slip / np.linalg.norm(slip), atol=1e-15)
    assert (np.asarray(change)[2] == 0).all()


def test_a_plane_holds_a_column_while_a_third_of_the_faces_around_it_touch():
    """Two of five do, of seven not."""
    grid = mpm.Grid((12,), 0.1, origin=(-3,))

    @jax.jit
    def held(x):
        particles = mpm.Particles(x[:, None], 0 * x[:, None], 50 + 0 * x, 0.05 + 0 * x)
        scene = canonical(mpm.Scene(grid, LAW, boundary=mpm.ContactPlane(0, 0.0)), float)
        start = mpm.prepare(scene, particles)
        return start_nodes(scene, start, jnp.zeros(()), jnp.asarray(1e-3), scene.stencil(start)).contacts[0].shut

    touching, before, away = 0.0249, 0.0264, 0.55  # the face is 0.025 m before the centre, and shut up to 0.001 m
    assert held(jnp.asarray([touching] * 2 + [before] * 3 + [away] * 2)).all()
    assert not held(jnp.asarray([touching] * 2 + [before] * 5)).any()


def test_a_face_far_behind_a_contact_plane_is_held_whatever_is_beside_it():
    """One particle a fifth of a spacing behind it, its neighbours a tenth before it, all on the way down: it stops,
    though more than two thirds of the faces around it do not touch."""
    grid = mpm.Grid((12, 12), 0.1, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.01), (0.5, 0.31)), grid, density=1e3)
    deep = int(np.abs(np.asarray(block.x) - [0.275, 0.035]).sum(axis=1).argmin())
    falling = dataclasses.replace(block, x=block.x.at[deep, 1].set(0.005), v=block.v.at[:, 1].set(-0.1))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), boundary=mpm.ContactPlane(1, 0.0))
    end, _ = mpm.step(scene, mpm.prepare(scene, falling), 0.0, 1e-3)
    assert end.v[deep, 1] > -0.01


def test_a_collider_that_pushes_is_said_to_move_nodes():
    """So that in explicit steps a plane beside it looks for what is shut, and does not take it from velocities without
    the push."""
    nodes = jnp.zeros((3, 2))
    collider = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (1.0, 0.3)))
    conditions = collider.conditions(nodes, 0.1, 0.0, 1e-3, reference=False)
    assert conditions.holds
    assert not conditions.moves
    assert not conditions.fixed.any()
