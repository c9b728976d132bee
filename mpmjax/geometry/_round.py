"""Round regions: balls, rings, capsules, cylinders and tubes."""

import itertools
from typing import Annotated

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import coordinates, finite, positive, require, require_fields, require_that
from mpmjax.geometry._region import AbstractRegion, Cells, box_cells, common, from_axis, length


class Ball(AbstractRegion):
    """A ball (a disk in 2-D, an interval in 1-D).

    Args:
        centre: centre [m], (d,).
        radius: radius [m].
    """

    centre: Annotated[Point, finite, "m"]
    radius: Annotated[Scalar, positive, "m"]

    def __check_init__(self):
        require_fields(self)
        coordinates("A ball's centre", self.centre)

    @property
    def dim(self) -> int:
        return len(self.centre)

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """‖x − centre‖ − radius."""
        return from_axis(x - jnp.asarray(self.centre, x.dtype)) - self.radius

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        centre, radius = np.asarray(self.centre, float), float(self.radius)
        return centre - radius, centre + radius

    def middle(self) -> Float[Array, "d"]:
        return jnp.asarray(self.centre)

    def fitted(self, size: np.ndarray) -> Cells | None:
        """In 2-D sectors of concentric rings; in 3-D none."""
        if self.dim == 1:
            return box_cells(*self.bounds(), size)
        return _polar_cells(self.centre, 0.0, self.radius, size) if self.dim == 2 else None


