"""Contact with rigid surfaces: walls and colliders that push particles' faces, where the material's surface is, and
surfaces of any shape that hold what flows while it presses.

A particle is a cube of side l0 = V0^(1/d) that its deformation makes an ellipsoid. Its face is behind its centre x_p by
the arm b_p, and moves by u − ∇u b under a displacement u. So the gap to a surface of unit normal n,

    g_p(u) = g_p(0) + n_p · Σ_i (w_ip − b_p · g_ip) u_i,

is linear in the displacement of the nodes about the start of the step. The force of a spring on it,
−k_p g_p (w_ip − b_p · g_ip) n_p on each node, acts at the face: its moment is that of −k_p g_p n_p there.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, NodeScalar, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._contact import AbstractContact, AbstractSpringContact, ConstrainedNodes, friction_change
from mpmjax.checks import require
from mpmjax.discretisation import Stencil, scatter
from mpmjax.geometry import length
from mpmjax.potential import AbstractSpring, Displacement, Forces, SurfaceImage

EXPLICIT_STIFFNESS = 2.0
"""Stiffness of contact in explicit steps, in the material's wave modulus over a spacing: that of half a spacing of the
material. More would shorten the longest stable step."""
IMPLICIT_STIFFNESS = 20.0  # stiffness of contact in implicit steps, in the material's wave modulus over a spacing
SIGNS = (1, -1)  # the directions of two surfaces that face each other, along the normal of the first


class FaceShape(eqx.Module):
    """The shapes of particles of one material.

    Along a unit vector n the half-width of a particle is h = ½ l0 ‖Fᵀn‖, which is the face's distance wherever n is
    along an edge. Where only the elastic part of the deformation is known or J alone, h = ½ l0 J^(1/d) after each step.
    """

    half: Float[Array, "q"]  # ½ l0 [m], shape (q,)
    deformation: Deformation  # F [-], shape (d, d, q), or J, shape (q,)
    rows: tuple[int, int] = eqx.field(static=True)  # first particle, and the one after the last
    total: bool = eqx.field(static=True)  # whether gradients are with respect to the reference positions
    flows: bool = eqx.field(static=True, default=False)  # whether the material resists changes of volume alone

    def width(self, n: Float[Array, "d q"]) -> tuple[Float[Array, "q"], Float[Array, "d q"]]:
        """h [m], shape (q,), and the arm b [m] from the face to the centre, shape (d, q): δh = n · ∇u b for a
        displacement u. By J alone b = h n, so that pressure acts where the face is whatever the flow (that J^(1/d)
        changes by another amount is made up for in the next step)."""
        F, d = self.deformation, len(n)
        if F.ndim == 1:
            h = self.half * jnp.where(F > 0, F, 1) ** (1 / d)  # a volume below zero is a fault that is told elsewhere
            return h, h * n
        m = la.matmul(la.transpose(F), n[:, None])[:, 0]
        square = (m**2).sum(axis=0)
        stretch = jnp.sqrt(jnp.where(square == 0, 1, square))
        return self.half * stretch, self.half / stretch * (m if self.total else la.matmul(F, m[:, None])[:, 0])


class Faces(eqx.Module):
    """The particles as contact with surfaces knows them in a step."""

    x: ParticleVector  # positions at the start of the step [m], shape (p, d)
    v: ParticleVector  # velocities at the start of the step [m/s], shape (p, d)
    shapes: tuple[FaceShape, ...]  # their shapes, one for each material
    stiffness: Float[Array, "p"]
    """Stiffness of contact of a face at rest A α M/dx [N/m], shape (p,), with M the modulus of contact (see
    `AbstractLaw.contact_modulus`), α the stiffness of explicit or implicit steps, and A the face's area: V0/l0, and in
    explicit steps V0 over the side of its material's largest particle."""
    inertia: Float[Array, "p"]
    """A α ρ0/dx [kg/m²], shape (p,): times the square of the velocity of approach, the stiffness of contact that a
    shock adds."""
    stencil: Stencil  # the nodes of each particle
    spacing: Scalar  # dx [m]
    dt: Scalar  # Δt [s]
    push_time: Scalar  # the time at which surfaces push [s]: the start of an explicit step, the end of an implicit one
    share: Scalar = 1.0
    """θ, the share of the step's displacement at which the integrator evaluates forces; 1 at its start."""
    explicit: bool = eqx.field(static=True, default=True)  # whether the step is explicit

    @property
    def flowing(self) -> Bool[np.ndarray, "p"]:
        """The particles of materials that flow, shape (p,)."""
        return self._each([shape.flows for shape in self.shapes])

    @property
    def round(self) -> Bool[np.ndarray, "p"]:
        """The particles whose faces are known by their volume alone, as they yield or flow, shape (p,)."""
        return self._each([shape.deformation.ndim == 1 for shape in self.shapes])

    def _each(self, of_materials: list[bool]) -> Bool[np.ndarray, "p"]:
        return np.repeat(of_materials, [len(shape.half) for shape in self.shapes])

    @property
    def flowing_volume(self) -> Float[Array, "p"]:
        """The volume of each of these [m^d], shape (p,), zero of others."""
        d, parts = self.x.shape[1], []
        for shape in self.shapes:
            F = shape.deformation
            volume = (2 * shape.half) ** d * (F if F.ndim == 1 else la.determinant(F))
            parts.append(volume if shape.flows else jnp.zeros_like(volume))
        return jnp.concatenate(parts)

    def stiffness_at(self, approach: Float[Array, "p"]) -> Float[Array, "p"]:
        """k_p = A α (M + ρ0 max(w, 0)²)/dx [N/m], shape (p,), at the velocity of approach w [m/s]: as in a shock, so
        that a particle by itself is stopped within half a spacing at any speed."""
        return self.stiffness + self.inertia * jnp.maximum(approach, 0) ** 2

    def width(self, n: Float[Array, "d p"]) -> tuple[Float[Array, "p"], Float[Array, "d p"]]:
        """Half-widths h [m] along unit vectors n, shape (p,), and arms b [m], shape (d, p), with δh = n · ∇u b."""
        parts = [shape.width(n[:, slice(*shape.rows)]) for shape in self.shapes]
        if len(parts) == 1:
            return parts[0]
        widths, arms = zip(*parts, strict=True)
        return jnp.concatenate(widths), jnp.concatenate(arms, axis=-1)


