"""The impulse that each boundary of a scene receives in a step, from the motion of the nodes and what made it."""

from dataclasses import replace

import jax
import jax.numpy as jnp

from mpmjax._types import Array, Mask, NodeVector, Scalar
from mpmjax.boundary import ConstrainedNodes, Impulses, OwnedImpulse, owners_of, received_impulses, taken_by_mirrors
from mpmjax.discretisation import Gathered
from mpmjax.potential import Image, Mirror, SurfaceImage
from mpmjax.state import Particles, Scene
from mpmjax.stepping._grid_update import GridUpdate, reaction
from mpmjax.stepping._integrator import AbstractIntegrator
from mpmjax.stepping._nodes import Nodes, places_of


def impulse_on_colliders(scene: Scene, nodes: Nodes, method: AbstractIntegrator, new: GridUpdate) -> Impulses:
    """The impulse on the scene's colliders, at their places at the time of the forces, by prescribed components, along
    normals, by springs and friction, from the nodes at the start of the step and their update."""
    colliders, share = nodes.conditions.colliders, method.force_at()
    assert colliders is not None
    position, pivots = colliders.position, colliders.pivots
    if share is not None:
        position = position + share * nodes.dt * nodes.potential.mirror.unfold(new.motion.carrier)
        pivots = pivots + share * nodes.dt * colliders.pivot_velocity
    held, numbers = new.held(nodes), _boundaries_of_colliders(scene)
    holding = held.without_spring_impulses(reaction(nodes, new.solved, new.elastic))
    parts = list(held.along_normals(holding))
    of_walls, holding = taken_by_mirrors(held.without_collider_impulses(holding), held.walls)
    for part in of_walls:
        if isinstance(part.owner, int) and part.owner in numbers:
            parts.append(replace(part, owner=numbers.index(part.owner)))
    parts.append(OwnedImpulse(holding, colliders.holder))
    for number, mine in _taken_by_contacts(held, colliders.holder >= 0):
        if number in numbers:
            parts.append(OwnedImpulse(jnp.where(mine, holding, 0), numbers.index(number)))
    mass, tied = (nodes if nodes.loose is None else nodes.loose).mass[:, None], Mirror(nodes.tied)
    for number, contact, active, change in zip(
        nodes.brought_by, nodes.contacts, held.active, new.friction, strict=True
    ):
        if number in numbers:  # by springs and friction
            rubbed, impulse = mass * tied.unfold(change), contact.spring_impulse(held, active)
            parts.append(OwnedImpulse(rubbed if impulse is None else rubbed + impulse, numbers.index(number)))
    return received_impulses(parts, position, pivots)


