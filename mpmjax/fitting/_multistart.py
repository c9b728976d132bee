"""Fits from many starting points, and the minima that they lead to."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int, Scalar
from mpmjax.checks import checked, require, require_between, require_finite, require_whole, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import chosen_optimiser, fit, require_influence
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult, restarted, table_of_minima
from mpmjax.fitting._search import AbstractOptimiser, Evaluation, Search, batch_size, counted, search_many

Ranges = Mapping[str, tuple[float, float]]  # lowest and highest value to start from, by the name of a parameter
Ends = list[tuple[Search, list[int]]]  # minima, with the numbers of the points that led there


class LocalMinimum(NamedTuple):
    """A minimum at which searches ended."""

    values: dict[str, np.ndarray]  # the value of each parameter, in its shape
    misfit: float  # root mean square of the residuals, in units of σ, or of the size of the data where σ is not given
    searches: int  # how many searches ended there
    members: tuple[int, ...]  # the numbers, from 0, of the points that these searches stand for; the first guess is 0


class MultistartFit(AbstractFit):
    """The best of many fits, and the other minima; `result["E"]` is the estimate of a parameter by the best."""

    best: FitResult  # the fit from the best minimum, with its errors
    minima: tuple[LocalMinimum, ...]  # the distinct minima, the best first
    starts: dict[str, np.ndarray]  # the points: the values of each parameter, shape (k, ...)
    searched: tuple[int, ...]  # the numbers of the points from which searches started
    failures: dict[int, str]  # why the simulation at a point, or the search from it, failed, by the number of the point
    unfinished: tuple[int, ...]
    """The numbers of the points from which no search came to a minimum within the optimiser's steps."""
    iterations: int  # how many iterations all searches took

    @property
    def all(self) -> tuple[Estimate, ...]:
        return self.best.all

    @property
    def count(self) -> int:
        """Number of points."""
        return len(next(iter(self.starts.values())))

    def __str__(self) -> str:
        """The table of the best fit, then one of the minima."""
        minima, labels = self.minima[:_SHOWN], self.best.problem.labels
        cells = [(f"{len(m.members):>24}", f"{m.searches:>8}") for m in minima]
        counts = f"{self.count} points, {len(self.searched)} searches, {self.iterations} iterations"
        rows = table_of_minima((f"{'points':>24}", "searches"), cells, minima, labels)
        lines = [str(self.best), "", counts, *rows]
        if len(self.minima) > _SHOWN:
            lines.append(f"and {len(self.minima) - _SHOWN} minima with a larger misfit.")
        if self.unfinished:
            lines.append(f"{len(self.unfinished)} of {self.count} points led to no minimum.")
        if self.failures:
            shown = ", ".join(map(str, list(self.failures)[:_SHOWN])) + (", …" if len(self.failures) > _SHOWN else "")
            lines.append(f"{len(self.failures)} of {self.count} points failed, number {shown}.")
        return "\n".join(lines)


