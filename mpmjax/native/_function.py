"""Functions of arrays that the native library may evaluate: one primitive of JAX, by XLA or by the library."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._jax import (
    Primitive,
    ShapedArray,
    Zero,
    instantiate_zeros,
    is_divided,
    lower_fun,
    primitive_batchers,
    primitive_jvps,
    primitive_transposes,
    register_lowering,
)
from mpmjax._types import Array
from mpmjax.native._library import target, uses_native

Shape = tuple[int, ...]


class NativeFunction:
    """A function of arrays, and of static parameters, that the library may evaluate in place of JAX.

    In a batch all its arguments have `batched` leading axes. A program that XLA itself divides among devices is left to
    XLA, which would gather whole arrays for a call that it cannot look into. Within `shard_map` each device calls.

    Args:
        name: its name, and that of its handler.
        written: the function in JAX, of one member of a batch: a list of results.
        shapes: the shapes of one member's results, as a function of arguments and parameters.
        fits: whether the library has a kernel, as a function of arguments, parameters and `batched`.
        like: the number of the argument whose dtype results have.
        native: the function by the library, of the whole batch, given `batched` too. Default: its handler is called.
        differentiable: whether its derivative is that of the function as written. Else its derivatives are `jvp` and
            `transpose`, which JAX calls with the parameters; None if it has none.
        unrolls: whether `written` is told to `unroll` loops: a few kernels are the fastest on a CPU, a single one on a
            GPU.
        aliases: arguments whose memory results may take, from their number to that of the result.
    """

    def __init__(
        self,
        name: str,
        written: Callable[..., list[Array]],
        shapes: Callable[..., list[Shape]],
        fits: Callable[..., bool],
        *,
        like: int = 0,
        native: Callable[..., list[Array]] | None = None,
        differentiable: bool = False,
        unrolls: bool = False,
        aliases: dict[int, int] | None = None,
    ):
        self.name, self.shapes, self.fits, self.like, self.unrolls = name, shapes, fits, like, unrolls
        self.written, self.native = written, native or partial(self._call, aliases=aliases)
        self.jvp: Callable[..., Any] | None = self._jvp_as_written if differentiable else None
        self.transpose: Callable[..., Any] | None = None

    def __repr__(self) -> str:
        return self.name

    def __call__(self, *args: Any, batched: int = 0, **params: Any) -> list[Array]:
        return native_p.bind(*args, function=self, params=tuple(sorted(params.items())), batched=batched)

    def of_members(self, batched: int, **params: Any) -> Callable[..., list[Array]]:
        """As written, mapped over leading axes."""
        function = partial(self.written, **params)
        for _ in range(batched):
            function = jax.vmap(function)
        return function

    def results(self, *args: Any, batched: int, **params: Any) -> list[tuple[Shape, Any]]:
        """Shapes and dtypes of the whole batch's results."""
        batch, dtype = args[0].shape[:batched], args[self.like].dtype
        return [((*batch, *shape), dtype) for shape in self.shapes(*args, **params)]

    def _call(self, *args: Array, batched: int, aliases: dict[int, int] | None, **params: Any) -> list[Array]:
        return call_library(self.name, args, self.results(*args, batched=batched, **params), params, aliases)

    def _jvp_as_written(self, primals: tuple, tangents: tuple, *, batched: int, **params: Any) -> Any:
        return jax.jvp(self.of_members(batched, **params), primals, tuple(map(instantiate_zeros, tangents)))


def call_library(
    name: str,
    args: Sequence[Array],
    results: Sequence[tuple[Shape, Any]],
    told: dict[str, Any],
    aliases: dict[int, int] | None = None,
) -> list[Array]:
    """Results, of given shapes and dtypes, of a handler of the library that is told its attributes: numpy's arrays, and
    booleans."""
    out = [jax.ShapeDtypeStruct(shape, dtype) for shape, dtype in results]
    called = jax.ffi.ffi_call(target(name), out, input_output_aliases=aliases or {})
    attributes = {key: np.bool_(value) if isinstance(value, bool) else value for key, value in told.items()}
    return list(called(*args, **attributes))


