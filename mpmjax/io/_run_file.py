"""A run's HDF5 file (docs/notes/file_format.md): opened with checks that it is one, holds all of its data itself, and
is whole; its frames, as ParaView reads them; and its description, all that is not frames.

Frames lie end to end in VTK's temporal PolyData, and `Steps` says where each begins; the topology is there once for all
of them. Every dataset is compressed and carries checksums, and a chunk holds one frame, so that writing a frame touches
no other.
"""

import json
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import reduce
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

from mpmjax.checks import canonical, require
from mpmjax.io._schema import decode, encode
from mpmjax.io._transactional_file import StagedFile, reason, require_no_writer
from mpmjax.simulation import Problem
from mpmjax.state import Scene, State, history_arrays
from mpmjax.stepping import AbstractIntegrator

File = Any  # an `h5py.File`, whose own annotations do not say what a name leads to
FORMAT = 9
_LIBVER_HEAD, _LIBVER = ("v108", "v108"), ("v110", "v110")  # what "latest" writes, VTK 9.7 cannot read
_GROUPS = ("VTKHDF", "mpmjax")
_GROWING = re.compile("VTKHDF/(Points|PointData/|Steps/)|mpmjax/(frames|collider_imp|boundary_imp|memory/|checksums)")
_ATTRIBUTES = ("dtype", "d", "counts", "dt", "control")  # of a run's description
# levels above 1 take up to 30 times as long for 3 to 5 % less: 55 and 63 % are saved of a jelly's and of a heap's run
_STORED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}
_MOST_SHRUNK = 1032  # the most that deflate shrinks data by
_UNITS = "SI: m, s, kg, Pa; deformation_gradient and J are pure numbers, affine_velocity is in 1/s"
UNKNOWN = "unknown"  # the control of a run that had one and was saved, not recorded
_UNCHANGING = ("mass", "volume", "X")
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


def check_place(path: Path, *, overwrite: bool) -> None:
    """Raise `ValueError` if no new file can be there; with `overwrite`, if what is there is no run or being written."""
    if not path.exists():
        require(path.parent.is_dir(), f"{path} cannot be written (no folder {path.parent}): name a place that can be.")
        return
    require(overwrite, f"{path} exists: choose another name, remove it, or ask to overwrite or to resume it.")
    require(path.is_file(), f"{path} is not a file: choose another name.")
    require_no_writer(path)  # first: what is just being written may not be a whole run to look at
    if path.stat().st_size > 0:
        import h5py  # here, since it takes long to import

        run = False
        with suppress(OSError), h5py.File(path, "r", locking=False) as file:
            run = all(_is_own(file, name) for name in _GROUPS)
        require(run, f"{path} is not a run that mpmjax wrote, and is not replaced: choose another name, or remove it.")


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
    import h5py

    check_hdf5(path)
    try:
        with h5py.File(path, "r", locking=False) as file:
            _check(path, file)
            whole = _fixed_checksum(file) == file["mpmjax"].attrs["checksum"]
            require(whole, "its scene, method or particles are not what was written")
            require_of_file(count_in(file) > 0, f"{path} holds no frame: run the simulation again.")
            yield file
    except FileRefusedError:
        raise
    except ValueError as error:
        raise ValueError(f"{path} is damaged ({reason(error)}): {_REMEDY}.") from None
    except (OSError, KeyError, RuntimeError, TypeError, AttributeError, IndexError, UnicodeError) as error:
        with open(path, "rb") as raw:
            head = raw.read(36)  # the superblock, which from HDF5 1.8 on says how long the file is
        stated = struct.unpack_from("<Q", head, 28)[0] if len(head) == 36 and head[8] in (2, 3) else 0
        what = "is cut short" if len(head) < 36 or path.stat().st_size < stated else "is damaged, or just being written"
        raise ValueError(f"{path} {what} ({reason(error)}): {_REMEDY}.") from None


def _is_own(group: File, name: str) -> bool:
    """Whether a name stands for an object itself, not for a link to an object in this or another file."""
    return type(group.get(name, getlink=True)).__name__ == "HardLink"


