"""Warnings of scenes that are valid but probably not meant, when particles are first prepared for one and after a run.

Only what is certain is warned of: a grip or collider that can never touch a node with mass is, one that the body may
still reach is not.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, ParticleVector
from mpmjax.boundary import ON_THE_WALL, AbstractBoundary
from mpmjax.checks import warn
from mpmjax.discretisation import BSpline, Grid, MLSGradient
from mpmjax.material import AbstractLaw
from mpmjax.state._particles import Particles
from mpmjax.state._scene import Scene

Boundaries = tuple[AbstractBoundary, ...]

_CROWDED = 1.25  # how many times the space that there is particles may take
_MOST_BEYOND = 0.035
"""Part of all volume that may lie beyond that after a run: in a heap of sand it is up to 0.02; in water after a splash
0.005 with 3 x 3 particles a cell, 0.04 with 2 x 2, which lose a tenth of its level and more."""
_MOST_CELLS = 10**7  # cells up to which it is looked for
_THIN = 2.0  # a body thinner than so many cells is not resolved
_MOST_ROUNDING = 2.0**-12
"""Rounding of positions, in spacings, up to which it is not warned of: some 2 000 cells from zero in float32."""
_CONTRAST = 100  # ratio of moduli within a cell from which it is warned of
_NEAR_KNOTS = 0.16  # distances to nodes or middles between them, of two directions together, in spacings


def warn_of_setup(scene: Scene, particles: Particles) -> None:
    """Warn of walls and colliders that lie over the body, of grips and colliders that touch nothing, of thin
    bodies; the floats of the scene are arrays."""
    boundary, total = scene.boundary, scene.total
    grid = jax.tree.map(np.asarray, scene.grid.with_layers(1))  # all bodies' nodes coincide
    there = np.flatnonzero(np.asarray(particles.mass) > 0)
    if not there.size:
        return
    x, volume = (np.asarray(a)[there] for a in (particles.x, particles.volume))
    resting = tuple(c.rests(total=total) and not grid.follow for c in boundary)
    places = jnp.asarray(x, x.dtype)  # without a dtype JAX compiles a program
    inputs = boundary, grid, places, jnp.asarray(volume, x.dtype), resting, total
    some = jax.tree.leaves(eqx.filter_eval_shape(_probe, *inputs))  # none, and no compiling, of walls
    within, touched = eqx.filter_jit(_probe)(*inputs) if some else ([None] * len(boundary),) * 2
    for number, (condition, inside, mask) in enumerate(zip(boundary, within, touched, strict=True), 1):
        name = f"{type(condition).__name__} (boundary {number})"
        if inside is None:
            nearest = _nearest(condition, grid, volume)
            beyond = [w.inward * (x[:, w.axis] - np.asarray(w.position)) < nearest for w in condition.walls()]
            inside = np.any(beyond, axis=0).sum()
        if inside:
            why = ": nodes there do not move freely. Move one of them; to hold a body on purpose take a Grip."
            if condition.pushes:
                why = ", or nearer to it than a quarter of their width: it pushes their faces away, half a width"
                why += " before their centres. Move one of them."
            warn(f"{inside} of {len(x)} particles lie in or beyond the {name} at the start{why}")
        may_meet = not total and condition.is_collider  # material comes to it: any node will do
        if mask is None:
            if not grid.follow and _stays_outside(condition, grid):
                warn(f"The {name} touches nothing, since it never comes into the grid's window: move it or the grid.")
        elif not np.asarray(mask)[slice(None) if may_meet else _in_stencils(scene.kernel, grid, places)].any():
            where = "of the window lies in it" if may_meet else "that a particle reaches lies in it"
            warn(f"The {name} touches nothing, since no node {where}: move it, or enlarge it to a spacing or more.")
    width = 2 * max(float(grid.spacing), float(volume.max()) ** (1 / grid.dim))
    for filled in _filled(x, volume.astype(float), width):
        if filled[0].max() >= _CROWDED:
            warn(
                f"Near {filled[1]} m particles take {filled[0].max():.2g} times the space that there is: where two "
                "sets fill the same place there is twice the mass. Leave one of them out there."
            )
            break
    has_knots = grid.dim > 1 and scene.kernel.order == 2 and isinstance(scene.gradient, MLSGradient)
    for number, (law, group) in enumerate(zip(scene.laws, particles.groups, strict=True), 1):
        rows = slice(*np.searchsorted(there, (group.rows.start, group.rows.stop)))
        which = "The body" if particles.counts is None else f"The body of material {number}"
        if rows.start < rows.stop:
            _warn_of_thinness(which, boundary, grid, x[rows], volume[rows, None] ** (1 / grid.dim) / 2)
            if has_knots and not law.measure.axes and law.viscosity is None:
                _warn_of_knots(x[rows] / np.asarray(grid.spacing))
    if not (total and scene.kernel.order == 1):
        _warn_of_contrast(scene, particles, there)
    warn_of_rounding(grid, particles.x)


def _stays_outside(condition: AbstractBoundary, grid: Grid) -> bool:
    """Whether its body, or each of its walls, is outside of a window that rests at all times; moving walls may come."""
    first, free = (np.asarray(grid.origin) - 1) * grid.spacing, np.asarray(grid.periodic)
    last = first + (np.asarray(grid.shape) + 1) * grid.spacing
    if (reach := condition.reach()) is not None:
        return bool((((reach[1] < first) | (reach[0] > last)) & ~free).any())
    beside = [not free[w.axis] and not first[w.axis] <= w.position <= last[w.axis] for w in condition.walls()]
    return bool(beside) and all(beside) and getattr(condition, "motion", None) is None


def _in_stencils(kernel: BSpline, grid: Grid, places: Array) -> Bool[np.ndarray, "n"]:
    """The nodes in the stencils of particles."""
    first_nodes, reached = np.asarray(_base(kernel, grid, places)), np.zeros(grid.shape, dtype=bool)
    for offset in itertools.product(range(kernel.order + 1), repeat=grid.dim):
        reached[tuple(((first_nodes + offset) % grid.shape).T)] = True
    return reached.reshape(-1)


def _warn_of_thinness(which: str, boundary: Boundaries, grid: Grid, x: np.ndarray, half: np.ndarray) -> None:
    """Warn of a body of few cells across, but for directions in which a wall or plane lies beside it."""
    dx, lower, upper = float(grid.spacing), (x - half).min(axis=0), (x + half).max(axis=0)
    for axis in np.flatnonzero(~np.asarray(grid.periodic)):
        thickness = (upper[axis] - lower[axis]) / dx
        walls = (wall for condition in boundary for wall in condition.walls() if wall.axis == axis)
        beside = any(lower[axis] - dx <= wall.position <= upper[axis] + dx for wall in walls)
        if thickness < _THIN - 1e-3 and not beside:
            warn(
                f"{which} is {thickness:.2g} cells thick in direction {axis}, and below {_THIN:g} its stiffness is the "
                "grid's: take a smaller spacing."
            )


def _warn_of_knots(places: np.ndarray) -> None:
    """Warn of an inviscid fluid at places [spacings] at which sums of moving least squares leave a force of a uniform
    pressure (see docs/notes/figures.md, "Water at rest")."""
    off = np.sort(np.abs(2 * places - np.rint(2 * places)) / 2, axis=1)[:, :2].sum(axis=1)
    if (off < _NEAR_KNOTS).mean() > 0.6:
        warn(
            "Particles of a fluid stand near nodes and the middles between them, where its pressure stirs it at rest, "
            "within seconds: give the scene gradient=SplineGradient(), or fill with three or four particles along a "
            "cell."
        )


def _warn_of_contrast(scene: Scene, particles: Particles, there: np.ndarray) -> None:
    """Warn where solids that share nodes have very different moduli within a cell."""
    if len(scene.laws) == 1 and all(jnp.ndim(leaf) == 0 for leaf in jax.tree.leaves(scene.material)):
        return
    modulus, dx = np.concatenate(_moduli(scene.laws, particles)), float(scene.grid.spacing)
    there = there[modulus[there] > 0]
    modulus = modulus[there]
    if not there.size or modulus.max() <= _CONTRAST * modulus.min():
        return
    layer = np.repeat(scene.layers, particles.sizes)[there]
    cell = np.floor(np.asarray(particles.x, float)[there] / dx).astype(np.int64)
    corners = [np.c_[cell + corner, layer] for corner in itertools.product((0, 1), repeat=scene.grid.dim)]
    nodes, at = np.unique(np.concatenate(corners), axis=0, return_inverse=True)
    most, least = np.zeros(len(nodes)), np.full(len(nodes), np.inf)
    for extreme, each in ((np.maximum, most), (np.minimum, least)):
        extreme.at(each, at.ravel(), np.tile(modulus, len(corners)))
    ratio, first = most / least, int((most / least).argmax())
    if ratio[first] > _CONTRAST:
        which = "BSpline(1) with it on nodes" if scene.total else "Bodies, if they press on each other"
        warn(
            f"Near {nodes[first, :-1] * dx} m moduli differ {ratio[first]:.2g} times within a cell. Beside such an "
            "interface the soft material is held over up to three quarters of a cell, and stresses of single particles "
            f"are up to ten times too large: take {which}, or a finer grid."
        )


@eqx.filter_jit
def _moduli(laws: tuple[AbstractLaw, ...], particles: Particles) -> list[Float[Array, "q"]]:
    """The wave moduli at rest of each material's particles [Pa]; zero of what flows or is rigid."""
    moduli = []
    for law, group in zip(laws, particles.groups, strict=True):
        solid = float(not law.flows and law.constraint is None)
        moduli.append(solid * law.contact_modulus(group.deformation(), group.history))
    return moduli


