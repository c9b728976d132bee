"""Fits on several grids: what is left of the discretisation in an estimate."""

import os
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from mpmjax._types import Scalar
from mpmjax.checks import checked, require, require_positive, warn
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import fit
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._result import AbstractFit, Estimate, FitResult, NoiseEstimate, table
from mpmjax.fitting._uncertainty import quantile


class RefinedFit(AbstractFit):
    """Estimates from several grids, extrapolated to a spacing of zero.

    `print(result)` shows a table; `result["E"]` is the extrapolated estimate of a parameter.
    """

    fits: tuple[FitResult, ...]
    """The fit on each grid, from coarse to fine."""
    refinements: tuple[int, ...]
    estimates: tuple[Estimate, ...]
    """The extrapolated numbers. Error and interval hold the noise's and the discretisation's part."""
    from_noise: tuple[float, ...]
    """The part of each error that the data's noise makes."""
    from_discretisation: tuple[float, ...]
    """The part that is left of the discretisation."""
    order: tuple[float, ...]
    """The order in the spacing with which each was extrapolated; NaN of what does not converge."""

    @property
    def all(self) -> tuple[Estimate, ...]:
        return self.estimates

    def __str__(self) -> str:
        """A table: the estimates on each grid and the extrapolated ones."""
        rows = []
        for k, e in enumerate(self.estimates):
            rules = "noise" if self.from_noise[k] > self.from_discretisation[k] else "discretisation"
            rules = "one grid alone" if len(self.fits) == 1 else rules
            grids = (f"{result.all[k].value:>13.6g}" for result in self.fits)
            rows.append((e.name, *grids, *e.cells, rules + ("  at its bound" if e.at_bound else "")))
        grids = (f"{f'spacing/{n}':>13}" for n in self.refinements)
        level = f"{100 * self.fits[-1].level:g} % interval"
        lines = table(("", *grids, f"{'extrapolated':>12} ± {'error':<9}", level, "what rules"), *rows)
        for n, each in zip(self.refinements, self.fits, strict=True):
            lines += [f"spacing/{n}: {text}" for text in each.warnings]
            lines += [] if each.converged else [f"spacing/{n}: NOT CONVERGED"]
        return "\n".join(lines)


