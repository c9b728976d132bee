"""The surfaces of a scene's bodies, as they see each other in a step."""

from itertools import combinations, combinations_with_replacement

import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeScalar, Scalar, components
from mpmjax.boundary import EXPLICIT_STIFFNESS, IMPLICIT_STIFFNESS, Body, BodyContact, Mirror, body_contact
from mpmjax.discretisation import Stencil, scatter
from mpmjax.state import MaterialPoints, Particles, Scene


def contacts_of_bodies(
    scene: Scene,
    particles: Particles,
    materials: tuple[MaterialPoints, ...],
    stencil: Stencil,
    images: Mirror,
    t: Scalar,
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
        t: time at the start of the step [s].
        dt: step [s].
        force_at: the share of the step's displacement at which forces are evaluated; None if the step is explicit.
    """
    if scene.bodies is None:
        return ()
    bodies = _bodies(scene, particles, materials, stencil, images, t)
    at = jnp.ones(()) if force_at is None else jnp.asarray(force_at)
    return tuple(
        body_contact(
            bodies[pair[0]],
            bodies[pair[1]],
            pair,
            friction=scene.bodies.friction,
            order=scene.kernel.order,
            spacing=scene.grid.spacing,
            dt=dt,
            stiffness=EXPLICIT_STIFFNESS if force_at is None else IMPLICIT_STIFFNESS,
            share=jnp.where(at > 0, at, 1).astype(particles.x.dtype),
        )
        for pair in combinations(range(scene.grid.layers), 2)
    )


def _bodies(
    scene: Scene,
    particles: Particles,
    materials: tuple[MaterialPoints, ...],
    stencil: Stencil,
    images: Mirror,
    t: Scalar,
) -> list[Body]:
    """The bodies, one for each layer of nodes."""
    d, dx, layers = particles.dim, jnp.asarray(scene.grid.spacing), scene.grid.layers
    volume = jnp.concatenate([points.volume * jnp.abs(points.volume_ratio()) for points in materials]) / dx**d
    modulus = jnp.concatenate([jnp.broadcast_to(p.law.wave_modulus(p.deformation), p.volume.shape) for p in materials])
    density = particles.mass / (volume * dx**d)
    of_volume = jnp.stack([jnp.ones_like(volume), modulus, density, volume ** (1 / d)])
    sums = scatter(stencil, volume * jnp.concatenate([of_volume, components(particles.v)]), None, scene.grid.size).T
    scalars, velocity = sums[:4], images.fold(sums[4:].T).T

    # w (x_p − x_i)_a = −D_a g_a, with g the moving-least-squares gradient
    nodes = scene.grid.nodes(scene.window(particles))
    places = components(scene.on_grid(particles, t) - nodes[0]) / dx
    nodes = (nodes - nodes[0]).T / dx
    pairs = list(combinations_with_replacement(range(d), 2))
    arms = -volume * stencil.moment / dx
    across = [jnp.eye(d, dtype=volume.dtype)[:, a, None] * arms[a] for a in range(d)]
    across += [jnp.eye(d, dtype=volume.dtype)[:, a, None] * arms[a] * places[b] for a, b in pairs]
    found = scatter(stencil.least_squares, None, jnp.stack(across, axis=1), scene.grid.size).T
    first, second = found[:d], found[d:]
    second = [own - nodes[b] * first[a] for own, (a, b) in zip(second, pairs, strict=True)]
    second = {pair: _fold(images, own, pair) for own, pair in zip(second, pairs, strict=True)}
    first = images.fold(first.T).T
    scalars = jnp.stack([images.fold_scalar(own) for own in scalars])

    part = jnp.where(scalars[0] > 0, scalars[0], 1)
    middle = first / part
    spread = [[second[min(a, b), max(a, b)] / part - middle[a] * middle[b] for b in range(d)] for a in range(d)]
    each = jnp.concatenate([scalars[:1], scalars[1:] / part, velocity / part, middle])
    spread = jnp.stack([jnp.stack(row) for row in spread]).reshape(d, d, layers, -1)
    each = each.reshape(len(each), layers, -1)
    return [
        Body(
            part=own[0],
            modulus=own[1],
            density=own[2],
            side=own[3],
            velocity=own[4 : 4 + d],
            middle=own[4 + d :],
            spread=spread[:, :, number],
        )
        for number, own in enumerate(each.swapaxes(0, 1))
    ]


def _fold(images: Mirror, component: NodeScalar, axes: tuple[int, int]) -> Float[Array, "n"]:
    """A component of a symmetric tensor on the nodes, folded at mirrors: odd across those that one of its axes is
    normal to."""
    a, b = axes
    for image in reversed(images.images):
        one = Mirror((image,))
        if a == b or image.axis not in axes:
            component = one.fold_scalar(component)
            continue
        odd = jnp.zeros((len(component), max(axes) + 1), component.dtype).at[:, image.axis].set(component)
        component = one.fold(odd)[:, image.axis]
    return component
