"""Boundaries: exact on the nodes they act on, also inside the implicit solves."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, KERNELS, LAWS, assert_close, cloud, ids, thorough
from numpy_oracle import grid_update

import mpmjax as mpm
from mpmjax.boundary import combined_conditions, mirror
from mpmjax.potential import Mirror, wall_image

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12)),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT)),
    "trbdf2": mpm.TRBDF2(0.0, mpm.implicit.Linearised(TIGHT)),
}
DX, DT = 0.1, 1e-2


def scene_of(grid, *boundary, **options):
    """A scene of the random cloud's grid, with gravity."""
    options = {"gravity": (1.0, -9.81, 2.0)[: grid.dim]} | options
    return mpm.Scene(grid, LAWS["fixed_corotated"], boundary=boundary, **options)


@pytest.mark.parametrize("method", **ids(METHODS, "semi_implicit"))
def test_walls_and_grips_hold_exactly_on_their_nodes(method):
    """Sticky: every component, slip: the normal one, grip: its own velocity on its axes; all others are free."""
    grid, particles = cloud(2)
    region, motion = mpm.Box((0.25, 0.15), (0.41, 0.31)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.7, -0.4)))
    slip, sticky = mpm.SlipBox((0.1, -np.inf), (np.inf, 0.5)), mpm.StickyBox((-np.inf, 0.0), (0.6, np.inf))
    grip = mpm.Grip(region, motion, axes=(False, True))
    step = grid_update(scene_of(grid, sticky, slip, grip), particles, DT, method)
    x, v, mass = np.asarray(step.position), np.asarray(step.velocity), np.asarray(step.nodes.mass)
    stuck = (x[:, 1] < 1e-9) | (x[:, 0] > 0.6 - 1e-9)
    slipping = np.stack([x[:, 0] < 0.1 + 1e-9, x[:, 1] > 0.5 - 1e-9], axis=1) & ~stuck[:, None]
    gripped = (np.abs(x - [0.33, 0.23]) < 0.081).all(axis=1)
    assert step.info.solve.converged
    for held in (stuck, slipping[:, 0], slipping[:, 1], gripped):
        assert (mass[held] > 0).any()
    assert (v[stuck] == 0).all()
    assert (v[slipping] == 0).all()
    assert_close(v[gripped, 1], np.full(gripped.sum(), -0.4), 1e-15)
    free = (mass > 0)[:, None] & ~(stuck[:, None] | slipping | (gripped[:, None] & [False, True]))
    assert (np.abs(v[free]) > 1e-6).all()


@pytest.mark.parametrize(("description", "reached"), [("updated", 0.3), *thorough(("total", 0.1))])
def test_a_grip_moves_with_its_motion_or_stays_in_the_reference(description, reached):
    """At t the updated description's grip holds the nodes where it is now, the total one's those where it began."""
    grid, particles = cloud(2)
    motion = mpm.Motion((0.0, 1.0, 2.0), ((0.0, 0.0), (0.2, 0.0), (0.1, 0.3)))
    grip = mpm.Grip(mpm.Box((0.1, -np.inf), (0.2, np.inf)), motion)
    scene = scene_of(grid, grip, description=DESCRIPTIONS[description])
    step = grid_update(scene, particles, 0.5, mpm.Explicit(), t=1.0)
    fixed = np.asarray(step.nodes.conditions.fixed)
    x = np.asarray(step.position)[:, 0]
    np.testing.assert_array_equal(fixed.all(axis=1), (x > reached - 1e-9) & (x < reached + 0.1 + 1e-9))
    held = fixed.all(axis=1)
    assert_close(step.velocity[held], np.broadcast_to([-0.1, 0.3], (held.sum(), 2)), 1e-14)


def test_a_motion_is_piecewise_linear_and_rests_outside_its_times():
    """Its velocity is the mean over the step, across corners too."""
    motion = mpm.Motion((1.0, 2.0, 4.0), ((0.0, 0.0), (1.0, 0.0), (1.0, -4.0)))
    for t, dt, velocity in [
        (0.0, 1.0, (0, 0)),
        (1.25, 0.5, (1, 0)),
        (1.5, 1.0, (0.5, -1)),
        (3.0, 0.5, (0, -2)),
        (4.0, 9.0, (0, 0)),
    ]:
        assert_close(motion.velocity(t, dt), np.array(velocity, float), 1e-15)
    assert_close(motion.at(3.0), np.array([1.0, -2.0]), 1e-15)


