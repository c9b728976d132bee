"""Regions of space, for `fill`, grips and colliders.

A region is its signed distance: Euclidean, negative inside, with a gradient of length one. Where several points of the
surface are nearest (the centre of a ball, the diagonal of a box) the gradient is the direction of one of them or their
mean. It is never NaN or zero, so that a collider acts on what is at its middle too.
"""

import abc
from typing import Annotated, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Corner, Float, Point, Scalar
from mpmjax.checks import coordinates, finite, require, require_fields, require_that

Cells = tuple[np.ndarray, np.ndarray]
"""Centroids [m], shape (m, d), and volumes [m^d], shape (m,), of cells fitted to a body."""


class AbstractRegion(eqx.Module):
    """A closed set of points."""

    flat: ClassVar[bool] = False  # whether its normal is the same everywhere
    fills_bounds: ClassVar[bool] = False  # whether every point of its bounding box lies in it

    @property
    @abc.abstractmethod
    def dim(self) -> int:
        """Space dimension d."""

    @abc.abstractmethod
    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """Signed distance of points x [m], shape (m, d), from the surface [m], shape (m,); negative inside."""

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box [m], each (d,). Default: all of space."""
        return np.full(self.dim, -np.inf), np.full(self.dim, np.inf)

    @abc.abstractmethod
    def middle(self) -> Float[Array, "d"]:
        """The centre, or another point that moves with the region [m], shape (d,)."""

    def contains(self, x: Float[Array, "m d"], margin: Scalar = 0.0) -> Bool[Array, "m"]:
        """Whether points x [m], shape (m, d), lie in the region or within `margin` [m] of it, shape (m,)."""
        return self.distance(x) <= margin

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        """The signed distances of points x [m], shape (m, d), from the smooth surfaces that bound it and meet in edges,
        shape (m, k). Default: its own alone."""
        return self.distance(x)[:, None]

    def joined(self, behind: Float[Array, "m k"]) -> Float[Array, "m"]:
        """How much of a small neighbourhood of points lies in the region, shape (m,), by the shares of it that lie
        behind each of its `sides`, shape (m, k); of a point alone shares are 0 or 1. Default: sides at right angles."""
        return behind.prod(axis=1)

    def fitted(self, size: np.ndarray) -> Cells | None:
        """Centroids [m], (m, d), and volumes [m^d], (m,), of cells that fill the region to its surface, near `size` in
        their sides [m], (d,). Default: those of its bounding box where that is the region, else None."""
        return box_cells(*self.bounds(), size) if self.fills_bounds else None


def length(a: Float[Array, "*m d"]) -> Float[Array, "*m"]:
    """The length of each vector, the last axis; its derivative at zero is zero."""
    square = (a**2).sum(axis=-1)
    zero = square == 0
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))


def from_axis(a: Float[Array, "m d"]) -> Float[Array, "m"]:
    """The length of each vector, the last axis; its derivative at zero is along a fixed direction."""
    some = jnp.asarray([0.8, 0.5, 0.3][: a.shape[-1]], a.dtype)
    return jnp.where((a == 0).all(axis=-1), (a * some).sum(axis=-1), length(a))


def common(slabs: Float[Array, "m j"]) -> Float[Array, "m"]:
    """Signed distance from the intersection of sets at right angles to each other, from those of the sets."""
    nearest = slabs.max(axis=-1)
    return jnp.where(nearest > 0, length(jnp.maximum(slabs, 0)), nearest)


def box_cells(lower: np.ndarray, upper: np.ndarray, size: np.ndarray) -> Cells:
    """Equal cells of a box, near `size` [m] in each direction."""
    number = np.maximum(np.rint((upper - lower) / size), 1).astype(int)
    cell = (upper - lower) / number
    axes = [low + (np.arange(n) + 0.5) * c for low, n, c in zip(lower, number, cell, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lower))
    return centres, np.full(len(centres), np.prod(cell))


class Box(AbstractRegion):
    """The axis-aligned box between two corners.

    Args:
        lower: smallest coordinate in each direction [m], (d,). It may be −inf, for a grip without a bound.
        upper: largest coordinate in each direction [m], (d,), above `lower`.
    """

    fills_bounds: ClassVar[bool] = True
    lower: Corner
    upper: Corner

    def __check_init__(self):
        require_fields(self)
        require(
            coordinates("A box's lower corner", self.lower) == coordinates("A box's upper corner", self.upper),
            f"A box needs two corners with as many coordinates, got {self.lower} and {self.upper}.",
        )
        below = "A box's lower corner must lie below its upper one in each direction"
        require_that(below, lambda a, b: a < b, self.lower, self.upper)

    @property
    def dim(self) -> int:
        return len(self.lower)

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """max(q) inside, ‖max(q, 0)‖ outside, q = max(lower − x, x − upper)."""
        below, above = jnp.split(self.sides(x), 2, axis=1)
        return common(jnp.where(below > above, below, above))

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        return jnp.concatenate([jnp.asarray(self.lower, x.dtype) - x, x - jnp.asarray(self.upper, x.dtype)], axis=1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.lower, float), np.asarray(self.upper, float)

    def middle(self) -> Float[Array, "d"]:
        """The middle of the corners; in a direction with one corner at infinity the other one, with both zero."""
        corners = jnp.stack([jnp.asarray(self.lower), jnp.asarray(self.upper)])
        finite = jnp.isfinite(corners)
        return jnp.where(finite, corners, 0).sum(axis=0) / jnp.maximum(finite.sum(axis=0), 1).astype(corners.dtype)


class HalfSpace(AbstractRegion):
    """The half-space behind a plane (a line in 2-D, a point in 1-D).

    Args:
        point: a point of the plane [m], (d,).
        normal: the direction out of the region, (d,), of any length.
    """

    point: Annotated[Point, finite, "m"]
    normal: Annotated[Point, finite]
    flat: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        require(
            coordinates("A half-space's point", self.point) == coordinates("A half-space's normal", self.normal),
            f"A half-space needs a point and a normal with as many coordinates, got {self.point} and {self.normal}.",
        )
        require_that("A half-space's normal must not be zero", lambda a: (a != 0).any(), self.normal)

    @property
    def dim(self) -> int:
        return len(self.point)

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """(x − point)·normal/‖normal‖."""
        normal = jnp.asarray(self.normal, x.dtype)
        return ((x - jnp.asarray(self.point, x.dtype)) * (normal / length(normal))).sum(axis=-1)

    def middle(self) -> Float[Array, "d"]:
        return jnp.asarray(self.point)
