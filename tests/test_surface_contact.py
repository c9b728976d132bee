"""Contact at the faces of particles: walls and colliders push where the material's surface is."""

import dataclasses
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import ALL_LAWS
from helpers import QUICK, assert_close, cloud, ids, slow, thorough

import mpmjax as mpm
from mpmjax.boundary import FaceShape
from mpmjax.boundary._surface_contact import Springs
from mpmjax.potential import Displacement, scattered
from mpmjax.stepping import start_nodes

INF = np.inf
LAW = mpm.FixedCorotated(1.0, 0.3)
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-12)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12)),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Linearised(TIGHT)),
}
for _name in METHODS.keys() - {"explicit"}:
    METHODS[_name] = eqx.tree_at(lambda m: m.adjoint_solver, METHODS[_name], TIGHT)


def floor(at, d=2):
    return mpm.SeparatingBox((*(-INF,) * (d - 1), at), (INF,) * d)


def level(at, d=2):
    """The same as a collider."""
    return mpm.SeparatingCollider(mpm.HalfSpace((*(0.0,) * (d - 1), at), (*(0.0,) * (d - 1), 1.0)))


def block(d=2, *, gap=0.0, cells=3, speed=0.0, dx=0.1, per_cell=2, at=0.0):
    """A block some spacings above a floor at a height [spacings], and its grid."""
    grid = mpm.Grid((cells + 8,) * d, dx, origin=(-4,) * d)
    body = mpm.fill(mpm.Box((0.0,) * d, (cells * dx,) * d), grid, density=1.0, particles_per_cell=per_cell**d)
    x, v = body.x.at[:, -1].add((at + gap) * dx), body.v.at[:, -1].set(-speed)
    return grid, dataclasses.replace(body, x=x, v=v)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_half_widths_are_those_of_the_deformed_particle(d):
    """Of a cube that is stretched and then turned, along its edges: half the stretched edges. n · ∇u b is their
    derivative by the displacement's gradient; for J alone b is that of a ball of its volume, h n."""
    rng = np.random.default_rng(0)
    R = np.linalg.qr(rng.normal(size=(d, d)))[0]
    s, l0 = np.array([0.7, 1.3, 1.1])[:d], 0.05
    F = jnp.asarray(R @ np.diag(s))
    gradient = jnp.asarray(rng.normal(size=(d, d)))
    for edge in range(d):
        n = jnp.asarray(R[:, edge])[:, None]
        cases = {
            "updated": (F, lambda e: F + e * gradient @ F, s[edge] * l0 / 2),
            "total": (F, lambda e: F + e * gradient, s[edge] * l0 / 2),
            "of J": (
                jnp.linalg.det(F),
                lambda e: jnp.linalg.det(F),
                s.prod() ** (1 / d) * l0 / 2,
            ),
        }
        for name, (stored, moved, exact) in cases.items():
            stored = jnp.abs(stored) if stored.ndim == 0 else stored

            def width(e, moved=moved, name=name):
                now = moved(e)
                now = now[..., None] if now.ndim else jnp.abs(now)[None]
                return FaceShape(jnp.asarray([l0 / 2]), now, (0, 1), name == "total").width(n)  # noqa: B023

            h, b = width(0.0)
            assert_close(h, np.array([exact]), 1e-12)
            if name == "of J":
                assert_close(b, exact * n, 1e-12)
                continue
            slope = jax.jvp(lambda e: width(e)[0], (0.0,), (1.0,))[1]
            assert_close(n[:, 0] @ gradient @ b[:, 0], slope[0], 1e-10)


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_the_force_of_springs_is_that_of_their_energy_and_acts_at_the_face(d):
    """f = −∂E/∂u, with its derivative; Σ f is −k g n, and Σ x_i × f_i that of −k g n at the face,
    x − ½ l0 F Fᵀn/‖Fᵀn‖."""
    grid, particles = cloud(d, p=4)
    scene = mpm.Scene(grid, LAW)
    stencil, rng = scene.stencil(particles), np.random.default_rng(1)
    n = rng.normal(size=(d, 4))
    n = jnp.asarray(n / np.linalg.norm(n, axis=0))
    F = jnp.moveaxis(particles.F, 0, -1)
    half = particles.volume ** (1 / d) / 2
    width, arm = FaceShape(half, F, (0, 4), total=False).width(n)
    springs = Springs(-0.1 * width[None], 3.0 + jnp.arange(4.0)[None], n, arm)
    u = jnp.asarray(0.01 * rng.normal(size=(grid.size, d)))

    def moved(u):
        return Displacement(stencil, grid.size, u)

    def energy(u):
        return springs.energy(moved(u))

    def force(u):
        return scattered([springs.force(moved(u))], stencil, grid.size)

    assert_close(force(u), -jax.grad(energy)(u), 1e-12)
    du = jnp.asarray(rng.normal(size=u.shape))
    resistance = scattered([springs(moved(du))], stencil, grid.size)
    assert_close(resistance, -jax.jvp(force, (u,), (du,))[1], 1e-12)
    rest = force(None)
    push = -springs.stiffness[0] * springs.stretch[0] * n
    assert_close(rest.sum(axis=0), push.sum(axis=1), 1e-12)
    m = jnp.einsum("bap,bp->ap", F, n)
    face = particles.x.T - half * jnp.einsum("abp,bp->ap", F, m) / jnp.linalg.norm(m, axis=0)
    x = grid.nodes(grid.window(particles.x))
    moment = jnp.einsum("ia,ib->ab", x, rest) - jnp.einsum("ap,bp->ab", face, push)
    assert_close(moment - moment.T + 1, np.ones((d, d)), 1e-12)


