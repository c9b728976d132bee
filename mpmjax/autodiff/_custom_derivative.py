"""Functions with derivative rules that hold in every nest of transformations, and with kernels of back ends.

Reverse mode splits a program into a known and a linear part, and there JAX replaces a function with a rule of
`jax.custom_jvp` by its code. The next derivative is then that of the code: of a solver's iteration, of an eigenvector
that has no derivative. A primitive is never replaced. `custom_derivative` makes one of a function:

    @custom_derivative
    def f(x, y, *, n): ...

    @f.defjvp
    def _(primals, tangents, *, n):   # returns f(*primals, n=n) and its change
        ...

Arguments and results are pytrees. Their arrays are differentiated and batched; other leaves, and the parameters that
are passed by name, are fixed in the program. Tangents that are zero are None, in the arguments and in the change. The
change is differentiated again for the next order, and transposed for reverse mode: it consists of operations that JAX
transposes, or of functions that have a rule for that too:

    @f.deftranspose
    def _(cotangent, args, *, n):   # the pytree of args with the cotangents of those that are `is_unknown` in it
        ...

Rules are written for one member of a batch: `jax.vmap` maps the function, or its rule.

At the end: what a program stores, and what reverse mode computes again.
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.ad_checkpoint import checkpoint_name
from jax.dtypes import float0

from mpmjax import _jax
from mpmjax._types import Array
from mpmjax.native import BACKENDS, AbstractBackend, backend

Structs = Sequence[jax.ShapeDtypeStruct]
ranks_may_differ = partial(jax.numpy_rank_promotion, "allow")
"""For rules, which JAX calls outside of the package's public functions, that allow it."""


