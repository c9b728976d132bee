"""The matrix of implicit solves, M + χH on free components, and its preconditioners; the interface of solvers and
the report of a solve."""

import abc
from collections.abc import Sequence
from dataclasses import replace
from functools import partial, reduce
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import Mark, require_that
from mpmjax.implicit._potential import AbstractHessianAction, ElasticPotential, ParticleStiffness

_BLOCK_SIZE = 64  # as in native/problems.h


class Projection(eqx.Module):
    """The projection Q of node vectors on the components that nothing holds. At a node with held normals n it also
    removes the components along them, I − Σ n nᵀ.

    Without normals it is a mask.
    """

    free: Mask  # whether nothing prescribes a component, shape (n, d)
    normals: tuple[NodeVector, ...] = ()
    """Held unit normals, each (n, d), at right angles where a node has several; zero in components that are not free,
    and at nodes without one."""

    def combine(self, a: NodeVector | Scalar, b: NodeVector | Scalar) -> NodeVector:
        """Q a + (I − Q) b."""
        if not self.normals:
            return jnp.where(self.free, a, b)
        gap = jnp.where(self.free, b - a, 0)
        held = reduce(jnp.add, (normal * (normal * gap).sum(axis=1, keepdims=True) for normal in self.normals))
        return jnp.where(self.free, a + held, b)

    def commuting_weight(self, weight: NodeVector) -> NodeVector:
        """A positive diagonal weight made to commute with Q: 1 in components that are not free, and the mean over its
        components at a node with a held normal."""
        for normal in self.normals:
            oblique = (normal != 0).any(axis=1, keepdims=True)
            weight = jnp.where(oblique, weight.mean(axis=1, keepdims=True), weight)
        return jnp.where(self.free, weight, 1)

    def identity_rows(self, vector: NodeVector, mass: NodeScalar) -> Array:
        """The part of an operator's product outside of the range of Q: the vector itself, and along a held normal the
        vector times the nodal mass. An inner product of the mass or more then does not enlarge it, at light nodes
        too."""
        return jnp.where(self.free, mass[:, None], 1) * vector if self.normals else vector


class ImplicitOperator(eqx.Module):
    """The symmetric matrix A = Q (M + χ H) Q + I − Q [kg] (derivation, eq. 21), with χ = βΔt² for the semi-implicit
    step and Δt_s² for a stage of length Δt_s.

    Q projects on free components (see `Projection`). Rows of prescribed components and of empty nodes are those of the
    identity; along a held normal the operator is the mass.
    """

    mass: NodeScalar  # nodal masses m_i [kg], shape (n,)
    factor: Scalar  # χ [s²]
    hessian: AbstractHessianAction  # H [N/m]
    projection: Projection  # Q
    viscosity: tuple[ElasticPotential, Scalar] | None = None
    """The potential whose viscous force −D v is in the equation, and r [1/s]: H is then H + r D. None if there is no
    such force, or if `hessian` has it already."""

    def unconstrained(self, v: NodeVector) -> NodeVector:
        """(M + χ H) v."""
        force = self.hessian(v)
        if self.viscosity is not None:
            potential, rate = self.viscosity
            force = force + rate * potential.viscous_resistance(v)
        return self.mass[:, None] * v + self.factor * force

    def mv(self, vector: NodeVector) -> NodeVector:
        """A v."""
        combine = self.projection.combine
        return combine(self.unconstrained(combine(vector, 0)), self.projection.identity_rows(vector, self.mass))

    def product(self, u: Float[Array, "m"], weight: Float[Array, "m"], active: Bool[Array, "k"]) -> Sequence[Array]:
        """W⁻¹A u and uᵀA u of a flat vector, with the diagonal of W. Outside of the active blocks u is zero and nothing
        is free."""
        v, free = u.reshape(self.projection.free.shape), self.projection.free.reshape(-1)
        if self.projection.normals or self.viscosity is not None:
            image = self.mv(v).reshape(-1)
            return image / weight, (u * image).sum()
        force, factor = self.hessian(self.projection.combine(v, 0)).reshape(-1), jnp.asarray(self.factor, u.dtype)
        return rest_of_product(force, u, self.mass, factor, free, weight, active)

    @property
    def is_particle_matrices(self) -> bool:
        """Whether A is the mass and one matrix for each particle on a mask, and nothing else."""
        H = self.hessian
        if not isinstance(H, ParticleStiffness) or H.stencil.own_derivatives is not None:
            return False
        if H.stencil.radius is not None:
            return False
        return not (H.mirror.images or H.coupled or H.others or self.projection.normals or self.viscosity is not None)

    def precomputed(self) -> "ImplicitOperator":
        """The operator, with H as one matrix for each particle, computed once for many applications."""
        if isinstance(self.hessian, ParticleStiffness) and self.viscosity is None:
            return self
        stiffness = self.hessian.precomputed()
        stiffness = stiffness if self.viscosity is None else stiffness.damped(*self.viscosity)
        return ImplicitOperator(self.mass, self.factor, stiffness, self.projection)

    def nodal_mass(self) -> NodeVector:
        """m_i [kg] in each component, shape (n, d)."""
        return jnp.broadcast_to(self.mass[:, None], self.projection.free.shape)

    def diagonal(self) -> NodeVector:
        """m_i + χ H_ii [kg], shape (n, d), without negative parts of H (see `ParticleStiffness.diagonal`)."""
        stiffness = self.precomputed().hessian
        assert isinstance(stiffness, ParticleStiffness)
        return self.mass[:, None] + self.factor * stiffness.diagonal(len(self.mass))

    def in_structure(self) -> jax.ShapeDtypeStruct:
        """Shape and dtype of a vector."""
        return jax.ShapeDtypeStruct(self.projection.free.shape, self.mass.dtype)

    def as_matrix(self) -> Float[Array, "nd nd"]:
        """A as a dense matrix."""
        vector = self.in_structure()
        columns = jax.vmap(lambda e: self.mv(e.reshape(vector.shape)).reshape(-1))
        return columns(jnp.eye(vector.size, dtype=vector.dtype)).T


