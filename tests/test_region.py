"""Regions: exact distances, unit gradients, and none of them NaN."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, ids, thorough
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import mpmjax as mpm
from mpmjax.cli._scene_file import _find_files
from mpmjax.geometry import surface_pieces
from mpmjax.io import decode

REGIONS = {
    "ball-1d": mpm.Ball((0.1,), 0.4),
    "ball-2d": mpm.Ball((0.1, 0.2), 0.4),
    "ball-3d": mpm.Ball((0.1, 0.2, -0.1), 0.4),
    "box-1d": mpm.Box((-0.3,), (0.4,)),
    "box-2d": mpm.Box((-0.3, -0.2), (0.4, 0.3)),
    "box-3d": mpm.Box((-0.3, -0.2, -0.1), (0.4, 0.3, 0.3)),
    "capsule-2d": mpm.geometry.Capsule((-0.3, -0.1), (0.3, 0.2), 0.2),
    "capsule-3d": mpm.geometry.Capsule((-0.3, -0.1, 0.1), (0.3, 0.2, -0.1), 0.2),
    "cylinder-2d": mpm.geometry.Cylinder((-0.3, -0.1), (0.3, 0.2), 0.2),
    "cylinder-3d": mpm.geometry.Cylinder((-0.3, -0.1, 0.1), (0.3, 0.2, -0.1), 0.25),
    "annulus-2d": mpm.geometry.Annulus((0.1, -0.1), 0.3, 0.5),
    "tube-3d": mpm.geometry.Tube((-0.3, -0.1, 0.1), (0.3, 0.2, -0.1), 0.15, 0.35),
    "half_space-2d": mpm.HalfSpace((0.1, 0.1), (3.0, 4.0)),
    "half_space-3d": mpm.HalfSpace((0.1, 0.1, 0.0), (3.0, 4.0, -1.0)),
    "union-2d": mpm.geometry.Union((mpm.Ball((-0.4, 0.0), 0.2), mpm.Box((0.1, -0.3), (0.5, 0.3)))),
    "intersection-2d": mpm.geometry.Intersection((mpm.Ball((0.0, 0.0), 0.6), mpm.Box((0.0, 0.0), (np.inf, np.inf)))),
    "complement-2d": mpm.geometry.Complement(mpm.Box((-0.3, -0.2), (0.4, 0.3))),
    "placed-2d": mpm.geometry.Placed(
        mpm.Box((-0.3, -0.2), (0.5, 0.1)), (1.0, 2.0), 0.2, displacement=(0.1, -0.1), centre=(0.2, 0.1)
    ),
    "placed-3d": mpm.geometry.Placed(
        mpm.Box((-0.5, -0.4, -0.6), (0.6, 0.5, 0.4)), mirror=(0.0, 3.0, 0.0), rotation=(0.1, -0.1, 0.05)
    ),
}
SAMPLED = {f"sampled-{d}d": mpm.Ball((0.1,) * d, 0.35) for d in (1, 2, 3)}
"""Regions to be sampled."""
EACH = pytest.mark.parametrize("region", **ids(REGIONS))


def points(region, count=200):
    return jnp.asarray(np.random.default_rng(1).uniform(-0.8, 0.8, (count, region.dim)))


def across_of(a, b, sphere):
    """Directions at right angles to an axis."""
    axis = (b - a) / np.linalg.norm(b - a)
    across = sphere - (sphere @ axis)[:, None] * axis
    return across / np.linalg.norm(across, axis=1, keepdims=True)


def lateral_points(region, sphere, rng):
    """Points of the lateral surface about an axis."""
    a, b = np.asarray(region.start), np.asarray(region.end)
    return a + rng.random((len(sphere), 1)) * (b - a) + region.radius * across_of(a, b, sphere)


def moved(region, X, back=False):
    """Points of a placed region's own region in its place, or the other way round."""
    d = region.dim
    centre = np.zeros(d) if region.centre is None else np.asarray(region.centre)
    by = centre + (0.0 if region.displacement is None else np.asarray(region.displacement))
    n = np.asarray(region.mirror) / np.linalg.norm(region.mirror)
    turn = Rotation.from_rotvec(region.rotation if d == 3 else (0, 0, region.rotation)).as_matrix()[:d, :d]
    A = turn @ (np.eye(d) - 2 * np.outer(n, n))
    return centre + (X - by) @ A if back else by + (X - centre) @ A.T


