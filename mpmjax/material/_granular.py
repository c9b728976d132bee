"""Granular materials: sand, soil and snow."""

from functools import reduce
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import between, positive, require_fields
from mpmjax.linalg import AbstractSpectral
from mpmjax.material._elastic import FixedCorotated, PoissonRatio, YoungsModulus
from mpmjax.material._hencky import AbstractHenckyPlasticity, Hencky
from mpmjax.material._law import AbstractInelastic


class DruckerPragerHistory(eqx.Module):
    """The history of a particle of sand."""

    gap: Float[Array, "*p"]
    """v_c [-], the logarithmic volume by which it has come apart and not closed again, at least zero, shape (p,)."""
    transverse_strain: Float[Array, "*p"] | None  # ε_t [-] (see `Hencky`), shape (p,); None in 3-D


class DruckerPrager(AbstractHenckyPlasticity):
    """Dry sand without cohesion: the law of Drucker and Prager at large strains (G. Klár, T. Gast, A. Pradhana, C. Fu,
    C. Schroeder, C. Jiang, J. Teran, ACM Trans. Graph. 35 (2016) 103, doi 10.1145/2897824.2925906).

    Elastic as Hencky's law. Grains slide at the friction angle φ: with m and e the mean and the deviator of the elastic
    logarithmic strain, in three dimensions whatever d is, the yield condition is

        ‖e‖ ≤ −α (3λ + 2μ)/(2μ) 3m,   α = √(2/3) 2 sin φ/(3 − sin φ),

    which is q ≤ 6 sin φ/(3 − sin φ) p with the Kirchhoff stresses p = −K tr ε and q = √(3/2) ‖s‖, Coulomb's limit in
    triaxial compression. Beyond, e is shortened to the cone at the same m: sliding keeps the volume (non-associated, no
    dilatancy). Where m > 0 the grains come apart and all strain is given up.

    The volume gained in coming apart must be lost again before grains press on each other, or loosened sand would
    resist at once and stay swollen. So the history has the gap, v_c ← v_c + tr ε − tr ε′ when a return map changes the
    trace (A. P. Tampubolon, T. Gast, G. Klár, C. Fu, J. Teran, C. Jiang, K. Museth, ACM Trans. Graph. 36 (2017)
    105, doi 10.1145/3072959.3073651), and the return map starts from the strain with v_c/3 added to its mean:
    apart while that mean is positive, else closed with v_c = 0. With v_c ≥ 0 no return map adds energy.

    At rest, F = I, sand is on the verge of sliding and of parting: the derivative there is the elastic one.

    *When it breaks*: it needs J > 0, as Hencky's law does. φ is that of triaxial compression; in extension
    and plane strain the cone is wider than Coulomb's. Where sand flows in plane strain its angle ψ is sin ψ = M/√3,
    M = 6 sin φ/(3 − sin φ): 44 degrees for φ = 30, and from φ = 42.2 on it bears a pull before it slides. For an angle
    ψ there, take sin φ = 3√3 sin ψ/(6 + √3 sin ψ): φ = 22.2 degrees for ψ = 30. Sand that has come apart is dust
    without forces: its particles may drift farther than a cell from each other and then never meet. Derivatives jump
    where sand starts to slide or to part.
    *Good values*: E = 3.5e5 Pa, ν = 0.3, density 2200 kg/m³; φ = 0.52 to 0.70 (30 to 40 degrees). E hardly
    changes the flow and limits the step: take it as soft as the settling under its own weight allows.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        friction_angle: φ [rad], strictly between 0 and π/2.
    """

    History: ClassVar[Any] = DruckerPragerHistory
    youngs_modulus: YoungsModulus
    poisson_ratio: PoissonRatio
    friction_angle: Annotated[PerParticle, between(0, np.pi / 2, open_ends=True), "rad"]

    def flow(
        self, history: DruckerPragerHistory, mean: Array, deviation: Array, dt: Scalar
    ) -> tuple[Array, Array, Array]:
        """To the cone at the same volume, or to its tip."""
        mean = mean + history.gap / 3
        apart = mean > 0
        sine = jnp.sin(self.friction_angle)
        slope = (2 / 3) ** 0.5 * 2 * sine / (3 - sine) * (1 + self.poisson_ratio) / (1 - 2 * self.poisson_ratio)
        allowed = jnp.where(apart, 0, -3 * slope * mean)
        slides = deviation > allowed
        ratio = jnp.where(slides, allowed / jnp.where(slides, deviation, 1), jnp.where(apart, 0, 1))
        return ratio, jnp.where(apart, 0, mean), jnp.where(apart, 3 * mean, 0)


