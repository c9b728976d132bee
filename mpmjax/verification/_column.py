"""A column under its own weight: an exact static state."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import AbstractBoundary, SymmetryPlane
from mpmjax.discretisation import Grid
from mpmjax.geometry import Box
from mpmjax.material import AbstractMaterial, FixedCorotated
from mpmjax.simulation import simulate
from mpmjax.state import Particles
from mpmjax.stepping import SemiImplicit
from mpmjax.verification._problem import (
    AbstractProblem,
    discretise,
    displacement_error,
    stress_error,
)

_LOADING, _HOLDING = 20, 8  # steps, of which each is a Newton step towards equilibrium
_STEP = 1e5  # [s], long enough for inertia not to matter


class Column(AbstractProblem):
    """A column 0 ≤ X ≤ 1 m on a symmetry plane under its weight, which is applied slowly. At full load
    P = −a E (1 − X) and x = X − a (X − X²/2).

    Exact at any load below E in one dimension with ν = 0, where P = E (F − 1) is linear. The free end needs no
    condition.

    Args:
        load: a, weight over stiffness.
        shift: distance of the free end beyond a node, as a fraction of a cell. Particles fill the column exactly, so
            that with a shift their place in the cell differs from cell to cell.
    """

    load: float = 0.04
    shift: float = 0.0
    material: AbstractMaterial = FixedCorotated(1.0, 0.0)
    density: float = 1.0
    dim: int = eqx.field(static=True, default=1)
    forced: bool = eqx.field(static=True, default=True)

    @property
    def duration(self) -> float:
        """Duration of the run [s], so long that inertia is negligible."""
        return _STEP * (_LOADING + _HOLDING)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        share = jnp.minimum(t / (_STEP * (_LOADING - 1)), 1)
        return X - self.load * share * (X - X**2 / 2)

    def grid(self, cells: int) -> Grid:
        return Grid((cells + 8,), 1 / (cells + self.shift), origin=(-3,))

    def body(self, cells: int) -> Box:
        del cells
        return Box((0.0,), (1.0,))

    def rest(self, cells: int, per_side: int, *, fitted: bool = False) -> Particles:
        """Particles at rest that fill the column exactly, `per_side` to a cell."""
        del fitted  # they always are
        n = cells * per_side
        X, volume = jnp.asarray((np.arange(n) + 0.5)[:, None] / n), jnp.full(n, 1 / n)
        return Particles(X, jnp.zeros_like(X), self.density * volume, volume)

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return (SymmetryPlane(0, 0.0),)

    def errors(self, cells: int, *, per_side: int = 2, **choices: Any) -> tuple[float, float]:
        """The relative errors under full load: of the displacement, over that of the top a/2, and of the stress, over
        that at the bottom a E.

        Args:
            cells: number of grid cells over the height of the column.
            per_side: particles to a cell.
            choices: kernel, gradient, transfer and description of the scene.
        """
        scene, particles = discretise(self, cells, per_side=per_side, **choices)
        steps = _LOADING + _HOLDING
        run = simulate(
            scene, particles, t1=self.duration, dt=self.duration / steps, method=SemiImplicit(), save_every=steps
        )
        stiffness = float(self.material.youngs_modulus)  # pyright: ignore[reportAttributeAccessIssue]
        u, P = displacement_error(self, particles, run)[-1], stress_error(self, particles, run)[-1]
        return float(u) / (self.load / 2), float(P) / (self.load * stiffness)
