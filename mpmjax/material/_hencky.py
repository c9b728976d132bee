"""Hencky's elasticity, linear in the logarithmic strain, and the return map of the laws that yield on it; of these von
Mises' for metals and Herschel and Bulkley's for pastes, whose flow keeps the volume."""

import abc
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix, PerParticle, Scalar
from mpmjax.autodiff import custom_derivative
from mpmjax.checks import between, positive, require_fields
from mpmjax.linalg import Logarithm, PowerLessOne
from mpmjax.material._differential import PrincipalDifferential
from mpmjax.material._elastic import AbstractIsotropic, PoissonRatio, YoungsModulus
from mpmjax.material._law import AbstractInelastic

_log = Logarithm()


class Hencky(AbstractIsotropic):
    """Hencky's elasticity (H. Hencky, Z. Tech. Phys. 9 (1928) 215; J. C. Simo, Comput. Methods Appl. Mech. Eng. 99
    (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Ψ = μ ε : ε + λ/2 (tr ε)² with the logarithmic strain ε = ½ log FᵀF, P = F⁻ᵀ (2μ ε + λ tr(ε) I).

    In fewer than three dimensions the total strain in the 3 − d directions normal to F is zero. Its elastic part ε_t is
    not zero once a law has yielded: then μ (3 − d) ε_t² is added to the energy, and (3 − d) ε_t to the trace.

    *When it breaks*: it needs J > 0. The force in a stretched fibre falls beyond a stretch of e: not a law for rubber.
    Each particle needs an eigenvalue problem.
    *Good values*: as for fixed corotated.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
        transverse_strain: ε_t [-], the elastic logarithmic strain in each of the 3 − d directions normal to F. None
            (default, and always in 3-D): zero.
    """

    transverse_strain: PerParticle | None = None

    def energy(self, F: Matrix) -> Array:
        strain = logarithmic_strain(F)
        squares = la.double_dot(strain, strain)
        if self.transverse_strain is not None:
            squares = squares + _missing(F) * self.transverse_strain**2
        return self.shear_modulus * squares + self.lame_lambda / 2 * self._dilation(la.trace(strain), F) ** 2

    def in_space(self, F: Matrix) -> tuple["Hencky", Deformation]:
        """With the stretches exp ε_t."""
        law, whole = Hencky(self.youngs_modulus, self.poisson_ratio), super().in_space(F)[1]
        if self.transverse_strain is not None:
            for i in range(len(F), 3):
                whole = whole.at[i, i].set(jnp.exp(self.transverse_strain))
        return law, whole

    def stress(self, F: Matrix) -> Matrix:
        strain = logarithmic_strain(F)
        dilation = self._dilation(la.trace(strain), F)
        kirchhoff = 2 * self.shear_modulus * strain + self.lame_lambda * dilation * la.identity_like(F)
        return la.matmul(la.cofactor(F), kirchhoff) / la.determinant(F)

    def principal_differential(self, s: Float[Array, "d *p"]) -> PrincipalDifferential:
        """With τ_i = 2μ ln s_i + λ (ln J + (3 − d) ε_t) and ∂τ_i/∂ln s_j = 2μ δ_ij + λ."""
        mu, lam = self.shear_modulus, self.lame_lambda * jnp.ones_like(s[0])
        log_s = jnp.log(s)
        tau = 2 * mu * log_s + lam * self._dilation(log_s.sum(axis=0), s)
        return PrincipalDifferential.of_kirchhoff(
            s,
            tau,
            growth=lambda i, j: 2 * mu + lam if i == j else lam,
            slope=lambda i, j: 2 * mu * _log.slope(s[j], s[i]),
        )

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.determinant(F) > 0

    def _dilation(self, trace: Array, like: Array) -> Array:
        """tr ε + (3 − d) ε_t [-]; the first axis of `like` is d."""
        return trace if self.transverse_strain is None else trace + _missing(like) * self.transverse_strain


