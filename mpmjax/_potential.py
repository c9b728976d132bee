"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import _linalg as la
from mpmjax._crossing import collect, spread
from mpmjax._kernel import Stencil
from mpmjax._mirror import Mirror
from mpmjax._types import Array, Float, Matrix, NodeVector
from mpmjax.material import AbstractMaterial


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ), for a displacement u of the nodes [m] from where they are now.

    h_ip is the material gradient: F_pᵀ ∇_x w_ip in the updated description, ∇_X w_ip in the total one. Every use of it
    goes through `strain` and its transpose `divergence`, so that force and Hessian are the derivatives of Φ.
    """

    material: AbstractMaterial
    volume: Float[Array, "p"]
    F: Matrix
    pull: Matrix | None
    """F_p in the updated description, None in the total one."""
    stencil: Stencil
    mirror: Mirror

    def strain(self, u: NodeVector) -> Matrix:
        """δF_p = Σ_i u_i h_ipᵀ, shape (d, d, p)."""
        _, slopes = collect(self.stencil, self.mirror.unfold(u))
        return self.deformed(jnp.swapaxes(slopes, 0, 1))

    def deformed(self, gradient: Matrix) -> Matrix:
        """δF_p from the gradient Σ_i u_i g_ipᵀ of the displacement."""
        return gradient if self.pull is None else la.matmul(gradient, self.pull)

    def divergence(self, P: Matrix, like: NodeVector) -> NodeVector:
        """Σ_p V0_p P_p h_ip [N], the transpose of `strain`; `like` is any node vector."""
        nodes = spread(self.stencil, None, jnp.swapaxes(self._flux(P), 0, 1), like.shape[0])
        return self.mirror.fold(nodes)

    def energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J]."""
        return (self.volume * self.material.energy(self.F + self.strain(u))).sum()

    def force(self, u: NodeVector) -> NodeVector:
        """f = −∂Φ/∂u [N]: at u = 0 the reference's f_i = −Σ_p V0_p P_p F_pᵀ ∇w_ip."""
        return -self.divergence(_stress(self.material, self.F + self.strain(u)), u)

    def rest_force(self, like: NodeVector) -> NodeVector:
        """The force at u = 0, without the gather."""
        return -self.divergence(_stress(self.material, self.F), like)

    def rest_flux(self) -> Matrix:
        """What the force at u = 0 is the sum of, f_i = −Σ_p (V0_p P_p F_pᵀ) g_ip: the bracket [J], shape (d, d, p)."""
        return self._flux(_stress(self.material, self.F))

    def stiffness(self, tangent: Callable[[Matrix], Matrix]) -> Float[Array, "m m p"]:
        """K_p [J], each particle's part of the Hessian Σ_p g_ip K_p g_jp: of the stress differential δF ↦ A : δF, the
        symmetric map from the components of the displacement's gradient, direction of the slope first, to those of what
        the force is the sum of. Shape (d², d², p)."""

        def flux_of(slopes: Matrix) -> Matrix:
            return la.transpose(self._flux(tangent(self.deformed(la.transpose(slopes)))))

        return la.matrix_of(flux_of, self.F)

    def _flux(self, P: Matrix) -> Matrix:
        P = self.volume * P
        return P if self.pull is None else la.matmul(P, la.transpose(self.pull))


@jax.jit
def _stress(material: AbstractMaterial, F: Matrix) -> Matrix:
    """The law's stress, compiled as one function wherever it is called, so that it is traced once."""
    return material.stress(F)