A_FIELD = {"field": mpm.NeoHookean(jnp.linspace(1e4, 2e4, 36), 0.3)}


@pytest.mark.parametrize("law", **ids(ALL_LAWS | A_FIELD, ("fluid", "field")))
def test_whatever_the_law_faces_are_pushed_by_its_wave_modulus(law):
    """λ + 2μ, or that of J, of every law at rest, also where its parameters or its history differ among particles."""
    grid, body = block(2, at=-0.05)
    scene = mpm.Scene(grid, law, boundary=level(0.0))
    particles = mpm.prepare(scene, body)
    h, n = 1e-5, particles.count

    @jax.jit
    def moduli(particles):
        (points,) = scene.material_points(particles)
        F = jnp.broadcast_to(jnp.eye(2)[..., None], (2, 2, n))
        F, pressed = (points.law.measure.of(F - e * jnp.zeros_like(F).at[1, 1].set(1.0)) for e in (0.0, h))
        slope = (points.law.stress(F) - points.law.stress(pressed)) / h
        modulus = jnp.broadcast_to(points.law.wave_modulus(F), n)
        return modulus, slope if slope.ndim == 1 else slope[1, 1]

    modulus, slope = moduli(particles)
    assert_close(modulus, slope, 1e-3)
    if scene.material.flows:  # held by nodes where it touches
        start = eqx.filter_jit(lambda p: start_nodes(scene, p, 0.0, 1e-5, scene.stencil(p)).contacts[0])
        return assert_close(start(particles).stiffness[0], 2 * modulus * 0.05 / 0.1, 1e-10)
    after, _ = mpm.step(scene, particles, 0.0, 1e-5)
    k, gap = 2 * modulus * 0.05 / 0.1, 0.005 * np.asarray(body.x[:, 1] < 0.03)
    assert_close((body.mass * after.v[:, 1]).sum(), 1e-5 * (k * gap).sum(), 1e-10)


EACH = pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
SLOWER = ("backward_euler", "implicit_midpoint")
FLOOR_OR_LEVEL = [
    (floor, "explicit"),
    *thorough(*((floor, name) for name in METHODS if name != "explicit"), *((level, name) for name in QUICK)),
    *slow(*((level, name) for name in METHODS if name not in QUICK)),
]
"""A collider with the updates that differ most: the others see it as they see a wall."""


def landed(method, wall, body, grid, steps, dt, **scene):
    made = mpm.Scene(grid, LAW, boundary=wall, **scene)
    return mpm.rollout(made, body, steps=steps, dt=dt, method=method)


@pytest.mark.parametrize(("wall", "method"), FLOOR_OR_LEVEL)
def test_where_a_wall_is_has_the_derivative_of_differences(wall, method):
    """Of the height, velocity and strain of a bar in the middle of its bounce, by the height of the floor."""
    grid, body = block(1, gap=0.05, speed=0.05, at=0.3, cells=2)

    @jax.jit
    def after(at):
        final = landed(METHODS[method], wall(at, 1), body, grid, 12, 0.04)
        return jnp.stack([final.x.mean(), final.v.mean(), final.F.min()])

    slope, step = jax.jit(jax.jacrev(after))(0.03), 1e-6
    difference = (after(0.03 + step) - after(0.03 - step)) / (2 * step)
    assert np.abs(np.asarray(slope)).min() > 1e-2
    assert_close(slope, difference, 1e-5)


@pytest.mark.parametrize(
    ("d", "method"),
    [
        *thorough((2, "explicit"), (2, "implicit_midpoint"), (3, "explicit")),
        *slow(
            (3, "implicit_midpoint"),
            *((d, name) for d in (2, 3) for name in METHODS if name not in ("explicit", "implicit_midpoint")),
        ),
    ],
)
def test_a_ball_s_place_size_and_motion_have_the_derivatives_of_differences(d, method):
    grid, body = block(d, gap=0.0, speed=0.1, at=0.3, cells=2)
    middle = jnp.asarray([*[0.11, 0.09, 0.08][: d - 1], -0.15])

    def after(q):
        motion = mpm.Motion((0.0, 1.0), jnp.stack([jnp.zeros(d), jnp.zeros(d).at[-1].set(q[d + 1])]))
        ball = mpm.SeparatingCollider(mpm.Ball(q[:d], q[d]), motion, friction=0.2)
        final = landed(METHODS[method], ball, body, grid, 8, 0.03)
        return final.x.mean(axis=0) @ jnp.arange(1.0, d + 1) + final.v.mean(axis=0) @ jnp.arange(2.0, d + 2)

    q = jnp.concatenate([middle, jnp.asarray([0.179, 0.05])])
    slope, step = jax.grad(after)(q), 1e-6
    difference = np.array([(after(q + step * e) - after(q - step * e)) / (2 * step) for e in np.eye(d + 2)])
    assert np.abs(np.asarray(slope)).min() > 1e-4
    assert_close(slope, difference, 1e-5)


