"""Contact of particles' faces with rigid surfaces: walls and colliders that push where the material's surface is."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes
from mpmjax.boundary._faces import Faces
from mpmjax.boundary._friction import friction_across, friction_along
from mpmjax.boundary._springs import Springs, spring_force
from mpmjax.discretisation import gather, scatter


class Surface(NamedTuple):
    """A rigid surface, as the particles see it."""

    distance: Float[Array, "p"]
    """Signed distance of each particle from it [m], shape (p,), below zero behind it."""
    normal: Float[Array, "d p"]
    """Unit normal towards the material [-], shape (d, p)."""
    friction: Scalar
    """Coulomb coefficient [-]."""
    velocity: Float[Array, "d p"] | None = None
    """Velocity of the surface [m/s], shape (d, p); None at rest."""
    axis: int | None = None
    """The axis of its normal; None if that is along no axis."""


class SurfaceContact(AbstractContact):
    """A surface that pushes the faces of particles. Each particle is a place.

    The gap g_p is the particle's distance from the surface less its half-width along the normal. A particle that is
    held has a spring of stiffness k_p on its gap (see `Springs`), and it is held if its gap is below zero where the
    integrator evaluates the force: then the spring pushes, and the two conditions exclude each other. Friction is at
    most μ times the push of the particles around each node.
    """

    gap: Float[Array, "p"]
    """g_p at the start of the step, from the surface as it is when forces act [m], shape (p,)."""
    normal: Float[Array, "d p"]
    """n_p [-], shape (d, p)."""
    widening: Array
    """B_p [m], shape (d, d, p)."""
    velocity: Float[Array, "d p"] | None
    """Velocity of the surface [m/s], shape (d, p); None at rest."""
    faces: Faces
    coefficient: Scalar
    """Coulomb coefficient [-]."""
    axis: int | None = eqx.field(static=True)
    """The axis of its normal; None if that is along no axis."""
    body: int | None = eqx.field(static=True)
    """The number of the collider that it belongs to; None if it belongs to none."""

    @property
    def friction_order(self) -> float:
        return 3.0 if self.axis is None else float(self.axis)

    @property
    def collider(self) -> int | None:
        return self.body

    @property
    def known_at_start(self) -> bool:
        """An explicit step's force is that of the gaps at its start."""
        return True

    def springs(self, active: Array) -> Springs:
        held = active & self.near
        return Springs(
            jnp.where(held, self.gap, 0), jnp.where(held, self.faces.stiffness, 0), self.normal, self.widening
        )

    @property
    def near(self) -> Bool[Array, "p"]:
        """The particles whose face is less than a spacing before or behind the surface, shape (p,): what is further
        does not come to it in a step, or has passed it."""
        return jnp.abs(self.gap) < self.faces.spacing

    def gap_felt(self, held: ConstrainedNodes) -> Float[Array, "p"]:
        """The gap where the force is evaluated [m], shape (p,); infinite for particles that are not near."""
        every = Springs(jnp.where(self.near, self.gap, 0), self.faces.stiffness, self.normal, self.widening)
        u = held.displacement
        moved = None if u is None else gather(self.faces.stencil, held.unheld.mirror.unfold(u))
        return jnp.where(self.near, every.opened(moved), jnp.inf)

    def push(self, held: ConstrainedNodes, active: Array) -> Float[Array, "p"]:
        """The normal impulse on each particle in the step [kg m/s], shape (p,)."""
        shut = active & self.near
        return jnp.where(shut, -self.faces.dt * self.faces.stiffness * jnp.where(shut, self.gap_felt(held), 0), 0)

    def likely_held(self, held: ConstrainedNodes, v: NodeVector) -> Bool[Array, "p"]:
        del v
        return self.gap_felt(held) < 0

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> Float[Array, "p"]:
        """The gap over the step [m/s]."""
        del v
        return self.gap_felt(held) / self.faces.dt

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> Float[Array, "p"]:
        del residual
        return -self.faces.dt * self.faces.stiffness * self.gap_felt(held)

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a velocity [m/s], and what that makes of a push [kg m/s]."""
        return noise, noise * self.faces.stiffness * self.faces.dt**2

    def reached(self, active: Array, shape: tuple[int, ...]) -> Bool[Array, "n d"]:
        """All components of the nodes around the particles held."""
        shut = (active & self.near).astype(self.gap.dtype)
        return jnp.broadcast_to(scatter(self.faces.stencil, shut[None], None, shape[0]) > 0, shape)

    def spring_impulse(self, held: ConstrainedNodes, active: Array) -> NodeVector:
        mirror, size = held.unheld.mirror, len(held.unheld.mass)
        return self.faces.dt * spring_force(
            (self.springs(active),), self.faces.stencil, mirror, held.displacement, size
        )

    def friction(self, held: ConstrainedNodes, active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        del residual
        push, d = jnp.maximum(self.push(held, active), 0), v.shape[1]
        around, mirror = [(self.coefficient * push)[None]], held.nodes.mirror
        if self.axis is None:
            velocity = jnp.zeros_like(self.normal) if self.velocity is None else self.velocity
            around += [push[None], push * self.normal, push * velocity]
        sums = scatter(self.faces.stencil, jnp.concatenate(around), None, len(v))
        limit = mirror.fold_scalar(sums[:, 0])
        if self.axis is not None:
            return friction_across(held, self.axis, limit, v)
        pushed, normal, moving = mirror.fold_scalar(sums[:, 1]), sums[:, 2 : d + 2], sums[:, d + 2 :]
        moving = mirror.fold(moving) / jnp.where(pushed == 0, 1, pushed)[:, None]
        return friction_along(held, mirror.fold(normal), moving, limit, v)


def surface_contact(surface: Surface, faces: Faces, body: int | None) -> SurfaceContact:
    """The contact of the particles' faces with a surface.

    Args:
        surface: the surface.
        faces: the faces.
        body: the number of the collider that it belongs to; None if it belongs to none.
    """
    width, widening = faces.width(surface.normal)
    return SurfaceContact(
        gap=surface.distance - width,
        normal=surface.normal,
        widening=widening,
        velocity=surface.velocity,
        faces=faces,
        coefficient=surface.friction,
        axis=surface.axis,
        body=body,
    )
