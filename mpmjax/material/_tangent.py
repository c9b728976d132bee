"""The stress differential: the derivative of a law's stress, as a linear map and by its eigenstructure."""

import abc
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, Float, Matrix


class AbstractTangent(eqx.Module):
    """The stress differential at one deformation: the linear map δF ↦ δP = ∂²Ψ/∂F∂F : δF (derivation, eq. 8).

    It holds everything that does not depend on δF, so that a solver that applies it many times computes that once.
    """

    @abc.abstractmethod
    def __call__(self, dF: Deformation) -> Deformation:
        """δP [Pa] for δF [-], both of shape (d, d, p); for laws of J alone δ(dΨ/dJ) for δJ, both of shape (p,)."""

    def pushed_forward(self, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"] | None:
        """The upper triangle of the symmetric matrix of G ↦ w (∂²Ψ/∂F∂F : (G A)) Aᵀ, row by row, in closed form, shape
        (d²(d² + 1)/2, *p). Rows and columns are the components G_ab, b before a. Default: None, and the map is applied
        to the d² unit matrices instead, which takes several times as long. It is never differentiated.

        Args:
            A: any matrices [-], shape (d, d, *p).
            weight: w, shape (*p).
        """
        del A, weight
        return None


class MatrixTangent(AbstractTangent):
    """The stress differential as a d² x d² matrix for each particle."""

    matrix: Float[Array, "m m *p"]
    """∂²Ψ/∂F∂F [Pa], on the d² components of δF in C order, shape (d², d², *p)."""

    def __call__(self, dF: Matrix) -> Matrix:
        return la.matmul(self.matrix, dF.reshape(-1, 1, *dF.shape[2:])).reshape(dF.shape)


class VolumetricTangent(AbstractTangent):
    """The stress differential of a law of J alone: δJ ↦ d²Ψ/dJ² δJ."""

    stiffness: Float[Array, "*p"]
    """d²Ψ/dJ² [Pa], shape (p,)."""

    def __call__(self, dF: Array) -> Array:
        return self.stiffness * dF


class PrincipalTangent(eqx.Module):
    """The eigenstructure of an isotropic law's ∂²Ψ/∂F∂F at F = U diag(s) Vᵀ (B. Smith, F. de Goes, T. Kim, ACM Trans.
    Graph. 38 (2019) 3, doi 10.1145/3241041).

    With e_ij the unit matrices, U (e_ij − e_ji) Vᵀ/√2 is an eigenvector of eigenvalue `twist`, U (e_ij + e_ji) Vᵀ/√2
    one of eigenvalue `flip`, and the d remaining eigenvectors are U diag(q) Vᵀ with q those of `scaling`.
    """

    twist: Float[Array, "c *p"]
    """(∂Ψ/∂s_i + ∂Ψ/∂s_j)/(s_i + s_j) [Pa] for the pairs i < j, in the order (0, 1), (0, 2), (1, 2), shape
    (d (d − 1)/2, *p)."""
    flip: Float[Array, "c *p"]
    """(∂Ψ/∂s_i − ∂Ψ/∂s_j)/(s_i − s_j) [Pa] for the same pairs."""
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
        """From functions of the indices i, j: twist and flip of each pair i < j, and each entry of the scaling.

        Args:
            s: signed principal stretches [-], shape (d, *p).
            twist: the twist of a pair [Pa], shape (*p).
            flip: the flip of a pair [Pa], shape (*p).
            scaling: ∂²Ψ/∂s_i∂s_j [Pa], shape (*p).
        """
        d, none = s.shape[0], jnp.zeros((0, *s.shape[1:]), s.dtype)

        def over_pairs(entry: Callable[[int, int], Array]) -> Array:
            return jnp.stack([entry(i, j) for i, j in la.pairs(d)]) if d > 1 else none

        entries = [[scaling(i, j) for j in range(d)] for i in range(d)]
        return cls(over_pairs(twist), over_pairs(flip), la.assemble(entries))