@pytest.mark.thorough
def test_a_node_within_a_thousandth_of_a_spacing_of_a_wall_is_on_it():
    """Of boxes, grips and colliders, from either side; a plane may lie off the half lattice by half as much."""
    grid = mpm.Grid((8,), DX)
    nodes, rest = grid.nodes(grid.window(jnp.zeros((1, 1)))), mpm.Motion((0.0,), ((0.0,),))
    boxes = mpm.StickyBox, mpm.SlipBox
    for share, met in ((0.9e-3, 2), (1.1e-3, 1)):
        lower, upper = (2 - share) * DX, (5 + share) * DX  # nodes 2 and 5 are just within; 0, 1, 6 and 7 beyond
        for box in boxes:
            found = combined_conditions((box((lower,), (upper,)),), nodes, DX, 0.0, 0.1, reference=False)
            np.testing.assert_array_equal(
                found.fixed[:, 0], np.isin(np.arange(8), [0, 1, 6, 7, *([2, 5] if met == 2 else [])])
            )
        between = mpm.Box(((2 + share) * DX,), ((5 - share) * DX,))
        for holds in (mpm.Grip(between, rest), mpm.StickyCollider(between), mpm.SlipCollider(between)):
            found = combined_conditions((holds,), nodes, DX, 0.0, 0.1, reference=False)
            np.testing.assert_array_equal(found.touched, np.isin(np.arange(8), [3, 4, *([2, 5] if met == 2 else [])]))
    for plane in (mpm.SymmetryPlane, mpm.ClampPlane, mpm.ContactPlane):
        scene_of(grid, plane(0, (2.5 + 0.45e-3) * DX))
        with pytest.raises(ValueError, match="half the grid's spacing"):
            scene_of(grid, plane(0, (2.5 + 0.55e-3) * DX))


def test_the_earlier_boundary_wins():
    """Where two prescribe one component; components that only the later one prescribes are its own."""
    grid = mpm.Grid((6, 6), DX)
    nodes = grid.nodes(grid.window(jnp.zeros((1, 2))))
    motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (2.0, 3.0)))
    grip = mpm.Grip(mpm.Box((-np.inf, -np.inf), (0.15, np.inf)), motion)
    slip = mpm.SlipBox((-np.inf, 0.0), (0.1, np.inf))
    rule = [(grip, slip), (slip, grip)]
    first, second = (np.asarray(combined_conditions(b, nodes, DX, 0.0, 0.1, reference=False).velocity) for b in rule)
    x = np.asarray(nodes)
    both = np.isclose(x[:, 0], 0.1)
    assert_close(first[both], np.broadcast_to([2.0, 3.0], (6, 2)), 1e-14)
    np.testing.assert_allclose(second[both & (x[:, 1] > 0.05)], np.broadcast_to([0.0, 3.0], (5, 2)), atol=1e-14)
    np.testing.assert_allclose(second[both & (x[:, 1] < 0.05)], np.zeros((1, 2)), atol=1e-14)
    np.testing.assert_allclose(first[x[:, 0] > 0.15][:, 0], 0)


# Two planes, at a node and half-way between two, that keep opposite sides.
PLANES = (mpm.SymmetryPlane(0, 0.3, keep="above"), mpm.SymmetryPlane(1, 0.55, keep="below"))


@eqx.filter_jit
def reflected(plane, a):
    """A particle array with the mirror images appended."""
    sign = jnp.ones(2).at[plane.axis].set(-1)
    match a.ndim:
        case 1:
            image = a
        case 2:
            image = a * sign
        case _:
            image = a * sign[:, None] * sign
    return jnp.concatenate([a, image])


def with_images(planes, particles):
    """The full model of a half one."""
    for plane in planes:
        shift = jnp.zeros(2).at[plane.axis].set(plane.position)
        arrays = {k: getattr(particles, k) for k in ("x", "v", "mass", "volume", "F", "C")}
        arrays["x"] = arrays["x"] - shift
        arrays = {k: reflected(plane, a) for k, a in arrays.items()}
        place = arrays["x"] + shift
        particles = mpm.Particles(deformations=(arrays.pop("F"),), **arrays | {"x": place, "X": place})
    return particles


