"""Observations: what was measured, and what a simulation says in its place."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import as_floats, require, require_fields, require_finite, require_positive
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene

Numbers = Float[np.ndarray, "..."] | Float[Array, "..."] | list | tuple | float | int


class AbstractObservation(eqx.Module):
    """A measurement of an experiment.

    One of your own says what it needs of each state (`observe`), and what it would have measured in a run of which it
    has seen all states (`predict`).
    """

    data: eqx.AbstractVar[np.ndarray]
    """The measured numbers, of any shape; NaN where nothing was measured."""
    sigma: eqx.AbstractVar[Float[np.ndarray, "..."] | None]
    """Standard deviation of its noise, a number or an array that broadcasts against the data, in the data's unit; None
    to estimate it from the misfit."""
    weight: eqx.AbstractVar[Scalar]
    """Factor of its squares [-]: 1 believes the noise, less than 1 counts points whose noise is correlated less."""
    robust: eqx.AbstractVar[Scalar | None]
    """The misfit, in standard deviations, beyond which squares grow but linearly (pseudo-Huber), so that outliers count
    little; None for squares throughout."""
    name: eqx.AbstractVar[str]
    """Name in tables and pictures."""

    @abc.abstractmethod
    def observe(self, scene: Scene, particles: Particles) -> Any:
        """The part of one state that is needed: an array, or a pytree of arrays."""

    @abc.abstractmethod
    def predict(self, seen: Any, run: Run) -> Array:
        """The measurement that a run predicts, in the shape of the data; NaN where the run does not reach.

        Args:
            seen: what `observe` returned at the start and after each step, with a leading axis.
            run: the run, for what states do not say: `run.dt`, `run.forces()`.
        """

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        """Check that the data fit an experiment with this scene and these prepared particles, until t1 [s].

        Raises:
            ValueError: they do not.
        """

    def explain(self, seen: Any, run: Run) -> None:
        """Say why a prediction is not finite.

        Raises:
            ValueError: always, where it is not.
        """

    def part_until(self, t1: float) -> "AbstractObservation | None":
        """The part that was measured until a time [s]; None where there is none, or it is not known, as of a curve."""

    def __check_init__(self):
        require_fields(self)
        name = self.title
        measured = np.isfinite(self.data)
        require(not np.isinf(self.data).any(), f"{name} must have finite data, or NaN where nothing was measured.")
        require(measured.sum() > 0, f"{name} has no data: it needs a finite number at least.")
        if self.sigma is not None:
            require_positive(f"The sigma of {name}", self.sigma)
            try:
                fits = np.broadcast_shapes(np.shape(self.sigma), self.data.shape) == self.data.shape
            except ValueError:
                fits = False
            require(
                fits, f"The sigma of {name} must fit its data of shape {self.data.shape}, got {np.shape(self.sigma)}."
            )
        require_positive(f"The weight of {name}", self.weight)
        if self.robust is not None:
            require_positive(f"The robust limit of {name}", self.robust)

    @property
    def title(self) -> str:
        """Kind and name, as messages have them."""
        return f"{type(self).__name__} {self.name!r}"

    @property
    def against(self) -> tuple[str, np.ndarray]:
        """The abscissa of pictures: its name, and a number for each row of the data."""
        return "number", np.arange(len(np.atleast_1d(self.data)))

    @property
    def trust(self) -> tuple[float, float | None]:
        """Weight and robust limit, as numbers."""
        return float(self.weight), None if self.robust is None else float(self.robust)

    @property
    def count(self) -> int:
        """How many numbers were measured."""
        return int(np.isfinite(self.data).sum())

    def scale(self) -> float:
        """The size of the data, which stands for an unknown σ until it is estimated."""
        data = self.data[np.isfinite(self.data)]
        return float(np.ptp(data) or np.abs(data).max() or 1.0)

    def residuals(self, predicted: Array, sigma: Scalar | Array) -> Array:
        """√weight (predicted − data)/σ [-], in C order, shape (m,); zero where nothing was measured.

        With `robust` large ones are drawn nearer (see `drawn_nearer`).
        """
        require(
            predicted.shape == self.data.shape,
            f"{self.title} has data of shape {self.data.shape}, what the simulation says has shape {predicted.shape}.",
        )
        dtype = predicted.dtype
        data, sigma, weight = (jnp.asarray(a, dtype) for a in (self.data, sigma, self.weight))
        measured = jnp.isfinite(data)
        r = jnp.where(measured, (predicted - jnp.where(measured, data, 0)) / sigma, 0).reshape(-1)
        if self.robust is not None:
            r = drawn_nearer(r, jnp.asarray(self.robust, dtype))
        return jnp.sqrt(weight) * r


class Curve(AbstractObservation):
    """A quantity measured against another one: stress against stretch, a force against a displacement.

    Args:
        x: measured abscissae, shape (m,).
        y: measured ordinates, shape (m,).
        of: function of (scene, particles) that returns one point (x, y) of the simulated curve; x must grow in time.
        sigma: standard deviation of the noise of y; None to estimate it.
        weight, robust, name: see `Series`.
        x_name: what pictures call the abscissa.
    """

    x: Float[np.ndarray, "m"]
    x_name: str = eqx.field(static=True)
    data: Float[np.ndarray, "m"]
    of: Callable[[Scene, Particles], Any]
    sigma: Float[np.ndarray, "..."] | None
    weight: Scalar
    robust: Scalar | None
    name: str = eqx.field(static=True)

    def __init__(
        self,
        x: Numbers,
        y: Numbers,
        of: Callable[[Scene, Particles], Any],
        *,
        sigma: Numbers | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "curve",
        x_name: str = "abscissa",
    ):
        self.x_name = x_name
        self.x, self.data, self.of, self.name = as_floats(x), as_floats(y), of, name
        self.sigma, self.weight, self.robust = as_floats(sigma), as_floats(weight), as_floats(robust)

    def __check_init__(self):
        require_fields(self)
        require(
            self.x.shape == self.data.shape,
            f"{self.title} needs x and y of one shape (m,), got {self.x.shape} and {self.data.shape}.",
        )
        require_finite(f"The abscissae of {self.title}", self.x)

    @property
    def title(self) -> str:
        """Kind and name, as messages have them."""
        return f"{type(self).__name__} {self.name!r}"

    @property
    def against(self) -> tuple[str, np.ndarray]:
        return self.x_name, self.x

    def observe(self, scene: Scene, particles: Particles) -> Any:
        return self.of(scene, particles)

    def predict(self, seen: Any, run: Run) -> Array:
        del run
        x, y = seen
        wanted = jnp.asarray(self.x, y.dtype)
        slack = _SLACK * (x[-1] - x[0])
        reached = (wanted >= x[0] - slack) & (wanted <= x[-1] + slack) & (jnp.diff(x) > 0).all()
        return jnp.where(reached, jnp.interp(wanted, x, y), jnp.nan)

    def explain(self, seen: Any, run: Run) -> None:
        del run
        x, y = (np.asarray(a) for a in seen)
        require(
            np.isfinite(x).all() and (np.diff(x) > 0).all(),
            f"The simulated abscissa of {self.title} must grow with every step of the run: slow the loading "
            "down, or reduce dt.",
        )
        slack = _SLACK * (x[-1] - x[0])
        outside = (self.x < x[0] - slack) | (self.x > x[-1] + slack)
        require(
            ~outside,
            f"The simulation covers {x[0]:.4g} to {x[-1]:.4g}, which leaves out measured points of {self.title} "
            f"({', '.join(f'{w:.4g}' for w in self.x[outside])}): pull further, or narrow the range.",
        )
        require_finite(f"The simulated ordinate of {self.title}", y)


def drawn_nearer(r: Array, limit: Scalar | Array) -> Array:
    """Residuals whose squares grow but linearly beyond a limit δ: r √(2/(1 + √(1 + r²/δ²))), half the square of which
    is the pseudo-Huber loss δ² (√(1 + r²/δ²) − 1)."""
    return r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (r / limit) ** 2)))


_SLACK = 1e-6
"""Part of a curve's length by which a point may lie beside it, as rounding of its start has it."""
