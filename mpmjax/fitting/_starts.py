"""Searches from many starting points, and the minima that they lead to."""

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Float, Int, Scalar
from mpmjax.checks import between, require, require_fields, require_finite, whole
from mpmjax.fitting._estimate import table
from mpmjax.fitting._evaluation import costs_at
from mpmjax.fitting._problem import SHOWN, FitProblem
from mpmjax.fitting._search import AbstractOptimiser, Search, batch_size, counted, search_many

Ends = list[tuple[Search, list[int]]]  # minima, with the numbers of the points that led there


class Starts(eqx.Module):
    """Where `fit` starts, besides its first guess.

        result = mpm.fit(pull, {"E": ...}, starts=mpm.fitting.Starts(64, ranges={"E": (1e4, 1e7)}))
        print(result)

    The points are the first guess, `points` of your own, and scrambled Sobol points (see `ranges`), a simulation each.
    Searches start from the first guess, your own points, the best of the others, and from each without a better one
    within the critical distance of multi-level single linkage (A. H. G. Rinnooy Kan, G. T. Timmer, Mathematical
    Programming 39 (1987) 57-78). They stand for the others, each linked to the nearest better one.

    A search that comes near another with a lower cost is counted where that one ends; one that three moves have hardly
    lowered is ended as at a minimum. Those within twice the least sum of squares are searched on, the best is fitted.
    Two are one minimum where coordinates differ by less than two hundredths, or the misfit hides that: Δᵀ JᵀJ Δ ≤ n s²
    of n coordinates, with J and s² = Σ r²/(m − n) of the better one, s² at least one where σ is given.

    Args:
        count: how many points, the first guess among them, your own not.
        fraction: of the points, the best ones, from which searches start whatever is near; 1 without a look at costs.
        ranges: lowest and highest value to start from, by the name of a parameter. Default: its prior, or its bounds,
            from a tenth to ten times the first guess of a `Positive`, one coordinate each way of an `Unbounded` one.
        points: values by the names of parameters, others at the first guess, from which a search starts in any case.
        if_needed: look at them only where the misfit of the first search is beyond the noise; searches then run one by
            one, the best points first, until the misfit of one is within it.
        seed: of the Sobol points.
        batch: how many points, and searches, run together. Default: eight with explicit steps, one with implicit ones.

    Raises:
        ValueError: no point; a fraction beyond 0 to 1. `fit` refuses ranges and points beyond bounds.
    """

    count: Annotated[int, whole(1)] = 64
    fraction: Annotated[Scalar, between(0, 1)] = 0.375
    ranges: dict[str, tuple[float, float]] | None = eqx.field(default=None, kw_only=True)
    points: tuple[dict[str, Any], ...] = eqx.field(default=(), kw_only=True)
    if_needed: bool = eqx.field(default=False, kw_only=True)
    seed: Annotated[int, whole(0)] = eqx.field(default=0, kw_only=True)
    batch: Annotated[int, whole(1)] | None = eqx.field(default=None, kw_only=True)
    __check_init__ = require_fields


def as_starts(starts: int | Literal["auto"] | Starts) -> Starts:
    """The starts that `fit` was asked for."""
    if starts == "auto":
        return Starts(_AUTOMATIC, 1 / 8, if_needed=True)
    return starts if isinstance(starts, Starts) else Starts(starts)


class LocalMinimum(NamedTuple):
    """A minimum at which searches ended."""

    values: dict[str, np.ndarray]  # the value of each parameter, in its shape
    misfit: float  # root mean square of the residuals, in units of σ, or of the size of the data where σ is not given
    searches: int  # how many searches ended there
    members: tuple[int, ...]  # the numbers, from 0, of the points that these searches stand for; the first guess is 0