def _check(path: Path, file: File) -> None:
    """Check that a file is a run of this format, holds all data itself, each dataset once, and every frame."""
    missing = [name for name in _GROUPS if file.get(name, getlink=True) is None]
    require_of_file(not missing, f"{path} has no group /{' or /'.join(missing)}: it is not a run that mpmjax wrote.")
    seen, todo = {file["/"]}, [file["/"]]
    while todo:  # HDF5 would follow links, and write to where they lead
        group = todo.pop()
        for name in group:
            item, fault = group[name] if _is_own(group, name) else None, None
            if item is None:
                fault = "is a link"
            elif item in seen:
                fault = "is a second name of an object"
            elif not isinstance(item, Mapping) and (item.is_virtual or item.external):
                fault = "has its data in other files"
            place = f"{path}: {group.name.rstrip('/')}/{name} {fault}"
            require_of_file(fault is None, f"{place}, which no run of mpmjax has: {_REMEDY}.")
            seen.add(item)
            todo += [item] if isinstance(item, Mapping) else []
    version = int(file["mpmjax"].attrs["format"])
    require_of_file(
        version == FORMAT,
        f"{path} has format {version}, this mpmjax reads format {FORMAT}: use mpmjax "
        f"{file['mpmjax'].attrs['version'].decode()}, which wrote it.",
    )
    # a frame that was never written reads as zeros, has no checksum, and may be declared to be larger than any memory
    growing = _datasets(file, growing=True)
    for name, item in (growing | _datasets(file, growing=False)).items():
        if not item.size:
            continue
        chunk: tuple[int, ...] = item.chunks or (0,)
        rows, size = chunk[0], item.dtype.itemsize * int(np.prod(chunk))
        require(rows and chunk[1:] == item.shape[1:], f"{name} does not lie in frames")
        least = size // _MOST_SHRUNK if item.compression else size
        stored: dict[int, int] = {}
        item.id.chunk_iter(lambda chunk, stored=stored: stored.update({chunk.chunk_offset[0]: chunk.size}))
        frames = range(count_in(file) if name in growing else -(-len(item) // rows))
        lost = next((n for n in frames if stored.get(n * rows, -1) < least), None)
        require(lost is None, f"frame {lost} of {name} was never written")


def checksum(rows: dict[str, np.ndarray]) -> int:
    """CRC-32 of the bytes of some arrays, in the order of their names. A block of zeros does not pass it, as it passes
    HDF5's own checksum, which is zero for zeros."""
    return reduce(lambda crc, name: zlib.crc32(rows[name].tobytes(), crc), sorted(rows), 0)


def _datasets(file: File, *, growing: bool) -> dict[str, Any]:
    """The datasets that grow with the frames, or those that do not, by their names."""
    datasets: dict[str, Any] = {}

    def add(name: str, item: Any) -> None:
        if not isinstance(item, Mapping) and bool(_GROWING.match(name)) == growing:
            datasets[name] = item

    file.visititems(add)
    return datasets


def _fixed_checksum(file: File) -> int:
    """The checksum of all datasets that do not grow with the frames."""
    return checksum({name: item[...] for name, item in _datasets(file, growing=False).items()})


def frame_rows(file: File, start: int, stop: int) -> dict[str, np.ndarray]:
    """The rows of some frames in each dataset that grows; a ValueError if they are not what was written."""
    rows = {}
    for name, item in _datasets(file, growing=True).items():
        count = (item.chunks or (0,))[0]
        rows[name] = item[start * count : stop * count]
    sums = rows.pop("mpmjax/checksums")
    for i in range(stop - start):
        frame = {name: a.reshape(stop - start, -1)[i] for name, a in rows.items()}
        require(checksum(frame) == sums[i], f"frame {start + i} is not what was written")
    return rows


def opened(staged: StagedFile, path: Path, *, new: bool = False) -> File:
    """The staged file as HDF5. Its head has been written with the superblock of HDF5 1.8: a later one says whether a
    writer is at work, and while it is, and for ever if it was killed, nobody could open the file."""
    import h5py

    if new:
        h5py.File(staged, "w", libver=_LIBVER_HEAD).close()
    try:
        return h5py.File(staged, "r+", libver=_LIBVER)
    except OSError as error:
        raise ValueError(f"{path} is damaged ({reason(error)}): {_REMEDY}.") from None


def created(staged: StagedFile, path: Path, described: dict[str, Any], rows: dict[str, np.ndarray]) -> File:
    """The staged file as that of a run without frames, each of which will be such rows; a ValueError if `load` would
    not take it, since the run's dtype rounds a number to one that is not allowed."""
    dtype, arrays = np.dtype(described["dtype"]), described["arrays"]
    try:
        scene = decode(described["scene"], Scene, "", arrays)
        decode(described["method"], AbstractIntegrator, "method", arrays)
    except ValueError as error:
        raise FileRefusedError(f"{path} could not be loaded again, as {dtype} rounds it: {error}") from None
    file = opened(staged, path, new=True)

    def fix(group: File, name: str, data: Any) -> None:
        data = np.asarray(data)
        group.create_dataset(name, data=data, chunks=data.shape, maxshape=(None, *data.shape[1:]), **_STORED)

    def grow(group: File, name: str, rows: np.ndarray) -> None:
        chunks, wide = (max(len(rows), 1), *rows.shape[1:]), rows.shape[1:]
        group.create_dataset(name, (0, *wide), rows.dtype, chunks=chunks, maxshape=(None, *wide), **_STORED)

    # the points, each a vertex, and no steps
    vtk, count = file.create_group("VTKHDF"), len(described["particles"]["mass"])
    vtk.attrs["Version"] = np.array([2, 0], np.int64)
    vtk.attrs.create("Type", np.bytes_("PolyData"))
    fix(vtk, "NumberOfPoints", [count])
    for name, cells in (("Vertices", count), ("Lines", 0), ("Polygons", 0), ("Strips", 0)):
        group = vtk.create_group(name)
        fix(group, "NumberOfCells", [cells])
        fix(group, "NumberOfConnectivityIds", [cells])
        fix(group, "Offsets", np.arange(cells + 1))
        grow(group, "Connectivity", np.arange(cells))
        group["Connectivity"].resize((cells,))
        group["Connectivity"][:] = np.arange(cells)
    vtk.create_group("Steps").attrs["NSteps"] = np.int64(0)
    file.create_group("mpmjax/arrays")
    for name, data in rows.items():
        grow(file, name, data)
    group = file["mpmjax"]
    words = {"version": version("mpmjax"), "units": _UNITS, "materials": ", ".join(scene.titles), "format": FORMAT}
    for name, value in ({name: described[name] for name in _ATTRIBUTES} | words).items():
        if value is not None:  # texts of fixed length: others lie where HDF5 has no checksum
            group.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value
    for name in ("scene", "method"):
        fix(group, name, np.frombuffer(json.dumps(described[name]).encode(), np.uint8))
    for name, data in described["particles"].items():
        if data is not None:
            fix(group, name, data)
    for name, data in arrays.items():
        fix(group, f"arrays/{name}", data)
    group.attrs["checksum"] = np.uint32(_fixed_checksum(file))
    return file


def rows_of(frame: int, time: float, state: State, fields: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """The rows that a state and fields of it add to each dataset, as a frame with this number and time [s]. What a law
    remembers comes before a field of its name, since a restart needs it."""
    x, v = np.asarray(state.x), np.asarray(state.v)
    p, d = x.shape
    flat = ((0, 0), (0, 3 - d))
    ratios, gradients = [], []
    k = max((stored.shape[1] for _, stored, _ in state.groups if stored.ndim > 1), default=d)
    for _, stored, _ in state.groups:
        alone, a = stored.ndim == 1, np.asarray(stored)
        ratios.append(a if alone else np.linalg.det(a) if d > 1 else a[:, 0, 0])
        gradients.append(a[:, None, None] ** (1 / k) * np.eye(k, dtype=a.dtype) if alone else a)
    J, F = np.concatenate(ratios), np.concatenate(gradients)
    data = {"velocity": np.pad(v, flat), "J": J, "deformation_gradient": _padded(F, 1.0)}
    if state.C is not None:
        data["affine_velocity"] = _padded(np.asarray(state.C), 0.0)
    if state.mass is not None:
        data |= {"mass": np.asarray(state.mass), "volume": np.asarray(state.volume)}
    for name, rows, leaf in history_arrays(state):
        data.setdefault(name, np.full(p, np.nan, x.dtype))[rows] = leaf
    for name, field in fields.items():
        data.setdefault(name, np.asarray(field).reshape(p, *[9] * (field.ndim == 3)))
    first = frame * p
    steps = {"PartOffsets": 0, "NumberOfParts": 1, "PointOffsets": first}  # the one part, read anew at each step
    steps |= {f"PointDataOffsets/{name}": first for name in data}
    return {
        "VTKHDF/Points": np.pad(x, flat),
        **{f"VTKHDF/PointData/{name}": a for name, a in data.items()},
        "VTKHDF/Steps/Values": np.array([time]),
        "VTKHDF/Steps/CellOffsets": np.zeros((1, 4), np.int64),
        "VTKHDF/Steps/ConnectivityIdOffsets": np.zeros((1, 4), np.int64),
        **{f"VTKHDF/Steps/{name}": np.array([value], np.int64) for name, value in steps.items()},
    }


def states_in(rows: dict[str, np.ndarray], like: State) -> State:
    """The states that the rows of some frames describe (see `rows_of`), with a leading axis; those that are used are
    dropped. `like` is a state of the same run, whose shapes count."""
    p, d = like.x.shape

    def taken(name: str, *shape: int) -> np.ndarray:
        return rows.pop(name).reshape(-1, p, *shape)

    def tensors(name: str) -> np.ndarray:
        return taken(f"VTKHDF/PointData/{name}", 3, 3)

    F, J = tensors("deformation_gradient"), taken("VTKHDF/PointData/J")
    masses = [None if like.mass is None else taken(f"VTKHDF/PointData/{name}") for name in ("mass", "volume")]
    history = [
        rows[f"VTKHDF/PointData/{name}"].reshape(-1, p)[:, of] for name, of, _ in history_arrays(like)
    ]  # kept, since laws may share a name
    parts = (
        taken("VTKHDF/Points", 3)[..., :d],
        taken("VTKHDF/PointData/velocity", 3)[..., :d],
        None if like.C is None else tensors("affine_velocity")[..., :d, :d],
        tuple((J if a.ndim == 1 else F[..., : a.shape[1], : a.shape[1]])[:, of] for of, a, _ in like.groups),
        jax.tree.unflatten(jax.tree.structure(like.histories), history),
        *masses,
    )
    return State(*jax.device_put(parts))


def _padded(a: np.ndarray, diagonal: float) -> np.ndarray:
    """Matrices (p, d, d) as rows of nine, missing directions with this diagonal."""
    d, missing = a.shape[1], 3 - a.shape[1]
    padded = np.pad(a, ((0, 0), (0, missing), (0, missing)))
    padded[:, range(d, 3), range(d, 3)] = diagonal
    return padded.reshape(-1, 9)


def describe(run: Problem) -> dict[str, Any]:
    """The description of a run in its file, without the frames."""
    particles, dtype = run.particles, run.particles.x.dtype
    scene, method, dt = canonical((run.scene, run.method, run.dt), dtype)
    arrays: dict[str, np.ndarray] = {}
    parts = {name: getattr(particles, name) for name in _UNCHANGING}
    return {
        "dtype": str(dtype),
        "d": particles.dim,
        "counts": particles.counts,
        "dt": np.asarray(dt)[()],
        "scene": encode(scene, arrays),
        "method": encode(method, arrays, "method"),
        "arrays": arrays,
        "particles": {name: None if a is None else np.asarray(a) for name, a in parts.items()},
    }


def description_in(group: File) -> dict[str, Any]:
    """The description of the run in a file (see `describe`)."""

    def plain(value: Any) -> Any:
        value = tuple(value.tolist()) if isinstance(value, np.ndarray) else value
        return value.decode() if isinstance(value, bytes) else value

    missing = {"counts", "control"} - group.attrs.keys()  # which a file may lack
    return {
        **{name: None if name in missing else plain(group.attrs[name]) for name in _ATTRIBUTES},
        **{name: json.loads(group[name][...].tobytes()) for name in ("scene", "method")},
        "arrays": {name: dataset[...] for name, dataset in group["arrays"].items()},
        "particles": {name: group[name][...] if name in group else None for name in _UNCHANGING},
    }


def check_same(path: Path, ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Check that the run to be continued is the one in the file."""
    mine, other = dict(_flat(ours)), dict(_flat(theirs))
    for name in (*other, *mine):
        a, b = mine.get(name), other.get(name)
        show = "another array" if isinstance(b, np.ndarray) else "none" if b is None else repr(b)
        got = "" if isinstance(a, np.ndarray) else f" instead of {a!r}"
        advice = "Resume the same run, or name a new file."
        if name == "control":
            advice = "Resume a run with the control and the memory that it began with, or name a new file."
            if b == UNKNOWN:
                advice = "`save` does not know a run's control: go on by simulate, from what load returns, or record."
        same = type(a) is type(b) and np.array_equal(*cast(Any, (a, b)))
        require_of_file(same, f"{path} holds another run: its {name} is {show}{got}. {advice}")


def _flat(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf under its dotted path."""
    if isinstance(data, (dict, list)):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _flat(value, f"{path}.{key}".lstrip("."))
    else:
        yield path, data.item() if isinstance(data, np.generic) else data


def standing_in(path: Path) -> tuple[int, int]:
    """The number of frames of a file, and how many steps led to the last, −1 if that is not known. Raises what `load`
    does, and for a file that is being written."""
    require_no_writer(path)
    with reading(path) as file:
        return count_in(file), int(file["mpmjax/frames"][count_in(file) - 1]["steps"])
