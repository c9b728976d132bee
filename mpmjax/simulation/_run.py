"""The outcome of a simulation."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from mpmjax._types import Array, Float, Scalar
from mpmjax.boundary import Impulses
from mpmjax.simulation._statistics import RunStatistics
from mpmjax.state import Particles, Scene, State, with_state
from mpmjax.stepping import AbstractIntegrator


class SimulationError(RuntimeError):
    """A run that went wrong on the way. `run` holds what was reached, its `final` the last good state."""

    def __init__(self, message: str, run: "Run"):
        super().__init__(message)
        self.run = run


class Forces(NamedTuple):
    """Mean forces and torques on k colliders or boundaries over the steps between one saved frame and the next, of f
    frames."""

    times: Float[Array, "g"]
    """The mean of the times of the steps' forces [s], shape (f − 1,): t_n + θΔt, with θ the method's `force_at`. It is
    half way between frames with θ = ½ (`ImplicitMidpoint`, `TRBDF2`, `SemiImplicit` with β = ½), ½Δt later with θ = 1
    (`BackwardEuler`, `SemiImplicit` with β = 1), and ½Δt earlier with θ = 0 (`Explicit`)."""
    force: Float[Array, "g k d"]
    """Friction included [N], shape (f − 1, k, d)."""
    torque: Float[Array, "g k r"]
    """About the centre of the collider's rotation, or where it has none about its shape's middle, as it moves [N m],
    shape (f − 1, k, r): r = 1 in 2-D, 3 in 3-D, 0 in 1-D. Of a grip about its region's middle, of other boundaries
    about the origin of the coordinates."""


class Run(eqx.Module):
    """A simulation's outcome. A pytree: it can be returned from `jax.jit`, `jax.vmap` and differentiated."""

    scene: Scene
    """The scene, with numbers as arrays of the particles' precision."""
    method: AbstractIntegrator
    """The integrator, likewise."""
    dt: Scalar
    """Δt [s]."""
    steps: Float[Array, "*f"]
    """Step number of each saved frame, shape (f,)."""
    frames: State | None
    """The saved states, with a leading axis f; None where nothing or only observations were saved."""
    observed: Any
    """The result of `observe` for each frame, with a leading axis f."""
    final: Particles
    """The particles at the end."""
    final_step: Float[Array, ""]
    """Step number at the end."""
    statistics: RunStatistics
    """Solver and contact statistics, and the first fault."""
    report: Float[Array, "..."] | None = None
    """Zero. Its tangent in forward mode is the relative residual of the first tangent solve that did not converge, zero
    if all did. None of a run from a file."""
    collider_impulse: Impulses | None = None
    """Linear and angular impulse on the scene's colliders from the run's start to each saved frame, with a leading axis
    f; None without colliders, or where nothing was saved. The difference between two frames, over the time between
    them, is the mean force and torque of these steps (see `forces`, which says at what time)."""
    final_collider_impulse: Impulses | None = None
    """Linear and angular impulse on the colliders to the end; None without colliders."""
    boundary_impulse: Impulses | None = None
    """As `collider_impulse`, on each of the scene's boundaries (see `boundary_forces`); None unless the scene has
    `boundary_forces`, or where nothing was saved."""
    final_boundary_impulse: Impulses | None = None
    """Impulse on each of the scene's boundaries from the run's start to its end; None unless the scene has
    `boundary_forces`."""

    @property
    def times(self) -> Float[Array, "*f"]:
        """Time of each saved frame [s], shape (f,)."""
        return self.steps * self.dt

    def frame(self, i: int) -> Particles:
        """The particles at the i-th saved frame, negative from the end.

        Raises:
            ValueError: no frames were saved.
            IndexError: there is no such frame.
        """
        if self.frames is None:
            raise ValueError("This run saved no frames: pass save_every to simulate.")
        if not -len(self) <= i < len(self):
            raise IndexError(f"The run has {len(self)} frames, there is no frame {i}.")
        return with_state(self.final, jax.tree.map(lambda a: a[i], self.frames))

    def forces(self) -> Forces:
        """The mean force and torque on each collider over the steps between one saved frame and the next.

        Raises:
            ValueError: nothing was saved on the way, or the scene has no collider.
        """
        if self.collider_impulse is None:
            raise ValueError(
                "Forces need saved frames and colliders: pass save_every to simulate, a collider to Scene."
            )
        return self._mean_forces(self.collider_impulse)

    def boundary_forces(self) -> Forces:
        """The mean force and torque of the material on each of the scene's boundaries (walls, planes, grips and
        colliders, in their order) and then on the guides of each `Rigid` body that has some, over the steps between one
        saved frame and the next.

        Raises:
            ValueError: nothing was saved on the way, or the scene does not have `boundary_forces`.
        """
        if self.boundary_impulse is None:
            raise ValueError(
                "Forces on boundaries need saved frames and a scene that computes them: pass save_every to simulate, "
                "boundary_forces=True to Scene."
            )
        return self._mean_forces(self.boundary_impulse)

    def _mean_forces(self, impulses: Impulses) -> Forces:
        times, at = self.times, self.method.force_at()
        between = (times[1:] - times[:-1])[:, None, None]
        mean = jax.tree.map(lambda a: (a[1:] - a[:-1]) / between, impulses)
        late = (0.0 if at is None else at) - 0.5
        return Forces((times[1:] + times[:-1]) / 2 + late * self.dt, mean.impulse, mean.angular)

    def __len__(self) -> int:
        return 0 if self.frames is None else int(np.shape(self.steps)[0])
