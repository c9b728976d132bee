"""Bodies that touch: the gap between them, what they give each other, friction, derivatives, bad input."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_files_hold, ids, slow, thorough

import mpmjax as mpm
from mpmjax.boundary import ConstrainedNodes, constrain
from mpmjax.boundary._body_contact import BodyContact, Coupling, Patch
from mpmjax.checks import canonical
from mpmjax.implicit import Projection
from mpmjax.potential import Displacement, Mirror
from mpmjax.stepping import start_nodes

LAW = mpm.NeoHookean(1e4, 0.3)
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


def stacked(d=2, *, gap=0.0, axis=-1, friction=0.3, speed=0.0, shift=0.0, cells=3, dx=0.1, order=2, law=LAW, **scene):
    """A block of some cells on a wider one, a gap between them [spacings], that comes and slides with a speed [m/s]."""
    grid = mpm.Grid((cells + 8,) * d, dx, origin=(-4,) * d)
    wide = np.full(d, (cells + 1) * dx)
    wide[axis] = 2 * dx
    top, start = np.full(d, cells * dx), np.zeros(d)
    start[axis], top[axis] = 2 * dx, 4 * dx
    lower = mpm.fill(mpm.Box((0.0,) * d, tuple(wide)), grid, density=1e3)
    upper = mpm.fill(mpm.Box(tuple(start), tuple(top)), grid, density=1e3)
    x = upper.x.at[:, axis].add(gap * dx).at[:, axis - 1].add(shift * dx)
    v = upper.v.at[:, axis].set(-speed).at[:, axis - 1].set(speed)
    particles = mpm.join(lower, dataclasses.replace(upper, x=x, v=v))
    kernel = mpm.BSpline(order)
    return mpm.Scene(grid, (law, law), kernel=kernel, bodies=mpm.Bodies(friction), **scene), particles


@eqx.filter_jit
def touching(scene, particles):
    """The contact of the first two bodies at the start, and the masses of all nodes."""
    scene = canonical(scene, particles.x.dtype)
    particles = mpm.prepare(scene, particles)
    nodes = start_nodes(scene, particles, 0.0, jnp.asarray(1e-3), scene.stencil(particles))
    (found,) = nodes.contacts
    return found, nodes.mass


def contact_of(scene, particles):
    """The contact of the first two bodies at the start, and the places of its nodes."""
    found, _ = touching(scene, particles)
    return found, scene.grid.nodes(scene.window(particles))[: len(found.gap)]


@pytest.mark.parametrize("seed", range(3))
def test_rounding_does_not_decide_where_bodies_touch(seed):
    """A node deep in a body that is a lattice has particles around it at a mean distance of zero."""
    scene, particles = stacked(gap=-0.05, speed=1.0, shift=0.3)
    noise = np.random.default_rng(seed).normal(size=particles.x.shape)
    moved = dataclasses.replace(particles, x=particles.x + 1e-15 * noise)
    one, other = (np.isfinite(touching(scene, p)[0].gap) for p in (particles, moved))
    assert one.any()
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("d", [2, *thorough(3)])
@pytest.mark.parametrize("order", [2, *thorough(3)])
def test_the_gap_is_the_distance_of_the_faces(d, order):
    """Between flat faces, at the nodes within half a spacing of the middle between them and a kernel's reach from the
    edges: to a part in a thousand of a spacing, with a normal across them. And whichever axis is across."""
    for axis, gap in ((d - 1, -0.07), (0, 0.0), (d - 1, 0.31)):
        scene, particles = stacked(d, gap=gap, axis=axis, cells=5, order=order)
        contact, x = contact_of(scene, particles)
        sides = np.delete(np.asarray(x), axis, axis=1)
        at = np.abs(np.asarray(x)[:, axis] - 0.2 - gap * 0.05) < 0.0501
        inside = at & (np.abs(sides - 0.25) < 0.0501 + 0.05 * (order == 2)).all(axis=1)
        assert inside.sum() >= 2
        assert_close(contact.gap[inside], np.full(inside.sum(), gap * 0.1), 0, 1e-4 if order == 2 else 2e-4)
        assert_close(contact.normal[inside, axis], -np.ones(inside.sum()), 1e-3)


def test_shares_of_the_surface_sum_to_it():
    """Σ_i k_i is α M/(2 dx) times the area on which two bodies of one law meet, that of the narrower one."""
    scene, particles = stacked(gap=0.0, cells=5)
    contact, _ = contact_of(scene, particles)
    total = float(contact.stiffness.sum()) / (2 * float(LAW.wave_modulus(jnp.eye(2)[..., None])[0]) / 2 / 0.1)
    assert 0.49 < total < 0.55  # at an edge the wider body counts too


def a_stencil():
    """That of two blocks."""
    scene, particles = stacked()
    return scene.stencil(particles)


def a_patch(grid, rng):
    """Nodes of which some have no weight."""
    m = int(np.prod(grid.shape))
    return Patch(jnp.asarray(rng.uniform(0, 1, m) * (rng.uniform(size=m) > 0.3)), grid.shape, grid.periodic)


@pytest.mark.parametrize(
    ("shape", "periodic"), [((4, 5), False), *thorough(((6,), True), ((4, 5, 4), (True, False, False)))]
)
def test_the_force_of_a_coupling_is_that_of_its_energy(shape, periodic):
    """f = −∂E/∂u, with its Hessian and diagonal; the two bodies' forces are opposite at each node."""
    rng, d, m = np.random.default_rng(0), len(shape), int(np.prod(shape))
    patch = a_patch(mpm.Grid(shape, 0.1, periodic=periodic), rng)
    across, normal = np.zeros((d, m)), rng.normal(size=(m, d))
    stretch = np.concatenate([rng.normal(size=(1, m)), across])
    stiffness = np.concatenate([rng.uniform(1, 2, (1, m)), across + rng.uniform(1, 2, m)])
    parts = stretch, stiffness, normal / np.linalg.norm(normal, axis=1, keepdims=True)
    own = Coupling(*(jnp.asarray(part) for part in parts), patch, (0, 2))
    u, du = (jnp.asarray(rng.normal(size=(3 * m, d))) for _ in range(2))

    stencil = a_stencil()  # which couplings do not need

    def moved(u):
        return Displacement(stencil, 3 * m, u.reshape(3 * m, d))

    def energy(u):
        return own.energy(moved(u))

    @jax.jit
    def both(u, du):
        force, change = jax.jvp(lambda u: own.force(moved(u)).nodes, (u,), (du,))
        hessian = jax.hessian(energy)(u.ravel())
        found = force, own(moved(du)).nodes, own.diagonal(stencil, 3 * m).nodes.reshape(-1)
        return found, (-jax.grad(energy)(u), -change, jnp.diag(hessian))

    found, expected = both(u, du)
    for one, other in zip(found, expected, strict=True):
        assert_close(one, other)
    layers = found[0].reshape(3, m, d)
    assert_close(layers[0], -layers[2])
    assert not layers[1].any()


