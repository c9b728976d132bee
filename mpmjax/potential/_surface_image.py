"""Surfaces of any shape that hold a fluid: the map of the nodes about them, linear across the surface."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector
from mpmjax.discretisation import BSpline, Grid, MLSGradient, make_stencil


class SurfaceImage(eqx.Module):
    """The map of a surface (see `surface_image`). A node i that follows its parents k, with weights τ_ik, has

    v_i = (1 − n_i n_iᵀ) Σ τ_ik v_k + n_i Σ τ_ik (ξ_i/ξ_k) n_k·v_k,   where the surface sticks Σ τ_ik (ξ_i/ξ_k) v_k .
    """

    parents: Int[Array, "k n"]  # the numbers of each node's parents, shape (k, n)
    part: Float[Array, "k n"]  # τ_ik [-], of sum one, or zero for nodes that follow none, shape (k, n)
    height: NodeScalar  # ξ, the distance before the surface in spacings, shape (n,)
    normal: NodeVector  # n, out of the surface [-], shape (n, d)
    velocity: NodeVector | None = None
    """Velocity V of a surface that moves, at the nodes [m/s], shape (n, d); None at rest. v is then relative to it,
    along normals alone unless it sticks."""
    sticks: bool = eqx.field(static=True, default=False)  # whether it holds the whole velocity

    @property
    def follows(self) -> Bool[Array, "n"]:
        """The nodes that follow others, shape (n,)."""
        return self.part.sum(axis=0) > 0

    def taking(self, usable: Bool[Array, "n"]) -> "SurfaceImage":
        """The map with parents among these alone; a node without any stays free."""
        part = jnp.where(usable[self.parents], self.part, 0)
        total = part.sum(axis=0)
        some = total > 1e-6
        return replace(self, part=jnp.where(some, part / jnp.where(some, total, 1), 0))

    def where(self, active: Bool[Array, "n"]) -> "SurfaceImage":
        """The map of nodes most of whose parents are held."""
        return replace(self, part=jnp.where(self.mean(active.astype(self.part.dtype)[:, None]) > 0.5, self.part.T, 0).T)

    def mean(self, field: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """Σ_k τ_ik f_k."""

        def followed(field: Float[Array, "n c"]) -> Float[Array, "n c"]:
            return (self.part[..., None] * field[self.parents]).sum(axis=0)

        return jax.lax.cond(self.part.any(), followed, jnp.zeros_like, field)  # sums cost most of a map

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
        if self.sticks:
            return jnp.where(self.follows[:, None], self.height[:, None] * self.mean(self.inverse * field), field)
        strain = (self.slope * field).sum(axis=1, keepdims=True)
        followed = self.mean(jnp.concatenate([field, strain], axis=1))
        along, strain = followed[:, :-1], followed[:, -1]
        across = self.height * strain - (self.normal * along).sum(axis=1)
        return jnp.where(self.follows[:, None], along + across[:, None] * self.normal, field)

    def fold_scalar(self, field: Array) -> Array:
        """Bᵀ for an even scalar field, shape (n,), or for several in columns."""
        return jax.linear_transpose(self.scalar, field)(field)[0]

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ for a vector field."""
        return jax.linear_transpose(self.vector, field)(field)[0]

    def fold_masses(self, masses: Float[Array, "n d d"]) -> Float[Array, "n d d"]:
        """The masses of parents, Σ τ_ik G_ikᵀ M_i G_ik with v_i = Σ τ_ik G_ik v_k: as much as BᵀMB or more, for any
        velocity."""
        d, n, height, slope = masses.shape[-1], self.normal, self.height[:, None], self.slope
        if self.sticks:
            parts = jnp.where(self.follows[:, None], height**2 * masses.reshape(-1, d * d), 0)
            taken = (self.inverse**2 * self.spread(parts)).reshape(masses.shape)
            return jnp.where(self.follows[:, None, None], 0, masses + taken)
        pushed = (masses * n[:, None]).sum(axis=2)  # M n
        across = (pushed * n).sum(axis=1, keepdims=True)
        bent = pushed - across * n  # (1 − n nᵀ) M n
        along = masses - n[:, :, None] * pushed[:, None] - bent[:, :, None] * n[:, None]
        parts = jnp.concatenate([along.reshape(-1, d * d), height * bent, height**2 * across], axis=1)
        taken = self.spread(jnp.where(self.follows[:, None], parts, 0))
        mixed = (taken[:, d * d : -1] + taken[:, -1:] * slope / 2)[:, None] * slope[:, :, None]
        taken = taken[:, : d * d].reshape(-1, d, d) + mixed + mixed.swapaxes(1, 2)
        return jnp.where(self.follows[:, None, None], 0, masses + taken)

    def reached(self, shape: tuple[int, ...]) -> Mask:
        """All components of velocity of what follows and is followed, a mask of this shape (n, d)."""
        follows = self.follows
        touched = follows | (self.spread(follows[:, None].astype(self.part.dtype))[:, 0] > 0)
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
    behind = (height < first) & (height > -(order + 3) / 2) & sloping & stencil.inside
    image = SurfaceImage(
        parents=jnp.clip(stencil.index, 0, grid.size - 1),
        part=jnp.where(behind, stencil.weight, 0),
        height=height,
        normal=normal,
        velocity=velocity,
        sticks=sticks,
    )
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