@EACH
def test_a_wall_makes_no_energy(method):
    """In a bounce that starts behind the wall by nothing: energy never exceeds what it was, but for what an explicit
    step's velocity, half a step behind, counts twice."""
    grid, body = block(1, gap=0.3, speed=0.05)
    scene = mpm.Scene(grid, LAW, boundary=floor(0.0, 1))
    dt = {mpm.Explicit: 0.02, mpm.TRBDF2: 0.05}.get(type(method), 0.1)  # TR-BDF2 makes some where it resolves nothing
    run = mpm.simulate(scene, body, t1=2.0, dt=dt, method=method, observe=lambda s, p: mpm.energy(s, p).total)
    energy = np.asarray(run.observed)
    assert energy.max() < energy[0] * (1 + (5e-3 if isinstance(method, mpm.Explicit) else 1e-9))
    assert int(run.statistics.violations) == 0
    assert float(run.final.v.mean()) > 0.01  # it came back


def mirrored(at, d=2):
    return mpm.ContactPlane(d - 1, at)


@pytest.mark.parametrize(
    ("d", "wall", "at"),
    [
        (1, floor, 0.0),
        *thorough((1, level, 0.0), (1, mirrored, 0.0), (2, floor, 0.3), (2, level, 0.5), (2, mirrored, 0.5)),
        *thorough((3, level, 0.8)),
        *slow((3, floor, 0.3), (3, mirrored, 0.0)),
    ],
)
def test_a_block_comes_to_rest_on_the_floor(d, wall, at):
    """Its face within 2 % of a spacing of where it is by the exact solution, from more than a spacing above. The floor
    lies `at` spacings from a node."""
    strain, dx, cells = 4e-3, 0.1, 4 if d < 3 else 3
    grid, body = block(d, gap=1.3, cells=cells, at=at)
    law = mpm.FixedCorotated(1.0, 0.0)
    gravity = (*(0.0,) * (d - 1), -strain / (cells * dx))
    scene = mpm.Scene(grid, law, boundary=wall(at * dx, d), gravity=gravity)
    run = mpm.simulate(scene, body, t1=120.0, dt=1.0, method=mpm.BackwardEuler())
    exact = at * dx + cells * dx * (0.5 - strain / 3)
    assert abs(float(run.final.x[:, -1].mean()) - exact) < 0.02 * dx
    assert float(jnp.abs(run.final.v).max()) < 1e-4


@pytest.mark.thorough
def test_a_block_comes_to_rest_on_a_floor_that_no_grid_line_follows():
    """With faces and edges askew to the grid, and its weight across the floor: within 2 % of a spacing."""
    strain, dx, n = 4e-3, 0.1, 8
    angle, foot = np.deg2rad(24.0), 0.1 * np.array([0.513, 0.237])
    along, up = np.array([np.cos(angle), -np.sin(angle)]), np.array([np.sin(angle), np.cos(angle)])
    side = dx / 2 * (np.arange(n) + 0.5)
    x = jnp.asarray(foot + (side[:, None, None] * along + (side[:, None] + 1.3 * dx) * up).reshape(-1, 2))
    volume = jnp.full(len(x), dx**2 / 4)
    body = mpm.Particles(x, jnp.zeros_like(x), volume, volume)
    slope = mpm.SeparatingCollider(mpm.HalfSpace(tuple(foot), tuple(up)))
    gravity = tuple(-strain / (n * dx / 2) * up)
    scene = mpm.Scene(
        mpm.Grid((16, 16), dx, origin=(-4, -6)), mpm.FixedCorotated(1.0, 0.0), boundary=slope, gravity=gravity
    )
    run = mpm.simulate(scene, body, t1=120.0, dt=1.0, method=mpm.BackwardEuler())
    height = (np.asarray(run.final.x).mean(axis=0) - foot) @ up
    assert abs(height - n * dx / 2 * (0.5 - strain / 3)) < 0.02 * dx
    assert float(jnp.abs(run.final.v).max()) < 1e-4


@pytest.mark.parametrize(
    ("d", "wall", "at", "method"),
    [
        (2, floor, 0.3, "explicit"),
        *thorough((1, floor, 0.8, "explicit"), (2, level, 0.5, "explicit"), (2, mirrored, 0.5, "explicit")),
        *thorough((3, floor, 0.3, "explicit"), (3, level, 0.8, "explicit"), (3, mirrored, 0.0, "explicit")),
        *thorough(
            (2, floor, 0.3, "implicit_midpoint"), (2, floor, 0.3, "trbdf2"), (3, floor, 0.3, "implicit_midpoint")
        ),
    ],
)
def test_an_impact_begins_when_the_face_is_at_the_wall(d, wall, at, method):
    """Within 5 % of the time in which the block crosses a cell. Until waves have come from its sides, a block that hits
    a wall at v loses the speed v c/L in a unit of time: t - 0.04 L/c is the onset, t that of 0.96 v."""
    dx, cells, gap, v = 0.1, 3, 1.3, 0.01
    c = float(jnp.sqrt(LAW.lame_lambda + 2 * LAW.shear_modulus))
    grid, body = block(d, gap=gap, cells=cells, at=at, speed=v * c)
    dt = (0.3 if method == "explicit" else 0.6) * dx / c
    t1 = (gap + 0.1) * dx / (v * c)
    scene = mpm.Scene(grid, LAW, boundary=wall(at * dx, d))
    run = mpm.simulate(
        scene, body, t1=round(t1 / dt) * dt, dt=dt, method=METHODS[method], observe=lambda s, p: p.v[:, -1].mean()
    )
    lost = 1 + np.asarray(run.observed) / (v * c)
    k = int(np.argmax(lost > 0.04))
    assert k > 0
    onset = np.interp(0.04, lost[k - 1 : k + 1], np.asarray(run.times)[k - 1 : k + 1]) - 0.04 * cells * dx / c
    assert abs(onset * v * c / dx - gap) < 0.05


