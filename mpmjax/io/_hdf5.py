"""Opening a run's HDF5 file, with checks that it is one, holds all of its data itself, and is whole."""

import math
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmjax.checks import require
from mpmjax.io._transactional_file import BUSY, StagedFile, reason, require_no_writer

File = Any
"""An `h5py.File`, whose own annotations do not say what a name leads to."""
FORMAT = 9
LIBVER_HEAD = ("v108", "v108")
_LIBVER = ("v110", "v110")  # what "latest" writes, VTK 9.7 cannot read
_GROWING = (
    "VTKHDF/Points",
    "VTKHDF/PointData/",
    "VTKHDF/Steps/",
    "mpmjax/frames",
    "mpmjax/collider_impulse",
    "mpmjax/boundary_impulse",
    "mpmjax/checksums",
)
_GROUPS = ("VTKHDF", "mpmjax")
_MOST_SHRUNK = 1032  # the most that deflate shrinks data by: h5repack may have compressed a run
_REMEDY = "restore it from a copy, or run the simulation again"


class FileRefusedError(ValueError):
    """A file cannot be used. The message says which, why, and what to do."""


def require_of_file(condition: Any, message: str) -> None:
    """Raise `FileRefusedError(message)` unless the condition holds."""
    if not condition:
        raise FileRefusedError(message)


def count_in(file: File) -> int:
    """Number of complete frames."""
    return int(file["VTKHDF/Steps"].attrs["NSteps"])


def set_count(file: File, count: int) -> None:
    """Set the number of complete frames."""
    file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(count))


def opened(staged: StagedFile, path: Path) -> File:
    """The staged file as HDF5. Its head has been written with the superblock of HDF5 1.8: a later one says whether a
    writer is at work, and while it is, and for ever if it was killed, nobody could open the file."""
    try:
        return h5py.File(staged, "r+", libver=_LIBVER)
    except OSError as error:
        raise ValueError(f"{path} is damaged ({reason(error)}): {_REMEDY}.") from None


def check_place(path: Path, *, overwrite: bool) -> None:
    """Raise `ValueError` if a new file cannot be there: no folder, a file that is there, and with `overwrite` one that
    is no run or is being written."""
    if not path.exists():
        require(path.parent.is_dir(), f"{path} cannot be written (no folder {path.parent}): name a place that can be.")
        return
    require(overwrite, f"{path} exists: choose another name, remove it, or ask to overwrite or to resume it.")
    require(path.is_file(), f"{path} is not a file: choose another name.")
    check_no_writer(path)  # first: what is just being written may not be a whole run to look at
    if path.stat().st_size > 0:
        try:
            with h5py.File(path, "r", locking=False) as file:
                run = all(_is_own(file, name) for name in _GROUPS)
        except OSError:
            run = False
        require(run, f"{path} is not a run that mpmjax wrote, and is not replaced: choose another name, or remove it.")


def check_no_writer(path: Path) -> None:
    """Raise `ValueError` if somebody is writing the file."""
    try:
        require_no_writer(path)
    except BlockingIOError:
        raise ValueError(BUSY.format(path)) from None
    except OSError:
        return  # whoever opens it next says why it cannot


def check_hdf5(path: Path) -> None:
    """Raise `ValueError` unless a file is there that can be read and begins as HDF5 does."""
    require(path.exists(), f"{path} does not exist: check its name.")
    require(path.is_file(), f"{path} is not a file: name one that mpmjax wrote.")
    try:
        with open(path, "rb") as raw:
            signature = raw.read(8)
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({reason(error)}): check its permissions.") from None
    require(len(signature) == 8, f"{path} is cut short to {len(signature)} bytes: {_REMEDY}.")
    require(signature == b"\x89HDF\r\n\x1a\n", f"{path} is not an HDF5 file: name one that mpmjax wrote.")


@contextmanager
def reading(path: Path) -> Iterator[File]:
    """Open a file to be read; every error of HDF5 becomes one line that says what to do."""
    check_hdf5(path)
    try:
        with h5py.File(path, "r", locking=False) as file:
            _check_format(path, file)
            _check_written(file)
            whole = fixed_checksum(file) == file["mpmjax"].attrs["checksum"]
            require(whole, "its scene, method or particles are not what was written")
            yield file
    except FileRefusedError:
        raise
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({reason(error)}): {_REMEDY}.") from None
    except (OSError, KeyError, RuntimeError, TypeError, AttributeError, IndexError, UnicodeError) as error:
        with open(path, "rb") as raw:
            head = raw.read(36)  # the superblock, which from HDF5 1.8 on says how long the file is
        stated = struct.unpack_from("<Q", head, 28)[0] if len(head) == 36 and head[8] in (2, 3) else 0
        short = len(head) < 36 or path.stat().st_size < stated
        what = "is cut short" if short else "is damaged, or just being written"
        raise ValueError(f"{path} {what} ({reason(error)}): {_REMEDY}.") from None


