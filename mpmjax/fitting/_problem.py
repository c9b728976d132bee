"""A fit as a problem of least squares: residuals of all observations as a function of one vector."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NoReturn

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import require, require_whole, shortened
from mpmjax.fitting._experiment import AbstractObservation, Experiment, observe_all
from mpmjax.fitting._parameter import AbstractParameter, changes
from mpmjax.state import velocity_gradient

Coordinates = Float[Array, "n"]  # the coordinates z of all parameters, one after the other [-]
Sigmas = tuple[Array, ...]  # the noise of each observation, in its data's unit


class FitProblem(eqx.Module):
    """The residuals of some experiments, in units of a noise, as a function of the coordinates of some parameters."""

    experiments: tuple[Experiment, ...]  # the experiments, with the first guesses
    names: tuple[str, ...] = eqx.field(static=True)  # the names of the parameters
    parameters: tuple[AbstractParameter, ...]  # what is searched
    starts: tuple[Array, ...]  # the first guess of each
    sigmas: Sigmas = ()  # the noise of each observation: given, estimated, or the size of its data until then
    memory: int = eqx.field(static=True, default=2**28)  # memory for what reverse mode stores, and for tangents [B]
    plane: tuple[Float[Array, "n"], Float[Array, "n f"]] | None = None  # see `on_plane`

    def __init__(
        self,
        experiments: Experiment | Sequence[Experiment],
        parameters: Mapping[str, AbstractParameter],
        memory: int = 2**28,
    ):
        self.memory, self.plane = require_whole("memory [B]", memory, 1), None
        experiments = (experiments,) if isinstance(experiments, Experiment) else tuple(experiments)
        require(len(experiments) > 0, "A fit needs an experiment at least.")
        require(len(parameters) > 0, "A fit needs a parameter at least.")
        dtypes = sorted({str(e.dtype) for e in experiments})
        require(len(dtypes) == 1, f"All experiments of a fit must have particles of one precision, got {dtypes}.")
        self.experiments, self.names, self.parameters = experiments, tuple(parameters), tuple(parameters.values())
        self.sigmas = first_noise(experiments)
        self.starts = tuple(self._start(name, p) for name, p in parameters.items())
        self.parameters = tuple(replace(p, start=start) for p, start in zip(self.parameters, self.starts, strict=True))
        points, freedom = self.points, self.points + self.fixed_by_priors - self.size
        require(
            freedom >= 0,
            f"{points} measured numbers cannot fix {self.size} parameters: measure more, give priors, or fit fewer.",
        )
        require(
            any(o.sigma is not None for o in self.observations) or freedom > 0,
            f"{points} measured numbers fix {self.size} parameters and leave none to estimate the noise: give sigma.",
        )

    def _start(self, name: str, parameter: AbstractParameter) -> Array:
        """The first guess of a parameter, which must be a number or an array of its experiments."""
        numbers = range(len(self.experiments)) if parameter.only is None else parameter.only
        unknown = [k for k in numbers if not 0 <= k < len(self.experiments)]
        require(not unknown, f"The parameter {name!r} is only of experiments {unknown}, which there are not.")
        require(len(numbers) > 0, f"The parameter {name!r} is of no experiment: only must name one at least.")
        experiment = self.experiments[numbers[0]]
        try:
            start = np.asarray(parameter.first_guess(experiment))
            changed = changes(parameter, experiment, start)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"The parameter {name!r} must name a number of the experiment e, such as "
                f"lambda e: e.scene.material.youngs_modulus: {shortened(str(error), 200)}."
            ) from None
        fault = f"The parameter {name!r} changes nothing of the experiment: name a number that it has."
        require(len(changed) > 0, fault)
        parameter.check(name, start)
        if parameter.prior is not None:
            parameter.prior.check(name, start.shape)
        for k in numbers:
            parameter.check_experiment(name, self.experiments[k])
        return jnp.asarray(start)

    def with_noise(self, sigmas: Sigmas) -> "FitProblem":
        """The problem with another noise of each observation."""
        return eqx.tree_at(lambda p: p.sigmas, self, sigmas)

    def on_plane(self, origin: np.ndarray, basis: np.ndarray) -> "FitProblem":
        """The problem as a function of y on a plane of some coordinates, origin + basis y, shapes (n,) and (n, f)."""
        plane = jnp.asarray(origin, self.dtype), jnp.asarray(basis, self.dtype)
        return eqx.tree_at(lambda p: p.plane, self, plane, is_leaf=lambda leaf: leaf is None)

    @property
    def size(self) -> int:
        """Number of coordinates n."""
        return sum(start.size for start in self.starts) if self.plane is None else self.plane[1].shape[1]

    @property
    def dtype(self) -> Any:
        """The precision of its numbers."""
        return self.experiments[0].dtype

    @property
    def observations(self) -> tuple[AbstractObservation, ...]:
        """The observations of all experiments, in their order."""
        return tuple(o for e in self.experiments for o in e.observations)

    @property
    def points(self) -> int:
        """How many numbers were measured."""
        return sum(o.count for o in self.observations)

    @property
    def measured(self) -> int:
        """How many residuals are of observations, zero of what was not measured among them."""
        return sum(o.data.size for o in self.observations)

    @property
    def rows(self) -> tuple[slice, ...]:
        """The residuals of each observation; those of priors follow."""
        ends = itertools.accumulate((o.data.size for o in self.observations), initial=0)
        return tuple(itertools.starmap(slice, itertools.pairwise(ends)))

    @property
    def fixed_by_priors(self) -> int:
        """How many numbers the priors fix by themselves."""
        each = zip(self.starts, self.parameters, strict=True)
        return sum(p.prior.fixes(start.shape) for start, p in each if p.prior is not None)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each coordinate: that of its parameter, with an index where that has several."""
        return tuple(
            f"{name}[{', '.join(map(str, place))}]" if place else name
            for name, start in zip(self.names, self.starts, strict=True)
            for place in np.ndindex(start.shape)
        )

    @property
    def owners(self) -> tuple[AbstractParameter, ...]:
        """The parameter of each coordinate."""
        return tuple(p for p, start in zip(self.parameters, self.starts, strict=True) for _ in range(start.size))

    @property
    def logarithmic(self) -> tuple[bool, ...]:
        """Whether each coordinate is the logarithm of its value."""
        return tuple(parameter.logarithmic for parameter in self.owners)

    @eqx.filter_jit
    def rounding_of_data(self) -> Array:
        """ε √Σ (data/σ)², the rounding of what the residuals are the difference of [-]."""
        each = zip(self.observations, self.sigmas, strict=True)
        ratios = (jnp.asarray(o.data, self.dtype) / jnp.asarray(sigma, self.dtype) for o, sigma in each)
        squares = sum((jnp.nansum(ratio**2) for ratio in ratios), jnp.zeros((), self.dtype))
        return float(jnp.finfo(self.dtype).eps) * jnp.sqrt(squares)

    def misfit(self, cost: float) -> float:
        """Root mean square of the residuals of the measured numbers, in units of σ, or of the size of the data."""
        return float(np.sqrt(2 * cost / self.points))

    def _valued(self, z: Coordinates) -> tuple[tuple[Array, ...], Float[Array, "n"], Float[Array, "2 n"]]:
        """See `_valued`, on the problem's plane."""
        return _valued(self.parameters, self.starts, z if self.plane is None else self.plane[0] + self.plane[1] @ z)

    def values(self, z: Coordinates) -> tuple[Array, ...]:
        """The value of each parameter."""
        return self._valued(z)[0]

    def by_name(self, z: Coordinates) -> dict[str, np.ndarray]:
        """The value of each parameter by its name, in its shape."""
        return {name: np.asarray(value) for name, value in zip(self.names, self.values(z), strict=True)}

    def numbers(self, z: Coordinates) -> Float[Array, "n"]:
        """The values of all parameters, one after the other."""
        return self._valued(z)[1]

    def shown(self, z: np.ndarray | Coordinates) -> str:
        """The first values with their labels, in a line."""
        numbers = self.numbers(jnp.asarray(z, self.dtype))
        shown = ", ".join(f"{label} {number:.5g}" for label, number in zip(self.labels[:SHOWN], numbers, strict=False))
        return shown + (", …" if self.size > SHOWN else "")

    def room(self, z: Coordinates) -> Float[Array, "2 n"]:
        """How far each value can fall and rise until its bounds, over its derivative by the coordinate [-]."""
        room = self._valued(z)[2]
        return room if self.plane is None else jnp.where(self.plane[1].T != 0, room[:, None], jnp.inf).min(axis=2)

    def at(self, z: Coordinates) -> tuple[Experiment, ...]:
        """The experiments with these values."""
        return tuple(self.put(experiment, z, number) for number, experiment in enumerate(self.experiments))

    def put(self, experiment: Experiment, z: Coordinates, number: int | None) -> Experiment:
        """An experiment with the parameters of the experiment of a number, or of all experiments with None."""
        before = experiment.particles
        for parameter, value in zip(self.parameters, self.values(z), strict=True):
            if parameter.only is None or number in parameter.only:
                experiment = parameter.put(experiment, value)
        now = experiment.particles
        if now.C is None or now.C is not before.C or now.v is before.v:
            return experiment
        # The gradient of the change of velocities that parameters made; one that they changed themselves stays.
        change = velocity_gradient(experiment.scene, eqx.tree_at(lambda q: q.v, now, now.v - before.v))
        return eqx.tree_at(lambda e: e.particles.C, experiment, now.C + change)

    def residuals(self, z: Coordinates, adjoint: Any) -> tuple[Array, Array]:
        """The residuals of all observations, then of priors [-], shape (m,), NaN where a run met a fault or does not
        reach; and its reports of tangent solves. `adjoint` is diffrax's, None for reverse mode within the memory."""
        parts, reports, noise = [], [], iter(self.sigmas)
        for experiment in self.at(z):
            run = experiment.run(adjoint=adjoint, throw=False, checkpoint_bytes=self.memory)
            each = zip(experiment.observations, run.observed, strict=True)
            parts += [observation.residuals_of(seen, run, next(noise)) for observation, seen in each]
            assert run.report is not None
            reports.append(run.report)
        return jnp.concatenate([*parts, self.prior_residuals(z)]), jnp.stack(reports)

    def prior_residuals(self, z: Coordinates) -> Array:
        """The residuals of all priors [-]."""
        each = zip(self.parameters, self.values(z), strict=True)
        return jnp.concatenate([parameter.prior_residuals(value) for parameter, value in each])

    def gradient(self, z: Coordinates) -> tuple[Array, Array, Coordinates]:
        """The residuals r, ½ Σ r² and its derivative by the coordinates, by one pass of reverse mode. NaN where a
        simulation met a fault, the derivative also where an adjoint solve did not converge."""

        def cost(z: Coordinates) -> tuple[Array, Array]:
            r = self.residuals(z.astype(self.dtype), None)[0].astype(z.dtype)
            return (r**2).sum() / 2, r

        (value, r), slope = jax.value_and_grad(cost, has_aux=True)(z)
        return r, value, slope

    def explain(
        self, z: Coordinates, failure: str = "What is observed of the simulation at the first guess is not finite."
    ) -> NoReturn:
        """Raise the error of the simulation at z, or of an observation that it does not reach; else `failure`."""
        for experiment in self.at(z):
            run = experiment.run()
            for observation, seen in zip(experiment.observations, run.observed, strict=True):
                observation.explain(seen, run)
        raise ValueError(failure)

    def jacobian(self, z: Coordinates, mode: Literal["forward", "reverse"] | None = None) -> tuple[Array, Array]:
        """The residuals and their derivative by the coordinates, shape (m, n), NaN where a tangent or adjoint solve did
        not converge: "forward", by a tangent of each coordinate beside the simulation, or in "reverse", by a pass back
        for each measured number, as many at once as the memory holds; default: the cheaper one."""
        if (self.cheaper_mode if mode is None else mode) == "reverse":
            r, pull, _ = jax.vjp(lambda z: self.residuals(z, None), z, has_aux=True)
            units = np.eye(self.measured, len(r), dtype=r.dtype)  # priors need no simulation
            _, (rows,) = in_batches(lambda unit: ((), pull(unit)), units, self.at_once)
            return r, jnp.concatenate([rows, jax.jacfwd(self.prior_residuals)(z)])
        evaluate = partial(self.residuals, adjoint=diffrax.ForwardMode())
        (r, _), (columns, unsolved) = linearised(evaluate, z, self.at_once)
        return r, jnp.where((unsolved != 0).any(), jnp.nan, columns.T)

    @property
    def cheaper_mode(self) -> Literal["forward", "reverse"]:
        """The mode in which a Jacobian costs less."""
        return "reverse" if 0 < ROW_COST * self.measured < self.size else "forward"

    @property
    def at_once(self) -> int:
        """How many tangents, or rows, of all experiments fit into the memory."""
        each = 0
        for e in self.experiments:
            seen = jax.eval_shape(eqx.Partial(observe_all, e.observations), e.scene, e.particles)
            each += _COPIES * size_of(e.particles) + size_of(seen) * (e.steps + 1)
        return max(1, int(self.memory // max(each, 1)))


def first_noise(experiments: Sequence[Experiment]) -> Sigmas:
    """The noise of each observation, or what stands for it until it is estimated."""
    noise = ((e.dtype, o.scale() if o.sigma is None else o.sigma) for e in experiments for o in e.observations)
    return tuple(jnp.asarray(sigma, dtype) for dtype, sigma in noise)


@eqx.filter_jit
def _valued(
    parameters: tuple[AbstractParameter, ...], starts: tuple[Array, ...], z: Coordinates
) -> tuple[tuple[Array, ...], Float[Array, "n"], Float[Array, "2 n"]]:
    """The value of each parameter, all numbers in a row, and their room: one program, which knows no scene."""
    parts = jnp.split(z, np.cumsum([start.size for start in starts])[:-1])
    each = [
        (p, start, part.reshape(start.shape).astype(start.dtype))
        for p, start, part in zip(parameters, starts, parts, strict=True)
    ]
    values = tuple(p.value(start, part) for p, start, part in each)
    down, up = zip(*(p.room(start, part) for p, start, part in each), strict=True)
    flat, *room = (jnp.concatenate([a.reshape(-1) for a in side]) for side in (values, down, up))
    return values, flat, jnp.stack(room)


def size_of(tree: Any) -> int:
    """Size of all arrays, or of shapes that stand for them [B]."""
    leaves = [leaf for leaf in jax.tree.leaves(tree) if hasattr(leaf, "dtype")]
    return sum(int(np.prod(leaf.shape)) * leaf.dtype.itemsize for leaf in leaves)


def linearised(function: Callable[[Coordinates], Any], z: Coordinates, at_once: int) -> tuple[Any, Any]:
    """A function's value, and its derivatives by the coordinates, a leading axis n, `at_once` of them together."""
    units = np.eye(len(z), dtype=z.dtype)
    return in_batches(lambda tangent: jax.jvp(function, (z,), (tangent,)), units, at_once)


def in_batches(function: Callable[[Any], tuple[Any, Any]], units: Any, at_once: int) -> tuple[Any, Any]:
    """A function of each row of `units`, arrays (k, ...), `at_once` together: what all share, and of each, (k, ...)."""
    count = len(jax.tree.leaves(units)[0])
    batches = -(-count // at_once)
    size = -(-count // batches)

    def batch(rows: Any) -> tuple[Any, Any]:
        if size > 1:
            return jax.vmap(function, out_axes=(None, 0))(rows)
        once, each = function(jax.tree.map(lambda a: a[0], rows))  # a third less to compile than a batch of one
        return once, jax.tree.map(lambda a: a[None], each)

    if batches == 1:
        return batch(units)

    def split(a: Any) -> Array:
        padded = jnp.concatenate([a, jnp.zeros((batches * size - count, *a.shape[1:]), a.dtype)])
        return padded.reshape(batches, size, *a.shape[1:])

    once, each = jax.lax.map(batch, jax.tree.map(split, units))
    return jax.tree.map(lambda a: a[0], once), jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:])[:count], each)


SHOWN = 4  # parameters that a line has room for
ROW_COST = 1.2  # of the Jacobian by reverse mode, over that of a column by forward mode (benchmarks/fit_cost.py)
_COPIES = 16  # memory that a tangent takes, in sizes of the particles' (benchmarks/fit_cost.py)
