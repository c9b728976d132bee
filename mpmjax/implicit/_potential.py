"""The elastic potential of the grid: energy, force and deformation as functions of nodal displacement, and the viscous
force as a function of nodal velocity; and its Hessians, as linear maps of nodal displacements."""

import abc
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix, NodeVector, Scalar
from mpmjax.autodiff import materialised
from mpmjax.checks import require_fields
from mpmjax.discretisation import Stencil, resist
from mpmjax.material import AbstractMaterial
from mpmjax.potential import AbstractStiffness, AbstractTerm, Displacement, Forces, Mirror, scattered
from mpmjax.state import MaterialPoints

Deformations = tuple[Deformation, ...]  # one entry for each material, shape (d, d, q), or (q,) for a law of J alone


class ElasticPotential(eqx.Module):
    """Φ(u) = Σ_p V0_p Ψ(F_p + Σ_i u_i h_ipᵀ) (derivation, eq. 14) for a displacement u of the nodes [m], shape (n, d).

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
    size: int = eqx.field(static=True)  # number of nodes n
    terms: tuple[AbstractTerm, ...] = ()  # further energies: springs to the ground, contact, terms of a user's own

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
        return sum((term.energy(moved) for term in self.terms), jnp.zeros((), self.stencil.xi.dtype))

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

    def stress_factors(self) -> tuple[Any, Matrix | None]:
        """Factors A and B of `weighted_stress` at u = 0, as `p2g` takes them: of one material V0 P, or the
        `kirchhoff_numbers` of its law, and F; of a law of J a pressure."""
        points, *others = self.material_points
        if others or points.total or self.stencil.radius is not None:
            return self.weighted_stress(), None
        F = points.deformation
        if F.ndim == 1:
            return (None, materialised(points.volume * points.stress(F) * F)), None
        if points.average is None and (numbers := points.law.kirchhoff_numbers(F)) is not None:
            return materialised(tuple(points.volume * number for number in numbers)), F
        return materialised(points.volume * points.stress(F)), F

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
        """D v [N], minus the viscous force at a nodal velocity v [m/s]; D is symmetric and positive semi-definite."""
        parts = self.resistances(self.displaced(v))
        return self.on_nodes(parts) if parts else jnp.zeros_like(v)

    def power(self, v: NodeVector) -> Float[Array, ""]:
        """v·D v [W], the power that viscosity dissipates at a nodal velocity v [m/s]."""
        moved = self.displaced(v)
        return sum((part.product(moved) for part in self.resistances(moved)), jnp.zeros((), v.dtype))

    def drags(self) -> list[tuple[Forces, Float[Array, ""]]]:
        """The viscous forces of the terms at the start of the step, and their powers (see `AbstractTerm.drag`)."""
        return [drag for term in self.terms if (drag := term.drag(self.size)) is not None]


class AbstractHessianAction(eqx.Module):
    """The symmetric linear map δu ↦ H δu [N], H = ∂²Φ/∂u∂u [N/m], on nodal displacements δu [m], shape (n, d)."""

    @abc.abstractmethod
    def __call__(self, du: NodeVector) -> NodeVector:
        """H δu."""

    @abc.abstractmethod
    def precomputed(self) -> "ParticleStiffness":
        """The map as one matrix for each particle, computed once for many applications."""


class ParticleStiffness(AbstractHessianAction):
    """H as one symmetric matrix for each particle, and what terms add. Applying it evaluates no law.

    Each particle's matrix K_p [J] gives H = Σ_p g_ip K_p g_jpᵀ. Its rows and columns are the components of ∇u, the
    derivative's direction first.
    """

    upper: Float[Array, "t p"]  # the upper triangle of K_p, row by row, shape (d²(d² + 1)/2, p)
    stencil: Stencil  # the nodes of each particle
    mirror: Mirror  # the planes at which nodes are mirrored
    positive_semidefinite: bool = eqx.field(static=True, default=False)
    """Whether the K_p with `coupled` are known to be positive semi-definite."""
    coupled: tuple[AbstractStiffness, ...] = ()  # the stiffness of materials that couples their particles
    others: tuple[AbstractStiffness, ...] = ()  # the stiffness of terms

    def is_positive_semidefinite(self) -> bool:
        """Whether H is known to be positive semi-definite."""
        return self.positive_semidefinite and all(part.is_positive_semidefinite() for part in self.others)

    def __call__(self, du: NodeVector) -> NodeVector:
        u = self.mirror.unfold(du)
        if not self.coupled + self.others:
            return self.mirror.fold(resist(self.stencil, self.upper, u))
        moved = Displacement(self.stencil, len(du), u)
        answers = [part(moved) for part in self.coupled + self.others]
        # what others scatter shares the gather and the scatter of the particles; else `resist` does both in one pass
        if any(answer.value is not None or answer.slopes is not None for answer in answers):
            slopes = moved.at_particles[1]
            flux = la.matmul(la.symmetric(self.upper), slopes.reshape(-1, 1, slopes.shape[-1])).reshape(slopes.shape)
            elastic = Forces(slopes=flux)
        else:
            elastic = Forces(nodes=resist(self.stencil, self.upper, moved.nodes))
        return self.mirror.fold(scattered([elastic, *answers], self.stencil, len(du)))

    def precomputed(self) -> "ParticleStiffness":
        return self

    def diagonal(self, size: int) -> NodeVector:
        """Σ_p Σ_b g_ip,b² K_p,ba,ba [N/m] on n = `size` nodes, shape (n, d), and the same of the others: a non-negative
        approximation of the diagonal of H.

        Negative entries of materials count as zero. It leaves out products of weight derivatives along different axes,
        which are zero for an isotropic law at F = I, and at mirror planes those of a node with its image.
        """
        d = self.stencil.strain_dim
        places = np.cumsum([0, *range(d * d, 1, -1)])  # of the diagonal, row by row
        elastic = jnp.stack([self.upper[m] for m in places]).reshape(d, d, -1)
        for part in self.coupled:
            share = part.diagonal(self.stencil, size).slopes
            elastic = elastic if share is None else elastic + share
        shares = [part.diagonal(self.stencil, size) for part in self.others]
        total = scattered([Forces(slopes=jnp.maximum(elastic, 0)), *shares], self.stencil.squared, size)
        return self.mirror.fold_scalar(total) if self.mirror.images else total

    def damped(self, potential: ElasticPotential, rate: Scalar) -> "ParticleStiffness":
        """H + r D, with r = `rate` [1/s] and D [N s/m] the positive semi-definite matrix of viscous forces."""
        upper, d = self.upper, self.stencil.strain_dim

        def damping(points: MaterialPoints) -> Array:
            def flux_of(slopes: Matrix) -> Matrix:
                return la.transpose(points.weighted_viscous_stress(la.transpose(slopes)))

            like = jnp.zeros((d, d, *points.volume.shape), points.volume.dtype)
            return la.upper_triangle(la.matrix_of(flux_of, like))

        if potential.material_viscous:
            upper = upper + rate * jnp.concatenate([damping(points) for points in potential.material_points], axis=-1)
        return replace(self, upper=upper, others=tuple(part.damped(rate) for part in self.others))


class TangentAction(AbstractHessianAction):
    """H by the stress differentials of the materials.

    Args:
        potential: the potential.
        tangents: for each material, the symmetric linear map δF ↦ δP [Pa] of its particles, both of F's shape.
        positive_semidefinite: whether all of these maps are known to be positive semi-definite.
        u: the displacement at which terms have their stiffness [m], shape (n, d). Default: none.
    """

    potential: ElasticPotential
    tangents: tuple[Callable[[Deformation], Deformation], ...]
    positive_semidefinite: bool = eqx.field(static=True, default=False)
    u: NodeVector | None = None

    @eqx.filter_jit  # a law may hold functions
    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p V0_p δP_p h_ip, with δP_p = ∂²Ψ/∂F∂F : δF_p (derivation, eqs. 7 and 8), and what terms add."""
        potential, moved = self.potential, self.potential.displaced(du)
        gradient, pairs = (
            la.transpose(moved.at_particles[1]),
            zip(potential.material_points, self.tangents, strict=True),
        )
        stress = [tangent(points.change(points.rows_of(gradient))) for points, tangent in pairs]
        elastic = Forces(slopes=la.transpose(potential.weighted_stress(stress)))
        at = potential.displaced(self.u)
        return potential.on_nodes([elastic, *(term.hessian(at)(moved) for term in potential.terms)])

    def precomputed(self) -> ParticleStiffness:
        potential, d = self.potential, self.potential.stencil.strain_dim
        pairs = zip(potential.material_points, self.tangents, strict=True)
        upper, coupled = zip(*(points.stiffness(tangent, d) for points, tangent in pairs), strict=True)
        coupled, at = sum(coupled, ()), potential.displaced(self.u)
        others, definite = tuple(term.hessian(at) for term in potential.terms), self.positive_semidefinite
        upper = jnp.concatenate(upper, axis=-1)
        return ParticleStiffness(upper, potential.stencil, potential.mirror, definite, coupled, others)


