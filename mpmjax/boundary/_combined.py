"""What the boundaries of a scene ask of the nodes together: conditions, contacts, mirrors."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Int, NodeVector, Scalar
from mpmjax.boundary._boundary import AbstractBoundary
from mpmjax.boundary._conditions import Conditions
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._faces import Faces
from mpmjax.boundary._mirror import Mirror
from mpmjax.boundary._surface_contact import surface_contact
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
        colliders = total.colliders
        if new.colliders is not None:
            holder = jnp.where(total.fixed, -1, new.colliders.holder)
            mine = eqx.tree_at(lambda c: c.holder, new.colliders, holder)
            colliders = mine if colliders is None else colliders.beside(mine)
        total = Conditions(total.fixed | new.fixed, velocity, colliders)
    return total


def contacts_of(
    boundaries: tuple[AbstractBoundary, ...],
    conditions: Conditions,
    grid: Grid,
    window: Int[Array, "d"],
    t: Scalar,
    dt: Scalar,
    faces: Faces | None,
    force_time: Scalar,
) -> tuple[AbstractContact, ...]:
    """The contacts of a scene, in the order of their friction: those that boundaries bring, and those of their surfaces
    with the particles' faces.

    Args:
        boundaries: the scene's boundaries.
        conditions: what they ask of the nodes.
        grid: the grid.
        window: lattice index of the window's first node, shape (d,).
        t: time [s].
        dt: step [s].
        faces: the particles' faces; None if no boundary has a surface.
        force_time: the time at which forces act [s].
    """
    found: list[AbstractContact] = []
    bodies = 0
    for boundary in boundaries:
        own = boundary.contacts(conditions, grid, window, t, dt)
        found += own if faces is None or not boundary.sees_faces else boundary.facing(own, faces)
        if faces is not None and boundary.pushes:
            body = bodies if boundary.bodies else None
            found += [surface_contact(one, faces, body) for one in boundary.surfaces(faces.x, t, dt, force_time)]
        bodies += boundary.bodies
    return tuple(sorted(found, key=lambda contact: contact.friction_order))


def mirror(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> Mirror:
    """The mirror images that the boundaries of a scene put in the window."""
    return Mirror(tuple(image for boundary in boundaries for image in boundary.mirror_images(grid, window)))
