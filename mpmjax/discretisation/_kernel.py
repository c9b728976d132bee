"""B-spline kernels."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import require, require_fields


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

    order: int = eqx.field(static=True, default=2)

    def __check_init__(self):
        require_fields(self)
        require(self.order in (1, 2, 3), f"A B-spline's order must be 1, 2 or 3, got {self.order}.")

    @property
    def variance(self) -> float:
        """Σ_i w_ip (x_i − x_p)²/dx² along an axis [-], for the quadratic and the cubic kernel. For the linear one it
        depends on the place."""
        return {2: 1 / 4, 3: 1 / 3}[self.order]

    def base(self, xi: Array) -> Array:
        """Lattice index of the first stencil node along each axis, for positions xi in spacings, both (d, p)."""
        return jnp.floor(xi - (self.order - 1) / 2)

    def weights(self, f: Array) -> Array:
        """Weights of the order + 1 nodes along each axis [-], shape (d, order + 1, p), at a distance f from the first
        node in spacings, shape (d, p)."""
        match self.order:
            case 1:
                return jnp.stack([1 - f, f], axis=1)
            case 2:
                height, curvature = (np.array(a, f.dtype)[:, None] for a in ((0, 0.75, 0), (0.5, -1, 0.5)))
                return self._from_knot(f) ** 2 * curvature + height
            case _:
                t = f - 1
                near = (3 * t**3 - 6 * t**2 + 4) / 6
                far = (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6
                return jnp.stack([(1 - t) ** 3 / 6, near, far, t**3 / 6], axis=1)

    def derivatives(self, f: Array) -> Array:
        """Derivatives of the weights with respect to f [1/spacing], shape (d, order + 1, p)."""
        match self.order:
            case 1:
                return jnp.stack([-jnp.ones_like(f), jnp.ones_like(f)], axis=1)
            case 2:
                return self._from_knot(f) * np.array((1, -2, 1), f.dtype)[:, None]
            case _:
                t = f - 1
                near = (9 * t**2 - 12 * t) / 6
                far = (-9 * t**2 + 6 * t + 3) / 6
                return jnp.stack([-((1 - t) ** 2) / 2, near, far, t**2 / 2], axis=1)

    @property
    def centre(self) -> float:
        """The middle of the distances f from a first node in which the others follow, in spacings."""
        return self.order / 2

    @property
    def knots(self) -> Float[np.ndarray, "s"]:
        """τ_i of `pieces`, shape (order + 1,): for the outermost nodes the end at which their weights vanish."""
        return np.array([0.5, *[0.0] * (self.order - 1), -0.5])

    @property
    def pieces(self) -> Float[np.ndarray, "s k"]:
        """Coefficients c of the weights as polynomials Σ_k c_ik (f − centre − τ_i)^k, shape (order + 1, order + 1)."""
        match self.order:
            case 1:
                return np.array([[0.0, -1], [0, 1]])
            case 2:
                return np.array([[0, 0, 0.5], [0.75, 0, -1], [0, 0, 0.5]])
            case _:
                return np.array([[0, 0, 0, -8], [23, -30, -12, 24], [23, 30, -12, -24], [0, 0, 0, 8]]) / 48

    def _from_knot(self, f: Array) -> Array:
        """The distances in which the quadratic kernel's weights are parabolas, one formula for all three: XLA does not
        vectorise a stack in what its derivative is fused with."""
        return f[:, None] - np.array((1.5, 1, 0.5), f.dtype)[:, None]