class Annulus(AbstractRegion):
    """The ring between two concentric circles, in 2-D.

    Args:
        centre: centre [m], (2,).
        inner: inner radius [m].
        outer: outer radius [m].
    """

    centre: Annotated[Point, finite, "m"]
    inner: Annotated[Scalar, positive, "m"]
    outer: Scalar

    def __check_init__(self):
        require_fields(self)
        d = coordinates("An annulus's centre", self.centre)
        require(d == 2, f"An annulus has a centre of two coordinates, got {self.centre}: take a Tube in 3-D.")
        _check_radii("An annulus", self.inner, self.outer)

    @property
    def dim(self) -> int:
        return 2

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """max(inner − r, r − outer), r = ‖x − centre‖."""
        within, beyond = jnp.unstack(self.sides(x), axis=-1)
        return jnp.where(within > beyond, within, beyond)

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        r = from_axis(x - jnp.asarray(self.centre, x.dtype))
        return jnp.stack([self.inner - r, r - self.outer], axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return Ball(self.centre, self.outer).bounds()

    def middle(self) -> Float[Array, "d"]:
        return jnp.asarray(self.centre)

    def fitted(self, size: np.ndarray) -> Cells:
        """Sectors of concentric rings."""
        return _polar_cells(self.centre, self.inner, self.outer, size)


class AbstractRound(AbstractRegion):
    """A region about the segment between two points."""

    start: Annotated[Point, finite, "m"]
    end: Annotated[Point, finite, "m"]

    def __check_init__(self):
        require_fields(self)
        name, start, end = f"A {type(self).__name__.lower()}", self.start, self.end
        alike = coordinates(f"{name}'s start", start) == coordinates(f"{name}'s end", end)
        require(alike, f"{name} needs two ends with as many coordinates, got {start} and {end}.")
        require_that(f"{name}'s ends must differ", lambda a, b: (a != b).any(), start, end)

    @property
    def dim(self) -> int:
        return len(self.start)

    def middle(self) -> Float[Array, "d"]:
        return (jnp.asarray(self.start) + jnp.asarray(self.end)) / 2


class Capsule(AbstractRound):
    """The points within a radius of a segment.

    Args:
        start: one end of the segment [m], (d,).
        end: the other end [m], (d,).
        radius: radius [m].
    """

    radius: Annotated[Scalar, positive, "m"]

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """‖x − nearest point of the segment‖ − radius."""
        start, end = jnp.asarray(self.start, x.dtype), jnp.asarray(self.end, x.dtype)
        axis, arm = end - start, x - start
        along = jnp.clip((arm * axis).sum(axis=-1) / (axis**2).sum(), 0, 1)
        return from_axis(arm - along[:, None] * axis) - self.radius

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        ends, radius = np.stack([np.asarray(self.start, float), np.asarray(self.end, float)]), float(self.radius)
        return ends.min(axis=0) - radius, ends.max(axis=0) + radius


class Cylinder(AbstractRound):
    """A round cylinder with flat ends (in 2-D a rectangle, with an axis in any direction).

    Args:
        start: centre of one end [m], (d,).
        end: centre of the other end [m], (d,).
        radius: radius [m].
    """

    radius: Annotated[Scalar, positive, "m"]

    def __check_init__(self):
        require_fields(self)
        require(len(self.start) > 1, f"A cylinder has two or three coordinates, got {self.start}: take a Box.")

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """As for a box, from the distances to the ends and to the lateral surface."""
        along, half, r = _about_axis(x, self.start, self.end)
        return common(jnp.stack([jnp.where(along < 0, -along, along) - half, r - self.radius], axis=-1))

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        along, half, r = _about_axis(x, self.start, self.end)
        return jnp.stack([-along - half, along - half, r - self.radius], axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        ends = np.stack([np.asarray(self.start, float), np.asarray(self.end, float)])
        axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        reach = float(self.radius) * np.sqrt(np.maximum(1 - axis**2, 0))
        return ends.min(axis=0) - reach, ends.max(axis=0) + reach

    def fitted(self, size: np.ndarray) -> Cells:
        """Sectors of concentric rings, in slices along the axis; in 2-D the rectangle's, along the axis and across."""
        if self.dim == 3:
            return _round_cells(self.start, self.end, 0.0, self.radius, size)
        start, end, radius = np.asarray(self.start, float), np.asarray(self.end, float), float(self.radius)
        height = np.linalg.norm(end - start)
        along, across = (end - start) / height, np.array([start[1] - end[1], end[0] - start[0]]) / height
        cells, areas = box_cells(np.array([0.0, -radius]), np.array([height, radius]), size)
        return start + cells @ np.stack([along, across]), areas


class Tube(AbstractRound):
    """The wall of a round tube with flat ends, in 3-D.

    Args:
        start: centre of one end [m], (3,).
        end: centre of the other end [m], (3,).
        inner: inner radius [m].
        outer: outer radius [m].
    """

    inner: Annotated[Scalar, positive, "m"]
    outer: Scalar

    def __check_init__(self):
        require_fields(self)
        require(len(self.start) == 3, f"A tube has three coordinates, got {self.start}: take an Annulus in 2-D.")
        _check_radii("A tube", self.inner, self.outer)

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """As for a cylinder, with the distance to the nearer of the two lateral surfaces."""
        below, above, within, beyond = jnp.unstack(self.sides(x), axis=-1)
        pairs = [jnp.where(below > above, below, above), jnp.where(within > beyond, within, beyond)]
        return common(jnp.stack(pairs, axis=-1))

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        along, half, r = _about_axis(x, self.start, self.end)
        return jnp.stack([-along - half, along - half, self.inner - r, r - self.outer], axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return Cylinder(self.start, self.end, self.outer).bounds()

    def fitted(self, size: np.ndarray) -> Cells:
        """Sectors of concentric rings, in slices along the axis."""
        return _round_cells(self.start, self.end, self.inner, self.outer, size)


def _check_radii(name: str, inner: Scalar, outer: Scalar) -> None:
    require_that(f"{name}'s inner radius must lie below its outer one", lambda a, b: a < b, inner, outer)


def _about_axis(
    x: Float[Array, "m d"], start: Point, end: Point
) -> tuple[Float[Array, "m"], Float[Array, ""], Float[Array, "m"]]:
    """Places of points along the axis through two points, from their middle [m], shape (m,), half the distance between
    the two [m], and distances from the axis [m], shape (m,)."""
    first, last = jnp.asarray(start, x.dtype), jnp.asarray(end, x.dtype)
    height = length(last - first)
    axis, arm = (last - first) / height, x - (first + last) / 2
    along = (arm * axis).sum(axis=-1)
    return along, height / 2, from_axis(arm - along[:, None] * axis)


def _polar_cells(centre: Point, inner: Scalar, outer: Scalar, size: np.ndarray) -> Cells:
    """The sectors of concentric rings that fill inner ≤ R ≤ outer [m] about a point of a plane.

    The rings are of equal thickness, near size[0]; each is cut into a multiple of four equal sectors, of a length near
    size[1] at its middle. With r₁, r₂ the radii of a ring and α the angle of a sector, its area is α (r₂² − r₁²)/2 and
    the radius of its centroid 2 (r₂³ − r₁³)/(3 (r₂² − r₁²)) sin(α/2)/(α/2).
    """
    inner, outer = float(inner), float(outer)
    edges = np.linspace(inner, outer, max(1, round((outer - inner) / size[0])) + 1)
    centroids, areas = [], []
    for r1, r2 in itertools.pairwise(edges):
        number = 4 * max(1, round(np.pi * (r1 + r2) / size[1] / 4))
        half = np.pi / number
        radius = 2 * (r2**3 - r1**3) / (3 * (r2**2 - r1**2)) * np.sin(half) / half
        angle = (2 * np.arange(number) + 1) * half
        centroids.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        areas.append(np.full(number, half * (r2**2 - r1**2)))
    return np.asarray(centre, float) + np.concatenate(centroids), np.concatenate(areas)


def _round_cells(first: Point, last: Point, inner: Scalar, outer: Scalar, size: np.ndarray) -> Cells:
    """`_polar_cells` about the axis between two points [m], shape (3,), in equal slices of thickness near size[2]."""
    start, end = np.asarray(first, float), np.asarray(last, float)
    height = np.linalg.norm(end - start)
    axis = (end - start) / height
    beside = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    beside = beside / np.linalg.norm(beside)
    plane, area = _polar_cells((0.0, 0.0), inner, outer, size)
    along, thickness = box_cells(np.zeros(1), np.array([height]), size[2:])
    centroids = start + (plane @ np.stack([beside, np.cross(axis, beside)]))[:, None] + along * axis
    return centroids.reshape(-1, 3), np.outer(area, thickness).reshape(-1)
