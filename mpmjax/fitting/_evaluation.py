"""Residuals in three stages: parameters are put into the experiments, these are run, and the runs are observed.

Each stage is a program of its own, so a new observation or parameter leaves the large one, of the runs, as it is. They
are transformed from outside: `jax.jvp` and `jax.vmap` then spare all numbers that the coordinates do not change.

At the end: residuals on twice the spacing and step, and how far the minimum moves there, as the discretisation errs.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.fitting._experiment import AbstractObservation, Experiment, observe_all
from mpmjax.fitting._problem import Coordinates, FitProblem, Sigmas, in_batches, size_of
from mpmjax.fitting._uncertainty import uncertainty
from mpmjax.simulation import Run, simulate
from mpmjax.state import Particles, Scene, state_of, with_state


class Kept(eqx.Module):
    """The leaves of a state that are read."""

    marks: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, scene: Scene, particles: Particles) -> list[Array]:
        return [leaf for leaf, mark in zip(jax.tree.leaves(state_of(particles)), self.marks, strict=True) if mark]

    def put(self, particles: Particles, parts: list[Array]) -> Particles:
        """The particles with these leaves."""
        leaves, tree = jax.tree.flatten(state_of(particles))
        left = iter(parts)
        state = [next(left) if mark else leaf for leaf, mark in zip(leaves, self.marks, strict=True)]
        return with_state(particles, jax.tree.unflatten(tree, state))


def parts_kept(problem: FitProblem, count: int) -> tuple[Kept, ...] | None:
    """The parts of the states that the observations of each experiment read; None where they do not fit into the memory
    `count` times, as runs or tangents, or residuals are not those of runs: these are then one program."""
    if any(getattr(type(problem), name) is not getattr(FitProblem, name) for name in ("jacobian", "residuals")):
        return None
    kept = _kept(problem)
    each = zip(problem.experiments, kept, strict=True)
    size = sum(size_of(kept(e.scene, e.particles)) * (e.steps + 1) for e, kept in each)
    return kept if count * size <= problem.memory else None


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


def staged(problem: FitProblem, z: Coordinates, kept: tuple[Kept, ...]) -> tuple[tuple[Array, Array], tuple[Run, ...]]:
    """`FitProblem.residuals` by forward mode, in three programs, and the runs; `kept` as of `parts_kept`."""
    experiments, of_priors = _put(problem, z)
    each = zip(experiments, kept, strict=True)
    runs = tuple(_run((e.scene, e.particles, e.method), part, e.t1, e.dt) for e, part in each)
    return _compared(tuple(e.observations for e in experiments), runs, kept, problem.sigmas, of_priors), runs


@eqx.filter_jit
def _run(setup: Any, kept: Kept, t1: float, dt: float) -> Run:
    """The run of a scene, particles and a method, which observes what is kept."""
    scene, particles, method = setup
    forward = diffrax.ForwardMode()
    return simulate(scene, particles, t1=t1, dt=dt, method=method, observe=kept, adjoint=forward, throw=False)


@eqx.filter_jit
def _compared(
    observations: tuple[tuple[AbstractObservation, ...], ...],
    runs: tuple[Run, ...],
    kept: tuple[Kept, ...],
    sigmas: Sigmas,
    of_priors: Array,
) -> tuple[Array, Array]:
    """The residuals of observations of runs that observed what is kept, then of priors; and the runs' reports."""
    parts, noise = [], iter(sigmas)
    for each, run, part in zip(observations, runs, kept, strict=True):

        def observe(row: Any, each: Any = each, run: Run = run, part: Kept = part) -> Any:
            return observe_all(each, run.scene, part.put(run.final, row[1]))

        seen = jax.lax.map(observe, (run.steps, run.observed))
        run = replace(run, observed=seen)
        parts += [o.residuals_of(s, run, next(noise)) for o, s in zip(each, seen, strict=True)]
    return jnp.concatenate([*parts, of_priors]), jnp.stack([jnp.asarray(run.report) for run in runs])


class Evaluation(NamedTuple):
    """Cost and derivatives at a place."""

    cost: Float[Array, ""]  # ½ Σ r²; NaN where a simulation failed
    gradient: Coordinates  # derivative of the cost by the coordinates, shape (n,)
    residuals: Float[Array, "m"] | None = None  # r [-], of an optimiser that uses them
    jacobian: Float[Array, "m n"] | None = None  # their derivative
    room: Float[Array, "2 n"] | None = None  # how far values can change until their bounds, see `FitProblem.room`
    runs: tuple[Run, ...] = ()  # runs of the experiments, where they were a program of their own


