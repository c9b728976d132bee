"""What the boundaries of a scene ask of the nodes together: conditions, contacts, mirrors."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Int, NodeVector, Scalar
from mpmjax.boundary._boundary import AbstractBoundary
from mpmjax.boundary._collider_contact import collider_contacts
from mpmjax.boundary._conditions import Conditions
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._mirror import Image, Mirror, MirrorMotion, Tie
from mpmjax.boundary._wall_contact import wall_contacts
from mpmjax.discretisation import Grid


def combined_conditions(
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
    for boundary in boundaries:
        fixed, velocity = boundary.spread(total.fixed, total.velocity, nodes, spacing)
        total = Conditions(fixed, velocity, total.side, total.friction, total.colliders)
    if total.side is None:
        return total
    side = jnp.where(total.fixed, 0, total.side)
    return Conditions(total.fixed, total.velocity, side, total.friction, total.colliders)


def contacts_of(
    boundaries: tuple[AbstractBoundary, ...],
    conditions: Conditions,
    grid: Grid,
    window: Int[Array, "d"],
    t: Scalar,
    dt: Scalar,
) -> tuple[AbstractContact, ...]:
    """The contacts of a scene, in the order of their friction.

    Of separating walls and of colliders a node has one of each, where several meet the earlier: so their contacts are
    those of the combined conditions. Any other contact is brought by a boundary itself.

    Args:
        boundaries: the scene's boundaries.
        conditions: what they ask of the nodes.
        grid: the grid.
        window: lattice index of the window's first node, shape (d,).
        t: time [s].
        dt: step [s].
    """
    return tuple(contact for _, contact in brought_contacts(boundaries, conditions, grid, window, t, dt))


def brought_contacts(
    boundaries: tuple[AbstractBoundary, ...],
    conditions: Conditions,
    grid: Grid,
    window: Int[Array, "d"],
    t: Scalar,
    dt: Scalar,
) -> list[tuple[int | None, AbstractContact]]:
    """The contacts of `contacts_of`, each with the number of the boundary that brings it, None for those of the
    combined conditions."""
    found: list[tuple[int | None, AbstractContact]]
    found = [(None, contact) for contact in (*wall_contacts(conditions), *collider_contacts(conditions))]
    for number, boundary in enumerate(boundaries):
        found += [(number, contact) for contact in boundary.contacts(conditions, grid, window, t, dt)]
    return sorted(found, key=lambda brought: brought[1].friction_order)


def mirror(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> Mirror:
    """The mirror images that the boundaries of a scene put in the window."""
    return Mirror(tuple(image for _, image in brought_images(boundaries, grid, window)))


def mirror_motion(
    boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
) -> MirrorMotion | None:
    """What all mirrors that move add to the velocity of the nodes beyond them; None if none moves."""
    total = None
    for boundary in boundaries:
        own = boundary.mirror_motion(grid, window, t, dt)
        if own is not None and total is not None:
            own = MirrorMotion(total.beyond | own.beyond, jnp.where(total.beyond, total.velocity, own.velocity))
        total = total if own is None else own
    return total


def brought_images(
    boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]
) -> list[tuple[int, Image | Tie]]:
    """The images of `mirror`, each with the number of its boundary."""
    return [(n, image) for n, boundary in enumerate(boundaries) for image in boundary.mirror_images(grid, window)]
