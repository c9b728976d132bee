"""The gradient operators: of the spline, and of moving least squares."""

import equinox as eqx


class SplineGradient(eqx.Module):
    """The gradient of the kernel itself, g_ip = ∇w_ip: the reference's choice."""


class MLSGradient(eqx.Module):
    """The moving-least-squares gradient, g_ip = w_ip D_p⁻¹ (x_i − x_p), D_p = Σ_i w_ip (x_i − x_p)(x_i − x_p)ᵀ.

    D_p = dx²/4 I for the quadratic and dx²/3 I for the cubic kernel; for the linear one the product is the gradient of
    the kernel, without the singularity of D_p at a node (C. Jiang, C. Schroeder, A. Selle, J. Teran, A. Stomakhin,
    ACM Trans. Graph. 34 (2015) 51, doi 10.1145/2766996; Y. Hu et al., ACM Trans. Graph. 37 (2018) 150,
    doi 10.1145/3197517.3201293). The velocity gradient then is APIC's affine matrix.
    """


Gradient = SplineGradient | MLSGradient
