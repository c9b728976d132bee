"""The thin adapter by which diffrax drives the step, and its adjoint; saving, stopping and progress are diffrax's."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Any, ClassVar, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Int, Scalar, components, particle_first
from mpmjax.autodiff import materialised, rematerialised
from mpmjax.boundary import Impulses, no_impulses
from mpmjax.checks import canonical, require, shortened
from mpmjax.discretisation import Stencil, in_window
from mpmjax.simulation._run import Fault, Run, RunStatistics, no_steps, one_step
from mpmjax.simulation._sorting import MemoryOrder, resorted
from mpmjax.state import Particles, Scene, State, state_of, with_dust, with_state
from mpmjax.stepping import AbstractIntegrator, StepInfo, step_compiled

LEAST_STRETCH = 1e-2  # principal stretch [-] below which a particle has collapsed


class RolloutState(eqx.Module):
    """The part of a rollout that evolves: the particles' state, and what colliders and boundaries have received."""

    particles: State  # what evolves of the particles
    collider_impulse: Impulses | None = None
    """Linear and angular impulse on the scene's colliders since the rollout began; None without colliders."""
    boundary_impulse: Impulses | None = None
    """Linear and angular impulse on the scene's boundaries; None unless the scene has `boundary_forces`."""
    memory: Any = None  # the memory of the run's control
    order: MemoryOrder | None = None
    """The order of the particles in memory; None if it is that in which they were given."""

    def to_loop_layout(self) -> "RolloutState":
        """The state in the layout of the loop over steps: component first, as a step has its arrays. XLA would else
        transpose all of them in each step."""
        return replace(self, particles=jax.tree.map(components, self.particles))

    def from_loop_layout(self, hold: Callable[[State], State] = lambda state: state) -> "RolloutState":
        """The state from the layout of the loop over steps, with `hold` applied to the arrays as the loop has them."""
        return replace(self, particles=jax.tree.map(particle_first, hold(self.particles)))

    def as_given(self) -> "RolloutState":
        """A state of the loop, particle first again and in the order in which the particles were given."""
        state = self.from_loop_layout()
        return state if self.order is None else replace(state, particles=self.order.undone(state.particles), order=None)

    def after(self, particles: Particles, info: StepInfo) -> "RolloutState":
        """The state after a step, from the particles after it and what it reports."""
        before = self.particles
        new = replace(self, particles=replace(state_of(particles), mass=before.mass, volume=before.volume))
        if self.collider_impulse is not None and info.colliders is not None:
            new = replace(new, collider_impulse=self.collider_impulse.plus(info.colliders))
        if self.boundary_impulse is not None and info.boundaries is not None:
            new = replace(new, boundary_impulse=self.boundary_impulse.plus(info.boundaries))
        return new


def initial_state(problem: "Problem") -> RolloutState:
    """The state in which a rollout begins."""
    scene, particles = problem.scene, problem.particles
    require(
        all(map(eqx.is_inexact_array, jax.tree.leaves(problem.memory))),
        "A control's memory must be a pytree of floats: store a switch or a count as one, and derive keys of random "
        "numbers from the time.",
    )
    of = particles.dim, particles.x.dtype
    colliders = no_impulses(scene.collider_count, *of) if scene.collider_count else None
    boundaries = no_impulses(len(scene.boundary) + len(scene.guides), *of) if scene.boundary_forces else None
    return RolloutState(state_of(particles, masses=problem.control is not None), colliders, boundaries, problem.memory)


Control = Callable[[Scene, Particles, Scalar, Scalar, Any], tuple[Scene, Particles, Any]]
"""A function of scene, particles, time [s], step [s] and memory that returns scene, particles and memory."""


