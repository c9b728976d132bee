"""Regions of space, for `fill`, grips and colliders: boxes, half-spaces, and what is made of other regions: union,
intersection, all that is not in one, one in another place.

A region is its signed distance: Euclidean, negative inside, with a gradient of length one. Where several points of the
surface are nearest (the centre of a ball, the diagonal of a box) the gradient is the direction of one of them or their
mean. It is never NaN or zero, so that a collider acts on what is at its middle too.
"""

import abc
from collections.abc import Callable
from functools import reduce
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Corner, Float, Point, Scalar
from mpmjax.checks import coordinates, finite, require, require_fields, require_that
from mpmjax.geometry._motion import turn

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


def check_corners(name: str, lower: Any, upper: Any, hint: str = "") -> None:
    """Check that two corners of a box have as many coordinates, the lower one's below the upper one's."""
    alike = coordinates(f"{name}'s lower corner", lower) == coordinates(f"{name}'s upper corner", upper)
    require(alike, f"{name} needs two corners with as many coordinates, got {lower} and {upper}.")
    below = f"{name}'s lower corner must lie below its upper one in each direction{hint}"
    require_that(below, lambda a, b: a < b, lower, upper)  # false of what is not a number


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
        check_corners("A box", self.lower, self.upper)

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
        alike = coordinates("A half-space's point", self.point) == coordinates("A half-space's normal", self.normal)
        require(alike, f"A half-space's point and normal need as many coordinates, got {self.point} and {self.normal}.")
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


Regions = tuple[AbstractRegion, ...]


def _several(regions: AbstractRegion | Regions | list[AbstractRegion]) -> Regions:
    return tuple(regions) if isinstance(regions, (tuple, list)) else (regions,)


def _extreme(choose: Callable[[Array, Array], Array], regions: Regions, x: Float[Array, "m d"]) -> Float[Array, "m"]:
    """The distance that `choose` prefers. Where two are equal the gradient is that of one: their mean may be zero."""
    return reduce(lambda a, b: jnp.where(choose(a, b), a, b), [region.distance(x) for region in regions])


class AbstractComposed(AbstractRegion):
    """A region made of several."""

    regions: Regions = eqx.field(converter=_several)

    def __check_init__(self):
        require_fields(self)
        name = f"A{'n' * isinstance(self, Intersection)} {type(self).__name__.lower()}"
        require(len(self.regions) > 0, f"{name} needs at least one region, got none.")
        dims = [region.dim for region in self.regions]
        require(len(set(dims)) == 1, f"{name}'s regions must have the same dimension, got {dims}.")

    @property
    def dim(self) -> int:
        return self.regions[0].dim

    def middle(self) -> Float[Array, "d"]:
        return jnp.stack([region.middle() for region in self.regions]).mean(axis=0)

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        return jnp.concatenate([region.sides(x) for region in self.regions], axis=1)

    def _each(self, behind: Float[Array, "m k"]) -> Float[Array, "r m"]:
        """`joined` of each of the regions."""
        numbers = [region.sides(jnp.zeros((1, self.dim))).shape[1] for region in self.regions]
        parts = jnp.split(behind, np.cumsum(numbers)[:-1], axis=1)
        return jnp.stack([region.joined(part) for region, part in zip(self.regions, parts, strict=True)])


