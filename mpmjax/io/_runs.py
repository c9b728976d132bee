"""Runs in files: HDF5 that ParaView opens as it is, and from which a run continues bit for bit.

    /VTKHDF     the frames (see `_run_file`): Points, and as PointData velocity, deformation_gradient, J = det F,
                with APIC affine_velocity, and what laws that yield remember
    /mpmjax     format, version, d, dtype, units, dt, counts, mass, volume, X, the scene and the method as JSON (see
                `_schema`) with their arrays, and a table with one row a frame: its step and the run's `RunStatistics`
                up to it; `collider_impulse` and `boundary_impulse`, those on each by then, linear, then angular;
                `checksums`, CRC-32 of all that a frame adds, and the attribute `checksum`, that of all other datasets

Whatever is not in a dataset lies in headers that HDF5 checks itself, so a flipped bit is found. `NSteps` is raised
last, and what lies beyond it, the remains of a writer that was killed, is neither read nor kept. A frame that the disk
does not take leaves the file as it was (see `_transactional_file`).

A file is read only if it holds all of its data itself: HDF5 follows links to other files, and would write into them.
"""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from mpmjax._types import Scalar
from mpmjax.boundary import Impulses
from mpmjax.checks import canonical, checked, is_traced, require, require_memory, require_whole, requirements, warn
from mpmjax.io._run_file import (
    File,
    check_hdf5,
    check_numbers,
    check_place,
    check_same,
    checksum,
    count_in,
    created,
    describe,
    description_in,
    frame_rows,
    opened,
    reading,
    require_of_file,
    rows_of,
    set_count,
    states_in,
)
from mpmjax.io._schema import decode
from mpmjax.io._transactional_file import StagedFile, reason, replacing, reporting, undisturbed
from mpmjax.simulation import (
    Fault,
    Problem,
    RolloutState,
    Run,
    RunStatistics,
    SimulationError,
    initial_state,
    no_steps,
    number_of_steps,
    raise_faults,
    run_to,
    segment,
    warn_of_inaccuracy,
)
from mpmjax.state import Particles, Scene, prepare, state_of
from mpmjax.stepping import AbstractIntegrator, Explicit, step_for

_IMPULSES = ("collider_impulse", "boundary_impulse")


class FrameWriter:
    """Writes a run a frame at a time. What is written has left the program when `append` returns. A context manager:
    leaving it closes the file. `create` and `resume` make one."""

    def __init__(self, file: File, staged: StagedFile, path: Path, like: RolloutState):
        self._file, self._staged, self._path, self._like = file, staged, path, like
        self._kept = self._standing()

    @classmethod
    def create(cls, path: str | os.PathLike, run: Problem, *, start: int = 0, overwrite: bool = False) -> "FrameWriter":
        """Begin a file with a run's prepared particles as its first frame, of step `start`. It takes its place when
        that is on the disk; whatever is wrong before leaves what was there."""
        path = Path(path)
        check_place(path, overwrite=overwrite)
        with undisturbed():
            with _new(path, run) as writer:
                writer.append(start, initial_state(run.scene, run.particles), no_steps(run.particles.x.dtype))
            return cls.resume(path, run)

    @classmethod
    def resume(cls, path: str | os.PathLike, run: Problem) -> "FrameWriter":
        """Open a file to append frames to it, after checking that it is whole, of the same run, and not being
        written. Frames that a killed writer left incomplete are cut off."""
        path = Path(path)
        described, begin, rows = _first(run)
        check_hdf5(path)
        staged = StagedFile(path)
        try:
            with reading(path) as file:
                for i in range(count_in(file)):
                    frame_rows(file, i, i + 1)
                check_same(path, described, description_in(file["mpmjax"]))
                require_of_file(count_in(file) > 0, f"{path} holds no frame: run the simulation again.")
            file = opened(staged, path)
            count = count_in(file)
            if any(len(file[name]) != count * len(data) for name, data in rows.items()):
                for name, data in rows.items():
                    file[name].resize(count * len(data), axis=0)
                file.flush()
                staged.commit()
        except BaseException as error:
            staged.close()
            if isinstance(error, OSError):
                raise OSError(f"{path} could not be written ({reason(error)}); it is as it was.") from None
            raise
        return cls(file, staged, path, begin)

    def append(self, step: int, state: RolloutState, statistics: RunStatistics) -> None:
        """Write the frame of a step, with impulses and statistics by then; one of the last frame's step replaces it.
        If the disk refuses, an OSError: the file is what it was, and this writer can only be closed."""
        file, n = self._file, count_in(self._file)
        if n and file["mpmjax/frames"][n - 1]["step"] == step:
            n -= 1
        try:
            for name, rows in _rows(n, step, file["mpmjax"].attrs["dt"], state, statistics).items():
                file[name].resize((n + 1) * len(rows), axis=0)
                file[name][n * len(rows) :] = rows
            file.flush()
            self._staged.commit()
            set_count(file, n + 1)
            file.flush()
            kept = self._standing()
            with undisturbed():  # a signal is told of this frame or of the one before it, as the file is then
                self._staged.commit()
                self._kept = kept
        except (OSError, RuntimeError) as error:
            raise OSError(f"frame {n} could not be written ({reason(error)})") from None
        if not self._staged.is_at(self._path):
            raise OSError(f"frame {n} has no file")

    def last(self) -> tuple[int, RolloutState, RunStatistics]:
        """Step number, state and statistics of the last frame."""
        n = count_in(self._file)
        steps, states, tallies = _frames(self._file, self._like, n - 1, n)
        return int(steps[0]), *_at((states, tallies), 0)

    def standing(self, then: str) -> str:
        """A sentence on what the file holds, and then what to do. It reads nothing, so that any thread may call it at
        any time."""
        if not self._staged.is_at(self._path):
            return f"{self._path} was removed or replaced while it was written: run the simulation again."
        frames, step, time = self._kept
        held = f"{frames} frame{'s' * (frames > 1)}, the last of step {step} (t = {time:.6g} s)"
        return f"{self._path} holds {held}. {then}"

    def _standing(self) -> tuple[int, int, float]:
        """The number of frames, and the last one's step and time [s]."""
        n = count_in(self._file)
        step = int(self._file["mpmjax/frames"][n - 1]["step"]) if n else 0
        return n, step, step * float(self._file["mpmjax"].attrs["dt"])

    def close(self) -> None:
        """Close the file; an OSError if what was written cannot be brought to the disk."""
        with suppress(OSError, RuntimeError):  # of a writer that failed; what it has not committed is dropped
            self._file.close()
        try:
            self._staged.sync()
        except OSError as error:
            raise OSError(f"{self._path} may not be whole on the disk ({reason(error)}): check it.") from None
        finally:
            self._staged.close()

    def __enter__(self) -> "FrameWriter":
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        there = self._staged.is_at(self._path)
        self.close()
        if kind is None and not there:
            raise OSError(self.standing(""))