class Problem(eqx.Module):
    """The part of a rollout that does not evolve."""

    scene: Scene  # what does not change
    particles: Particles  # the particles at the start
    dt: Scalar  # Δt [s]
    method: AbstractIntegrator  # the integrator
    stencil: Stencil | None = None  # in the total description, where it is made once
    observe: Callable[[Scene, Particles], Any] | None = None  # what is saved of each frame besides its state
    control: Control | None = None  # what acts before each step
    memory: Any = None  # the control's memory before the first step
    start: Scalar = 0.0  # number of the first step
    until: Scalar = np.inf  # number of steps after which a watched run ends, if it is less than were asked for
    slot: Scalar = 0.0  # zero; adjoint solves report through its cotangent (see `Reporting`)
    fault: Int[Array, ""] | None = None
    """`Fault` of the state before the first step; None if it is known that there is none."""
    unmet: Int[Array, ""] | None = None  # see `RunStatistics`; likewise
    save_every: int | None = eqx.field(static=True, default=None)
    """Number of steps between saved frames, if there are any."""

    def at(self, state: State) -> Particles:
        """The particles with a state put in."""
        return with_state(self.particles, state)

    def controlled(self, y: RolloutState, step: Scalar) -> "tuple[Problem, RolloutState]":
        """The problem and the state y as the control has them in the step after so many of the run."""
        if self.control is None:
            return self, y
        before = self.scene, self.at(y.particles), y.memory
        after = self.control(*before[:2], (self.start + step) * self.dt, self.dt, y.memory)
        after = canonical(after, y.particles.x.dtype)
        whole = isinstance(after, tuple) and len(after) == 3 and isinstance(after[0], Scene)
        require(whole, f"A control must return (scene, particles, memory), got {shortened(str(after))}.")
        asked, new = ({"particles": q, "memory": m} for _, q, m in (before, after))
        name = partial(jax.tree_util.keystr, simple=True, separator=".")
        a, b = ({name(path): jnp.shape(x) for path, x in jax.tree_util.tree_leaves_with_path(t)} for t in (asked, new))
        where = next((f": {k} has shape {b.get(k)} and had {a.get(k)}" for k in a | b if a.get(k) != b.get(k)), "")
        require(
            bool(eqx.tree_equal(jax.tree.map(jnp.shape, asked), jax.tree.map(jnp.shape, new))),
            f"A control must return particles and memory of the structure and shapes that it was given{where}.",
        )
        scene, particles, memory = after
        fixed = [([type(a) for a in (*s.boundary, *s.loads, *s.laws)], s.grid.shape) for s in (self.scene, scene)]
        require(
            fixed[0] == fixed[1],
            "A control must return a scene with the boundaries, loads, laws and grid that it was given, and may change "
            "their numbers only.",
        )
        return replace(self, scene=scene), replace(y, particles=state_of(particles, masses=True), memory=memory)

    def in_step(self, state: State) -> Particles:
        """The particles as a step takes them."""
        return self.at(state) if self.control is None else with_dust(self.at(state))

    def resorted(self, y: RolloutState, step: Array) -> "tuple[Problem, RolloutState]":
        """The problem and the state y before a step, `step` of them since the rollout began, their particles in the
        order of the state, which are sorted if it is time to."""
        y = y.from_loop_layout(materialised)
        if y.order is None:
            return self, y
        t = (self.start + step) * self.dt
        state, order = resorted(y.order, self.scene, self.particles, y.particles, t, step, self.save_every)
        scene, particles = order.put_into(self.scene, self.particles)
        return replace(self, scene=scene, particles=particles), replace(y, particles=state, order=order)