@EACH
def test_single_precision_stays_single(method):
    grid, body = block(2)
    body = jax.tree.map(lambda a: a.astype(jnp.float32), body)
    for wall in (floor(0.0), level(0.0), mpm.ContactPlane(1, 0.0)):
        scene = mpm.Scene(grid, LAW, boundary=wall)
        after, _ = jax.eval_shape(lambda body, s=scene: mpm.step(s, body, 0.0, 1e-3, method=method), body)
        assert {str(leaf.dtype) for leaf in jax.tree.leaves(after)} == {"float32"}


@pytest.mark.parametrize(("wall", "method"), FLOOR_OR_LEVEL)
def test_both_of_two_opposite_walls_push(wall, method):
    """A layer in the middle of two walls that are too near stays, beside one off it by δ that comes back: both springs
    push it with k δ in an explicit step."""
    grid, shift, dt = mpm.Grid((9, 9), 0.1, origin=(-4, -4)), jnp.asarray([0.0, 4e-3]), 1e-3
    x = jnp.asarray([[0.0, -0.3], [0.0, 0.25]]).at[:, 0].add(shift)  # no node has both
    layers = mpm.Particles(x, jnp.zeros_like(x), jnp.full(2, 0.01), jnp.full(2, 0.01))
    low, high = (-0.04, -INF), (0.04, INF)
    if wall is floor:
        walls = (mpm.SeparatingBox(low, high),)
    else:
        walls = tuple(mpm.SeparatingCollider(mpm.HalfSpace((s * 0.04, 0.0), (-s * 1.0, 0.0))) for s in (-1, 1))
    after = landed(METHODS[method], walls, layers, grid, 1, dt)
    assert_close(after.v[0, 0] + 1, 1.0, 1e-13)
    assert float(after.v[1, 0]) < 0
    if method == "explicit":
        k = 2 * float(LAW.lame_lambda + 2 * LAW.shear_modulus)  # α M A/dx, A = dx
        assert_close(after.v[1, 0], -2 * k * 4e-3 * dt / 0.01, 1e-10)


def vessel(kind, lower, upper, motion=None):
    """Walls of a vessel that is open above; only some kinds may move."""
    n, d = np.eye(len(lower)), len(lower)
    match kind:
        case "box":
            return (mpm.SeparatingBox(lower, upper),)
        case "colliders":
            low = [mpm.SeparatingCollider(mpm.HalfSpace(lower, tuple(a)), motion) for a in n]
            high = [mpm.HalfSpace((*upper[:-1], 0.0), tuple(-a)) for a in n[:-1]]
            if d == 3:  # a floor and a side beside a box, since five take XLA minutes
                rest = mpm.SlipBox((-INF, lower[1], -INF), upper, motion)
                return low[0], low[2], rest
            return (*low, *(mpm.SeparatingCollider(each, motion) for each in high))
        case "slip colliders" | "sticky colliders":
            collider = mpm.SlipCollider if kind.startswith("slip") else mpm.StickyCollider
            low = [collider(mpm.HalfSpace(lower, tuple(2 * a)), motion) for a in n]
            return (*low, *(collider(mpm.HalfSpace((*upper[:-1], 0.0), tuple(-a)), motion) for a in n[:-1]))
        case "slip":
            return (mpm.SlipBox(lower, upper, motion),)
        case "sticky":
            return (mpm.StickyBox(lower, upper, motion),)
    plane = mpm.ContactPlane if kind == "contact" else mpm.SymmetryPlane
    sides = (plane(a, upper[a], keep="below") for a in range(d - 1))
    return (*(plane(a, lower[a]) for a in range(d)), *sides)


