"""Contact with the walls of separating boxes, and friction along an axis of the grid."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector
from mpmjax.boundary._conditions import Conditions
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes


class WallContact(AbstractContact):
    """Separating walls at right angles to one axis. Each node at or beyond a wall is a place."""

    axis: int = eqx.field(static=True)
    """The axis."""
    side: NodeScalar
    """The inward normal's component along it, +1 or −1; 0 on nodes at no wall, shape (n,)."""
    coefficient: NodeScalar
    """Coulomb coefficient [-], shape (n,)."""

    @property
    def friction_order(self) -> float:
        return float(self.axis)

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> NodeScalar:
        """The velocity along the inward normal [m/s]."""
        del held
        return self.side * v[:, self.axis]

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        """The impulse along the inward normal [kg m/s]."""
        return self.side * held.impulse(residual)[:, self.axis]

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a velocity [m/s], and of a node's momentum [kg m/s], shape (n,)."""
        return noise, noise * held.unheld.mass

    def friction(self, held: ConstrainedNodes, active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        impulse = jnp.maximum(self.normal_impulse(held, residual), 0)
        return friction_across(held, self.axis, self.coefficient * jnp.where(active, impulse, 0), v)

    def fixed(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The component along the axis."""
        return active[:, None] & (jnp.arange(shape[1]) == self.axis)

    def owner(self, owners: Any) -> Int[Array, "n"]:
        return owners.side[:, self.axis]

    def blocked(self, held: ConstrainedNodes, v: NodeVector, noise: Array) -> Bool[Array, "n"] | None:
        """Nodes that a collider with the same normal drives off the wall, but cannot while the wall holds them."""
        colliders, part = held.unheld.conditions.colliders, held.nodes.free_normal
        if colliders is None or part is None:
            return None
        driven = (part.direction == 0).all(axis=1) & (
            (colliders.normal * (v - colliders.velocity)).sum(axis=1) < -noise
        )
        return driven & (self.side * colliders.normal[:, self.axis] > 0)


def wall_contacts(conditions: Conditions) -> tuple[WallContact, ...]:
    """The separating walls among a scene's conditions, one contact an axis."""
    side, friction = conditions.side, conditions.friction
    if side is None or friction is None:
        return ()
    return tuple(WallContact(a, side[:, a], friction[:, a]) for a in range(side.shape[1]))


def friction_across(held: ConstrainedNodes, axis: int, limit: NodeScalar, v: NodeVector) -> NodeVector:
    """The change of velocity by friction on walls at right angles to an axis [m/s], shape (n, d).

    Args:
        held: the nodes with an active set held.
        axis: the wall's normal.
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
        v: velocity of all nodes [m/s], shape (n, d).
    """
    mass, normal = held.mass, held.normal
    tangent = jnp.arange(v.shape[1]) != axis
    slip = jnp.where(tangent, v, 0)
    slip = slip if normal is None else slip - normal * (normal * slip).sum(axis=1, keepdims=True)
    square = (slip**2).sum(axis=1)
    speed = jnp.sqrt(jnp.where(square == 0, 1, square))
    share = jnp.minimum(limit / jnp.where(mass == 0, 1, mass) / speed, 1)
    free = tangent & ~held.unheld.conditions.fixed
    return -jnp.where(free & (square > 0)[:, None], share[:, None] * slip, 0)
