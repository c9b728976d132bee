"""Profile likelihoods: intervals that need no straight line."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import checked, require, require_positive, require_whole, warn
from mpmjax.fitting._fit import checked_level
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas
from mpmjax.fitting._result import FitResult, intervals
from mpmjax.fitting._search import NoDerivativeError, search
from mpmjax.fitting._uncertainty import quantile


class Profile(eqx.Module):
    """How the misfit grows when one parameter is held at other values and all others are fitted anew.

    `print(profile)` says its interval.
    """

    label: str
    """The parameter."""
    unit: str
    values: np.ndarray
    """Values of the parameter, growing, shape (p,); the fit's is among them."""
    statistic: np.ndarray
    """Δχ² = Σ r² there less that of the fit, in units of the noise, shape (p,)."""
    numbers: np.ndarray
    """All fitted numbers along it, one a column in the order of `labels`, shape (p, n)."""
    labels: tuple[str, ...]
    """Names of the fitted numbers."""
    estimate: float
    """The value of the fit."""
    symmetric: tuple[float, float]
    """The interval of the standard error."""
    interval: tuple[float, float]
    """Where Δχ² is below the threshold. An end that was not found is the parameter's bound, or infinite."""
    threshold: float
    """Δχ² at the interval's ends: the quantile of χ² of one degree of freedom, or of F(1, ν)."""
    degrees_of_freedom: float
    """ν of the noise's estimate; infinite where it was given."""
    level: float
    """The level of the interval [-], such as 0.95."""
    warnings: tuple[str, ...]
    """Where it ends without an end of the interval, in words."""

    @property
    def signed_root(self) -> np.ndarray:
        """±√Δχ², negative below the estimate, shape (p,): a straight line in the search's coordinate where the
        symmetric interval is right."""
        return np.sign(self.values - self.estimate) * np.sqrt(np.maximum(self.statistic, 0))

    def along(self, label: str) -> np.ndarray:
        """Another fitted number where this one is held, shape (p,).

        Raises:
            ValueError: there is none of this name.
        """
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
    level: Scalar | None = None,
    points: int = 4,
    rtol: Scalar = 1e-3,
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
    doi 10.2307/2347496). Unlike the interval of the standard error it does not depend on the coordinate, and need be
    neither symmetric nor finite. In a linear problem both are one.

    From the estimate it goes to either side in steps of equal growth of √Δχ², as the last two points foretell it, each
    fit started on the line through them. A value at which the simulation fails is approached by halves. Where the
    threshold is never reached the interval is open on that side, and a warning says how far Δχ² came; where Δχ² jumps
    over it, as a simulation does beyond its stable step, a warning says that. One program is compiled for all points,
    and for all numbers of a fit.

    The noise is held at what the fit found. With a robust or weighted observation the threshold is approximate.

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
    problem = result.problem
    require(label in problem.labels, f"A profile is of a fitted number: {', '.join(problem.labels)}. Got {label!r}.")
    level = checked_level(result.level if level is None else level)
    require_whole("profile's points", points, 1)
    require_positive("profile's rtol", rtol)
    at = problem.labels.index(label)
    _, freedom = result.uncertainty.of(np.eye(problem.size)[at])
    walk = _Walk(result, at, result.optimiser if optimiser is None else optimiser, progress)
    reach = float(quantile(level, freedom))
    ends = [walk.end(side, reach, points, float(rtol)) for side in (-1, 1)]
    path = sorted(walk.visited, key=lambda point: point.z[at])
    numbers = np.stack([walk.numbers(point.z) for point in path])
    values = [walk.value(end.at) for end in ends]
    warnings = tuple(walk.warnings(ends, reach))
    for text in warnings:
        warn(text)
    estimate = result.estimates[at]
    symmetric = intervals(problem, jnp.asarray(result.z), result.uncertainty, result.gradient, level)
    return Profile(
        label=label,
        unit=estimate.unit,
        values=numbers[:, at],
        statistic=np.array([point.growth for point in path]),
        numbers=numbers,
        labels=problem.labels,
        estimate=estimate.value,
        symmetric=(float(symmetric[0][at]), float(symmetric[1][at])),
        interval=(min(values), max(values)),
        threshold=reach**2,
        degrees_of_freedom=float(freedom),
        level=level,
        warnings=warnings,
    )


