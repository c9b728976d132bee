"""What one linear solve leaves undone."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector


class LeftUndone(eqx.Module):
    """What the linearisation of a step leaves undone: how far the elastic force that moved the nodes, linear in their
    displacement, is from that of the law for the same displacement."""

    force: Float[Array, "*f"]
    """The norm of the difference over all nodes, held ones too [N]."""
    scale: Float[Array, "*f"]
    """The largest of four such norms [N]: of the two forces, of the force at the start, and of the nodes' momentum over
    Δt."""

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
