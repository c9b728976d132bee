"""VTK's layout of moving particles in HDF5: temporal PolyData, as ParaView reads it.

Frames lie end to end in Points and PointData, and `Steps` says where each begins; the topology, a vertex a particle, is
there once for all of them. Numbers keep the run's dtype. In one and two dimensions vectors are padded with zeros and
deformation gradients with the identity; where a law knows J alone, J^(1/d) I stands for F. What laws remember is a
dataset a name, NaN at the particles of other laws. Every dataset carries checksums, and a chunk holds one frame, so
that writing a frame touches no other.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax.state import State, by_material, history_arrays

File = Any
"""An `h5py.File`, whose own annotations do not say what a name leads to."""


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
    groups = [np.asarray(stored) for _, stored, _ in by_material(state)]
    data = {
        "velocity": np.pad(v, flat),
        "J": np.concatenate([_ratio(stored) for stored in groups]),
        "deformation_gradient": _padded(np.concatenate([_gradient(stored, d) for stored in groups]), 1.0),
    }
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


def _ratio(stored: np.ndarray) -> np.ndarray:
    """J of one material's particles, of F, shape (q, d, d), or J itself, shape (q,)."""
    if stored.ndim == 1:
        return stored
    return np.linalg.det(stored) if stored.shape[1] > 1 else stored[:, 0, 0]


def _gradient(stored: np.ndarray, d: int) -> np.ndarray:
    """F of one material's particles, shape (q, d, d), where J alone is known J^(1/d) I."""
    return stored if stored.ndim > 1 else stored[:, None, None] ** (1 / d) * np.eye(d, dtype=stored.dtype)


def _padded(a: np.ndarray, diagonal: float) -> np.ndarray:
    """Matrices (p, d, d) as rows of nine, missing directions with this diagonal."""
    d, missing = a.shape[1], 3 - a.shape[1]
    padded = np.pad(a, ((0, 0), (0, missing), (0, missing)))
    padded[:, range(d, 3), range(d, 3)] = diagonal
    return padded.reshape(-1, 9)


def count_in(file: File) -> int:
    """Number of complete frames."""
    return int(file["VTKHDF/Steps"].attrs["NSteps"])


def set_count(file: File, count: int) -> None:
    """Set the number of complete frames."""
    file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(count))
