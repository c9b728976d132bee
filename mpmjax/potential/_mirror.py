"""Planes whose far side is a mirror image: mass and tangential velocity even, normal velocity odd.

Nodes beyond such a plane are signed copies of those before it. With B the map from true nodes to all nodes, masses,
momenta and forces are folded with Bᵀ and velocities unfolded with B, so that every system keeps its symmetry: the
implicit one is Bᵀ(M + βΔt²H)B. The transfers know nothing of it. At a `SymmetryPlane` B is always that of the plane; at
a wall that may be left only in the *columns* (lines of nodes along the normal) that it holds. What ties the nodes of a
body together is such a map too.
"""

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import require
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractMotion
from mpmjax.potential._surface_image import SurfaceImage, one_mass
from mpmjax.potential._wall_image import WallImage


class MirrorPlace(NamedTuple):
    """The place of a boundary's mirror."""

    axis: int  # the direction of its normal
    position: Scalar  # coordinate on the lattice of nodes [m]
    motion: AbstractMotion | None  # how it moves; None if it rests


@custom_derivative
def carried_by(*places: Array) -> Float[Array, ""]:
    """How far the grid is carried along an axis by the mirrors across it, at these coordinates [m]: zero, with the
    derivative by the place of a mirror. A mirror lies on the lattice of nodes, so where it is elsewhere the lattice is
    too."""
    return jnp.zeros_like(jnp.asarray(places[0]))


@carried_by.defjvp
def _(places: tuple[Array, ...], changes: tuple[Any, ...]) -> tuple[Array, Any]:
    moved = [change for change in changes if change is not None]
    require(
        len(places) == 1 or not moved,
        f"There are {len(places)} mirrored planes across one axis, and the grid cannot go with one of them: no "
        "derivative by their places. Take SeparatingBox, or jax.lax.stop_gradient(position) of all of them.",
    )
    return carried_by(*places), moved[0] if moved else None


class AbstractImage(eqx.Module):
    """A linear map B of fields from true nodes to all nodes, or of one set of nodes to another."""

    @abc.abstractmethod
    def scalar(self, field: NodeScalar) -> NodeScalar:
        """B for an even scalar field, such as mass."""

    @abc.abstractmethod
    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field."""

    def fold_scalar(self, field: Array) -> Array:
        """Bᵀ for an even scalar field, shape (n,), or for several in columns, shape (n, c)."""
        return transposed(self.scalar if field.ndim == 1 else jax.vmap(self.scalar, 1, 1), field)

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ for a vector field."""
        return transposed(self.vector, field)


class Image(AbstractImage):
    """Signed copies of true nodes at their mirror images, along one axis of the window."""

    shape: tuple[int, ...] = eqx.field(static=True)  # the grid's shape, of each of its layers
    layers: int = eqx.field(static=True)  # layers of nodes, one a body
    axis: int = eqx.field(static=True)  # the plane's normal
    source: Int[Array, "m"]  # the node of which each node along the axis is a copy, shape (m,)
    even: Int[Array, "m"]  # the sign of copies of even fields, 0 where the source is outside of the window, shape (m,)
    odd: Int[Array, "m"]  # the sign of copies of odd fields, 0 on the plane too, shape (m,)
    velocity: Array | None = None
    """Velocity V of a mirror that moves along its normal [m/s], or at the nodes of one that holds all components, shape
    (n, d); None at rest. An odd component of a node beyond it is 2V minus that of its image, and V on it."""
    holds_all: bool = eqx.field(static=True, default=False)
    """Whether all components of a vector are odd; else the normal one."""

    @property
    def size(self) -> int:
        """n, the number of nodes."""
        return self.layers * math.prod(self.shape)

    def scalar(self, field: NodeScalar) -> NodeScalar:
        return self._even(field.reshape(self.layers, *self.shape, 1)).reshape(field.shape)

    def united(self, blocks: Array) -> Array:
        """Even scalars, summed over the nodes that are each other's image, at each of them: B Bᵀ on blocks (see
        `WallImage`)."""
        return self._even(transposed(self._even, blocks))

    def _even(self, blocks: Array) -> Array:
        return self._copy(blocks, self.even[:, None])

    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field: tangential components even, the normal one odd, or all of them. Of a mirror that moves
        B v + ℓ, where ℓ has the odd components that the field has on the mirror and beyond."""
        odd = (jnp.arange(field.shape[1]) == self.axis) | self.holds_all
        signs = jnp.where(odd, self.odd[:, None], self.even[:, None])
        copied = self._copy(field.reshape(self.layers, *self.shape, -1), signs).reshape(field.shape)
        if self.velocity is None:
            return copied
        return copied + jnp.where(self.carried(field.shape[1]), field, 0)

    def fold(self, field: NodeVector) -> NodeVector:
        at_rest = replace(self, velocity=None)  # what it adds is no part of the linear map
        return transposed(at_rest.vector, field)

    def carried(self, dim: int) -> Mask:
        """The components that have what the mirror's motion adds, on it and beyond, shape (n, d)."""
        return self.held(self.odd <= 0, dim)

    def with_motion(self, field: NodeVector) -> NodeVector:
        """A velocity [m/s] with 2V in its odd components beyond the mirror."""
        assert self.velocity is not None
        return jnp.where(self.held((self.odd < 0) | (self.even == 0), field.shape[1]), 2 * self.velocity, field)

    def held(self, along: Bool[Array, "m"], dim: int) -> Mask:
        """The odd components of some nodes along the axis, as a mask of shape (n, d)."""
        return self.along(along)[:, None] & ((jnp.arange(dim) == self.axis) | self.holds_all)

    def along(self, values: Array) -> Array:
        """Values along the axis, shape (m,), at all nodes, shape (n,)."""
        by_axis = [1] * len(self.shape)
        by_axis[self.axis] = -1
        return jnp.broadcast_to(values.reshape(by_axis), (self.layers, *self.shape)).reshape(-1)

    def _copy(self, blocks: Array, sign: Array) -> Array:
        """Copy along the axis; `sign` has one row a node of the axis and one column a component."""
        by_axis = [1] * blocks.ndim
        by_axis[self.axis + 1], by_axis[-1] = sign.shape
        copied = jnp.take(blocks, self.source, axis=self.axis + 1, mode="clip")
        return copied * sign.reshape(by_axis).astype(blocks.dtype)


