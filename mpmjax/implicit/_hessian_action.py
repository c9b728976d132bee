"""The elastic energy's Hessian as a linear map of nodal displacements."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix, NodeVector, Scalar
from mpmjax.boundary import Coupling, Mirror, Springs, spring_answer, spring_diagonal, spring_resistance
from mpmjax.discretisation import Stencil, gather, resist, scatter
from mpmjax.implicit._potential import ElasticPotential
from mpmjax.state import MaterialPoints, SupportStiffness, VolumeAverage, stiffness_of


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


class AveragedStiffness(eqx.Module):
    """What averaged volumes add to the stiffness of the particles of one material, which then is no longer that of each
    by itself: with the slopes g of the displacement, δJ = c : g, and the mean δJ̄ = S V0 δJ,

        flux = K g + b δJ̄ + V0 c S (b : g + k δJ̄)

    (see `AveragedTangent`)."""

    rows: tuple[int, int] = eqx.field(static=True)
    """First particle and the one after the last."""
    average: VolumeAverage
    """S."""
    volumetric: Matrix
    """V0 c [m^d], shape (d, d, q), the derivative's direction first."""
    coupling: Matrix
    """b [J], likewise."""
    bulk: Float[Array, "q"]
    """k [J], shape (q,)."""

    def __call__(self, slopes: Matrix) -> Matrix:
        """b δJ̄ + V0 c S (b : g + k δJ̄) [J], from the slopes of all particles; zero for those of other materials."""
        g, count = slopes[..., slice(*self.rows)], slopes.shape[-1]
        mean = self.average.spread(la.double_dot(self.volumetric, g))
        back = self.average.spread(la.double_dot(self.coupling, g) + self.bulk * mean)
        own = self.coupling * mean + self.volumetric * back
        return own if self.rows == (0, count) else jnp.zeros_like(slopes).at[..., slice(*self.rows)].set(own)

    def diagonal(self) -> Matrix:
        """The diagonal of each particle's matrix if volumes were not averaged, without that of K [J], (d, d, q)."""
        c = self.volumetric / self.average.volume
        return 2 * self.coupling * c + self.bulk * c**2


def _averaged_stiffness(points: MaterialPoints, average: VolumeAverage, tangent: Any) -> AveragedStiffness:
    """From the stress differential of a material whose volumes are averaged, an `AveragedTangent`."""
    cofactor, d = tangent.cofactor, tangent.at.dim
    own, mean = tangent.local(jnp.zeros_like(cofactor), jnp.ones_like(points.volume))

    def flux(P: Matrix) -> Matrix:
        return la.transpose(points.flux(P, d))

    return AveragedStiffness(points.rows, average, flux(cofactor), flux(own), points.volume * mean)


class ParticleStiffness(AbstractHessianAction):
    """H as one symmetric matrix for each particle. Applying it evaluates no law."""

    upper: Float[Array, "t p"]
    """The upper triangle of K_p [J] (see `ElasticPotential.stiffness`), row by row, shape (d²(d² + 1)/2, p)."""
    stencil: Stencil
    mirror: Mirror
    positive_semidefinite: bool = eqx.field(static=True, default=False)
    supports: tuple[SupportStiffness, ...] = ()
    """Of the springs to the ground."""
    springs: tuple[Springs, ...] = ()
    """The springs of contact, whose Hessian is added."""
    averaged: tuple[AveragedStiffness, ...] = ()
    """The materials whose volumes are averaged."""
    couplings: tuple[Coupling, ...] = ()
    """Those between bodies."""

    def is_positive_semidefinite(self) -> bool:
        return self.positive_semidefinite

    @property
    def alone(self) -> bool:
        """Whether H is the resistance of the particles and nothing else."""
        return not (self.mirror.images or self.supports or self.springs or self.averaged or self.couplings)

    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p g_ip K_p Σ_j g_jp δu_j, and what supports and springs add."""
        u = self.mirror.unfold(du)
        separate = not self.averaged and not self.springs
        force = self.mirror.fold(resist(self.stencil, self.upper, u) if separate else self._with_others(u))
        force = _with_couplings(force, self.couplings, self.mirror, du)
        return force + sum(support(du) for support in self.supports) if self.supports else force

    def _with_others(self, u: NodeVector) -> NodeVector:
        """The same with what averaged volumes and the springs of contact add to the sums, before these are folded."""
        moved = gather(self.stencil, u)
        slopes, value = moved[1], None
        flux = la.matmul(la.symmetric(self.upper), slopes.reshape(-1, 1, slopes.shape[-1])).reshape(slopes.shape)
        for one in self.averaged:
            flux = flux + one(slopes)
        if self.springs:
            value, more = spring_answer(self.springs, moved)
            flux = flux + more
        return scatter(self.stencil, value, flux, len(u))

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
        added = [(slice(*one.rows), one.diagonal().reshape(d * d, -1)) for one in self.averaged]

        places = np.cumsum([0, *range(d * d, 1, -1)])  # of the diagonal, row by row

        def entry(m: int) -> Array:
            own = self.upper[places[m]]
            for rows, more in added:
                own = own.at[rows].add(more[m])
            return own

        stiff = jnp.stack([jnp.maximum(entry(m), 0) for m in range(d * d)])
        nodes = scatter(self.stencil.squared, None, stiff.reshape(d, d, -1), like.shape[0])
        found = self.mirror.fold_scalars(nodes)
        if self.springs:
            found = found + spring_diagonal(self.springs, self.stencil, self.mirror, like.shape[0])
        for coupling in self.couplings:
            found = found + self.mirror.fold_scalars(coupling.diagonal(len(like)))
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
    materials = tuple(zip(potential.material_points, tangents, strict=True))
    upper = potential.stiffness(tuple(t if points.average is None else _own_part(t) for points, t in materials))
    averaged = tuple(
        _averaged_stiffness(points, points.average, t) for points, t in materials if points.average is not None
    )
    return ParticleStiffness(
        upper,
        potential.stencil,
        potential.mirror,
        positive_semidefinite,
        stiffness_of(potential.held_by()),
        potential.springs,
        averaged,
        potential.couplings,
    )


def _own_part(tangent: Any) -> Callable[[Deformation], Deformation]:
    """The part of an `AveragedTangent` at means that do not change."""
    return lambda dF: tangent.local(dF, jnp.zeros_like(tangent.tau))[0]


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
        stiffness, damping = self.elastic.precomputed(), self.potential.damping_matrices()
        upper = stiffness.upper if damping is None else stiffness.upper + self.rate * damping
        supports = stiffness_of(self.potential.held_by(), self.rate)
        return eqx.tree_at(lambda s: (s.upper, s.supports), stiffness, (upper, supports))


def damped(elastic: AbstractHessianAction, potential: ElasticPotential, rate: Scalar) -> AbstractHessianAction:
    """H + r D, with D [N s/m] the positive semi-definite matrix of the viscous force; H without viscosity.

    A stage of length Δt_s has r = 1/Δt_s, which gives M + Δt_s D + Δt_s² H.
    """
    return _DampedAction(elastic, potential, rate) if potential.viscous else elastic
