"""The impulse that each boundary of a scene receives in a step, from the motion of the nodes and what made it."""

import jax
import jax.numpy as jnp

from mpmjax._types import Array, NodeVector, Scalar
from mpmjax.boundary import ConstrainedNodes, Impulses, OwnedImpulse, received_impulses, taken_by_mirrors
from mpmjax.discretisation import Gathered
from mpmjax.potential import Image, Mirror, SurfaceImage
from mpmjax.state import Particles, Scene
from mpmjax.stepping._grid_update import GridUpdate, reaction
from mpmjax.stepping._integrator import AbstractIntegrator
from mpmjax.stepping._nodes import Nodes, places_of


def impulse_on_colliders(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    unfolded: Nodes,
    nodes: Nodes,
    method: AbstractIntegrator,
    new: GridUpdate,
) -> Impulses:
    """The impulse on the scene's colliders by prescribed components, along normals, by springs and friction (see
    `impulse_on_boundaries`), on true nodes alone."""
    held, owners = new.held(nodes), unfolded.conditions.owner
    assert owners is not None
    holding = held.without_spring_impulses(reaction(nodes, new.solved, new.elastic))
    parts = _of_what_holds(held, holding, owners)
    mass, tied = (nodes if nodes.loose is None else nodes.loose).mass[:, None], Mirror(nodes.tied)
    contacts = zip(nodes.brought_by, nodes.contacts, held.active, new.friction, strict=True)
    for number, contact, active, change in contacts:
        if number is not None and scene.boundary[number].is_collider:
            parts.append(OwnedImpulse(mass * tied.unfold(change), number))
            if (push := contact.spring_impulse(held, active)) is not None:
                parts.append(OwnedImpulse(push, number))
    moved = nodes.potential.mirror.unfold(new.motion.carrier)
    places, pivots = _places_and_pivots(scene, particles, t, unfolded, owners, method, moved)
    on = {number: pivots[number] for number, boundary in enumerate(scene.boundary) if boundary.is_collider}
    return received_impulses(parts, places, on)


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
    window, owners = scene.window(particles), unfolded.conditions.owner
    assert owners is not None
    images = [(n, i) for n, each in enumerate(scene.boundary) for i in each.mirror_images(scene.grid, window, t, dt)]
    contacts = list(zip(nodes.brought_by, nodes.contacts, held.active, strict=True))
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

    parts += _of_what_holds(held, residual, owners)
    for (number, _, _), change in zip(contacts, new.friction, strict=True):
        of_planes, friction = taken_by_mirrors(unfolded.mass[:, None] * unfold(change), images)
        parts += of_planes
        if number is not None:
            parts.append(OwnedImpulse(friction, number))

    moved = unfold(new.motion.carrier)
    for image in nodes.tied:
        moved = image.with_own(moved, image.places(new.motion.carrier))
    places, pivots = _places_and_pivots(scene, particles, t, unfolded, owners, method, moved)
    return received_impulses(parts, places, pivots, couples)


def _places_and_pivots(
    scene: Scene,
    particles: Particles,
    t: Scalar,
    nodes: Nodes,
    owners: Array,
    method: AbstractIntegrator,
    moved: NodeVector,
) -> tuple[NodeVector, dict[int, Array]]:
    """Where nodes and the boundaries' pivots are at the time of the forces [m], as nodes move with a velocity [m/s]. In
    the total description body and boundaries have moved the nodes of the reference configuration."""
    places = at = scene.nodes(particles, t)
    if scene.total:
        places = jnp.where(nodes.occupied, places_of(particles, nodes.potential.stencil, scene.grid.size), at)
        for number, boundary in enumerate(scene.boundary):
            carried = boundary.carried(at, t)
            places = places if carried is None else jnp.where(owners == number, carried, places)

    def pivots(t: Scalar) -> Array:
        each = [boundary.pivot(t) for boundary in scene.boundary] + [None] * len(scene.guides)
        return jnp.stack([jnp.zeros_like(at[0]) if one is None else jnp.asarray(one, at.dtype) for one in each])

    points, share = pivots(t), method.force_at()
    if share is not None:
        places, points = places + share * nodes.dt * moved, points + share * (pivots(t + nodes.dt) - points)
    return places, dict(enumerate(points))


def _of_what_holds(held: ConstrainedNodes, residual: NodeVector, owners: Array) -> list[OwnedImpulse]:
    """The parts of an impulse that holds nodes by colliders along their normals, walls and contacts, and by what
    prescribes components."""
    parts = list(held.along_normals(residual))
    of_walls, residual = taken_by_mirrors(held.without_collider_impulses(residual), held.walls)
    parts += [*of_walls, OwnedImpulse(residual, owners)]
    # of the other components what contacts fix is theirs, then all of the nodes that surfaces reach: there masses that
    # are one in all directions are not BᵀMB, and what differs, without a sum along a plane, is the surface's
    nodes, taken = held.unconstrained, owners >= 0
    contacts = zip(nodes.brought_by, nodes.contacts, held.active, strict=True)
    masks = [(number, contact.fixed(active, taken.shape)) for number, contact, active in contacts]
    masks += [(number, wall.reached(taken.shape)) for number, wall in held.walls if isinstance(wall, SurfaceImage)]
    for number, mask in masks:
        if number is not None:
            parts.append(OwnedImpulse(jnp.where(mask & ~taken, residual, 0), number))
            taken = taken | mask
    return parts
