"""The contents of a run's file: its frames as ParaView reads them, and its description, all that is not frames.

Frames are VTK's layout of moving particles in HDF5, temporal PolyData. They lie end to end in Points and PointData, and
`Steps` says where each begins; the topology, a vertex a particle, is there once for all of them. Numbers keep the run's
dtype. In one and two dimensions vectors are padded with zeros and deformation gradients with the identity; where a law
knows J alone, J^(1/d) I stands for F. What laws remember is a dataset a name, NaN at the particles of other laws. Every
dataset carries checksums, and a chunk holds one frame, so that writing a frame touches no other.
"""

import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax.checks import canonical
from mpmjax.io._hdf5 import FORMAT, File, FileRefusedError, fixed_checksum, require_of_file
from mpmjax.io._schema import decode, encode
from mpmjax.state import Particles, Scene, State, by_material, history_arrays
from mpmjax.stepping import AbstractIntegrator

_UNITS = "SI: m, s, kg, Pa; deformation_gradient and J are pure numbers, affine_velocity is in 1/s"
_UNCHANGING = ("mass", "volume", "X")


def add_fixed(file: File, name: str, data: Any) -> None:
    """A dataset that is written once."""
    data = np.asarray(data)
    file.create_dataset(name, data=data, chunks=data.shape, maxshape=(None, *data.shape[1:]), fletcher32=True)


def add_growing(file: File, name: str, rows: np.ndarray) -> None:
    """An empty dataset that grows by such rows a frame."""
    chunks, wide = (max(len(rows), 1), *rows.shape[1:]), rows.shape[1:]
    file.create_dataset(name, (0, *wide), rows.dtype, chunks=chunks, maxshape=(None, *wide), fletcher32=True)


def add_topology(file: File, count: int) -> None:
    """The group /VTKHDF with `count` points, each a vertex, and no steps."""
    vtk = file.create_group("VTKHDF")
    vtk.attrs["Version"] = np.array([2, 0], np.int64)
    vtk.attrs.create("Type", np.bytes_("PolyData"))
    add_fixed(vtk, "NumberOfPoints", [count])
    for name, cells in (("Vertices", count), ("Lines", 0), ("Polygons", 0), ("Strips", 0)):
        group = vtk.create_group(name)
        add_fixed(group, "NumberOfCells", [cells])
        add_fixed(group, "NumberOfConnectivityIds", [cells])
        add_fixed(group, "Offsets", np.arange(cells + 1))
        add_growing(group, "Connectivity", np.arange(cells))
        group["Connectivity"].resize((cells,))
        group["Connectivity"][:] = np.arange(cells)
    vtk.create_group("Steps").attrs["NSteps"] = np.int64(0)


def rows_of(frame: int, time: float, state: State) -> dict[str, np.ndarray]:
    """The rows that a state adds to each dataset, as a frame with this number and time [s]."""
    x, v = np.asarray(state.x), np.asarray(state.v)
    p, d = x.shape
    flat = ((0, 0), (0, 3 - d))
    deformations = [_both(np.asarray(stored), d) for _, stored, _ in by_material(state)]
    J, F = (np.concatenate(parts) for parts in zip(*deformations, strict=True))
    data = {"velocity": np.pad(v, flat), "J": J, "deformation_gradient": _padded(F, 1.0)}
    if state.C is not None:
        data["affine_velocity"] = _padded(np.asarray(state.C), 0.0)
    for name, rows, leaf in history_arrays(state):
        data.setdefault(name, np.full(p, np.nan, x.dtype))[rows] = leaf
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
    """The states that some frames' rows describe, with a leading axis.

    Args:
        rows: of each dataset, those of all of the frames (see `rows_of`). Those that are used are dropped.
        like: a state of the same run, whose shapes count and whose numbers do not.
    """
    p, d = like.x.shape

    def taken(name: str, *shape: int) -> np.ndarray:
        return rows.pop(name).reshape(-1, p, *shape)

    def tensors(name: str) -> np.ndarray:
        return taken(f"VTKHDF/PointData/{name}", 3, 3)[..., :d, :d]

    F, J = tensors("deformation_gradient"), taken("VTKHDF/PointData/J")
    each = [(J if stored.ndim == 1 else F)[:, of] for of, stored, _ in by_material(like)]
    history = [
        jnp.asarray(rows[f"VTKHDF/PointData/{name}"].reshape(-1, p)[:, of]) for name, of, _ in history_arrays(like)
    ]  # kept, since laws may share a name
    return State(
        x=jnp.asarray(taken("VTKHDF/Points", 3)[..., :d]),
        v=jnp.asarray(taken("VTKHDF/PointData/velocity", 3)[..., :d]),
        deformations=tuple(jnp.asarray(stored) for stored in each),
        C=None if like.C is None else jnp.asarray(tensors("affine_velocity")),
        histories=jax.tree.unflatten(jax.tree.structure(like.histories), history),
    )


