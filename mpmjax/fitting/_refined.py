"""Fits on several grids: what is left of the discretisation in an estimate."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import equinox as eqx
import numpy as np

from mpmjax._types import Scalar
from mpmjax.checks import checked, require, require_positive
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._fit import fit
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._result import Estimate, FitResult


class RefinedFit(eqx.Module):
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
    """The order in the spacing with which each was extrapolated."""

    def __getitem__(self, label: str) -> Estimate:
        """The extrapolated estimate of a parameter.

        Raises:
            KeyError: there is none of this name.
        """
        for estimate in self.estimates:
            if estimate.label == label:
                return estimate
        raise KeyError(f"There is no estimate {label!r}, but {', '.join(e.label for e in self.estimates)}.")

    def __str__(self) -> str:
        """A table."""
        level = 100 * self.fits[-1].level
        on = "".join(f"{f'spacing/{n}':>13}" for n in self.refinements)
        lines = [f"{'':<20}{on} {'extrapolated':>13} ± {'error':<9} {f'{level:g} % interval':<25} what rules"]
        for k, e in enumerate(self.estimates):
            each = "".join(f"{found.all[k].value:>13.6g}" for found in self.fits)
            rules = "noise" if self.from_noise[k] > self.from_discretisation[k] else "discretisation"
            interval = f"{e.interval[0]:.5g} to {e.interval[1]:.5g}"
            name = f"{e.label} [{e.unit}]" if e.unit else e.label
            lines.append(f"{name:<20}{each} {e.value:>13.6g} ± {e.error:<9.2g} {interval:<25} {rules}")
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
    rtol: Scalar = 1e-6,
    max_steps: int = 50,
    progress: Callable[[str], None] | None = None,
) -> RefinedFit:
    """Fit on several grids, extrapolate to a spacing of zero, and count what is left as an error.

        def build(n):
            grid = mpm.Grid((24 * n,), 0.05 / n, origin=(-4 * n,))
            ...
            return mpm.Experiment(scene, particles, t1=0.1, dt=2e-3 / n, observations=tracks)

        print(mpm.fit_refined(build, {"E": ...}))

    With estimates a and b on the two finest grids, their spacings in the ratio r, the extrapolation is
    b + (b − a)/(r^p − 1), and its error from the discretisation is taken as that whole correction. With three grids or
    more p is what the three finest show, between half and twice `order`. It is added to the error of the noise by
    squares.

    Args:
        build: the experiments on n times as many cells a direction, from n; take the step n times shorter too.
        parameters: what is fitted, see `fit`. Each fit starts from the one before.
        refinements: the n, growing, two at least.
        order: p, the order in the spacing. One is careful: estimates that converge faster get a wider interval.
        report: what else to report, see `fit`.
        level: of the intervals, see `fit`.
        rtol: see `fit`.
        max_steps: see `fit`.
        progress: see `fit`.

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
    for n in numbers:
        found = fit(build(n), parameters, report=report, level=level, rtol=rtol, max_steps=max_steps, progress=progress)
        fits.append(found)
        parameters = found.restarted(parameters)
    values = np.array([[e.value for e in found.all] for found in fits])
    estimates, noise, left, orders = [], [], [], []
    for k, last in enumerate(fits[-1].all):
        p = _order(values[:, k], numbers, float(order))
        correction = (values[-1, k] - values[-2, k]) / ((numbers[-1] / numbers[-2]) ** p - 1)
        value, error = values[-1, k] + correction, float(np.hypot(last.error, correction))
        reach = fits[-1].quantile * error
        estimates.append(last._replace(value=value, error=error, interval=(value - reach, value + reach)))
        noise.append(last.error)
        left.append(abs(float(correction)))
        orders.append(p)
    return RefinedFit(tuple(fits), tuple(numbers), tuple(estimates), tuple(noise), tuple(left), tuple(orders))


def _order(values: np.ndarray, refinements: list[int], order: float) -> float:
    """The order that the three finest grids show, if their ratios are one; else the one that was given."""
    if len(values) < 3 or refinements[-1] * refinements[-3] != refinements[-2] ** 2:
        return order
    first, second = values[-2] - values[-3], values[-1] - values[-2]
    if second == 0 or first / second <= 1:
        return order / 2
    seen = np.log(first / second) / np.log(refinements[-1] / refinements[-2])
    return float(np.clip(seen, order / 2, 2 * order))
