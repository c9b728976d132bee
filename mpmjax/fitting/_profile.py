"""Profile likelihoods: intervals that need no straight line."""

from collections.abc import Callable
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Scalar
from mpmjax.checks import checked, positive, require, warn, whole
from mpmjax.fitting._evaluation import costs_at
from mpmjax.fitting._fit import Level
from mpmjax.fitting._result import FitResult, intervals
from mpmjax.fitting._search import AbstractOptimiser, search
from mpmjax.fitting._uncertainty import quantile


class Profile(eqx.Module):
    """How the misfit grows when one parameter is held at other values and all others are fitted anew.

    `print(profile)` says its interval.
    """

    label: str  # the parameter
    unit: str  # the unit of the parameter
    values: np.ndarray  # values of the parameter, growing, shape (p,); the fit's is among them
    statistic: np.ndarray  # Δχ² = Σ r² there less that of the fit, in units of the noise, shape (p,)
    numbers: np.ndarray  # all fitted numbers along it, one a column in the order of `labels`, shape (p, n)
    labels: tuple[str, ...]  # names of the fitted numbers
    estimate: float  # the value of the fit
    symmetric: tuple[float, float]  # the interval of the standard error
    interval: tuple[float, float]
    """Where Δχ² is below the threshold. An end that was not found is the parameter's bound, or infinite."""
    threshold: float  # Δχ² at the interval's ends: the quantile of χ² of one degree of freedom, or of F(1, ν), or more
    degrees_of_freedom: float  # ν of the noise's estimate; infinite where it was given
    level: float  # the level of the interval [-], such as 0.95
    warnings: tuple[str, ...]  # where it ends without an end of the interval, in words

    @property
    def signed_root(self) -> np.ndarray:
        """±√Δχ², negative below the estimate, shape (p,): straight in the coordinate where `symmetric` is right."""
        return np.sign(self.values - self.estimate) * np.sqrt(np.maximum(self.statistic, 0))

    def along(self, label: str) -> np.ndarray:
        """Another fitted number where this one is held, shape (p,); a ValueError if there is none of this name."""
        require(label in self.labels, f"The profile has {', '.join(self.labels)}, got {label!r}.")
        return self.numbers[:, self.labels.index(label)]

    def __str__(self) -> str:
        """The interval in a line, and warnings."""
        unit = f" {self.unit}" if self.unit else ""
        (a, b), (c, d) = self.interval, self.symmetric
        line = (
            f"{self.label} = {self.estimate:.6g}{unit}, {100 * self.level:g} % interval by its profile {a:.5g} to "
            f"{b:.5g}{unit} (by its standard error {c:.5g} to {d:.5g})"
        )
        return "\n".join([line, *self.warnings])