def _check_format(path: Path, file: File) -> None:
    missing = [name for name in _GROUPS if file.get(name, getlink=True) is None]
    require_of_file(not missing, f"{path} has no group /{' or /'.join(missing)}: it is not a run that mpmjax wrote.")
    _check_contained(path, file)
    version = int(file["mpmjax"].attrs["format"])
    require_of_file(
        version == FORMAT,
        f"{path} has format {version}, this mpmjax reads format {FORMAT}: use mpmjax "
        f"{file['mpmjax'].attrs['version'].decode()}, which wrote it.",
    )


def _is_own(group: File, name: str) -> bool:
    """Whether a name stands for an object itself, not for a link to an object in this or another file."""
    return isinstance(group.get(name, getlink=True), h5py.HardLink)


def _check_contained(path: Path, file: File) -> None:
    """Check that all data are in this file, each dataset once: HDF5 would follow links and write to where they lead."""
    seen, todo = {file["/"]}, [file["/"]]
    while todo:
        group = todo.pop()
        for name in group:
            item = group[name] if _is_own(group, name) else None
            elsewhere = isinstance(item, h5py.Dataset) and (item.is_virtual or item.external)
            fault = (
                "is a link"
                if item is None
                else "is a second name of an object"
                if item in seen
                else "has its data in other files"
                if elsewhere
                else None
            )
            where = f"{path}: {group.name.rstrip('/')}/{name}"
            require_of_file(fault is None, f"{where} {fault}, which no run of mpmjax has: {_REMEDY}.")
            seen.add(item)
            todo += [item] if isinstance(item, h5py.Group) else []


def _check_written(file: File) -> None:
    """Check that every counted frame was written: one that was not reads as zeros, has no checksum, and may be declared
    to be larger than any memory."""
    count = count_in(file)

    def check(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.size:
            chunk: tuple[int, ...] = item.chunks or (0,)
            rows, size = chunk[0], item.dtype.itemsize * math.prod(chunk)
            require(rows and chunk[1:] == item.shape[1:], f"{name} does not lie in frames")
            frames = count if name.startswith(_GROWING) else -(-len(item) // rows)
            least = size // _MOST_SHRUNK if item.compression else size
            stored: dict[int, int] = {}
            item.id.chunk_iter(lambda chunk: stored.update({chunk.chunk_offset[0]: chunk.size}))
            lost = next((n for n in range(frames) if stored.get(n * rows, -1) < least), None)
            require(lost is None, f"frame {lost} of {name} was never written")

    file.visititems(check)


def checksum(rows: dict[str, np.ndarray]) -> int:
    """CRC-32 of the bytes of some arrays, in the order of their names. A block of zeros does not pass it, as it passes
    HDF5's own checksum, which is zero for zeros."""
    return reduce(lambda crc, name: zlib.crc32(rows[name].tobytes(), crc), sorted(rows), 0)


def _datasets(file: File, *, growing: bool) -> dict[str, Any]:
    """The datasets that grow with the frames, or those that do not, by their names."""
    datasets: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and name.startswith(_GROWING) == growing:
            datasets[name] = item

    file.visititems(add)
    return datasets


def fixed_checksum(file: File) -> int:
    """The checksum of all datasets that do not grow with the frames."""
    return checksum({name: item[...] for name, item in _datasets(file, growing=False).items()})


def frame_rows(file: File, start: int, stop: int) -> dict[str, np.ndarray]:
    """The rows of frames `start` to `stop` in each dataset that grows.

    Raises:
        ValueError: they are not what was written.
    """
    rows = {}
    for name, item in _datasets(file, growing=True).items():
        count = (item.chunks or (0,))[0]
        rows[name] = item[start * count : stop * count]
    sums = rows.pop("mpmjax/checksums")
    for i in range(stop - start):
        lengths = {name: len(a) // (stop - start) for name, a in rows.items()}
        frame = {name: a[i * lengths[name] : (i + 1) * lengths[name]] for name, a in rows.items()}
        require(checksum(frame) == sums[i], f"frame {start + i} is not what was written")
    return rows