class Scaling(AbstractImage):
    """A factor of each component of velocity, or a matrix, by which nodes that walls tie to others have one mass for
    all of them."""

    factor: Float[Array, "n d *d"]  # shape (n, d), or (n, d, d) [-]
    inverse: Float[Array, "n d *d"]  # its inverse, in the same shape [-]

    def scalar(self, field: NodeScalar) -> NodeScalar:
        return field

    def vector(self, field: NodeVector) -> NodeVector:
        return self.factor * field if self.factor.ndim == 2 else (self.factor * field[:, None]).sum(axis=2)


def with_one_mass(
    walls: Sequence[WallImage | SurfaceImage], mass: NodeScalar, fixed: Mask
) -> tuple["Mirror", tuple[int, ...], NodeScalar]:
    """The maps of walls, one or more, that hold nodes of these masses [kg], shape (n,), with a scaling before them; the
    numbers of the walls in the maps' order; and the masses folded by them. A node b before a wall across an axis has
    the mass Σ m along it, and across it Σ B² m by a unit of its velocity; it is scaled so that both are one. Surfaces
    come first, and follow no nodes that later maps fill in."""
    planes = [(k, wall) for k, wall in enumerate(walls) if isinstance(wall, WallImage)]
    surfaces = [(k, wall) for k, wall in enumerate(walls) if isinstance(wall, SurfaceImage)]
    numbers, dim, usable = tuple(k for k, _ in (*surfaces, *planes)), fixed.shape[1], mass > 0
    masses = jnp.broadcast_to(mass[:, None], (len(mass), dim + 1))
    for _, wall in reversed(planes):
        masses, usable = wall.fold_masses(masses), usable & ~wall.carried(dim).any(axis=1)
    images, across, mass = tuple(wall for _, wall in planes), masses[:, :dim], masses[:, dim]
    if not surfaces:
        both = (across > 0) & (masses[:, dim:] > 0)
        factor = jnp.sqrt(jnp.where(both, masses[:, dim:], 1) / jnp.where(both, across, 1))
        return Mirror((Scaling(factor, 1 / factor), *images)), numbers, mass
    across = across[:, :, None] * jnp.eye(dim, dtype=mass.dtype)
    for _, surface in reversed(surfaces):
        image = surface.taking(usable)
        (across, mass), usable, images = image.fold_masses(across, mass), usable & ~image.follows, (image, *images)
    return Mirror((Scaling(*one_mass(across, mass, fixed)), *images)), numbers, mass


def transposed(linear: Callable[[Array], Array], field: Array) -> Array:
    """The transpose of a linear map of a field to one alike."""
    return jax.linear_transpose(linear, field)(field)[0]


class Tie(AbstractImage):
    """One velocity for several nodes, that of the first: the map B of a rigid part."""

    tied: Bool[Array, "n"]  # the nodes tied together

    def scalar(self, field: NodeScalar) -> NodeScalar:
        return jnp.where(self.tied, field[jnp.argmax(self.tied)], field)

    def vector(self, field: NodeVector) -> NodeVector:
        return jnp.where(self.tied[:, None], field[jnp.argmax(self.tied)], field)


