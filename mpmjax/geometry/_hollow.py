"""Hollow round regions."""

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import coordinates, require, require_fields, require_finite, require_positive, require_that
from mpmjax.geometry._cells import Cells, polar_cells, round_cells
from mpmjax.geometry._region import AbstractRegion, Cylinder, about_axis, check_segment, common, from_axis


def _check_radii(name: str, inner: Scalar, outer: Scalar) -> None:
    require_positive(f"{name}'s inner radius", inner)
    require_that(f"{name}'s inner radius must lie below its outer one", lambda a, b: a < b, inner, outer)


class Annulus(AbstractRegion):
    """The ring between two concentric circles, in 2-D.

    Args:
        centre: centre [m], (2,).
        inner: inner radius [m].
        outer: outer radius [m].
    """

    centre: Point
    inner: Scalar
    outer: Scalar

    def __check_init__(self):
        require_fields(self)
        d = coordinates("An annulus's centre", self.centre)
        require(d == 2, f"An annulus has a centre of two coordinates, got {self.centre}: take a Tube in 3-D.")
        require_finite("An annulus's centre", self.centre)
        _check_radii("An annulus", self.inner, self.outer)

    @property
    def dim(self) -> int:
        return 2

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """max(inner − r, r − outer), r = ‖x − centre‖."""
        r = from_axis(x - jnp.asarray(self.centre, x.dtype))
        return jnp.where(r < (self.inner + self.outer) / 2, self.inner - r, r - self.outer)

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        r = from_axis(x - jnp.asarray(self.centre, x.dtype))
        return jnp.stack([self.inner - r, r - self.outer], axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        centre, radius = np.asarray(self.centre, float), float(self.outer)
        return centre - radius, centre + radius

    def middle(self) -> Float[Array, "d"]:
        return jnp.asarray(self.centre)

    def fitted(self, size: np.ndarray) -> Cells:
        """Sectors of concentric rings."""
        centroids, areas = polar_cells(float(self.inner), float(self.outer), size)
        return np.asarray(self.centre, float) + centroids, areas


class Tube(AbstractRegion):
    """The wall of a round tube with flat ends, in 3-D.

    Args:
        start: centre of one end [m], (3,).
        end: centre of the other end [m], (3,).
        inner: inner radius [m].
        outer: outer radius [m].
    """

    start: Point
    end: Point
    inner: Scalar
    outer: Scalar

    def __check_init__(self):
        require_fields(self)
        check_segment("A tube", self.start, self.end)
        require(len(self.start) == 3, f"A tube has three coordinates, got {self.start}: take an Annulus in 2-D.")
        _check_radii("A tube", self.inner, self.outer)

    @property
    def dim(self) -> int:
        return 3

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """As for a cylinder, with the distance to the nearer of the two lateral surfaces."""
        along, half, r = about_axis(x, self.start, self.end)
        beside = jnp.where(r < (self.inner + self.outer) / 2, self.inner - r, r - self.outer)
        return common(jnp.stack([jnp.where(along < 0, -along, along) - half, beside], axis=-1))

    def sides(self, x: Float[Array, "m d"]) -> Float[Array, "m k"]:
        along, half, r = about_axis(x, self.start, self.end)
        return jnp.stack([-along - half, along - half, self.inner - r, r - self.outer], axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return Cylinder(self.start, self.end, self.outer).bounds()

    def middle(self) -> Float[Array, "d"]:
        return (jnp.asarray(self.start) + jnp.asarray(self.end)) / 2

    def fitted(self, size: np.ndarray) -> Cells:
        """Sectors of concentric rings, in slices along the axis."""
        ends = np.asarray(self.start, float), np.asarray(self.end, float)
        return round_cells(*ends, float(self.inner), float(self.outer), size)
