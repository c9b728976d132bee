"""Colliders: exact on the nodes that lie in them, along oblique normals, in every update; what they receive is what
the material loses."""

import dataclasses
import functools
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, QUICK, assert_close, cloud, explicit_limit, ids, thorough
from numpy_oracle import grid_update

import mpmjax as mpm
from mpmjax.boundary import ConstrainedNodes, combined_conditions
from mpmjax.discretisation import scatter
from mpmjax.implicit import ImplicitOperator, Projection
from mpmjax.potential import Mirror

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "mass": mpm.SemiImplicit(solver=TIGHT, preconditioner=mpm.implicit.MassPreconditioner()),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12)),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Linearised(TIGHT)),
}
EACH_METHOD = pytest.mark.parametrize("method", **ids(METHODS, "explicit", QUICK))
DX, DT, G = 0.1, 1e-2, np.array([1.0, -9.81, 2.0])
LAW = LAWS["fixed_corotated"]
BALL = mpm.Ball((0.31, 0.02), 0.22)
ROLLING = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0), (0.4, 0.3)), (0.0, 3.0), (0.31, 0.02))
ROLLING_3D = mpm.RigidMotion((0.0, 1.0), ((0.0,) * 3, (0.4, 0.3, 0.2)), ((0.0,) * 3, (1.0, 3.0, 2.0)), (0.3, 0.0, 0.3))


def scene_of(grid, *boundary, **options):
    return mpm.Scene(grid, LAW, gravity=tuple(G[: grid.dim]), boundary=boundary, **options)


def normal_of(x, place=BALL.centre):
    """Of a ball, at points x."""
    arm = np.asarray(x) - np.asarray(place)
    return arm / np.linalg.norm(arm, axis=1, keepdims=True)


def turning(x, motion, dt, t=0.0):
    """Velocity of points of a body in plane motion from t to t + dt, by complex numbers."""
    (_, t1), (_, angle) = motion.times, motion.rotation
    shift = np.asarray(motion.displacement[1])
    now, then = (complex(*(np.asarray(motion.centre) + s * shift / t1)) for s in (t, t + dt))
    arm = x[:, 0] + 1j * x[:, 1] - now
    after = then + arm * np.exp(1j * angle * dt / t1)
    return np.stack([after.real, after.imag], axis=1) / dt - x / dt


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["rough", "slip"])
def test_three_boundaries_of_a_corner_act_alike_in_any_order(kind):
    """To rounding, over steps in which a cube is pressed into the corner. The mean of two orders leaves 1e-3 of v."""
    grid, law = mpm.Grid((10, 10, 10), DX, origin=(-4, -4, -4)), mpm.NeoHookean(1e5, 0.3)
    cube = mpm.fill(mpm.Box((0.0,) * 3, (2 * DX,) * 3), grid, density=1e3, velocity=(-1.5, -1.0, -1.0))
    planes = [mpm.HalfSpace((0.0,) * 3, normal) for normal in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    corner = [mpm.SeparatingCollider(plane, friction=mu) for plane, mu in zip(planes, (0.3, 0.8, 0.1), strict=True)]
    if kind == "slip":
        tilted = [
            mpm.HalfSpace((0.0,) * 3, normal) for normal in ((1.0, 0.2, 0.1), (0.15, 1.0, -0.2), (-0.1, 0.25, 1.0))
        ]
        corner = [mpm.SlipCollider(plane) for plane in tilted]
    first, *others = (
        mpm.rollout(mpm.Scene(grid, law, gravity=(-50.0, -40.0, -60.0), boundary=order), cube, steps=15, dt=2e-3)
        for order in itertools.permutations(corner)
    )
    for other in others:
        assert_close(other.v, first.v, 1e-12)


@EACH_METHOD
def test_what_colliders_hold_moves_with_them(method):
    """Sticky: the whole velocity; slip: the component alone along the normal in the middle of the step, as the body
    turns; beside a wall's component, both; to rounding, also after a solve."""
    grid, particles = cloud(2, p=60)
    sticky = mpm.StickyCollider(
        mpm.HalfSpace((0.5, 0.5), (-3.0, -4.0)), mpm.Motion((0.0, 1.0), ((0.0,) * 2, (0.3, 0.1)))
    )
    lifted = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.0, 0.2)))
    wall = mpm.Grip(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), lifted, axes=(False, True))
    step = grid_update(scene_of(grid, wall, sticky, mpm.SlipCollider(BALL, ROLLING)), particles, DT, method)
    x, v, mass = np.asarray(step.position), np.asarray(step.velocity), np.asarray(step.nodes.mass)
    stuck = ((x - 0.5) @ [-3.0, -4.0] < 1e-9) & (x[:, 1] > 0.01)
    touched = (np.linalg.norm(x - BALL.centre, axis=1) < 0.22) & (mass > 0)
    floor = x[:, 1] < 1e-9
    assert step.info.solve.converged
    assert (stuck & (mass > 0)).sum() > 3
    assert (touched & ~floor).sum() > 3
    assert (touched & floor).sum() > 1
    assert_close(v[stuck], np.broadcast_to([0.3, 0.1], v[stuck].shape), 1e-14)
    assert_close(v[floor, 1], np.full(floor.sum(), 0.2), 1e-14)
    half = ROLLING.rotation[1] * DT / 2
    n = normal_of(x) @ np.array([[np.cos(half), np.sin(half)], [-np.sin(half), np.cos(half)]])
    assert_close(((v - turning(x, ROLLING, DT)) * n).sum(axis=1)[touched], np.zeros(touched.sum()), 0, 1e-13)
    along = v[:, 0] * n[:, 1] - v[:, 1] * n[:, 0]
    assert (np.abs(along[touched & ~floor]) > 1e-3).all()
    (push,) = step.held.along_normals(step.holding)
    beside = np.asarray(step.reaction - push.impulse)  # the floor's part, where both hold
    assert_close(beside[touched & floor, 0], np.zeros((touched & floor).sum()), 0, 1e-11 * np.abs(step.reaction).max())


