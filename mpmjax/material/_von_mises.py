"""Plastic flow that keeps the volume: metals by von Mises' law, pastes by Herschel and Bulkley's."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, PerParticle, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import require_between, require_fields, require_positive
from mpmjax.material._hencky import AbstractHenckyPlasticity


class VonMisesHistory(eqx.Module):
    """The history of a particle of von Mises' law, and of Herschel and Bulkley's, which does not depend on α."""

    plastic_strain: Float[Array, "*p"]
    """α [-], the accumulated equivalent plastic strain ∫ √(2/3) ‖d_p‖ dt, shape (p,); of pastes ∫ γ̇/√3 dt."""
    transverse_strain: Float[Array, "*p"] | None
    """ε_t [-] (see `Hencky`), shape (p,); None in 3-D."""


class VonMises(AbstractHenckyPlasticity):
    """Von Mises' plasticity with linear isotropic hardening, at large strains (J. C. Simo, Comput. Methods Appl. Mech.
    Eng. 99 (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Elastic as Hencky's law, with Kirchhoff stress s = 2μ e in the deviator e of the elastic logarithmic strain. It
    yields at

        ‖s‖ = √(2/3) (σ_y + H α),

    which is the stress σ_y in uniaxial tension. Flow is associated and keeps the volume: the return map shortens e by

        Δγ = (‖s‖ − √(2/3) (σ_y + H α)) / (2μ + 2H/3),   α ← α + √(2/3) Δγ,

    along e, in closed form. Plane strain yields out of the plane too.

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

    History: ClassVar[Any] = VonMisesHistory
    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    yield_stress: PerParticle
    hardening_modulus: PerParticle = 0.0

    def __check_init__(self):
        require_fields(self)
        require_positive("VonMises's yield_stress [Pa]", self.yield_stress)
        require_between("VonMises's hardening_modulus [Pa]", self.hardening_modulus, 0, np.inf)

    def flow(self, history: VonMisesHistory, mean: Array, deviation: Array, dt: Scalar) -> tuple[Array, Array, Array]:
        """Radial return of the deviator."""
        del dt
        stiffness = 2 * self.elastic(history).shear_modulus
        allowed = (2 / 3) ** 0.5 * (self.yield_stress + self.hardening_modulus * history.plastic_strain)
        excess = stiffness * deviation - allowed
        yields = excess > 0
        flow = jnp.where(yields, excess / (stiffness + 2 / 3 * self.hardening_modulus), 0)
        ratio = 1 - flow / jnp.where(yields, deviation, 1)
        return ratio, mean, history.plastic_strain + (2 / 3) ** 0.5 * flow


class HerschelBulkley(AbstractHenckyPlasticity):
    """An elastic body that flows, beyond a yield stress, at a rate that grows with the stress: paste, mud, foam, dough
    (W. H. Herschel, R. Bulkley, Kolloid-Z. 39 (1926) 291; in the Material Point Method Y. Yue, B. Smith, C. Batty,
    C. Zheng, E. Grinspun, ACM Trans. Graph. 34 (2015) 160, doi 10.1145/2751541). With n = 1 it is Bingham's law.

    Elastic as Hencky's law, with Kirchhoff stress s = 2μ e in the deviator e of the elastic logarithmic strain. With
    the shear stress τ = ‖s‖/√2 and the shear rate of the flow γ̇ = √2 ‖d_p‖,

        γ̇ = 0 where τ ≤ τ_Y,   else   τ = τ_Y + η γ̇ⁿ.

    Flow is along e and keeps the volume. The return map shortens e to the overstress that belongs to the flow of the
    step, by the backward Euler method: with the trial stress τ* > τ_Y,

        τ = τ* − μ Δt γ̇,   μ Δt γ̇ + η γ̇ⁿ = τ* − τ_Y,

    whose share w = μ Δt γ̇/(τ* − τ_Y) solves w + c wⁿ = 1, c = η ((τ* − τ_Y)/(μ Δt))ⁿ/(τ* − τ_Y): in closed form
    1/(1 + c) for n = 1, else by Newton's method in ln w. In steady shear the stress is that of the law at any step. At
    rest it relaxes to τ_Y, for n = 1 as e^{−μt/η}. With η = 0 it is `VonMises` with the tensile yield stress √3 τ_Y.

    *When it breaks*: it needs J > 0, as Hencky's law does. The stress lags a step behind the law, since the return map
    follows the step, and in an implicit step the elastic law alone resists: its part adds to the flow's stress some
    μ Δt γ̇, of which `run.statistics.linearisation_error` tells.
    Explicit steps are limited by the speed of sound, not by η. τ_Y is that of shear, a factor √3 below that of
    tension. With n = 1 the derivative jumps where flow begins.
    *Good values*: τ_Y of some tens to some hundreds of Pa, n = 0.3 to 1, and η so that η γ̇ⁿ is of the size of τ_Y. The
    elasticity of pastes hardly matters to their flow and limits the step: take E as soft as a yield strain τ_Y/μ of a
    few per cent allows, and ν = 0.45.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        yield_stress: τ_Y [Pa], in shear, greater than zero.
        consistency: η [Pa sⁿ], at least zero; the viscosity of the flow if n = 1.
        exponent: n [-], positive; less than 1 where what flows faster flows more easily.
    """

    History: ClassVar[Any] = VonMisesHistory
    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    yield_stress: PerParticle
    consistency: PerParticle
    exponent: PerParticle = 1.0

    def __check_init__(self):
        require_fields(self)
        require_positive("HerschelBulkley's yield_stress [Pa]", self.yield_stress)
        require_between("HerschelBulkley's consistency [Pa s^n]", self.consistency, 0, np.inf)
        require_positive("HerschelBulkley's exponent", self.exponent)

    @property
    def flows(self) -> bool:
        return True

    def flow(self, history: VonMisesHistory, mean: Array, deviation: Array, dt: Scalar) -> tuple[Array, Array, Array]:
        """Return of the deviator to the overstress of its flow over the step."""
        stiffness = self.elastic(history).shear_modulus
        trial = 2**0.5 * stiffness * deviation
        yields = trial > self.yield_stress
        excess = jnp.where(yields, trial - self.yield_stress, 1)
        fastest = excess / (stiffness * dt)  # the rate at which the flow of the step takes all of the excess
        exponent = jnp.asarray(self.exponent, deviation.dtype)
        share = _share_of_flow(self.consistency * fastest**self.exponent / excess, exponent)
        relaxed = jnp.where(yields, share * excess, 0)
        ratio = 1 - relaxed / jnp.where(yields, trial, 1)
        return ratio, mean, history.plastic_strain + relaxed / (3**0.5 * stiffness)


_NEWTON_STEPS = 8
"""Enough for 1e-15 at exponents from 0.1 to 4."""


@custom_derivative
def _share_of_flow(c: Array, n: Array) -> Array:
    """w [-] of w + c wⁿ = 1, by Newton's method for ln(w + c wⁿ) = 0 in ln w: a convex function, of slope between 1 and
    n, that starts beyond its root, so each iterate is nearer.

    Args:
        c: at least zero [-], shape (p,).
        n: positive [-], shape () or (p,).
    """
    log_c = jnp.log(c)
    log_w = jnp.minimum(0, -log_c / n)
    for _ in range(_NEWTON_STEPS):
        viscous = log_c + n * log_w
        total = jnp.logaddexp(log_w, viscous)
        part = jnp.exp(viscous - total)
        log_w = log_w - total / (1 - part + n * part)
    return jnp.exp(log_w)


@_share_of_flow.defjvp
def _(primals: tuple[Array, Array], tangents: tuple[Any, Any]) -> tuple[Array, Array]:
    """dw (1 + n c wⁿ⁻¹) = −wⁿ dc − c wⁿ ln w dn, where c wⁿ = 1 − w."""
    (c, n), (dc, dn) = primals, tangents
    w = _share_of_flow(c, n)
    change = jnp.zeros_like(w)
    if dc is not None:
        change = change + w**n * dc
    if dn is not None:
        change = change + (1 - w) * jnp.log(w) * dn
    return w, -w / (w + n * (1 - w)) * change
