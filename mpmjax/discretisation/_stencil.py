"""The stencil: the nodes, weights and weight gradients of each particle."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Indices, Int, ParticleVector, components
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import AbstractGradient, BSpline
from mpmjax.native import materialised


class Places(eqx.Module):
    """Where particles are among their nodes, from which a stencil's factors follow: in 3-D 6 numbers a particle for 27.

    The i-th node along an axis has the index term (first + i) stride, and as weight and as derivative the polynomials
    Σ_k c_ik (t − τ_i)^k in the offset t, around knots τ at which small weights are small by a power and not by a
    difference.
    """

    first: Int[Array, "d p"]
    """Number of the first node along each axis in the window, shape (d, p)."""
    strides: Int[Array, "d"]
    """Distance in the flat node index of neighbours along each axis, shape (d,)."""
    offset: Float[Array, "d p"]
    """t, the distance from the middle of the places that have these nodes, in spacings, shape (d, p)."""
    polynomials: Float[Array, "2 s k"]
    """τ, and c of the weights [-] and of their derivatives [1/m], shape (2, s, s + 2)."""


class Stencil(eqx.Module):
    """The nodes of each particle, s = order + 1 along each axis, with their weights and weight derivatives.

    Weights and gradients of the s^d stencil nodes are products of one factor for each axis, and only the factors are
    stored. w_ip is the product of the weights; g_ip in direction a has the weight derivative along a in place of the
    weight. The stencil is made at the positions x (updated Lagrangian), or once at the reference positions X (total
    Lagrangian), and gradients are with respect to those. Component first: the particle axis is last.
    """

    index_factors: Int[Array, "d s p"]
    """Term of the flat node index from each axis, shape (d, s, p); meaningless for a particle that is not `inside`."""
    weights: Float[Array, "d s p"]
    """Weights along each axis [-], shape (d, s, p)."""
    weight_derivatives: Float[Array, "d s p"]
    """Derivatives of the weights along each axis [1/m], by the scene's gradient operator, shape (d, s, p)."""
    mls_weight_derivatives: Float[Array, "d s p"] | None
    """Derivatives by moving least squares, shape (d, s, p); None if the scene's gradient operator is that, or if the
    transfer keeps no affine velocity."""
    moment: Float[Array, "d p"]
    """Diagonal of D_p [m²], shape (d, p)."""
    inside: Bool[Array, "p"]
    """Whether the whole stencil of the particle lies in the window."""
    places: Places | None = None
    """The compressed stencil, for sums that are not differentiated; None where factors are no such polynomials."""

    @property
    def least_squares(self) -> "Stencil":
        """The stencil with the gradient of moving least squares."""
        if self.mls_weight_derivatives is None:
            return self
        return replace(self, weight_derivatives=self.mls_weight_derivatives, mls_weight_derivatives=None, places=None)

    @property
    def squared(self) -> "Stencil":
        """The stencil of w_ip² and of the squared components g_ip,a²."""
        return replace(self, weights=self.weights**2, weight_derivatives=self.weight_derivatives**2, places=None)

    def of(self, particles: Int[Array, "s"]) -> "Stencil":
        """The stencil of some of the particles, by their numbers, with the scene's gradient operator alone."""
        whole = replace(self, mls_weight_derivatives=None, places=None)
        return jax.tree.map(lambda factor: factor[..., particles], whole)

    @property
    def factors(self) -> tuple[Array, Array, Array]:
        """Terms of the index, weights and their derivatives, each (d, s, p)."""
        return self.index_factors, self.weights, self.weight_derivatives

    @property
    def index(self) -> Indices:
        """Flat index of each stencil node, shape (s^d, p)."""
        return _tensor(jnp.add, list(self.index_factors))

    @property
    def weight(self) -> Float[Array, "k p"]:
        """w_ip [-], shape (s^d, p)."""
        return _tensor(jnp.multiply, list(self.weights))

    @property
    def gradient(self) -> Float[Array, "k d p"]:
        """g_ip [1/m] of the scene's gradient operator, shape (s^d, d, p)."""
        w, g = list(self.weights), list(self.weight_derivatives)
        return jnp.stack([_tensor(jnp.multiply, [*w[:a], g[a], *w[a + 1 :]]) for a in range(len(w))], axis=1)


@eqx.filter_jit
def in_window(kernel: BSpline, grid: Grid, window: Int[Array, "d"], x: ParticleVector) -> Bool[Array, "p"]:
    """Whether the whole stencil of a particle at x lies in the window, shape (p,)."""
    base = kernel.base(components(x) / grid.spacing)
    first = base - window.astype(base.dtype)[:, None]  # in floats: what is far outside overflows an integer
    shape = jnp.asarray(grid.shape, dtype=base.dtype)[:, None]
    along_axis = jnp.asarray(grid.periodic)[:, None] | ((first >= 0) & (first + kernel.order < shape))
    return reduce(jnp.logical_and, along_axis)