def test_the_mean_over_a_patch():
    """That of a constant is the constant, wherever any of the nodes around has weight, and what is spread keeps its
    sum; a node beyond the window is none, and one across a period is."""
    rng = np.random.default_rng(1)
    for periodic in (False, (True, False)):
        grid = mpm.Grid((4, 5), 0.1, periodic=periodic)
        patch = a_patch(grid, rng)
        near = np.asarray(patch.total(patch.weight)) > 0
        assert near.sum() > 5
        assert_close(patch.mean(jnp.full((20, 2), 3.0))[near], np.full((near.sum(), 2), 3.0))
        amount = jnp.asarray(rng.normal(size=(20, 2)) * near[:, None])
        assert_close(patch.spread(amount).sum(axis=0), amount.sum(axis=0))
        weight, field = np.asarray(patch.weight).reshape(4, 5), rng.normal(size=(4, 5))
        rows = [3, 0, 1] if periodic else [0, 1]  # around the first
        block = np.ix_(rows, [1, 2, 3])
        found = patch.mean(jnp.asarray(field).reshape(-1, 1)).reshape(4, 5)[0, 2]
        assert_close(found, (weight * field)[block].sum() / weight[block].sum())


@pytest.mark.parametrize("method", **ids(METHODS, "semi_implicit"))
def test_bodies_that_meet_keep_momentum(method):
    """Linear and, with APIC in explicit steps, angular momentum to rounding, while they push and rub."""
    scene, particles = stacked(gap=-0.05, speed=1.0, shift=0.3)
    explicit = method.is_explicit
    dt = 1e-3 if explicit else 4e-3
    new, info = mpm.step(scene, particles, 0.0, dt, method=method)
    before, after = ((particles.mass[:, None] * p.v).sum(axis=0) for p in (particles, new))
    upper = slice(particles.sizes[0], None)
    slowed = (particles.mass[:, None] * (new.v - particles.v))[upper].sum(axis=0)
    assert slowed[1] > 0.003 * abs(before[1])  # they push
    assert slowed[0] < -0.0005 * abs(before[0])  # and rub
    assert_close(after, before, 1e-12 if explicit else 1e-9)
    if explicit:
        assert_close(spin(mpm.prepare(scene, new)), spin(mpm.prepare(scene, particles)), 1e-12, 1e-14)
        assert info.contact.sweeps == 0
    assert info.contact.violations == 0


