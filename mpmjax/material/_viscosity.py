"""A Newtonian viscous stress."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Matrix, PerParticle


class Viscosity(eqx.Module):
    """A Newtonian viscous stress, linear in the velocity gradient L = ∇_x v."""

    shear: PerParticle
    """η [Pa s]."""
    bulk: PerParticle
    """ζ [Pa s]."""

    def stress(self, L: Matrix) -> Matrix:
        """σ_v = 2η dev D + ζ tr(D) I [Pa], D = ½ (L + Lᵀ), dev D = D − ⅓ tr(D) I in every dimension."""
        twice = L + la.transpose(L)
        spherical = (self.bulk - 2 / 3 * self.shear) * la.trace(L)
        return self.shear * twice + spherical * la.identity_like(L)

    def stiffest(self, dim: int) -> Array:
        """The largest eigenvalue [Pa s] of L ↦ σ_v: 2η for shear, 2η (1 − d/3) + dζ for even expansion."""
        even = 2 * (1 - dim / 3) * self.shear + dim * self.bulk
        return jnp.asarray(even) if dim == 1 else jnp.maximum(2 * self.shear, even)
