"""Checks of what a user passes in: each raises a `ValueError` that says what must hold, what was got, what to do.

A value that is being traced has no number yet and is passed; the same value is checked when it is first written down.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer


def is_traced(tree: Any) -> bool:
    """Whether any leaf of the tree is a tracer, so that its value is not known yet."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def require(condition: Any, message: str) -> None:
    """Raise `ValueError(message)` unless the condition holds everywhere, or is not known yet."""
    if not is_traced(condition) and not np.all(condition):
        raise ValueError(message)


def require_finite(name: str, value: Any) -> None:
    """Every number of `value` must be finite."""
    if not is_traced(value) and not np.isfinite(np.asarray(value, dtype=float)).all():
        raise ValueError(f"{name} must be finite, got {value}.")  # written only here: writing an array takes ms


def require_positive(name: str, value: Any) -> None:
    """Every number of `value` must be finite and above zero."""
    require_finite(name, value)
    if not is_traced(value) and not (np.asarray(value) > 0).all():
        raise ValueError(f"{name} must be greater than zero, got {value}.")


def coordinates(name: str, point: Any) -> int:
    """How many coordinates a point has; it must be a plain sequence of them."""
    if isinstance(point, (tuple, list)):
        return len(point)
    require(np.ndim(point) == 1, f"{name} must be a sequence of numbers, one a direction, got {point}.")
    return len(point)


def require_between(name: str, value: Any, lower: float | int, upper: float | int, *, open_ends: bool = False) -> None:
    """Every number of `value` must lie in [lower, upper], or in (lower, upper) with `open_ends`."""
    require_finite(name, value)
    if not is_traced(value):
        a = np.asarray(value)
        inside = (a > lower) & (a < upper) if open_ends else (a >= lower) & (a <= upper)
        if not inside.all():
            words = f"strictly between {lower} and {upper}" if open_ends else f"from {lower} to {upper}"
            raise ValueError(f"{name} must be {words}, got {value}.")


def require_moduli(name: str, youngs_modulus: Any, poisson_ratio: Any) -> None:
    """E must be greater than zero and ν strictly between −1 and 0.5."""
    require_positive(f"{name}'s youngs_modulus [Pa]", youngs_modulus)
    require_between(f"{name}'s poisson_ratio", poisson_ratio, -1, 0.5, open_ends=True)


def canonical(tree: Any, dtype: Any) -> Any:
    """Make every number of the tree a strong array of one dtype.

    A Python float is static under `eqx.filter_jit`, so a new value would compile anew, and `eqx.tree_at` puts one past
    any converter; so this is applied at the entry of every public function that compiles.
    """

    def convert(leaf: Any) -> Any:
        if isinstance(leaf, (bool, np.bool_)) or not isinstance(leaf, (int, float, np.number, np.ndarray, jax.Array)):
            return leaf
        if isinstance(leaf, jax.Array) and leaf.dtype == dtype and not leaf.weak_type:
            return leaf
        if isinstance(leaf, jax.Array):
            return jax.lax.convert_element_type(leaf, dtype)
        return jnp.asarray(np.asarray(leaf, dtype))  # of a NumPy array: of a Python number XLA compiles a program

    return jax.tree.map(convert, tree)