@functools.cache
def surface_of(region):
    """Points of the surface and whether a point is inside, each from the set's own definition."""
    n, rng = 200_000, np.random.default_rng(2)
    d = region.dim
    sphere = rng.normal(size=(n, d))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    match region:
        case mpm.geometry.Placed():
            return moved(region, surface_of(region.region))
        case mpm.geometry.Complement():
            return surface_of(region.region)
        case mpm.Ball():
            return np.asarray(region.centre) + region.radius * sphere
        case mpm.geometry.Annulus():
            radius = np.where(rng.random((n, 1)) < 0.5, region.inner, region.outer)
            return np.asarray(region.centre) + radius * sphere
        case mpm.geometry.Tube():
            round_one = [mpm.geometry.Cylinder(region.start, region.end, r) for r in (region.inner, region.outer)]
            lateral = np.concatenate([lateral_points(c, sphere, rng) for c in round_one])
            a, b = np.asarray(region.start), np.asarray(region.end)
            radii = np.sqrt(rng.uniform(region.inner**2, region.outer**2, (n, 1)))
            return np.concatenate([lateral, np.where(rng.random((n, 1)) < 0.5, a, b) + radii * across_of(a, b, sphere)])
        case mpm.Box():
            lower, upper = (np.asarray(a) for a in region.bounds())
            x = rng.uniform(lower, upper, (n, d))
            axis = rng.integers(0, d, n)
            x[np.arange(n), axis] = np.where(rng.random(n) < 0.5, lower[axis], upper[axis])
            return x
        case mpm.geometry.Capsule() | mpm.geometry.Cylinder():
            a, b = np.asarray(region.start), np.asarray(region.end)
            axis, across = (b - a) / np.linalg.norm(b - a), across_of(a, b, sphere)
            side = lateral_points(region, sphere, rng)
            if isinstance(region, mpm.geometry.Cylinder):
                cap = np.where(rng.random((n, 1)) < 0.5, a, b) + region.radius * np.sqrt(rng.random((n, 1))) * across
            else:
                cap = np.where((sphere @ axis < 0)[:, None], a, b) + region.radius * sphere
            return np.concatenate([side, cap])
        case mpm.HalfSpace():
            x, unit = rng.uniform(-2, 2, (n, d)), np.asarray(region.normal) / np.linalg.norm(region.normal)
            return x - ((x - np.asarray(region.point)) @ unit)[:, None] * unit
    raise AssertionError


@pytest.mark.parametrize("name", [name for name in REGIONS if not name.startswith(("union", "intersection"))])
def test_the_distance_is_that_of_the_nearest_point_of_the_surface(name):
    """In size, by brute force over points of the surface: never more than theirs, and less by their spacing at most."""
    region = REGIONS[name]
    surface = surface_of(region)
    x = points(region, 40)
    nearest = cdist(np.asarray(x), surface).min(axis=1)
    distance = np.abs(np.asarray(region.distance(x)))
    assert (distance <= nearest + 1e-12).all()
    resolution = {1: 1e-12, 2: 3e-4, 3: 1e-2}[region.dim]
    assert (nearest - distance < resolution).all(), (nearest - distance).max()


