"""Elastic laws of the volume alone."""

import abc

import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, Matrix
from mpmjax.material._base import AbstractMaterial
from mpmjax.material._kinematics import VOLUME_RATIO, VolumeRatio
from mpmjax.material._law import AbstractElastic
from mpmjax.material._tangent import AbstractTangent, VolumetricTangent


class AbstractVolumetric(AbstractElastic):
    """An elastic law given by its energy density Ψ(J), J = det F, and nothing else of the deformation.

    Its particles store J and no F, so that it works in the updated description alone. A law needs `energy(J)` alone:
    its derivatives default to automatic differentiation.
    """

    @property
    def kinematics(self) -> VolumeRatio:
        return VOLUME_RATIO

    @property
    def allows_total(self) -> bool:
        """No: that description needs F."""
        return False

    @property
    def allows_averaged_volume(self) -> bool:
        """No: nothing would resist what the average does not see."""
        return False

    @abc.abstractmethod
    def energy(self, J: Array, /) -> Array:
        """Ψ(J) [J/m³ of undeformed volume], shape (p,).

        Args:
            J: det F [-], shape (p,).
        """

    def stress(self, J: Array, /) -> Array:
        """dΨ/dJ [Pa], minus the pressure, shape (p,). Default: the energy's gradient."""
        return super().stress(J)

    def tangent(self, J: Array, /) -> VolumetricTangent:
        """d²Ψ/dJ² [Pa]. Default: the derivative of the stress."""
        return VolumetricTangent(jax.jvp(self.stress, (J,), (jnp.ones_like(J),))[1])

    def projected_tangent(self, J: Array, /) -> VolumetricTangent:
        """max(d²Ψ/dJ², 0)."""
        return VolumetricTangent(jnp.maximum(self.tangent(J).stiffness, 0))

    def tangent_eigenvalues(self, J: Array, /, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """The one of d/dJ(JΨ') J tr(L) I that is not zero, d times the factor."""
        del total
        return dim * (self.tangent(J).stiffness * J * J + J * self.stress(J))[None]

    def of_gradient(self) -> "VolumetricOfGradient":
        return VolumetricOfGradient(self)


class VolumetricOfGradient(AbstractMaterial):
    """A law of J alone as a function of F: Ψ(det F)."""

    law: AbstractVolumetric

    def energy(self, F: Matrix) -> Array:
        return self.law.energy(la.determinant(F))

    def stress(self, F: Matrix) -> Matrix:
        """Ψ' J F⁻ᵀ."""
        return self.law.stress(la.determinant(F)) * la.cofactor(F)

    def tangent(self, F: Matrix) -> "VolumetricOfGradientTangent":
        J = la.determinant(F)
        return VolumetricOfGradientTangent(self.law.stress(J), self.law.tangent(J), F)

    def is_admissible(self, F: Matrix) -> Array:
        return self.law.is_admissible(la.determinant(F))


class VolumetricOfGradientTangent(AbstractTangent):
    """δP = Ψ'' (J F⁻ᵀ : δF) J F⁻ᵀ + Ψ' δ(J F⁻ᵀ)."""

    pull: Array
    bulk: VolumetricTangent
    F: Matrix

    def __call__(self, dF: Matrix) -> Matrix:
        cofactor = la.cofactor(self.F)
        dJ = la.double_dot(cofactor, dF)
        return self.bulk(dJ) * cofactor + self.pull * la.cofactor_differential(self.F, dF)
