"""How well a minimum of least squares fixes its parameters."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from mpmjax.checks import warn

_ROUNDINGS = 1e3  # of the largest singular value of J, its columns of length one: smaller ones are of unseen directions
_SHARE = 1e-6  # part of a unit vector below which it does not lie in a direction
_LEAST_FREEDOM = 1e-3  # degrees of freedom below which there are none, but rounding
_AT_BOUND = 1e-2  # standard errors from a bound at which a number lies at it
_NODES = 100  # nodes of Gauss-Hermite quadrature
_MOST_SAID = 8  # directions that are named
_NEARLY_ONE = 0.99  # correlation from which two parameters are said to be seen only together
_COVERAGE = 2.0  # standard errors to which the grid convergence index reaches
_PART = 0.1  # share of a direction's largest effect on the data from which a coordinate is named with it


class Uncertainty(NamedTuple):
    """The covariance of n coordinates at a minimum, by the Gauss-Newton Hessian."""

    inverse: np.ndarray  # the covariance [-] but in directions that the data do not see, shape (n, n)
    unseen: np.ndarray  # directions that the data do not see, one a column, shape (n, u)
    weak: np.ndarray  # directions seen a tenth as well as each coordinate alone, one a column, shape (n, w)
    spectrum: np.ndarray  # the eigenvalues of the Fisher information JᵀJ, growing, shape (n,)
    directions: np.ndarray  # their eigenvectors, one a column, shape (n, n)
    parts: tuple[np.ndarray, ...]  # what each observation brings to it, and last, if known, the discretisation, (n, n)
    freedoms: tuple[float, ...]  # degrees of freedom of the noise of each; infinite where it is known

    @property
    def rank(self) -> int:
        """Number of directions that the data see."""
        return len(self.inverse) - self.unseen.shape[1]

    @property
    def error(self) -> np.ndarray:
        """Standard errors, shape (n,)."""
        return self.of(np.eye(len(self.inverse)))[0]

    @property
    def alone(self) -> np.ndarray:
        """Standard errors if all other coordinates were known, shape (n,); infinite of one that changes nothing."""
        return np.sqrt(_ratio(np.ones(len(self.spectrum)), self.directions**2 @ self.spectrum))

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
            correlation = self.inverse / np.outer(error, error)
        correlation[np.isinf(error)] = np.nan
        correlation[:, np.isinf(error)] = np.nan
        return correlation

    def of(self, gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The standard errors of numbers with these gradients by the coordinates, shape (..., n), infinite where one
        has a part in a direction that the data do not see; and their degrees of freedom, both of shape (...): infinite
        where all noise is known, else by Welch and Satterthwaite (B. L. Welch, Biometrika 34 (1947) 28,
        doi 10.1093/biomet/34.1-2.28), (Σ_k v_k)²/Σ_k v_k²/ν_k with the variances v_k that the observations bring."""
        size = np.linalg.norm(gradient, axis=-1).max(initial=0)
        depends = np.abs(gradient @ self.unseen).max(axis=-1, initial=0) > _SHARE * size
        variance = quadratic(gradient, self.inverse)
        freedom = np.where(depends, np.inf, self.freedom(variance, self.brought(gradient)))
        return np.asarray(np.sqrt(np.where(depends, np.inf, variance))), freedom

    def brought(self, gradient: np.ndarray) -> list[np.ndarray]:
        """The part of their variance that each observation brings."""
        return [quadratic(gradient, part) for part in self.parts]

    def freedom(self, variance: np.ndarray, brought: list[np.ndarray]) -> np.ndarray:
        """The degrees of freedom of a variance, of which the noise of observations brought parts."""
        whole = np.where((variance > 0) & np.isfinite(variance), variance, 1)  # its square may overflow
        return _ratio(1.0, sum((v / whole) ** 2 / f for v, f in zip(brought, self.freedoms, strict=True)))


