"""Fits to growing horizons, each from where the last one ended."""

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Scalar
from mpmjax.analysis import sensitivity
from mpmjax.checks import checked, require, require_positive, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import chosen_optimiser, fit
from mpmjax.fitting._multistart import label_cells, value_cells
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult, restarted, table
from mpmjax.fitting._search import begin, iterate, jacobian, search
from mpmjax.fitting._series import Series


class Stage(NamedTuple):
    """A search with the data until one time."""

    horizon: float
    """The time [s]."""
    values: dict[str, np.ndarray]
    """The value of each parameter at its minimum, in its shape."""
    misfit: float
    """Root mean square of the residuals, in units of σ, or of the size of the data where σ is not given."""
    iterations: int


class StagedFit(AbstractFit):
    """A fit that came about in stages.

    `print(result)` shows a table; `result["E"]` is the estimate of a parameter by the last stage.
    """

    stages: tuple[Stage, ...]
    """The searches before the last, with growing horizons."""
    result: FitResult
    """The last fit, with its errors."""
    horizons: tuple[float, ...]
    """Until when the data of each experiment were used in the last fit [s]."""
    remarks: tuple[str, ...]
    """How the horizons were chosen, in words."""

    @property
    def all(self) -> tuple[Estimate, ...]:
        return self.result.all

    def __str__(self) -> str:
        """The remarks, a table of the stages, then that of the last fit."""
        head = f"{'until [s]':>24}", f"{'misfit/σ':>10}", *label_cells(self.result.problem)
        rows = [(f"{s.horizon:>24.4g}", f"{s.misfit:>10.4g}", *value_cells(s.values)) for s in self.stages]
        return "\n".join([*self.remarks, "", *table(head, *rows), "", str(self.result)])


