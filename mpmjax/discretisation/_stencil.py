"""The stencil: where each particle is among its nodes, from which weights and weight gradients follow."""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Indices, Int, ParticleVector, components
from mpmjax.autodiff import materialised
from mpmjax.discretisation._basis import Basis, basis_of
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import VARIANCE, AbstractGradient, BSpline


class Stencil(eqx.Module):
    """The nodes of each particle, s = order + 1 along each axis, with their weights and weight gradients.

    Weights w_ip and gradients g_ip are products of one polynomial along each axis, in the offset t of the particle (see
    `Basis`): of w_ip the weights along the axes, of g_ip in direction a with the gradient's factor along a. The stencil
    is made at the positions x (updated Lagrangian), or once at the reference positions X (total Lagrangian), and
    gradients are with respect to those. Component first: the particle axis is last.
    """

    first: Int[Array, "d p"]
    """Number of the first node along each axis in the window, shape (d, p); meaningless for a particle that is not
    `inside`."""
    offset: Float[Array, "d p"]
    """t, the distance from the middle of the places that have these nodes, in spacings, shape (d, p)."""
    slope: Float[Array, ""]
    """Factor of the gradient's polynomials, 1/dx [1/m]."""
    inside: Bool[Array, "p"]
    """Whether the whole stencil of the particle lies in the window."""
    basis: Basis = eqx.field(static=True)
    own_derivatives: Float[Array, "d s p"] | None = None
    """The gradient's factors along each axis [1/m], shape (d, s, p), of a gradient operator that is not given by
    polynomials: all sums are then written in JAX. Else None."""
    flat: Bool[Array, "d p"] | None = None
    """Along which axes a particle has no gradient, shape (d, p). None: it has one along all."""

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return len(self.basis.shape)

    @property
    def is_least_squares(self) -> bool:
        """Whether the gradient is that of moving least squares."""
        return self.own_derivatives is None and self.basis.slopes == self.basis.moments

    @property
    def least_squares(self) -> "Stencil":
        """The stencil with the gradient of moving least squares."""
        if self.is_least_squares:
            return self
        basis = self.basis._replace(slopes=self.basis.moments)
        return replace(self, basis=basis, own_derivatives=None, flat=None)

    @property
    def squared(self) -> "Stencil":
        """The stencil of w_ip² and of the squared components g_ip,a²."""
        custom, families = self.own_derivatives, (self.basis.weights, self.basis.slopes)
        squares = [[np.polynomial.polynomial.polymul(row, row).tolist() for row in rows] for rows in families]
        weights, slopes = (tuple(map(tuple, rows)) for rows in squares)
        basis = self.basis._replace(weights=weights, slopes=slopes)
        return replace(self, basis=basis, slope=self.slope**2, own_derivatives=None if custom is None else custom**2)

    def of(self, particles: Int[Array, "s"]) -> "Stencil":
        """The stencil of some of the particles, by their numbers."""
        arrays = self.first, self.offset, self.inside, self.own_derivatives, self.flat
        first, offset, inside, custom, flat = (a if a is None else a[..., particles] for a in arrays)
        return replace(self, first=first, offset=offset, inside=inside, own_derivatives=custom, flat=flat)

    @property
    def moment(self) -> Float[Array, "d p"]:
        """Diagonal of D_p = Σ_i w_ip (x_i − x_p)(x_i − x_p)ᵀ [m²], shape (d, p)."""
        order, t = len(self.basis.knots) - 1, self.offset
        return ((0.5 - t) * (0.5 + t) if order == 1 else jnp.full_like(t, VARIANCE[order])) / self.slope**2

    @property
    def weights(self) -> Float[Array, "d s p"]:
        """Weights along each axis [-], shape (d, s, p)."""
        return self.basis.polynomials((0, 0), self.offset)

    @property
    def weight_derivatives(self) -> Float[Array, "d s p"]:
        """The gradient's factors along each axis [1/m], shape (d, s, p)."""
        custom = self.own_derivatives
        derivatives = self.basis.polynomials((1, 0), self.offset) * self.slope if custom is None else custom
        return derivatives if self.flat is None else jnp.where(self.flat[:, None], 0, derivatives)

    @property
    def index(self) -> Indices:
        """Flat index of each stencil node, shape (s^d, p)."""
        return _tensor(jnp.add, list(self.basis.index_terms(self.first)))

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
    layer: Int[np.ndarray, "p"] | None = None,
) -> Stencil:
    """The stencil of particles at x.

    Args:
        kernel: B-spline.
        gradient: the gradient operator of the force and of the deformation gradient's update.
        grid: grid.
        window: lattice index of the window's first node.
        x: positions [m], shape (p, d).
        layer: the number of the nodes' layer of each particle, shape (p,). Default: there is one.
    """
    dx = jnp.asarray(grid.spacing, x.dtype)
    xi = components(x) / dx
    offset = materialised(xi - jax.lax.stop_gradient(kernel.base(xi)) - kernel.centre)
    first = first_nodes(kernel, grid, window, xi)
    if layer is not None:
        first = first.at[0].add(jnp.asarray(layer * grid.shape[0], jnp.int32))
    basis, custom = basis_of(kernel, grid, gradient.polynomials(kernel)), None
    if gradient.polynomials(kernel) is None:
        families = basis.slopes, basis.moments
        custom = gradient.derivatives(*(basis._replace(slopes=c).polynomials((1, 0), offset) / dx for c in families))
    return Stencil(first, offset, 1 / dx, in_window(kernel, grid, window, x), basis, custom)


def first_nodes(kernel: BSpline, grid: Grid, window: Int[Array, "d"], xi: Array) -> Int[Array, "d p"]:
    """Number of the first stencil node along each axis in the window, shape (d, p), for positions xi in spacings."""
    first = jax.lax.stop_gradient(kernel.base(xi)).astype(jnp.int32) - window.astype(jnp.int32)[:, None]
    if any(grid.periodic):
        axes = zip(first, grid.shape, grid.periodic, strict=True)
        first = jnp.stack([index % period if wraps else index for index, period, wraps in axes])
    return first


def _tensor(combine: Callable[[Array, Array], Array], factors: list[Array]) -> Array:
    """The outer combination of one factor for each axis, each (s, p), in C order, shape (s^d, p)."""
    combined = factors[0]
    for factor in factors[1:]:
        combined = combine(combined[:, None], factor).reshape(-1, factor.shape[-1])
    return combined
