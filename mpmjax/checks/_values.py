"""Checks of what a user passes in: each raises a `ValueError` that says what must hold, what was got, what to do.

A value that is being traced has no number yet, and its check is put off. A module states what must hold of its values
once, in its `__check_init__`. A constructor checks there what is known; `requirements` runs the same statements again
and returns those that were put off, for a compiled program to evaluate.
"""

import math
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass, field, fields, is_dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np

from mpmjax._jax import Tracer
from mpmjax._tables import shortened, within

_UNKNOWN = 2**34  # memory assumed to be available if the system does not say [B]


class InputError(ValueError):
    """A `ValueError` of what a user passes in. It ends with its own line within `jax.jit` too."""

    def add_note(self, note: str, /) -> None:
        if "JAX_TRACEBACK_FILTERING" not in note:  # else JAX's, on frames of its own, would be what one reads
            super().add_note(note)


def is_traced(tree: Any) -> bool:
    """Whether any leaf of the tree is a tracer, so that its value is not known yet."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


class Requirement(NamedTuple):
    """A requirement on values that are being traced."""

    message: str
    met: Callable[[], Any]  # computes bools that are all true if it is met


# The list in which `requirements` collects; None outside of it, where checks of unknown values are skipped.
_put_off: ContextVar[list[Requirement] | None] = ContextVar("_put_off", default=None)


def requirements(tree: Any) -> list[Requirement]:
    """The requirements of the modules in a tree on their traced values, in a fixed order; a ValueError if one on
    values that are known is not met, as `equinox.tree_at` can make it."""
    gathered: list[Requirement] = []
    token = _put_off.set(gathered)
    try:
        for module in _modules(tree):
            for kind in type(module).__mro__:
                if "__check_init__" in vars(kind):
                    vars(kind)["__check_init__"](module)
    finally:
        _put_off.reset(token)
    return gathered


def first_unmet(required: list[Requirement]) -> jax.Array:
    """The number, from one, of the first requirement that is not met; zero if all are."""
    met = jnp.stack([jnp.all(requirement.met()) for requirement in required])
    return jnp.where(met.all(), 0, 1 + jnp.argmin(met)).astype(jnp.int32)


def _modules(tree: Any) -> Iterator[Any]:
    """The dataclass instances in a tree, each after those in it."""
    if isinstance(tree, (tuple, list)):
        for entry in tree:
            yield from _modules(entry)
    elif is_dataclass(tree) and not isinstance(tree, type):
        for field in fields(tree):
            yield from _modules(getattr(tree, field.name))
        yield tree


def require(condition: Any, message: str) -> None:
    """Raise `ValueError(message)` unless the condition holds everywhere; traced ones wait for `requirements`."""
    if is_traced(condition):
        if (gathered := _put_off.get()) is not None:
            gathered.append(Requirement(message, lambda: condition))
    elif not np.all(condition):
        raise InputError(message)


def require_that(what: str, holds: Callable[..., Any], *values: Any) -> None:
    """Raise `ValueError` unless a condition on the arrays of some values holds everywhere, which `what` says in
    words. It is made of operators and methods that NumPy's and JAX's arrays have both."""
    if is_traced(values):
        if (gathered := _put_off.get()) is not None:
            gathered.append(Requirement(f"{what}.", lambda: holds(*map(jnp.asarray, values))))
    elif not np.all(holds(*map(np.asarray, values))):  # written only here: writing an array takes ms
        raise InputError(f"{what}, got {' and '.join(shortened(str(value)) for value in values)}.")


def warn(message: str) -> None:
    """Give a Python warning, at the line from which the package was called."""
    level, frame = 1, sys._getframe()
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in ("mpmjax", "equinox", "jaxtyping"):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, stacklevel=level)


def as_floats(value: Any) -> Any:
    """An array of floats, NaN where it is masked; what holds no real numbers stays, for `require_fields` to refuse."""
    try:
        array = np.ma.asanyarray(value)
    except (TypeError, ValueError):  # of a tracer; of rows that differ in length
        return value
    return np.ma.filled(array.astype(float), np.nan) if array.dtype.kind in "iuf" else value


def as_plain(value: Any) -> Any:
    """A list or array as a tuple of Python's numbers or as a number, which can fix a program; all else as it is."""
    if isinstance(value, (np.ndarray, np.generic, jax.Array)) and not is_traced(value):
        value = value.tolist()
    return tuple(value) if isinstance(value, list) else value


