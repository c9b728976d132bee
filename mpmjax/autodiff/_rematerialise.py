"""Loops whose steps are computed again in reverse mode, but for what is dear."""

from collections.abc import Callable
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

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
