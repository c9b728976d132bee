"""What a simulation returns."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from mpmjax._diffrax import Tally
from mpmjax._exchange import Exchange
from mpmjax._method import Method
from mpmjax._particles import Particles, State, with_state
from mpmjax._scene import Scene
from mpmjax._types import Array, Float, Scalar


class SimulationError(RuntimeError):
    """A run that went wrong on the way. `run` holds what was reached, its `final` the last good state."""

    def __init__(self, message: str, run: "Run"):
        super().__init__(message)
        self.run = run


class Run(eqx.Module):
    """A simulation's outcome. A pytree: it can be returned from `jax.jit`, `jax.vmap` and differentiated."""

    scene: Scene
    """As it was simulated."""
    method: Method
    """As it was used."""
    dt: Scalar
    """Δt [s]."""
    steps: Float[Array, "*f"]
    """Step number of each saved frame, shape (f,)."""
    frames: State | None
    """The saved states, with a leading axis f; None where nothing or only observations were saved."""
    observed: Any
    """What `observe` returned for each frame, with a leading axis f."""
    final: Particles
    """The particles at the end."""
    final_step: Float[Array, ""]
    """Step number at the end."""
    tally: Tally
    """Solver and contact statistics, and the first fault."""

    @property
    def times(self) -> Float[Array, "*f"]:
        """Time of each saved frame [s], shape (f,)."""
        return self.steps * self.dt

    def frame(self, i: int) -> Particles:
        """The particles at the i-th saved frame."""
        if self.frames is None:
            raise ValueError("This run saved no frames: pass save_every to simulate.")
        return with_state(self.final, jax.tree.map(lambda a: a[i], self.frames))

    def forces(self) -> tuple[Float[Array, "g"], Exchange]:
        """The mean force [N] and torque [N m] on each collider between one saved frame and the next.

        Returns:
            the times half way between frames [s], shape (f − 1,), and an `Exchange` over time: force (f − 1, k, d) and
            torque (f − 1, k, r).

        Raises:
            ValueError: no frames were saved, or the scene has no collider.
        """
        if self.frames is None or self.frames.received is None:
            raise ValueError(
                "Forces need saved frames and colliders: pass save_every to simulate, a collider to Scene."
            )
        times = self.times
        between = times[1:] - times[:-1]
        mean = jax.tree.map(lambda a: (a[1:] - a[:-1]) / between[:, None, None], self.frames.received)
        return (times[1:] + times[:-1]) / 2, mean

    def __len__(self) -> int:
        return 0 if self.frames is None else int(np.shape(self.steps)[0])
