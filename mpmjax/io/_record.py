"""Long runs, written to a file while they run."""

import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Literal

from tqdm import tqdm

from mpmjax._types import Scalar
from mpmjax.checks import canonical, checked, require, require_whole, requirements
from mpmjax.io._runs import FrameWriter
from mpmjax.io._transactional_file import reporting
from mpmjax.simulation import (
    Fault,
    RolloutState,
    Run,
    RunStatistics,
    SimulationError,
    initial_state,
    number_of_steps,
    raise_faults,
    run_to,
    segment,
    warn_of_inaccuracy,
)
from mpmjax.state import Particles, Scene, prepare, state_of
from mpmjax.stepping import AbstractIntegrator, Explicit, step_for


@checked
def record(
    path: str | os.PathLike,
    scene: Scene,
    particles: Particles,
    *,
    t1: Scalar,
    dt: Scalar | Literal["stable"],
    method: AbstractIntegrator = Explicit(),
    save_every: int,
    start: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    progress: bool = False,
) -> Run:
    """Simulate as `simulate` does, writing each frame to a file when it is reached; memory holds one frame only.

    The steps between two frames are one compiled program, called again and again, and give the same numbers as
    `simulate` with the same `save_every`, bit for bit on a CPU. A run that is interrupted or meets a fault leaves a
    whole file.

    Args:
        path: the file to be (see `save`).
        scene: the scene.
        particles: the particles at step `start`; when resuming, those the recorded run began with.
        t1: end time [s], a whole number of steps after time zero.
        dt: step [s], or "stable", as in `simulate`.
        method: update of the grid velocity.
        save_every: write a frame at the start, every so many steps, and at the end.
        start: number of the first step. Not used when resuming.
        overwrite: replace a file that is there.
        resume: continue from the last frame in the file up to t1. Where that is reached already, nothing is done.
        progress: show a progress bar on standard error.

    Returns:
        the run without its frames, which are in the file.

    Raises:
        ValueError: those of `simulate` and `load`; a file that is there, of another run, or being written.
        SimulationError: those of `simulate`; the last good state is in the file.
        OSError: the disk refused a frame, as when it is full. The file holds all frames before it and can be resumed.
    """
    dtype = particles.x.dtype
    start = 0 if resume else require_whole("start", start, 0)
    requirements(method)
    particles = prepare(scene, particles)
    dt = step_for(scene, particles, t1, dt, method, start)
    end = start + number_of_steps(t1, dt, start, dtype)
    save_every = min(require_whole("save_every", save_every, 1), end - start)
    if resume:
        writer = FrameWriter.resume(path, scene, particles, method, dt)
    else:
        writer = FrameWriter.create(path, scene, particles, method, dt, start=start, overwrite=overwrite)
    scene, dt_, method = canonical((scene, dt, method), dtype)
    with writer:
        step, state, statistics = writer.last()
        start = step - int(statistics.steps)
        require(
            int(statistics.fault) == Fault.NONE,
            f"{path} ends with a fault after step {step} and would meet it again: start anew with another dt or scene.",
        )
        bar = tqdm(initial=step, total=max(step, end), unit="step", file=sys.stderr, disable=not progress)

        def stopped() -> str:
            bar.close()
            return writer.standing("Resume it to continue.")

        def append(step: int, state: RolloutState, statistics: RunStatistics) -> None:
            try:
                writer.append(step, state, statistics)
            except OSError as error:
                raise OSError(f"{error}. {writer.standing('Make room, then resume it.')}") from None

        with bar, reporting(stopped):
            healthy = True
            before: Callable[[], RolloutState] = partial(initial_state, scene, particles)
            while healthy and step < end:
                count = min(save_every - (step - start) % save_every, end - step)
                state, new, before = segment(scene, particles, state, step, count, dt_, method, max_steps=save_every)
                statistics, step = statistics.merged(new), step + int(new.steps)
                healthy = int(new.fault) == Fault.NONE and int(new.unconverged) == 0
                if healthy:
                    append(step, state, statistics)
                    bar.update(count)
        run = run_to(state, step, statistics, scene, particles, dt_, method)
        try:
            raise_faults(run, particles, before, start)
        except SimulationError as error:
            try:
                received = error.run.final_collider_impulse, error.run.final_boundary_impulse
                last = RolloutState(state_of(error.run.final), *received)
                append(int(error.run.final_step), last, statistics)
                again = "Resumed it would end there again: begin anew."
                then = "It can be resumed as it is." if int(statistics.fault) == Fault.NONE else again
                text = writer.standing(then)
            except OSError as refused:
                text = str(refused)
            raise SimulationError(f"{error} {text}", error.run) from None
        warn_of_inaccuracy(run)
        return run