class Springs(AbstractSpring):
    """The springs between one surface, or two that face each other, and the particles: s is 1 or 2."""

    stretch: Float[Array, "s p"]  # g_p at u = 0 [m], shape (s, p); zero where nothing is held
    stiffness: Float[Array, "s p"]  # k_p [N/m], shape (s, p); zero where nothing is held
    normal: Float[Array, "d p"]  # n_p [-], out of the first surface, shape (d, p); the second one's is the opposite
    arm: Float[Array, "d p"]
    """b_p [m], from the face at the first surface to the centre, shape (d, p); the second one's is the opposite."""

    def elongation(self, moved: Displacement) -> Float[Array, "s p"]:
        """n · (u − ∇u b) [m], shape (s, p)."""
        (value, slopes), d = moved.at_particles, len(self.normal)
        shift = (self.normal * value).sum(axis=0)
        growth = (self.normal[None] * self.arm[:, None] * slopes[:d, :d]).sum(axis=(0, 1))
        return jnp.stack([sign * shift - growth for sign in SIGNS[: len(self.stretch)]])

    def spread(self, amount: Float[Array, "s p"], size: int) -> Forces:
        along = amount[0] - amount[1:].sum(axis=0)  # the normal of the first surface
        return Forces(value=along * self.normal, slopes=-amount.sum(axis=0) * self.arm[:, None] * self.normal)

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        """Without the products of weights and their derivatives."""
        k = self.stiffness.sum(axis=0)
        return Forces(value=k * self.normal**2, slopes=k * (self.arm[:, None] * self.normal) ** 2)


