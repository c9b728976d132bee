"""What accuracy costs: a scene's error against seconds, by method, step and spacing, and the cheapest setting that is
good enough.

The error is that of the motion: the largest over eight evenly spaced times of the RMS over particles of the distance
between a particle's displacement and the reference's, over the largest RMS displacement of the reference. Where the
reference has k particles for one, the mean of the k nearest at time zero stands for it.

The reference is a run of TR-BDF2, refined in space and in time together: transfers act once a step, and on a given grid
a smaller step alone need not bring the motion nearer to the truth. The spacing and the step are halved until two runs
in a row differ by less than a third of the error that is asked for, or the next one would take too long; that
difference is the estimate of the reference's own error, which is safe from first order on.
"""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import fields
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

from mpmjax._checks import canonical, require, require_positive
from mpmjax._method import TRBDF2, BackwardEuler, Explicit, ImplicitMidpoint, Method, SemiImplicit
from mpmjax._particles import Particles, State, state_of, with_state
from mpmjax._scene import Scene, prepare
from mpmjax._simulate import integrate
from mpmjax._stability import stable_dt

FRAMES = 8
"""Times at which motions are compared."""
METHODS: tuple[Method, ...] = (Explicit(), SemiImplicit(), BackwardEuler(), ImplicitMidpoint(), TRBDF2())
"""What is tried by default."""
_REFERENCE = TRBDF2()
_RESOLVED = 0.25  # the error above which a larger one at a smaller step does not say that the best was reached
_HOPELESS = 4  # how far below the explicit limit a run that still fails will not get better
_MOST_STEPS = 2**30
_PILOT = 20  # explicit steps from which the time of all of them is foreseen, or fourfold as often as is needed
_PILOT_SECONDS = 0.2  # to last so long: a call alone takes as long as a hundred steps of a small scene

Build = Callable[[int], tuple[Scene, Particles]]
"""From a refinement n to the scene with 1/n of its spacing, and its particles."""


class Trial(NamedTuple):
    """A setting, what it cost and how good it was."""

    method: Method
    refinement: int
    """By how much the spacing is finer than the scene's own."""
    dt: float
    """Δt [s]."""
    steps: int
    seconds: float
    """Wall time, compilation left out: the better of two runs, or foreseen from fewer steps."""
    error: float
    """Relative error of the motion; infinite where the run failed, NaN where it was foreseen to take too long."""

    def __str__(self) -> str:
        spacing = f", spacing / {self.refinement}" if self.refinement > 1 else ""
        return f"{name_of(self.method)}, dt = {self.dt:.3g} s{spacing}"


