"""Results of fits: estimates with their errors, and the table that shows them."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.checks import require
from mpmjax.fitting._estimate import (
    IMPROBABLE,
    VALUE,
    AbstractFit,
    Estimate,
    NoiseEstimate,
    improbable,
    shape_of,
    strongest_mode,
    table,
)
from mpmjax.fitting._evaluation import CoarseGrid, unexplained
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._search import AbstractOptimiser, Iteration, Search
from mpmjax.fitting._starts import Screening
from mpmjax.fitting._uncertainty import (
    Prediction,
    Uncertainty,
    at_bound,
    banded,
    noise,
    quantile,
    seen_together,
    uncertainty,
)
from mpmjax.simulation import Run, warn_of_inaccuracy
from mpmjax.state import warn_of_rounding


class FitResult(AbstractFit):
    """Fitted parameters, their errors, and the fitted scene."""

    problem: FitProblem  # the residuals that were made small, with the noise given or estimated
    z: np.ndarray  # the coordinates at the minimum [-], shape (n,)
    residuals: np.ndarray  # residuals of all observations, then of priors, in units of their noise [-], shape (m,)
    jacobian: np.ndarray  # their derivative by the coordinates, shape (m, n)
    uncertainty: Uncertainty  # covariance, correlation, Fisher spectrum and its directions
    estimates: tuple[Estimate, ...]  # the fitted numbers, one for each entry of each parameter
    reported: tuple[Estimate, ...]  # the estimates that `report` asked for
    chi_squared: float  # Σ r², priors included
    degrees_of_freedom: int  # measured numbers and priors, less parameters
    noise: tuple[NoiseEstimate, ...]  # the noise of each observation
    experiments: tuple[Experiment, ...]  # the experiments with the fitted values
    runs: tuple[Run, ...]  # their runs, without what was observed, where the search made them; else empty
    level: float  # the level of the intervals [-], such as 0.95
    optimiser: AbstractOptimiser  # the method of the search
    converged: bool  # whether the search met its tolerance
    history: tuple[Iteration, ...]  # the iterations of the search
    warnings: tuple[str, ...]  # directions that the data do not see, and a misfit beyond the noise, in words
    interrupted: bool = False  # whether Ctrl-C ended it
    moved: np.ndarray | str | None = None  # how far z moves on twice the spacing, then step, shape (2, n); or why not
    screening: Screening | None = None  # the other points from which the minimum was searched, if it was
    remarks: tuple[str, ...] = ()  # how its start was come by, in words

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The value of each parameter, in its shape."""
        return self.problem.by_name(jnp.asarray(self.z, self.problem.dtype))

    @property
    def all(self) -> tuple[Estimate, ...]:
        return (*self.estimates, *self.reported)

    @property
    def is_beyond(self) -> bool:
        """Whether the misfit of an observation is beyond its noise."""
        return any(noise.is_beyond for noise in self.noise)

    @property
    def fitted(self) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """The fit's value of each observation where it was measured, NaN elsewhere, in the shape and unit of its
        data, and its derivative by the coordinates, shape (..., n), from the residuals."""
        values, derivatives = [], []
        observations = [o for e in self.experiments for o in e.observations]
        for o, sigma, rows in zip(observations, self.problem.sigmas, self.problem.rows, strict=True):
            weight, limit = o.trust
            r, J = self.residuals[rows] / np.sqrt(weight), self.jacobian[rows] / np.sqrt(weight)
            if limit is not None:  # the inverse of `drawn_nearer`
                s = (r / limit) ** 2 / 4
                r, J = r * np.sqrt(1 + s), J * ((1 + 2 * s) / np.sqrt(1 + s))[:, None]
            scale = np.broadcast_to(np.asarray(sigma, float), o.data.shape)
            values.append(o.data + scale * r.reshape(o.data.shape))
            derivatives.append(scale[..., None] * J.reshape(*o.data.shape, -1))
        return values, derivatives

    def plot(
        self, axes: Any = None, *, measured: Sequence[Experiment] = (), predictions: Sequence[Prediction] = ()
    ) -> tuple[Any, ...]:
        """Draw what was measured, the fit, and the confidence band of its mean, in the data's units.

        Args:
            axes: matplotlib's axes to draw into, one for each observation. Default: those of a new figure.
            measured: the experiments with more data than were fitted; `predictions` are then needed.
            predictions: those of `predict_observations`, with bands of new measurements. Default: the fit's own.

        Returns:
            The axes: `result.plot()[0].figure.savefig("fit.pdf")`.

        Raises:
            ValueError: not as many axes, or predictions, as observations.
        """
        observations = [o for e in measured or self.experiments for o in e.observations]
        fitted = [float(o.against[1].max()) for e in self.experiments for o in e.observations]
        if not predictions:
            each = zip(*self.fitted, strict=True)
            predictions = [banded(self.uncertainty, self.level, value, J) for value, J in each]
        count = len(observations)
        if axes is None:
            from matplotlib import pyplot as plt  # here, since it takes a second that only pictures should pay

            axes = plt.subplots(count, 1, figsize=(5.4, 3.4 * count), layout="constrained", squeeze=False)[1]
        axes = tuple(np.ravel(np.asarray(axes, dtype=object)))
        fault = f"{len(axes)} axes and {len(predictions)} predictions for {count}"
        fits = len(axes) == len(predictions) == count
        require(fits, f"plot takes axes and a prediction for each observation, got {fault}.")
        for axis, observation, predicted, last in zip(axes, observations, predictions, fitted, strict=True):
            observation.draw(axis, predicted, last)
        return axes

    def restarted(self, parameters: Mapping[str, AbstractParameter]) -> dict[str, AbstractParameter]:
        """The parameters, to be searched from the fitted values."""
        return {name: replace(p, start=self.values[name]) for name, p in parameters.items()}

    def warn_of_runs(self) -> None:
        """Give the warnings of the fitted experiments' runs, which give none while they are searched for."""
        for run, experiment in zip(self.runs, self.experiments, strict=False):
            warn_of_rounding(experiment.scene.grid, run.final.x, experiment.particles.x)
            warn_of_inaccuracy(run)
        for experiment in self.experiments[len(self.runs) :]:
            experiment.run()

    @property
    def scene(self) -> Any:
        """The fitted scene of the first experiment, ready to run."""
        return self.experiments[0].scene

    @property
    def p_value(self) -> float:
        """The probability of so large a χ² by the noise given alone; NaN if any is estimated, robust or weighted."""
        plain = all(o.trust == (1.0, None) for e in self.experiments for o in e.observations)
        if not plain or any(noise.estimated for noise in self.noise) or self.degrees_of_freedom < 1:
            return np.nan
        from scipy.special import chdtrc  # here, since it takes long to import

        return float(chdtrc(self.degrees_of_freedom, self.chi_squared))

    def __str__(self) -> str:
        """A table of the estimates, one of the noise, and what is to be said of them."""
        left, rows, many = iter(self.estimates), [], []
        for name, start in zip(self.problem.names, self.problem.starts, strict=True):
            each = list(itertools.islice(left, start.size))
            if start.size <= _MOST_ROWS:
                rows += each
                continue
            of_all = (([e.value for e in each], 4), ([e.error for e in each], 2))
            value, error = (f"{min(a):.{n}g} to {max(a):.{n}g}, median {np.median(a):.{n}g}" for a, n in of_all)
            what = each[0]._replace(label=name).name
            many.append(f"{what:<24} {' x '.join(map(str, start.shape))} numbers, {value}; errors {error}")
        widened = any(e.interval != e.noise_interval for e in self.all)
        alone = ["by noise alone"] if widened else []
        head = "", VALUE.format("value"), f"{100 * self.level:g} % interval", *alone, f"{'start':>10}", ""
        first, *body = table(head, *(e.row(widened) for e in (*rows, *self.reported)))
        shapes = any(n.shape for n in self.noise)
        noise = table(
            ("", f"{'numbers':>12}", "noise σ", "misfit/σ", "residuals" if shapes else ""), *(n.row for n in self.noise)
        )
        chi = f"χ² = {self.chi_squared:.4g} for {self.degrees_of_freedom} degrees of freedom"
        chi += "" if np.isnan(self.p_value) else f", probability {self.p_value:.2g}"
        who = f"found by {type(self.optimiser).__name__} in {len(self.history)} iterations"
        lost = [] if self.converged else ["NOT CONVERGED: errors hold only at a minimum."]
        if isinstance(self.moved, np.ndarray):
            spacing, both = (self.problem.shown(place) for place in self.z + np.cumsum(self.moved, axis=0))
            lost += [f"on twice the spacing: {spacing}", f"and with twice the step: {both}"]
        looked = [] if self.screening is None else ["", str(self.screening)]
        before = [*self.remarks, ""] if self.remarks else []
        return "\n".join([*before, first, *many, *body, "", *noise, "", chi, who, *lost, *self.warnings, *looked])


