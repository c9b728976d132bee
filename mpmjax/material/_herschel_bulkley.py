"""Pastes, muds and foams: Herschel and Bulkley's viscoplasticity on Hencky's elasticity."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Matrix, PerParticle, Scalar
from mpmjax.autodiff import ruled
from mpmjax.checks import require_between, require_fields, require_moduli, require_positive
from mpmjax.material._hencky import ElasticStrain, Hencky, no_transverse_strain
from mpmjax.material._law import AbstractInelastic


class HerschelBulkleyHistory(eqx.Module):
    """The history of a particle of Herschel and Bulkley's law."""

    plastic_strain: Float[Array, "*p"]
    """α [-], the accumulated equivalent plastic strain ∫ γ̇/√3 dt, as `VonMises` has it, shape (p,). The law does not
    depend on it."""
    transverse_strain: Float[Array, "*p"] | None
    """ε_t [-] (see `Hencky`), shape (p,); None in 3-D."""


class HerschelBulkley(AbstractInelastic):
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
    rest it relaxes to τ_Y, for n = 1 as e^{−μt/η}. With η = 0 it is `VonMises` with the tensile yield stress √3 τ_Y. In
    1-D and 2-D the deviator is that of three dimensions. Where nothing yields F is unchanged to the last bit.

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

    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    yield_stress: PerParticle
    consistency: PerParticle
    exponent: PerParticle = 1.0

    def __check_init__(self):
        require_fields(self)
        require_moduli("HerschelBulkley", self.youngs_modulus, self.poisson_ratio)
        require_positive("HerschelBulkley's yield_stress [Pa]", self.yield_stress)
        require_between("HerschelBulkley's consistency [Pa s^n]", self.consistency, 0, np.inf)
        require_positive("HerschelBulkley's exponent", self.exponent)

    def initial_history(self, F: Matrix) -> HerschelBulkleyHistory:
        """α = 0, ε_t = 0."""
        return HerschelBulkleyHistory(jnp.zeros(F.shape[2:], F.dtype), no_transverse_strain(F))

    def elastic(self, history: HerschelBulkleyHistory) -> Hencky:
        """Hencky's law with the history's ε_t."""
        return Hencky(self.youngs_modulus, self.poisson_ratio, history.transverse_strain)

    def return_map(
        self, F: Matrix, history: HerschelBulkleyHistory, dt: Scalar
    ) -> tuple[Matrix, HerschelBulkleyHistory]:
        """Return of the deviator to the overstress of its flow over the step."""
        strain = ElasticStrain.of(F, history.transverse_strain)
        stiffness = self.elastic(history).shear_modulus
        trial = 2**0.5 * stiffness * strain.deviation
        yields = trial > self.yield_stress
        excess = jnp.where(yields, trial - self.yield_stress, 1)
        fastest = excess / (stiffness * dt)  # the rate at which the flow of the step takes all of the excess
        share = _share_of_flow(self.consistency * fastest**self.exponent / excess, jnp.asarray(self.exponent, F.dtype))
        relaxed = jnp.where(yields, share * excess, 0)
        ratio = 1 - relaxed / jnp.where(yields, trial, 1)
        F, transverse = strain.returned(ratio, strain.mean)
        return F, HerschelBulkleyHistory(history.plastic_strain + relaxed / (3**0.5 * stiffness), transverse)


_NEWTON_STEPS = 8
"""Enough for 1e-15 at exponents from 0.1 to 4."""


@ruled
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