class _RestrictedProblem(FitProblem):
    """A problem on a plane of its coordinates, z = origin + basis y, as a function of y. Both are arrays: another plane
    of as many dimensions does not compile anew."""

    whole: FitProblem = eqx.field(kw_only=True)
    origin: Coordinates = eqx.field(kw_only=True)
    basis: Float[Array, "n f"] = eqx.field(kw_only=True)

    def __init__(self, whole: FitProblem, origin: Coordinates, basis: Float[Array, "n f"]):
        self.experiments, self.names = whole.experiments, whole.names
        self.parameters, self.starts, self.memory = whole.parameters, whole.starts, whole.memory
        self.whole, self.origin, self.basis = whole, origin, basis

    @property
    def size(self) -> int:
        return self.basis.shape[1]

    @property
    def dtype(self) -> Any:
        return self.whole.dtype

    def place(self, y: Float[Array, "f"]) -> Float[Array, "n"]:
        """The coordinates of the whole problem."""
        return self.origin + self.basis @ y

    def coordinates(self, z: Coordinates) -> tuple[Array, ...]:
        return self.whole.coordinates(self.place(z))

    def room(self, z: Coordinates) -> Float[Array, "2 f"]:
        """On planes of some of the coordinates."""
        return jnp.where(self.basis.T != 0, self.whole.room(self.place(z))[:, None], jnp.inf).min(axis=2)

    def residuals(self, z: Coordinates, sigmas: Sigmas, adjoint: Any) -> tuple[Array, Array]:
        return self.whole.residuals(self.place(z), sigmas, adjoint)


class _Point(NamedTuple):
    """The least misfit where the coordinate is held."""

    z: np.ndarray  # all coordinates, shape (n,)
    growth: float  # Δχ²

    @property
    def root(self) -> float:
        """√Δχ²; negative where the misfit is less than that of the fit."""
        return float(np.sign(self.growth) * np.sqrt(abs(self.growth)))


class _End(NamedTuple):
    """Where one side of a profile ends."""

    at: float  # the coordinate at the threshold; infinite where that is not reached
    last: _Point  # the last point
    fault: float | None = None  # the nearest coordinate at which the simulation fails
    jump: float | None = None  # Δχ² beyond a jump at the threshold, if it jumps