def spin(particles):
    """Angular momentum about the origin, that of the affine velocity with it, for the quadratic kernel."""
    x, v, C, m = particles.x, particles.v, particles.C, particles.mass
    own = (C[:, 1, 0] - C[:, 0, 1]) * 0.1**2 / 4
    return (m * (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + own)).sum()


def test_bodies_that_do_not_touch_move_as_each_alone():
    """To rounding, though they share cells' nodes, a contact plane and a grip; of as many particles each, which is one
    program."""
    grip = mpm.Grip(mpm.Box((-0.1, -0.1), (0.05, 0.3)), mpm.Motion((0.0,), ((0.0, 0.0),)))
    walls = grip, mpm.ContactPlane(1, 0.0, friction=0.3)
    scene, particles = stacked(gap=0.4, speed=0.3, boundary=walls, gravity=(2.0, -9.81))
    both_wide, names = np.asarray(particles.x[:, 0]) < 0.3, ("x", "v", "mass", "volume")
    rows = [np.arange(particles.count)[group.rows][both_wide[group.rows]] for group in particles.groups]
    each = [mpm.Particles(**{name: getattr(particles, name)[own] for name in names}) for own in rows]
    both, _ = mpm.step(scene, mpm.join(*each), 0.0, 1e-3)
    alone = mpm.Scene(scene.grid, LAW, boundary=walls, gravity=(2.0, -9.81))
    for own, group in zip(each, both.groups, strict=True):
        new, _ = mpm.step(alone, own, 0.0, 1e-3)
        assert_close(both.v[group.rows], new.v)
        assert_close(both.x[group.rows], new.x)


@pytest.mark.thorough
def test_half_of_two_bodies_is_pushed_as_the_whole():
    """At a symmetry plane through nodes: the push makes the accelerations that it makes without the plane, but for what
    normals know of the side beyond."""
    grid = mpm.Grid((20, 16), 0.1, origin=(-10, -4))
    blocks = mpm.Box((-0.5, 0.0), (0.5, 0.2)), mpm.Box((-0.3, 0.19), (0.3, 0.39))
    found = []

    @eqx.filter_jit
    def pushes(scene, particles):
        nodes = start_nodes(scene, particles, 0.0, jnp.asarray(1e-3), scene.stencil(particles))
        contact = nodes.contacts[0]
        force = nodes.potential.on_nodes([contact.springs(contact.gap < 0).force(nodes.potential.displaced(None))])
        return nodes.per_mass(force)

    for plane in ((), mpm.SymmetryPlane(0, 0.0)):
        bodies = [mpm.fill(block, grid, density=1e3) for block in blocks]
        if plane:
            rows = [np.asarray(body.x[:, 0] > 0) for body in bodies]
            names = ("x", "v", "mass", "volume")
            bodies = [mpm.Particles(*(getattr(b, n)[own] for n in names)) for b, own in zip(bodies, rows, strict=True)]
        scene = mpm.Scene(grid, (LAW, LAW), boundary=plane, bodies=mpm.Bodies())
        scene, particles = canonical(scene, bodies[0].x.dtype), mpm.prepare(scene, mpm.join(*bodies))
        found.append(np.asarray(pushes(scene, particles)).reshape(2, 20, 16, 2)[:, 10:])
    assert abs(found[0]).max() > 10
    assert_close(found[1], found[0], 0, 3e-4 * abs(found[0]).max())


@eqx.filter_jit
def rubbed(scene, particles, v):
    """The contact of two bodies, the change of the nodes' velocity v by friction, and the components that are free."""
    nodes = start_nodes(scene, particles, 0.0, jnp.asarray(1e-3), scene.stencil(particles))
    (contact,) = nodes.contacts
    held = constrain(nodes, (contact.gap < 0,))
    return contact, contact.friction(held, held.active[0], jnp.zeros_like(v))(v), held.nodes.projection.free


