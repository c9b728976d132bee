"""The thin adapter by which diffrax drives the step: saving, stopping and progress are its own."""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Int, Scalar, components
from mpmjax.checks import first_unmet, requirements
from mpmjax.discretisation import Stencil, in_window
from mpmjax.native import stored
from mpmjax.simulation._rollout_state import RolloutState
from mpmjax.simulation._sorting import resorted
from mpmjax.simulation._statistics import Fault, RunStatistics, no_steps, one_step
from mpmjax.state import Particles, Scene, State, with_state
from mpmjax.stepping import AbstractIntegrator, step_compiled

LEAST_STRETCH = 1e-2
"""Principal stretch [-] below which a particle has collapsed."""


class Problem(eqx.Module):
    """The part of a rollout that does not evolve."""

    scene: Scene
    particles: Particles
    stencil: Stencil | None
    dt: Scalar
    method: AbstractIntegrator
    observe: Callable[[Scene, Particles], Any] | None = None
    start: Scalar = 0.0
    """Number of the first step."""
    until: Scalar = np.inf
    """Number of steps after which a watched run ends, if it is less than were asked for."""
    slot: Scalar = 0.0
    """Zero; adjoint solves report through its cotangent (see `Reporting`)."""
    fault: Int[Array, ""] | None = None
    """`Fault` of the state before the first step; None if it is known that there is none."""
    unmet: Int[Array, ""] | None = None
    """See `RunStatistics`; likewise."""
    save_every: int | None = eqx.field(static=True, default=None)
    """Number of steps between saved frames, if there are any."""

    def at(self, state: State) -> Particles:
        """The particles with a state put in."""
        return with_state(self.particles, state)

    def resorted(self, y: RolloutState, step: Array) -> "tuple[Problem, RolloutState]":
        """The problem and the state before a step, their particles in the order of the state, which are sorted if it is
        time to.

        Args:
            y: the state as the loop carries it.
            step: the number of steps since the rollout began.
        """
        y = y.uncarried(stored)
        if y.order is None:
            return self, y
        t = (self.start + step) * self.dt
        state, order = resorted(y.order, self.scene, self.particles, y.particles, t, step, self.save_every)
        scene, particles = order.put_into(self.scene, self.particles)
        return replace(self, scene=scene, particles=particles), replace(y, particles=state, order=order)


def faulty_particles(problem: Problem, state: State, t: Scalar) -> dict[Fault, Bool[Array, "p"]]:
    """Which particles have each fault that a state may have at time t [s], the gravest fault first."""
    scene, particles = problem.scene, problem.at(state)
    finite = _finite((particles.x, particles.v, particles.C))
    finite = finite & jnp.concatenate([_finite((group.stored, group.history)) for group in particles.groups])
    outside = ~in_window(scene.kernel, scene.grid, scene.window(particles), scene.on_grid(particles, t))
    materials = scene.material_points(particles, t)
    admitted = jnp.concatenate([points.is_admissible(points.deformation) for points in materials])
    faults = {Fault.NOT_FINITE: ~finite, Fault.OUTSIDE: finite & outside, Fault.INADMISSIBLE: finite & ~admitted}
    if not scene.total:  # there forces are made of P, here of P Fᵀ, which vanishes with F: nothing opens what collapsed
        kept = [points.law.measure.collapsed(points.deformation, LEAST_STRETCH) for points in materials]
        faults[Fault.COLLAPSED] = finite & jnp.concatenate(kept)
    return faults


def _finite(fields: Any) -> Bool[Array, "p"]:
    """Whether all numbers of each particle are finite, of fields whose first axis is the particles'."""
    return reduce(jnp.logical_and, [la.finite(components(a)) for a in jax.tree.leaves(fields)])


def passed_particles(problem: Problem, before: State, after: State, t: Scalar) -> list[tuple[int, Bool[Array, "p"]]]:
    """The numbers of the boundaries that keep something out, and which particles passed each in the step from t [s]."""
    scene = problem.scene
    start = scene.grid.wrapped(before.x, scene.window(problem.at(before)))
    end = start + (after.x - before.x)
    reach = (scene.kernel.order + 1) / 2
    passed_by = [b.passed(start, end, scene.grid.spacing, t, problem.dt, reach) for b in scene.boundary]
    return [(number, passed) for number, passed in enumerate(passed_by) if passed is not None]


def gravest(faults: dict[Fault, Bool[Array, "p"]]) -> Int[Array, ""]:
    """The gravest fault that any particle has, of faults in their order, by one reduction over the particles."""
    ranks = {fault: len(faults) - i for i, fault in enumerate(faults)}
    of_particle = jnp.zeros_like(next(iter(faults.values())), jnp.int32)
    for fault, particles in reversed(faults.items()):
        of_particle = jnp.where(particles, ranks[fault], of_particle)
    worst, fault_found = of_particle.max(initial=0), jnp.asarray(Fault.NONE, jnp.int32)
    for fault, rank in ranks.items():
        fault_found = jnp.where(worst == rank, fault, fault_found)
    return fault_found


