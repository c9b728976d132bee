"""The surfaces of a scene's bodies, as they see each other in a step."""

from itertools import combinations

import jax.numpy as jnp

from mpmjax._types import Scalar, components
from mpmjax.boundary import Body, BodyContact, Mirror, body_contact
from mpmjax.discretisation import Stencil, scatter
from mpmjax.state import MaterialPoints, Particles, Scene
from mpmjax.stepping._particle_faces import contact_moduli


def contacts_of_bodies(
    scene: Scene,
    particles: Particles,
    materials: tuple[MaterialPoints, ...],
    stencil: Stencil,
    images: Mirror,
    dt: Scalar,
    force_at: Scalar | None = None,
) -> tuple[BodyContact, ...]:
    """The contacts of each two bodies of a scene; none if it has no `bodies`.

    Args:
        scene: the scene.
        particles: prepared particles.
        materials: their materials.
        stencil: their stencil.
        images: the mirrors of symmetry planes, beyond which bodies go on.
        dt: step [s].
        force_at: the share of the step's displacement at which forces are evaluated; None if the step is explicit.
    """
    if scene.bodies is None:
        return ()
    bodies = _bodies(scene, particles, materials, stencil, images)
    at = jnp.ones(()) if force_at is None else jnp.asarray(force_at)
    return tuple(
        body_contact(
            bodies[pair[0]],
            bodies[pair[1]],
            pair,
            friction=scene.bodies.friction,
            order=scene.kernel.order,
            grid=scene.grid,
            images=images,
            dt=dt,
            share=jnp.where(at > 0, at, 1).astype(particles.x.dtype),
        )
        for pair in combinations(range(scene.grid.layers), 2)
    )


def _bodies(
    scene: Scene, particles: Particles, materials: tuple[MaterialPoints, ...], stencil: Stencil, images: Mirror
) -> list[Body]:
    """The bodies, one for each layer of nodes."""
    d, dx, layers = particles.dim, jnp.asarray(scene.grid.spacing), scene.grid.layers
    volume = jnp.concatenate([points.volume * jnp.abs(points.volume_ratio()) for points in materials])
    means = jnp.stack([contact_moduli(scene, particles, materials), particles.mass / volume, volume ** (1 / d) / dx])
    part = volume / dx**d
    values = part * jnp.concatenate([jnp.ones_like(part)[None], means, components(particles.v)])
    sums = scatter(stencil, values, None, scene.grid.size)
    # w (x_p − x_i)_a = −D_a g_a, with g the moving-least-squares gradient
    arms = -jnp.eye(d, dtype=part.dtype)[..., None] * (part * stencil.moment / dx)
    middle = images.fold(scatter(stencil.least_squares, None, arms, scene.grid.size)).T
    scalars = jnp.stack([images.fold_scalar(own) for own in sums[:, :4].T])
    velocity = images.fold(sums[:, 4:]).T

    full = jnp.where(scalars[0] > 0, scalars[0], 1)
    each = jnp.concatenate([scalars[:1], scalars[1:] / full, velocity / full, middle / full])
    each = each.reshape(len(each), layers, -1).swapaxes(0, 1)
    return [
        Body(part=own[0], modulus=own[1], density=own[2], side=own[3], velocity=own[4 : 4 + d], middle=own[4 + d :])
        for own in each
    ]
