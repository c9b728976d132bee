"""Fits of parameters to what was observed."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.checks import checked, require, require_tolerance, require_whole, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._least_squares import Iteration, Minimum, NoDerivativeError, levenberg_marquardt
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._result import Estimate, FitResult, NoiseEstimate
from mpmjax.fitting._uncertainty import Uncertainty, noise, quantile, seen_together, uncertainty


@checked
def fit(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
    rtol: Scalar = 1e-6,
    max_steps: int = 50,
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

    The least sum of squares of (simulated − measured)/σ over all observations of all experiments is searched by the
    Levenberg-Marquardt method (optimistix), its Jacobian by forward mode through every step and every implicit solve.
    A step at which a simulation fails is not taken. Where an observation gives no σ, it is estimated: as
    √(Σ r²/(m − n)) of one observation, and of several so that each explains its own misfit, in rounds.

    Errors are those of the Gauss-Newton Hessian (JᵀJ)⁻¹: what the noise of the data, independent and normal, does to
    the parameters. They say nothing of what the law or the discretisation gets wrong, which often is more: fit on two
    spacings and compare.

    Args:
        experiments: one or several, which share the parameters.
        parameters: what is fitted, by name.
        report: what else to report with its error, by name: functions of an experiment that return one number.
        level: of the intervals [-].
        rtol: relative change of the parameters and residuals at which the search ends.
        max_steps: most iterations of a search.
        progress: called with a line an iteration, such as `print`.

    Raises:
        ValueError: a parameter that is no number of the experiment, lies outside its bounds or does not influence the
            data; too few data; data that the simulation does not reach.
        SimulationError: the simulation at the first guess meets a fault.
        RuntimeError: there is no derivative.
    """
    problem = FitProblem((experiments,) if isinstance(experiments, Experiment) else tuple(experiments), parameters)
    require((level > 0) & (level < 1), f"level must lie between 0 and 1, got {level}.")
    require_tolerance("rtol", rtol)
    level, rtol = float(level), float(rtol)
    max_steps = require_whole("max_steps", max_steps, 1)
    begun = time.perf_counter()

    def say(iteration: Iteration) -> None:
        if progress is not None:
            progress(_line(problem, iteration, time.perf_counter() - begun))

    known = [observation.sigma is not None for observation in problem.observations]
    sigmas = tuple(jnp.asarray(o.scale() if o.sigma is None else o.sigma, problem.dtype) for o in problem.observations)
    report = dict(report or {})
    _check_report(problem, report)
    z, history, rounds = jnp.zeros(problem.size, problem.dtype), (), 0
    while True:
        found = _search(problem, z, sigmas, rtol, max_steps, say)
        z, history, rounds = found.z, history + found.history, rounds + 1
        estimated, freedom = _noise(problem, found, known)
        floor = [_LEAST * o.scale() / float(np.max(s)) for o, s in zip(problem.observations, sigmas, strict=True)]
        factors = [max(factor, least) for factor, least in zip(estimated, floor, strict=True)]
        sigmas = tuple(sigma * factor for sigma, factor in zip(sigmas, factors, strict=True))
        moved = [abs(factor - 1) > _NOISE_RTOL for factor in factors]
        changing = any(m and factor > least for m, factor, least in zip(moved, factors, floor, strict=True))
        if not changing or problem.scales_alike or not found.converged or rounds == _MOST_ROUNDS:
            break
    result = _result(problem, found, factors, freedom, sigmas, known, report, level)
    result = replace(result, history=history)
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
    z: Coordinates,
    sigmas: tuple[Array, ...],
    rtol: float,
    max_steps: int,
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
        found = levenberg_marquardt(problem, z, sigmas, rtol=rtol, max_steps=max_steps, report=say, begun=begun)
    except NoDerivativeError:
        raise RuntimeError(
            "The fit has no derivative. Either the tangent solve of a step did not converge: raise the max_steps of "
            "the method's adjoint_solver, or leave its preconditioner at DiagonalPreconditioner(). Or a law or an "
            "observation cannot be differentiated where the run takes it."
        ) from None
    if not np.isfinite(found.history[0].cost):
        for experiment in problem.at(z):
            experiment.explain()
        raise ValueError("What is observed of the simulation at the first guess is not finite.")
    return found


def _require_influence(problem: FitProblem, sigmas: tuple[Array, ...], J: Array) -> None:
    """Check that the data depend on every coordinate, at the first guess, where the Jacobian is J.

    Raises:
        ValueError: they do not.
    """
    rounding = _ROUNDINGS * float(jnp.finfo(problem.dtype).eps) * problem.size_of_data(sigmas)
    size = np.linalg.norm(np.asarray(J), axis=0)
    unseen = [label for label, column in zip(problem.labels, size, strict=True) if column <= rounding]
    require(
        not unseen,
        f"The data do not depend on {', '.join(unseen)}: their derivative by it is zero but for rounding. Leave it "
        "out, give it a prior, or observe what it changes.",
    )


def _noise(problem: FitProblem, found: Minimum, known: list[bool]) -> tuple[list[float], list[float]]:
    """By what each noise is to be multiplied, and the degrees of freedom of its estimate (zero of what is given)."""
    r, J = np.asarray(found.r), np.asarray(found.J)
    factors, freedoms = [], []
    for observation, rows, given in zip(problem.observations, problem.rows, known, strict=True):
        factor, freedom = (1.0, 0.0) if given else noise(r, J, rows, observation.count, *observation.trust)
        require(
            np.isfinite(factor),
            f"The noise of {observation.name!r} cannot be estimated from its {observation.count} numbers: the "
            "parameters use all of them up. Give its sigma.",
        )
        factors.append(factor)
        freedoms.append(freedom)
    return factors, freedoms


