"""Prescribed motions: data, never callables, so that they can be saved, differentiated and changed without
compiling."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._checks import is_traced, require, require_finite
from mpmjax._types import Array, Float, Scalar


class Motion(eqx.Module):
    """A displacement that is piecewise linear in time, at rest before the first and after the last of its times.

    Args:
        times: increasing times [s], (j,).
        displacement: displacement at each of them [m], (j, d).
    """

    times: Float[Array, "j"] | Float[np.ndarray, "j"] | tuple[float | int, ...] | list[float | int]
    displacement: Float[Array, "j d"] | Float[np.ndarray, "j d"] | tuple | list

    def __check_init__(self):
        times, displacement = jnp.shape(jnp.asarray(self.times)), jnp.shape(jnp.asarray(self.displacement))
        require(
            len(times) == 1 and len(displacement) == 2 and times[0] == displacement[0],
            f"A motion needs one row of displacements a time, got shapes {times} and {displacement}.",
        )
        require_finite("A motion's times", self.times)
        require_finite("A motion's displacement", self.displacement)
        if not is_traced(self.times):
            require(np.diff(np.asarray(self.times)) > 0, f"A motion's times must increase, got {self.times}.")

    def at(self, t: Scalar) -> Float[Array, "d"]:
        """Displacement at time t [m], shape (d,)."""
        times, displacement = jnp.asarray(self.times), jnp.asarray(self.displacement)
        return jnp.stack([jnp.interp(t, times, displacement[:, a]) for a in range(displacement.shape[1])])

    def velocity(self, t: Scalar, dt: Scalar) -> Float[Array, "d"]:
        """Mean velocity from t to t + dt [m/s], shape (d,): what moves a node exactly along the displacement."""
        return (self.at(t + dt) - self.at(t)) / dt


def still(dim: int) -> Motion:
    """No motion in `dim` dimensions."""
    return Motion((0.0,), ((0.0,) * dim,))
