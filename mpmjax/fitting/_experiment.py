"""An experiment: a scene, how it is run, and what was measured of it."""

import abc
import itertools
from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import as_floats, canonical, checked, finite, positive, require, require_fields, require_positive
from mpmjax.fitting._uncertainty import Prediction
from mpmjax.simulation import Run, number_of_steps, simulate
from mpmjax.state import Particles, Scene, prepare
from mpmjax.stepping import AbstractIntegrator, Explicit

Numbers = Float[np.ndarray, "..."] | Float[Array, "..."] | list | tuple | float | int


class Shown(eqx.Module):
    """How pictures show an observation: its columns in their file's units, if it has one.

    Args:
        x, y: names of abscissa and ordinate, with their units. Default: those of the observation.
        columns: names of the data's components, for the legend.
        x_unit: what one of the abscissa's unit is [SI].
        unit: what one of the data's unit is [SI]; negative where the file counts the other way.
        path: times [s] and the abscissa then, in its unit, of data not measured against time, shape (2, m).
    """

    x: str = eqx.field(static=True, default="")
    y: str = eqx.field(static=True, default="")
    columns: tuple[str, ...] = eqx.field(static=True, default=())
    x_unit: Annotated[Scalar, positive] = eqx.field(converter=as_floats, default=1.0)
    unit: Annotated[Scalar, finite] = eqx.field(converter=as_floats, default=1.0)
    path: Annotated[Float[np.ndarray, "2 m"], finite] | None = eqx.field(converter=as_floats, default=None)

    def __check_init__(self):
        require_fields(self)
        require(np.asarray(self.unit) != 0, "Shown's unit must not be zero, got 0: give what one of it is in SI units.")

    def along(self, x: np.ndarray) -> np.ndarray:
        """The abscissae of pictures, from those of the observation."""
        return np.asarray(x) / self.x_unit if self.path is None else np.interp(x, *self.path)


