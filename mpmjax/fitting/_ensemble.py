"""Fits of many data sets of one experiment: repeated specimens, and data drawn anew."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc

from mpmjax._types import Scalar
from mpmjax.checks import checked, require, warn
from mpmjax.fitting._batch import Problems, batch_size, search_many
from mpmjax.fitting._choice import chosen_optimiser
from mpmjax.fitting._estimates import fit_result, settle_noise
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import MOST_ROUNDS, explain
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import FitResult
from mpmjax.fitting._search import Iteration


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
        first = self._found[0]
        names = {name: np.full(value.shape, np.nan) for name, value in first.values.items()}
        each = [names if fit is None else fit.values for fit in self.fits]
        return {name: np.stack([values[name] for values in each]) for name in names}

    @property
    def errors(self) -> np.ndarray:
        """The standard error of each estimate of the n numbers, NaN where the fit failed, shape (k, n)."""
        lost = [np.nan] * len(self._found[0].estimates)
        return np.array([lost if fit is None else [e.error for e in fit.estimates] for fit in self.fits])

    @property
    def alike(self) -> np.ndarray:
        """Of each number, the probability of so large a spread if all data sets had one value and the errors are right:
        Cochran's Q = Σ (z_k − z̄)²/s_k² of the values, of logarithms where none is at zero, χ² of k − 1 degrees of
        freedom (W. G. Cochran, Biometrics 10 (1954) 101, doi 10.2307/3001666), shape (n,)."""
        found, first = [fit.estimates for fit in self._found], self._found[0].problem
        z, s, held = (
            np.array([[getattr(e, name) for e in each] for each in found]) for name in ("value", "error", "at_bound")
        )
        if len(z) < 2:
            return np.full(z.shape[1], np.nan)
        ratio = np.array(first.logarithmic) & ~held.any(axis=0)
        z, s = np.where(ratio, np.log(np.where(ratio, z, 1)), z), s / np.where(ratio, z, 1)
        weight = 1 / s**2
        mean = (weight * z).sum(axis=0) / weight.sum(axis=0)
        return np.asarray(chdtrc(len(z) - 1, (weight * (z - mean) ** 2).sum(axis=0)))

    @property
    def _found(self) -> list[FitResult]:
        return [fit for fit in self.fits if fit is not None]

    def __str__(self) -> str:
        """A table: of each number the mean and spread over the data sets, and what errors the fits have."""
        found = self._found
        lines = [f"{'':<24} {'mean':>12} {'spread':>10} {'error of one':>13}  same value?"]
        values = np.array([[e.value for e in fit.estimates] for fit in found])
        errors = np.array([[e.error for e in fit.estimates] for fit in found])
        held = np.sum([[e.at_bound for e in fit.estimates] for fit in found], axis=0)
        for k, e in enumerate(found[0].estimates):
            name = f"{e.label} [{e.unit}]" if e.unit else e.label
            spread = values[:, k].std(ddof=1) if len(found) > 1 else np.nan
            error = np.sqrt((errors[:, k] ** 2).mean())
            alike = f"p = {self.alike[k]:.2g}" + (f", {held[k]} at the bound" if held[k] else "")
            lines.append(f"{name:<24} {values[:, k].mean():>12.6g} {spread:>10.2g} {error:>13.2g}  {alike}")
        lines.append(f"{len(found)} data sets" + (f", {len(self.failures)} failed" if self.failures else ""))
        return "\n".join(lines)


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
        found = mpm.fit_ensemble(specimens, {"E": ...})
        print(found)  # mean and spread of E, and whether the specimens differ by more than their errors
        found.values["E"]  # shape (number of specimens,)

    Each gets what `fit` says of it: the same estimates and errors. One that fails ends alone.

    Args:
        experiments: the data sets: an experiment each, or several experiments each that share the parameters. They may
            differ in every number (data, noise, places, velocities, materials), and in no shape, choice or function:
            give a marker that was not seen as NaN.
        parameters: see `fit`.
        batch: how many searches run together, see `fit_multistart`.
        report: see `fit`.
        level: see `fit`.
        optimiser: see `fit`.
        progress: called with a line, such as `print`, as searches end.

    Raises:
        ValueError: as `fit`; data sets of different shapes; no fit that did not fail.
    """
    require(len(experiments) > 0, "An ensemble needs a data set at least.")
    require((level > 0) & (level < 1), f"level must lie between 0 and 1, got {level}.")
    sets = [
        (e,) if isinstance(e, Experiment) else tuple(e) if isinstance(e, (tuple, list)) else () for e in experiments
    ]
    for k, own in enumerate(sets):
        known = len(own) > 0 and all(isinstance(e, Experiment) for e in own)
        require(known, f"Data set {k} must be an Experiment, or a tuple of some, got {type(experiments[k]).__name__}.")
    problems = [FitProblem(own, parameters) for own in sets]
    optimiser = chosen_optimiser(problems[0]) if optimiser is None else optimiser
    fits = _fit_each(problems, optimiser, batch, dict(report or {}), float(level), progress)
    failures = {k: fit for k, fit in enumerate(fits) if isinstance(fit, str)}
    if len(failures) == len(fits):
        explain(problems[0], jnp.zeros(problems[0].size, problems[0].dtype))
        raise ValueError(f"None of {len(fits)} fits succeeded: {failures[0]}.")
    if failures:
        shown = "; ".join(f"number {k}: {why}" for k, why in list(failures.items())[:3])
        warn(f"{len(failures)} of {len(fits)} data sets could not be fitted: {shown}.")
    lost = [k for k, fit in enumerate(fits) if isinstance(fit, FitResult) and not fit.converged]
    if lost:
        warn(f"{len(lost)} of {len(fits)} fits did not converge, the first number {lost[0]}: raise max_steps.")
    return EnsembleFit(tuple(fit if isinstance(fit, FitResult) else None for fit in fits), failures)


def _fit_each(
    problems: list[FitProblem],
    optimiser: AbstractOptimiser,
    batch: int | None,
    report: dict[str, Callable[[Experiment], Any]],
    level: float,
    progress: Callable[[str], None] | None,
) -> list[FitResult | str]:
    """The fit of each, or why it failed; in rounds, as long as the noise of some changes."""
    stacked, n = Problems.of(problems, shared=False), problems[0].size
    batch = batch_size(problems[0], batch, len(problems))
    sigmas = [p.first_sigmas for p in problems]
    starts = np.zeros((len(problems), n))
    history: list[tuple[Iteration, ...]] = [()] * len(problems)
    fits: list[FitResult | str] = [""] * len(problems)
    left = list(range(len(problems)))
    for round_ in range(MOST_ROUNDS):

        def say(done: int, count: int, number: int = round_) -> None:
            if progress is not None:
                progress(f"round {number + 1}: {done} of {count} fits are done")

        members = search_many(
            stacked.only(left),
            optimiser,
            starts[left],
            sigmas=Problems.of([sigmas[k] for k in left], shared=False),
            batch=batch,
            progress=say,
        )
        again = []
        for k, member in zip(left, members, strict=True):
            found = member.minimum
            if found is None:
                fits[k] = member.failure
                continue
            starts[k], history[k] = np.asarray(found.z), history[k] + found.history
            factors, freedom, sigmas[k], changing = settle_noise(problems[k], found, sigmas[k])
            if changing and found.converged and round_ < MOST_ROUNDS - 1:
                again.append(k)
            else:
                result = fit_result(problems[k], optimiser, found, factors, freedom, sigmas[k], report, level)
                fits[k] = replace(result, history=history[k])
        left = again
        if not left:
            break
    return fits
