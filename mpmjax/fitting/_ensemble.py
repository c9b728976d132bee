"""Fits of many data sets of one experiment: repeated specimens, and data drawn anew."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc

from mpmjax._types import Float, Scalar
from mpmjax.checks import checked, require, require_whole, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import checked_level, chosen_optimiser, in_rounds
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult, fit_result, table
from mpmjax.fitting._search import Minimum, Problems, batch_size, search_many


class EnsembleFit(eqx.Module):
    """One fit for each data set.

    `print(result)` shows a table; `result.values["E"]` are the estimates of a parameter; `result.fits[3]` is one fit.
    """

    fits: tuple[FitResult | None, ...]
    """The fit of each data set; None where it failed."""
    failures: dict[int, str]
    """Why fits failed, by the number of the data set."""

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The estimates of each parameter, NaN where the fit failed, shape (k, ...)."""
        lost = {name: np.full(value.shape, np.nan) for name, value in self._done[0].values.items()}
        each = [lost if fit is None else fit.values for fit in self.fits]
        return {name: np.stack([values[name] for values in each]) for name in lost}

    @property
    def errors(self) -> np.ndarray:
        """The standard error of each estimate of the n numbers, NaN where the fit failed, shape (k, n)."""
        lost = [np.nan] * len(self._done[0].estimates)
        return np.array([lost if fit is None else [e.error for e in fit.estimates] for fit in self.fits])

    @property
    def alike(self) -> np.ndarray:
        """Probability of so large a spread of each number if all data sets had one value and the errors are right:
        Cochran's Q = Σ (z_k − z̄)²/s_k² of the values, of logarithms where none is at zero, χ² of k − 1 degrees of
        freedom (W. G. Cochran, Biometrics 10 (1954) 101, doi 10.2307/3001666), shape (n,)."""
        z, s, held = self._columns
        if len(z) < 2:
            return np.full(z.shape[1], np.nan)
        ratio = np.array(self._done[0].problem.logarithmic) & ~held.any(axis=0)
        z, s = np.where(ratio, np.log(np.where(ratio, z, 1)), z), s / np.where(ratio, z, 1)
        weight = 1 / s**2
        mean = (weight * z).sum(axis=0) / weight.sum(axis=0)
        return np.asarray(chdtrc(len(z) - 1, (weight * (z - mean) ** 2).sum(axis=0)))

    @property
    def _done(self) -> list[FitResult]:
        return [fit for fit in self.fits if fit is not None]

    @property
    def _columns(self) -> tuple[np.ndarray, ...]:
        """Values, errors, and whether they lie at a bound, each of shape (fits that did not fail, n)."""
        rows = [fit.estimates for fit in self._done]
        return tuple(np.array([[getattr(e, f) for e in row] for row in rows]) for f in ("value", "error", "at_bound"))

    def __str__(self) -> str:
        """A table: the mean and spread of each number over the data sets, and the errors of the fits."""
        (values, errors, held), alike = self._columns, self.alike
        spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
        rows = [
            (
                e.name,
                f"{values[:, k].mean():>12.6g}",
                f"{spread[k]:>10.2g}",
                f"{np.sqrt((errors[:, k] ** 2).mean()):>13.2g}",
                f"p = {alike[k]:.2g}" + (f", {held[:, k].sum()} at the bound" if held[:, k].any() else ""),
            )
            for k, e in enumerate(self._done[0].estimates)
        ]
        head = "", f"{'mean':>12}", f"{'spread':>10}", "error of one", "same value?"
        last = f"{len(values)} data sets" + (f", {len(self.failures)} failed" if self.failures else "")
        return "\n".join([*table(head, *rows), last])