def test_bodies_that_touch_do_so_beside_a_clamp_too():
    """The gap is that beside a symmetry plane: where bodies are is mirrored alike, only velocities are not. Friction
    changes neither what the plane holds nor what is along the normal."""
    gaps = []
    for plane in (mpm.SymmetryPlane, mpm.ClampPlane):
        scene, particles = stacked(gap=-0.1, boundary=plane(0, 0.0), friction=1.0)
        scene = canonical(scene, particles.x.dtype)
        v = jnp.asarray(np.random.default_rng(4).normal(size=(scene.grid.size, 2)))
        contact, change, free = rubbed(scene, mpm.prepare(scene, particles), v)
        gaps.append(contact.gap)
        assert abs(change[free]).max() > 0.02
        assert not change[~free].any()
        both = change.reshape(2, *contact.normal.shape)
        across = jnp.where(free.all(axis=1).reshape(2, -1), (both * contact.normal).sum(axis=2), 0)
        assert abs(across).max() < 1e-12
    np.testing.assert_array_equal(*gaps)


def test_springs_across_the_normal_hold_what_slips_by_less_than_friction_may_take():
    """f = min(1, μ|g|/(w Δt))², with the slip's velocity w, where bodies press; none where they do not yet."""
    speed = np.array([5.0, -5.0])  # of the upper body
    contact, _ = touching(*stacked(gap=-0.05, speed=5.0, shift=0.3))
    near, normal = np.asarray(contact.near), np.asarray(contact.normal)
    slip = np.linalg.norm(speed - normal * (normal @ speed)[:, None], axis=1)[near]
    grip = np.minimum(1, 0.3 * np.maximum(-contact.gap[near], 0) / (slip * 1e-3)) ** 2
    assert ((grip > 0.01) & (grip < 0.9)).any()
    assert_close(contact.grip[near], grip)


def test_bodies_share_what_friction_may_take_beside_springs():
    """Σ (μ k |g| − k f |s|) Δt in all where all slides, none where springs have taken more; each node in proportion to
    what it has left, opposite on the bodies and along the slip."""
    rng, m, dt, ones = np.random.default_rng(2), 9, 0.5, np.ones(9)
    along, normal = np.array([0.8, -0.6]), np.tile([0.6, 0.8], (m, 1))
    depth, stiffness, grip = rng.uniform(0.1, 2, m), rng.uniform(1, 2, m), rng.uniform(0.5, 1, m)
    numbers = (jnp.asarray(a) for a in (-depth, ones > 0, normal, stiffness, grip))
    contact = BodyContact(*numbers, 0.5, dt, 1.0, Patch(jnp.asarray(ones), (3, 3), (False, False)), (0, 1))
    nodes = SimpleNamespace(mass=jnp.ones(2 * m), projection=Projection(jnp.ones((2 * m, 2), bool)))
    stencil, still = a_stencil(), jnp.zeros((2 * m, 2))
    nodes.potential = SimpleNamespace(mirror=Mirror(()), displaced=lambda u: Displacement(stencil, 2 * m, u))
    nodes.per_mass = lambda impulse: impulse

    @jax.jit
    def rubbed(slip):
        held = ConstrainedNodes(nodes, (contact.near,), Mirror(()), nodes, still.at[:m].set(slip * along))
        return contact.friction(held, contact.near, still)(still.at[:m].set(1e3 * along))

    for slip in (0.3, 0.9):
        left = dt * stiffness * (0.5 * depth - grip * slip)
        rest = np.maximum(left, 0)
        assert (left.sum() > 0) == (slip == 0.3)
        assert 0 < (left < 0).sum() < m
        wanted = rest * max(left.sum(), 0) / rest.sum()
        upper, lower = np.asarray(rubbed(slip)).reshape(2, m, 2)
        assert_close(upper, -wanted[:, None] * along)
        assert_close(lower, -upper)


