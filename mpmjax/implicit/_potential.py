"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement, and the viscous
force as a function of nodal velocity."""

from collections.abc import Callable
from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix, NodeVector
from mpmjax.boundary import Coupling, Mirror, Springs, spring_energy, spring_force
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.state import MaterialPoints, Support

Deformations = tuple[Deformation, ...]
"""One entry for each material, shape (d, d, q), or (q,) for a law of J alone."""


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ) (derivation, eq. 14) for a displacement u of the nodes [m], shape (n, d),
    in the step.

    h_ip is the material gradient: F_pᵀ ∇_x w_ip in the updated description, ∇_X w_ip in the total one. It enters only
    by `deformation_change` and its transpose, `nodal_sum` of `flux`, so that force and Hessian are derivatives of Φ.
    """

    material_points: tuple[MaterialPoints, ...]
    stencil: Stencil
    mirror: Mirror
    size: int = eqx.field(static=True)
    """Number of nodes n."""
    supports: tuple[Support, ...] = ()
    """Springs and dashpots to the ground, whose energy and resistance are added."""
    springs: tuple[Springs, ...] = ()
    """The springs of contact, whose energy is part of Φ."""
    couplings: tuple[Coupling, ...] = ()
    """Those between bodies."""

    def deformation_change(self, u: NodeVector) -> Deformations:
        """δF_p = Σ_i u_i h_ipᵀ, one array for each material."""
        return self.change(self._gradient(u))

    def change(self, gradient: Matrix) -> Deformations:
        """δF_p from the gradient Σ_i u_i g_ipᵀ of the displacement."""
        return tuple(points.change(points.rows_of(gradient)) for points in self.material_points)

    def current_deformation(self) -> Deformations:
        """F_p at u = 0, one array for each material."""
        return tuple(points.deformation for points in self.material_points)

    def deformation(self, u: NodeVector) -> Deformations:
        """F_p + δF_p at a nodal displacement u [m], shape (n, d), one array for each material."""
        return tuple(F + dF for F, dF in zip(self.current_deformation(), self.deformation_change(u), strict=True))

    def no_displacement(self) -> NodeVector:
        """u = 0 [m], shape (n, d)."""
        return jnp.zeros((self.size, self._dim), self.stencil.weights.dtype)

    def energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J]."""
        parts = [
            (points.volume * points.energy_density(F)).sum()
            for points, F in zip(self.material_points, self.deformation(u), strict=True)
        ]
        return sum([*parts[1:], *self.spring_energies(u)], parts[0])

    def admissible_energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J], NaN if a law does not admit the deformation. It must not be differentiated."""
        parts = [
            jnp.where(points.is_admissible(F), points.volume * points.energy_density(F), jnp.nan).sum()
            for points, F in zip(self.material_points, self.deformation(u), strict=True)
        ]
        return sum([*parts[1:], *self.spring_energies(u)], parts[0])

    def support_energies(self, u: NodeVector) -> list[Float[Array, ""]]:
        """The energy of each support's springs [J]."""
        return [support.energy(u) for support in self.held_by()]

    def spring_energies(self, u: NodeVector) -> list[Float[Array, ""]]:
        """The energies of the springs of supports and of contact [J]."""
        contact = [spring_energy(self.springs, gather(self.stencil, self.mirror.unfold(u)))] if self.springs else []
        coupled = [coupling.energy(self.mirror.unfold(u)) for coupling in self.couplings]
        return self.support_energies(u) + contact + coupled

    def held_by(self) -> tuple[Support, ...]:
        """The supports, on the nodes as the mirrors fold them."""
        return tuple(support.mirrored(self.mirror) for support in self.supports)

    def support_force(self) -> NodeVector:
        """The force of the supports' springs at u = 0 [N], shape (n, d). There must be one."""
        first, *others = (support.force(None, self.size) for support in self.held_by())
        return sum(others, first)

    def support_drag(self) -> NodeVector | None:
        """The force of their dashpots at the points' velocity at the start of the step [N]; None without any."""
        found = [drag for support in self.held_by() if (drag := support.drag(self.size)) is not None]
        return sum(found[1:], found[0]) if found else None

    def force(self, u: NodeVector) -> NodeVector:
        """f = −∂Φ/∂u [N], shape (n, d). At u = 0, f_i = −Σ_p V0_p P_p F_pᵀ ∇w_ip."""
        force = -self.nodal_sum(self.flux(self._stress(self.deformation(u))))
        if self.springs or self.couplings:
            force = force + self.spring_force(u)
        return force + sum(support.force(u, self.size) for support in self.held_by()) if self.supports else force

    def spring_force(self, u: NodeVector | None) -> NodeVector:
        """The part of `force` by the springs of contact [N], shape (n, d); None for u = 0."""
        parts = [spring_force(self.springs, self.stencil, self.mirror, u, self.size)] if self.springs else []
        moved = None if u is None else self.mirror.unfold(u)
        parts += [self.mirror.fold(coupling.force(moved, self.size)) for coupling in self.couplings]
        return reduce(jnp.add, parts)

    def flux(self, P: Deformations) -> Matrix:
        """V0_p P_p F_pᵀ [J], shape (d, d, p), from the stress of each material; in the total description V0_p P_p."""
        return _joined([points.flux(own, self._dim) for points, own in zip(self.material_points, P, strict=True)])

    def current_flux(self) -> Matrix:
        """V0_p P_p F_pᵀ at u = 0 [J], shape (d, d, p), of which the force is f_i = −Σ_p (V0_p P_p F_pᵀ) g_ip."""
        return self.flux(self._stress(self.current_deformation()))

    @property
    def viscous(self) -> bool:
        """Whether any of the materials has viscosity, or a support a dashpot."""
        return self.material_viscous or any(support.damping is not None for support in self.supports)

    @property
    def material_viscous(self) -> bool:
        """Whether any of the materials has viscosity."""
        return any(points.viscosity is not None for points in self.material_points)

    def viscous_flux(self, gradient: Matrix) -> Matrix:
        """|J| V0 σ_v of each particle [J], whose sum over g_ip is D v, at the particles' velocity gradient [1/s]; both
        of shape (d, d, p)."""
        return _joined([points.viscous_flux(points.rows_of(gradient)) for points in self.material_points])

    def viscous_resistance(self, v: NodeVector) -> NodeVector:
        """D v [N], the negative of the viscous force at a nodal velocity v [m/s]. D is symmetric and positive
        semi-definite."""
        parts = [self.nodal_sum(self.viscous_flux(self._gradient(v)))] if self.material_viscous else []
        parts += [r for support in self.held_by() if (r := support.resistance(v)) is not None]
        return sum(parts[1:], parts[0]) if parts else jnp.zeros_like(v)

    def power(self, v: NodeVector) -> Float[Array, ""]:
        """v·D v [W], the power that viscosity dissipates at a nodal velocity v [m/s]."""
        power = jnp.zeros((), v.dtype)
        for support in self.held_by():
            power = power + support.power(v)
        if not self.material_viscous:
            return power
        gradient = self._gradient(v)
        return power + (self.viscous_flux(gradient) * gradient).sum()

    def nodal_sum(self, flux: Matrix) -> NodeVector:
        """Σ_p flux_p g_ip [N], shape (n, d)."""
        return self.mirror.fold(scatter(self.stencil, None, jnp.swapaxes(flux, 0, 1), self.size))

    def damping_matrices(self) -> Float[Array, "t p"] | None:
        """The matrices of the materials' D [J s], one for each particle, as `stiffness` has those of H; None if no
        material has viscosity."""
        if not self.material_viscous:
            return None

        def matrix(points: MaterialPoints) -> Array:
            def flux_of(slopes: Matrix) -> Matrix:
                return la.transpose(points.viscous_flux(la.transpose(slopes)))

            like = jnp.zeros((self._dim, self._dim, *points.volume.shape), points.volume.dtype)
            return la.upper_triangle(la.matrix_of(flux_of, like))

        return _joined([matrix(points) for points in self.material_points])

    def stiffness(self, tangents: tuple[Callable[[Deformation], Deformation], ...]) -> Float[Array, "t p"]:
        """Each particle's symmetric matrix K_p [J], with H = Σ_p g_ip K_p g_jpᵀ, made from its material's stress
        differential.

        Rows and columns are the components of ∇u, the derivative's direction first. What is returned is the upper
        triangle, row by row, shape (d²(d² + 1)/2, p).

        Args:
            tangents: for each material, the stress differential δF ↦ δP of its particles.
        """

        pairs = zip(self.material_points, tangents, strict=True)
        return _joined([points.stiffness(tangent, self._dim) for points, tangent in pairs])

    def _gradient(self, field: NodeVector) -> Matrix:
        _, slopes = gather(self.stencil, self.mirror.unfold(field))
        return jnp.swapaxes(slopes, 0, 1)

    @property
    def _dim(self) -> int:
        return len(self.stencil.weights)

    def _stress(self, F: Deformations) -> Deformations:
        return tuple(points.stress(own) for points, own in zip(self.material_points, F, strict=True))


def _joined(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)