_GRAVEST_FIRST = (Fault.NOT_FINITE, Fault.PASSED, Fault.OUTSIDE, Fault.INADMISSIBLE, Fault.COLLAPSED)
"""The faults of a state, and of the step that led to it."""


def fault_of(problem: Problem, before: State, after: State, t: Scalar) -> Int[Array, ""]:
    """The gravest fault of a state, or of the step from t [s] that led to it."""
    faults = faulty_particles(problem, after, t + problem.dt)
    passed = [particles for _, particles in passed_particles(problem, before, after, t)]
    if passed:
        faults[Fault.PASSED] = reduce(jnp.logical_or, passed)
    return gravest({fault: faults[fault] for fault in _GRAVEST_FIRST if fault in faults})


def examined(problem: Problem, state: RolloutState) -> tuple[Problem, RolloutState]:
    """The problem with the fault of its start, found from values that were not known when they were given, and the
    state, made NaN if a parameter is bad, since what follows would look like numbers."""
    arrays, rest = eqx.partition((problem, state), eqx.is_array)
    constant, begin = eqx.combine(jax.lax.stop_gradient(arrays), rest)
    unmet = first_unmet(requirements((constant.scene, constant.particles, constant.method)))
    fault = jnp.where(
        unmet > 0,
        Fault.BAD_PARAMETERS,
        gravest(faulty_particles(constant, begin.particles, constant.start * constant.dt)),
    )
    valid = jnp.where(unmet > 0, jnp.nan, 1)
    state = jax.tree.map(lambda a: a * valid.astype(a.dtype), state)
    return replace(problem, fault=fault, unmet=unmet), state


def step_number(t: Array) -> Array:
    """diffrax's time as the number of a step: it divides an interval evenly, which is exact only up to rounding."""
    return jnp.round(t)


class StepSolver(diffrax.AbstractSolver):
    """One step of the method a unit of diffrax's time, which counts steps from the run's first: physical time is n·Δt,
    n counting from the problem's start, and every step has the same Δt to the last bit. `args` is a `Problem`."""

    term_structure: ClassVar = diffrax.ODETerm
    interpolation_cls: ClassVar[Callable[..., diffrax.LocalLinearInterpolation]] = diffrax.LocalLinearInterpolation
    watch: bool = False
    """Whether a fault stops the run. All values are then known and were checked; else that is done here."""

    def order(self, terms: Any) -> int:
        """Order in time; nothing depends on it, since Δt is constant."""
        del terms
        return 1

    def init(self, terms: Any, t0: Any, t1: Any, y0: RolloutState, args: Problem) -> tuple[RunStatistics, Array]:
        """Empty statistics, and a report of zero."""
        del terms, t0, t1
        dtype = y0.particles.x.dtype
        statistics = no_steps(dtype)
        if args.fault is not None:
            statistics = replace(statistics, fault=args.fault, unmet=args.unmet)
        return statistics, jnp.zeros((), dtype)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: RolloutState, args: Problem, solver_state: Any, made_jump: Any
    ) -> tuple:
        """One step. A fault is reported as the solver's failure: as an event diffrax would ask for it once more."""
        del terms, t1, made_jump
        statistics, report = solver_state
        args, y = args.resorted(y0, step_number(t0))
        t = (args.start + step_number(t0)) * args.dt
        method = args.method.reporting(args.slot)
        particles, info = step_compiled(args.scene, args.at(y.particles), t, args.dt, method, args.stencil)
        report = report + info.solve.report
        y1 = y.after(particles, info)
        arrays, rest = eqx.partition((args, y.particles, y1.particles, t), eqx.is_array)
        fault = fault_of(*eqx.combine(jax.lax.stop_gradient(arrays), rest))
        statistics = statistics.after_step(one_step(info, fault), solved=not args.method.is_explicit)
        y1 = y1.carried()
        dense = {"y0": y0, "y1": y1}
        if not self.watch:
            return y1, None, dense, (statistics, report), diffrax.RESULTS.successful
        results: Any = diffrax.RESULTS  # whose members the type checker takes for another type
        goes_on = (statistics.fault == Fault.NONE) & (step_number(t0) + 1 < args.until)
        result = results.where(goes_on, results.successful, results.nonlinear_divergence)
        return y1, None, dense, (statistics, report), result

    def func(self, terms: Any, t0: Any, y0: RolloutState, args: Problem) -> RolloutState:
        """Not a vector field; diffrax only asks for its shape."""
        return terms.vf(t0, y0, args)


def no_vector_field(t: Any, y: RolloutState, args: Problem) -> RolloutState:
    """A stand-in for the equation that diffrax expects; the solver does not evaluate it."""
    del t, args
    return jax.tree.map(jnp.zeros_like, y)
