"""A fit as a problem of least squares: residuals of all observations as a function of one vector."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import require, shortened
from mpmjax.fitting._experiment import Experiment
from mpmjax.fitting._observation import AbstractObservation
from mpmjax.fitting._parameter import AbstractParameter

Coordinates = Float[Array, "n"]
"""The coordinates z of all parameters, one after the other [-]."""


class FitProblem(eqx.Module):
    """The residuals of some experiments as a function of the coordinates of some parameters."""

    experiments: tuple[Experiment, ...]
    names: tuple[str, ...] = eqx.field(static=True)
    parameters: tuple[AbstractParameter, ...]
    starts: tuple[Array, ...]
    """The first guess of each."""

    def __init__(self, experiments: tuple[Experiment, ...], parameters: Mapping[str, AbstractParameter]):
        require(len(experiments) > 0, "A fit needs an experiment at least.")
        require(len(parameters) > 0, "A fit needs a parameter at least.")
        dtypes = sorted({str(e.dtype) for e in experiments})
        require(len(dtypes) == 1, f"All experiments of a fit must have particles of one precision, got {dtypes}.")
        self.experiments, self.names, self.parameters = experiments, tuple(parameters), tuple(parameters.values())
        self.starts = tuple(self._start(name, p) for name, p in parameters.items())
        self.parameters = tuple(replace(p, start=start) for p, start in zip(self.parameters, self.starts, strict=True))
        points = sum(o.count for o in self.observations)
        known = sum(s.size for s, p in zip(self.starts, self.parameters, strict=True) if p.prior is not None)
        require(
            points + known >= self.size,
            f"{points} measured numbers cannot fix {self.size} parameters: measure more, give priors, or fit fewer.",
        )
        given = any(o.sigma is not None for o in self.observations)
        require(
            given or points + known > self.size,
            f"{points} measured numbers fix {self.size} parameters and leave none to estimate the noise: give sigma.",
        )

    def _start(self, name: str, parameter: AbstractParameter) -> Array:
        own = range(len(self.experiments)) if parameter.only is None else parameter.only
        unknown = [k for k in own if not 0 <= k < len(self.experiments)]
        require(not unknown, f"The parameter {name!r} is only of experiments {unknown}, which there are not.")
        require(len(own) > 0, f"The parameter {name!r} is of no experiment: only must name one at least.")
        start = _first_guess(name, parameter, self.experiments[own[0]])
        parameter.check(name, np.asarray(start))
        if parameter.prior is not None:
            shapes = {np.shape(parameter.prior.mean), np.shape(parameter.prior.sigma)}
            fits = shapes <= {(), start.shape}
            require(fits, f"The prior of {name!r} must have one number or shape {start.shape}, got {sorted(shapes)}.")
        return start

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return sum(start.size for start in self.starts)

    @property
    def dtype(self) -> Any:
        """The precision of its numbers."""
        return self.experiments[0].dtype

    @property
    def observations(self) -> tuple[AbstractObservation, ...]:
        """Those of all experiments, in their order."""
        return tuple(o for e in self.experiments for o in e.observations)

    @property
    def noise_is_given(self) -> tuple[bool, ...]:
        """Of each observation, whether its noise is given, and not to be estimated."""
        return tuple(o.sigma is not None for o in self.observations)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each coordinate: that of its parameter, with an index where that has several."""
        labels = []
        for name, start in zip(self.names, self.starts, strict=True):
            places = np.ndindex(start.shape)
            labels += [name if start.ndim == 0 else f"{name}[{', '.join(map(str, place))}]" for place in places]
        return tuple(labels)

    @property
    def scales_alike(self) -> bool:
        """Whether another noise would not move the minimum: of one observation, squares alone and no prior."""
        (first, *others), priors = self.observations, [p for p in self.parameters if p.prior is not None]
        return not others and not priors and first.robust is None

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Of each coordinate, whether it is the logarithm of its value."""
        each = zip(self.parameters, self.starts, strict=True)
        return tuple(parameter.logarithmic for parameter, start in each for _ in range(start.size))

    def size_of_data(self, sigmas: tuple[Array, ...]) -> float:
        """√Σ (data/σ)², the size of what the residuals are the difference of [-]."""
        each = zip(self.observations, sigmas, strict=True)
        return float(np.sqrt(sum(np.nansum((o.data / np.asarray(sigma)) ** 2) for o, sigma in each)))

    @property
    def rows(self) -> tuple[slice, ...]:
        """The residuals of each observation; those of priors follow."""
        ends = np.cumsum([0, *(o.data.size for o in self.observations)])
        return tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))

    def coordinates(self, z: Coordinates) -> tuple[Array, ...]:
        """The coordinates of each parameter, in its shape."""
        parts = jnp.split(z, np.cumsum([start.size for start in self.starts])[:-1])
        return tuple(part.reshape(start.shape) for part, start in zip(parts, self.starts, strict=True))

    def values(self, z: Coordinates) -> tuple[Array, ...]:
        """The value of each parameter."""
        each = zip(self.parameters, self.starts, self.coordinates(z), strict=True)
        return tuple(parameter.value(start, own) for parameter, start, own in each)

    def numbers(self, z: Coordinates) -> Float[Array, "n"]:
        """The values of all parameters, one after the other."""
        return jnp.concatenate([value.reshape(-1) for value in self.values(z)])

    def at(self, z: Coordinates) -> tuple[Experiment, ...]:
        """The experiments with these values."""
        found = []
        for number, experiment in enumerate(self.experiments):
            for parameter, value in zip(self.parameters, self.values(z), strict=True):
                if parameter.only is None or number in parameter.only:
                    experiment = parameter.put(experiment, value)
            found.append(experiment)
        return tuple(found)

    def residuals(self, z: Coordinates, sigmas: tuple[Array, ...], adjoint: Any) -> tuple[Array, Array]:
        """The residuals of all observations, then of priors [-], shape (m,), NaN where a simulation met a fault or does
        not reach a measurement; and what tangent solves report (see `Run.report`).

        Args:
            z: the coordinates.
            sigmas: the noise of each observation.
            adjoint: how diffrax differentiates.
        """
        parts, reports, noise = [], [], iter(sigmas)
        for experiment in self.at(z):
            run = experiment.run(adjoint=adjoint, throw=False)
            for observation, predicted in zip(experiment.observations, experiment.predictions(run), strict=True):
                r = observation.residuals(predicted, next(noise))
                parts.append(jnp.where(run.statistics.healthy, r, jnp.nan))
            assert run.report is not None
            reports.append(run.report)
        for parameter, value in zip(self.parameters, self.values(z), strict=True):
            if parameter.prior is not None:
                parts.append(parameter.prior.residuals(value).reshape(-1))
        return jnp.concatenate(parts), jnp.stack(reports)

    def jacobian(self, z: Coordinates, sigmas: tuple[Array, ...]) -> tuple[Array, Array]:
        """The residuals and their derivative by the coordinates, shape (m, n), in one pass of forward mode: the
        simulation once, its tangents for all coordinates beside it. NaN where a tangent solve did not converge."""

        def both(z: Coordinates) -> tuple[tuple[Array, Array], Array]:
            r, report = self.residuals(z, sigmas, diffrax.ForwardMode())
            return (r, report), r

        (J, unsolved), r = jax.jacfwd(both, has_aux=True)(z)
        return r, jnp.where((unsolved != 0).any(), jnp.nan, J)


def _first_guess(name: str, parameter: AbstractParameter, experiment: Experiment) -> Array:
    """The first guess of a parameter, which must be a number or an array of the experiment.

    Raises:
        ValueError: it is not, or putting another value there changes nothing.
    """
    try:
        start = parameter.first_guess(experiment)
        changed = parameter.put(experiment, start + 1 + jnp.abs(start))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"The parameter {name!r} must name a number of the experiment e, such as "
            f"lambda e: e.scene.material.youngs_modulus: {shortened(str(error), 200)}."
        ) from None
    before, after = jax.tree.leaves(experiment), jax.tree.leaves(changed)
    same = len(before) == len(after) and all(
        np.shape(a) == np.shape(b) and np.array_equal(a, b)
        for a, b in zip(before, after, strict=True)
        if eqx.is_array_like(a)
    )
    require(not same, f"The parameter {name!r} changes nothing of the experiment: name a number that it has.")
    return start