@pytest.mark.parametrize(
    ("law", "kind", "d", "at", "per_cell"),
    [
        ("fluid", "box", 2, 0.0, 2),
        *thorough(*(("fluid", kind, 2, 0.0, 2) for kind in ("slip", "contact", "symmetry"))),
        *slow(("fluid", "colliders", 2, 0.0, 2), ("fluid", "colliders", 2, 0.6, 4)),
        *thorough(*((law, "box", 2, 0.0, 2) for law in ("fluid_in_tension", "viscous_fluid", "herschel_bulkley"))),
        *thorough(("fluid", "box", 2, 0.3, 2), ("viscous_fluid", "box", 2, 0.0, 4)),
        *thorough(("fluid", "box", 3, 0.0, 2)),
    ],
)
def test_what_flows_stays_in_its_vessel_when_it_is_let_down(law, kind, d, at, per_cell):
    """For 35 of the times that sound takes to the floor and back it is as high as it is filled, less what its weight
    compresses it by, at most 4/3 of 2 %, and the lowest layer of cells holds what fits."""
    dx, weight = 0.1, 0.02
    width, depth, c = 6 * dx if d < 3 else 3 * dx, 4 * dx, np.sqrt(10.0)
    grid = mpm.Grid((14 if d < 3 else 11,) * (d - 1) + (12,), dx, origin=(-4,) * d)
    lower = (at * dx,) * d
    upper = (*(a + width for a in lower[:-1]), INF)
    filled = mpm.Box(lower, (*upper[:-1], lower[-1] + depth))
    body = mpm.fill(filled, grid, density=1e3, particles_per_cell=per_cell**d)
    gravity = (*(0.0,) * (d - 1), -weight * c**2 / depth)
    scene = mpm.Scene(grid, ALL_LAWS[law], boundary=vessel(kind, lower, upper), gravity=gravity)
    final = mpm.rollout(scene, body, steps=1120, dt=0.5 * dx / c, method=mpm.Explicit())
    height = np.asarray(final.x)[:, -1] - lower[-1]
    stirred = 0.02 if d == 3 else 0.01  # in 3-D the water at walls on nodes stands 1.8 % low
    assert 1 - 4 / 3 * weight - stirred < height.mean() / (depth / 2) < 1.01
    assert (height < dx).mean() * depth / dx < 1.1


@pytest.mark.parametrize("at", [0.3, *thorough(0.0, 0.1, 0.7)])
def test_water_that_is_let_down_on_a_floor_anywhere_neither_rises_nor_gains_energy(at):
    """For 3000 steps it swings about the level at which it rests."""
    dx, weight, c = 0.1, 0.02, np.sqrt(10.0)
    grid = mpm.Grid((12,), dx, origin=(-4,))
    body = mpm.fill(mpm.Box((at * dx,), ((at + 4) * dx,)), grid, density=1e3)
    scene = mpm.Scene(grid, mpm.Fluid(1e4), boundary=floor(at * dx, 1), gravity=(-weight * c**2 / (4 * dx),))
    dt, per_swing = 0.5 * dx / c, 32
    steps = 94 * per_swing
    observe = lambda _, now: jnp.stack([now.x.mean(), (now.v**2).mean()])  # noqa: E731
    run = mpm.simulate(scene, body, t1=steps * dt, dt=dt, observe=observe)
    level, energy = np.asarray(run.observed)[-steps:].reshape(94, per_swing, 2).mean(axis=1).T
    assert_close((level - at * dx) / (2 * dx), np.full(94, 1 - 2 / 3 * weight), 5e-3)
    assert energy[-1] < energy[0] / 2


@pytest.mark.parametrize("method", **ids(METHODS, "explicit", ("semi_implicit", "trbdf2")))
def test_a_wall_that_holds_a_fluid_keeps_a_velocity_that_is_linear_across_it(method):
    """In both directions of a corner, between nodes: such a field is one of those that the walls admit, and a short
    step brings it back to the particles."""
    grid, at = mpm.Grid((12, 12), 0.1, origin=(-4, -4)), 0.025
    body = mpm.fill(mpm.Box((at, at), (at + 0.3, at + 0.3)), grid, density=1e3)
    closing = -1e-3 * (body.x - at)
    body = dataclasses.replace(body, v=closing, C=jnp.tile(-1e-3 * jnp.eye(2), (len(body.x), 1, 1)))
    walls = mpm.SeparatingBox((at, at), (INF, INF))
    scene = mpm.Scene(grid, mpm.Fluid(1e4), boundary=walls)
    after, _ = mpm.step(scene, mpm.prepare(scene, body), 0.0, 1e-6, method=method)
    assert_close(after.v, closing, 1e-6)


@pytest.mark.parametrize(
    ("law", "kind", "d", "at", "times"),
    [
        ("fluid", "box", 2, 0.0, 9.0),
        ("fluid", "slip", 2, 0.1, 9.0),
        ("fluid", "sticky", 2, 0.0, 0.7),
        *thorough(("fluid", "slip colliders", 2, 0.1, 9.0), ("fluid", "sticky colliders", 2, 0.25, 0.7)),
        *slow(("fluid", "colliders", 2, 0.25, 0.7)),
        *slow(("herschel_bulkley", "colliders", 2, 0.1, 9.0)),
        *slow(("viscous_fluid", "colliders", 2, 0.1, 9.0), ("fluid", "colliders", 3, 0.1, 9.0)),
        *thorough(("fluid", "slip", 2, 0.0, 0.7)),
        *thorough(*(("fluid", kind, 2, at, 0.7) for kind in ("slip", "sticky") for at in (0.1, 0.25, 0.5))),
        *thorough(*((law, "slip", 2, 0.1, 9.0) for law in ("viscous_fluid", "herschel_bulkley"))),
        *thorough(("fluid", "slip", 3, 0.1, 9.0), ("viscous_fluid", "sticky", 2, 0.25, 9.0)),
        *thorough(*(("fluid", "box", 2, at, times) for at in (0.1, 0.25, 0.5) for times in (2.0, 9.0))),
        *thorough(
            *(("fluid", "box", 2, at, 0.7) for at in (0.0, 0.1, 0.25, 0.5, 0.7)), ("fluid", "symmetry", 2, 0.5, 0.7)
        ),
        *thorough(*((law, "box", 2, 0.1, 9.0) for law in ("fluid_in_tension", "viscous_fluid", "herschel_bulkley"))),
        *thorough(*((law, "contact", 2, 0.5, 0.7) for law in ("fluid", "viscous_fluid", "herschel_bulkley"))),
        *thorough(("herschel_bulkley", "symmetry", 2, 0.0, 9.0), ("fluid", "box", 3, 0.1, 9.0)),
    ],
)
def test_a_fluid_at_rest_between_walls_stays_at_rest(law, kind, d, at, times):
    """Wherever walls lie between nodes, at so many times the explicit limit."""
    rests_between_walls(law, kind, d, at, times)


