"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement, and the viscous
force as a function of nodal velocity."""

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
"""One entry for each material, shape (d, d, q), or (q,) for a law of J alone."""


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ) for a displacement u of the nodes [m], shape (n, d), in the step.

    h_ip is the material gradient: F_pᵀ ∇_x w_ip in the updated description, ∇_X w_ip in the total one. It enters only
    by `strain` and its transpose `divergence`, so that force and Hessian are derivatives of Φ.
    """

    material_points: tuple[MaterialPoints, ...]
    stencil: Stencil
    mirror: Mirror

    def strain(self, u: NodeVector) -> Deformations:
        """δF_p = Σ_i u_i h_ipᵀ, one array for each material."""
        return self.change(self._gradient(u))

    def change(self, gradient: Matrix) -> Deformations:
        """δF_p from the gradient Σ_i u_i g_ipᵀ of the displacement."""
        return tuple(c.change(c.own(gradient)) for c in self.material_points)

    def current_deformation(self) -> Deformations:
        """F_p at u = 0, one array for each material."""
        return tuple(c.deformation for c in self.material_points)

    def deformation(self, u: NodeVector) -> Deformations:
        """F_p + δF_p at a nodal displacement u [m], shape (n, d), one array for each material."""
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
        """Φ(u) [J], NaN if a law does not admit the deformation. It must not be differentiated."""
        parts = [
            jnp.where(c.law.is_admissible(F), c.volume * c.law.energy(F), jnp.nan).sum()
            for c, F in zip(self.material_points, self.deformation(u), strict=True)
        ]
        return sum(parts[1:], parts[0])

    def force(self, u: NodeVector) -> NodeVector:
        """f = −∂Φ/∂u [N], shape (n, d). At u = 0, f_i = −Σ_p V0_p P_p F_pᵀ ∇w_ip."""
        return -self.divergence(self._stress(self.deformation(u)), u)

    def current_force(self, like: NodeVector) -> NodeVector:
        """f at u = 0, without the gather. `like` is any node vector."""
        return -self.divergence(self._stress(self.current_deformation()), like)

    def current_flux(self) -> Matrix:
        """V0_p P_p F_pᵀ at u = 0 [J], shape (d, d, p), of which the force is f_i = −Σ_p (V0_p P_p F_pᵀ) g_ip."""
        return self._flux(self._stress(self.current_deformation()))

    @property
    def viscous(self) -> bool:
        """Whether any of the materials has viscosity."""
        return any(c.viscosity is not None for c in self.material_points)

    def viscous_flux(self, gradient: Matrix) -> Matrix:
        """The viscous `current_flux` [J] at a velocity gradient of the particles [1/s], both of shape (d, d, p)."""
        return _joined([c.damping_force(c.own(gradient)) for c in self.material_points])

    def damping_force(self, v: NodeVector) -> NodeVector:
        """D v [N], the negative of the viscous force at a nodal velocity v [m/s]. D is symmetric and positive
        semi-definite."""
        return self.sum_of(self.viscous_flux(self._gradient(v)), v)

    def power(self, v: NodeVector) -> Float[Array, ""]:
        """v·D v [W], the power that viscosity dissipates at a nodal velocity v [m/s]."""
        gradient = self._gradient(v)
        return (self.viscous_flux(gradient) * gradient).sum()

    def sum_of(self, flux: Matrix, like: NodeVector) -> NodeVector:
        """Σ_p flux_p g_ip; `like` is any node vector."""
        return self.mirror.fold(scatter(self.stencil, None, jnp.swapaxes(flux, 0, 1), like.shape[0]))

    def damping_matrices(self) -> Float[Array, "m m p"]:
        """The matrices of D [J s], one for each particle, shape (d², d², p), as `stiffness` has those of H."""

        def matrix(c: MaterialPoints) -> Array:
            like = jnp.zeros((self._dim, self._dim, *c.volume.shape), c.volume.dtype)
            return la.matrix_of(lambda slopes: la.transpose(c.damping_force(la.transpose(slopes))), like)

        return _joined([matrix(c) for c in self.material_points])

    def stiffness(self, tangents: tuple[Callable[[Deformation], Deformation], ...]) -> Float[Array, "m m p"]:
        """The matrices K_p [J] of the Hessian Σ_p g_ip K_p g_jp, one for each particle, shape (d², d², p).

        K_p maps the gradient of the displacement to the flux of which the force is the sum; both are flattened with the
        direction of the derivative first.

        Args:
            tangents: for each material, the stress differential δF ↦ A : δF of its particles.
        """

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
    """The stress of a law, compiled as one function so that it is traced once."""
    return law.stress(F)