@checked
def fit_ensemble(
    experiments: tuple[Any, ...] | list[Any],
    parameters: dict[str, AbstractParameter],
    *,
    batch: int | None = None,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> EnsembleFit:
    """Fit each of many data sets by itself, together in one compiled program: repeated specimens, for instance.

        specimens = [mpm.Experiment(scene, particles, ..., observations=tracks) for tracks in measured]
        result = mpm.fitting.fit_ensemble(specimens, {"E": ...})
        print(result)  # mean and spread of E, and whether the specimens differ by more than their errors
        result.values["E"]  # shape (number of specimens,)

    Each gets what `fit` says of it: the same estimates and errors. One that fails ends alone.

    Args:
        experiments: the data sets: an experiment each, or several experiments each that share the parameters. They may
            differ in every number (data, noise, places, velocities, materials), and in no shape, choice or function:
            give a marker that was not seen as NaN.
        parameters: see `fit`.
        batch: how many searches run together, see `fit_multistart`.
        report, level, optimiser: see `fit`.
        progress: called with a line, such as `print`, as searches end.

    Raises:
        ValueError: as `fit`; data sets of different shapes; no fit that did not fail.
    """
    require(len(experiments) > 0, "An ensemble needs a data set at least.")
    level = checked_level(level)
    sets = [
        (e,) if isinstance(e, Experiment) else tuple(e) if isinstance(e, (tuple, list)) else () for e in experiments
    ]
    for k, each in enumerate(sets):
        usable = len(each) > 0 and all(isinstance(e, Experiment) for e in each)
        require(usable, f"Data set {k} must be an Experiment, or a tuple of some, got {type(experiments[k]).__name__}.")
    problems = [FitProblem(each, parameters) for each in sets]
    optimiser = chosen_optimiser(problems[0]) if optimiser is None else optimiser
    stacked, size = Problems.of(problems), batch_size(problems[0], batch, len(problems))

    def minimise(round_: int, numbers: list[int], starts: list[Any], sigmas: list[Any]) -> list[Minimum | str]:
        def say(done: int, count: int) -> None:
            if progress is not None:
                progress(f"round {round_ + 1}: {done} of {count} fits are done")

        z, noise = np.array(starts, float), Problems.of(sigmas)
        members = search_many(stacked.only(numbers), optimiser, z, sigmas=noise, batch=size, progress=say)
        return [m.failure if m.minimum is None else m.minimum for m in members]

    outcomes = in_rounds(problems, [p.first_sigmas for p in problems], minimise)
    reported = dict(report or {})
    fits = [
        end if isinstance(end, str) else fit_result(problem, optimiser, *end, reported, level)
        for problem, end in zip(problems, outcomes, strict=True)
    ]
    failures = {k: fit for k, fit in enumerate(fits) if isinstance(fit, str)}
    if len(failures) == len(fits):
        z = jnp.zeros(problems[0].size, problems[0].dtype)
        problems[0].explain(z, failure=f"None of {len(fits)} fits succeeded: {failures[0]}.")
    if failures:
        shown = "; ".join(f"number {k}: {why}" for k, why in list(failures.items())[:3])
        warn(f"{len(failures)} of {len(fits)} data sets could not be fitted: {shown}.")
    lost = [k for k, fit in enumerate(fits) if isinstance(fit, FitResult) and not fit.converged]
    if lost:
        warn(f"{len(lost)} of {len(fits)} fits did not converge, the first number {lost[0]}: raise max_steps.")
    return EnsembleFit(tuple(fit if isinstance(fit, FitResult) else None for fit in fits), failures)


class Bootstrap(AbstractFit):
    """The estimates of fits of data drawn anew.

    `print(result)` shows a table; `result["E"].interval` is a percentile interval.
    """

    estimates: tuple[Estimate, ...]
    """The fitted numbers: values of the fit of what was measured, errors and percentile intervals of the samples."""
    samples: Float[np.ndarray, "k n"]
    """Their values in each fit that did not fail, shape (k, n)."""
    level: float
    """The level of the intervals [-]."""
    failed: int
    """How many fits failed, or came to no minimum."""

    @property
    def all(self) -> tuple[Estimate, ...]:
        return self.estimates

    def __str__(self) -> str:
        """A table."""
        head = "", f"{'value':>12} ± {'error':<9}", f"{100 * self.level:g} % interval"
        last = f"{len(self.samples)} fits of data drawn anew" + (f", {self.failed} failed" if self.failed else "")
        return "\n".join([*table(head, *((e.name, *e.cells) for e in self.estimates)), last])


@checked
def bootstrap(
    result: FitResult,
    *,
    repeats: int = 200,
    seed: int = 0,
    batch: int | None = None,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> Bootstrap:
    """Errors and intervals of a fit without linearisation: the fitted simulation's data with new normal noise of the
    fit's σ, fitted again, many times (the parametric bootstrap: B. Efron, R. J. Tibshirani, An Introduction to the
    Bootstrap, Chapman & Hall 1993, chapters 6.5 and 13).

        print(mpm.fitting.bootstrap(mpm.fit(pull, {"E": ...})))

    It takes the model and the independence of the noise for granted, as the errors of `fit` do: what it adds is the
    curvature of the model and what bounds do. `weight` and `robust` act in each fit; the noise drawn is of σ for each
    number. A prior's mean is drawn anew too. Two hundred repeats fix a standard error to 5 %, and a 95 % interval
    less well.

    Args:
        result: the fit.
        repeats: how many fits.
        seed: of the noise.
        batch: how many fits run together, see `fit_multistart`.
        optimiser: the method of each. Default: that of the fit.
        progress: called with a line, such as `print`, as fits end.

    Raises:
        ValueError: fewer than two repeats; fewer than two fits that succeeded.
    """
    require_whole("repeats", repeats, 2)
    rng = np.random.default_rng(require_whole("seed", seed, 0))
    problem, z = result.problem, jnp.asarray(result.z, result.problem.dtype)
    predicted = [np.asarray(y, float) for e in problem.at(z) for y in e.predictions(e.run())]
    problems = [_drawn(problem, predicted, result.sigmas, rng) for _ in range(repeats)]

    def say(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} fits are done")

    members = search_many(
        Problems.of(problems),
        result.optimiser if optimiser is None else optimiser,
        np.repeat(np.asarray(result.z, float)[None], repeats, axis=0),
        sigmas=Problems.of([result.sigmas]),
        batch=batch_size(problem, batch, repeats),
        progress=say,
    )
    ends = [m.minimum.z for m in members if m.minimum is not None and m.minimum.converged]
    require(len(ends) > 1, f"Of {repeats} fits of data drawn anew {len(ends)} came to a minimum: raise max_steps.")
    if len(ends) < repeats:
        warn(
            f"{repeats - len(ends)} of {repeats} fits of data drawn anew came to no minimum: intervals leave them out."
        )
    samples = np.array([problem.numbers(end) for end in ends])
    lower, upper = np.quantile(samples, [(1 - result.level) / 2, (1 + result.level) / 2], axis=0).tolist()
    errors = samples.std(axis=0, ddof=1).tolist()
    each = zip(result.estimates, errors, lower, upper, strict=True)
    estimates = tuple(e._replace(error=error, interval=(a, b)) for e, error, a, b in each)
    return Bootstrap(estimates, samples, result.level, repeats - len(ends))


def _drawn(problem: FitProblem, predicted: list[np.ndarray], sigmas: tuple, rng: np.random.Generator) -> FitProblem:
    """The problem with data of its simulation and new noise, NaN where nothing was measured."""
    drawn = []
    for observation, y, sigma in zip(problem.observations, predicted, sigmas, strict=True):
        noisy = y + np.asarray(sigma) * rng.normal(size=y.shape)
        drawn.append(np.where(np.isfinite(observation.data), noisy, np.nan))
    problem = eqx.tree_at(lambda p: [o.data for o in p.observations], problem, drawn)
    priors = [p.prior.drawn(rng) for p in problem.parameters if p.prior is not None]
    return eqx.tree_at(lambda q: [p.prior for p in q.parameters if p.prior is not None], problem, priors)
