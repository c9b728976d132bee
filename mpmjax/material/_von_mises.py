"""Metals: von Mises' yield condition on Hencky's elasticity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import require_between, require_fields, require_moduli, require_positive
from mpmjax.material._hencky import ElasticStrain, Hencky, no_transverse_strain
from mpmjax.material._law import AbstractInelastic


class VonMisesHistory(eqx.Module):
    """The history of a particle of von Mises' law."""

    plastic_strain: Float[Array, "*p"]
    """α [-], the accumulated equivalent plastic strain ∫ √(2/3) ‖d_p‖ dt, shape (p,)."""
    transverse_strain: Float[Array, "*p"] | None
    """ε_t [-] (see `Hencky`), shape (p,); None in 3-D."""


class VonMises(AbstractInelastic):
    """Von Mises' plasticity with linear isotropic hardening, at large strains (J. C. Simo, Comput. Methods Appl. Mech.
    Eng. 99 (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Elastic as Hencky's law, with Kirchhoff stress s = 2μ e in the deviator e of the elastic logarithmic strain. It
    yields at

        ‖s‖ = √(2/3) (σ_y + H α),

    which is the stress σ_y in uniaxial tension. Flow is associated and keeps the volume: the return map shortens e by

        Δγ = (‖s‖ − √(2/3) (σ_y + H α)) / (2μ + 2H/3),   α ← α + √(2/3) Δγ,

    along e, in closed form. In 1-D and 2-D the deviator is that of three dimensions: plane strain yields out of the
    plane too. Where nothing yields F is unchanged to the last bit.

    *When it breaks*: it needs J > 0, as Hencky's law does. The stress lags a step behind the yield condition, since the
    return map follows the step. Without hardening, strain localises in bands as wide as a cell. In float32 strains have
    an error of 1e-7, a thousandth of a metal's yield strain of 1e-4.
    *Good values*: steel E = 2.1e11 Pa, ν = 0.3, σ_y = 2.5e8 Pa, H = 1e9 Pa; annealed copper 1.2e11 Pa, 0.34, 7e7 Pa,
    5e8 Pa; lead 1.6e10 Pa, 0.44, 1e7 Pa, 5e7 Pa.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        yield_stress: σ_y [Pa], greater than zero.
        hardening_modulus: H [Pa], at least zero: the slope of yield stress over plastic strain.
    """

    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    yield_stress: PerParticle
    hardening_modulus: PerParticle = 0.0

    def __check_init__(self):
        require_fields(self)
        require_moduli("VonMises", self.youngs_modulus, self.poisson_ratio)
        require_positive("VonMises's yield_stress [Pa]", self.yield_stress)
        require_between("VonMises's hardening_modulus [Pa]", self.hardening_modulus, 0, np.inf)

    def initial_history(self, F: Matrix) -> VonMisesHistory:
        """α = 0, ε_t = 0."""
        return VonMisesHistory(jnp.zeros(F.shape[2:], F.dtype), no_transverse_strain(F))

    def elastic(self, history: VonMisesHistory) -> Hencky:
        """Hencky's law with the history's ε_t."""
        return Hencky(self.youngs_modulus, self.poisson_ratio, history.transverse_strain)

    def return_map(self, F: Matrix, history: VonMisesHistory, dt: Scalar) -> tuple[Matrix, VonMisesHistory]:
        """Radial return of the deviator."""
        del dt
        strain = ElasticStrain.of(F, history.transverse_strain)
        stiffness = 2 * self.elastic(history).shear_modulus
        allowed = (2 / 3) ** 0.5 * (self.yield_stress + self.hardening_modulus * history.plastic_strain)
        excess = stiffness * strain.deviation - allowed
        yields = excess > 0
        flow = jnp.where(yields, excess / (stiffness + 2 / 3 * self.hardening_modulus), 0)
        ratio = 1 - flow / jnp.where(yields, strain.deviation, 1)
        F, transverse = strain.returned(ratio, strain.mean)
        return F, VonMisesHistory(history.plastic_strain + (2 / 3) ** 0.5 * flow, transverse)
