"""What P2G and G2P conserve and reproduce, and that the one is the other's transpose."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import GRADIENTS, KERNELS, TRANSFERS, assert_close, cloud, ids, thorough

import mpmjax as mpm
from mpmjax._types import components
from mpmjax.discretisation._stencil import make_stencil
from mpmjax.discretisation._sums import gather
from mpmjax.discretisation._transfer import g2p, p2g

make, to_grid, to_particles = eqx.filter_jit(make_stencil), eqx.filter_jit(p2g), eqx.filter_jit(g2p)
from_nodes = eqx.filter_jit(gather)

EACH_KERNEL = pytest.mark.parametrize("kernel", **ids(KERNELS, "quadratic"))
EACH_DIM = pytest.mark.parametrize("d", [2, *thorough(1, 3)])
EACH_GRADIENT = pytest.mark.parametrize("gradient", **ids(GRADIENTS))
EACH_TRANSFER = pytest.mark.parametrize("transfer", **ids(TRANSFERS))


@cache
def scattered(kernel, gradient, d):
    """Random particles: grid, node positions, stencil, and x, v, C with the particle axis last, and mass."""
    grid, particles = cloud(d)
    window = grid.window(particles.x)
    stencil = make(kernel, gradient, grid, window, particles.x)
    x, v, C = components(particles.x), components(particles.v), components(particles.C)
    return grid, np.asarray(grid.nodes(window)), stencil, *map(np.asarray, (x, v, C, particles.mass))


def on_particles(transfer, stencil, v, before, after):
    """`g2p` of NumPy arrays, as NumPy arrays, of particles at zero."""
    arrays = (jnp.asarray(a) for a in (0 * v, v, before, after))
    return jax.tree.map(np.asarray, to_particles(transfer, stencil, 0.1, *arrays))


def on_nodes(stencil, mass, v, C, size):
    """The nodes' mass and momentum by `p2g`, of NumPy arrays, as NumPy arrays."""
    arrays = (a if a is None else jnp.asarray(a) for a in (mass, v, C))
    node_mass, velocity = map(np.asarray, to_grid(stencil, *arrays, size))
    return node_mass, node_mass[:, None] * velocity


def angular_momentum(x, momentum):
    """Σ x × p, of arrays (points, d): the independent components of the skew matrix Σ (p xᵀ − x pᵀ)."""
    spin = momentum.T @ x
    return (spin - spin.T)[np.tril_indices(len(spin), -1)]


def affine_angular_momentum(stencil, x, v, C, mass):
    """Σ m x × v + Σ m D_p (C_yx − C_xy), D_p the kernel's second moment (dx²/4 quadratic, dx²/3 cubic)."""
    spin = np.einsum("p,abp,bp->ab", mass, C, stencil.moment)
    return angular_momentum(x.T, (mass * v).T) + (spin - spin.T)[np.tril_indices(len(spin), -1)]


def noise(grid, d, seed=3):
    """Random node velocities."""
    return np.random.default_rng(seed).normal(size=(grid.size, d))


@EACH_KERNEL
@EACH_DIM
@EACH_GRADIENT
def test_p2g_conserves_mass_and_momentum(kernel, gradient, d):
    """Mass and linear momentum to rounding, and with the affine term angular momentum, for either gradient operator."""
    grid, nodes, stencil, x, v, C, mass = scattered(kernel, gradient, d)
    node_mass, momentum = on_nodes(stencil, mass, v, C, grid.size)
    np.testing.assert_allclose(node_mass.sum(), mass.sum(), rtol=1e-14)
    np.testing.assert_allclose(momentum.sum(axis=0), (mass * v).sum(axis=1), atol=1e-13)
    expected = affine_angular_momentum(stencil, x, v, C, mass)
    np.testing.assert_allclose(angular_momentum(nodes, momentum), expected, atol=1e-13)
    node_mass, momentum = on_nodes(stencil, mass, v, None, grid.size)
    np.testing.assert_allclose(node_mass.sum(), mass.sum(), rtol=1e-14)
    np.testing.assert_allclose(momentum.sum(axis=0), (mass * v).sum(axis=1), atol=1e-13)


