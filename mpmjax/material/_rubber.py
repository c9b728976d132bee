"""Laws of rubber: Mooney-Rivlin, Yeoh, Gent and Ogden."""

import abc
from functools import reduce
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import as_plain, finite, positive, require, require_fields, require_that
from mpmjax.linalg import PowerBeyondLine, PowerLessOne, exponential_beyond_line
from mpmjax.material._differential import PrincipalDifferential
from mpmjax.material._law import AbstractMaterial


class AbstractRubber(AbstractMaterial):
    """A nearly incompressible law: an energy of the isochoric stretches (P. J. Flory, Trans. Faraday Soc. 57 (1961)
    829, doi 10.1039/tf9615700829), and one of the volume, convex and without bound at J = 0 (J. C. Simo, R. L. Taylor,
    K. S. Pister, Comput. Methods Appl. Mech. Eng. 51 (1985) 177, doi 10.1016/0045-7825(85)90033-7).

    Ψ = Σ_k w_k(E_k) + K/4 (J² − 1 − 2 ln J), where E_k = λ̄_1^α + λ̄_2^α + λ̄_3^α − 3 of an exponent α = α_k, with the
    isochoric stretches λ̄_i = J^−1/3 λ_i. Laws give the exponents and functions w_k.

    P = F⁻ᵀ S with S = Σ_k w_k' α (C̄^{α/2} − (1 + E_k/3) I) + K/2 (J² − 1) I. In fewer dimensions the stretches normal
    to F are one: plane and uniaxial strain. At small strains the law is Hooke's, with K and μ = ½ Σ_k w_k'(0) α².
    """

    bulk_modulus: eqx.AbstractVar[PerParticle]  # K [Pa]
    __check_init__ = require_fields

    @abc.abstractmethod
    def powers(self) -> tuple[PerParticle, ...]:
        """The exponents α_k [-]. The whole numbers 2 and −2, for Ī1 and Ī2, need no eigenvalues."""

    @abc.abstractmethod
    def work(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        """w_k [Pa] at each E_k [-], of which it depends on no other, each of shape (*p)."""

    def energy(self, F: Matrix) -> Array:
        J = la.determinant(F)
        excess = tuple(_second_order(a, F, jnp.log(J)) for a in self.powers())
        volumetric = self.bulk_modulus / 4 * (J**2 - 1 - 2 * jnp.log(J))
        return sum(self.work(excess), volumetric)

    def stress(self, F: Matrix) -> Matrix:
        J, identity = la.determinant(F), la.identity_like(F)
        strains, excess = self._strains(F, jnp.log(J))
        S = self.bulk_modulus / 2 * (J**2 - 1) * identity
        for exponent, strain, E, slope in zip(self.powers(), strains, excess, self._slopes(excess), strict=True):
            S = S + exponent * slope * (strain - E / 3 * identity)
        return la.matmul(la.cofactor(F), S) / J

    def principal_differential(self, s: Float[Array, "d *p"]) -> PrincipalDifferential:
        """With p_i = λ̄_i^α − 1 and e_i = p_i − E/3: τ_i = Σ_k w' α e_i + K/2 (J² − 1),
        ∂τ_i/∂ln s_j = Σ_k α² (w'' e_i e_j + w' ((1 + p_i)(δ_ij − 1/3) − e_j/3)) + K J²."""
        d, J = len(s), s.prod(axis=0)
        log_J = jnp.log(J)
        powers = [PowerLessOne(a * jnp.ones_like(J), -a / 3 * log_J) for a in self.powers()]
        p = [power.of(s) for power in powers]
        excess = tuple(_excess(a, part.sum(axis=0), log_J, d) for a, part in zip(self.powers(), p, strict=True))
        e = [part - E / 3 for part, E in zip(p, excess, strict=True)]
        slopes, curvatures = jax.jvp(self._slopes, (excess,), (tuple(map(jnp.ones_like, excess)),))
        terms = [*zip(self.powers(), slopes, curvatures, powers, p, e, strict=True)]
        tau = sum((a * dw * e for a, dw, _, _, _, e in terms), self.bulk_modulus / 2 * (J**2 - 1))

        def growth(i: int, j: int) -> Array:
            shares = [
                a**2 * (ddw * e[i] * e[j] + dw * ((1 + p[i]) * ((i == j) - 1 / 3) - e[j] / 3))
                for a, dw, ddw, _, p, e in terms
            ]
            return sum(shares, self.bulk_modulus * J**2)

        def slope(i: int, j: int) -> Array:
            return reduce(jnp.add, (a * dw * power.slope(s[j], s[i]) for a, dw, _, power, _, _ in terms))

        return PrincipalDifferential.of_kirchhoff(s, tau, growth, slope)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.determinant(F) > 0

    def _slopes(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        """dw_k/dE_k [Pa]."""
        return jax.jvp(self.work, (excess,), (tuple(map(jnp.ones_like, excess)),))[1]

    def _strains(self, F: Matrix, log_J: Array) -> tuple[tuple[Matrix, ...], tuple[Array, ...]]:
        """C̄^{α/2} − I and E of each exponent."""
        strains = tuple(_isochoric_power(a, F, log_J) for a in self.powers())
        pairs = zip(self.powers(), strains, strict=True)
        return strains, tuple(_excess(a, la.trace(A), log_J, len(F)) for a, A in pairs)


def _isochoric_power(exponent: PerParticle, F: Matrix, log_J: Array) -> Matrix:
    """C̄^{α/2} − I, C̄ = J^−2/3 C, by products where the law's class fixes α at 2 or −2, else by the eigenvalues of C.
    Its derivatives hold at repeated stretches."""
    if isinstance(exponent, int) and exponent == 2:
        return jnp.exp(-2 / 3 * log_J) * la.matmul(la.transpose(F), F) - la.identity_like(F)
    if isinstance(exponent, int) and exponent == -2:
        cofactor = la.cofactor(F)
        return jnp.exp(-4 / 3 * log_J) * la.matmul(la.transpose(cofactor), cofactor) - la.identity_like(F)
    exponent = exponent * jnp.ones_like(log_J)
    return PowerLessOne(exponent / 2, -exponent / 3 * log_J)(la.matmul(la.transpose(F), F))


def _excess(exponent: PerParticle, trace: Array, log_J: Array, dim: int) -> Array:
    """E = λ̄_1^α + λ̄_2^α + λ̄_3^α − 3 [-], zero at rest, by the trace of `_isochoric_power` in the d directions of F."""
    return trace + (3 - dim) * jnp.expm1(-exponent / 3 * log_J)


def _second_order(exponent: PerParticle, F: Matrix, log_J: Array) -> Array:
    """E as of `_excess`, where α ln λ̄_i are left out, whose sum is zero: of full precision where α is near zero."""
    if isinstance(exponent, int):
        return _excess(exponent, la.trace(_isochoric_power(exponent, F, log_J)), log_J, len(F))
    exponent = exponent * jnp.ones_like(log_J)
    power = PowerBeyondLine(exponent / 2, -exponent / 3 * log_J)
    return la.trace(power(la.matmul(la.transpose(F), F))) + (3 - len(F)) * exponential_beyond_line(power.shift)


class MooneyRivlin(AbstractRubber):
    """Mooney-Rivlin rubber (M. Mooney, J. Appl. Phys. 11 (1940) 582, doi 10.1063/1.1712836; R. S. Rivlin, Phil. Trans.
    R. Soc. A 241 (1948) 379, doi 10.1098/rsta.1948.0024).

    Ψ = C1 (Ī1 − 3) + C2 (Ī2 − 3) + K/4 (J² − 1 − 2 ln J), μ = 2 (C1 + C2). C2 = 0 is neo-Hookean, the volume apart.

    *When it breaks*: it needs J > 0. It follows a tension test to a stretch of about 2 or 3: it has no upturn, and
    overestimates equibiaxial tension with the C2 of a uniaxial test alone. With C2 < 0 it is unstable at some stretch.
    *Good values*: soft rubber C1 = 0.1 to 0.3 MPa and C2 = 0 to C1, K = 2 GPa; 100 to 1000 μ at pressures far below it.

    Args:
        c1: C1 [Pa], one value or one per particle (p,).
        c2: C2 [Pa], likewise; C1 + C2 must be positive.
        bulk_modulus: K [Pa].
    """

    c1: Annotated[PerParticle, finite, "Pa"]
    c2: Annotated[PerParticle, finite, "Pa"]
    bulk_modulus: Annotated[PerParticle, positive, "Pa"]

    def __check_init__(self):
        require_fields(self)
        require_that("MooneyRivlin's c1 and c2 [Pa] must have a positive sum", lambda a, b: a + b > 0, self.c1, self.c2)

    @property
    def shear_modulus(self) -> PerParticle:
        """μ = 2 (C1 + C2) [Pa]."""
        return 2 * (self.c1 + self.c2)

    def powers(self) -> tuple[PerParticle, ...]:
        return (2, -2)

    def work(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        return self.c1 * excess[0], self.c2 * excess[1]


class Yeoh(AbstractRubber):
    """Yeoh's rubber (O. H. Yeoh, Rubber Chem. Technol. 66 (1993) 754, doi 10.5254/1.3538343).

    Ψ = C1 E + C2 E² + C3 E³ + K/4 (J² − 1 − 2 ln J) with E = Ī1 − 3, and μ = 2 C1.

    *When it breaks*: it needs J > 0. With C2 or C3 < 0 it may soften and lose stability at some stretch: keep
    C1 + 2 C2 E + 3 C3 E² positive over the stretches in use. It knows Ī1 alone, and so underestimates equibiaxial
    tension at small stretches.
    *Good values*: C2 near −C1/100, C3 near C1/10 000 for gum rubber; K as for `MooneyRivlin`.

    Args:
        c1: C1 [Pa], positive, one value or one per particle (p,).
        c2: C2 [Pa], likewise.
        c3: C3 [Pa], likewise.
        bulk_modulus: K [Pa].
    """

    c1: Annotated[PerParticle, positive, "Pa"]
    c2: Annotated[PerParticle, finite, "Pa"]
    c3: Annotated[PerParticle, finite, "Pa"]
    bulk_modulus: Annotated[PerParticle, positive, "Pa"]

    @property
    def shear_modulus(self) -> PerParticle:
        """μ = 2 C1 [Pa]."""
        return 2 * self.c1

    def powers(self) -> tuple[PerParticle, ...]:
        return (2,)

    def work(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        (E,) = excess
        return (E * (self.c1 + E * (self.c2 + E * self.c3)),)


class Gent(AbstractRubber):
    """Gent's rubber, whose chains can be stretched so far and no farther (A. N. Gent, Rubber Chem. Technol. 69 (1996)
    59, doi 10.5254/1.3538357).

    Ψ = −μ J_m/2 ln(1 − (Ī1 − 3)/J_m) + K/4 (J² − 1 − 2 ln J).

    *When it breaks*: it needs J > 0 and Ī1 − 3 < J_m; what lies beyond is reported, and refused by fits. Near the limit
    it stiffens without bound, and steps must shrink. It knows Ī1 alone, as `Yeoh` does.
    *Good values*: J_m = 30 to 100 for rubber, below 3 for tissue; μ = 0.2 to 2 MPa; K as for `MooneyRivlin`.

    Args:
        shear_modulus: μ [Pa], one value or one per particle (p,).
        limit: J_m [-], the largest Ī1 − 3, likewise.
        bulk_modulus: K [Pa].
    """

    shear_modulus: Annotated[PerParticle, positive, "Pa"]
    limit: Annotated[PerParticle, positive]
    bulk_modulus: Annotated[PerParticle, positive, "Pa"]

    def powers(self) -> tuple[PerParticle, ...]:
        return (2,)

    def work(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        (E,) = excess
        return (-self.shear_modulus / 2 * self.limit * jnp.log1p(-E / self.limit),)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        J = la.determinant(F)
        positive = J > 0
        _, (excess,) = self._strains(F, jnp.log(jnp.where(positive, J, 1)))
        return positive & (excess < self.limit)

    def inadmissible(self, or_else: str) -> tuple[str, str]:
        what = "has a deformation gradient that Gent does not allow (det F ≤ 0, or a stretch beyond its limit)"
        return what, f"Reduce dt{or_else}, or raise the limit."


class Ogden(AbstractRubber):
    """Ogden's rubber (R. W. Ogden, Proc. R. Soc. Lond. A 326 (1972) 565, doi 10.1098/rspa.1972.0026).

    Ψ = Σ_k μ_k/α_k (λ̄_1^α_k + λ̄_2^α_k + λ̄_3^α_k − 3) + K/4 (J² − 1 − 2 ln J), μ = ½ Σ_k μ_k α_k.

    *When it breaks*: it needs J > 0. It is stable at every stretch if each μ_k α_k is positive, Drucker's condition of
    each term: fit by `with_shear_moduli`. Two exponents of one sign are nearly the same to data of one kind of test:
    fit several kinds together. A particle takes an eigenvalue problem, which `MooneyRivlin` (2 and −2) spares.
    *Good values*: two or three terms, one exponent 1 to 2, one 4 to 6 for the upturn, one negative near −2 for what
    uniaxial and biaxial tests tell apart; K as for `MooneyRivlin`.

    Args:
        moduli: μ_k [Pa], a tuple with one number a term.
        exponents: α_k [-], not zero, likewise.
        bulk_modulus: K [Pa].
    """

    moduli: Annotated[tuple[Scalar, ...], finite, "Pa"] = eqx.field(converter=as_plain)
    exponents: Annotated[tuple[Scalar, ...], finite] = eqx.field(converter=as_plain)
    bulk_modulus: Annotated[PerParticle, positive, "Pa"]

    def __check_init__(self):
        require_fields(self)
        terms = len(self.moduli)
        require(
            terms == len(self.exponents) > 0,
            f"Ogden needs a modulus and an exponent for each of its terms, got {terms} and {len(self.exponents)}.",
        )
        require_that("Ogden's exponents must not be zero", lambda a: a != 0, self.exponents)
        sum_of_moduli = "Ogden's moduli [Pa] times their exponents must have a positive sum"
        require_that(sum_of_moduli, lambda m, a: (m * a).sum() > 0, self.moduli, self.exponents)

    @property
    def shear_modulus(self) -> Scalar:
        """μ = ½ Σ_k μ_k α_k [Pa]."""
        return sum(modulus * exponent for modulus, exponent in zip(self.moduli, self.exponents, strict=True)) / 2

    def with_shear_moduli(self, shear_moduli: tuple[Scalar, ...]) -> "Ogden":
        """The law of these exponents whose terms have given shear moduli, μ_k = 2 c_k/α_k.

        Positive ones make each term, and so the law, stable at every stretch, by construction, and make better
        parameters of a fit than μ_k: c_k stays finite where an exponent goes to zero, and the first slope of the stress
        does not change with α_k. The exponents come first:

            "alpha": mpm.Positive(lambda e: e.scene.material.exponents[0]),
            "c": mpm.Positive(update=lambda e, c: eqx.tree_at(
                lambda e: e.scene.material, e, e.scene.material.with_shear_moduli(tuple(c))), start=(3e5,)),

        Args:
            shear_moduli: c_k [Pa], one a term.
        """
        require(
            len(shear_moduli) == len(self.exponents),
            f"with_shear_moduli takes one shear modulus for each of its {len(self.exponents)} terms, got "
            f"{len(shear_moduli)}.",
        )
        moduli = tuple(2 * c / a for c, a in zip(shear_moduli, self.exponents, strict=True))
        return eqx.tree_at(lambda law: law.moduli, self, moduli)

    def powers(self) -> tuple[Scalar, ...]:
        return self.exponents

    def work(self, excess: tuple[Array, ...]) -> tuple[Array, ...]:
        return tuple(m / a * E for m, a, E in zip(self.moduli, self.exponents, excess, strict=True))