class Mirror(eqx.Module):
    """The mirrors of several planes: `unfold` applies B, from true nodes to all nodes; `fold` applies Bᵀ."""

    images: tuple[AbstractImage | WallImage | SurfaceImage, ...]  # the images at each plane, in their order

    def unfold(self, field: NodeVector) -> NodeVector:
        """B v: fill in the mirror images."""
        unfolded = field
        for image in self.images:
            unfolded = image.vector(unfolded)
            unfolded = image.moved(unfolded, field) if isinstance(image, WallImage | SurfaceImage) else unfolded
        return unfolded

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ f: add to the true nodes what their mirror images received, and leave nothing on the others."""
        return reduce(lambda field, image: image.fold(field), reversed(self.images), field)

    def unscaled(self, field: NodeVector) -> NodeVector:
        """A velocity of true nodes, as that of which `unfold` makes it by its scaling."""
        for image in self.images:
            field = replace(image, factor=image.inverse).vector(field) if isinstance(image, Scaling) else field
        return field

    @property
    def moving(self) -> tuple[Image | WallImage | SurfaceImage, ...]:
        """The mirrors and walls that move."""
        planes = (image for image in self.images if isinstance(image, Image | WallImage | SurfaceImage))
        return tuple(image for image in planes if image.velocity is not None)

    def added(self, field: NodeVector) -> NodeVector:
        """The part of a velocity that mirrors which move add to it, on them and beyond; zero elsewhere."""
        total = jnp.zeros_like(field)
        for image in self.moving:
            total = jnp.where(image.carried(field.shape[1]), field, total)
        return total

    def with_leaders(self, field: NodeVector, v: NodeVector) -> NodeVector:
        """A velocity [m/s] of true nodes, with v as if it moved along at those that others follow at a surface that
        moves: lumped masses are BᵀMB only of what does, so that velocities are folded relative to it."""
        walls = [image for image in self.images if isinstance(image, WallImage | SurfaceImage)]
        true = ~reduce(jnp.logical_or, (image.carried(field.shape[1]) for image in walls), jnp.zeros(field.shape, bool))
        for image in self.moving:
            if isinstance(image, SurfaceImage) and image.velocity is not None:
                leads = true & image.reached(field.shape)
                field = jnp.where(leads, self.unscaled(jnp.where(leads, image.following(v), 0)), field)
        return field

    def with_motion(self, velocity: NodeVector) -> NodeVector:
        """A velocity [m/s], shape (n, d), with 2V in its odd components beyond mirrors that move, and (1 − B) V behind
        walls that do. Where several mirrors reach, the first one holds, of walls the last."""
        images = self.moving
        walls = [image for image in images if isinstance(image, WallImage | SurfaceImage)]
        for image in (*reversed([image for image in images if isinstance(image, Image)]), *walls):
            velocity = image.with_motion(velocity)
        return velocity

    def unfold_scalar(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """B for an even scalar, such as mass."""
        return reduce(lambda field, image: image.scalar(field), self.images, field)

    def fold_scalar(self, field: Array) -> Array:
        """Bᵀ for an even scalar, shape (n,), or for several in columns, shape (n, c)."""
        return reduce(lambda field, image: image.fold_scalar(field), reversed(self.images), field)

    def continued(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """A folded even scalar as it is where bodies go on beyond the planes: on a plane twice what is folded there."""
        for image in self.images:
            if isinstance(image, Image):
                on_it = image.along((image.odd == 0) & (image.even == 1))
                field = image.scalar(jnp.where(on_it, 2 * field, field))
        return field

    def of_places(self) -> "Mirror":
        """The mirrors of vectors that say where bodies are: only the normal component is odd, at a plane that holds all
        of the velocity too."""
        return Mirror(tuple(replace(i, holds_all=False) if isinstance(i, Image) else i for i in self.images))

    def without_ties(self) -> "Mirror":
        """The mirrors alone, without what ties nodes of one body together."""
        return Mirror(tuple(image for image in self.images if isinstance(image, Image)))


def mirror_image(axis: int, position: Scalar, keep: str, grid: Grid, window: Int[Array, "d"]) -> Image:
    """The map of a mirror from true nodes to all nodes of the window. True nodes are "above" or "below" the mirror,
    whose coordinate [m] is a multiple of half a spacing."""
    length = grid.shape[axis]
    j = jnp.arange(length, dtype=jnp.int32)
    halves = jnp.round(2 * jnp.asarray(position) / grid.spacing).astype(jnp.int32) - 2 * window[axis]
    before = 2 * j - halves if keep == "above" else halves - 2 * j
    ghost = before < 0
    source = jnp.where(ghost, halves - j, j)
    inside = (source >= 0) & (source < length)
    even = jnp.where(inside, 1, 0)
    odd = jnp.where(inside & (before != 0), jnp.where(ghost, -1, 1), 0)
    return Image(grid.shape, grid.layers, axis, jnp.clip(source, 0, length - 1), even, odd)
