"""Who sums between particles and nodes on a CPU: the native library or XLA."""

import os
from typing import NamedTuple

import jax

from mpmjax.native._library import library

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
    found = library()
    if found.handle is None and asked == "native":
        raise ValueError(
            f"{VARIABLE}=native asks for the native sums, but there is no library of them that can be used: "
            f"{found.reason}. Install mpmjax again where there is a C++ compiler, or unset {VARIABLE}."
        )
    if found.handle is None:
        return False, f"no native library: {found.reason}"
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
