"""Runs, scenes and tables in files."""

from mpmjax.io._aside import reason, replacing, save_figure
from mpmjax.io._hdf5 import check_hdf5, check_place
from mpmjax.io._interrupt import end_on_signals, reporting, stopping
from mpmjax.io._record import record
from mpmjax.io._replaced import ReplacedFile
from mpmjax.io._runs import load, save, steps_in
from mpmjax.io._schema import arguments, decode, register

__all__ = [
    "ReplacedFile",
    "arguments",
    "check_hdf5",
    "check_place",
    "decode",
    "end_on_signals",
    "load",
    "reason",
    "record",
    "register",
    "replacing",
    "reporting",
    "save",
    "save_figure",
    "steps_in",
    "stopping",
]
