"""Timed runs of a scene, its motion by a method at a step and the seconds it takes, and the reference run among them.

The reference takes explicit steps where those are cheap, at the `stable_dt` of the whole motion, else TR-BDF2 with the
step halved until that changes the motion by less than a third of the target error, or is below the explicit limit. Then
spacing and step are halved together, as time allows: transfers act once a step, so on a given grid a smaller step need
not improve the motion. The last change estimates the error, safely from the first order on.
"""

import math
import time
from collections.abc import Callable
from dataclasses import fields
from typing import Any, NamedTuple

import jax
import numpy as np

from mpmjax.checks import canonical, require, shape_of
from mpmjax.simulation import Problem, SimulationError, initial_state, no_steps, raise_faults, run_to, segment
from mpmjax.state import Particles, Scene, State, prepare, with_state
from mpmjax.stepping import TRBDF2, AbstractIntegrator, Explicit, stable_dt

FRAMES = 8  # number of times at which motions are compared
_MOST_STEPS = 2**30
_PILOT_SECONDS = 0.2  # for which so many steps are run as the time of all is foreseen from: a call alone takes time too
_BRIEF = 0.3  # seconds of a run below which it is timed again
HOPELESS = 4  # a run that fails at a step this many times below the explicit limit is taken to fail at any step
_FEW = 1000  # explicit steps that no implicit run which follows the motion is cheaper than

Build = Callable[[int], tuple[Scene, Particles]]
"""A function of a refinement n, which returns the scene at 1/n of its spacing, and its particles."""


class Trial(NamedTuple):
    """A run by a method at a step and spacing, with its seconds and error."""

    method: AbstractIntegrator  # the integrator
    refinement: int  # the spacing of the scene over that of the run
    dt: float  # Δt [s]
    steps: int  # how many steps the run took
    seconds: float
    """Wall time without compilation [s]: of one run, the faster of two brief ones, or foreseen from fewer steps."""
    error: float  # relative error of the motion; infinite if the run failed, NaN if it was foreseen to take too long
    linearisation_error: float = 0.0  # linearisation error of the steps [-] (`RunStatistics.linearisation_error`)

    def __str__(self) -> str:
        spacing = f", spacing / {self.refinement}" if self.refinement > 1 else ""
        return f"{name_of(self.method)}, dt = {self.dt:.3g} s{spacing}"


def name_of(method: AbstractIntegrator) -> str:
    """The name of an integrator with its numbers, such as "SemiImplicit(beta=1)"."""
    numbers = [f.name for f in fields(method) if shape_of(getattr(method, f.name)) == ()]
    shown = ", ".join(f"{name}={float(getattr(method, name)):g}" for name in numbers)
    return f"{type(method).__name__}({shown})"


class Displacements(NamedTuple):
    """Initial positions of particles, and their displacements at the times of comparison."""

    X: np.ndarray  # initial positions [m], shape (p, d)
    u: np.ndarray  # displacements [m], shape (frames, p, d)

    @property
    def size(self) -> float:
        """The largest RMS displacement [m]."""
        return float(_rms(self.u).max())

    def distance(self, finer: "Displacements") -> float:
        """The relative error against the motion of as many or more particles, see `_work_precision`."""
        share = max(1, round(len(finer.X) / len(self.X)))
        from scipy.spatial import KDTree  # here, since it takes long to import

        near = KDTree(finer.X).query(self.X, k=share)[1].reshape(len(self.X), share)
        return float(_rms(self.u - finer.u[:, near].mean(axis=2)).max() / finer.size)


class Timed(NamedTuple):
    """The outcome of a run."""

    states: list[State] | None  # the states at the times of comparison, None of a run that failed
    linearisation_error: float  # linearisation error of the steps [-]
    seconds: float


class Clock:
    """An allowance of seconds, compilation included."""

    def __init__(self, seconds: float):
        self.seconds, self._end = seconds, time.perf_counter() + seconds

    @property
    def left(self) -> float:
        """Seconds left; negative once they are overrun."""
        return self._end - time.perf_counter()

    def allows(self, seconds: float) -> bool:
        """Whether compiled code may run for so long: it fits into the seconds left, or into a twentieth of all."""
        return seconds <= max(self.left, self.seconds / 20)


