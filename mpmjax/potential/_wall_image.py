"""Walls that lie anywhere across an axis: the map of the nodes about them, linear across the wall."""

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.discretisation import Grid, Stencil


class WallImage(eqx.Module):
    """The map of a wall that lies anywhere across an axis (see `wall_image`), in the columns of nodes that it holds.

    It touches the K *rows* of nodes from b to a spacing and a kernel behind the wall: a slice of the grid. Blocks are
    fields in the shape of the window (layers, ..., m, ..., c), with c values at each node; rows have K for m, a row and
    columns 1, and so have the masks of rows, which broadcast with them.
    """

    shape: tuple[int, ...] = eqx.field(static=True)  # the grid's shape, of each of its layers
    layers: int = eqx.field(static=True)  # layers of nodes, one a body
    axis: int = eqx.field(static=True)  # the wall's normal
    start: Int[Array, ""]  # the first row's number along the axis
    base: Bool[Array, "..."]  # the row b
    follows: Bool[Array, "..."]  # the rows behind b, which have its normal velocity times B
    share: Float[Array, "..."]  # B of b, which is 1, and of the rows behind it; zero at others
    tied: Bool[Array, "..."]  # the rows that have the tangential velocity of b
    first: Bool[Array, "..."]  # the first row from behind that has a tangential velocity of its own
    held: Bool[Array, "..."] | None = None  # the columns where the wall holds; None for all of them
    sticks: bool = eqx.field(static=True, default=False)  # whether the rows behind b have its whole velocity times B
    velocity: NodeVector | None = None
    """Velocity V of a wall that moves, at the nodes [m/s], shape (n, d); None at rest. Where rows follow b by B they
    have B v_b + (1 − B) V."""

    def blocks(self, field: Array) -> Array:
        """A field of shape (n,) or (n, c), or blocks, as blocks."""
        return field if field.ndim > 2 else field.reshape(self.layers, *self.shape, -1)

    def rows(self, field: Array) -> Array:
        """The rows of a field."""
        blocks, count = self.blocks(field), self.share.shape[self.axis + 1]
        return jax.lax.dynamic_slice_in_dim(blocks, self.start, count, self.axis + 1, allow_negative_indices=False)

    def row(self, rows: Array) -> Array:
        """The row b of some rows, as columns."""
        return self.column(jnp.where(self.base, rows, 0))

    def with_rows(self, field: Array, rows: Array) -> Array:
        """A field with other rows. XLA writes them over the field, in the loop that computes them: they may depend on
        the row's own values, and on sums over rows (`column`)."""
        blocks, axis = self.blocks(field), self.axis + 1
        laid = jax.lax.dynamic_update_slice_in_dim(blocks, rows, self.start, axis, allow_negative_indices=False)
        return laid.reshape(field.shape)

    def column(self, rows: Array) -> Array:
        """The sum over the rows of each column, as columns. XLA computes it before what reads it."""
        return rows.sum(axis=self.axis + 1, keepdims=True)

    def columns_around(self, weights: NodeScalar) -> Bool[Array, "..."]:
        """The columns where some weights of nodes, shape (n,), have a sum in the rows."""
        return self.column(self.rows(weights)) > 0

    def reached(self, shape: tuple[int, ...]) -> Mask:
        """All components of velocity of b and of what follows it, a mask of this shape (n, d)."""
        mask = (self.base | self.follows) & (True if self.held is None else self.held)
        nodes = jnp.zeros((self.layers, *self.shape, 1), bool)
        return jnp.broadcast_to(self.with_rows(nodes, self.rows(nodes) | mask).reshape(-1, 1), shape)

    def carried(self, dim: int) -> Mask:
        """The components that follow b by B, shape (n, d). Of a wall that moves a field has there what its motion
        adds."""
        follows, rows = self._moved(dim), self.rows(jnp.zeros((self.layers, *self.shape, dim), bool))
        return self.with_rows(jnp.zeros((self.layers, *self.shape, dim), bool), rows | follows).reshape(-1, dim)

    def with_motion(self, field: NodeVector) -> NodeVector:
        """A velocity [m/s] with (1 − B) V in these components."""
        assert self.velocity is not None
        added = (1 - self.share) * self.rows(self.velocity)
        return self.with_rows(field, jnp.where(self._moved(field.shape[1]), added, self.rows(field)))

    def _moved(self, dim: int) -> Array:
        follows = self.follows if self.held is None else self.follows & self.held
        return follows & ((jnp.arange(dim) == self.axis) | self.sticks)

    def scalar(self, field: Array) -> Array:
        """B for an even scalar field."""
        return self._copied(field, self.tied, 1)

    def fold_scalar(self, field: Array) -> Array:
        """Bᵀ for an even scalar field."""
        return self._gathered(field, self.tied, 1)

    def united(self, blocks: Array, *, whole: bool = False) -> Array:
        """Even scalars, summed over the nodes that are tied to each other, at each of them (as B Bᵀ does), or over the
        `whole` of what follows b."""
        rows, alike = self.rows(blocks), self.base | (self.follows if whole else self.tied)
        return self.with_rows(blocks, jnp.where(alike, self.column(jnp.where(alike, rows, 0)), rows))

    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field."""
        return self._copied(field, *self._components(jnp.arange(field.shape[1]) == self.axis, self.share))

    def moved(self, unfolded: NodeVector, field: NodeVector) -> NodeVector:
        """A field that `vector` has unfolded, with what the wall's motion adds to it as the `field` before has it."""
        if self.velocity is None:
            return unfolded
        added = jnp.where(self._moved(field.shape[1]), self.rows(field), 0)
        return self.with_rows(unfolded, self.rows(unfolded) + added)

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ for a vector field."""
        return self._gathered(field, *self._components(jnp.arange(field.shape[1]) == self.axis, self.share))

    def fold_masses(self, masses: Float[Array, "n c"]) -> Float[Array, "n c"]:
        """The masses that b has along each direction by a unit of its velocity [kg], then its mass as a scalar, and
        none on what follows: Σ B² m across the wall, shape (n, d + 1)."""
        return self._gathered(masses, *self._components(jnp.arange(masses.shape[1]) == self.axis, self.share**2))

    def _components(self, normal: Bool[Array, "c"], share: Array) -> tuple[Array, Array]:
        """Which rows follow b in each component, and by which factor."""
        normal = normal | self.sticks
        return jnp.where(normal, self.follows, self.tied), jnp.where(normal, share, 1)

    def _copied(self, field: Array, follows: Array, factor: Array | int) -> Array:
        follows, rows = follows if self.held is None else follows & self.held, self.rows(field)
        return self.with_rows(field, jnp.where(follows, factor * self.row(rows), rows))

    def _gathered(self, field: Array, follows: Array, factor: Array | int) -> Array:
        follows, rows = follows if self.held is None else follows & self.held, self.rows(field)
        total = self.column(jnp.where(follows, factor * rows, 0))
        return self.with_rows(field, jnp.where(follows, 0, rows + jnp.where(self.base, total, 0)))


def wall_image(
    axis: int,
    position: Scalar,
    inward: Array | int,
    grid: Grid,
    window: Int[Array, "d"],
    order: int,
    filled: tuple[Stencil, Float[Array, "p"]] | None = None,
    *,
    sticks: bool = False,
    velocity: NodeVector | None = None,
) -> WallImage:
    """The map of a wall at any coordinate [m] along an axis, for a kernel of this order; `inward` is the component of
    its inward normal, +1 or −1.

    With ξ the distance of a node before the wall, b is the nearest one before it that no kernel at the wall passes:
    ξ_b ≥ ½ for quadratic kernels. Nodes behind b have its normal velocity times B = ξ/ξ_b, so that it is zero on the
    wall, and fields that are linear across it are in the map: forces of a uniform pressure, which have neither sum nor
    first moment about the wall, vanish. Nodes more than a quarter of a spacing behind the wall have the tangential
    velocity of b; behind a wall that `sticks` all have B times that too. With the wall on a node this is the mirror,
    and half-way between nodes too but for cubic kernels.

    Sums over particles are no integrals: by `filled`, the stencil of particles and the volumes that press [m^d], shape
    (p,), a wall that is at no multiple of half a spacing is moved by up to 0.02 spacings to where a uniform pressure
    has no moment.
    """
    near, length = 1e-3, grid.shape[axis]  # what is as near to ½ or −¼ counts as there
    count = min(order + 3, length)  # from b to the nodes of what is a spacing behind the wall
    place = jnp.asarray(position) / grid.spacing  # then from the window's first node, of a wall that is none far off
    place = jnp.clip(place - window[axis].astype(place.dtype), -length, 2 * length)
    sign = jnp.asarray(inward, place.dtype)
    base = inward * (jnp.floor(sign * place + max(order - 1, 1) / 2 - near).astype(jnp.int32) + 1)
    start = jnp.clip(jnp.where(inward > 0, base - count + 1, base), 0, length - count)
    j = start + jnp.arange(count, dtype=jnp.int32)
    before, of_base = (sign * (row.astype(place.dtype) - place) for row in (j, base))
    follows, stays = inward * (j - base) < 0, before > -0.25 - near
    if filled is not None:
        along, volume = filled[0].along(axis), filled[1]

        def middle() -> Array:
            force = moment = jnp.zeros_like(volume)
            first = along.basis.base(along.xi)[0].astype(jnp.int32)
            for n, slope in enumerate(along.weight_derivatives[0]):
                node = first + n
                part = jnp.where(inward * (node - base) <= 0, slope, 0)
                force, moment = force + part, moment + part * sign * (node.astype(place.dtype) - place)
            total, turn = jnp.stack([force, moment]) @ volume  # a product, of which XLA makes vectors
            return jnp.clip(jnp.where(total == 0, 0, turn / jnp.where(total == 0, 1, total)), -0.02, 0.02)

        aside = jnp.abs(2 * place - jnp.round(2 * place)) > 2 * near
        shift = jax.lax.cond(aside, middle, lambda: jnp.zeros((), volume.dtype))
        before, of_base = before - shift, of_base - shift
    by_row = [count if k == axis + 1 else 1 for k in range(grid.dim + 2)]
    return WallImage(
        shape=grid.shape,
        layers=grid.layers,
        axis=axis,
        start=start,
        base=(j == base).reshape(by_row),
        follows=follows.reshape(by_row),
        share=jnp.where(j == base, 1, jnp.where(follows, before / of_base, 0)).reshape(by_row),
        tied=(follows & ~stays).reshape(by_row),
        first=(stays & (before - 1 <= -0.25 - near)).reshape(by_row),
        sticks=sticks,
        velocity=velocity,
    )
