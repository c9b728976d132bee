"""Preconditioners of the implicit solves."""

import abc
from typing import ClassVar

import equinox as eqx

from mpmjax.implicit._inner_product import AbstractInnerProduct, DiagonalInnerProduct
from mpmjax.implicit._operator import ImplicitOperator


class AbstractPreconditioner(eqx.Module):
    """A symmetric positive definite stand-in W for M + cH that is easily inverted.

    Iterations grow with the spread of the eigenvalues of W⁻¹(M + cH), and the tolerance of a solve is that of its
    residual in the norm of W⁻¹. A preconditioner of your own derives from this class.
    """

    advice: ClassVar[str | None] = None
    """What to take in its place where solves do not converge, as words that follow "or"; None where nothing better is
    known."""

    @abc.abstractmethod
    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        """The inner product of W. It must commute with the operator's projection, as a diagonal does that has gone
        through `operator.projection.commuting_weight`."""


class DiagonalPreconditioner(AbstractPreconditioner):
    """M + c diag(H), negative parts of H left out. The default.

    How much it saves depends on the scene. Of halves, layers and inclusions at contrasts of 10 to 10 000, in two and
    three dimensions, it took an eighth to three fifths of the mass's iterations at a hundred times the explicit limit,
    and a third to all of them at twenty times. In homogeneous bodies it took from a third of them to a fifth more.
    """

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.diagonal()))


class MassPreconditioner(AbstractPreconditioner):
    """M, with which the solve is the algorithm of the derivation, section 2.1."""

    advice: ClassVar[str | None] = "take preconditioner=DiagonalPreconditioner(), which needs fewer iterations"

    def inner_product(self, operator: ImplicitOperator) -> AbstractInnerProduct:
        return DiagonalInnerProduct(operator.projection.commuting_weight(operator.nodal_mass()))
