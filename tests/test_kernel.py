"""B-splines, gradient operators, and the stencil's place in the window."""

import dataclasses
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIMS, GRADIENTS, KERNELS, assert_close, ids, thorough

import mpmjax as mpm
from mpmjax.discretisation._stencil import in_window, make_stencil

DX = 0.125  # a power of two, so that lattice positions and edges are exact
COMBINATIONS = [
    pytest.param(kernel, gradient, d, id=f"{k}-{g}-{d}d", marks=() if d == 2 else pytest.mark.thorough)
    for k, kernel in KERNELS.items()
    for g, gradient in GRADIENTS.items()
    for d in DIMS
]


@eqx.filter_jit
def _make(kernel, gradient, grid, x):
    window = grid.window(x)
    stencil = make_stencil(kernel, gradient, grid, window, x)
    return stencil, window, grid.nodes(window), in_window(kernel, grid, window, x)


def make(kernel, gradient, grid, x):
    """The stencil, and as NumPy arrays window and node positions, and who is inside the window."""
    stencil, *others = _make(kernel, gradient, grid, jnp.asarray(x))
    return stencil, *map(np.asarray, others)


def places(d, seed=0, p=40):
    """Random positions in spacings inside a window of 8 nodes, with some on nodes, faces and centres of cells."""
    x = np.random.default_rng(seed).uniform(2, 5, (p, d))
    x[:3] = [[3.0], [3.5], [2.0]]
    return DX * x


@cache
def stencil_of(kernel, gradient, d):
    """A stencil and the vectors from particles to its nodes [m], shape (k, d, p)."""
    x = places(d)
    stencil, _, nodes, _ = make(kernel, gradient, mpm.Grid((8,) * d, DX), x)
    return stencil, nodes[stencil.index].swapaxes(1, 2) - x.T


@pytest.mark.parametrize(("kernel", "gradient", "d"), COMBINATIONS)
def test_weights_are_a_partition_of_unity(kernel, gradient, d):
    """Σ w = 1, no weight is negative, and the gradients sum to zero."""
    stencil, _ = stencil_of(kernel, gradient, d)
    np.testing.assert_allclose(stencil.weight.sum(axis=0), 1, rtol=1e-14)
    assert (stencil.weight >= 0).all()
    np.testing.assert_allclose(stencil.gradient.sum(axis=0), 0, atol=1e-14 / DX)


@pytest.mark.parametrize(("kernel", "gradient", "d"), COMBINATIONS)
def test_weights_and_gradients_reproduce_affine_functions(kernel, gradient, d):
    """Σ w (x_i − x) = 0 and Σ g (x_i − x)ᵀ = I, for the chosen gradient and for the transfer's."""
    stencil, arms = stencil_of(kernel, gradient, d)
    np.testing.assert_allclose((stencil.weight[:, None] * arms).sum(axis=0), 0, atol=1e-15)
    for g in (stencil.gradient, stencil.least_squares.gradient):
        slope = np.einsum("kap,kbp->abp", g, arms)
        np.testing.assert_allclose(slope, np.broadcast_to(np.eye(d)[..., None], slope.shape), atol=1e-13)


