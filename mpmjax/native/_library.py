"""The shared library of kernels for CPUs: found in lib, checked, and registered with XLA."""

import ctypes
import functools
import warnings
from pathlib import Path
from typing import NamedTuple

import jax

INTERFACE = 12
"""The version of the library's interface, as in native/CMakeLists.txt: both change with the handlers' arguments."""
PATH = Path(__file__).parent / "lib" / "sums.so"
"""In a folder of its own: Python takes a shared library among modules for a module."""
KERNELS = (
    "gather",
    "scatter",
    "average",
    "pull",
    "resist",
    "combine",
    "product",
    "solve",
    "eigen",
    "rotation",
    "order",
    "rearrange",
    "stored",
)


class Library(NamedTuple):
    """The library, or why there is none."""

    handle: ctypes.CDLL | None
    reason: str
    """Why it is not used; empty if it is."""


@functools.cache
def library() -> Library:
    """The library, loaded and registered once. One that is there and does not fit is warned of, once."""
    if not PATH.is_file():
        return Library(None, "it was not built: the installation found no C++ compiler that it could use")
    try:
        handle = ctypes.CDLL(str(PATH))
        if (interface := handle.mpmjax_interface()) != INTERFACE:
            raise RuntimeError(f"it has interface {interface}, and this version of mpmjax needs {INTERFACE}")
        handle.mpmjax_instructions.restype = ctypes.c_char_p
        for name in (*KERNELS, "threads"):
            capsule = jax.ffi.pycapsule(getattr(handle, f"mpmjax_{name}"))
            jax.ffi.register_ffi_target(f"mpmjax_{name}", capsule, platform="cpu")
    except Exception as error:  # whatever the loader or XLA says of a library that does not fit
        reason = " ".join(str(error).split())
        warnings.warn(
            f"The native sums in {PATH} are not used: {reason}. Sums by XLA are slower and no different. To build the "
            "library for this jaxlib, install mpmjax again.",
            stacklevel=2,
        )
        return Library(None, f"it does not fit: {reason}")
    if not handle.mpmjax_instructions():
        return Library(None, "it has kernels for AVX2 and AVX-512 alone")
    return Library(handle, "")
