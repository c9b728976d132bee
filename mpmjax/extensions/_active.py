"""Laws with an active stress along fibres, as of muscles, whose activation a control sets."""

from typing import Annotated, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix, PerParticle, Scalar
from mpmjax.checks import finite, positive, require, require_fields
from mpmjax.material import AbstractInelastic, AbstractMaterial, MatrixDifferential

_TURNED = (1 + 2**0.5) / 2
"""The most, of λ a T, that fibres add to the tangent of `stable_dt`: by L with L n = m and Lᵀ n = (√2 − 1) m, m ⟂ n."""


class Activation(eqx.Module):
    """The history of an `Active` law."""

    activation: Float[Array, "*q"]  # a [-], shape (q,): from 0, at rest, to 1


class Active(AbstractInelastic):
    """A law with fibres that pull, as those of a muscle: Ψ(F) + a T (λ − 1), λ = ‖F a0‖, so that P has the further
    term a T (F a0) a0ᵀ/λ, a tension T at full activation per undeformed area.

    The activation a belongs to the particles, zero at first: a control sets `particles.history.activation`, and files
    and pictures have it. The energy is convex in F for a ≥ 0, so that fibres make no solve harder.

        muscle = mpm.extensions.Active(mpm.NeoHookean(1e4, 0.3), strength=5e3)

    *When it breaks*: activation that jumps shakes the body, so let it grow over a few steps; `stable_dt` knows the
    present activation, so ask for it at the largest. Volumes cannot be averaged.

    *Good values*: a strength of some tenths of Young's modulus shortens the body by as much.

    Args:
        law: the elastic law of F without activation.
        strength: T [Pa], one number or one a particle.
        angle: of the fibres in the undeformed body, from the first axis to the second [rad], likewise.
        elevation: of the fibres towards the third axis [rad], likewise.
    """

    allows_total: ClassVar[bool] = True  # its return map changes nothing
    relaxes_stress: ClassVar[bool] = False
    law: AbstractMaterial
    strength: Annotated[PerParticle, positive, "Pa"]
    angle: Annotated[PerParticle, finite, "rad"] = 0.0
    elevation: Annotated[PerParticle, finite, "rad"] = 0.0

    def __check_init__(self):
        require_fields(self)
        require(self.law.measure.axes == 2, f"Active takes an elastic law of F, got {self.law.title()}.")

    def initial_history(self, F: Deformation) -> Activation:
        return Activation(jnp.zeros(F.shape[2:], F.dtype))

    def elastic(self, history: Activation) -> "Contracted":
        return Contracted(self.law, self.angle, self.elevation, self.strength * history.activation)

    def return_map(self, F: Deformation, history: Activation, dt: Scalar) -> tuple[Deformation, Activation]:
        """The deformation as it is."""
        return F, history


class Contracted(AbstractMaterial):
    """The elastic law of `Active` at an activation."""

    law: AbstractMaterial
    angle: PerParticle
    elevation: PerParticle
    tension: PerParticle  # a T [Pa]

    def _fibre(self, F: Matrix) -> tuple[list[Array], Float[Array, "d p"], Array]:
        """a0, n = F a0/λ and λ [-], shapes (d,), (d, p) and (p,); λ has the part out of the plane or line too."""
        angle, elevation = jnp.asarray(self.angle, F.dtype), jnp.asarray(self.elevation, F.dtype)
        whole = [jnp.cos(angle) * jnp.cos(elevation), jnp.sin(angle) * jnp.cos(elevation), jnp.sin(elevation)]
        rest, beyond = whole[: len(F)], whole[len(F) :]
        f = jnp.stack([F[:, k] * a for k, a in enumerate(rest)]).sum(axis=0)
        stretch = jnp.sqrt((f**2).sum(axis=0) + sum(a**2 for a in beyond))
        return rest, f / stretch, stretch

    def energy(self, F: Matrix) -> Array:
        return self.law.energy(F) + self.tension * (self._fibre(F)[2] - 1)

    def _active_stress(self, F: Matrix) -> Matrix:
        """a T n a0ᵀ."""
        rest, n, _ = self._fibre(F)
        return self.tension * jnp.stack([n * a for a in rest], axis=1)

    def stress(self, F: Matrix) -> Matrix:
        return self.law.stress(F) + self._active_stress(F)

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return self.law.is_admissible(F)

    def projected_differential(self, F: Matrix) -> MatrixDifferential:
        """The law's, projected, and that of the fibres, which is positive semi-definite for a ≥ 0."""
        fibres = la.matrix_of(lambda dF: jax.jvp(self._active_stress, (F,), (dF,))[1], F)
        return MatrixDifferential(la.matrix_of(self.law.projected_differential(F), F) + fibres)

    def stiffness_eigenvalues(self, F: Matrix, dim: int, *, total: bool) -> Float[Array, "m p"]:
        """The law's, each with a bound of what fibres add: no eigenvalue of a sum is beyond the sum of the largest."""
        stretch = self._fibre(F)[2]
        most = jnp.abs(self.tension) * (1 / stretch if total else _TURNED * stretch)
        return self.law.stiffness_eigenvalues(F, dim, total=total) + most