def run_to(
    problem: Problem, state: RolloutState, step: Any, statistics: RunStatistics, saved: Any = None, **more: Any
) -> Run:
    """The run that ended in this state at step `step`; its `saved` states have a leading axis, and `more` are the
    fields that these do not have: their `steps`, what was `observed`."""
    dtype, saved = problem.particles.x.dtype, RolloutState(cast(Any, None)) if saved is None else saved
    return Run(
        scene=problem.scene,
        method=problem.method,
        dt=problem.dt,
        frames=saved.particles,
        final=problem.at(state.particles),
        final_step=jnp.asarray(step, dtype),
        statistics=statistics,
        collider_impulse=saved.collider_impulse,
        final_collider_impulse=state.collider_impulse,
        boundary_impulse=saved.boundary_impulse,
        final_boundary_impulse=state.boundary_impulse,
        memory=saved.memory,
        final_memory=state.memory,
        **({"steps": jax.device_put(np.zeros((0,), dtype)), "observed": None} | more),
    )


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
        collapsed = [points.law.measure.collapsed(points.deformation, LEAST_STRETCH) for points in materials]
        faults[Fault.COLLAPSED] = finite & jnp.concatenate(collapsed)
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
    rank = jnp.zeros_like(next(iter(faults.values())), jnp.int32)
    for number, particles in enumerate(reversed(faults.values()), 1):
        rank = jnp.where(particles, number, rank)
    return jnp.asarray([Fault.NONE, *reversed(faults)], jnp.int32)[rank.max(initial=0)]


_GRAVEST_FIRST = (Fault.NOT_FINITE, Fault.PASSED, Fault.OUTSIDE, Fault.INADMISSIBLE, Fault.COLLAPSED)
"""The faults of a state, and of the step that led to it."""


class StepSolver(diffrax.AbstractSolver):
    """One step of the method a unit of diffrax's time, which counts steps from the run's first: physical time is n·Δt,
    n counting from the problem's start, and every step has the same Δt to the last bit. `args` is a `Problem`."""

    term_structure: ClassVar = diffrax.ODETerm
    interpolation_cls: ClassVar[Callable[..., diffrax.LocalLinearInterpolation]] = diffrax.LocalLinearInterpolation
    watch: bool = False
    """Whether a fault stops the run. All values are then known and were checked; else that is done here."""

    def order(self, terms: Any) -> int:
        """Order in time; nothing depends on it, since Δt is constant."""
        return 1

    def init(self, terms: Any, t0: Any, t1: Any, y0: RolloutState, args: Problem) -> tuple[RunStatistics, Array]:
        """Empty statistics, and a report of zero."""
        dtype = y0.particles.x.dtype
        statistics = no_steps(dtype)
        if args.fault is not None:
            statistics = replace(statistics, fault=args.fault, unmet=args.unmet)
        return statistics, jnp.zeros((), dtype)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: RolloutState, args: Problem, solver_state: Any, made_jump: Any
    ) -> tuple:
        """One step. A fault is reported as the solver's failure: as an event diffrax would ask for it once more."""
        statistics, report = solver_state
        step = jnp.round(t0)  # diffrax divides an interval evenly, which is exact only up to rounding
        args, y = args.resorted(y0, step)
        args, y = args.controlled(y, step)
        t = (args.start + step) * args.dt
        method = args.method.reporting(args.slot)
        particles, info = step_compiled(args.scene, args.in_step(y.particles), t, args.dt, method, args.stencil)
        report = report + info.solve.report
        y1 = y.after(particles, info)
        arrays, rest = eqx.partition((args, y.particles, y1.particles, t), eqx.is_array)
        constant, before, after, t = eqx.combine(jax.lax.stop_gradient(arrays), rest)
        faults = faulty_particles(constant, after, t + constant.dt)
        if passed := [particles for _, particles in passed_particles(constant, before, after, t)]:
            faults[Fault.PASSED] = reduce(jnp.logical_or, passed)
        fault = gravest({fault: faults[fault] for fault in _GRAVEST_FIRST if fault in faults})
        statistics = statistics.merged(one_step(info, fault), solved=not args.method.is_explicit)
        y1 = y1.to_loop_layout()
        results: Any = diffrax.RESULTS  # whose members the type checker takes for another type
        result = results.successful
        if self.watch:
            goes_on = (statistics.fault == Fault.NONE) & (step + 1 < args.until)
            result = results.where(goes_on, result, results.nonlinear_divergence)
        return y1, None, {"y0": y0, "y1": y1}, (statistics, report), result

    def func(self, terms: Any, t0: Any, y0: RolloutState, args: Problem) -> RolloutState:
        """Not a vector field; diffrax only asks for its shape."""
        return terms.vf(t0, y0, args)


