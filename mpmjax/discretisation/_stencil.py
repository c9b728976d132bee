"""The stencil: where each particle is among its nodes, and the polynomials of which its weights are products.

Axisymmetry: bodies of revolution on a grid of their section, with coordinates (r, z) and the axis at r = 0. In the
Material Point Method: D. Sulsky, H. L. Schreyer, Comput. Methods Appl. Mech. Eng. 139 (1996) 409, doi
10.1016/S0045-7825(96)01091-2. A particle is a ring of section A: V0 = 2π r0 A and m = ρ V0, which `fill` gives it, so
masses and forces are those of the whole circle. Its gradient operator has a component more, the hoop's w_ip/r_p:

    ∇u = Σ_i u_i ⊗ ∇w_ip + (Σ_i w_ip u_i,r / r_p) e_θ ⊗ e_θ,    f_i = −Σ_p V0 (τ_p ∇w_ip + τ_p,θθ w_ip/r_p e_r).

f is the derivative of Σ V0 Ψ(F) by u, so that work, the symmetry of the Hessian and momentum along z are kept. F is a
3x3 matrix whose hoop entry stays r/r0 exactly in both descriptions, since a particle moves with what stretches it, and
every law is that of three dimensions. r_p is taken where the stencil stands: now, or in the total description at the
start. Of particles all is done here: a matrix of theirs is (3, 3, p), and what the nodes are given and give is (2, p)
and (2, 2, p). The mirror that a scene puts at the axis keeps u_r/r finite there, u_r being odd in r.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Indices, Int, ParticleVector, components
from mpmjax.autodiff import materialised
from mpmjax.discretisation._grid import Grid
from mpmjax.discretisation._kernel import VARIANCE, AbstractGradient, BSpline, around_knots

Kind = tuple[int, int]
"""A one-dimensional polynomial for each node: 0 for the weights or 1 for the gradient's factors, and how many times it
is differentiated."""
Term = tuple[Kind, ...]  # a polynomial along each axis, whose product is one number for each node of a particle


class Basis(NamedTuple):
    """Numbering of nodes, and polynomials, fixed in a program.

    The i-th node along an axis from the first one on has the polynomials Σ_k c_ik (t − τ_i)^k in the offset t, around
    knots τ at which small weights are small by a power and not by a difference. ξ is a place in spacings from the
    window's first node."""

    shape: tuple[int, ...]  # nodes along each axis
    periodic: tuple[bool, ...]  # whether each axis is
    knots: tuple[float, ...]  # τ, of the s nodes along an axis
    weights: tuple[tuple[float, ...], ...]  # c of the weights [-]
    slopes: tuple[tuple[float, ...], ...]  # c of the gradient's factors [1/spacing]
    moments: tuple[tuple[float, ...], ...]  # c of these factors by moving least squares [1/spacing]

    @property
    def value(self) -> tuple[Term]:
        """The term of the weights."""
        return (((0, 0),) * len(self.shape),)

    @property
    def gradient(self) -> tuple[Term, ...]:
        """The terms of the gradient's components."""
        axes = range(len(self.shape))
        return tuple(tuple((1, 0) if b == a else (0, 0) for b in axes) for a in axes)

    def base(self, xi: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """The number of the first node along an axis, without a derivative."""
        return jnp.floor(jax.lax.stop_gradient(xi) - (len(self.knots) - 2) / 2)

    def offset(self, xi: Float[Array, "*b p"]) -> Float[Array, "*b p"]:
        """t, the distance from the middle of the places that have the same nodes, in spacings."""
        return xi - self.base(xi) - (len(self.knots) - 1) / 2

    def index_terms(self, xi: Float[Array, "*b d p"]) -> Int[Array, "*b d s p"]:
        """The share of each axis in the flat index of a node. Around a periodic axis the nodes after its last are its
        first ones."""
        first = self.base(xi).astype(jnp.int32)
        along = first[..., None, :] + jnp.arange(len(self.knots), dtype=first.dtype)[:, None]
        if any(self.periodic):  # by whole numbers in the code: XLA divides by those in an array one by one
            axes = [along[..., a, :, :] for a in range(len(self.shape))]
            for a in np.flatnonzero(self.periodic):
                n = self.shape[a]
                axes[a] = axes[a] - n * (axes[a] // n - first[..., a, None, :] // n)
            along = jnp.stack(axes, axis=-3)
        strides = [math.prod(self.shape[a + 1 :]) for a in range(len(self.shape))]
        return along * np.array(strides, np.int32)[:, None, None]

    def polynomials(self, kind: Kind, t: Float[Array, "*b p"]) -> Float[Array, "*b s p"]:
        """The polynomials of a kind at offsets along an axis, or along several."""
        family, order = kind
        rows = np.array((self.weights, self.slopes)[family])
        rows = np.polynomial.polynomial.polyder(rows, order, axis=1) if order else rows
        return around_knots(rows, np.array(self.knots), t)


def basis_of(kernel: BSpline, grid: Grid, slopes: Float[np.ndarray, "s k"] | None = None) -> Basis:
    """The basis of a kernel on a grid, with the gradient's factors as `kernel.slopes`; by default these."""
    tables = kernel.pieces, kernel.slopes if slopes is None else slopes, kernel.moments
    rows = (tuple(map(tuple, np.asarray(table).tolist())) for table in tables)
    return Basis(grid.shape, grid.periodic, tuple(kernel.knots.tolist()), *rows)


def differentiated(terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """The derivatives of terms by t, along the first axis of all, along the second of all, ..."""
    axes = range(len(terms[0]))
    return tuple((*term[:b], (term[b][0], term[b][1] + 1), *term[b + 1 :]) for b in axes for term in terms)


class Stencil(eqx.Module):
    """The nodes of each particle, s = order + 1 along each axis, with their weights and weight gradients.

    Weights w_ip and gradients g_ip are products of one polynomial along each axis, of the particle's place ξ (see
    `Basis`): of w_ip the weights along the axes, of g_ip in direction a with the gradient's factor along a. The stencil
    is made at the positions x (updated Lagrangian), or once at the reference positions X (total Lagrangian), and
    gradients are with respect to those. Component first: the particle axis is last.
    """

    xi: Float[Array, "d p"]
    """ξ, the place in spacings from the window's first node, shape (d, p). Along periodic axes the stencil's first node
    is one of the window; before layer k lie k windows along the first axis."""
    slope: Float[Array, ""]  # factor of the gradient's polynomials, 1/dx [1/m]
    inside: Bool[Array, "p"]  # whether the whole stencil of the particle lies in the window
    basis: Basis = eqx.field(static=True)  # the polynomials, and the window
    own_derivatives: Float[Array, "d s p"] | None = None
    """The gradient's factors along each axis [1/m], shape (d, s, p), of a gradient operator that is not given by
    polynomials: all sums are then written in JAX. Else None."""
    flat: Bool[Array, "d p"] | None = None
    """Along which axes a particle has no gradient, shape (d, p). None: it has one along all."""
    radius: Float[Array, "p"] | None = None
    """Distance from the axis of bodies of revolution [m], shape (p,) (see `in_space`); else None."""

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return len(self.basis.shape)

    @property
    def strain_dim(self) -> int:
        """Rows of a particle's deformation gradient (see `Grid.strain_dim`)."""
        return len(self.basis.shape) if self.radius is None else 3

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
        radius = None if self.radius is None else self.radius**2
        custom, families = self.own_derivatives, (self.basis.weights, self.basis.slopes)
        squares = [[np.polynomial.polynomial.polymul(row, row).tolist() for row in rows] for rows in families]
        weights, slopes = (tuple(map(tuple, rows)) for rows in squares)
        basis = self.basis._replace(weights=weights, slopes=slopes)
        custom = None if custom is None else custom**2
        return replace(self, basis=basis, slope=self.slope**2, own_derivatives=custom, radius=radius)

    def of(self, particles: Int[Array, "s"]) -> "Stencil":
        """The stencil of some of the particles, by their numbers."""
        names = "xi", "inside", "own_derivatives", "flat", "radius"
        arrays = {name: getattr(self, name) for name in names}
        return replace(self, **{name: a if a is None else a[..., particles] for name, a in arrays.items()})

    def along(self, axis: int) -> "Stencil":
        """The stencil on the nodes of one axis, of whose layers all are one."""
        shape, flat, custom = self.basis.shape[axis : axis + 1], self.flat, self.own_derivatives
        part = slice(axis, axis + 1)
        return replace(
            self,
            xi=_around(self.basis, self.xi, (True,) * self.dim)[part],
            basis=self.basis._replace(shape=shape, periodic=self.basis.periodic[part]),
            own_derivatives=None if custom is None else custom[part],
            flat=None if flat is None else flat[part],
        )

    @property
    def moment(self) -> Float[Array, "d p"]:
        """Diagonal of D_p = Σ_i w_ip (x_i − x_p)(x_i − x_p)ᵀ [m²], shape (d, p)."""
        if (order := len(self.basis.knots) - 1) > 1:
            return jnp.full_like(self.xi, VARIANCE[order]) / self.slope**2
        t = self.basis.offset(self.xi)
        return (0.5 - t) * (0.5 + t) / self.slope**2

    @property
    def weights(self) -> Float[Array, "d s p"]:
        """Weights along each axis [-], shape (d, s, p)."""
        return self.basis.polynomials((0, 0), self.basis.offset(self.xi))

    @property
    def weight_derivatives(self) -> Float[Array, "d s p"]:
        """The gradient's factors along each axis [1/m], shape (d, s, p)."""
        custom = self.own_derivatives
        t = self.basis.offset(self.xi)
        derivatives = self.basis.polynomials((1, 0), t) * self.slope if custom is None else custom
        return derivatives if self.flat is None else jnp.where(self.flat[:, None], 0, derivatives)

    @property
    def index(self) -> Indices:
        """Flat index of each stencil node, shape (s^d, p)."""
        return _tensor(jnp.add, list(self.basis.index_terms(self.xi)))

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
    return locate(basis_of(kernel, grid), window, components(x) / grid.spacing)[1]


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
    basis, custom = basis_of(kernel, grid, gradient.polynomials(kernel)), None
    xi, inside = locate(basis, window, components(x) / dx)
    if layer is not None:
        start = layer * grid.shape[0]
        beyond = start + grid.shape[0] - (0 if grid.periodic[0] else kernel.order) + (kernel.order - 1) / 2
        most = np.nextafter(beyond.astype(x.dtype), 0)  # beyond it, by rounding or outside, are nodes of another layer
        place = xi[0] + jnp.asarray(start, x.dtype)
        xi = xi.at[0].set(jnp.where(place > most, most, place))
    xi = materialised(xi)
    if gradient.polynomials(kernel) is None:
        families = basis.slopes, basis.moments
        custom = gradient.derivatives(
            *(basis._replace(slopes=c).polynomials((1, 0), basis.offset(xi)) / dx for c in families)
        )
    radius = components(x)[0] if grid.axisymmetric else None
    return Stencil(xi, 1 / dx, inside, basis, custom, radius=radius)


def locate(
    basis: Basis, window: Int[Array, "d"], place: Float[Array, "d p"]
) -> tuple[Float[Array, "d p"], Bool[Array, "p"]]:
    """ξ of places in spacings from the origin, both (d, p), and whether all nodes of each lie in the window, (p,). They
    are moved by whole windows along periodic axes, until the first node does."""
    xi = place - window.astype(place.dtype)[:, None]
    xi = _around(basis, xi, basis.periodic) if any(basis.periodic) else xi
    first, shape = basis.base(xi), jnp.asarray(basis.shape, dtype=xi.dtype)[:, None]
    along_axis = jnp.asarray(basis.periodic)[:, None] | ((first >= 0) & (first + len(basis.knots) <= shape))
    return xi, reduce(jnp.logical_and, along_axis)


def _around(basis: Basis, xi: Float[Array, "d p"], wraps: tuple[bool, ...]) -> Float[Array, "d p"]:
    """Places moved by whole windows along some axes, so that the first node of each is one of the window."""

    def moved(place: Array, n: int) -> Array:
        place = place - n * jnp.floor(basis.base(place) / n)
        # by rounding: 41/41 is less than one in float32, as XLA divides, and what is just below a seam is on it
        place = jnp.where(basis.base(place) < n, place, place - n)
        return jnp.where(place < least, least, place)

    least, each = (len(basis.knots) - 2) / 2, zip(xi, basis.shape, wraps, strict=True)
    return jnp.stack([moved(place, n) if wrapped else place for place, n, wrapped in each])


def _tensor(combine: Callable[[Array, Array], Array], factors: list[Array]) -> Array:
    """The outer combination of one factor for each axis, each (s, p), in C order, shape (s^d, p)."""
    combined = factors[0]
    for factor in factors[1:]:
        combined = combine(combined[:, None], factor).reshape(-1, factor.shape[-1])
    return combined


def in_space(
    radius: Float[Array, "p"], value: Float[Array, "2 p"], slopes: Float[Array, "2 2 p"]
) -> Float[Array, "3 3 p"]:
    """The slopes of a field in space, from its value and slopes in the section: with u_r/r around the axis."""
    return jnp.pad(slopes, ((0, 1), (0, 1), (0, 0))).at[2, 2].set(value[0] / radius)


def in_section(
    radius: Float[Array, "p"], slopes: Float[Array, "3 3 p"]
) -> tuple[Float[Array, "2 p"], Float[Array, "2 2 p"]]:
    """The transpose of `in_space`: what particles give to the value and to the slopes in the section."""
    hoop = slopes[2, 2] / radius
    return jnp.stack([hoop, jnp.zeros_like(hoop)]), slopes[:2, :2]