def slid(name, friction, *, steps, dt):
    """What a block has moved down a slab of 30 degrees, and how fast it is at half of the time and at its end."""
    law = mpm.NeoHookean(1e6, 0.3)
    grid = mpm.Grid((46, 16), 0.1, origin=(-3, -3))
    slab = mpm.fill(mpm.Box((0.0, 0.0), (4.0, 0.4)), grid, density=1e3)
    block = mpm.fill(mpm.Box((0.43, 0.4), (1.03, 0.8)), grid, density=1e3)
    particles, angle = mpm.join(slab, block), np.pi / 6
    gravity = (10 * np.sin(angle), -10 * np.cos(angle))
    held = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))
    scene = mpm.Scene(grid, (law, law), gravity=gravity, boundary=held, bodies=mpm.Bodies(friction))
    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=METHODS[name], save_every=steps // 2)
    rows = slice(particles.sizes[0], None)
    return run.frames.x[-1, rows].mean(axis=0) - block.x.mean(axis=0), run.frames.v[1:, rows].mean(axis=1)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["explicit", "semi_implicit", "implicit_midpoint", "trbdf2"])
def test_a_block_slides_down_a_slope_as_the_closed_form_says(name):
    """Δv = g t sin θ − μ (g t cos θ + Δv_n) within 1 %, from when it slides; what is in brackets is the push by the
    block's own momentum across the slope. Without vibrations that is Δv = g t (sin θ − μ cos θ)."""
    steps, dt = (420, 0.5 / 420) if name == "explicit" else (60, 0.5 / 60)
    _, v = slid(name, 0.3, steps=steps, dt=dt)
    gained, push = v[1] - v[0], 10 * np.cos(np.pi / 6) * 0.25 + (v[1] - v[0])[1]
    assert_close(gained[0], 10 * np.sin(np.pi / 6) * 0.25 - 0.3 * push, 1e-2)
    if name == "semi_implicit":
        assert_close(gained[0], 2.5 * (0.5 - 0.3 * np.cos(np.pi / 6)), 1e-2)


@pytest.mark.thorough
def test_a_block_rests_on_a_rough_slope():
    """tan 30° = 0.577 < 0.8: it does not slide, but for what the slab gives and while it bounces. With friction after
    the solve alone it moves by 44 mm."""
    moved, v = slid("semi_implicit", 0.8, steps=60, dt=0.5 / 60)
    assert abs(moved[0]) < 0.01 * 1.25  # of what it falls without friction
    assert abs(v[-1][0]) < 0.01 * 2.5


@pytest.mark.parametrize(
    ("method", "d"), [("explicit", 2), *thorough(("semi_implicit", 2), ("explicit", 3)), *slow(("semi_implicit", 3))]
)
def test_derivatives_of_a_touch_are_those_of_differences(method, d):
    """By friction, by a law, and by the place and speed of a body."""
    method = METHODS[method]
    scene, particles = stacked(d, gap=-0.05, speed=1.0, shift=0.3)
    dt, rows = 1e-3 if method.is_explicit else 4e-3, slice(particles.sizes[0], None)

    def end(numbers):
        friction, stiffer, place, speed = numbers
        own = eqx.tree_at(lambda s: s.bodies.friction, scene, friction)
        own = eqx.tree_at(lambda s: s.material[1].youngs_modulus, own, 1e4 * stiffer)
        moved = dataclasses.replace(
            particles,
            x=particles.x.at[rows, -1].add(0.1 * place),
            v=particles.v.at[rows].multiply(speed),
        )
        new = mpm.rollout(own, moved, steps=3, dt=dt, method=method)
        return (new.x * jnp.sin(jnp.arange(new.x.size)).reshape(new.x.shape)).sum() + (new.v**2).sum()

    at = jnp.array([0.1, 1.0, 0.0, 1.0])
    both, h = jax.jit(jax.value_and_grad(end)), 1e-5
    found = both(at)[1]
    differences = [(both(at.at[k].add(h))[0] - both(at.at[k].add(-h))[0]) / (2 * h) for k in range(4)]
    assert np.abs(np.asarray(differences)).min() > 1e-6
    for one, other in zip(found, differences, strict=True):
        assert_close(one, other, 1e-5)


