"""What a fit found."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.special import chdtrc

from mpmjax._types import Array
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._search import Iteration
from mpmjax.fitting._uncertainty import Uncertainty


class Estimate(NamedTuple):
    """A fitted number, or one that follows from those."""

    label: str
    value: float
    error: float
    """Standard error."""
    interval: tuple[float, float]
    """Where it lies at the level of the fit."""
    unit: str = ""
    start: float = np.nan
    """The first guess."""
    at_bound: bool = False
    """Whether it came to lie at a bound, where errors mean little."""


class NoiseEstimate(NamedTuple):
    """The noise of an observation."""

    name: str
    sigma: float
    """Standard deviation, the root mean square where it varies, in the data's unit."""
    estimated: bool
    """Whether the fit estimated it."""
    misfit: float
    """Root mean square of the residuals, in units of σ."""
    points: int
    """How many numbers were measured."""


class FitResult(eqx.Module):
    """Fitted parameters, their errors, and the fitted scene.

    `print(result)` shows a table; `result["E"]` is the estimate of a parameter.
    """

    problem: FitProblem
    """What was fitted."""
    z: np.ndarray
    """The coordinates found [-], shape (n,)."""
    sigmas: tuple[Array, ...]
    """The noise of each observation, given or estimated, in the data's unit."""
    residuals: np.ndarray
    """Those of all observations, then of priors, in units of their noise [-], shape (m,)."""
    jacobian: np.ndarray
    """Their derivative by the coordinates, shape (m, n)."""
    uncertainty: Uncertainty
    """Covariance of the coordinates, and the directions that the data do not see."""
    estimates: tuple[Estimate, ...]
    """The fitted numbers, one for each entry of each parameter."""
    reported: tuple[Estimate, ...]
    """What else was asked for."""
    chi_squared: float
    """Σ r², priors included."""
    degrees_of_freedom: int
    """Measured numbers and priors, less parameters."""
    noise: tuple[NoiseEstimate, ...]
    """The noise of each observation."""
    experiments: tuple[Experiment, ...]
    """The experiments with the fitted values."""
    level: float
    """The level of the intervals [-], such as 0.95."""
    optimiser: AbstractOptimiser
    """The method of the search."""
    converged: bool
    history: tuple[Iteration, ...]
    warnings: tuple[str, ...]
    """What the data cannot tell, and what does not fit, in words."""
    interrupted: bool = False
    """Whether Ctrl-C ended it."""

    @property
    def values(self) -> dict[str, np.ndarray]:
        """The value of each parameter, in its shape."""
        values = self.problem.values(jnp.asarray(self.z, self.problem.dtype))
        return {name: np.asarray(value) for name, value in zip(self.problem.names, values, strict=True)}

    @property
    def covariance(self) -> np.ndarray:
        """Of the search's coordinates [-], shape (n, n)."""
        return self.uncertainty.covariance

    @property
    def gradient(self) -> np.ndarray:
        """The derivative of ½ Σ r² by the coordinates that a bound holds, zero of all others, shape (n,)."""
        held = np.array([e.at_bound for e in self.estimates])
        return np.asarray(self.jacobian.T @ self.residuals) * held

    @property
    def correlation(self) -> np.ndarray:
        """Of the estimates, shape (n, n)."""
        return self.uncertainty.correlation

    @property
    def spectrum(self) -> np.ndarray:
        """The eigenvalues of the Fisher information JᵀJ, growing, shape (n,): 1/√λ is how far, in coordinates, the data
        leave the direction open."""
        return self.uncertainty.spectrum

    @property
    def directions(self) -> np.ndarray:
        """The eigenvectors of the Fisher information, one a column, shape (n, n)."""
        return self.uncertainty.directions

    @property
    def all(self) -> tuple[Estimate, ...]:
        """The fitted numbers, and what was reported."""
        return (*self.estimates, *self.reported)

    def restarted(self, parameters: Mapping[str, AbstractParameter]) -> dict[str, AbstractParameter]:
        """The parameters, to be searched from the values found."""
        return {name: replace(p, start=self.values[name]) for name, p in parameters.items()}

    @property
    def scene(self) -> Any:
        """The fitted scene of the first experiment, ready to run."""
        return self.experiments[0].scene

    @property
    def p_value(self) -> float:
        """The probability of so large a χ² if the model and the noise given are right; NaN if noise was estimated, or
        an observation is robust or weighted."""
        plain = all(o.trust == (1.0, None) for e in self.experiments for o in e.observations)
        if not plain or any(noise.estimated for noise in self.noise) or self.degrees_of_freedom < 1:
            return np.nan
        return float(chdtrc(self.degrees_of_freedom, self.chi_squared))

    def __getitem__(self, label: str) -> Estimate:
        """The estimate of a parameter, or of what was reported.

        Raises:
            KeyError: there is none of this name.
        """
        for estimate in self.all:
            if estimate.label == label:
                return estimate
        raise KeyError(f"There is no estimate {label!r}, but {', '.join(e.label for e in self.estimates)}.")

    def __str__(self) -> str:
        """A table."""
        lines = [f"{'':<24} {'value':>12} ± {'error':<9} {f'{100 * self.level:g} % interval':<25} {'start':>10}"]
        left = iter(self.estimates)
        rows: list[Estimate] = []
        for name, start in zip(self.problem.names, self.problem.starts, strict=True):
            own = list(itertools.islice(left, start.size))
            if start.size > _MOST_ROWS:
                lines.append(_summary(name, start.shape, own))
            else:
                rows += own
        for e in (*rows, *self.reported):
            name = f"{e.label} [{e.unit}]" if e.unit else e.label
            interval = f"{e.interval[0]:.5g} to {e.interval[1]:.5g}"
            start = "" if np.isnan(e.start) else f"{e.start:.4g}"
            bound = "  at its bound" if e.at_bound else ""
            lines.append(f"{name:<24} {e.value:>12.6g} ± {e.error:<9.2g} {interval:<25} {start:>10}{bound}")
        lines += ["", f"{'':<24} {'numbers':>12}   {'noise σ':<22} misfit/σ"]
        for n in self.noise:
            sigma = f"{n.sigma:.3g} {'estimated' if n.estimated else 'given'}"
            lines.append(f"{n.name:<24} {n.points:>12}   {sigma:<22} {n.misfit:.3g}")
        said = f"χ² = {self.chi_squared:.4g} for {self.degrees_of_freedom} degrees of freedom"
        lines += ["", said + ("" if np.isnan(self.p_value) else f", probability {self.p_value:.2g}")]
        lines.append(f"found by {type(self.optimiser).__name__} in {len(self.history)} iterations")
        if not self.converged:
            lines.append("NOT CONVERGED: errors hold only at a minimum.")
        return "\n".join([*lines, *self.warnings])


def _summary(name: str, shape: tuple[int, ...], each: list[Estimate]) -> str:
    """Many numbers of one parameter in a line."""
    unit = f" [{each[0].unit}]" if each[0].unit else ""
    values, errors = (np.array([getattr(e, field) for e in each]) for field in ("value", "error"))
    return (
        f"{name + unit:<24} {' x '.join(map(str, shape))} numbers, {values.min():.4g} to {values.max():.4g}, median "
        f"{np.median(values):.4g}; errors {errors.min():.2g} to {errors.max():.2g}, median {np.median(errors):.2g}"
    )


_MOST_ROWS = 12
"""Numbers of one parameter up to which each has a row of the table."""
