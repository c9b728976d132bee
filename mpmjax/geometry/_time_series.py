"""Numbers and vectors that change in time, as data."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import require, require_fields, require_finite, require_that
from mpmjax.geometry._motion import Times


class TimeSeries(eqx.Module):
    """A number or vector that is piecewise linear in time, constant before its first time and after its last.

    Args:
        times: increasing times [s], (j,).
        values: the value at each of them, (j,), or (j, d) of vectors.
    """

    times: Times
    values: Times | Float[Array, "j d"] | Float[np.ndarray, "j d"] | tuple | list

    def __check_init__(self):
        require_fields(self)
        j, rows = jnp.shape(jnp.asarray(self.times)), jnp.shape(jnp.asarray(self.values))
        require(
            len(j) == 1 and len(rows) in (1, 2) and j[0] == rows[0] > 0,
            f"A time series needs one value or vector a time, got shapes {j} and {rows}.",
        )
        require_finite("A time series' times", self.times)
        require_finite("A time series' values", self.values)
        require_that("A time series' times must increase", lambda t: t[1:] > t[:-1], self.times)

    def at(self, t: Scalar) -> Float[Array, "..."]:
        """The value at time t, a number or of shape (d,)."""
        times, values = jnp.asarray(self.times), jnp.asarray(self.values)
        if values.ndim == 1:
            return jnp.interp(t, times, values)
        return jnp.stack([jnp.interp(t, times, values[:, a]) for a in range(values.shape[1])])


Changing = Scalar | TimeSeries
"""A number, constant or as a time series."""
ChangingVector = Point | TimeSeries
"""A vector of d numbers, likewise."""


def value_at(value: Changing | ChangingVector, t: Scalar) -> Float[Array, "..."]:
    """The value at time t of what is constant or a time series."""
    return value.at(t) if isinstance(value, TimeSeries) else jnp.asarray(value)


def require_some(name: str, value: Changing | ChangingVector) -> None:
    """Check that a value has numbers, and finite ones; a series has been checked.

    Raises:
        ValueError: it has none, or one that is not finite.
    """
    if not isinstance(value, TimeSeries):
        require(jnp.size(jnp.asarray(value)) > 0, f"{name} must have a number at least, got {value}.")
        require_finite(name, value)


def vector_size(value: Changing | ChangingVector) -> int | None:
    """How many components a vector has that is constant or a time series; None of a number."""
    shape = jnp.shape(jnp.asarray(value.values if isinstance(value, TimeSeries) else value))
    rest = shape[1:] if isinstance(value, TimeSeries) else shape
    return rest[0] if len(rest) == 1 else None
