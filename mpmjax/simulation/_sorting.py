"""Particles sorted by cell on the way, where motion mixes them.

Particles that share nodes then lie beside each other in memory, and sums over nodes find these in the cache. What is
returned, saved or observed has the order in which the particles were given.
"""

import os
from dataclasses import replace
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import unvmap_any

from mpmjax._types import Array, Bool, Float, Int, ParticleVector, Scalar, components, particle_first
from mpmjax.autodiff import custom_derivative
from mpmjax.discretisation import BSpline, Grid, basis_of, locate
from mpmjax.native import backend
from mpmjax.state import AttachedPoints, Particles, Scene, State, is_foreign

Order = Int[Array, "p"]  # the number of the particle that comes first, second, ..
VARIABLE = "MPMJAX_ORDER"
LEAST = 16_384  # fewer particles stay as they were given: they fit into the cache in any order
STEPS = 50  # steps between two sorts
FEWEST = 10  # in runs of fewer steps, in all or between two frames, particles stay as they were given
MIXED = 0.25
"""Particles are sorted if more than this share of them are in another cell than the one before and the next one."""


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
        return _whole(self.numbers[0])

    def undone(self, state: State) -> State:
        """A state in this order, brought into that in which the particles were given."""
        return _in_order(jnp.asarray(True), _places(self.number), state)

    def put_into(self, scene: Scene, particles: Particles) -> tuple[Scene, Particles]:
        """The scene and the particles with what they know of particles one by one in this order."""
        particles = replace(particles, mass=self.numbers[1], volume=self.numbers[2])
        laws = tuple(eqx.combine(values, law) for values, law in zip(self.parameters, scene.laws, strict=True))
        scene = eqx.tree_at(lambda s: s.material, scene, laws if isinstance(scene.material, tuple) else laws[0])
        if self.attached:
            scene = eqx.tree_at(lambda s: tuple(load.on.particle for load in s.loads), scene, self.attached)
        return scene, particles


def memory_order(scene: Scene, particles: Particles, steps: int) -> MemoryOrder | None:
    """The order in which prepared particles were given, which `resorted` will change; None if they stay in it.

    Particles are sorted in the updated description, with native sums, if a law yields or flows: bodies that only deform
    keep their order. So does a scene with a body force, which may know particles by their numbers, and all with the
    environment variable MPMJAX_ORDER=given, read when a program is compiled. `steps` are those of the run, or between
    two saved frames."""
    asked = os.environ.get(VARIABLE, "")
    if asked not in ("", "given"):
        raise ValueError(f"{VARIABLE} must be given, or not be set, got {asked!r}.")
    mixes = not scene.total and any(not law.allows_total for law in scene.laws)
    countable = LEAST <= particles.count <= 2 ** (jnp.finfo(particles.x.dtype).nmant + 1)
    if asked or not mixes or not countable or scene.body_force is not None or steps < FEWEST:
        return None
    if not backend().gains_from_order:
        return None

    parameters = []
    for law, n in zip(scene.laws, particles.sizes, strict=True):
        chosen = jax.tree.map(lambda a, n=n: eqx.is_array(a) and a.shape == (n,), law, is_leaf=is_foreign)
        parameters.append(eqx.filter(law, chosen))
    number = jnp.arange(particles.count, dtype=particles.x.dtype)
    numbers = jnp.stack([number, particles.mass, particles.volume])
    return MemoryOrder(numbers, tuple(parameters), _attached(scene))


def resorted(
    order: MemoryOrder,
    scene: Scene,
    particles: Particles,
    state: State,
    t: Scalar,
    step: Float[Array, ""],
    save_every: int | None,
) -> tuple[State, MemoryOrder]:
    """The state and its order before a step, `step` of them since the run began; scene and particles are as given. They
    change where a frame was just saved, and every `STEPS` steps from there. So a run that goes on from a frame has the
    same order, and the same bits, as the one that saved it."""
    due = (step if save_every is None else step % save_every) % STEPS == 0

    def by_cells() -> tuple[Order, tuple[Array, ...]]:
        place = _places(order.number)
        original = replace(particles, x=jax.lax.stop_gradient(state.x)[place])
        cells = cells_of(scene.kernel, scene.grid, scene.window(original), scene.on_grid(original, t))
        numbers = []
        for group in particles.groups:  # by cell if many are far from their neighbours
            part = cells[group.rows]
            mixed = (jnp.abs(part[1:] - part[:-1]) > 1).mean() > MIXED
            by_number = jnp.arange(part.size, dtype=part.dtype)
            numbers.append(group.rows.start + jnp.where(mixed, by_cell(part), by_number))
        number = jnp.concatenate(numbers)
        new = _places(number)
        return place[number], tuple(new[_whole(rows)].astype(rows.dtype) for rows in _attached(scene))

    def same() -> tuple[Order, tuple[Array, ...]]:
        return jnp.zeros(particles.count, jnp.int32), order.attached

    # of the members of a batch, which may end at different times, all take the branch that any of them needs
    whole, attached = jax.lax.cond(unvmap_any(due), by_cells, same)
    groups = zip(state.groups, order.parameters, strict=True)
    parameters = (_moved(due, whole[rows] - rows.start, values) for (rows, *_), values in groups)
    changed = MemoryOrder(rearranged(due, whole, order.numbers.T).T, tuple(parameters), attached)
    return _in_order(due, whole, state), changed


