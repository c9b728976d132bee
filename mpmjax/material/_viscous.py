"""Viscosity, added to any law."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Matrix, PerParticle
from mpmjax.checks import require, require_between, require_fields
from mpmjax.material._base import Law


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


class Viscous(eqx.Module):
    """A law with a Newtonian viscosity: to the law's stress is added

        σ_v = 2η dev D + ζ tr(D) I,    D = sym ∇_x v,    dev D = D − ⅓ tr(D) I (plane strain in two dimensions).

    With a fluid this gives the compressible Navier-Stokes equations, with a solid the Kelvin-Voigt model, a spring and
    a dashpot in parallel. It conserves linear and angular momentum, takes |J| V0 as the particle's volume (J = det F,
    or det F_E of a law with a history), and only dissipates energy.

    Explicit steps take the velocity gradient C that particles stored a step ago. Implicit ones solve for it in the
    configuration of the step's start: methods of second order are of first order in what a step turns or strains.
    *When it breaks*: explicit steps are limited by diffusion besides sound, dx²/ν (see `stable_dt`). APIC, PIC and FLIP
    have a numerical viscosity on the scale of the grid, in which a small η disappears: see their orders.
    *Good values*: η of water 1e-3, of oil 0.1, of honey 10 Pa s; for a solid some thousandths of E times the period
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
        """The viscosity without the law."""
        return Viscosity(self.shear_viscosity, self.bulk_viscosity)