def inside(region, x):
    """From the set's definition."""
    match region:
        case mpm.Ball():
            return ((x - np.asarray(region.centre)) ** 2).sum(axis=1) < region.radius**2
        case mpm.Box():
            return ((x > np.asarray(region.lower)) & (x < np.asarray(region.upper))).all(axis=1)
        case mpm.HalfSpace():
            return (x - np.asarray(region.point)) @ np.asarray(region.normal) < 0
        case mpm.geometry.Union():
            return np.any([inside(r, x) for r in region.regions], axis=0)
        case mpm.geometry.Intersection():
            return np.all([inside(r, x) for r in region.regions], axis=0)
        case mpm.geometry.Complement():
            return ~inside(region.region, x)
        case mpm.geometry.Placed():
            return inside(region.region, moved(region, x, back=True))
        case mpm.geometry.Annulus():
            r = np.linalg.norm(x - np.asarray(region.centre), axis=1)
            return (r > region.inner) & (r < region.outer)
        case mpm.geometry.Tube():
            inner, outer = (mpm.geometry.Cylinder(region.start, region.end, r) for r in (region.inner, region.outer))
            return inside(outer, x) & ~inside(inner, x)
    a, axis = np.asarray(region.start), np.asarray(region.end) - np.asarray(region.start)
    s = (x - a) @ axis / (axis @ axis)
    near = s.clip(0, 1) if isinstance(region, mpm.geometry.Capsule) else s
    beside = np.linalg.norm(x - a - near[:, None] * axis, axis=1) < region.radius
    return beside & ((s > 0) & (s < 1) if isinstance(region, mpm.geometry.Cylinder) else True)


@EACH
def test_it_is_negative_inside_and_the_bounds_hold_all_of_it(region):
    x = points(region, 2000)
    within = inside(region, np.asarray(x))
    np.testing.assert_array_equal(np.asarray(region.distance(x)) < 0, within)
    np.testing.assert_array_equal(np.asarray(region.contains(x)), within)
    np.testing.assert_array_equal(np.asarray(region.contains(x, 0.1)), np.asarray(region.distance(x)) <= 0.1)
    lower, upper = region.bounds()
    held = np.asarray(x)[within]
    assert within.any()
    assert (held >= lower).all()
    assert (held <= upper).all()
    if np.isfinite(lower).all():  # and they are tight
        assert (held.min(axis=0) - lower < 0.15).all()
        assert (upper - held.max(axis=0) < 0.15).all()
        assert (np.abs(region.middle() - (lower + upper) / 2) < 0.1).all() or hasattr(region, "regions")


@EACH
def test_its_gradient_has_length_one(region):
    """Almost everywhere, and it is that of central differences."""
    x, h = points(region), 1e-6

    @jax.jit
    def slopes(x):
        gradient = jax.grad(lambda x: region.distance(x).sum())(x)
        ahead, behind = (jax.vmap(region.distance)(x + s * jnp.eye(region.dim)[:, None]) for s in (h, -h))
        return gradient, (ahead - behind).T / (2 * h)

    gradient, difference = map(np.asarray, slopes(x))
    assert_close(np.linalg.norm(gradient, axis=1), np.ones(len(x)), 1e-12)
    wrong = np.abs(difference - gradient).max(axis=1) > 1e-6
    assert wrong.sum() <= 1  # a point on an edge of the distance itself


@pytest.mark.parametrize("name", **ids({name: name for name in REGIONS | SAMPLED}, ("capsule-2d", "sampled-1d")))
def test_no_derivative_is_nan_anywhere(name):
    """First and second, at centres, edges, corners and on the surface, in the place and in every number of it."""
    region = REGIONS[name] if name in REGIONS else mpm.geometry.sample_distance(SAMPLED[name], 0.05)
    lower, upper = (np.nan_to_num(np.asarray(b), neginf=-1.0, posinf=1.0) for b in region.bounds())
    middle = np.asarray(region.middle())
    ends = [getattr(region, name, None) for name in ("start", "end", "centre")]
    ends = [np.asarray(end) for end in ends if end is not None]
    special = jnp.asarray(np.stack([middle, lower, upper, (middle + lower) / 2, *ends, np.where(upper > 0, upper, 0)]))

    def slope(region, x):
        return jax.grad(lambda x: region.distance(x).sum())(x)

    parameters, rest = jax.tree.flatten(jax.tree.map(lambda a: jnp.asarray(a, float), region))

    @jax.jit
    def derivatives(leaves, x):
        there = jax.jacfwd(lambda leaves, x: slope(rest.unflatten(leaves), x), argnums=(0, 1))(leaves, x)
        return slope(rest.unflatten(leaves), x), there

    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(derivatives(parameters, special)))


