"""The part of a rollout that evolves."""

from dataclasses import replace

import equinox as eqx

from mpmjax.boundary import ColliderImpulse, no_impulse
from mpmjax.state import Particles, Scene, State, state_of
from mpmjax.stepping import StepInfo


class RolloutState(eqx.Module):
    """The part of a rollout that evolves: the state of the particles, and what the colliders have received."""

    particles: State
    collider_impulse: ColliderImpulse | None
    """Linear and angular impulse on the scene's colliders since the rollout began; None without colliders."""

    def after(self, particles: Particles, info: StepInfo) -> "RolloutState":
        """The state after a step, from the particles after it and what it reports."""
        new = replace(self, particles=state_of(particles))
        if self.collider_impulse is None or info.colliders is None:
            return new
        return replace(new, collider_impulse=self.collider_impulse.plus(info.colliders))


def initial_state(scene: Scene, particles: Particles) -> RolloutState:
    """The state in which a rollout of prepared particles begins."""
    impulse = no_impulse(scene.collider_count, particles.dim, particles.x.dtype) if scene.collider_count else None
    return RolloutState(state_of(particles), impulse)
