"""The action of the elastic energy's Hessian, both ways, and the operator M + cH of the implicit solve."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix, NodeScalar, NodeVector, Scalar
from mpmjax.boundary import Mirror
from mpmjax.checks import require_fields
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.implicit._metric import Metric
from mpmjax.implicit._potential import ElasticPotential, Matrices
from mpmjax.implicit._projection import Projection
from mpmjax.material import AbstractMaterial, AbstractTangent, projected_tangent


class AbstractHessianAction(eqx.Module):
    """The linear map δu ↦ H δu = ∂²Φ/∂u∂u : δu [N], of nodes' displacements."""

    @abc.abstractmethod
    def __call__(self, du: NodeVector) -> NodeVector:
        """H δu."""

    @abc.abstractmethod
    def assembled(self) -> "Stiffness":
        """The same map, for many applications."""


class Stiffness(AbstractHessianAction):
    """H by one matrix a particle, made once: d⁴ numbers each, and no way through the law at each application."""

    matrix: Float[Array, "m m p"]
    """K_p [J] (see `ElasticPotential.stiffness`), shape (d², d², p)."""
    stencil: Stencil
    mirror: Mirror

    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p g_ip K_p Σ_j g_jp δu_j."""
        _, slopes = gather(self.stencil, self.mirror.unfold(du))
        flux = la.matmul(self.matrix, slopes.reshape(-1, 1, slopes.shape[-1])).reshape(slopes.shape)
        return self.mirror.fold(scatter(self.stencil, None, flux, du.shape[0]))

    def assembled(self) -> "Stiffness":
        """Itself."""
        return self

    def diagonal(self, like: NodeVector) -> NodeVector:
        """Σ_p Σ_b g_ip,b² K_p,ba,ba [N/m], never negative: the diagonal for a scaling, not to the last digit.

        Negative entries of K count as zero. What the diagonal has besides are products of slopes along different axes,
        which an isotropic law has none of at F = I, and at mirror planes of a node's with its image's.

        Args:
            like: any node vector.
        """
        d = like.shape[1]
        stiff = jnp.stack([jnp.maximum(self.matrix[m, m], 0) for m in range(d * d)])
        nodes = scatter(self.stencil.squared, None, stiff.reshape(d, d, -1), like.shape[0])
        return jnp.stack([self.mirror.fold_scalar(component) for component in nodes.T], axis=1)


class _AnalyticAction(AbstractHessianAction):
    potential: ElasticPotential
    tangents: tuple[AbstractTangent, ...]

    def __call__(self, du: NodeVector) -> NodeVector:
        """Σ_p V0_p A_p h_ip, with A_p = ∂²Ψ/∂F∂F : δF_p (reference, eqs. 7 and 8, the gradient in eq. 7 being node
        i's)."""
        return _analytic_action(self.potential, self.tangents, du)

    def assembled(self) -> Stiffness:
        """From the stress differentials."""
        return _stiffness(self.potential, self.tangents)


def _stiffness(potential: ElasticPotential, tangents: tuple[Callable[[Matrix], Matrix], ...]) -> Stiffness:
    return Stiffness(potential.stiffness(tangents), potential.stencil, potential.mirror)


@jax.jit
def _analytic_action(potential: ElasticPotential, tangents: tuple[AbstractTangent, ...], du: NodeVector) -> NodeVector:
    changes = (tangent(dF) for tangent, dF in zip(tangents, potential.strain(du), strict=True))
    return potential.divergence(tuple(changes), du)


class _JvpAction(AbstractHessianAction):
    potential: ElasticPotential
    u: NodeVector

    def __call__(self, du: NodeVector) -> NodeVector:
        """The derivative of ∂Φ/∂u in the direction δu."""
        return _jvp_action(self.potential, self.u, du)

    def assembled(self) -> Stiffness:
        """From the derivative of the energies' gradients by F."""
        laws = (c.law for c in self.potential.material_points)
        places = zip(laws, self.potential.displaced(self.u), strict=True)
        return _stiffness(self.potential, tuple(_derived_tangent(law, F) for law, F in places))


def _derived_tangent(law: AbstractMaterial, F: Matrix) -> Callable[[Matrix], Matrix]:
    stress = jax.grad(lambda F: law.energy(F).sum())
    return lambda dF: jax.jvp(stress, (F,), (dF,))[1]


@jax.jit
def _jvp_action(potential: ElasticPotential, u: NodeVector, du: NodeVector) -> NodeVector:
    return jax.jvp(jax.grad(potential.energy), (u,), (du,))[1]


class _DampedAction(AbstractHessianAction):
    elastic: AbstractHessianAction
    potential: ElasticPotential
    rate: Scalar

    def __call__(self, du: NodeVector) -> NodeVector:
        """(H + r D) δu."""
        return self.elastic(du) + self.rate * self.potential.damping_force(du)

    def assembled(self) -> Stiffness:
        """One matrix a particle for both."""
        stiffness = self.elastic.assembled()
        return eqx.tree_at(
            lambda s: s.matrix, stiffness, stiffness.matrix + self.rate * self.potential.damping_matrices()
        )


def damped(elastic: AbstractHessianAction, potential: ElasticPotential, rate: Scalar) -> AbstractHessianAction:
    """H + r D, D the viscous force's by velocity [N s/m]: with r = 1/c a stage of length c has M + c D + c² H. Without
    viscosity it is H."""
    return _DampedAction(elastic, potential, rate) if potential.viscous else elastic


class AnalyticHessian(eqx.Module):
    """Hessian by the law's analytic stress differential (reference, eqs. 7 to 12). The faster of the two.

    With `projected`, each particle's stress differential is made positive semi-definite first (see
    `projected_tangent`), so that M + cH is positive definite whatever the compression and the step. A particle whose
    differential is so already is not changed by it. One linear solve then solves another, more strongly damped
    equation where it matters; Newton's method only takes another way to the same solution. First derivatives stay
    exact; second ones are refused.

    Args:
        projected: whether to project.
    """

    projected: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        require_fields(self)

    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        """The Hessian of the potential at a displacement u."""
        return self._action(potential, potential.displaced(u))

    def at_current(self, potential: ElasticPotential, like: NodeVector) -> AbstractHessianAction:
        """The Hessian at u = 0, without the gather."""
        del like
        return self._action(potential, potential.current_deformation())

    def exact(self) -> "AnalyticHessian":
        """The Hessian itself, of which this may be a projection."""
        return AnalyticHessian()

    def _action(self, potential: ElasticPotential, F: Matrices) -> _AnalyticAction:
        def tangent(law: AbstractMaterial, F: Matrix) -> AbstractTangent:
            return projected_tangent(law, F) if self.projected else law.tangent(F)

        laws = (c.law for c in potential.material_points)
        return _AnalyticAction(potential, tuple(tangent(law, own) for law, own in zip(laws, F, strict=True)))


class JvpHessian(eqx.Module):
    """Hessian by `jax.jvp` of the energy's gradient: needs nothing of a law but its energy, and checks the other."""

    def at(self, potential: ElasticPotential, u: NodeVector) -> AbstractHessianAction:
        """The Hessian of the potential at a displacement u."""
        return _JvpAction(potential, u)

    def at_current(self, potential: ElasticPotential, like: NodeVector) -> AbstractHessianAction:
        """The Hessian at u = 0."""
        return _JvpAction(potential, jnp.zeros_like(like))

    def exact(self) -> "JvpHessian":
        """Itself."""
        return self


Hessian = AnalyticHessian | JvpHessian


class ImplicitOperator(lx.AbstractLinearOperator):
    """Q (M + c H) Q + I − Q, symmetric: c = βΔt² for the semi-implicit step (reference, eq. 6 times m_i), the square of
    its length for a stage.

    Q keeps what is not held (see `Projection`); rows of prescribed components and of empty nodes are the identity, and
    along the held normals of colliders stands the mass.
    """

    mass: NodeScalar
    factor: Scalar
    hessian: AbstractHessianAction
    projection: Projection
    inner: Metric = eqx.field(static=True, default=Metric.MASS)

    @property
    def _shape(self) -> tuple[int, ...]:
        return self.projection.free.shape

    def unconstrained(self, v: NodeVector) -> NodeVector:
        """(M + c H) v."""
        return self.mass[:, None] * v + self.factor * self.hessian(v)

    def mv(self, vector: NodeVector) -> NodeVector:
        """The operator applied to a node vector."""
        split = self.projection.combine
        return split(self.unconstrained(split(vector, 0)), self.projection.identity(vector, self.mass))

    def assembled(self) -> "ImplicitOperator":
        """The same operator, for many applications."""
        return eqx.tree_at(lambda o: o.hessian, self, self.hessian.assembled())

    def metric(self) -> NodeVector:
        """W, the inner product over all rows: on free ones m_i or m_i + c H_ii (its mean over the directions where a
        normal is held, so that it commutes with Q), on identity rows 1."""
        mass = jnp.broadcast_to(self.mass[:, None], self._shape)
        return self.projection.metric(self.diagonal() if self.inner is Metric.DIAGONAL else mass)

    def diagonal(self) -> NodeVector:
        """m_i + c H_ii, of H's diagonal what is positive (see `Stiffness.diagonal`)."""
        mass = jnp.broadcast_to(self.mass[:, None], self._shape)
        return mass + self.factor * self.hessian.assembled().diagonal(mass)

    def as_matrix(self) -> Float[Array, "nd nd"]:
        """The dense matrix, for tests and small problems."""
        shape = self._shape
        columns = jax.vmap(lambda e: self.mv(e.reshape(shape)).reshape(-1))
        return columns(jnp.eye(shape[0] * shape[1], dtype=self.mass.dtype)).T

    def transpose(self) -> "ImplicitOperator":
        """Itself."""
        return self

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Of a node vector."""
        return jax.ShapeDtypeStruct(self._shape, self.mass.dtype)

    def out_structure(self) -> jax.ShapeDtypeStruct:
        """Of a node vector."""
        return self.in_structure()


@lx.is_symmetric.register(ImplicitOperator)
def _(operator: ImplicitOperator) -> bool:
    return True


for _property in (
    lx.is_diagonal,
    lx.is_tridiagonal,
    lx.has_unit_diagonal,
    lx.is_lower_triangular,
    lx.is_upper_triangular,
    lx.is_positive_semidefinite,  # H can be indefinite
    lx.is_negative_semidefinite,
):

    @_property.register(ImplicitOperator)
    def _(operator: ImplicitOperator) -> bool:
        return False


del _property


@lx.linearise.register(ImplicitOperator)
@lx.conj.register(ImplicitOperator)
def _(operator: ImplicitOperator) -> Any:
    return operator
