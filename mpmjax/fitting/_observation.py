"""Observations: what was measured, and what a simulation says in its place."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import as_floats, require, require_fields, require_finite, require_positive
from mpmjax.fitting._columns import ROUNDED, after
from mpmjax.fitting._prior import drawn_nearer
from mpmjax.fitting._quantities import Markers
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene

Numbers = Float[np.ndarray, "..."] | Float[Array, "..."] | list | tuple | float | int


class AbstractObservation(eqx.Module):
    """What was measured in an experiment.

    One of your own says what it needs of each state (`observe`), and what it would have measured in a run of which it
    has seen all states (`predict`).
    """

    data: eqx.AbstractVar[np.ndarray]
    """What was measured, of any shape; NaN where nothing was."""
    sigma: eqx.AbstractVar[Float[np.ndarray, "..."] | None]
    """Standard deviation of its noise, a number or an array that broadcasts against the data, in the data's unit; None
    to estimate it from the misfit."""
    weight: eqx.AbstractVar[Scalar]
    """Factor of its squares [-]: 1 believes the noise, less than 1 counts points whose noise is correlated less."""
    robust: eqx.AbstractVar[Scalar | None]
    """The misfit, in standard deviations, beyond which squares grow but linearly (pseudo-Huber), so that outliers count
    little; None for squares throughout."""
    name: eqx.AbstractVar[str]
    """What tables and pictures call it."""

    @abc.abstractmethod
    def observe(self, scene: Scene, particles: Particles) -> Any:
        """What is needed of one state: an array, or a pytree of arrays."""

    @abc.abstractmethod
    def predict(self, seen: Any, run: Run) -> Array:
        """What would have been measured, in the shape of the data; NaN where the run does not reach.

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
        name = f"{type(self).__name__} {self.name!r}"
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
    def against(self) -> tuple[str, np.ndarray]:
        """What pictures draw the data over: its name, and a number for each row of the data."""
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
            f"{type(self).__name__} {self.name!r} has data of shape {self.data.shape}, what the simulation says has "
            f"shape {predicted.shape}.",
        )
        dtype = predicted.dtype
        data, sigma, weight = (jnp.asarray(a, dtype) for a in (self.data, sigma, self.weight))
        measured = jnp.isfinite(data)
        r = jnp.where(measured, (predicted - jnp.where(measured, data, 0)) / sigma, 0).reshape(-1)
        if self.robust is not None:
            r = drawn_nearer(r, jnp.asarray(self.robust, dtype))
        return jnp.sqrt(weight) * r


class Series(AbstractObservation):
    """A quantity measured against time: a height, a front, an energy, an image, anything that a state says.

    Between steps it is interpolated linearly.

    Args:
        times: when it was measured [s], shape (f,), growing, from 0 to the experiment's t1.
        values: what was measured, shape (f, ...); NaN or masked where nothing was.
        of: function of (scene, particles) that returns it, shape (...).
        sigma: standard deviation of the noise, in the unit of the values; None to estimate it.
        weight: factor of the squares.
        robust: misfit in standard deviations beyond which squares grow but linearly.
        name: what tables and pictures call it.
    """

    times: Float[np.ndarray, "f"]
    data: Float[np.ndarray, "f ..."]
    of: Callable[[Scene, Particles], Any]
    sigma: Float[np.ndarray, "..."] | None
    weight: Scalar
    robust: Scalar | None
    name: str = eqx.field(static=True)

    def __init__(
        self,
        times: Numbers,
        values: Numbers,
        of: Callable[[Scene, Particles], Any],
        *,
        sigma: Numbers | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "series",
    ):
        self.times, self.data, self.of, self.name = as_floats(times), as_floats(values), of, name
        self.sigma, self.weight, self.robust = as_floats(sigma), as_floats(weight), as_floats(robust)

    def __check_init__(self):
        require_fields(self)
        what = f"{type(self).__name__} {self.name!r}"
        require(
            self.data.shape[:1] == self.times.shape,
            f"{what} needs times of shape (f,) and values of shape (f, ...), got {self.times.shape} and "
            f"{self.data.shape}.",
        )
        require_finite(f"The times of {what} [s]", self.times)
        require(np.diff(self.times) > 0, f"The times of {what} must grow: sort the measurements by time.")

    @property
    def against(self) -> tuple[str, np.ndarray]:
        return "time [s]", self.times

    def observe(self, scene: Scene, particles: Particles) -> Any:
        return self.of(scene, particles)

    def predict(self, seen: Array, run: Run) -> Array:
        return self._at_times(seen, run)

    def _at_times(self, values: Array, run: Run, first: Scalar = 0.0) -> Array:
        """Values at the times; NaN at times that a parameter has moved out of the run.

        Args:
            values: one for each step or state, shape (k, ...).
            run: the run, with every step saved.
            first: where the first one stands, in steps from the start.
        """
        step = jnp.asarray(self.times, values.dtype) / run.dt
        outside = (step < -_BEYOND) | (step > (len(run.steps) - 1) * (1 + ROUNDED) + _BEYOND)
        outside = outside.reshape(-1, *[1] * (values.ndim - 1))
        return jnp.where(outside, jnp.nan, between(values, step - first))

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        what = f"{type(self).__name__} {self.name!r}"
        outside = (self.times < 0) | after(self.times, t1)
        require(
            ~outside,
            f"The times of {what} must lie in the run, from 0 to {t1:g} s, but {int(outside.sum())} do not, the first "
            f"{self.times[outside][:1]}: raise t1, or leave them out.",
        )
        self._check_shape(eqx.filter_eval_shape(lambda *state: self.observe(*state), scene, particles))

    def _check_shape(self, seen: Any) -> None:
        shape = getattr(seen, "shape", None)
        require(
            shape == self.data.shape[1:],
            f"{type(self).__name__} {self.name!r} has values of shape {self.data.shape[1:]} at each time, but of "
            f"returns {'no array' if shape is None else f'shape {shape}'}.",
        )

    def until(self, t1: float) -> "Series":
        """The part of it that was measured until a time [s].

        Raises:
            ValueError: there is none.
        """
        kept = ~after(self.times, t1)
        require(kept.any(), f"{type(self).__name__} {self.name!r} begins at {self.times[0]:g} s, after t1 = {t1:g} s.")
        sigma = None if self.sigma is None else np.broadcast_to(self.sigma, self.data.shape)[kept]
        return eqx.tree_at(
            lambda o: (o.times, o.data, o.sigma),
            self,
            (self.times[kept], self.data[kept], sigma),
            is_leaf=lambda leaf: leaf is None,
        )

    def part_until(self, t1: float) -> "Series | None":
        seen = np.isfinite(self.data[~after(self.times, t1)]).any()
        return self.until(t1) if seen else None

    def explain(self, seen: Array, run: Run) -> None:
        require_finite(f"What the simulation says of {self.name!r}", seen)
        reached = np.isfinite(np.asarray(self.predict(seen, run)))
        require(reached, f"A parameter moves times of {self.name!r} out of the run: raise t1.")