def rests_between_walls(law, kind, d, at, times, crossed=0.0):
    """It starts in its exact state, in a vessel that moves over so many spacings: the pressure stays within 3 % of that
    at the floor, the level within 0.5 % of its own."""
    dx, wide, deep, modulus, law = 1 / 16, 4 / 16, (4 if crossed else 2) / 16, 1e4, ALL_LAWS[law]
    low, load = at * dx, modulus / 40
    grid = mpm.Grid((12,) * d, dx, origin=(-4,) * d)
    lower, upper = (low,) * d, (low + wide,) * (d - 1)
    body = mpm.fill(mpm.Box(lower, (*upper, low + deep)), grid, density=1e3)
    pressure, history = load * (1 + (low - body.x[:, -1]) / deep), None
    stored = J = (1 + 7 * pressure / modulus) ** (-1 / 7)
    if law.measure.axes:
        strain, bulk = jnp.zeros_like(pressure), mpm.Hencky(law.youngs_modulus, law.poisson_ratio).bulk_modulus
        for _ in range(20):  # alike in three directions
            strain = -pressure / (3 * bulk) * jnp.exp(2 * strain)
        stored, J = jnp.exp(strain)[:, None, None] * jnp.eye(2), jnp.exp(2 * strain)
        history = law.History(jnp.zeros_like(strain), strain)
    body = dataclasses.replace(
        body, deformations=(stored,), histories=(history,), volume=body.volume / J, mass=1e3 * body.volume / J
    )
    reference = mpm.Scene(grid, law if law.measure.axes else mpm.Fluid(modulus))
    dt = times * float(mpm.stable_dt(reference, body, safety=1.0))
    steps, method = round(170 / times), mpm.Explicit() if times < 1 else mpm.SemiImplicit()
    way = (*(crossed * dx * np.array([1.0, 0.6, 0.4]))[: d - 1], -crossed * dx)
    body = dataclasses.replace(body, v=body.v + jnp.asarray(way) / (steps * dt))
    motion = mpm.Motion((0.0, steps * dt), ((0.0,) * d, way)) if crossed else None
    walls, gravity = vessel(kind, lower, (*upper, INF), motion), (*(0.0,) * (d - 1), -load / (1e3 * deep))
    scene = mpm.Scene(grid, law, boundary=walls, gravity=gravity)
    final = mpm.rollout(scene, mpm.prepare(scene, body), steps=steps, dt=dt, method=method)
    height = final.x[:, -1] - way[-1] - low
    assert_close(height.mean(), (body.x[:, -1] - low).mean(), 5e-3)
    F = jnp.moveaxis(final.F, 0, -1)
    stress = law.elastic(final.groups[0].history).stress(F)
    mean = -(stress * F).sum(axis=(0, 1)) / 2 / mpm.linalg.determinant(F) if law.measure.axes else -stress
    off = mean / load - (1 - height / deep)
    assert float(jnp.sqrt((off**2).mean())) < 0.03


@pytest.mark.parametrize(
    ("law", "kind", "d", "times"),
    [
        ("fluid", "slip", 2, 0.7),
        *thorough(*(("fluid", kind, 2, 9.0) for kind in ("slip", "sticky", "slip colliders"))),
        *thorough(*(("fluid", kind, 2, 0.7) for kind in ("sticky colliders", "sticky", "colliders"))),
        *slow(("fluid", "colliders", 2, 9.0)),
        *thorough(("viscous_fluid", "sticky", 2, 9.0), ("herschel_bulkley", "slip", 2, 9.0), ("fluid", "slip", 3, 9.0)),
    ],
)
def test_a_fluid_at_rest_in_a_vessel_that_moves_stays_at_rest_in_it(law, kind, d, times):
    """The walls pass nodes on a way of 1.3 spacings."""
    rests_between_walls(law, kind, d, 0.1, times, crossed=1.3)


@pytest.mark.thorough
def test_a_fluid_thrown_at_its_own_speed_of_sound_stays_in_its_vessel():
    """In steps of 0.03 dx/c: no centre comes half a spacing behind a wall, as in the test below."""
    dx, c = 0.1, 10.0
    grid = mpm.Grid((14, 14), dx, origin=(-4, -4))
    fluid = mpm.fill(mpm.Box((0.1, 0.04), (0.5, 0.44)), grid, density=1e3, velocity=(0.0, -c))
    scene = mpm.Scene(grid, mpm.Fluid(1e5), boundary=mpm.SeparatingBox((0.0, 0.0), (0.6, 0.9)))
    run = mpm.simulate(scene, fluid, t1=0.045, dt=0.03 * dx / c, observe=lambda _, now: now.x[:, 1].min())
    assert float(run.observed.min()) > -0.5 * dx


