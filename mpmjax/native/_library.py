"""The shared library of native sums: found in lib, checked, and registered with XLA."""

import ctypes
import functools
import os
import warnings
from pathlib import Path
from typing import NamedTuple

import jax

INTERFACE = 12
"""The version of the library's interface, as in native/CMakeLists.txt: both change with the handlers' arguments."""
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
        handle = _registered(ctypes.CDLL(str(PATH)))
        if not handle.mpmjax_instructions():
            return Library(None, "it has kernels for AVX2 and AVX-512 alone")
        return Library(handle, "")
    except Exception as error:  # whatever the loader or XLA says of a library that does not fit
        reason = " ".join(str(error).split())
        warnings.warn(
            f"The native sums in {PATH} are not used: {reason}. Sums by XLA are slower and no different. To build the "
            "library for this jaxlib, install mpmjax again.",
            stacklevel=2,
        )
        return Library(None, f"it does not fit: {reason}")


def _registered(handle: ctypes.CDLL) -> ctypes.CDLL:
    interface = handle.mpmjax_interface()
    if interface != INTERFACE:
        raise RuntimeError(f"it has interface {interface}, and this version of mpmjax needs {INTERFACE}")
    handle.mpmjax_instructions.restype = ctypes.c_char_p
    for name in (*HANDLERS, "threads"):
        capsule = jax.ffi.pycapsule(getattr(handle, target(name)))
        jax.ffi.register_ffi_target(target(name), capsule, platform="cpu")
    return handle


VARIABLE = "MPMJAX_BACKEND"


class Backend(NamedTuple):
    """Who sums between particles and nodes, and why."""

    name: str
    """`native` or `xla`."""
    reason: str
    """Why it is that one."""
    instructions: str | None = None
    """The instruction set of the native sums, such as AVX2."""
    threads: int | None = None
    """The threads of the native sums, which are XLA's."""

    def __str__(self) -> str:
        if self.name == "xla":
            return f"XLA ({self.reason})"
        return f"native, {self.instructions}, {self.threads} thread{'s' if self.threads != 1 else ''} ({self.reason})"


def uses_native() -> tuple[bool, str]:
    """Whether the native sums are used by what is compiled next, and why.

    Raises:
        ValueError: the environment variable MPMJAX_BACKEND asks for what there is not.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "native", "xla"):
        raise ValueError(f"{VARIABLE} must be native or xla, or not be set, got {asked!r}.")
    if asked == "xla":
        return False, f"{VARIABLE}=xla"
    native = library()
    if native.handle is None and asked == "native":
        raise ValueError(
            f"{VARIABLE}=native asks for the native sums, but there is no library of them that can be used: "
            f"{native.reason}. Install mpmjax again where there is a C++ compiler, or unset {VARIABLE}."
        )
    if native.handle is None:
        return False, f"no native library: {native.reason}"
    return True, f"{VARIABLE}=native" if asked else "the default"


def is_native() -> bool:
    """Whether what is compiled next for the default device has native sums."""
    return jax.default_backend() == "cpu" and uses_native()[0]


def backend() -> Backend:
    """Who sums between particles and nodes, and why: `native`, compiled kernels for CPUs, or `xla`.

    The environment variable MPMJAX_BACKEND, `native` or `xla`, chooses when a program is compiled; without it CPUs take
    the native sums where these were built, and other devices always take XLA's. The two differ by rounding.

    Raises:
        ValueError: MPMJAX_BACKEND asks for what there is not.
    """
    device = jax.default_backend()
    if device != "cpu":
        return Backend("xla", f"the device is a {device}")
    native, reason = uses_native()
    return Backend("native", reason, library().instructions, library().threads) if native else Backend("xla", reason)
