"""Arrays of measured data, from NumPy archives and HDF5 files."""

import zipfile
from pathlib import Path

import h5py
import numpy as np

from mpmjax.checks import require
from mpmjax.io import reason


def read_arrays(path: Path, *names: str) -> list[np.ndarray]:
    """Arrays of numbers in a NumPy archive or an HDF5 file.

    Raises:
        ValueError: no such file or array, or one that is not numbers.
    """
    suffixes = (".npz", ".h5", ".hdf5")
    require(path.suffix in suffixes, f"{path} must be a {', '.join(suffixes)} file with the arrays {', '.join(names)}.")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                found = {name: file[name] for name in names if name in file}
        else:
            with h5py.File(path, "r", locking=False) as file:
                found = {name: np.asarray(file[name]) for name in names if name in file}
    except (OSError, KeyError, EOFError, ValueError, TypeError, MemoryError, zipfile.BadZipFile) as error:
        raise ValueError(f"Cannot read the data file {path}: {reason(error).lower()}.") from None
    for name in names:
        require(name in found, f"{path} has no array {name!r}.")
        numbers = np.issubdtype(found[name].dtype, np.number) and not np.iscomplexobj(found[name])
        require(numbers, f"{path}: the array {name!r} must hold real numbers, got {found[name].dtype}.")
    return [found[name].astype(float) for name in names]