@EACH_KERNEL
@EACH_DIM
@EACH_TRANSFER
def test_g2p_conserves_momentum(transfer, kernel, d):
    """Linear momentum to rounding by every transfer, angular momentum by APIC."""
    grid, nodes, stencil, x, v, C, mass = scattered(kernel, GRADIENTS["mls"], d)
    node_mass, momentum = on_nodes(stencil, mass, v, C if transfer.affine else None, grid.size)
    before = momentum / np.where(node_mass > 0, node_mass, 1)[:, None]
    after = before + noise(grid, d)
    moved, new, affine, *_ = on_particles(transfer, stencil, v, before, after)
    on_grid = node_mass[:, None] * after
    np.testing.assert_allclose((mass * moved).sum(axis=1), on_grid.sum(axis=0), atol=1e-13)
    np.testing.assert_allclose((mass * new).sum(axis=1), on_grid.sum(axis=0), atol=1e-13)
    if transfer.affine:
        expected = angular_momentum(nodes, on_grid)
        np.testing.assert_allclose(affine_angular_momentum(stencil, x, new, affine, mass), expected, atol=1e-13)


@EACH_KERNEL
@EACH_DIM
@EACH_GRADIENT
def test_apic_reproduces_affine_motion(kernel, gradient, d):
    """v = a + B x goes from particles to nodes and back, in v and C, to rounding."""
    grid, nodes, stencil, x, _, _, mass = scattered(kernel, gradient, d)
    rng = np.random.default_rng(5)
    a, B = rng.normal(size=d), rng.normal(size=(d, d))
    v = a[:, None] + B @ x
    C = np.broadcast_to(B[..., None], (d, d, x.shape[1]))
    node_mass, momentum = on_nodes(stencil, mass, v, C, grid.size)
    field = a + nodes @ B.T
    assert_close(momentum, node_mass[:, None] * field, 1e-14)
    moved, new, affine, *_ = on_particles(mpm.APIC(), stencil, v, 0 * field, field)
    assert_close(moved, v, 1e-13)
    assert_close(new, v, 1e-13)
    assert_close(affine, C, 1e-13)


@EACH_KERNEL
@EACH_DIM
@EACH_TRANSFER
def test_a_constant_velocity_stays(transfer, kernel, d):
    """Every transfer carries a constant velocity over to the particles, whatever they did before; C is then zero."""
    grid, _, stencil, _, v, _, _ = scattered(kernel, GRADIENTS["mls"], d)
    constant = np.broadcast_to(np.arange(1.0, d + 1), (grid.size, d))
    expected = np.broadcast_to(constant[0][:, None], v.shape)
    moved, new, affine, *_ = on_particles(transfer, stencil, expected, constant, constant)
    assert_close(moved, expected, 1e-14)
    assert_close(new, expected, 1e-14)
    assert (affine is not None) == transfer.affine
    if affine is not None:
        np.testing.assert_allclose(affine, 0, atol=1e-12)
    if not isinstance(transfer, mpm.FLIP):
        assert_close(on_particles(transfer, stencil, v, 0 * constant, constant)[1], expected, 1e-14)


@EACH_DIM
def test_flip_blends_the_change_with_pic(d):
    """FLIP(0) is PIC; FLIP(1) on a grid that does not change keeps every velocity; between them it is linear in α."""
    grid, _, stencil, _, v, _, _ = scattered(KERNELS["quadratic"], GRADIENTS["mls"], d)
    before, after = noise(grid, d), noise(grid, d, seed=4)
    pic = on_particles(mpm.PIC(), stencil, v, before, after)[1]
    ends = [on_particles(mpm.FLIP(alpha), stencil, v, before, after)[1] for alpha in (0.0, 1.0, 0.3)]
    np.testing.assert_array_equal(on_particles(mpm.FLIP(1.0), stencil, v, before, before)[1], v)
    assert_close(ends[0], pic, 1e-14)
    change = from_nodes(stencil, jnp.asarray(after - before))[0]
    assert_close(ends[1], v + change, 1e-14)
    assert_close(ends[2], 0.3 * ends[1] + 0.7 * ends[0], 1e-14)


