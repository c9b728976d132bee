"""Errors that follow from a fit: of its predictions, and of its parameters by data drawn anew."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import checked, positive, require, warn, whole
from mpmjax.fitting._estimate import VALUE, AbstractFit, Estimate, table
from mpmjax.fitting._experiment import Experiment, Numbers, fits
from mpmjax.fitting._fit import Level
from mpmjax.fitting._problem import Coordinates, FitProblem, linearised
from mpmjax.fitting._result import FitResult
from mpmjax.fitting._search import AbstractOptimiser, batch_size, counted, search_many
from mpmjax.fitting._uncertainty import Prediction, banded


@checked
def predict(
    result: FitResult,
    of: Callable[[Experiment], Any],
    *,
    experiment: Experiment | int = 0,
    sigma: Annotated[Numbers, positive] | None = None,
    level: Level | None = None,
) -> Prediction:
    """Anything that follows from the parameters of a fit, with its band.

        def height(e):
            run = mpm.simulate(heavier(e.scene), e.particles, t1=1.0, dt=e.dt, adjoint=diffrax.ForwardMode())
            return run.final.x[:, 1].max()

        mpm.fitting.predict(result, height)

    The error is by the delta method: √(g·C g) of each number, g its derivative by the search's coordinates (forward
    mode) and C their covariance; the band is normal, or Student's where the noise was estimated, and holds as far as
    the quantity is linear in the coordinates over their errors.

    Args:
        result: the fit.
        of: function of an experiment with the fitted parameters, that returns a number or an array; its runs take
            `adjoint=diffrax.ForwardMode()`.
        experiment: the number of one that was fitted, or another one, with the parameters that belong to all.
        sigma: noise of a new measurement, in the unit of the quantity; a number or an array that broadcasts against it.
            Default: no prediction band.
        level: of the bands [-]. Default: that of the fit.

    Raises:
        ValueError: there is no such experiment; a run in `of` that has no forward derivative; a level that is none.
    """
    count = len(result.problem.experiments)
    if isinstance(experiment, int):
        require(0 <= experiment < count, f"The fit has experiments 0 to {count - 1}, got {experiment}.")
    one = sigma is None or np.size(sigma) > 0
    require(one, "predict's sigma must be a number or an array of numbers, got an empty one.")
    level = float(result.level if level is None else level)
    try:
        (value,), (J,) = _linearised(result, eqx.Partial(_of_one, of, experiment))
    except TypeError as error:
        if "custom_vjp" not in str(error):
            raise
        raise ValueError(
            "What is predicted has no derivative by forward mode: give the runs in it adjoint=diffrax.ForwardMode()."
        ) from None
    noise: Any = None if sigma is None else np.asarray(sigma, float)
    fault = f"predict's sigma must fit what is predicted, of shape {value.shape}, got shape {np.shape(noise)}."
    require(fits(noise, value.shape), fault)
    noise = None if noise is None else np.broadcast_to(noise, value.shape)
    return banded(result.uncertainty, level, value, J, noise)


@checked
def predict_observations(
    result: FitResult,
    experiments: tuple[Experiment, ...] | list[Experiment] | None = None,
    *,
    level: Level | None = None,
) -> tuple[Prediction, ...]:
    """The observations of a fit as it predicts them, with bands, in their order, and of new measurements with the noise
    that was given or estimated.

    Args:
        result: the fit.
        experiments: as many with as many observations each, such as the same with more data, or longer, of which
            observations and end times are taken. Default: those fitted.
        level: of the bands [-]. Default: that of the fit.

    Raises:
        ValueError: other experiments that are not as many, or have not as many observations.
    """
    fitted = result.problem.experiments
    asked = fitted if experiments is None else tuple(experiments)
    shape, wanted = ([len(e.observations) for e in each] for each in (asked, fitted))
    require(
        shape == wanted,
        f"predict_observations needs experiments with as many observations as were fitted, {wanted}, got {shape}.",
    )
    observations = [o for e in asked for o in e.observations]
    level = float(result.level if level is None else level)
    same = all(
        e.t1 == f.t1 and eqx.tree_equal(e.observations, f.observations) for e, f in zip(asked, fitted, strict=True)
    )
    if same and all(np.isfinite(o.data).all() for o in observations):
        values, derivatives = result.fitted
    else:
        asked = tuple(replace(e, observations=a.observations, t1=a.t1) for e, a in zip(fitted, asked, strict=True))
        values, derivatives = _linearised(result, eqx.Partial(_observed, asked))
    predictions = []
    each = zip(values, derivatives, observations, result.problem.sigmas, strict=True)
    for number, (value, J, o, sigma) in enumerate(each):
        # The noise of new measurements is the observation's own, or that of the fitted one.
        sigma = np.asarray(sigma if o.sigma is None else o.sigma, float)
        noise = np.broadcast_to(sigma if fits(sigma, value.shape) else np.sqrt((sigma**2).mean()), value.shape)
        predictions.append(banded(result.uncertainty, level, value, J, noise, number))
    return tuple(predictions)


def _of_one(
    of: Callable[[Experiment], Any], experiment: Experiment | int, problem: FitProblem, z: Coordinates
) -> tuple[Array, ...]:
    """A function of one experiment with the parameters put in."""
    e = problem.put(experiment, z, None) if isinstance(experiment, Experiment) else problem.at(z)[experiment]
    return (jnp.asarray(of(e), problem.dtype),)


def _observed(experiments: tuple[Experiment, ...], problem: FitProblem, z: Coordinates) -> tuple[Array, ...]:
    """Predictions of the observations of some experiments, NaN where a run fails."""
    predicted = []
    for number, experiment in enumerate(experiments):
        fitted = problem.put(experiment, z, number)
        run = fitted.run(adjoint=diffrax.ForwardMode(), throw=False)
        predicted += [jnp.where(run.statistics.healthy, p, jnp.nan) for p in fitted.predictions(run)]
    return tuple(predicted)


def _linearised(
    result: FitResult, function: Callable[[FitProblem, Coordinates], tuple[Array, ...]]
) -> tuple[tuple[Array, ...], list[np.ndarray]]:
    """Values that follow from a fit, and their derivatives by the coordinates, shape (..., n)."""
    problem = result.problem
    z = jnp.asarray(result.z, problem.dtype)
    values, columns = _compiled(function, problem, z)
    return values, [np.moveaxis(np.asarray(column), 0, -1) for column in columns]


_compiled = eqx.filter_jit(lambda function, problem, z: linearised(partial(function, problem), z, problem.at_once))


class Bootstrap(AbstractFit):
    """The estimates of fits of data drawn anew; `result["E"].interval` is a percentile interval."""

    estimates: tuple[Estimate, ...]  # of the fit of what was measured, errors and intervals of the samples
    samples: Float[np.ndarray, "k n"]  # their values in each fit that did not fail, shape (k, n)
    level: float  # the level of the intervals [-]
    failed: int  # how many fits failed, or came to no minimum

    def __str__(self) -> str:
        """A table."""
        head = "", VALUE.format("value"), f"{100 * self.level:g} % interval"
        last = f"{len(self.samples)} fits of data drawn anew" + (f", {self.failed} failed" if self.failed else "")
        return "\n".join([*table(head, *((e.name, *e.cells) for e in self.estimates)), last])


@checked
def bootstrap(
    result: FitResult,
    *,
    repeats: Annotated[int, whole(2)] = 200,
    seed: Annotated[int, whole(0)] = 0,
    batch: Annotated[int, whole(1)] | None = None,
    optimiser: AbstractOptimiser | None = None,
    progress: Callable[[str], None] | None = None,
) -> Bootstrap:
    """Errors and intervals of a fit without linearisation: the fitted simulation's data with new normal noise of the
    fit's σ, and priors' means, drawn and fitted again, many times (the parametric bootstrap: B. Efron,
    R. J. Tibshirani, An Introduction to the Bootstrap, Chapman & Hall 1993, chapters 6.5 and 13). It takes the model
    and independent noise for granted. 200 repeats fix a standard error to 5 %.

    Args:
        result: the fit.
        repeats: how many fits.
        seed: of the noise.
        batch: how many fits run together, see `Starts`.
        optimiser: the method of each. Default: that of the fit.
        progress: called with a line, such as `print`, as fits end.

    Raises:
        ValueError: fewer than two repeats; fewer than two fits that succeeded.
    """
    rng = np.random.default_rng(seed)
    problem, z = result.problem, jnp.asarray(result.z, result.problem.dtype)
    predicted = [np.asarray(y, float) for e in problem.at(z) for y in e.predictions(e.run())]
    problems = []
    for _ in range(repeats):
        each = zip(problem.observations, predicted, problem.sigmas, strict=True)
        noisy = ((o, y + np.asarray(sigma) * rng.normal(size=y.shape)) for o, y, sigma in each)
        data = [np.where(np.isfinite(o.data), y, np.nan) for o, y in noisy]
        priors = [p.prior.drawn(rng) for p in problem.parameters if p.prior is not None]
        drawn = eqx.tree_at(lambda p: [o.data for o in p.observations], problem, data)
        drawn = eqx.tree_at(lambda q: [p.prior for p in q.parameters if p.prior is not None], drawn, priors)
        problems.append(drawn)
    members = search_many(
        problems,
        result.optimiser if optimiser is None else optimiser,
        dict.fromkeys(range(repeats), result.z),
        batch=batch_size(problem, batch, repeats),
        progress=counted(progress, "{} of {} fits are done"),
    )
    ends = [m.z for m in members.values() if m.converged]
    require(len(ends) > 1, f"Of {repeats} fits of data drawn anew {len(ends)} came to a minimum: raise max_steps.")
    failed = repeats - len(ends)
    if failed:
        warn(f"{failed} of {repeats} fits of data drawn anew came to no minimum: intervals leave them out.")
    samples = np.array([problem.numbers(end) for end in ends])
    ends = np.quantile(samples, [(1 - result.level) / 2, (1 + result.level) / 2], axis=0).T.tolist()
    each = zip(result.estimates, samples.std(axis=0, ddof=1).tolist(), ends, strict=True)
    estimates = tuple(e._replace(error=error, interval=tuple(interval)) for e, error, interval in each)
    return Bootstrap(estimates, samples, result.level, failed)
