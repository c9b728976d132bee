"""The vibrating bar, fixed at one end and free at the other."""

import math

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import AbstractBoundary, SymmetryPlane
from mpmjax.discretisation import Grid
from mpmjax.geometry import Box
from mpmjax.material import AbstractMaterial, FixedCorotated
from mpmjax.verification._problem import AbstractProblem, Ends, box_grid


class VibratingBar(AbstractProblem):
    """v = v0 cos(ωt) sin(βX), β = (2n − 1)π/2L, ω = β√(E/ρ0), on 0 ≤ X ≤ L.

    Exact at any amplitude in one dimension with ν = 0, where P = E (F − 1) is linear. The free end needs no
    condition.

    Args:
        speed: v0 [m/s].
        mode: n, from 1.
        length: length L of the bar [m].
    """

    speed: float = 0.1
    mode: int = eqx.field(static=True, default=1)
    length: float = eqx.field(static=True, default=25.0)
    material: AbstractMaterial = FixedCorotated(100.0, 0.0)
    density: float = 1.0
    dim: int = eqx.field(static=True, default=1)
    forced: bool = eqx.field(static=True, default=False)

    @property
    def wave_number(self) -> float:
        """β [1/m]."""
        return (2 * self.mode - 1) * math.pi / (2 * self.length)

    @property
    def frequency(self) -> float:
        """ω [1/s]."""
        return self.wave_number * self.wave_speed

    @property
    def duration(self) -> float:
        """One period [s]."""
        return 2 * math.pi / self.frequency

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        omega = self.frequency
        return X + self.speed / omega * jnp.sin(omega * t) * jnp.sin(self.wave_number * X)

    def grid(self, cells: int) -> Grid:
        return box_grid((0.0,), (self.length,), cells, Ends.MIRRORED)

    def body(self, cells: int) -> Box:
        del cells
        return Box((0.0,), (self.length,))

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        """Fixed at X = 0."""
        return (SymmetryPlane(0, 0.0),)