@contextmanager
def _new(path: Path, run: Problem) -> Iterator[FrameWriter]:
    """A writer of a new file, without frames, which is at `path` when the block has ended without an error."""
    described, begin, rows = _first(run)
    with replacing(path) as aside, StagedFile(aside) as staged:
        file = created(staged, path, described, rows)
        file.flush()
        staged.commit()
        with FrameWriter(file, staged, aside, begin) as writer:
            yield writer


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
        scene, t1, dt, method: as in `simulate`.
        particles: the particles at step `start`; when resuming, those the recorded run began with.
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
    start = 0 if resume else require_whole("start", start, 0)
    requirements(method)
    particles = prepare(scene, particles)
    dt = step_for(scene, particles, t1, dt, method, start)
    end = start + number_of_steps(t1, dt, start, particles.x.dtype)
    save_every = min(require_whole("save_every", save_every, 1), end - start)
    scene, dt_, method = canonical((scene, dt, method), particles.x.dtype)
    problem = Problem(scene, particles, dt_, method)
    if resume:
        writer = FrameWriter.resume(path, problem)
    else:
        writer = FrameWriter.create(path, problem, start=start, overwrite=overwrite)
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
                state, new, before = segment(problem, state, step, count, max_steps=save_every)
                statistics, step = _merged(statistics, new), step + int(new.steps)
                healthy = int(new.fault) == Fault.NONE and int(new.unconverged) == 0
                if healthy:
                    append(step, state, statistics)
                    bar.update(count)
        run = run_to(problem, state, step, statistics)
        try:
            raise_faults(run, particles, before, start)
        except SimulationError as error:
            good = error.run
            last = RolloutState(state_of(good.final), good.final_collider_impulse, good.final_boundary_impulse)
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
def save(path: str | os.PathLike, run: Run) -> None:
    """Save a run's frames (without frames, its final state as the one frame) with all that a restart needs.

    The file is written aside, synced and renamed: at every moment `path` is either what it was or the whole run.
    Observations are not saved. Of the statistics only the last frame's is known; the others are −1.

    Raises:
        ValueError: a run inside a jax transformation or a batch of them, a scene that files cannot hold, numbers that
            no run has, a place that cannot be written, a file there that is no run or is being written.
        OSError: the disk refused.
    """
    path = Path(path)
    check_place(path, overwrite=True)
    require(not is_traced(run), "A run inside a jax transformation has no values yet: save it outside.")
    require(run.final.x.ndim == 2, "Save a batch of runs one by one: jax.tree.map(lambda a: a[i], run).")
    final_step = int(run.final_step)
    count = int((np.asarray(run.steps) < final_step).sum())  # beyond it lie frames of a run that met a fault
    steps, frames = _at((run.steps, run.frames), slice(count))
    states = (state_of(run.final),) if frames is None else (frames, state_of(run.final))
    check_numbers(run.scene, run.dt, np.append(steps, final_step), *states)
    unknown = jax.tree.map(lambda a: np.full_like(a, -1), run.statistics)
    with _new(path, Problem(run.scene, run.final, run.dt, run.method)) as writer:
        for i in range(count):
            frame = _at((frames, run.collider_impulse, run.boundary_impulse), i)
            writer.append(int(steps[i]), RolloutState(*frame), unknown)
        received = run.final_collider_impulse, run.final_boundary_impulse
        writer.append(final_step, RolloutState(state_of(run.final), *received), run.statistics)


