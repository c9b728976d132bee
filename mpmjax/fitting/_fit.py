"""Fits of parameters to what was observed."""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.checks import checked, require, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._levenberg_marquardt import LevenbergMarquardt
from mpmjax.fitting._log import FitLog, opened_log
from mpmjax.fitting._optimiser import LBFGS, AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import ROW_COST, SHOWN, Coordinates, FitProblem
from mpmjax.fitting._result import FitResult, SettledNoise, fit_result, settle_noise
from mpmjax.fitting._search import Iteration, Minimum, NoDerivativeError, SearchState, search
from mpmjax.io import reporting


@checked
def fit(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
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

    The least sum of squares of (simulated − measured)/σ over all observations of all experiments is searched: with few
    parameters, or few measured numbers, by the Levenberg-Marquardt method (optimistix), with many by L-BFGS (optax),
    with derivatives through every step and every implicit solve. A step at which a simulation fails is not taken.
    Where an observation gives no σ, it is estimated: as √(Σ r²/(m − n)) of one observation, and of several so that each
    explains its own misfit, in rounds.

    Errors are those of the Gauss-Newton Hessian (JᵀJ)⁻¹: what the noise of the data, independent and normal, does to
    the parameters. They say nothing of what the law or the discretisation gets wrong, which often is more: fit on two
    spacings and compare.

    Args:
        experiments: one or several, which share the parameters.
        parameters: what is fitted, by name.
        report: what else to report with its error, by name: functions of an experiment that return one number.
        level: of the intervals [-].
        optimiser: the method of the search. Default: `LevenbergMarquardt` where its Jacobian is cheap, else `LBFGS`.
        memory: for what reverse mode stores, and for the tangents of forward mode that are made at once [B].
        progress: called with a line before the first iteration, which is compiled, and one after each, such as `print`:
            misfit, gradient, parameters, seconds, and about how many are left (see docs/fitting.md).
        log: an HDF5 file that is to hold each iteration (its layout: docs/fitting.md). Whatever ends the fit, the file
            is whole and lacks at most the iteration in progress.
        resume: continue the fit of the log, bit for bit. Only the optimiser's `max_steps` may differ.

    Ctrl-C ends a fit after the iteration in progress, and it returns the best that it has, not converged.

    Raises:
        ValueError: a parameter that is no number of the experiment, lies outside its bounds or does not influence the
            data; too few data; data that the simulation does not reach; a log that is there already or, with `resume`,
            is not, or is of another fit.
        SimulationError: the simulation at the first guess meets a fault.
        RuntimeError: there is no derivative.
        OSError: the disk refused the log, which holds what it held before.
    """
    require(log is not None or not resume, "resume continues the fit of a log: name it by log.")
    problem = FitProblem(experiments, parameters, memory)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    level = checked_level(level)
    report = dict(report or {})
    _check_report(problem, report)
    with ExitStack() as stack:
        written = None
        if log is not None:
            written = stack.enter_context(opened_log(Path(log), problem, optimiser, resume=resume))
            stack.enter_context(reporting(written.contents))
        minimum, settled = _searched(problem, optimiser, progress, written)
    result = fit_result(problem, optimiser, minimum, settled, report, level)
    if not minimum.converged:
        stopped = "was interrupted" if minimum.interrupted else "did not converge"
        advice = "" if minimum.interrupted else f" {_ADVICE}"
        warn(f"The fit {stopped} after {len(result.history)} iterations: its errors hold only at a minimum.{advice}")
    elif settled.changing:
        warn(f"The noise of the observations did not settle in {MOST_ROUNDS} rounds: give the sigma of one of them.")
    for text in result.warnings:
        warn(text)
    return result


def chosen_optimiser(problem: FitProblem) -> AbstractOptimiser:
    """Levenberg-Marquardt while its Jacobian is cheap: by forward mode it costs as much as a simulation for each few
    parameters, by reverse mode for each measured number. Else L-BFGS, whose gradient costs the same for any number of
    parameters, and which takes more iterations (docs/fitting.md has the measurement)."""
    columns = min(problem.size, ROW_COST * problem.measured)
    return LevenbergMarquardt() if columns <= MOST_COLUMNS else LBFGS()


def checked_level(level: Scalar) -> float:
    """The level of intervals, which must lie between 0 and 1."""
    require((level > 0) & (level < 1), f"level must lie between 0 and 1, got {level}.")
    return float(level)


def in_rounds(
    problems: list[FitProblem],
    sigmas: list[tuple[Array, ...]],
    minimise: Callable[[int, list[int], list[Coordinates], list[tuple[Array, ...]]], Sequence[Minimum | str]],
    rounds: int = 0,
) -> list[tuple[Minimum, SettledNoise] | str]:
    """Searches of each problem, again and again until the noise that it leaves is the noise that it was made with: the
    last minimum, with all iterations, and the noise; or why the search failed.

    `minimise` makes searches, given the number of the round, those of the problems, their starts and their noise.
    """
    starts = [jnp.zeros(p.size, p.dtype) for p in problems]
    histories: list[tuple[Iteration, ...]] = [()] * len(problems)
    outcomes: list[tuple[Minimum, SettledNoise] | str] = [""] * len(problems)
    left = list(range(len(problems)))
    while left:
        ends = minimise(rounds, left, [starts[k] for k in left], [sigmas[k] for k in left])
        rounds, searched, left = rounds + 1, left, []
        for k, end in zip(searched, ends, strict=True):
            if isinstance(end, str):
                outcomes[k] = end
                continue
            settled = settle_noise(problems[k], end, sigmas[k])
            starts[k], sigmas[k], histories[k] = end.z, settled.sigmas, histories[k] + end.history
            outcomes[k] = end._replace(history=histories[k]), settled
            if settled.changing and end.converged and rounds < MOST_ROUNDS:
                left.append(k)
    return outcomes


def _searched(
    problem: FitProblem, optimiser: AbstractOptimiser, progress: Callable[[str], None] | None, log: FitLog | None
) -> tuple[Minimum, SettledNoise]:
    """The minimum and the noise, in rounds. A log is continued, and gets each iteration."""
    end = None if log is None else log.end
    rounds, earlier, sigmas, state, seconds_before = (0, (), problem.first_sigmas, None, 0.0) if end is None else end
    lines, begun = Progress(problem, optimiser, progress), time.perf_counter() - seconds_before
    lines.begin(0 if state is None else len(earlier) + len(state.history))

    def minimise(number: int, _: Any, starts: list[Coordinates], noise: list[tuple[Array, ...]]) -> list[Minimum]:
        def report(state: SearchState) -> None:
            seconds = time.perf_counter() - begun
            if log is not None:
                log.append(noise[0], state, seconds)
            lines(state, seconds)

        return [_search(problem, optimiser, starts[0], noise[0], state if number == rounds else None, report)]

    (outcome,) = in_rounds([problem], [sigmas], minimise, rounds)
    assert not isinstance(outcome, str)
    minimum, settled = outcome
    return minimum._replace(history=(*earlier, *minimum.history)), settled


def _check_report(problem: FitProblem, report: Mapping[str, Callable[[Experiment], Any]]) -> None:
    for name, of in report.items():
        require(name not in problem.labels, f"What is reported must not have a parameter's name, got {name!r}.")
        shape = jnp.shape(of(problem.experiments[0]))
        require(shape == (), f"What is reported as {name!r} must be one number, got shape {shape}.")


def _search(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    z: Coordinates,
    sigmas: tuple[Array, ...],
    state: SearchState | None,
    report: Callable[[SearchState], None],
) -> Minimum:
    """The least sum of squares with a noise.

    Raises:
        SimulationError, ValueError: the first simulation is at fault, or does not reach the data.
        ValueError: a parameter does not influence the data.
        RuntimeError: there is no derivative.
    """

    def begun(seen: Evaluation) -> None:
        require_influence(problem, sigmas, seen)

    try:
        minimum = search(problem, optimiser, z, sigmas, state=state, report=report, begun=begun)
    except NoDerivativeError:
        raise RuntimeError(
            "The fit has no derivative. Either the tangent or adjoint solve of a step did not converge: raise the "
            "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner(). Or a "
            "law or an observation cannot be differentiated where the run takes it."
        ) from None
    if not np.isfinite(minimum.history[0].cost):
        problem.explain(z)
    return minimum


def require_influence(problem: FitProblem, sigmas: tuple[Array, ...], seen: Evaluation) -> None:
    """Check that the data depend on every coordinate, at the first guess.

    Raises:
        ValueError: they do not.
    """
    rounding = _ROUNDINGS * float(jnp.finfo(problem.dtype).eps) * float(problem.size_of_data(sigmas))
    if seen.jacobian is None:
        # |Jᵀr| ≤ ‖r‖ times a column's length: where it is not small, the column is not.
        size = np.abs(np.asarray(seen.gradient)) / max(np.sqrt(2 * float(seen.cost)), np.finfo(float).tiny)
        if (size <= rounding).any():
            size = np.abs(np.asarray(_random_pull(problem, jnp.zeros(problem.size, problem.dtype), sigmas)))
    else:
        size = np.linalg.norm(np.asarray(seen.jacobian), axis=0)
    unseen = [label for label, length in zip(problem.labels, size, strict=True) if length <= rounding]
    more = f" and {len(unseen) - _MOST_NAMES} more" if len(unseen) > _MOST_NAMES else ""
    require(
        not unseen,
        f"The data do not depend on {', '.join(unseen[:_MOST_NAMES])}{more}: their derivative by it is zero but for "
        "rounding. Leave it out, give it a prior, or observe what it changes.",
    )


@eqx.filter_jit
def _random_pull(problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> Coordinates:
    """Jᵀw with random numbers w of variance one, by one pass of reverse mode: the expected square of a component is
    that of the length of J's column."""
    r, pull, _ = jax.vjp(lambda z: problem.residuals(z, sigmas, None), z, has_aux=True)
    return pull(jax.random.normal(jax.random.key(0), r.shape, r.dtype))[0]


class Progress:
    """A line an iteration: misfit Σ r², gradient, parameters, seconds, and the time that is left.

    The time left is that of the present search. It is the usual time of an iteration times how many are left: about so
    many as the optimiser's distance from converged needs to fall to one at the rate of the last three iterations, where
    it is known and falls; else at most those up to `max_steps`.
    """

    def __init__(self, problem: FitProblem, optimiser: AbstractOptimiser, say: Callable[[str], None] | None):
        self._problem, self._optimiser, self._say = problem, optimiser, say
        self._durations: list[float] = []
        self._distances: list[float] = []
        self._last = time.perf_counter()

    def begin(self, done: int) -> None:
        """Say that the first iteration begins, which is compiled before; a log may hold iterations that are done."""
        if self._say is None:
            return
        labels, problem = self._problem.labels, self._problem
        named = ", ".join(labels[:SHOWN]) + (", …" if len(labels) > SHOWN else "")
        after = f" after {done} iterations of the log" if done else ""
        count = f"{problem.size} number{'s' * (problem.size > 1)}"
        self._say(f"compiling the fit of {count} ({named}) to {problem.points} that were measured{after}")

    def __call__(self, state: SearchState, seconds: float) -> None:
        """Say where the search stands after an iteration, and so many seconds since the fit began."""
        iteration = state.history[-1]
        if iteration.number == 0:
            self._distances = []
        now = time.perf_counter()
        self._durations.append(now - self._last)
        self._distances.append(self._optimiser.distance(state.inner, state.seen))
        self._last = now
        if self._say is None:
            return
        self._say(
            f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  "
            f"{self._problem.shown(iteration.z)}  {_clock(seconds)}{self._left(len(state.history))}"
        )

    def _left(self, done: int) -> str:
        """The time left, in words; nothing while only the iteration that was compiled is timed, and at the end."""
        most = self._optimiser.max_steps - done
        if len(self._durations) < 2 or most == 0 or self._distances[-1] <= 1:
            return ""
        pace, steps = float(np.median(self._durations[1:])), iterations_left(self._distances)
        if steps is None or steps > most:
            return f", at most {_clock(pace * most)} left"
        return f", about {_clock(pace * steps)} left"


def iterations_left(distances: list[float]) -> int | None:
    """How many iterations the distance needs to fall to one, at the mean rate of its last three values; None where it
    does not fall, or is not known."""
    last = np.asarray(distances[-3:])
    if len(last) < 3 or not (np.isfinite(last).all() and 0 < last[-1] < last[0]):
        return None
    return max(1, int(np.ceil(np.log(last[-1]) / (np.log(last[0] / last[-1]) / 2))))


def _clock(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 100:
        return f"{seconds:.3g} s" if seconds >= 0.1 else "0.1 s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


MOST_COLUMNS = 32
"""Columns of a Jacobian, or rows at what they cost more, up to which Levenberg-Marquardt is the cheaper."""
MOST_ROUNDS = 20
"""Most re-estimations of the noise."""
_MOST_NAMES = 6
_ROUNDINGS = 10
"""Derivatives by a coordinate below so many roundings of the data are none."""
_ADVICE = (
    "Raise max_steps, start closer, give a rtol that the precision can reach, or see whether simulations fail or the "
    "misfit has a kink where it ended."
)