@checked
def fit_multistart(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    starts: int = 64,
    fraction: Scalar = 0.375,
    ranges: dict[str, tuple[float, float]] | None = None,
    seed: int = 0,
    batch: int | None = None,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> MultistartFit:
    """Look over many points for where fits start: the best minimum, with its errors, and what other minima there are.

        result = mpm.fitting.fit_multistart(pull, {"E": ...}, starts=64, ranges={"E": (1e4, 1e7)})
        print(result)

    The points are the first guess and scrambled Sobol points (see `ranges`). The simulation runs once at each of them,
    without derivatives. Searches start from the first guess, from a fraction of the points, the best ones, and from
    each that has no better one within the critical distance of multi-level single linkage (A. H. G. Rinnooy Kan, G. T.
    Timmer, Mathematical Programming 39 (1987) 57-78). They stand for the others, each of which is linked to the nearest
    better one. Where a search comes to no minimum, the points that it stood for are linked anew, without it.

    Searches run together, `batch` in one compiled program. Points and searches whose simulation fails hinder no others.
    A search that comes within a hundredth, in each coordinate, of another with a lower cost is ended, and counted where
    that one ends; one whose sum of squares three moves, or six iterations, have lowered by less than a hundredth is
    ended there, as at a minimum. Those that come within twice the least sum of squares are searched on, and the best is
    then fitted as `fit` does.

    Two searches ended at one minimum where their coordinates differ by less than two hundredths, or where the misfit
    hides the difference: Δᵀ JᵀJ Δ ≤ n s² of n coordinates, J and s² = Σ r²/(m − n), or one if σ is given and that is
    less, being those of the better one. Where σ is not given, searches take the size of the data in its place: several
    observations without one weigh alike in them, and are only weighed by their noise in the last fit.

    Args:
        experiments, parameters, report, level: see `fit`.
        starts: how many points, the first guess among them.
        fraction: of the points, the best ones, from which searches start whatever is near. 1 searches from all of them,
            without a look; 0 only from those of single linkage and the first guess.
        ranges: lowest and highest value to start from, by the name of a parameter. Default: its prior, or its bounds,
            from a tenth to ten times the first guess of a `Positive`, one coordinate each way of an `Unbounded` one.
        seed: of the starting points.
        batch: how many points, and searches, run together. Default: eight with explicit steps, one with implicit ones.
        optimiser: the method of each search, and of the last fit. Default: as `fit` chooses.
        progress: called with a line, such as `print`, as points are done, as searches end, and by the last fit.

    Raises:
        ValueError: as `fit`; a range of no parameter, or outside of its bounds; no search that came to a minimum.
        SimulationError: no search came to a minimum, and the simulation at the first guess meets a fault.
    """
    require_whole("starts", starts, 1)
    require_between("fraction", fraction, 0, 1)
    problem = FitProblem(experiments, parameters)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    shares = unit_points(starts - 1, problem.size, require_whole("seed", seed, 0))
    points = starting_points(problem, shares, dict(ranges or {}))
    sigmas, size, costs = problem.first_sigmas, batch_size(problem, batch, starts), np.zeros(starts)
    if fraction < 1:
        told = counted(progress, "{} of {} simulations are done", again=False)
        costs = costs_at(problem, points, sigmas, size, told)
    failures = {int(k): _FAILS for k in np.flatnonzero(~np.isfinite(costs))}
    together = partial(search_many, [(problem, sigmas)], optimiser, batch=size, joining=_JOINED)

    def begun(number: int, seen: Evaluation) -> None:
        if number == 0:
            require_influence(problem, sigmas, seen)

    # Searches from the points that stand for others, until each point is stood for by one that came to a minimum.
    members: dict[int, Search] = {}
    while True:
        # The first guess, which is none of the cube's points, stands for itself.
        others = linked(shares, costs[1:], fraction)
        stands = [0 if np.isfinite(costs[0]) else -1, *np.where(others < 0, -1, others + 1).tolist()]
        chosen = sorted(set(stands) - {-1, *members}, key=lambda k: (k > 0, costs[k]))
        if not chosen:
            break
        told = counted(progress, "{} of {} searches are done", again=False)
        members |= together({k: points[k] for k in chosen}, settling=_SETTLED, progress=told, begun=begun)
        if any(m.interrupted for m in members.values()):
            break
        costs[[k for k in chosen if _end(members, k) is None]] = np.nan
    failures |= {k: m.failure for k, m in members.items() if m.failure}
    ends: dict[int, list[int]] = {}
    for k, by in enumerate(stands):
        if by >= 0 and (end := _end(members, by)) is not None:
            ends.setdefault(end, []).append(k)
    groups = _grouped(problem, [(members[end], numbers) for end, numbers in ends.items()])
    if not groups:
        failure = f"No search of {len(members)} came to a minimum: {failures.get(0, 'raise max_steps')}."
        problem.explain(jnp.zeros(problem.size, problem.dtype), failure)
    # Those near to the best one are searched on, without settling.
    near = sum(end.cost <= _NEAR_BEST * groups[0][0].cost for end, _ in groups[:_SHOWN])
    further = together({k: groups[k][0].z for k in range(near)})
    on = [(groups[k][0] if m.failure else m, groups[k][1]) for k, m in further.items()]
    groups = _grouped(problem, [*on, *groups[near:]])
    minima = tuple(
        LocalMinimum(
            problem.by_name(end.z), problem.misfit(end.cost), len(members.keys() & numbers), tuple(sorted(numbers))
        )
        for end, numbers in groups
    )
    start = restarted(parameters, minima[0].values)
    best = fit(experiments, start, report=report, level=level, optimiser=optimiser, progress=progress)
    ended = {k for _, numbers in groups for k in numbers}
    if minima[0].searches == 1 and len(ended & members.keys()) > 1:
        warn(
            f"The best minimum was found by one search of {len(members)}: there may be a better one. Take more starts, "
            "a larger fraction, or narrower ranges."
        )
    values = [problem.by_name(jnp.asarray(point, problem.dtype)) for point in points]
    return MultistartFit(
        best=best,
        minima=minima,
        starts={name: np.stack([v[name] for v in values]) for name in problem.names},
        searched=tuple(sorted(members)),
        failures=dict(sorted(failures.items())),
        unfinished=tuple(k for k in range(starts) if k not in ended and k not in failures),
        iterations=sum(len(m.history) for m in (*members.values(), *further.values()) if not m.failure),
    )


def costs_at(
    problem: FitProblem,
    points: Float[np.ndarray, "k n"],
    sigmas: Sigmas,
    batch: int,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> Float[np.ndarray, "k"]:
    """½ Σ r² at many points, without derivatives; NaN where a simulation fails. `batch` are computed together, and
    `progress` is called with how many are done, and of how many."""
    costs = np.empty(len(points))
    for first in range(0, len(points), batch):
        rows = points[np.minimum(np.arange(first, first + batch), len(points) - 1)]
        costs[first : first + batch] = _costs(problem, rows, sigmas)[: len(points) - first]
        progress(min(first + batch, len(points)), len(points))
    return costs


@eqx.filter_jit
def _costs(problem: FitProblem, points: Float[np.ndarray, "b n"] | Array, sigmas: Sigmas) -> Float[Array, "b"]:
    """½ Σ r² at some points together, compiled."""

    def cost(z: Coordinates) -> Array:
        r, _ = problem.residuals(z, sigmas, diffrax.ForwardMode())
        return (r**2).sum() / 2

    return jax.vmap(cost)(jnp.asarray(points, problem.dtype))


def _end(members: dict[int, Search], k: int) -> int | None:
    """The number of the search at whose minimum a search ended; None if it came to none."""
    while (joined := members[k].joined) is not None:
        k = joined
    return k if members[k].converged else None


def _grouped(problem: FitProblem, ends: Ends) -> Ends:
    """The distinct minima, the lowest first, with the numbers of the points that lead there."""
    groups: Ends = []
    for minimum, points in sorted(ends, key=lambda pair: pair[0].cost):
        for better, numbers in groups:
            change = np.asarray(minimum.z - better.z, float)
            r, J = np.asarray(better.seen.residuals, float), np.asarray(better.seen.jacobian, float)
            variance = float((r**2).sum()) / max(np.count_nonzero(r) - len(change), 1)
            variance = max(variance, 1.0 if all(problem.noise_is_given) else 0.0)
            if (np.abs(change) <= _NEAR).all() or ((J @ change) ** 2).sum() <= len(change) * variance:
                numbers += points
                break
        else:
            groups.append((minimum, list(points)))
    return groups


def unit_points(count: int, size: int, seed: int) -> Float[np.ndarray, "k n"]:
    """Scrambled Sobol points of the open unit cube of `size` dimensions, which fill it evenly (SciPy's)."""
    from scipy.stats import qmc  # here, since it takes long to import

    exponent = max(int(np.ceil(np.log2(max(count, 1)))), 0)
    sobol = qmc.Sobol(size, seed=seed)  # pyright: ignore[reportCallIssue] (rng from SciPy 1.15 on)
    return np.clip(sobol.random_base2(exponent)[:count], _EDGE, 1 - _EDGE)


def starting_points(problem: FitProblem, shares: Float[np.ndarray, "k n"], ranges: Ranges) -> Float[np.ndarray, "l n"]:
    """Coordinates of the first guess, and of points of the unit cube, its sides as `ranges` of `fit_multistart` says.
    The range of a positive parameter is one of its logarithm.
    """
    unknown = sorted(set(ranges) - set(problem.names))
    require(not unknown, f"ranges must be of parameters ({', '.join(problem.names)}), got {', '.join(unknown)}.")
    columns, column = [], 0
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        share = shares[:, column : column + start.size].reshape(-1, *start.shape)
        column += start.size
        first, (lowest, highest), limits = np.asarray(start, float), parameter.domain, ranges.get(name)
        prior = None if parameter.prior is None else parameter.prior.distribution()
        lower, upper = np.asarray(lowest), np.asarray(highest)
        if limits is not None:
            require(len(limits) == 2, f"The range of {name!r} must be two numbers, got {len(limits)}.")
            require_finite(f"The range of {name!r}", np.asarray(limits, float))
            inside = lowest <= limits[0] < limits[1] <= highest and (limits[0] > 0 or not parameter.logarithmic)
            within = "positive numbers" if parameter.logarithmic else f"between {lowest:g} and {highest:g}"
            require(inside, f"The range of {name!r} must grow and be {within}, got {limits[0]:g} to {limits[1]:g}.")
            lower, upper = (np.asarray(float(limit)) for limit in limits)
        elif prior is None and parameter.logarithmic:
            lower, upper = first / _DECADE, first * _DECADE
        elif prior is None and not np.isfinite([lowest, highest]).all():
            ends = (parameter.value(jnp.asarray(first), jnp.full(first.shape, side)) for side in (-1.0, 1.0))
            lower, upper = (np.asarray(end) for end in ends)
        if limits is None and prior is not None:
            from scipy.special import ndtr, ndtri  # here, since it takes long to import

            mean, sigma = prior
            below, above = ndtr((lowest - mean) / sigma), ndtr((highest - mean) / sigma)
            values = mean + sigma * ndtri(below + share * (above - below))
        elif parameter.logarithmic:
            values = np.exp(np.log(lower) + share * (np.log(upper) - np.log(lower)))
        else:
            values = lower + share * (upper - lower)
        z = parameter.coordinate(start, jnp.asarray(values, start.dtype))
        columns.append(np.asarray(z, float).reshape(len(share), -1))
    return np.concatenate([np.zeros((1, problem.size)), np.concatenate(columns, axis=1)])


def linked(shares: Float[np.ndarray, "k n"], costs: Float[np.ndarray, "k"], fraction: Scalar) -> Int[np.ndarray, "k"]:
    """For each point the number of the one that stands for it, from which a search starts; its own where one starts
    there, and -1 where the cost is not finite.

    In multi-level single linkage a search starts from each point that has no better one within the critical distance

        r = π^(-1/2) (Γ(1 + n/2) σ ln k / k)^(1/n),  σ = 2,

    of k even points of the unit cube: in a ball of this radius lie σ ln k of them. Any other point is linked to the
    nearest better one, and so on to one that is searched from. On a rough function that is too few: a fraction of all
    points, the best ones, is searched from besides.

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
        distances = np.linalg.norm(shares[better] - shares[k], axis=1)
        alone = place < fraction * count or (distances > near).all()
        stands[k] = k if alone else stands[better[distances.argmin()]]
    return stands


def critical_distance(count: int, size: int) -> float:
    """The radius of a ball in which σ ln k of k points of the unit cube of n dimensions lie, but for its boundary."""
    if count < 2:
        return 0.0
    logarithm = math.lgamma(1 + size / 2) + np.log(_SIGMA * np.log(count) / count)
    return float(np.exp(logarithm / size) / np.sqrt(np.pi))


_FAILS = "the simulation fails there, or does not reach the data"
_JOINED = 0.01  # a search so near to a better one, in each coordinate, would go the same way
_SETTLED = 1e-2  # a search that lately lowered its sum of squares by less than this part is at a minimum
_NEAR_BEST = 2.0  # searches that end within this factor of the least sum of squares are searched on
_NEAR = 0.02  # ends of searches so near in each coordinate are one minimum
_SHOWN = 8  # how many minima a table shows
_EDGE = 1e-3  # shares nearer to 0 and 1 are none: a start at a bound does not move
_DECADE = 10.0  # how far from the first guess a positive parameter starts, as a factor
_SIGMA = 2.0  # σ of the critical distance
