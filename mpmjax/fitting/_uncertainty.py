"""How well a minimum of least squares fixes its parameters."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri, stdtrit

_ROUNDINGS = 1e3
"""Singular values of J, its columns of length one, below this many roundings of the largest are none: the data do not
see the direction."""
_SHARE = 1e-6
"""Part of a unit vector below which it does not lie in a direction."""
_LEAST_FREEDOM = 1e-3
"""Degrees of freedom below which there are none, but rounding."""
_NODES = 100
"""Of Gauss-Hermite quadrature."""
_MOST_SAID = 8
"""Directions and pairs that are named."""
_NEARLY_ONE = 0.99
"""Correlation from which two parameters are said to be seen only together."""


class Uncertainty(NamedTuple):
    """The covariance of n coordinates at a minimum, by the Gauss-Newton Hessian."""

    inverse: np.ndarray
    """The pseudo-inverse of JᵀJ, shape (n, n): the covariance, but in directions that the data do not see."""
    unseen: np.ndarray
    """Directions that the data do not see, one a column, shape (n, u)."""
    spectrum: np.ndarray
    """The eigenvalues of the Fisher information JᵀJ, growing, shape (n,)."""
    directions: np.ndarray
    """Their eigenvectors, one a column, shape (n, n)."""
    parts: tuple[np.ndarray, ...]
    """For each observation whose noise was estimated, its part of the covariance, shape (n, n)."""
    freedoms: tuple[float, ...]
    """The degrees of freedom of each of these estimates."""

    @property
    def rank(self) -> int:
        """Number of directions that the data see."""
        return len(self.inverse) - self.unseen.shape[1]

    @property
    def error(self) -> np.ndarray:
        """Standard errors, shape (n,)."""
        return np.array([self.of(unit)[0] for unit in np.eye(len(self.inverse))])

    @property
    def covariance(self) -> np.ndarray:
        """The covariance, shape (n, n); infinite on the diagonal of a coordinate that the data do not see."""
        covariance = self.inverse.copy()
        at = np.isinf(self.error)
        covariance[at, at] = np.inf
        return covariance

    @property
    def correlation(self) -> np.ndarray:
        """Correlations, shape (n, n); NaN beside a coordinate that the data do not see."""
        error = self.error
        with np.errstate(invalid="ignore"):
            found = self.inverse / np.outer(error, error)
        found[np.isinf(error)] = np.nan
        found[:, np.isinf(error)] = np.nan
        return found

    def of(self, gradient: np.ndarray) -> tuple[float, float]:
        """The standard error of a number with this gradient by the coordinates, shape (n,), and its degrees of freedom:
        infinite where all noise is known, else by Welch and Satterthwaite (B. L. Welch, Biometrika 34 (1947) 28,
        doi 10.1093/biomet/34.1-2.28), (Σ_k v_k)²/Σ_k v_k²/ν_k with the variances v_k that the observations bring."""
        if np.abs(self.unseen.T @ gradient).max(initial=0) > _SHARE * np.linalg.norm(gradient):
            return np.inf, np.inf
        variance = float(gradient @ self.inverse @ gradient)
        brought = [float(gradient @ part @ gradient) for part in self.parts]
        spread = sum(v**2 / freedom for v, freedom in zip(brought, self.freedoms, strict=True))
        return np.sqrt(variance), variance**2 / spread if spread > 0 else np.inf


def quantile(level: float, degrees_of_freedom: float) -> float:
    """How many standard errors an interval of this level reaches to each side: of Student's t, or with infinite degrees
    of freedom of the normal distribution."""
    p = (1 + level) / 2
    return float(ndtri(p) if np.isinf(degrees_of_freedom) else stdtrit(degrees_of_freedom, p))


def uncertainty(J: np.ndarray, eps: float, estimated: Sequence[tuple[slice, float]]) -> Uncertainty:
    """The uncertainty of the coordinates.

    Args:
        J: derivative of the residuals, in units of their noise, shape (m, n).
        eps: the precision in which it was computed.
        estimated: rows and degrees of freedom of each observation whose noise was estimated.
    """
    n = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    length = np.where(length == 0, 1, length)
    _, singular, Vt = np.linalg.svd(J / length, full_matrices=len(J) < n)
    values = np.zeros(n)
    values[: len(singular)] = singular
    seen = values > _ROUNDINGS * eps * values.max(initial=0)
    root = Vt[seen] / values[seen, None] / length
    inverse = root.T @ root
    unseen = (Vt[~seen] / length).T
    spectrum, directions = np.linalg.eigh(J.T @ J)
    parts = tuple(inverse @ J[rows].T @ J[rows] @ inverse for rows, _ in estimated)
    return Uncertainty(
        inverse,
        unseen / np.maximum(np.linalg.norm(unseen, axis=0), np.finfo(float).tiny),
        np.maximum(spectrum, 0),
        directions,
        parts,
        tuple(freedom for _, freedom in estimated),
    )


def noise(
    r: np.ndarray, J: np.ndarray, rows: slice, count: int, weight: float, robust: float | None
) -> tuple[float, float]:
    """The factor by which an observation's noise is larger than was assumed, and its degrees of freedom: their number
    less the share of the parameters that it fixes, m − tr(J_k (JᵀJ)⁻¹ J_kᵀ). NaN where that leaves none.

    Args:
        r: residuals of all observations.
        J: their derivative.
        rows: those of the observation.
        count: how many of them were measured.
        weight: the factor of its squares.
        robust: its robust limit.
    """
    U, singular, _ = np.linalg.svd(J / np.maximum(np.linalg.norm(J, axis=0), np.finfo(float).tiny), full_matrices=False)
    seen = singular > 1e-8 * singular.max(initial=0)
    freedom = count - float((U[rows][:, seen] ** 2).sum())
    if freedom < _LEAST_FREEDOM:
        return np.nan, freedom
    return float(np.sqrt((r[rows] ** 2).sum() / (weight * freedom * _mean_square(robust)))), freedom


def _mean_square(robust: float | None) -> float:
    """The mean square of robust residuals of normal noise of variance one: 1 without a limit, less with one."""
    if robust is None:
        return 1.0

    r, weight = np.polynomial.hermite_e.hermegauss(_NODES)
    return float((weight * 2 * r**2 / (1 + np.sqrt(1 + (r / robust) ** 2))).sum() / np.sqrt(2 * np.pi))


def seen_together(labels: tuple[str, ...], found: Uncertainty, logarithmic: tuple[bool, ...]) -> list[str]:
    """What the data cannot tell, in words: directions in which the coordinates may change and the data do not, and
    pairs of coordinates that are nearly so.

    Args:
        labels: the coordinates' names.
        found: their uncertainty.
        logarithmic: whether they are logarithms of their values.
    """
    said, correlation = [], found.correlation
    for direction in found.unseen.T:
        parts = [i for i in range(len(labels)) if abs(direction[i]) > 0.05]
        said.append(_unseen(parts, direction, labels, logarithmic))
    for i, j in itertools.combinations(range(len(labels)), 2):
        rho = correlation[i, j]
        if abs(rho) > _NEARLY_ONE:
            together = "together" if rho > 0 else "in opposite directions"
            said.append(
                f"{labels[i]} and {labels[j]}: {abs(rho):.5f} correlated, a change of both {together} is hardly seen."
            )
    more = len(said) - _MOST_SAID
    return said[:_MOST_SAID] + ([f"There are {more} more such directions and pairs."] if more > 0 else [])


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
