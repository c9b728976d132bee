"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement; and what
viscosity makes of nodal velocity."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix, NodeVector
from mpmjax.boundary import Mirror
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.material import AbstractElastic
from mpmjax.state import MaterialPoints

Deformations = tuple[Deformation, ...]
"""One entry for each material, shape (d, d, q), or (q,) where its law knows J alone."""


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ), for a displacement u of the nodes [m] from where they are now.

    h_ip is the material gradient: F_pᵀ ∇_x w_ip in the updated description, ∇_X w_ip in the total one. Every use of it
    goes through `strain` and its transpose `divergence`, so that force and Hessian are the derivatives of Φ.
    """

    material_points: tuple[MaterialPoints, ...]
    stencil: Stencil
    mirror: Mirror

    def strain(self, u: NodeVector) -> Deformations:
        """δF_p = Σ_i u_i h_ipᵀ, one array a material."""
        return self.change(self._gradient(u))

    def change(self, gradient: Matrix) -> Deformations:
        """δF_p from the gradient Σ_i u_i g_ipᵀ of the displacement."""
        return tuple(c.change(c.own(gradient)) for c in self.material_points)

    def current_deformation(self) -> Deformations:
        """F_p at u = 0, one array a material."""
        return tuple(c.deformation for c in self.material_points)

    def deformation(self, u: NodeVector) -> Deformations:
        """F_p + δF_p at a nodal displacement u [m], shape (n, d), one array a material."""
        return tuple(F + dF for F, dF in zip(self.current_deformation(), self.strain(u), strict=True))

    def divergence(self, P: Deformations, like: NodeVector) -> NodeVector:
        """Σ_p V0_p P_p h_ip [N], the transpose of `strain`; `like` is any node vector."""
        return self.sum_of(self._flux(P), like)

    def energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J]."""
        parts = [
            (c.volume * c.law.energy(F)).sum() for c, F in zip(self.material_points, self.deformation(u), strict=True)
        ]
        return sum(parts[1:], parts[0])

    def admissible_energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J], NaN where a law is not defined, whatever its formula gives there: not to be differentiated."""
        parts = [
            jnp.where(c.law.is_admissible(F), c.volume * c.law.energy(F), jnp.nan).sum()
            for c, F in zip(self.material_points, self.deformation(u), strict=True)
        ]
        return sum(parts[1:], parts[0])

    def force(self, u: NodeVector) -> NodeVector:
        """f = −∂Φ/∂u [N]: at u = 0 f_i = −Σ_p V0_p P_p F_pᵀ ∇w_ip."""
        return -self.divergence(self._stress(self.deformation(u)), u)

    def current_force(self, like: NodeVector) -> NodeVector:
        """The force at u = 0, without the gather."""
        return -self.divergence(self._stress(self.current_deformation()), like)

    def current_flux(self) -> Matrix:
        """V0_p P_p F_pᵀ at u = 0 [J], shape (d, d, p): the force there is f_i = −Σ_p (V0_p P_p F_pᵀ) g_ip."""
        return self._flux(self._stress(self.current_deformation()))

    @property
    def viscous(self) -> bool:
        """Whether any of the materials has viscosity."""
        return any(c.viscosity is not None for c in self.material_points)

    def viscous_flux(self, gradient: Matrix) -> Matrix:
        """The viscous counterpart of `current_flux` [J], at a velocity gradient of the particles [1/s], (d, d, p)."""
        return _joined([c.damping_force(c.own(gradient)) for c in self.material_points])

    def damping_force(self, v: NodeVector) -> NodeVector:
        """D v [N], minus the viscous force at a velocity of the nodes; D is symmetric and positive semi-definite."""
        return self.sum_of(self.viscous_flux(self._gradient(v)), v)

    def power(self, v: NodeVector) -> Float[Array, ""]:
        """v·D v [W], the power that viscosity dissipates at a velocity of the nodes."""
        gradient = self._gradient(v)
        return (self.viscous_flux(gradient) * gradient).sum()

    def sum_of(self, flux: Matrix, like: NodeVector) -> NodeVector:
        """Σ_p flux_p g_ip; `like` is any node vector."""
        return self.mirror.fold(scatter(self.stencil, None, jnp.swapaxes(flux, 0, 1), like.shape[0]))

    def damping_matrices(self) -> Float[Array, "m m p"]:
        """Each particle's part of D [J s], as `stiffness` has that of H."""

        def matrix(c: MaterialPoints) -> Array:
            like = jnp.zeros((self._dim, self._dim, *c.volume.shape), c.volume.dtype)
            return la.matrix_of(lambda slopes: la.transpose(c.damping_force(la.transpose(slopes))), like)

        return _joined([matrix(c) for c in self.material_points])

    def stiffness(self, tangents: tuple[Callable[[Deformation], Deformation], ...]) -> Float[Array, "m m p"]:
        """K_p [J], each particle's part of the Hessian Σ_p g_ip K_p g_jp: of the stress differentials δF ↦ A : δF, one
        for each material, the symmetric maps from the components of the displacement's gradient, direction of the slope
        first, to those of what the force is the sum of. Shape (d², d², p)."""

        def matrix(c: MaterialPoints, tangent: Callable[[Deformation], Deformation]) -> Array:
            def flux_of(slopes: Matrix) -> Matrix:
                return la.transpose(c.flux(tangent(c.change(la.transpose(slopes))), self._dim))

            return la.matrix_of(flux_of, jnp.zeros((self._dim, self._dim, *c.volume.shape), c.volume.dtype))

        return _joined([matrix(c, tangent) for c, tangent in zip(self.material_points, tangents, strict=True)])

    def _gradient(self, field: NodeVector) -> Matrix:
        _, slopes = gather(self.stencil, self.mirror.unfold(field))
        return jnp.swapaxes(slopes, 0, 1)

    @property
    def _dim(self) -> int:
        return len(self.stencil.weights)

    def _stress(self, F: Deformations) -> Deformations:
        return tuple(_stress(c.law, own) for c, own in zip(self.material_points, F, strict=True))

    def _flux(self, P: Deformations) -> Matrix:
        return _joined([c.flux(own, self._dim) for c, own in zip(self.material_points, P, strict=True)])


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)


@jax.jit
def _stress(law: AbstractElastic, F: Deformation) -> Deformation:
    """The law's stress, compiled as one function wherever it is called, so that it is traced once."""
    return law.stress(F)
