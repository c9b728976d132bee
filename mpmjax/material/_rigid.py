"""Rigid bodies."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Bool, Deformation, Float, Matrix, Scalar
from mpmjax.checks import as_plain, require, require_fields, require_positive
from mpmjax.material._law import AbstractMaterial, Freedom


class Rigid(AbstractMaterial):
    """A rigid body that moves as the forces on it make it: M V' = Σ f, (I ω)' = Σ r × f.

    Its particles give it mass and shape, so `fill` it with its density. Loads, gravity and contact act on it as on any
    body, and it stands in the same implicit system as what it touches. It is a body of its own: a scene with other
    materials has `bodies` (see `Bodies`).

        plate = mpm.Rigid(1e8, free=(False, True), turns=False)
        scene = mpm.Scene(grid, (rubber, plate), bodies=mpm.Bodies(), loads=mpm.PointLoad(top, (0.0, -100.0)))

    *When it breaks*: in the total description, where `RigidPart` is. A step must turn it by much less than a radian.
    What a wall, a plane or a grip holds of one of its nodes it holds of the whole body, which then does not turn,
    except as the grip does.

    *Good values*: for the modulus, some ten times that of what it touches.

    Args:
        modulus: the modulus M of pressure waves [Pa] by which contact takes its stiffness, positive: between it and
            another body M M'/(M + M').
        free: the directions in which it may move, one bool each; in the others it rests. Default: all of them.
        turns: whether it may turn.
    """

    allows_averaged_volume: ClassVar[bool] = False  # its volume does not change
    modulus: Scalar
    free: tuple[bool, ...] | None = eqx.field(static=True, default=None, converter=as_plain)
    turns: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        require_fields(self)
        require_positive("Rigid's modulus [Pa]", self.modulus)
        require(
            self.free is None or len(self.free) in (1, 2, 3),
            f"Rigid's free directions must be one bool for each of the scene's, got {self.free}.",
        )

    @property
    def freedom(self) -> Freedom:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Where it may move, and whether it may turn."""
        return Freedom(self.free, self.turns)

    def energy(self, F: Matrix) -> Array:
        return jnp.zeros(F.shape[2:], F.dtype)

    def wave_modulus(self, F: Deformation) -> Float[Array, "*p"]:
        return jnp.broadcast_to(jnp.asarray(self.modulus, F.dtype), (1,))

    def is_admissible(self, F: Matrix) -> Bool[Array, "p"]:
        return la.finite(F)
