"""Power sums of the isochoric principal stretches, of which the laws of rubber are functions.

With J = det F and C = FᵀF, the isochoric stretches are λ̄_i = J^−1/3 λ_i: three of them, whatever d is, those normal to
F being J^−1/3 (plane and uniaxial strain). A power sum is T_α = λ̄_1^α + λ̄_2^α + λ̄_3^α. The first two invariants of the
isochoric deformation are Ī1 = T_2 and Ī2 = T_−2, and the sums of other powers are Ogden's.
"""

import abc

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Matrix, PerParticle
from mpmjax.linalg import PowerLessOne


class AbstractPowerSum(eqx.Module):
    """A power sum T_α of the isochoric stretches.

    Its derivative is ∂T/∂F = α F⁻ᵀ D, with the deviator D = C̄^{α/2} − T/3 I of the isochoric C̄ = J^−2/3 C.
    """

    exponent: eqx.AbstractVar[PerParticle]
    """α [-]."""

    @abc.abstractmethod
    def strain(self, F: Matrix, log_J: Array) -> Matrix:
        """C̄^{α/2} − I, shape (d, d, *p).

        Args:
            F: deformation gradient [-], shape (d, d, *p).
            log_J: ln J [-], shape (*p).
        """

    def excess(self, trace: Array, log_J: Array, dim: int) -> Array:
        """T − 3 [-], shape (*p), zero at rest.

        Args:
            trace: that of `strain` in the d directions of F [-], shape (*p).
            log_J: ln J [-], shape (*p).
            dim: d.
        """
        return trace + (3 - dim) * jnp.expm1(-self.exponent / 3 * log_J)


class FirstInvariant(AbstractPowerSum):
    """Ī1 = T_2."""

    exponent: PerParticle = eqx.field(static=True, default=2)

    def strain(self, F: Matrix, log_J: Array) -> Matrix:
        """J^−2/3 C − I."""
        return jnp.exp(-2 / 3 * log_J) * la.matmul(la.transpose(F), F) - la.identity_like(F)


class SecondInvariant(AbstractPowerSum):
    """Ī2 = T_−2."""

    exponent: PerParticle = eqx.field(static=True, default=-2)

    def strain(self, F: Matrix, log_J: Array) -> Matrix:
        """J^2/3 C⁻¹ − I, by the cofactor matrix J F⁻ᵀ."""
        cofactor = la.cofactor(F)
        return jnp.exp(-4 / 3 * log_J) * la.matmul(la.transpose(cofactor), cofactor) - la.identity_like(F)


class PowerSum(AbstractPowerSum):
    """T_α of any exponent, by the eigenvalues of C. Its derivatives hold at repeated stretches."""

    exponent: PerParticle

    def strain(self, F: Matrix, log_J: Array) -> Matrix:
        """J^{−α/3} C^{α/2} − I."""
        exponent = self.exponent * jnp.ones_like(log_J)
        return PowerLessOne(exponent / 2, -exponent / 3 * log_J)(la.matmul(la.transpose(F), F))
