"""VTK's layout of moving particles in HDF5: temporal PolyData, as ParaView reads it.

Frames lie end to end in Points and PointData, and `Steps` says where each begins; the topology, a vertex a particle, is
there once for all of them. Numbers keep the run's dtype. In one and two dimensions vectors are padded with zeros and
deformation gradients with the identity. Every dataset carries checksums, and a chunk holds one frame, so that writing a
frame touches no other.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np

from mpmjax._particles import State

File = Any
"""An `h5py.File`, whose own annotations do not say what a name leads to."""

_TENSORS = {"deformation_gradient": ("F", 1.0), "affine_velocity": ("C", 0.0)}  # field, and what pads its diagonal


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
    """What a state adds to each dataset as the frame of that number, at that time [s]."""
    x, v, F = np.asarray(state.x), np.asarray(state.v), np.asarray(state.F)
    missing = 3 - x.shape[1]
    data = {"velocity": np.pad(v, ((0, 0), (0, missing))), "J": np.linalg.det(F)}
    for name, (field, diagonal) in _TENSORS.items():
        if (a := getattr(state, field)) is not None:
            padded = np.pad(np.asarray(a), ((0, 0), (0, missing), (0, missing)))
            padded[:, range(3 - missing, 3), range(3 - missing, 3)] = diagonal
            data[name] = padded.reshape(-1, 9)
    first = frame * len(x)
    steps = {"PartOffsets": 0, "NumberOfParts": 1, "PointOffsets": first}  # the one part, read anew at each step
    steps |= {f"PointDataOffsets/{name}": first for name in data}
    return {
        "VTKHDF/Points": np.pad(x, ((0, 0), (0, missing))),
        **{f"VTKHDF/PointData/{name}": a for name, a in data.items()},
        "VTKHDF/Steps/Values": np.array([time]),
        "VTKHDF/Steps/CellOffsets": np.zeros((1, 4), np.int64),
        "VTKHDF/Steps/ConnectivityIdOffsets": np.zeros((1, 4), np.int64),
        **{f"VTKHDF/Steps/{name}": np.array([value], np.int64) for name, value in steps.items()},
    }


def states_in(file: File, d: int, start: int, stop: int) -> State:
    """The states of frames `start` to `stop`, with a leading axis."""
    f, p, data = stop - start, int(file["VTKHDF/NumberOfPoints"][0]), file["VTKHDF/PointData"]
    rows = slice(start * p, stop * p)

    def tensors(name: str) -> Any:
        return jnp.asarray(data[name][rows].reshape(f, p, 3, 3)[..., :d, :d]) if name in data else None

    x, v = (jnp.asarray(a[rows, :d].reshape(f, p, d)) for a in (file["VTKHDF/Points"], data["velocity"]))
    return State(x=x, v=v, F=tensors("deformation_gradient"), C=tensors("affine_velocity"))


def count_in(file: File) -> int:
    """Number of complete frames."""
    return int(file["VTKHDF/Steps"].attrs["NSteps"])


def set_count(file: File, count: int) -> None:
    """Declare so many frames complete."""
    file["VTKHDF/Steps"].attrs.modify("NSteps", np.int64(count))
