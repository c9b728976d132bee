"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement, and the viscous
force as a function of nodal velocity."""

from collections.abc import Sequence
from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix, NodeVector
from mpmjax.autodiff import materialised
from mpmjax.discretisation import Stencil
from mpmjax.potential import AbstractTerm, Displacement, Forces, Mirror, scattered
from mpmjax.state import MaterialPoints

Deformations = tuple[Deformation, ...]
"""One entry for each material, shape (d, d, q), or (q,) for a law of J alone."""


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ) (derivation, eq. 14) for a displacement u of the nodes [m], shape (n, d),
    in the step.

    h_ip is the material gradient: F_pᵀ ∇_x w_ip in the updated description, ∇_X w_ip in the total one. It enters only
    by `change` and its transpose, `weighted_stress`, so that force and Hessian are derivatives of Φ.

    Materials are no `AbstractTerm`: all of them together have one matrix a particle, in one array that the solver
    applies in a pass, and the integrator chooses how it is made (`AbstractHessian`), where a term states its own
    stiffness. What they are asked besides, how G2P strains them and the eigenvalues that bound the step, no other term
    has, so that the sums over one tuple would be longer than these over two.
    """

    material_points: tuple[MaterialPoints, ...]  # the particles of each material
    stencil: Stencil  # the nodes of each particle
    mirror: Mirror  # the planes at which nodes are mirrored
    size: int = eqx.field(static=True)
    """Number of nodes n."""
    terms: tuple[AbstractTerm, ...] = ()
    """Further energies: springs to the ground, contact, terms of a user's own."""

    def displaced(self, u: NodeVector | None) -> Displacement:
        """A displacement or velocity of the nodes, shape (n, d), with that of their mirror images; None for zero."""
        unfolded = u if u is None or not self.mirror.images else self.mirror.unfold(u)
        return Displacement(self.stencil, self.size, unfolded)

    def on_nodes(self, forces: Sequence[Forces]) -> NodeVector:
        """The sum of forces on the nodes [N], shape (n, d)."""
        total = scattered(forces, self.stencil, self.size)
        return self.mirror.fold(total) if self.mirror.images else total

    def deformation(self, u: NodeVector | Displacement | None) -> Deformations:
        """F_p + Σ_i u_i h_ipᵀ at a displacement u [m], shape (n, d), one array for each material; None for u = 0."""
        moved = u if isinstance(u, Displacement) else self.displaced(u)
        if moved.at_rest:
            return tuple(points.deformation for points in self.material_points)
        gradient = la.transpose(moved.at_particles[1])
        return tuple(points.deformation + points.change(points.rows_of(gradient)) for points in self.material_points)

    def energy(self, u: NodeVector | Displacement) -> Float[Array, ""]:
        """Φ(u) [J]."""
        moved = u if isinstance(u, Displacement) else self.displaced(u)
        pairs = zip(self.material_points, self.deformation(moved), strict=True)
        parts = [(points.volume * points.energy_density(F)).sum() for points, F in pairs]
        return reduce(jnp.add, [*parts, *(term.energy(moved) for term in self.terms)])

    def admissible_energy(self, u: NodeVector) -> Float[Array, ""]:
        """Φ(u) [J], NaN if a law or term does not admit the displacement. It must not be differentiated."""
        moved = self.displaced(u)
        pairs = zip(self.material_points, self.deformation(moved), strict=True)
        admitted = [points.is_admissible(F).all() for points, F in pairs]
        admitted += [defined for term in self.terms if (defined := term.is_admissible(moved)) is not None]
        return jnp.where(reduce(jnp.logical_and, admitted), self.energy(moved), jnp.nan)

    def term_energy(self, u: NodeVector | None) -> Float[Array, ""]:
        """The part of Φ(u) by the terms [J]; None for u = 0."""
        moved = self.displaced(u)
        return sum((term.energy(moved) for term in self.terms), jnp.zeros((), self.stencil.offset.dtype))

    def force(self, u: NodeVector | None) -> NodeVector:
        """f = −∂Φ/∂u [N], shape (n, d); None for u = 0, where f_i = −Σ_p V0_p P_p F_pᵀ ∇w_ip."""
        moved = self.displaced(u)
        pairs = zip(self.material_points, self.deformation(moved), strict=True)
        elastic = self.weighted_stress([points.stress(F) for points, F in pairs])
        return self.on_nodes([Forces(slopes=-la.transpose(elastic)), *(term.force(moved) for term in self.terms)])

    def weighted_stress(self, P: Sequence[Deformation] | None = None) -> Matrix:
        """V0_p P_p F_pᵀ [J], shape (d, d, p), of which the force is f_i = −Σ_p (V0_p P_p F_pᵀ) g_ip; in the total
        description V0_p P_p. P is the stress of each material [Pa]. Default: at u = 0."""
        d, each = self.stencil.strain_dim, self.material_points
        P = [points.stress(points.deformation) for points in each] if P is None else P
        return jnp.concatenate([q.weighted_stress(stress, d) for q, stress in zip(each, P, strict=True)], axis=-1)

    def stress_factors(self) -> tuple[Matrix, Matrix | None]:
        """Factors A and B of `weighted_stress` at u = 0, A Bᵀ: of one material V0 P and F, whose product a sum over
        particles can form; B is None where they are multiplied."""
        points, *others = self.material_points
        if others or not points.strained_by_gradient or self.stencil.radius is not None:
            return self.weighted_stress(), None
        return materialised(points.volume * points.stress(points.deformation)), points.deformation

    @property
    def viscous(self) -> bool:
        """Whether any of the materials has viscosity, or any of the terms a resistance."""
        return any(part.viscosity is not None for part in self.material_points) or any(t.viscous for t in self.terms)

    @property
    def material_viscous(self) -> bool:
        """Whether any of the materials has viscosity."""
        return any(points.viscosity is not None for points in self.material_points)

    def weighted_viscous_stress(self, gradient: Matrix) -> Matrix:
        """|J| V0 σ_v of each particle [J], whose sum over g_ip is D v, at the particles' velocity gradient [1/s]; both
        of shape (d, d, p)."""
        parts = [points.weighted_viscous_stress(points.rows_of(gradient)) for points in self.material_points]
        return jnp.concatenate(parts, axis=-1)

    def resistances(self, moved: Displacement) -> list[Forces]:
        """The parts of D v before the scatter, of materials and terms."""
        parts = [part for term in self.terms if (part := term.resistance(moved)) is not None]
        if self.material_viscous:
            stress = self.weighted_viscous_stress(la.transpose(moved.at_particles[1]))
            parts.append(Forces(slopes=la.transpose(stress)))
        return parts

    def viscous_resistance(self, v: NodeVector) -> NodeVector:
        """D v [N], the negative of the viscous force at a nodal velocity v [m/s]. D is symmetric and positive
        semi-definite."""
        parts = self.resistances(self.displaced(v))
        return self.on_nodes(parts) if parts else jnp.zeros_like(v)

    def power(self, v: NodeVector) -> Float[Array, ""]:
        """v·D v [W], the power that viscosity dissipates at a nodal velocity v [m/s]."""
        moved = self.displaced(v)
        return sum((part.product(moved) for part in self.resistances(moved)), jnp.zeros((), v.dtype))

    def drags(self) -> list[tuple[Forces, Float[Array, ""]]]:
        """The viscous forces of the terms at the start of the step, and their powers (see `AbstractTerm.drag`)."""
        return [drag for term in self.terms if (drag := term.drag(self.size)) is not None]
