"""Back ends: who evaluates sums between particles and nodes, and other functions that have kernels."""

import os
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import numpy as np

from mpmjax._types import Array
from mpmjax.native._library import CUDA_KERNELS, KERNELS, cuda_library, library

VARIABLE = "MPMJAX_BACKEND"


class AbstractBackend(eqx.Module):
    """Who evaluates functions on a platform: which kernels there are, of which arguments, and how XLA calls them."""

    reason: str  # why it is this one
    name: ClassVar[str]  # the name in MPMJAX_BACKEND and in reports
    platform: ClassVar[str]  # the platform of JAX, such as cpu
    prefix: ClassVar[str] = "mpmjax_"  # of the names that its kernels have in XLA's registry
    gains_from_order: ClassVar[bool] = False
    """Whether sorting particles by cell saves more time in its sums than it takes."""
    by_default: ClassVar[bool] = True  # whether it is taken without being asked for

    @staticmethod
    def absence() -> str:
        """Why it cannot be used here; empty if it can."""
        return ""

    @abstractmethod
    def has(self, kernel: str, arrays: Sequence[Any], *, basis: Any = None, **params: Any) -> bool:
        """Whether there is a kernel of this name for arrays of these shapes and dtypes, those of one member of a batch,
        and for the parameters of the function that it stands for; sums have a `basis`."""

    def call(
        self,
        kernel: str,
        operands: Sequence[Array | None],
        results: Sequence[jax.ShapeDtypeStruct],
        attributes: dict[str, Any],
        aliases: dict[int, int] | None = None,
    ) -> list[Array]:
        """The results of a kernel, called through XLA's foreign function interface by its name.

        Args:
            kernel: its name.
            operands: arrays, None for those that the kernel can do without; in a batch all have the same leading axes.
            results: their shapes and dtypes.
            attributes: numpy's arrays, and booleans.
            aliases: operands whose memory results may take, from their number to that of the result.
        """
        called = jax.ffi.ffi_call(self.prefix + kernel, list(results), input_output_aliases=aliases or {})
        told = {key: np.bool_(value) if isinstance(value, bool) else value for key, value in attributes.items()}
        present = np.array([a is not None for a in operands], np.int64)
        return list(called(*(a for a in operands if a is not None), **told, present=present))


class XLA(AbstractBackend):
    """The reference, which has no kernels: XLA compiles each function as it is written in JAX."""

    name = "xla"

    def has(self, kernel: str, arrays: Sequence[Any], *, basis: Any = None, **params: Any) -> bool:
        return False

    def __str__(self) -> str:
        return f"XLA ({self.reason})"


class Native(AbstractBackend):
    """Kernels in C++ for CPUs, on the threads of XLA: of arrays of single or double precision, and for sums of two to
    four nodes an axis."""

    name = "native"
    platform = "cpu"
    gains_from_order = True

    @staticmethod
    def absence() -> str:
        return library().reason

    def has(self, kernel: str, arrays: Sequence[Any], *, basis: Any = None, **params: Any) -> bool:
        if kernel == "stored":
            return len(arrays) > 0
        return kernel in KERNELS and _fits(arrays, basis)

    def __str__(self) -> str:
        handle = library().handle
        assert handle is not None
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            count = jax.ffi.ffi_call("mpmjax_threads", jax.ShapeDtypeStruct((), "int32"))
            threads = max(int(jax.jit(count)()), 1)
        instructions = handle.mpmjax_instructions().decode()
        return f"native, {instructions}, {threads} thread{'s' if threads != 1 else ''} ({self.reason})"


class Cuda(AbstractBackend):
    """Kernels in CUDA for NVIDIA's cards, compiled for each card by the NVRTC that JAX brings: the sums, transfers and
    decompositions of `Native`."""

    name = "cuda"
    platform = "cuda"
    by_default = False  # until it has run on a card

    @staticmethod
    def absence() -> str:
        return cuda_library().reason

    def has(self, kernel: str, arrays: Sequence[Any], *, basis: Any = None, **params: Any) -> bool:
        return kernel in CUDA_KERNELS and _fits(arrays, basis)

    def __str__(self) -> str:
        return f"CUDA ({self.reason})"


def _fits(arrays: Sequence[Any], basis: Any) -> bool:
    """Whether arrays have one precision, and a sum the limits of native/problems.h."""
    floats = {a.dtype for a in arrays if a.dtype not in (np.int32, np.bool_)}
    if len(floats) > 1 or not floats <= {np.dtype("float32"), np.dtype("float64")}:
        return False
    if basis is None:
        return True
    return max(len(basis.weights[0]), len(basis.slopes[0])) <= 9 and len(basis.knots) in (2, 3, 4)


BACKENDS: tuple[type[AbstractBackend], ...] = (Native, Cuda)
"""All of them but XLA, at most one a platform. Another one is a class here and its name in this tuple."""


def backend(platform: str | None = None) -> AbstractBackend:
    """Who sums between particles and nodes in what is compiled next, and why: `native`, compiled kernels for CPUs,
    `cuda`, kernels for NVIDIA's cards, or `xla`.

    The environment variable MPMJAX_BACKEND, one of these, chooses when a program is compiled; without it CPUs take
    theirs where these were built, and other devices XLA's. They differ by rounding.

    Args:
        platform: the platform of JAX, such as cpu or cuda. Default: that of the default device.

    Raises:
        ValueError: MPMJAX_BACKEND asks for what there is not.
    """
    asked, platform = os.environ.get(VARIABLE, ""), platform or jax.default_backend()
    if platform == "gpu" and "rocm" not in jax.devices()[0].client.platform_version.lower():
        platform = "cuda"  # its name in lowered programs
    names = [*(kind.name for kind in BACKENDS), XLA.name]
    if asked not in ("", *names):
        raise ValueError(f"{VARIABLE} must be {' or '.join(names)}, or not be set, got {asked!r}.")
    if asked == XLA.name:
        return XLA(f"{VARIABLE}=xla")
    for kind in BACKENDS:
        if kind.platform != platform or asked not in ("", kind.name):
            continue
        if not asked and not kind.by_default:
            return XLA(f"{kind.name} is on trial, taken with {VARIABLE}={kind.name}")
        absence = kind.absence()
        if absence and asked:
            raise ValueError(
                f"{VARIABLE}={asked} asks for the {asked} sums, but there is no library of them that can be used: "
                f"{absence}. Install mpmjax again where there is a C++ compiler, or unset {VARIABLE}."
            )
        if absence:
            return XLA(f"no {kind.name} library: {absence}")
        return kind(f"{VARIABLE}={asked}" if asked else "the default")
    return XLA(f"the device is a {platform}")