@checked
def load(path: str | os.PathLike) -> Run:
    """The run in a file, bit for bit: scene, method, dt, frames, statistics; `final` is the last frame.
    Unless jax's 64-bit mode is on, a float64 run is rounded to float32, with a warning.

    Raises:
        ValueError: a file that is missing, cut short or damaged, not of this package or of another format, without
            frames.
    """
    path = Path(path)
    with reading(path) as file:
        described = description_in(file["mpmjax"])
        dtype, arrays = np.dtype(described["dtype"]), described["arrays"]
        require(dtype.kind == "f", f"its numbers are of {dtype}")
        if dtype.itemsize > (most := jnp.zeros(()).dtype).itemsize:
            warn(f'{path} holds a {dtype} run, read in {most}: call jax.config.update("jax_enable_x64", True) before.')
            dtype = most
        require_of_file(count_in(file) > 0, f"{path} holds no frame: run the simulation again.")
        require_memory(f"The run in {path}", path.stat().st_size, "read a part of it by h5py.")
        scene = decode(described["scene"], Scene, "scene", arrays)
        method = decode(described["method"], AbstractIntegrator, "method", arrays)
        scene, method = canonical((scene, method), dtype)
        parts: dict[str, Any] = jax.device_put(described["particles"])
        blank = jax.device_put(np.zeros((len(parts["mass"]), scene.grid.dim), dtype))
        particles = Particles(blank, blank, **parts, counts=described["counts"])
        like = jax.eval_shape(lambda: initial_state(scene, prepare(scene, particles)))
        steps, frames, tallies = _frames(file, like, 0, count_in(file))
        check_numbers(scene, described["dt"], steps, frames.particles)
    last, statistics = _at((frames, tallies), -1)
    return run_to(
        Problem(scene, particles, canonical(described["dt"], dtype), method),
        last,
        steps[-1],
        statistics,
        steps=canonical(steps, dtype),
        frames=frames.particles,
        collider_impulse=frames.collider_impulse,
        boundary_impulse=frames.boundary_impulse,
    )


_merged = eqx.filter_jit(RunStatistics.merged)


def _at(tree: Any, index: int | slice) -> Any:
    """The entries of arrays along their first axis. NumPy takes them: each operation of JAX by itself is a program to
    compile."""
    return jax.tree.map(lambda a: jax.device_put(np.asarray(a)[index]), tree)


def _first(run: Problem) -> tuple[dict[str, Any], RolloutState, dict[str, np.ndarray]]:
    """A run's description, its state at the start, and the rows of a frame of it."""
    described, begin = describe(run), initial_state(run.scene, run.particles)
    return described, begin, _rows(0, 0, described["dt"], begin, no_steps(run.particles.x.dtype))


def _rows(frame: int, step: int, dt: Any, state: RolloutState, statistics: RunStatistics) -> dict[str, np.ndarray]:
    """The rows that a frame adds to each dataset."""
    values = {"step": np.int64(step)} | {f.name: np.asarray(getattr(statistics, f.name)) for f in fields(RunStatistics)}
    row = np.array([tuple(values.values())], [(name, a.dtype) for name, a in values.items()])
    rows = rows_of(frame, step * float(dt), state.particles) | {"mpmjax/frames": row}
    for name in _IMPULSES:
        if (both := getattr(state, name)) is not None:
            rows[f"mpmjax/{name}"] = np.concatenate([np.asarray(both.impulse), np.asarray(both.angular)], axis=1)[None]
    return rows | {"mpmjax/checksums": np.array([checksum(rows)], np.uint32)}


def _frames(file: File, like: RolloutState, start: int, stop: int) -> tuple[np.ndarray, RolloutState, RunStatistics]:
    """Step numbers, states and statistics of frames `start` to `stop`, each with a leading axis; of `like` only shapes
    count."""
    rows = frame_rows(file, start, stop)
    table = rows["mpmjax/frames"]
    tallies = RunStatistics(**jax.device_put({f.name: table[f.name] for f in fields(RunStatistics)}))
    received: dict[str, Any] = {}
    for name in _IMPULSES:
        if getattr(like, name) is not None:
            both = np.split(rows[f"mpmjax/{name}"], [like.particles.x.shape[1]], axis=-1)
            received[name] = Impulses(*jax.device_put(both))
    return table["step"], RolloutState(states_in(rows, like.particles), **received), tallies
