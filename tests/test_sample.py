"""Filling a region: exact totals, counts, places, and what is refused."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIMS, thorough

import mpmjax as mpm

DX = 0.1


def grid_of(d):
    return mpm.Grid((16,) * d, DX)


def box_of(d, upper=(0.737, 0.481, 0.353)):
    return mpm.Box((0.111, 0.222, 0.205)[:d], upper[:d])


@pytest.mark.parametrize("d", DIMS)
def test_total_mass_in_a_box_is_exact(d):
    """Also where the box is no multiple of the spacing; the particles are alike, inside, and centred on the box."""
    box, density = box_of(d), 1234.5
    particles = mpm.fill(box, grid_of(d), particles_per_cell=2**d, density=density)
    lower, upper = box.bounds()
    np.testing.assert_allclose(particles.volume.sum(), np.prod(upper - lower), rtol=1e-13)
    np.testing.assert_allclose(particles.mass.sum(), density * np.prod(upper - lower), rtol=1e-13)
    np.testing.assert_allclose(particles.mass / particles.volume, density, rtol=1e-14)
    assert np.ptp(particles.volume) == 0
    assert box.contains(particles.x).all()
    np.testing.assert_allclose(particles.x.mean(axis=0), (lower + upper) / 2, rtol=1e-13)
    assert len(np.unique(np.asarray(particles.x), axis=0)) == particles.count == len(particles.x)


@pytest.mark.parametrize("d", DIMS)
def test_a_box_of_whole_cells_holds_the_count_asked_for(d):
    """n^d a cell, or a count for each direction, at the centres of the subdivided cells."""
    box = mpm.Box((0.2,) * d, (0.5,) * d)
    for per_cell, counts in ((3**d, (3,) * d), ((4, 1, 2)[:d], (4, 1, 2)[:d])):
        particles = mpm.fill(box, grid_of(d), particles_per_cell=per_cell, density=1.0)
        assert particles.count == 3**d * np.prod(counts)
        np.testing.assert_allclose(particles.volume, np.prod(DX / np.array(counts)), rtol=1e-13)
        for axis, n in enumerate(counts):
            places = np.unique(np.round(np.asarray(particles.x)[:, axis], 12))
            np.testing.assert_allclose(places, 0.2 + DX / n * (np.arange(3 * n) + 0.5), atol=1e-12)


@pytest.mark.parametrize("d", DIMS)
def test_two_in_each_direction_are_the_default(d):
    particles = mpm.fill(mpm.Box((0.2,) * d, (0.5,) * d), grid_of(d), density=1.0)
    assert particles.count == 6**d


@pytest.mark.parametrize(("side", "count"), [(0.31, 6), (0.33, 7)])
def test_counts_in_a_box_are_rounded_to_the_nearest(side, count):
    """6.2 lattice cells become 6, 6.6 become 7."""
    assert mpm.fill(mpm.Box((0.2,), (0.2 + side,)), grid_of(1), particles_per_cell=2, density=1.0).count == count


def test_a_sliver_gets_one_particle_across():
    """A box thinner than a lattice cell is still filled, with its exact mass."""
    particles = mpm.fill(mpm.Box((0.2, 0.2), (0.5, 0.201)), grid_of(2), density=10.0)
    assert particles.count == 6
    np.testing.assert_allclose(particles.mass.sum(), 10 * 0.3 * 0.001, rtol=1e-13)


BALL = {1: 0.6, 2: np.pi * 0.3**2, 3: 4 / 3 * np.pi * 0.3**3}
"""The volume of a ball of radius 0.3."""


@pytest.mark.parametrize("d", DIMS)
def test_a_ball_has_its_volume_to_a_thousandth_at_ten_cells_a_diameter(d):
    """Each particle has the part of its cell that is inside: the mass is right, the centre of mass too, and no particle
    lies outside."""
    centre = np.array([0.513, 0.47, 0.5])[:d]
    grid = mpm.Grid((16,) * d, 0.06)
    particles = mpm.fill(mpm.Ball(tuple(centre), 0.3), grid, density=2.0)
    offset, volume = np.asarray(particles.x) - centre, np.asarray(particles.volume)
    assert volume.sum() == pytest.approx(BALL[d], rel=2e-4)
    np.testing.assert_allclose(volume @ offset / volume.sum(), 0, atol=1e-4 * 0.3)
    assert (np.linalg.norm(offset, axis=1) < 0.3).all()
    np.testing.assert_allclose(particles.mass, 2 * particles.volume, rtol=1e-14)
    assert volume.min() >= 0.019 * 0.03**d
    assert volume.max() <= 1.021 * 0.03**d
    inertia = {1: 0.3**2 / 3, 2: 0.3**2 / 2, 3: 0.3**2 * 3 / 5}[d]
    assert volume @ (offset**2).sum(axis=1) / volume.sum() == pytest.approx(inertia, rel=0.01)


@pytest.mark.parametrize(
    "region",
    [
        mpm.Ball((0.013, 0.02), 0.3),
        *thorough(mpm.Ball((0.013, 0.02, -0.01), 0.3), mpm.geometry.Capsule((-0.2, -0.1), (0.2, 0.1), 0.15)),
    ],
)
def test_volume_and_inertia_of_a_filled_region_are_of_second_order(region):
    """The change from grid to grid falls to about a quarter, against finer cells by tenfold."""

    def found(spacing):
        grid = mpm.Grid((8,) * region.dim, spacing)
        q = mpm.fill(region, grid, density=1.0)
        return np.array([q.volume.sum(), (q.volume * (q.x**2).sum(axis=1)).sum()])

    exact = found(0.6 / (320 if region.dim == 2 else 64))
    e = np.array([np.abs(found(0.6 / n) / exact - 1) for n in (5, 10, 20)])
    assert (e[0] < 3e-2).all()
    assert (e[2] < e[0] / 8).all(), e


def test_the_lattice_of_a_filled_region_is_that_of_the_grid():
    """Whole cells lie where they would in a box of whole cells, wherever the body is."""
    particles = mpm.fill(mpm.Ball((0.513, 0.47), 0.3), grid_of(2), particles_per_cell=(2, 3), density=1.0)
    whole = np.isclose(particles.volume, DX**2 / 6, rtol=1e-12)
    place = np.asarray(particles.x)[whole] / (DX / np.array([2, 3])) % 1
    assert whole.mean() > 0.6
    np.testing.assert_allclose(place, 0.5, atol=1e-9)


def test_a_filled_region_need_not_be_smooth():
    """A square turned by 30 degrees: corners and edges anywhere in cells."""
    turn = np.array([np.cos(np.pi / 6), np.sin(np.pi / 6)])
    square = mpm.geometry.Cylinder(tuple(-0.3 * turn), tuple(0.3 * turn), 0.3)
    particles = mpm.fill(square, grid_of(2), density=1.0)
    assert float(particles.volume.sum()) == pytest.approx(0.36, rel=1e-3)
    assert square.contains(particles.x).all()


def test_a_wall_thinner_than_a_cell_is_filled():
    """With three parts of eight of a cell: no more is lost than a few per cent."""
    ring = mpm.geometry.Annulus((0.0, 0.0), 0.5, 0.52)
    particles = mpm.fill(ring, grid_of(2), density=1.0)
    assert float(particles.volume.sum()) == pytest.approx(np.pi * (0.52**2 - 0.25), rel=0.02)


FITTED = {
    "disk": (mpm.Ball((0.1, 0.2), 0.3), np.pi * 0.09, 0.09 / 2),
    "interval": (mpm.Ball((0.1,), 0.3), 0.6, 0.03),
    "annulus": (mpm.geometry.Annulus((0.1, 0.2), 0.2, 0.4), np.pi * 0.12, 0.1),
    "cylinder": (mpm.geometry.Cylinder((0.1, 0.2, 0.0), (0.5, 0.4, 0.4), 0.2), np.pi * 0.04 * 0.6, 0.02 + 0.36 / 12),
    "tube": (mpm.geometry.Tube((0.1, 0.2, 0.0), (0.5, 0.4, 0.4), 0.2, 0.4), np.pi * 0.12 * 0.6, 0.1 + 0.36 / 12),
    "rectangle": (mpm.geometry.Cylinder((0.1, 0.2), (0.4, 0.6), 0.2), 0.2, (0.25 + 0.16) / 12),
}


@pytest.mark.parametrize("name", FITTED)
def test_fitted_cells_have_the_regions_volume_and_middle(name):
    """Exactly; their polar inertia to the size of the cells; alike in size, and inside."""
    region, volume, inertia = FITTED[name]
    q = mpm.fill(region, mpm.Grid((8,) * region.dim, 0.05), density=3.0, fitted=True)
    share = np.asarray(q.volume) / volume
    offset = np.asarray(q.x - region.middle())
    assert share.sum() == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(share @ offset, 0, atol=1e-13)
    assert share @ (offset**2).sum(axis=1) == pytest.approx(inertia, rel=0.02)
    assert region.contains(q.x, -1e-3).all()
    assert share.max() < 2.5 * share.min()
    np.testing.assert_allclose(q.mass, 3 * q.volume, rtol=1e-14)


def test_what_has_no_fitted_cells_is_refused():
    with pytest.raises(ValueError, match="leave out fitted"):
        mpm.fill(mpm.geometry.Capsule((0.0, 0.0), (1.0, 0.0), 0.2), grid_of(2), density=1.0, fitted=True)


def bent(xi):
    """A map with a Jacobian that varies, of the unit square or cube."""
    r, angle = 1 + xi[0], xi[1]
    return jnp.stack([r * jnp.cos(angle), r * jnp.sin(angle), *xi[2:]])


@pytest.mark.parametrize("d", [2, 3])
def test_a_mapped_lattice_has_the_images_volume_and_moments(d):
    """Sectors of a ring between radii one and two: total volume and centre of mass in closed form."""
    q = mpm.fill_mapped(bent, mpm.Box((0.0,) * d, (1.0,) * d), (6, 7, 2)[:d], density=2.0, velocity=(1.0, 0.0, 2.0)[:d])
    assert q.count == (6 * 7 * 2 if d == 3 else 42)
    volume = np.asarray(q.volume)
    assert volume.sum() == pytest.approx(1.5, rel=1e-12)
    centre = np.array([7 / 3 * np.sin(1.0), 7 / 3 * (1 - np.cos(1.0)), 0.75])[:d] / 1.5
    np.testing.assert_allclose(volume @ np.asarray(q.x) / 1.5, centre, rtol=1e-9)
    np.testing.assert_allclose(q.mass, 2 * q.volume, rtol=1e-14)
    np.testing.assert_array_equal(q.v[0], [1.0, 0.0, 2.0][:d])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mapping": lambda xi: xi**2, "box": mpm.Box((-1.0, 0.1), (1.0, 1.0))}, "must not fold"),
        ({"mapping": lambda xi: xi[:1]}, "must take 2 coordinates to 2"),
        ({"counts": (3,)}, "counts must be 2 positive whole numbers"),
        ({"box": mpm.Box((0.0, 0.0), (1.0, np.inf))}, "must be finite"),
    ],
)
def test_a_map_that_cannot_be_filled_is_refused(arguments, message):
    given = {"mapping": bent, "box": mpm.Box((0.0, 0.0), (1.0, 1.0)), "counts": (2, 2), "density": 1.0}
    with pytest.raises(ValueError, match=message):
        mpm.fill_mapped(**given | arguments)


def test_velocity_is_given_to_every_particle():
    """Rest by default; a tuple or array otherwise. F, C and X are left to `prepare`."""
    rest = mpm.fill(box_of(2), grid_of(2), density=1.0)
    moving = mpm.fill(box_of(2), grid_of(2), density=1.0, velocity=(1.0, -2.0))
    np.testing.assert_array_equal(rest.v, 0)
    np.testing.assert_array_equal(moving.v, np.broadcast_to([1.0, -2.0], rest.x.shape))
    assert rest.F is rest.C is rest.X is None


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("kernel", [2, *thorough(1, 3)])
def test_a_gradient_that_is_not_given_is_that_of_the_velocities(d, kernel):
    """Of a linear field, at a curved free surface too, with its derivative where the field is zero; exactly zero of
    bodies that move as a whole."""
    grid = mpm.Grid((19,) * d, DX)
    ball = mpm.fill(mpm.Ball((0.62, 0.6, 0.61)[:d], 0.3), grid, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), kernel=mpm.BSpline(kernel), gradient=mpm.SplineGradient())
    A = np.random.default_rng(0).normal(size=(d, d))

    def gradient(s):
        return mpm.prepare(scene, replace(ball, v=s * (ball.x - 0.5) @ A.T)).C

    found, slope = jax.jvp(gradient, (0.0,), (1.0,))
    np.testing.assert_array_equal(found, 0)
    np.testing.assert_allclose(slope, np.broadcast_to(A, slope.shape), atol=2e-6)
    np.testing.assert_allclose(gradient(2.0), 2 * slope, atol=1e-12)
    other = mpm.fill(mpm.Ball((1.45,) * d, 0.15), grid, density=1e3, velocity=(0.3,) * d)
    np.testing.assert_array_equal(mpm.prepare(scene, mpm.join(ball, other)).C, 0)


@pytest.mark.parametrize("d", [2, 3])
def test_a_velocity_may_be_a_field_or_a_motion(d):
    """With its gradient, in any set that it is joined to; of constant fields exactly zero."""
    spin, axis = 2.0, (0.0, 0.0, 1.0)
    turns = (0.3, 2.3) if d == 2 else (axis, tuple((1 + spin) * a for a in axis))
    motion = mpm.RigidMotion((0.0, 1.0), ((0.0,) * d, (0.5,) * d), turns, (0.6,) * d)
    W = np.zeros((d, d))
    W[0, 1], W[1, 0] = -spin, spin
    box = mpm.Box((0.4,) * d, (0.7,) * d)
    for velocity in (motion, lambda x: jnp.full(d, 0.5) + (x - 0.6) @ W.T):
        q = mpm.fill(box, grid_of(d), density=1.0, velocity=velocity)
        np.testing.assert_allclose(q.v, 0.5 + (q.x - 0.6) @ W.T, atol=1e-12)
        np.testing.assert_allclose(q.C, np.broadcast_to(W, q.C.shape), atol=1e-12)
        still = mpm.fill(mpm.Box((1.0,) * d, (1.2,) * d), grid_of(d), density=1.0)
        both = mpm.join(still, q)
        np.testing.assert_array_equal(both.C, np.concatenate([np.zeros((still.count, d, d)), q.C]))
    constant = mpm.fill(box, grid_of(d), density=1.0, velocity=lambda x: jnp.full(d, 0.3) + 0 * x)
    np.testing.assert_array_equal(constant.C, 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64, "float32"])
def test_every_leaf_has_the_dtype_asked_for(dtype):
    """And is a strong array, so that nothing is promoted later."""
    leaves = jax.tree.leaves(mpm.fill(box_of(3), grid_of(3), particles_per_cell=8, density=1.0, dtype=dtype))
    assert len(leaves) == 4
    assert all(leaf.dtype == jnp.dtype(dtype) and not leaf.weak_type for leaf in leaves)
    assert mpm.fill(box_of(2), grid_of(2), density=1.0).x.dtype == jnp.float64  # jax's own, in 64-bit mode


def test_density_can_be_differentiated():
    """Total mass is density times volume, in derivatives too."""
    total = jax.grad(lambda rho: mpm.fill(box_of(2), grid_of(2), density=rho).mass.sum())(10.0)
    np.testing.assert_allclose(total, 0.626 * 0.259, rtol=1e-13)


class Nowhere(mpm.geometry.AbstractRegion):
    """A region with bounds but no points."""

    dim = 2

    def distance(self, x):
        return jnp.ones(len(x))

    def bounds(self):
        return np.zeros(2), np.ones(2)

    def middle(self):
        return jnp.zeros(2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"particles_per_cell": 3}, "2-th power of a whole number"),
        ({"particles_per_cell": 0}, "particles_per_cell must be at least 1, got 0"),
        ({"particles_per_cell": -4}, "particles_per_cell must be at least 1, got -4"),
        ({"particles_per_cell": (2, 2, 2)}, "one or 2 positive whole numbers"),
        ({"particles_per_cell": (2, 0)}, r"particles_per_cell must be at least 1, got \(2, 0\)"),
        ({"density": 0.0}, "density .* must be greater than zero"),
        ({"density": -1.0}, "density .* must be greater than zero"),
        ({"density": np.nan}, "density .* must be finite"),
        ({"region": mpm.Box((0.0,), (1.0,))}, "The region is 1-dimensional, the grid 2-dimensional"),
        ({"region": mpm.Ball((0.0, 0.0, 0.0), 1.0)}, "The region is 3-dimensional"),
        ({"region": mpm.Box((-np.inf, 0.0), (1.0, 1.0))}, "must be finite"),
        ({"region": Nowhere()}, "holds no particle at this spacing"),
        ({"velocity": (1.0, 2.0, 3.0)}, "velocity .*must have 2 components"),
        ({"velocity": (1.0,)}, "velocity .*must have 2 components"),
    ],
)
def test_bad_arguments_are_refused(arguments, message):
    """Each with what must hold and what was got."""
    with pytest.raises(ValueError, match=message):
        mpm.fill(**{"region": mpm.Box((0.2, 0.2), (0.4, 0.4)), "grid": grid_of(2), "density": 1.0} | arguments)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: mpm.Box((0.0, 0.0), (1.0, 0.0)), "lower corner must lie below its upper one"),
        (lambda: mpm.Box((0.0, 0.0), (1.0,)), "as many coordinates"),
        (lambda: mpm.Box((0.0, np.nan), (1.0, 1.0)), "lower corner must lie below"),
        (lambda: mpm.Ball((0.0, 0.0), 0.0), r"radius \[m\] must be greater than zero"),
        (lambda: mpm.Ball((0.0, np.inf), 1.0), r"centre \[m\] must be finite"),
    ],
)
def test_bad_regions_are_refused(make, message):
    """A box has a volume, a ball a radius."""
    with pytest.raises(ValueError, match=message):
        make()
