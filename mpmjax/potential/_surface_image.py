"""Surfaces of any shape that hold a fluid: the map of the nodes about them, linear across the surface."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector
from mpmjax.discretisation import BSpline, Grid, MLSGradient, Stencil, gather, make_stencil, scatter

_NEAR = 8  # the part of all nodes for which there is room about a surface; where it has more, sums are over all


class _Rows(eqx.Module):
    """Nodes about a surface, all or some, in rows."""

    number: Int[Array, "m"]  # theirs, or of none where rows are left over, shape (m,)
    stencil: Stencil  # of the places whose nodes each follows, with weights w_ik
    height: Float[Array, "m"]  # ξ, the distance before the surface in spacings, shape (m,)
    normal: Float[Array, "m d"]  # n, out of the surface [-], shape (m, d)

    def of(self, field: Float[Array, "n *c"]) -> Float[Array, "m *c"]:
        """A field's values there, zero for no nodes."""
        return field.at[self.number].get(mode="fill", fill_value=0, wrap_negative_indices=False)

    def laid(self, values: Float[Array, "m c"], like: Float[Array, "n k"]) -> Float[Array, "n c"]:
        """A field with these values, zero elsewhere."""
        zeros = jnp.zeros((len(like), values.shape[1]), values.dtype)
        return zeros.at[self.number].add(values, wrap_negative_indices=False)