def evaluated(problem: FitProblem, z: Coordinates) -> Evaluation | None:
    """Residuals and Jacobian by forward mode, and the runs, without what was observed; None as of `parts_kept`."""
    if (kept := parts_kept(problem, 1 + problem.size)) is None:
        return None
    z, rest = jnp.asarray(z, problem.dtype), []

    def along(tangent: Any) -> tuple[Any, Any]:
        def residuals(z: Coordinates) -> tuple[Any, Any]:
            both, runs = staged(problem, z, kept)
            arrays, rest[:] = eqx.partition(tuple(replace(run, observed=None) for run in runs), eqx.is_array)
            return both, arrays

        both, changes, arrays = jax.jvp(residuals, (z,), (tangent,), has_aux=True)
        return (both, arrays), changes

    ((r, _), runs), (columns, unsolved) = in_batches(along, np.eye(len(z), dtype=z.dtype), len(z))
    J = np.where(np.asarray(unsolved).any(), np.nan, np.asarray(columns).T).astype(r.dtype)
    return of_residuals(np.asarray(r), J, problem.room(z))._replace(runs=eqx.combine(runs, tuple(rest)))


def of_residuals(r: Any, J: Any, room: Array) -> Evaluation:
    """An evaluation by residuals and Jacobian, its sums in the precision of coordinates."""
    exact = r.astype(float)
    return Evaluation((exact**2).sum() / 2, J.T.astype(float) @ exact, r, J, room)


def residuals_at(problem: FitProblem, points: Float[np.ndarray, "b n"]) -> Float[Array, "b m"]:
    """Residuals at some points together, without derivatives."""
    kept = parts_kept(problem, len(points))

    def one(z: Coordinates) -> Array:
        return (_residuals(problem, z) if kept is None else staged(problem, z, kept)[0])[0]

    return jax.vmap(one)(jnp.asarray(points, problem.dtype))


def costs_at(
    problem: FitProblem,
    points: Float[np.ndarray, "k n"],
    batch: int,
    progress: Callable[[int, int], None] = lambda done, count: None,
) -> Float[np.ndarray, "k"]:
    """½ Σ r² at many points, `batch` of them together; NaN where a simulation fails. `progress` as of `search_many`."""
    costs = np.empty(len(points))
    for first in range(0, len(points), batch):
        r = residuals_at(problem, points[np.minimum(np.arange(first, first + batch), len(points) - 1)])
        costs[first : first + batch] = (np.asarray(r) ** 2).sum(axis=1)[: len(points) - first] / 2
        progress(min(first + batch, len(points)), len(points))
    return costs


_residuals = eqx.filter_jit(lambda problem, z: problem.residuals(z, diffrax.ForwardMode()))
_put = eqx.filter_jit(lambda problem, z: (problem.at(z), problem.prior_residuals(z)))


class CoarseGrid(NamedTuple):
    """The look at twice the spacing, and at twice the step there."""

    moved: Float[np.ndarray, "2 n"]
    """How far the minimum moves on twice the spacing, and from there with twice the step."""
    residuals: Float[np.ndarray, "m"]  # those of the minimum on twice the spacing


def look_at_coarse_grid(problem: FitProblem, z: Coordinates, jacobian: Float[np.ndarray, "m n"]) -> CoarseGrid | str:
    """The look at twice the spacing from the minimum z, or why there is none: by Gauss-Newton steps −(JᵀJ)⁻¹ Jᵀ r with
    r of the coarse grid and J of the fine one, zero of what a bound holds, at most three of each, while Σ r² falls."""
    inverse = uncertainty(jacobian, float(jnp.finfo(problem.dtype).eps), ()).inverse
    places, first = [np.asarray(z, float)], None
    for longer in (1, 2):
        try:  # steps so many times longer, or the next of which t1 is a whole number
            scenes = [eqx.tree_at(lambda s: s.grid, e.scene, e.scene.grid.coarsened()) for e in problem.experiments]
            each = [
                (e, scene, e.t1 / -(-e.steps // longer)) for e, scene in zip(problem.experiments, scenes, strict=True)
            ]
            experiments = tuple(replace(e, scene=scene, dt=dt) for e, scene, dt in each)
        except ValueError as error:  # of a wall that must lie on nodes, or a period
            return str(error)
        coarse, least, tried = eqx.tree_at(lambda p: p.experiments, problem, experiments), np.inf, places[-1:]
        for _ in range(_STEPS):
            try:
                r = np.asarray(residuals_at(coarse, np.array(tried[-1:])), float)[0]
            except KeyboardInterrupt:
                return "interrupted."
            first = r if first is None else first
            if not (r**2).sum() < least:
                # The first step stays even so: it is what a linear model says.
                tried = tried[: max(len(tried) - 1, 2)]
                break
            least = (r**2).sum()
            tried.append(tried[-1] - inverse @ (jacobian.T @ r))
        if not np.isfinite(least):
            return "the simulation fails there."
        places.append(tried[-1])
    return CoarseGrid(np.diff(places, axis=0), np.asarray(first))


def unexplained(
    r: Float[np.ndarray, "m"], J: Float[np.ndarray, "m n"], coarse: CoarseGrid | str | None
) -> Float[np.ndarray, "m"]:
    """The part of residuals r that is not like their change on twice the spacing, as far as parameters, with the
    Jacobian J, do not make up for that. An error of the order two is a third of that change."""
    if not isinstance(coarse, CoarseGrid):
        return r
    change = coarse.residuals - r
    change = change - J @ np.linalg.lstsq(J, change)[0]
    share = (r @ change) / max(change @ change, np.finfo(float).tiny)
    return r - np.clip(share, 0, 1) * change


_STEPS = 3
