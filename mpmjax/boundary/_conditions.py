"""Boundary conditions: functions of node position that prescribe grid velocities or mark contact.

Every condition acts on the grid alone; the transfers know nothing of it. A wall acts on the nodes at and beyond it; a
node within a thousandth of a spacing of a wall counts as on it. Where walls, planes and grips lie only selects nodes,
so derivatives with respect to it are zero.
"""

import abc

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, ParticleVector, Scalar

ON_THE_WALL = 1e-3
"""Distance within which a node is on a wall, in spacings."""


class ColliderConditions(eqx.Module):
    """The conditions of k colliders on the nodes that lie in them."""

    normal: NodeVector
    """Unit normal out of the collider that holds or pushes the node along it, shape (n, d); zero where none does."""
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
    leavable: Bool[Array, "n"] | None = None
    """Whether the node may leave, shape (n,); None where there is no such collider."""
    friction: NodeScalar | None = None
    """Coulomb coefficient there [-], shape (n,)."""

    def beside(self, later: "ColliderConditions") -> "ColliderConditions":
        """Both conditions; where two normals meet at a node, that of the earlier collider."""
        number = len(self.pivots)

        def numbered(n: Array) -> Array:
            return jnp.where(n < 0, n, n + number)

        def joined(a: Array | None, b: Array | None) -> Array | None:
            if a is None or b is None:
                return a if b is None else jnp.where(mine, jnp.zeros_like(b), b)
            return jnp.where(mine, a, b)

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
            leavable=joined(self.leavable, later.leavable),
            friction=joined(self.friction, later.friction),
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
    side: NodeVector | None = None
    """Inward normal (+1 or −1) of a separating wall in each direction, 0 where there is none; None without any."""
    friction: NodeVector | None = None
    """Coulomb coefficient of that wall [-]."""
    colliders: ColliderConditions | None = None
    """Conditions of colliders; None without any."""


class AbstractBoundary(eqx.Module):
    """A boundary condition."""

    @property
    @abc.abstractmethod
    def dim(self) -> int | None:
        """Space dimension d of the condition; None if it fits any."""

    @abc.abstractmethod
    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """The conditions on nodes at the given positions for the step from t to t + dt.

        With `reference`, the nodes are those of the reference configuration and a region that moves stays where it was.
        """

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"] | None:
        """Which particles passed the boundary in the step from t to t + dt; None if it keeps nothing out.

        A particle that moves less than a spacing in a step stops before a wall, or so little beyond it that a node of
        its stencil is still free. A particle has passed if it is deeper than that, or if it moved more than a spacing
        towards the wall in the step and ended beyond it. One that began beyond has not passed.

        Args:
            start: positions at t [m], shape (p, d).
            end: positions at t + dt [m], shape (p, d).
            spacing: dx [m].
            t: time [s].
            dt: step [s].
            reach: half the kernel's width in spacings.
        """
        del start, end, spacing, t, dt, reach
        return None


def crossed(
    start: Array, end: Array, wall: Array | Scalar, deepest: Array | Scalar, spacing: Scalar
) -> Bool[Array, "..."]:
    """Whether a coordinate that moved from `start` to `end` passed a wall that keeps material above it: it moved by
    more than a spacing and ended below the wall, or it ended below `deepest`."""
    fast = (start >= wall) & (end < wall) & (start - end > spacing)
    return fast | ((start >= deepest) & (end < deepest))


def combine(
    boundaries: tuple[AbstractBoundary, ...],
    nodes: NodeVector,
    spacing: Scalar,
    t: Scalar,
    dt: Scalar,
    *,
    reference: bool,
) -> Conditions:
    """The conditions of all boundaries of a scene. Where two prescribe the same component, the earlier one holds.

    Contact acts on components that nothing prescribes. A node may have components that are prescribed and, besides
    them, a collider's normal component: both hold (see `Nodes.free_normal`). A normal that lies within a hundredth of
    the prescribed components asks for nothing more. Of two colliders' normals the earlier one holds.
    """
    total = Conditions(jnp.zeros(nodes.shape, dtype=bool), jnp.zeros_like(nodes))
    for boundary in boundaries:
        new = boundary.conditions(nodes, spacing, t, dt, reference=reference)
        velocity = jnp.where(total.fixed, total.velocity, new.velocity)
        side, friction = total.side, total.friction
        if new.side is not None and new.friction is not None:
            if side is None or friction is None:
                side, friction = new.side, new.friction
            else:
                friction = jnp.where(side != 0, friction, new.friction)
                side = jnp.where(side != 0, side, new.side)
        colliders = total.colliders
        if new.colliders is not None:
            holder = jnp.where(total.fixed, -1, new.colliders.holder)
            mine = eqx.tree_at(lambda c: c.holder, new.colliders, holder)
            colliders = mine if colliders is None else colliders.beside(mine)
        total = Conditions(total.fixed | new.fixed, velocity, side, friction, colliders)
    if total.side is None:
        return total
    side = jnp.where(total.fixed, 0, total.side)
    return Conditions(total.fixed, total.velocity, side, total.friction, total.colliders)
