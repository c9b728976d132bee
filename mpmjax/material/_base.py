"""What a law is."""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle
from mpmjax.checks import require_fields, require_moduli


class AbstractTangent(eqx.Module):
    """The stress differential at one deformation: the linear map δF ↦ δP = ∂²Ψ/∂F∂F : δF (reference, eq. 8).

    Holds what does not depend on δF, so that a solver which applies it many times computes that once.
    """

    @abc.abstractmethod
    def __call__(self, dF: Matrix) -> Matrix:
        """δP [Pa] for δF [-], both of shape (d, d, p)."""


class MatrixTangent(AbstractTangent):
    """The stress differential as a matrix."""

    matrix: Float[Array, "m m *p"]
    """A on the d² components in C order, shape (d², d², *p) [Pa]."""

    def __call__(self, dF: Matrix) -> Matrix:
        """δP for δF."""
        return la.matmul(self.matrix, dF.reshape(-1, 1, *dF.shape[2:])).reshape(dF.shape)


class PrincipalTangent(eqx.Module):
    """The closed-form eigenstructure of ∂²Ψ/∂F∂F at F = U diag(s) Vᵀ (B. Smith, F. de Goes, T. Kim, ACM Trans. Graph.
    38 (2019) 3, doi 10.1145/3241041).

    With e_ij the unit matrices, U (e_ij − e_ji) Vᵀ/√2 is an eigenvector of eigenvalue `twist`, U (e_ij + e_ji) Vᵀ/√2
    one of eigenvalue `flip`, and the d remaining eigenvectors are U diag(q) Vᵀ with q those of `scaling`.
    """

    twist: Float[Array, "c *p"]
    """Of the pairs i < j [Pa], in the order (0, 1), (0, 2), (1, 2), shape (d (d − 1)/2, *p)."""
    flip: Float[Array, "c *p"]
    """Likewise."""
    scaling: Matrix
    """∂²Ψ/∂s_i∂s_j [Pa], shape (d, d, *p)."""

    @classmethod
    def of(
        cls,
        s: Float[Array, "d *p"],
        twist: Callable[[int, int], Array],
        flip: Callable[[int, int], Array],
        scaling: Callable[[int, int], Array],
    ) -> "PrincipalTangent":
        """From an expression a pair, and one an entry of the scaling, at stretches s."""
        d, none = s.shape[0], jnp.zeros((0, *s.shape[1:]), s.dtype)

        def over_pairs(entry: Callable[[int, int], Array]) -> Array:
            return jnp.stack([entry(i, j) for i, j in la.pairs(d)]) if d > 1 else none

        entries = [[scaling(i, j) for j in range(d)] for i in range(d)]
        return cls(over_pairs(twist), over_pairs(flip), la.assemble(entries))


class AbstractMaterial(eqx.Module):
    """A hyperelastic law: energy density, its gradient and its second differential.

    Matrices are component first, (d, d, p). Parameters are one value for all particles or one for each, shape (p,);
    each is a leaf that can be differentiated and batched. Two dimensions are plane strain; one is uniaxial strain.
    """

    @abc.abstractmethod
    def energy(self, F: Matrix) -> Array:
        """Ψ(F) [J/m³ of undeformed volume], shape (p,)."""

    @abc.abstractmethod
    def stress(self, F: Matrix) -> Matrix:
        """The first Piola-Kirchhoff stress P = ∂Ψ/∂F [Pa], shape (d, d, p)."""

    @abc.abstractmethod
    def tangent(self, F: Matrix) -> AbstractTangent:
        """The stress differential at F, ∂²Ψ/∂F∂F: a symmetric map."""

    @abc.abstractmethod
    def principal_tangent(self, s: Float[Array, "d *p"]) -> PrincipalTangent:
        """The eigenstructure of the stress differential at signed principal stretches s [-], shape (d, *p)."""

    @abc.abstractmethod
    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        """Whether the law is defined at F."""


class AbstractInelastic(eqx.Module):
    """An elastic law that yields: F is the elastic part F_E of the deformation, and what a step strains beyond the
    yield condition is taken out of it after the step (return map). The implicit solve sees the elastic law alone.

    What a particle remembers besides F_E is its history: a pytree, the law's own, of arrays of shape (p,).
    """

    @abc.abstractmethod
    def initial_history(self, F: Matrix) -> Any:
        """The history of particles at elastic deformations F that have never yielded, leaves of shape (p,)."""

    @abc.abstractmethod
    def elastic(self, history: Any) -> AbstractMaterial:
        """The elastic law in force."""

    @abc.abstractmethod
    def return_map(self, F: Matrix, history: Any) -> tuple[Matrix, Any]:
        """The return map: the admissible F_E next to a trial one, and the history after it."""


Law = AbstractMaterial | AbstractInelastic


class AbstractVolumetric(eqx.Module):
    """Marks a law that knows of the deformation its determinant alone: what other laws see as F is J, (1, 1, p), and a
    particle stores no more."""


class AbstractIsotropic(AbstractMaterial):
    """A law that small strains see as Lamé's: δP = 2μ ε + λ tr(ε) I at F = I."""

    youngs_modulus: PerParticle
    """E [Pa]."""
    poisson_ratio: PerParticle
    """ν [-]."""

    def __check_init__(self):
        require_fields(self)
        require_moduli(type(self).__name__, self.youngs_modulus, self.poisson_ratio)

    @property
    def shear_modulus(self) -> PerParticle:
        """μ = E / (2 (1 + ν)) [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> PerParticle:
        """λ = E ν / ((1 + ν)(1 − 2ν)) [Pa]."""
        return self.youngs_modulus * self.poisson_ratio / ((1 + self.poisson_ratio) * (1 - 2 * self.poisson_ratio))

    @property
    def bulk_modulus(self) -> PerParticle:
        """K = E / (3 (1 − 2ν)) [Pa], of three dimensions."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))
