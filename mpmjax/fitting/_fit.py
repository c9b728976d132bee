"""Fits of parameters to what was observed: of one data set, or of each of many."""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Scalar
from mpmjax.checks import between, checked, require, shortened, warn, whole
from mpmjax.fitting._estimate import table
from mpmjax.fitting._evaluation import Evaluation, look_at_coarse_grid
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._log import recorded
from mpmjax.fitting._optimiser import LBFGS, LevenbergMarquardt
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import ROW_COST, Coordinates, FitProblem
from mpmjax.fitting._result import FitResult, Minimum, fit_result, minimum_of
from mpmjax.fitting._search import NO_DERIVATIVE, AbstractOptimiser, Iteration, Search, batch_size, counted, search_many
from mpmjax.fitting._starts import Starts, as_starts, look_around, starting_points, unit_points
from mpmjax.fitting._uncertainty import seen_together, uncertainty

Level = Annotated[Scalar, between(0, 1, open_ends=True)]


@checked
def fit(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    starts: int | Literal["auto"] | Starts = "auto",
    discretisation: bool = True,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Level = 0.95,
    optimiser: AbstractOptimiser | None = None,
    memory: int = 2**28,
    progress: Callable[[str], None] | None = None,
    log: str | os.PathLike | None = None,
    resume: bool = False,
) -> FitResult:
    """Fit parameters of a scene to what was observed of it, with standard errors.

        pull = mpm.Experiment(
            scene, particles, t1=0.5, dt=5e-3, method=mpm.SemiImplicit(),
            observations=mpm.Tracks(times, positions, which=markers, sigma=1e-4),
        )
        result = mpm.fit(pull, {
            "E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, unit="Pa"),
            "nu": mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0, 0.49),
        })
        print(result)

    The least sum of squares of (simulated − measured)/σ over all observations is searched, with derivatives through
    every step and every implicit solve. A σ that is not given is estimated as √(Σ r²/(m − n)), of several observations
    in rounds. Errors and intervals hold a misfit beyond the noise (docs/fitting.md#intervals-that-hold). Ctrl-C ends a
    fit after the iteration in progress: the best so far is returned, not converged.

    Args:
        experiments: one or several, which share the parameters.
        parameters: what is fitted, by name.
        starts: from how many points it is searched, or which (`Starts`), 1 from the first guess alone. "auto": where
            the misfit of the first search is beyond the noise, 24 more points are looked at, and some searched from,
            until a misfit is within it (`result.screening`).
        discretisation: whether to look at twice the spacing, and at twice the step there, by three runs each at most,
            and count as errors how far the minimum moves.
        report: what else to report with its error, by name: functions of an experiment that return one number.
        level: of the intervals [-].
        optimiser: the method of the search. Default: `LevenbergMarquardt` with few parameters or few measured numbers,
            else `LBFGS`.
        memory: for what reverse mode stores, and for the tangents of forward mode that are made at once [B].
        progress: called with a line before the first iteration, which is compiled, and one after each, such as `print`.
        log: an HDF5 file (docs/fitting.md) that holds each iteration that is done, whatever ends the fit: of the first
            search, and of the last one from another start.
        resume: continue the fit of the log, bit for bit. Only the optimiser's `max_steps` may differ.

    Raises:
        ValueError: a parameter that is no number of the experiment, lies outside its bounds or does not influence the
            data; too few data, or data not reached; a log that is there already, with `resume` none or another fit's.
        SimulationError: the simulation at the first guess meets a fault.
        RuntimeError: there is no derivative.
        OSError: the disk refused the log, which holds what it held before.
    """
    require(log is not None or not resume, "resume continues the fit of a log: name it by log.")
    problem = FitProblem(experiments, parameters, memory)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    level, report = float(level), dict(report or {})
    for name, of in report.items():
        require(name not in problem.labels, f"What is reported must not have a parameter's name, got {name!r}.")
        shape = jnp.shape(of(problem.experiments[0]))
        require(shape == (), f"What is reported as {name!r} must be one number, got shape {shape}.")
    starts = as_starts(starts)
    starting_points(problem, unit_points(0, problem.size, 0), starts)  # those that cannot be are refused
    say, alike = progress or (lambda text: None), set[str]()
    with recorded(problem, optimiser, progress, None if log is None else Path(log), resume=resume) as (past, record):

        def iterated(problem: FitProblem, search: Search) -> None:
            if search.history[-1].number == 0:
                _see(problem, search.seen, alike)
            record(problem, search)

        def enough(other: Search) -> bool:
            """Whether a search is at a lower minimum, which the noise explains."""
            if not starts.if_needed or not other.converged or other.joined is not None or other.cost >= end.cost:
                return False
            result = resulted(minimum_of(minimum.problem, other))
            return result is not None and not result.is_beyond

        descend = partial(_in_rounds, optimiser=optimiser, report=iterated)
        resulted = partial(fit_result, optimiser=optimiser, report=report, level=level)
        rounds, earlier, latest, state = (0, (), problem, None) if past is None else past
        (minimum,) = descend([latest], [jnp.zeros(problem.size, problem.dtype)], rounds=rounds, state=state)
        result, end, screening = resulted(minimum), minimum.search, None
        history = (*earlier, *end.history)
        # The log of a fit that other starts have brought farther holds a search that begins where none ended.
        brought = any(b.number == 0 and not np.array_equal(a.z, b.z) for a, b in pairwise(history))
        needed = not starts.if_needed or (result is not None and result.is_beyond)
        if not end.interrupted and not brought and needed and (starts.count > 1 or starts.points):
            say(f"looking at other starts, {starts.count + len(starts.points)} points")
            best, screening = look_around(minimum.problem, optimiser, starts, end, enough, progress)
            if best is not None:
                (minimum,) = descend([problem], [best.z])
                result, end = resulted(minimum), minimum.search
                history = (*history, *end.history)
    if result is None:
        require_end(end)
        tried = "" if screening is None else f"No search of {len(screening.searched)} came to a minimum: {end.failure}."
        problem.explain(jnp.zeros(problem.size, problem.dtype), *([tried] if tried else []))
    if discretisation and not end.interrupted:
        say("looking at twice the spacing")
        free = np.array([not e.at_bound for e in result.estimates])
        coarse = look_at_coarse_grid(result.problem, end.z, result.jacobian * free)
        result = resulted(minimum, coarse=coarse) or result
    result = replace(result, history=history, screening=screening)
    _warn_of(result, end, moves=minimum.moves, but=alike)
    return result


