"""The generalized vortex: a ring whose material turns, most at the middle of its width."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.boundary import AbstractBoundary, Conditions
from mpmjax.discretisation import Grid
from mpmjax.geometry import Annulus
from mpmjax.material import AbstractMaterial, NeoHookean
from mpmjax.verification._problem import AbstractProblem, Ends, box_grid

_RING, _ROOM = Annulus((0.0, 0.0), 0.75, 1.25), 1.5


class RestOutside(AbstractBoundary):
    """A boundary that holds nodes outside of the ring at rest, as the exact motion is at its edges."""

    @property
    def dim(self) -> int:
        return 2

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        del spacing, t, dt, reference
        outside = _RING.distance(nodes)[:, None] >= 0
        return Conditions(jnp.broadcast_to(outside, nodes.shape), jnp.zeros_like(nodes))


class Vortex(AbstractProblem):
    """x = Q(g h) X, a rotation by g(t) h(R), g = A sin(πt), h = 1 − 32(R−1)² + 256(R−1)⁴ (K. Kamojjala, R. Brannon,
    A. Sadeghirad, J. Guilkey, Eng. Comput. 31 (2015) 201, doi 10.1007/s00366-013-0342-x).

    The volume does not change, and the edges of the ring are at rest.

    Args:
        amplitude: A [rad]. The shear of F reaches 7 A in the ring.
        material: any law.
        density: ρ0 [kg/m²].
    """

    amplitude: float = 0.1
    material: AbstractMaterial = NeoHookean(1e3, 0.3)
    density: float = 1e3
    dim: int = eqx.field(static=True, default=2)
    forced: bool = eqx.field(static=True, default=True)

    @property
    def duration(self) -> float:
        """Duration of the run [s], the time of a turn and its return."""
        return 1.0

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        s = (jnp.sqrt((X**2).sum()) - 1) ** 2
        turn = self.amplitude * jnp.sin(jnp.pi * t) * (1 - 32 * s + 256 * s**2)
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        return jnp.stack([cos * X[0] - sin * X[1], sin * X[0] + cos * X[1]])

    def grid(self, cells: int) -> Grid:
        return box_grid((-_ROOM,) * 2, (_ROOM,) * 2, cells, Ends.PLAIN)

    def body(self, cells: int) -> Annulus:
        del cells
        return _RING

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return (RestOutside(),)
