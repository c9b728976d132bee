"""Snow."""

from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import require_between, require_fields, require_moduli, require_positive
from mpmjax.linalg import AbstractSpectral
from mpmjax.material._elastic import FixedCorotated
from mpmjax.material._law import AbstractInelastic


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
    below 2/d. The table's 0.25 is enough for packed snow; torn snow that is pressed again gains a little energy, but it
    is soft and holds little. The moduli grow without bound under compression, by a factor e at J_P = 1 − 1/ξ, and the
    explicit step shrinks with them: take semi-implicit steps for packed snow. The return map's derivative jumps where
    yielding begins.
    *Good values* (the paper's table): E = 1.4e5 Pa, ν = 0.2, θ_c = 2.5e-2, θ_s = 7.5e-3, ξ = 10, density 400 kg/m³.
    A smaller θ_c or θ_s makes powder of chunks, a larger ξ and E ice.

    Args:
        youngs_modulus: E [Pa] of undisturbed snow, one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        critical_compression: θ_c [-], between 0 and 1.
        critical_stretch: θ_s [-], positive.
        hardening: ξ [-], at least 0.
    """

    youngs_modulus: PerParticle = 1.4e5
    poisson_ratio: PerParticle = 0.2
    critical_compression: PerParticle = 2.5e-2
    critical_stretch: PerParticle = 7.5e-3
    hardening: PerParticle = 10.0

    def __check_init__(self):
        require_fields(self)
        require_moduli("Snow", self.youngs_modulus, self.poisson_ratio)
        require_between("Snow's critical_compression", self.critical_compression, 0, 1, open_ends=True)
        require_positive("Snow's critical_stretch", self.critical_stretch)
        require_between("Snow's hardening", self.hardening, 0, 1e3)

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
        del dt
        least, most = (jnp.asarray(a, F.dtype) for a in (1 - self.critical_compression, 1 + self.critical_stretch))
        excess = _Clamp(least, most)(la.matmul(la.transpose(F), F))
        clamped = F + la.matmul(F, excess)
        yielded = la.determinant(F) / la.determinant(clamped)
        return clamped, SnowHistory(history.plastic_volume * yielded)


_DUST = -60.0
"""The smallest exponent of hardening, which gives a modulus of 1e-26 E."""


class SnowElasticity(FixedCorotated):
    """Fixed corotated elasticity restricted to J > 0: the clamp would keep an inverted particle inverted."""

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        """J > 0."""
        return la.determinant(F) > 0


class _Clamp(AbstractSpectral):
    """clamp(√c)/√c − 1 of c = s², so that F (I + f(FᵀF)) has the stretches of F, clamped. Exactly zero within the
    limits."""

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