@checked
def fit_staged(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    horizons: tuple[float, ...] | list[float] | None = None,
    growth: Scalar = 1e3,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> StagedFit:
    """Fit to the data until a first time, then until later ones, each from where the last search ended.

    For motions that repeat or that contacts decide, of which a fit to all data ends in a false minimum.

        result = mpm.fitting.fit_staged(swing, {"E": ...})
        print(result)  # how the horizons were chosen, the stages, the estimate

    *The first horizon*, where `horizons` does not give it, is the last time until which a change of one in any
    coordinate changes the data by no more than they change themselves, √Σ (∂y/∂z)² ≤ √Σ (y − y(0))², by the derivative
    at the first guess: of a vibration about half a period. Where that ratio does not grow with time, as of a drop
    under gravity, there is but one stage. Horizons then double.

    *The last horizon* is the experiment's end, or the time until which `sensitivity` is below `growth`: later data are
    left out, and a warning says so. It is measured again at each stage's values.

    The last stage is a `fit`. Those before it are searches alone: parameters that the data do not see yet stay where
    they are. Each stage compiles anew. What has no times, such as a `Curve`, counts in the last stage, or in all if its
    experiment has nothing else.

    Args:
        experiments: see `fit`. Horizons are times of each of them.
        parameters: see `fit`.
        horizons: growing times [s]; the end of the data is added. Default: by the rule above.
        growth: sensitivity [-] beyond which data are left out; infinite to use all.
        report, level: see `fit`.
        optimiser: the method of each search. Default: as `fit` chooses.
        progress: called with a line an iteration, and with what is said, such as `print`.

    Raises:
        ValueError: as `fit`; horizons that do not grow, or none of which has data.
        SimulationError: the simulation at the first guess meets a fault within the first horizon.
    """
    require(float(growth) > 0, f"growth must be positive, or infinite to use all data, got {growth}.")
    times = None if horizons is None else [float(t) for t in horizons]
    if times is not None:
        require(len(times) > 0, "horizons must hold a time at least; leave them out to have them chosen.")
        require_positive("horizons [s]", np.array(times))
        require(all(a < b for a, b in pairwise(times)), f"horizons must grow, got {times}.")
    problem = FitProblem(experiments, parameters)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    end = max(e.t1 for e in problem.experiments)
    remarks: list[str] = []

    def say(text: str) -> None:
        if progress is not None:
            progress(text)

    def remark(text: str) -> None:
        remarks.append(text)
        say(text)

    z = jnp.zeros(problem.size, problem.dtype)
    limits = _limits(problem.at(z), float(growth))
    if times is None:
        first = _first_horizon(_cut(problem, limits, end), optimiser, z)
        times = [first * 2.0**k for k in range(_MOST_STAGES) if first * 2.0**k < _NEARLY_ALL * end]
        remark(_FIRST.format(first, end) if times else _ONE_STAGE)
    stages: list[Stage] = []
    for horizon in times:
        cut = _cut(problem, limits, horizon)
        if [e.steps for e in cut.experiments] == [e.steps for e in _cut(problem, limits, end).experiments]:
            break
        minimum = search(cut, optimiser, z, cut.first_sigmas)
        if not np.isfinite(minimum.history[0].cost):
            cut.explain(z, f"What is observed of the simulation until {horizon:g} s is not finite.")
        if minimum.interrupted:
            raise KeyboardInterrupt
        z, misfit, count = minimum.z, cut.misfit(minimum.cost), len(minimum.history)
        stages.append(Stage(horizon, problem.by_name(z), misfit, count))
        say(f"until {horizon:.4g} s: misfit/σ {misfit:.4g}, {problem.shown(z)}, {count} iterations")
        limits = _limits(problem.at(z), float(growth))
    cut = _cut(problem, limits, end)
    for k, (whole, used, limit) in enumerate(zip(problem.experiments, cut.experiments, limits, strict=True)):
        if used.steps < whole.steps:
            remark(_SHORT.format(f"{whole.name!r} (number {k})", growth, limit, whole.t1))
            warn(remarks[-1])
    start = restarted(parameters, problem.by_name(z))
    result = fit(cut.experiments, start, report=report, level=level, optimiser=optimiser, progress=progress)
    return StagedFit(tuple(stages), result, tuple(e.t1 for e in cut.experiments), tuple(remarks))


def _cut(problem: FitProblem, limits: Sequence[float], horizon: float) -> FitProblem:
    """The problem of the data until a horizon, and the limit of each experiment."""
    each = zip(problem.experiments, limits, strict=True)
    return eqx.tree_at(lambda p: p.experiments, problem, tuple(e.until(min(horizon, limit)) for e, limit in each))


def _limits(experiments: Sequence[Experiment], growth: float) -> list[float]:
    """The time until which each has derivatives that grow no further [s]."""
    if np.isinf(growth):
        return [e.t1 for e in experiments]
    limits = []
    for e in experiments:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            grown = sensitivity(e.scene, e.particles, t1=e.t1, dt=e.dt, method=e.method)
        beyond = np.flatnonzero(~(np.asarray(grown.growth) <= growth))
        times = np.asarray(grown.times)
        limits.append(e.t1 if len(beyond) == 0 else float(times[max(beyond[0] - 1, 0)]))
    return limits


def _first_horizon(problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates) -> float:
    """The time until which the data are nearly linear in the coordinates [s], see `fit_staged`.

    Raises:
        SimulationError, ValueError: the simulation fails.
    """
    sigmas, start = problem.first_sigmas, z.astype(float)
    _, _, seen = iterate(problem, optimiser, start, sigmas, begin(problem, optimiser, start, sigmas))
    if not np.isfinite(seen.cost):
        problem.explain(z)
    J = np.asarray(jacobian(problem, z, sigmas)[1] if seen.jacobian is None else seen.jacobian, float)
    times, changes, motions = [], [], []
    for o, rows, sigma in zip(problem.observations, problem.rows, sigmas, strict=True):
        if isinstance(o, Series):
            times.append(o.times)
            changes.append((J[rows] ** 2).reshape(len(o.times), -1, problem.size).sum(axis=1))
            motions.append(np.asarray(o.weight) * _motion(o.data, np.asarray(sigma)))
    if not times:
        return max(e.t1 for e in problem.experiments)
    order = np.argsort(np.concatenate(times), kind="stable")
    t = np.concatenate(times)[order]
    change = np.cumsum(np.concatenate(changes)[order], axis=0)
    motion = np.cumsum(np.concatenate(motions)[order])
    usable = (motion > 0) & (np.arange(1, len(t) + 1) >= min(_LEAST_TIMES, len(t)))
    if not usable.any():
        return float(t[-1])
    t, ratio = t[usable], np.sqrt(change[usable] / motion[usable, None])
    bound = np.maximum(1, _GROWN * ratio.min(axis=0))
    return float(min(t[np.flatnonzero(column <= b)[-1]] for column, b in zip(ratio.T, bound, strict=True)))


def _motion(data: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Σ ((y − y(0))/σ)² at each time, y(0) the first that was measured of each number, shape (f,)."""
    rows = data.reshape(len(data), -1)
    seen = np.isfinite(rows)
    first = rows[seen.argmax(axis=0), np.arange(rows.shape[1])]
    spread = np.broadcast_to(sigma, data.shape).reshape(rows.shape)
    return (np.where(seen, (rows - first) / spread, 0) ** 2).sum(axis=1)


_FIRST = (
    "The first horizon is {0:.4g} s of {1:.4g} s: until then a change of one in a coordinate changes the data by no "
    "more than they change themselves. Horizons double from there."
)
_ONE_STAGE = (
    "One stage suffices: until the end of the data a change of one in a coordinate changes them by no more than they "
    "change themselves, or by as much at all times."
)
_SHORT = (
    "Of the experiment {0} data are used only until {2:.4g} s of {3:.4g} s: beyond, derivatives grow to more than "
    "{1:.3g} times those of free flight, or the simulation fails, and a fit would follow chance. Give windows of the "
    "later motion, each from an observed state, as experiments of their own."
)
_MOST_STAGES = 20
_NEARLY_ALL = 0.75
"""A horizon beyond this part of the end is the end."""
_LEAST_TIMES = 4
"""How many measured times the first horizon has, at least."""
_GROWN = 1.2
"""A ratio that grows by no more than this factor does not grow."""