class Bench(NamedTuple):
    """Runs and times a scene. Each method is compiled once for all steps."""

    refinement: int
    scene: Scene
    particles: Particles
    t1: float

    @classmethod
    def of(cls, build: Build, refinement: int, t1: float) -> "Bench":
        """The bench of a scene at a refinement, until t1 [s]."""
        scene, particles = build(refinement)
        return cls(refinement, scene, prepare(scene, particles), float(t1))

    def whole(self, dt: float) -> int:
        """The smallest number of steps, a multiple of `FRAMES`, with a step of at most dt [s]."""
        return FRAMES * math.ceil(self.t1 / (FRAMES * float(dt)) - 1e-9)

    def motion(self, states: list[State]) -> Displacements:
        """The displacements at these states."""
        X = np.asarray(self.particles.x)
        return Displacements(X, np.stack([np.asarray(state.x) for state in states]) - X)

    def limit(self, states: list[State]) -> float:
        """The smallest `stable_dt` of the start and of these states [s]."""
        on_the_way = [self.particles, *(with_state(self.particles, state) for state in states)]
        least = min(float(stable_dt(self.scene, particles)) for particles in on_the_way)
        return max(least, self.t1 / _MOST_STEPS)  # with the linear kernel it may be zero

    def run(self, method: AbstractIntegrator, steps: int) -> Timed:
        """The run, compiled before; of two brief ones the faster."""
        self.timed(method, steps, 1, 1)
        first = self.timed(method, steps, FRAMES, steps // FRAMES)
        if first.states is None or first.seconds >= _BRIEF:
            return first
        return min(first, self.timed(method, steps, FRAMES, steps // FRAMES), key=lambda run: run.seconds)

    def foresee(self, method: AbstractIntegrator, steps: int) -> float:
        """The seconds of a number of steps, estimated from fewer of them."""
        self.timed(method, steps, 1, 1)  # which compiles
        some, seconds = 1, self.timed(method, steps, 1, 1).seconds
        while seconds < _PILOT_SECONDS and some < steps:
            some = min(4 * some, steps)
            seconds = self.timed(method, steps, 1, some).seconds
        return seconds / some * steps

    def timed(self, method: AbstractIntegrator, steps: int, frames: int, each: int, *, throw: bool = False) -> Timed:
        """The states after each of `frames` times `each` steps of t1 / `steps`, and the seconds that they took. A
        faulty run has no states, or raises with `throw`."""
        begun, dtype = time.perf_counter(), self.particles.x.dtype
        scene, dt, method = canonical((self.scene, self.t1 / steps, method), dtype)
        problem = Problem(scene, self.particles, dt, method)
        state, states, statistics = initial_state(problem), [], no_steps(dtype)
        for k in range(frames):
            state, new, before = segment(problem, state, k * each, each, max_steps=_MOST_STEPS)
            statistics = statistics.merged(new)
            if not bool(jax.block_until_ready(statistics.healthy)):
                if throw:
                    run = run_to(problem, state, statistics.steps, statistics)
                    raise_faults(run, problem, before, 0)
                return Timed(None, 0.0, time.perf_counter() - begun)
            states.append(state.particles)
        return Timed(states, float(statistics.linearisation_error), time.perf_counter() - begun)


def _rms(distance: np.ndarray) -> Any:
    """The root mean square over particles of distances, shape (frames, p, d)."""
    return np.sqrt((distance**2).sum(axis=-1).mean(axis=-1))


def settle(
    build: Build, bench: Bench, error: float, seconds: float, say: Callable[[str], None] = lambda line: None
) -> tuple[float, Trial, Displacements]:
    """The best reference run within `seconds`, compilation included: the longest explicit step on the grid of the
    scene's own bench that trials may take, `stable_dt` of the whole motion [s]; the run, whose error is an estimate,
    for trials of this target error; and its motion. `say` is called with a line on each run. A ValueError says that
    nothing moves, or why no run ended well in that time."""
    more = (
        f"more than the {seconds:.3g} s that a reference is given. Allow more (most_seconds in [run], --most-seconds), "
        "choose a shorter t1, or give dt and method."
    )

    def refined(bench: Bench, steps: int) -> tuple[Trial, list[State] | None, Displacements | None]:
        """A run, its error the change from the motion of the run before; its states and motion, None if it failed."""
        states, _, seconds = bench.run(method, steps)
        motion = None if states is None else bench.motion(states)
        change = math.inf if motion is None or coarse is None else coarse.distance(motion)
        spacing = f", spacing / {bench.refinement}" if bench.refinement > 1 else ""
        outcome = "failed" if motion is None else "" if math.isinf(change) else f"changes the motion by {change:.2g}"
        say(f"reference: {name_of(method)}, {steps} steps{spacing}: {seconds:.2g} s {outcome}".rstrip())
        return Trial(method, bench.refinement, bench.t1 / steps, steps, seconds, change), states, motion

    clock, growth = Clock(seconds), 2 ** (bench.particles.dim + 1)
    limit = bench.limit([])
    steps, method = bench.whole(limit), Explicit()
    say(f"reference: {bench.particles.count} particles, {steps} explicit steps of {bench.t1 / steps:.3g} s; compiling")
    foreseen = bench.foresee(method, steps)
    if (1 + growth) * foreseen > clock.left and steps > _FEW:
        steps, method = 2 * FRAMES, TRBDF2()
    elif not clock.allows(2 * foreseen):
        raise ValueError(f"{steps} explicit steps take {foreseen:.2g} s and two runs are needed: {more}")
    good: Trial | None = None
    coarse: Displacements | None = None  # the motion of that run
    while True:  # until the step resolves the motion, or the time is up
        new, states, motion = refined(bench, steps)
        if states is not None and motion is not None:
            require(motion.size > 0, "Nothing moves in this scene, so there is no motion to be right or wrong.")
            limit, good, coarse = min(limit, bench.limit(states)), new, motion
        allowed = clock.allows(2 * new.seconds)
        if good is not None and (new.error <= error / 3 or new.dt <= limit * (1 + 1e-9) or not allowed):
            break
        if not allowed or (good is None and new.dt < limit / HOPELESS):
            why = "It ended well."
            try:
                bench.timed(method, steps, FRAMES, steps // FRAMES, throw=True)
            except SimulationError as fault:
                why = str(fault)
            raise ValueError(
                f"The reference run, {name_of(method)} in {steps} steps ({new.seconds:.2g} s), fails, and half "
                f"the step will not do or takes too long. {why}"
            )
        steps = max(2 * steps, bench.whole(limit) if method.is_explicit else 0)
    while growth * good.seconds < clock.left and (good.refinement == bench.refinement or good.error > error / 3):
        new, _, motion = refined(Bench.of(build, 2 * good.refinement, bench.t1), 2 * good.steps)
        if motion is None:
            break
        good, coarse = new, motion
    alone = good.refinement == bench.refinement  # there was no time for a finer grid
    while alone and good.error > error / 3 and (math.isinf(good.error) or clock.allows(2 * good.seconds)):
        new, _, motion = refined(bench, 2 * good.steps)
        if motion is None:
            break
        good, coarse = new, motion
    assert coarse is not None
    require(math.isfinite(good.error), f"The motion of one run only is known: {more}")
    return limit, good, coarse
