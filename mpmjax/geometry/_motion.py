"""Prescribed motions. They are data, no callables: saved, differentiated and changed without compiling anew."""

from functools import partial
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import Mark, coordinates, finite, require, require_fields, require_finite, require_that, shape_of

_Row = Float[Array, "j"] | Float[np.ndarray, "j"] | tuple[float | int | Array, ...] | list[float | int | Array]
Times = Annotated[_Row, finite, "s"]
Displacements = Annotated[Float[Array, "j d"] | Float[np.ndarray, "j d"] | tuple | list, finite, "m"]


class AbstractMotion(eqx.Module):
    """The motion of a rigid body, from positions X before the motion to positions x at time t: at least a displacement,
    piecewise linear in time, at rest before its first time and after its last."""

    turns: ClassVar[bool] = True  # whether it may turn the body
    times: eqx.AbstractVar[Times]
    displacement: eqx.AbstractVar[Displacements]

    def rests(self) -> bool:
        """Whether nothing ever moves. Default: False. It is asked only while numbers are known."""
        return False

    def swept(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The corners of a box [m], each of shape (d,), that holds another one at all times. Default: of all space. It
        is asked only while numbers are known."""
        return np.full(lower.shape, -np.inf), np.full(upper.shape, np.inf)

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return shape_of(self.displacement)[1]

    def at(self, t: Scalar) -> Float[Array, "d"]:
        """Displacement at time t [m], shape (d,); of a body that turns, that of its centre."""
        return _interpolated(t, jnp.asarray(self.times), jnp.asarray(self.displacement))

    def shift(self, t: Scalar, dt: Scalar) -> Float[Array, "d"]:
        """The change of the displacement from t to t + dt [m], shape (d,)."""
        return _change(t, dt, jnp.asarray(self.times), jnp.asarray(self.displacement))

    def origin(self, x: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """The positions X before the motion of the points that are at x at time t [m], both (m, d). Default: x − d(t),
        as the rest of a translation by the displacement."""
        return x - self.at(t)

    def place(self, X: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """The positions x at time t of the points X [m], both (m, d)."""
        return X + self.at(t)

    def turned(self, a: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """The vectors a, fixed in the body, as turned by it at time t, both (m, d)."""
        return a

    def velocity_of(self, X: Float[Array, "m d"], t: Scalar, dt: Scalar) -> Float[Array, "m d"]:
        """Mean velocity of the points X from t to t + dt [m/s], shape (m, d): (place(t + dt) − place(t))/dt."""
        return jnp.broadcast_to(self.shift(t, dt) / dt, X.shape)

    def pivot(self, middle: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        """The point for torques at time t [m], shape (d,), of a body with the given middle [m], shape (d,)."""
        return middle + self.at(t)


class Motion(AbstractMotion):
    """A translation, piecewise linear in time, at rest before its first time and after its last.

    Args:
        times: increasing times [s], (j,).
        displacement: displacement at each of them [m], (j, d).
    """

    times: Times
    displacement: Displacements
    turns: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)
        _check_rows("A motion's", "displacement", self.times, self.displacement)

    def rests(self) -> bool:
        return _constant(self.displacement)

    def swept(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        moved = np.asarray(self.displacement, float)
        return lower + moved.min(axis=0), upper + moved.max(axis=0)

    def velocity(self, t: Scalar, dt: Scalar) -> Float[Array, "d"]:
        """Mean velocity from t to t + dt [m/s], shape (d,). A node with it follows the displacement exactly."""
        return self.shift(t, dt) / dt


class RigidMotion(AbstractMotion):
    """A displacement d and a rotation R about a centre c, x = c + d(t) + R(t) (X − c).

    Both are piecewise linear in time, at rest before the first time and after the last. The rotation is an angle in
    2-D, and a rotation vector (axis times angle) in 3-D, so that between two times the spin is constant if the axis is.
    A step moves points along chords, to their exact positions at its end.

    Args:
        times: increasing times [s], (j,).
        displacement: displacement of the centre at each of them [m], (j, d).
        rotation: rotation at each of them [rad], (j,) in 2-D, (j, 3) in 3-D.
        centre: centre of the rotation and point for torques, before the motion [m], (d,).
    """

    times: Times
    displacement: Displacements
    rotation: Annotated[_Row | Float[Array, "j r"] | Float[np.ndarray, "j r"] | tuple | list, finite, "rad"]
    centre: Annotated[Point, finite, "m"]

    def __check_init__(self):
        require_fields(self)
        _check_rows("A rigid motion's", "displacement", self.times, self.displacement)
        d, shape = self.dim, shape_of(self.rotation)
        require(d in (2, 3), f"A rigid motion is two- or three-dimensional, got {d} coordinates: take a Motion.")
        expected = (len(self.times),) if d == 2 else (len(self.times), 3)
        require(shape == expected, f"A rigid motion's rotation must have shape {expected} here, got {shape}.")
        fits = coordinates("A rigid motion's centre", self.centre) == d
        require(fits, f"A rigid motion's centre must have {d} coordinates, as its displacement has, got {self.centre}.")

    def rests(self) -> bool:
        return _constant(self.displacement) and _constant(self.rotation)

    def rotation_at(self, t: Scalar) -> Float[Array, "r"]:
        """Angle or rotation vector at time t [rad], shape (1,) or (3,)."""
        return _interpolated(t, jnp.asarray(self.times), self._rotations())

    def _rotations(self) -> Float[Array, "j r"]:
        return jnp.asarray(self.rotation).reshape(len(self.times), -1)

    def origin(self, x: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """c + Rᵀ (x − c − d)."""
        centre = jnp.asarray(self.centre, x.dtype)
        return centre + turn(x - centre - self.at(t), -self.rotation_at(t))

    def place(self, X: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """c + d + R (X − c)."""
        centre = jnp.asarray(self.centre, X.dtype)
        return centre + self.at(t) + turn(X - centre, self.rotation_at(t))

    def turned(self, a: Float[Array, "m d"], t: Scalar) -> Float[Array, "m d"]:
        """R a."""
        return turn(a, self.rotation_at(t))

    def velocity_of(self, X: Float[Array, "m d"], t: Scalar, dt: Scalar) -> Float[Array, "m d"]:
        """The mean velocity of the centre plus the change of R over the step times (X − c)/dt."""
        arm, by = X - jnp.asarray(self.centre, X.dtype), _change(t, dt, jnp.asarray(self.times), self._rotations())
        columns = _turn_further(jnp.eye(self.dim, dtype=X.dtype), self.rotation_at(t), by)
        return (self.shift(t, dt) + sum(arm[:, a, None] * columns[a] for a in range(self.dim))) / dt

    def pivot(self, middle: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        return jnp.asarray(self.centre, middle.dtype) + self.at(t)


def still(dim: int) -> Motion:
    """No motion, in `dim` dimensions."""
    return Motion((0.0,), ((0.0,) * dim,))


def _constant(rows: Any) -> bool:
    return bool((np.ptp(np.asarray(rows), axis=0) == 0).all())


def _check_rows(owner: str, values: str, times: Times, rows: Any, *, axes: tuple[int, ...] = (2,)) -> None:
    """Check that increasing times have one row each of some values, with so many axes."""
    j, shape = shape_of(times), shape_of(rows)
    kind = "row" if axes == (2,) else "number or row"
    fits = len(j) == 1 and len(shape) in axes and j[0] == shape[0] > 0
    require(fits, f"{owner} {values} must be one {kind} a time, one time at least, got shapes {j} and {shape}.")
    require_that(f"{owner} times must increase", lambda t: t[1:] > t[:-1], times)


def _interpolated(t: Scalar, times: Float[Array, "j"], values: Float[Array, "j *c"]) -> Float[Array, "*c"]:
    """The piecewise linear interpolation of values, or of each column of them, at time t."""
    if values.ndim == 1:
        return jnp.interp(t, times, values)
    return jnp.stack([jnp.interp(t, times, values[:, a]) for a in range(values.shape[1])])


def _change(t: Scalar, dt: Scalar, times: Float[Array, "j"], values: Float[Array, "j c"]) -> Float[Array, "c"]:
    """The change of each column from t to t + dt, computed from the slopes.

    A difference would have the values' rounding: over dt = 1e-5 s a thousandth of the velocity in single precision.
    """
    slopes = jnp.diff(values, axis=0) / jnp.diff(times)[:, None]
    within = jnp.diff(jnp.clip(times - t, 0, dt))  # the part of the step that lies between two times
    return (within[:, None] * slopes).sum(axis=0)


def _turn_further(a: Float[Array, "m d"], rotation: Float[Array, "r"], by: Float[Array, "r"]) -> Float[Array, "m d"]:
    """R(rotation + by) a − R(rotation) a. For a small `by` it is the integral of the derivative by Gauss' rule of four
    points, without cancellation, at a relative error of 6e-10 ‖by‖⁸."""
    turned = partial(turn, a)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    along = [
        weight / 2 * jax.jvp(turned, (rotation + (1 + node) / 2 * by,), (by,))[1]
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True)
    ]
    return jnp.where((by**2).sum() < 0.1, sum(along), turned(rotation + by) - turned(rotation))


def turn(a: Float[Array, "m d"], rotation: Float[Array, "r"]) -> Float[Array, "m d"]:
    """Vectors turned by an angle, or by a rotation vector r (O. Rodrigues):
    a + (sin θ/θ) r × a + ((1 − cos θ)/θ²) r × (r × a), θ = ‖r‖."""
    if rotation.shape == (1,):
        cos, sin = jnp.cos(rotation[0]), jnp.sin(rotation[0])
        return jnp.stack([cos * a[:, 0] - sin * a[:, 1], sin * a[:, 0] + cos * a[:, 1]], axis=1)
    square = (rotation**2).sum()
    small = square < 1e-3  # where the quotients are their series, to the last digit and with all their derivatives
    angle = jnp.sqrt(jnp.where(small, 1, square))
    once = jnp.where(small, 1 - square / 6 + square**2 / 120 - square**3 / 5040, jnp.sin(angle) / angle)
    twice = jnp.where(
        small, 1 / 2 - square / 24 + square**2 / 720 - square**3 / 40320, 2 * (jnp.sin(angle / 2) / angle) ** 2
    )
    across = jnp.cross(rotation, a)
    return a + once * across + twice * jnp.cross(rotation, across)


class TimeSeries(eqx.Module):
    """A number or vector that is piecewise linear in time, constant before its first time and after its last.

    Args:
        times: increasing times [s], (j,).
        values: the value at each of them, (j,), or (j, d) of vectors.
    """

    times: Times
    values: Annotated[_Row | Float[Array, "j d"] | Float[np.ndarray, "j d"] | tuple | list, finite]

    def __check_init__(self):
        require_fields(self)
        _check_rows("A time series'", "values", self.times, self.values, axes=(1, 2))

    def at(self, t: Scalar) -> Float[Array, "..."]:
        """The value at time t, a number or of shape (d,)."""
        return _interpolated(t, jnp.asarray(self.times), jnp.asarray(self.values))


Changing = Scalar | TimeSeries  # a number, constant or as a time series
ChangingVector = Point | TimeSeries  # a vector of d numbers, likewise


def value_at(value: Changing | ChangingVector, t: Scalar) -> Float[Array, "..."]:
    """The value at time t of what is constant or a time series."""
    return value.at(t) if isinstance(value, TimeSeries) else jnp.asarray(value)


@partial(Mark, "finite numbers, one at least")
def require_some(name: str, value: Changing | ChangingVector) -> None:
    """Check that a value has numbers, and finite ones; a series has been checked.

    Raises:
        ValueError: it has none, or one that is not finite.
    """
    if not isinstance(value, TimeSeries):
        require(0 not in (shape_of(value) or ()), f"{name} must have a number at least, got {value}.")
        require_finite(name, value)


def vector_size(value: Changing | ChangingVector) -> int | None:
    """How many components a vector has that is constant or a time series; None of a number."""
    shape = shape_of(value.values if isinstance(value, TimeSeries) else value)
    rest = shape[1:] if isinstance(value, TimeSeries) else shape
    return rest[0] if len(rest) == 1 else None