def _see(problem: FitProblem, seen: Evaluation, alike: set[str]) -> None:
    """Refuse parameters that the data do not see at the first guess; warn of data of the other sign and, once, of
    parameters not seen apart, `alike`."""
    rounding = _ROUNDINGS * float(problem.rounding_of_data())
    if seen.jacobian is None:
        # |Jᵀr| ≤ ‖r‖ times a column's length: where it is not small, the column is not.
        size = np.abs(np.asarray(seen.gradient)) / max(np.sqrt(2 * float(seen.cost)), np.finfo(float).tiny)
        if (size <= rounding).any():
            # Jᵀw with random numbers w of variance one: the expected square of a component is that of J's column.
            size = np.abs(np.asarray(_random_pull(problem, jnp.zeros(problem.size, problem.dtype))))
    else:
        size = np.linalg.norm(np.asarray(seen.jacobian), axis=0)
    unseen = [label for label, length in zip(problem.labels, size, strict=True) if length <= rounding]
    require(
        not unseen,
        f"The data do not depend on {shortened(', '.join(unseen))}: their derivative by it is zero but for "
        "rounding. Leave it out, give it a prior, or observe what it changes.",
    )
    if seen.residuals is not None:
        _warn_of_signs(problem, np.asarray(seen.residuals))
    if seen.jacobian is None or alike:
        return
    errors = uncertainty(np.asarray(seen.jacobian, float), float(jnp.finfo(problem.dtype).eps), ())
    for text in seen_together(problem.labels, errors, problem.logarithmic):
        alike.add(text.split(":")[0])
        warn(f"At the first guess, {text}")


def _warn_of_signs(problem: FitProblem, residuals: np.ndarray) -> None:
    """Warn of observations that the first guess computes with the sign opposite to the data's: there is no fit of a
    modulus to them but zero. Those with a robust loss, which bends residuals, are left out."""
    for o, rows, sigma in zip(problem.observations, problem.rows, problem.sigmas, strict=True):
        data = -np.asarray(o.residuals(jnp.zeros(o.data.shape, problem.dtype), sigma))
        computed = residuals[rows] + data
        if o.robust is None and computed @ data < -_OPPOSITE * np.linalg.norm(computed) * np.linalg.norm(data):
            warn(
                f"At the first guess, {o.name} is computed with the sign opposite to the data's. Turn the data "
                "(scale = -1 in a scene file), if it is not the guess that is to turn."
            )