@pytest.mark.thorough
def test_a_body_stands_where_its_motion_takes_it():
    """At t the nodes are those of the shape moved and turned, and the normals turn with it to the step's middle."""
    grid = mpm.Grid((30, 30), DX, origin=(-10, -10))
    nodes = grid.nodes(grid.window(jnp.zeros((1, 2))))
    bar = mpm.Box((-0.6, -0.15), (0.6, 0.15))
    motion = mpm.RigidMotion((0.0, 2.0), ((0.0, 0.0), (0.6, 0.4)), (0.0, 1.2), (0.0, 0.0))
    touch = combined_conditions((mpm.SlipCollider(bar, motion),), nodes, DX, 1.0, 0.1, reference=False)
    angle, shift = 0.6, np.array([0.3, 0.2])
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    back = (np.asarray(nodes) - shift) @ R
    inside = (np.abs(back) < [0.6, 0.15]).all(axis=1)
    np.testing.assert_array_equal(np.asarray(touch.touched), inside)
    middle = inside & (np.abs(back[:, 0]) < 0.4) & (np.abs(back[:, 1]) > 1e-9)
    up = np.array([-np.sin(angle + 0.03), np.cos(angle + 0.03)])
    assert_close(touch.slides[0].normal[middle], np.sign(back[middle, 1:]) * up, 1e-13)
    assert_close(mpm.SlipCollider(bar, motion).pivot(1.0), shift, 1e-14)


@pytest.mark.parametrize("name", ["explicit", *thorough("semi_implicit")])
def test_two_rough_slopes_rub_alike_whichever_comes_first(name):
    """A block that slides into a groove: 20 steps later no particle is elsewhere. One friction after the other, the
    first had a part of the other's: 1e-4 m in 20 steps."""
    dx = 0.1
    grid = mpm.Grid((16, 16), dx, origin=(-8, -4))
    block = mpm.fill(mpm.Box((-0.1, 0.1), (0.1, 0.4)), grid, density=1.0)
    block = dataclasses.replace(block, v=jnp.tile(jnp.array([0.3, -1.0]), (block.count, 1)))
    slopes = [mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (s, 1.0)), friction=0.4) for s in (0.9, -0.7)]
    final = []
    for order in (slopes, slopes[::-1]):
        scene = mpm.Scene(grid, mpm.FixedCorotated(100.0, 0.3), boundary=tuple(order))
        final.append(mpm.rollout(scene, block, steps=20, dt=5e-3, method=METHODS[name]))
    assert np.abs(final[0].v - block.v).max() > 0.1
    assert_close(final[0].x, final[1].x, 1e-9 if name == "semi_implicit" else 1e-13)


@pytest.mark.parametrize(
    ("d", "name"), [(2, "explicit"), *thorough((2, "semi_implicit"), (3, "explicit"), (3, "semi_implicit"))]
)
def test_all_bodies_in_which_a_node_lies_hold_it_whichever_comes_first(d, name):
    """In a vessel of three oblique sides, one of which moves, in 3-D with a floor: n·v = n·v_c of each, and the same
    velocities and impulses on each body in either order."""
    grid, particles = cloud(d, p=60)
    angles, rising = np.pi * np.array([0.5, 7 / 6, 11 / 6]), np.array([0.2, -0.1, 0.3])[:d]
    normals = np.stack([np.cos(angles), np.sin(angles), np.array([0.3, -0.2, 0.0])], axis=1)[:, :d]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sides = [mpm.HalfSpace(tuple(0.3 - 0.1 * n), tuple(n)) for n in normals]
    motions = [mpm.Motion((0.0, 1.0), ((0.0,) * d, tuple(to))) for to in (rising, 0 * rising, 0 * rising)]
    bodies = [mpm.SlipCollider(side, motion) for side, motion in zip(sides, motions, strict=True)]  # one program
    bodies += [mpm.SlipBox((-np.inf, -np.inf, 0.1), (np.inf,) * 3)] if d == 3 else []
    steps = [grid_update(scene_of(grid, *order), particles, DT, METHODS[name]) for order in (bodies, bodies[::-1])]
    x, mass = np.asarray(steps[0].position), np.asarray(steps[0].nodes.mass) > 0
    v, other = (np.asarray(step.velocity)[mass] for step in steps)
    assert_close(v, other, 1e-9)
    for received, turned in zip(*(jax.tree.leaves(step.info.colliders) for step in steps), strict=True):
        assert_close(received, turned[::-1], 1e-9)
    inside = np.stack([(x - 0.3) @ n < -0.1 + 1e-9 for n in normals])[:, mass]
    assert all((inside[[a, b]].all(axis=0)).sum() > 2 for a, b in ((0, 1), (1, 2), (0, 2)))
    for n, held, asked in zip(normals, inside, (normals[0] @ rising, 0, 0), strict=True):
        assert_close(v[held] @ n, np.full(held.sum(), asked), 0, 1e-12)
    if d == 2:  # nothing else holds
        assert_close(steps[0].info.colliders.impulse.sum(axis=0), -np.asarray(steps[0].reaction).sum(axis=0), 1e-9)
    else:
        assert_close(v[x[mass, 2] < 0.1 + 1e-9, 2], np.zeros((x[mass, 2] < 0.1 + 1e-9).sum()), 0, 1e-15)


