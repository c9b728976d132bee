"""Measured data in files: columns of CSV files, arrays of NumPy archives and HDF5 files."""

import csv
import difflib
import re
import zipfile
from pathlib import Path

import numpy as np

from mpmjax.checks import require, shortened
from mpmjax.io import reason

_PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "h": 1e2, "k": 1e3, "M": 1e6, "G": 1e9}
_UNITS = {prefix + unit: factor for prefix, factor in _PREFIXES.items() for unit in ("m", "s", "N", "Pa", "J")}
_UNITS |= {prefix + "g": factor * 1e-3 for prefix, factor in _PREFIXES.items()}  # factors to SI units


class Columns:
    """Columns of a CSV file with a header; lines that start with # are comments.

    Args:
        path: the file.
        names: the columns, by their heads.

    Raises:
        ValueError: no such file or column, a row with more or fewer fields than the header, or an entry that is no
            finite number: one line that names the file and its line.
    """

    def __init__(self, path: Path, *names: str):
        self.path = path
        try:
            text = path.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise ValueError(f"Cannot read the data file {path}: {reason(error).lower()}.") from None
        numbered = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and line[0] != "#"]
        require(len(numbered) > 0, f"{path} is empty: it needs a header that names its columns, and rows.")
        reader = csv.reader((line for _, line in numbered), skipinitialspace=True)
        rows = []
        while reader.line_num < len(numbered):
            line = numbered[reader.line_num][0]
            try:
                rows.append((line, next(reader)))
            except csv.Error as error:
                raise ValueError(f"{path}, line {line}: not CSV: {error}.") from None
        (self.header_line, head), *rows = rows
        head = [name.strip() for name in head]
        for name in names:
            close = difflib.get_close_matches(name, head, 1)
            hint = f", did you mean {close[0]!r}?" if close else f" among its {len(head)}."
            if apart := [mark for mark in (";", "\t") if len(head) == 1 and mark in head[0]]:
                hint = f": its fields are parted by {apart[0]!r}; part them by commas."
            # of what else is in the file nothing is said: it may be another file than was meant
            require(name in head, f"{path} has no column {name!r}{hint}")
            require(head.count(name) == 1, f"{path}, line {self.header_line}: the column {name!r} is there twice.")
        require(len(rows) > 0, f"{path} has a header and no rows: there is nothing to fit.")
        for line, fields in rows:
            full = len(fields) == len(head)
            require(full, f"{path}, line {line}: {len(fields)} fields, but the header has {len(head)}.")
        self.lines = np.array([line for line, _ in rows])  # the line of each row, from 1
        self._data = {
            name: np.array([self._number(n, name, row[head.index(name)]) for n, row in rows]) for name in names
        }

    def _number(self, line: int, name: str, cell: str) -> float:
        try:
            number = float(cell)
        except ValueError:
            number = np.nan
        fault = f"{self.path}, line {line}: {name} must be a finite number, got {shortened(cell, 20)!r}."
        require(np.isfinite(number), fault)
        return number

    def __getitem__(self, name: str) -> np.ndarray:
        """The numbers of a column, as they stand in the file."""
        return self._data[name]

    def require(self, condition: np.ndarray, message: str) -> None:
        """Check every row; the message names the first line that is not right, {column} its number in that column."""
        wrong = np.flatnonzero(~np.asarray(condition))
        if len(wrong):
            row = {name: f"{column[wrong[0]]:g}" for name, column in self._data.items()}
            text = re.sub(r"\{(.+?)\}", lambda match: row.get(match[1], match[0]), message)
            raise ValueError(f"{self.path}, line {self.lines[wrong[0]]}: {text}")

    def scaled(self, name: str, unit: float, key: str = "unit") -> np.ndarray:
        """A column times `unit`, which the user calls `key`: in SI units, as its head says, if it does: "x [mm]"."""
        stated = stated_unit(name)
        require(
            stated is None or np.isclose(unit, stated, rtol=1e-9),
            f"{self.path}, line {self.header_line}: the column {name!r} states another unit than {key} = {unit:g}: "
            f"give {key} = {stated or 1:g}, or name the column otherwise.",
        )
        return self._data[name] * unit


def after(times: np.ndarray, t1: float) -> np.ndarray:
    """Whether times lie after a run's end t1 [s], by more than single precision has rounded the times of its steps."""
    return times > t1 * (1 + ROUNDED)


ROUNDED = 1e-6  # part of a time by which it may be rounded: its step's number times dt, each in single precision


def stated_unit(name: str) -> float | None:
    """The factor to SI units that a column's head states, as "x [mm]", "force (kN)" or "stress_MPa"; None if none."""
    bracketed = re.search(r"[\[(]\s*(\S+?)\s*[\])]$", name)
    match = bracketed or re.search(r"_([^\W_]+)$", name)
    if bracketed and bracketed[1] in ("m", "s", "N", "Pa", "J"):
        return 1.0
    return None if match is None else _UNITS.get(match[1])


def read_columns(path: Path | str, *names: str) -> list[np.ndarray]:
    """Columns of a CSV file, see `Columns`."""
    columns = Columns(Path(path), *names)
    return [columns[name] for name in names]


def read_arrays(path: Path, *names: str) -> list[np.ndarray]:
    """Arrays of real numbers in a NumPy archive or an HDF5 file."""
    suffixes = (".npz", ".h5", ".hdf5")
    require(path.suffix in suffixes, f"{path} must be a {', '.join(suffixes)} file with the arrays {', '.join(names)}.")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in names if name in file}
        else:
            import h5py  # here, since it takes long to import

            with h5py.File(path, "r", locking=False) as file:
                arrays = {name: np.asarray(file[name]) for name in names if name in file}
    except (OSError, KeyError, EOFError, ValueError, TypeError, MemoryError, zipfile.BadZipFile) as error:
        raise ValueError(f"Cannot read the data file {path}: {reason(error).lower()}.") from None
    for name in names:
        require(name in arrays, f"{path} has no array {name!r}.")
        numbers = np.issubdtype(arrays[name].dtype, np.number) and not np.iscomplexobj(arrays[name])
        require(numbers, f"{path}: the array {name!r} must hold real numbers, got {arrays[name].dtype}.")
    return [arrays[name].astype(float) for name in names]
