"""A fit in which some directions of its coordinates are held."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float
from mpmjax.fitting._problem import Coordinates, FitProblem


class RestrictedProblem(FitProblem):
    """A problem on a plane of its coordinates, z = origin + basis y, as a function of y. Both are arrays: another plane
    of as many dimensions does not compile anew."""

    whole: FitProblem = eqx.field(kw_only=True)
    origin: Coordinates = eqx.field(kw_only=True)
    basis: Float[Array, "n f"] = eqx.field(kw_only=True)

    def __init__(self, whole: FitProblem, origin: Coordinates, basis: Float[Array, "n f"]):
        self.experiments, self.names = whole.experiments, whole.names
        self.parameters, self.starts, self.memory = whole.parameters, whole.starts, whole.memory
        self.whole, self.origin, self.basis = whole, origin, basis

    @property
    def size(self) -> int:
        return self.basis.shape[1]

    @property
    def dtype(self) -> Any:
        return self.whole.dtype

    def place(self, y: Float[Array, "f"]) -> Float[Array, "n"]:
        """The coordinates of the whole problem."""
        return self.origin + self.basis @ y

    def coordinates(self, z: Coordinates) -> tuple[Array, ...]:
        return self.whole.coordinates(self.place(z))

    def room(self, z: Coordinates) -> Float[Array, "2 f"]:
        """On planes of some of the coordinates."""
        return jnp.where(self.basis.T != 0, self.whole.room(self.place(z))[:, None], jnp.inf).min(axis=2)

    def residuals(self, z: Coordinates, sigmas: tuple[Array, ...], adjoint: Any) -> tuple[Array, Array]:
        return self.whole.residuals(self.place(z), sigmas, adjoint)