@pytest.mark.thorough
def test_a_normal_that_prescribed_components_hold_already_asks_nothing():
    grid, particles = cloud(2, p=60)
    mass = np.asarray(grid_update(scene_of(grid), particles, DT, METHODS["explicit"]).nodes.mass) > 0
    box = mpm.SlipBox((-np.inf, 0.3), (np.inf, np.inf))
    alone = grid_update(scene_of(grid, box), particles, DT, METHODS["explicit"])
    rising = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.0, 5.0)))
    for tilt in (9e-3, 11e-3):  # a hundredth is what counts as parallel
        steep = mpm.SlipCollider(mpm.HalfSpace((0.0, 0.3), (tilt, 1.0)), rising)
        step = grid_update(scene_of(grid, box, steep), particles, DT, METHODS["explicit"])
        below = (np.asarray(step.position)[:, 1] < 0.25) & mass
        expected = alone.velocity[below] if tilt < 1e-2 else np.broadcast_to([5 / tilt, 0.0], (below.sum(), 2))
        assert_close(step.velocity[below], expected, 1e-12)


@pytest.mark.thorough
def test_what_the_earlier_holds_the_later_does_not_receive():
    """Of a grip and a body that sticks."""
    grid = mpm.Grid((6, 6), DX)
    nodes = grid.nodes(grid.window(jnp.zeros((1, 2))))
    x = np.asarray(nodes)
    left, floor = mpm.HalfSpace((0.25, 0.0), (1.0, 0.0)), mpm.HalfSpace((0.0, 0.25), (0.0, 1.0))
    later = (x[:, 0] > 0.25) & (x[:, 1] < 0.25)
    grip = mpm.Grip(left, mpm.Motion((0.0,), ((0.0, 0.0),)), axes=(True, False))
    owner = combined_conditions((grip, mpm.StickyCollider(floor)), nodes, DX, 0.0, 0.1, reference=False).owner
    np.testing.assert_array_equal(owner[:, 1], np.where(x[:, 1] < 0.25, 1, -1))
    np.testing.assert_array_equal(owner[:, 0], np.where(x[:, 0] < 0.25, 0, np.where(later, 1, -1)))


@pytest.mark.thorough
@pytest.mark.parametrize("preconditioner", [mpm.implicit.DiagonalPreconditioner(), mpm.implicit.MassPreconditioner()])
def test_the_operator_is_symmetric_and_its_inner_product_commutes_with_the_projection(preconditioner):
    """Q (M + χH) Q and the identity, or the mass, on the rest; beside fixed components too."""
    grid, particles = cloud(2, p=12, cells=3)
    ball = mpm.Ball((0.16, 0.02), 0.22)
    slope = mpm.SlipCollider(mpm.HalfSpace((0.1, 0.1), (1.0, -0.3)))
    scene = scene_of(grid, mpm.SlipBox((-np.inf, 0.0), (np.inf, np.inf)), mpm.SlipCollider(ball), slope)
    step = grid_update(scene, particles, DT, METHODS["explicit"])
    nodes = step.nodes
    action = mpm.implicit.AnalyticHessian().at(nodes.potential, None)
    operator = ImplicitOperator(nodes.mass, jnp.asarray(1e-3), action, nodes.projection)
    A, W = np.asarray(operator.as_matrix()), np.asarray(preconditioner.inner_product(operator).weight).ravel()
    n = A.shape[0]
    Q = np.asarray(jax.vmap(lambda e: nodes.projection.combine(e.reshape(-1, 2), 0).ravel())(jnp.eye(n))).T
    free = ImplicitOperator(nodes.mass, jnp.asarray(1e-3), action, Projection(jnp.ones_like(nodes.free)))
    first, second = (np.abs(normal).max(axis=1) > 1e-6 for normal in nodes.projection.normals)
    assert first.mean() < 0.9
    assert (first & second).sum() > 1
    assert_close(A, A.T, 1e-14)
    assert_close(Q @ Q, Q, 1e-14)
    assert_close(Q, Q.T, 1e-14)
    assert_close(W[:, None] * Q, Q * W, 1e-14)
    assert_close(Q @ A @ Q, Q @ np.asarray(free.as_matrix()) @ Q, 1e-14)
    rest = A - Q @ A @ Q
    assert_close((np.eye(n) - Q) @ rest @ (np.eye(n) - Q), rest, 1e-14)
    assert np.linalg.eigvalsh(rest + Q).min() > 0
    share = rest / W[:, None]
    assert np.linalg.norm(share, 2) < 1 + 1e-12


