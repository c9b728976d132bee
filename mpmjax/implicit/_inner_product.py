"""The inner product in which a linear system is solved."""

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp


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
