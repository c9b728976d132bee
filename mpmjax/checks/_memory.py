"""Memory: a check, before it is allocated, that it is available."""

import math
import os
from pathlib import Path

import jax

_UNKNOWN = 2**34
"""Memory assumed to be available if the system does not say [B]."""


def require_memory(what: str, needed: float | int, advice: str, *, device: bool = False) -> None:
    """Check that what will be allocated fits into the available memory.

    Args:
        what: what it is, as the subject of "takes at least so many GB".
        needed: how many bytes it takes at least.
        advice: which number to change.
        device: whether it lies on jax's device.

    Raises:
        ValueError: it does not.
    """
    if needed < 2**26:  # asking takes longer
        return
    there = available_memory(device=device)
    if not needed <= there:
        raise ValueError(
            f"{what} takes at least {_gigabytes(needed)} of memory, and {_gigabytes(there)} are available: {advice}"
        )


def available_memory(*, device: bool = False) -> float | int:
    """Memory that can be allocated [B]: of the host, within its control group's limit, or with `device` of jax's
    device."""
    stats = jax.local_devices()[0].memory_stats() if device else None  # None of a CPU, whose memory is the host's
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    return min(_free(), _within_limit())


def _free() -> int:
    try:
        entries = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        return 1024 * int(entries["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        pass
    try:
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return _UNKNOWN


def _within_limit() -> float | int:
    """Memory that the process's control group may still take [B]; the file cache counts as free."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = int((group / "memory.max").read_text()), int((group / "memory.current").read_text())
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return limit - used + int(stat.get("file", 0))
    except (OSError, ValueError):  # no such group, or no limit: "max"
        return math.inf


def _gigabytes(count: float | int) -> str:
    return f"{count / 1e9:.3g} GB"