class Screening(eqx.Module):
    """Points at which the simulation was tried, searches from some of them, and the minima that these found."""

    minima: tuple[LocalMinimum, ...]  # the distinct minima, the best first
    points: dict[str, np.ndarray]  # the values of each parameter, shape (k, ...); the first guess is number 0
    searched: tuple[int, ...]  # the numbers of the points from which searches started
    failures: dict[int, str]  # why the simulation at a point, or the search from it, failed, by the number of the point
    unfinished: tuple[int, ...]  # the numbers of the points from which no search came to a minimum in its steps
    iterations: int  # how many iterations all searches took
    remark: str  # what is to be said of it, in words; empty if nothing

    def __str__(self) -> str:
        """A table of the minima."""
        count, rows = len(next(iter(self.points.values()))), []
        for m in self.minima[:_SHOWN]:
            values = (f"{value.reshape(-1)[0]:>13.6g}" for value in list(m.values.values())[:SHOWN])
            rows.append((f"{len(m.members):>24}", f"{m.searches:>8}", f"{m.misfit:>10.4g}", *values))
        labels = [f"{name if v.ndim == 1 else f'{name}, first':>13}" for name, v in self.points.items()][:SHOWN]
        lines = [f"{count} points, {len(self.searched)} searches, {self.iterations} iterations"]
        lines += table((f"{'points':>24}", "searches", f"{'misfit/σ':>10}", *labels), *rows)
        if len(self.minima) > _SHOWN:
            lines.append(f"and {len(self.minima) - _SHOWN} minima with a larger misfit.")
        if self.unfinished:
            lines.append(f"{len(self.unfinished)} of {count} points led to no minimum.")
        if self.failures:
            shown = ", ".join(map(str, list(self.failures)[:_SHOWN])) + (", …" if len(self.failures) > _SHOWN else "")
            lines.append(f"{len(self.failures)} of {count} points failed, number {shown}.")
        return "\n".join(lines)


def look_around(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    starts: Starts,
    first: Search,
    enough: Callable[[Search], bool],
    progress: Callable[[str], None] | None,
) -> tuple[Search | None, Screening]:
    """The best minimum of searches from many points, None where none is better than the `first`, and what was found."""
    shares = unit_points(starts.count - 1, problem.size, starts.seed)
    points = starting_points(problem, shares, starts)
    size, costs, remark = batch_size(problem, starts.batch, len(points)), np.zeros(len(points)), ""
    if starts.fraction < 1:
        costs = costs_at(problem, points, size, counted(progress, "{} of {} simulations are done"))
    failures = {int(k): _FAILS for k in np.flatnonzero(~np.isfinite(costs))}
    if 2 * len(failures) > len(points):
        try:
            problem.explain(jnp.asarray(points[min(failures)], problem.dtype), _FAILS)
        except (ValueError, RuntimeError) as cause:
            failures[min(failures)] = str(cause)
            remark = f"{len(failures)} of {len(points)} starts failed, the first since: {cause}"

    # A program that makes one iteration is compiled already.
    size = 1 if starts.if_needed and starts.batch is None else size
    search = partial(search_many, [problem], optimiser, batch=size)
    members, stands = _searched(search, first, points, shares, costs, starts.fraction, enough, progress)
    failures |= {k: m.failure for k, m in members.items() if m.failure}
    ends: dict[int, list[int]] = {}
    for k, by in enumerate(stands):
        if by in members and (end := _end(members, by)) is not None:
            ends.setdefault(end, []).append(k)
    groups, further = _grouped(problem, [(members[end], numbers) for end, numbers in ends.items()]), {}
    if not starts.if_needed:
        # Those near to the best one are searched on, without settling.
        near = [k for k, (end, _) in enumerate(groups[:_SHOWN]) if end.cost <= _NEAR_BEST * groups[0][0].cost]
        further = search({k: groups[k][0].z for k in near if groups[k][0] is not first})
        on = [(groups[k][0] if m.failure else m, groups[k][1]) for k, m in further.items()]
        groups = _grouped(problem, [*on, *(group for k, group in enumerate(groups) if k not in further)])

    ended = {k for _, numbers in groups for k in numbers}
    minima = tuple(
        LocalMinimum(problem.by_name(end.z), problem.misfit(end.cost), len(members.keys() & ks), tuple(sorted(ks)))
        for end, ks in groups
    )
    if minima and minima[0].searches == 1 and len(ended & members.keys()) > 1 and not starts.if_needed:
        remark = (
            f"The best minimum was found by one search of {len(members)}: there may be a better one. Take more starts, "
            "a larger fraction, or narrower ranges."
        )
    best = groups[0][0] if groups and groups[0][0] is not first else None
    if best is not None and not first.failure and best.cost > (1 - _LOWER) * first.cost:
        best = None
    values = [problem.by_name(jnp.asarray(point, problem.dtype)) for point in points]
    return best, Screening(
        minima=minima,
        points={name: np.stack([v[name] for v in values]) for name in problem.names},
        searched=tuple(sorted(members)),
        failures=dict(sorted(failures.items())),
        unfinished=tuple(k for k in range(len(points)) if k not in ended and k not in failures),
        iterations=sum(len(m.history) for m in (*members.values(), *further.values()) if not m.failure),
        remark=remark,
    )


