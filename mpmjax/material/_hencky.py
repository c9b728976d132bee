"""Hencky's elasticity, linear in the logarithmic strain, and the return map of the laws that yield on it."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import require_moduli
from mpmjax.linalg import Logarithm, PowerLessOne
from mpmjax.material._differential import IsotropicDifferential, PrincipalDifferential
from mpmjax.material._elastic import AbstractIsotropic
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

    def in_space(self, F: Matrix) -> tuple["Hencky", Matrix]:
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

    def stress_differential(self, F: Matrix) -> IsotropicDifferential:
        return IsotropicDifferential(self, F)

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

    def __check_init__(self):
        require_moduli(type(self).__name__, self.youngs_modulus, self.poisson_ratio)

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