@pytest.mark.thorough
def test_a_linear_solve_with_a_collider_is_the_dense_one():
    """min over what Q leaves free, by dense algebra from Q and the unconstrained matrix."""
    grid, particles = cloud(2, p=12, cells=3)
    scene = scene_of(grid, mpm.SlipCollider(mpm.Ball((0.16, 0.12), 0.22), ROLLING))
    step = grid_update(scene, particles, DT, METHODS["semi_implicit"])
    nodes = step.nodes
    action = mpm.implicit.AnalyticHessian().at(nodes.potential, None)
    whole = ImplicitOperator(nodes.mass, nodes.dt**2, action, Projection(jnp.ones_like(nodes.free)))
    A, n = np.asarray(whole.as_matrix()), nodes.velocity.size
    Q = np.asarray(jax.vmap(lambda e: nodes.projection.combine(e.reshape(-1, 2), 0).ravel())(jnp.eye(n))).T
    b = np.asarray(nodes.mass[:, None] * nodes.explicit_velocity()).ravel()
    held = (np.eye(n) - Q) @ np.asarray(nodes.prescribed).ravel()
    v = np.linalg.solve(Q @ A @ Q + np.eye(n) - Q, Q @ (b - A @ held) + held)
    assert_close(step.velocity.ravel(), v, 1e-10)


# --- contact ---------------------------------------------------------------------------------------------------------


@functools.cache
def landing(d=2):
    """A spinning block that meets a turning ball and a tilted half-space, one side of it lifting off."""
    grid = mpm.Grid((12,) * d, DX, origin=(-4,) * d)
    block = mpm.fill(mpm.Box((0.0,) * d, (0.4,) * d), grid, particles_per_cell=2**d, density=1e3)
    spin = 8.0 * jnp.stack([0.2 - block.x[:, 1], block.x[:, 0] - 0.2], axis=1)
    v = jnp.concatenate([spin, jnp.zeros((block.count, d - 2))], axis=1) + jnp.asarray([0.3, -0.5, 0.2][:d])
    return grid, eqx.tree_at(lambda b: b.v, block, v)


def obstacles(friction, d=2):
    spin = (0.0, 3.0) if d == 2 else ((0.0,) * 3, (1.0, 2.0, 3.0))
    motion = mpm.RigidMotion((0.0, 1.0), ((0.0,) * d, (0.4, 0.3, 0.2)[:d]), spin, (0.2, -0.2, 0.2)[:d])
    ball = mpm.SeparatingCollider(mpm.Ball((0.2, -0.2, 0.2)[:d], 0.24), motion, friction)
    slope = mpm.SeparatingCollider(mpm.HalfSpace((0.1,) * d, (4.0, 3.0, 1.0)[:d]), friction=friction)
    return ball, slope


def judged(contact, step, method):
    """The gaps that the springs of a contact feel, and nodes of which nothing is held."""
    nodes = step.nodes
    nothing_held = ConstrainedNodes(nodes, (), Mirror(()), nodes, method.mean_displacement(nodes, step.update.solved))
    return np.asarray(contact.spring_gap(nothing_held)), nothing_held


def pushes(contact, step, method):
    """At the nodes: the sums of the pushes around, and their mean normal and velocity of the surface, of one side."""
    gap, nothing_held = judged(contact, step, method)
    push = jnp.where(gap < 0, contact.normal_impulse(nothing_held, step.reaction), 0)[:1]
    velocity = jnp.zeros_like(contact.normal) if contact.velocity is None else contact.velocity
    fields = jnp.concatenate([push, push * contact.normal, push * velocity])
    sums, d = np.asarray(scatter(contact.faces.stencil, fields, None, len(step.velocity))), len(contact.normal)
    total = np.where(sums[:, 0] == 0, 1, sums[:, 0])[:, None]
    normal = sums[:, 1 : d + 1]
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    return sums[:, 0], normal / np.where(length == 0, 1, length), sums[:, d + 1 :] / total


@pytest.mark.parametrize("method", **ids(METHODS, "explicit", QUICK))
def test_a_separating_collider_pushes_never_pulls_and_is_not_entered(method):
    """What is given is what springs give that push where gaps are below zero, with a wall beside; each collider
    receives its own."""
    grid, particles = landing()
    particles = eqx.tree_at(lambda q: q.x, particles, particles.x + jnp.asarray([0.0, -1e-3]))
    wall = mpm.SeparatingBox((-np.inf, 0.0), (np.inf, np.inf))
    colliders = obstacles(0.0)
    scene = scene_of(grid, *colliders, wall)
    step = grid_update(scene, particles, 0.5 * explicit_limit(scene), method)
    assert int(step.info.contact.violations) == 0
    total = 0
    for number, contact in zip(step.nodes.brought_by, step.nodes.contacts, strict=True):
        gap, nothing_held = judged(contact, step, method)
        given = np.asarray(contact.spring_impulse(nothing_held, jnp.asarray(gap < 0)))
        total = total + given
        if number < len(colliders):
            assert (gap < 0).any()
            assert (gap[np.asarray(contact.near)] > 0).any()
            assert_close(step.info.colliders.impulse[number], -given.sum(axis=0), 1e-7)
    assert np.abs(np.asarray(step.reaction) - total).max() < 1e-7 * np.abs(total).max()


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", **ids(METHODS, (), QUICK))
def test_what_colliders_receive_is_what_the_material_loses(method, d):
    """Change of momentum + impulse on all colliders = gravity's, with friction, sticking, sliding and separation."""
    grid, particles = landing(d)
    sticky = mpm.StickyCollider(mpm.Ball((0.4,) * d, 0.15), ROLLING if d == 2 else ROLLING_3D)
    slip = mpm.SlipCollider(mpm.geometry.Capsule((0.0,) * d, (0.0, 0.2, 0.1)[:d], 0.11))
    scene = scene_of(grid, *obstacles(0.3, d), sticky, slip)
    dt = 0.5 * explicit_limit(scene)
    after, info = mpm.step(scene, particles, 0.0, dt, method=method)
    mass = np.asarray(particles.mass)
    change = mass @ np.asarray(after.v - particles.v)
    gravity = mass.sum() * dt * G[:d]
    given = np.asarray(info.colliders.impulse)
    assert given.shape == (4, d)
    assert info.colliders.angular.shape == (4, 1 if d == 2 else 3)
    assert (np.abs(given).max(axis=1) > 1e-3 * np.abs(given).max()).all()
    assert_close(change + given.sum(axis=0), gravity, 1e-9)
    assert info.contact.violations == 0


