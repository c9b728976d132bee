"""Couples on points of a body."""

from typing import ClassVar

import jax.numpy as jnp

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import require, require_fields
from mpmjax.geometry import TimeSeries, inertia, require_some, spinning, value_at, vector_size
from mpmjax.state._attachment import AbstractPlace, AttachedPoints
from mpmjax.state._loaded_points import LoadedPoints
from mpmjax.state._loads import AbstractLoad


class Couple(AbstractLoad):
    """A couple, a torque on several points of a body by forces f_s = w_s α × r_s without a sum.

    r_s are the points' distances from their common centre, with the weights w_s, as the step begins, and
    α = (Σ w_s (‖r_s‖² 1 − r_s r_sᵀ))⁻¹ T. The torque is exact and keeps its direction; how the forces turn with the
    points is not part of an implicit solve's matrix.

    Args:
        on: the points, `PointsAt` or a `Patch`: two at least, in 3-D three that are not on one line.
        total: T [N m], a number in 2-D (per metre of thickness), (3,) in 3-D, or a `TimeSeries`.
    """

    on: AbstractPlace
    total: Scalar | Point | TimeSeries
    moves_points_on: ClassVar[bool] = False  # forces act on the nodes as the step begins

    def __check_init__(self):
        require_fields(self)
        require_some("Couple's total [N m]", self.total)
        if isinstance(self.on, AttachedPoints):
            count = jnp.shape(jnp.asarray(self.on.particle))[0]
            require(count >= self.on.dim, f"A Couple needs {self.on.dim} points at least, got {count}.")

    def check(self, dim: int) -> None:
        AbstractLoad.check(self, dim)
        require(dim > 1, "A Couple needs two or three dimensions, got one.")
        size = vector_size(self.total)
        require(
            size == {2: None, 3: 3}[dim],
            f"Couple's total must be {'a number in 2-D' if dim == 2 else 'three numbers in 3-D'}, got "
            f"{'a number' if size is None else f'{size} of them'}.",
        )

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        """w α × r."""
        del dt
        weight, x = points.weight, points.x.T
        arms = x - (weight[:, None] * x).sum(axis=0) / weight.sum()
        alpha = jnp.linalg.solve(inertia(arms, weight), jnp.atleast_1d(value_at(self.total, t)))
        return weight * spinning(alpha, arms).T