MIRROR_CASES = [
    ("quadratic", "explicit", "updated"),
    *thorough(
        *((k, "explicit", "updated") for k in KERNELS if k != "quadratic"), ("quadratic", "semi_implicit", "updated")
    ),
    *(pytest.param(k, "semi_implicit", "updated", marks=pytest.mark.slow) for k in ("linear", "cubic")),
    *(pytest.param("quadratic", k, "updated", marks=pytest.mark.slow) for k in list(METHODS)[2:]),
    *thorough(("quadratic", "semi_implicit", "total")),
]


@pytest.mark.parametrize(("kernel", "method", "description"), MIRROR_CASES)
def test_a_mirrored_half_equals_the_full_model(kernel, method, description):
    """Planes at a node and half-way between nodes, above and below, to 1e-10 over three steps."""
    _, particles = cloud(2)
    move = jnp.array([0.31, -0.06])  # beyond the first plane, below the second
    x = particles.x + move
    quarter = eqx.tree_at(lambda p: (p.x, p.X, p.v), particles, (x, x, 0.2 * particles.v))
    assert (np.abs(np.asarray(quarter.x) - [0.3, 0.55]).min(axis=0) < DX / 2).all()  # both planes are felt
    grid = mpm.Grid((24, 24), DX, origin=(-9, -6))
    options = {"kernel": KERNELS[kernel], "description": DESCRIPTIONS[description], "gravity": (0.0, 0.0)}
    run = {"steps": 3, "dt": 5e-3, "method": METHODS[method]}
    half = mpm.rollout(scene_of(grid, *PLANES, **options), quarter, **run)
    full = mpm.rollout(scene_of(grid, **options), with_images(PLANES, quarter), **run)
    for name in ("x", "v", "F", "C"):
        assert_close(getattr(full, name)[: quarter.count], getattr(half, name), 1e-10)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_fold_is_the_transpose_of_unfold(d):
    """B and Bᵀ as dense matrices; a fold brings all mass to the true nodes."""
    grid = mpm.Grid((7, 6, 5)[:d], DX)
    images: Mirror = mirror((mpm.SymmetryPlane(0, 0.2),), grid, grid.window(jnp.zeros((1, d))))
    size = grid.size * d
    basis = jnp.eye(size).reshape(size, grid.size, d)
    B, transpose = (np.asarray(jax.vmap(f)(basis)).reshape(size, size).T for f in (images.unfold, images.fold))
    np.testing.assert_array_equal(B.T, transpose)
    # nodes 0, 1 mirror 4, 3; node 2 lies on the plane
    v = np.random.default_rng(0).normal(size=(*grid.shape, d))
    out = np.asarray(images.unfold(jnp.asarray(v.reshape(-1, d)))).reshape(v.shape)
    np.testing.assert_array_equal(out[2:, ..., 1:], v[2:, ..., 1:])
    np.testing.assert_array_equal(out[3:, ..., 0], v[3:, ..., 0])
    np.testing.assert_array_equal(out[:2, ..., 1:], v[[4, 3], ..., 1:])
    np.testing.assert_array_equal(
        out[:3, ..., 0], -v[[4, 3, 2], ..., 0] * np.array([1, 1, 0]).reshape(-1, *[1] * (d - 1))
    )
    mass = np.arange(1.0, grid.size + 1).reshape(grid.shape)
    folded = np.asarray(images.fold_scalar(jnp.asarray(mass.reshape(-1)))).reshape(grid.shape)
    np.testing.assert_array_equal(folded[:2], 0)
    np.testing.assert_array_equal(folded[2:5], mass[2:5] + np.stack([0 * mass[0], mass[1], mass[0]]))


@pytest.mark.parametrize("keep", ["above", "below"])
def test_what_has_no_image_in_the_window_is_still(keep):
    """Nodes beyond a plane so near the window's end that theirs lie outside of it: no velocity, and no mass."""
    grid = mpm.Grid((7,), DX)
    position, ghosts, known = {"above": (0.55, [0, 1, 2, 3, 4, 5], [5]), "below": (0.05, [1, 2, 3, 4, 5, 6], [1])}[keep]
    images = mirror((mpm.SymmetryPlane(0, position, keep),), grid, grid.window(jnp.zeros((1, 1))))
    v, true = np.arange(1.0, 8.0), {"above": 6, "below": 0}[keep]
    expected = np.zeros(7)
    expected[true], expected[known] = v[true], -v[true]
    np.testing.assert_array_equal(images.unfold(jnp.asarray(v[:, None]))[:, 0], expected)
    np.testing.assert_array_equal(images.unfold_scalar(jnp.asarray(v)), np.abs(expected))
    assert set(np.flatnonzero(expected)) <= {true, *ghosts}