@pytest.mark.parametrize("kernel", **ids({k: KERNELS[k] for k in ("quadratic", "cubic")}))
def test_gradients_of_quadratic_functions(kernel):
    """Exact with the spline gradient, and with that of moving least squares and the cubic kernel. With the quadratic
    one it is off by 4 (s/4 − s³) dx, s spacings beyond the nearest node: of first order, opposite on its two sides.
    """
    x = places(1)
    s = x[:, 0] / DX - np.round(x[:, 0] / DX)
    s[np.isclose(abs(s), 0.5)] = 0.5
    for gradient, expected in ((mpm.SplineGradient(), 0 * s), (mpm.MLSGradient(), 4 * (s / 4 - s**3) * DX)):
        stencil, _, nodes, _ = make(kernel, gradient, mpm.Grid((8,), DX), x)
        slope = (stencil.gradient[:, 0] * nodes[stencil.index][..., 0] ** 2).sum(axis=0)
        miss = expected if kernel.order == 2 else 0 * s
        np.testing.assert_allclose(slope - 2 * x[:, 0], miss, atol=1e-13)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_spline_gradient_is_the_derivative_of_the_weights(kernel, d):
    """∇w is the forward derivative of the weights with respect to the particle's position."""
    grid = mpm.Grid((8,) * d, DX)

    @jax.jit
    def weight_and_gradient(x, along):
        def stencil(x):
            return make_stencil(kernel, mpm.SplineGradient(), grid, grid.window(x), x)

        return jax.jvp(lambda x: stencil(x).weight, (x,), (along,))[1], stencil(x).gradient

    x = jnp.asarray(places(d))
    for axis in range(d):
        derivative, gradient = weight_and_gradient(x, jnp.zeros_like(x).at[:, axis].set(1))
        assert_close(gradient[:, axis], derivative, 1e-13)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_linear_kernel_has_one_gradient(d):
    """With hat functions the least-squares gradient is the spline's, at nodes too, where D is singular."""
    one, other = (stencil_of(KERNELS["linear"], gradient, d)[0] for gradient in GRADIENTS.values())
    assert_close(one.gradient, other.gradient, 1e-15)
    assert np.isfinite(one.gradient).all()


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_moment_is_the_second_moment_of_the_weights(kernel, d):
    """D_p = Σ w (x_i − x)(x_i − x)ᵀ is diagonal, and `moment` is its diagonal; MLS gradients are D⁻¹ w (x_i − x)."""
    stencil, arms = stencil_of(kernel, GRADIENTS["mls"], d)
    D = np.einsum("kp,kap,kbp->abp", stencil.weight, arms, arms)
    np.testing.assert_allclose(D, np.eye(d)[..., None] * stencil.moment, atol=1e-15)
    assert_close(stencil.gradient * stencil.moment, stencil.weight[:, None] * arms, 1e-13)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_nodes_are_those_within_the_support(kernel, d):
    """The stencil lists, once each, all nodes with a weight, and every weight is the kernel at its node's distance."""
    stencil, arms = stencil_of(kernel, GRADIENTS["spline"], d)
    assert (np.abs(arms) <= DX * (kernel.order + 1) / 2 + 1e-12).all()
    assert all(len(set(nodes)) == (kernel.order + 1) ** d for nodes in np.asarray(stencil.index).T)
    r = np.abs(arms) / DX
    hat = {
        1: lambda r: 1 - r,
        2: lambda r: np.where(r < 0.5, 0.75 - r**2, 0.5 * (1.5 - r) ** 2),
        3: lambda r: np.where(r < 1, 2 / 3 - r**2 + r**3 / 2, (2 - r) ** 3 / 6),
    }[kernel.order]
    np.testing.assert_allclose(stencil.weight, hat(r).prod(axis=1), atol=1e-14)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_periodic_indices_wrap(kernel, d):
    """A shift by any number of periods changes no index or weight, and no particle is outside."""
    grid = mpm.Grid((8,) * d, DX, periodic=True)
    x = np.random.default_rng(1).uniform(0, 8, (30, d))
    x[0], x[1] = 0.0, 7.9
    x *= DX
    period = 8 * DX * np.random.default_rng(2).integers(-3, 4, x.shape)
    here, there = (make(kernel, mpm.MLSGradient(), grid, y)[0] for y in (x, x + period))
    assert here.inside.all()
    assert ((here.index >= 0) & (here.index < grid.size)).all()
    np.testing.assert_array_equal(here.index, there.index)
    assert_close(here.weight, there.weight, 1e-12)
    lattice = np.stack(np.unravel_index(here.index, grid.shape), axis=1)  # (k, d, p)
    distance = lattice * DX - x.T
    distance -= 8 * DX * np.round(distance / (8 * DX))
    assert (np.abs(distance) <= DX * (kernel.order + 1) / 2 + 1e-12).all()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "n", [41, 49, 64]
)  # XLA divides by these by their reciprocals: 41/41 in float32 is less than 1
def test_beside_a_seam_nodes_are_those_of_the_window_and_of_the_layer(n, dtype):
    """However near to where the first node jumps, and however many windows away."""
    kernel, grid = mpm.BSpline(2), mpm.Grid((n,), 1.0, periodic=True, layers=4)
    seam = np.asarray(0.5 + n * np.arange(-2.0, 3.0), dtype)
    x = np.concatenate([seam, np.nextafter(seam, -n), np.nextafter(seam, 3 * n), seam + np.asarray(0.7, dtype)])[
        :, None
    ]
    for layer in (0, 3):
        layers = np.full(len(x), layer)
        make = lambda x, layers=layers: make_stencil(kernel, mpm.MLSGradient(), grid, grid.window(x), x, layer=layers)  # noqa: E731
        index = jax.jit(lambda x, make=make: make(x).index)(jnp.asarray(x))
        np.testing.assert_array_equal(index // n, layer)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("origin", [0, -3])
def test_particles_outside_are_flagged_also_at_the_edges(kernel, d, origin):
    """Inside is from (order − 1)/2 spacings off the first node, included, to as far from the last, excluded."""
    n, half = 8, (kernel.order - 1) / 2
    grid = mpm.Grid((n,) * d, DX, origin=(origin,) * d)
    tiny = 1e-9
    along = np.array([half, half - tiny, n - 1 - half - tiny, n - 1 - half, -1.0, n + 5.0, n / 2])
    expected = [True, False, True, False, False, False, True]
    for axis in range(d):
        x = np.full((len(along), d), n / 2)
        x[:, axis] = along
        x = DX * (x + origin)
        stencil, _, nodes, inside = make(kernel, mpm.SplineGradient(), grid, x)
        np.testing.assert_array_equal(inside, expected)
        np.testing.assert_array_equal(stencil.inside, expected)
        reproduced = np.einsum("kp,kpa->pa", stencil.weight[:, expected], nodes[stencil.index[:, expected]])
        np.testing.assert_allclose(reproduced, x[expected], atol=1e-14)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_only_the_open_direction_of_a_half_periodic_window_has_an_outside(d):
    """Direction 0 wraps, the others do not."""
    grid = mpm.Grid((8,) * d, DX, periodic=(True,) + (False,) * (d - 1))
    x = DX * np.stack([np.full(d, 4.0), np.r_[-9.0, np.full(d - 1, 4.0)], np.full(d, -9.0)])
    inside = make(mpm.BSpline(), mpm.MLSGradient(), grid, x)[-1]
    np.testing.assert_array_equal(inside, [True, True, d == 1])


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_stencil_does_not_depend_on_where_the_window_lies(kernel, d):
    """A shift of particles and origin by k dx gives the same indices, and weights and gradients to 1e-13."""
    shift = np.arange(3, 3 + d)
    here, _ = stencil_of(kernel, mpm.MLSGradient(), d)
    there = make(kernel, mpm.MLSGradient(), mpm.Grid((8,) * d, DX, origin=shift.tolist()), places(d) + DX * shift)[0]
    np.testing.assert_array_equal(here.index, there.index)
    assert_close(here.weight, there.weight, 1e-13)
    assert_close(here.gradient, there.gradient, 1e-13)


def test_indices_have_32_bits_whatever_a_window_has():
    """Those that native sums have kernels for."""
    x, window = places(2), np.zeros(2)
    for dtype in ("int32", "int64"):
        stencil = make_stencil(
            mpm.BSpline(),
            mpm.MLSGradient(),
            mpm.Grid((8, 8), DX),
            jnp.asarray(window, dtype),
            jnp.asarray(x),
        )
        assert stencil.index.dtype == jnp.int32


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_following_window_keeps_the_material_in_its_middle(d):
    """Wherever the particles go they are inside, their window moves by whole spacings, their stencil stays."""
    grid = mpm.Grid((10,) * d, DX, follow=True)
    kernel, gradient, x = mpm.BSpline(), mpm.MLSGradient(), places(d)
    here, home, _, _ = make(kernel, gradient, grid, x)
    for shift in (1, -7, 4000):
        moved = x + shift * DX
        there, window, nodes, inside = make(kernel, gradient, grid, moved)
        np.testing.assert_array_equal(window - home, shift)
        assert inside.all()
        np.testing.assert_array_equal(here.index, there.index)
        assert_close(here.weight, there.weight, 1e-11)
        middle = (moved.min(axis=0) + moved.max(axis=0)) / 2
        assert (np.abs(nodes.mean(axis=0) - middle) <= DX).all()


@pytest.mark.parametrize("order", [0, 4, -1])
def test_other_orders_are_refused(order):
    """Only orders 1, 2 and 3 exist."""
    with pytest.raises(ValueError, match="order must be from 1 to 3"):
        mpm.BSpline(order)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
@pytest.mark.parametrize("gradient", **ids(GRADIENTS))
def test_polynomials_have_their_derivatives(kernel, gradient):
    """Of every order, at the edge of a cell too; and offsets lie in the interval of which they hold."""
    stencil, _ = stencil_of(kernel, gradient, 2)
    basis, t = stencil.basis, stencil.basis.offset(stencil.xi)
    assert (abs(t) <= 0.5).all()
    for family in (0, 1):
        for order in range(5):
            value = lambda t, kind=(family, order): basis.polynomials(kind, t)  # noqa: E731
            slope = jax.jvp(value, (t,), (jnp.ones_like(t),))[1]
            np.testing.assert_allclose(basis.polynomials((family, order + 1), t), slope, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("kernel", **ids(KERNELS))
def test_small_weights_are_small_by_a_power(kernel):
    """Near a knot a weight is right to rounding of itself, not of the largest."""
    edge = 4.0 + (kernel.order + 1) % 2 / 2
    away = np.logspace(-6, -2, 9)
    stencil = make(kernel, mpm.MLSGradient(), mpm.Grid((12,), 1.0), (edge + away)[:, None])[0]
    least = np.asarray(stencil.weight).min(axis=0)
    expected = {1: away, 2: away**2 / 2, 3: away**3 / 6}[kernel.order]
    np.testing.assert_allclose(least, expected, rtol=1e-9)


def test_what_is_made_of_a_stencil():
    """Its squares, some of its particles, and moving least squares, also of a gradient operator given by no polynomials
    and where some particles have no gradient."""

    class Half(mpm.discretisation.AbstractGradient):
        def derivatives(self, spline, least_squares):
            return (spline + least_squares) / 2

    x, kernel, grid = places(2), KERNELS["quadratic"], mpm.Grid((8, 8), DX)
    mls, spline = (make(kernel, gradient, grid, x)[0] for gradient in (mpm.MLSGradient(), mpm.SplineGradient()))
    half = make(kernel, Half(), grid, x)[0]
    assert_close(half.gradient, (mls.gradient + spline.gradient) / 2, 1e-14)
    assert mls.is_least_squares
    assert mls.least_squares is mls
    flat = dataclasses.replace(spline, flat=jnp.arange(80).reshape(2, 40) % 3 == 0)
    assert_close(flat.gradient, jnp.where(flat.flat, 0, spline.gradient), 1e-15)
    for one in (mls, spline, half, flat):
        assert_close(one.squared.weight, one.weight**2, 1e-14)
        assert_close(one.squared.gradient, one.gradient**2, 1e-13)
        assert_close(one.of(jnp.asarray([3, 1])).gradient, one.gradient[..., jnp.asarray([3, 1])], 1e-15)
        assert_close(one.least_squares.gradient, mls.gradient, 1e-14)