@pytest.mark.parametrize(
    ("law", "d", "mach"),
    [("fluid", 1, 2.0), *thorough(("viscous_fluid", 1, 2.0), ("fluid_in_tension", 1, 2.0), ("fluid", 2, 1.5))],
)
def test_a_fluid_thrown_faster_than_its_sound_does_not_pass_the_floor(law, d, mach):
    """No centre comes half a spacing behind it. Its pressure, of many times its modulus, would press faces by more than
    a spacing into springs that do not stiffen, and through the floor at any step."""
    grid, body = block(d, cells=12 if d == 1 else 6)
    c = np.sqrt(10.0)
    falling = dataclasses.replace(body, mass=1e3 * body.mass, v=body.v.at[:, -1].set(-mach * c))
    walls = mpm.SeparatingBox((0.0,) * d, (*(0.6,) * (d - 1), INF))
    final = mpm.rollout(mpm.Scene(grid, ALL_LAWS[law], boundary=walls), falling, steps=400, dt=0.01 * 0.1 / c)
    assert bool((final.F > 0).all())
    assert float(final.x[:, -1].min()) > -0.05


@pytest.mark.parametrize(
    ("method", "dt"), [("trbdf2", 1.0), *thorough(("trbdf2", 0.25), ("semi_implicit", 1.0), ("implicit_midpoint", 1.0))]
)
def test_what_a_plate_presses_follows_it_within_a_step(method, dt):
    """At a constant speed between walls: the force is that of the column and the springs, one behind the other."""
    speed, height = 0.002, 0.2
    grid, body = block(1, cells=2)
    way = mpm.Motion((0.0, 10.0), ((0.0,), (-10 * speed,)))
    plate = mpm.SeparatingCollider(mpm.HalfSpace((height,), (-1.0,)), way, 0.3)
    scene = mpm.Scene(grid, LAW, boundary=(mpm.SymmetryPlane(0, 0.0), plate))
    run = mpm.simulate(scene, body, t1=6.0, dt=dt, method=METHODS[method], save_every=1)
    times, force, _ = run.forces()
    softer = 1 + grid.spacing / (20 * height)
    stretch = 1 - 5 * speed / (softer * height)
    stress = -float(LAW.stress(jnp.full((1, 1, 1), stretch))[0, 0, 0])
    assert_close(np.interp(5.0, times, force[:, 0, 0]), stress, 0.01)


@pytest.mark.thorough
def test_a_particle_behind_the_surface_by_a_spacing_is_left_alone():
    _, body = block(1)
    behind, grid = dataclasses.replace(body, x=body.x - 0.5), mpm.Grid((30,), 0.1, origin=(-15,))
    with pytest.warns(UserWarning, match="6 of 6 particles lie in or beyond the SeparatingBox"):
        final = landed(mpm.Explicit(), floor(0.0, 1), behind, grid, 3, 0.02)
    assert_close(final.x, behind.x, 1e-14)


@pytest.mark.thorough
def test_explicit_steps_within_the_bound_of_stable_dt_stay_bounded_in_contact():
    """A block squeezed between walls a tenth of a spacing too near, at 0.95 of the bound; at 1.7 of it, it blows up,
    and what has left the window rests there."""
    grid, body = block(2, cells=3)
    walls = mpm.SeparatingBox((0.0, 0.0), (0.299, 0.299))
    scene = mpm.Scene(grid, LAW, boundary=walls)
    limit = float(mpm.stable_dt(scene, body, safety=1.0))
    free = float(mpm.stable_dt(mpm.Scene(grid, LAW), body, safety=1.0))
    assert 0.5 < limit / free < 0.9
    for share, holds in ((0.95, True), (1.7, False)):
        final = mpm.rollout(scene, mpm.prepare(scene, body), steps=400, dt=share * limit, method=mpm.Explicit())
        assert (float(jnp.abs(final.x - body.x).max()) < 0.05) == holds


@pytest.mark.parametrize(
    ("d", "method"),
    [
        (2, "explicit"),
        *thorough(*((2, name) for name in METHODS if name != "explicit"), *((3, name) for name in QUICK)),
        *slow(*((3, name) for name in METHODS if name not in QUICK)),
    ],
)
def test_torn_snow_that_has_lost_its_stiffness_lies_on_the_floor(d, method):
    """It has nearly no modulus and its whole mass. It stays above the floor for the time in which it would fall by
    eight spacings, in steps that `stable_dt` knows of."""
    grid, body = block(d, gap=0.2)
    scene = mpm.Scene(grid, mpm.Snow(1e2, 0.2), boundary=floor(0.0, d), gravity=(*(0.0,) * (d - 1), -10.0))
    torn = torn_snow(mpm.prepare(scene, body))
    dt = 1e-3
    assert dt < float(mpm.stable_dt(scene, torn)) < 0.01
    final = mpm.rollout(scene, torn, steps=400, dt=dt, method=METHODS[method])
    assert float(final.x[:, -1].min()) > 0.0


