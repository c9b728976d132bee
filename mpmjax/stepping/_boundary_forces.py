"""What each boundary of a scene receives in a step, from the motion of the nodes and the impulses that made it."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, NodeScalar, NodeVector, Scalar
from mpmjax.boundary import (
    BoundaryImpulse,
    ConstrainedNodes,
    Given,
    Owners,
    RigidImage,
    brought_images,
    impulse_on_boundaries,
    owners_of,
    taken_by_mirrors,
)
from mpmjax.discretisation import AbstractTransfer, Gathered, Stencil
from mpmjax.state import Particles, Scene
from mpmjax.stepping._nodes import Nodes, places_of


def given_to_boundaries(
    scene: Scene,
    particles: Particles,
    stencil: Stencil,
    t: Scalar,
    unfolded: Nodes,
    nodes: Nodes,
    reaction: NodeVector,
    before: NodeVector | None,
    mean: NodeVector | None,
    held: ConstrainedNodes,
    slowed: tuple[NodeVector, ...],
) -> BoundaryImpulse:
    """The impulse on each boundary of the scene in the step from t.

    Args:
        scene: the scene.
        particles: the particles at the start of the step.
        stencil: their stencil.
        t: time at the start of the step [s].
        unfolded: the nodes at the start of the step, not folded at symmetry planes.
        nodes: the same, folded.
        reaction: the impulse on all nodes besides gravity, body forces and internal ones, without friction [kg m/s],
            shape (n, d).
        before: the velocity whose change over the step transfers take [m/s], shape (n, d); None if it is not known.
        mean: the velocity with which positions move [m/s], shape (n, d); None if it is v^{n+1}.
        held: the nodes with what contacts hold.
        slowed: the change of velocity by the friction of each contact [m/s], shape (n, d).
    """
    grid, window, dt = scene.grid, scene.window(particles), nodes.dt
    images = brought_images(scene.boundary, grid, window)
    contacts = list(zip(nodes.brought_by, nodes.contacts, held.active, strict=True))
    unfold, colliders = nodes.mirror.unfold, nodes.conditions.colliders
    at = scene.nodes(particles, t)
    owners = owners_of(scene.boundary, nodes.conditions, at, grid.spacing, t, dt, reference=scene.total)
    for image in nodes.mirror.rigid:
        owners = _held_as_one(owners, image, unfolded.mass)

    # springs act on all nodes
    given, residual = [], reaction
    for number, contact, active in contacts:
        push = contact.spring_impulse(held, active)
        if push is not None:
            residual = residual - push
            if number is not None:  # else two bodies push each other
                given.append(Given(push, number))

    # what symmetry planes take of the impulses on all nodes, and what reaches the folded ones
    if scene.transfer.needs_change and before is not None:
        kept = _share_of_change(scene.transfer, scene.grid.dim, residual.dtype)
        residual = residual + kept * unfolded.mass[:, None] * (unfolded.velocity - before)
    of_planes, residual = taken_by_mirrors(residual, images)
    given += of_planes

    # then colliders along their normals, contact planes, and what is prescribed
    along = held.collider_impulse(residual)
    if along is not None and colliders is not None:
        given.append(Given(along[:, None] * colliders.normal, owners.collider[:, None]))
        residual = residual - given[-1].impulse
    columns = [
        (number, image.within(active))
        for number, contact, active in contacts
        if number is not None and (image := contact.mirror_image) is not None
    ]
    of_planes, residual = taken_by_mirrors(residual, columns)
    given += [*of_planes, Given(residual, owners.fixed)]
    taken = owners.fixed >= 0
    for number, contact, active in contacts:
        if number is not None:
            mine = contact.fixed(active, residual.shape) & ~taken
            given.append(Given(jnp.where(mine, residual, 0), number))
            taken = taken | mine

    for (number, _, _), change in zip(contacts, slowed, strict=True):
        of_planes, friction = taken_by_mirrors(unfolded.mass[:, None] * unfold(change), images)
        given += of_planes
        if number is not None:
            given.append(Given(friction, number))

    places, pivots = at, _pivots(scene, t, residual)
    if scene.total:
        places = _moved_places(scene, particles, stencil, unfolded, owners, at, t)
    if mean is not None:
        places = places + dt / 2 * mean
        pivots = (pivots + _pivots(scene, t + dt, residual)) / 2
    return impulse_on_boundaries(given, places, pivots)


def _held_as_one(owners: Owners, image: RigidImage, mass: NodeScalar) -> Owners:
    """The owners where the first that holds a node of a rigid body holds all of them in this direction.

    Args:
        owners: what boundaries hold, node by node.
        image: the map of the rigid body.
        mass: masses of all nodes [kg], shape (n,).
    """
    own, full = image.own(owners.fixed), image.own(mass) > 0
    count = jnp.iinfo(own.dtype).max
    first = jnp.where((own >= 0) & full[:, None], own, count).min(axis=0)
    spread = jnp.broadcast_to(jnp.where(first == count, -1, first), own.shape)
    return eqx.tree_at(lambda o: o.fixed, owners, image.with_own(owners.fixed, spread))


def _share_of_change(transfer: AbstractTransfer, dim: int, dtype: jnp.dtype) -> Array:
    """The share with which particles take the change of the nodes' velocity and not the velocity itself, (1, d)."""
    zero, one = jnp.zeros((dim, 1), dtype), jnp.ones((dim, 1), dtype)
    slope = jnp.zeros((dim, dim, 1), dtype)
    none, all_of_it = (Gathered(value, slope, slope) for value in (zero, one))
    return (transfer.velocity(zero, none, all_of_it) - transfer.velocity(zero, none, none)).T


def _moved_places(
    scene: Scene, particles: Particles, stencil: Stencil, nodes: Nodes, owners: Owners, reference: NodeVector, t: Scalar
) -> NodeVector:
    """Where the body has moved the nodes of the reference configuration at time t [m], shape (n, d)."""
    colliders, places = nodes.conditions.colliders, reference
    places = jnp.where(nodes.occupied, nodes.per_mass(places_of(particles, stencil, scene.grid.size)), places)
    for number, boundary in enumerate(scene.boundary):
        carried = boundary.carried(reference, t)
        if carried is not None:
            places = jnp.where((owners.fixed == number).all(axis=1, keepdims=True), carried, places)
    if colliders is None:
        return places
    touched = (colliders.owner >= 0) | (colliders.holder >= 0).any(axis=1)
    return jnp.where(touched[:, None], colliders.position, places)


def _pivots(scene: Scene, t: Scalar, like: NodeVector) -> Array:
    """The points about which torques are taken at time t [m], shape (b, d)."""
    found = [boundary.pivot(t) for boundary in scene.boundary]
    origin = jnp.zeros(like.shape[1], like.dtype)
    return jnp.stack([origin if pivot is None else jnp.asarray(pivot, like.dtype) for pivot in found])
