"""The description of a run in its file: all of it but the frames, so that it can be loaded, resumed and compared."""

import json
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from mpmjax.checks import canonical
from mpmjax.io._hdf5 import FORMAT, FileRefusedError, fixed_checksum, require_of_file
from mpmjax.io._schema import decode, encode
from mpmjax.io._vtkhdf import File, add_fixed
from mpmjax.state import Particles, Scene
from mpmjax.stepping import AbstractIntegrator

_UNITS = "SI: m, s, kg, Pa; deformation_gradient and J are pure numbers, affine_velocity is in 1/s"
_UNCHANGING = ("mass", "volume", "X")


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
