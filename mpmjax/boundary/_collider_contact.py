"""Contact with separating colliders."""

from typing import Any, ClassVar

import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, NodeScalar, NodeVector
from mpmjax.boundary._conditions import Conditions
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes


class ColliderContact(AbstractContact):
    """The separating colliders of a scene. Each node in one of them is a place."""

    leavable: Bool[Array, "n"]
    """Nodes in a separating collider, shape (n,)."""
    normal: NodeVector
    """Unit normal out of it, shape (n, d)."""
    velocity: NodeVector
    """Its velocity there [m/s], shape (n, d)."""
    coefficient: NodeScalar | None
    """Coulomb coefficient there [-], shape (n,)."""
    of_collider: ClassVar[bool] = True

    @property
    def friction_order(self) -> float:
        return 3.0

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> NodeScalar:
        """The velocity out of the collider, relative to it [m/s]; zero where the normal has no free part, what is
        prescribed leaving the collider nothing to hold."""
        departure = (self.normal * (v - self.velocity)).sum(axis=1)
        return jnp.where(self.leavable & (held.nodes.free_normal.direction != 0).any(axis=1), departure, 0)

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        """The impulse along the normal [kg m/s]."""
        impulse = held.collider_impulse(residual)
        assert impulse is not None
        return impulse

    def friction(self, held: ConstrainedNodes, active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        """−min(1, μ r / (m ‖s‖)) s with the slip s = Q (v − v_c), r the normal impulse and v_c the collider's
        velocity."""
        if self.coefficient is None:
            return jnp.zeros_like(v)
        mass = held.nodes.mass
        slip = held.nodes.projection.combine(v - self.velocity, 0)
        square = (slip**2).sum(axis=1)
        slides = active & (square > 0) & (mass > 0)
        limit = self.coefficient * jnp.maximum(self.normal_impulse(held, residual), 0)
        stopping = mass * jnp.sqrt(jnp.where(slides, square, 1))
        share = jnp.where(slides, jnp.minimum(limit / jnp.where(slides, stopping, 1), 1), 0)
        return -share[:, None] * slip

    def owner(self, owners: Any) -> Int[Array, "n"]:
        return owners.collider

    def normals(self, active: Array) -> Bool[Array, "n"]:
        return active


def collider_contacts(conditions: Conditions) -> tuple[ColliderContact, ...]:
    """The separating colliders among a scene's conditions, as one contact: where normals of two meet, the earlier one's
    is held."""
    touched = conditions.colliders
    if touched is None or touched.leavable is None:
        return ()
    return (ColliderContact(touched.leavable, touched.normal, touched.velocity, touched.friction),)