class AbstractHenckyPlasticity(AbstractInelastic):
    """An isotropic law that yields on Hencky's elasticity: its return map has the form of small strains, and
    tr ε = ln J separates changes of volume from changes of shape.

    The elastic logarithmic strain in three dimensions, whatever d is, has a mean and a deviator, ε = m I + e. Flow
    turns no principal direction, scales the deviator and sets the mean, ε ← k e + m′ I. With F = R exp ε that is
    F ← F exp((k − 1) ε + c I) = F eᶜ C^((k−1)/2), where C = FᵀF and c = m′ − k m: a function of C, whose derivative
    needs no eigenvectors. Where k = 1 and m′ = m nothing yields, and F is unchanged to the last bit.
    """

    History: ClassVar[Any]
    """The class of the history: one variable [-], and `transverse_strain`, ε_t [-] (see `Hencky`), both of shape (p,);
    no ε_t in 3-D."""
    youngs_modulus: eqx.AbstractVar[PerParticle]
    poisson_ratio: eqx.AbstractVar[PerParticle]

    __check_init__ = require_fields

    def initial_variable(self) -> PerParticle:
        """The history's variable where nothing has yielded. Default: zero."""
        return 0.0

    @abc.abstractmethod
    def flow(self, history: Any, mean: Array, deviation: Array, dt: Scalar) -> tuple[Array, Array, Array]:
        """k, m′ and the history's new variable [-], each of shape (p,).

        Args:
            history: the history before the step.
            mean: m [-] of the trial strain, shape (p,).
            deviation: ‖e‖ [-] of the trial strain, shape (p,).
            dt: the step [s].
        """

    def initial_history(self, F: Matrix) -> Any:
        """The initial variable, and ε_t = 0."""
        variable = self.initial_variable() * jnp.ones(F.shape[2:], F.dtype)
        return self.History(variable, None if len(F) == 3 else jnp.zeros(F.shape[2:], F.dtype))

    def elastic(self, history: Any) -> Hencky:
        """Hencky's law with the history's ε_t."""
        return Hencky(self.youngs_modulus, self.poisson_ratio, history.transverse_strain)

    def return_map(self, F: Matrix, history: Any, dt: Scalar) -> tuple[Matrix, Any]:
        """F and ε_t at the strain k e + m′ I."""
        strain, transverse = logarithmic_strain(F), history.transverse_strain
        trace = la.trace(strain)
        mean = (trace if transverse is None else trace + _missing(F) * transverse) / 3
        e = strain - mean * la.identity_like(F)
        squares = la.double_dot(e, e)
        if transverse is not None:
            squares = squares + _missing(F) * (transverse - mean) ** 2
        deviates = squares > 0  # where not, the derivative of ‖e‖ is zero
        deviation = jnp.where(deviates, jnp.sqrt(jnp.where(deviates, squares, 1)), 0)
        ratio, new_mean, variable = self.flow(history, mean, deviation, dt)
        shift = new_mean - ratio * mean
        change = PowerLessOne((ratio - 1) / 2, shift)(la.matmul(la.transpose(F), F))
        transverse = None if transverse is None else ratio * transverse + shift
        return F + la.matmul(F, change), self.History(variable, transverse)


def _missing(like: Array) -> int:
    """3 − d, the number of directions that have a transverse strain; an array's first axis is d."""
    if like.shape[0] == 3:
        raise ValueError("In 3-D no direction is transverse: Hencky's transverse_strain must be None.")
    return 3 - like.shape[0]


def logarithmic_strain(F: Matrix) -> Matrix:
    """ε = ½ log FᵀF, shape (d, d, *p)."""
    return _log(la.matmul(la.transpose(F), F)) / 2


class VonMisesHistory(eqx.Module):
    """The history of a particle of von Mises' law, and of Herschel and Bulkley's, which does not depend on α."""

    plastic_strain: Float[Array, "*p"]
    """α [-], the accumulated equivalent plastic strain ∫ √(2/3) ‖d_p‖ dt, shape (p,); of pastes ∫ γ̇/√3 dt."""
    transverse_strain: Float[Array, "*p"] | None  # ε_t [-] (see `Hencky`), shape (p,); None in 3-D


class VonMises(AbstractHenckyPlasticity):
    """Von Mises' plasticity with linear isotropic hardening, at large strains (J. C. Simo, Comput. Methods Appl. Mech.
    Eng. 99 (1992) 61, doi 10.1016/0045-7825(92)90123-2).

    Elastic as Hencky's law, with Kirchhoff stress s = 2μ e in the deviator e of the elastic logarithmic strain. Yield:

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
    youngs_modulus: YoungsModulus
    poisson_ratio: PoissonRatio
    yield_stress: Annotated[PerParticle, positive, "Pa"]
    hardening_modulus: Annotated[PerParticle, between(0, np.inf), "Pa"] = 0.0

    def flow(self, history: VonMisesHistory, mean: Array, deviation: Array, dt: Scalar) -> tuple[Array, Array, Array]:
        """Radial return of the deviator."""
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
    youngs_modulus: YoungsModulus
    poisson_ratio: PoissonRatio
    yield_stress: Annotated[PerParticle, positive, "Pa"]
    consistency: Annotated[PerParticle, between(0, np.inf), "Pa s^n"]
    exponent: Annotated[PerParticle, positive] = 1.0

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


_NEWTON_STEPS = 8  # enough for 1e-15 at exponents from 0.1 to 4


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
