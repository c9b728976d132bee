"""The matrix of implicit solves, M + χH on free components, as a lineax operator."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.implicit._hessian import AbstractHessianAction, ParticleStiffness
from mpmjax.implicit._projection import Projection
from mpmjax.implicit._vectors import ParticleMatrices, product


class AbstractSymmetricOperator(lx.AbstractLinearOperator):
    """A symmetric operator on arrays of one shape, given by its products with vectors."""

    @abc.abstractmethod
    def is_positive_semidefinite(self) -> bool:
        """Whether the operator is known to be positive semi-definite, as solvers such as `lineax.CG` require."""

    @abc.abstractmethod
    def mv(self, vector: Array) -> Array:
        """The product with a vector."""

    @abc.abstractmethod
    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of a vector."""

    def support(self) -> Bool[Array, "..."] | None:
        """Where the operator is not the identity, in the shape of a vector; None if that is not known."""
        return None

    def product(
        self, v: Array, weight: Float[Array, "..."], active: Bool[Array, "k"]
    ) -> tuple[Array, Float[Array, ""]]:
        """W⁻¹A v and vᵀA v for this operator A, as an iteration needs them.

        Args:
            v: v.
            weight: the diagonal of W, of the same shape.
            active: where vectors may differ from zero, and where they are passed over (see `active_blocks`).
        """
        del active
        image = self.mv(v)
        return image / weight, (v * image).sum()

    def matrices(self) -> ParticleMatrices | None:
        """The operator as one matrix for each particle; None if it is more than that."""
        return None

    def out_structure(self) -> jax.ShapeDtypeStruct:
        return self.in_structure()

    def as_matrix(self) -> Float[Array, "nd nd"]:
        vector = self.in_structure()
        columns = jax.vmap(lambda e: self.mv(e.reshape(vector.shape)).reshape(-1))
        return columns(jnp.eye(vector.size, dtype=vector.dtype)).T

    def transpose(self) -> "AbstractSymmetricOperator":
        return self


class ImplicitOperator(AbstractSymmetricOperator):
    """Q (M + χ H) Q + I − Q [kg] (derivation, eq. 21), with χ = βΔt² for the semi-implicit step and Δt_s² for a stage
    of length Δt_s.

    Q projects on free components (see `Projection`). Rows of prescribed components and of empty nodes are those of the
    identity; along a held normal the operator is the mass.
    """

    mass: NodeScalar
    """Nodal masses m_i [kg], shape (n,)."""
    factor: Scalar
    """χ [s²]."""
    hessian: AbstractHessianAction
    """H [N/m]."""
    projection: Projection

    def is_positive_semidefinite(self) -> bool:
        return self.hessian.is_positive_semidefinite()

    def unconstrained(self, v: NodeVector) -> NodeVector:
        """(M + χ H) v."""
        return self.mass[:, None] * v + self.factor * self.hessian(v)

    def mv(self, vector: NodeVector) -> NodeVector:
        combine = self.projection.combine
        return combine(self.unconstrained(combine(vector, 0)), self.projection.identity_rows(vector, self.mass))

    def product(
        self, v: NodeVector, weight: NodeVector, active: Bool[Array, "k"]
    ) -> tuple[NodeVector, Float[Array, ""]]:
        """Without held normals, all but H v in one pass."""
        free = self.projection.free
        if self.projection.normals:
            return super().product(v, weight, active)
        force = self.hessian(self.projection.combine(v, 0)).reshape(-1)
        image, square = product(
            force, v.reshape(-1), self.mass, self.factor, free.reshape(-1), weight.reshape(-1), active
        )
        return image.reshape(v.shape), square

    def support(self) -> Mask:
        return self.projection.free

    def matrices(self) -> ParticleMatrices | None:
        hessian, free = self.hessian, self.projection.free
        if self.projection.normals or not isinstance(hessian, ParticleStiffness) or not hessian.alone:
            return None
        stencil = hessian.stencil
        return ParticleMatrices(
            stencil.factors, stencil.places, hessian.upper, self.mass, self.factor, free.reshape(-1)
        )

    def precomputed(self) -> "ImplicitOperator":
        """The operator, with H as one matrix for each particle, computed once for many applications."""
        return eqx.tree_at(lambda o: o.hessian, self, self.hessian.precomputed())

    def nodal_mass(self) -> NodeVector:
        """m_i [kg] in each component, shape (n, d)."""
        return jnp.broadcast_to(self.mass[:, None], self.projection.free.shape)

    def diagonal(self) -> NodeVector:
        """m_i + χ H_ii [kg], shape (n, d), without negative parts of H (see `ParticleStiffness.diagonal`)."""
        mass = self.nodal_mass()
        return mass + self.factor * self.hessian.precomputed().diagonal(mass)

    def in_structure(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(self.projection.free.shape, self.mass.dtype)


@lx.is_symmetric.register(AbstractSymmetricOperator)
def _(operator: AbstractSymmetricOperator) -> bool:
    return True


@lx.is_positive_semidefinite.register(AbstractSymmetricOperator)
def _(operator: AbstractSymmetricOperator) -> bool:
    return operator.is_positive_semidefinite()


for _property in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_negative_semidefinite,
):

    @_property.register(AbstractSymmetricOperator)
    def _(operator: AbstractSymmetricOperator) -> bool:
        return False


del _property


@lx.linearise.register(AbstractSymmetricOperator)
@lx.materialise.register(AbstractSymmetricOperator)
@lx.conj.register(AbstractSymmetricOperator)
def _(operator: AbstractSymmetricOperator) -> Any:
    return operator
