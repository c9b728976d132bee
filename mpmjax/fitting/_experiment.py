"""An experiment: a scene, how it is run, and what was measured of it."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.checks import canonical, checked, is_traced, require
from mpmjax.fitting._observation import AbstractObservation
from mpmjax.simulation import Run, number_of_steps, simulate
from mpmjax.state import Particles, Scene, prepare, velocity_gradient
from mpmjax.stepping import AbstractIntegrator, Explicit


class Experiment(eqx.Module):
    """A scene as it was set up in the laboratory, and what was measured of it.

    Args:
        scene: the scene, with first guesses of what is fitted.
        particles: the particles at the start.
        t1: end time [s]: no later than the last measurement needs.
        dt: step [s].
        method: the integrator.
        observations: what was measured.
        name: what tables and pictures call it.

    Raises:
        ValueError: as `prepare`; a t1 that is not a whole number of steps; no observation, or one that does not fit the
            particles or lies outside the run.
    """

    scene: Scene
    particles: Particles
    method: AbstractIntegrator
    observations: tuple[AbstractObservation, ...]
    t1: float = eqx.field(static=True)
    dt: float = eqx.field(static=True)
    name: str = eqx.field(static=True)

    @checked
    def __init__(
        self,
        scene: Scene,
        particles: Particles,
        *,
        t1: Scalar,
        dt: Scalar,
        observations: AbstractObservation | tuple[AbstractObservation, ...] | list[AbstractObservation],
        method: AbstractIntegrator = Explicit(),
        name: str = "experiment",
    ):
        self.particles = prepare(scene, particles)
        self.scene, self.method = canonical((scene, method), particles.x.dtype)
        self.t1, self.dt, self.name = float(t1), float(dt), name
        self.observations = (observations,) if isinstance(observations, AbstractObservation) else tuple(observations)
        require(
            len(self.observations) > 0, f"The experiment {name!r} needs an observation at least: what was measured."
        )
        number_of_steps(self.t1, self.dt, 0, particles.x.dtype)
        for observation in self.observations:
            observation.check(self.scene, self.particles, self.t1)

    @property
    def dtype(self) -> Any:
        """The precision of its particles."""
        return self.particles.x.dtype

    @property
    def steps(self) -> int:
        """Number of steps."""
        return number_of_steps(self.t1, self.dt, 0, self.dtype)

    def with_observations(
        self, observations: tuple[AbstractObservation, ...], t1: float | int | None = None
    ) -> "Experiment":
        """The experiment with other observations, and to another end."""
        return Experiment(
            self.scene,
            self.particles,
            t1=self.t1 if t1 is None else t1,
            dt=self.dt,
            method=self.method,
            observations=observations,
            name=self.name,
        )

    def with_gradient_since(self, before: Particles) -> "Experiment":
        """The experiment with the velocity gradient of the change of velocities that parameters made since `before`. A
        gradient that they changed themselves stays."""
        now = self.particles
        if now.C is None or now.C is not before.C or now.v is before.v:
            return self
        change = velocity_gradient(self.scene, eqx.tree_at(lambda q: q.v, now, now.v - before.v))
        return eqx.tree_at(lambda e: e.particles.C, self, now.C + change)

    def until(self, t1: float) -> "Experiment":
        """The experiment, ended at the first step from a time [s] on, with what was measured until then; itself
        where nothing was, or the time is not before its end. What has no times, such as a `Curve`, is left out."""
        parts = [o.part_until(t1) for o in self.observations]
        kept = tuple(part for part in parts if part is not None)
        steps = int(np.ceil(t1 / self.dt - _ON_A_STEP))
        if not kept or steps >= self.steps:
            return self
        return self.with_observations(kept, steps * self.dt)

    @property
    def observed_shape(self) -> Any:
        """The shape of what its observations need of one state."""
        return jax.eval_shape(_Observe(self.observations), self.scene, self.particles)

    def run(self, *, adjoint: Any = None, throw: bool = True, checkpoint_bytes: int = 2**28) -> Run:
        """The simulation of it, with what its observations observe after each step (see `simulate`)."""
        return simulate(
            self.scene,
            self.particles,
            t1=self.t1,
            dt=self.dt,
            method=self.method,
            observe=_Observe(self.observations),
            adjoint=adjoint,
            checkpoint_bytes=checkpoint_bytes,
            throw=throw,
        )

    def predictions(self, run: Run) -> tuple[Array, ...]:
        """Predictions of a run of it by each observation, in the shape of its data."""
        return tuple(o.predict(seen, run) for o, seen in zip(self.observations, run.observed, strict=True))

    def explain(self) -> None:
        """Say why what is observed is not finite.

        Raises:
            SimulationError: the simulation met a fault.
            ValueError: an observation is beyond what the simulation reaches.
        """
        assert not is_traced(self)
        run = self.run()
        for observation, seen in zip(self.observations, run.observed, strict=True):
            observation.explain(seen, run)


class _Observe(eqx.Module):
    """Observes a state for all observations of an experiment."""

    observations: tuple[AbstractObservation, ...]

    def __call__(self, scene: Scene, particles: Particles) -> tuple[Any, ...]:
        return tuple(observation.observe(scene, particles) for observation in self.observations)


_ON_A_STEP = 1e-6
"""Part of a step by which a time may lie after it and is on it."""