def require_placement(tree: Any) -> None:
    """Refuse arrays that carry placements which neither loops nor compiled sums support: manual axes over which they
    vary, as within a `jax.shard_map` that checks them, or explicit axes over which they are divided."""
    for leaf in jax.tree.leaves(tree):
        while isinstance(leaf, jax.Array):
            kind = jax.typeof(leaf)
            axes = getattr(kind, "manual_axis_type", None)
            if getattr(axes, "varying", getattr(kind, "vma", None)):  # the name from jax 0.10 on, and the older one
                raise InputError("A jax.shard_map must not check over which axes arrays vary: give it check_vma=False.")
            if any(axis is not None for axis in getattr(kind.sharding, "spec", ())):
                raise InputError(
                    "Arrays must not be divided over explicit axes: make the mesh of axes of the kind "
                    "jax.sharding.AxisType.Auto, or divide them within jax.shard_map(..., check_vma=False)."
                )
            leaf = getattr(leaf, "val", getattr(leaf, "primal", None))  # the array within a batch or a tangent


def require_tolerance(name: str, value: Any) -> None:
    """Check that a relative tolerance is positive; warn of one that any guess meets."""
    require_positive(name, value)
    if not is_traced(value) and np.any(np.asarray(value) >= 1):
        warn(
            f"{name} is {shortened(str(value))}: at 1 or more the zero vector already meets it, so nothing is solved. "
            "Take 1e-2 or less."
        )


def require_finite(name: str, value: Any) -> None:
    """Every number of `value` must be finite."""
    require_that(f"{name} must be finite", lambda a: abs(a.astype(float)) < np.inf, value)


def require_positive(name: str, value: Any, dtype: Any = None) -> None:
    """Every number of `value` must be finite and above zero; with a dtype, in that precision."""
    require_finite(name, value)
    if dtype is None:
        require_that(f"{name} must be greater than zero", lambda a: a > 0, value)
    else:
        least = float(jnp.finfo(dtype).tiny)
        require_that(f"{name} must be greater than zero in {jnp.dtype(dtype)}", lambda a: a >= least, value)


def require_whole(name: str, value: Any, least: int) -> int:
    """A number must be whole, known and at least so large; it may be an array's."""
    if is_traced(value):
        raise InputError(f"{name} must be a known number, not a traced one.")
    a = np.asarray(value, dtype=float)
    if not (a.ndim == 0 and np.isfinite(a) and a == np.rint(a) and a >= least):
        raise InputError(f"{name} must be a whole number of at least {least}, got {shortened(str(value))}.")
    return int(value)


def coordinates(name: str, point: Any) -> int:
    """How many coordinates a point has, one to three; it must be a plain sequence of them."""
    plain = isinstance(point, (tuple, list)) or np.ndim(point) == 1
    if not (plain and 1 <= len(point) <= 3):
        raise InputError(
            f"{name} must be a sequence of one to three numbers, one a direction, got {shortened(str(point))}."
        )
    return len(point)


@dataclass(frozen=True)
class Mark:
    """A condition in an annotation (see `require_fields`), which signatures show by its words."""

    words: str  # what must hold
    check: Callable[[str, Any], object]  # raises a ValueError for a name and a value that does not meet it
    bounds: dict[str, float | int] = field(default_factory=dict, compare=False)  # of numbers, named as in JSON schemas

    def __call__(self, name: str, value: Any) -> None:
        self.check(name, value)

    def __repr__(self) -> str:
        return self.words