def _both(stored: np.ndarray, d: int) -> tuple[np.ndarray, np.ndarray]:
    """J, shape (q,), and F, shape (q, d, d), of what one material's particles store: F, or J alone."""
    if stored.ndim == 1:
        return stored, stored[:, None, None] ** (1 / d) * np.eye(d, dtype=stored.dtype)
    return (np.linalg.det(stored) if d > 1 else stored[:, 0, 0]), stored


def _padded(a: np.ndarray, diagonal: float) -> np.ndarray:
    """Matrices (p, d, d) as rows of nine, missing directions with this diagonal."""
    d, missing = a.shape[1], 3 - a.shape[1]
    padded = np.pad(a, ((0, 0), (0, missing), (0, missing)))
    padded[:, range(d, 3), range(d, 3)] = diagonal
    return padded.reshape(-1, 9)


def describe(scene: Scene, particles: Particles, method: AbstractIntegrator, dt: Any) -> dict[str, Any]:
    """The description of a run in its file, without the frames."""
    dtype = particles.x.dtype
    scene, method, dt = canonical((scene, method, dt), dtype)
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


def check_readable(path: Path, described: dict[str, Any]) -> None:
    """Check that `load` will take what is written: a number may be rounded by the run's dtype to one that is not
    allowed."""
    dtype, arrays = np.dtype(described["dtype"]), described["arrays"]
    try:
        decode(described["scene"], Scene, "", arrays)
        decode(described["method"], AbstractIntegrator, "method", arrays)
    except ValueError as error:
        raise FileRefusedError(f"{path} could not be loaded again, as {dtype} rounds it: {error}") from None


def write_description(group: File, described: dict[str, Any]) -> None:
    """Write what `describe` returned into the group of a file that is for it, the last of what is written once."""
    for name, text in {"version": version("mpmjax"), "units": _UNITS, "dtype": described["dtype"]}.items():
        group.attrs.create(name, np.bytes_(text))  # of fixed length: others lie where HDF5 has no checksum
    group.attrs["format"] = np.int64(FORMAT)
    group.attrs["d"] = np.int64(described["d"])
    if described["counts"] is not None:
        group.attrs["counts"] = np.asarray(described["counts"], np.int64)
    group.attrs["dt"] = described["dt"]
    for name in ("scene", "method"):
        add_fixed(group, name, np.frombuffer(json.dumps(described[name]).encode(), np.uint8))
    for name, data in described["particles"].items():
        if data is not None:
            add_fixed(group, name, data)
    for name, data in described["arrays"].items():
        add_fixed(group, f"arrays/{name}", data)
    group.attrs["checksum"] = np.uint32(fixed_checksum(group.file))


def description_in(group: File) -> dict[str, Any]:
    """The description of the run in a file (see `describe`)."""
    return {
        "dtype": group.attrs["dtype"].decode(),
        "d": int(group.attrs["d"]),
        "counts": tuple(group.attrs["counts"].tolist()) if "counts" in group.attrs else None,
        "dt": group.attrs["dt"],
        **{name: json.loads(group[name][...].tobytes()) for name in ("scene", "method")},
        "arrays": {name: dataset[...] for name, dataset in group["arrays"].items()},
        "particles": {name: group[name][...] if name in group else None for name in _UNCHANGING},
    }


def check_same(path: Path, ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Check that the run to be continued is the one in the file."""
    mine, other = dict(_flat(ours)), dict(_flat(theirs))
    for name in (*other, *mine):
        pair: Any = mine.get(name), other.get(name)
        a, b = pair
        show = "another array" if isinstance(b, np.ndarray) else "none" if b is None else repr(b)
        got = "" if isinstance(a, np.ndarray) else f" instead of {a!r}"
        require_of_file(
            type(a) is type(b) and np.array_equal(*pair),
            f"{path} holds another run: its {name} is {show}{got}. Resume the same run, or name a new file.",
        )


def _flat(data: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every leaf under its dotted path."""
    if isinstance(data, (dict, list)):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _flat(value, f"{path}.{key}".lstrip("."))
    else:
        yield path, data.item() if isinstance(data, np.generic) else data