@pytest.mark.thorough
def test_forces_on_colliders_against_time(tmp_path):
    """Between frames the mean force is the impulses of the steps over the time, also where the run is observed. Resumed
    from a file the impulse goes on from where it was, in a run that continues another it begins at zero. A block
    presses on the ground with its weight and what its momentum loses."""
    grid = mpm.Grid((16, 16), DX, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.3, 0.0), (0.6, 0.3)), grid, particles_per_cell=4, density=1e3)
    ground = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), friction=0.5)
    ball = mpm.StickyCollider(mpm.Ball((-0.1, 0.9), 0.15))
    scene = mpm.Scene(grid, LAW, gravity=(0.0, -9.81), boundary=(ground, ball))
    settings = {"dt": DT, "method": mpm.SemiImplicit(), "save_every": 5}
    run = mpm.simulate(scene, block, t1=20 * DT, **settings)
    particles, steps = mpm.prepare(scene, block), []
    for n in range(20):
        particles, info = mpm.step(scene, particles, n * DT, DT, method=mpm.SemiImplicit())
        steps.append(info.colliders)
    times, *means = run.forces()
    np.testing.assert_allclose(times, DT * np.array([3, 8, 13, 18]))  # forces of the ends of the steps
    for name, mean in zip(("impulse", "angular"), means, strict=True):
        each = np.stack([getattr(info, name) for info in steps]).reshape(4, 5, 2, -1)
        assert_close(mean, each.mean(axis=1) / DT, 1e-12)
    force = np.asarray(means[0])
    assert not force[:, 1].any()
    weight = float(block.mass.sum()) * 9.81
    gained = np.diff([mpm.momentum(run.frame(i))[1] for i in range(5)]) / (5 * DT)
    assert_close(-force[:, 0, 1], weight + gained, 1e-6)
    half = mpm.simulate(scene, block, t1=10 * DT, **settings)
    recorded, saved = tmp_path / "recorded.h5", tmp_path / "saved.h5"
    mpm.record(recorded, scene, block, t1=10 * DT, **settings)
    mpm.save(saved, half)
    for path in (recorded, saved):
        mpm.record(path, scene, block, t1=20 * DT, resume=True, **settings)
        resumed = mpm.load(path)
        pairs = [(resumed.collider_impulse, run.collider_impulse), (resumed.forces(), run.forces())]
        pairs.append((resumed.final_collider_impulse, run.final_collider_impulse))
        for a, b in zip(*map(jax.tree.leaves, zip(*pairs, strict=True)), strict=True):
            assert np.array_equal(a, b)
    observed = mpm.simulate(scene, block, t1=20 * DT, observe=lambda scene, particles: particles.x[0, 0], **settings)
    for a, b in zip(observed.forces(), run.forces(), strict=True):
        assert np.array_equal(a, b)
    again = mpm.simulate(scene, half.final, t1=20 * DT, start=10, **settings)
    assert not any(a[0].any() for a in jax.tree.leaves(again.collider_impulse))
    for a, b in zip(again.forces(), run.forces(), strict=True):
        assert_close(a, b[2:], 1e-12)
    with pytest.raises(ValueError, match="Forces need saved frames and colliders"):
        mpm.simulate(eqx.tree_at(lambda s: s.boundary, scene, ()), block, t1=DT, dt=DT, save_every=1).forces()


@pytest.mark.thorough
def test_the_force_on_a_collider_can_be_differentiated():
    """By the stiffness of what it is pressed into, against a central difference."""
    grid = mpm.Grid((14, 14), DX, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.3, 0.0), (0.6, 0.3)), grid, particles_per_cell=4, density=1e3)
    down = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.0, -0.3)))
    press = mpm.SlipCollider(mpm.Box((0.0, 0.3), (1.0, 0.6)), down)
    floor = mpm.SymmetryPlane(1, 0.0)

    def force(modulus):
        scene = mpm.Scene(grid, mpm.NeoHookean(modulus, 0.3), boundary=(press, floor))
        return mpm.simulate(scene, block, t1=2e-2, dt=2e-3, save_every=10).forces().force[0, 0, 1]

    both = jax.value_and_grad(force)
    (value, slope), (above, _), (below, _) = both(1e5), both(1e5 + 10), both(1e5 - 10)
    assert float(value) > 0
    assert float(slope) == pytest.approx(float(above - below) / 20, rel=1e-6)


