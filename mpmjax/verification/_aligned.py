"""Axis-aligned displacement: a manufactured motion of a box."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import AbstractBoundary
from mpmjax.discretisation import Grid
from mpmjax.geometry import Box
from mpmjax.material import AbstractMaterial, NeoHookean
from mpmjax.verification._problem import AbstractProblem, Ends, box_boundary, box_grid

_PHASES = {1: (0.0,), 2: (0.0, 1.0), 3: (0.0, 2 / 3, 4 / 3)}  # of π


class AxisAligned(AbstractProblem):
    """u_i = A sin(πX_i) sin(πct + φ_i) on the unit box, c² = E/ρ0 (M. Steffen, P. C. Wallstedt, J. E. Guilkey,
    R. M. Kirby, M. Berzins, Comput. Model. Eng. Sci. 31 (2008) 107).

    φ = (0, π) in 2-D, (0, 2π/3, 4π/3) in 3-D. The motion is odd at the faces, so it is periodic over [−1, 1]^d.

    Args:
        amplitude: A [m], below 1/π. 0.05 deforms by up to 16 per cent.
        dim: space dimension.
        ends: boundary at the faces.
        material: any law; its Young's modulus sets c.
        density: ρ0 [kg/m^d].
    """

    amplitude: float = 0.05
    dim: int = eqx.field(static=True, default=2)
    ends: Ends = eqx.field(static=True, default=Ends.PERIODIC)
    material: AbstractMaterial = NeoHookean(1e7, 0.3)
    density: float = 1e3
    forced: bool = eqx.field(static=True, default=True)

    @property
    def duration(self) -> float:
        """One period, 2/c [s]."""
        return 2 / float(self._speed)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        phase = jnp.pi * jnp.asarray(_PHASES[self.dim], X.dtype)
        return X + self.amplitude * jnp.sin(jnp.pi * X) * jnp.sin(jnp.pi * self._speed * t + phase)

    def grid(self, cells: int) -> Grid:
        return box_grid(*self._corners(), cells, self.ends)

    def body(self, cells: int) -> Box:
        del cells
        return Box(*self._corners())

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return box_boundary(*self._corners(), self.ends)

    @property
    def _speed(self) -> Any:
        law: Any = self.material
        return (law.youngs_modulus / self.density) ** 0.5

    def _corners(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        return ((-1.0 if self.ends is Ends.PERIODIC else 0.0),) * self.dim, (1.0,) * self.dim
