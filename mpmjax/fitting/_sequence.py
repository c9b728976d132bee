"""Fits in a sequence, each from where the last one ended: to growing horizons, or on finer grids."""

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Scalar
from mpmjax.analysis import sensitivity
from mpmjax.checks import checked, positive, require, warn
from mpmjax.fitting._estimate import VALUE, AbstractFit, Estimate, NoiseEstimate, table
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import Level, chosen_optimiser, fit, require_end
from mpmjax.fitting._observation import AbstractTimed
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import Coordinates, FitProblem, first_noise
from mpmjax.fitting._result import FitResult
from mpmjax.fitting._search import AbstractOptimiser, jacobian, search
from mpmjax.fitting._starts import Starts, as_starts
from mpmjax.fitting._uncertainty import quantile


@checked
def fit_staged(
    experiments: Experiment | tuple[Experiment, ...] | list[Experiment],
    parameters: dict[str, AbstractParameter],
    *,
    horizons: Annotated[tuple[float, ...] | list[float], positive, "s"] | None = None,
    growth: Scalar = 1e3,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Level = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> FitResult:
    """Fit to the data until a first time, then until later ones, each from where the last search ended.

    For motions that repeat or that contacts decide, of which a fit to all data ends in a false minimum.

        result = mpm.fitting.fit_staged(swing, {"E": ...})
        print(result)  # how the horizons were chosen, the stages (`result.remarks`), the estimate

    The first horizon, where `horizons` does not give it, is the last time until which a change of one in any coordinate
    changes the data by no more than they change themselves, √Σ (∂y/∂z)² ≤ √Σ (y − y(0))², at the first guess: of a
    vibration about half a period. Where that ratio does not grow with time there is but one stage. Horizons then
    double, to the end, or to the time until which `sensitivity` is below `growth`: later data are left out, with a
    warning. The last stage is a `fit`, those before it are searches alone, each compiled anew. What has no times, such
    as a `Curve`, counts in the last stage, or in all if its experiment has nothing else.

    Args:
        experiments, parameters, report, level: see `fit`. Horizons are times of each experiment.
        horizons: growing times [s]; the end of the data is added. Default: by the rule above.
        growth: sensitivity [-] beyond which data are left out; infinite to use all.
        optimiser: the method of each search. Default: as `fit` chooses.
        progress: called with a line an iteration, and with what is said, such as `print`.

    Raises:
        ValueError: as `fit`; horizons that do not grow, or none of which has data.
        SimulationError: the simulation at the first guess meets a fault within the first horizon.
    """
    require(float(growth) > 0, f"growth must be positive, or infinite to use all data, got {growth}.")
    if (times := None if horizons is None else [float(t) for t in horizons]) is not None:
        require(len(times) > 0, "horizons must hold a time at least; leave them out to have them chosen.")
        require(all(a < b for a, b in pairwise(times)), f"horizons must grow, got {times}.")
    problem = FitProblem(experiments, parameters)
    optimiser = chosen_optimiser(problem) if optimiser is None else optimiser
    end = max(e.t1 for e in problem.experiments)
    say, remarks = progress or (lambda text: None), list[str]()

    def tell(text: str) -> None:
        remarks.append(text)
        say(text)

    z = jnp.zeros(problem.size, problem.dtype)
    whole = _until(problem, _limits(problem.at(z), float(growth)))
    if times is None:
        first = _first_horizon(whole, z)
        times = [first * 2.0**k for k in range(_MOST_STAGES) if first * 2.0**k < _NEARLY_ALL * end]
        tell(
            f"The first horizon is {first:.4g} s of {end:.4g} s: until then a change of one in a coordinate changes "
            "the data by no more than they change themselves. Horizons double from there."
            if times
            else "One stage suffices: until the end of the data a change of one in a coordinate changes them by no "
            "more than they change themselves, or by as much at all times."
        )
    for horizon in times:
        cut = _until(whole, [horizon] * len(whole.experiments))
        if [e.steps for e in cut.experiments] == [e.steps for e in whole.experiments]:
            break
        minimum = search(cut, optimiser, z)
        require_end(minimum)
        if minimum.failure:
            cut.explain(z, f"What is observed of the simulation until {horizon:g} s is not finite.")
        z, misfit, count = minimum.z, cut.misfit(minimum.cost), len(minimum.history)
        tell(f"until {horizon:.4g} s: misfit/σ {misfit:.4g}, {problem.shown(z)}, {count} iterations")
        whole = _until(problem, _limits(problem.at(z), float(growth)))
    for k, (e, used) in enumerate(zip(problem.experiments, whole.experiments, strict=True)):
        if used.steps < e.steps:
            tell(
                f"Of the experiment {e.name!r} (number {k}) data are used only until {used.t1:.4g} s of "
                f"{e.t1:.4g} s: beyond, derivatives grow to more than {growth:.3g} times those of free flight, or "
                "the simulation fails, and a fit would follow chance. Give windows of the later motion, each from an "
                "observed state, as experiments of their own."
            )
            warn(remarks[-1])
    start = {name: replace(parameters[name], start=value) for name, value in problem.by_name(z).items()}
    result = fit(whole.experiments, start, report=report, level=level, optimiser=optimiser, progress=progress)
    return replace(result, remarks=tuple(remarks))


def _until(problem: FitProblem, horizons: Sequence[float]) -> FitProblem:
    """The problem of the data until a horizon of each experiment [s]."""
    cut = tuple(e.until(horizon) for e, horizon in zip(problem.experiments, horizons, strict=True))
    return eqx.tree_at(lambda p: p.experiments, problem, cut).with_noise(first_noise(cut))


def _limits(experiments: Sequence[Experiment], growth: float) -> list[float]:
    """The time until which each has derivatives that grow no further [s]."""
    if np.isinf(growth):
        return [e.t1 for e in experiments]
    limits = []
    for e in experiments:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            grown = sensitivity(e.scene, e.particles, t1=e.t1, dt=e.dt, method=e.method)
        beyond = np.flatnonzero(~(np.asarray(grown.growth) <= growth))
        limits.append(float(np.asarray(grown.times)[max(beyond[0] - 1, 0)]) if len(beyond) else e.t1)
    return limits


def _first_horizon(problem: FitProblem, z: Coordinates) -> float:
    """The time until which the data are nearly linear in the coordinates [s], see `fit_staged`."""
    parts = []
    r, J = (np.asarray(a, float) for a in jacobian(problem, z))
    if not np.isfinite(r).all():
        problem.explain(z)
    for o, rows, sigma in zip(problem.observations, problem.rows, problem.sigmas, strict=True):
        if isinstance(o, AbstractTimed):
            change = (J[rows] ** 2).reshape(len(o.times), -1, problem.size).sum(axis=1)
            data = o.data.reshape(len(o.times), -1)
            measured, spread = np.isfinite(data), np.broadcast_to(np.asarray(sigma), o.data.shape).reshape(data.shape)
            first = data[measured.argmax(axis=0), np.arange(data.shape[1])]
            # Σ ((y − y(0))/σ)² at each time, y(0) the first that was measured of each number
            motion = np.asarray(o.weight) * (np.where(measured, (data - first) / spread, 0) ** 2).sum(axis=1)
            parts.append((o.times, change, motion))
    if not parts:
        return max(e.t1 for e in problem.experiments)
    t, change, motion = map(np.concatenate, zip(*parts, strict=True))
    order = np.argsort(t, kind="stable")
    t, change, motion = t[order], np.cumsum(change[order], axis=0), np.cumsum(motion[order])
    usable = (motion > 0) & (np.arange(1, len(t) + 1) >= min(_LEAST_TIMES, len(t)))
    if not usable.any():
        return float(t[-1])
    t, ratio = t[usable], np.sqrt(change[usable] / motion[usable, None])
    bound = np.maximum(1, _GROWN * ratio.min(axis=0))
    return float(min(t[np.flatnonzero(column <= b)[-1]] for column, b in zip(ratio.T, bound, strict=True)))


class RefinedFit(AbstractFit):
    """Estimates from several grids, extrapolated to a spacing of zero: `result["E"]` is that of a parameter."""

    fits: tuple[FitResult, ...]  # the fit on each grid, from coarse to fine
    refinements: tuple[int, ...]  # the spacing of the scene over that of each fit
    estimates: tuple[Estimate, ...]  # the extrapolated numbers, with errors of the noise and of the discretisation
    from_noise: tuple[float, ...]  # the part of each error that the data's noise makes
    from_discretisation: tuple[float, ...]  # the part that is left of the discretisation
    order: tuple[float, ...]  # the order in the spacing with which each was extrapolated; NaN of what does not converge
    remark: str = ""  # whether a misfit beyond the noise falls with the spacing, in words; empty where there is none

    def __str__(self) -> str:
        """A table: the estimates on each grid and the extrapolated ones."""
        names, rows = [f"spacing/{n}" for n in self.refinements], []
        for k, e in enumerate(self.estimates):
            rules = "noise" if self.from_noise[k] > self.from_discretisation[k] else "discretisation"
            rules = "one grid alone" if len(self.fits) == 1 else rules
            grids = (f"{result.all[k].value:>13.6g}" for result in self.fits)
            rows.append((e.name, *grids, *e.cells, rules + ("  at its bound" if e.at_bound else "")))
        head = (*(f"{name:>13}" for name in names), VALUE.format("extrapolated"))
        lines = table(("", *head, f"{100 * self.fits[-1].level:g} % interval", "what rules"), *rows)
        for name, each in zip(names, self.fits, strict=True):
            lost = [] if each.converged else ["NOT CONVERGED"]
            looked = [] if each.screening is None else [each.screening]
            lines += [f"{name}: {text}" for text in (*each.warnings, *lost, *looked)]
        return "\n".join([*lines, *([self.remark] if self.remark else [])])


@checked
def fit_refined(
    build: Callable[[int], Any],
    parameters: dict[str, AbstractParameter],
    *,
    refinements: tuple[int, ...] | list[int] = (1, 2),
    order: Annotated[Scalar, positive] = 1,
    starts: int | Literal["auto"] | Starts = "auto",
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Level = 0.95,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
    log: str | os.PathLike | None = None,
    resume: bool = False,
) -> RefinedFit:
    """Fit on several grids, extrapolate to a spacing of zero, and count what is left as an error.

        def build(n):
            grid = mpm.Grid((24 * n,), 0.05 / n, origin=(-4 * n,))
            ...
            return mpm.Experiment(scene, particles, t1=0.1, dt=2e-3 / n, observations=tracks)

        print(mpm.fitting.fit_refined(build, {"E": ...}))

    With estimates a and b on the two finest grids, logarithms of `Positive` parameters, and spacings in the ratio r,
    the extrapolation is b + (b − a)/(r^p − 1), not beyond a bound, and that whole correction is the standard error that
    is left of the discretisation. p is `order`; three grids of equal ratios show it, between half and twice that, but
    the error is no less than by `order`. Where the estimates do not converge, or one is at its bound, the finest stays,
    its last change the error, with a warning. Estimates may agree by chance, so the error is at least D/2 of those from
    the noise, D being what the finest grid misses of the data, in units of σ: a discretisation may do as much in ways
    that a parameter follows as in others. D² is what Σ r² loses from the grid before, over r^2p − 1. After Ctrl-C it
    extrapolates from grids whose fit was done.

    Args:
        build: the experiments on n times as many cells a direction, from n; take the step n times shorter too.
        refinements: the n, growing, two at least. Each fit starts from the one before.
        order: p, the order in the spacing. One is careful: estimates that converge faster get a wider interval.
        starts: of the first grid, see `fit`. Finer ones start from all minima of the one before, and if need be others.
        parameters, report, level, optimiser, progress, resume: see `fit`.
        log: the name of the logs, one a grid: of "fit.h5" they are "fit_1.h5", "fit_2.h5". See `fit`.

    Raises:
        ValueError: fewer than two refinements, or not growing ones; see `fit`.
    """
    numbers = list(refinements)
    grow = len(numbers) >= 2 and numbers[0] >= 1 and all(a < b for a, b in pairwise(numbers))
    require(grow, f"refinements must be two or more growing whole numbers, got {numbers}.")
    fits, start, places = list[FitResult](), parameters, as_starts(starts)
    options: dict[str, Any] = {"report": report, "level": level, "optimiser": optimiser, "progress": progress}
    for n in numbers:
        path = None if log is None else Path(log).with_stem(f"{Path(log).stem}_{n}")
        goes_on = resume and path is not None and (path.exists() or n == numbers[0])
        result = fit(build(n), start, starts=places, discretisation=False, log=path, resume=goes_on, **options)
        if not result.interrupted or not fits:
            fits.append(result)
        if result.interrupted:
            break
        start = result.restarted(parameters)
        minima = () if result.screening is None else result.screening.minima
        places = replace(places, points=tuple(m.values for m in minima), if_needed=True)
    numbers = numbers[: len(fits)]
    if len(fits) < len(refinements):
        warn(f"The fit on several grids was interrupted: of {len(refinements)} grids it tells of {len(fits)}.")
    missed = _missed(fits[-2].noise, fits[-1].noise, numbers, float(order)) if len(fits) > 1 else 0.0
    remark = ""
    if len(fits) > 1 and fits[-1].is_beyond:
        before, after = _squares(fits[-2].noise, fits[-1].noise)
        points, by_noise = (sum(n.points for n in fits[-1].noise if all_of or not n.estimated) for all_of in (1, 0))
        falls = after - by_noise < _FALLS * (before - by_noise)
        shown = f"{np.sqrt(before / points):.3g} σ on {numbers[-2]}, {np.sqrt(after / points):.3g} σ on {numbers[-1]}"
        remark = (
            f"The misfit falls with the spacing ({shown}): it is the discretisation's. Go on to a finer grid."
            if falls
            else f"The misfit does not fall with the spacing ({shown}): this is a false minimum or a wrong model, and "
            "not the discretisation. Take more starts, or another law."
        )
        warn(remark)
    kinds = [*fits[-1].problem.owners, *[None] * len(fits[-1].reported)]
    each = zip(kinds, zip(*(result.all for result in fits), strict=True), strict=True)
    normal = float(quantile(float(level), np.inf))
    extrapolated = (_extrapolate(kind, of, numbers, float(order), missed, normal) for kind, of in each)
    estimates, left, orders = zip(*extrapolated, strict=True)
    by_noise = tuple(e.error for e in fits[-1].all)
    grids: dict[str, Any] = {"fits": tuple(fits), "refinements": tuple(numbers), "estimates": estimates}
    return RefinedFit(**grids, from_noise=by_noise, from_discretisation=left, order=orders, remark=remark)


def _squares(coarse: tuple[NoiseEstimate, ...], fine: tuple[NoiseEstimate, ...]) -> tuple[float, float]:
    """Σ r² on two grids, in units of the finer one's σ."""
    before = sum(b.points * (a.misfit * a.sigma / b.sigma) ** 2 for a, b in zip(coarse, fine, strict=True))
    return before, sum(b.points * b.misfit**2 for b in fine)


def _missed(
    coarse: tuple[NoiseEstimate, ...], fine: tuple[NoiseEstimate, ...], refinements: list[int], order: float
) -> float:
    """D of `fit_refined`, by how much the finest grid misses the data beyond their noise, in units of its σ."""
    before, after = _squares(coarse, fine)
    return float(np.sqrt(max(before - after, 0.0) / ((refinements[-1] / refinements[-2]) ** (2 * order) - 1)))


def _extrapolate(
    kind: AbstractParameter | None,
    estimates: tuple[Estimate, ...],
    refinements: list[int],
    order: float,
    missed: float,
    normal: float,
) -> tuple[Estimate, float, float]:
    """One number of a parameter (None if reported) extrapolated from its estimates from coarse to fine; the part of its
    error that is left of the discretisation; and the order, NaN where the estimates do not converge. `missed` as of
    `_missed`; `normal` the reach of a normal interval, in standard errors."""
    last = estimates[-1]
    if len(estimates) == 1:
        return last, float("nan"), float("nan")
    held = any(e.at_bound for e in estimates[-3:])
    bounds = (-np.inf, np.inf) if kind is None else kind.domain
    # The logarithm of a number that may be zero has no end.
    logarithmic = kind is not None and kind.logarithmic and last.interval[0] > 0 and not held

    def coordinate(value: float) -> float:
        return float(np.log(value / last.value)) if logarithmic else value - last.value

    def back(z: float) -> float:
        return float(np.clip(last.value * np.exp(z) if logarithmic else last.value + z, *bounds))

    values = np.array([coordinate(e.value) for e in estimates])
    ratio, steps = refinements[-1] / refinements[-2], np.diff(values)
    p, change = float("nan") if held else order, steps[-1]
    if len(steps) > 1 and refinements[-1] * refinements[-3] == refinements[-2] ** 2 and change != 0 and not held:
        # The order that the three finest grids show; none where steps do not shrink.
        shrinks = steps[-2] / change
        p = float(np.clip(np.log(shrinks) / np.log(ratio), order / 2, 2 * order)) if shrinks > 1 else float("nan")
    correction = 0.0 if np.isnan(p) else change / (ratio**p - 1)
    value = back(correction)
    hidden = missed / 2 * last.noise_error / (last.value if logarithmic else 1)
    remains = max(abs(change) / (1 if np.isnan(p) else ratio ** min(p, order) - 1), hidden)
    if np.isnan(p):
        shown = ", ".join(f"{e.value:.5g}" for e in estimates)
        what = "lies at its bound on a grid" if held else "does not converge with the spacing"
        warn(f"{last.label} {what} ({shown}): it is not extrapolated.")
    # An interval that ends at a bound holds that bound, and whatever more there is to its reach.
    reach = [abs(coordinate(end)) if end != bound else np.inf for end, bound in zip(last.interval, bounds, strict=True)]
    reach = np.hypot(reach, normal * remains)
    discretisation = remains * (value if logarithmic else 1)
    estimate = last._replace(
        value=value,
        error=float(np.hypot(last.error, discretisation)),
        interval=(back(correction - reach[0]), back(correction + reach[1])),
        start=estimates[0].start,
        at_bound=held,
    )
    return estimate, discretisation, p


_MOST_STAGES = 20
_NEARLY_ALL = 0.75  # a horizon beyond this part of the end is the end
_LEAST_TIMES = 4  # how many measured times the first horizon has, at least
_FALLS = 0.7  # part of a misfit's squares beyond the noise, below which it falls with the spacing; of order 1/2 a half
_GROWN = 1.2  # a ratio that grows by no more than this factor does not grow