def _result(
    problem: FitProblem,
    found: Minimum,
    factors: list[float],
    freedoms: list[float],
    sigmas: tuple[Array, ...],
    known: list[bool],
    report: Mapping[str, Callable[[Experiment], Any]],
    level: float,
) -> FitResult:
    """The result, its residuals in units of the noise that was found."""
    r, J = np.array(found.r, float), np.array(found.J, float)
    for rows, factor in zip(problem.rows, factors, strict=True):
        r[rows], J[rows] = r[rows] / factor, J[rows] / factor
    eps = float(jnp.finfo(problem.dtype).eps)
    estimated = [(rows, f) for rows, f, given in zip(problem.rows, freedoms, known, strict=True) if not given]
    errors = uncertainty(J, eps, estimated)
    experiments = problem.at(found.z)
    priors = len(r) - problem.rows[-1].stop
    counts = [o.count for o in problem.observations]
    noises = tuple(
        NoiseEstimate(
            o.name,
            float(np.sqrt((np.asarray(sigma) ** 2).mean())),
            not given,
            float(np.sqrt((r[rows] ** 2).sum() / max(count, 1))),
            count,
        )
        for o, sigma, given, rows, count in zip(problem.observations, sigmas, known, problem.rows, counts, strict=True)
    )
    result = FitResult(
        estimates=_estimates(problem, found.z, errors, level),
        reported=tuple(_reported(problem, found.z, errors, level, name, of) for name, of in report.items()),
        covariance=errors.covariance,
        correlation=errors.correlation,
        spectrum=errors.spectrum,
        directions=errors.directions,
        chi_squared=float((r**2).sum()),
        degrees_of_freedom=sum(counts) + priors - errors.rank,
        noise=noises,
        experiments=experiments,
        values={n: np.asarray(v) for n, v in zip(problem.names, problem.values(found.z), strict=True)},
        level=level,
        converged=found.converged,
        history=found.history,
        warnings=tuple(seen_together(problem.labels, errors, problem.logarithmic)),
    )
    if result.p_value < _IMPROBABLE:
        text = (
            f"The misfit is {np.sqrt(result.chi_squared / result.degrees_of_freedom):.2g} times the noise given: the "
            "model or its discretisation does not explain the data, and the errors are too small by as much or more."
        )
        result = replace(result, warnings=(*result.warnings, text))
    return result


def _estimates(problem: FitProblem, z: Coordinates, errors: Uncertainty, level: float) -> tuple[Estimate, ...]:
    """The fitted numbers. An interval is symmetric in the coordinate, so it lies within the bounds."""
    each_error = [errors.of(unit) for unit in np.eye(problem.size)]
    reach = jnp.asarray([quantile(level, freedom) * error for error, freedom in each_error], z.dtype)
    lower, upper = (problem.values(z + side * reach) for side in (-1, 1))
    at, slope = jax.jvp(problem.values, (z,), (jnp.ones_like(z),))
    numbers = zip(
        problem.labels, *(_flat(a) for a in (at, slope, lower, upper, problem.starts)), errors.error, strict=True
    )
    each = zip(problem.parameters, problem.starts, problem.coordinates(z), strict=True)
    bound = [(p.unit, bool(at)) for p, start, part in each for at in p.at_bound(start, part).reshape(-1)]
    return tuple(
        Estimate(label, value, abs(by) * error, (min(a, b), max(a, b)), unit, start, at_bound)
        for (label, value, by, a, b, start, error), (unit, at_bound) in zip(numbers, bound, strict=True)
    )


def _reported(
    problem: FitProblem, z: Coordinates, errors: Uncertainty, level: float, name: str, of: Callable[[Experiment], Any]
) -> Estimate:
    """A function of the first experiment, its error by its derivative."""

    def value(z: Coordinates) -> Array:
        return jnp.asarray(of(problem.at(z)[0]))

    error, freedom = errors.of(np.asarray(jax.jacfwd(value)(z), float))
    number, reach = float(value(z)), quantile(level, freedom) * error
    return Estimate(name, number, error, (number - reach, number + reach), start=float(value(jnp.zeros_like(z))))


def _flat(arrays: tuple[Array, ...]) -> list[float]:
    return [float(x) for a in arrays for x in np.asarray(a).reshape(-1)]


def _line(problem: FitProblem, iteration: Iteration, seconds: float) -> str:
    """Progress."""
    values = _flat(problem.values(jnp.asarray(iteration.z, problem.dtype)))
    shown = ", ".join(f"{label} {value:.5g}" for label, value in zip(problem.labels[:4], values, strict=False))
    more = ", …" if problem.size > 4 else ""
    return (
        f"{iteration.number:4d}  misfit {2 * iteration.cost:10.4g}  gradient {iteration.gradient:8.2g}  {shown}{more}  "
        f"{seconds:.1f} s"
    )


_NOISE_RTOL = 1e-3
"""The noise of several observations is settled when its estimate changes less, relatively."""
_MOST_ROUNDS = 20
_LEAST = 1e-12
"""Smallest noise, in sizes of the data: exact data have none."""
_ROUNDINGS = 10
"""Derivatives by a coordinate below so many roundings of the data are none."""
_IMPROBABLE = 1e-3
_ADVICE = "Raise max_steps, start closer, or give a rtol that the precision can reach."