class AbstractHessian(eqx.Module):
    """The Hessian of the potential in an implicit update.

    With one linear solve the Hessian is part of the equation. With Newton's method it only sets the steps towards the
    solution of an equation without it. Subclass it for a Hessian of your own: `at` can return a `TangentAction`, which
    is made from stress differentials at a deformation.
    """

    @abc.abstractmethod
    def at(self, potential: ElasticPotential, u: NodeVector | None) -> AbstractHessianAction:
        """The Hessian of the potential at a nodal displacement u [m], shape (n, d); None for u = 0."""

    def exact(self) -> "AbstractHessian":
        """The Hessian that this one approximates, which derivatives of a solution by Newton's method use. Default: this
        one."""
        return self


class AnalyticHessian(AbstractHessian):
    """The Hessian by the stress differential of the law (derivation, eqs. 7 to 12). Faster than `JvpHessian`.

    With `projected`, the stress differential of each particle is made positive semi-definite first (see the law's
    `projected_differential`). M + χH is then positive definite at every compression and step. Particles whose
    differential is positive semi-definite already are not changed. One linear solve then solves another equation, with
    more damping; Newton's method takes other steps to the same solution. First derivatives stay exact; second
    derivatives raise.

    Args:
        projected: whether the stress differentials are projected.
    """

    projected: bool = eqx.field(static=True, default=False)
    __check_init__ = require_fields

    def at(self, potential: ElasticPotential, u: NodeVector | None) -> TangentAction:
        of_law = lambda law, F: law.projected_differential(F) if self.projected else law.stress_differential(F)  # noqa: E731
        pairs = zip(potential.material_points, potential.deformation(u), strict=True)
        tangents = tuple(points.stress_differential(F, of_law, definite=self.projected) for points, F in pairs)
        return TangentAction(potential, tangents, self.projected, u)

    def exact(self) -> "AnalyticHessian":
        return AnalyticHessian() if self.projected else self


class JvpHessian(AbstractHessian):
    """The Hessian by `jax.jvp` of the gradient of each law's energy. It needs only the energy of a law."""

    def at(self, potential: ElasticPotential, u: NodeVector | None) -> TangentAction:
        def differential(law: AbstractMaterial, F: Deformation, dF: Deformation) -> Deformation:
            return jax.jvp(jax.grad(lambda F: law.energy(F).sum()), (F,), (dF,))[1]

        # no closure: the rule of a solve takes its problem as a tree of arrays
        of_law = lambda law, F: eqx.Partial(differential, law, F)  # noqa: E731
        pairs = zip(potential.material_points, potential.deformation(u), strict=True)
        tangents = tuple(points.stress_differential(F, of_law) for points, F in pairs)
        return TangentAction(potential, tangents, u=u)
