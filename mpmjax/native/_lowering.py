"""How JAX lowers a primitive to a call of the native library."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import ShapedArray

from mpmjax.native._backend import uses_native
from mpmjax.native._library import target

_Rule = Callable[..., Any]


def with_native(
    name: str,
    written: _Rule,
    fits: Callable[..., bool],
    aliases: dict[int, int],
    memory: Callable[..., list[ShapedArray]],
    unread: tuple[int, ...] = (),
    **attributes: bool,
) -> _Rule:
    """The lowering rule for CPUs of a primitive: a call of the native library where it has a kernel, else as written.

    A program that XLA itself divides among devices is left to XLA, which would gather whole arrays for a call that it
    cannot look into. Within `shard_map` each device calls.

    Args:
        name: name in the library.
        written: lowering rule of the function written in JAX.
        fits: whether the library has a kernel for arguments, given their shapes and dtypes and the batch's axes.
        aliases: arguments whose memory results may take.
        memory: arrays that the kernel works in, as a function of its arguments and parameters. It is given them as
            further results, whose memory XLA then keeps from step to step.
        unread: numbers of arguments that the kernel is not given.
        attributes: what the library is told besides.
    """

    def rule(ctx: Any, *args: Any, **params: Any) -> Any:
        avals = ctx.avals_in
        if not uses_native()[0] or not fits(avals, params["batched"]) or is_divided(ctx.module_context):
            return written(ctx, *args, **params)
        told = {"valued": np.bool_(params["valued"])} if "valued" in params else {}
        told |= {name: np.bool_(value) for name, value in attributes.items()}
        results = len(ctx.avals_out)
        read = [k for k in range(len(args)) if k not in unread]
        args = tuple(args[k] for k in read)
        out = [*ctx.avals_out, *memory(*avals, **params)]
        ctx = ctx.replace(avals_in=[avals[k] for k in read], avals_out=out)
        return jax.ffi.ffi_lowering(target(name), operand_output_aliases=aliases)(ctx, *args, **told)[:results]

    return rule


def sums_fit(avals: Any, batched: int) -> bool:
    """Whether the library has a kernel for sums of these: index factors, weights, and others of the weights' dtype."""
    index, weights = avals[:2]
    d, s, _ = index.shape[batched:]
    known = index.dtype == np.int32 and weights.dtype in (np.float32, np.float64)
    same = all(aval.dtype == weights.dtype for aval in avals[1:])
    return known and same and d in (1, 2, 3) and s in (2, 3, 4)


def is_divided(context: Any) -> bool:
    """Whether XLA divides the program that is being lowered among several devices."""
    axes = context.axis_context
    manual = getattr(axes, "manual_axes", None)
    if manual is None:
        return (getattr(axes, "num_devices", 1) or 1) > 1
    return set(manual) != set(axes.mesh.axis_names)
