"""The boundaries of a scene together: conditions, contacts, mirrors."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Int, NodeVector, Scalar
from mpmjax.boundary._boundary import AbstractBoundary
from mpmjax.boundary._conditions import Conditions, no_conditions
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._faces import Faces
from mpmjax.boundary._surface_contact import surface_contact
from mpmjax.discretisation import Grid
from mpmjax.potential import Image, Mirror, MirrorMotion, Tie


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
    them, normals of several colliders: all hold (see `Nodes.free_normals`). A normal that lies within a hundredth of
    the prescribed components and of earlier normals asks for nothing more.
    """
    total = no_conditions(nodes)
    for boundary in boundaries:
        new = boundary.conditions(nodes, spacing, t, dt, reference=reference)
        velocity = jnp.where(total.fixed, total.velocity, new.velocity)
        colliders = total.colliders
        if new.colliders is not None:
            holder = jnp.where(total.fixed, -1, new.colliders.holder)
            mine = eqx.tree_at(lambda c: c.holder, new.colliders, holder)
            colliders = mine if colliders is None else colliders.beside(mine)
        either = total.holds or new.holds, total.moves or new.moves
        total = Conditions(total.fixed | new.fixed, velocity, colliders, *either)
    for boundary in boundaries:
        fixed, velocity = boundary.spread(total.fixed, total.velocity, nodes, spacing)
        total = replace(total, fixed=fixed, velocity=velocity)
    return total


def brought_contacts(
    boundaries: tuple[AbstractBoundary, ...],
    conditions: Conditions,
    grid: Grid,
    window: Int[Array, "d"],
    t: Scalar,
    dt: Scalar,
    faces: Faces | None,
    force_time: Scalar,
) -> list[tuple[int, AbstractContact]]:
    """The contacts of a scene, in the order of their friction, each with the number of its boundary: those that
    boundaries bring, and those of their surfaces with the particles' faces.

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
    found: list[tuple[int, AbstractContact]] = []
    bodies = 0
    for number, boundary in enumerate(boundaries):
        own = boundary.contacts(conditions, grid, window, t, dt)
        own = own if faces is None or not boundary.sees_faces else boundary.facing(own, faces)
        if faces is not None and boundary.pushes:
            body = bodies if boundary.bodies else None
            surfaces = boundary.surfaces(faces.x, t, dt, force_time)
            own = (*own, *(surface_contact(one, faces, body) for one in surfaces))
        found += [(number, contact) for contact in own]
        bodies += boundary.bodies
    return sorted(found, key=lambda brought: brought[1].friction_order)


def mirror(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> Mirror:
    """The mirror images that the boundaries of a scene put in the window."""
    return Mirror(tuple(image for _, image in brought_images(boundaries, grid, window)))


def mirror_motion(
    boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
) -> MirrorMotion | None:
    """The velocity that moving mirrors add to the nodes beyond them; None if none moves."""
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
