"""What colliders receive: moments of all boundaries, gravity and force are the change of angular momentum."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRADIENTS, LAWS, assert_close, explicit_limit, thorough
from numpy_oracle import grid_update

import mpmjax as mpm

DX, G = 0.1, np.array([1.0, -9.81, 2.0])
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "midpoint": mpm.ImplicitMidpoint(mpm.implicit.Newton(TIGHT, 1e-13)),
}
TOTAL = {"description": mpm.TotalLagrangian(), "gradient": GRADIENTS["mls"]}


def cross(a, b):
    a, b = np.broadcast_arrays(a, b)
    return np.cross(a, b) if a.shape[-1] == 3 else (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])[..., None]


def angular_momentum(scene, q):
    """Σ m x × v + Σ m (F D Cᵀ) : ε, F the map from the stencil's positions to x, D the kernel's moment."""
    x, v, m, C = (np.asarray(a) for a in (q.x, q.v, q.mass, q.C))
    F = np.asarray(q.F) if scene.total else np.broadcast_to(np.eye(q.dim), C.shape)
    spin = DX**2 / 4 * F @ C.transpose(0, 2, 1)
    skew = [spin[:, i, j] - spin[:, j, i] for i, j in ([(1, 2), (2, 0), (0, 1)] if q.dim == 3 else [(0, 1)])]
    return (m[:, None] * (cross(x, v) + np.stack(skew, axis=1))).sum(axis=0)


def rolling(d, shift, spin, centre):
    """A turn by `spin` and a shift, within a second."""
    turn = (0.0, spin) if d == 2 else ((0.0,) * 3, (0.4 * spin, -0.3 * spin, spin))
    return mpm.RigidMotion((0.0, 1.0), ((0.0,) * d, shift[:d]), turn, centre[:d])


def body(d, grid):
    """A block that spins and drifts."""
    block = mpm.fill(mpm.Box((0.0,) * d, (0.4,) * d), grid, particles_per_cell=2**d, density=1e3)
    arm = block.x - 0.2
    spin = 3.0 * jnp.stack([-arm[:, 1], arm[:, 0]] + [0.3 * arm[:, 0]] * (d - 2), axis=1)
    return eqx.tree_at(lambda b: b.v, block, spin + jnp.asarray([0.3, -0.5, 0.2][:d]))


def boundaries(description, d):
    """Walls about the block's upper half, colliders about its lower one, all of them turning or moving where they can,
    and the points about which the colliders' torques are taken, as functions of time."""
    slow, fast = (0.4, -0.3, 0.2)[:d], (-0.6, 0.2, 0.3)[:d]
    roller = rolling(d, slow, 15.0, (0.1, -0.1, 0.2))
    floor = mpm.StickyCollider(mpm.Box((-1.0,) * d, (1.0, 0.05, 1.0)[:d]), roller)
    pull = mpm.Motion((0.0, 1.0), ((0.0,) * d, fast))
    grip = mpm.Grip(mpm.Box((0.28, 0.28, -1.0)[:d], (1.0,) * d), pull)
    lid = mpm.StickyBox((-np.inf,) * d, (np.inf, 0.38, np.inf)[:d])
    side = mpm.SlipBox((0.02, -np.inf, -np.inf)[:d], (np.inf,) * d)
    if description == "total":
        return (floor, grip, lid, side), [roller]
    ball = mpm.SeparatingCollider(mpm.Ball((0.3, 0.0, 0.2)[:d], 0.15), rolling(d, slow, -4.0, (0.2, 0.1, 0.0)), 0.3)
    wedge = mpm.SlipCollider(mpm.geometry.Capsule((0.1, 0.0, -1.0)[:d], (0.1, -0.1, 1.0)[:d], 0.1), roller)
    box = mpm.SeparatingBox((-np.inf,) * d, (0.32, np.inf, np.inf)[:d], 0.2)
    return (ball, wedge, grip, lid, box), [ball.motion, roller]


