"""Residuals and their Jacobian by three compiled programs: what is put into the experiments, their runs with tangents,
and what is observed of these. So a new observation or parameter leaves the large program, of the runs, as it is.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.fitting._experiment import AbstractObservation, Experiment, observe_all
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas, in_batches, size_of
from mpmjax.simulation import Run, simulate
from mpmjax.state import Particles, Scene, state_of, with_state


class Evaluated(eqx.Module):
    """Residuals and Jacobian at a place, for an optimiser in the place of the problem that they are of."""

    place: Coordinates
    r: Float[Array, "m"]
    J: Float[Array, "m n"]
    rooms: Float[Array, "2 2 n"]  # see `FitProblem.room`: at the place, and where the search is

    @property
    def dtype(self) -> Any:
        """The precision of the problem."""
        return self.r.dtype

    def jacobian(self, z: Coordinates, sigmas: Sigmas, mode: Any = None) -> tuple[Array, Array]:
        """Residuals and Jacobian, see `FitProblem.jacobian`."""
        del z, sigmas, mode
        return self.r, self.J

    def room(self, z: Coordinates) -> Float[Array, "2 n"]:
        """Room at the place, or where the search was, see `FitProblem.room`."""
        return jnp.where((z == self.place).all(), *self.rooms)


def parts_kept(problem: FitProblem, count: int) -> tuple["Kept", ...] | None:
    """The parts of the states that the observations of each experiment read; None where the residuals are not those of
    runs, or these parts do not fit into the memory `count` times, as runs or tangents. Observations are then a part of
    the runs' program."""
    if any(getattr(type(problem), name) is not getattr(FitProblem, name) for name in ("jacobian", "residuals")):
        return None
    kept = _kept(problem)
    each = zip(problem.experiments, kept, strict=True)
    size = sum(size_of(kept(e.scene, e.particles)) * (e.steps + 1) for e, kept in each)
    return kept if count * size <= problem.memory else None


class Kept(eqx.Module):
    """The leaves of a state that are read."""

    marks: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, scene: Scene, particles: Particles) -> list[Array]:
        del scene
        return [leaf for leaf, mark in zip(jax.tree.leaves(state_of(particles)), self.marks, strict=True) if mark]

    def put(self, particles: Particles, parts: list[Array]) -> Particles:
        """The particles with these leaves."""
        leaves, tree = jax.tree.flatten(state_of(particles))
        left = iter(parts)
        state = [next(left) if mark else leaf for leaf, mark in zip(leaves, self.marks, strict=True)]
        return with_state(particles, jax.tree.unflatten(tree, state))


@eqx.filter_jit
def _kept(problem: FitProblem) -> tuple[Kept, ...]:
    """See `parts_kept`. Compiled, and so traced once for all numbers."""
    kept = []
    for e in problem.experiments:
        leaves, tree = jax.tree.flatten(state_of(e.particles))

        def seen(leaves: list[Array], e: Experiment = e, tree: Any = tree) -> Any:
            of = e.scene, with_state(e.particles, jax.tree.unflatten(tree, leaves))
            return eqx.filter(observe_all(e.observations, *of), eqx.is_array)

        traced = jax.make_jaxpr(seen)(leaves).jaxpr
        read = {id(name) for names in (*(line.invars for line in traced.eqns), traced.outvars) for name in names}
        kept.append(Kept(tuple(id(name) in read for name in traced.invars)))
    return tuple(kept)


def evaluated(
    problem: FitProblem, place: Coordinates, z: Coordinates, sigmas: Sigmas, kept: tuple[Kept, ...]
) -> Evaluated:
    """Residuals and Jacobian at a place, of a search that is at z, by forward mode; `kept` as of `parts_kept`."""
    place, z = (jnp.asarray(a, problem.dtype) for a in (place, z))
    experiments, tangents, prior, rooms = _placed(problem, place, z)
    each = zip(experiments, tangents, kept, strict=True)
    runs = [_run(_setup(e), _setup(t), part, e.t1, e.dt, problem.size) for e, t, part in each]
    runs, changes = zip(*runs, strict=True)
    observations, moved = (tuple(e.observations for e in each) for each in (experiments, tangents))
    r, J = _compared((observations, runs), (moved, changes), kept, sigmas, prior)
    return Evaluated(place, r, J, rooms)