Noise = list[tuple[Array, float, float]]
"""The noise of each observation, in its data's unit, by how much it is larger than in the search, and the degrees of
freedom of the estimate, zero where it is given."""
Both = tuple[Uncertainty, Uncertainty]  # by the noise and what the misfit shows, and by the noise alone


class Minimum(NamedTuple):
    """Where a search ended, and the noise by its residuals."""

    problem: FitProblem  # with the noise that it was searched with
    search: Search
    noise: Noise | None  # None where the search failed
    moves: bool  # whether that noise moves the minimum


def minimum_of(problem: FitProblem, search: Search) -> Minimum:
    """The noise by the residuals where a search of a problem ended."""
    if search.failure:
        return Minimum(problem, search, None, moves=False)
    r, J = np.asarray(search.seen.residuals), np.asarray(search.seen.jacobian)
    J = J[:, ~at_bound(r, J, np.asarray(problem.room(search.z)))]  # what a bound holds fits nothing away
    settled, changing = [], False
    for observation, rows, sigma in zip(problem.observations, problem.rows, problem.sigmas, strict=True):
        is_given = observation.sigma is not None
        factor, freedom = (1.0, 0.0) if is_given else noise(r, J, rows, observation.count, *observation.trust)
        require(
            np.isfinite(factor),
            f"The noise of {observation.name!r} cannot be estimated from its {observation.count} numbers: the "
            "parameters use all of them up. Give its sigma.",
        )
        floor = _LEAST * observation.scale() / float(np.asarray(sigma).max())
        factor = max(factor, floor)
        settled.append((jnp.asarray(np.asarray(sigma) * factor, sigma.dtype), factor, freedom))
        changing |= abs(factor - 1) > _NOISE_RTOL and factor > floor
    # Another noise of one observation, of squares alone and without priors, does not move the minimum.
    one = len(settled) == 1 and problem.observations[0].robust is None
    moves = changing and not (one and all(p.prior is None for p in problem.parameters))
    return Minimum(problem, search, settled, moves)


