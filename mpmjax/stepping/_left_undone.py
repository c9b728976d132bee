"""The part of the elastic force that an implicit step leaves undone."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector


class LeftUndone(eqx.Module):
    """The difference between the elastic force that moved the nodes and the law's force for the same displacement: from
    the linearisation of one linear solve, and from the return maps of laws that yield, which follow the solve."""

    force: Float[Array, "*f"]
    """The norm of the difference over all nodes, held ones too [N]."""
    scale: Float[Array, "*f"]
    """The largest of four such norms [N]: of the two forces, of the force at the start, and of the nodes' momentum over
    Δt. The momentum of what yields counts only by its rounding, √ε of it."""

    @property
    def part(self) -> Float[Array, "*f"]:
        """The force over its scale [-], zero if both are."""
        return self.force / jnp.where(self.scale == 0, 1, self.scale)


def nothing_left_undone(dtype: Any) -> LeftUndone:
    """Of a step whose force is that of the law."""
    return LeftUndone(jnp.zeros((), dtype), jnp.zeros((), dtype))


def norm(a: NodeVector) -> Float[Array, ""]:
    """The Euclidean norm over all nodes."""
    return jnp.sqrt((a**2).sum())