class AbstractInnerProduct(eqx.Module):
    """The inner product ⟨a, b⟩ = aᵀ W b with a symmetric positive definite W = L Lᵀ.

    W is a preconditioner of a symmetric A: W⁻¹A is self-adjoint in this inner product, and the number of iterations
    grows with the spread of its eigenvalues. `ConjugateResidual` works on W⁻¹A. Any other solver is given L⁻¹A L⁻ᵀ,
    which has the same eigenvalues and is symmetric in the plain inner product.

    The W of an `ImplicitOperator` must commute with its projection Q, W = Q W Q + (I − Q) W (I − Q), so that residuals
    and steps have no part in held components.
    """

    @abc.abstractmethod
    def apply(self, v: Any) -> Any:
        """W v."""

    @abc.abstractmethod
    def solve_factor(self, r: Any) -> Any:
        """L⁻¹ r."""

    @abc.abstractmethod
    def solve_factor_transpose(self, v: Any) -> Any:
        """L⁻ᵀ v."""

    def solve(self, r: Any) -> Any:
        """W⁻¹ r."""
        return self.solve_factor_transpose(self.solve_factor(r))

    def factored(self) -> "AbstractInnerProduct":
        """The inner product for solvers that need L: this one, if it has the factor."""
        return self


class DiagonalInnerProduct(AbstractInnerProduct):
    """The inner product of a diagonal W.

    Args:
        weight: the positive diagonal, of the structure of a vector.
    """

    weight: Any

    def apply(self, v: Any) -> Any:
        return jax.tree.map(jnp.multiply, self.weight, v)

    def solve_factor(self, r: Any) -> Any:
        return jax.tree.map(lambda r, w: r / jnp.sqrt(w), r, self.weight)

    def solve_factor_transpose(self, v: Any) -> Any:
        return self.solve_factor(v)

    def solve(self, r: Any) -> Any:
        return jax.tree.map(jnp.divide, r, self.weight)


class AbstractPreconditioner(eqx.Module):
    """A symmetric positive definite approximation W of M + χH that is easily inverted.

    The number of iterations grows with the spread of the eigenvalues of W⁻¹(M + χH). The tolerance of a solve is that
    of its residual in the norm of W⁻¹. Subclass it for a preconditioner of your own.
    """

    advice: ClassVar[str | None] = None
    """The remedy where solves do not converge, as words that follow "or"; None if nothing better is known."""

    @abc.abstractmethod
    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        """The inner product of W. W must commute with the operator's projection; for a diagonal,
        `operator.projection.commuting_weight` makes it so."""


class DiagonalPreconditioner(AbstractPreconditioner):
    """M + χ diag(H) without negative parts of H. The default.

    The saving depends on the scene. Bodies of halves, layers and inclusions, in two and three dimensions, at contrasts
    of 10 to 10 000 took an eighth to three fifths of the iterations of `MassPreconditioner` at a hundred times the
    explicit limit, and a third to all of them at twenty times; homogeneous ones between a third of them and a fifth
    more.
    """

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.diagonal()))


class MassPreconditioner(AbstractPreconditioner):
    """M: W⁻¹A is then the matrix of eq. 6 of the derivation."""

    advice: ClassVar[str | None] = "take preconditioner=DiagonalPreconditioner(), which needs fewer iterations"

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.nodal_mass()))