def fit_result(
    minimum: Minimum,
    optimiser: AbstractOptimiser,
    report: Mapping[str, Callable[[Experiment], Any]],
    level: float,
    coarse: CoarseGrid | str | None = None,
) -> FitResult | None:
    """The result at a minimum, None where the search failed; options as of `fit` and its result."""
    problem, end, settled, _ = minimum
    if settled is None:
        return None
    r, J = np.array(end.seen.residuals, float), np.array(end.seen.jacobian, float)
    for rows, (_, factor, _) in zip(problem.rows, settled, strict=True):
        r[rows], J[rows] = r[rows] / factor, J[rows] / factor
    z, eps, rest = end.z, float(jnp.finfo(problem.dtype).eps), unexplained(r, J, coarse)
    moved = coarse.moved if isinstance(coarse, CoarseGrid) else coarse
    judged = (_judged(problem, k, settled, r, J, rest) for k in range(len(settled)))
    noises, of_noise, of_misfit = zip(*judged, strict=True)

    held, gradient = at_bound(r, J, np.asarray(problem.room(z))), J.T @ r
    off = [moved] if isinstance(moved, np.ndarray) else []
    if not end.converged:
        off.append(uncertainty(J * ~held, eps, ()).inverse @ gradient)
    errors = uncertainty(J, eps, of_misfit, np.vstack(off) if off else None)
    both = errors, uncertainty(J, eps, of_noise)
    result = FitResult(
        problem=problem.with_noise(tuple(sigma for sigma, *_ in settled)),
        z=np.asarray(z),
        residuals=r,
        jacobian=J,
        uncertainty=errors,
        estimates=_estimates(problem, z, held, gradient * held, both, level),
        reported=tuple(
            _reported(name, lambda z, of=of: jnp.asarray(of(problem.at(z)[0])), z, both, level)
            for name, of in report.items()
        ),
        chi_squared=float((r**2).sum()),
        degrees_of_freedom=problem.points + len(r) - problem.measured - errors.rank + int(held.sum()),
        noise=noises,
        experiments=problem.at(z),
        runs=end.seen.runs,
        level=level,
        optimiser=optimiser,
        converged=end.converged,
        history=end.history,
        warnings=(),
        interrupted=end.interrupted,
        moved=moved,
    )

    texts = seen_together(problem.labels, errors, problem.logarithmic)
    if isinstance(moved, str):
        texts.append(f"On twice the spacing nothing is known, so that errors hold nothing of the grid: {moved}")
    if not end.converged and optimiser.has_stalled(end.inner):
        texts.append(
            "The search ended at a kink of the misfit, as where friction begins to stick, or where simulations fail "
            "beyond: errors hold the step that it left undone."
        )
    if result.p_value < IMPROBABLE:
        share = 1 - (rest @ rest) / (r @ r)
        alike = f", of whose square twice the spacing explains {share:.0%}" if isinstance(coarse, CoarseGrid) else ""
        texts.append(
            f"The misfit is {np.sqrt(result.chi_squared / result.degrees_of_freedom):.2g} times the noise given"
            f"{alike}: the model or its discretisation does not explain the data. Errors hold it."
        )
    for n in noises:
        if n.shape:
            worth = f"{n.points} numbers are worth {n.worth:.2g} independent ones"
            texts.append(f"The residuals of {n.name!r} {_SHAPES[n.shape]}. Errors are larger as {worth}.")
    return replace(result, warnings=tuple(texts))


