"""Particles in another order in memory, with all that is known of them one by one."""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int
from mpmjax.discretisation import Order, rearranged
from mpmjax.material import AbstractLaw
from mpmjax.state._attachment import AttachedPoints
from mpmjax.state._particles import Particles, State, by_material
from mpmjax.state._scene import Scene


class Rearrangement(eqx.Module):
    """Another order of particles, in which those of a material stay among themselves."""

    whole: Order
    """The number of the particle that comes first, second, ..., shape (p,)."""
    within: tuple[Int[Array, "..."], ...]
    """The order within each material, by numbers among its particles, shape (q,)."""
    wanted: Bool[Array, ""]
    """If False, everything stays where it is."""

    def __call__(self, a: Array) -> Array:
        """An array over all particles, shape (p, ...), in this order."""
        return rearranged(self.wanted, self.whole, a)

    def of_material(self, number: int, tree: Any) -> Any:
        """Arrays over the particles of one material, shape (q, ...), in this order."""
        return jax.tree.map(lambda a: rearranged(self.wanted, self.within[number], a), tree)

    def of_state(self, state: State) -> State:
        """A state in this order."""
        sorted_groups = [self.of_material(k, (F, history)) for k, (_, F, history) in enumerate(by_material(state))]
        deformations, histories = zip(*sorted_groups, strict=True)
        # transposed, as a rollout's loop has it in memory
        C = None if state.C is None else jnp.swapaxes(self(jnp.swapaxes(state.C, 1, 2)), 1, 2)
        return replace(state, x=self(state.x), v=self(state.v), C=C, deformations=deformations, histories=histories)


def rearrangement(whole: Order, sizes: tuple[int, ...], wanted: Bool[Array, ""]) -> Rearrangement:
    """The order of particles, so many of each material."""
    within, first = [], 0
    for size in sizes:
        within.append(whole[first : first + size] - first)
        first += size
    return Rearrangement(whole, tuple(within), wanted)


def places(order: Order) -> Order:
    """Where each particle is in an order: the inverse permutation."""
    return jnp.zeros_like(order).at[order].set(jnp.arange(order.size, dtype=order.dtype), unique_indices=True)


class MemoryOrder(eqx.Module):
    """The order of a rollout's particles in memory, and in that order what does not evolve of them."""

    numbers: Float[Array, "3 p"]
    """Rows: original index, mass [kg], undeformed volume [m^d]. One array, which a loop carries at the cost of
    one; floats, as all of a rollout's state."""
    parameters: tuple[Any, ...]
    """The parameters of each law that have one number a particle, in the law's structure, with None for the others."""
    attached: tuple[Float[Array, "..."], ...]
    """The places of the particles that the points of each load are attached to."""

    @property
    def number(self) -> Order:
        """The number of each particle in the order in which they were given."""
        return whole_numbers(self.numbers[0])

    def changed(self, change: Rearrangement, attached: tuple[Float[Array, "..."], ...]) -> "MemoryOrder":
        """Another order, in which loads are attached to the particles at these places."""
        parameters = (change.of_material(k, values) for k, values in enumerate(self.parameters))
        return MemoryOrder(change(self.numbers.T).T, tuple(parameters), attached)

    def undone(self, state: State) -> State:
        """A state in this order, brought into that in which the particles were given."""
        sizes = tuple(rows.stop - rows.start for rows, _, _ in by_material(state))
        return rearrangement(places(self.number), sizes, jnp.asarray(True)).of_state(state)

    def put_into(self, scene: Scene, particles: Particles) -> tuple[Scene, Particles]:
        """The scene and the particles with what they know of particles one by one in this order."""
        particles = replace(particles, mass=self.numbers[1], volume=self.numbers[2])
        laws = tuple(eqx.combine(values, law) for values, law in zip(self.parameters, scene.laws, strict=True))
        scene = eqx.tree_at(lambda s: s.material, scene, laws if isinstance(scene.material, tuple) else laws[0])
        if not self.attached:
            return scene, particles
        return eqx.tree_at(lambda s: tuple(load.on.particle for load in s.loads), scene, self.attached), particles


def given_order(scene: Scene, particles: Particles) -> MemoryOrder:
    """The order in which prepared particles were given, of a scene whose floats are arrays and whose loads are
    attached."""
    parameters = (eqx.filter(law, _one_a_particle(law, n)) for law, n in zip(scene.laws, particles.sizes, strict=True))
    number = jnp.arange(particles.count, dtype=particles.x.dtype)
    numbers = jnp.stack([number, particles.mass, particles.volume])
    return MemoryOrder(numbers, tuple(parameters), attached_particles(scene))


def attached_particles(scene: Scene) -> tuple[Float[Array, "..."], ...]:
    """The numbers of the particles that the points of each load are attached to."""
    return tuple(jnp.asarray(load.on.particle) for load in scene.loads if isinstance(load.on, AttachedPoints))


def whole_numbers(numbers: Float[Array, "..."]) -> Array:
    """Numbers of particles that are stored as floats, as integers. No derivative passes."""
    return jax.lax.stop_gradient(numbers).astype(jnp.int32)


def _one_a_particle(law: AbstractLaw, size: int) -> Any:
    """Which leaves of a law are parameters with one number for each of so many particles, as a tree of booleans."""
    return jax.tree.map(lambda node: eqx.is_array(node) and node.shape == (size,), law, is_leaf=is_foreign)


def is_foreign(node: Any) -> bool:
    """Whether a part of a law is a module of another kind, such as a network, whose numbers are its own."""
    return isinstance(node, eqx.Module) and not isinstance(node, AbstractLaw)
