"""A ring with free surfaces that expands and shrinks."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.discretisation import Grid
from mpmjax.geometry import Annulus
from mpmjax.material import AbstractMaterial, NeoHookean
from mpmjax.verification._problem import AbstractProblem, Ends, box_grid

_ROOM = 1.0


class ExpandingRing(AbstractProblem):
    """x = X (1 + A sin(πct) U(R)/R), c² = E/ρ0, on Ri ≤ R ≤ Ro, with
    U = (6 Ri Ro R − 3 (Ri + Ro) R² + 2 R³) / (Ri² (3 Ro − Ri)) (radii and conditions of the expanding ring of
    P. C. Wallstedt, J. E. Guilkey, J. Comput. Phys. 227 (2008) 9628, doi 10.1016/j.jcp.2008.07.019).

    The displacement of the inner edge is A sin(πct). U′ vanishes at both edges, so that with ν = 0 they are free of
    traction at every amplitude. The grid has no part in the shape.

    Args:
        amplitude: A [m], below Ri.
        inner: Ri [m].
        outer: Ro [m].
        material: a law with ν = 0, of which the radial stress vanishes at a radial stretch of one.
        density: ρ0 [kg/m²].
    """

    amplitude: float = 0.1
    inner: float = 0.4
    outer: float = 0.6
    material: AbstractMaterial = NeoHookean(1e7, 0.0)
    density: float = 1e3
    dim: int = eqx.field(static=True, default=2)
    forced: bool = eqx.field(static=True, default=True)

    @property
    def duration(self) -> float:
        """One period, 2/c [s]."""
        return 2 / float(self._speed)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        a, b = self.inner, self.outer
        R = jnp.sqrt((X**2).sum())
        over = (6 * a * b - 3 * (a + b) * R + 2 * R**2) / (a**2 * (3 * b - a))
        return X * (1 + self.amplitude * jnp.sin(jnp.pi * self._speed * t) * over)

    def grid(self, cells: int) -> Grid:
        return box_grid((-_ROOM,) * 2, (_ROOM,) * 2, cells, Ends.PLAIN)

    def body(self, cells: int) -> Annulus:
        del cells
        return Annulus((0.0, 0.0), self.inner, self.outer)

    @property
    def _speed(self) -> Any:
        law: Any = self.material
        return (law.youngs_modulus / self.density) ** 0.5
