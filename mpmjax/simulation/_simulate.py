"""Rollouts: many steps, with saving, faults and derivatives."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.autodiff import guard, rematerialised
from mpmjax.checks import (
    canonical,
    checked,
    first_unmet,
    is_traced,
    require,
    require_finite,
    require_memory,
    require_positive,
    require_whole,
    requirements,
)
from mpmjax.simulation._diffrax import (
    Control,
    Problem,
    RolloutState,
    StepSolver,
    UnitSteps,
    checkpointed,
    faulty_particles,
    gravest,
    initial_state,
    run_to,
)
from mpmjax.simulation._faults import UNSOLVED, guarded, raise_faults, warn_of_inaccuracy
from mpmjax.simulation._run import Fault, Run, RunStatistics
from mpmjax.simulation._sorting import memory_order
from mpmjax.state import Particles, Scene, prepare, warn_of_rounding, with_state
from mpmjax.stepping import MOST_STEPS, AbstractIntegrator, Explicit, step_for, step_unchecked

_CHECKPOINT_BYTES = 2**28


@checked
def simulate(
    scene: Scene,
    particles: Particles,
    *,
    t1: Scalar,
    dt: Scalar | Literal["stable"],
    method: AbstractIntegrator = Explicit(),
    save_every: int | None = None,
    observe: Callable[[Scene, Particles], Any] | None = None,
    start: Scalar = 0,
    adjoint: diffrax.AbstractAdjoint | None = None,
    checkpoint_bytes: int = _CHECKPOINT_BYTES,
    progress: bool = False,
    throw: bool = True,
    control: Control | None = None,
    memory: Any = None,
) -> Run:
    """Simulate a scene from step `start` to time t1 in steps of dt.

    The rollout is differentiable by every float of scene, particles and method: in reverse mode by default, in forward
    mode (`jax.jvp`, `jax.jacfwd`) with `adjoint=diffrax.ForwardMode()`. Only the number of steps, `save_every` and
    choices of code compile anew.

    Args:
        scene: the scene.
        particles: the particles at step `start`.
        t1: end time [s], a whole number of steps after time zero.
        dt: step [s]; or "stable", the longest that `stable_dt` allows of the particles as they start and of which t1 is
            a whole number (`run.dt` says it). What stretches or stiffens on the way may need a shorter one.
        method: update of the grid velocity.
        save_every: save the state at the start, every so many steps, and at the end. Default: only `final` is returned.
        observe: instead of states, save what this function of (scene, particles) returns, by default at every step. An
            `equinox.Module` may hold arrays; a plain function compiles anew unless it is the same object.
        start: number of the first step, e.g. a former run's `final_step`; time there is start·dt. Impulses are summed
            from here on.
        adjoint: how diffrax differentiates. Default: reverse mode by segments of steps.
        checkpoint_bytes: memory for what reverse mode stores by default [B]. With less of it steps are computed again,
            once if it is enough for the square root of their number.
        progress: show diffrax's progress meter.
        throw: raise on faults. False puts them into `statistics`, and a failed batch member leaves others alone.
        control: a pure function `(scene, particles, t, dt, memory) -> (scene, particles, memory)`, called before each
            step: the scene that it returns has other numbers in this step (accelerations, motions of boundaries), the
            particles go on from there (activations, what enters or leaves), and so does the memory. Weights that are
            trained are arrays of an `equinox.Module`. See docs/control.md.
        memory: the control's memory at the start, a pytree of floats; e.g. a former run's `final_memory`.

    Raises:
        ValueError: of `prepare`; a value of the method that it does not allow; a t1 not whole steps after the start.
        SimulationError: a `Fault`, with step, time and first bad particle (its `run.final` is the last good state, for
            which the run is computed once more), or a solve that ended beyond ten times its tolerance; one that ended
            nearer is a Python warning.
        RuntimeError: the same, and values that scene, particles or method do not allow, under an outer transformation
            (`jax.jit`, `jax.grad`, `jax.vmap`); and a tangent or adjoint solve that did not converge. Of compiled
            programs its last line says what is wrong. With `throw=False` the state or the derivative is NaN then.
    """
    start = require_whole("start", start, 0)
    dtype = particles.x.dtype
    scene, method, control, memory = canonical((scene, method, control, memory), dtype)
    requirements(method)
    particles = prepare(scene, particles)
    dt = step_for(scene, particles, t1, dt, method, start)
    count = number_of_steps(t1, dt, start, dtype)
    if save_every is not None:
        save_every = min(require_whole("save_every", save_every, 1), count)
    if observe is not None and save_every is None:
        save_every = 1
    first, dt_ = canonical((start, dt), dtype)
    begin = initial_state(Problem(scene, particles, dt_, method, control=control, memory=memory))
    state_bytes = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(begin))
    # under jax.jit also if all that was passed is known
    traced = is_traced((begin, scene, particles, dt_, method, observe, control))
    if save_every is not None and observe is None:
        frames = count // save_every + 2
        require_memory(
            f"{frames} frames of {particles.count} particles",
            float(frames) * state_bytes,
            f"save less often than every {save_every} steps, observe what is needed of them, or use record.",
            device=True,
        )
    slot: Scalar = 0.0
    if traced and throw:
        no_fault, unsolved, zero = jnp.zeros((), jnp.int32), UNSOLVED.format("the adjoint"), jnp.zeros((), dtype)
        (scene, particles, method), slot = guard((scene, particles, method), zero, no_fault, (), unsolved)
    if adjoint is None:
        # of a step besides its state: momentum and mass of the nodes, as much for solutions, what the particles gather
        d = particles.dim
        numbers = 2 * (d + 1) * scene.grid.size + (d + d * d) * particles.count
        step_bytes = state_bytes + numbers * dtype.itemsize
        adjoint = checkpointed(count, state_bytes, step_bytes, checkpoint_bytes, stops=not traced)
    held = {"observe": observe, "control": control, "memory": memory, "slot": slot, "save_every": save_every}
    problem = Problem(scene, particles, dt_, method, start=first, **held)
    go = partial(integrate, problem, begin, max_steps=count, adjoint=adjoint, progress=progress, watch=not traced)
    end = go(until=np.asarray(np.inf, dtype))
    saved = {"steps": end.steps, "observed": end.observed, "report": end.report if traced else None}
    run = run_to(problem, end.state, end.step, end.statistics, end.frames, **saved)
    if not throw:
        return run
    if traced:
        return guarded(run, end.report)
    warn_of_rounding(scene.grid, run.final.x, particles.x)
    raise_faults(run, problem, lambda: _before_fault(go, begin, end.statistics), start)
    warn_of_inaccuracy(run)
    return run


@checked
def rollout(
    scene: Scene,
    particles: Particles,
    *,
    steps: int,
    dt: Scalar,
    method: AbstractIntegrator = Explicit(),
    start: Scalar = 0,
    control: Control | None = None,
    memory: Any = None,
) -> Particles:
    """The plain rollout: `jax.lax.scan` over steps, without saving or checks. Reverse mode stores the state before each
    step and the solutions of implicit solves, and computes the rest again.

    Args:
        scene, particles, method, start, control, memory: as in `simulate`.
        steps: number of steps.
        dt: step [s].

    Raises:
        ValueError: from `prepare`; a step that is not positive, or a number of steps that is negative.
    """
    require_positive("dt [s]", dt, particles.x.dtype)
    steps, start = require_whole("steps", steps, 0), require_whole("start", start, 0)
    start = jnp.asarray(start, particles.x.dtype)
    scene, dt, method, control, memory = canonical((scene, dt, method, control, memory), particles.x.dtype)
    requirements(method)
    of = {"start": start, "control": control, "memory": memory}
    return _rollout(Problem(scene, prepare(scene, particles), dt, method, **of), steps)


@eqx.filter_jit
def _rollout(problem: Problem, steps: int) -> Particles:
    scene, particles = problem.scene, problem.particles
    problem = replace(problem, stencil=scene.stencil(particles) if scene.total else None)

    def body(y: RolloutState, n: Array) -> tuple[RolloutState, None]:
        here, y = problem.resorted(y, n)
        here, y = here.controlled(y, n)
        t = (here.start + n) * here.dt
        new, info = step_unchecked(here.scene, here.in_step(y.particles), t, here.dt, here.method, here.stencil)
        return y.after(new, info).to_loop_layout(), None

    order = memory_order(scene, particles, steps) if problem.control is None else None
    begin = replace(initial_state(problem), collider_impulse=None, boundary_impulse=None, order=order)
    end, _ = jax.lax.scan(rematerialised(body), begin.to_loop_layout(), jnp.arange(steps, dtype=particles.x.dtype))
    return with_state(particles, end.as_given().particles)


def number_of_steps(t1: Any, dt: Any, start: int, dtype: Any) -> int:
    """Steps of dt from step `start` to time t1; a ValueError if no whole number, none, or too many for the dtype."""
    if is_traced((t1, dt)):
        raise ValueError("t1 and dt fix the number of steps and must be known numbers, not traced ones.")
    require_positive("dt [s]", dt, dtype)
    require_finite("t1 [s]", t1)
    ratio, exact = float(t1) / float(dt), 2 ** (jnp.finfo(dtype).nmant - 1)
    few = ratio <= MOST_STEPS
    require(few, f"A run has at most {MOST_STEPS} steps, got t1 / dt = {ratio:.9g}: choose a shorter t1 or longer dt.")
    few = ratio < exact
    require(few, f"{jnp.dtype(dtype)} counts steps exactly only below {exact}, got t1 / dt = {ratio:.9g}: use float64.")
    total = round(ratio)
    require(
        abs(ratio - total) <= 1e-6 * max(1.0, abs(ratio)),
        f"t1 must be a whole number of steps: t1 / dt = {ratio:.9g} (t1 = {t1}, dt = {dt}); "
        f"take dt = {t1} / {max(1, math.ceil(ratio))}.",
    )
    require(total > start, f"t1 must lie after the start: t1 / dt = {total} steps, start = {start}.")
    return total - int(start)


class End(NamedTuple):
    """The end of an integration."""

    steps: Float[Array, "f"]  # numbers of the saved frames; none if nothing was saved
    frames: RolloutState | None  # them, along a first axis, without particles where something is observed instead
    observed: Any  # likewise
    state: RolloutState
    step: Float[Array, ""]  # the number of the last step
    statistics: RunStatistics
    report: Float[Array, ""]  # relative residual of the first tangent solve that did not converge; zero if all did


@eqx.filter_jit
def integrate(
    problem: Problem,
    state: RolloutState,
    count: Float[Array, ""] | None = None,
    *,
    until: Scalar | Float[np.ndarray, ""],
    max_steps: int,
    adjoint: diffrax.AbstractAdjoint = diffrax.ForwardMode(),  # the plain loop
    progress: bool = False,
    watch: bool = True,
) -> End:
    """Integrate `count` ≤ `max_steps` steps from a problem's start, at which the particles have this state. With
    `watch` the run stops at a fault, and `until` so many steps. Without a count, all of them: what diffrax derives of
    its last time is then a constant to XLA, and not a program of two thousand operations."""
    scene, particles, start, save_every = problem.scene, problem.particles, problem.start, problem.save_every
    dtype = particles.x.dtype
    zero, all_steps = (np.asarray(n, dtype) for n in (0, max_steps))
    until, slot = (jnp.asarray(a, dtype) for a in (until, problem.slot))
    stencil = scene.stencil(particles) if scene.total else None
    problem = replace(problem, stencil=stencil, until=until, slot=slot)
    if not watch:  # the fault of the start, from values that were not known when they were given
        arrays, rest = eqx.partition((problem, state), eqx.is_array)
        constant, begin = eqx.combine(jax.lax.stop_gradient(arrays), rest)
        unmet = first_unmet(requirements((constant.scene, constant.particles, constant.method)))
        fault = gravest(faulty_particles(constant, begin.particles, constant.start * constant.dt))
        valid = jnp.where(unmet > 0, jnp.nan, 1)  # with a bad parameter what follows would look like numbers
        state = jax.tree.map(lambda a: a * valid.astype(a.dtype), state)
        problem = replace(problem, fault=jnp.where(unmet > 0, Fault.BAD_PARAMETERS, fault), unmet=unmet)
    if problem.control is None:  # a control may know particles by their numbers
        state = replace(state, order=memory_order(scene, particles, save_every or max_steps))
    state = state.to_loop_layout()

    def frame(t: Any, y: RolloutState, args: Problem) -> Any:
        y = y.as_given()
        if args.observe is None:
            return y, None
        return replace(y, particles=cast(Any, None)), args.observe(args.scene, args.at(y.particles))

    subs = {"final": diffrax.SubSaveAt(t1=True, fn=lambda t, y, args: y.as_given())}
    if save_every is not None:
        subs["frames"] = diffrax.SubSaveAt(t0=True, t1=True, steps=save_every, fn=frame)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(lambda t, y, args: y),  # the solver does not evaluate it
        StepSolver(watch),
        t0=zero,
        t1=all_steps if count is None else count,
        dt0=None,
        y0=state,
        args=problem,
        saveat=diffrax.SaveAt(subs=subs, solver_state=True),
        stepsize_controller=UnitSteps(),
        adjoint=adjoint,
        max_steps=max_steps,
        throw=False,
        progress_meter=diffrax.TqdmProgressMeter() if progress else diffrax.NoProgressMeter(),
    )
    times, values, (statistics, report) = cast(Any, (solution.ts, solution.ys, solution.solver_state))
    final = jax.tree.map(lambda a: a[-1], values["final"])
    frames, observed = (None, None) if save_every is None else values["frames"]
    steps = jnp.zeros((0,), dtype) if save_every is None else start + jnp.round(times["frames"])
    return End(steps, frames, observed, final, start + statistics.steps.astype(dtype), statistics, report)


def _before_fault(go: Callable[..., Any], begin: RolloutState, statistics: RunStatistics) -> RolloutState:
    """The last good state of a run that met a fault, computed once more by the same program, `integrate` with all its
    arguments but `until`: no run carries it."""
    good = int(statistics.fault_step) - 1
    return begin if good == 0 else go(until=np.asarray(good, begin.particles.x.dtype)).state


def segment(
    problem: Problem, begin: RolloutState, step: int, count: int, *, max_steps: int
) -> tuple[RolloutState, RunStatistics, Callable[[], RolloutState]]:
    """The state after `count` ≤ `max_steps` steps from step `step`, their statistics, and a function that returns the
    last good state. The problem is canonical. Segments of all lengths are one compiled program."""
    first, number = canonical((step, count), problem.particles.x.dtype)
    go = partial(integrate, replace(problem, start=first), begin, number, max_steps=max_steps)
    end = go(until=np.asarray(np.inf, first.dtype))
    return end.state, end.statistics, partial(_before_fault, go, begin, end.statistics)
