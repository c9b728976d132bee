"""Where many searches of one problem start."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from scipy.special import ndtr, ndtri

from mpmjax._types import Array, Float
from mpmjax.checks import require, require_finite
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest value to start from, by the name of a parameter."""


def unit_points(count: int, size: int, seed: int) -> Float[np.ndarray, "k n"]:
    """Scrambled Sobol points of the open unit cube, which fill it evenly (SciPy's).

    Args:
        count: how many, k.
        size: dimension of the cube, n.
        seed: of the scrambling.
    """
    from scipy.stats import qmc

    exponent = max(int(np.ceil(np.log2(max(count, 1)))), 0)
    sobol = qmc.Sobol(size, seed=seed)  # pyright: ignore[reportCallIssue] (rng from SciPy 1.15 on)
    return np.clip(sobol.random_base2(exponent)[:count], _EDGE, 1 - _EDGE)


def starting_points(problem: FitProblem, shares: Float[np.ndarray, "k n"], ranges: Ranges) -> Float[np.ndarray, "l n"]:
    """Coordinates of the first guess and of points of the unit cube.

    The cube's sides are, of a parameter, its range, if it has one, else its prior's distribution, else from bound to
    bound, else from a tenth to ten times the first guess of a positive one, and one coordinate to each side of any
    other. The range of a positive parameter is one of its logarithm.

    Args:
        problem: what is fitted.
        shares: the points of the unit cube.
        ranges: see above.

    Returns:
        one more than points.

    Raises:
        ValueError: a range of no parameter, or outside of its bounds.
    """
    unknown = sorted(set(ranges) - set(problem.names))
    require(not unknown, f"ranges must be of parameters ({', '.join(problem.names)}), got {', '.join(unknown)}.")
    parts, column = [], 0
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        own = shares[:, column : column + start.size].reshape(-1, *start.shape)
        parts.append(_spread(name, parameter, start, own, ranges.get(name)).reshape(len(own), -1))
        column += start.size
    return np.concatenate([np.zeros((1, problem.size)), np.concatenate(parts, axis=1)])


def _spread(
    name: str, parameter: AbstractParameter, start: Array, shares: np.ndarray, given: tuple[float, float] | None
) -> np.ndarray:
    """Coordinates of a parameter at shares of its distribution between 0 and 1, shape (k, ...)."""
    first, (lowest, highest) = np.asarray(start, float), parameter.domain
    known = None if parameter.prior is None else parameter.prior.distribution()
    if given is None and known is not None:
        mean, sigma = known
        below, above = ndtr((lowest - mean) / sigma), ndtr((highest - mean) / sigma)
        values = mean + sigma * ndtri(below + shares * (above - below))
    else:
        lower, upper = _range(name, parameter, first, given)
        if parameter.logarithmic:
            values = np.exp(np.log(lower) + shares * (np.log(upper) - np.log(lower)))
        else:
            values = lower + shares * (upper - lower)
    return np.asarray(parameter.coordinate(start, jnp.asarray(values, start.dtype)), float)


def _range(
    name: str, parameter: AbstractParameter, first: np.ndarray, given: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value to start from."""
    lowest, highest = parameter.domain
    if given is not None:
        require(len(given) == 2, f"The range of {name!r} must be two numbers, got {len(given)}.")
        require_finite(f"The range of {name!r}", np.asarray(given, float))
        inside = lowest <= given[0] < given[1] <= highest and (given[0] > 0 or not parameter.logarithmic)
        within = "positive numbers" if parameter.logarithmic else f"between {lowest:g} and {highest:g}"
        require(inside, f"The range of {name!r} must grow and be {within}, got {given[0]:g} to {given[1]:g}.")
        return np.asarray(float(given[0])), np.asarray(float(given[1]))
    if np.isfinite([lowest, highest]).all():
        return np.asarray(lowest), np.asarray(highest)
    if parameter.logarithmic:
        return np.asarray(first / _DECADE), np.asarray(first * _DECADE)
    ends = [np.asarray(parameter.value(jnp.asarray(first), jnp.full(first.shape, side))) for side in (-1.0, 1.0)]
    return ends[0], ends[1]


_EDGE = 1e-3
"""Shares nearer to 0 and 1 are none: a start at a bound does not move."""
_DECADE = 10.0
"""How far from the first guess a positive parameter starts, as a factor."""
