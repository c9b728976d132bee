"""The numbers of a fit and their errors."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array
from mpmjax.checks import require
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._problem import Coordinates, FitProblem
from mpmjax.fitting._result import Estimate, FitResult, NoiseEstimate
from mpmjax.fitting._search import Minimum
from mpmjax.fitting._uncertainty import Uncertainty, at_bound, noise, quantile, seen_together, uncertainty


def noise_factors(problem: FitProblem, found: Minimum) -> tuple[list[float], list[float]]:
    """By what each noise is to be multiplied, and the degrees of freedom of its estimate (zero of what is given)."""
    r, J = np.asarray(found.r), np.asarray(found.J)
    J = J[:, ~at_bound(r, J, np.asarray(problem.room(found.z)))]  # what a bound holds fits nothing away
    factors, freedoms = [], []
    for observation, rows, given in zip(problem.observations, problem.rows, problem.noise_is_given, strict=True):
        factor, freedom = (1.0, 0.0) if given else noise(r, J, rows, observation.count, *observation.trust)
        require(
            np.isfinite(factor),
            f"The noise of {observation.name!r} cannot be estimated from its {observation.count} numbers: the "
            "parameters use all of them up. Give its sigma.",
        )
        factors.append(factor)
        freedoms.append(freedom)
    return factors, freedoms


def settle_noise(
    problem: FitProblem, found: Minimum, sigmas: tuple[Array, ...]
) -> tuple[list[float], list[float], tuple[Array, ...], bool]:
    """What a minimum says of the noise: by what each is to be multiplied, the degrees of freedom of its estimate, the
    noise, and whether that moves the minimum, so that it must be searched again."""
    estimated, freedom = noise_factors(problem, found)
    floor = [_LEAST * o.scale() / float(np.max(s)) for o, s in zip(problem.observations, sigmas, strict=True)]
    factors = [max(factor, least) for factor, least in zip(estimated, floor, strict=True)]
    sigmas = tuple(sigma * factor for sigma, factor in zip(sigmas, factors, strict=True))
    changing = any(
        abs(factor - 1) > _NOISE_RTOL and factor > least for factor, least in zip(factors, floor, strict=True)
    )
    return factors, freedom, sigmas, changing and not problem.scales_alike


def fit_result(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    found: Minimum,
    factors: list[float],
    freedoms: list[float],
    sigmas: tuple[Array, ...],
    report: Mapping[str, Callable[[Experiment], Any]],
    level: float,
) -> FitResult:
    """The result at a minimum.

    Args:
        problem: what was fitted.
        optimiser: by which method.
        found: the minimum, its residuals in units of the noise of its search.
        factors: by what the noise was found to be larger than in that search.
        freedoms: degrees of freedom of each estimate of the noise.
        sigmas: the noise that was found.
        report: see `fit`.
        level: of the intervals.
    """
    r, J = np.array(found.r, float), np.array(found.J, float)
    for rows, factor in zip(problem.rows, factors, strict=True):
        r[rows], J[rows] = r[rows] / factor, J[rows] / factor
    eps = float(jnp.finfo(problem.dtype).eps)
    given = problem.noise_is_given
    estimated = [(rows, f) for rows, f, known in zip(problem.rows, freedoms, given, strict=True) if not known]
    errors = uncertainty(J, eps, estimated)
    held = at_bound(r, J, np.asarray(problem.room(found.z)))
    priors = len(r) - problem.rows[-1].stop
    counts = [o.count for o in problem.observations]
    noises = tuple(
        NoiseEstimate(
            o.name,
            float(np.sqrt((np.asarray(sigma) ** 2).mean())),
            not known,
            float(np.sqrt((r[rows] ** 2).sum() / max(count, 1))),
            count,
        )
        for o, sigma, known, rows, count in zip(problem.observations, sigmas, given, problem.rows, counts, strict=True)
    )
    result = FitResult(
        problem=problem,
        z=np.asarray(found.z),
        sigmas=sigmas,
        residuals=r,
        jacobian=J,
        uncertainty=errors,
        estimates=_estimates(problem, found.z, errors, (J.T @ r) * held, held, level),
        reported=tuple(_reported(problem, found.z, errors, level, name, of) for name, of in report.items()),
        chi_squared=float((r**2).sum()),
        degrees_of_freedom=sum(counts) + priors - errors.rank + int(held.sum()),
        noise=noises,
        experiments=problem.at(found.z),
        level=level,
        optimiser=optimiser,
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


def _estimates(
    problem: FitProblem, z: Coordinates, errors: Uncertainty, gradient: np.ndarray, held: np.ndarray, level: float
) -> tuple[Estimate, ...]:
    """The fitted numbers.

    Args:
        problem: what was fitted.
        z: the coordinates found.
        errors: their uncertainty.
        gradient: the derivative of ½ Σ r² by those that a bound holds, zero of the others.
        held: which these are.
        level: of the intervals.
    """
    error = errors.of(np.eye(problem.size))[0]
    slope = np.asarray(jax.jvp(problem.numbers, (z,), (jnp.ones_like(z),))[1], float)
    lower, upper = intervals(problem, z, errors, gradient, level)
    columns = problem.numbers(z), np.abs(slope) * error, lower, upper, problem.numbers(jnp.zeros_like(z)), held
    units = [p.unit for p, start in zip(problem.parameters, problem.starts, strict=True) for _ in range(start.size)]
    return tuple(
        Estimate(label, value, error, (a, b), unit, start, at_bound)
        for label, unit, value, error, a, b, start, at_bound in zip(
            problem.labels, units, *(np.asarray(column).tolist() for column in columns), strict=True
        )
    )


def intervals(
    problem: FitProblem, z: Coordinates, errors: Uncertainty, gradient: np.ndarray, level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper ends of the fitted numbers' intervals, each of shape (n,).

    They are where Δχ² = 2 g δ + δ²/s² reaches its threshold q², s being the standard error and g the gradient, zero but
    of what a bound holds. δ is of the coordinate. Beside a bound, at three times the reach or nearer, data that follow
    the value would be missed too often: there each end is the farther of two, of the coordinate and of a straight line
    in the value. Where that line meets the bound, it alone makes the interval, which ends there: the coordinate never
    comes to a bound, and goes beyond all measure to the other side.

    Args:
        problem: what was fitted.
        z: the coordinates found.
        errors: their uncertainty.
        gradient: g, shape (n,).
        level: of the intervals.
    """
    error, freedom = errors.of(np.eye(problem.size))
    q = quantile(level, freedom)
    pull = np.where(np.isfinite(error), gradient, 0) * np.where(np.isfinite(error), error, 1)
    root = np.hypot(pull, q)
    down, up = np.asarray(problem.room(z), float)
    below, above = error * (root + pull), error * q**2 / (root + pull)
    at, slope = (np.asarray(a, float) for a in jax.jvp(problem.numbers, (z,), (jnp.ones_like(z),)))
    straight = at - slope * np.minimum(below, down), at + slope * np.minimum(above, up)
    curved = (problem.numbers(z + side * jnp.asarray(q * error, z.dtype)) for side in (-1, 1))
    meets, near = ((times * below >= down) | (times * above >= up) for times in (1, _BESIDE))
    lower, upper = (
        np.where(meets, line, np.where(near, farther(line, curve), curve))
        for line, curve, farther in zip(straight, np.array(list(curved), float), (np.minimum, np.maximum), strict=True)
    )
    each = zip(problem.parameters, problem.starts, strict=True)
    ends = np.array([p.domain for p, start in each for _ in range(start.size)]).T
    return np.clip(lower, *ends), np.clip(upper, *ends)


def _reported(
    problem: FitProblem, z: Coordinates, errors: Uncertainty, level: float, name: str, of: Callable[[Experiment], Any]
) -> Estimate:
    """A function of the first experiment, its error by its derivative."""

    def value(z: Coordinates) -> Array:
        return jnp.asarray(of(problem.at(z)[0]))

    error, freedom = errors.of(np.asarray(jax.jacfwd(value)(z), float))
    number, reach = float(value(z)), float(quantile(level, freedom) * error)
    return Estimate(name, number, float(error), (number - reach, number + reach), start=float(value(jnp.zeros_like(z))))


_IMPROBABLE = 1e-3
"""Probability of a χ² from which the model is said not to explain the data."""
_BESIDE = 3
"""Reaches of an interval within which it is beside a bound."""
_NOISE_RTOL = 1e-3
"""The noise of several observations is settled when its estimate changes less, relatively."""
_LEAST = 1e-12
"""Smallest noise, in sizes of the data: exact data have none."""