class custom_derivative:  # noqa: N801, a decorator
    """A function with rules for its derivative and its transpose, and with a kernel where a back end has one.

    A program that XLA itself divides among devices is left to XLA, which would gather whole arrays for a call that it
    cannot look into. Within `shard_map` each device calls.

    Args:
        function: the function in JAX.
        kernel: its name in back ends. Default: they have none.
        results: the shapes and dtypes of its results, as a function of arguments and parameters. Default: it is traced
            for them.
        call: the function by a back end: of `call(operands, attributes, results, aliases)`, which returns the results
            of a kernel as a list and is told those of one member, by default the function's; and of arrays that all
            have the leading axes of a batch. It returns None where there is no kernel. Default: the arguments are
            operands, the parameters attributes.
        aliases: operands of the default call whose memory results may take.
        unrolls: whether the function is told to `unroll` loops where it is not compiled for a CPU: a few kernels are
            the fastest there, a single one on a GPU.
        elementwise: whether results have the shapes of the arguments, one each, and axes do not matter.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        *,
        kernel: str | None = None,
        results: Callable[..., Any] | None = None,
        call: Callable[..., Any] | None = None,
        aliases: dict[int, int] | None = None,
        unrolls: bool = False,
        elementwise: bool = False,
    ):
        self.function, self.kernel, self.results, self.call, self.aliases = function, kernel, results, call, aliases
        self.unrolls, self.elementwise = unrolls, elementwise
        self.jvp: Callable[..., Any] | None = None
        self.transpose: Callable[..., Any] | None = None
        self.__doc__, self.__name__, self.__module__ = function.__doc__, function.__name__, function.__module__

    def __repr__(self) -> str:
        return self.kernel or self.__name__

    def defjvp(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        """The rule of the derivative."""
        self.jvp = rule
        return rule

    def deftranspose(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        """The transpose, by arguments in which the function is linear."""
        self.transpose = rule
        return rule

    def differentiated_as_written(self) -> "custom_derivative":
        """The function, its derivative that of its code."""
        self.jvp = partial(eqx.filter_jvp, self.function)
        return self

    def __call__(self, *args: Any, **params: Hashable) -> Any:
        leaves, tree = jax.tree.flatten(args)
        if self.kernel is not None:  # where JAX transposes a program, numbers that were arrays are plain ones
            leaves = [jnp.asarray(leaf) for leaf in leaves]
        kinds = jax.Array, np.ndarray, np.number, np.bool_
        fixed: tuple[Hashable, ...] = tuple(_ARRAY if isinstance(leaf, kinds) else leaf for leaf in leaves)
        arrays = [jnp.asarray(leaf) for leaf, f in zip(leaves, fixed, strict=True) if f is _ARRAY]
        call = _Call(self, tree, fixed, tuple(map(type, fixed)), tuple(sorted(params.items())))
        return jax.tree.unflatten(jax.tree.structure(call.results(arrays)), _custom_p.bind(*arrays, call=call))


def is_unknown(leaf: Any) -> bool:
    """Whether a transpose is asked for the cotangent of this argument, of which it is given shape and dtype."""
    return isinstance(leaf, jax.ShapeDtypeStruct)


def without_derivative(tree: Any) -> Any:
    """The tree, its arrays and floats constants to derivatives; other leaves, as counts and functions, as they are."""
    kinds = (jax.Array, np.ndarray, np.floating, float)
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, kinds) else leaf, tree)


_ARRAY: Hashable = object()


class _Call(NamedTuple):
    """The part of a call that is fixed in a program: everything but the arrays."""

    function: custom_derivative
    tree: Any
    fixed: tuple[Hashable, ...]  # the leaves of the arguments, `_ARRAY` in the place of each array
    types: tuple[type, ...]  # the types of these leaves: 1 and 1.0 are equal, but not the same program
    params: tuple[tuple[str, Hashable], ...]
    mapped: tuple[tuple[int | None, ...], ...] = ()
    """The mapped axes of the arrays for each `jax.vmap` around the call, the inner one first. Results are mapped along
    axis 0."""

    def args(self, arrays: Sequence[Any]) -> tuple[Any, ...]:
        """The arguments with these arrays in their places."""
        remaining = iter(arrays)
        return jax.tree.unflatten(self.tree, [next(remaining) if f is _ARRAY else f for f in self.fixed])

    def tangents(self, arrays: Sequence[Any]) -> tuple[Any, ...]:
        """The tangents of the arguments, from those of the arrays."""
        remaining = iter(arrays)
        return jax.tree.unflatten(self.tree, [next(remaining) if f is _ARRAY else None for f in self.fixed])

    def arrays(self, args: Any) -> list[Any]:
        """The leaves in the places of the arrays."""
        leaves = self.tree.flatten_up_to(args)
        return [leaf for leaf, f in zip(leaves, self.fixed, strict=True) if f is _ARRAY]

    def results(self, arrays: Sequence[Any]) -> Any:
        """The results' shapes and dtypes, for arrays of one member."""
        if self.function.results is not None:
            return self.function.results(*self.args(arrays), **dict(self.params))
        return jax.eval_shape(partial(_evaluated, self._replace(mapped=())), *arrays)

    def of_member(self, arrays: Sequence[Any]) -> tuple[tuple[int, ...], Structs]:
        """The size of the batch, and shapes and dtypes of one member's arrays."""
        shapes, batch = [list(np.shape(a)) for a in arrays], []
        for axes in reversed(self.mapped):
            taken = [shape.pop(axis) for shape, axis in zip(shapes, axes, strict=True) if axis is not None]
            batch.append(taken[0])
        dtypes = [a.dtype if hasattr(a, "dtype") else jnp.result_type(a) for a in arrays]
        return tuple(batch), [jax.ShapeDtypeStruct(*each) for each in zip(shapes, dtypes, strict=True)]

    def with_leading_axes(self, arrays: Sequence[Array]) -> list[Array]:
        """The arrays of the whole batch, with the mapped axes first, the outer one before the inner one."""
        batch, members = self.of_member(arrays)
        whole = list(arrays)
        for level, axes in enumerate(reversed(self.mapped)):
            pairs = zip(whole, axes, strict=True)
            whole = [jnp.expand_dims(a, level) if x is None else jnp.moveaxis(a, x + level, level) for a, x in pairs]
        return [jnp.broadcast_to(a, (*batch, *member.shape)) for a, member in zip(whole, members, strict=True)]


def _evaluate(call: _Call, *arrays: Array, unroll: bool = False) -> Any:
    if call.mapped:  # the outer axes first
        member = partial(_evaluate, call._replace(mapped=call.mapped[:-1]), unroll=unroll)
        return jax.vmap(member, in_axes=call.mapped[-1])(*arrays)
    told = dict(call.params) | ({"unroll": True} if unroll and call.function.unrolls else {})
    with ranks_may_differ():
        return call.function.function(*call.args(arrays), **told)


_evaluated = jax.jit(_evaluate, static_argnums=0, static_argnames="unroll")  # traced once for arrays of the same shapes