def _in_order(wanted: Bool[Array, ""], order: Order, state: State) -> State:
    """A state with the particles of each material in another order, where that is wanted."""
    groups = [_moved(wanted, order[rows] - rows.start, (F, history)) for rows, F, history in state.groups]
    deformations, histories = zip(*groups, strict=True)
    x, v, C = _moved(wanted, order, (state.x, state.v, state.C))
    return State(x, v, C, deformations, histories)


def _moved(wanted: Bool[Array, ""], order: Order, tree: Any) -> Any:
    return jax.tree.map(lambda a: rearranged(wanted, order, a), tree)


def _attached(scene: Scene) -> tuple[Float[Array, "..."], ...]:
    """The numbers of the particles that the points of each load are attached to."""
    return tuple(jnp.asarray(load.on.particle) for load in scene.loads if isinstance(load.on, AttachedPoints))


def _whole(numbers: Float[Array, "..."]) -> Array:
    """Numbers of particles that are stored as floats, as integers. No derivative passes."""
    return jax.lax.stop_gradient(numbers).astype(jnp.int32)


def _places(order: Order) -> Order:
    """The place of each particle in an order: the inverse permutation."""
    return jnp.zeros_like(order).at[order].set(jnp.arange(order.size, dtype=order.dtype), unique_indices=True)


def cells_of(kernel: BSpline, grid: Grid, window: Int[Array, "d"], x: ParticleVector) -> Int[Array, "p"]:
    """The C-order index of the first node of each particle's stencil, shape (p,): particles with the same one share all
    nodes. Without meaning outside of the window."""
    basis = basis_of(kernel, grid)
    xi, _ = locate(basis, window, components(x) / grid.spacing)
    return basis.index_terms(xi)[:, 0].sum(axis=0, dtype=jnp.int32)


@partial(custom_derivative, kernel="order")
def by_cell(cells: Int[Array, "p"]) -> Order:
    """The numbers of the particles cell after cell, and in a cell in their order, shape (p,)."""
    return jnp.argsort(cells, stable=True).astype(cells.dtype)


def rearranged(wanted: Bool[Array, ""], order: Order, a: Float[Array, "p ..."]) -> Float[Array, "p ..."]:
    """An array in another order, a[order], where that is wanted, else as it is.

    On CPUs this is done in place, so that in a loop what is not wanted costs nothing; of a `jax.lax.cond` XLA copies
    what either branch returns. It is done component by component, as a step has its arrays: XLA would transpose them.
    """
    rows = components(a).reshape(-1, len(a))
    moved = _rearrange(wanted, order, rows, inverse=False)
    return particle_first(moved.reshape(*a.shape[1:], len(a)))


@partial(custom_derivative, kernel="rearrange", aliases={2: 0})
def _rearrange(wanted: Array, order: Array, rows: Array, *, inverse: bool) -> Array:
    moved = rows.at[:, order].set(rows, mode="drop") if inverse else rows.at[:, order].get(mode="clip")
    return jnp.where(wanted, moved, rows)


@_rearrange.defjvp
def _(primals: tuple, tangents: tuple, *, inverse: bool) -> tuple[Array, Any]:
    """By the rows, in which it is linear."""
    change = tangents[2] if tangents[2] is None else _rearrange(*primals[:2], tangents[2], inverse=inverse)
    return _rearrange(*primals, inverse=inverse), change


@_rearrange.deftranspose
def _(cotangent: Array, args: tuple, *, inverse: bool) -> tuple:
    """The other order."""
    return None, None, _rearrange(*args[:2], cotangent, inverse=not inverse)