@pytest.mark.parametrize("mu", [0.2, *thorough(1e5)])
@pytest.mark.parametrize("name", ["explicit", *thorough("semi_implicit", "implicit_midpoint")])
def test_friction_opposes_slip_by_at_most_mu_times_the_push(name, mu):
    """Relative to the collider: where it does not stop a node, exactly μ times the push of the particles around,
    against the slip that is left."""
    grid, particles = landing()
    particles = eqx.tree_at(lambda q: q.x, particles, particles.x + jnp.asarray([0.0, -1e-3]))
    scene, method = scene_of(grid, *obstacles(mu)), METHODS[name]
    step = grid_update(scene, particles, 0.5 * explicit_limit(scene), method)
    rub, mass = np.asarray(step.friction), np.asarray(step.nodes.mass)
    found = [pushes(contact, step, method) for contact in step.nodes.contacts]
    limit = mu * sum(push for push, _, _ in found)
    assert (np.linalg.norm(rub, axis=1) <= limit * (1 + 1e-9)).all()
    sliding = 0
    for push, n, velocity in found:
        alone = (mu * push == limit) & (push > 1e-6 * push.max()) & (mass > 0)
        slip = np.asarray(step.velocity) - velocity
        slip = slip - n * (n * slip).sum(axis=1, keepdims=True)
        left = np.linalg.norm(slip, axis=1)
        slides = alone & (left > 1e-9)
        assert alone.sum() > 2
        assert np.abs((rub * n).sum(axis=1)[alone]).max() < 1e-10 * push.max()
        if slides.any():
            assert_close(rub[slides], -limit[slides, None] * slip[slides] / left[slides, None], 1e-8)
        sliding += slides.sum()
    assert sliding > 4 if mu < 1 else sliding == 0


@pytest.mark.thorough
@pytest.mark.parametrize("floor", ["box", "plane"])
def test_friction_of_a_wall_leaves_alone_what_others_hold(floor):
    """At a node that a moving body holds along an oblique normal, or a grip in one direction, the wall's friction acts
    in the directions that are left; elsewhere it takes energy."""
    grid, block = landing(3)
    block = eqx.tree_at(lambda b: b.v, block, block.v + jnp.array([1.0, 0.5, -1.5]))
    pushed = mpm.Motion((0.0, 1.0), ((0.0,) * 3, (0.4, 0.2, 0.1)))
    side = mpm.SlipCollider(mpm.HalfSpace((0.12,) * 3, (2.0, 1.0, 0.5)), pushed)
    drag = mpm.Grip(mpm.HalfSpace((0.0, 0.32, 0.0), (0.0, -1.0, 0.0)), pushed, axes=(True, False, False))
    mu = 0.3
    wall = {
        "box": mpm.SeparatingBox((-np.inf, -np.inf, 0.0), (np.inf,) * 3, friction=mu),
        "plane": mpm.ContactPlane(2, 0.0, friction=mu),
    }[floor]
    block = eqx.tree_at(lambda b: b.x, block, block.x - jnp.array([0.0, 0.0, 1e-3]))
    scene = scene_of(grid, drag, side, wall)
    step = grid_update(scene, block, 0.3 * explicit_limit(scene), mpm.Explicit())
    x, v, mass = np.asarray(step.position), np.asarray(step.velocity), np.asarray(step.nodes.mass) > 0
    n = np.array([2.0, 1.0, 0.5]) / np.sqrt(5.25)
    mass &= x[:, 2] > -1e-9  # what lies beyond a plane is its mirror image
    held, gripped = (x - 0.12) @ n < 1e-9, x[:, 1] > 0.32
    rubbed = np.abs(step.friction).max(axis=1) > 1e-9 * np.abs(step.friction).max()
    assert (rubbed & held & ~gripped).sum() > 3
    assert (rubbed & gripped & ~held).sum() > 3
    assert (rubbed & ~held & ~gripped).sum() > 3
    assert_close(v[held & mass] @ n, np.full((held & mass).sum(), n @ [0.4, 0.2, 0.1]), 1e-13)
    assert_close(v[gripped & mass, 0], np.full((gripped & mass).sum(), 0.4), 1e-14)
    friction = np.asarray(step.friction)
    assert ((friction * v).sum(axis=1)[rubbed & ~held & ~gripped] < 0).all()
    if floor == "box":  # what the body pushes is not the wall's
        push = pushes(step.nodes.contacts[2], step, mpm.Explicit())[0]
        size = np.linalg.norm(friction, axis=1)
        assert (size <= mu * push * (1 + 1e-9))[rubbed].all()
        assert np.isclose(size, mu * push, rtol=1e-9)[rubbed & held].sum() > 3


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["explicit", "semi_implicit"])
def test_a_collider_lets_go_freely(name):
    """A block whose faces a tilted floor just does not touch leaves as if there were none."""
    grid, block = landing()
    block = eqx.tree_at(lambda b: b.v, block, jnp.broadcast_to(jnp.array([0.4, 0.3]), block.v.shape))
    floor = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (4.0, 3.0)), friction=0.5)
    scene = eqx.tree_at(lambda s: s.gravity, scene_of(grid, floor), (0.8, 0.6))
    run = {"steps": 5, "dt": 0.2 * explicit_limit(scene), "method": METHODS[name]}
    with_floor = mpm.rollout(scene, block, **run)
    without = mpm.rollout(eqx.tree_at(lambda s: s.boundary, scene, ()), block, **run)
    for field in ("x", "v", "F"):
        assert_close(getattr(with_floor, field), getattr(without, field), 1e-11)