finite, positive = Mark("finite", require_finite), Mark("greater than zero", require_positive, {"exclusiveMinimum": 0})
tolerance = Mark("a relative tolerance greater than zero", require_tolerance, {"exclusiveMinimum": 0})


def between(lower: float | int, upper: float | int, *, open_ends: bool = False) -> Mark:
    """The mark of numbers in [lower, upper], or in (lower, upper) with `open_ends`."""
    words = f"from {lower} to {upper}" if upper < math.inf else f"at least {lower}"
    words = f"strictly between {lower} and {upper}" if open_ends else words
    names = ("exclusiveMinimum", "exclusiveMaximum") if open_ends else ("minimum", "maximum")
    bounds = {name: end for name, end in zip(names, (lower, upper), strict=True) if abs(end) < math.inf}

    def check(name: str, value: Any) -> None:
        require_finite(name, value)
        require_that(f"{name} must be {words}", lambda a: within(a, bounds), value)

    return Mark(words, check, bounds)


def whole(least: int) -> Mark:
    """The mark of numbers that `require_whole` takes."""
    return Mark(f"a whole number of at least {least}", partial(require_whole, least=least), {"minimum": least})


def canonical(tree: Any, dtype: Any) -> Any:
    """Make every number of the tree a strong array of one dtype.

    A Python float is static under `eqx.filter_jit`, so a new value would compile anew, and `eqx.tree_at` puts one past
    any converter; so this is applied at the entry of every public function that compiles. The whole numbers of a linear
    solver are counts, which fix its program, and stay.
    """

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, lx.AbstractLinearSolver):
            return jax.tree.map(lambda a: a if isinstance(a, int) else convert(a), leaf)
        if isinstance(leaf, (bool, np.bool_)) or not isinstance(leaf, (int, float, np.number, np.ndarray, jax.Array)):
            return leaf
        if isinstance(leaf, jax.Array) and leaf.dtype == dtype and not leaf.weak_type:
            return leaf
        if isinstance(leaf, jax.Array):
            return jax.lax.convert_element_type(leaf, dtype)
        return jnp.asarray(np.asarray(leaf, dtype), dtype)  # else JAX compiles a program for it

    return jax.tree.map(convert, tree, is_leaf=lambda node: isinstance(node, lx.AbstractLinearSolver))


def require_memory(what: str, needed: float | int, advice: str, *, device: bool = False) -> None:
    """Raise a `ValueError` if `needed` bytes are more than the available memory of jax's `device` or the host. `what`
    is the subject of "takes at least so many GB", `advice` says which number to change."""
    if needed < 2**26:  # asking takes longer
        return
    there = available_memory(device=device)
    if not needed <= there:
        raise InputError(
            f"{what} takes at least {needed / 1e9:.3g} GB of memory, and {there / 1e9:.3g} GB are available: {advice}"
        )


def available_memory(*, device: bool = False) -> float | int:
    """Memory that can be allocated [B]: of jax's `device`, or of the host within its control group's limit."""
    stats = jax.local_devices()[0].memory_stats() if device else None  # None of a CPU, whose memory is the host's
    if stats and "bytes_limit" in stats:
        return stats["bytes_limit"] - stats.get("bytes_in_use", 0)
    free, limit, group = _UNKNOWN, math.inf, Path("/sys/fs/cgroup")
    try:
        free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        entries = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = 1024 * int(entries["MemAvailable"].split()[0])  # with caches that can be dropped
    except (AttributeError, OSError, KeyError, ValueError):
        pass
    try:
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        most, used = int((group / "memory.max").read_text()), int((group / "memory.current").read_text())
        limit = most - used + int(stat.get("file", 0))  # the file cache counts as free
    except (OSError, ValueError):  # no such group, or no limit: "max"
        pass
    return min(free, limit)
