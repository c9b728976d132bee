"""B-spline kernels, and the gradient operators that are made of them."""

from abc import abstractmethod
from typing import Annotated

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.checks import between, require_fields

VARIANCE = {2: 1 / 4, 3: 1 / 3}  # `BSpline.variance` of each order
_STEEPEST = {2: 6.0, 3: 3.1368191}
"""The largest value over a cell of dx² Σ_i (∂w_ip)²/w_ip, for the quadratic and the cubic kernel."""


class BSpline(eqx.Module):
    """The tensor-product B-spline of a given order: 1 linear, 2 quadratic, 3 cubic.

    A particle has order + 1 nodes in each direction. The weights are a partition of unity and reproduce affine
    functions.

    *When it breaks*: the gradient of the linear kernel jumps at cell faces. Particles that cross them make the error
    grow under refinement (M. Steffen, R. M. Kirby, M. Berzins, Int. J. Numer. Methods Eng. 76 (2008) 922,
    doi 10.1002/nme.2360). A particle on a node next to empty nodes has no gradient along
    that axis, and no stiffness.

    *Good values*: 2, the default; 3 where smoothness matters.

    Args:
        order: 1, 2 or 3.
    """

    order: Annotated[int, between(1, 3)] = eqx.field(static=True, default=2)
    __check_init__ = require_fields

    @property
    def variance(self) -> float:
        """Σ_i w_ip (x_i − x_p)²/dx² along an axis [-], for the quadratic and the cubic kernel. For the linear one it
        depends on the place."""
        return VARIANCE[self.order]

    def base(self, xi: Array) -> Array:
        """Lattice index of the first stencil node along each axis, for positions xi in spacings, both (d, p)."""
        return jnp.floor(xi - (self.order - 1) / 2)

    def weights(self, f: Array) -> Array:
        """Weights of the order + 1 nodes along each axis [-], shape (d, order + 1, p), at a distance f from the first
        node in spacings, shape (d, p)."""
        return around_knots(self.pieces, self.knots, f - self.order / 2)

    @property
    def knots(self) -> Float[np.ndarray, "s"]:
        """τ_i of `pieces`, shape (order + 1,): for the outermost nodes the end at which their weights vanish."""
        return np.array([0.5, *[0.0] * (self.order - 1), -0.5])

    @property
    def pieces(self) -> Float[np.ndarray, "s k"]:
        """Coefficients c of the weights as polynomials Σ_k c_ik (f − order/2 − τ_i)^k, shape (order + 1, order + 1)."""
        match self.order:
            case 1:
                return np.array([[0.0, -1], [0, 1]])
            case 2:
                return np.array([[0, 0, 0.5], [0.75, 0, -1], [0, 0, 0.5]])
            case _:
                return np.array([[0, 0, 0, -8], [23, -30, -12, 24], [23, 30, -12, -24], [0, 0, 0, 8]]) / 48

    @property
    def slopes(self) -> Float[np.ndarray, "s k"]:
        """Coefficients of the derivatives of the weights, as `pieces` [1/spacing]."""
        return np.polynomial.polynomial.polyder(self.pieces, axis=1)

    @property
    def moments(self) -> Float[np.ndarray, "s k"]:
        """Coefficients of w (i − f)/variance, the derivatives by moving least squares, as `pieces` [1/spacing].
        The linear kernel, whose variance vanishes at nodes, has the slopes."""
        if self.order == 1:
            return self.slopes
        arms = [(node - self.order / 2 - knot, -1.0) for node, knot in enumerate(self.knots)]
        pairs = zip(self.pieces, arms, strict=True)
        return np.array([np.polynomial.polynomial.polymul(*both) for both in pairs]) / VARIANCE[self.order]