@EACH_KERNEL
@EACH_DIM
@EACH_GRADIENT
@EACH_TRANSFER
def test_what_deforms_is_the_gradient_of_what_carries(transfer, gradient, kernel, d):
    """By the chosen operator, of the mean velocity if there is one; x and F are moved by them; an impulse at the
    particles, of one factor or of two, is the transpose."""
    grid, _, stencil, x, v, C, mass = scattered(kernel, gradient, d)
    if not transfer.affine:
        C = None
    before, after, mean = (jnp.asarray(noise(grid, d, seed)) for seed in (3, 4, 5))
    A, F = (jnp.asarray(np.random.default_rng(seed).normal(size=(d, d, v.shape[1]))) for seed in (6, 7))
    for mean_, carrier in ((None, after), (mean, mean)):
        arrays = (jnp.asarray(a) for a in (x, v))
        moved, _, _, slope, end, strained = to_particles(transfer, stencil, 0.1, *arrays, before, after, mean_, F=F)
        value, slopes = from_nodes(stencil, carrier)
        assert_close(moved, value, 1e-14)
        assert_close(slope, jnp.swapaxes(slopes, 0, 1), 1e-14)
        assert_close(end, x + 0.1 * value, 1e-14)
        assert_close(strained, F + 0.1 * jnp.einsum("abp,bcp->acp", slope, F), 1e-14)
    if stencil.is_least_squares or not transfer.affine:
        for B, impulse in ((None, 2 * A), (F, 2 * jnp.einsum("abp,cbp->acp", A, F))):
            factors = ((jnp.asarray(2.0), A, B), None)
            given = [to_grid(stencil, mass, jnp.asarray(v), C, grid.size, each) for each in factors]
            change = given[0][0][:, None] * (given[0][1] - given[1][1])
            assert float((change * mean).sum()) == pytest.approx(float((impulse * slope).sum()), rel=1e-10)


def test_velocity_and_its_gradient_are_those_of_the_new_velocity():
    """Not of the one that moves the particles: v, and C by moving least squares with APIC, whatever the gradient
    operator, and by the chosen one where PIC and FLIP keep it for viscosity."""
    for name, gradient in GRADIENTS.items():
        grid, _, stencil, _, v, _, _ = scattered(KERNELS["quadratic"], gradient, 2)
        before, after, mean = (jnp.asarray(noise(grid, 2, seed)) for seed in (3, 4, 5))
        for transfer in TRANSFERS.values():
            operator = stencil.least_squares if transfer.affine else stencil
            expected = jnp.swapaxes(from_nodes(operator, after)[1], 0, 1)
            alpha = transfer.alpha if isinstance(transfer, mpm.FLIP) else 0.0
            ends = [from_nodes(stencil, a)[0] for a in (after, after - before)]
            for mean_ in (None, mean):
                arrays = (jnp.asarray(v), before, after, mean_)
                _, new, C, *_ = to_particles(transfer, stencil, 0.1, 0 * arrays[0], *arrays, keep_gradient=True)
                assert_close(C, expected, 1e-14)
                assert_close(new, (1 - alpha) * ends[0] + alpha * (v + ends[1]), 1e-14)
        if name == "spline":
            assert np.abs(from_nodes(stencil, after)[1] - from_nodes(stencil.least_squares, after)[1]).max() > 1


def hat(order, r):
    """The B-spline at a distance of r spacings, in closed form."""
    r = abs(r)
    match order:
        case 1:
            return max(1 - r, 0)
        case 2:
            return 0.75 - r**2 if r < 0.5 else max(1.5 - r, 0) ** 2 / 2
        case _:
            return 2 / 3 - r**2 + r**3 / 2 if r < 1 else max(2 - r, 0) ** 3 / 6


@EACH_KERNEL
@EACH_DIM
def test_p2g_and_g2p_agree_with_a_plain_double_loop(kernel, d):
    """Sums over all nodes and a few particles in NumPy, with the kernel in closed form."""
    grid, nodes, stencil, x, v, C, mass = scattered(kernel, GRADIENTS["mls"], d)
    field = noise(grid, d)
    some = range(5)
    m = np.where(np.arange(len(mass)) < len(some), mass, 0)
    node_mass, momentum = np.zeros(grid.size), np.zeros((grid.size, d))
    gathered = np.zeros((d, len(some)))
    for p in some:
        for i, place in enumerate(nodes):
            w = np.prod([hat(kernel.order, (place[a] - x[a, p]) / float(grid.spacing)) for a in range(d)])
            node_mass[i] += w * m[p]
            momentum[i] += w * m[p] * (v[:, p] + C[:, :, p] @ (place - x[:, p]))
            gathered[:, p] += w * field[i]
    got_mass, got_momentum = on_nodes(stencil, m, v, C, grid.size)
    assert_close(got_mass, node_mass, 1e-13)
    assert_close(got_momentum, momentum, 1e-13)
    moved, *_ = on_particles(mpm.PIC(), stencil, v, field, field)
    assert_close(moved[:, : len(some)], gathered, 1e-13)


@pytest.mark.parametrize("alpha", [-0.1, 1.1, np.nan])
def test_a_flip_share_outside_zero_to_one_is_refused(alpha):
    """α must lie in [0, 1]."""
    with pytest.raises(ValueError, match="FLIP's alpha must be"):
        mpm.FLIP(alpha)