class Union(AbstractComposed):
    """The union of several regions. Its distance is exact outside; inside, where they overlap, it may be too small.

    Args:
        regions: the regions.
    """

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        return _extreme(jnp.less, self.regions, x)

    def joined(self, behind: Float[Array, "m k"]) -> Float[Array, "m"]:
        # exact where they touch and where they overlap inside; too large where an overlap meets a side
        return jnp.minimum(self._each(behind).sum(axis=0), 1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = zip(*(region.bounds() for region in self.regions), strict=True)
        return np.min(lower, axis=0), np.max(upper, axis=0)


class Intersection(AbstractComposed):
    """The points that lie in each of several regions: with a `Box` a part of a round body, with a `Complement` a body
    with a hole.

        quarter = Intersection((Cylinder((0, 0, 0), (0, 0, 1), 0.5), Box((0, 0, 0), (1, 1, 1))))
        plate = Intersection((Box((0, 0), (1, 1)), Complement(Ball((0.5, 0.5), 0.2))))

    Its distance is exact inside; outside, beyond edges, it may be too small.

    Args:
        regions: the regions.
    """

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        return _extreme(jnp.greater, self.regions, x)

    def joined(self, behind: Float[Array, "m k"]) -> Float[Array, "m"]:
        return self._each(behind).prod(axis=0)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = zip(*(region.bounds() for region in self.regions), strict=True)
        return np.max(lower, axis=0), np.min(upper, axis=0)


class Complement(AbstractRegion):
    """All that is not in a region: as a collider's shape, a vessel; in an `Intersection`, what is cut off.

    Args:
        region: the region.
    """

    region: AbstractRegion
    __check_init__ = require_fields

    @property
    def dim(self) -> int:
        return self.region.dim

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        return -self.region.distance(x)

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        return -self.region.sides(x)

    def joined(self, behind: Float[Array, "m k"]) -> Float[Array, "m"]:
        return 1 - self.region.joined(1 - behind)

    def middle(self) -> Float[Array, "d"]:
        return self.region.middle()


class Placed(AbstractRegion):
    """A region mirrored, turned about a centre and moved: x = c + u + R M (X − c), M = I − 2 n nᵀ, n the unit normal.

    Args:
        region: the region.
        mirror: normal of the plane through the centre in which it is mirrored, (d,), of any length. Default: it is not.
        rotation: angle in 2-D, rotation vector (axis times angle), (3,), in 3-D [rad]. Default: none.
        displacement: by what it is moved [m], (d,). Default: none.
        centre: the centre c [m], (d,). Default: the origin.
    """

    region: AbstractRegion
    mirror: Annotated[Point, finite] | None = None
    rotation: Annotated[Scalar | Point, finite, "rad"] | None = None
    displacement: Annotated[Point, finite, "m"] | None = None
    centre: Annotated[Point, finite, "m"] | None = None

    def __check_init__(self):
        require_fields(self)
        d = self.dim
        for name in ("mirror", "displacement", "centre"):
            if (vector := getattr(self, name)) is not None:
                right = coordinates(f"A placed region's {name}", vector) == d
                require(right, f"A placed region's {name} must have {d} coordinates, as the region has, got {vector}.")
        if self.mirror is not None:
            require_that("A placed region's mirror must not be zero", lambda a: (a != 0).any(), self.mirror)
        if self.rotation is not None:
            shape, expected = jnp.shape(jnp.asarray(self.rotation)), {2: (), 3: (3,)}.get(d)
            fault = "one angle in two dimensions, three numbers in three, none in one"
            require(shape == expected, f"A placed region's rotation must be {fault}; got {self.rotation} in {d}.")

    @property
    def dim(self) -> int:
        return self.region.dim

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        return self.region.distance(self._origin(x))

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        return self.region.sides(self._origin(x))

    def joined(self, behind: Float[Array, "m k"]) -> Float[Array, "m"]:
        return self.region.joined(behind)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The box around the region's bounding box in its place."""
        zero = np.zeros((1, self.dim))
        start = np.asarray(self._place(zero), float)[0]
        columns = np.asarray(self._place(np.eye(self.dim)), float) - start
        columns[np.abs(columns) < _RIGHT] = 0  # by which an infinite corner stays in its direction
        with np.errstate(invalid="ignore"):  # zero times infinity, which counts as zero
            ends = np.stack(self.region.bounds())[:, :, None] * columns
        ends = np.where(columns == 0, 0, ends)
        return start + ends.min(axis=0).sum(axis=0), start + ends.max(axis=0).sum(axis=0)

    def middle(self) -> Float[Array, "d"]:
        return self._place(self.region.middle()[None])[0]

    def fitted(self, size: np.ndarray) -> Cells | None:
        """The region's cells, in their place."""
        cells = self.region.fitted(size)
        return None if cells is None else (np.asarray(self._place(cells[0]), float), cells[1])

    def _place(self, X: Float[Array, "m d"] | np.ndarray) -> Float[Array, "m d"]:
        X = jnp.asarray(X)
        centre = self._vector(self.centre, X)
        arm = self._mirrored(X - centre)
        arm = arm if self.rotation is None else turn(arm, jnp.asarray(self.rotation, X.dtype).reshape(-1))
        return centre + self._vector(self.displacement, X) + arm

    def _origin(self, x: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """Where points were: c + M Rᵀ (x − c − u)."""
        centre = self._vector(self.centre, x)
        arm = x - centre - self._vector(self.displacement, x)
        arm = arm if self.rotation is None else turn(arm, -jnp.asarray(self.rotation, x.dtype).reshape(-1))
        return centre + self._mirrored(arm)

    def _vector(self, vector: Point | None, x: Array) -> Array:
        return jnp.zeros(self.dim, x.dtype) if vector is None else jnp.asarray(vector, x.dtype)

    def _mirrored(self, a: Float[Array, "m d"]) -> Float[Array, "m d"]:
        if self.mirror is None:
            return a
        n = jnp.asarray(self.mirror, a.dtype)
        return a - (2 * (a * n).sum(axis=-1, keepdims=True) / (n * n).sum()) * n


_RIGHT = 1e-9  # the cosine below which an angle is a right one
