"""Runs in files (docs/notes/file_format.md): HDF5 that ParaView opens as it is, and from which a run continues bit for
bit.

Whatever is not in a dataset lies in headers that HDF5 checks itself, so a flipped bit is found. `NSteps` is raised
last, and what lies beyond it, the remains of a writer that was killed, is neither read nor kept. A frame that the disk
does not take leaves the file as it was (see `_transactional_file`). A file is read only if it holds all of its data
itself: HDF5 follows links to other files, and would write into them.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from mpmjax._types import Scalar
from mpmjax.analysis import energy
from mpmjax.checks import (
    canonical,
    checked,
    is_traced,
    require,
    require_finite,
    require_memory,
    require_positive,
    require_whole,
    requirements,
    warn,
)
from mpmjax.io._frame_writer import FIELDS_WRITTEN, FrameWriter, at, check_fields, frames_in, new_writer
from mpmjax.io._run_file import check_place, count_in, description_in, reading, require_of_file
from mpmjax.io._schema import decode
from mpmjax.io._transactional_file import reporting
from mpmjax.simulation import (
    Control,
    Fault,
    Problem,
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
from mpmjax.state import Particles, Scene, State, prepare, state_of
from mpmjax.stepping import AbstractIntegrator, Explicit, step_for

_merged = eqx.filter_jit(RunStatistics.merged)


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
    fields: tuple[str, ...] | list[str] = FIELDS_WRITTEN,
    start: int = 0,
    overwrite: bool = False,
    resume: bool = False,
    progress: bool = False,
    control: Control | None = None,
    memory: Any = None,
) -> Run:
    """Simulate as `simulate` does, writing each frame to a file when it is reached; memory holds one frame only.

    The steps between two frames are one compiled program, called again and again, and give the same numbers as
    `simulate` with the same `save_every`, bit for bit on a CPU. An interruption or a fault leaves a whole file.

    Args:
        path: the file to be (see `save`).
        scene, t1, dt, method: as in `simulate`.
        particles: the particles at step `start`; when resuming, those the recorded run began with.
        save_every: write a frame at the start, every so many steps, and at the end.
        fields: what each frame has beside the state, for those who plot it: any of "pressure", "von_mises", "stress"
            (Cauchy) [Pa], "density" [kg/m^d], "energy" [J/m^d], "speed" [m/s], "material" (from 1), "mass" [kg],
            "volume" [m^d] and "particle" (from 0). A file that is resumed keeps those it has.
        start: number of the first step. Not used when resuming.
        overwrite: replace a file that is there.
        resume: continue from the last frame in the file up to t1. Where that is reached already, nothing is done.
        progress: show a progress bar on standard error.
        control, memory: as in `simulate`. Each frame has the memory; a run is resumed with the control and memory that
            it began with, of which the file knows the control's name and a checksum of the arrays of each.

    Returns:
        the run without its frames, which are in the file.

    Raises:
        ValueError: those of `simulate` and `load`; a file that is there, of another run, or being written.
        SimulationError: those of `simulate`; the last good state is in the file.
        OSError: the disk refused a frame, as when it is full. The file holds all frames before it and can be resumed.
    """
    start = 0 if resume else require_whole("start", start, 0)
    requirements(method)
    check_fields(fields)
    particles = prepare(scene, particles)
    dt = step_for(scene, particles, t1, dt, method, start)
    end = start + number_of_steps(t1, dt, start, particles.x.dtype)
    save_every = min(require_whole("save_every", save_every, 1), end - start)
    scene, dt_, method, *kept = canonical((scene, dt, method, control, memory), particles.x.dtype)
    problem = Problem(scene, particles, dt_, method, **dict(zip(("control", "memory"), kept, strict=True)))
    if resume:
        writer = FrameWriter.resume(path, problem)
    else:
        eqx.filter_eval_shape(problem.controlled, initial_state(problem), 0.0)  # else what it refuses leaves a file
        writer = FrameWriter.create(path, problem, fields, start=start, overwrite=overwrite)
    with writer:
        step, state, statistics = writer.last()
        start = step - int(statistics.steps)
        require(
            int(statistics.fault) == Fault.NONE,
            f"{path} ends with a fault after step {step} and would meet it again: start anew with another dt or scene.",
        )
        told: dict[str, Any] = {"unit": "step", "smoothing": 0, "file": sys.stderr, "disable": not progress}
        bar = tqdm(initial=step, total=max(step, end), desc="compiling" if step < end else None, **told)

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
            before: Callable[[], RolloutState] = partial(initial_state, problem)
            while healthy and step < end:
                count = min(save_every - (step - start) % save_every, end - step)
                state, new, before = segment(problem, state, step, count, max_steps=save_every)
                statistics, step = _merged(statistics, new), step + int(new.steps)
                healthy = int(new.fault) == Fault.NONE and int(new.unconverged) == 0
                if healthy:
                    append(step, state, statistics)
                    if progress and bar.desc:  # the first steps compile, which says nothing of the time left
                        bar.set_description(refresh=False)
                        bar.initial, bar.start_t = step, time.time()
                        bar.last_print_t = bar.start_t  # or a bar that ends soon is taken for one never shown
                    bar.update(count)
        run = run_to(problem, state, step, statistics)
        try:
            raise_faults(run, problem, before, start)
        except SimulationError as error:
            good = error.run
            received = good.final_collider_impulse, good.final_boundary_impulse, good.final_memory
            last = RolloutState(_end_of(good, state.particles), *received)
            try:
                append(int(good.final_step), last, statistics)
                resumable = int(statistics.fault) == Fault.NONE
                again = "It can be resumed as it is." if resumable else "Resumed it would end there again: begin anew."
                text = writer.standing(again)
            except OSError as refused:
                text = str(refused)
            raise SimulationError(f"{error} {text}", good) from None
        warn_of_inaccuracy(run)
        return run


@checked
def save(path: str | os.PathLike, run: Run, *, fields: tuple[str, ...] | list[str] = FIELDS_WRITTEN) -> None:
    """Save a run's frames (without frames, its final state as the one frame) with all that a restart needs, and
    fields for those who plot them (see `record`).

    The file is written aside, synced and renamed: at every moment `path` is either what it was or the whole run.
    Observations are not saved. Of the statistics only the last frame's is known; the others are −1.

    Raises:
        ValueError: a run inside a jax transformation or a batch of them, a scene that files cannot hold, numbers that
            no run has, a place that cannot be written, a file there that is no run or is being written.
        OSError: the disk refused.
    """
    path = Path(path)
    check_fields(fields)
    check_place(path, overwrite=True)
    require(not is_traced(run), "A run inside a jax transformation has no values yet: save it outside.")
    require(run.final.x.ndim == 2, "Save a batch of runs one by one: jax.tree.map(lambda a: a[i], run).")
    final_step = int(run.final_step)
    count = int((np.asarray(run.steps) < final_step).sum())  # beyond it lie frames of a run that met a fault
    steps, frames = at((run.steps, run.frames), slice(count))
    last = RolloutState(_end_of(run, frames), run.final_collider_impulse, run.final_boundary_impulse, run.final_memory)
    states = (last.particles,) if frames is None else (frames, last.particles)
    _check_numbers(run.scene, run.dt, np.append(steps, final_step), *states)
    unknown = jax.tree.map(lambda a: np.full_like(a, -1), run.statistics)
    with new_writer(path, Problem(run.scene, run.final, run.dt, run.method), last, fields) as writer:
        for i in range(count):
            frame = at((frames, run.collider_impulse, run.boundary_impulse, run.memory), i)
            writer.append(int(steps[i]), RolloutState(*frame), unknown)
        writer.append(final_step, last, run.statistics)


def _check_numbers(scene: Scene, dt: Any, steps: np.ndarray, *states: State) -> None:
    """Check that dt is positive, step numbers grow, states are finite, and a grid can number the positions."""
    require_positive("dt [s]", dt)
    require(steps[0] >= 0 and (np.diff(steps) > 0).all(), f"A run's steps must grow from 0 or later, got {steps}.")
    most = float(scene.grid.spacing) * 2**31  # as far as nodes are numbered
    for state in states:
        for leaf in jax.tree.leaves(state):
            require_finite("A run's frames", leaf)
        require(np.abs(state.x).max(initial=0) < most, f"Positions must be below {most:.3g} m.")


def _end_of(run: Run, like: State | None) -> State:
    """The state at the end, with masses if a state `like` it has them."""
    return state_of(run.final, masses=like is not None and like.mass is not None)


@checked
def load(path: str | os.PathLike, *, frame: int | None = None) -> Run:
    """The run in a file, bit for bit: scene, method, dt, frames, statistics; `final` is the last frame.
    Unless jax's 64-bit mode is on, a float64 run is rounded to float32, with a warning.

    Args:
        path: the file.
        frame: number of the only frame to read, from the end if negative, with which the run ends. Default: all.

    Raises:
        ValueError: a frame that is not there; a file that is missing, cut short or damaged, not of this package or of
            another format, without frames.
    """
    path = Path(path)
    with reading(path) as file:
        described: Any = description_in(file["mpmjax"])
        dtype, arrays = np.dtype(described["dtype"]), described["arrays"]
        require(dtype.kind == "f", f"its numbers are of {dtype}")
        if dtype.itemsize > (most := jnp.zeros(()).dtype).itemsize:
            warn(f'{path} holds a {dtype} run, read in {most}: call jax.config.update("jax_enable_x64", True) before.')
            dtype = most
        count = count_in(file)
        there = frame is None or -count <= frame < count
        require_of_file(there, f"{path} has {count} frames, there is no frame {frame}.")
        start, stop = (0, count) if frame is None else (frame % count, frame % count + 1)
        size = path.stat().st_size * (stop - start) / count
        require_memory(f"The run in {path}", size, "read one of its frames by load(path, frame=0).")
        scene = decode(described["scene"], Scene, "scene", arrays)
        method = decode(described["method"], AbstractIntegrator, "method", arrays)
        scene, method = canonical((scene, method), dtype)
        parts: dict[str, Any] = jax.device_put(described["particles"])
        blank = jax.device_put(np.zeros((len(parts["mass"]), scene.grid.dim), dtype))
        particles = Particles(blank, blank, **parts, counts=described["counts"])
        problem = Problem(scene, particles, canonical(described["dt"], dtype), method)
        remembered = (0.0,) * len(file["mpmjax"].get("memory", ()))

        def begin() -> RolloutState:
            state = initial_state(replace(problem, particles=prepare(scene, particles)))
            if described["control"] is None:
                return state
            whole = replace(state.particles, mass=particles.mass, volume=particles.volume)
            return replace(state, particles=whole, memory=remembered)

        like = jax.eval_shape(begin)
        steps, frames, tallies = frames_in(file, like, start, stop)
        _check_numbers(scene, described["dt"], steps, frames.particles)
    last, statistics = at((frames, tallies), -1)
    return run_to(problem, last, steps[-1], statistics, frames, steps=canonical(steps, dtype))


@checked
def table(run: Run | str | os.PathLike) -> dict[str, np.ndarray]:
    """Numbers of each saved frame of a run or of one in a file, by their names and units: step, time, energies, the
    mean force and torque on each collider and boundary since the frame before (see `Run.forces`; NaN at the first).
    From a file also the `RunStatistics` up to the frame. `pandas.DataFrame` takes them; `mpmjax info RUN --table`
    writes them as CSV.

    Raises:
        ValueError: a run without frames, and those of `load`.
    """
    statistics: dict[str, np.ndarray] = {}
    if not isinstance(run, Run):
        path, run = Path(run), load(run)
        with reading(path) as file:
            rows = file["mpmjax/frames"][: len(run)]
            statistics = {name: rows[name] for name in rows.dtype.names if name != "step"}
    require(len(run) > 0, "The run has no frames to tabulate: pass save_every to simulate.")
    columns = {"step": np.asarray(run.steps), "time [s]": np.asarray(run.times)}
    if run.frames is not None and run.frames.mass is not None:
        columns["mass [kg]"] = np.asarray(run.frames.mass).sum(axis=1)
    energies = [energy(run.scene, run.frame(i)) for i in range(len(run))]
    for name in ("kinetic", "elastic", "potential", "total"):
        columns[f"{name} energy [J]"] = np.array([float(getattr(e, name)) for e in energies])
    for what, impulse, forces in (
        ("collider", run.collider_impulse, run.forces),
        ("boundary", run.boundary_impulse, run.boundary_forces),
    ):
        for kind, unit in (("force", "N"), ("torque", "N m")) if impulse is not None else ():
            mean = np.asarray(getattr(forces(), kind))
            axes = "xyz" if kind == "force" or mean.shape[2] == 3 else "z"
            for k, axis in np.ndindex(mean.shape[1:]):
                columns[f"{what} {k} {kind} {axes[axis]} [{unit}]"] = np.append(np.nan, mean[:, k, axis])
    return columns | statistics
