"""The conditions of boundaries on the nodes: prescribed velocities, and those of colliders."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeVector, Scalar
from mpmjax.geometry import Motion


class ColliderConditions(eqx.Module):
    """The conditions of k colliders on the nodes that lie in them."""

    normal: NodeVector
    """Unit normal out of the collider that holds the node along it, shape (n, d); zero where none does."""
    velocity: NodeVector
    """Velocity of that collider there [m/s], shape (n, d)."""
    held: Bool[Array, "n"]
    """Whether the normal component of the node's velocity is held, shape (n,)."""
    owner: Int[Array, "n"]
    """Number of that collider, −1 for none, shape (n,)."""
    holder: Int[Array, "n d"]
    """Number of the collider that prescribes each component, −1 for none, shape (n, d)."""
    position: NodeVector
    """Where the nodes are [m], shape (n, d): in the total description those that are held have moved with the body."""
    pivots: Float[Array, "k d"]
    """The points about which the colliders' torques are taken [m], shape (k, d)."""
    pivot_velocity: Float[Array, "k d"]
    """Their velocity [m/s], shape (k, d)."""
    slides: bool = eqx.field(static=True, default=False)
    """Whether there is a body along which nodes slide."""

    def beside(self, later: "ColliderConditions") -> "ColliderConditions":
        """Both conditions; where two normals meet at a node, that of the earlier collider."""
        number = len(self.pivots)

        def numbered(n: Array) -> Array:
            return jnp.where(n < 0, n, n + number)

        mine = self.owner >= 0
        touched = mine | (self.holder >= 0).any(axis=1)
        return ColliderConditions(
            normal=jnp.where(mine[:, None], self.normal, later.normal),
            velocity=jnp.where(mine[:, None], self.velocity, later.velocity),
            held=jnp.where(mine, self.held, later.held),
            owner=jnp.where(mine, self.owner, numbered(later.owner)),
            holder=jnp.where(self.holder >= 0, self.holder, numbered(later.holder)),
            position=jnp.where(touched[:, None], self.position, later.position),
            pivots=jnp.concatenate([self.pivots, later.pivots]),
            pivot_velocity=jnp.concatenate([self.pivot_velocity, later.pivot_velocity]),
            slides=self.slides or later.slides,
        )

    def after(self, time: Scalar, velocity: NodeVector) -> "ColliderConditions":
        """The same conditions with nodes and pivots moved on by a time [s], the nodes at a velocity [m/s], shape (n,
        d)."""
        moved = self.position + time * velocity, self.pivots + time * self.pivot_velocity
        return eqx.tree_at(lambda c: (c.position, c.pivots), self, moved)


class Conditions(eqx.Module):
    """The conditions of boundaries on the window's nodes."""

    fixed: Mask
    """Components of velocity that are prescribed, shape (n, d)."""
    velocity: NodeVector
    """Their values [m/s], shape (n, d); zero elsewhere."""
    colliders: ColliderConditions | None = None
    """Conditions of colliders; None without any."""
    holds: bool = eqx.field(static=True, default=True)
    """Whether any component may be held. What is known here costs a step nothing where the answer is no."""
    moves: bool = eqx.field(static=True, default=True)
    """Whether one may be held at another velocity than zero, by a collider too."""


def no_conditions(nodes: NodeVector) -> Conditions:
    """No condition on these nodes, shape (n, d)."""
    return Conditions(jnp.zeros(nodes.shape, dtype=bool), jnp.zeros_like(nodes), holds=False, moves=False)


def held_by_wall(fixed: Mask, motion: Motion | None, nodes: NodeVector, t: Scalar, dt: Scalar) -> Conditions:
    """Components that a wall holds, shape (n, d), at rest or at the velocity of its motion."""
    if motion is None:
        return Conditions(fixed, jnp.zeros_like(nodes), moves=False)
    return Conditions(fixed, jnp.where(fixed, motion.velocity(t, dt), 0))
