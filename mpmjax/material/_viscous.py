"""Viscosity, beside any law."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Matrix, PerParticle
from mpmjax.checks import require, require_between, require_fields
from mpmjax.material._base import Law


class Viscosity(eqx.Module):
    """The viscous part of a Cauchy stress, linear in the velocity gradient L = ∇_x v."""

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
        """The largest eigenvalue [Pa s] of L ↦ σ_v: 2η of what shears, 2η (1 − d/3) + dζ of what expands evenly."""
        even = 2 * (1 - dim / 3) * self.shear + dim * self.bulk
        return jnp.asarray(even) if dim == 1 else jnp.maximum(2 * self.shear, even)


class Viscous(eqx.Module):
    """A law with viscosity beside it: the stress of the law, and of the velocity gradient the Newtonian one,

        σ_v = 2η dev D + ζ tr(D) I,    D = sym ∇_x v,    dev D = D − ⅓ tr(D) I (plane strain in two dimensions).

    With a fluid it makes the compressible Navier-Stokes equations, with a solid Kelvin's and Voigt's, a spring and a
    dashpot side by side. It conserves linear and angular momentum, takes |J| V0 as the particle's volume (J = det F, of
    what yields det F_E), and never gives energy.

    Explicit steps take the velocity gradient that particles stored a step ago, C; implicit ones solve for it, at the
    configuration of the step's start, so that methods of second order lose it to what Δt ∇v turns and strains.
    *When it breaks*: explicit steps have a limit of diffusion besides that of sound, dx²/ν (see `stable_dt`). APIC, PIC
    and FLIP have a viscosity of their own on the scale of the grid, which a small η disappears in: see their orders.
    *Good values*: η of water 1e-3, of oil 0.1, of honey 10 Pa s; a solid's η of some thousandths of E times the period
    that is to be damped: a pressure wave's amplitude falls as e^{−ω²t (4η/3 + ζ)/(2 (λ + 2μ))}.

    Args:
        law: any law, elastic, plastic or fluid.
        shear_viscosity: η [Pa s], at least 0, one value or one per particle (p,).
        bulk_viscosity: ζ [Pa s], likewise.
    """

    law: Law
    shear_viscosity: PerParticle
    bulk_viscosity: PerParticle = 0.0

    def __check_init__(self):
        require(not isinstance(self.law, Viscous), "Viscous takes a law that is not viscous yet: add the viscosities.")
        require_fields(self)
        require_between("Viscous's shear_viscosity [Pa s]", self.shear_viscosity, 0, float("inf"))
        require_between("Viscous's bulk_viscosity [Pa s]", self.bulk_viscosity, 0, float("inf"))

    @property
    def viscosity(self) -> Viscosity:
        """Without the law."""
        return Viscosity(self.shear_viscosity, self.bulk_viscosity)