def warn_of_rounding(grid: Grid, x: ParticleVector, before: ParticleVector | None = None) -> None:
    """Warn of positions x [m] so far from zero that their rounding is no longer small beside the spacing, unless those
    examined `before` were as far off."""

    def rounding(x: ParticleVector) -> float:
        return float(jnp.finfo(x.dtype).eps) * float(np.abs(np.asarray(x)).max()) / float(grid.spacing)

    error = rounding(x)
    if error > _MOST_ROUNDING and (before is None or rounding(before) <= _MOST_ROUNDING):
        warn(
            f"{x.dtype} rounds positions {float(np.abs(np.asarray(x)).max()):.4g} m from zero to {error:.2g} spacings, "
            "and each step adds as much: move the scene nearer to zero, or take float64 particles."
        )


def warn_of_crowding(scene: Scene, particles: Particles) -> None:
    """Warn of particles that take much more space than there is, after a run in the updated description. A law sees the
    volume of each particle by itself, and not that they crowd."""
    undeformed = np.asarray(scene.grid.section(particles.x, particles.volume), float)
    volume = undeformed * np.concatenate(_ratios(scene.laws, particles))
    if not undeformed.any():
        return
    side = float(undeformed.max()) ** (1 / particles.dim)
    for filled in _filled(np.asarray(particles.x), volume, max(float(scene.grid.spacing), 2 * side)):
        beyond = np.maximum(filled[0] - _CROWDED, 0).sum() / filled[0].sum()
        if beyond > _MOST_BEYOND:
            warn(
                f"At the end particles take up to {filled[0].max():.2g} times the space that there is, most near "
                f"{filled[1]} m, and {100 * beyond:.2g} % of their volume is too much where it lies: levels and "
                "pressures are wrong. Take three particles along a cell, a shorter step, for a fluid "
                "correction=extensions.DensityCorrection(room), and around it a SeparatingBox or ContactPlanes."
            )
            return


