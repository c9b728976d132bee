"""The layers of nodes of a scene's rigid bodies: from particles to the two nodes that move each body, and back."""

from dataclasses import replace

import jax.numpy as jnp

from mpmjax._types import Array, Bool, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.boundary import Conditions
from mpmjax.geometry import RigidBody, rigid_body, rotation_of, rotation_of_chords, spinning, turn
from mpmjax.potential import Image, Mirror, RigidImage
from mpmjax.state import Particles, RigidMaterial, Scene


def rigid_layers(
    scene: Scene, particles: Particles, mass: NodeScalar, conditions: Conditions, planes: Mirror, dt: Scalar
) -> tuple[Mirror, Bool[Array, "n 1"], NodeVector, Conditions]:
    """The rigid bodies of a scene, whose nodes are folded to two of each layer, the first with the velocity V and the
    second with s = Gω (see `RigidImage`).

    Args:
        scene: the scene.
        particles: prepared particles.
        mass: masses of all nodes, not folded at planes [kg], shape (n,).
        conditions: what boundaries prescribe of all nodes.
        planes: the mirrors of symmetry planes.
        dt: step [s].

    Returns:
        the maps; the nodes of rigid bodies, shape (n, 1); their velocity at the start of the step [m/s], shape (n, d),
        zero elsewhere; and the conditions on all nodes, those of rigid bodies on these two.
    """
    grid, places = scene.grid, scene.nodes(particles, 0.0)  # at any time: planes beside rigid bodies rest
    of_bodies, velocity = jnp.zeros((len(mass), 1), bool), jnp.zeros_like(places)
    fixed, prescribed, images = conditions.fixed, conditions.velocity, []
    for material in scene.rigid_bodies:
        body, freedom, d = _body(particles, material), material.freedom, grid.dim
        root, arms = body.root(), places[: len(places) // grid.layers] - body.centre
        if any(grid.periodic):  # to the nearest image
            period = jnp.asarray(grid.shape, arms.dtype) * grid.spacing
            arms = jnp.where(jnp.asarray(grid.periodic), arms - period * jnp.round(arms / period), arms)
        image = RigidImage(material.layer, grid.layers, arms, jnp.linalg.inv(root) if len(root) else root)

        # which components of V and s are held: what is held of any of the body's nodes is held of all
        layer_mass = image.own(mass)
        held = image.own(conditions.fixed) & (layer_mass > 0)[:, None]
        of_planes = [image.reaches(plane, mass) for plane in planes.images if isinstance(plane, Image)]
        guided = jnp.zeros(d, bool) if freedom.directions is None else ~jnp.asarray(freedom.directions)
        by_nodes = held.any(axis=0)
        by_planes = jnp.stack(of_planes).any(axis=0) if of_planes else jnp.zeros(d, bool)
        spins = freedom.turns & ~by_nodes.any() & ~by_planes.any()
        both = jnp.stack([guided | by_nodes | by_planes, jnp.broadcast_to(~spins, (d,))])

        # at what velocity [m/s]: that of the rigid motion nearest to what is prescribed, from its mean, and from the
        # turning of what is prescribed with all components
        weight = jnp.where(held, layer_mass[:, None], 0)
        total = weight.sum(axis=0)
        per_total = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)
        value = image.own(conditions.velocity)
        mean, middle = per_total * (weight * value).sum(axis=0), per_total * (weight * arms).sum(axis=0)
        whole = jnp.where(held.all(axis=1), layer_mass, 0)
        chords = jnp.where((whole > 0)[:, None], arms - middle, 0)
        angle = jnp.where(freedom.turns, rotation_of_chords(chords, dt * (value - mean), whole), 0)
        back = turn(middle[None], angle)[0] - middle if len(angle) else 0.0  # the centre too moves along its chord
        value = _first_two(image, jnp.where(by_nodes & ~guided, mean - back / dt, 0), root @ angle / dt)[:2]

        images.append(image)
        of_bodies = image.with_own(of_bodies, jnp.ones((len(arms), 1), bool))
        velocity = image.with_own(velocity, _first_two(image, body.velocity, root @ body.spin))
        fixed = image.with_own(fixed, jnp.zeros(arms.shape, bool).at[:2].set(both))
        prescribed = image.with_own(prescribed, jnp.zeros_like(arms).at[:2].set(jnp.where(both, value, 0)))
    return Mirror(tuple(images)), of_bodies, velocity, Conditions(fixed, prescribed, conditions.colliders)


def moved_rigidly(
    scene: Scene,
    before: Particles,
    after: Particles,
    mirror: Mirror,
    fixed: Mask,
    new: NodeVector,
    mean: NodeVector,
    dt: Scalar,
) -> Particles:
    """The particles after G2P with those of rigid bodies moved as one, whatever the transfer:

        c ← c + Δt V̄,    x_p ← c + R (x_p − c),    v_p ← V + ω × (x_p − c),    F_p ← R F_p,

    where R is the rotation at the mean angular momentum I ω̄, and the spin at the end has the angular momentum after the
    step; of a body whose spin is prescribed, R is the rotation by Δt ω̄ and the spin is that. The nodes' velocities,
    after the step and that with which positions move, are folded.
    """
    x, v, C, deformations = after.x, after.v, after.C, list(after.deformations)
    for material, image in zip(scene.rigid_bodies, mirror.rigid, strict=True):
        rows, body = slice(*before.groups[material.number].rows), _body(before, material)
        end, over = image.own(new), image.own(mean)
        R = rotation_of(body, body.inertia @ image.spin(over[1]), dt)
        momentum = body.inertia @ image.spin(end[1])
        spin = momentum / body.inertia.diagonal()
        if before.dim == 3:  # else the inertia does not turn, and what is held is the same
            spin = R @ jnp.linalg.solve(body.inertia, R.T @ momentum)  # (R I Rᵀ)⁻¹ L
            held, axes = image.own(fixed)[1].any(), jnp.eye(3, dtype=x.dtype)
            R = jnp.where(held, turn(axes, dt * image.spin(over[1])).T, R)
            spin = jnp.where(held, image.spin(end[1]), spin)
        arms = (R @ body.arms.T).T
        x = x.at[rows].set(body.centre + dt * over[0] + arms)
        v = v.at[rows].set(end[0] + spinning(spin, arms))
        if C is not None:
            C = C.at[rows].set(spinning(spin, jnp.eye(before.dim, dtype=x.dtype)).T)
        deformations[material.number] = R @ jnp.asarray(before.deformations[material.number])
    return replace(after, x=x, v=v, C=C, deformations=tuple(deformations))


def _body(particles: Particles, material: RigidMaterial) -> RigidBody:
    rows = slice(*particles.groups[material.number].rows)
    return rigid_body(particles.x[rows], particles.v[rows], particles.mass[rows], particles.volume[rows])


def _first_two(image: RigidImage, velocity: Array, s: Array) -> NodeVector:
    """The layer's nodes with V at the first, s at the second and zero elsewhere, shape (m, d)."""
    return jnp.zeros_like(image.arms).at[0].set(velocity).at[1, : len(s)].set(s)
