"""The shared libraries of kernels, for CPUs and for NVIDIA's cards: found in lib, checked, and registered with XLA."""

import ctypes
import functools
import importlib.util
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import jax

INTERFACE = 19
"""The version of the libraries' interface, as in native/CMakeLists.txt: both change with the handlers' arguments."""
PATH = Path(__file__).parent / "lib" / "sums.so"
"""In a folder of its own: Python takes a shared library among modules for a module."""
CUDA_PATH = PATH.with_name("cuda.so")
CUDA_KERNELS = "gather", "scatter", "average", "pull", "resist", "p2g", "g2p", "eigen", "rotation"
KERNELS = *CUDA_KERNELS, "combine", "product", "solve", "order", "rearrange", "stored"


class Library(NamedTuple):
    """A library, or why there is none."""

    handle: ctypes.CDLL | None
    reason: str  # why it is not used; empty if it is


@functools.cache
def library() -> Library:
    """The library for CPUs, loaded and registered once. One that is there and does not fit is warned of, once."""

    def absence(handle: ctypes.CDLL) -> str:
        handle.mpmjax_instructions.restype = ctypes.c_char_p
        return "" if handle.mpmjax_instructions() else "it has no kernels for this processor; reinstall on it"

    return _loaded(PATH, absence, (*KERNELS, "threads"), "cpu")


@functools.cache
def cuda_library() -> Library:
    """The library for NVIDIA's cards, with the driver, NVRTC and a first kernel: loaded and registered once."""

    def absence(handle: ctypes.CDLL) -> str:
        handle.mpmjax_start.restype = ctypes.c_char_p
        cache, reason = _cache(), ""
        for nvrtc in _nvrtc():
            if not (reason := handle.mpmjax_start(nvrtc.encode(), cache.encode()).decode()):
                break
        return " ".join(reason.split())

    return _loaded(CUDA_PATH, absence, CUDA_KERNELS, "CUDA")


def _loaded(path: Path, absence: Callable[[ctypes.CDLL], str], kernels: Sequence[str], platform: str) -> Library:
    if not path.is_file():
        return Library(None, "it is not in this installation: it is built from source, where there is a C++ compiler")
    try:
        handle = ctypes.CDLL(str(path))
        if (interface := handle.mpmjax_interface()) != INTERFACE:
            raise RuntimeError(f"it has interface {interface}, and this version of mpmjax needs {INTERFACE}")
        if reason := absence(handle):
            return Library(None, reason)
        for name in kernels:
            capsule = jax.ffi.pycapsule(getattr(handle, f"mpmjax_{name}"))
            jax.ffi.register_ffi_target(f"mpmjax_{name}", capsule, platform=platform)
    except Exception as error:  # whatever the loader or XLA says of a library that does not fit
        reason = " ".join(str(error).split())
        warnings.warn(
            f"The native sums in {path} are not used: {reason}. Sums by XLA are slower and no different. To build the "
            "library for this jaxlib, install mpmjax again.",
            stacklevel=3,
        )
        return Library(None, f"it does not fit: {reason}")
    return Library(handle, "")


def _nvrtc() -> Iterator[str]:
    """Where NVRTC may be: in the wheels that JAX depends on, in an installation of CUDA, where the loader looks."""
    spec = importlib.util.find_spec("nvidia")
    folders = [Path(place) for place in (spec and spec.submodule_search_locations) or ()]
    for pattern, roots in (("*/lib/libnvrtc.so.*", folders), ("cuda*/lib64/libnvrtc.so.*", [Path("/usr/local")])):
        for root in roots:
            yield from sorted((str(path) for path in root.glob(pattern)), reverse=True)
    yield from ("libnvrtc.so.13", "libnvrtc.so.12")


def _cache() -> str:
    """The folder in which compiled kernels are kept for later processes; empty where there can be none."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mpmjax"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return ""
    return str(folder)
