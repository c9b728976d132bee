"""Starting points of many searches of one problem, and those that searches start from: single linkage."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import gammaln, ndtr, ndtri

from mpmjax._types import Array, Float, Int, Scalar
from mpmjax.checks import require, require_finite
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest value to start from, by the name of a parameter."""


def unit_points(count: int, size: int, seed: int) -> Float[np.ndarray, "k n"]:
    """Scrambled Sobol points of the open unit cube of `size` dimensions, which fill it evenly (SciPy's)."""
    from scipy.stats import qmc  # here, since it takes long to import

    exponent = max(int(np.ceil(np.log2(max(count, 1)))), 0)
    sobol = qmc.Sobol(size, seed=seed)  # pyright: ignore[reportCallIssue] (rng from SciPy 1.15 on)
    return np.clip(sobol.random_base2(exponent)[:count], _EDGE, 1 - _EDGE)


def starting_points(problem: FitProblem, shares: Float[np.ndarray, "k n"], ranges: Ranges) -> Float[np.ndarray, "l n"]:
    """Coordinates of the first guess, and of points of the unit cube.

    A parameter's side of the cube is its range, if it has one, else its prior's distribution, else from bound to
    bound, else from a tenth to ten times the first guess of a positive one, and one coordinate to each side of any
    other. The range of a positive parameter is one of its logarithm.

    Raises:
        ValueError: a range of no parameter, or outside of its bounds.
    """
    unknown = sorted(set(ranges) - set(problem.names))
    require(not unknown, f"ranges must be of parameters ({', '.join(problem.names)}), got {', '.join(unknown)}.")
    parts, column = [], 0
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        part = shares[:, column : column + start.size].reshape(-1, *start.shape)
        parts.append(_spread(name, parameter, start, part, ranges.get(name)).reshape(len(part), -1))
        column += start.size
    return np.concatenate([np.zeros((1, problem.size)), np.concatenate(parts, axis=1)])


def _spread(
    name: str, parameter: AbstractParameter, start: Array, shares: np.ndarray, limits: tuple[float, float] | None
) -> np.ndarray:
    """Coordinates of a parameter at shares of its distribution between 0 and 1, shape (k, ...)."""
    first, (lowest, highest) = np.asarray(start, float), parameter.domain
    prior = None if parameter.prior is None else parameter.prior.distribution()
    if limits is None and prior is not None:
        mean, sigma = prior
        below, above = ndtr((lowest - mean) / sigma), ndtr((highest - mean) / sigma)
        values = mean + sigma * ndtri(below + shares * (above - below))
    else:
        lower, upper = _range(name, parameter, first, limits)
        if parameter.logarithmic:
            values = np.exp(np.log(lower) + shares * (np.log(upper) - np.log(lower)))
        else:
            values = lower + shares * (upper - lower)
    return np.asarray(parameter.coordinate(start, jnp.asarray(values, start.dtype)), float)


def _range(
    name: str, parameter: AbstractParameter, first: np.ndarray, limits: tuple[float, float] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value to start from."""
    lowest, highest = parameter.domain
    if limits is not None:
        require(len(limits) == 2, f"The range of {name!r} must be two numbers, got {len(limits)}.")
        require_finite(f"The range of {name!r}", np.asarray(limits, float))
        inside = lowest <= limits[0] < limits[1] <= highest and (limits[0] > 0 or not parameter.logarithmic)
        within = "positive numbers" if parameter.logarithmic else f"between {lowest:g} and {highest:g}"
        require(inside, f"The range of {name!r} must grow and be {within}, got {limits[0]:g} to {limits[1]:g}.")
        return np.asarray(float(limits[0])), np.asarray(float(limits[1]))
    if np.isfinite([lowest, highest]).all():
        return np.asarray(lowest), np.asarray(highest)
    if parameter.logarithmic:
        return np.asarray(first / _DECADE), np.asarray(first * _DECADE)
    ends = [np.asarray(parameter.value(jnp.asarray(first), jnp.full(first.shape, side))) for side in (-1.0, 1.0)]
    return ends[0], ends[1]


def linked(shares: Float[np.ndarray, "k n"], costs: Float[np.ndarray, "k"], fraction: Scalar) -> Int[np.ndarray, "k"]:
    """For each point the number of the one that stands for it, from which a search starts; its own where one starts
    there, and -1 where the cost is not finite.

    Multi-level single linkage (A. H. G. Rinnooy Kan, G. T. Timmer, Mathematical Programming 39 (1987) 57-78): a search
    starts from each point that has no better one within the critical distance

        r = π^(-1/2) (Γ(1 + n/2) σ ln k / k)^(1/n),  σ = 2,

    of k even points of the unit cube: in a ball of this radius lie σ ln k of them. Any other point is linked to the
    nearest better one, and so on to one that is searched from. On a rough function that is too few: a fraction of all
    points, the best ones, is searched from besides, whatever their neighbours.

    Args:
        shares: the points, evenly spread over the unit cube.
        costs: the function there; not finite where it fails.
        fraction: from 0, none besides, to 1, all.
    """
    count, size = shares.shape
    stands = np.full(count, -1)
    usable = np.isfinite(costs)
    order = np.argsort(np.where(usable, costs, np.inf), kind="stable")[: usable.sum()]
    near = critical_distance(count, size)
    for place, k in enumerate(order):
        better = order[:place]
        distances = cdist(shares[k : k + 1], shares[better])[0]
        alone = place < fraction * count or (distances > near).all()
        stands[k] = k if alone else stands[better[distances.argmin()]]
    return stands


def critical_distance(count: int, size: int) -> float:
    """The radius of a ball in which σ ln k of k points of the unit cube of n dimensions lie, but for its boundary."""
    if count < 2:
        return 0.0
    logarithm = gammaln(1 + size / 2) + np.log(_SIGMA * np.log(count) / count)
    return float(np.exp(logarithm / size) / np.sqrt(np.pi))


_EDGE = 1e-3
"""Shares nearer to 0 and 1 are none: a start at a bound does not move."""
_DECADE = 10.0
"""How far from the first guess a positive parameter starts, as a factor."""
_SIGMA = 2.0
"""σ of the critical distance."""
