"""Contact of particles' faces with rigid surfaces: walls and colliders that push where the material's surface is."""

from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes
from mpmjax.boundary._faces import Faces
from mpmjax.boundary._friction import friction_across, friction_along
from mpmjax.boundary._springs import SIGNS, Springs, along
from mpmjax.checks import require
from mpmjax.discretisation import scatter
from mpmjax.geometry import length


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
    opposite: Float[Array, "p"] | None = None
    """Signed distance of each particle from a second surface that faces this one, as the other wall of a vessel does
    [m], shape (p,); None without one."""


class SurfaceContact(AbstractContact):
    """A surface, or two that face each other, that pushes the faces of particles. Each particle is a place at each.

    The gap g_p is the particle's distance from the surface less its half-width along the normal. A particle that is
    held has a spring of stiffness k_p on its gap (see `Springs`), which pushes with −k_p g_p: with the gap at the end
    of the step, in an explicit step with that at its start. It is held if that gap is below zero, so that the spring
    pushes and the two conditions exclude each other.

    The stiffness of a face that comes with the velocity w is that of M + ρ0 w² in the place of the wave modulus M, as
    in a shock: a particle by itself, of half a spacing, is stopped within half a spacing at any speed.

    The energy ½ k_p min(g_p, 0)² is convex in g_p. So a force by the gap at the end of the step takes at least as much
    energy as the spring keeps, −k_p g¹ (g¹ − g⁰) ≤ ½ k_p (min(g⁰, 0)² − min(g¹, 0)²), at any step, as long as k_p
    does not grow. An integrator that evaluates forces at θ of the step's displacement gets the force by springs of gap
    θ g⁰ and stiffness k_p/θ.

    Friction is at most μ times the push of the particles around each node.
    """

    gap: Float[Array, "s p"]
    """g_p with the particles at the start of the step, and the surface at its end or, in an explicit step, at its start
    [m], shape (s, p), of s surfaces."""
    normal: Float[Array, "d p"]
    """n_p of the first surface [-], shape (d, p)."""
    arm: Float[Array, "d p"]
    """b_p at the first surface [m], shape (d, p) (see `Springs`)."""
    stiffness: Float[Array, "s p"]
    """k_p at the velocities of the start of the step [N/m], shape (s, p) (see `Faces.stiffness_at`)."""
    velocity: Float[Array, "d p"] | None
    """Velocity of the surface [m/s], shape (d, p); None at rest."""
    faces: Faces
    coefficient: Scalar
    """Coulomb coefficient [-]."""
    axis: int | None = eqx.field(static=True)
    """The axis of its normal; None if that is along no axis."""
    body: int | None = eqx.field(static=True)
    """The number of the collider that it belongs to; None if it belongs to none."""
    beside: Bool[Array, "s p"] | None = None
    """The particles that it may push, shape (s, p); None for all."""

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
        held, share = active & self.near, self.faces.share
        return Springs(
            stretch=share * jnp.where(held, self.gap, 0),
            stiffness=jnp.where(held, self.stiffness / share, 0),
            normal=self.normal,
            arm=self.arm,
        )

    @property
    def near(self) -> Bool[Array, "s p"]:
        """The particles whose face is less than a spacing before or behind the surface, shape (s, p): what is
        further does not come to it in a step, or has passed it."""
        near = jnp.abs(self.gap) < self.faces.spacing
        return near if self.beside is None else near & self.beside

    def gap_felt(self, held: ConstrainedNodes) -> Float[Array, "s p"]:
        """The gap that the spring feels [m], shape (s, p); infinite for particles that are not near."""
        every = self.springs(jnp.ones(self.gap.shape, bool))
        return jnp.where(self.near, every.stretched(held.moved) / self.faces.share, jnp.inf)

    def push(self, held: ConstrainedNodes, active: Array) -> Float[Array, "s p"]:
        """The normal impulse on each particle in the step [kg m/s], shape (s, p)."""
        shut = active & self.near
        return jnp.where(shut, -self.faces.dt * self.stiffness * jnp.where(shut, self.gap_felt(held), 0), 0)

    def likely_held(self, held: ConstrainedNodes, v: NodeVector) -> Bool[Array, "s p"]:
        del v
        return self.gap_felt(held) < 0

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> Float[Array, "s p"]:
        """The gap over the step [m/s]."""
        del v
        return self.gap_felt(held) / self.faces.dt

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> Float[Array, "s p"]:
        del residual
        return -self.faces.dt * self.stiffness * self.gap_felt(held)

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a velocity [m/s], and what that makes of a push [kg m/s]."""
        return noise, noise * self.stiffness * self.faces.dt**2

    def reached(self, active: Array, shape: tuple[int, ...]) -> Bool[Array, "n d"]:
        """All components of the nodes around the particles held."""
        shut = (active & self.near).any(axis=0).astype(self.gap.dtype)
        return jnp.broadcast_to(scatter(self.faces.stencil, shut[None], None, shape[0]) > 0, shape)

    @staticmethod
    def stability_rate(contacts: tuple[Any, ...], nodal_mass: NodeScalar, mass: Array, steepness: Array) -> Array:
        """n k (1 + A b²)/m, with n the largest eigenvalue of the sum of n nᵀ over the surfaces whose springs a particle
        may feel now, at least one, and k that of a face that comes with all of the particle's speed."""
        del nodal_mass
        square = jnp.stack([(c.arm**2).sum(axis=0) for c in contacts]).max(axis=0)
        each = [c.near.sum(axis=0, dtype=c.normal.dtype) * c.normal[:, None] * c.normal for c in contacts]
        number = jnp.maximum(la.symmetric_eigen(reduce(jnp.add, each))[0].max(axis=0), 1)
        faces = contacts[0].faces
        return number * faces.stiffness_at(length(faces.v)) * (1 + steepness * square) / mass

    def friction(self, held: ConstrainedNodes, active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        del residual
        pushes, d = jnp.maximum(self.push(held, active), 0), v.shape[1]
        push = pushes.sum(axis=0)
        around, mirror = [(self.coefficient * push)[None]], held.nodes.mirror
        if self.axis is None:
            velocity = jnp.zeros_like(self.normal) if self.velocity is None else self.velocity
            around += [push[None], along(pushes) * self.normal, push * velocity]
        sums = scatter(self.faces.stencil, jnp.concatenate(around), None, len(v))
        limit = mirror.fold_scalar(sums[:, 0])
        if self.axis is not None:
            return friction_across(held, self.axis, limit, v)
        pushed, normal, moving = mirror.fold_scalar(sums[:, 1]), sums[:, 2 : d + 2], sums[:, d + 2 :]
        moving = mirror.fold(moving) / jnp.where(pushed == 0, 1, pushed)[:, None]
        return friction_along(held, mirror.fold(normal), moving, limit, v)


def surface_contact(surface: Surface, faces: Faces, body: int | None = None) -> SurfaceContact:
    """The contact of the particles' faces with a surface.

    Args:
        surface: the surface.
        faces: the faces.
        body: the number of the collider that it belongs to; None if it belongs to none.
    """
    width, arm = faces.width(surface.normal)
    relative = faces.v.T if surface.velocity is None else faces.v.T - surface.velocity
    leaving = (surface.normal * relative).sum(axis=0)
    distances = (surface.distance,) if surface.opposite is None else (surface.distance, surface.opposite)
    return SurfaceContact(
        gap=jnp.stack(distances) - width,
        normal=surface.normal,
        arm=arm,
        stiffness=jnp.stack([faces.stiffness_at(-sign * leaving) for sign in SIGNS[: len(distances)]]),
        velocity=surface.velocity,
        faces=faces,
        coefficient=surface.friction,
        axis=surface.axis,
        body=body,
    )


def refuse_contact(total: bool) -> None:
    """Refuse contact that is judged by where material is in the total description, whose nodes do not know it.

    Raises:
        ValueError: the description is total Lagrangian.
    """
    require(
        not total,
        "In the total description there is no contact: use the updated one, or SymmetryPlane or SlipBox for a wall "
        "that is never left.",
    )