def _values(*arrays: Array, call: _Call, unroll: bool = False) -> list[Array]:
    return jax.tree.leaves(_evaluated(call, *arrays, unroll=unroll))


def _by_kernel(chosen: AbstractBackend, arrays: Sequence[Array], call: _Call) -> list[Array] | None:
    """The values by a back end, None where it has no kernel."""
    function, params = call.function, dict(call.params)
    batch, members = call.of_member(arrays)
    if function.kernel is None or not chosen.has(function.kernel, members, **params):
        return None
    kernel: str = function.kernel

    def called(
        operands: Sequence[Array | None],
        attributes: dict[str, Any],
        results: Structs | None = None,
        aliases: dict[int, int] | None = function.aliases,
    ) -> list[Array]:
        results = jax.tree.leaves(call.results(members)) if results is None else results
        whole = [jax.ShapeDtypeStruct((*batch, *a.shape), a.dtype) for a in results]
        return chosen.call(kernel, operands, whole, attributes, aliases)

    with ranks_may_differ():
        args = call.args(call.with_leading_axes(arrays))
        out = called(args, params) if function.call is None else function.call(called, *args, **params)
    return None if out is None else jax.tree.leaves(out)


def _lowered(platform: str, ctx: Any, *arrays: Any, call: _Call) -> Any:
    """By the back end of a platform, or as written."""

    def values(*arrays: Array) -> list[Array]:
        out = None if _jax.is_divided(ctx.module_context) else _by_kernel(backend(platform), arrays, call)
        return _values(*arrays, call=call, unroll=platform != "cpu") if out is None else out

    return _jax.lower_fun(values, multiple_results=True)(ctx, *arrays)


def _abstract(*arrays: _jax.ShapedArray, call: _Call) -> list[_jax.ShapedArray]:
    batch, members = call.of_member(arrays)
    return [_jax.ShapedArray((*batch, *a.shape), a.dtype) for a in jax.tree.leaves(call.results(members))]


