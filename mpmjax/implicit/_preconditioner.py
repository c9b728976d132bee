"""Preconditioners of the implicit solves, and the inner products that they are."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax.implicit._operator import ImplicitOperator


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

    The saving depends on the scene. In bodies of halves, layers and inclusions at contrasts of 10 to 10 000, in two and
    three dimensions, it took between an eighth and three fifths of the iterations of `MassPreconditioner` at a hundred
    times the explicit limit, and between a third and all of them at twenty times. In homogeneous bodies it took between
    a third of them and a fifth more.
    """

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.diagonal()))


class MassPreconditioner(AbstractPreconditioner):
    """M: W⁻¹A is then the matrix of eq. 6 of the derivation."""

    advice: ClassVar[str | None] = "take preconditioner=DiagonalPreconditioner(), which needs fewer iterations"

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.nodal_mass()))
