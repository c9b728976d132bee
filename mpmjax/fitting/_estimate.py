"""Estimates of numbers and of noise, with their errors."""

import abc
from typing import NamedTuple

import equinox as eqx
import numpy as np


class Estimate(NamedTuple):
    """A fitted number, or one that follows from those.

    Attributes:
        label: the name of the parameter, with the index of an array.
        value: the fitted value.
        error: standard error, of the noise and of what the misfit shows (see `fit`).
        interval: where it lies at the level of the fit.
        unit: as the parameter says it.
        start: the first guess.
        at_bound: whether it came to lie at a bound, where errors mean little.
        noise_error: standard error that the noise alone makes.
        noise_interval: where it lies by the noise alone.
    """

    label: str
    value: float
    error: float
    interval: tuple[float, float]
    unit: str = ""
    start: float = np.nan
    at_bound: bool = False
    noise_error: float = np.nan
    noise_interval: tuple[float, float] = (np.nan, np.nan)

    @property
    def name(self) -> str:
        """Label and unit."""
        return f"{self.label} [{self.unit}]" if self.unit else self.label

    @property
    def cells(self) -> tuple[str, str]:
        """Value with error, and interval, as a `table` has them."""
        return f"{self.value:>12.6g} ± {self.error:<9.2g}", f"{self.interval[0]:.5g} to {self.interval[1]:.5g}"


class NoiseEstimate(NamedTuple):
    """The noise of an observation.

    Attributes:
        name: the name of the observation.
        sigma: standard deviation, the root mean square where it varies, in the data's unit.
        estimated: whether the fit estimated it.
        misfit: root mean square of the residuals, in units of σ.
        points: how many numbers were measured.
        worth: how many independent numbers they are worth, by the correlation of their residuals.
        shape: the shape of the residuals, "a ramp", "drifts" or "correlated"; empty where they have none.
        is_beyond: whether the misfit is beyond the noise: by χ² where that is given, by the shape where it is not.
    """

    name: str
    sigma: float
    estimated: bool
    misfit: float
    points: int
    worth: float
    shape: str
    is_beyond: bool


class AbstractFit(eqx.Module):
    """Estimates by name: `result["E"]` is that of a parameter, and `print(result)` shows a table."""

    @property
    @abc.abstractmethod
    def all(self) -> tuple[Estimate, ...]:
        """The fitted numbers, and the reported ones."""

    def __getitem__(self, label: str) -> Estimate:
        """The estimate of a parameter, or of a reported number.

        Raises:
            KeyError: there is none of this name.
        """
        for estimate in self.all:
            if estimate.label == label:
                return estimate
        raise KeyError(f"There is no estimate {label!r}, but {', '.join(e.label for e in self.all)}.")