def active_blocks(*may_differ_from_zero: Bool[Array, "m"]) -> Bool[Array, "k"]:
    """Whether a block of 64 consecutive numbers may differ from zero, shape (⌈m/64⌉,). Others are skipped."""
    some = reduce(jnp.logical_or, may_differ_from_zero)
    return jnp.pad(some, (0, -len(some) % _BLOCK_SIZE)).reshape(-1, _BLOCK_SIZE).any(axis=1)


def _product(*args: Array) -> tuple[Array, Array]:
    """W⁻¹A v and vᵀA v, with (A v)_i = m_i v_i + χ f_i where i is free, f = H v, and v_i elsewhere."""
    force, v, mass, factor, free, weight, _ = args
    image = jnp.where(free, jnp.repeat(mass, len(v) // max(1, len(mass))) * v + factor * force, v)
    return image / weight, (v * image).sum()


rest_of_product = custom_derivative(_product, kernel="product", aliases={0: 0}).differentiated_as_written()
"""The rest of a product with M + χH, once H v is known, with an inner product. In JAX these are some four passes over
the window, of which a body may fill a small part; natively it is one, in place, that skips inactive blocks."""


combine_onto = tuple(
    custom_derivative(
        lambda a, b, c, d, scales, weight, _: (a + scales[0] * b, z := c + scales[1] * d, (weight * z * z).sum()),
        kernel="combine",
        aliases={onto: 0, 2 + onto: 1},
    ).differentiated_as_written()
    for onto in (0, 1)
)
"""Two sums of two vectors with a norm, in the memory of a and c, or of b and d. In JAX these are some four passes over
the window, of which a body may fill a small part; natively it is one that skips inactive blocks."""


_COUNT = partial(jnp.zeros, (), jnp.int32)


class SolveInfo(eqx.Module):
    """Cost and quality of the solution of one step's equations. The defaults are those of an update without a solve."""

    iterations: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)
    """Iterations of the linear solver, summed over Newton steps; 0 if the solver states none."""
    newton: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)  # Newton steps
    line_search: Int[Array, "*f"] = eqx.field(default_factory=_COUNT)  # halvings of a Newton step by the line search
    residual: Float[Array, "*f"] = eqx.field(kw_only=True)
    """True relative residual at the end. For one linear solve it is in the norm of the inverse preconditioner; for
    Newton's method in that of the inverse mass, and relative to the momentum of the balanced forces if their sum
    vanishes."""
    converged: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.ones, (), bool))
    """Whether the residual is within the solver's tolerance, or at the limit of the precision."""
    nearly_converged: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.zeros, (), bool))
    """Whether it is not, but within ten times the tolerance."""
    indefinite: Bool[Array, "*f"] = eqx.field(default_factory=partial(jnp.zeros, (), bool))
    """Whether the solver met a direction of negative curvature. M + χH is then indefinite, and may be near singular."""
    report: Float[Array, "*f"] = eqx.field(kw_only=True)
    """Zero. Its tangent is the relative residual of the tangent solves that did not converge (see `Reporting`)."""

    def followed_by(self, later: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves of one equation, and the quality of the later one."""
        return replace(
            later,
            iterations=self.iterations + later.iterations,
            newton=self.newton + later.newton,
            line_search=self.line_search + later.line_search,
            indefinite=self.indefinite | later.indefinite,
            report=self.report + later.report,
        )

    def together_with(self, other: "SolveInfo") -> "SolveInfo":
        """The summed cost of two solves that are both needed, and the quality of the worse one."""
        both = self.followed_by(other)
        converged = self.converged & other.converged
        usable = (self.converged | self.nearly_converged) & (other.converged | other.nearly_converged)
        worst = jnp.maximum(self.residual, other.residual)
        return replace(both, residual=worst, converged=converged, nearly_converged=usable & ~converged)


def no_solve(dtype: Any) -> SolveInfo:
    """The report of an update without a solve."""
    return SolveInfo(residual=jnp.zeros((), dtype), report=jnp.zeros((), dtype))


class AbstractInnerProductSolver(lx.AbstractLinearSolver[Any]):
    """A symmetric solver that takes an inner product itself.

    `init` is given an `ImplicitOperator`, `compute` the option `inner_product`, an `AbstractInnerProduct`. Its result
    is successful if it converged. Its statistics are `num_steps`, `residual`, `nearly_converged` and `indefinite` (see
    `SolveInfo`), and `spectral_radius`, a lower estimate of ‖W⁻¹A‖.
    """


@partial(Mark, "with an atol above zero")
def require_solver(name: str, solver: lx.AbstractLinearSolver) -> None:
    """Check a linear solver: a ValueError if it has an absolute tolerance that is not above zero."""
    if (atol := getattr(solver, "atol", None)) is not None:
        require_that(
            f"{name} must have an atol above zero, as it compares residuals component by component and those of empty "
            "nodes are zero (right-hand sides are scaled to norm one, so that it may be as large as rtol)",
            lambda a: a > 0,
            atol,
        )