def quadratic(gradient: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """g·A g of gradients of shape (..., n), not negative."""
    return np.asarray(np.maximum(np.einsum("...i,ij,...j->...", gradient, matrix, gradient), 0))


def _ratio(a: Any, b: Any) -> np.ndarray:
    """a/b, infinite where b is zero."""
    some = np.asarray(b) > 0
    return np.where(some, a / np.where(some, b, 1), np.inf)


def quantile(level: float, degrees_of_freedom: float | np.ndarray) -> np.ndarray:
    """How many standard errors an interval of this level reaches to each side, of Student's t, normal if infinite."""
    p, normal = (1 + level) / 2, np.isinf(degrees_of_freedom)
    from scipy.special import ndtri, stdtrit  # here, since it takes long to import

    return np.where(normal, ndtri(p), stdtrit(np.where(normal, 1, degrees_of_freedom), p))


def uncertainty(
    J: np.ndarray, eps: float, noises: Sequence[tuple[slice, float, float]], moved: np.ndarray | None = None
) -> Uncertainty:
    """The uncertainty of the coordinates by J, the derivative of residuals in units of their noise, shape (m, n), of
    precision `eps`. `noises` are of each observation its rows, the factor by which the variance of its residuals is
    larger than one, and the degrees of freedom with which that is known: with factors c_k it is the covariance
    (JᵀJ)⁻¹ Σ c_k J_kᵀJ_k (JᵀJ)⁻¹ (H. White, Econometrica 48 (1980) 817, doi 10.2307/1912934).

    `moved` has errors Δ, shape (k, n): how far the minimum moves on twice the spacing, and then with twice the step,
    and the step that a search left undone. The covariance then has Σ Δ Δᵀ/4 besides: the 95 % interval of the grid
    convergence index, two grids and the order two, reaches 3 |Δ|/(2² − 1) to each side (P. J. Roache, J. Fluids Eng.
    116 (1994) 405, doi 10.1115/1.2910291). Of steps, whose order is one, |Δ| is the error itself."""
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
    weak = (Vt[seen & (values < np.sqrt(1 - _NEARLY_ONE))] / length).T
    spectrum, directions = np.linalg.eigh(J.T @ J)
    parts = tuple(inverse @ J[rows].T @ J[rows] @ inverse for rows, *_ in noises)
    inverse = inverse + sum((c - 1) * part for (_, c, _), part in zip(noises, parts, strict=True))
    parts = tuple(c * part for (_, c, _), part in zip(noises, parts, strict=True))
    freedoms = tuple(freedom for *_, freedom in noises)
    if moved is not None:
        part = moved.T @ moved / _COVERAGE**2
        inverse, parts, freedoms = inverse + part, (*parts, part), (*freedoms, np.inf)
    unseen, weak = (a / np.maximum(np.linalg.norm(a, axis=0), np.finfo(float).tiny) for a in (unseen, weak))
    return Uncertainty(inverse, unseen, weak, np.maximum(spectrum, 0), directions, parts, freedoms)


def at_bound(r: np.ndarray, J: np.ndarray, room: np.ndarray) -> np.ndarray:
    """Whether each coordinate's value lies at a bound, shape (n,): the data want to go beyond, and it is a hundredth of
    its standard error away, were all others known. Room is as of `FitProblem.room`."""
    length = np.maximum(np.linalg.norm(J, axis=0), np.finfo(float).tiny)
    error = np.sqrt((r**2).sum() / max(len(r) - len(length), 1))
    wanted = np.stack([J.T @ r, -J.T @ r]) / length
    return np.asarray(((wanted > room * length) & (room * length <= _AT_BOUND * error)).any(axis=0))


def noise(
    r: np.ndarray, J: np.ndarray, rows: slice, count: int, weight: float, robust: float | None
) -> tuple[float, float]:
    """The factor by which the noise of an observation, some rows of r and J, is larger than was assumed, and its
    degrees of freedom: the `count` of its measured numbers less the share of the parameters that it fixes,
    m − tr(J_k (JᵀJ)⁻¹ J_kᵀ). NaN where that leaves none."""
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


def seen_together(labels: tuple[str, ...], errors: Uncertainty, logarithmic: tuple[bool, ...]) -> list[str]:
    """Directions in which coordinates, or logarithms, may change and the data do not, or hardly, in words."""
    length, correlation, texts = np.where(np.isinf(errors.alone), 1, 1 / errors.alone), errors.correlation, []
    for columns, weak in ((errors.unseen, False), (errors.weak, True)):
        effects = columns * length[:, None]  # on the data
        if effects.shape[1] > 1:
            from scipy.linalg import qr  # here, since it takes long to import

            # Combinations, each with a coordinate to itself, so that few coordinates meet in one.
            *_, pivots = qr(effects.T, mode="r", pivoting=True)
            effects = effects @ np.linalg.inv(effects[pivots[: effects.shape[1]]])
        for effect in effects.T:
            parts = np.flatnonzero(np.abs(effect) > _PART * np.abs(effect).max())
            change = effect[parts] / length[parts]
            change, names = change / change[np.abs(change).argmax()], [labels[i] for i in parts]
            logarithms, rho = all(logarithmic[i] for i in parts), correlation[parts[0], parts[-1]]
            proportion = (
                f"{', '.join(names)}: a change in the proportion {' : '.join(f'{c:+.2g}' for c in change)} of their "
                f"{'logarithms' if logarithms else 'coordinates'}"
            )
            if weak and len(parts) == 2 and np.isfinite(rho):
                together = "together" if rho > 0 else "in opposite directions"
                correlated = f"{abs(rho):.5f} correlated, a change of both {together} is hardly seen."
                texts.append(f"{names[0]} and {names[1]}: {correlated}")
            elif weak:
                seen = np.sqrt((effect / length @ errors.directions) ** 2 @ errors.spectrum) / np.linalg.norm(effect)
                texts.append(f"{proportion} is hardly seen, {1 / seen:.2g} times less than of one alone.")
            elif len(parts) == 1:
                texts.append(f"{names[0]}: the data do not see it.")
            elif len(parts) == 2 and logarithms:
                power = change[0] / change[1]
                only = f"{names[0]}·{names[1]}^{-power:.3g}"
                if abs(abs(power) - 1) < 0.01:
                    only = f"their {'ratio' if power > 0 else 'product'}"
                texts.append(f"{names[0]} and {names[1]}: only {only} is seen.")
            else:
                texts.append(f"{proportion} is not seen by the data.")
    more = len(texts) - _MOST_SAID
    return texts[:_MOST_SAID] + ([f"There are {more} more such directions."] if more > 0 else [])


class Prediction(NamedTuple):
    """A quantity by a fit, with the error that the parameters' errors make. All arrays have its shape."""

    value: np.ndarray  # the quantity at the fit
    error: np.ndarray  # standard error; infinite where the value depends on what the data do not see
    lower: np.ndarray  # where the value lies at the level: the confidence band, of each point by itself
    upper: np.ndarray  # the band's upper end
    sigma: np.ndarray | None  # standard deviation of the noise of a measurement of it, where that is known
    new_lower: np.ndarray | None  # where a new measurement lies at the level, its noise included: the prediction band
    new_upper: np.ndarray | None  # the prediction band's upper end
    level: float  # the level of the bands [-], such as 0.95


def banded(
    errors: Uncertainty, level: float, value: Any, J: Any, sigma: np.ndarray | None = None, number: int | None = None
) -> Prediction:
    """Values with their bands, by their derivative J, shape (..., n), and by the noise of new measurements, if known,
    of the observation of a number, if they are of one."""
    mean, gradient = np.asarray(value, float), np.asarray(J, float)
    has_derivative = np.asarray(np.isfinite(gradient).all(axis=-1))
    gradient = np.where(has_derivative[..., None], gradient, 0)
    lost = int((np.isfinite(mean) & ~has_derivative).sum())
    if lost:
        warn(f"{lost} of {mean.size} predicted numbers have no derivative, and so no band.")
    error, freedom = errors.of(gradient)
    error = np.where(has_derivative, error, np.nan)
    reach = quantile(level, freedom) * error
    new_lower = new_upper = None
    if sigma is not None:
        # One observation: s² + g·C g, Student's as that of a mean. With several the noise adds to its own part alone.
        total = np.where(np.isfinite(error), error, 0) ** 2 + sigma**2
        brought = [part + (sigma**2 if k == number else 0) for k, part in enumerate(errors.brought(gradient))]
        wider = np.where(np.isfinite(error), np.sqrt(total), error)
        beyond = quantile(level, errors.freedom(total, brought)) * wider
        new_lower, new_upper = np.asarray(mean - beyond), np.asarray(mean + beyond)
    return Prediction(
        mean, np.asarray(error), np.asarray(mean - reach), np.asarray(mean + reach), sigma, new_lower, new_upper, level
    )
