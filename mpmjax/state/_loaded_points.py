"""Points that are attached to particles, in a step: how the nodes move them, and how forces on them reach the nodes."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Int, Matrix, NodeVector, ParticleMatrix, Scalar, components
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.material import AbstractLaw
from mpmjax.potential import AbstractSpring, Displacement, Forces
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
    particle: Int[Array, "s"]
    """The number of that particle, shape (s,)."""

    def after(self, time: Scalar) -> "LoadedPoints":
        """The points moved on by a time [s] with their velocity, and turned with its gradient."""
        F = self.deformation
        if F is not None and self.rate is not None:
            F = F + time * self.rate
        return eqx.tree_at(
            lambda p: (p.x, p.deformation), self, (self.x + time * self.v, F), is_leaf=lambda leaf: leaf is None
        )

    def displacement(self, moved: Displacement) -> Float[Array, "d s"]:
        """Σ_i N_is u_i, of a displacement or velocity of the nodes."""
        if moved.at_rest:
            return jnp.zeros_like(self.x)
        value, slopes = gather(self.stencil, moved.nodes)
        return value + sum(r * slope for r, slope in zip(self.arm, slopes, strict=True))

    def nodal(self, force: Float[Array, "d s"], size: int) -> NodeVector:
        """Σ_s N_is f_s, the transpose of `displacement`, shape (n, d)."""
        return scatter(self.stencil, force, self.arm[:, None] * force, size)

    def diagonal(self, coefficient: Float[Array, "d s"], size: int) -> NodeVector:
        """Σ_s (w_ip² + Σ_b g_ip,b² r_sb²) k_s [N/m], shape (n, d): a non-negative approximation of the diagonal of
        Σ_s N_is k_s N_js, exact where the arms are zero."""
        return scatter(self.stencil.squared, coefficient, self.arm[:, None] ** 2 * coefficient, size)

    def at_particles(
        self, rates: Float[Array, "s"], mass: Float[Array, "p"], steepness: Float[Array, "p"]
    ) -> Float[Array, "p"]:
        """Σ_s k_s (1 + A_p r_s²)/m_p of each particle, shape (p,), from k_s of each point: a bound of Σ_i N_is² k_s/m_i
        for a particle alone on the grid."""
        reach = 1 + (self.arm**2).sum(axis=0) * steepness[self.particle]
        return jnp.zeros_like(mass).at[self.particle].add(rates * reach) / mass


class Support(AbstractSpring):
    """Springs ½ k_s (e_s + N_s u)² between points and the ground, and dashpots of resistance Σ_s N_sᵀ c_s N_s v."""

    points: LoadedPoints
    stiffness: Float[Array, "d s"]
    """k_s in each direction [N/m]."""
    stretch: Float[Array, "d s"]
    """e_s [m], at the start of the step."""
    damping: Float[Array, "d s"] | None
    """c_s [N s/m]; None without dashpots."""

    def elongation(self, moved: Displacement) -> Float[Array, "d s"]:
        return self.points.displacement(moved)

    def spread(self, amount: Float[Array, "d s"], size: int) -> Forces:
        return Forces(nodes=self.points.nodal(amount, size))

    def spread_square(self, amount: Float[Array, "d s"], size: int) -> Forces:
        return Forces(nodes=self.points.diagonal(amount, size))

    @property
    def viscous(self) -> bool:
        return self.damping is not None

    def resistance(self, velocity: Displacement) -> Forces | None:
        return None if self.damping is None else self.spread(self.damping * self.elongation(velocity), velocity.size)

    def drag(self, size: int) -> tuple[Forces, Float[Array, ""]] | None:
        """At the points' velocity."""
        if self.damping is None:
            return None
        return self.spread(-self.damping * self.points.v, size), (self.damping * self.points.v**2).sum()

    def damped(self, rate: Scalar) -> "Support":
        """Springs of k + r c."""
        return self if self.damping is None else replace(self, stiffness=self.stiffness + rate * self.damping)

    def stability_rates(self, mass: Float[Array, "p"], steepness: Array) -> tuple[Array, Array | float]:
        """Twice what a particle alone feels, which covers transfers that forget the affine velocity."""
        z = self.points.at_particles(2 * self.stiffness.max(axis=0), mass, steepness)
        if self.damping is None:
            return z, 0.0
        return z, self.points.at_particles(4 * self.damping.max(axis=0), mass, steepness)


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
        particle=rows,
    )


def keeps_deformation(law: AbstractLaw) -> bool:
    """Whether particles of a law keep the whole deformation gradient."""
    return law.allows_total and law.measure.undeformed(2).ndim == 2


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