class CamClayHistory(eqx.Module):
    """The history of a particle of Cam clay."""

    volume_strain: Float[Array, "*p"]
    """α [-], the plastic logarithmic change of volume, shape (p,). It sets the strength: negative where compacted."""
    transverse_strain: Float[Array, "*p"] | None  # ε_t [-] (see `Hencky`), shape (p,); None in 3-D


class CamClay(AbstractHenckyPlasticity):
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
    and q are linear. No return map adds elastic energy, which does not depend on α.

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

    History: ClassVar[Any] = CamClayHistory
    youngs_modulus: YoungsModulus
    poisson_ratio: PoissonRatio
    friction: Annotated[PerParticle, positive]
    preconsolidation: Annotated[PerParticle, between(0, np.inf), "Pa"]
    cohesion: Annotated[PerParticle, between(0, np.inf)] = 0.0
    hardening: Annotated[PerParticle, positive] = 1.0

    def initial_variable(self) -> PerParticle:
        """α = −arsinh(p₀/K)/ξ."""
        bulk_modulus = Hencky(self.youngs_modulus, self.poisson_ratio).bulk_modulus
        return -jnp.arcsinh(self.preconsolidation / bulk_modulus) / self.hardening

    def compaction(self, history: CamClayHistory) -> Float[Array, "p"]:
        """e to the change of α, or 1 of what has loosened."""
        return jnp.exp(jnp.minimum(history.volume_strain - self.initial_variable(), 0))

    def flow(self, history: CamClayHistory, mean: Array, deviation: Array, dt: Scalar) -> tuple[Array, Array, Array]:
        """To a tip, or to the ellipse at the same pressure; all stresses are divided by K."""
        alpha, beta, M = history.volume_strain, self.cohesion, self.friction
        nu = self.poisson_ratio
        p0 = jnp.sinh(self.hardening * jnp.where(alpha < 0, -alpha, 0))
        p, q = -3 * mean, 6**0.5 * 3 * (1 - 2 * nu) / (2 * (1 + nu)) * deviation
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
        return ratio, jnp.where(tip, -held / 3, mean), alpha - change


class SnowHistory(eqx.Module):
    """The history of a particle of snow."""

    plastic_volume: Float[Array, "*p"]
    """J_P = det F_P [-], shape (p,): below 1 packed and harder, above 1 torn and softer."""