@checked
def profile(
    result: FitResult,
    label: str,
    *,
    level: Level | None = None,
    points: Annotated[int, whole(1)] = 4,
    rtol: Annotated[Scalar, positive] = 1e-3,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> Profile:
    """The profile likelihood of a fitted number and the interval that follows from it.

        stiffness = mpm.fitting.profile(result, "E")
        print(stiffness)
        lower, upper = stiffness.interval

    The number is held at a value, all others are fitted anew, and Δχ² is by how much the misfit grew. The interval is
    where Δχ² is below a threshold: the quantile of χ² of one degree of freedom where the noise was given, of F(1, ν)
    where it was estimated with ν degrees of freedom (D. M. Bates, D. G. Watts, Nonlinear Regression Analysis and Its
    Applications, Wiley 1988, chapter 6; D. J. Venzon, S. H. Moolgavkar, Applied Statistics 37 (1988) 87,
    doi 10.2307/2347496), larger by the square of what errors are where the misfit is beyond the noise. It does not
    depend on the coordinate. Where the threshold is never reached it is open, and where Δχ² jumps over it, as beyond a
    stable step, it ends there, with a warning. With a robust or weighted observation it is approximate.

    Args:
        result: the fit.
        label: the fitted number, such as "E" or "E[2]".
        level: of the interval [-]. Default: that of the fit.
        points: how many on either side before the threshold, at least.
        rtol: tolerance of an end, relative to its distance from the estimate in the search's coordinate.
        optimiser: the method of the search. Default: that of the fit.
        progress: called with a line a point, such as `print`.

    Raises:
        ValueError: there is no such fitted number; a level that is none.
    """
    problem, names = result.problem, result.problem.labels
    require(label in names, f"A profile is of a fitted number: {', '.join(names)}. Got {label!r}.")
    level = float(result.level if level is None else level)
    say = progress or (lambda text: None)
    path = _Path(result, names.index(label), result.optimiser if optimiser is None else optimiser, say)
    at, errors = path.at, result.uncertainty
    # By the noise alone √Δχ² is one at a standard error; the threshold is as much farther as the misfit widens that.
    wider = result.estimates[at].error / result.estimates[at].noise_error
    wider = wider if np.isfinite(wider) else 1.0
    freedom = float(errors.of(np.eye(problem.size)[at])[1])
    reach = float(quantile(level, freedom)) * wider
    ends = [_walk(path, side, reach, points, float(errors.error[at]) / wider, float(rtol)) for side in (-1, 1)]

    z, growth = min(path.visited, key=lambda point: point[1])
    if growth < -_BETTER:
        path.remarks.append(
            f"the profile found a misfit smaller by {-growth:.2g} at {path.numbers(z)[at]:.5g}: the fit is not at the "
            "least one. Fit again from there."
        )
    if path.unsettled:
        path.remarks.append(f"at {path.unsettled} points of the profile the others did not converge.")
    texts = [f"{label}: {text}" for text in path.remarks]
    for text in texts:
        warn(text)
    visited = sorted(path.visited, key=lambda point: point[0][at])
    numbers, values = np.stack([path.numbers(z) for z, _ in visited]), [path.value(end) for end in ends]
    pull = result.jacobian.T @ result.residuals * np.array([e.at_bound for e in result.estimates])
    symmetric = intervals(problem, jnp.asarray(result.z), errors, pull / wider**2, level)
    return Profile(
        label=label,
        unit=result.estimates[at].unit,
        values=numbers[:, at],
        statistic=np.array([growth for _, growth in visited]),
        numbers=numbers,
        labels=names,
        estimate=result.estimates[at].value,
        symmetric=(float(symmetric[0][at]), float(symmetric[1][at])),
        interval=(min(values), max(values)),
        threshold=reach**2,
        degrees_of_freedom=freedom,
        level=level,
        warnings=tuple(texts),
    )


_Point = tuple[np.ndarray, float]  # all coordinates where one is held, the others fitted, shape (n,), and Δχ² there


class _Path:
    """The least misfit along one coordinate: what was visited of it so far, and what is to be said of it."""

    def __init__(self, result: FitResult, at: int, optimiser: AbstractOptimiser, progress: Callable[[str], None]):
        self.problem, self.optimiser, self.at = result.problem, optimiser, at
        self.progress, self.uncertainty = progress, result.uncertainty
        self.start: _Point = np.asarray(result.z, float), 0.0
        self.least, self.visited, self.unsettled = self._misfit(self.start[0]), [self.start], 0
        self.remarks = list[str]()
        errors, unit = result.uncertainty, np.eye(self.problem.size)[at]
        blind = errors.unseen.shape[1] and np.isinf(errors.error[at])
        # how the other coordinates follow this one when it is moved, by the covariance
        along = errors.unseen @ (errors.unseen.T @ unit) if blind else errors.inverse @ unit
        self.along = along / along[at]

    def numbers(self, z: np.ndarray) -> np.ndarray:
        """All fitted numbers, (n,), of their coordinates."""
        return np.asarray(self.problem.numbers(jnp.asarray(z, self.problem.dtype)), float)

    def value(self, place: float) -> float:
        """The number where its coordinate is at a place, which may be infinite."""
        z = self.start[0].copy()
        z[self.at] = place
        return float(self.numbers(z)[self.at])

    def pace(self, error: float) -> float:
        """How far a first step goes: a standard error, in a bounded number's coordinate what moves the value by it."""
        pace = error if np.isfinite(error) else min(float(self.uncertainty.alone[self.at]), 1.0)
        room = self.problem.room(jnp.asarray(self.start[0], self.problem.dtype))[:, self.at]
        return float(np.log1p(pace)) if np.isfinite(room).any() else pace

    def _misfit(self, z: np.ndarray) -> float:
        return 2 * float(costs_at(self.problem, z[None], 1)[0])

    def visit(self, place: float, last: _Point, before: _Point) -> _Point | None:
        """The least misfit with the coordinate held at a place, from the line through two points, or along the
        covariance from the fit; None where the simulation fails."""
        at, problem = self.at, self.problem
        covered = last[0][at] - before[0][at]
        z = last[0] + (self.along if covered == 0 else (last[0] - before[0]) / covered) * (place - last[0][at])
        z[at] = place
        if len(z) == 1:
            square = self._misfit(z)
        else:
            basis = np.delete(np.eye(len(z)), at, axis=1)
            held = problem.on_plane(z, basis)
            end = search(held, self.optimiser, jnp.zeros(held.size, problem.dtype))
            if end.interrupted:
                raise KeyboardInterrupt
            if end.failure:
                return None
            self.unsettled += not end.converged
            z, square = z + basis @ np.asarray(end.z, float), float((np.asarray(end.seen.residuals, float) ** 2).sum())
        if not np.isfinite(square):
            return None
        self.visited.append((z, square - self.least))
        self.progress(f"profile of {problem.labels[at]}: Δχ² {square - self.least:8.4g}  {problem.shown(z)}")
        return self.visited[-1]

    def open_end(self, side: int, last: _Point, reach: float, fault: float) -> float:
        """The infinite end of an interval, below the threshold at its last point, and before a `fault`, if finite."""
        beyond = f" Beyond, at {self.value(fault):.5g}, the simulation fails." if np.isfinite(fault) else ""
        self.remarks.append(
            f"the interval is open {_SIDES[side]}. At {self.numbers(last[0])[self.at]:.5g} Δχ² is "
            f"{max(last[1], 0):.2g}, less than {reach**2:.3g}: the data do not bound it.{beyond}"
        )
        return side * np.inf


def _walk(path: _Path, side: int, reach: float, points: int, error: float, rtol: float) -> float:
    """The coordinate to one side where √Δχ² is `reach`, walked to in so many points or more; infinite if never."""
    start, at = path.start, path.at
    farthest = max(_FARTHEST, 3 * reach * error) if np.isfinite(error) else _FARTHEST
    before, last, pace, fault = start, start, path.pace(error), np.inf
    for _ in range(_MOST_POINTS):
        gone = float(abs(last[0][at] - start[0][at]))
        wanted = gone + _BEYOND * reach / points * pace
        wanted = (gone + fault) / 2 if wanted >= fault else min(wanted, farthest)
        point = path.visit(start[0][at] + side * wanted, last, before)
        if point is None:
            fault = wanted
            if fault - gone < _NEAR_FAULT * fault:
                break
            continue
        if _root(point) >= reach:
            return _crossing(path, side, last, point, reach, rtol)
        grown = _root(point) - _root(last)
        longest = _FASTER * (wanted - gone) * points / reach
        pace = min((wanted - gone) / grown, longest) if grown > 0 else longest
        here, there, estimate = (path.numbers(z)[at] for z, _ in (point, last, start))
        before, last = last, point
        if wanted >= farthest or abs(here - there) <= _STILL * (wanted - gone) * abs(estimate):
            break
    return path.open_end(side, last, reach, float(start[0][at] + side * fault))


def _crossing(path: _Path, side: int, below: _Point, above: _Point, reach: float, rtol: float) -> float:
    """Where √Δχ² is `reach` between two points, by Brent's method. What fails to be simulated counts as beyond."""
    from scipy.optimize import root_scalar  # here, since it takes long to import

    at = path.at
    tried: dict[float, _Point | None] = {below[0][at]: below, above[0][at]: above}

    def excess(place: float) -> float:
        if place not in tried:
            tried[place] = path.visit(place, below, above)
        point = tried[place]
        return reach if point is None else _root(point) - reach

    within = rtol / 2 * abs(above[0][at] - path.start[0][at])
    root = float(root_scalar(excess, method="brentq", bracket=(below[0][at], above[0][at]), xtol=within).root)
    sides = ([p for p in tried if (excess(p) < 0) == inside] for inside in (True, False))
    inner, outer = (min(places, key=lambda p: abs(p - root)) for places in sides)
    last, beyond = tried[inner], tried[outer]
    assert last is not None
    if excess(outer) - excess(inner) < _JUMP * reach or abs(outer - inner) > 4 * within:
        return root
    if beyond is None:
        return path.open_end(side, last, reach, float(outer))
    path.remarks.append(
        f"the interval ends {_SIDES[side]} at {path.numbers(last[0])[at]:.5g}, where Δχ² jumps from "
        f"{max(last[1], 0):.2g} to {beyond[1]:.2g}: the simulation changes abruptly there, and not the data end it. "
        "See whether its step is stable."
    )
    return root


def _root(point: _Point) -> float:
    """√Δχ²; negative where the misfit is less than that of the fit."""
    return float(np.sign(point[1]) * np.sqrt(abs(point[1])))


_SIDES = {-1: "below", 1: "above"}
_FARTHEST = 14.0  # coordinates that a profile is followed: to a millionth and a million-fold of a positive number
_MOST_POINTS = 40  # on one side
_BEYOND = 1.02  # steps are so much longer than foretold: in a linear problem the last one goes beyond the threshold
_FASTER = 2.0  # a step is no longer than so many times the one before
_STILL = 1e-6  # part of its estimate by which a number at a bound changes over a unit of the coordinate: a walk ends
_JUMP = 0.2  # √Δχ² that grows by more than this part of the threshold's within the tolerance jumps
_NEAR_FAULT = 0.02  # a value at which the simulation fails is approached to this part of its distance from the estimate
_BETTER = 1e-2  # a Δχ² below zero by more is another minimum