class WorkPrecision(NamedTuple):
    """Error against seconds."""

    trials: tuple[Trial, ...]
    reference: Trial
    """Its error is the estimate of its own."""
    target: float
    """The error that was asked for."""
    limit: float
    """The longest explicit step on the scene's own grid that is offered, `stable_dt` of the whole motion [s]."""

    def cheapest(self, *, explicit: bool | None = None) -> Trial | None:
        """The fastest trial that is good enough: of all, of the explicit ones or of the others; None if none is.

        Good enough is the target or, where no trial reaches it, a quarter above the least error of all, which then is
        that of the grid. A trial is as good as the worse of itself and the next smaller step: where the error passes
        through zero on its way from one sign to the other, that is luck. An explicit step beyond the limit is not
        good, however well it went.
        """
        trials = [t for t in self.trials if not (isinstance(t.method, Explicit) and t.dt * t.refinement > self.limit)]
        errors = [max(t.error, self._next(t).error) for t in trials]
        enough = max(self.target, 1.25 * min((e for e in errors if e >= 0), default=math.inf))
        good = [t for t, e in zip(trials, errors, strict=True) if e <= enough < math.inf]
        good = [t for t in good if explicit in (None, isinstance(t.method, Explicit))]
        return min(good, key=lambda trial: trial.seconds, default=None)

    def _next(self, trial: Trial) -> Trial:
        """The same with the next smaller step that was run, or itself."""
        own = [t for t in self.trials if (t.refinement, name_of(t.method)) == (trial.refinement, name_of(trial.method))]
        finer = [t for t in own if t.dt < trial.dt and not math.isnan(t.error)]
        return max(finer, key=lambda t: t.dt, default=trial)

    def verdict(self) -> str:
        """In words: the cheapest setting, and what the other kind of method would have cost."""
        best = self.cheapest()
        if best is None:
            return "No run ended well: allow more seconds or choose a shorter t1."
        is_explicit = isinstance(best.method, Explicit)
        rival = self.cheapest(explicit=not is_explicit)
        foreseen = [t for t in self.trials if math.isnan(t.error) and isinstance(t.method, Explicit) != is_explicit]
        if rival is not None:
            other = f"{rival} needs {rival.seconds:.2g} s"
        elif foreseen:
            cheap = min(foreseen, key=lambda trial: trial.seconds)
            other = f"{cheap} would need {cheap.seconds:.2g} s"
        else:
            other = f"no {'implicit' if is_explicit else 'explicit'} setting tried is as good"
        said = f"{best} ({best.steps} steps): {best.seconds:.2g} s, error {best.error:.2g}; {other}."
        if best.error > self.target:
            said += f" None reached {self.target:g}: on the grids tried no step does better."
        if self.reference.error > self.target / 2:
            said += f" The reference is known to {self.reference.error:.2g} only, and so are the errors."
        return said


def name_of(method: Method) -> str:
    """A method's name with its one number, such as "SemiImplicit(beta=1)"."""
    numbers = [f.name for f in fields(method) if f.name in ("beta", "rho")]
    shown = ", ".join(f"{name}={float(getattr(method, name)):g}" for name in numbers)
    return f"{type(method).__name__}({shown})"


def work_precision(
    build: Build,
    *,
    t1: float,
    error: float = 1e-2,
    methods: tuple[Method, ...] = METHODS,
    refinements: tuple[int, ...] = (1, 2),
    also: tuple[tuple[Method, float], ...] = (),
    most_seconds: float = 60.0,
    progress: Callable[[Trial], None] = lambda trial: None,
) -> WorkPrecision:
    """Run a scene by several methods, on several grids, with ever smaller steps, until each is as good as asked for or
    gets no better.

    Implicit methods start with eight steps in all; explicit ones at the default safety of `stable_dt`, at the greatest
    stretch of the first reference run, and once at twice that, which should fail. What would take longer than
    `most_seconds` is not run: its time is foreseen from fewer steps. The seconds are this machine's, so the result is
    not a function of the arguments alone.

    *When it breaks*: where refinement does not settle the motion (chaotic contact, PIC at long times), the reference
    is uncertain, and says so in its `error`.

    Args:
        build: from a refinement n = 1, 2, 4, ... to the scene with 1/n of its spacing and as many particles a cell.
        t1: end time [s].
        error: the relative error that is asked for.
        methods: what is tried.
        refinements: on which grids.
        also: methods with one step [s] each, tried besides on the scene's own grid.
        most_seconds: longest run [s].
        progress: called with each trial as it is done.

    Raises:
        ValueError: from `prepare`; nothing moves, or no run of the reference ended well.
    """
    require_positive("t1 [s]", t1)
    require_positive("error", error)
    require_positive("most_seconds", most_seconds)
    benches = {n: Bench.of(build, n, t1, most_seconds) for n in {1, *refinements}}
    limit, reference, truth = settle(build, benches[1], error)
    progress(reference)
    trials: list[Trial] = []

    def note(bench: Bench, method: Method, steps: int, seconds: float, miss: float) -> Trial:
        trials.append(Trial(method, bench.refinement, bench.t1 / steps, steps, seconds, miss))
        progress(trials[-1])
        return trials[-1]

    def tried(bench: Bench, method: Method, steps: int) -> Trial:
        states, seconds = bench.run(method, steps)
        miss = math.inf if states is None else bench.motion(states).distance(truth)
        return note(bench, method, steps, seconds, miss)

    def refine(bench: Bench, method: Method) -> None:
        steps, best, idle = FRAMES, math.inf, 0
        if isinstance(method, Explicit):
            steps = bench.whole(limit / bench.refinement)
            seconds = bench.foresee(method, steps)
            if seconds > bench.most_seconds:
                note(bench, method, steps, seconds, math.nan)
                return
            tried(bench, method, bench.whole(2 * limit / bench.refinement))
        while best > max(error / 3, reference.error / 2) and idle < 2:
            trial = tried(bench, method, steps)
            resolved = trial.error < _RESOLVED or trial.dt < limit / bench.refinement
            idle = idle + 1 if resolved and trial.error > 0.8 * best else 0
            best = min(best, trial.error)
            if trial.error == math.inf and trial.dt < limit / (_HOPELESS * bench.refinement):
                return
            steps *= 2
            if 2 * trial.seconds > bench.most_seconds:
                note(bench, method, steps, 2 * trial.seconds, math.nan)
                return

    for n, method in itertools.product(refinements, methods):
        refine(benches[n], method)
    for method, dt in also:
        tried(benches[1], method, benches[1].whole(dt))
    return WorkPrecision(tuple(trials), reference, float(error), limit)


