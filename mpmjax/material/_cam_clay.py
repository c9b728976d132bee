"""Soil and wet snow that compact: a Cam clay on Hencky's elasticity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import require_between, require_fields, require_moduli, require_positive
from mpmjax.material._hencky import ElasticStrain, Hencky, no_transverse_strain
from mpmjax.material._law import AbstractInelastic


class CamClayHistory(eqx.Module):
    """The history of a particle of Cam clay."""

    volume_strain: Float[Array, "*p"]
    """α [-], the plastic logarithmic change of volume, shape (p,). It sets the strength: negative where compacted."""
    transverse_strain: Float[Array, "*p"] | None
    """ε_t [-] (see `Hencky`), shape (p,); None in 3-D."""


class CamClay(AbstractInelastic):
    """Soil or snow that shears, compacts and, if cohesive, tears: a non-associated Cam clay at large strains, with the
    yield condition (eq. 3) and the hardening (eq. 4) of J. Gaume, T. Gast, J. Teran, A. van Herwijnen, C. Jiang, Nat.
    Commun. 9 (2018) 3047, doi 10.1038/s41467-018-05181-w.

    With the Kirchhoff stresses p = −K tr ε and q = √(3/2) ‖2μ e‖, m and e the mean and the deviator of the elastic
    logarithmic strain in three dimensions whatever d is, the yield condition is the ellipse

        q² (1 + 2β) + M² (p + β p₀)(p − p₀) ≤ 0,   p₀ = K sinh(ξ max(−α, 0)).

    The return map takes p₀ before the step, and
    - for p > p₀ or p < −β p₀ goes to that tip of the ellipse, q = 0, and α changes by the volume given up,
      tr ε − tr ε′;
    - else, for q outside, shortens e at the same p. α then changes by what the volume would on the straight way to the
      ellipse's centre, at p_c = (1 − β) p₀/2: −(p − p_×)/K with p_× the pressure where that way meets the ellipse.

    So it hardens and compacts for p > p_c, softens and loosens for p < p_c, and shears on at p = p_c without change,
    the critical state: q = M (1 + β)/((1 − β) √(1 + 2β)) p, which is M p without cohesion, and is there for β < 1.
    Where α ≥ 0 the material bears no stress: the particles are apart, and α is the gap that must close first. The
    paper's flow is associated (its eqs. 12, 13) and its elasticity neo-Hookean; here it is Hencky's, in whose strains p
    and q are linear. Where nothing yields F is unchanged to the last bit. No return map adds elastic energy, which does
    not depend on α.

    *When it breaks*: it needs J > 0, as Hencky's law does. The stress lags behind the ellipse by one step's
    hardening, an error in proportion to the step's strain. Softening localises strain in bands as wide as a cell.
    The sinh stiffens: ξ (−α) of a few is no longer soil. Derivatives jump where it starts to yield, and are
    unbounded at the tips.
    *Good values*: M = 0.5 to 1.5 (M = 6 sin φ/(3 − sin φ) at the friction angle φ of triaxial compression), β = 0 for
    dry soil, 0.1 to 1 for cohesive snow, ξ = 1 to 10; snow E = 1e6 Pa, ν = 0.3, p₀ = 1e3 to 1e5 Pa.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        friction: M [-], greater than zero: slope of the critical state.
        preconsolidation: initial p₀ [Pa], at least zero: the pressure at which a particle first yields.
        cohesion: β [-], at least zero: the tension it bears, as a fraction of p₀.
        hardening: ξ [-], greater than zero.
    """

    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    friction: PerParticle
    preconsolidation: PerParticle
    cohesion: PerParticle = 0.0
    hardening: PerParticle = 1.0

    def __check_init__(self):
        require_fields(self)
        require_moduli("CamClay", self.youngs_modulus, self.poisson_ratio)
        require_positive("CamClay's friction", self.friction)
        require_between("CamClay's preconsolidation [Pa]", self.preconsolidation, 0, np.inf)
        require_between("CamClay's cohesion", self.cohesion, 0, np.inf)
        require_positive("CamClay's hardening", self.hardening)

    def initial_history(self, F: Matrix) -> CamClayHistory:
        """α = −arsinh(p₀/K)/ξ, ε_t = 0."""
        return CamClayHistory(self._first_strain() * jnp.ones(F.shape[2:], F.dtype), no_transverse_strain(F))

    def _first_strain(self) -> PerParticle:
        """α of what never yielded."""
        bulk_modulus = Hencky(self.youngs_modulus, self.poisson_ratio).bulk_modulus
        return -jnp.arcsinh(self.preconsolidation / bulk_modulus) / self.hardening

    def compaction(self, history: CamClayHistory) -> Float[Array, "p"]:
        """e to the change of α, or 1 of what has loosened."""
        return jnp.exp(jnp.minimum(history.volume_strain - self._first_strain(), 0))

    def elastic(self, history: CamClayHistory) -> Hencky:
        """Hencky's law with the history's ε_t."""
        return Hencky(self.youngs_modulus, self.poisson_ratio, history.transverse_strain)

    def return_map(self, F: Matrix, history: CamClayHistory, dt: Scalar) -> tuple[Matrix, CamClayHistory]:
        """To a tip, or to the ellipse at the same pressure; all stresses are divided by K."""
        del dt
        strain = ElasticStrain.of(F, history.transverse_strain)
        alpha, beta, M = history.volume_strain, self.cohesion, self.friction
        nu = self.poisson_ratio
        p0 = jnp.sinh(self.hardening * jnp.where(alpha < 0, -alpha, 0))
        p, q = -3 * strain.mean, 6**0.5 * 3 * (1 - 2 * nu) / (2 * (1 + nu)) * strain.deviation
        # to a tip
        compacts, tears = p > p0, p < -beta * p0
        tip = compacts | tears
        held = jnp.where(compacts, p0, jnp.where(tears, -beta * p0, p))
        # to the ellipse
        square = jnp.where(tip, 0, (held + beta * p0) * (p0 - held))
        proper = square > 0
        allowed = jnp.where(proper, M * jnp.sqrt(jnp.where(proper, square, 1) / (1 + 2 * beta)), 0)
        shears = q > allowed
        ratio = jnp.where(shears, allowed / jnp.where(shears, q, 1), jnp.where(tip, 0, 1))
        # straight to the centre, the share t of the way from there
        centre, half = (1 - beta) / 2 * p0, (1 + beta) / 2 * p0
        radius = (1 + 2 * beta) * q**2 + (M * (p - centre)) ** 2
        t = M * half / jnp.sqrt(jnp.where(shears, radius, 1))
        change = jnp.where(tip, p - held, jnp.where(shears, (1 - t) * (p - centre), 0))
        F, transverse = strain.returned(ratio, jnp.where(tip, -held / 3, strain.mean))
        return F, CamClayHistory(alpha - change, transverse)