@pytest.mark.parametrize(
    ("description", "name", "d"),
    [
        *thorough(
            ("updated", "explicit", 2),
            ("updated", "semi_implicit", 2),
            ("updated", "explicit", 3),
            ("total", "explicit", 2),
            ("total", "midpoint", 2),
            ("total", "explicit", 3),
        ),
    ],
)
def test_moments_of_all_boundaries_are_the_change_of_angular_momentum(description, name, d):
    """Over five steps of a body that walls, grips and turning colliders hold, to rounding. In the total description the
    nodes' places are added up here from their velocities; there angular momentum is that of the nodes, which that of
    the particles is at the start of a step."""
    grid, method = mpm.Grid((14,) * d, DX, origin=(-5,) * d), METHODS[name]
    boundary, motions = boundaries(description, d)
    options = TOTAL if description == "total" else {}
    scene = mpm.Scene(grid, LAWS["fixed_corotated"], gravity=tuple(G[:d]), boundary=boundary, **options)
    particles, dt, shift = mpm.prepare(scene, body(d, grid)), 0.3 * explicit_limit(scene), 0.0
    reference = np.asarray(grid.nodes(grid.window(particles.x)))
    upper = reference[:, 1] > 0.25
    beside = reference[:, 0] < 0.05 if description == "total" else reference[:, 0] > 0.32 - 2 * DX
    walled = (upper | beside)[:, None]
    wrong_if_at_reference, acted = 0.0, 0.0
    for n in range(5):
        step = grid_update(scene, particles, dt, method, n * dt)
        mass, new = np.asarray(step.nodes.mass)[:, None], step.update
        v0, v1 = np.asarray(step.nodes.velocity), np.asarray(new.motion.velocity)
        late = float(method.force_at() or 0)  # the share of the step at which its forces act
        carrier = np.asarray(new.motion.carrier)
        place = reference + shift + late * dt * carrier

        def moment(impulse, place=place):
            return cross(place, np.asarray(impulse)).sum(axis=0)

        pivots = np.stack([np.asarray(m.centre) + np.asarray(m.at((n + late) * dt)) for m in motions])
        turning = [n for n, one in enumerate(scene.boundary) if one.is_collider]
        each = zip(step.nodes.brought_by, step.nodes.contacts, step.held.active, new.friction, strict=True)
        rub = 0
        for _, contact, active, slip in (contact for contact in each if contact[0] in turning):
            spring = contact.spring_impulse(step.held, active)
            rub = rub + mass * np.asarray(slip) + (0 if spring is None else np.asarray(spring))
        holding = np.asarray(step.holding)
        friction = np.asarray(step.friction)
        push = sum(np.asarray(given.impulse) for given in step.held.along_normals(step.holding))
        held = np.isin(step.nodes.conditions.owner, turning)
        of_colliders = np.where(held, holding, 0) + push + rub
        of_walls = np.where(walled, np.asarray(step.reaction) + friction - of_colliders, 0)
        received = step.info.colliders
        given = -np.asarray(received.angular) - cross(pivots, np.asarray(received.impulse))
        outer = moment(of_walls) + given.sum(axis=0) + moment(mass * dt * G[:d])
        change, elastic = moment(mass * (v1 - v0)), moment(new.elastic)
        scale = np.abs(given).sum() + np.abs(moment(of_walls)).sum()
        if name != "semi_implicit":  # its linearised force has a moment
            assert np.abs(elastic).max() < 1e-9 * scale
        assert_close(angular_momentum(scene, particles), moment(mass * v0, reference + shift), 1e-10)
        assert_close(change, outer + elastic, 0, 1e-9 * scale)
        if description == "updated":
            gain = angular_momentum(scene, step.particles) - angular_momentum(scene, particles)
            carried = cross(dt * carrier, mass * ((1 - late) * v1 + late * v0)).sum(axis=0)  # zero unless θ = 1
            assert_close(gain, outer + elastic + carried, 0, 1e-9 * scale)
        else:
            shift = shift + dt * carrier
            wrong = moment(of_colliders, reference) - moment(of_colliders)
            wrong_if_at_reference = max(wrong_if_at_reference, np.abs(wrong).max() / scale)
        acted = np.maximum(acted, np.abs([*given, moment(of_walls)]) / scale)
        particles = step.particles
    assert acted.min() > 1e-4
    assert description == "updated" or wrong_if_at_reference > 1e-2