@pytest.mark.thorough
def test_a_turning_body_drags_what_it_touches_and_is_braked():
    """A cylinder under a block, turning anticlockwise: friction drives the block to the left; the torque on the body is
    clockwise and that of μ times the load at arms between the surface and a particle's width above it, since friction
    acts at the particles' centres."""
    grid = mpm.Grid((14, 12), DX, origin=(-7, -6))
    block = mpm.fill(mpm.Box((-0.4, 0.0), (0.4, 0.2)), grid, density=1e3)
    wheel = mpm.Ball((0.0, -0.45), 0.46)
    motion = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0),) * 2, (0.0, 20.0), wheel.centre)
    scene = mpm.Scene(grid, LAW, gravity=(0.0, -9.81), boundary=mpm.SeparatingCollider(wheel, motion, 0.3))
    dt, total = 0.3 * explicit_limit(scene), np.zeros(3)
    step = jax.jit(lambda p, n: mpm.step(scene, p, n * dt, dt))
    particles = mpm.prepare(scene, block)
    for n in range(40):
        particles, info = step(particles, float(n))
        total += [*info.colliders.impulse[0], info.colliders.angular[0, 0]]
    drag, load, torque = total
    assert float(particles.v[:, 0].mean()) < -0.01
    assert drag > 0
    assert load < 0
    assert torque < 0
    assert 0.46 < -torque / (0.3 * -load) < 0.51


@pytest.mark.slow
def test_a_ball_pushed_through_a_block_meets_resistance():
    """In 3-D, with a ball by samples of its distance as well: both are pushed back, by nearly the same."""
    grid = mpm.Grid((12,) * 3, DX, origin=(-3,) * 3)
    block = mpm.fill(mpm.Box((0.0,) * 3, (0.5,) * 3), grid, particles_per_cell=8, density=1e3)
    ball = mpm.Ball((0.25, 0.25, 0.7), 0.2)
    down = mpm.Motion((0.0, 1.0), ((0.0,) * 3, (0.0, 0.0, -4.0)))
    floor = mpm.SlipBox((-np.inf, -np.inf, 0.0), (np.inf,) * 3)
    impulses = []
    for shape in (ball, mpm.geometry.sample_distance(ball, 0.05)):
        scene = mpm.Scene(grid, LAW, boundary=(floor, mpm.SeparatingCollider(shape, down, 0.1)))
        dt = 0.3 * explicit_limit(scene)
        step = jax.jit(lambda p, n, scene=scene, dt=dt: mpm.step(scene, p, n * dt, dt))
        particles, total = mpm.prepare(scene, block), np.zeros(3)
        for n in range(20):
            particles, info = step(particles, float(n))
            total += np.asarray(info.colliders.impulse[0])
        assert np.isfinite(np.asarray(particles.x)).all()
        impulses.append(total)
    assert impulses[0][2] > 1.0
    assert np.abs(impulses[0][:2]).max() < 1e-6 * impulses[0][2]
    assert_close(impulses[0], impulses[1], 0.1)


# --- the total description, refusals, derivatives --------------------------------------------------------------------


@pytest.mark.thorough
def test_in_the_total_description_a_sticky_collider_is_a_grip_that_turns():
    """It holds the reference nodes where it began; a whole body in it turns rigidly, exactly, F = R."""
    grid, block = landing()
    block = eqx.tree_at(lambda b: b.v, block, 0 * block.v)
    motion = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0), (0.3, 0.2)), (0.0, 1.5), (0.1, 0.0))
    sticky = mpm.StickyCollider(mpm.Box((-1.0, -1.0), (1.0, 1.0)), motion)
    scene = mpm.Scene(grid, LAW, boundary=sticky, description=mpm.TotalLagrangian())
    after = mpm.rollout(scene, block, steps=10, dt=0.05)
    cos, sin = np.cos(0.75), np.sin(0.75)
    R = np.array([[cos, -sin], [sin, cos]])
    assert_close(after.F, np.broadcast_to(R, after.F.shape), 1e-13)
    assert_close(after.x, [0.25, 0.1] + (np.asarray(block.x) - [0.1, 0.0]) @ R.T, 1e-13)


def test_what_passes_a_collider_comes_from_outside_by_more_than_a_spacing():
    """Beside what enters slowly, what was inside and what goes past."""
    start = jnp.asarray([[-0.3, 0.5], [-0.05, 0.5], [0.1, 0.5], [-0.3, 0.5]])
    end = jnp.asarray([[1.3, 0.5], [0.02, 0.5], [0.9, 0.5], [-0.3, 2.0]])
    body = mpm.StickyCollider(mpm.Box((0.0, 0.0), (1.0, 1.0)))
    assert body.passed(start, end, DX, 0.0, DT, 1.5).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("boundary", "options", "message"),
    [
        (mpm.SeparatingCollider(BALL), {"description": mpm.TotalLagrangian()}, "there is no contact"),
        (mpm.SlipCollider(BALL), {"description": mpm.TotalLagrangian()}, "slide along a half-space that does not turn"),
        (
            mpm.SlipCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)), ROLLING),
            {"description": mpm.TotalLagrangian()},
            "turn",
        ),
        (mpm.StickyCollider(mpm.Ball((0.0,) * 3, 1.0)), {}, "must have 2 coordinates"),
    ],
)
def test_what_cannot_work_is_refused(boundary, options, message):
    with pytest.raises(ValueError, match=message):
        scene_of(mpm.Grid((8, 8), DX), boundary, **options)
    with pytest.raises(ValueError, match="same dimension"):
        mpm.StickyCollider(mpm.Ball((0.0,) * 3, 1.0), ROLLING)
    with pytest.raises(ValueError, match="friction must be from 0"):
        mpm.SeparatingCollider(BALL, friction=-1.0)


