"""Derivative rules that hold in every nest of transformations.

Reverse mode splits a program into a known and a linear part, and there JAX replaces a function with a rule of
`jax.custom_jvp` by its code. The next derivative is then that of the code: of a solver's iteration, of an eigenvector
that has no derivative. A primitive is never replaced. `ruled` makes one of a
function:

    @ruled
    def f(x, y): ...

    @f.defjvp
    def _(primals, tangents):   # returns f(*primals) and its change
        ...

Arguments and results are pytrees. Their arrays are differentiated and batched; other leaves are fixed in the program.
Tangents that are zero are None, in the arguments and in the change. The change is differentiated again for the next
order, and transposed for reverse mode: it consists of operations that JAX transposes, or of functions that have a rule
for that too:

    @f.deftranspose
    def _(cotangent, args):   # of one result: the pytree of args with the cotangents of those that are None in it
        ...
"""

from collections.abc import Callable, Hashable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.dtypes import float0

from mpmjax._jax import (
    Primitive,
    ShapedArray,
    Zero,
    instantiate_zeros,
    is_undefined_primal,
    lower_fun,
    primitive_batchers,
    primitive_jvps,
    primitive_transposes,
    register_lowering,
)
from mpmjax._types import Array
from mpmjax.native import ranks_may_differ


class ruled:  # noqa: N801, a decorator
    """A function with a rule for its derivative."""

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self.jvp: Callable[..., Any] | None = None
        self.transpose: Callable[..., Any] | None = None
        self.__doc__, self.__name__, self.__module__ = function.__doc__, function.__name__, function.__module__

    def __repr__(self) -> str:
        return self.__name__

    def defjvp(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        """The rule of the derivative."""
        self.jvp = rule
        return rule

    def deftranspose(self, rule: Callable[..., Any]) -> Callable[..., Any]:
        """The transpose, by arguments in which the function is linear."""
        self.transpose = rule
        return rule

    def __call__(self, *args: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        fixed: tuple[Hashable, ...] = tuple(
            _ARRAY if isinstance(leaf, (jax.Array, np.ndarray)) else leaf for leaf in leaves
        )
        arrays = [jnp.asarray(leaf) for leaf, f in zip(leaves, fixed, strict=True) if f is _ARRAY]
        call = _Call(self, tree, fixed, tuple(map(type, fixed)))
        shapes = jax.eval_shape(partial(_evaluated, call), *arrays)
        return jax.tree.unflatten(jax.tree.structure(shapes), _ruled_p.bind(*arrays, call=call))


def without_derivative(tree: Any) -> Any:
    """The tree, its arrays and floats constants to derivatives; other leaves, as counts and functions, as they are."""
    kinds = (jax.Array, np.ndarray, np.floating, float)
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if isinstance(leaf, kinds) else leaf, tree)


_ARRAY: Hashable = object()


class _Call(NamedTuple):
    """The part of a call that is fixed in a program: everything but the arrays."""

    rule: ruled
    tree: Any
    fixed: tuple[Hashable, ...]
    """The leaves of the arguments, `_ARRAY` in the place of each array."""
    types: tuple[type, ...]
    """The types of these leaves: 1 and 1.0 are equal, but not the same program."""
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


def _evaluate(call: _Call, *arrays: Array) -> Any:
    def value(arrays: tuple[Array, ...]) -> Any:
        with ranks_may_differ():
            return call.rule.function(*call.args(arrays))

    for axes in call.mapped:
        value = jax.vmap(value, in_axes=(axes,))
    return value(arrays)


_evaluated = jax.jit(_evaluate, static_argnums=0)  # traced once for all its uses on arrays of the same shapes


def _values(*arrays: Array, call: _Call) -> list[Array]:
    return jax.tree.leaves(_evaluated(call, *arrays))


def _shapes(*arrays: ShapedArray, call: _Call) -> list[ShapedArray]:
    results = jax.tree.leaves(jax.eval_shape(partial(_evaluated, call), *arrays))
    return [ShapedArray(a.shape, a.dtype) for a in results]


def _batch(arrays: Sequence[Any], axes: Sequence[Any], *, call: _Call) -> tuple[list[Array], list[int]]:
    out = _ruled_p.bind(*arrays, call=call._replace(mapped=(*call.mapped, tuple(axes))))
    return out, [0] * len(out)


def _jvp(primals: Sequence[Any], tangents: Sequence[Any], *, call: _Call) -> tuple[list[Any], list[Any]]:
    moving = [type(t) is not Zero and t.dtype != float0 for t in tangents]
    rule = call.rule.jvp
    if rule is None:
        raise NotImplementedError(f"{call.rule.__name__} has no derivative.")

    def changed(primals: Sequence[Any], tangents: Sequence[Any]) -> tuple[list[Any], list[Any]]:
        remaining = iter(tangents)
        along = call.tangents([next(remaining) if m else None for m in moving])
        with ranks_may_differ():
            out, change = rule(call.args(primals), along)
        leaves, tree = jax.tree.flatten(out)
        return leaves, tree.flatten_up_to(change)

    for axes in call.mapped:
        changed = jax.vmap(changed, in_axes=(list(axes), [axis for axis, m in zip(axes, moving, strict=True) if m]))
    out, change = changed(list(primals), [t for t, m in zip(tangents, moving, strict=True) if m])
    zeros = [Zero(jax.typeof(a).to_tangent_aval()) for a in out]
    return out, [zero if c is None else c for c, zero in zip(change, zeros, strict=True)]


def _transpose(cotangents: Sequence[Any], *arrays: Any, call: _Call) -> list[Any]:
    linear = [is_undefined_primal(a) for a in arrays]
    rule = call.rule.transpose
    if rule is None:
        raise NotImplementedError(f"{call.rule.__name__} has no transpose.")

    def pulled(cotangent: Array, arrays: Sequence[Any]) -> list[Any]:
        remaining = iter(arrays)
        args = call.args([None if one else next(remaining) for one in linear])
        with ranks_may_differ():
            pulled = call.arrays(rule(cotangent, args))
        return [a for a, one in zip(pulled, linear, strict=True) if one]

    def over_axis(pulled: Callable[..., list[Any]], axes: Sequence[int | None]) -> Callable[..., list[Any]]:
        fixed = [axis for axis, one in zip(axes, linear, strict=True) if not one]
        wanted = [axis for axis, one in zip(axes, linear, strict=True) if one]
        mapped = jax.vmap(pulled, in_axes=(0, fixed), out_axes=[axis or 0 for axis in wanted])

        def summed(cotangent: Array, arrays: Sequence[Any]) -> list[Any]:
            """Sum over the members of the batch that share an array."""
            parts = zip(mapped(cotangent, arrays), wanted, strict=True)
            return [a.sum(axis=0) if axis is None else a for a, axis in parts]

        return summed

    for axes in call.mapped:
        pulled = over_axis(pulled, axes)
    fixed = [a for a, one in zip(arrays, linear, strict=True) if not one]
    results = iter(pulled(instantiate_zeros(cotangents[0]), fixed))
    return [next(results) if one else None for one in linear]


_ruled_p = Primitive("ruled")
_ruled_p.multiple_results = True
_ruled_p.def_impl(_values)
_ruled_p.def_abstract_eval(_shapes)
primitive_jvps[_ruled_p] = _jvp
primitive_transposes[_ruled_p] = _transpose
primitive_batchers[_ruled_p] = _batch
register_lowering(_ruled_p, lower_fun(_values, multiple_results=True))