@eqx.filter_jit
def _base(kernel: BSpline, grid: Grid, x: ParticleVector) -> Int[Array, "p d"]:
    """The first node of each particle's stencil, counted from the window's."""
    return kernel.base(x / grid.spacing).astype(jnp.int32) - grid.window(x)


@eqx.filter_jit
def _ratios(laws: tuple[AbstractLaw, ...], particles: Particles) -> list[Float[Array, "q"]]:
    """The volume that the particles of each material take, over the undeformed one."""
    groups = zip(laws, particles.groups, strict=True)
    return [law.compaction(group.history) * group.volume_ratio() for law, group in groups]


def _probe(
    boundary: Boundaries, grid: Grid, x: ParticleVector, volume: Array, resting: tuple[bool, ...], total: bool
) -> tuple[list[Int[Array, ""] | None], list[Bool[Array, "n"] | None]]:
    """How many particles lie in each body at the start, in the updated description; and on which nodes each boundary
    acts that rests."""
    t, dt, nodes = jnp.zeros((), x.dtype), jnp.ones((), x.dtype), grid.nodes(grid.window(x)).astype(x.dtype)

    def covered(body: AbstractBoundary) -> Int[Array, ""] | None:
        distance = None if total else body.distance(x, t)
        return None if distance is None else (distance < _nearest(body, grid, volume)).sum()

    def touched(body: AbstractBoundary) -> Bool[Array, "n"]:
        distance = body.distance(nodes, t) if body.pushes else None
        if distance is not None:
            return distance <= grid.spacing
        return body.conditions(nodes, grid.spacing, t, dt, reference=total).touched

    return [covered(b) for b in boundary], [touched(b) if r else None for b, r in zip(boundary, resting, strict=True)]


def _nearest(boundary: AbstractBoundary, grid: Grid, volume: Any) -> Any:
    """How near particles may start to what holds or pushes them [m], (p,): to what pushes their faces, a quarter of
    their width."""
    return volume ** (1 / grid.dim) / 4 if boundary.pushes else 0 * volume - ON_THE_WALL * grid.spacing


def _filled(x: np.ndarray, volume: np.ndarray, width: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """How many times its space each node of a lattice of spacing `width` [m] holds, by linear weights, which those of
    one body fill to a tenth, and where the fullest is [m]: of two lattices, as a layer between two rows of nodes shows
    less; of none where that is too much to look for."""
    for offset in (0.0, 0.5):
        scaled = np.asarray(x, float) / width + offset
        d, index = scaled.shape[1], np.floor(scaled).astype(np.int64)
        first, share = index.min(axis=0), scaled - index
        index = index - first
        shape = index.max(axis=0) + 2
        if shape.prod() > _MOST_CELLS:
            return
        share_filled = np.zeros(shape.prod())
        for corner in itertools.product((0, 1), repeat=d):
            weight = np.where(corner, share, 1 - share).prod(axis=1)
            node = np.ravel_multi_index(tuple((index + corner).T), shape)
            share_filled += np.bincount(node, weight * volume, share_filled.size)
        fullest = np.asarray(np.unravel_index(int(share_filled.argmax()), shape))
        yield share_filled / width**d, (fullest + first - offset) * width
