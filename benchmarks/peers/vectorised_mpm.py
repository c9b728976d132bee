"""MLS-MPM by hand in C++, for the processor that it is compiled on: what is to be had. A peer to compare with.

The same scheme as `mpmjax.Explicit` with the default scene; see `taichi_mpm.py`. One thread a core; needs GCC 12 or
later.
"""

import ctypes
import os
import subprocess
import tempfile
import weakref
from functools import cache
from pathlib import Path

import numpy as np

_OPTIONS = "-std=c++20", "-O3", "-march=native", "-ffast-math", "-shared", "-fPIC", "-pthread", "-Wno-psabi"


@cache
def _library() -> ctypes.CDLL:
    """The compiled program."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "vectorised_mpm.so"
        source = Path(__file__).with_suffix(".cc")
        subprocess.run([os.environ.get("CXX", "g++"), *_OPTIONS, "-o", library, source], check=True)
        found = ctypes.CDLL(str(library))
    number, whole, place = ctypes.c_double, ctypes.c_int, ctypes.c_void_p
    found.begin.argtypes = [whole, whole, ctypes.c_int64, place, *[number] * 3, *[place] * 3, number, number, whole]
    found.begin.restype = place
    found.run.argtypes = [place, whole, number, *[place] * 3]
    found.end.argtypes = [place]
    return found


class VectorisedMPM:
    """A body under gravity in a box whose walls it does not touch; arguments as `TaichiMPM`'s."""

    def __init__(
        self,
        x: np.ndarray,
        v: np.ndarray,
        *,
        mass: float,
        volume: float,
        shape: tuple[int, ...],
        spacing: float,
        shear_modulus: float,
        lame_lambda: float,
        gravity: tuple[float, ...],
        dtype: str,
    ):
        self._library, (p, d) = _library(), x.shape
        self._found = np.empty((p, d), dtype), np.empty((p, d), dtype), np.empty((p, d, d), dtype)
        nodes, forces = np.asarray(shape, "int64"), np.asarray(gravity, "float64")
        x, v = (np.ascontiguousarray(a, "float64") for a in (x, v))
        self._body = self._library.begin(
            x.shape[1],
            np.dtype(dtype).itemsize,
            len(x),
            nodes.ctypes.data,
            spacing,
            shear_modulus,
            lame_lambda,
            *(a.ctypes.data for a in (forces, x, v)),
            mass,
            volume,
            len(os.sched_getaffinity(0)),
        )
        weakref.finalize(self, self._library.end, self._body)

    def run(self, steps: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Go on for some steps. Returns x, v and F, which the next call overwrites."""
        self._library.run(self._body, steps, dt, *(a.ctypes.data for a in self._found))
        return self._found
