"""Columns of measured data, from CSV files."""

import csv
import difflib
from pathlib import Path

import numpy as np

from mpmjax.checks import require, shortened
from mpmjax.io import reason


def read_columns(path: Path, *names: str) -> list[np.ndarray]:
    """Columns of a CSV file with a header; lines that start with # are comments.

    Raises:
        ValueError: no such file or column, or an entry that is no number.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read the data file {path}: {reason(error).lower()}.") from None
    columns: list[list[float]] = [[] for _ in names]
    try:
        reader = csv.DictReader(lines, skipinitialspace=True)
        known = reader.fieldnames or []
        for name in names:  # of what else is in the file nothing is said: it may be another file than was meant
            close = difflib.get_close_matches(name, known, 1)
            hint = f", did you mean {close[0]!r}?" if close else f" among its {len(known)}."
            require(name in known, f"{path} has no column {name!r}{hint}")
        for row, record in enumerate(reader, 1):
            for column, name in zip(columns, names, strict=True):
                cell = record[name]
                where = f"{path}, data row {row}: {name} must be a finite number, got"
                require(cell is not None, f"{where} a row that ends before it.")
                try:
                    column.append(float(cell))
                except ValueError:
                    raise ValueError(f"{where} {shortened(cell, 20)!r}.") from None
                require(np.isfinite(column[-1]), f"{where} {shortened(cell, 20)!r}.")
    except csv.Error as error:
        raise ValueError(f"{path} is not a CSV file: {error}.") from None
    require(len(columns[0]) > 0, f"{path} has a header and no rows: there is nothing to fit.")
    return [np.asarray(column) for column in columns]
