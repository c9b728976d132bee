"""Surfaces that touch in a step: the faces of particles, before walls and colliders, and those of bodies."""

from functools import partial
from itertools import combinations

import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar, components
from mpmjax.boundary import EXPLICIT_STIFFNESS, IMPLICIT_STIFFNESS, Body, BodyContact, Faces, FaceShape, body_contact
from mpmjax.discretisation import scatter
from mpmjax.implicit import ElasticPotential
from mpmjax.potential import Mirror
from mpmjax.state import MaterialPoints, Particles, Scene


def faces_of(
    scene: Scene, particles: Particles, potential: ElasticPotential, t: Scalar, dt: Scalar, force_at: Scalar | None
) -> Faces:
    """The faces of prepared particles in a step from t. Forces are evaluated at the share `force_at` of the step's
    displacement; None if the step is explicit."""
    materials, shapes, areas, explicit = potential.material_points, [], [], force_at is None
    factor, radius = EXPLICIT_STIFFNESS if explicit else IMPLICIT_STIFFNESS, potential.stencil.radius
    d = particles.x.shape[1]
    for law, points in zip(scene.laws, materials, strict=True):
        size = points.volume
        if radius is not None:  # the section of a ring, undeformed where F says how far it has grown
            now = 2 * jnp.pi * points.rows_of(radius)
            size = size / now * (points.deformation[2, 2] if law.allows_total and not points.total else 1)
        side = size ** (1 / d)
        shape = points.deformation[:d, :d] if law.allows_total else points.volume_ratio()
        shapes.append(FaceShape(side / 2, shape, points.rows, points.total, law.flows))
        # of a sliver A = V0/l0 is large for its mass, and would shorten explicit steps
        areas.append(points.volume / (side.max(initial=0) if explicit else side))
    at = 0.0 if explicit else jnp.asarray(force_at, particles.x.dtype)
    per_modulus = jnp.concatenate(areas) * (factor / jnp.asarray(scene.grid.spacing))
    return Faces(
        x=particles.x,
        v=particles.v,
        shapes=tuple(shapes),
        stiffness=per_modulus * contact_moduli(scene, particles, materials),
        inertia=per_modulus * particles.mass / particles.volume,
        stencil=potential.stencil,
        spacing=jnp.asarray(scene.grid.spacing),
        dt=jnp.asarray(dt),
        push_time=t if explicit else t + jnp.where(at > 0, dt, 0),
        share=1.0 if explicit else jnp.where(at > 0, at, 1),
        explicit=explicit,
    )


def contacts_of_bodies(
    scene: Scene,
    friction: Scalar,
    particles: Particles,
    potential: ElasticPotential,
    images: Mirror,
    dt: Scalar,
    force_at: Scalar | None,
) -> list[BodyContact]:
    """The contacts of each two bodies of a scene with `bodies`, which go on beyond symmetry planes (see `faces_of`)."""
    # the bodies, one for each layer of nodes
    materials, stencil = potential.material_points, potential.stencil
    d, dx, layers = particles.dim, jnp.asarray(scene.grid.spacing), scene.grid.layers
    volume = jnp.concatenate([points.volume * jnp.abs(points.volume_ratio()) for points in materials])
    means = jnp.stack([contact_moduli(scene, particles, materials), particles.mass / volume, volume ** (1 / d) / dx])
    part = volume / dx**d
    values = part * jnp.concatenate([jnp.ones_like(part)[None], means, components(particles.v)])
    sums = scatter(stencil, values, None, scene.grid.size)
    # w (x_p − x_i)_a = −D_a g_a, with g the moving-least-squares gradient
    arms = -jnp.eye(d, dtype=part.dtype)[..., None] * (part * stencil.moment / dx)
    middle = images.of_places().fold(scatter(stencil.least_squares, None, arms, scene.grid.size)).T
    scalars = images.fold_scalar(sums[:, :4]).T
    velocity = images.fold(sums[:, 4:]).T

    full = jnp.where(scalars[0] > 0, scalars[0], 1)
    each = jnp.concatenate([scalars[:1], scalars[1:] / full, velocity / full, middle / full])
    each = each.reshape(len(each), layers, -1).swapaxes(0, 1)
    bodies = [
        Body(part=a[0], modulus=a[1], density=a[2], side=a[3], velocity=a[4 : 4 + d], middle=a[4 + d :]) for a in each
    ]

    at = jnp.ones(()) if force_at is None else jnp.asarray(force_at)
    share = jnp.where(at > 0, at, 1).astype(particles.x.dtype)
    between = partial(body_contact, friction=friction, order=scene.kernel.order, grid=scene.grid, images=images)
    return [between(bodies[a], bodies[b], (a, b), dt=dt, share=share) for a, b in combinations(range(layers), 2)]


def contact_moduli(scene: Scene, particles: Particles, materials: tuple[MaterialPoints, ...]) -> Float[Array, "p"]:
    """The modulus of contact [Pa] of each prepared particle, shape (p,) (see `AbstractLaw.contact_modulus`)."""
    each = zip(scene.laws, materials, particles.histories, strict=True)
    return jnp.concatenate([law.contact_modulus(points.deformation, history) for law, points, history in each])
