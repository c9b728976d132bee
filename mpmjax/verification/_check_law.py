"""Checks of laws: closed forms against derivatives of the energy, and tension tests of incompressible materials."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Float, Matrix
from mpmjax.checks import canonical, require, require_positive
from mpmjax.material import AbstractLaw, AbstractMaterial, MatrixDifferential

_CHECKED = (
    "the energy",
    "the energy's gradient",
    "the derivative of the energy's gradient",
    "the energy after a rotation of space",
    "stress",
    "kirchhoff_numbers",
    "stress_differential",
    "the derivative of stress_differential by F and the law's parameters",
    "principal_differential",
)
"""The checks, in this order; the last only for a law that overrides it."""


def check_law(law: AbstractLaw, *, dim: int = 3, F: Any = None, rtol: float = 1e-9) -> None:
    """Check that the methods of a law are derivatives of its energy, and finite where steps and gradients need them.

    The check is in float64, at each deformation that the law admits:

    - The energy is finite, and a rotation of space does not change it.
    - `stress` is the gradient of the energy, `kirchhoff_numbers` give it, `stress_differential` is its derivative, and
      `principal_differential` the eigenstructure of that, as in the defaults of `AbstractMaterial`. Differences are
      relative to the size of the stress differential.
    - The derivatives of the stress differential by F and by the parameters of the law are finite.

    For a law with a history, the elastic law of its initial history is checked. For a viscous law, the law without the
    viscosity is. Return maps are not checked.

    Args:
        law: the law.
        dim: 1, 2 or 3.
        F: deformation gradients, shape (p, dim, dim); a law of J alone is checked as the function Ψ(det F). Default:
            F = I, repeated and nearly repeated stretches, stretches from 0.6 to 1.6, all of these rotated and not.
        rtol: the largest relative difference allowed.

    Raises:
        ValueError: a difference, or a derivative that is not finite; the message names the method, F and the relative
            difference. No deformation that the law admits.
    """
    with jax.enable_x64(True):
        gradients = jnp.asarray(_deformations(dim) if F is None else np.asarray(F, float))
        fits = gradients.ndim == 3 and gradients.shape[1:] == (dim, dim)
        require(fits, f"check_law's F must have shape (p, {dim}, {dim}), got {gradients.shape}.")
        place = jnp.moveaxis(gradients, 0, -1)
        typed: AbstractLaw = canonical(law, place.dtype)
        elastic = typed.elastic(typed.initial_history(typed.measure.of(place)))
        by_gradient: Any = elastic if elastic.measure.axes else _OfVolume(elastic)
        faults = eqx.filter_jit(_faults)(by_gradient, place)
    admitted, told = np.asarray(faults[0]), type(elastic).__name__
    require(admitted.any(), f"{told} admits none of check_law's {len(admitted)} deformations: give some by F.")
    for what, wrong in zip(_CHECKED, faults[1], strict=False):
        wrong = np.where(admitted, np.asarray(wrong), 0)
        worst = int(np.argmax(np.where(np.isnan(wrong), np.inf, wrong)))
        where = f"at F = {np.array2string(np.asarray(gradients[worst]), precision=6, separator=', ')}".replace("\n", "")
        require(not np.isnan(wrong[worst]), f"{told}: {what} is not finite {where}.")
        require(wrong[worst] <= rtol, f"{told}: {what} is off by {wrong[worst]:.2g} of its size {where}.")


class _OfVolume(AbstractMaterial):
    """A law of J alone as a function of F: Ψ(det F), P = Ψ' J F⁻ᵀ."""

    law: Any

    def energy(self, F: Matrix) -> Array:
        return self.law.energy(la.determinant(F))

    def stress(self, F: Matrix) -> Matrix:
        return self.law.stress(la.determinant(F)) * la.cofactor(F)

    def stress_differential(self, F: Matrix) -> MatrixDifferential:
        J, cofactor = la.determinant(F), la.cofactor(F)

        def differential(dF: Matrix) -> Matrix:
            change = self.law.stress_differential(J)(la.double_dot(cofactor, dF))
            return change * cofactor + self.law.stress(J) * la.cofactor_differential(F, dF)

        return MatrixDifferential(la.matrix_of(differential, F))

    def is_admissible(self, F: Matrix) -> Array:
        return self.law.is_admissible(la.determinant(F))