@pytest.mark.thorough
def test_the_middle_has_a_direction_too():
    """Nodes on a plate's mid-plane, an axis or a centre: a collider needs a normal of length one there."""
    middles = {
        mpm.Box((0.0, 0.0), (1.0, 2.0)): [[0.5, 1.0], [0.5, 0.7]],
        mpm.Ball((0.2, 0.1)[:2], 0.3): [[0.2, 0.1]],
        mpm.geometry.Capsule((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.2): [[0.5, 0.0, 0.0]],
        mpm.geometry.Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 2.0): [[0.3, 0.0, 0.5], [0.0, 0.0, 0.5]],
        mpm.geometry.Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), 0.5): [[0.0, 0.0, 2.0]],
        mpm.geometry.Annulus((0.2, 0.1), 0.3, 0.5): [[0.2, 0.1], [0.6, 0.1]],
        mpm.geometry.Tube((0.0, 0.0, 0.0), (0.0, 0.0, 4.0), 0.5, 0.7): [[0.0, 0.0, 2.0], [0.6, 0.0, 2.0]],
    }
    for region, points in middles.items():
        gradient = jax.grad(lambda x, region=region: region.distance(x).sum())(jnp.asarray(points))
        assert (np.linalg.norm(np.asarray(gradient), axis=1) > 0.5).all(), region