class AbstractObservation(eqx.Module):
    """A measurement of an experiment. One of your own says what it needs of each state (`observe`), and what it would
    have measured in a run of which it has seen all states (`predict`)."""

    data: eqx.AbstractVar[np.ndarray]  # the measured numbers, of any shape; NaN where nothing was measured
    name: eqx.AbstractVar[str]  # name in tables and pictures
    sigma: Float[np.ndarray, "..."] | None = eqx.field(converter=as_floats, default=None, kw_only=True)
    """Standard deviation of its noise, broadcast against the data, in their unit; None to estimate it."""
    weight: Scalar = eqx.field(converter=as_floats, default=1.0, kw_only=True)
    """Factor of its squares [-]: 1 believes the noise, less than 1 counts points whose noise is correlated less."""
    robust: Scalar | None = eqx.field(converter=as_floats, default=None, kw_only=True)
    """The misfit in σ beyond which squares grow but linearly (pseudo-Huber), for outliers; None for squares alone."""
    shown: Shown = eqx.field(default=Shown(), kw_only=True)  # how pictures show it, such as in other units

    @abc.abstractmethod
    def observe(self, scene: Scene, particles: Particles) -> Any:
        """The part of one state that is needed: an array, or a pytree of arrays."""

    @abc.abstractmethod
    def predict(self, seen: Any, run: Run) -> Array:
        """The measurement that a run predicts, in the shape of the data, NaN where it does not reach, from what
        `observe` returned at the start and after each step, with a leading axis."""

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        """Raise a `ValueError` if the data do not fit this scene and these prepared particles, until t1 [s]."""

    def explain(self, seen: Any, run: Run) -> None:
        """Raise a `ValueError` that says why a prediction is not finite, where it is not."""

    def part_until(self, t1: float) -> "AbstractObservation | None":
        """The part that was measured until a time [s]; None where there is none, or it is not known, as of a curve."""

    def __check_init__(self):
        require_fields(self)
        name = self.title
        measured = np.isfinite(self.data)
        require(not np.isinf(self.data).any(), f"{name} must have finite data, or NaN where nothing was measured.")
        require(measured.sum() > 0, f"{name} has no data: it needs a finite number at least.")
        sigma: Any = self.sigma
        for what, value in {"sigma": sigma, "weight": self.weight, "robust limit": self.robust}.items():
            if value is not None:
                require_positive(f"The {what} of {name}", value)
        fault = f"The sigma of {name} must fit its data of shape {self.data.shape}, got {np.shape(sigma)}."
        require(fits(sigma, self.data.shape), fault)

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

    @property
    def components(self) -> list[tuple[int, str]]:
        """Numbers and names of the components, in C order, of which anything was measured."""
        shape = self.data.shape[1:]
        measured = np.isfinite(self.data.reshape(len(self.data), -1)).any(axis=0)
        names = [list(map(str, range(n))) for n in shape]
        if shape and shape[-1] <= 3:
            names[-1] = list("xyz"[: shape[-1]])
        labels = self.shown.columns or tuple(", ".join(of) for of in itertools.product(*names))
        return [(k, labels[k]) for k in np.flatnonzero(measured).tolist()]

    def draw(self, axis: Any, predicted: Prediction, last: float) -> None:
        """Draw data, fit and bands in the data's units; the data that were fitted end at the abscissa `last`."""
        shown, (name, against) = self.shown, self.against
        order = np.argsort(against)
        x = shown.along(against[order])

        def columns(of: Any) -> np.ndarray:
            return np.broadcast_to(np.asarray(of, float), predicted.value.shape).reshape(len(x), -1)[order] / shown.unit

        data, model, lower, upper = map(columns, (self.data, predicted.value, predicted.lower, predicted.upper))
        level = f"{100 * predicted.level:g} %"
        says = {"measured": "measured", "fit": "fit", "mean": f"{level} of the mean"}
        says |= {"new": f"{level} of new measurements"}
        if len(self.components) > 1:  # a colour for each component, by its name, and grey for the rest
            axis.plot([], [], "o", color="0.4", markersize=3.5, label=says["measured"])
            axis.plot([], [], color="0.4", linewidth=1.2, label=says["fit"])
            axis.fill_between([], [], [], color="0.4", alpha=0.35, linewidth=0, label=says["mean"])
            says = {}
        for number, (k, label) in enumerate(self.components[:_MOST_LINES]):
            band: dict[str, Any] = {"color": f"C{number}", "linewidth": 0}
            if predicted.new_lower is not None:
                new = columns(predicted.new_lower)[:, k], columns(predicted.new_upper)[:, k]
                axis.fill_between(x, *new, alpha=0.12, label=says.get("new"), **band)
            axis.fill_between(x, lower[:, k], upper[:, k], alpha=0.35, label=says.get("mean"), **band)
            axis.plot(x, model[:, k], color=f"C{number}", linewidth=1.2, label=says.get("fit"))
            dots: dict[str, Any] = {"markersize": 3.5, "markeredgecolor": "white", "markeredgewidth": 0.5}
            axis.plot(x, data[:, k], "o", color=f"C{number}", label=says.get("measured", label), **dots)
        count = len(self.components)
        title = f"{_MOST_LINES} of {count} shown" if count > _MOST_LINES else None
        axis.legend(fontsize=7, frameon=False, title=title)
        if against.max() > last:
            axis.axvline(float(shown.along(np.array([last]))[0]), color="0.6", linewidth=0.8, linestyle="--")
            axis.set_title("fitted to the dashed line, predicted beyond", fontsize=9)
        axis.set(xlabel=shown.x or name, ylabel=shown.y or self.name)
        axis.spines[["top", "right"]].set_visible(False)

    def scale(self) -> float:
        """The size of the data, which stands for an unknown σ until it is estimated."""
        data = self.data[np.isfinite(self.data)]
        return float(np.ptp(data) or np.abs(data).max() or 1.0)

    def residuals(self, predicted: Array, sigma: Scalar | Array) -> Array:
        """√weight (predicted − data)/σ [-], shape (m,), by `drawn_nearer` if robust; zero where data are missing."""
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

    def residuals_of(self, seen: Any, run: Run, sigma: Scalar | Array) -> Array:
        """The residuals of a run of which it has seen the states; NaN where the run met a fault."""
        return jnp.where(run.statistics.healthy, self.residuals(self.predict(seen, run), sigma), jnp.nan)


