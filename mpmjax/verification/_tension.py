"""Tension tests of incompressible materials in closed form."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float
from mpmjax.checks import canonical, require, require_positive
from mpmjax.material import AbstractMaterial

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
