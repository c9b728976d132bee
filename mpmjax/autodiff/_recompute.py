"""Loops whose steps are computed again in reverse mode, but for what is dear."""

from collections.abc import Callable
from typing import Any

import jax
from jax.ad_checkpoint import checkpoint_name

_KEPT = "mpmjax_kept"


def recomputed(step: Callable[..., Any]) -> Callable[..., Any]:
    """The step of a `jax.lax.scan`, of which reverse mode stores what it starts from and what is `kept`. The rest is
    computed again, which takes less time than to store it and to read it back."""
    keep = jax.checkpoint_policies.save_only_these_names(_KEPT)
    return jax.checkpoint(step, prevent_cse=False, policy=keep)


def kept(tree: Any) -> Any:
    """The tree, its arrays not computed again in the steps of `recomputed`: the results of iterations."""
    return jax.tree.map(lambda leaf: checkpoint_name(leaf, _KEPT) if isinstance(leaf, jax.Array) else leaf, tree)
