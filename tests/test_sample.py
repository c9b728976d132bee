"""Filling a region: exact totals, counts, places, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIMS

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


@pytest.mark.parametrize("d", DIMS)
def test_a_ball_keeps_the_lattice_points_inside_it(d):
    """All points are within the radius, symmetric about the centre, and their volume tends to the ball's."""
    radius, centre = 0.3, (0.5,) * d
    ball = mpm.Ball(centre, radius)
    particles = mpm.fill(ball, grid_of(d), particles_per_cell=4**d, density=2.0)
    offset = np.asarray(particles.x) - centre
    assert (np.linalg.norm(offset, axis=1) <= radius).all()
    np.testing.assert_allclose(offset.mean(axis=0), 0, atol=1e-12)
    exact = {1: 2 * radius, 2: np.pi * radius**2, 3: 4 / 3 * np.pi * radius**3}[d]
    np.testing.assert_allclose(particles.volume.sum(), exact, rtol=0.02)
    np.testing.assert_allclose(particles.mass, 2 * particles.volume, rtol=1e-14)


def test_velocity_is_given_to_every_particle():
    """Rest by default; a tuple or array otherwise. F, C and X are left to `prepare`."""
    rest = mpm.fill(box_of(2), grid_of(2), density=1.0)
    moving = mpm.fill(box_of(2), grid_of(2), density=1.0, velocity=(1.0, -2.0))
    np.testing.assert_array_equal(rest.v, 0)
    np.testing.assert_array_equal(moving.v, np.broadcast_to([1.0, -2.0], rest.x.shape))
    assert rest.F is rest.C is rest.X is None


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


class Nowhere(mpm.AbstractRegion):
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
        ({"particles_per_cell": 0}, "2-th power of a whole number"),
        ({"particles_per_cell": -4}, "2-th power of a whole number"),
        ({"particles_per_cell": (2, 2, 2)}, "one or 2 positive whole numbers"),
        ({"particles_per_cell": (2, 0)}, "one or 2 positive whole numbers"),
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
        (lambda: mpm.Ball((0.0, 0.0), 0.0), "radius must be greater than zero"),
        (lambda: mpm.Ball((0.0, np.inf), 1.0), "centre must be finite"),
    ],
)
def test_bad_regions_are_refused(make, message):
    """A box has a volume, a ball a radius."""
    with pytest.raises(ValueError, match=message):
        make()
