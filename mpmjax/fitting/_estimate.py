"""Estimates of numbers and of noise, and the shapes that residuals show where a model misses the data."""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np


class Estimate(NamedTuple):
    """A fitted number, or one that follows from those."""

    label: str  # the name of the parameter, with the index of an array
    value: float  # the fitted value
    error: float  # standard error, of the noise and of what the misfit shows (see `fit`)
    interval: tuple[float, float]  # where it lies at the level of the fit
    unit: str = ""  # as the parameter says it
    start: float = np.nan  # the first guess
    at_bound: bool = False  # whether it came to lie at a bound, where errors mean little
    noise_error: float = np.nan  # standard error that the noise alone makes
    noise_interval: tuple[float, float] = (np.nan, np.nan)  # where it lies by the noise alone

    @property
    def name(self) -> str:
        """Label and unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def cells(self) -> tuple[str, str]:
        """Value with error, and interval, as a `table` has them."""
        return f"{self.value:>12.6g} ± {self.error:<9.2g}", f"{self.interval[0]:.5g} to {self.interval[1]:.5g}"

    def row(self, widened: bool) -> tuple[str, ...]:
        """All of it, as a `table` has it; the interval of the noise alone where others are `widened`."""
        alone = [f"{self.noise_interval[0]:.5g} to {self.noise_interval[1]:.5g}"] if widened else []
        start = "" if np.isnan(self.start) else f"{self.start:>10.4g}"
        return self.name, *self.cells, *alone, start, "at its bound" if self.at_bound else ""


class NoiseEstimate(NamedTuple):
    """The noise of an observation."""

    name: str  # the name of the observation
    sigma: float  # standard deviation, the root mean square where it varies, in the data's unit
    estimated: bool  # whether the fit estimated it
    misfit: float  # root mean square of the residuals, in units of σ
    points: int  # how many numbers were measured
    worth: float  # how many independent numbers they are worth, by the correlation of their residuals
    shape: str  # the shape of the residuals, "a ramp", "drifts" or "correlated"; empty where they have none
    is_beyond: bool  # whether the misfit is beyond the noise: by χ² where that is given, by the shape where it is not

    @property
    def row(self) -> tuple[str, ...]:
        """All of it, as a `table` has it."""
        sigma = f"{self.sigma:.3g} {'estimated' if self.estimated else 'given'}"
        shape = self.shape and f"{self.shape}: worth {self.worth:.2g} independent numbers"
        return self.name, f"{self.points:>12}", sigma, f"{self.misfit:.3g}", shape


class AbstractFit(eqx.Module):
    """Estimates by name: `result["E"]` is that of a parameter, and `print(result)` shows a table."""

    estimates: eqx.AbstractVar[tuple[Estimate, ...]]

    @property
    def all(self) -> tuple[Estimate, ...]:
        """The fitted numbers, and the reported ones."""
        return self.estimates

    @abc.abstractmethod
    def __str__(self) -> str:
        """A table."""

    def __getitem__(self, label: str) -> Estimate:
        """The estimate of a parameter, or of a reported number; a KeyError if there is none of this name."""
        estimates = {estimate.label: estimate for estimate in self.all}
        if label not in estimates:
            raise KeyError(f"There is no estimate {label!r}, but {', '.join(estimates)}.")
        return estimates[label]


def table(head: Sequence[str], *rows: Sequence[str]) -> list[str]:
    """The lines of a table, its columns as wide as they need."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    widths[0] = max(widths[0], _FIRST_COLUMN)
    return ["  ".join(f"{cell:<{w}}" for cell, w in zip(row, widths, strict=True)).rstrip() for row in (head, *rows)]


def improbable(squares: Any, freedom: float) -> bool:
    """Whether Σ r² of this many degrees of freedom is beyond noise of variance one."""
    from scipy.special import chdtrc  # here, since it takes long to import

    return bool(freedom > 0 and chdtrc(freedom, squares) < IMPROBABLE)