@pytest.mark.thorough
def test_three_bodies_touch_each_other(tmp_path):
    """Each two of them; materials may share a body; a run comes back from its file."""
    grid = mpm.Grid((10, 16), 0.1, origin=(-4, -4))
    boxes = [mpm.Box((0.0, 0.3 * k), (0.3, 0.3 * k + 0.3)) for k in range(3)]
    particles = mpm.join(*(mpm.fill(box, grid, density=1e3) for box in boxes))
    scene = mpm.Scene(grid, (LAW,) * 3, bodies=mpm.Bodies())
    assert scene.grid.layers == 3
    two = mpm.Scene(grid, (LAW,) * 3, bodies=mpm.Bodies(of_materials=(0, 1, 0)))
    assert two.grid.layers == 2
    squeezed = dataclasses.replace(particles, x=particles.x * jnp.array([1.0, 0.98]))
    new, info = mpm.step(scene, squeezed, 0.0, 1e-3)
    v = np.stack([new.v[k * 36 : k * 36 + 36, 1].mean() for k in range(3)])
    assert v[0] < 0 < v[2]
    assert abs(v.sum()) < 1e-12 * v[2]
    assert info.contact.violations == 0
    assert_files_hold(tmp_path / "run.h5", mpm.simulate(two, squeezed, t1=2e-3, dt=1e-3))


def test_the_longest_step_knows_of_bodies():
    """Of bodies of one law it is √½ of that without contact while they are apart, and by the springs that there are
    where they touch, 0.63."""
    scene, particles = stacked()
    alone = mpm.Scene(scene.grid, scene.material)
    ratio = float(mpm.stable_dt(scene, particles) / mpm.stable_dt(alone, particles))
    assert 0.6 < ratio < 0.66
    apart = dataclasses.replace(particles, x=particles.x.at[: particles.sizes[0], 1].add(-0.25))
    ratio = float(mpm.stable_dt(scene, apart) / mpm.stable_dt(alone, apart))
    assert 0.7 < ratio < 0.78


def test_torn_snow_that_has_lost_its_stiffness_lies_on_a_body():
    """It has nearly no modulus and its whole mass, and the steps that `stable_dt` gives hold it."""
    scene, particles = stacked(gap=0.2, law=mpm.Snow(1e5, 0.2), gravity=(0.0, -10.0))
    held = mpm.StickyBox((-np.inf, 0.1), (np.inf, np.inf))
    scene = dataclasses.replace(scene, boundary=held)
    particles = mpm.prepare(scene, particles)
    upper = slice(particles.sizes[0], None)
    torn = eqx.tree_at(lambda p: p.histories[1].plastic_volume, particles, jnp.full(particles.sizes[1], 9.0))
    final = mpm.rollout(scene, torn, steps=400, dt=1e-3)
    assert float(final.x[upper, 1].min()) > 0.15


