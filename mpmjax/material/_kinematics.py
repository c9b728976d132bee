"""The stored deformation of particles: the deformation gradient, or its determinant."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Matrix


class AbstractKinematics(eqx.Module):
    """The measure of deformation that a law's particles store, and how the motion of the grid changes it.

    In a step it is component first, a particle's number or matrix in the first axes.
    """

    axes: ClassVar[int]
    """How many axes one particle's deformation has."""
    symbol: ClassVar[str]
    """In messages, what is stored."""
    name: ClassVar[str]
    """In messages, what it is."""
    volume: ClassVar[str]
    """In messages, what most laws need to be positive."""
    rate: ClassVar[str]
    """In messages, the rate [1/s] whose product with a step must be below 1."""

    @abc.abstractmethod
    def undeformed(self, dim: int) -> np.ndarray:
        """The deformation of one particle at rest [-], of one particle's shape."""

    @abc.abstractmethod
    def of(self, F: Matrix) -> Deformation:
        """The stored deformation at deformation gradients [-], shape (d, d, p)."""

    @abc.abstractmethod
    def change(self, gradient: Matrix, deformation: Deformation) -> Deformation:
        """The change [-] by the gradient ∇u of a displacement, shape (d, d, p), to first order."""

    @abc.abstractmethod
    def flux(self, stress: Deformation, deformation: Deformation, dim: int) -> Matrix:
        """The summand of the nodal force f_i = −Σ_p flux_p g_ip, in the unit of the stress, shape (d, d, p): the
        transpose of `change`.

        Args:
            stress: the energy's derivative by the deformation.
            deformation: the deformation.
            dim: d.
        """

    @abc.abstractmethod
    def determinant(self, deformation: Deformation) -> Array:
        """J = det F [-], shape (p,)."""

    @abc.abstractmethod
    def collapsed(self, deformation: Deformation, least: float) -> Bool[Array, "p"]:
        """Whether the smallest principal stretch is below the least one that is allowed [-], shape (p,)."""


class DeformationGradient(AbstractKinematics):
    """The deformation gradient F [-], shape (d, d, p), or its elastic part."""

    axes: ClassVar[int] = 2
    symbol: ClassVar[str] = "F"
    name: ClassVar[str] = "deformation gradient"
    volume: ClassVar[str] = "det F"
    rate: ClassVar[str] = "|∇v|"

    def undeformed(self, dim: int) -> np.ndarray:
        return np.eye(dim)

    def of(self, F: Matrix) -> Matrix:
        return F

    def change(self, gradient: Matrix, deformation: Matrix) -> Matrix:
        """∇u F."""
        return la.matmul(gradient, deformation)

    def flux(self, stress: Matrix, deformation: Matrix, dim: int) -> Matrix:
        """P Fᵀ."""
        del dim
        return la.matmul(stress, la.transpose(deformation))

    def determinant(self, deformation: Matrix) -> Array:
        return la.determinant(deformation)

    def collapsed(self, deformation: Matrix, least: float) -> Bool[Array, "p"]:
        """Whether 1/‖F⁻¹‖ is below the least stretch, shape (p,). It lies between the smallest stretch and 1/√d of it,
        and needs no eigenvalues."""
        cofactor = la.cofactor(deformation)
        return la.determinant(deformation) ** 2 <= least**2 * la.double_dot(cofactor, cofactor)


class VolumeRatio(AbstractKinematics):
    """J = det F [-] alone, shape (p,)."""

    axes: ClassVar[int] = 0
    symbol: ClassVar[str] = "J"
    name: ClassVar[str] = "volume"
    volume: ClassVar[str] = "J"
    rate: ClassVar[str] = "|div v|"

    def undeformed(self, dim: int) -> np.ndarray:
        del dim
        return np.ones(())

    def of(self, F: Matrix) -> Array:
        return la.determinant(F)

    def change(self, gradient: Matrix, deformation: Array) -> Array:
        """tr(∇u) J."""
        return la.trace(gradient) * deformation

    def flux(self, stress: Array, deformation: Array, dim: int) -> Matrix:
        """dΨ/dJ J I."""
        return stress * deformation * jnp.eye(dim, dtype=deformation.dtype)[..., None]

    def determinant(self, deformation: Array) -> Array:
        return deformation

    def collapsed(self, deformation: Array, least: float) -> Bool[Array, "p"]:
        """Whether J is below the least stretch, shape (p,): nothing else is stored."""
        return jnp.abs(deformation) <= least


DEFORMATION_GRADIENT, VOLUME_RATIO = DeformationGradient(), VolumeRatio()
"""The two there are."""