class SurfaceImage(eqx.Module):
    """The map of a surface (see `surface_image`). A node i that follows its parents k, with weights τ_ik, has

    v_i = (1 − n_i n_iᵀ) Σ τ_ik v_k + n_i Σ τ_ik (ξ_i/ξ_k) n_k·v_k,   where the surface sticks Σ τ_ik (ξ_i/ξ_k) v_k .
    """

    stencil: Stencil  # of the places whose nodes each node follows, with weights w_ik
    height: NodeScalar  # ξ, the distance before the surface in spacings, shape (n,)
    normal: NodeVector  # n, out of the surface [-], shape (n, d)
    near: _Rows  # the nodes that may follow, as many as there is room for
    fits: Bool[Array, ""]  # whether there is room for all of them
    parents: NodeScalar  # p_k, one for nodes that may be followed and else zero, shape (n,)
    behind: Bool[Array, "n"]  # the nodes that may follow, shape (n,)
    share: NodeScalar  # 1/Σ w_ik p_k, with τ_ik = w_ik p_k times that, or zero for nodes that follow none, shape (n,)
    velocity: NodeVector | None = None
    """Velocity V of a surface that moves, at the nodes [m/s], shape (n, d); None at rest. v is then relative to it,
    along normals alone unless it sticks."""
    sticks: bool = eqx.field(static=True, default=False)  # whether it holds the whole velocity

    @property
    def follows(self) -> Bool[Array, "n"]:
        """The nodes that follow others, shape (n,)."""
        return self.share > 0

    def taking(self, usable: Bool[Array, "n"]) -> "SurfaceImage":
        """The map with parents among these alone; a node without any stays free."""
        parents = jnp.where(usable, self.parents, 0)
        total = replace(self, parents=parents, share=self.behind.astype(parents.dtype)).mean(parents[:, None])[:, 0]
        some = total > 1e-6
        return replace(self, parents=parents, share=jnp.where(some, 1 / jnp.where(some, total, 1), 0))

    def where(self, active: Bool[Array, "n"]) -> "SurfaceImage":
        """The map of nodes most of whose parents are held."""
        held = self.mean(active.astype(self.share.dtype)[:, None])[:, 0] > 0.5
        return replace(self, behind=self.behind & held, share=jnp.where(held, self.share, 0))

    def _by_rows(self, function: Callable[..., Any], *fields: Array) -> Any:
        """A function of rows, their shares, and fields of nodes: of rows near the surface, or of all without room."""

        def over(rows: _Rows, *fields: Array) -> Any:
            return function(rows, rows.of(self.share), *fields)

        every = _Rows(jnp.arange(len(self.height)), self.stencil, self.height, self.normal)
        return jax.lax.cond(self.fits, partial(over, self.near), partial(over, every), *fields)

    def mean(self, field: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """Σ_k τ_ik f_k."""

        def followed(rows: _Rows, share: Array, leading: Array) -> Array:
            return rows.laid((share * gather(rows.stencil, leading)[0]).T, leading)

        return self._by_rows(followed, self.parents[:, None] * field)

    def spread(self, field: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """Σ_i τ_ik f_i."""
        return jax.linear_transpose(self.mean, field)(field)[0]

    @property
    def inverse(self) -> Float[Array, "n 1"]:
        """1/ξ of nodes before the surface, shape (n, 1)."""
        before = self.height > 0
        return jnp.where(before, 1 / jnp.where(before, self.height, 1), 0)[:, None]

    @property
    def slope(self) -> NodeVector:
        """n/ξ of nodes before the surface, shape (n, d)."""
        return self.inverse * self.normal

    def scalar(self, field: Array) -> Array:
        """B for an even scalar field."""
        columns = field.reshape(len(field), -1)
        return jnp.where(self.follows[:, None], self.mean(columns), columns).reshape(field.shape)

    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field."""
        strain = self.inverse * field if self.sticks else (self.slope * field).sum(axis=1, keepdims=True)
        leading = self.parents[:, None] * (strain if self.sticks else jnp.concatenate([field, strain], axis=1))

        def following(rows: _Rows, share: Array, leading: Array) -> Array:
            along, height, normal = (share * gather(rows.stencil, leading)[0]).T, rows.height[:, None], rows.normal
            if self.sticks:
                return rows.laid(height * along, leading)
            along, strain = along[:, :-1], along[:, -1:]
            across = height * strain - (normal * along).sum(axis=1, keepdims=True)
            return rows.laid(along + across * normal, leading)

        return jnp.where(self.follows[:, None], 0, field) + self._by_rows(following, leading)

    def fold_scalar(self, field: Array) -> Array:
        """Bᵀ for an even scalar field, shape (n,), or for several in columns."""
        return jax.linear_transpose(self.scalar, field)(field)[0]

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ for a vector field."""
        return jax.linear_transpose(self.vector, field)(field)[0]

    def fold_masses(self, masses: Float[Array, "n d d"], mass: NodeScalar) -> tuple[Float[Array, "n d d"], NodeScalar]:
        """The masses of parents, Σ τ_ik G_ikᵀ M_i G_ik with v_i = Σ τ_ik G_ik v_k: as much as BᵀMB or more, for any
        velocity; and Bᵀ of a mass."""
        d, size, slope = masses.shape[-1], len(mass), self.slope

        def taken_from(rows: _Rows, share: Array, masses: Array, mass: Array) -> Array:
            M, n, height = rows.of(masses), rows.normal, rows.height[:, None]
            if self.sticks:
                parts = [height**2 * M.reshape(-1, d * d)]
            else:
                pushed = (M * n[:, None]).sum(axis=2)  # M n
                across = (pushed * n).sum(axis=1, keepdims=True)
                bent = pushed - across * n  # (1 − n nᵀ) M n
                along = M - n[:, :, None] * pushed[:, None] - bent[:, :, None] * n[:, None]
                parts = [along.reshape(-1, d * d), height * bent, height**2 * across]
            return scatter(
                rows.stencil, share * jnp.concatenate([*parts, rows.of(mass)[:, None]], axis=1).T, None, size
            )

        taken = self.parents[:, None] * self._by_rows(taken_from, masses, mass)
        around, mass = taken[:, : d * d].reshape(masses.shape), jnp.where(self.follows, 0, mass + taken[:, -1])
        if self.sticks:
            around = self.inverse[:, None] ** 2 * around
        else:
            mixed = (taken[:, d * d : -2] + taken[:, -2:-1] * slope / 2)[:, None] * slope[:, :, None]
            around = around + mixed + mixed.swapaxes(1, 2)
        return jnp.where(self.follows[:, None, None], 0, masses + around), mass

    def reached(self, shape: tuple[int, ...]) -> Mask:
        """All components of velocity of what follows and is followed, a mask of this shape (n, d)."""
        follows = self.follows
        touched = follows | (self.spread(follows[:, None].astype(self.share.dtype))[:, 0] > 0)
        return jnp.broadcast_to(touched[:, None], shape)

    def carried(self, dim: int) -> Mask:
        """All components of the nodes that follow, a mask of shape (n, d)."""
        return jnp.broadcast_to(self.follows[:, None], (len(self.height), dim))

    def with_motion(self, field: NodeVector) -> NodeVector:
        """A velocity [m/s] with (1 − B) V where nodes follow, of its normal part alone unless the surface sticks."""
        V = self.following(jnp.zeros_like(field))
        added = V - self.vector(V)
        if not self.sticks:
            added = (self.normal * added).sum(axis=1, keepdims=True) * self.normal
        return jnp.where(self.follows[:, None], added, field)

    def following(self, v: NodeVector) -> NodeVector:
        """A velocity [m/s], shape (n, d), that moves with the surface, along its normal or where it sticks wholly."""
        assert self.velocity is not None
        across = ((self.velocity - v) * self.normal).sum(axis=1, keepdims=True)
        return self.velocity if self.sticks else v + across * self.normal

    def moved(self, unfolded: NodeVector, field: NodeVector) -> NodeVector:
        """As of a `WallImage`."""
        return unfolded if self.velocity is None else unfolded + jnp.where(self.follows[:, None], field, 0)


def surface_image(
    distance: NodeScalar,
    normal: NodeVector,
    filled: Bool[Array, "n"],
    grid: Grid,
    window: Int[Array, "d"],
    order: int,
    velocity: NodeVector | None,
    sticks: bool = False,
) -> SurfaceImage:
    """The map of a surface at signed distances [m] from the nodes, for a kernel of this order.

    Nodes less than ξ_b before it, half the kernel's order, follow the `filled` ones up to two spacings farther, by the
    weights of a quadratic kernel ξ_b + ½ before their foot on the surface. Normal velocities are linear across it and
    zero on it, so that forces of a uniform pressure have nearly no sum on any node; tangential ones are constant, or
    where it `sticks` linear too.
    """
    height, dx = distance / grid.spacing, jnp.asarray(grid.spacing, distance.dtype)
    first, sloping = max(order, 1) / 2, (normal**2).sum(axis=1) > 0
    layer = np.repeat(np.arange(grid.layers), grid.size // grid.layers)
    place = grid.nodes(window) + (jnp.where(sloping, first + 0.5 - height, 0) * dx)[:, None] * normal
    stencil = make_stencil(BSpline(2), MLSGradient(), grid, window, place, layer=None if grid.layers == 1 else layer)
    behind = (height < first) & (height > -(order + 3) / 2) & sloping & stencil.inside & filled.any()
    stencil = replace(stencil, xi=jnp.where(behind, stencil.xi, 1))  # elsewhere in the window too
    number = jnp.nonzero(behind, size=-(-len(height) // _NEAR), fill_value=len(height))[0].astype(jnp.int32)
    near, fits = _Rows(number, stencil.of(number), height[number], normal[number]), behind.sum() <= len(number)
    ones = jnp.ones_like(height)
    image = SurfaceImage(stencil, height, normal, near, fits, ones, behind, ones, velocity, sticks)
    return image.taking(filled & (height >= first) & (height < first + 2))


def one_mass(masses: Float[Array, "n d d"], mass: NodeScalar, fixed: Mask) -> tuple[Array, Array]:
    """Factors A of nodes' velocities, and A⁻¹, both of shape (n, d, d), by which masses M that differ by direction are
    one, Aᵀ M A = m: A = √m L⁻ᵀ with L Lᵀ = M. Where a component is `fixed` A is diagonal, for as much mass or more."""
    d, eye = masses.shape[-1], jnp.eye(masses.shape[-1], dtype=masses.dtype)
    held = jnp.abs(masses).sum(axis=2)[..., None] * eye
    masses = jnp.where(fixed.any(axis=1)[:, None, None], held, masses)
    some = mass > 0
    lacking = (masses * eye).sum(axis=2) == 0  # components that follow others at a wall across their axis
    masses = jnp.where(some[:, None, None], masses + jnp.where(lacking, mass[:, None], 0)[:, None] * eye, eye)
    M, root = la.entries(jnp.moveaxis(masses, 0, -1)), jnp.sqrt(jnp.where(some, mass, 1))
    L = [[jnp.zeros_like(mass)] * d for _ in range(d)]
    A = [[jnp.zeros_like(mass)] * d for _ in range(d)]
    for i in range(d):
        for j in range(i + 1):
            left = M[i][j] - sum(L[i][k] * L[j][k] for k in range(j))
            L[i][j] = jnp.sqrt(left) if i == j else left / L[j][j]
        for j in range(i + 1):  # of L⁻¹, transposed
            A[j][i] = ((root if i == j else 0) - sum(L[i][k] * A[j][k] for k in range(j, i))) / L[i][i]
    inverse = la.transpose(la.assemble(L)) / root
    return jnp.moveaxis(la.assemble(A), -1, 0), jnp.moveaxis(inverse, -1, 0)
