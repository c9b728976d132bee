"""Functions of arrays as JAX primitives: on batches, by XLA, and on CPUs by the native library."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mpmjax._types import Array
from mpmjax.native._library import target, uses_native


def members(function: Callable[..., Any], batched: int) -> Callable[..., Any]:
    """The function mapped over `batched` leading axes."""
    for _ in range(batched):
        function = jax.vmap(function)
    return function


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """A compiled function that `jax.disable_jit` leaves compiled, as it does JAX's own primitives."""

    def call(*args: Array, **params: Any) -> Any:
        with jax.disable_jit(False):
            return function(*args, **params)

    return call


def native_primitive(
    name: str,
    function: Callable[..., list[Array]],
    shapes: Callable[..., list[tuple]],
    fits: Callable[..., bool],
    aliases: dict[int, int] | None = None,
    like: int = 1,
    workspace: Callable[..., tuple] | None = None,
    unread: tuple[int, ...] = (),
    **attributes: bool,
) -> Primitive:
    """A primitive that evaluates a function. In a batch all its arguments have as many leading axes as the batch.

    Args:
        name: name of the primitive; its second word is that in the native library.
        function: the function of arrays.
        shapes: the shapes of the results, as a function of the arguments.
        fits: whether the library has a kernel for arguments, given their shapes and dtypes and the batch's axes.
        aliases: arguments whose memory results may take, from their number to that of the result.
        like: the argument whose dtype results have.
        workspace: the shape of memory that the library's kernel works in, as a function of the arguments; None if it
            needs none.
        unread: numbers of arguments that the library is not given.
        attributes: what the library is told besides the primitive's parameters.
    """

    def run(*args: Array, batched: int, unroll: bool = False, **params: Any) -> list[Array]:
        return members(partial(function, unroll=unroll, **params), batched)(*args)

    def results(*args: ShapedArray, batched: int, **params: Any) -> list[ShapedArray]:
        batch = args[0].shape[:batched]
        return [ShapedArray((*batch, *shape), args[like].dtype) for shape in shapes(*args, **params)]

    def batch(args: tuple, axes: tuple, *, batched: int, **params: Any) -> tuple[list[Array], list[int]]:
        size = next(a.shape[x] for a, x in zip(args, axes, strict=True) if x is not None)
        args = tuple(batching.bdim_at_front(a, x, size) for a, x in zip(args, axes, strict=True))
        out = primitive.bind(*args, batched=batched + 1, **params)
        return out, [0] * len(out)

    def memory(*args: ShapedArray, batched: int, **params: Any) -> list[ShapedArray]:
        if workspace is None:
            return []
        return [ShapedArray((*args[0].shape[:batched], *workspace(*args, **params)), args[like].dtype)]

    primitive = Primitive(name)
    primitive.multiple_results = True
    static = ("batched", "unroll", "valued", "size")
    once = jax.jit(run, static_argnames=static)  # traced once for all its uses
    written = mlir.lower_fun(once, multiple_results=True)
    native = with_native(name.split("_")[1], written, fits, aliases or {}, memory, unread, **attributes)
    primitive.def_impl(_compiled(jax.jit(primitive.bind, static_argnames=static)))
    primitive.def_abstract_eval(results)
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(partial(once, unroll=True), multiple_results=True))
    mlir.register_lowering(primitive, native, platform="cpu")
    return primitive


def differentiable(primitive: Primitive, function: Callable[..., list[Array]]) -> Primitive:
    """A primitive with the derivative of the function that it evaluates, as that is written in JAX."""

    def jvp(primals: tuple, tangents: tuple, *, batched: int) -> tuple[list[Array], list[Array]]:
        floats = [k for k, primal in enumerate(primals) if jnp.issubdtype(primal.dtype, jnp.floating)]

        def written(*operands: Array) -> list[Array]:
            at = dict(zip(floats, operands, strict=True))
            return members(function, batched)(*(at.get(k, primal) for k, primal in enumerate(primals)))

        along = tuple(ad.instantiate_zeros(tangents[k]) for k in floats)
        return jax.jvp(written, tuple(primals[k] for k in floats), along)

    ad.primitive_jvps[primitive] = jvp
    return primitive


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
    has_kernel = index.dtype == np.int32 and weights.dtype in (np.float32, np.float64)
    same = all(aval.dtype == weights.dtype for aval in avals[1:])
    return has_kernel and same and d in (1, 2, 3) and s in (2, 3, 4)


def is_divided(context: Any) -> bool:
    """Whether XLA divides the program that is being lowered among several devices."""
    axes = context.axis_context
    manual = getattr(axes, "manual_axes", None)
    if manual is None:
        return (getattr(axes, "num_devices", 1) or 1) > 1
    return set(manual) != set(axes.mesh.axis_names)


def materialised(tree: Any) -> Any:
    """The tree as it is, its arrays stored in memory once. XLA would else compute them again, or read them out of what
    a loop has stored, in each number of each operation that takes them, which it then often cannot vectorise.

    It is a call that does nothing, in place, and costs a microsecond. The derivatives' arrays are stored too.
    """
    leaves, structure = jax.tree.flatten(tree)
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, jax.Array)]
    for i, array in zip(places, _stored_p.bind(*(leaves[i] for i in places)), strict=True):
        leaves[i] = array
    return jax.tree.unflatten(structure, leaves)


_stored_p = Primitive("stored")
_stored_p.multiple_results = True


@_stored_p.def_impl
@_stored_p.def_abstract_eval
def _same(*arrays: Any) -> list[Any]:
    return list(arrays)


def _some(changes: Any) -> list[Any]:
    """Tangents or cotangents, of which those that are not zero are stored."""
    places = [i for i, change in enumerate(changes) if type(change) is not ad.Zero]
    results = list(changes)
    for i, change in zip(places, _stored_p.bind(*(changes[i] for i in places)), strict=True):
        results[i] = change
    return results


def _lowered(ctx: Any, *arrays: Any) -> Any:
    if not arrays or not uses_native()[0] or is_divided(ctx.module_context):
        return arrays
    aliases = {i: i for i in range(len(arrays))}
    return jax.ffi.ffi_lowering(target("stored"), operand_output_aliases=aliases)(ctx, *arrays)


ad.primitive_jvps[_stored_p] = lambda primals, tangents: (_stored_p.bind(*primals), _some(tangents))
ad.primitive_transposes[_stored_p] = lambda cotangents, *_: _some(cotangents)
batching.primitive_batchers[_stored_p] = lambda arrays, axes: (_stored_p.bind(*arrays), list(axes))
mlir.register_lowering(_stored_p, lambda ctx, *arrays: arrays)
mlir.register_lowering(_stored_p, _lowered, platform="cpu")
