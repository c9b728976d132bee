"""Loops whose steps are computed again in reverse mode, but for what is dear."""

from collections.abc import Callable
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

_KEPT, _SUMS = "mpmjax_kept", "mpmjax_sums"


def recomputed(step: Callable[..., Any], *, sums: bool = False) -> Callable[..., Any]:
    """The step of a `jax.lax.scan`, of which reverse mode stores what it starts from and what is `kept`. The rest is
    computed again, which takes less time than to store it and to read it back. With `sums`, where few steps are stored
    at once, `kept_sums` are too."""
    keep = jax.checkpoint_policies.save_only_these_names(_KEPT, *([_SUMS] if sums else []))
    return jax.checkpoint(step, prevent_cse=False, policy=keep)


def kept(tree: Any, name: str = _KEPT) -> Any:
    """The tree, its arrays not computed again in the steps of `recomputed`: the results of iterations."""
    return jax.tree.map(lambda leaf: checkpoint_name(leaf, name) if isinstance(leaf, jax.Array) else leaf, tree)


def kept_sums(tree: Any) -> Any:
    """The tree, its arrays sums over stencils, which may be stored."""
    return kept(tree, _SUMS)