class Snow(AbstractInelastic):
    """Snow (A. Stomakhin, C. Schroeder, L. Chai, J. Teran, A. Selle, ACM Trans. Graph. 32 (2013) 102,
    doi 10.1145/2461912.2461948).

    Fixed corotated elasticity of F_E (the paper's eq. 1) whose moduli harden with plastic compression,
    E e^{ξ (1 − J_P)} (its eq. 2). The principal stretches of F_E stay within [1 − θ_c, 1 + θ_s]; what exceeds them goes
    into F_P (its section 7), of which only J_P has an effect (F = F_E F_P). In plane strain nothing yields normal to
    the plane, where the stretch is one.

    *When it breaks*: it needs J > 0. Where hardening outruns yielding a return map creates energy: keep ξ J_P θ_c well
    below 2/d. The table's 0.25 is enough for packed snow; torn snow that is pressed again gains little, being soft.
    The moduli grow without bound under compression, by a factor e at J_P = 1 − 1/ξ, and the explicit step shrinks with
    them: take semi-implicit steps for packed snow. The return map's derivative jumps where yielding begins.
    *Good values* (the paper's table): E = 1.4e5 Pa, ν = 0.2, θ_c = 2.5e-2, θ_s = 7.5e-3, ξ = 10, density 400 kg/m³.
    A smaller θ_c or θ_s makes powder of chunks, a larger ξ and E ice.

    Args:
        youngs_modulus: E [Pa] of undisturbed snow, one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        critical_compression: θ_c [-], between 0 and 1.
        critical_stretch: θ_s [-], positive.
        hardening: ξ [-], at least 0.
    """

    youngs_modulus: YoungsModulus = 1.4e5
    poisson_ratio: PoissonRatio = 0.2
    critical_compression: Annotated[PerParticle, between(0, 1, open_ends=True)] = 2.5e-2
    critical_stretch: Annotated[PerParticle, positive] = 7.5e-3
    hardening: Annotated[PerParticle, between(0, 1e3)] = 10.0
    __check_init__ = require_fields

    def initial_history(self, F: Matrix) -> SnowHistory:
        """J_P = 1."""
        return SnowHistory(jnp.ones(F.shape[2:], F.dtype))

    def elastic(self, history: SnowHistory) -> "SnowElasticity":
        """Fixed corotated with E e^{ξ (1 − J_P)}, the exponent bounded below so that E stays positive in float32."""
        harder = jnp.exp(jnp.maximum(self.hardening * (1 - history.plastic_volume), _DUST))
        return SnowElasticity(self.youngs_modulus * harder, self.poisson_ratio)

    def compaction(self, history: SnowHistory) -> Float[Array, "p"]:
        """J_P, or 1 of what is torn."""
        return jnp.minimum(history.plastic_volume, 1)

    def return_map(self, F: Matrix, history: SnowHistory, dt: Scalar) -> tuple[Matrix, SnowHistory]:
        """Clamp the principal stretches of F_E; J_P ← J_P det F_trial / det F_E."""
        least, most = (jnp.asarray(a, F.dtype) for a in (1 - self.critical_compression, 1 + self.critical_stretch))
        excess = _Clamp(least, most)(la.matmul(la.transpose(F), F))
        clamped = F + la.matmul(F, excess)
        yielded = la.determinant(F) / la.determinant(clamped)
        return clamped, SnowHistory(history.plastic_volume * yielded)


_DUST = -60.0  # the smallest exponent of hardening, which gives a modulus of 1e-26 E


class SnowElasticity(FixedCorotated):
    """Fixed corotated elasticity restricted to J > 0: the clamp would keep an inverted particle inverted."""

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        """J > 0."""
        return la.determinant(F) > 0


class _Clamp(AbstractSpectral):
    """clamp(√c)/√c − 1 of c = s², so that F (I + f(FᵀF)) has the stretches of F, clamped. Zero within the limits."""

    least: Array
    most: Array

    def _limit(self, c: Array) -> tuple[Array, Array]:
        """Whether c is clamped, and the stretch it is clamped to."""
        below, above = c < self.least**2, c > self.most**2
        return below | above, jnp.where(below, self.least, self.most)

    def of(self, s: Array) -> Array:
        """(limit − √c)/√c where clamped."""
        clamped, limit = self._limit(s)
        root = jnp.sqrt(jnp.where(clamped, s, 1))
        return jnp.where(clamped, (limit - root) / root, 0)

    def slope(self, a: Array, b: Array) -> Array:
        """−limit/(√a √b (√a + √b)) where both are clamped to one limit, else the quotient of differences."""
        (at_a, limit), (at_b, other) = self._limit(a), self._limit(b)
        alike = at_a & at_b & (limit == other)
        apart = (at_a | at_b) & ~alike
        root_a, root_b = jnp.sqrt(jnp.where(alike, a, 1)), jnp.sqrt(jnp.where(alike, b, 1))
        together = -limit / (root_a * root_b * (root_a + root_b))
        quotient = (self.of(a) - self.of(b)) / jnp.where(apart, a - b, 1)
        return jnp.where(alike, together, jnp.where(apart, quotient, 0))

    def coefficient(self, s: Array, order: int) -> Array:
        """limit c^(−1/2) Π (−½ − k)/((k + 1) c) over k < n where clamped."""
        clamped, limit = self._limit(s)
        s = jnp.where(clamped, s, 1)
        scaled = reduce(jnp.multiply, ((-0.5 - k) / ((k + 1) * s) for k in range(order)), limit / jnp.sqrt(s))
        return jnp.where(clamped, scaled, 0)

    def alike(self, low: Array, high: Array) -> Bool[Array, "..."]:
        """Whether both are clamped to the same limit, or neither is."""
        (at_low, limit), (at_high, other) = self._limit(low), self._limit(high)
        return jnp.where(at_low & at_high, limit == other, at_low == at_high)
