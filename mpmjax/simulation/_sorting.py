"""Particles sorted by cell on the way, where motion mixes them.

Particles that share nodes then lie beside each other in memory, and sums over nodes find these in the cache. What is
returned, saved or observed has the order in which the particles were given.
"""

import os
from dataclasses import replace

import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any

from mpmjax._types import Array, Bool, Float, Int, Scalar
from mpmjax.discretisation import Order, by_cell, cells_of
from mpmjax.native import is_native
from mpmjax.state import (
    MemoryOrder,
    Particles,
    Scene,
    State,
    attached_particles,
    given_order,
    places,
    rearrangement,
    whole_numbers,
)

VARIABLE = "MPMJAX_ORDER"
LEAST = 16_384
"""Fewer particles stay as they were given: they fit into the cache in any order."""
STEPS = 50
"""Steps between two sorts."""
FEWEST = 10
"""In runs of fewer steps, in all or between two frames, particles stay as they were given."""
MIXED = 0.25
"""Particles are sorted if more than this share of them are in another cell than the one before and the next one."""


def memory_order(scene: Scene, particles: Particles, steps: int) -> MemoryOrder | None:
    """The order in which prepared particles were given, which `resorted` will change; None if they stay in it.

    Particles are sorted in the updated description, with native sums, if a law yields or flows: bodies that only deform
    keep their order. A body force may know particles by their numbers, so with one they stay as they are. With the
    environment variable MPMJAX_ORDER=given they always do; it is read when a program is compiled.

    Args:
        scene: the scene.
        particles: its prepared particles.
        steps: the number of steps of the run, or between two saved frames.

    Raises:
        ValueError: the variable has another value.
    """
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "given"):
        raise ValueError(f"{VARIABLE} must be given, or not be set, got {asked!r}.")
    mixes = not scene.total and any(not law.allows_total for law in scene.laws)
    countable = LEAST <= particles.count <= 2 ** (jnp.finfo(particles.x.dtype).nmant + 1)
    if asked or not mixes or not countable or scene.body_force is not None or steps < FEWEST or not is_native():
        return None
    return given_order(scene, particles)


def resorted(
    order: MemoryOrder,
    scene: Scene,
    particles: Particles,
    state: State,
    t: Scalar,
    step: Float[Array, ""],
    save_every: int | None,
) -> tuple[State, MemoryOrder]:
    """The state and its order before a step. They change where a frame was just saved, and every `STEPS` steps from
    there. So a run that goes on from a frame has the same order, and the same bits, as the one that saved it.

    Args:
        order: the order of the state.
        scene: the scene, as given.
        particles: the particles, as given.
        state: the state.
        t: time [s].
        step: number of steps since the run began.
        save_every: number of steps between frames; None if none is saved.
    """
    due = (step if save_every is None else step % save_every) % STEPS == 0
    attached = attached_particles(scene)

    def found() -> tuple[Order, tuple[Array, ...]]:
        place = places(order.number)
        original = replace(particles, x=jax.lax.stop_gradient(state.x)[place])
        cells = cells_of(scene.kernel, scene.grid, scene.window(original), scene.on_grid(original, t))
        number = jnp.concatenate([_sorted_if_mixed(cells, group.rows) for group in particles.groups])
        new = places(number)
        return place[number], tuple(new[whole_numbers(rows)].astype(rows.dtype) for rows in attached)

    def same() -> tuple[Order, tuple[Array, ...]]:
        return jnp.zeros(particles.count, jnp.int32), order.attached

    # of the members of a batch, which may end at different times, all take the branch that any of them needs
    whole, attached = jax.lax.cond(unvmap_any(due), found, same)
    change = rearrangement(whole, particles.sizes, due)
    return change.of_state(state), order.changed(change, attached)


def _sorted_if_mixed(cells: Int[Array, "p"], rows: tuple[int, int]) -> Int[Array, "q"]:
    """The numbers of one material's particles, by cell if they are mixed."""
    among = cells[slice(*rows)]
    return rows[0] + jnp.where(is_mixed(among), by_cell(among), jnp.arange(among.size, dtype=among.dtype))


def is_mixed(cells: Int[Array, "q"]) -> Bool[Array, ""]:
    """Whether particles in these cells are far from an order by cell."""
    return (jnp.abs(cells[1:] - cells[:-1]) > 1).mean() > MIXED