@pytest.mark.thorough
def test_samples_converge_to_the_distance_at_second_order():
    """Near the surface: a ball's distance and its normal. Quadratic splines move it inward by (d − 1) h²/8R, which the
    volume that is kept undoes."""
    ball, rng = mpm.Ball((0.1, 0.2, 0.0), 0.4), np.random.default_rng(3)
    direction = rng.normal(size=(100, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x = jnp.asarray(np.array([0.1, 0.2, 0.0]) + 0.4 * direction)
    errors, slopes = [], []
    for h in (0.1, 0.05, 0.025):
        sampled = mpm.geometry.sample_distance(ball, h)
        errors.append(np.abs(sampled.distance(x)).mean())
        normal = jax.grad(lambda x, region=sampled: region.distance(x).sum())(x)
        slopes.append(np.abs(np.asarray(normal) - direction).mean())
    assert (np.log2(np.divide(errors[:-1], errors[1:])) > 1.8).all()
    assert (np.log2(np.divide(slopes[:-1], slopes[1:])) > 1.8).all()
    assert errors[-1] < 0.01 * 2 * 0.025**2 / 8 / 0.4


def test_beyond_its_lattice_a_sampled_distance_goes_on():
    """Positive, growing, and never more than the way there."""
    ball = mpm.Ball((0.0, 0.0), 0.3)
    sampled = mpm.geometry.sample_distance(ball, 0.1)
    x = jnp.stack([jnp.linspace(0.3, 3.0, 28), jnp.linspace(0.0, 2.0, 28)], axis=1)
    far = np.asarray(sampled.distance(x))
    assert (np.diff(far) > 0).all()
    assert (np.abs(far - ball.distance(x)) < 0.6).all()


def test_a_mesh_is_sampled():
    """A cube of twelve triangles has the distance of the box, to the samples' order, and a hole is refused."""
    corners = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * 0.5
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    mesh, box = mpm.geometry.sample_mesh((corners, faces), 0.125), mpm.Box((0.0,) * 3, (0.5,) * 3)
    exact = mpm.geometry.sample_distance(box, 0.125)
    np.testing.assert_allclose(mesh.lower, exact.lower)
    np.testing.assert_allclose(mesh.values, exact.values, atol=1e-12)
    with pytest.raises(ValueError, match="must be a closed surface"):
        mpm.geometry.sample_mesh((corners, faces[:-1]), 0.05)


@pytest.mark.parametrize("suffix", ["stl", *thorough("obj", "ply")])
def test_a_scene_file_names_a_mesh_with_its_scale_and_place(suffix, tmp_path):
    """The file lies beside that of the scene, and may be in millimetres, of which units that are wrong remind."""
    import trimesh

    trimesh.creation.box((500, 500, 500)).export(tmp_path / f"part.{suffix}")
    table = {"kind": "Mesh", "file": f"part.{suffix}", "spacing": 0.125, "scale": 1e-3}
    _find_files([{"region": {"kind": "Placed", "region": table}}], tmp_path)
    region = decode(table, mpm.geometry.AbstractRegion)
    exact = mpm.geometry.sample_distance(mpm.Box((-0.25,) * 3, (0.25,) * 3), 0.125)
    np.testing.assert_allclose(region.lower, exact.lower)
    np.testing.assert_allclose(region.values, exact.values, atol=1e-6)
    for scale, says in ((1.0, "measures 500 x 500 x 500 m"), (1e-6, "less than the spacing 0.125 m")):
        with pytest.raises(ValueError, match=f"{says}.* give scale = 1e-3 for a file in millimetres"):
            decode(table | {"scale": scale}, mpm.geometry.AbstractRegion)
    for file in ("nowhere.stl", __file__):
        with pytest.raises(ValueError, match="no mesh"):
            decode(table | {"file": file}, mpm.geometry.AbstractRegion)
    with pytest.raises(ValueError, match="Unknown kind 'Mesh'"):  # a run's file holds what was made of it
        decode(table, mpm.geometry.AbstractRegion, arrays={})


def test_without_trimesh_it_is_said_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "trimesh", None)
    monkeypatch.setitem(__import__("sys").modules, "rtree", None)
    with pytest.raises(ImportError, match=r"mpmjax\[mesh\]"):
        mpm.geometry.sample_mesh("part.stl", 0.1)


def test_an_intersection_is_filled_and_pressed_as_the_part_that_it_is():
    """A quarter cylinder has a quarter of the volume, its round face a quarter of the area; so has its image beside
    it, and a ring cut by a hole the area of the ring."""
    cylinder, quarter = mpm.geometry.Cylinder((0.0,) * 3, (0.0, 0.0, 0.4), 0.5), mpm.Box((0.0,) * 3, (np.inf,) * 3)
    part, grid = mpm.geometry.Intersection((cylinder, quarter)), mpm.Grid((16, 16, 12), 0.1, origin=(-8, -1, -1))
    np.testing.assert_allclose(mpm.fill(part, grid, density=1.0).volume.sum(), np.pi * 0.25 * 0.4 / 4, rtol=2e-3)
    round_face = surface_pieces(part, 0.05, within=mpm.Box((0.01, 0.01, 0.01), (1.0, 1.0, 0.39)))
    whole = np.pi / 2 * 0.5 - 2 * 0.5 * np.arcsin(0.01 / 0.5)  # but for strips along the planes
    np.testing.assert_allclose(round_face.size.sum(), whole * 0.38, rtol=2e-3)
    image = mpm.geometry.Placed(part, mirror=(1.0, 0.0, 0.0))
    np.testing.assert_allclose(image.bounds(), [[-0.5, 0.0, 0.0], [0.0, 0.5, 0.4]], atol=1e-15)
    ring = mpm.geometry.Intersection((mpm.Ball((0.0, 0.0), 0.5), mpm.geometry.Complement(mpm.Ball((0.0, 0.0), 0.3))))
    x = points(ring)
    np.testing.assert_allclose(ring.distance(x), mpm.geometry.Annulus((0.0, 0.0), 0.3, 0.5).distance(x), atol=1e-15)
    turned = mpm.geometry.Placed(mpm.geometry.Cylinder((0.0,) * 3, (0.0, 0.0, 0.4), 0.5), rotation=(0.5, 0.0, 0.0))
    np.testing.assert_allclose(mpm.fill(turned, grid, density=1.0, fitted=True).volume.sum(), np.pi * 0.25 * 0.4)


@pytest.mark.parametrize("region", [REGIONS["cylinder-3d"], REGIONS["capsule-2d"], REGIONS["union-2d"]])
def test_any_bounded_region_can_be_filled(region):
    """The particles' volume tends to the region's."""
    grid = mpm.Grid((40,) * region.dim, 0.05, origin=(-20,) * region.dim)
    particles = mpm.fill(region, grid, density=1.0, particles_per_cell=4**region.dim)
    axis = (
        0.0 if isinstance(region, mpm.geometry.Union) else float(np.linalg.norm(np.subtract(region.end, region.start)))
    )
    volume = {2: 0.4 * axis + np.pi * 0.2**2, 3: np.pi * 0.25**2 * axis}[region.dim]
    volume = np.pi * 0.2**2 + 0.24 if isinstance(region, mpm.geometry.Union) else volume
    np.testing.assert_allclose(particles.volume.sum(), volume, rtol=5e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mpm.HalfSpace((0.0, 0.0), (0.0, 0.0)), "normal must not be zero"),
        (lambda: mpm.HalfSpace((0.0, 0.0), (0.0, 0.0, 1.0)), "as many coordinates"),
        (lambda: mpm.geometry.Capsule((0.0, 0.0), (0.0, 0.0), 1.0), "ends must differ"),
        (lambda: mpm.geometry.Cylinder((0.0,), (1.0,), 1.0), "take a Box"),
        (lambda: mpm.geometry.Annulus((0.0, 0.0, 0.0), 0.1, 0.2), "take a Tube"),
        (lambda: mpm.geometry.Annulus((0.0, 0.0), 0.2, 0.1), "inner radius must lie below"),
        (lambda: mpm.geometry.Tube((0.0, 0.0), (1.0, 0.0), 0.1, 0.2), "take an Annulus"),
        (lambda: mpm.geometry.Tube((0.0,) * 3, (1.0, 0.0, 0.0), 0.0, 0.2), r"inner \[m\] must be greater than zero"),
        (lambda: mpm.geometry.Cylinder((0.0, 0.0), (1.0, 0.0), -1.0), r"radius \[m\] must be greater than zero"),
        (lambda: mpm.geometry.Union(()), "at least one region"),
        (lambda: mpm.geometry.Union((mpm.Ball((0.0,), 1.0), mpm.Ball((0.0, 0.0), 1.0))), "the same dimension"),
        (lambda: mpm.geometry.Intersection(()), "An intersection needs at least one region"),
        (lambda: mpm.geometry.Placed(mpm.Ball((0.0,), 1.0), rotation=1.0), "none in one"),
        (lambda: mpm.geometry.Placed(mpm.Ball((0.0, 0.0), 1.0), rotation=(0.0, 0.0, 1.0)), "one angle in two"),
        (lambda: mpm.geometry.Placed(mpm.Ball((0.0, 0.0), 1.0), mirror=(0.0, 0.0)), "mirror must not be zero"),
        (lambda: mpm.geometry.Placed(mpm.Ball((0.0, 0.0), 1.0), displacement=(0.0,)), "must have 2 coordinates"),
        (
            lambda: mpm.geometry.SampledDistance((0.0,), 0.1, np.ones((5, 5))),
            "as many coordinates as its values have axes",
        ),
        (lambda: mpm.geometry.SampledDistance((0.0,), 0.1, -np.ones(3)), "at least 4 samples"),
        (lambda: mpm.geometry.SampledDistance((0.0,), 0.1, np.ones(5)), "must be negative somewhere"),
        (lambda: mpm.geometry.sample_distance(REGIONS["half_space-2d"], 0.1), "Only a region with bounds"),
    ],
)
def test_bad_regions_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("region", "volume"),
    [
        (mpm.Ball((1.02, 1.03), 0.35), np.pi * 0.35**2),
        (mpm.Box((0.5, 0.51), (1.5, 0.63)), 0.12),  # 1.2 samples thick
        *thorough((mpm.Ball((1.02, 1.03, 1.01), 0.35), 4 / 3 * np.pi * 0.35**3)),
    ],
)
def test_samples_keep_the_volume(region, volume):
    """Though they round edges and move curved surfaces inward, by some hundredths here: in what is filled."""
    filled = mpm.fill(mpm.geometry.sample_distance(region, 0.1), mpm.Grid((24,) * region.dim, 0.1), density=1.0)
    assert float(filled.mass.sum()) == pytest.approx(volume, rel=1e-3)