def _judged(
    problem: FitProblem, k: int, settled: Noise, r: np.ndarray, J: np.ndarray, rest: np.ndarray
) -> tuple[NoiseEstimate, tuple[slice, float, float], tuple[slice, float, float]]:
    """The noise of observation k by residuals r, of which twice the spacing leaves the `rest`, and what `uncertainty`
    takes of it: by the noise alone, and by what the misfit shows."""
    observation, rows, is_given = problem.observations[k], problem.rows[k], problem.observations[k].sigma is not None
    (sigma, _, freedom), weight, count = settled[k], observation.trust[0], observation.count
    size, squares = float(np.sqrt((np.asarray(sigma) ** 2).mean())), (r[rows] ** 2).sum()
    misfit = float(np.sqrt(squares / max(count, 1)))
    ratio, left = noise(r, J, rows, count, *observation.trust)
    plain = is_given and observation.trust == (1.0, None)
    missed = plain and improbable(squares, left)
    freedom, factor, kind, wider, strongest = np.inf if is_given else freedom, 1.0, "", 1.0, 0.0
    # What is left of exact data is the search's and rounding's.
    exact = max(_EXACT, _ROUNDINGS * float(jnp.finfo(problem.dtype).eps))
    if misfit * size > exact * observation.scale() and np.isfinite(ratio):
        order = np.argsort(observation.against[1])
        factor, kind = shape_of(r[rows].reshape(len(order), -1)[order])
        if plain or (kind and not is_given):
            strongest = weight * strongest_mode(rest[rows].reshape(len(order), -1) / np.sqrt(weight))
        wider = max(weight * factor * min(ratio, 1) ** 2, strongest, 1.0)  # noise alone has the variance `weight`
        factor, kind = (factor, kind) if wider > 1 else (1.0, "")
    beyond = missed or bool(kind and not is_given)
    estimate = NoiseEstimate(observation.name, size, not is_given, misfit, count, count / factor, kind, beyond)
    # The strongest mode is a discrepancy's size, no variance that is known from few numbers.
    few = freedom if wider in (1, strongest) else max(left / factor, _LEAST_FREEDOM)
    return estimate, (rows, 1.0, freedom), (rows, wider, few)


