"""Regions made of other regions: their union, their intersection, all that is not in one, one in another place."""

from collections.abc import Callable
from functools import reduce
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import coordinates, finite, require, require_fields, require_that
from mpmjax.geometry._motion import turn
from mpmjax.geometry._region import AbstractRegion, Cells

Regions = tuple[AbstractRegion, ...]


def _several(regions: AbstractRegion | Regions | list[AbstractRegion]) -> Regions:
    return tuple(regions) if isinstance(regions, (tuple, list)) else (regions,)


def _extreme(choose: Callable[[Array, Array], Array], regions: Regions, x: Float[Array, "m d"]) -> Float[Array, "m"]:
    """The distance that `choose` prefers. Where two are equal the gradient is that of one: their mean may be zero."""
    return reduce(lambda a, b: jnp.where(choose(a, b), a, b), [region.distance(x) for region in regions])


class AbstractComposed(AbstractRegion):
    """A region made of several."""

    regions: eqx.AbstractVar[Regions]

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

    regions: Regions = eqx.field(converter=_several)

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

    regions: Regions = eqx.field(converter=_several)

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
