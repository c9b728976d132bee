"""The grid's side of a step: what the particles bring to the nodes, and what the nodes' new velocity is made from."""

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._boundary import Conditions, combine, mirror
from mpmjax._kernel import Stencil
from mpmjax._particles import Particles
from mpmjax._potential import ElasticPotential
from mpmjax._scene import Scene
from mpmjax._transfer import p2g, spread
from mpmjax._types import Array, Bool, Float, Mask, NodeScalar, NodeVector, Scalar, components


class Nodes(eqx.Module):
    """What the velocity update of one step is given."""

    mass: NodeScalar
    """m_i [kg], shape (n,), folded at symmetry planes."""
    velocity: NodeVector
    """v_i^n [m/s], shape (n, d); zero on empty nodes."""
    occupied: Bool[Array, "n 1"]
    """Whether the node has mass beyond rounding, shape (n, 1)."""
    acceleration: Array
    """Body acceleration g [m/s²], shape (d,), or (n, d) where it varies."""
    dt: Float[Array, ""]
    """Δt [s]."""
    spacing: Float[Array, ""]
    """dx [m]."""
    potential: ElasticPotential
    """Φ, of nodal displacements."""
    conditions: Conditions
    """What the boundaries prescribe."""

    def explicit_velocity(self) -> NodeVector:
        """v* = v^n + Δt f / m + Δt g (reference, eq. 4)."""
        f = self.potential.rest_force(self.velocity)
        return jnp.where(self.occupied, self.inertial_velocity() + self.dt * self.per_mass(f), 0)

    def inertial_velocity(self) -> NodeVector:
        """ṽ = v^n + Δt g."""
        return jnp.where(self.occupied, self.velocity + self.dt * self.acceleration, 0)

    def per_mass(self, impulse: NodeVector) -> NodeVector:
        """An impulse or force over the nodes' mass; zero on empty nodes."""
        return jnp.where(self.occupied, impulse / jnp.where(self.occupied, self.mass[:, None], 1), 0)

    def free(self, active: Mask | bool) -> Mask:
        """The components that neither a boundary prescribes nor a wall holds, on nodes that have mass."""
        return self.occupied & ~self.conditions.fixed & ~jnp.asarray(active)


def particles_to_grid(scene: Scene, particles: Particles, t: Scalar, dt: Scalar, stencil: Stencil) -> Nodes:
    """P2G, folded at symmetry planes, with the elastic potential and the boundaries of the step from t to t + dt."""
    grid, window = scene.grid, scene.window(particles)
    v, F = components(particles.v), particles.deformation()
    C = None if particles.C is None else components(particles.C)
    images = mirror(scene.boundary, grid, window)
    gravity = jnp.asarray(scene.gravity)
    with jax.named_scope("p2g"):
        raw, momentum = p2g(stencil, particles.mass, v, C, grid.size)
        mass, momentum = images.fold_scalar(raw), images.fold(momentum)
        occupied = (mass > jnp.finfo(mass.dtype).eps * particles.mass.mean())[:, None]
        full = jnp.where(occupied, mass[:, None], 1)
        if scene.body_force is None and not images.images:
            acceleration = gravity
        else:  # a force is folded like the momentum it makes: a plane's mirror image is pulled the other way
            force = raw[:, None] * gravity
            if scene.body_force is not None:
                push = particles.mass * components(scene.body_force.acceleration(particles.x, t))
                force = force + spread(stencil.index, stencil.weight[:, None], push[None], grid.size)
            acceleration = jnp.where(occupied, images.fold(force) / full, 0)
    return Nodes(
        mass=jnp.where(occupied[:, 0], mass, 0),
        velocity=jnp.where(occupied, momentum / full, 0),
        occupied=occupied,
        acceleration=acceleration,
        dt=jnp.asarray(dt),
        spacing=jnp.asarray(grid.spacing),
        potential=ElasticPotential(scene.material, particles.volume, F, None if scene.total else F, stencil, images),
        conditions=combine(scene.boundary, grid.nodes(window), grid.spacing, t, dt, reference=scene.total),
    )
