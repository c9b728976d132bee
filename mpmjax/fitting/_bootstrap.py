"""Errors by the bootstrap: fits of data drawn anew."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Float
from mpmjax.checks import checked, require, require_whole, warn
from mpmjax.fitting._batch import Problems, batch_size, search_many
from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import FitResult


class Bootstrap(eqx.Module):
    """The estimates of fits of data drawn anew.

    `print(result)` shows a table; `result.interval("E")` is a percentile interval.
    """

    labels: tuple[str, ...]
    """The names of the fitted numbers."""
    samples: Float[np.ndarray, "k n"]
    """Their values in each fit that did not fail, shape (k, n)."""
    values: Float[np.ndarray, "n"]
    """Their values in the fit of what was measured, shape (n,)."""
    level: float
    """The level of the intervals [-]."""
    failed: int
    """How many fits failed, or came to no minimum."""

    def _column(self, label: str) -> np.ndarray:
        if label not in self.labels:
            raise KeyError(f"There is no estimate {label!r}, but {', '.join(self.labels)}.")
        return self.samples[:, self.labels.index(label)]

    def error(self, label: str) -> float:
        """The standard error of a fitted number.

        Raises:
            KeyError: there is none of this name.
        """
        return float(self._column(label).std(ddof=1))

    def interval(self, label: str) -> tuple[float, float]:
        """The percentile interval of a fitted number, at the level.

        Raises:
            KeyError: there is none of this name.
        """
        lower, upper = np.quantile(self._column(label), [(1 - self.level) / 2, (1 + self.level) / 2])
        return float(lower), float(upper)

    def __str__(self) -> str:
        """A table."""
        lines = [f"{'':<24} {'value':>12} ± {'error':<9} {100 * self.level:g} % interval"]
        for label, value in zip(self.labels, self.values, strict=True):
            lower, upper = self.interval(label)
            lines.append(f"{label:<24} {value:>12.6g} ± {self.error(label):<9.2g} {lower:.5g} to {upper:.5g}")
        lines.append(
            f"{len(self.samples)} fits of data drawn anew" + (f", {self.failed} failed" if self.failed else "")
        )
        return "\n".join(lines)


@checked
def bootstrap(
    result: FitResult,
    *,
    repeats: int = 200,
    seed: int = 0,
    batch: int | None = None,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> Bootstrap:
    """Errors and intervals of a fit without linearisation: the fitted simulation's data with new normal noise of the
    fit's σ, fitted again, many times (the parametric bootstrap: B. Efron, R. J. Tibshirani, An Introduction to the
    Bootstrap, Chapman & Hall 1993, chapters 6.5 and 13).

        print(mpm.bootstrap(mpm.fit(pull, {"E": ...})))

    It takes the model and the independence of the noise for granted, as the errors of `fit` do: what it adds is the
    curvature of the model and what bounds do. `weight` and `robust` act in each fit; the noise drawn is of σ for each
    number. A prior's mean is drawn anew too. Two hundred repeats fix a standard error to 5 %, and a 95 % interval
    less well.

    Args:
        result: the fit.
        repeats: how many fits.
        seed: of the noise.
        batch: how many fits run together, see `fit_multistart`.
        optimiser: the method of each. Default: that of the fit.
        progress: called with a line, such as `print`, as fits end.

    Raises:
        ValueError: fewer than two repeats; fewer than two fits that succeeded.
    """
    require_whole("repeats", repeats, 2)
    rng = np.random.default_rng(require_whole("seed", seed, 0))
    problem, z = result.problem, jnp.asarray(result.z, result.problem.dtype)
    predicted = [np.asarray(y, float) for e in problem.at(z) for y in e.predictions(e.run())]
    problems = [_drawn(problem, predicted, result.sigmas, rng) for _ in range(repeats)]

    def say(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} fits are done")

    members = search_many(
        Problems.of(problems, shared=False),
        result.optimiser if optimiser is None else optimiser,
        np.repeat(np.asarray(result.z, float)[None], repeats, axis=0),
        sigmas=Problems.of([result.sigmas], shared=True),
        batch=batch_size(problem, batch, repeats),
        progress=say,
    )
    ends = [m.minimum.z for m in members if m.minimum is not None and m.minimum.converged]
    require(len(ends) > 1, f"Of {repeats} fits of data drawn anew {len(ends)} came to a minimum: raise max_steps.")
    if len(ends) < repeats:
        warn(
            f"{repeats - len(ends)} of {repeats} fits of data drawn anew came to no minimum: intervals leave them out."
        )
    samples = np.array([problem.numbers(end) for end in ends])
    values = np.array([e.value for e in result.estimates])
    return Bootstrap(problem.labels, samples, values, result.level, repeats - len(ends))


def _drawn(problem: FitProblem, predicted: list[np.ndarray], sigmas: tuple, rng: np.random.Generator) -> FitProblem:
    """The problem with data of its simulation and new noise, NaN where nothing was measured."""
    drawn = []
    for observation, y, sigma in zip(problem.observations, predicted, sigmas, strict=True):
        noisy = y + np.asarray(sigma) * rng.normal(size=y.shape)
        drawn.append(np.where(np.isfinite(observation.data), noisy, np.nan))
    problem = eqx.tree_at(lambda p: [o.data for o in p.observations], problem, drawn)
    priors = [p.prior.drawn(rng) for p in problem.parameters if p.prior is not None]
    return eqx.tree_at(lambda q: [p.prior for p in q.parameters if p.prior is not None], problem, priors)
