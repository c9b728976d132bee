"""Points that are attached to particles, in a step: how the nodes move them, and how forces on them reach the nodes."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix, NodeVector, ParticleMatrix, Scalar, components
from mpmjax.boundary import Mirror
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.material import AbstractLaw
from mpmjax.state._attachment import AttachedPoints
from mpmjax.state._particles import Particles


class LoadedPoints(eqx.Module):
    """s points that move with particles: u_s = Σ_i N_is u_i with N_is = w_ip + g_ip·r_s, the particle's own motion at
    the arm r_s. So a force reaches no node that its particle does not reach, its sum is right and so is its moment."""

    x: Float[Array, "d s"]
    """Where they are [m]."""
    v: Float[Array, "d s"]
    """Their velocity, v_p + C_p r_s, without a C v_p [m/s]."""
    deformation: Matrix | None
    """F of their particles [-], shape (d, d, s); None where a law does not keep it."""
    rate: Matrix | None
    """Rate of F [1/s], shape (d, d, s); None without a velocity gradient."""
    place: Float[Array, "d s"]
    """Where they were when they were attached [m]."""
    weight: Float[Array, "s"]
    """Their undeformed areas [m^(d−1)], or shares [-]."""
    area: Float[Array, "d s"] | None
    """Outward normal times area of the undeformed surface [m^(d−1)]; None of points."""
    arm: Float[Array, "d s"]
    """r_s [m]: F_p R_s, in the total description R_s."""
    stencil: Stencil
    """Nodes, weights and derivatives of the particle that each point is attached to."""
    mirror: Mirror
    """The mirrors on which the nodes are folded."""

    def after(self, time: Scalar) -> "LoadedPoints":
        """The points moved on by a time [s] with their velocity, and turned with its gradient."""
        F = self.deformation
        if F is not None and self.rate is not None:
            F = F + time * self.rate
        return eqx.tree_at(
            lambda p: (p.x, p.deformation), self, (self.x + time * self.v, F), is_leaf=lambda leaf: leaf is None
        )

    def displacement(self, u: NodeVector) -> Float[Array, "d s"]:
        """Σ_i N_is u_i, of a displacement or velocity of the nodes, shape (n, d)."""
        value, slopes = gather(self.stencil, self.mirror.unfold(u))
        return value + sum(r * slope for r, slope in zip(self.arm, slopes, strict=True))

    def nodal(self, force: Float[Array, "d s"], size: int) -> NodeVector:
        """Σ_s N_is f_s, the transpose of `displacement`, shape (n, d)."""
        return self.mirror.fold(scatter(self.stencil, force, self.arm[:, None] * force, size))

    def diagonal(self, coefficient: Float[Array, "d s"], like: NodeVector) -> NodeVector:
        """Σ_s (w_ip² + Σ_b g_ip,b² r_sb²) k_s [N/m], shape (n, d): a non-negative approximation of the diagonal of
        Σ_s N_is k_s N_js, exact where the arms are zero."""
        squares = scatter(self.stencil.squared, coefficient, self.arm[:, None] ** 2 * coefficient, like.shape[0])
        return self.mirror.fold_scalars(squares)


def loaded_points(
    on: AttachedPoints, laws: tuple[AbstractLaw, ...], particles: Particles, stencil: Stencil, *, total: bool
) -> LoadedPoints:
    """The points of prepared particles at the start of a step.

    Args:
        on: the points.
        laws: the laws of the particles' materials.
        particles: prepared particles.
        stencil: their stencil.
        total: whether the description is total Lagrangian.
    """
    dtype = particles.x.dtype
    rows = jnp.asarray(on.particle, dtype).astype(jnp.int32)
    offset = jnp.asarray(on.offset, dtype).T
    F = _deformation(laws, particles)
    F = None if F is None else components(F[rows])
    arm = offset if F is None else la.matmul(F, offset[:, None])[:, 0]
    kept = offset if total else arm
    v, rate = components(particles.v[rows]), None
    if particles.C is not None:
        C = components(particles.C[rows])
        v = v + la.matmul(C, kept[:, None])[:, 0]
        rate = None if F is None else C if total else la.matmul(C, F)
    return LoadedPoints(
        x=components(particles.x[rows]) + arm,
        v=v,
        deformation=F,
        rate=rate,
        place=jnp.asarray(on.place, dtype).T,
        weight=jnp.asarray(on.weight, dtype),
        area=None if on.area is None else jnp.asarray(on.area, dtype).T,
        arm=kept,
        stencil=stencil.of(rows),
        mirror=Mirror(()),
    )


def keeps_deformation(law: AbstractLaw) -> bool:
    """Whether particles of a law keep the whole deformation gradient."""
    return law.allows_total and law.kinematics.undeformed(2).ndim == 2


def _deformation(laws: tuple[AbstractLaw, ...], particles: Particles) -> ParticleMatrix | None:
    """F of all particles, shape (p, d, d), the identity of those whose law does not keep it; None if none does."""
    if not any(keeps_deformation(law) for law in laws):
        return None
    still = jnp.eye(particles.dim, dtype=particles.x.dtype)
    parts = []
    for law, stored, count in zip(laws, particles.deformations, particles.sizes, strict=True):
        whole = keeps_deformation(law) and stored is not None
        parts.append(jnp.asarray(stored) if whole else jnp.broadcast_to(still, (count, *still.shape)))
    return jnp.concatenate(parts)