def _estimates(
    problem: FitProblem, z: Coordinates, held: np.ndarray, gradient: np.ndarray, both: Both, level: float
) -> tuple[Estimate, ...]:
    """The fitted numbers; the gradient of half the misfit is zero but of what a bound has `held`."""
    errors, noise_alone = both
    seen = np.isfinite(errors.error)
    wider = np.where(seen, errors.error, 1) / np.where(seen, noise_alone.error, 1)
    (lower, upper), alone = (
        intervals(problem, z, each, gradient / by**2, level) for each, by in ((errors, wider), (noise_alone, 1.0))
    )
    # Few degrees of freedom of the noise are more beside what the grid adds: an interval is never the narrower for it.
    widest = np.minimum(lower, alone[0]), np.maximum(upper, alone[1])
    size = np.abs(np.asarray(jax.jvp(problem.numbers, (z,), (jnp.ones_like(z),))[1], float))
    by = size * errors.error, size * noise_alone.error
    numbers = np.array([problem.numbers(z), problem.numbers(jnp.zeros_like(z)), *by, *widest, *alone], float).T.tolist()
    return tuple(
        Estimate(label, value, error, (a, b), owner.unit, start, bound, of_noise, (c, d))
        for label, owner, bound, (value, start, error, of_noise, a, b, c, d) in zip(
            problem.labels, problem.owners, held.tolist(), numbers, strict=True
        )
    )


def _reported(name: str, value: Callable[[Coordinates], Array], z: Coordinates, both: Both, level: float) -> Estimate:
    """A number that follows from the fitted ones."""
    number, start, along = float(value(z)), float(value(jnp.zeros_like(z))), jax.jacfwd(value)(z)
    whole, alone = (banded(each, level, number, along) for each in both)
    ends = float(min(whole.lower, alone.lower)), float(max(whole.upper, alone.upper))
    by_noise = float(alone.error), (float(alone.lower), float(alone.upper))
    return Estimate(name, number, float(whole.error), ends, "", start, False, *by_noise)


def intervals(
    problem: FitProblem, z: Coordinates, errors: Uncertainty, gradient: np.ndarray, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends of the fitted numbers' intervals, each of shape (n,).

    They are where Δχ² = 2 g δ + δ²/s² reaches its threshold q², δ of the coordinate, s the standard error and g the
    gradient, zero but of what a bound holds. Beside a bound, at three times the reach or nearer, each end is the
    farther of two, of the coordinate and of a straight line in the value, or the truth would be missed too often. Where
    that line meets the bound, it alone makes the interval, which ends there.
    """
    error, freedom = errors.of(np.eye(problem.size))
    q = quantile(level, freedom)
    pull = np.where(np.isfinite(error), gradient, 0) * np.where(np.isfinite(error), error, 1)
    root = np.hypot(pull, q)
    down, up = np.asarray(problem.room(z), float)
    below, above = error * (root + pull), error * q**2 / (root + pull)
    at, slope = (np.asarray(a, float) for a in jax.jvp(problem.numbers, (z,), (jnp.ones_like(z),)))
    straight = at - slope * np.minimum(below, down), at + slope * np.minimum(above, up)
    curved = (problem.numbers(jnp.asarray(np.asarray(z) + side * q * error, z.dtype)) for side in (-1, 1))
    meets, near = ((times * below >= down) | (times * above >= up) for times in (1, _BESIDE))
    lower, upper = (
        np.where(meets, line, np.where(near, farther(line, curve), curve))
        for line, curve, farther in zip(straight, np.array(list(curved), float), (np.minimum, np.maximum), strict=True)
    )
    ends = np.array([p.domain for p in problem.owners]).T
    return np.clip(lower, *ends), np.clip(upper, *ends)


_MOST_ROWS = 12  # numbers of one parameter up to which each has a row of the table
_SHAPES = {
    "a ramp": "show a ramp: look at the drift and the zero of what measured, and at loads and the start of the run",
    "drifts": "drift: look at law and damping, for another minimum, and at what was taken as known and may be fitted: "
    "place and friction of a wall, velocity at the start, scale of a picture",
    "correlated": "are correlated: look at their picture, for a motion that law or grid miss, or smoothed data",
}
_EXACT = 1e-6  # misfit, in sizes of the data, below which data are exact
_ROUNDINGS = 100  # the same in roundings
_LEAST_FREEDOM = 4.0  # of a misfit: the factor errs to the safe side, and fewer would widen intervals more
_BESIDE = 3  # reaches of an interval within which it is beside a bound
_NOISE_RTOL = 1e-3  # the noise of several observations is settled when its estimate changes less, relatively
_LEAST = 1e-12  # smallest noise, in sizes of the data: exact data have none