@pytest.mark.thorough
def test_fold_is_the_transpose_of_unfold_where_some_columns_are_held():
    """Two planes that meet, with random columns of either: every node is itself or follows one; no mass is lost.
    Behind the walls B = ξ/ξ_b is negative, on them it is zero."""
    grid, rng = mpm.Grid((7, 6), DX), np.random.default_rng(0)
    columns = [np.broadcast_to(rng.random((1, 6)) < 0.5, (7, 6)), np.broadcast_to(rng.random((7, 1)) < 0.5, (7, 6))]
    window = grid.window(jnp.zeros((1, 2)))
    walls = [wall_image(0, 0.2, 1, grid, window, order=2), wall_image(1, 0.35, -1, grid, window, order=2)]
    held = [jnp.asarray(columns[0][None, :1, :, None]), jnp.asarray(columns[1][None, :, :1, None])]
    images = Mirror(tuple(dataclasses.replace(w, held=h) for w, h in zip(walls, held, strict=True)))
    basis = jnp.eye(84).reshape(84, 42, 2)
    B, transpose = (np.asarray(jax.vmap(f)(basis)).reshape(84, 84).T for f in (images.unfold, images.fold))
    np.testing.assert_array_equal(B.T, transpose)
    assert ((B != 0).sum(axis=1) <= 1).all()
    assert set(np.unique(B.round(12))) == {-3, -2, -1, 0, 1}
    free = ~columns[0] & ~columns[1]
    np.testing.assert_array_equal(B[np.repeat(free.ravel(), 2)], np.eye(84)[np.repeat(free.ravel(), 2)])
    mass = jnp.asarray(rng.random(42))
    lost = float(mass.sum() - images.fold_scalar(mass).sum())
    beyond = np.zeros((7, 6))  # nodes whose image lies outside the window: none below 0.2, above 0.35 rows of it
    assert abs(lost - float((np.asarray(mass).reshape(7, 6) * beyond).sum())) < 1e-12


@pytest.mark.parametrize("kernel", **ids(KERNELS, "quadratic"))
def test_a_column_hangs_in_its_own_weight_from_a_symmetry_plane(kernel):
    """u = ρg (X − X²/2)/(λ + 2μ): nothing moves but for the quadrature of the weights, half a per cent of g, since the
    plane's mirror image is pulled the other way."""
    cells, g, modulus = 8, -10.0, 1e5
    grid = mpm.Grid((cells + 8,), 1 / cells, origin=(-3,))
    rest = mpm.fill(mpm.Box((0.0,), (1.0,)), grid, particles_per_cell=2, density=1e3)
    X = rest.x[:, 0]
    u, strain = 1e3 * g / modulus * (X - X**2 / 2), 1e3 * g / modulus * (1 - X)
    particles = mpm.Particles(
        (X + u)[:, None], rest.v, rest.mass, rest.volume, ((1 + strain)[:, None, None],), X=rest.x
    )
    scene = mpm.Scene(
        grid,
        mpm.FixedCorotated(modulus, 0.0),
        gravity=(g,),
        boundary=mpm.SymmetryPlane(0, 0.0),
        kernel=kernel,
        gradient=mpm.MLSGradient(),
        description=mpm.TotalLagrangian(),
    )
    after, _ = mpm.step(scene, particles, 0.0, 1e-6)
    assert float(jnp.abs(after.v[: 2 * cells - 2]).max()) < 6e-3 * abs(g) * 1e-6


@pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
def test_a_periodic_body_may_straddle_the_seam(method):
    """Moved by whole spacings across it, or by a whole period, it moves as in the middle; momentum is conserved."""
    _, particles = cloud(2)
    grid = mpm.Grid((12, 12), DX, periodic=(True, True))
    scene = scene_of(grid, gravity=(0.0, 0.0))
    particles = eqx.tree_at(lambda p: p.x, particles, particles.x + 0.3)
    run = {"steps": 5, "dt": 5e-3, "method": method}
    here = mpm.rollout(scene, particles, **run)
    for shift in ([0.5, -0.4], [1.2, -2.4]):
        moved = eqx.tree_at(lambda p: p.x, particles, particles.x + jnp.array(shift))
        there = mpm.rollout(scene, moved, **run)
        assert_close(there.x - jnp.array(shift), here.x, 1e-12)
        for name in ("v", "F", "C"):
            assert_close(getattr(there, name), getattr(here, name), 1e-11)
    assert np.abs(np.asarray(here.v - particles.v)).max() > 0.1
    assert_close(here.mass @ here.v, particles.mass @ particles.v, 1e-12)


