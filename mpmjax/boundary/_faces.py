"""The faces of particles: how far the material of each reaches beyond its centre, and how stiff it is there."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, ParticleVector, Scalar
from mpmjax.discretisation import Stencil

EXPLICIT_STIFFNESS = 2.0
"""Stiffness of contact in explicit steps, in the material's wave modulus over a spacing: that of half a spacing of the
material. More would shorten the longest stable step."""
IMPLICIT_STIFFNESS = 20.0
"""Stiffness of contact in implicit steps, in the material's wave modulus over a spacing."""


class FaceShape(eqx.Module):
    """The shapes of particles of one material: cubes of side l0 = V0^(1/d) that their deformation makes ellipsoids.

    Along a unit vector n the half-width of a particle is h = ½ l0 ‖Fᵀn‖, which is the face's distance wherever n is
    along an edge. Where only the elastic part of the deformation is known or J alone, h = ½ l0 J^(1/d) after each step.
    """

    half: Float[Array, "q"]
    """½ l0 [m], shape (q,)."""
    deformation: Deformation
    """F [-], shape (d, d, q), or J, shape (q,)."""
    rows: tuple[int, int] = eqx.field(static=True)
    """First particle, and the one after the last."""
    total: bool = eqx.field(static=True)
    """Whether gradients are with respect to the reference positions."""

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

    x: ParticleVector
    """Positions at the start of the step [m], shape (p, d)."""
    v: ParticleVector
    """Velocities at the start of the step [m/s], shape (p, d)."""
    shapes: tuple[FaceShape, ...]
    """Their shapes, one for each material."""
    stiffness: Float[Array, "p"]
    """Stiffness of contact of a face at rest A α M/dx [N/m], shape (p,), with M the modulus of contact (see
    `AbstractLaw.contact_modulus`), α the stiffness of explicit or implicit steps, and A the face's area: V0/l0, and in
    explicit steps V0 over the side of its material's largest particle."""
    inertia: Float[Array, "p"]
    """A α ρ0/dx [kg/m²], shape (p,): times the square of the velocity of approach, the stiffness of contact that a
    shock adds."""
    stencil: Stencil
    spacing: Scalar
    """dx [m]."""
    dt: Scalar
    """Δt [s]."""
    force_at: Scalar = 0.0
    """The share θ of the step's displacement at which the integrator evaluates forces; 0 at its start."""
    explicit: bool = eqx.field(static=True, default=True)
    """Whether the step is explicit."""

    @property
    def share(self) -> Scalar:
        """θ, or 1 where forces are those at the start of the step."""
        if self.explicit:
            return 1.0
        at = jnp.asarray(self.force_at)
        return jnp.where(at > 0, at, 1)

    def stiffness_at(self, approach: Float[Array, "p"]) -> Float[Array, "p"]:
        """k_p = A α (M + ρ0 max(w, 0)²)/dx [N/m], shape (p,), at the velocity of approach w [m/s]."""
        return self.stiffness + self.inertia * jnp.maximum(approach, 0) ** 2

    def width(self, n: Float[Array, "d p"]) -> tuple[Float[Array, "p"], Float[Array, "d p"]]:
        """Half-widths h [m] along unit vectors n, shape (p,), and arms b [m], shape (d, p), with δh = n · ∇u b."""
        parts = [shape.width(n[:, slice(*shape.rows)]) for shape in self.shapes]
        if len(parts) == 1:
            return parts[0]
        widths, arms = zip(*parts, strict=True)
        return jnp.concatenate(widths), jnp.concatenate(arms, axis=-1)