def fits(sigma: Any, shape: tuple[int, ...]) -> bool:
    """Whether a noise, if there is one, broadcasts against data of a shape."""
    try:
        return np.broadcast_to(sigma, shape).shape == shape
    except ValueError:
        return False


def drawn_nearer(r: Array, limit: Scalar | Array) -> Array:
    """Residuals whose squares grow but linearly beyond a limit δ: r √(2/(1 + √(1 + r²/δ²))), half the square of which
    is the pseudo-Huber loss δ² (√(1 + r²/δ²) − 1)."""
    return r * jnp.sqrt(2 / (1 + jnp.sqrt(1 + (r / limit) ** 2)))


class Experiment(eqx.Module):
    """A scene as it was set up in the laboratory, and what was measured of it.

    Args:
        scene: the scene, with first guesses of what is fitted.
        particles: the particles at the start.
        t1: end time [s]: no later than the last measurement needs.
        dt: step [s].
        method: the integrator.
        observations: what was measured.
        name: what tables and pictures call it.

    Raises:
        ValueError: as `prepare`; a t1 that is not a whole number of steps; no observation, or one that does not fit the
            particles or lies outside the run.
    """

    scene: Scene
    particles: Particles
    method: AbstractIntegrator
    observations: tuple[AbstractObservation, ...]
    t1: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @checked
    def __init__(
        self,
        scene: Scene,
        particles: Particles,
        *,
        t1: Scalar,
        dt: Scalar,
        observations: AbstractObservation | tuple[AbstractObservation, ...] | list[AbstractObservation],
        method: AbstractIntegrator = Explicit(),
        name: str = "experiment",
    ):
        self.particles = prepare(scene, particles)
        self.scene, self.method = canonical((scene, method), particles.x.dtype)
        self.t1, self.dt, self.name = float(t1), float(dt), name
        self.observations = (observations,) if isinstance(observations, AbstractObservation) else tuple(observations)
        any_seen = len(self.observations) > 0
        require(any_seen, f"The experiment {name!r} needs an observation at least: what was measured.")
        number_of_steps(self.t1, self.dt, 0, particles.x.dtype)
        for observation in self.observations:
            observation.check(self.scene, self.particles, self.t1)

    @property
    def dtype(self) -> Any:
        """The precision of its particles."""
        return self.particles.x.dtype

    @property
    def steps(self) -> int:
        """Number of steps."""
        return number_of_steps(self.t1, self.dt, 0, self.dtype)

    def until(self, t1: float) -> "Experiment":
        """The experiment until the first step from a time [s] on, with the data that have times; itself without any."""
        parts = [o.part_until(t1) for o in self.observations]
        kept = tuple(part for part in parts if part is not None)
        steps = int(np.ceil(t1 / self.dt - _ON_A_STEP))
        if not kept or steps >= self.steps:
            return self
        return replace(self, observations=kept, t1=steps * self.dt)

    def run(self, *, adjoint: Any = None, throw: bool = True, checkpoint_bytes: int = 2**28) -> Run:
        """The simulation of it, with what its observations observe after each step (see `simulate`)."""
        how: dict[str, Any] = {"adjoint": adjoint, "checkpoint_bytes": checkpoint_bytes, "throw": throw}
        observe = eqx.Partial(observe_all, self.observations)
        return simulate(self.scene, self.particles, t1=self.t1, dt=self.dt, method=self.method, observe=observe, **how)

    def predictions(self, run: Run) -> tuple[Array, ...]:
        """Predictions of a run of it by each observation, in the shape of its data."""
        return tuple(o.predict(seen, run) for o, seen in zip(self.observations, run.observed, strict=True))


def observe_all(observations: tuple[AbstractObservation, ...], scene: Scene, particles: Particles) -> tuple[Any, ...]:
    """The parts of a state that all observations of an experiment need."""
    return tuple(observation.observe(scene, particles) for observation in observations)


_MOST_LINES = 6  # components of an observation that are drawn
_ON_A_STEP = 1e-6  # part of a step by which a time may lie after it and is on it