def test_particles_feel_each_other_across_the_seam():
    """Two particles in neighbouring cells on its two sides exchange momentum; without periodicity they cannot."""
    x, v = jnp.array([[0.03], [1.17]]), jnp.array([[1.0], [-1.0]])
    one = jnp.ones(2)
    pair = mpm.Particles(x, v, one, 0.05 * one, C=jnp.zeros((2, 1, 1)))
    new, _ = mpm.step(scene_of(mpm.Grid((12,), DX, periodic=True)), pair, 0.0, 1e-3)
    assert np.abs(np.asarray(new.v[:, 0] - v[:, 0] - 1e-3)).min() > 0.05


BAD = {
    "off the half lattice": (lambda g: scene_of(g, mpm.SymmetryPlane(0, 0.13)), "half the grid's spacing"),
    "axis beyond the grid": (lambda g: scene_of(g, mpm.SymmetryPlane(2, 0.1)), "axis must be below 2"),
    "plane in a periodic direction": (
        lambda g: scene_of(mpm.Grid((8, 8), DX, periodic=(True, False)), mpm.SymmetryPlane(0, 0.1)),
        "periodic",
    ),
    "separation in the total description": (
        lambda g: scene_of(g, mpm.SeparatingBox((0, 0), (1, 1)), description=mpm.TotalLagrangian()),
        "no contact",
    ),
    "contact in the total description": (
        lambda g: scene_of(g, mpm.ContactPlane(0, 0.1), description=mpm.TotalLagrangian()),
        "no contact",
    ),
    "contact off the half lattice": (lambda g: scene_of(g, mpm.ContactPlane(0, 0.13)), "use SeparatingBox"),
    "contact in a periodic direction": (
        lambda g: scene_of(mpm.Grid((8, 8), DX, periodic=(True, False)), mpm.ContactPlane(0, 0.1)),
        "periodic",
    ),
    "friction of a contact plane below zero": (lambda g: mpm.ContactPlane(0, 0.1, friction=-0.1), "friction"),
    "side of a contact plane": (lambda g: mpm.ContactPlane(0, 0.1, keep="left"), "above"),
    "particles beyond the contact plane": (
        lambda g: mpm.prepare(scene_of(g, mpm.ContactPlane(0, 0.3)), cloud(2)[1]),
        "above the ContactPlane",
    ),
    "dimension of a wall": (lambda g: scene_of(g, mpm.StickyBox((0,), (1,))), "2 coordinates"),
    "dimension of gravity": (lambda g: scene_of(g, gravity=(1.0,)), "gravity must have 2"),
    "dimension of a grip": (
        lambda g: mpm.Grip(mpm.Box((0,), (1,)), mpm.Motion((0.0,), ((0.0, 0.0),))),
        "same dimension",
    ),
    "dimension of a grip in the scene": (
        lambda g: scene_of(g, mpm.Grip(mpm.Box((0, 0, 0), (1, 1, 1)), mpm.Motion((0.0,), ((0.0,) * 3,)))),
        "2",
    ),
    "no axis of a grip": (
        lambda g: mpm.Grip(mpm.Box((0, 0), (1, 1)), mpm.Motion((0.0,), ((0.0, 0.0),)), axes=(False, False)),
        "at least one",
    ),
    "times that fall": (lambda g: mpm.Motion((1.0, 0.0), ((0.0,), (1.0,))), "increase"),
    "corners swapped": (lambda g: mpm.SlipBox((1, 0), (0, 1)), "below"),
    "friction below zero": (lambda g: mpm.SeparatingBox((0, 0), (1, 1), friction=-0.1), "friction"),
    "side of a plane": (lambda g: mpm.SymmetryPlane(0, 0.1, keep="left"), "above"),
    "particles beyond the plane": (
        lambda g: mpm.prepare(scene_of(g, mpm.SymmetryPlane(0, 0.3)), cloud(2)[1]),
        "particle",
    ),
    "particles outside the window": (lambda g: mpm.prepare(scene_of(mpm.Grid((5, 5), DX)), cloud(2)[1]), "window"),
}


@pytest.mark.parametrize(("make", "message"), **ids(BAD))
def test_bad_boundaries_are_refused(make, message):
    """With a ValueError that says what must hold."""
    with pytest.raises(ValueError, match=message):
        make(cloud(2)[0])