def _faults(law: AbstractMaterial, F: Matrix) -> tuple[Bool[Array, "p"], tuple[Float[Array, "p"], ...]]:
    """Whether the law admits each F, and the relative differences of `_CHECKED`, NaN where a value is not finite."""
    base, d = AbstractMaterial, len(F)
    Q = jnp.broadcast_to(jnp.asarray(_rotation(np.random.default_rng(1), d))[..., None], F.shape)
    energy, turned = law.energy(F), law.energy(la.matmul(Q, F))
    stress = base.stress(law, F)
    A = la.matrix_of(lambda dF: jax.jvp(lambda F: base.stress(law, F), (F,), (dF,))[1], F)
    stiffness = jnp.sqrt((A**2).sum(axis=(0, 1)))
    U, s, V = la.principal_frame(F)
    tau, pair, one = la.matmul(stress, la.transpose(F)), law.kirchhoff_numbers(F), la.identity_like(F)

    def differential(law: AbstractMaterial, F: Matrix) -> Array:
        return la.matrix_of(law.stress_differential(F), F)

    numbers, rest = eqx.partition(law, eqx.is_inexact_array)
    ones = jax.tree.map(jnp.ones_like, numbers)
    third = jax.jvp(lambda n, F: differential(eqx.combine(n, rest), F), (numbers, F), (ones, Q))[1]

    def compared(ours: Array, expected: Array) -> Array:
        scale = _size(expected) + stiffness
        return _size(ours - expected) / jnp.where(scale == 0, 1, scale)

    faults = (
        0 * energy,
        0 * _size(stress),
        0 * stiffness,
        compared(turned[None, None], energy[None, None]),
        compared(law.stress(F), stress),
        compared(tau if pair is None else pair[0] * la.matmul(F, la.transpose(F)) + pair[1] * one, tau),
        compared(differential(law, F), A),
        0 * _size(third),
    )
    if type(law).principal_differential is not base.principal_differential:  # assembled at F = U diag(s) Vᵀ
        tangent, modes = law.principal_differential(s), la.principal_modes(U, V).reshape(d * d, d * d, -1)
        core = la.diagonal(jnp.concatenate([jnp.zeros_like(s), tangent.twist, tangent.flip]))
        core = core.at[:d, :d].set(tangent.scaling)
        faults += (compared(la.matmul(la.transpose(modes), la.matmul(core, modes)), A),)
    return law.is_admissible(F), faults


def _size(A: Float[Array, "a b p"]) -> Float[Array, "p"]:
    return jnp.sqrt((A**2).sum(axis=(0, 1)))


def _rotation(rng: np.random.Generator, d: int) -> np.ndarray:
    Q = np.linalg.qr(rng.normal(size=(d, d)))[0]
    Q[:, 0] *= np.sign(np.linalg.det(Q))
    return Q


def _deformations(d: int) -> Float[np.ndarray, "p d d"]:
    """The default deformations of `check_law`."""
    rng = np.random.default_rng(0)
    stretches = [np.ones(3), np.full(3, 1.2), np.array([1.2, 0.9, 0.9]), np.array([0.8, 0.8, 1.3])]
    stretches += [s + gap * np.array([0.4, -1.0, 0.7]) for s in stretches for gap in (1e-14, 1e-7, 1e-3)]
    stretches += list(rng.uniform(0.6, 1.6, (8, 3)))
    plain = [np.diag(s[:d]) for s in stretches]
    return np.stack(plain + [_rotation(rng, d) @ F @ _rotation(rng, d).T for F in plain])


Tension = Literal["uniaxial", "pure shear", "equibiaxial"]
"""A tension test: the stretches are λ, λ^−½, λ^−½; or λ, 1, 1/λ (a wide strip: plane strain); or λ, λ, λ^−2."""


def tension(law: AbstractMaterial, stretch: Float[Array, "m"], kind: Tension) -> Float[Array, "m"]:
    """The nominal stress of a tension test at constant volume [Pa], shape (m,).

    The stretches s are those of the test with J = 1. A pressure p makes the faces normal to the third axis free:
    P_i = ∂Ψ/∂s_i − p/s_i with p = s_3 ∂Ψ/∂s_3, of which the energy of the volume drops out. So it is the response of a
    law whose bulk modulus is infinite; with a finite K that of a simulation differs by some of p/K.

    Args:
        law: an isotropic law.
        stretch: λ [-], shape (m,), positive.
        kind: "uniaxial", "pure shear" or "equibiaxial".

    Raises:
        ValueError: no such test, or a stretch that is not positive.
    """
    require(kind in _STRETCHES, f"kind must be one of {', '.join(_STRETCHES)}, got {kind!r}.")
    require_positive("A stretch", stretch)
    stretch = jnp.asarray(stretch, float)
    return _tension(canonical(law, stretch.dtype), stretch, jnp.asarray(_STRETCHES[kind], stretch.dtype))


@eqx.filter_jit
def _tension(law: AbstractMaterial, stretch: Float[Array, "m"], powers: Float[Array, "3"]) -> Float[Array, "m"]:
    s = stretch ** powers[:, None]
    P = law.stress(la.diagonal(s))
    return P[0, 0] - s[2] / s[0] * P[2, 2]


_STRETCHES = {"uniaxial": (1, -0.5, -0.5), "pure shear": (1, 0, -1), "equibiaxial": (1, 1, -2)}
"""The powers of λ that the stretches are."""
