"""The writer of a run's file, a frame at a time, and the reader of its frames."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields as columns
from pathlib import Path
from types import TracebackType
from typing import Any

import equinox as eqx
import jax
import numpy as np

from mpmjax.analysis import FIELDS, fields_of
from mpmjax.boundary import Impulses
from mpmjax.checks import canonical, require
from mpmjax.io._run_file import (
    UNKNOWN,
    File,
    check_hdf5,
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
    rows_of,
    set_count,
    states_in,
)
from mpmjax.io._transactional_file import StagedFile, reason, replacing, undisturbed
from mpmjax.simulation import Problem, RolloutState, RunStatistics, initial_state, no_steps
from mpmjax.state import with_state

FIELDS_WRITTEN = ("pressure", "von_mises", "material")  # the fields that a file has unless it is asked for others

_IMPULSES = ("collider_impulse", "boundary_impulse")


def check_fields(fields: Sequence[str], where: str = "fields") -> None:
    """Raise `ValueError` unless all of these are fields that a file can have."""
    for name in fields:
        require(name in FIELDS, f"{where} must be some of {', '.join(FIELDS)}, got {name!r}.")


class FrameWriter:
    """Writes a run a frame at a time. What is written has left the program when `append` returns. A context manager:
    leaving it closes the file. `create` and `resume` make one."""

    def __init__(self, file: File, staged: StagedFile, path: Path, run: Problem, fields: Sequence[str]):
        self._file, self._staged, self._path, self._run, self._fields = file, staged, path, run, fields
        self._kept = self._standing()

    @classmethod
    def create(
        cls,
        path: str | os.PathLike,
        run: Problem,
        fields: Sequence[str] = FIELDS_WRITTEN,
        *,
        start: int = 0,
        overwrite: bool = False,
    ) -> "FrameWriter":
        """Begin a file with a run's prepared particles as its first frame, of step `start`. It takes its place when
        that is on the disk; whatever is wrong before leaves what was there."""
        path = Path(path)
        check_place(path, overwrite=overwrite)
        with undisturbed():
            begin = initial_state(run)
            with new_writer(path, run, begin, fields) as writer:
                writer.append(start, begin, no_steps(run.particles.x.dtype))
            return cls.resume(path, run)

    @classmethod
    def resume(cls, path: str | os.PathLike, run: Problem) -> "FrameWriter":
        """Open a file to append frames to it, after checking that it is whole, of the same run, and not being
        written. Frames that a killed writer left incomplete are cut off. The fields are those that it has."""
        path = Path(path)
        check_hdf5(path)
        staged = StagedFile(path)
        try:
            with reading(path) as file:
                for i in range(count_in(file)):
                    frame_rows(file, i, i + 1)
                fields = [name for name in FIELDS if f"VTKHDF/PointData/{name}" in file]
                described, rows = _first(run, initial_state(run), fields)
                check_same(path, described, description_in(file["mpmjax"]))
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
        return cls(file, staged, path, run, fields)

    def append(self, step: int, state: RolloutState, statistics: RunStatistics) -> None:
        """Write the frame of a step, with impulses and statistics by then; one of the last frame's step replaces it.
        If the disk refuses, an OSError: the file is what it was, and this writer can only be closed."""
        file, n = self._file, count_in(self._file)
        if n and file["mpmjax/frames"][n - 1]["step"] == step:
            n -= 1
        try:
            for name, rows in _rows(self._run, self._fields, n, step, state, statistics).items():
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
        n, like = count_in(self._file), jax.eval_shape(lambda: initial_state(self._run))
        steps, states, tallies = frames_in(self._file, like, n - 1, n)
        return int(steps[0]), *at((states, tallies), 0)

    def standing(self, then: str) -> str:
        """A sentence on what the file holds, and then what to do. Any thread may call it: it reads no file."""
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
def new_writer(path: Path, run: Problem, begin: RolloutState, fields: Sequence[str]) -> Iterator[FrameWriter]:
    """A writer of a new file, without frames, which will be of states as that at the beginning. It is at `path` when
    the block has ended without an error."""
    described, rows = _first(run, begin, fields)
    with replacing(path) as aside, StagedFile(aside) as staged:
        file = created(staged, path, described, rows)
        file.flush()
        staged.commit()
        with FrameWriter(file, staged, aside, run, fields) as writer:
            yield writer


def at(tree: Any, index: int | slice) -> Any:
    """Entries of arrays along their first axis, by NumPy: each operation of JAX would be a program to compile."""
    return jax.tree.map(lambda a: jax.device_put(np.asarray(a)[index]), tree)


def _first(run: Problem, begin: RolloutState, fields: Sequence[str]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """A run's description, and the rows of a frame of its state at the beginning. Of a control, which may be any
    function, the description has the name, a checksum of its numbers and one of its first memory."""

    def numbers(tree: Any) -> str:
        leaves = list(map(np.asarray, jax.tree.leaves(eqx.filter(tree, eqx.is_array))))
        return f"{checksum({str(i): a for i, a in enumerate([*leaves, *(np.array(a.shape) for a in leaves)])}):08x}"

    control = None if begin.particles.mass is None else UNKNOWN
    if run.control is not None:
        name = getattr(run.control, "__qualname__", type(run.control).__qualname__)
        control = f"{name} {numbers(run.control)} with memory {numbers(run.memory)}"
    rows = _rows(run, fields, 0, 0, begin, no_steps(run.particles.x.dtype))
    return describe(run) | {"control": control}, rows


def _rows(
    run: Problem, fields: Sequence[str], frame: int, step: int, state: RolloutState, statistics: RunStatistics
) -> dict[str, np.ndarray]:
    """The rows that a frame adds to each dataset."""
    values = {"step": np.int64(step)} | {
        f.name: np.asarray(getattr(statistics, f.name)) for f in columns(RunStatistics)
    }
    row = np.array([tuple(values.values())], [(name, a.dtype) for name, a in values.items()])
    time = step * float(canonical(run.dt, run.particles.x.dtype))
    plotted = fields_of(run.scene, with_state(run.particles, state.particles), tuple(fields)) if fields else {}
    rows = rows_of(frame, time, state.particles, plotted) | {"mpmjax/frames": row}
    for name in _IMPULSES:
        if (both := getattr(state, name)) is not None:
            rows[f"mpmjax/{name}"] = np.concatenate([np.asarray(both.impulse), np.asarray(both.angular)], axis=1)[None]
    rows |= {f"mpmjax/memory/{i}": np.asarray(a)[None] for i, a in enumerate(jax.tree.leaves(state.memory))}
    return rows | {"mpmjax/checksums": np.array([checksum(rows)], np.uint32)}


def frames_in(file: File, like: RolloutState, start: int, stop: int) -> tuple[np.ndarray, RolloutState, RunStatistics]:
    """Step numbers, states and statistics of frames, each with a leading axis; of `like` only shapes count."""
    rows = frame_rows(file, start, stop)
    table = rows["mpmjax/frames"]
    tallies = RunStatistics(**jax.device_put({f.name: table[f.name] for f in columns(RunStatistics)}))
    received: dict[str, Any] = {}
    for name in _IMPULSES:
        if getattr(like, name) is not None:
            both = np.split(rows[f"mpmjax/{name}"], [like.particles.x.shape[1]], axis=-1)
            received[name] = Impulses(*jax.device_put(both))
    kept, memory = jax.tree.flatten(like.memory)[0], jax.tree.structure(like.memory)
    received["memory"] = memory.unflatten(jax.device_put(rows[f"mpmjax/memory/{i}"]) for i in range(len(kept)))
    return table["step"], RolloutState(states_in(rows, like.particles), **received), tallies
