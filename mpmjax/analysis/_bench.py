"""Timed runs of a scene: its motion by a method at a step, and the seconds it takes."""

import math
import time
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy.spatial

from mpmjax.checks import canonical, shape_of
from mpmjax.simulation import Run, SimulationError, before_fault, initial_state, integrate, no_steps, raise_faults
from mpmjax.state import Particles, Scene, State, prepare, with_state
from mpmjax.stepping import AbstractIntegrator, stable_dt

FRAMES = 8
"""Number of times at which motions are compared."""
_MOST_STEPS = 2**30
_PILOT_SECONDS = 0.2  # for which so many steps are run as the time of all is foreseen from: a call alone takes time too
_BRIEF = 0.3  # seconds of a run below which it is timed again

Build = Callable[[int], tuple[Scene, Particles]]
"""A function of a refinement n, which returns the scene at 1/n of its spacing, and its particles."""


class Trial(NamedTuple):
    """A run by a method at a step and spacing, with its seconds and error."""

    method: AbstractIntegrator
    refinement: int
    """The spacing of the scene over that of the run."""
    dt: float
    """Δt [s]."""
    steps: int
    seconds: float
    """Wall time without compilation [s]: of one run, the faster of two brief ones, or foreseen from fewer steps."""
    error: float
    """Relative error of the motion; infinite if the run failed, NaN if it was foreseen to take too long."""
    linearisation_error: float = 0.0
    """Linearisation error of the steps [-] (`RunStatistics.linearisation_error`)."""

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

    X: np.ndarray
    """Initial positions [m], shape (p, d)."""
    u: np.ndarray
    """Displacements [m], shape (frames, p, d)."""

    @property
    def size(self) -> float:
        """The largest RMS displacement [m]."""
        return float(_rms(self.u).max())

    def distance(self, finer: "Displacements") -> float:
        """The relative error against the motion of as many or more particles, see `_work_precision`."""
        share = max(1, round(len(finer.X) / len(self.X)))
        near = scipy.spatial.KDTree(finer.X).query(self.X, k=share)[1].reshape(len(self.X), share)
        return float(_rms(self.u - finer.u[:, near].mean(axis=2)).max() / finer.size)


class Timed(NamedTuple):
    """The outcome of a run."""

    states: list[State] | None
    """The states at the times of comparison, None of a run that failed."""
    linearisation_error: float
    """Linearisation error of the steps [-]."""
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
        """Whether a run of compiled code that takes these seconds is allowed: it fits into the seconds left, or into a
        twentieth of all."""
        return seconds <= max(self.left, self.seconds / 20)


class Bench(NamedTuple):
    """Runs and times a scene. Each method is compiled once for all steps."""

    refinement: int
    scene: Scene
    particles: Particles
    t1: float

    @classmethod
    def of(cls, build: Build, refinement: int, t1: float) -> "Bench":
        """The bench of a scene at a refinement."""
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
        self._go(method, steps, 1, 1)
        first = self.timed(method, steps, FRAMES, steps // FRAMES)
        if first.states is None or first.seconds >= _BRIEF:
            return first
        return min(first, self.timed(method, steps, FRAMES, steps // FRAMES), key=lambda run: run.seconds)

    def foresee(self, method: AbstractIntegrator, steps: int) -> float:
        """The seconds of a number of steps, estimated from fewer of them."""
        self._go(method, steps, 1, 1)
        some, seconds = 1, self.timed(method, steps, 1, 1).seconds
        while seconds < _PILOT_SECONDS and some < steps:
            some = min(4 * some, steps)
            seconds = self.timed(method, steps, 1, some).seconds
        return seconds / some * steps

    def timed(self, method: AbstractIntegrator, steps: int, frames: int, each: int) -> Timed:
        """As `_go`, with the seconds that it took."""
        begun = time.perf_counter()
        states, linearisation_error = self._go(method, steps, frames, each)
        return Timed(states, linearisation_error, time.perf_counter() - begun)

    def why(self, method: AbstractIntegrator, steps: int) -> str:
        """The error message of a run that fails."""
        try:
            self._go(method, steps, FRAMES, steps // FRAMES, throw=True)
        except SimulationError as error:
            return str(error)
        return "It ended well."

    def _go(
        self, method: AbstractIntegrator, steps: int, frames: int, each: int, *, throw: bool = False
    ) -> tuple[list[State] | None, float]:
        """The states after each of `frames` times `each` steps of t1 / `steps`, and their linearisation
        error. A faulty run has no states, or raises with `throw`."""
        dtype = self.particles.x.dtype
        scene, dt, method = canonical((self.scene, self.t1 / steps, method), dtype)
        state, states, statistics = initial_state(scene, self.particles), [], no_steps(dtype)
        for k in range(frames):
            begin = state
            go = partial(
                integrate,
                scene,
                self.particles,
                begin,
                jnp.asarray(k * each, dtype),
                jnp.asarray(each, dtype),
                dt,
                method,
                until=np.asarray(np.inf, dtype),
                max_steps=_MOST_STEPS,
                save_every=None,
                observe=None,
                adjoint=diffrax.ForwardMode(),  # the plain loop
                progress=False,
                watch=True,
            )
            reached = go()
            state, new = reached.state, reached.statistics
            statistics = statistics.merged(new)
            if not bool(jax.block_until_ready(statistics.healthy)):
                if throw:
                    final = with_state(self.particles, state.particles)
                    number = statistics.steps.astype(dtype)
                    run = Run(scene, method, dt, jnp.zeros((0,), dtype), None, None, final, number, statistics)
                    raise_faults(run, self.particles, partial(before_fault, go, begin, new), 0)
                return None, 0.0
            states.append(state.particles)
        return states, float(statistics.linearisation_error)


def _rms(distance: np.ndarray) -> Any:
    """The root mean square over particles of distances, shape (frames, p, d)."""
    return np.sqrt((distance**2).sum(axis=-1).mean(axis=-1))
