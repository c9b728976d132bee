"""The conditions of boundaries on the nodes: prescribed velocities, and those of colliders."""

from dataclasses import replace
from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeVector, Scalar
from mpmjax.geometry import Motion

PARALLEL = 1e-2
"""Length of a unit normal's part in free directions up to which it is prescribed by the others."""


class Given(eqx.Module):
    """Impulses on the nodes, and the boundaries or colliders that give them."""

    impulse: NodeVector
    """[kg m/s], shape (n, d)."""
    owner: Int[Array, "..."] | int
    """The number of the boundary or collider, −1 for none: of all nodes, or of shape (n, 1) or (n, d)."""


class Slide(eqx.Module):
    """A collider that holds the nodes in it along its normal."""

    normal: NodeVector
    """Unit normal out of it, shape (n, d); zero at nodes that it does not hold."""
    velocity: NodeVector
    """Velocity of the collider at the nodes [m/s], shape (n, d)."""
    number: int = eqx.field(static=True, default=0)
    """Number of the collider among all colliders."""


class ColliderConditions(eqx.Module):
    """The conditions of k colliders on the nodes that lie in them."""

    slides: tuple[Slide, ...]
    """The colliders that hold nodes along their normal alone, in the scene's order."""
    holder: Int[Array, "n d"]
    """Number of the collider that prescribes each component, −1 for none, shape (n, d)."""
    position: NodeVector
    """Where the nodes are [m], shape (n, d): in the total description those that are held have moved with the body."""
    pivots: Float[Array, "k d"]
    """The points about which the colliders' torques are taken [m], shape (k, d)."""
    pivot_velocity: Float[Array, "k d"]
    """Their velocity [m/s], shape (k, d)."""

    @property
    def touched(self) -> Bool[Array, "n"]:
        """The nodes of which any component is held, shape (n,)."""
        return reduce(
            jnp.logical_or, (slide.normal.any(axis=1) for slide in self.slides), (self.holder >= 0).any(axis=1)
        )

    def beside(self, later: "ColliderConditions") -> "ColliderConditions":
        """These conditions and those of colliders that stand later in the scene."""
        number = len(self.pivots)

        def numbered(n: Array) -> Array:
            return jnp.where(n < 0, n, n + number)

        return ColliderConditions(
            slides=self.slides + tuple(replace(slide, number=slide.number + number) for slide in later.slides),
            holder=jnp.where(self.holder >= 0, self.holder, numbered(later.holder)),
            position=jnp.where(self.touched[:, None], self.position, later.position),
            pivots=jnp.concatenate([self.pivots, later.pivots]),
            pivot_velocity=jnp.concatenate([self.pivot_velocity, later.pivot_velocity]),
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