class _Walk:
    """A walk along a profile, which remembers the points that it visited."""

    def __init__(
        self, result: FitResult, at: int, optimiser: AbstractOptimiser, progress: Callable[[str], None] | None
    ):
        self.problem, self.sigmas, self.at = result.problem, result.sigmas, at
        self.optimiser, self.progress = optimiser, progress
        self.label, self.unsettled = result.problem.labels[at], 0
        z = np.asarray(result.z, float)
        self.least = self._misfit(z)
        self.start = _Point(z, 0.0)
        self.visited = [self.start]
        errors, unit = result.uncertainty, np.eye(result.problem.size)[at]
        self.error = float(errors.error[at])
        # How the other coordinates follow this one when it is moved, by the covariance.
        blind = errors.unseen.shape[1] and np.isinf(self.error)
        along = errors.unseen @ (errors.unseen.T @ unit) if blind else errors.inverse @ unit
        self.rate = along / along[at]
        self.pace = self.error if np.isfinite(self.error) else min(float(errors.alone[at]), 1.0)
        if np.isfinite(result.problem.room(jnp.asarray(result.z, result.problem.dtype))[:, at]).any():
            # Away from a bound, a step of the coordinate that moves the value by its standard error.
            self.pace = float(np.log1p(self.pace))

    def end(self, side: int, reach: float, points: int, rtol: float) -> _End:
        """Walk to one side until √Δχ² is beyond `reach`, and find where it crosses."""
        farthest = max(_FARTHEST, 3 * reach * self.error) if np.isfinite(self.error) else _FARTHEST
        before, last, pace, nearest_fault = self.start, self.start, self.pace, np.inf
        for _ in range(_MOST_POINTS):
            gone = self._distance(last)
            wanted = gone + _BEYOND * reach / points * pace
            wanted = (gone + nearest_fault) / 2 if wanted >= nearest_fault else min(wanted, farthest)
            point = self.visit(self.start.z[self.at] + side * wanted, last, before)
            if point is None:
                nearest_fault = wanted
                if nearest_fault - gone < _NEAR_FAULT * nearest_fault:
                    break
                continue
            if point.root >= reach:
                return self._crossing(last, point, reach, rtol)
            grown = point.root - last.root
            longest = _FASTER * (wanted - gone) * points / reach
            pace = min((wanted - gone) / grown, longest) if grown > 0 else longest
            value, before_it, estimate = (self.numbers(p.z)[self.at] for p in (point, last, self.start))
            still = abs(value - before_it) <= _STILL * (wanted - gone) * abs(estimate)
            before, last = last, point
            if wanted >= farthest or still:
                break
        fault = self.start.z[self.at] + side * nearest_fault
        return _End(side * np.inf, last, float(fault) if np.isfinite(fault) else None)

    def _distance(self, point: _Point) -> float:
        """Distance of a point's coordinate from the estimate's."""
        return float(abs(point.z[self.at] - self.start.z[self.at]))

    def visit(self, place: float, last: _Point, before: _Point) -> _Point | None:
        """The least misfit with the coordinate held at a place; None where the simulation fails. The search of the
        others starts on the line through two points, or along the direction of the covariance from the fit."""
        covered = last.z[self.at] - before.z[self.at]
        rate = self.rate if covered == 0 else (last.z - before.z) / covered
        guess = last.z + rate * (place - last.z[self.at])
        guess[self.at] = place
        try:
            z, misfit = self._refitted(guess)
        except NoDerivativeError:
            return None
        if not np.isfinite(misfit):
            return None
        point = _Point(z, misfit - self.least)
        self.visited.append(point)
        if self.progress is not None:
            self.progress(f"profile of {self.label}: Δχ² {point.growth:8.4g}  {self.problem.shown(z)}")
        return point

    def numbers(self, z: np.ndarray) -> np.ndarray:
        """All fitted numbers at coordinates."""
        return np.asarray(self.problem.numbers(jnp.asarray(z, self.problem.dtype)), float)

    def value(self, place: float) -> float:
        """The value of the number where its coordinate is at a place, which may be infinite."""
        z = self.start.z.copy()
        z[self.at] = place
        return float(self.numbers(z)[self.at])

    def warnings(self, ends: list[_End], reach: float) -> list[str]:
        """Ends that are no ends of the interval, in words."""
        texts = []
        for end, where in zip(ends, ("below", "above"), strict=True):
            value = self.numbers(end.last.z)[self.at]
            if end.jump is not None:
                texts.append(
                    f"{self.label}: the interval ends {where} at {value:.5g}, where Δχ² jumps from "
                    f"{max(end.last.growth, 0):.2g} to {end.jump:.2g}: the simulation changes abruptly there, and not "
                    "the data end it. See whether its step is stable."
                )
            if np.isfinite(end.at):
                continue
            fault = end.fault
            beyond = "" if fault is None else f" Beyond, at {self.value(fault):.5g}, the simulation fails."
            texts.append(
                f"{self.label}: the interval is open {where}. At {value:.5g} Δχ² is {max(end.last.growth, 0):.2g}, "
                f"less than {reach**2:.3g}: the data do not bound it.{beyond}"
            )
        best = min(self.visited, key=lambda point: point.growth)
        if best.growth < -_BETTER:
            texts.append(
                f"{self.label}: the profile found a misfit smaller by {-best.growth:.2g} at "
                f"{self.numbers(best.z)[self.at]:.5g}: the fit is not at the least one. Fit again from there."
            )
        if self.unsettled:
            texts.append(f"{self.label}: at {self.unsettled} points of the profile the others did not converge.")
        return texts

    def _crossing(self, below: _Point, above: _Point, reach: float, rtol: float) -> _End:
        """Where √Δχ² is `reach` between two points, by Brent's method. A value at which the simulation fails counts as
        beyond it."""
        from scipy.optimize import root_scalar  # here, since it takes long to import

        tried: dict[float, _Point | None] = {below.z[self.at]: below, above.z[self.at]: above}

        def excess(place: float) -> float:
            if place not in tried:
                tried[place] = self.visit(place, below, above)
            point = tried[place]
            return reach if point is None else point.root - reach

        within = rtol / 2 * self._distance(above)
        root = root_scalar(excess, method="brentq", bracket=(below.z[self.at], above.z[self.at]), xtol=within).root
        apart = {place: excess(place) for place in tried}
        inner = min((p for p in apart if apart[p] < 0), key=lambda p: abs(p - root))
        outer = min((p for p in apart if apart[p] >= 0), key=lambda p: abs(p - root))
        last, next_ = tried[inner], tried[outer]
        assert last is not None
        if apart[outer] - apart[inner] < _JUMP * reach or abs(outer - inner) > 4 * within:
            return _End(float(root), last)
        if next_ is None:
            return _End(float(np.copysign(np.inf, outer - inner)), last, float(outer))
        return _End(float(root), last, jump=next_.growth)

    def _refitted(self, guess: np.ndarray) -> tuple[np.ndarray, float]:
        """All coordinates, the others fitted, and the misfit."""
        if len(guess) == 1:
            return guess, self._misfit(guess)
        problem = self.problem
        basis = np.delete(np.eye(len(guess)), self.at, axis=1)
        held = _RestrictedProblem(problem, jnp.asarray(guess, problem.dtype), jnp.asarray(basis, problem.dtype))
        minimum = search(held, self.optimiser, jnp.zeros(basis.shape[1], problem.dtype), self.sigmas)
        if minimum.interrupted:
            raise KeyboardInterrupt
        if not minimum.converged and np.isfinite(minimum.cost):
            self.unsettled += 1
        return guess + basis @ np.asarray(minimum.z, float), float((np.asarray(minimum.r, float) ** 2).sum())

    def _misfit(self, z: np.ndarray) -> float:
        """Σ r²."""
        r = _residuals(self.problem, jnp.asarray(z, self.problem.dtype), self.sigmas)
        return float((np.asarray(r, float) ** 2).sum())


@eqx.filter_jit
def _residuals(problem: FitProblem, z: Coordinates, sigmas: Sigmas) -> Array:
    """The residuals, compiled."""
    return problem.residuals(z, sigmas, None)[0]


_FARTHEST = 14.0
"""How far a profile is followed, in the search's coordinate: to a millionth and a million-fold of a positive one."""
_MOST_POINTS = 40  # on one side
_BEYOND = 1.02
"""Steps are so much longer than is foretold, so that in a linear problem the last one goes beyond the threshold."""
_FASTER = 2.0  # a step is no longer than so many times the one before
_STILL = 1e-6
"""A walk ends where the number changes, over a unit of the coordinate, by less than so much of its estimate: at a
bound."""
_JUMP = 0.2  # √Δχ² that grows by more than this part of the threshold's within the tolerance jumps
_NEAR_FAULT = 0.02  # a value at which the simulation fails is approached to this part of its distance from the estimate
_BETTER = 1e-2  # a Δχ² below zero by more is another minimum