@pytest.mark.thorough
@pytest.mark.parametrize("d", [pytest.param(3, marks=pytest.mark.slow), 2])
def test_moments_at_the_two_ends_of_a_column_balance(d):
    """One end is held, the other turned by 2 rad (in 3-D about the axis) and shifted; then it comes to rest."""
    grid = mpm.Grid((13,) * d, DX, origin=(-5, -5, -3)[-d:])
    lower, upper = (-0.1,) * (d - 1) + (0.0,), (0.1,) * (d - 1) + (0.6,)
    column = mpm.fill(mpm.Box(lower, upper), grid, particles_per_cell=2**d, density=1e3)
    wide = (1.0,) * (d - 1)
    turn = (0.0, 1.0) if d == 2 else ((0.0,) * 3, (0.0, 0.0, 2.0))
    shift = (0.2, 0.1) if d == 2 else (0.1, 0.2, 0.05)
    motion = mpm.RigidMotion((0.0, 0.5), ((0.0,) * d, shift), turn, (0.0,) * (d - 1) + (0.6,))
    ends = (
        mpm.StickyCollider(mpm.Box((-1.0,) * d, (*wide, 0.05))),
        mpm.StickyCollider(mpm.Box((-1.0,) * (d - 1) + (0.55,), (*wide, 1.0)), motion),
    )
    scene = mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), boundary=ends, **TOTAL)
    method = mpm.SemiImplicit(hessian=mpm.implicit.AnalyticHessian(projected=True))
    run = mpm.simulate(scene, column, t1=3.0, dt=0.05, save_every=10, method=method)
    _, force, torque = (np.asarray(a) for a in run.forces())
    pivots = np.stack([ends[0].shape.middle(), np.asarray(motion.centre) + shift])
    moments = torque[-1] + cross(pivots, force[-1])
    assert_close(force[-1].sum(axis=0), np.zeros(d), 0, 1e-5 * np.abs(force).max())
    assert_close(moments.sum(axis=0), np.zeros(moments.shape[1]), 0, 1e-5 * np.abs(moments).max())
    assert np.abs(moments[:, -1]).min() > 1.0


@pytest.mark.thorough
def test_in_the_total_description_the_torque_on_a_slip_half_space_moves_with_the_material():
    """A block that a sticky plate drags along the half-space: at rest the moments on both balance, but for what the
    places of nodes that slide, known by the particles alone, are off."""
    grid = mpm.Grid((20, 10), DX, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.6, 0.3)), grid, particles_per_cell=4, density=1e3)
    drag = mpm.Motion((0.0, 0.5), ((0.0, 0.0), (0.5, -0.06)))
    slope = (0.1, 1.0)
    plate = mpm.StickyCollider(mpm.Box((-1.0, 0.25), (2.0, 1.0)), drag)
    ground = mpm.SlipCollider(mpm.HalfSpace((0.0, 0.02), slope))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), boundary=(plate, ground), **TOTAL)
    run = mpm.simulate(scene, block, t1=3.0, dt=0.05, save_every=10, method=mpm.SemiImplicit())
    _, force, torque = (np.asarray(a) for a in run.forces())
    pivots = np.stack([np.asarray(plate.shape.middle()) + drag.displacement[1], ground.shape.middle()])
    moments = torque[-1] + cross(pivots, force[-1])
    assert_close(force[-1].sum(axis=0), np.zeros(2), 0, 1e-6 * np.abs(force).max())
    assert abs(moments.sum()) < 1e-3 * np.abs(moments).max()
