"""Fits from many starting points, and the minima that they lead to."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.distance import cdist
from scipy.special import gammaln, ndtr, ndtri

from mpmjax._types import Array, Float, Int, Scalar
from mpmjax.checks import checked, require, require_between, require_finite, require_whole, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import chosen_optimiser, fit, require_influence
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult, restarted, table_of_minima
from mpmjax.fitting._search import Member, Minimum, Problems, batch_size, counted, search_many

Ranges = Mapping[str, tuple[float, float]]  # lowest and highest value to start from, by the name of a parameter
Ends = list[tuple[Minimum, list[int]]]  # minima, with the numbers of the points that led there


class LocalMinimum(NamedTuple):
    """A minimum at which searches ended."""

    values: dict[str, np.ndarray]
    """The value of each parameter, in its shape."""
    misfit: float
    """Root mean square of the residuals, in units of σ, or of the size of the data where σ is not given."""
    searches: int
    """How many searches ended there."""
    members: tuple[int, ...]
    """The numbers, from 0, of the points that these searches stand for; the first guess is 0."""


class MultistartFit(AbstractFit):
    """The best of many fits, and the other minima.

    `print(result)` shows a table; `result["E"]` is the estimate of a parameter by the best.
    """

    best: FitResult
    """The fit from the best minimum, with its errors."""
    minima: tuple[LocalMinimum, ...]
    """The distinct minima, the best first."""
    starts: dict[str, np.ndarray]
    """The points: the values of each parameter, shape (k, ...)."""
    searched: tuple[int, ...]
    """The numbers of the points from which searches started."""
    failures: dict[int, str]
    """Why the simulation at a point, or the search from it, failed, by the number of the point."""
    unfinished: tuple[int, ...]
    """The numbers of the points from which no search came to a minimum within the optimiser's steps."""
    iterations: int
    """How many iterations all searches took."""

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

    The points are the first guess and scrambled Sobol points over the ranges; of a parameter without one, over its
    prior, between its bounds, from a tenth to ten times the first guess of a `Positive`, and one coordinate to each
    side of an `Unbounded` one. The simulation runs once at each of them, without derivatives. Searches start from the
    first guess, from a fraction of the points, the best ones, and from each that has no better one within the critical
    distance of multi-level single linkage (A. H. G. Rinnooy Kan, G. T. Timmer, Mathematical Programming 39 (1987)
    57-78). They stand for the others, each of which is linked to the nearest better one. Where a search comes to no
    minimum, the points that it stood for are linked anew, without it.

    Searches run together, `batch` in one compiled program; one that is done leaves its place to the next. Points and
    searches whose simulation fails hinder no others. A search that comes within a hundredth, in each coordinate, of
    another with a lower cost is ended, and counted where that one ends; one whose sum of squares three moves, or six
    iterations, have lowered by less than a hundredth is ended there, as at a minimum. Those that come within twice the
    least sum of squares are searched on, and the best is then fitted as `fit` does.

    Two searches ended at one minimum where their coordinates differ by less than two hundredths, or where the misfit
    hides the difference: Δᵀ JᵀJ Δ ≤ n s² of n coordinates, J and s² = Σ r²/(m − n), or one if σ is given and that is
    less, being those of the better one.

    Where σ is not given, searches take the size of the data in its place: several observations without one weigh alike
    in them, and are only weighed by their noise in the last fit.

    Args:
        experiments, parameters: see `fit`.
        starts: how many points, the first guess among them.
        fraction: of the points, the best ones, from which searches start whatever is near. 1 searches from all of them,
            without a look; 0 only from those of single linkage and the first guess.
        ranges: lowest and highest value to start from, by the name of a parameter.
        seed: of the starting points.
        batch: how many points, and searches, run together. Default: eight with explicit steps, one with implicit ones.
        report, level: see `fit`.
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
    noise = Problems.of([sigmas])
    together = partial(search_many, Problems.of([problem]), optimiser, sigmas=noise, batch=size, joining=_JOINED)
    members, stands = _searched(problem, sigmas, points, shares, costs, fraction, together, progress)
    failures |= {k: m.failure for k, m in members.items() if m.minimum is None}
    groups = _grouped(problem, _ends(members, stands))
    if not groups:
        failure = f"No search of {len(members)} came to a minimum: {failures.get(0, 'raise max_steps')}."
        problem.explain(jnp.zeros(problem.size, problem.dtype), failure)
    # Those near to the best one are searched on, without settling.
    near = sum(end.cost <= _NEAR_BEST * groups[0][0].cost for end, _ in groups[:_SHOWN])
    further = together(np.array([end.z for end, _ in groups[:near]], float))
    on = [(groups[k][0] if m.minimum is None else m.minimum, groups[k][1]) for k, m in enumerate(further)]
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
        iterations=sum(len(m.minimum.history) for m in (*members.values(), *further) if m.minimum is not None),
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


