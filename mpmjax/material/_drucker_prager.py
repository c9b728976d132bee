"""Dry sand: the yield condition of Drucker and Prager on Hencky's elasticity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import require_between, require_fields, require_moduli
from mpmjax.material._hencky import ElasticStrain, Hencky, no_transverse_strain
from mpmjax.material._law import AbstractInelastic


class DruckerPragerHistory(eqx.Module):
    """The history of a particle of sand."""

    gap: Float[Array, "*p"]
    """v_c [-], the logarithmic volume by which it has come apart and not closed again, at least zero, shape (p,)."""
    transverse_strain: Float[Array, "*p"] | None
    """ε_t [-] (see `Hencky`), shape (p,); None in 3-D."""


class DruckerPrager(AbstractInelastic):
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

    Where sand neither slides nor parts F is unchanged to the last bit. At rest, F = I, it is on the verge of both: the
    derivative there is the elastic one.

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

    youngs_modulus: PerParticle
    poisson_ratio: PerParticle
    friction_angle: PerParticle

    def __check_init__(self):
        require_fields(self)
        require_moduli("DruckerPrager", self.youngs_modulus, self.poisson_ratio)
        require_between("DruckerPrager's friction_angle [rad]", self.friction_angle, 0, np.pi / 2, open_ends=True)

    def initial_history(self, F: Matrix) -> DruckerPragerHistory:
        """v_c = 0, ε_t = 0."""
        return DruckerPragerHistory(jnp.zeros(F.shape[2:], F.dtype), no_transverse_strain(F))

    def elastic(self, history: DruckerPragerHistory) -> Hencky:
        """Hencky's law with the history's ε_t."""
        return Hencky(self.youngs_modulus, self.poisson_ratio, history.transverse_strain)

    def return_map(self, F: Matrix, history: DruckerPragerHistory, dt: Scalar) -> tuple[Matrix, DruckerPragerHistory]:
        """To the cone at the same volume, or to its tip."""
        del dt
        strain = ElasticStrain.of(F, history.transverse_strain)
        mean = strain.mean + history.gap / 3
        apart = mean > 0
        sine = jnp.sin(self.friction_angle)
        slope = (2 / 3) ** 0.5 * 2 * sine / (3 - sine) * (1 + self.poisson_ratio) / (1 - 2 * self.poisson_ratio)
        allowed = jnp.where(apart, 0, -3 * slope * mean)
        slides = strain.deviation > allowed
        ratio = jnp.where(slides, allowed / jnp.where(slides, strain.deviation, 1), jnp.where(apart, 0, 1))
        F, transverse = strain.returned(ratio, jnp.where(apart, 0, mean))
        return F, DruckerPragerHistory(jnp.where(apart, 3 * mean, 0), transverse)
