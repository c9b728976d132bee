"""The particles of one material in a step: their law, their deformation, and how the grid's motion changes it."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix, particle_first
from mpmjax.material import AbstractInelastic, AbstractMaterial, Law, Viscosity, Viscous
from mpmjax.state._particles import Group, Particles

Laws = Law | Viscous | tuple[Law | Viscous, ...]
"""One law for all particles, or one for each of their groups."""
Deformation = Float[Array, "e e q"]
"""The deformation as a law sees it: F with e = d, or J with e = 1."""


class MaterialPoints(eqx.Module):
    """The particles of one material, which pay for their own law only."""

    law: AbstractMaterial
    """The elastic law in force, frozen in the step."""
    volume: Float[Array, "q"]
    """V0 [m^d], shape (q,)."""
    F: Deformation
    """F or its elastic part [-], shape (d, d, q); for a law that depends on J only, J, shape (1, 1, q)."""
    total: bool = eqx.field(static=True, default=False)
    """Whether gradients are with respect to the reference positions."""
    rows: tuple[int, int] | None = eqx.field(static=True, default=None)
    """First particle and the one after the last; None for all of them."""
    viscosity: Viscosity | None = None
    """The viscosity beside the law; None without."""

    def own(self, field: Array) -> Array:
        """The part of an array over all particles (particle axis last) that belongs to this material."""
        return field if self.rows is None else field[..., slice(*self.rows)]

    def deformed(self, gradient: Matrix) -> Deformation:
        """δF [-] by the gradient ∇u of a displacement, shape (d, d, q): ∇u F, in the total description ∇u; δJ is
        tr(∇u) J."""
        if self.total:
            return gradient
        if len(self.F) < len(gradient):
            return la.trace(gradient) * self.F
        return la.matmul(gradient, self.F)

    def flux(self, P: Deformation, dim: int) -> Matrix:
        """What the force is the sum of [J], shape (d, d, q), f_i = −Σ_p (V0 P Fᵀ) g_ip: the transpose of `deformed`. In
        the total description V0 P; by P = dΨ/dJ it is V0 P J I."""
        P = self.volume * P
        if self.total:
            return P
        if len(self.F) < dim:
            return P * self.F * jnp.eye(dim, dtype=P.dtype)[..., None]
        return la.matmul(P, la.transpose(self.F))

    def damping_force(self, gradient: Matrix) -> Matrix:
        """Likewise of the viscous stress, |J| V0 σ_v [J], by the velocity gradient ∇v [1/s], shape (d, d, q): in the
        total description L = ∇v F⁻¹, and the flux |J| V0 σ_v F⁻ᵀ. A symmetric map, and positive semi-definite."""
        if self.viscosity is None:
            return jnp.zeros_like(gradient)
        J = la.determinant(self.F)
        if not self.total:
            return self.volume * jnp.abs(J) * self.viscosity.stress(gradient)
        inverse = la.transpose(la.cofactor(self.F)) / J
        stress = self.viscosity.stress(la.matmul(gradient, inverse))
        return self.volume * jnp.abs(J) * la.matmul(stress, la.transpose(inverse))


def material_points(laws: Laws, particles: Particles, *, total: bool) -> tuple[MaterialPoints, ...]:
    """The materials of prepared particles."""

    def one(law: Law | Viscous, group: Group) -> MaterialPoints:
        law, viscosity = split(law)
        elastic = law.elastic(group.history) if isinstance(law, AbstractInelastic) else law
        volume = particles.volume if group.rows is None else particles.volume[slice(*group.rows)]
        return MaterialPoints(elastic, volume, group.deformation(), total, group.rows, viscosity)

    return tuple(one(law, group) for law, group in _paired(laws, particles))


def return_map(laws: Laws, particles: Particles) -> Particles:
    """The particles after the return maps of laws that yield: from the trial deformation to one that the law admits."""
    if not any(isinstance(split(law)[0], AbstractInelastic) for law, _ in _paired(laws, particles)):
        return particles

    def one(law: Law | Viscous, group: Group) -> tuple[Array | None, Any]:
        law, _ = split(law)
        if not isinstance(law, AbstractInelastic):
            return group.F, group.history
        F, history = law.return_map(group.deformation(), group.history)
        return particle_first(F), history

    found = [one(law, group) for law, group in _paired(laws, particles)]
    F, history = zip(*found, strict=True) if isinstance(laws, tuple) else found[0]
    return replace(particles, F=F, history=history)


def split(law: Law | Viscous) -> tuple[Law, Viscosity | None]:
    """A law without its viscosity, and the viscosity; None without."""
    return (law.law, law.viscosity) if isinstance(law, Viscous) else (law, None)


def _paired(laws: Laws, particles: Particles) -> list[tuple[Law | Viscous, Group]]:
    return list(zip(laws if isinstance(laws, tuple) else (laws,), particles.groups, strict=True))