def between(values: Array, place: Array) -> Array:
    """Values between rows, by linear interpolation; before the first and after the last two, beyond them.

    Args:
        values: shape (f, ...).
        place: numbers of rows, shape (m,), not whole.
    """
    last = jnp.clip(jnp.floor(place + _ON_A_ROW), 0, len(values) - 2)
    share, at = (place - last).reshape(-1, *[1] * (values.ndim - 1)), last.astype(int)
    return (1 - share) * values[at] + share * values[at + 1]


_ON_A_ROW = 1e-6
"""Part of a step by which a time may miss a step and is on it."""
_BEYOND = 1e-2
"""Part of a step by which a time may lie beyond the run, as rounding has it."""
_SLACK = 1e-6
"""Part of a curve's length by which a point may lie beside it, as rounding of its start has it."""


class Tracks(Series):
    """Places of material points that were followed: markers, or features of a video.

    Args:
        times: when they were seen [s], shape (f,), growing.
        positions: where [m], shape (f, m, d); NaN where a marker was not seen.
        which: the markers: numbers of particles, shape (m,), or `Markers.at` for places between particles.
        sigma: standard deviation of the noise of a coordinate [m]; None to estimate it.
        weight: factor of the squares.
        robust: misfit in standard deviations beyond which squares grow but linearly.
        name: what tables and pictures call it.
    """

    def __init__(
        self,
        times: Numbers,
        positions: Numbers,
        *,
        which: Markers | np.ndarray | Array | list[int] | tuple[int, ...],
        sigma: Numbers | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "tracks",
    ):
        markers = which if isinstance(which, Markers) else Markers.of(which)
        super().__init__(times, positions, markers, sigma=sigma, weight=weight, robust=robust, name=name)

    def __check_init__(self):
        require_fields(self)
        assert isinstance(self.of, Markers)
        require(
            self.data.ndim == 3 and self.of.count == self.data.shape[1],
            f"Tracks {self.name!r} need positions of shape (f, m, d) of the m markers, got {self.data.shape} and "
            f"{self.of.count} markers.",
        )

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        require(
            self.data.shape[2] == particles.dim,
            f"Tracks {self.name!r} are {self.data.shape[2]}-dimensional, the particles {particles.dim}-dimensional.",
        )
        super().check(scene, particles, t1)
        assert isinstance(self.of, Markers)
        self.of.check(self.name, particles.count)


class Curve(AbstractObservation):
    """A quantity measured against another one: stress against stretch, a force against a displacement.

    Args:
        x: measured abscissae, shape (m,).
        y: measured ordinates, shape (m,).
        of: function of (scene, particles) that returns one point (x, y) of the simulated curve; x must grow in time.
        sigma: standard deviation of the noise of y; None to estimate it.
        weight: factor of the squares.
        robust: misfit in standard deviations beyond which squares grow but linearly.
        name: what tables and pictures call it.
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
            f"Curve {self.name!r} needs x and y of one shape (m,), got {self.x.shape} and {self.data.shape}.",
        )
        require_finite(f"The abscissae of Curve {self.name!r}", self.x)

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
            f"The simulated abscissa of Curve {self.name!r} must grow with every step of the run: slow the loading "
            "down, or reduce dt.",
        )
        slack = _SLACK * (x[-1] - x[0])
        outside = (self.x < x[0] - slack) | (self.x > x[-1] + slack)
        require(
            ~outside,
            f"The simulation covers {x[0]:.4g} to {x[-1]:.4g}, which leaves out measured points of Curve {self.name!r} "
            f"({', '.join(f'{w:.4g}' for w in self.x[outside])}): pull further, or narrow the range.",
        )
        require_finite(f"The simulated ordinate of Curve {self.name!r}", y)
