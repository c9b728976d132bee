"""Forces and torques on colliders and boundaries, as observations."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Scalar
from mpmjax.checks import require
from mpmjax.fitting._observation import Numbers, Series
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene


class Force(Series):
    """The force on a collider, or on any boundary, against time, such as that of a plate on which a body falls or of a
    grip that pulls.

    Compared with the force of each step at its own time (see `Forces`), interpolated linearly.

    Args:
        times: when it was measured [s], shape (f,), growing.
        forces: the force [N], shape (f, d); NaN where a component was not measured.
        collider: number of the collider, from 0, in the order of the scene's boundaries.
        boundary: number of the boundary, from 0, in the scene's order, in the place of `collider`. The scene must have
            `boundary_forces`.
        sigma: standard deviation of the noise [N]; None to estimate it.
        weight: factor of the squares.
        robust: misfit in standard deviations beyond which squares grow but linearly.
        name: what tables and pictures call it.
    """

    collider: int = eqx.field(static=True)
    boundary: int | None = eqx.field(static=True)

    def __init__(
        self,
        times: Numbers,
        forces: Numbers,
        *,
        collider: int = 0,
        boundary: int | None = None,
        sigma: Numbers | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "force",
    ):
        self.collider, self.boundary = collider, boundary
        super().__init__(times, forces, _nothing, sigma=sigma, weight=weight, robust=robust, name=name)

    def _check_shape(self, seen: Any) -> None:
        """The forces' shape is checked when they are predicted."""
        del seen

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        super().check(scene, particles, t1)
        what = f"{type(self).__name__} {self.name!r}"
        if self.boundary is not None:
            number = len(scene.boundary) + len(scene.guides)
            require(
                0 <= self.boundary < number,
                f"{what} is of boundary {self.boundary}, from 0, but the scene has {number}.",
            )
            require(
                scene.boundary_forces,
                f"{what} is of boundary {self.boundary}, on which the scene computes no force: give it "
                "boundary_forces=True.",
            )
            return
        count = scene.collider_count
        require(
            0 <= self.collider < count, f"{what} is of collider {self.collider}, from 0, but the scene has {count}."
        )

    def predict(self, seen: Any, run: Run) -> Array:
        del seen
        at = run.method.force_at()
        return self._at_times(self._simulated(run), run, 0.0 if at is None else at)

    def explain(self, seen: Any, run: Run) -> None:
        super().explain(self._simulated(run), run)

    def _simulated(self, run: Run) -> Array:
        if self.boundary is None:
            return self._of(run.forces())[:, self.collider]
        return self._of(run.boundary_forces())[:, self.boundary]

    def _of(self, forces: Any) -> Array:
        return forces.force


class Torque(Force):
    """The torque on a collider or boundary against time, as `Force`: [N m], shape (f, 1) in two dimensions and (f, 3)
    in three, about the centre of the collider's rotation or, where it has none, about its shape's middle; of a grip
    about its region's middle, of other boundaries about the origin."""

    def _of(self, forces: Any) -> Array:
        return forces.torque


def _nothing(scene: Scene, particles: Particles) -> Array:
    """A zero: nothing is needed of the states."""
    del scene
    return jnp.zeros((), particles.x.dtype)