def _warn_of(result: FitResult, end: Search, *, moves: bool, but: set[str]) -> None:
    """Warn of a search that did not converge, or whose noise `moves` it, and of what the result says `but` that."""
    if not result.converged:
        stopped = "was interrupted" if result.interrupted else "did not converge"
        advice = " Raise max_steps, start closer, or give a rtol that the precision can reach."
        if result.interrupted or result.optimiser.has_stalled(end.inner):
            advice = ""
        warn(f"The fit {stopped} after {len(result.history)} iterations: its errors hold only at a minimum.{advice}")
    elif moves:
        warn(f"The noise of the observations did not settle in {MOST_ROUNDS} rounds: give the sigma of one of them.")
    remark = "" if result.screening is None else result.screening.remark
    for text in (*result.warnings, *([remark] if remark else [])):
        if text.split(":")[0] not in but:
            warn(text)


def chosen_optimiser(problem: FitProblem) -> AbstractOptimiser:
    """Levenberg-Marquardt while its Jacobian is cheap, else L-BFGS (docs/fitting.md has the measurement)."""
    columns = min(problem.size, ROW_COST * problem.measured)
    return LevenbergMarquardt() if columns <= MOST_COLUMNS else LBFGS()


def _in_rounds(
    problems: list[FitProblem],
    starts: Sequence[Coordinates],
    *,
    rounds: int = 0,
    progress: Callable[[str], None] | None = None,
    state: Search | None = None,
    **options: Any,
) -> list[Minimum]:
    """Searches of each problem, as of `search_many`, until one leaves the noise that it was made with."""
    histories: list[tuple[Iteration, ...]] = [()] * len(problems)
    minima, places = dict[int, Minimum](), dict(enumerate(starts))
    while places:
        told = counted(progress, f"round {rounds + 1}: {{}} of {{}} fits are done")
        ends = search_many(problems, starts=places, state=state, progress=told, **options)
        rounds, places, state, problems = rounds + 1, {}, None, list(problems)
        for k, end in ends.items():
            histories[k] += end.history
            minima[k] = minimum = minimum_of(problems[k], end._replace(history=histories[k]))
            if minimum.moves and minimum.noise and end.converged and rounds < MOST_ROUNDS:
                places[k] = end.z
                problems[k] = problems[k].with_noise(tuple(sigma for sigma, *_ in minimum.noise))
    return [minima[k] for k in range(len(problems))]


def require_end(end: Search) -> None:
    """Raise a `KeyboardInterrupt` of an interrupted search, a `RuntimeError` of one without a derivative."""
    if end.interrupted:
        raise KeyboardInterrupt
    if end.failure == NO_DERIVATIVE:
        raise RuntimeError(
            "The fit has no derivative. Either the tangent or adjoint solve of a step did not converge: raise the "
            "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner(). Or a "
            "law or an observation cannot be differentiated where the run takes it."
        )


@eqx.filter_jit
def _random_pull(problem: FitProblem, z: Coordinates) -> Coordinates:
    """Jᵀw with random numbers w of variance one, by one pass of reverse mode."""
    r, pull, _ = jax.vjp(lambda z: problem.residuals(z, None), z, has_aux=True)
    return pull(jax.random.normal(jax.random.key(0), r.shape, r.dtype))[0]


