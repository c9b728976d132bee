"""Columns under their own weight: exact static states."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import AbstractBoundary, SymmetryPlane
from mpmjax.discretisation import Grid
from mpmjax.geometry import Box
from mpmjax.material import AbstractMaterial, FixedCorotated, Hencky
from mpmjax.simulation import simulate
from mpmjax.state import Particles
from mpmjax.stepping import AbstractIntegrator, BackwardEuler, SemiImplicit
from mpmjax.verification._exact_problem import AbstractProblem, discretise, displacement_error, stress_error

_LOADING, _HOLDING = 20, 8  # steps, of which each is a Newton step towards equilibrium
_HALLEY = 6  # iterations, of third order, from a good start
_STEP = 1e5  # [s], long enough for inertia not to matter


class AbstractColumn(AbstractProblem):
    """A column 0 ≤ X ≤ 1 m of ν = 0 on a symmetry plane, under its weight, which is applied slowly. Particles fill it
    exactly; the free end needs no condition."""

    load: eqx.AbstractVar[float]
    """a, weight over stiffness."""
    shift: eqx.AbstractVar[float]
    """Distance of the free end beyond a node, as a fraction of a cell: with it the particles' place in the cell differs
    from cell to cell."""
    method: ClassVar[AbstractIntegrator]
    """The integrator that finds the equilibrium."""

    @property
    def duration(self) -> float:
        """Duration of the run [s], so long that inertia is negligible."""
        return _STEP * (_LOADING + _HOLDING)

    def acting(self, t: Scalar) -> Array:
        """The part of the load that acts at time t."""
        return self.load * jnp.minimum(t / (_STEP * (_LOADING - 1)), 1)

    def grid(self, cells: int) -> Grid:
        return Grid((cells + 8,), 1 / (cells + self.shift), origin=(-3,))

    def body(self, cells: int) -> Box:
        del cells
        return Box((0.0,), (1.0,))

    def rest(self, cells: int, per_side: int, *, fitted: bool = False) -> Particles:
        del fitted  # they always are
        n = cells * per_side
        X, volume = jnp.asarray((np.arange(n) + 0.5)[:, None] / n), jnp.full(n, 1 / n)
        return Particles(X, jnp.zeros_like(X), self.density * volume, volume)

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return (SymmetryPlane(0, 0.0),)

    def errors(self, cells: int, *, per_side: int = 2, **choices: Any) -> tuple[float, float]:
        """The relative errors under full load: of the displacement, over that of the top, and of the stress, over that
        at the bottom a E.

        Args:
            cells: number of grid cells over the height of the column.
            per_side: particles to a cell.
            choices: kernel, gradient, transfer and description of the scene.
        """
        scene, particles = discretise(self, cells, per_side=per_side, **choices)
        t1, steps = self.duration, _LOADING + _HOLDING
        run = simulate(scene, particles, t1=t1, dt=t1 / steps, method=self.method, save_every=steps)
        top = 1 - float(self.position(jnp.ones(1), t1)[0])
        bottom = self.load * float(self.material.youngs_modulus)  # pyright: ignore[reportAttributeAccessIssue]
        u, P = displacement_error(self, particles, run)[-1], stress_error(self, particles, run)[-1]
        return float(u) / top, float(P) / bottom


class Column(AbstractColumn):
    """A column of P = E (F − 1), exact at any load below E. At full load P = −a E (1 − X) and x = X − a (X − X²/2).

    Args:
        load: a, weight over stiffness.
        shift: distance of the free end beyond a node, as a fraction of a cell.
    """

    method: ClassVar[AbstractIntegrator] = SemiImplicit()
    load: float = 0.04
    shift: float = 0.0
    material: AbstractMaterial = FixedCorotated(1.0, 0.0)
    density: float = 1.0
    dim: int = eqx.field(static=True, default=1)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        return X - self.acting(t) * (X - X**2 / 2)


class HenckyColumn(AbstractColumn):
    """A column of Hencky's law, at any load.

    At full load the Cauchy stress is σ = P = −a E (1 − X) (with ν = 0 the section stays). From E ln F/F = σ follow,
    with Lambert's W and s = a (1 − X), F = W(s)/s and x = (Φ(a) − Φ(s))/a, Φ = W + W²/2. A load of 0.04 is that of a
    column of 50 m, 80 kg/m³, 1 MPa and g = 10 m/s², the convergence test of AMPLE (W. M. Coombs, C. E. Augarde,
    https://wmcoombs.github.io/tests); a load of 4 that of one of 10 kPa, which is pressed to 0.30 at the bottom.

    Args:
        load: a, weight over stiffness.
        shift: distance of the free end beyond a node, as a fraction of a cell.
    """

    method: ClassVar[AbstractIntegrator] = BackwardEuler()
    load: float = 4.0
    shift: float = 0.0
    material: AbstractMaterial = Hencky(1.0, 0.0)
    density: float = 1.0
    dim: int = eqx.field(static=True, default=1)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        a = self.acting(t)
        none = a == 0
        a = jnp.where(none, 1.0, a)
        return jnp.where(none, X, (_potential(a) - _potential(a * (1 - X))) / a)


def _potential(s: Array) -> Array:
    """Φ = W + W²/2 with W(s) of Lambert, s ≥ 0: Halley's iteration for W e^W = s."""
    w = jnp.log1p(s)
    for _ in range(_HALLEY):
        e = jnp.exp(w)
        miss = w * e - s
        w = w - miss / (e * (w + 1) - (w + 2) * miss / (2 * w + 2))
    return w + w**2 / 2
