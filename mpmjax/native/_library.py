"""The shared library of native sums: found in lib, checked, and registered with XLA."""

import ctypes
import functools
import warnings
from pathlib import Path
from typing import NamedTuple

import jax

INTERFACE = 11
"""What the library has to answer, as in native/CMakeLists.txt: both change with the handlers' arguments."""
PATH = Path(__file__).parent / "lib" / "sums.so"
"""In a folder of its own: Python takes a shared library among modules for a module."""
HANDLERS = (
    "gather",
    "scatter",
    "average",
    "pull",
    "resist",
    "combine",
    "product",
    "solve",
    "slope",
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

    @property
    def instructions(self) -> str | None:
        """The instruction set that it uses on this machine, such as AVX2; None without it."""
        if self.handle is None:
            return None
        self.handle.mpmjax_instructions.restype = ctypes.c_char_p
        return self.handle.mpmjax_instructions().decode()

    @property
    def threads(self) -> int | None:
        """The threads of XLA that it shares its work among; None without it."""
        if self.handle is None:
            return None
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            count = jax.ffi.ffi_call(target("threads"), jax.ShapeDtypeStruct((), "int32"))
            return max(int(jax.jit(count)()), 1)


def target(name: str) -> str:
    """The name by which XLA knows a handler."""
    return f"mpmjax_{name}"


@functools.cache
def library() -> Library:
    """The library, loaded and registered once. One that is there and does not fit is warned of, once."""
    if not PATH.is_file():
        return Library(None, "it was not built: the installation found no C++ compiler that it could use")
    try:
        return Library(_registered(ctypes.CDLL(str(PATH))), "")
    except Exception as error:  # whatever the loader or XLA says of a library that does not fit
        reason = " ".join(str(error).split())
        warnings.warn(
            f"The native sums in {PATH} are not used: {reason}. Sums by XLA are slower and no different. To build the "
            "library for this jaxlib, install mpmjax again.",
            stacklevel=2,
        )
        return Library(None, f"it does not fit: {reason}")


def _registered(handle: ctypes.CDLL) -> ctypes.CDLL:
    found = handle.mpmjax_interface()
    if found != INTERFACE:
        raise RuntimeError(f"it has interface {found}, and this version of mpmjax needs {INTERFACE}")
    for name in (*HANDLERS, "threads"):
        capsule = jax.ffi.pycapsule(getattr(handle, target(name)))
        jax.ffi.register_ffi_target(target(name), capsule, platform="cpu")
    return handle
