"""Walls that hold columns of nodes across an axis while these press: those of contact planes, and of boxes around what
flows."""

from collections.abc import Callable
from dataclasses import replace
from itertools import chain
from typing import Any

import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes, friction_change
from mpmjax.boundary._surface_contact import Faces
from mpmjax.discretisation import Grid
from mpmjax.potential import Image, SurfaceImage, WallImage, wall_image

SHUT = 1e-2  # the gap up to which a plane holds what is before it, in spacings


FlatWall = tuple[int, Scalar, Array | int]
"""The axis across which a wall lies, its coordinate [m], infinite for none, and its inward normal's component, ±1."""


class PlaneContact(AbstractContact):
    """A wall at right angles to an axis in the window, or two that face each other. Each column of nodes along the
    normal is a place at each: of shape (layers, ..., 1, ..., s), the shape of the window with 1 for the axis.

    Holding a column means that its nodes move by the wall's map (see `wall_image`), with normal velocities B_i v_b. The
    normal impulse is r = Σ (1 − B_i) R_i, with R the impulses that are missing at the nodes: what they leave on b is
    Σ B_i R_i = 0. The gap velocity is what r works on, −r of an explicit step that holds the column:

        Σ m_i (1 − B_i S/M) (v_i − B_i v_b),   S = Σ B m,   M = Σ B² m,

    so that the two conditions exclude each other; of a wall that moves, v_i is without (1 − B_i) V_i. Columns that no
    particle reaches whose face is at the wall are not held. Those that are each other's image in another plane are held
    together.
    Friction acts on the first node of a column that has a tangential velocity of its own.
    """

    walls: tuple[WallImage, ...]  # the walls' maps
    inward: tuple[Array | int, ...]  # the component of each inward normal: +1 or −1
    coefficient: Scalar | None  # Coulomb coefficient [-]; None without friction
    shut: Bool[Array, "..."]  # the columns that may be held

    @property
    def axis(self) -> int:
        """Direction of the normals."""
        return self.walls[0].axis

    def known_at_start(self, nodes: Any) -> bool:
        """Where nothing across another axis and no other boundary moves the nodes of a column."""
        alone = all(wall.axis == self.axis for wall in walls_of(nodes)) and not nodes.potential.mirror.images
        return alone and not nodes.conditions.holds

    def images(self, active: Array) -> tuple[WallImage, ...]:
        return tuple(replace(wall, held=active[..., k : k + 1]) for k, wall in enumerate(self.walls))

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> Array:
        """The momentum with which each column leaves its wall [kg m/s]: its weights times what its velocity lacks of
        the map's."""
        mass, along = held.unconstrained.mass, v[:, self.axis]
        each = []
        for inward, wall in zip(self.inward, self.walls, strict=True):
            rows = wall.rows(along)
            if wall.velocity is not None:
                rows = rows - (1 - wall.share) * wall.rows(wall.velocity[:, self.axis])
            each.append(inward * wall.column(column_weight(wall, mass) * (rows - wall.share * wall.row(rows))))
        return self._tied(held, jnp.where(self.shut, jnp.concatenate(each, axis=-1), 0))

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> Array:
        """The normal impulse of each column [kg m/s]."""
        impulse = held.without_collider_impulses(residual)[:, self.axis]
        each = [
            inward * wall.column(jnp.where(wall.follows, (1 - wall.share) * wall.rows(impulse), 0))
            for inward, wall in zip(self.inward, self.walls, strict=True)
        ]
        return self._tied(held, jnp.concatenate(each, axis=-1))

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a column's momentum [kg m/s], for both."""
        mass = held.unconstrained.mass
        weights = [wall.column(column_weight(wall, mass)) for wall in self.walls]
        least = noise * self._tied(held, jnp.concatenate(weights, axis=-1))
        return least, least

    def friction(
        self, held: ConstrainedNodes, active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector] | None:
        if self.coefficient is None:
            return None
        limits = self.coefficient * jnp.where(active, jnp.maximum(self.normal_impulse(held, residual), 0), 0)
        limit = jnp.zeros(len(residual), limits.dtype)
        for wall, part in zip(self.walls, jnp.split(limits, len(self.walls), axis=-1), strict=True):
            limit = wall.with_rows(limit, jnp.where(wall.first, part, wall.rows(limit)))
        normal = (jnp.arange(residual.shape[1]) == self.axis).astype(limit.dtype)
        velocity = self.walls[0].velocity  # of a box both rest
        moving = jnp.zeros((), limit.dtype) if velocity is None else velocity
        return friction_change(held.nodes.projection, held.nodes.mass, normal, moving, limit)

    def fixed(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The normal component of nodes that follow in it alone, as on the wall."""
        across = jnp.zeros(shape[0], bool)
        for k, wall in enumerate(self.walls):
            held = wall.follows & ~wall.tied & active[..., k : k + 1]
            across = wall.with_rows(across, wall.rows(across) | held)
        return across[:, None] & (jnp.arange(shape[1]) == self.axis)

    def _tied(self, held: ConstrainedNodes, columns: Array) -> Array:
        """A quantity of the columns, summed over columns that are each other's image in other planes."""
        nodes = held.unconstrained
        for image in (*walls_of(nodes), *nodes.potential.mirror.images):
            if isinstance(image, Image | WallImage) and image.axis != self.axis:
                columns = image.united(columns)
        return columns


def walls_of(nodes: Any) -> list[WallImage]:
    """The walls across axes, of contacts and those that are never left."""
    planes = (contact for contact in nodes.contacts if isinstance(contact, PlaneContact))
    each = chain.from_iterable((*nodes.walls, *(plane.walls for plane in planes)))
    return [wall for wall in each if isinstance(wall, WallImage)]


def with_tied_columns(nodes: Any) -> Any:
    """The nodes whose walls that are never left hold the columns too that other walls tie to theirs: else what these
    move would be left behind."""

    def tied(wall: WallImage | SurfaceImage) -> WallImage | SurfaceImage:
        if not isinstance(wall, WallImage) or wall.held is None:
            return wall
        columns = wall.held.astype(nodes.mass.dtype)
        for other in walls_of(nodes):
            columns = columns if other.axis == wall.axis else other.united(columns, whole=True)
        return replace(wall, held=columns > 0)

    return replace(nodes, walls=tuple(tuple(map(tied, walls)) for walls in nodes.walls))


def wall_images(
    planes: tuple[FlatWall, ...], faces: Faces, grid: Grid, window: Int[Array, "d"], **of_all: Any
) -> tuple[WallImage, ...]:
    """The maps of planes for what flows (see `wall_image`)."""
    order, filled = len(faces.stencil.basis.knots) - 1, (faces.stencil, faces.flowing_volume)
    return tuple(wall_image(*plane, grid, window, order, filled, **of_all) for plane in planes)


def column_weight(wall: WallImage, mass: NodeScalar) -> Array:
    """m_i (1 − B_i S/M) [kg] of the nodes that follow b, zero at others, as rows of the wall."""
    rows = wall.rows(mass)
    first = rows * wall.share
    total, square = wall.column(first), wall.column(first * wall.share)
    return jnp.where(wall.follows, rows - first * total / jnp.where(square == 0, 1, square), 0)


def plane_contact(
    walls: tuple[WallImage, ...], inward: tuple[Array | int, ...], friction: Scalar | None, around: Float[Array, "n s"]
) -> PlaneContact:
    """The contact of walls across an axis with the columns around particles whose gap is shut, where the weights of
    those have a sum, shape (n, s)."""
    shut = [wall.columns_around(around[:, k]) for k, wall in enumerate(walls)]
    return PlaneContact(walls, inward, friction, jnp.concatenate(shut, axis=-1))
