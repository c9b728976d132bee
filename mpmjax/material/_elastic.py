"""Elastic laws: fixed corotated and neo-Hookean."""

from typing import Annotated

import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix, PerParticle
from mpmjax.checks import between, positive, require_fields
from mpmjax.material._differential import Entry, IsotropicDifferential, PrincipalDifferential
from mpmjax.material._law import AbstractMaterial

YoungsModulus = Annotated[PerParticle, positive, "Pa"]
PoissonRatio = Annotated[PerParticle, between(-1, 0.5, open_ends=True)]


class AbstractIsotropic(AbstractMaterial):
    """A law given by Young's modulus and Poisson's ratio: at small strains δP = 2μ ε + λ tr(ε) I."""

    youngs_modulus: YoungsModulus  # E [Pa]
    poisson_ratio: PoissonRatio  # ν [-]
    __check_init__ = require_fields

    @property
    def shear_modulus(self) -> PerParticle:
        """μ = E / (2 (1 + ν)) [Pa]."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> PerParticle:
        """λ = E ν / ((1 + ν)(1 − 2ν)) [Pa]."""
        return self.youngs_modulus * self.poisson_ratio / ((1 + self.poisson_ratio) * (1 - 2 * self.poisson_ratio))

    @property
    def bulk_modulus(self) -> PerParticle:
        """K = E / (3 (1 − 2ν)) [Pa], that of three dimensions."""
        return self.youngs_modulus / (3 * (1 - 2 * self.poisson_ratio))


class FixedCorotated(AbstractIsotropic):
    """Fixed corotated elasticity (A. Stomakhin, R. Howes, C. Schroeder, J. Teran, SCA 2012, doi
    10.2312/SCA/SCA12/025-032).

    Ψ = μ ‖F − R‖² + λ/2 (J − 1)², P = 2μ (F − R) + λ (J − 1) J F⁻ᵀ, F = R S, J = det F (derivation, eq. 11).

    *When it breaks*: not by inversion, since it is defined for every F, J ≤ 0 included. In 2-D and 3-D its Hessian is
    indefinite under any uniform compression, and the stress differential grows like 1/(s_i + s_j) where two signed
    principal stretches nearly cancel.
    *Good values*: jelly E = 1e4 to 1e6 Pa, ν = 0.3; ν above 0.45 stiffens the volume and asks for more iterations.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
    """

    def energy(self, F: Matrix) -> Array:
        stretch = F - la.rotation(F)
        volumetric = self.lame_lambda / 2 * (la.determinant(F) - 1) ** 2
        return self.shear_modulus * la.double_dot(stretch, stretch) + volumetric

    def stress(self, F: Matrix) -> Matrix:
        volumetric = self.lame_lambda * (la.determinant(F) - 1)
        return 2 * self.shear_modulus * (F - la.rotation(F)) + volumetric * la.cofactor(F)

    def principal_differential(self, s: Float[Array, "d *p"]) -> PrincipalDifferential:
        """With v = λ (J − 1) J/(s_i s_j): twist 2μ (1 − 2/(s_i + s_j)) + v, flip 2μ − v, scaling
        2μ δ_ij + λ (J/s_i)(J/s_j) + (1 − δ_ij) v."""
        mu, lam = 2 * self.shear_modulus * jnp.ones_like(s[0]), self.lame_lambda * jnp.ones_like(s[0])
        return _with_volumetric(s, lam * (s.prod(axis=0) - 1), lam, lambda i, j: mu * (1 - 2 / (s[i] + s[j])), mu)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.finite(F)


class NeoHookean(AbstractIsotropic):
    """Compressible neo-Hookean elasticity (J. Bonet, R. D. Wood, Nonlinear Continuum Mechanics for Finite Element
    Analysis, 2nd ed., Cambridge 2008, eq. 6.27).

    Ψ = μ/2 (F : F − d) − μ ln J + λ/2 (ln J)², P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ.

    *When it breaks*: it needs J > 0; inversion is reported. Its Hessian can be indefinite under compression, and under
    even expansion once λ ln J > μ (1 + J^{2/d}): in 2-D never at ν = 0.3, and from J = 1.04 on at ν = 0.49.
    *Good values*: rubber μ = 0.1 to 2 MPa with ν = 0.49 (nearly incompressible), gels as for fixed corotated.

    Args:
        youngs_modulus: E [Pa], one value or one per particle (p,).
        poisson_ratio: ν [-], strictly between −1 and 0.5.
    """

    def energy(self, F: Matrix) -> Array:
        log_J = jnp.log(la.determinant(F))
        mu, lam = self.shear_modulus, self.lame_lambda
        return mu / 2 * (la.double_dot(F, F) - F.shape[0]) - mu * log_J + lam / 2 * log_J**2

    def stress(self, F: Matrix) -> Matrix:
        pull, _ = self.volumetric(la.determinant(F))
        return self.shear_modulus * F + pull * la.cofactor(F)

    def kirchhoff_numbers(self, F: Matrix) -> tuple[Array, Array] | None:
        if type(self).stress is not NeoHookean.stress:  # a law that derives from this one
            return None
        J = la.determinant(F)
        return self.shear_modulus * jnp.ones_like(J), self.volumetric(J)[0] * J

    def stress_differential(self, F: Matrix) -> "NeoHookeanDifferential":
        return NeoHookeanDifferential(self, F)

    def volumetric(self, J: Array) -> tuple[Array, Array]:
        """q = (λ ln J − μ)/J, by which the cofactor matrix enters the stress, and b = dq/dJ."""
        pull = (self.lame_lambda * jnp.log(J) - self.shear_modulus) / J
        return pull, self.lame_lambda / J**2 - pull / J

    def principal_differential(self, s: Float[Array, "d *p"]) -> PrincipalDifferential:
        """With v = (μ − λ ln J)/(s_i s_j): twist μ − v, flip μ + v, scaling μ + (μ + λ (1 − ln J))/s_i² on the diagonal
        and λ/(s_i s_j) off it."""
        mu, J = self.shear_modulus * jnp.ones_like(s[0]), s.prod(axis=0)
        pull, bulk = self.volumetric(J)
        return _with_volumetric(s, pull, bulk, lambda i, j: mu, mu)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.determinant(F) > 0


class NeoHookeanDifferential(IsotropicDifferential):
    """δP = μ δF + q δ(J F⁻ᵀ) + b (J F⁻ᵀ : δF) J F⁻ᵀ, with q = (λ ln J − μ)/J and b = λ/J² − q/J = dq/dJ."""

    law: NeoHookean

    def pushed_forward(self, A: Matrix, weight: Float[Array, "*p"]) -> Float[Array, "t *p"]:
        """w (μ δ_ac (A Aᵀ)_bd + b T_ab T_cd + q ε_ace ε_bdf Y_fe), with T = J F⁻ᵀ Aᵀ and, in 3-D, Y = cof(A) Fᵀ; in
        2-D the last term is q ε_ac ε_bd det A, and in 1-D none."""
        d, back, law = len(A), la.transpose(A), self.law
        pull, bulk = (weight * factor for factor in law.volumetric(la.determinant(self.F)))
        square, first = weight * law.shear_modulus * la.matmul(A, back), la.matmul(la.cofactor(self.F), back)
        if d == 3:
            second = pull * la.matmul(la.cofactor(A), la.transpose(self.F))
        else:
            second = (pull * la.determinant(A))[None, None]
        # once, and not again in each component
        computed = jax.lax.optimization_barrier((square, first, bulk * first, second))
        square, first, bulk, second = map(la.entries, computed)

        def entry(b: int, a: int, e: int, c: int) -> Array:
            """In the row of G_ab and the column of G_ce."""
            value = bulk[a][b] * first[c][e]
            if a == c:
                return value + square[b][e]
            if b == e:
                return value
            cross = second[3 - b - e][3 - a - c] if d == 3 else second[0][0]
            return value + cross if (c - a - e + b) % 3 == 0 else value - cross

        places = [(b, a) for b in range(d) for a in range(d)]
        return jnp.stack([entry(*row, *column) for k, row in enumerate(places) for column in places[k:]])


def _with_volumetric(s: Array, pull: Array, bulk: Array, twist: Entry, stiffness: Array) -> PrincipalDifferential:
    """The eigenstructure of a law with P = deviatoric part + q J F⁻ᵀ, q = `pull` and b = dq/dJ = `bulk`.

    δ(q J F⁻ᵀ) = b (J F⁻ᵀ : δF) J F⁻ᵀ + q δ(J F⁻ᵀ) has twist q J/(s_i s_j), flip −q J/(s_i s_j) and scaling
    b (J/s_i)(J/s_j) + (1 − δ_ij) q J/(s_i s_j), both quotients being products of the other stretches.
    The deviatoric part has a `twist` for each pair, and `stiffness` as its flip and the diagonal of its scaling.
    """
    d = s.shape[0]

    def others(*without: int) -> Array:
        return jnp.stack([jnp.ones_like(s[0]), *(s[k] for k in range(d) if k not in without)]).prod(axis=0)

    def scaling(i: int, j: int) -> Array:
        spherical = bulk * others(i) * others(j)
        return spherical + (stiffness if i == j else pull * others(i, j))

    return PrincipalDifferential.of(
        s,
        twist=lambda i, j: twist(i, j) + pull * others(i, j),
        flip=lambda i, j: stiffness - pull * others(i, j),
        scaling=scaling,
    )
