"""Regions of space: what `fill` fills and a grip holds."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._checks import coordinates, is_traced, require, require_finite, require_positive
from mpmjax._types import Array, Bool, Float, Point, Scalar


class AbstractRegion(eqx.Module):
    """A closed set of points."""

    @abc.abstractmethod
    def contains(self, x: Float[Array, "m d"], margin: Scalar = 0.0) -> Bool[Array, "m"]:
        """Whether each of the points x [m], shape (m, d), lies in the region or within `margin` [m] of it."""

    @abc.abstractmethod
    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the bounding box [m], each (d,)."""


class Box(AbstractRegion):
    """The axis-aligned box between two corners.

    Args:
        lower: smallest coordinate in each direction [m], (d,). −inf is allowed where a grip is meant to reach so far.
        upper: largest coordinate in each direction [m], (d,), above `lower`.
    """

    lower: Point
    upper: Point

    def __check_init__(self):
        require(
            coordinates("A box's lower corner", self.lower) == coordinates("A box's upper corner", self.upper),
            f"A box needs two corners with as many coordinates, got {self.lower} and {self.upper}.",
        )
        if not is_traced((self.lower, self.upper)):
            require(
                np.asarray(self.lower) < np.asarray(self.upper),
                f"A box's lower corner must lie below its upper one in each direction, got {self.lower}, {self.upper}.",
            )

    def contains(self, x: Float[Array, "m d"], margin: Scalar = 0.0) -> Bool[Array, "m"]:
        """Between the corners."""
        lower, upper = jnp.asarray(self.lower, x.dtype), jnp.asarray(self.upper, x.dtype)
        return ((x >= lower - margin) & (x <= upper + margin)).all(axis=-1)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The corners."""
        return np.asarray(self.lower, float), np.asarray(self.upper, float)


class Ball(AbstractRegion):
    """A ball (a disk in 2-D, an interval in 1-D).

    Args:
        centre: centre [m], (d,).
        radius: radius [m].
    """

    centre: Point
    radius: Scalar

    def __check_init__(self):
        coordinates("A ball's centre", self.centre)
        require_finite("A ball's centre", self.centre)
        require_positive("A ball's radius", self.radius)

    def contains(self, x: Float[Array, "m d"], margin: Scalar = 0.0) -> Bool[Array, "m"]:
        """Within the radius of the centre."""
        centre = jnp.asarray(self.centre, x.dtype)
        return ((x - centre) ** 2).sum(axis=-1) <= (self.radius + margin) ** 2

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre minus and plus the radius."""
        centre, radius = np.asarray(self.centre, float), float(self.radius)
        return centre - radius, centre + radius