def two_round_bodies(d, dx, *, nu=0.3, by=(0.0, 0.0, 0.0)):
    """Two of 0.6 m diameter that meet at 1 m/s."""
    cells = round(0.6 / dx)
    shape = (3 * cells + 4, *(2 * cells,) * (d - 1))
    grid, law = mpm.Grid(shape, dx, origin=[-n // 2 for n in shape]), mpm.NeoHookean(1e5, nu)
    centres = [np.array((0.33 * s, 0.02 * s, 0.01)) + np.array(by) * dx for s in (-1, 1)]
    two = [
        mpm.fill(mpm.Ball(tuple(c[:d]), 0.3), grid, density=1e3, velocity=(-0.5 * s, 0.0, 0.0)[:d])
        for c, s in zip(centres, (-1, 1), strict=True)
    ]
    scene = mpm.Scene(grid, (law, law), bodies=mpm.Bodies())
    return scene, mpm.prepare(scene, mpm.join(*two))


@pytest.mark.parametrize(
    ("d", "by", "share"),
    [(2, (0.0, 0.0, 0.0), 1.0), *thorough((2, (0.31, 0.17, 0.0), 0.25), (3, (0.0, 0.0, 0.0), 1.0))],
)
def test_small_round_bodies_make_no_energy(d, by, share):
    """Bodies of six cells that meet and part: never more energy than they brought, and the work of the push, which all
    of a touch is none but for what the gap's places on the lattice make, is less than a twentieth of it."""
    scene, particles = two_round_bodies(d, 0.1, by=by)
    dt = share * float(mpm.stable_dt(scene, particles))
    new, found = mpm.budget(scene, particles, steps=round(0.35 / dt), dt=dt)
    start = float(mpm.energy(scene, particles).total)
    most = np.cumsum(np.asarray(found.energy.change)).max() / start
    work = np.cumsum(np.asarray(found.energy.boundary)) / start
    assert most < 1e-3
    assert work.min() < -0.02  # they were pressed
    assert abs(work[-1]) < 0.05
    assert abs(np.asarray(found.energy.solver).sum()) < 1e-12 * start  # the push is all that boundaries do
    assert float(new.x[: particles.sizes[0], 0].max()) < float(new.x[particles.sizes[0] :, 0].min())


@eqx.filter_jit
def fastest(coupling, mass):
    """The largest ω² [1/s²] of springs between nodes of these masses."""
    root = jnp.where(mass > 0, 1 / jnp.sqrt(jnp.where(mass > 0, mass, 1)), 0)[:, None]

    stencil = a_stencil()  # which couplings do not need

    def resisted(u):
        return root * coupling(Displacement(stencil, len(mass), root * u)).nodes

    def power(_, u):
        v = resisted(u)
        return v / jnp.sqrt((v**2).sum())

    start = root * jnp.asarray(np.random.default_rng(0).normal(size=(len(mass), 2)))
    u = jax.lax.fori_loop(0, 60, power, start)
    return (u * resisted(u)).sum()


def test_springs_between_bodies_are_no_stiffer_than_the_longest_step_knows():
    """The largest ω² of the springs alone is 4 k/(ρ dx²) at most, wherever on the lattice two blocks touch; at their
    edges a hundredth more."""
    rng = np.random.default_rng(2)
    bound = 4 * 2 * float(LAW.wave_modulus(jnp.eye(2)[..., None])[0]) / 2 / 1e3 / 0.1**2
    most = []
    for _ in range(8):
        scene, particles = stacked(gap=-0.1 * rng.uniform(), shift=rng.uniform(), cells=4)
        by = jnp.asarray(rng.uniform(-0.05, 0.05, 2))
        contact, mass = touching(scene, dataclasses.replace(particles, x=particles.x + by))
        most.append(float(fastest(contact.springs(jnp.ones(contact.gap.shape, bool)), mass)) / bound)
    assert 0.5 < max(most) < 1.02


@pytest.mark.thorough
@pytest.mark.parametrize("volume", [None, mpm.AveragedVolume()], ids=["own", "averaged"])
def test_nearly_incompressible_balls_part_again(volume):
    """In three dimensions, at ν = 0.49: with the momentum that they had, and less energy."""
    grid, law = mpm.Grid((16, 10, 10), 0.1, origin=(-8, -5, -5)), mpm.NeoHookean(1e5, 0.49)
    places = ((-0.21, -0.02, 0.01), (0.5, 0.0, 0.0)), ((0.21, 0.02, 0.01), (-0.5, 0.0, 0.0))
    two = [mpm.fill(mpm.Ball(x, 0.2), grid, density=1e3, velocity=v) for x, v in places]
    scene = mpm.Scene(grid, (law, law), bodies=mpm.Bodies(0.2), volume=volume)
    particles = mpm.prepare(scene, mpm.join(*two))
    new = mpm.rollout(scene, particles, steps=400, dt=8e-4)
    mass = particles.mass[:, None]
    assert_close((mass * new.v).sum(axis=0), jnp.zeros(3), 0, 1e-13 * float((mass * abs(particles.v)).sum()))
    assert mpm.energy(scene, new).total < mpm.energy(scene, particles).total
    left, right = slice(0, two[0].count), slice(two[0].count, None)
    assert new.x[left, 0].max() + 0.02 < new.x[right, 0].min()
    assert new.v[left, 0].mean() < -0.1


BAD = {
    "one material": (lambda: mpm.Scene(mpm.Grid((8, 8), 0.1), LAW, bodies=mpm.Bodies()), "two or more"),
    "a number left out": (
        lambda: mpm.Scene(mpm.Grid((8, 8), 0.1), (LAW, LAW), bodies=mpm.Bodies(of_materials=(0, 2))),
        "none left out",
    ),
    "negative friction": (lambda: mpm.Bodies(-0.1), "friction"),
    "the total description": (
        lambda: mpm.Scene(mpm.Grid((8, 8), 0.1), (LAW, LAW), bodies=mpm.Bodies(), description=mpm.TotalLagrangian()),
        "no contact",
    ),
    "the linear kernel": (
        lambda: mpm.Scene(mpm.Grid((8, 8), 0.1), (LAW, LAW), bodies=mpm.Bodies(), kernel=mpm.BSpline(1)),
        "kernel",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_bodies_are_refused(case):
    make, words = BAD[case]
    with pytest.raises(ValueError, match=words):
        make()
