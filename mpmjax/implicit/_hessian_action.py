"""The elastic energy's Hessian as a linear map of nodal displacements."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, NodeVector, Scalar
from mpmjax.boundary import Coupling, Mirror, Springs, spring_answer, spring_diagonal, spring_resistance
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.state import SupportStiffness, stiffness_of


class AbstractHessianAction(eqx.Module):
    """The symmetric linear map δu ↦ H δu [N], H = ∂²Φ/∂u∂u [N/m], on nodal displacements δu [m], shape (n, d)."""

    @abc.abstractmethod
    def is_positive_semidefinite(self) -> bool:
        """Whether H is known to be positive semi-definite."""

    @abc.abstractmethod
    def __call__(self, du: NodeVector) -> NodeVector:
        """H δu."""

    @abc.abstractmethod
    def precomputed(self) -> "ParticleStiffness":
        """The same map as one matrix for each particle, computed once for many applications."""


class ParticleStiffness(AbstractHessianAction):
    """H as one matrix for each particle, of d⁴ numbers. Applying it evaluates no law."""

    matrix: Float[Array, "m m p"]
    """K_p [J] (see `ElasticPotential.stiffness`), shape (d², d², p)."""
    stencil: Stencil
    mirror: Mirror
    positive_semidefinite: bool = eqx.field(static=True, default=False)
    supports: tuple[SupportStiffness, ...] = ()
    """Of the springs to the ground."""
    springs: tuple[Springs, ...] = ()
    """The springs of contact, whose Hessian is added."""
    couplings: tuple[Coupling, ...] = ()
    """Those between bodies."""

    def is_positive_semidefinite(self) -> bool:
        return self.positive_semidefinite

    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p g_ip K_p Σ_j g_jp δu_j, and what supports and springs add."""
        moved = gather(self.stencil, self.mirror.unfold(du))
        slopes, value = moved[1], None
        flux = la.matmul(self.matrix, slopes.reshape(-1, 1, slopes.shape[-1])).reshape(slopes.shape)
        if self.springs:
            value, more = spring_answer(self.springs, moved)
            flux = flux + more
        force = self.mirror.fold(scatter(self.stencil, value, flux, du.shape[0]))
        force = _with_couplings(force, self.couplings, self.mirror, du)
        return force + sum(support(du) for support in self.supports) if self.supports else force

    def precomputed(self) -> "ParticleStiffness":
        return self

    def diagonal(self, like: NodeVector) -> NodeVector:
        """Σ_p Σ_b g_ip,b² K_p,ba,ba [N/m], shape (n, d): a non-negative approximation of the diagonal of H.

        Negative entries of K count as zero. It leaves out products of weight derivatives along different axes, which
        are zero for an isotropic law at F = I, and at mirror planes those of a node with its image.

        Args:
            like: any node vector.
        """
        d = like.shape[1]
        stiff = jnp.stack([jnp.maximum(self.matrix[m, m], 0) for m in range(d * d)])
        nodes = scatter(self.stencil.squared, None, stiff.reshape(d, d, -1), like.shape[0])
        found = jnp.stack([self.mirror.fold_scalar(component) for component in nodes.T], axis=1)
        if self.springs:
            found = found + spring_diagonal(self.springs, self.stencil, self.mirror, like.shape[0])
        for coupling in self.couplings:
            each = coupling.diagonal(len(like)).T
            found = found + jnp.stack([self.mirror.fold_scalar(component) for component in each], axis=1)
        return found + sum(support.diagonal(like) for support in self.supports) if self.supports else found


class TangentAction(AbstractHessianAction):
    """H by the stress differentials of the materials.

    Args:
        potential: the elastic potential.
        tangents: for each material, the symmetric linear map δF ↦ δP [Pa] of its particles, both of F's shape.
        positive_semidefinite: whether all of these maps are known to be positive semi-definite.
    """

    potential: ElasticPotential
    tangents: tuple[Callable[[Deformation], Deformation], ...]
    positive_semidefinite: bool = eqx.field(static=True, default=False)

    def is_positive_semidefinite(self) -> bool:
        return self.positive_semidefinite

    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p V0_p δP_p h_ip, with δP_p = ∂²Ψ/∂F∂F : δF_p (derivation, eqs. 7 and 8)."""
        return _tangent_action(self.potential, self.tangents, du)

    def precomputed(self) -> ParticleStiffness:
        return particle_stiffness(self.potential, self.tangents, positive_semidefinite=self.positive_semidefinite)


def particle_stiffness(
    potential: ElasticPotential,
    tangents: tuple[Callable[[Deformation], Deformation], ...],
    *,
    positive_semidefinite: bool,
) -> ParticleStiffness:
    """H as one matrix for each particle, from the stress differentials of the materials."""
    matrix = potential.stiffness(tangents)
    supports, springs, couplings = stiffness_of(potential.held_by()), potential.springs, potential.couplings
    return ParticleStiffness(
        matrix, potential.stencil, potential.mirror, positive_semidefinite, supports, springs, couplings
    )


@eqx.filter_jit
def _tangent_action(
    potential: ElasticPotential, tangents: tuple[Callable[[Deformation], Deformation], ...], du: NodeVector
) -> NodeVector:
    changes = (tangent(dF) for tangent, dF in zip(tangents, potential.deformation_change(du), strict=True))
    force = potential.nodal_sum(potential.flux(tuple(changes)))
    if potential.springs:
        force = force + spring_resistance(potential.springs, potential.stencil, potential.mirror, du)
    force = _with_couplings(force, potential.couplings, potential.mirror, du)
    supports = stiffness_of(potential.held_by())
    return force + sum(support(du) for support in supports) if supports else force


def _with_couplings(force: NodeVector, couplings: tuple[Coupling, ...], mirror: Mirror, du: NodeVector) -> NodeVector:
    """A force with what the springs between bodies add to it [N], shape (n, d)."""
    if not couplings:
        return force
    moved = mirror.unfold(du)
    return force + sum(mirror.fold(coupling.resistance(moved)) for coupling in couplings)


class _DampedAction(AbstractHessianAction):
    elastic: AbstractHessianAction
    potential: ElasticPotential
    rate: Scalar

    def is_positive_semidefinite(self) -> bool:
        return self.elastic.is_positive_semidefinite()

    def __call__(self, du: NodeVector) -> NodeVector:
        """(H + r D) δu."""
        return self.elastic(du) + self.rate * self.potential.viscous_resistance(du)

    def precomputed(self) -> ParticleStiffness:
        stiffness, matrix = self.elastic.precomputed(), self.potential.damping_matrices()
        matrix = stiffness.matrix if matrix is None else stiffness.matrix + self.rate * matrix
        supports = stiffness_of(self.potential.held_by(), self.rate)
        return eqx.tree_at(lambda s: (s.matrix, s.supports), stiffness, (matrix, supports))


def damped(elastic: AbstractHessianAction, potential: ElasticPotential, rate: Scalar) -> AbstractHessianAction:
    """H + r D, with D [N s/m] the positive semi-definite matrix of the viscous force; H without viscosity.

    A stage of length Δt_s has r = 1/Δt_s, which gives M + Δt_s D + Δt_s² H.
    """
    return _DampedAction(elastic, potential, rate) if potential.viscous else elastic