def around_knots(
    coefficients: Float[np.ndarray, "s k"], knots: Float[np.ndarray, "s"], t: Float[Array, "*b p"]
) -> Float[Array, "*b s p"]:
    """The polynomials Σ_k c_ik (t − τ_i)^k. One formula for all of them: XLA does not vectorise a stack in what its
    derivative is fused with."""
    c, at = coefficients.astype(t.dtype), t[..., None, :] - knots.astype(t.dtype)[:, None]
    total = jnp.zeros_like(at) + c[:, -1:]
    for k in range(c.shape[1] - 2, -1, -1):
        total = total * at + c[:, k : k + 1]
    return total


class AbstractGradient(eqx.Module):
    """The gradient operator g_ip [1/m] of the internal force and of the deformation gradient's update."""

    def polynomials(self, kernel: BSpline) -> Float[np.ndarray, "s k"] | None:
        """Coefficients of the factor that `derivatives` gives as polynomials, times the spacing: as `kernel.slopes`,
        shape (order + 1, k). Default: None, with which sums are those of XLA, by `derivatives`."""
        return None

    @abstractmethod
    def derivatives(self, spline: Float[Array, "d s p"], least_squares: Float[Array, "d s p"]) -> Float[Array, "d s p"]:
        """The factor along each axis that replaces the weight in g_ip [1/m], shape (d, s, p).

        Args:
            spline: this factor for the gradient of the spline, the derivative of the weight [1/m], shape (d, s, p).
            least_squares: this factor for the moving-least-squares gradient [1/m], shape (d, s, p).
        """

    def steepness(self, kernel: BSpline, spacing: Scalar, inverse_moment: Float[Array, "*p"]) -> Array | None:
        """Ξ [1/m²], a bound of the eigenvalues of Σ_i g_ip g_ipᵀ/w_ip at any place in a cell, for `stable_dt`. Default:
        None, with which `stable_dt` raises in the updated description; in the total one it needs no bound.

        Args:
            kernel: B-spline.
            spacing: distance dx between nodes [m].
            inverse_moment: the largest eigenvalue of D_p⁻¹, D_p = Σ_i w_ip (x_i − x_p)(x_i − x_p)ᵀ [1/m²].
        """
        return None


class SplineGradient(AbstractGradient):
    """The gradient of the kernel, g_ip = ∇w_ip."""

    def polynomials(self, kernel: BSpline) -> Float[np.ndarray, "s k"]:
        return kernel.slopes

    def derivatives(self, spline: Float[Array, "d s p"], least_squares: Float[Array, "d s p"]) -> Float[Array, "d s p"]:
        return spline

    def steepness(self, kernel: BSpline, spacing: Scalar, inverse_moment: Float[Array, "*p"]) -> Array | None:
        return inverse_moment if kernel.order == 1 else _STEEPEST[kernel.order] / jnp.asarray(spacing) ** 2


class MLSGradient(AbstractGradient):
    """The moving-least-squares gradient, g_ip = w_ip D_p⁻¹ (x_i − x_p), D_p = Σ_i w_ip (x_i − x_p)(x_i − x_p)ᵀ.

    D_p is dx²/4 I for the quadratic and dx²/3 I for the cubic kernel. For the linear kernel g_ip is the gradient of the
    kernel, without the singularity of D_p at a node (C. Jiang, C. Schroeder, A. Selle, J. Teran, A. Stomakhin,
    ACM Trans. Graph. 34 (2015) 51, doi 10.1145/2766996; Y. Hu et al., ACM Trans. Graph. 37 (2018) 150,
    doi 10.1145/3197517.3201293). The velocity gradient is then the affine matrix of APIC.
    """

    def polynomials(self, kernel: BSpline) -> Float[np.ndarray, "s k"]:
        return kernel.moments

    def derivatives(self, spline: Float[Array, "d s p"], least_squares: Float[Array, "d s p"]) -> Float[Array, "d s p"]:
        return least_squares

    def steepness(self, kernel: BSpline, spacing: Scalar, inverse_moment: Float[Array, "*p"]) -> Array | None:
        return inverse_moment