def _batch(arrays: Sequence[Any], axes: Sequence[Any], *, call: _Call) -> tuple[list[Array], list[int | None]]:
    if call.function.elementwise:
        return _custom_p.bind(*arrays, call=call), list(axes)
    out = _custom_p.bind(*arrays, call=call._replace(mapped=(*call.mapped, tuple(axes))))
    return out, [0] * len(out)


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, call: _Call) -> tuple[list[Any], list[Any]]:
    moving = [type(t) is not _jax.Zero and t.dtype != float0 for t in tangents]
    rule = call.function.jvp
    if rule is None:
        raise NotImplementedError(f"{call.function} has no derivative.")
    if not any(moving):
        out = _custom_p.bind(*primals, call=call)
        return out, [_jax.Zero(jax.typeof(a).to_tangent_aval()) for a in out]

    def changed(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        remaining = iter(tangents)
        along = call.tangents([next(remaining) if m else None for m in moving])
        with ranks_may_differ():
            out, change = rule(call.args(primals), along, **dict(call.params))
        leaves, tree = jax.tree.flatten(out)
        return leaves, tree.flatten_up_to(change)

    for axes in call.mapped:
        changed = jax.vmap(changed, in_axes=(list(axes), [axis for axis, m in zip(axes, moving, strict=True) if m]))
    out, change = changed(list(primals), [t for t, m in zip(tangents, moving, strict=True) if m])
    zeros = [_jax.Zero(jax.typeof(a).to_tangent_aval()) for a in out]
    return out, [zero if c is None else c for c, zero in zip(change, zeros, strict=True)]


def _transpose(cotangents: Sequence[Any], *arrays: Any, call: _Call) -> list[Any]:
    wanted = [_jax.is_undefined_primal(a) for a in arrays]
    rule = call.function.transpose
    if rule is None:
        raise NotImplementedError(f"{call.function} has no transpose.")
    _, members = call.of_member([a.aval if one else a for a, one in zip(arrays, wanted, strict=True)])
    structure = jax.tree.structure(call.results(members))

    def pulled(cotangents: Sequence[Any], arrays: Sequence[Any]) -> list[Any]:
        remaining = iter(arrays)
        every = [struct if one else next(remaining) for struct, one in zip(members, wanted, strict=True)]
        with ranks_may_differ():
            out = rule(jax.tree.unflatten(structure, cotangents), call.args(every), **dict(call.params))
        return [a for a, one in zip(call.arrays(out), wanted, strict=True) if one]

    def over_axis(pulled: Callable[..., list[Any]], axes: Sequence[int | None]) -> Callable[..., list[Any]]:
        fixed = [axis for axis, one in zip(axes, wanted, strict=True) if not one]
        unknown = [axis for axis, one in zip(axes, wanted, strict=True) if one]
        mapped = jax.vmap(pulled, in_axes=(0, fixed), out_axes=[axis or 0 for axis in unknown])

        def summed(cotangents: Sequence[Any], arrays: Sequence[Any]) -> list[Any]:
            """Sum over the members of the batch that share an array."""
            parts = zip(mapped(cotangents, arrays), unknown, strict=True)
            return [a.sum(axis=0) if axis is None and a is not None else a for a, axis in parts]

        return summed

    for axes in call.mapped:
        pulled = over_axis(pulled, axes)
    single = len(cotangents) == 1
    whole = [_jax.instantiate_zeros(c) if single else None if type(c) is _jax.Zero else c for c in cotangents]
    fixed = [a for a, one in zip(arrays, wanted, strict=True) if not one]
    results = iter(pulled(whole, fixed))
    return [next(results) if one else None for one in wanted]


_custom_p = _jax.Primitive("custom")
_custom_p.multiple_results = True
_compiled = jax.jit(_custom_p.bind, static_argnames="call")


@_custom_p.def_impl
def _run(*arrays: Array, call: _Call) -> list[Array]:
    with jax.disable_jit(False):  # compiled there too, as JAX's own primitives are
        return _compiled(*arrays, call=call)


_custom_p.def_abstract_eval(_abstract)
_jax.primitive_jvps[_custom_p] = _jvp
_jax.primitive_transposes[_custom_p] = _transpose
_jax.primitive_batchers[_custom_p] = _batch
_jax.register_lowering(_custom_p, partial(_lowered, "others"))
for _platform in ("cpu", *(kernels.platform for kernels in BACKENDS)):
    _jax.register_lowering(_custom_p, partial(_lowered, _platform), platform=_platform)


def materialised(tree: Any) -> Any:
    """The tree as it is, its arrays stored in memory once. XLA would else compute them again, or read them out of what
    a loop has stored, in each number of each operation that takes them, which it then often cannot vectorise.

    It is a call that does nothing, in place, and costs a microsecond. The derivatives' arrays are stored too.
    """
    leaves, structure = jax.tree.flatten(tree)
    places = [i for i, leaf in enumerate(leaves) if isinstance(leaf, _jax.Tracer)]  # what is known is stored already
    for i, array in zip(places, _stored(*(leaves[i] for i in places)), strict=True):
        leaves[i] = array
    return jax.tree.unflatten(structure, leaves)


def _some_stored(changes: Sequence[Any]) -> list[Any]:
    """Tangents or cotangents, of which those that are not None are stored."""
    stored = iter(_stored(*(a for a in changes if a is not None)))
    return [None if a is None else next(stored) for a in changes]


_stored = custom_derivative(
    lambda *arrays: list(arrays),
    kernel="stored",
    results=lambda *arrays: list(arrays),
    call=lambda call, *arrays: call(arrays, {}, aliases={i: i for i in range(len(arrays))}),
    elementwise=True,
)
_stored.defjvp(lambda primals, tangents: (_stored(*primals), _some_stored(tangents)))
_stored.deftranspose(lambda cotangents, args: (*_some_stored(cotangents),))


_SAVED, _SUMS = "mpmjax_saved", "mpmjax_sums"


def rematerialised(step: Callable[..., Any], *, sums: bool = False) -> Callable[..., Any]:
    """The step of a `jax.lax.scan`, of which reverse mode stores what it starts from and what is `saved_for_backward`.
    The rest is computed again, which takes less time than to store it and to read it back. With `sums`, where few steps
    are stored at once, sums are too."""
    names = (_SAVED, *([_SUMS] if sums else []))
    return jax.checkpoint(step, prevent_cse=False, policy=jax.checkpoint_policies.save_only_these_names(*names))


def saved_for_backward(tree: Any, *, sums: bool = False) -> Any:
    """The tree, its arrays not computed again in the steps of `rematerialised`: the results of iterations, or sums over
    stencils, which may be stored."""
    name = _SUMS if sums else _SAVED
    return jax.tree.map(lambda leaf: checkpoint_name(leaf, name) if isinstance(leaf, jax.Array) else leaf, tree)
