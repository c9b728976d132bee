"""A standing pressure wave of any amplitude."""

import math

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import AbstractBoundary, SlipBox, SymmetryPlane
from mpmjax.checks import require
from mpmjax.discretisation import Grid
from mpmjax.geometry import Box
from mpmjax.material import AbstractMaterial, FixedCorotated
from mpmjax.verification._problem import AbstractProblem, Ends, box_grid

_ACROSS = 4  # cells


class StandingWave(AbstractProblem):
    """u₁ = A sin(πX₁) cos(πct) on 0 ≤ X₁ ≤ 1, c² = (λ + 2μ)/ρ0, without any force.

    Exact at every amplitude with F₁₁ > 0: under uniaxial strain fixed corotated elasticity has
    P₁₁ = (λ + 2μ)(F₁₁ − 1), and no coupling to other directions. In these the body is periodic over four cells.

    Args:
        amplitude: A [m], below 1/π.
        dim: space dimension.
        ends: boundary at X₁ = 0 and 1.
    """

    amplitude: float = 0.05
    dim: int = eqx.field(static=True, default=1)
    ends: Ends = eqx.field(static=True, default=Ends.MIRRORED)
    material: AbstractMaterial = FixedCorotated(1e4, 0.3)
    density: float = 1e3
    forced: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        require(isinstance(self.material, FixedCorotated), "The standing wave is exact for FixedCorotated only.")
        require(abs(self.amplitude) < 1 / math.pi, f"The amplitude must be below 1/π, got {self.amplitude}.")

    @property
    def duration(self) -> float:
        """Half a period [s]."""
        return 1 / self.wave_speed

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        law = self.material
        assert isinstance(law, FixedCorotated)
        c = jnp.sqrt(jnp.asarray(law.lame_lambda + 2 * law.shear_modulus) / self.density)
        return X.at[0].add(self.amplitude * jnp.sin(jnp.pi * X[0]) * jnp.cos(jnp.pi * c * t))

    def grid(self, cells: int) -> Grid:
        along = box_grid(self._ends()[:1], self._ends()[1:], cells, self.ends)
        across = self.dim - 1
        return Grid(
            (*along.shape, *(_ACROSS,) * across),
            along.spacing,
            origin=(*along.origin, *(0,) * across),
            periodic=(*along.periodic, *(True,) * across),
        )

    def body(self, cells: int) -> Box:
        (low, high), across = self._ends(), self.dim - 1
        return Box((low, *(0.0,) * across), (high, *(_ACROSS / cells,) * across))

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        match self.ends:
            case Ends.MIRRORED:
                return (SymmetryPlane(0, 0.0), SymmetryPlane(0, 1.0, keep="below"))
            case Ends.PLAIN:
                across = (math.inf,) * (self.dim - 1)
                return (SlipBox((0.0, *(-a for a in across)), (1.0, *across)),)
            case Ends.PERIODIC:
                return ()

    def _ends(self) -> tuple[float, float]:
        return (-1.0 if self.ends is Ends.PERIODIC else 0.0), 1.0