def make_stencil(
    kernel: BSpline,
    gradient: AbstractGradient,
    grid: Grid,
    window: Int[Array, "d"],
    x: ParticleVector,
    *,
    affine: bool,
    layer: Int[np.ndarray, "p"] | None = None,
) -> Stencil:
    """The stencil of particles at x.

    Args:
        kernel: B-spline.
        gradient: the gradient operator of the force and of the deformation gradient's update.
        grid: grid.
        window: lattice index of the window's first node.
        x: positions [m], shape (p, d).
        affine: whether the transfer keeps an affine velocity, which needs the moving-least-squares gradient.
        layer: the number of the nodes' layer of each particle, shape (p,). Default: there is one.
    """
    dx = grid.spacing
    xi = components(x) / dx
    f = materialised(xi - jax.lax.stop_gradient(kernel.base(xi)))
    weights, spline = kernel.weights(f), kernel.derivatives(f) / dx
    if kernel.order == 1:
        moment = f * (1 - f) * dx**2
        least_squares = spline
    else:
        variance = kernel.variance
        moment = jnp.full_like(f, variance) * dx**2
        offset = jnp.arange(kernel.order + 1, dtype=f.dtype)[:, None] - f[:, None]
        least_squares = weights * offset / (variance * dx)
    derivatives = gradient.derivatives(spline, least_squares)
    first = first_nodes(kernel, window, xi)
    factors = index_factors(kernel, grid, first)
    if layer is not None:
        factors = factors.at[0].add(jnp.asarray(layer * math.prod(grid.shape), jnp.int32))
        first = first.at[0].add(jnp.asarray(layer * grid.shape[0], jnp.int32))
    places = None
    if (derivatives is spline or derivatives is least_squares) and not any(grid.periodic):
        places = Places(
            first=first,
            strides=jnp.asarray(_strides(grid)),
            offset=jax.lax.stop_gradient(f - kernel.centre),
            polynomials=jax.lax.stop_gradient(
                _polynomials(kernel, jnp.asarray(dx, f.dtype), derivatives is not spline)
            ),
        )
    return Stencil(
        index_factors=factors,
        weights=weights,
        weight_derivatives=derivatives,
        mls_weight_derivatives=least_squares if affine and derivatives is not least_squares else None,
        moment=moment,
        inside=in_window(kernel, grid, window, x),
        places=places,
    )


def _polynomials(kernel: BSpline, spacing: Array, least_squares: bool) -> Float[Array, "2 s k"]:
    """Knots and coefficients of the weights and of their derivatives or those of moving least squares, shape
    (2, order + 1, order + 3)."""
    pieces, knots = kernel.pieces, kernel.knots
    if least_squares and kernel.order > 1:
        arms = [(node - kernel.centre - knot, -1.0) for node, knot in enumerate(knots)]
        slopes = [np.polynomial.polynomial.polymul(*both) for both in zip(pieces, arms, strict=True)]
        slopes = np.array(slopes) / kernel.variance
    else:
        slopes = np.pad(np.polynomial.polynomial.polyder(pieces, axis=1), ((0, 0), (0, 2)))
    weights = np.pad(pieces, ((0, 0), (0, 1)))
    coefficients = jnp.stack([jnp.asarray(weights, spacing.dtype), slopes.astype(spacing.dtype) / spacing])
    both_knots = jnp.broadcast_to(jnp.asarray(knots, spacing.dtype)[:, None], (2, len(knots), 1))
    return jnp.concatenate([both_knots, coefficients], axis=2)


def first_nodes(kernel: BSpline, window: Int[Array, "d"], xi: Array) -> Int[Array, "d p"]:
    """Number of the first stencil node along each axis in the window, shape (d, p), for positions xi in spacings."""
    return jax.lax.stop_gradient(kernel.base(xi)).astype(jnp.int32) - window.astype(jnp.int32)[:, None]


def _strides(grid: Grid) -> Int[np.ndarray, "d"]:
    """Distance in the C-order node index of neighbours along each axis, shape (d,)."""
    return np.array([math.prod(grid.shape[a + 1 :]) for a in range(grid.dim)], np.int32)


def index_factors(kernel: BSpline, grid: Grid, first: Int[Array, "d p"]) -> Int[Array, "d s p"]:
    """Term of the C-order node index from each axis, shape (d, s, p), from the `first_nodes`."""
    along = first[:, None] + jnp.arange(kernel.order + 1, dtype=jnp.int32)[:, None]
    if any(grid.periodic):  # by whole numbers in the code: XLA divides by those in an array one by one
        axes = zip(along, grid.shape, grid.periodic, strict=True)
        along = jnp.stack([index % period if wraps else index for index, period, wraps in axes])
    return along * _strides(grid)[:, None, None]


def _tensor(combine: Callable[[Array, Array], Array], factors: list[Array]) -> Array:
    """The outer combination of one factor for each axis, each (s, p), in C order, shape (s^d, p)."""
    combined = factors[0]
    for factor in factors[1:]:
        combined = combine(combined[:, None], factor).reshape(-1, factor.shape[-1])
    return combined