class Surface(NamedTuple):
    """A rigid surface, as the particles see it."""

    distance: Float[Array, "p"]  # signed distance of each particle from it [m], shape (p,), below zero behind it
    normal: Float[Array, "d p"]  # unit normal towards the material [-], shape (d, p)
    friction: Scalar  # Coulomb coefficient [-]
    velocity: Float[Array, "d p"] | None = None  # velocity of the surface [m/s], shape (d, p); None at rest
    axis: int | None = None  # the axis of its normal; None if that is along no axis
    opposite: Float[Array, "p"] | None = None
    """Signed distance of each particle from a second surface that faces this one, as the other wall of a vessel does
    [m], shape (p,); None without one."""


class SurfaceContact(AbstractSpringContact):
    """A surface, or two that face each other, that pushes the faces of particles. Each particle is a place at each.

    The gap g_p is the particle's distance from the surface less its half-width along the normal, at the start of the
    step; the surface is where it is at `Faces.push_time`. Friction is at most μ times the push of the particles around
    each node.
    """

    gap: Float[Array, "s p"]
    near: Bool[Array, "s p"]
    """The particles that it may push, whose face is less than a spacing before or behind the surface: one that is
    further does not come to it in a step, or has passed it."""
    normal: Float[Array, "d p"]  # n_p of the first surface [-], shape (d, p)
    arm: Float[Array, "d p"]  # b_p at the first surface [m], shape (d, p) (see `Springs`)
    stiffness: Float[Array, "s p"]
    velocity: Float[Array, "d p"] | None  # velocity of the surface [m/s], shape (d, p); None at rest
    faces: Faces  # the faces that are pushed
    dt: Scalar
    share: Scalar
    coefficient: Scalar  # Coulomb coefficient [-]
    axis: int | None = eqx.field(static=True)  # the axis of its normal; None if that is along no axis

    def at(self, share: Scalar) -> "SurfaceContact":
        if self.velocity is None:
            return self
        way = (1 - share) * self.dt * (self.normal * self.velocity).sum(axis=0)
        return replace(self, gap=self.gap + jnp.stack([sign * way for sign in SIGNS[: len(self.gap)]]))

    def spread(self, stretch: Array, stiffness: Array) -> Springs:
        return Springs(stretch, stiffness, self.normal, self.arm)

    @staticmethod
    def stability_rate(contacts: tuple[Any, ...], nodal_mass: NodeScalar, mass: Array, steepness: Array) -> Array:
        """n k (1 + A b²)/m, with n the largest eigenvalue of the sum of n nᵀ over the surfaces whose springs a particle
        may feel now, at least one, and k that of a face that comes with all of the particle's speed."""
        square = jnp.stack([(c.arm**2).sum(axis=0) for c in contacts]).max(axis=0)
        each = [c.near.sum(axis=0, dtype=c.normal.dtype) * c.normal[:, None] * c.normal for c in contacts]
        number = jnp.maximum(la.symmetric_eigen(reduce(jnp.add, each))[0].max(axis=0), 1)
        faces = contacts[0].faces
        return number * faces.stiffness_at(length(faces.v)) * (1 + steepness * square) / mass

    def friction(
        self, held: ConstrainedNodes, active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector]:
        pushes, (size, d) = jnp.where(active, jnp.maximum(self.normal_impulse(held, residual), 0), 0), residual.shape
        push, mirror = pushes.sum(axis=0), held.nodes.potential.mirror
        limit = self.coefficient * push
        if self.axis is not None:
            limit = mirror.fold_scalar(scatter(self.faces.stencil, limit[None], None, size)[:, 0])
            normal, moving = (jnp.arange(d) == self.axis).astype(limit.dtype), 0.0
        else:
            velocity = jnp.zeros_like(self.normal) if self.velocity is None else self.velocity
            around = jnp.concatenate(
                [limit[None], push[None], (pushes[0] - pushes[1:].sum(axis=0)) * self.normal, push * velocity]
            )
            sums = scatter(self.faces.stencil, around, None, size)
            limit, pushed = mirror.fold_scalar(sums[:, :2]).T
            # both in one pass: each map of a surface is large to compile
            normal, moving = jax.vmap(mirror.fold, 1)(sums[:, 2:].reshape(size, 2, d))
            moving = moving / jnp.where(pushed == 0, 1, pushed)[:, None]
        return friction_change(held.nodes.projection, held.nodes.mass, normal, moving, limit)