@eqx.filter_jit
def _placed(
    problem: FitProblem, place: Coordinates, z: Coordinates
) -> tuple[tuple[Experiment, ...], tuple[Experiment, ...], tuple[Array, Array], Array]:
    """The experiments at a place; the tangents of what depends on the coordinates, with a leading axis n, and None for
    all else; residuals of priors with their Jacobian; and the rooms there and at z."""
    moved = partial(_moved, problem, eqx.is_inexact_array)
    tangents = jax.vmap(lambda unit: jax.jvp(moved, (place,), (unit,))[1])(jnp.eye(len(place), dtype=place.dtype))
    prior = problem.prior_residuals(place), jax.jacfwd(problem.prior_residuals)(place)
    return problem.at(place), tangents, prior, jnp.stack([problem.room(place), problem.room(z)])


def _setup(experiment: Experiment) -> Any:
    """The part of an experiment that is run."""
    return experiment.scene, experiment.particles, experiment.method


def _moved(problem: FitProblem, is_kind: Callable[[Any], bool], z: Coordinates) -> tuple[Experiment, ...]:
    """The arrays of a kind of the experiments at z that parameters have changed, and None for all others, which are the
    same objects as before."""
    before, (leaves, tree) = jax.tree.leaves(problem.experiments), jax.tree.flatten(problem.at(z))
    alike = before if len(before) == len(leaves) else [None] * len(leaves)
    parts = (a if is_kind(a) and a is not b else None for a, b in zip(leaves, alike, strict=True))
    return jax.tree.unflatten(tree, list(parts))


@eqx.filter_jit
def _run(setup: Any, tangents: Any, kept: Kept, t1: float, dt: float, count: int) -> tuple[Run, Run]:
    """The run of a scene, particles and a method, which observes what is kept; and its `count` tangents, with a leading
    axis, by those of the setup."""
    moving, fixed = _parted(setup, tangents)
    run, static = _run_of(fixed, kept, t1, dt)

    def along(unit: tuple[Array, Any]) -> tuple[Any, Any]:
        floats, change, others = jax.jvp(run, (moving,), (unit[1],), has_aux=True)
        return (floats, others), change

    (floats, others), changes = in_batches(along, (jnp.arange(count), tangents), count)
    return eqx.combine(floats, others, *static), changes


@eqx.filter_jit
def _runs(setup: Any, moved: Any, kept: Kept, t1: float, dt: float, count: int) -> Run:
    """The runs of `count` values of a part of a setup, which all have a leading axis, as the runs' arrays do."""
    run, static = _run_of(_parted(setup, moved)[1], kept, t1, dt)
    floats, others = jax.vmap(lambda _, moved: run(moved))(jnp.arange(count), moved)
    return eqx.combine(floats, others, *static)


def _run_of(fixed: Any, kept: Kept, t1: float, dt: float) -> tuple[Callable[[Any], tuple[Any, Any]], list[Any]]:
    """A function of a part of a setup that returns the floats and the other arrays of the run of the whole, with all
    its states; and a list that has the rest of the run once it was called."""
    static = []

    def run(moving: Any) -> tuple[Any, Any]:
        scene, particles, method = eqx.combine(moving, fixed)
        forward = diffrax.ForwardMode()
        run = simulate(scene, particles, t1=t1, dt=dt, method=method, observe=kept, adjoint=forward, throw=False)
        arrays, other = eqx.partition(run, eqx.is_array)
        static[:] = [other]
        return eqx.partition(arrays, eqx.is_inexact_array)

    return run, static


