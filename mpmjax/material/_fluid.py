"""Laws of the volume alone, a weakly compressible fluid made of one, and viscosity beside any law."""

from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, PerParticle, Scalar
from mpmjax.checks import between, positive, require, require_fields
from mpmjax.material._differential import VolumetricDifferential
from mpmjax.material._law import (
    VOLUME_RATIO,
    AbstractInelastic,
    AbstractLaw,
    AbstractMaterial,
    DeformationMeasure,
    Viscosity,
)


class AbstractVolumetric(AbstractMaterial):
    """An elastic law given by its energy density Ψ(J), J = det F, and nothing else of the deformation.

    Its particles store J and no F, so that it works in the updated description alone. Their volumes cannot be averaged:
    nothing would resist what the average does not see. A law needs `energy(J)` alone [J/m³ of undeformed volume], of
    J [-] of shape (p,): its derivatives default to automatic differentiation.
    """

    measure: ClassVar[DeformationMeasure] = VOLUME_RATIO
    allows_total: ClassVar[bool] = False
    allows_averaged_volume: ClassVar[bool] = False

    def stress_differential(self, J: Array, /) -> VolumetricDifferential:
        """d²Ψ/dJ² [Pa]. Default: the derivative of the stress."""
        return VolumetricDifferential(jax.jvp(self.stress, (J,), (jnp.ones_like(J),))[1])

    def projected_differential(self, J: Array, /) -> VolumetricDifferential:
        """max(d²Ψ/dJ², 0)."""
        return VolumetricDifferential(jnp.maximum(self.stress_differential(J).stiffness, 0))

    def stiffness_eigenvalues(self, J: Array, /, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """The one of d/dJ(JΨ') J tr(L) I that is not zero, d times the factor."""
        return dim * (self.stress_differential(J).stiffness * J * J + J * self.stress(J))[None]


class Tait(AbstractVolumetric):
    """Tait's equation of state, as F. D. Murnaghan integrated it (Proc. Natl. Acad. Sci. 30 (1944) 244,
    doi 10.1073/pnas.30.9.244): p = −dΨ/dJ = K/γ (J^−γ − 1), a bulk modulus that rises by γ p.

    Ψ = K/γ (J − 1 + (J^{1−γ} − 1)/(γ − 1)), for γ = 1 K (J − 1 − ln J): zero at rest, and convex for every J > 0.
    Without `tension` Ψ is zero beyond J = 1; derivatives at J = 1 are those of compression. There is tension by
    default, unlike in `Fluid`, whose return map undoes expansion and whose parameters these are.

    *When it breaks*: it needs J > 0; a step that makes a particle's volume negative is reported.
    """

    bulk_modulus: Annotated[PerParticle, positive, "Pa"]
    exponent: Annotated[PerParticle, positive] = 7.0
    tension: bool = eqx.field(static=True, default=True)
    __check_init__ = require_fields

    def energy(self, J: Array, /) -> Array:
        acting = self._acting(J)
        return self.bulk_modulus / self.exponent * (acting - 1 + _raised(acting, 1 - self.exponent))

    def stress(self, J: Array, /) -> Array:
        return self.bulk_modulus / self.exponent * (1 - self._acting(J) ** -self.exponent)

    def stress_differential(self, J: Array, /) -> VolumetricDifferential:
        """d²Ψ/dJ² = K J^{−1−γ}."""
        stiffness = self.bulk_modulus * self._acting(J) ** (-1 - self.exponent)
        return VolumetricDifferential(stiffness if self.tension else jnp.where(J > 1, 0, stiffness))

    def is_admissible(self, J: Array, /) -> Bool[Array, "p"]:
        return J > 0

    def _acting(self, J: Array) -> Array:
        return J if self.tension else _pressed(J)


class Fluid(AbstractInelastic):
    """A weakly compressible, inviscid fluid (J. J. Monaghan, J. Comput. Phys. 110 (1994) 399, eq. 2.3,
    doi 10.1006/jcph.1994.1034; in the Material Point Method by J alone: A. P. Tampubolon et al., ACM Trans. Graph. 36
    (2017) 105, doi 10.1145/3072959.3073651).

    p = K/γ (J^−γ − 1) with J = ρ0/ρ (see `Tait`), sound at √(K/ρ0) at rest. Particles store J in the place of F.
    Without `tension` a surface separates freely: beyond J = 1 the pressure is zero, and J returns to 1 at the end of
    the step, so that the fluid resists as soon as it is compressed again.

    *When it breaks*: J is the product of the steps' changes and not the particles' real spacing, from which it drifts
    in long mixing flows. With tension, fluid that is torn stays connected until its particles lie further apart than
    the kernel reaches, and clusters. Without it, sound waves with troughs below zero pressure are cut off; and a single
    linear solve, whose tangent at J = 1 is that of compression, resists expansion within the step, which Newton's
    method does not. Explicit steps shrink with 1/√K.
    *Good values*: water has γ = 7 and K = 2.2e9 Pa, but its speed of sound is rarely of interest: K of 100 to 1000
    times ρ g H, H the depth, or 100 ρ v², keeps changes of density under 1 %. γ = 1 makes p linear in the density.

    Args:
        bulk_modulus: K [Pa] at rest, one value or one per particle (p,).
        exponent: γ [-], positive.
        tension: whether the pressure may be below zero. Closed vessels and acoustics want it, free surfaces do not.
    """

    measure: ClassVar[DeformationMeasure] = VOLUME_RATIO
    relaxes_stress: ClassVar[bool] = False  # it takes out expansion, which has no stress
    bulk_modulus: Annotated[PerParticle, positive, "Pa"]
    exponent: Annotated[PerParticle, positive] = 7.0
    tension: bool = eqx.field(static=True, default=False)
    __check_init__ = require_fields

    def initial_history(self, J: Array, /) -> None:
        return None

    def elastic(self, history: None) -> Tait:
        return Tait(self.bulk_modulus, self.exponent, self.tension)

    def return_map(self, J: Array, history: None, dt: Scalar, /) -> tuple[Array, None]:
        """min(J, 1); with tension J."""
        return J if self.tension else _pressed(J), history


def _pressed(J: Array) -> Array:
    """min(J, 1), with the derivative of compression at J = 1."""
    return jnp.where(J > 1, 1, J)


_NEARLY_ZERO = 1e-2
_TERMS = 6


def _raised(J: Array, a: Scalar) -> Array:
    """−(J^a − 1)/a, by its series in a ln J where a is small, whose derivatives hold at a = 0."""
    small = jnp.abs(a) < _NEARLY_ZERO
    log = jnp.log1p(J - 1)  # exact near J = 1, where a fluid works
    x = jnp.where(small, a * log, 0)
    series = jnp.ones_like(x)
    for n in range(_TERMS, 1, -1):
        series = 1 + x / n * series
    power = jnp.where(small, 1, a)
    return -jnp.where(small, log * series, jnp.expm1(power * log) / power)


def _of_law(name: str) -> Any:
    return property(lambda self: getattr(self.law, name))


class Viscous(AbstractLaw):
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

    law: AbstractLaw
    shear_viscosity: Annotated[PerParticle, between(0, jnp.inf), "Pa s"]
    bulk_viscosity: Annotated[PerParticle, between(0, jnp.inf), "Pa s"] = 0.0

    def __check_init__(self):
        require_fields(self)
        require(self.law.viscosity is None, "Viscous takes a law that is not viscous yet: add the viscosities.")
        require(self.law.constraint is None, "Viscous takes a law that deforms: a rigid body has nothing that flows.")

    @property
    def viscosity(self) -> Viscosity:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The viscosity without the law."""
        return Viscosity(self.shear_viscosity, self.bulk_viscosity)

    # all else is the law's
    measure = _of_law("measure")
    allows_total = _of_law("allows_total")
    allows_averaged_volume = _of_law("allows_averaged_volume")
    relaxes_stress = _of_law("relaxes_stress")
    flows = _of_law("flows")  # pyright: ignore[reportIncompatibleMethodOverride]
    hardly_changes_volume = _of_law("hardly_changes_volume")
    initial_history = _of_law("initial_history")
    compaction = _of_law("compaction")
    elastic = _of_law("elastic")
    return_map = _of_law("return_map")
    title = _of_law("title")
    inadmissible = _of_law("inadmissible")
