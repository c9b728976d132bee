"""Gradient operators: those of the spline and of moving least squares."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Scalar
from mpmjax.discretisation._kernel import BSpline

_STEEPEST = {2: 6.0, 3: 3.1368191}
"""The largest value over a cell of dx² Σ_i (∂w_ip)²/w_ip, for the quadratic and the cubic kernel."""


class AbstractGradient(eqx.Module):
    """The gradient operator g_ip [1/m] of the internal force and of the deformation gradient's update."""

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
        del kernel, spacing, inverse_moment
        return None


class SplineGradient(AbstractGradient):
    """The gradient of the kernel, g_ip = ∇w_ip."""

    def derivatives(self, spline: Float[Array, "d s p"], least_squares: Float[Array, "d s p"]) -> Float[Array, "d s p"]:
        del least_squares
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

    def derivatives(self, spline: Float[Array, "d s p"], least_squares: Float[Array, "d s p"]) -> Float[Array, "d s p"]:
        del spline
        return least_squares

    def steepness(self, kernel: BSpline, spacing: Scalar, inverse_moment: Float[Array, "*p"]) -> Array | None:
        del kernel, spacing
        return inverse_moment