@checked
def fit_refined(
    build: Callable[[int], Any],
    parameters: dict[str, AbstractParameter],
    *,
    refinements: tuple[int, ...] | list[int] = (1, 2),
    order: Scalar = 1,
    report: dict[str, Callable[[Experiment], Any]] | None = None,
    level: Scalar = 0.95,
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

    With estimates a and b on the two finest grids, logarithms of `Positive` parameters, and their spacings in the
    ratio r, the extrapolation is b + (b − a)/(r^p − 1), not beyond a bound, and the standard error that is left of
    the discretisation is taken as that whole correction. p is `order`; with three grids of equal ratios it is what
    they show, between half and twice that. A higher order than `order` may be shown by grids that are too coarse to
    tell, so the error then is the correction by `order`. Where the estimates do not converge, or one lies at its
    bound, which tells nothing of where it would be without, the finest stays, with its last change as the error, and
    a warning says so.

    Two estimates may agree by chance and both be wrong, as where an error changes its sign between the grids. What the
    finest grid misses of the data then tells more: D, in units of σ. A discretisation that changes predictions by D in
    ways that no parameter can follow may change them as much in ways that a parameter does follow. The parameter that
    makes up for it moves by D times its standard error from the noise; half of this is the least error that is taken.
    D² is what the sum of squares loses from the grid before to the finest, over r^2p − 1, and needs no σ.

    Intervals are made of the noise's and the discretisation's part, and keep to the bounds.

    Args:
        build: the experiments on n times as many cells a direction, from n; take the step n times shorter too.
        parameters: what is fitted, see `fit`. Each fit starts from the one before.
        refinements: the n, growing, two at least.
        order: p, the order in the spacing. One is careful: estimates that converge faster get a wider interval.
        report, level, optimiser, progress: see `fit`.
        log: the name of the logs, one a grid: of "fit.h5" they are "fit_1.h5", "fit_2.h5". See `fit`.
        resume: continue from the logs that are there.

    After Ctrl-C it returns what it has, and extrapolates from grids on which the fit was done.

    Raises:
        ValueError: fewer than two refinements, or not growing ones; see `fit`.
    """
    numbers = list(refinements)
    require(
        len(numbers) >= 2 and numbers[0] >= 1 and all(a < b for a, b in pairwise(numbers)),
        f"refinements must be two or more growing whole numbers, got {numbers}.",
    )
    require_positive("order", order)
    fits: list[FitResult] = []
    start = parameters
    for n in numbers:
        path = None if log is None else Path(log).with_stem(f"{Path(log).stem}_{n}")
        again = resume and path is not None and (path.exists() or n == numbers[0])
        result = fit(
            build(n),
            start,
            report=report,
            level=level,
            optimiser=optimiser,
            progress=progress,
            log=path,
            resume=again,
        )
        if not result.interrupted or not fits:
            fits.append(result)
        if result.interrupted:
            break
        start = result.restarted(parameters)
    numbers = numbers[: len(fits)]
    if len(fits) < len(refinements):
        warn(f"The fit on several grids was interrupted: of {len(refinements)} grids it tells of {len(fits)}.")
    sizes = [(p, fits[-1].values[name].size) for name, p in parameters.items()]
    kinds: list[AbstractParameter | None] = [p for p, size in sizes for _ in range(size)]
    kinds += [None] * len(fits[-1].reported)
    each = zip(kinds, zip(*(result.all for result in fits), strict=True), strict=True)
    normal = float(quantile(float(level), np.inf))
    missed = _missed(fits[-2].noise, fits[-1].noise, numbers, float(order)) if len(fits) > 1 else 0.0
    extrapolated = [_extrapolate(kind, of, numbers, float(order), missed, normal) for kind, of in each]
    estimates, left, orders = zip(*extrapolated, strict=True)
    return RefinedFit(tuple(fits), tuple(numbers), estimates, tuple(e.error for e in fits[-1].all), left, orders)


def _missed(
    coarse: tuple[NoiseEstimate, ...], fine: tuple[NoiseEstimate, ...], refinements: list[int], order: float
) -> float:
    """D, by how much the finest grid misses the data beyond their noise, in units of its σ: by what the sum of squares
    lost since the grid before, as the square of what falls with the spacing to the power of the order."""
    pairs = zip(coarse, fine, strict=True)
    lost = sum(b.points * ((a.misfit * a.sigma / b.sigma) ** 2 - b.misfit**2) for a, b in pairs)
    return float(np.sqrt(max(lost, 0.0) / ((refinements[-1] / refinements[-2]) ** (2 * order) - 1)))


def _extrapolate(
    kind: AbstractParameter | None,
    estimates: tuple[Estimate, ...],
    refinements: list[int],
    order: float,
    missed: float,
    normal: float,
) -> tuple[Estimate, float, float]:
    """One number extrapolated from its estimates on the grids, from coarse to fine; the part of its error that is left
    of the discretisation; and the order, NaN where the estimates do not converge.

    `kind` is its parameter, None if it was reported; `missed` as of `_missed`; `normal` the reach of an interval of the
    normal distribution, in standard errors.
    """
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
    p = float("nan") if held else _order(values, refinements, order)
    change = values[-1] - values[-2]
    ratio = refinements[-1] / refinements[-2]
    correction = 0.0 if np.isnan(p) else change / (ratio**p - 1)
    value = back(correction)
    hidden = missed / 2 * last.error / (last.value if logarithmic else 1)
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


def _order(values: np.ndarray, refinements: list[int], order: float) -> float:
    """The order that the three finest grids show, if their ratios are one, NaN if they do not converge; with fewer, or
    other ratios, the one that was given."""
    if len(values) < 3 or refinements[-1] * refinements[-3] != refinements[-2] ** 2:
        return order
    first, second = values[-2] - values[-3], values[-1] - values[-2]
    if second == 0:
        return order
    if first / second <= 1:
        return float("nan")
    seen = np.log(first / second) / np.log(refinements[-1] / refinements[-2])
    return float(np.clip(seen, order / 2, 2 * order))
