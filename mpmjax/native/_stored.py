"""Arrays that a CPU stores where they are computed."""

from typing import Any

import jax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from mpmjax.native._library import target, uses_native
from mpmjax.native._primitive import is_divided


def stored(tree: Any) -> Any:
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
