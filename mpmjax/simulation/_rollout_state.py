"""The part of a rollout that evolves."""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import components, particle_first
from mpmjax.boundary import Impulses, no_impulses
from mpmjax.state import MemoryOrder, Particles, Scene, State, state_of
from mpmjax.stepping import StepInfo


class RolloutState(eqx.Module):
    """The part of a rollout that evolves: the particles' state, and what colliders and boundaries have received."""

    particles: State
    collider_impulse: Impulses | None
    """Linear and angular impulse on the scene's colliders since the rollout began; None without colliders."""
    boundary_impulse: Impulses | None = None
    """Linear and angular impulse on the scene's boundaries; None unless the scene has `boundary_forces`."""
    order: MemoryOrder | None = None
    """The order of the particles in memory; None if it is that in which they were given."""

    def carried(self) -> "RolloutState":
        """The state in the layout of the loop over steps: component first, as a step has its arrays, and C with the
        direction of the derivative before the component, as a gather has it. XLA would else transpose all of them in
        each step."""
        return replace(self, particles=_with_transposed_affine(jax.tree.map(components, self.particles)))

    def uncarried(self, hold: Callable[[State], State] = lambda state: state) -> "RolloutState":
        """The state from the layout of the loop over steps.

        Args:
            hold: what is done to the arrays as they are carried. Default: nothing.
        """
        state = _with_transposed_affine(hold(self.particles))
        return replace(self, particles=jax.tree.map(particle_first, state))

    def as_given(self) -> "RolloutState":
        """A carried state, particle first again and in the order in which the particles were given."""
        state = self.uncarried()
        return state if self.order is None else replace(state, particles=self.order.undone(state.particles), order=None)

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
    colliders = no_impulses(scene.collider_count, *of) if scene.collider_count else None
    boundaries = no_impulses(len(scene.boundary) + len(scene.guides), *of) if scene.boundary_forces else None
    return RolloutState(state_of(particles), colliders, boundaries)


def _with_transposed_affine(state: State) -> State:
    """A component-first state with C transposed."""
    return state if state.C is None else eqx.tree_at(lambda s: s.C, state, jnp.swapaxes(state.C, 0, 1))
