"""How well a minimum of least squares fixes its parameters."""

import itertools
from typing import NamedTuple

import numpy as np
import scipy.stats

_UNSEEN = 1e-12
"""Eigenvalues of JᵀJ below this part of the largest are rounding: the data do not see the direction at all."""
_NEARLY_ONE = 0.99
"""Correlation from which two parameters are said to be seen only together."""


class Uncertainty(NamedTuple):
    """The covariance of the coordinates at a minimum."""

    covariance: np.ndarray
    """(JᵀJ)⁻¹, shape (n, n); infinite on its diagonal where the data do not see a coordinate."""
    spectrum: np.ndarray
    """The eigenvalues of the Fisher information JᵀJ, growing, shape (n,)."""
    directions: np.ndarray
    """Their eigenvectors, shape (n, n), one a column."""
    degrees_of_freedom: float
    """Of Student's t: infinite where the noise is known."""

    @property
    def error(self) -> np.ndarray:
        """Standard errors, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> np.ndarray:
        """Correlations, shape (n, n); NaN beside a coordinate that is not seen."""
        error = self.error
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(error, error)

    def quantile(self, level: float) -> float:
        """How many standard errors an interval of this level reaches to each side: of Student's t, or of the normal
        distribution where the noise is known."""
        return float(scipy.stats.t.ppf((1 + level) / 2, self.degrees_of_freedom))


def uncertainty(J: np.ndarray, degrees_of_freedom: float) -> Uncertainty:
    """The covariance of the coordinates, by the Gauss-Newton Hessian.

    Args:
        J: derivative of the residuals, in units of their noise, shape (m, n).
        degrees_of_freedom: of the noise's estimate; infinite if it is known.
    """
    _, singular, Vt = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    spectrum = np.zeros(J.shape[1])
    spectrum[: len(singular)] = singular**2
    seen = spectrum > _UNSEEN * spectrum.max(initial=0)
    inverse = np.where(seen, 1 / np.where(seen, spectrum, 1), 0)
    covariance = (Vt.T * inverse) @ Vt
    unseen = (np.abs(Vt[~seen]) > 1e-6).any(axis=0)
    covariance[unseen, unseen] = np.inf
    return Uncertainty(covariance, spectrum[::-1], Vt[::-1].T, degrees_of_freedom)


def noise(r: np.ndarray, J: np.ndarray, rows: slice, count: int) -> tuple[float, float]:
    """The factor by which an observation's noise is larger than was assumed, and its degrees of freedom: their number
    less the share of the parameters that it fixes, m − tr(J_k (JᵀJ)⁻¹ J_kᵀ).

    Args:
        r: residuals of all observations.
        J: their derivative.
        rows: those of the observation.
        count: how many of them were measured.
    """
    U, singular, _ = np.linalg.svd(J, full_matrices=False)
    seen = singular > np.sqrt(_UNSEEN) * singular.max(initial=0)
    freedom = count - float((U[rows][:, seen] ** 2).sum())
    return (float(np.sqrt((r[rows] ** 2).sum() / freedom)) if freedom > 0 else np.nan), freedom


def seen_together(labels: tuple[str, ...], found: Uncertainty, logarithmic: tuple[bool, ...]) -> list[str]:
    """What the data cannot tell, in words: directions in which the coordinates may change and the data do not, and
    pairs of coordinates that are nearly so.

    Args:
        labels: the coordinates' names.
        found: their uncertainty.
        logarithmic: whether they are logarithms of their values.
    """
    said, named = [], set()
    for value, direction in zip(found.spectrum, found.directions.T, strict=True):
        if value <= _UNSEEN * found.spectrum[-1]:
            parts = [i for i in range(len(labels)) if abs(direction[i]) > 0.05]
            named |= set(itertools.combinations(parts, 2))
            said.append(_unseen(parts, direction, labels, logarithmic))
    for i, j in itertools.combinations(range(len(labels)), 2):
        rho = found.correlation[i, j]
        if abs(rho) > _NEARLY_ONE and (i, j) not in named:
            together = "together" if rho > 0 else "in opposite directions"
            said.append(
                f"{labels[i]} and {labels[j]}: {abs(rho):.5f} correlated, a change of both {together} is hardly seen."
            )
    return said


def _unseen(parts: list[int], direction: np.ndarray, labels: tuple[str, ...], logarithmic: tuple[bool, ...]) -> str:
    """A direction that the data do not see, in words."""
    names = [labels[i] for i in parts]
    if len(parts) == 1:
        return f"{names[0]}: the data do not see it."
    change = direction[parts]
    if len(parts) == 2 and all(logarithmic[i] for i in parts) and abs(abs(change[0] / change[1]) - 1) < 0.01:
        return f"{names[0]} and {names[1]}: only their {'ratio' if change[0] * change[1] > 0 else 'product'} is seen."
    shown = " : ".join(f"{c:+.2g}" for c in change)
    return f"{', '.join(names)}: a change in the proportion {shown} of their coordinates is not seen by the data."