@eqx.filter_jit
def _compared(
    compared: Any, tangents: Any, kept: tuple[Kept, ...], sigmas: Sigmas, prior: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The residuals of observations and runs, then of priors, and their Jacobian by the tangents of both, NaN where a
    tangent solve did not converge."""
    moving, fixed = _parted(compared, tangents)

    def residuals(moving: Any) -> Array:
        observations, runs = eqx.combine(moving, fixed)
        return _residuals(observations, runs, kept, sigmas)

    def along(tangent: Any) -> tuple[Array, Array]:
        return jax.jvp(residuals, (moving,), (tangent,))

    (r, columns), (of_priors, by_priors) = in_batches(along, tangents, len(prior[1].T)), prior
    unsolved = jnp.stack([change.report for change in tangents[1]])
    J = jnp.where((unsolved != 0).any(), jnp.nan, jnp.concatenate([columns.T, by_priors]))
    return jnp.concatenate([r, of_priors]), J


def _residuals(
    observations: tuple[tuple[AbstractObservation, ...], ...],
    runs: tuple[Run, ...],
    kept: tuple[Kept, ...],
    sigmas: Sigmas,
) -> Array:
    """The residuals of observations of runs that observed what is kept."""
    parts, noise = [], iter(sigmas)
    for each, run, part in zip(observations, runs, kept, strict=True):

        def observe(row: Any, each: Any = each, run: Run = run, part: Kept = part) -> Any:
            return observe_all(each, run.scene, part.put(run.final, row[1]))

        seen = jax.lax.map(observe, (run.steps, run.observed))
        run = replace(run, observed=seen)
        parts += [o.residuals_of(s, run, next(noise)) for o, s in zip(each, seen, strict=True)]
    return jnp.concatenate(parts)


def costs_at(
    problem: FitProblem,
    points: Float[np.ndarray, "k n"],
    sigmas: Sigmas,
    batch: int,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> Float[np.ndarray, "k"]:
    """½ Σ r² at many points, without derivatives; NaN where a simulation fails. `batch` are computed together, and
    `progress` is called with how many are done, and of how many."""
    costs = np.empty(len(points))
    for first in range(0, len(points), batch):
        rows = points[np.minimum(np.arange(first, first + batch), len(points) - 1)]
        together = _costs(problem, jnp.asarray(rows, problem.dtype), sigmas)
        costs[first : first + batch] = together[: len(points) - first]
        progress(min(first + batch, len(points)), len(points))
    return costs


def _costs(problem: FitProblem, points: Float[Array, "b n"], sigmas: Sigmas) -> Float[Array, "b"]:
    """½ Σ r² at some points together."""
    kept = parts_kept(problem, len(points))
    if kept is None:
        return _costs_at_once(problem, points, sigmas)
    experiments, moved, prior = _placed_together(problem, points)
    each = zip(experiments, moved, kept, strict=True)
    runs = tuple(_runs(_setup(e), _setup(m), part, e.t1, e.dt, len(points)) for e, m, part in each)
    observations, moved = (tuple(e.observations for e in each) for each in (experiments, moved))
    return _squares(observations, moved, runs, kept, sigmas, prior)


@eqx.filter_jit
def _costs_at_once(problem: FitProblem, points: Float[Array, "b n"], sigmas: Sigmas) -> Float[Array, "b"]:
    """See `_costs`: in one program, which keeps no states."""
    return jax.vmap(lambda z: (problem.residuals(z, sigmas, diffrax.ForwardMode())[0] ** 2).sum() / 2)(points)


@eqx.filter_jit
def _placed_together(problem: FitProblem, points: Float[Array, "b n"]) -> tuple[Any, Any, Float[Array, "b k"]]:
    """The experiments at the first point; what the points change of them, with a leading axis; residuals of priors."""
    moved, prior = jax.vmap(lambda z: (_moved(problem, eqx.is_array, z), problem.prior_residuals(z)))(points)
    return problem.at(points[0]), moved, prior


@eqx.filter_jit
def _squares(
    observations: Any, moved: Any, runs: tuple[Run, ...], kept: tuple[Kept, ...], sigmas: Sigmas, prior: Array
) -> Array:
    """½ Σ r² of several runs each, of moved observations."""
    fixed, (arrays, rest) = _parted(observations, moved)[1], eqx.partition(runs, eqx.is_array)

    def cost(moved: Any, arrays: Any, prior: Array) -> Array:
        r = _residuals(eqx.combine(moved, fixed), eqx.combine(arrays, rest), kept, sigmas)
        return ((r**2).sum() + (prior**2).sum()) / 2

    return jax.vmap(cost)(moved, arrays, prior)


def _parted(tree: Any, tangents: Any) -> tuple[Any, Any]:
    """The leaves of a tree that have tangents, and all others."""
    has = jax.tree.map(lambda _, tangent: tangent is not None, tree, tangents, is_leaf=lambda leaf: leaf is None)
    return eqx.partition(tree, has)