def impulse_on_boundaries(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    unfolded: Nodes,
    nodes: Nodes,
    method: AbstractIntegrator,
    new: GridUpdate,
) -> Impulses:
    """The impulse on each boundary of the scene, and by each constraint that holds a body, in the step from t, from the
    nodes at its start, before and after the fold at symmetry planes, and their update."""
    held, unfold, dt = new.held(nodes), nodes.potential.mirror.unfold, nodes.dt
    whole, elastic = new.solved, new.elastic
    if nodes.potential.mirror.images:  # of all nodes
        whole = jax.tree.map(unfold, whole)
        elastic = None if unfolded.f is None else method.elastic_impulse(unfolded, whole)
    residual = reaction(unfolded, whole, elastic)
    window, at = scene.window(particles), scene.nodes(particles, t)
    images = [(n, i) for n, each in enumerate(scene.boundary) for i in each.mirror_images(scene.grid, window, t, dt)]
    contacts = list(zip(nodes.brought_by, nodes.contacts, held.active, strict=True))
    owners = owners_of(scene.boundary, at, scene.grid.spacing, t, dt, reference=scene.total)
    planes = [(number, image) for number, image in images if isinstance(image, Image)]
    solved, couples, soft = new.solved.velocity, [], jnp.ones_like(unfolded.mass, dtype=bool)
    for constraint, image in zip(scene.constraints, nodes.tied, strict=True):
        loose, tied = (unfolded.mass, unfold(solved) - unfolded.velocity), (nodes.mass, solved - nodes.velocity)
        guide = scene.guides.get(constraint.number)
        owners, couple = constraint.received(image, owners, planes, loose, tied, guide)
        couples.append(couple)
        soft = image.with_own(soft, jnp.zeros_like(image.own(soft)))

    # springs act on all nodes
    parts = []
    for number, contact, active in contacts:
        push = contact.spring_impulse(held, active)
        if push is not None:
            residual = residual - push
            if number is not None:  # else two bodies push each other
                parts.append(OwnedImpulse(push, number))

    # what symmetry planes take of the impulses on all nodes, and what reaches the folded ones
    if scene.transfer.needs_change:
        # the share with which particles take the change of the nodes' velocity and not the velocity itself, (1, d)
        d, dtype, velocity = scene.grid.dim, residual.dtype, scene.transfer.velocity
        zero, slope = jnp.zeros((d, 1), dtype), jnp.zeros((d, d, 1), dtype)
        none, all_of_it = Gathered(zero, slope, slope), Gathered(zero + 1, slope, slope)
        share = (velocity(zero, none, all_of_it) - velocity(zero, none, none)).T
        mass = jnp.where(soft, unfolded.mass, 0)[:, None]  # a constraint takes the velocity
        residual = residual + share * mass * (unfolded.velocity - unfold(new.before(nodes)))
    of_planes, residual = taken_by_mirrors(residual, images)
    parts += of_planes

    # then colliders along their normals, contact planes, and what is prescribed
    numbers = jnp.asarray(_boundaries_of_colliders(scene), jnp.int32)
    for part in held.along_normals(residual):
        parts.append(OwnedImpulse(part.impulse, jnp.where(part.owner < 0, -1, numbers[part.owner])))
        residual = residual - part.impulse
    of_planes, residual = taken_by_mirrors(residual, held.walls)
    parts += [*of_planes, OwnedImpulse(residual, owners)]
    for number, mine in _taken_by_contacts(held, owners >= 0):
        parts.append(OwnedImpulse(jnp.where(mine, residual, 0), number))

    for (number, _, _), change in zip(contacts, new.friction, strict=True):
        of_planes, friction = taken_by_mirrors(unfolded.mass[:, None] * unfold(change), images)
        parts += of_planes
        if number is not None:
            parts.append(OwnedImpulse(friction, number))

    # about where nodes and pivots are at the time of the forces
    places = _carried(scene, particles, t, unfolded, at, owners) if scene.total else at
    pivots, force_at = _pivots(scene, t, residual), method.force_at()
    if force_at is not None:
        moved = unfold(new.motion.carrier)
        for image in nodes.tied:
            moved = image.with_own(moved, image.places(new.motion.carrier))
        places = places + force_at * dt * moved
        pivots = pivots + force_at * (_pivots(scene, t + dt, residual) - pivots)
    return received_impulses(parts, places, pivots, couples)


def _carried(scene: Scene, particles: Particles, t: Scalar, nodes: Nodes, at: NodeVector, owners: Array) -> NodeVector:
    """Where body, boundaries and colliders have moved the nodes `at` the reference configuration [m]."""
    moved = places_of(particles, nodes.potential.stencil, scene.grid.size)
    places, colliders = jnp.where(nodes.occupied, moved, at), nodes.conditions.colliders
    for number, boundary in enumerate(scene.boundary):
        carried = boundary.carried(at, t)
        if carried is not None:
            places = jnp.where((owners == number).all(axis=1, keepdims=True), carried, places)
    return places if colliders is None else jnp.where(colliders.touched[:, None], colliders.position, places)


def _taken_by_contacts(held: ConstrainedNodes[Nodes], taken: Mask) -> list[tuple[int, Mask]]:
    """The components whose impulse is that of each contact, by its boundary's number: first what contacts fix, then all
    of the nodes that surfaces reach. There masses that are one in all directions are not BᵀMB, and what differs,
    without a sum along a plane, is the surface's."""
    nodes, shape, parts = held.unconstrained, taken.shape, []
    contacts = zip(nodes.brought_by, nodes.contacts, held.active, strict=True)
    masks = [(number, contact.fixed(active, shape)) for number, contact, active in contacts]
    masks += [(number, wall.reached(shape)) for number, wall in held.walls if isinstance(wall, SurfaceImage)]
    for number, mask in masks:
        if number is not None:
            parts.append((number, mask & ~taken))
            taken = taken | mask
    return parts


def _boundaries_of_colliders(scene: Scene) -> list[int]:
    """The number of the boundary that each collider is."""
    return [n for n, boundary in enumerate(scene.boundary) for _ in range(boundary.collider_count)]


def _pivots(scene: Scene, t: Scalar, like: NodeVector) -> Array:
    """The points about which torques are taken at time t [m], shape (b, d)."""
    pivots = [boundary.pivot(t) for boundary in scene.boundary] + [None] * len(scene.guides)
    origin = jnp.zeros(like.shape[1], like.dtype)
    return jnp.stack([origin if pivot is None else jnp.asarray(pivot, like.dtype) for pivot in pivots])