# --- what gets through -----------------------------------------------------------------------------------------------


def floors(d):
    """Every kind of boundary that keeps material above the last coordinate's zero, or a little above or below it."""
    below = (-np.inf,) * (d - 1)
    deep = (-9.0,) * (d - 1), (9.0,) * (d - 1)
    slab, plate = (mpm.Box((*deep[0], bottom), (*deep[1], 0.0)) for bottom in (-9.0, -0.2))
    rising = mpm.Motion((0.0, 1.0), ((0.0,) * d, (0.0,) * (d - 1) + (1.0,)))
    return {
        "sticky": mpm.StickyBox((*below, 0.0), (np.inf,) * d),
        "slip": mpm.SlipBox((*below, -0.03), (np.inf,) * d),
        "separating": mpm.SeparatingBox((*below, 0.0), (np.inf,) * d, 0.3),
        "symmetry": mpm.SymmetryPlane(d - 1, 0.0),
        "contact": mpm.ContactPlane(d - 1, 0.05, friction=0.3),
        "sticky_collider": mpm.StickyCollider(slab, rising),
        "slip_collider": mpm.SlipCollider(mpm.HalfSpace((0.0,) * d, (0.0,) * (d - 1) + (2.0,)), rising),
        "separating_collider": mpm.SeparatingCollider(mpm.Ball((0.2,) * (d - 1) + (-4.0,), 4.0), friction=0.1),
        "plate": mpm.SeparatingCollider(plate),
    }


FLOORS = [
    *((2, name, "explicit") for name in floors(2)),
    *((1, name, "explicit") for name in ("sticky", "symmetry", "sticky_collider")),
    *((2, name, "semi_implicit") for name in ("slip", "contact", "separating_collider")),
    *(pytest.param(3, name, "explicit", marks=pytest.mark.slow) for name in ("separating", "slip_collider")),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("d", "name", "method"), FLOORS)
def test_what_passes_a_boundary_is_named(d, name, method):
    """At 2.5 and 5 cells a step a block ends beyond each kind of boundary; at up to 0.9 it does not, but for the less
    than a cell and a half in which a particle's stencil has nodes that are free."""
    floor, steps, dt = floors(d)[name], 24, 1e-3
    grid = mpm.Grid((10,) * (d - 1) + (150,), DX, origin=(-3,) * (d - 1) + (-130,))
    low, high = (0.0,) * (d - 1) + (0.61,), (0.4,) * (d - 1) + (1.01,)
    block = mpm.fill(mpm.Box(low, high), grid, particles_per_cell=2**d, density=1e3)
    scene = mpm.Scene(grid, LAWS["fixed_corotated"], boundary=floor)

    def thrown(cells, throw=True):
        v = block.v.at[:, -1].set(-cells * DX / dt)
        fast = eqx.tree_at(lambda b: b.v, block, v)
        return mpm.simulate(scene, fast, t1=steps * dt, dt=dt, method=METHODS[method], throw=throw)

    for cells in (0.4, 0.9):
        run = thrown(cells, throw=False)
        assert int(run.statistics.fault) in (
            mpm.simulation.Fault.NONE,
            mpm.simulation.Fault.COLLAPSED,
        )  # it is thrown far beyond its sound
        assert float(run.final.x[:, -1].min()) > -1.5 * DX
    for cells in (2.5, 5.0):
        with pytest.raises(mpm.SimulationError, match=rf"At step \d+ .* passed boundary 0, {type(floor).__name__}"):
            thrown(cells)


@pytest.mark.parametrize("inward", [1, -1])
def test_how_deep_a_moving_wall_lets_a_particle_come_is_counted_from_the_nodes(inward):
    """To where no node of its stencil is free: 1.5 spacings before the first free node, wherever the wall has moved."""
    wide, corner = (np.inf,) * 2, (0.0, 0.0)
    lower, upper = (corner, wide) if inward == 1 else (tuple(-a for a in wide), corner)
    wall = mpm.SlipBox(lower, upper, mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.09 * inward, 0.0))))
    start = jnp.array([[0.0, 1.0], [0.0, 1.0]]) * inward
    end = jnp.array([[-0.049, 1.0], [-0.051, 1.0]]) * inward  # the node at 0 is held, that at 0.1 is the first free one
    np.testing.assert_array_equal(wall.passed(start, end, 0.1, 1.0, 0.0, 1.5), [False, True])