def torn_snow(particles):
    """The same snow, torn until nothing is left of its stiffness."""
    return eqx.tree_at(lambda p: p.histories[0].plastic_volume, particles, jnp.full(particles.count, 9.0))


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_slivers_at_a_curved_edge_do_not_shorten_explicit_steps(d):
    """A floor shortens the longest step of a ball, whose edge `fill` cuts, hardly more than that of a block (√½)."""
    grid = mpm.Grid((14,) * d, 0.1, origin=(-4,) * d)
    ball = mpm.fill(mpm.Ball((0.31,) * d, 0.3), grid, density=1.0)
    assert float(ball.volume.min()) < 0.1 * float(ball.volume.max())
    limit, free = (float(mpm.stable_dt(mpm.Scene(grid, LAW, boundary=b), ball)) for b in (floor(0.0, d), ()))
    assert limit > 0.65 * free


@pytest.mark.parametrize(
    ("kind", "method"),
    [
        ("slip", "semi_implicit"),
        *thorough(("slip", "explicit"), ("slip", "trbdf2"), ("sticky", "semi_implicit"), ("sticky", "explicit")),
        *thorough(("slip colliders", "semi_implicit")),
        *slow(("sticky", "trbdf2"), ("slip colliders", "explicit"), ("slip colliders", "trbdf2")),
        *slow(*((kind, method) for kind in ("slip", "sticky", "slip colliders") for method in SLOWER)),
        *slow(*(("sticky colliders", method) for method in METHODS)),
    ],
)
def test_walls_that_hold_a_fluid_beside_a_solid_feel_all_that_they_take(kind, method):
    """Between nodes and in a corner: their impulse is the change of momentum that nothing else gives, and a start
    velocity has the derivative of differences. The columns of the solid are held at their nodes."""
    speed = beside_a_solid(kind, METHODS[method], first=False)
    difference = (speed(1 + 1e-4)[0] - speed(1 - 1e-4)[0]) / 2e-4
    assert_close(speed(1.0)[1], difference, 1e-5)


@pytest.mark.slow
def test_colliders_that_a_fluid_may_leave_feel_all_that_they_take():
    """So are those of half-spaces across axes, whose contacts take long to compile."""
    test_walls_that_hold_a_fluid_beside_a_solid_feel_all_that_they_take("colliders", "explicit")


@pytest.mark.parametrize("kind", ["sticky", *thorough("slip")])
def test_walls_hold_columns_together_that_meet_behind_a_solid_in_their_corner(kind):
    """The fluid reaches the nodes before the corner and none behind it."""
    beside_a_solid(kind, METHODS["explicit"], first=True)


@pytest.mark.parametrize(
    ("kind", "method"),
    thorough(("sticky", "explicit"), ("slip", "semi_implicit"), ("slip colliders", "explicit")),
)
def test_walls_that_move_feel_all_that_they_take_from_a_fluid(kind, method):
    """Beside a solid; their motion has the derivative of differences."""
    speed = beside_a_solid(kind, METHODS[method], first=False, moving=True)
    difference = (speed(1 + 1e-4)[0] - speed(1 - 1e-4)[0]) / 2e-4
    assert_close(speed(1.0)[1], difference, 1e-5)


def beside_a_solid(kind, method, *, first, moving=False):
    """A function of the scale of the start velocity, and of the walls' motion, to Σ v² after a step of a fluid beside a
    solid, which is in the walls' first corner or the last one, and to its derivative. The walls' impulse is the change
    of momentum that nothing else gives."""
    grid, at, dt = mpm.Grid((16, 14), 0.1, origin=(-4, -4)), 0.02, 2e-3
    cuts, laws = ((at, at + 0.15), (LAW, mpm.Fluid(1e4))) if first else ((at, at + 0.4), (mpm.Fluid(1e4), LAW))
    blocks = (mpm.Box((a, at), (b, at + 0.3)) for a, b in pairwise((*cuts, at + 0.7)))
    body = mpm.join(*(mpm.fill(box, grid, density=1e3) for box in blocks))
    body = dataclasses.replace(body, v=jnp.asarray(np.random.default_rng(0).normal(size=body.x.shape)) * 0.01)
    way = jnp.asarray([[0.0, 0.0], [4e-5, -2e-5]])
    walls = vessel(kind, (at, at), (at + 0.7, INF), mpm.Motion((0.0, dt), way) if moving else None)
    walls = walls[-2:]  # of colliders the floor and the last side: a third one takes XLA as long again
    scene = mpm.Scene(grid, laws, boundary=walls, gravity=(0.0, -1.0), boundary_forces=True)
    start = mpm.prepare(scene, body)

    def after(scale):
        scaled = dataclasses.replace(start, v=scale * start.v)
        of = scene
        if moving:
            of = eqx.tree_at(lambda s: [b.motion.displacement for b in s.boundary], scene, [scale * way] * len(walls))
        end, info = mpm.step(of, scaled, 0.0, dt, method=method)
        return (end.v**2).sum(), (end, info)

    both = (lambda scale: (after(scale), 0.0)) if first else jax.jit(jax.value_and_grad(after, has_aux=True))
    (_, (end, info)), _ = both(1.0)
    weight = dt * float(body.mass.sum()) * np.array([0.0, -1.0])
    change = (body.mass[:, None] * (end.v - body.v)).sum(axis=0)
    for felt in (info.boundaries, info.colliders):
        assert felt is None or np.allclose(weight - felt.impulse.sum(axis=0), change, rtol=1e-6, atol=0)
    return lambda scale: ((it := both(scale))[0][0], it[1])