class Displacements(NamedTuple):
    """Where particles were, and how far they had come at the times of comparison."""

    X: np.ndarray
    """(p, d) [m]."""
    u: np.ndarray
    """(frames, p, d) [m]."""

    @property
    def size(self) -> float:
        """The largest RMS displacement [m]."""
        return float(_rms(self.u).max())

    def distance(self, finer: "Displacements") -> float:
        """From a motion of as many or more particles, relative to its size."""
        share = max(1, round(len(finer.X) / len(self.X)))
        near = scipy.spatial.KDTree(finer.X).query(self.X, k=share)[1].reshape(len(self.X), share)
        return float(_rms(self.u - finer.u[:, near].mean(axis=2)).max() / finer.size)


class Bench(NamedTuple):
    """Runs and times a scene; each method is compiled once, whatever its step."""

    refinement: int
    scene: Scene
    particles: Particles
    t1: float
    most_seconds: float

    @classmethod
    def of(cls, build: Build, refinement: int, t1: float, most_seconds: float) -> "Bench":
        """The bench of a refined scene."""
        scene, particles = build(refinement)
        return cls(refinement, scene, prepare(scene, particles), float(t1), float(most_seconds))

    def whole(self, dt: float) -> int:
        """The least number of steps, a multiple of the frames, whose step is not longer than dt [s]."""
        return FRAMES * math.ceil(self.t1 / (FRAMES * float(dt)) - 1e-9)

    def motion(self, states: list[State]) -> Displacements:
        """The motion through these states."""
        X = np.asarray(self.particles.x)
        return Displacements(X, np.stack([np.asarray(state.x) for state in states]) - X)

    def limit(self, states: list[State]) -> float:
        """The least `stable_dt` at the start and in these states [s]."""
        on_the_way = [self.particles, *(with_state(self.particles, state) for state in states)]
        least = min(float(stable_dt(self.scene, particles)) for particles in on_the_way)
        return max(least, self.t1 / _MOST_STEPS)  # with the linear kernel it may be zero

    def run(self, method: Method, steps: int) -> tuple[list[State] | None, float]:
        """The states at the times of comparison, None of a run that failed, and its seconds."""
        self._go(method, steps, 1, 1)
        states, seconds = self.timed(method, steps, FRAMES, steps // FRAMES)
        if states is not None and seconds < self.most_seconds / 10:
            seconds = min(seconds, self.timed(method, steps, FRAMES, steps // FRAMES)[1])
        return states, seconds

    def foresee(self, method: Method, steps: int) -> float:
        """Seconds of so many steps, from a few of them."""
        self._go(method, steps, 1, 1)
        some = min(_PILOT, steps)
        seconds = self.timed(method, steps, 1, some)[1]
        while seconds < _PILOT_SECONDS and some < steps:
            some = min(4 * some, steps)
            seconds = self.timed(method, steps, 1, some)[1]
        return seconds / some * steps

    def timed(self, method: Method, steps: int, frames: int, each: int) -> tuple[list[State] | None, float]:
        """The states after each of some frames of so many steps, None if one is at fault, and the seconds."""
        begun = time.perf_counter()
        states = self._go(method, steps, frames, each)
        return states, time.perf_counter() - begun

    def _go(self, method: Method, steps: int, frames: int, each: int) -> list[State] | None:
        """The states after each of some frames of so many steps; None if one is at fault."""
        dtype = self.particles.x.dtype
        scene, dt, method = canonical((self.scene, self.t1 / steps, method), dtype)
        state, states = state_of(self.particles), []
        for k in range(frames):
            _, state, tally, _ = integrate(
                scene,
                with_state(self.particles, state),
                jnp.asarray(k * each, dtype),
                jnp.asarray(each, dtype),
                dt,
                method,
                max_steps=_MOST_STEPS,
                save_every=None,
                observe=None,
                adjoint=diffrax.ForwardMode(),  # the plain loop
                progress=False,
                watch=True,
            )
            if not bool(jax.block_until_ready(tally.healthy)):
                return None
            states.append(state)
        return states


def settle(build: Build, bench: Bench, error: float) -> tuple[float, Trial, Displacements]:
    """The explicit limit over the motion on the scene's own grid [s], the reference, and its motion.

    Its first step is halved, on that grid, until that changes the motion by less than a third of the error, or it is
    below the explicit limit; then spacing and step are halved together.
    """
    steps, limit, states, motion, change = FRAMES, bench.limit([]), None, None, math.inf
    while change > error / 3 and (states is None or bench.t1 / steps > limit):
        steps *= 2
        states, seconds = bench.run(_REFERENCE, steps)
        _require_prospects(bench, steps, seconds, limit)
        if states is not None:
            coarse, motion = motion, bench.motion(states)
            require(motion.size > 0, "Nothing moves in this scene, so there is no motion to be right or wrong.")
            change = math.inf if coarse is None else coarse.distance(motion)
            limit = bench.limit(states)
    assert motion is not None
    change, seconds = math.inf, 0.0
    while change > error / 3 and (math.isinf(change) or seconds * 2 ** (bench.particles.dim + 1) <= bench.most_seconds):
        bench, coarse = Bench.of(build, 2 * bench.refinement, bench.t1, bench.most_seconds), motion
        steps *= 2
        states, seconds = bench.run(_REFERENCE, steps)
        while states is None:
            _require_prospects(bench, steps, seconds, limit / bench.refinement)
            steps *= 2
            states, seconds = bench.run(_REFERENCE, steps)
        motion = bench.motion(states)
        change = coarse.distance(motion)
    return limit, Trial(_REFERENCE, bench.refinement, bench.t1 / steps, steps, seconds, change), motion


def _require_prospects(bench: Bench, steps: int, seconds: float, limit: float) -> None:
    """Half the step must not take too long, and may succeed where this one fails."""
    require(
        2 * seconds <= bench.most_seconds and bench.t1 / steps > limit / _HOPELESS,
        f"The reference, {name_of(_REFERENCE)} in {steps} steps ({seconds:.2g} s), does not settle or fails, and half "
        f"the step will not do: allow more than {bench.most_seconds:g} s a run, choose a shorter t1, or see by "
        "`mpmjax run` with that step what goes wrong.",
    )


def _rms(distance: np.ndarray) -> np.ndarray:
    """Over particles, of distances (frames, p, d)."""
    return np.sqrt((distance**2).sum(axis=-1).mean(axis=-1))