class UnitSteps(diffrax.ConstantStepSize):
    """Steps of one. Of a `dt0` that it is given diffrax asks a program on the host whether it leads to `t1`, and JAX's
    cache does not keep programs that call the host."""

    def init(self, terms: Any, t0: Any, t1: Any, y0: Any, dt0: Any, args: Any, func: Any, error_order: Any) -> Any:
        """The end of the first step, and the controller's state."""
        return super().init(terms, t0, t1, y0, jnp.ones_like(t0), args, func, error_order)


_MOST_LOOPS = 4  # each further loop takes all steps once more


class SegmentAdjoint(diffrax.AbstractAdjoint):
    """Reverse mode that stores the state before each segment of steps. From the last segment to the first it computes
    the steps again, storing what each starts from, its sums and what is `saved_for_backward`, and differentiates them.

    The loops are scans, so that derivatives of any kind and order exist. All steps are taken: nothing stops a run.
    """

    lengths: tuple[int, ...] = eqx.field(static=True)
    """How often each loop turns, the outermost first: the number of segments, then that of their steps; more of them
    where segments have segments. Steps beyond the last one do nothing."""

    def loop(self, *, throw: Any, passed_solver_state: Any, passed_controller_state: Any, **of_diffrax: Any) -> Any:
        return self._loop(inner_while_loop=None, outer_while_loop=self._nested_loops, **of_diffrax)

    def _nested_loops(self, cond_fun: Any, body_fun: Any, state: Any, *, max_steps: int, buffers: Any) -> Any:
        """As `equinox.internal.while_loop`."""
        turns = math.prod(self.lengths)

        def taken(state: Any) -> Any:
            return jax.tree.map(jnp.asarray, body_fun(state))

        def step(state: Any, number: jax.Array) -> tuple[Any, None]:
            if turns == max_steps:
                return taken(state), None
            return jax.lax.cond(number < max_steps, taken, lambda state: state, state), None

        turn = rematerialised(step, sums=True)
        for _ in self.lengths[1:]:
            turn = jax.checkpoint(partial(jax.lax.scan, turn), prevent_cse=False)
        numbers = jnp.arange(turns).reshape(self.lengths)
        return jax.lax.scan(turn, jax.tree.map(jnp.asarray, state), numbers)[0]


def checkpointed(
    steps: int, state_bytes: int, step_bytes: int, budget: int, *, stops: bool = False
) -> diffrax.AbstractAdjoint:
    """The adjoint for reverse mode that computes steps again as seldom as a `budget` of memory allows [B]: by
    segments, in up to four loops; with less memory, or where a fault `stops` the run, diffrax's, whose checkpoints
    move. A state takes `state_bytes`, what is stored of a step at once, its state included, `step_bytes`."""
    for loops in () if stops else range(1, _MOST_LOOPS + 1):
        *outer, inner = _lengths(steps, loops)
        if sum(outer) * state_bytes + inner * step_bytes <= budget:
            return SegmentAdjoint((*outer, inner))
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=max(1, min(steps, budget // state_bytes)))


def _lengths(steps: int, loops: int) -> tuple[int, ...]:
    """The turns of so many loops with as many turns each, if possible none of them for nothing."""
    if loops == 1:
        return (steps,)
    most = math.ceil(round(steps ** (1 / loops), 6))
    inner = next((n for n in range(most, most // 2, -1) if steps % n == 0), most)
    return (*_lengths(math.ceil(steps / inner), loops - 1), inner)
