"""Fits of parameters to what was observed."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.checks import checked, require, warn
from mpmjax.fitting._choice import chosen_optimiser
from mpmjax.fitting._estimates import fit_result, noise_factors
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._result import FitResult
from mpmjax.fitting._search import Iteration, Minimum, NoDerivativeError, influence, search


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
        memory: for checkpoints of reverse mode, and for the tangents of forward mode that are made at once [B].
        progress: called with a line an iteration, such as `print`.

    Raises:
        ValueError: a parameter that is no number of the experiment, lies outside its bounds or does not influence the
            data; too few data; data that the simulation does not reach.
        SimulationError: the simulation at the first guess meets a fault.
        RuntimeError: there is no derivative.
    """
    several = (experiments,) if isinstance(experiments, Experiment) else tuple(experiments)
    problem = FitProblem(several, parameters, memory)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    require((level > 0) & (level < 1), f"level must lie between 0 and 1, got {level}.")
    level = float(level)
    begun = time.perf_counter()

    def say(iteration: Iteration) -> None:
        if progress is not None:
            progress(_line(problem, iteration, time.perf_counter() - begun))

    sigmas = tuple(jnp.asarray(o.scale() if o.sigma is None else o.sigma, problem.dtype) for o in problem.observations)
    report = dict(report or {})
    _check_report(problem, report)
    z, history, rounds = jnp.zeros(problem.size, problem.dtype), (), 0
    while True:
        found = _search(problem, optimiser, z, sigmas, say)
        z, history, rounds = found.z, history + found.history, rounds + 1
        estimated, freedom = noise_factors(problem, found)
        floor = [_LEAST * o.scale() / float(np.max(s)) for o, s in zip(problem.observations, sigmas, strict=True)]
        factors = [max(factor, least) for factor, least in zip(estimated, floor, strict=True)]
        sigmas = tuple(sigma * factor for sigma, factor in zip(sigmas, factors, strict=True))
        moved = [abs(factor - 1) > _NOISE_RTOL for factor in factors]
        changing = any(m and factor > least for m, factor, least in zip(moved, factors, floor, strict=True))
        if not changing or problem.scales_alike or not found.converged or rounds == _MOST_ROUNDS:
            break
    result = fit_result(problem, found, factors, freedom, sigmas, report, level)
    result = replace(result, history=history, optimiser=optimiser)
    if not found.converged:
        stopped = "was interrupted" if found.interrupted else "did not converge"
        advice = "" if found.interrupted else f" {_ADVICE}"
        warn(f"The fit {stopped} after {len(history)} iterations: its errors hold only at a minimum.{advice}")
    elif changing and not problem.scales_alike:
        warn(f"The noise of the observations did not settle in {rounds} rounds: give the sigma of one of them.")
    for text in result.warnings:
        warn(text)
    return result


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
    say: Callable[[Iteration], None],
) -> Minimum:
    """The least sum of squares with a noise.

    Raises:
        SimulationError, ValueError: the first simulation is at fault, or does not reach the data.
        ValueError: a parameter does not influence the data.
        RuntimeError: there is no derivative.
    """
    try:
        begun = partial(_require_influence, problem, sigmas)
        found = search(problem, optimiser, z, sigmas, report=say, begun=begun)
    except NoDerivativeError:
        raise RuntimeError(
            "The fit has no derivative. Either the tangent or adjoint solve of a step did not converge: raise the "
            "max_steps of the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner(). Or a "
            "law or an observation cannot be differentiated where the run takes it."
        ) from None
    if not np.isfinite(found.history[0].cost):
        for experiment in problem.at(z):
            experiment.explain()
        raise ValueError("What is observed of the simulation at the first guess is not finite.")
    return found


def _require_influence(problem: FitProblem, sigmas: tuple[Array, ...], seen: Evaluation) -> None:
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


def _line(problem: FitProblem, iteration: Iteration, seconds: float) -> str:
    """Progress."""
    values = problem.numbers(jnp.asarray(iteration.z, problem.dtype))
    shown = ", ".join(f"{label} {value:.5g}" for label, value in zip(problem.labels[:4], values, strict=False))
    more = ", …" if problem.size > 4 else ""
    return (
        f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  {shown}{more}  "
        f"{seconds:.1f} s"
    )


_NOISE_RTOL = 1e-3
"""The noise of several observations is settled when its estimate changes less, relatively."""
_MOST_ROUNDS = 20
_MOST_NAMES = 6
_LEAST = 1e-12
"""Smallest noise, in sizes of the data: exact data have none."""
_ROUNDINGS = 10
"""Derivatives by a coordinate below so many roundings of the data are none."""
_ADVICE = "Raise max_steps, start closer, or give a rtol that the precision can reach."