@pytest.mark.thorough
def test_a_slip_half_space_in_the_total_description_is_a_slip_box():
    """Axis-aligned, to the last bit but those of a normal's length."""
    grid, block = landing()
    runs = []
    for floor in (
        mpm.SlipBox((-np.inf, 0.0), (np.inf, np.inf)),
        mpm.SlipCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 2.0))),
    ):
        scene = scene_of(grid, floor, description=mpm.TotalLagrangian())
        runs.append(mpm.rollout(scene, block, steps=5, dt=0.3 * explicit_limit(scene), method=METHODS["semi_implicit"]))
    assert_close(runs[0].x, runs[1].x, 1e-11)


@pytest.mark.thorough
def test_single_precision_stays_single():
    """Under strict promotion, in the updates and in what is reported."""
    grid, block = landing()
    block = jax.tree.map(lambda a: a.astype(jnp.float32), block)
    sticky = mpm.StickyCollider(
        mpm.geometry.Union((mpm.geometry.Capsule((0.4, 0.4), (0.4, 0.3), 0.15), mpm.Box((0.0, 0.3), (0.1, 0.4))))
    )
    scene = scene_of(grid, *obstacles(0.3), sticky)
    for method in (mpm.Explicit(), mpm.SemiImplicit()):
        after, info = mpm.step(scene, block, 0.0, 1e-3, method=method)
        floats = [a for a in jax.tree.leaves((after, info)) if jnp.issubdtype(a.dtype, jnp.floating)]
        assert {a.dtype for a in floats} == {jnp.dtype(jnp.float32)}


TIGHTEST = mpm.implicit.ConjugateResidual(rtol=1e-14)
UPDATES = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHTEST, adjoint_solver=TIGHTEST),
}


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["separating", *(pytest.param(k, marks=pytest.mark.slow) for k in ("slip", "sticky"))])
@pytest.mark.parametrize("name", UPDATES)
def test_derivatives_by_a_colliders_motion_shape_and_friction(name, kind):
    """After 20 steps: reverse mode against central differences to 1e-6, one parameter after the other (displacement,
    rotation, centre, radius, friction), against forward mode to 1e-12, and a Taylor remainder of slope 2. A ball whose
    centre lies on a node, too."""
    grid, block = landing()
    block = eqx.tree_at(lambda b: b.v, block, block.v / 4)
    dt = 0.25 * DX / np.sqrt(1.35e4 / 1e3)

    def outcome(q):
        motion = mpm.RigidMotion((0.0, 1.0), jnp.stack([jnp.zeros(2), q[:2]]), jnp.stack([0 * q[2], q[2]]), (0.2, -0.2))
        ball = mpm.Ball((0.2 + q[5], -0.2), 0.2437 + q[3])
        match kind:
            case "separating":
                collider = mpm.SeparatingCollider(ball, motion, q[4])
            case "slip":
                collider = mpm.SlipCollider(ball, motion)
            case _:
                collider = mpm.StickyCollider(ball, motion)
        scene = scene_of(grid, collider)
        final = mpm.rollout(scene, block, steps=20, dt=dt, method=UPDATES[name])
        weights = jnp.asarray(np.random.default_rng(0).normal(size=final.x.shape))
        return (weights * final.x).sum() + 0.1 * (weights * final.v).sum()

    at = jnp.array([0.31, 0.23, 2.0, 0.0, 0.2, 0.0])
    value, gradient = jax.jit(outcome), np.asarray(jax.jit(jax.grad(outcome))(at))
    acts = {"separating": [0, 1, 2, 4, 5], "slip": [0, 1, 2, 5], "sticky": [0, 1, 2]}[kind]
    h = 1e-6 if kind == "separating" else 1e-5  # within which the active set stays
    difference = np.array([float(value(at + h * e) - value(at - h * e)) / (2 * h) for e in jnp.eye(6)])
    assert np.isfinite(gradient).all()
    assert (np.abs(difference[acts]) > 1e-8).all(), difference
    np.testing.assert_allclose(gradient[acts], difference[acts], rtol=1e-6)
    np.testing.assert_allclose(gradient, difference, atol=1e-7 * np.abs(difference).max())
    t = jnp.zeros(6).at[jnp.array(acts)].set(np.random.default_rng(1).normal(size=len(acts)))
    slope = float(gradient @ t)
    assert abs(float(jax.jit(lambda q: jax.jvp(outcome, (q,), (t,))[1])(at)) / slope - 1) < 1e-12
    lengths = np.array([1e-6, 5e-7, 2.5e-7]) if kind == "separating" else np.array([1e-4, 3e-5, 1e-5])
    remainders = [abs(float(value(at + h * t) - value(at)) - h * slope) for h in lengths]
    assert abs(np.polyfit(np.log(lengths), np.log(remainders), 1)[0] - 2) < 0.1
