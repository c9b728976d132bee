"""The part of a rollout that evolves."""

from dataclasses import replace

import equinox as eqx

from mpmjax.boundary import BoundaryImpulse, ColliderImpulse, no_boundary_impulse, no_impulse
from mpmjax.state import Particles, Scene, State, state_of
from mpmjax.stepping import StepInfo


class RolloutState(eqx.Module):
    """The part of a rollout that evolves: the particles' state, and what colliders and boundaries have received."""

    particles: State
    collider_impulse: ColliderImpulse | None
    """Linear and angular impulse on the scene's colliders since the rollout began; None without colliders."""
    boundary_impulse: BoundaryImpulse | None = None
    """The same of each of its boundaries; None unless the scene has `boundary_forces`."""

    def after(self, particles: Particles, info: StepInfo) -> "RolloutState":
        """The state after a step, from the particles after it and what it reports."""
        new = replace(self, particles=state_of(particles))
        if self.collider_impulse is not None and info.colliders is not None:
            new = replace(new, collider_impulse=self.collider_impulse.plus(info.colliders))
        if self.boundary_impulse is not None and info.boundaries is not None:
            new = replace(new, boundary_impulse=self.boundary_impulse.plus(info.boundaries))
        return new


def initial_state(scene: Scene, particles: Particles) -> RolloutState:
    """The state in which a rollout of prepared particles begins."""
    of = particles.dim, particles.x.dtype
    colliders = no_impulse(scene.collider_count, *of) if scene.collider_count else None
    boundaries = no_boundary_impulse(len(scene.boundary) + len(scene.guides), *of) if scene.boundary_forces else None
    return RolloutState(state_of(particles), colliders, boundaries)