def surface_contact(surface: Surface, faces: Faces) -> SurfaceContact:
    """The contact of the particles' faces with a surface."""
    width, arm = faces.width(surface.normal)
    relative = faces.v.T if surface.velocity is None else faces.v.T - surface.velocity
    leaving = (surface.normal * relative).sum(axis=0)
    distances = (surface.distance,) if surface.opposite is None else (surface.distance, surface.opposite)
    gap = jnp.stack(distances) - width
    return SurfaceContact(
        gap=gap,
        near=jnp.abs(gap) < faces.spacing,
        normal=surface.normal,
        arm=arm,
        stiffness=jnp.stack([faces.stiffness_at(-sign * leaving) for sign in SIGNS[: len(distances)]]),
        velocity=surface.velocity,
        faces=faces,
        dt=faces.dt,
        share=faces.share,
        coefficient=surface.friction,
        axis=surface.axis,
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


class FlowContact(AbstractContact):
    """A surface that holds the nodes of what flows by its map (see `surface_image`). A place is a node k that others
    follow; a node is held where most of those that it follows are.

    The normal impulse is r_k = Σ τ_ik (1 − ξ_i/ξ_k) n_i·R_i, with R the impulses that are missing at the nodes: what
    they leave on k is the map's. The gap velocity is what r works on, −r of an explicit step that holds the place: so
    much of m (v − B a), with a the folded velocity.
    """

    image: SurfaceImage  # the map where all is held
    coefficient: Scalar  # Coulomb coefficient [-]
    shut: Bool[Array, "n"]  # the places that may be held

    def images(self, active: Array) -> tuple[SurfaceImage, ...]:
        return (self.image.where(active),)

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> NodeScalar:
        """The momentum with which the nodes that follow leave the surface [kg m/s]."""
        mass, image = held.unconstrained.mass, self.image.taking(held.unconstrained.mass > 0)
        v = v if image.velocity is None else v - image.velocity
        speed, height = (image.normal * v).sum(axis=1), image.height
        before = jnp.where(height > 0, height, 1)
        follows = jnp.where(image.follows, mass, 0)
        sums = image.spread(jnp.stack([follows * height * speed, follows * height**2], axis=1)).T
        folded = (mass * speed + sums[0] / before) / jnp.where(mass > 0, mass + sums[1] / before**2, 1)
        lacking = follows * (speed - height * image.mean((folded / before)[:, None])[:, 0])
        return jnp.where(self.shut, self._pressed(image, lacking), 0)

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        image = self.image.taking(held.unconstrained.mass > 0)
        missing = (image.normal * held.without_collider_impulses(residual)).sum(axis=1)
        return self._pressed(image, jnp.where(image.follows, missing, 0))

    @staticmethod
    def _pressed(image: SurfaceImage, impulse: NodeScalar) -> NodeScalar:
        """Σ τ_ik (1 − ξ_i/ξ_k) of impulses along normals, on nodes that follow."""
        plain, arm = image.spread(jnp.stack([impulse, image.height * impulse], axis=1)).T
        return plain - arm / jnp.where(image.height > 0, image.height, 1)

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a place's momentum [kg m/s], for both."""
        least = noise * self.image.spread(jnp.where(self.image.follows, held.unconstrained.mass, 0)[:, None])[:, 0]
        return least, least

    def friction(
        self, held: ConstrainedNodes, active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector]:
        limit = self.coefficient * jnp.where(active, jnp.maximum(self.normal_impulse(held, residual), 0), 0)
        moving = 0.0 if self.image.velocity is None else self.image.velocity
        nodes = held.nodes
        return friction_change(nodes.projection, nodes.mass, self.image.normal, moving, limit)