def shape_of(r: np.ndarray) -> tuple[float, str]:
    """The shape of residuals (f, ...), sequences of f in the order of time, or of another abscissa: numbers measured,
    over how many independent ones they are worth, one at least; and "a ramp", "drifts", "correlated", or "" of noise.

    Numbers with correlation ρ_k at a distance k are worth N/τ independent ones (G. V. Bayley, J. M. Hammersley, Suppl.
    J. R. Stat. Soc. 8 (1946) 184, doi 10.2307/2983560), τ being the larger of 1 + 2 Σ ρ_k, which counts for means, as
    far as sums of pairs are positive (C. J. Geyer, Stat. Sci. 7 (1992) 473, doi 10.1214/ss/1177011137), and
    1 + 2 Σ ρ_k², which counts where residuals oscillate. Sequences are worth (tr C)²/tr C² independent ones, C being
    their covariance. A ramp is a straight line, by Student's t of its slope, corrected for the correlation beside it.
    """
    rows = np.asarray(r, float).reshape(len(r), -1)
    rows = rows[:, (rows != 0).any(axis=0)]
    count, columns = rows.shape
    if count < _LEAST_ROWS or columns == 0:
        return 1.0, ""
    alike, of_means, of_squares = _correlation(rows)
    t = np.linspace(-1, 1, count)
    left = rows - np.polynomial.polynomial.polyval(t, np.polynomial.polynomial.polyfit(t, rows, 1)).T
    rest = np.maximum((left**2).sum(axis=0), np.finfo(float).tiny)
    explained, squares = (rows**2).sum() - rest.sum(), (count - 2) * (t @ rows) ** 2 / (t @ t) / rest
    steep = improbable(squares.sum() / alike / max(_correlation(left)[1:]), columns / alike)
    kind = "correlated" if max(alike, of_means, of_squares) > 1 else ""
    kind = "a ramp" if steep and explained > rest.sum() else "drifts" if of_means > count / _DRIFT else kind
    return alike * max(of_means, of_squares), kind


def strongest_mode(rows: np.ndarray) -> float:
    """The square of the largest singular value of residuals (f, c) in units of their noise, above the (√f + √c)² that
    noise has (S. Geman, Ann. Probab. 8 (1980) 252, doi 10.1214/aop/1176994775); zero where chance may explain it
    (I. M. Johnstone, Ann. Stat. 29 (2001) 295, doi 10.1214/aos/1009210544)."""
    f, c = np.sqrt(rows.shape)
    above = np.linalg.norm(rows, 2) ** 2 - (f + c) ** 2
    return float(above) if above > _TRACY_WIDOM * (f + c) * (1 / f + 1 / c) ** (1 / 3) else 0.0


def _correlation(rows: np.ndarray) -> tuple[float, float, float]:
    """Sequences (f, c) over how many independent ones they are worth, and τ along them, of means and of squares; one
    where chance may explain them: by the correlation of all pairs, of neighbours, and by the number of runs of one sign
    (A. Wald, J. Wolfowitz, Ann. Math. Statist. 11 (1940) 147, doi 10.1214/aoms/1177731909)."""
    count, columns = rows.shape
    total = (rows**2).sum()
    lags = np.array([(rows[: count - k] * rows[k:]).sum() for k in range(count)]) / total
    gram = rows.T @ rows if columns < count else rows @ rows.T
    participation = (gram**2).sum() / total**2  # tr C²/(tr C)², and 1/f by chance
    alone = ((rows**2).sum(axis=0) ** 2).sum() / total**2  # the same of the diagonal of C
    pairs = columns * (columns - 1) / 2
    together = columns > 1 and improbable(count * pairs * (participation / alone - 1) / (columns - 1), pairs)
    alike = float(columns * np.clip(participation - 1 / count, 1 / columns, 1)) if together else 1.0
    above = (rows > 0).sum(axis=0)
    changes = 2 * above * (count - above) / count
    deviation = np.sqrt(max((changes * (changes - 1) / (count - 1)).sum(), 1.0))
    runs = (changes.sum() - np.count_nonzero(np.diff(rows > 0, axis=0))) / deviation
    # Both are normal of variance one where numbers are independent.
    if not improbable(max(lags[1] * np.sqrt(count * columns), runs, 0) ** 2 / alike, 1.0):
        return alike, 1.0, 1.0
    pair_sums = lags[: count // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pair_sums <= 0)
    of_means = 1 + 2 * lags[1 : 2 * ends[0] if len(ends) else count].sum()
    by_chance = (1 - np.arange(1, count) / count) * alike / (count * columns)
    of_squares = 1 + 2 * np.maximum(lags[1:] ** 2 - by_chance, 0).sum()
    if together:
        alike = columns * np.clip(participation - max(of_means, of_squares) / count, 1 / columns, 1)
    return float(alike), float(np.clip(of_means, 1, count)), float(np.clip(of_squares, 1, count))


IMPROBABLE = 1e-3  # Probability, of noise alone, below which a misfit is beyond the noise, or residuals have a shape
_TRACY_WIDOM = 3.27  # quantile of Tracy and Widom's distribution, of order one, that is as improbable
_LEAST_ROWS = 8  # rows below which nothing is said of their order
VALUE = f"{{:>12}} ± {'error':<9}"  # head of the first of `Estimate.cells`
_FIRST_COLUMN = 24
_DRIFT = 6  # independent numbers along a sequence, up to which it drifts
