"""Names of JAX beyond its stable interface: all that the package touches, in one place.

Tried with jax 0.10.1, 0.11.2 and 0.12.0.1. `tests/test_imports.py` says that no other file imports such names, and that
each of these exists.
"""

from typing import Any

from jax.core import ShapedArray as ShapedArray, Tracer as Tracer
from jax.extend.core import Primitive as Primitive
from jax.interpreters.ad import (
    Zero as Zero,
    instantiate_zeros as instantiate_zeros,
    is_undefined_primal as is_undefined_primal,
    primitive_jvps as primitive_jvps,
    primitive_transposes as primitive_transposes,
)
from jax.interpreters.batching import primitive_batchers as primitive_batchers
from jax.interpreters.mlir import lower_fun as lower_fun, register_lowering as register_lowering


def is_divided(context: Any) -> bool:
    """Whether XLA divides the program that is being lowered, of a module context, among several devices."""
    axes = context.axis_context
    manual = getattr(axes, "manual_axes", None)
    if manual is None:
        return (getattr(axes, "num_devices", 1) or 1) > 1
    return set(manual) != set(axes.mesh.axis_names)