native_p = Primitive("native")
native_p.multiple_results = True
_static = ("function", "params", "batched")
ranks_may_differ = partial(jax.numpy_rank_promotion, "allow")
"""For rules, which JAX calls outside of the package's public functions, that allow it."""


def _run(*args: Array, function: NativeFunction, params: tuple, batched: int, unroll: bool = False) -> list[Array]:
    told = {"unroll": unroll} if function.unrolls else {}
    with ranks_may_differ():
        return function.of_members(batched, **dict(params), **told)(*args)


_once = jax.jit(_run, static_argnames=(*_static, "unroll"))  # traced once for all its uses
_compiled = jax.jit(native_p.bind, static_argnames=_static)


@native_p.def_impl
def _evaluate(*args: Array, **params: Any) -> list[Array]:
    with jax.disable_jit(False):  # compiled there too, as JAX's own primitives are
        return _compiled(*args, **params)


@native_p.def_abstract_eval
def _abstract(*args: Any, function: NativeFunction, params: tuple, batched: int) -> list[ShapedArray]:
    return [ShapedArray(*result) for result in function.results(*args, batched=batched, **dict(params))]


def _batch(args: tuple, axes: tuple, *, batched: int, **params: Any) -> tuple[list[Array], list[int]]:
    size = next(a.shape[x] for a, x in zip(args, axes, strict=True) if x is not None)
    pairs = zip(args, axes, strict=True)
    whole = (jnp.broadcast_to(a, (size, *jnp.shape(a))) if x is None else jnp.moveaxis(a, x, 0) for a, x in pairs)
    out = native_p.bind(*whole, batched=batched + 1, **params)
    return out, [0] * len(out)


def _jvp(primals: tuple, tangents: tuple, *, function: NativeFunction, params: tuple, batched: int) -> Any:
    if function.jvp is None:
        raise NotImplementedError(f"{function} has no derivative.")
    with ranks_may_differ():
        return function.jvp(primals, tangents, batched=batched, **dict(params))


def _transpose(cotangents: list, *args: Any, function: NativeFunction, params: tuple, batched: int) -> list:
    if function.transpose is None:
        raise NotImplementedError(f"{function} has no transpose.")
    with ranks_may_differ():
        return function.transpose(cotangents, *args, batched=batched, **dict(params))


def _on_cpu(ctx: Any, *args: Any, function: NativeFunction, params: tuple, batched: int) -> Any:
    told = {**dict(params), "batched": batched}
    if uses_native()[0] and not is_divided(ctx.module_context) and function.fits(*ctx.avals_in, **told):
        with ranks_may_differ():
            return lower_fun(partial(function.native, **told), multiple_results=True)(ctx, *args)
    written = partial(_once, function=function, params=params, batched=batched)
    return lower_fun(written, multiple_results=True)(ctx, *args)


primitive_batchers[native_p], primitive_jvps[native_p], primitive_transposes[native_p] = _batch, _jvp, _transpose
register_lowering(native_p, lower_fun(partial(_once, unroll=True), multiple_results=True))
register_lowering(native_p, _on_cpu, platform="cpu")


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
    places = [i for i, change in enumerate(changes) if type(change) is not Zero]
    results = list(changes)
    for i, change in zip(places, _stored_p.bind(*(changes[i] for i in places)), strict=True):
        results[i] = change
    return results


def _lowered(ctx: Any, *arrays: Any) -> Any:
    if not arrays or not uses_native()[0] or is_divided(ctx.module_context):
        return arrays
    aliases = {i: i for i in range(len(arrays))}
    return jax.ffi.ffi_lowering(target("stored"), operand_output_aliases=aliases)(ctx, *arrays)


primitive_jvps[_stored_p] = lambda primals, tangents: (_stored_p.bind(*primals), _some(tangents))
primitive_transposes[_stored_p] = lambda cotangents, *_: _some(cotangents)
primitive_batchers[_stored_p] = lambda arrays, axes: (_stored_p.bind(*arrays), list(axes))
register_lowering(_stored_p, lambda ctx, *arrays: arrays)
register_lowering(_stored_p, _lowered, platform="cpu")