def _searched(
    problem: FitProblem,
    sigmas: Sigmas,
    points: Float[np.ndarray, "k n"],
    shares: Float[np.ndarray, "l n"],
    costs: Float[np.ndarray, "k"],
    fraction: Scalar,
    together: Callable[..., tuple[Member, ...]],
    progress: Callable[[str], None] | None,
) -> tuple[dict[int, Member], Int[np.ndarray, "k"]]:
    """Searches from the points that stand for the others, until each point is stood for by one that came to a minimum:
    the searches by the numbers of their points, and for each point the number of the one that stands for it, -1 where
    its cost is not finite."""
    members: dict[int, Member] = {}
    costs = costs.copy()
    while True:
        # The first guess, which is none of the cube's points, stands for itself.
        others = linked(shares, costs[1:], fraction)
        stands = np.concatenate([[0 if np.isfinite(costs[0]) else -1], np.where(others < 0, -1, others + 1)])
        chosen = sorted(set(stands.tolist()) - {-1, *members}, key=lambda k: (k > 0, costs[k]))
        if not chosen:
            return members, stands

        def begun(number: int, seen: Evaluation, chosen: list[int] = chosen) -> None:
            if chosen[number] == 0:
                require_influence(problem, sigmas, seen)

        told = counted(progress, "{} of {} searches are done", again=False)
        outcomes = together(points[chosen], settling=_SETTLED, progress=told, begun=begun)
        joined = [None if m.joined is None else chosen[m.joined] for m in outcomes]
        members |= {k: m._replace(joined=end) for k, m, end in zip(chosen, outcomes, joined, strict=True)}
        if any(m.interrupted for m in outcomes):
            return members, stands
        costs[[k for k in chosen if _end(members, k) is None]] = np.nan


def _end(members: dict[int, Member], k: int) -> int | None:
    """The number of the search at whose minimum a search ended; None if it came to none."""
    while (joined := members[k].joined) is not None:
        k = joined
    minimum = members[k].minimum
    return k if minimum is not None and minimum.converged else None


def _ends(members: dict[int, Member], stands: Int[np.ndarray, "k"]) -> Ends:
    """Where searches ended, with the numbers of the points that those stand for."""
    numbers: dict[int, list[int]] = {}
    for k, by in enumerate(stands.tolist()):
        end = None if by < 0 else _end(members, by)
        if end is not None:
            numbers.setdefault(end, []).append(k)
    ends = [(members[end].minimum, points) for end, points in numbers.items()]
    return [(minimum, points) for minimum, points in ends if minimum is not None]


def _grouped(problem: FitProblem, ends: Ends) -> Ends:
    """The distinct minima, the lowest first, with the numbers of the points that lead there."""
    groups: Ends = []
    least = 1.0 if all(problem.noise_is_given) else 0.0
    for minimum, points in sorted(ends, key=lambda pair: pair[0].cost):
        for better, numbers in groups:
            if _same(np.asarray(minimum.z - better.z, float), better, least):
                numbers += points
                break
        else:
            groups.append((minimum, list(points)))
    return groups


def _same(change: np.ndarray, better: Minimum, least: float) -> bool:
    """Whether an end of a search is the same minimum as a better one: `change` is the difference of their coordinates,
    `least` the least mean square of residuals."""
    r, J = np.asarray(better.r, float), np.asarray(better.J, float)
    variance = max(least, float((r**2).sum()) / max(np.count_nonzero(r) - len(change), 1))
    return bool((np.abs(change) <= _NEAR).all() or ((J @ change) ** 2).sum() <= len(change) * variance)


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


_FAILS = "the simulation fails there, or does not reach the data"
_JOINED = 0.01  # a search so near to a better one, in each coordinate, would go the same way
_SETTLED = 1e-2  # a search that lately lowered its sum of squares by less than this part is at a minimum
_NEAR_BEST = 2.0  # searches that end within this factor of the least sum of squares are searched on
_NEAR = 0.02  # ends of searches so near in each coordinate are one minimum
_SHOWN = 8  # how many minima a table shows
_EDGE = 1e-3  # shares nearer to 0 and 1 are none: a start at a bound does not move
_DECADE = 10.0  # how far from the first guess a positive parameter starts, as a factor
_SIGMA = 2.0  # σ of the critical distance
