"""Fits of parameters to what was observed."""

import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.checks import checked, require, warn
from mpmjax.fitting._choice import chosen_optimiser
from mpmjax.fitting._estimates import fit_result, settle_noise
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._log import FitLog, opened_log
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._progress import Progress
from mpmjax.fitting._result import FitResult
from mpmjax.fitting._search import Iteration, Minimum, NoDerivativeError, Standing, influence, search
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
    several = (experiments,) if isinstance(experiments, Experiment) else tuple(experiments)
    problem = FitProblem(several, parameters, memory)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    require((level > 0) & (level < 1), f"level must lie between 0 and 1, got {level}.")
    level = float(level)
    report = dict(report or {})
    _check_report(problem, report)
    z = jnp.zeros(problem.size, problem.dtype)
    with ExitStack() as stack:
        kept = None
        if log is not None:
            kept = stack.enter_context(opened_log(Path(log), problem, optimiser, z, resume=resume))
            stack.enter_context(reporting(kept.standing))
        found, history, sigmas, factors, freedom, unsettled = _rounds(problem, optimiser, z, progress, kept)
    result = fit_result(problem, optimiser, found, factors, freedom, sigmas, report, level)
    result = replace(result, history=history, interrupted=found.interrupted)
    if not found.converged:
        stopped = "was interrupted" if found.interrupted else "did not converge"
        advice = "" if found.interrupted else f" {_ADVICE}"
        warn(f"The fit {stopped} after {len(history)} iterations: its errors hold only at a minimum.{advice}")
    elif unsettled:
        warn(f"The noise of the observations did not settle in {MOST_ROUNDS} rounds: give the sigma of one of them.")
    for text in result.warnings:
        warn(text)
    return result


def _rounds(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    z: Coordinates,
    progress: Callable[[str], None] | None,
    kept: FitLog | None,
) -> tuple[Minimum, tuple[Iteration, ...], tuple[Array, ...], list[float], list[float], bool]:
    """The search, again and again until the noise that it leaves is the noise that it was made with.

    Returns:
        the last minimum; all iterations; the noise; by how much it differs from that of the last search; the degrees of
        freedom of its estimates; whether it did not settle.
    """
    sigmas = problem.first_sigmas
    history, rounds, standing, before = (), 0, None, 0.0
    if kept is not None and kept.last is not None:
        history, rounds, (sigmas, standing), before = kept.earlier, kept.rounds, kept.last, kept.seconds
    said, begun = Progress(problem, optimiser, progress), time.perf_counter() - before
    said.begin(0 if standing is None else len(history) + len(standing.history))
    while True:

        def report(standing: Standing, sigmas: tuple[Array, ...] = sigmas) -> None:
            seconds = time.perf_counter() - begun
            if kept is not None:
                kept.append(sigmas, standing, seconds)
            said(standing, seconds)

        found = _search(problem, optimiser, z, sigmas, standing, report)
        z, history, rounds, standing = found.z, history + found.history, rounds + 1, None
        factors, freedom, sigmas, changing = settle_noise(problem, found, sigmas)
        if not changing or not found.converged or rounds == MOST_ROUNDS:
            return found, history, sigmas, factors, freedom, found.converged and changing


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
    standing: Standing | None,
    report: Callable[[Standing], None],
) -> Minimum:
    """The least sum of squares with a noise.

    Raises:
        SimulationError, ValueError: the first simulation is at fault, or does not reach the data.
        ValueError: a parameter does not influence the data.
        RuntimeError: there is no derivative.
    """
    try:
        begun = partial(require_influence, problem, sigmas)
        found = search(problem, optimiser, z, sigmas, standing=standing, report=report, begun=begun)
    except NoDerivativeError:
        raise RuntimeError(
            "The fit has no derivative. Either the tangent or adjoint solve of a step did not converge: raise the "
            "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner(). Or a "
            "law or an observation cannot be differentiated where the run takes it."
        ) from None
    if not np.isfinite(found.history[0].cost):
        explain(problem, z)
        raise ValueError("What is observed of the simulation at the first guess is not finite.")
    return found


def explain(problem: FitProblem, z: Coordinates) -> None:
    """Say why what is observed is not finite there.

    Raises:
        SimulationError, ValueError: see `Experiment.explain`.
    """
    for experiment in problem.at(z):
        experiment.explain()


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
            size = influence(problem, jnp.zeros(problem.size, problem.dtype), sigmas)
    else:
        size = np.linalg.norm(np.asarray(seen.jacobian), axis=0)
    unseen = [label for label, length in zip(problem.labels, size, strict=True) if length <= rounding]
    require(
        not unseen,
        f"The data do not depend on {_listed(unseen)}: their derivative by it is zero but for rounding. Leave it "
        "out, give it a prior, or observe what it changes.",
    )


def _listed(names: list[str]) -> str:
    """The first names, and how many there are besides."""
    more = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {more} more" if more > 0 else "")


MOST_ROUNDS = 20
"""Of searches with another noise."""
_MOST_NAMES = 6
_ROUNDINGS = 10
"""Derivatives by a coordinate below so many roundings of the data are none."""
_ADVICE = (
    "Raise max_steps, start closer, give a rtol that the precision can reach, or see whether simulations fail or the "
    "misfit has a kink where it ended."
)
