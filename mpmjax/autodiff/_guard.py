"""The guard: an identity that raises if a number says that there is a fault.

A check on the outcome of a program is removed with the outcome if only a derivative of it is used. This one is an
operation of its own, linear in what it guards: its tangent guards the tangents and its transpose the cotangents, by the
same number, so that no derivative of what is guarded can be had without the check.

Beside a fault, which is known, it takes a *signal*: a zero whose tangent or cotangent is not zero where a derivative
went wrong on its way (see `Reporting`).
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import _jax
from mpmjax._types import Array, Float, Int


def guard(
    tree: Any, signal: Float[Array, ""], fault: Int[Array, ""], faults: Sequence[str], failure: str
) -> tuple[Any, Float[Array, ""]]:
    """The tree and the signal as they are. In jit, grad, jvp, vmap and all that is made of them a `RuntimeError` is
    raised where a fault is met and any of the tree or of its derivative is used.

    Args:
        tree: what is guarded; its arrays.
        signal: a zero that is differentiable.
        fault: 0, or the number, from one, of what is at fault.
        faults: what is said of each.
        failure: what is said where the signal's tangent or cotangent is not zero; its largest value is added where it
            is known.
    """
    arrays, rest = eqx.partition(tree, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    *leaves, signal = _guard_p.bind(*leaves, signal, fault, faults=tuple(faults), failure=failure, derivative=False)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest), signal


_guard_p = _jax.Primitive("guard")
_guard_p.multiple_results = True


@_guard_p.def_impl
def _evaluate(*operands: Any, faults: tuple[str, ...], failure: str, derivative: bool) -> list[Any]:
    """Raise at once, as the numbers are known."""
    if (worst := np.max(operands[-1])) > 0:
        raise RuntimeError(faults[int(worst) - 1])
    if derivative and not np.all(np.asarray(signal := operands[-2]) == 0):
        raise RuntimeError(f"{failure} The relative residual was {np.max(np.abs(signal)):.2g}.")
    return list(operands[:-1])


@_guard_p.def_abstract_eval
def _abstract(*operands: Any, **_: Any) -> list[Any]:
    return list(operands[:-1])


def _compiled(*operands: Any, faults: tuple[str, ...], failure: str, derivative: bool) -> list[Any]:
    """Check once, by one number on which each leaf then depends."""
    *leaves, signal, fault = operands
    if not faults and not derivative:
        return [*leaves, signal]
    index = jnp.max(fault)
    if derivative:
        index = jnp.where((index == 0) & (signal != 0).any(), len(faults) + 1, index)

    def fail(index: Any) -> Any:
        raise RuntimeError((*faults, failure)[int(index) - 1])

    def called() -> Any:  # what JAX says of it ends with this line; `equinox.error_if` adds a page after its own
        return jax.pure_callback(fail, jax.ShapeDtypeStruct((), bool), index)

    raised = jax.lax.cond(index > 0, called, lambda: jnp.asarray(False))

    def unusable(dtype: Any) -> Any:
        if jnp.issubdtype(dtype, jnp.inexact):
            return np.nan
        return True if jnp.issubdtype(dtype, jnp.bool_) else jnp.iinfo(dtype).max

    return [*(jnp.where(raised, jnp.full_like(a, unusable(a.dtype)), a) for a in leaves), signal]


_jax.register_lowering(_guard_p, _jax.lower_fun(_compiled, multiple_results=True))


def _differentiated(primals: Any, tangents: Any, *, derivative: bool, **parameters: Any) -> Any:
    """Guard the tangents that are not zero. The signal's tangent is always made an array, so that a cotangent can
    pass."""
    out = _guard_p.bind(*primals, derivative=derivative, **parameters)
    return out, _guarded(tangents[:-1], primals[-1], derivative=True, **parameters)


def _guarded(changes: Any, fault: Any, **parameters: Any) -> list[Any]:
    """Tangents or cotangents of leaves and signal, guarded."""
    *leaves, signal = changes
    places = [i for i, change in enumerate(leaves) if type(change) is not _jax.Zero]
    if not places:
        return [*leaves, signal]
    *some, signal = _guard_p.bind(*(leaves[i] for i in places), _jax.instantiate_zeros(signal), fault, **parameters)
    for i, change in zip(places, some, strict=True):
        leaves[i] = change
    return [*leaves, signal]


_jax.primitive_jvps[_guard_p] = _differentiated


_jax.primitive_transposes[_guard_p] = lambda cotangents, *operands, **parameters: [
    *_guarded(cotangents, operands[-1], **parameters),
    None,
]


def _batched(operands: Any, axes: Any, **parameters: Any) -> tuple[list[Any], list[Any]]:
    """Raise for the whole batch if one member has a fault: all numbers of signal and fault are looked at anyway."""
    return _guard_p.bind(*operands, **parameters), list(axes[:-1])


_jax.primitive_batchers[_guard_p] = _batched