def _searched(
    search: Callable[..., dict[int, Search]],
    first: Search,
    points: Float[np.ndarray, "l n"],
    shares: Float[np.ndarray, "k n"],
    costs: Float[np.ndarray, "l"],
    fraction: Scalar,
    enough: Callable[[Search], bool],
    progress: Callable[[str], None] | None,
) -> tuple[dict[int, Search], list[int]]:
    """Searches from points that stand for others, until each is stood for by one whose search came to a minimum: the
    searches by their points, and the point that stands for each, -1 where its cost is not finite."""
    members, apart = {0: first}, len(points) - len(shares)
    while True:
        # The first guess and points of one's own are none of the cube's, and stand for themselves.
        others = linked(shares, costs[apart:], fraction)
        alone = np.where(np.isfinite(costs[:apart]), np.arange(apart), -1)
        stands = [*alone.tolist(), *np.where(others < 0, -1, others + apart).tolist()]
        chosen = sorted(set(stands) - {-1, *members}, key=lambda k: (k >= apart, costs[k]))
        if not chosen:
            return members, stands
        from_there, told = {k: points[k] for k in chosen}, counted(progress, "{} of {} searches are done")
        members = search(from_there, joining=_JOINED, settling=_SETTLED, progress=told, done=members, enough=enough)
        if any(m.interrupted or enough(m) for m in members.values()):
            return members, stands
        costs[[k for k in chosen if _end(members, k) is None]] = np.nan


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
            variance = max(variance, float(all(o.sigma is not None for o in problem.observations)))
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


def starting_points(problem: FitProblem, shares: Float[np.ndarray, "k n"], starts: Starts) -> Float[np.ndarray, "l n"]:
    """Coordinates of the first guess, of the points of `starts`, and of points of the unit cube within its `ranges`."""
    ranges, points = starts.ranges or {}, {f"Start {k}": point for k, point in enumerate(starts.points)}
    for what, values in {"ranges": ranges, **points}.items():
        unknown = sorted(set(values) - set(problem.names))
        require(not unknown, f"{what} must be of parameters ({', '.join(problem.names)}), got {', '.join(unknown)}.")
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
        asked = np.array([np.broadcast_to(np.asarray(p.get(name, first), float), first.shape) for p in starts.points])
        for value in asked:
            parameter.check(name, np.asarray(value))
        values = np.concatenate([asked.reshape(-1, *first.shape), values])
        if len(values):
            values = _coordinates(parameter, start, values)
        columns.append(np.asarray(values, float).reshape(len(values), first.size))
    return np.concatenate([np.zeros((1, problem.size)), np.concatenate(columns, axis=1)])


def linked(shares: Float[np.ndarray, "k n"], costs: Float[np.ndarray, "k"], fraction: Scalar) -> Int[np.ndarray, "k"]:
    """For each of some points of the unit cube, `shares`, the number of the one that stands for it by multi-level
    single linkage (see `Starts`): its own where a search starts there, as at the best fraction of all, and -1 where the
    cost is not finite."""
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
    """π^(-1/2) (Γ(1 + n/2) σ ln k / k)^(1/n): the radius of a ball that holds σ ln k of k points of the n-cube."""
    if count < 2:
        return 0.0
    logarithm = math.lgamma(1 + size / 2) + np.log(_SIGMA * np.log(count) / count)
    return float(np.exp(logarithm / size) / np.sqrt(np.pi))


_coordinates = eqx.filter_jit(lambda p, start, values: p.coordinate(start, jnp.asarray(values, start.dtype)))
_AUTOMATIC = 24  # points that are looked at without being asked
_SHOWN = 8  # how many minima a table shows
_FAILS = "the simulation fails there, or does not reach the data"
_JOINED = 0.01  # a search so near to a better one, in each coordinate, would go the same way
_SETTLED = 1e-2  # a search that lately lowered its sum of squares by less than this part is at a minimum
_NEAR_BEST = 2.0  # searches that end within this factor of the least sum of squares are searched on
_LOWER = 1e-3  # a minimum that is lower by less than this part is none better
_NEAR = 0.02  # ends of searches so near in each coordinate are one minimum
_EDGE = 1e-3  # shares nearer to 0 and 1 are none: a start at a bound does not move
_DECADE = 10.0  # how far from the first guess a positive parameter starts, as a factor
_SIGMA = 2.0  # σ of the critical distance