class EnsembleFit(eqx.Module):
    """One fit for each data set; `print(result)` shows a table, `result.values["E"]` the estimates of a parameter."""

    fits: tuple[FitResult | None, ...]  # the fit of each data set; None where it failed
    failures: dict[int, str]  # why fits failed, by the number of the data set

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The estimates of each parameter, NaN where the fit failed, shape (k, ...)."""
        each = [None if fit is None else fit.values for fit in self.fits]
        lost = {name: np.full(value.shape, np.nan) for name, value in self._done[0].values.items()}
        return {name: np.stack([(values or lost)[name] for values in each]) for name in lost}

    @property
    def errors(self) -> np.ndarray:
        """The standard error of each estimate of the n numbers, NaN where the fit failed, shape (k, n)."""
        lost = [np.nan] * len(self._done[0].estimates)
        return np.array([lost if fit is None else [e.error for e in fit.estimates] for fit in self.fits])

    @property
    def alike(self) -> np.ndarray:
        """Probability of so large a spread of each number if all data sets had one value, shape (n,): Cochran's
        Q = Σ (z_k − z̄)²/s_k² of values, or logarithms, as χ² of k − 1 degrees of freedom (W. G. Cochran, Biometrics 10
        (1954) 101, doi 10.2307/3001666)."""
        z, s, held = self._columns
        if len(z) < 2:
            return np.full(z.shape[1], np.nan)
        ratio = np.array(self._done[0].problem.logarithmic) & ~held.any(axis=0)
        z, s = np.where(ratio, np.log(np.where(ratio, z, 1)), z), s / np.where(ratio, z, 1)
        weight = 1 / s**2
        mean = (weight * z).sum(axis=0) / weight.sum(axis=0)
        from scipy.special import chdtrc  # here, since it takes long to import

        return np.asarray(chdtrc(len(z) - 1, (weight * (z - mean) ** 2).sum(axis=0)))

    @property
    def _done(self) -> list[FitResult]:
        """The fits that did not fail."""
        return [fit for fit in self.fits if fit is not None]

    @property
    def _columns(self) -> tuple[np.ndarray, ...]:
        """Values, errors, and whether they lie at a bound, each of shape (fits that did not fail, n)."""
        fields = "value", "error", "at_bound"
        return tuple(np.array([[getattr(e, f) for e in fit.estimates] for fit in self._done]) for f in fields)

    def __str__(self) -> str:
        """A table: the mean and spread of each number over the data sets, and the errors of the fits."""
        (values, errors, held), alike = self._columns, self.alike
        spread = values.std(axis=0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
        mean, error, rows = values.mean(axis=0), np.sqrt((errors**2).mean(axis=0)), []
        for k, e in enumerate(self._done[0].estimates):
            at_bound = f", {held[:, k].sum()} at the bound" if held[:, k].any() else ""
            numbers = f"{mean[k]:>12.6g}", f"{spread[k]:>10.2g}", f"{error[k]:>13.2g}"
            rows.append((e.name, *numbers, f"p = {alike[k]:.2g}{at_bound}"))
        head = "", f"{'mean':>12}", f"{'spread':>10}", "error of one", "same value?"
        last = f"{len(values)} data sets" + (f", {len(self.failures)} failed" if self.failures else "")
        return "\n".join([*table(head, *rows), last])


@checked
def fit_ensemble(
    experiments: tuple[Any, ...] | list[Any],
    parameters: dict[str, AbstractParameter],
    *,
    batch: Annotated[int, whole(1)] | None = None,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Level = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> EnsembleFit:
    """Fit each of many data sets by itself, together in one compiled program: repeated specimens, for instance.

        specimens = [mpm.Experiment(scene, particles, ..., observations=tracks) for tracks in measured]
        result = mpm.fitting.fit_ensemble(specimens, {"E": ...})
        print(result)  # mean and spread of E, and whether the specimens differ by more than their errors
        result.values["E"]  # shape (number of specimens,)

    Each gets the estimates and errors of `fit`. One that fails ends alone.

    Args:
        experiments: the data sets: an experiment each, or several each that share the parameters. They may differ in
            every number, and in no shape, choice or function: give a marker that was not seen as NaN.
        batch, progress: how many searches run together, see `Starts`; called with a line as they end.
        parameters, report, level, optimiser: see `fit`.

    Raises:
        ValueError: as `fit`; data sets of different shapes; no fit that did not fail.
    """
    require(len(experiments) > 0, "An ensemble needs a data set at least.")
    for k, e in enumerate(experiments):
        each = e if isinstance(e, (tuple, list)) else (e,)
        usable = len(each) > 0 and all(isinstance(part, Experiment) for part in each)
        require(usable, f"Data set {k} must be an Experiment, or a tuple of some, got {type(e).__name__}.")
    problems = [FitProblem(e, parameters) for e in experiments]
    optimiser = chosen_optimiser(problems[0]) if optimiser is None else optimiser
    size = batch_size(problems[0], batch, len(problems))
    zeros = [jnp.zeros(p.size, p.dtype) for p in problems]
    minima = _in_rounds(problems, zeros, optimiser=optimiser, progress=progress, batch=size)
    fits = [fit_result(minimum, optimiser, dict(report or {}), float(level)) for minimum in minima]
    failures = {k: minimum.search.failure for k, minimum in enumerate(minima) if minimum.search.failure}
    if len(failures) == len(fits):
        problems[0].explain(zeros[0], failure=f"None of {len(fits)} fits succeeded: {failures[0]}.")
    if failures:
        shown = "; ".join(f"number {k}: {why}" for k, why in list(failures.items())[:3])
        warn(f"{len(failures)} of {len(fits)} data sets could not be fitted: {shown}.")
    lost = [k for k, fit in enumerate(fits) if fit is not None and not fit.converged]
    if lost:
        warn(f"{len(lost)} of {len(fits)} fits did not converge, the first number {lost[0]}: raise max_steps.")
    return EnsembleFit(tuple(fits), failures)


MOST_COLUMNS = 32  # of a Jacobian, or rows at what they cost more, up to which Levenberg-Marquardt is the cheaper
MOST_ROUNDS = 20  # most re-estimations of the noise
_ROUNDINGS = 10  # derivatives by a coordinate below so many roundings of the data are none
_OPPOSITE = 0.9  # cosine of the angle between computed and measured numbers beyond which their sign is another
