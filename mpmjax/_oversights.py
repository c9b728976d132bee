"""What is no error, and most likely not what was meant: said in a warning where scene and particles first meet.

Only what is certain is said. A collider that is met later is none of it; a grip or collider that can never touch a node
that carries mass is.
"""

import itertools
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._boundary import ON_THE_WALL, AbstractBoundary, Grip, SeparatingBox, SlipBox, StickyBox
from mpmjax._checks import warn
from mpmjax._collider import AbstractCollider
from mpmjax._grid import Grid
from mpmjax._kernel import BSpline
from mpmjax._mirror import Plane
from mpmjax._motion import AbstractMotion, Motion, RigidMotion
from mpmjax._particles import Particles
from mpmjax._types import Array, Bool, Float, NodeVector, ParticleVector, Scalar

_THIN = 2.0
"""Cells below which a body's thickness is not resolved."""
Boundaries = tuple[AbstractBoundary, ...]


def warn_of_oversights(grid: Grid, kernel: BSpline, boundary: Boundaries, particles: Particles, *, total: bool) -> None:
    """Warn of walls and colliders that lie over the body, of grips and colliders that touch nothing, of thin bodies.

    Args:
        grid: the grid.
        kernel: the kernel.
        boundary: the scene's boundary conditions.
        particles: the particles, as they start.
        total: whether the description is total Lagrangian: colliders that lie over the body then hold it.
    """
    for number, condition in enumerate(boundary, 1):
        name = f"{type(condition).__name__} (boundary {number})"
        covered = 0
        if isinstance(condition, StickyBox | SlipBox | SeparatingBox):
            covered = _beyond(condition, grid, particles.x)
        elif isinstance(condition, AbstractCollider) and not total:
            covered = int((np.asarray(_depth(condition, particles.x)) < -ON_THE_WALL * float(grid.spacing)).sum())
        if covered:
            warn(
                f"{covered} of {particles.count} particles lie in or beyond the {name} at the start: nodes there do "
                "not move freely. Move one of them; to hold a body on purpose take a Grip."
            )
        if isinstance(condition, Grip | AbstractCollider) and _is_idle(condition, grid, kernel, particles.x, total):
            warn(
                f"The {name} touches nothing: no node "
                + ("of the window lies in it" if _needs_all_nodes(condition, total) else "that a particle reaches does")
                + ", and so it has no effect. Move it, or enlarge it to a spacing or more."
            )
    for text in _thin(grid, boundary, particles):
        warn(text)


def _beyond(box: StickyBox | SlipBox | SeparatingBox, grid: Grid, x: ParticleVector) -> int:
    """How many particles lie beyond the walls."""
    margin, places = ON_THE_WALL * float(grid.spacing), np.asarray(x)
    outside = (places < np.asarray(box.lower) - margin) | (places > np.asarray(box.upper) + margin)
    return int(outside.any(axis=1).sum())


@eqx.filter_jit
def _depth(collider: AbstractCollider, x: ParticleVector) -> Float[Array, "p"]:
    return collider.distance(x, jnp.zeros((), x.dtype))


def _needs_all_nodes(condition: Grip | AbstractCollider, total: bool) -> bool:
    """Whether the body may come to the boundary: then it is idle only if it holds no node at all."""
    return not total and not isinstance(condition, Grip)


def _is_idle(condition: Grip | AbstractCollider, grid: Grid, kernel: BSpline, x: ParticleVector, total: bool) -> bool:
    """Whether it is certain never to act. In the total description, if no node that a particle reaches lies in it; in
    the updated one, if it does not move and that is so of a grip, or of a collider and all nodes of a window at rest.
    """
    if not total and (not _rests(condition.motion) or grid.follow):
        return False
    nodes = grid.nodes(grid.window(x)).astype(x.dtype)
    held = np.asarray(_held(condition, nodes, jnp.asarray(grid.spacing, x.dtype), total))
    return not (held.any() if _needs_all_nodes(condition, total) else held[_reached(grid, kernel, x)].any())


def _rests(motion: AbstractMotion | None) -> bool:
    """Whether a motion is none, and known to be."""
    if not isinstance(motion, Motion | RigidMotion):
        return motion is None
    rows = [motion.displacement] + ([motion.rotation] if isinstance(motion, RigidMotion) else [])
    return all((np.ptp(np.asarray(values), axis=0) == 0).all() for values in rows)


@eqx.filter_jit
def _held(condition: AbstractBoundary, nodes: NodeVector, spacing: Scalar, total: bool) -> Bool[Array, "n"]:
    """Which nodes a boundary condition acts on at the start."""
    zero = jnp.zeros((), nodes.dtype)
    asked = condition.conditions(nodes, spacing, zero, zero + 1, reference=total)
    held = asked.fixed.any(axis=1)
    return held if asked.touch is None else held | (asked.touch.owner >= 0)


def _reached(grid: Grid, kernel: BSpline, x: ParticleVector) -> np.ndarray:
    """Which nodes of the window, (n,), lie in a particle's stencil."""
    shape = np.asarray(grid.shape)
    first = np.asarray(kernel.base(x / grid.spacing)) - np.asarray(grid.window(x))
    reached = np.zeros(grid.shape, dtype=bool)
    for offset in itertools.product(range(kernel.order + 1), repeat=grid.dim):
        reached[tuple(((first + offset).astype(int) % shape).T)] = True
    return reached.reshape(-1)


def _thin(grid: Grid, boundary: Boundaries, particles: Particles) -> Iterator[str]:
    """What is said of materials that fill less than two cells in a direction, no wall or plane being beside them."""
    dx, places = float(grid.spacing), np.asarray(particles.x)
    side = np.asarray(particles.volume) ** (1 / grid.dim)
    ends = np.cumsum([0, *(particles.counts or (particles.count,))])
    for number, (start, stop) in enumerate(itertools.pairwise(ends), 1):
        half = side[start:stop, None] / 2
        lower, upper = (places[start:stop] - half).min(axis=0), (places[start:stop] + half).max(axis=0)
        for axis in range(grid.dim):
            thickness = (upper[axis] - lower[axis]) / dx
            if thickness >= _THIN - 1e-3 or grid.periodic[axis]:
                continue
            if any(_is_beside(condition, axis, lower[axis] - dx, upper[axis] + dx) for condition in boundary):
                continue
            which = "The body" if particles.counts is None else f"The body of material {number}"
            yield (
                f"{which} is {thickness:.2g} cells thick in direction {axis}, and below {_THIN:g} its stiffness is the "
                "grid's: take a smaller spacing."
            )


def _is_beside(condition: AbstractBoundary, axis: int, lower: float, upper: float) -> bool:
    """Whether a wall or plane at right angles to an axis lies between two positions on it."""
    if isinstance(condition, Plane):
        return condition.axis == axis and bool(lower <= float(condition.position) <= upper)
    if isinstance(condition, StickyBox | SlipBox | SeparatingBox):
        walls = (float(condition.lower[axis]), float(condition.upper[axis]))
        return any(bool(lower <= wall <= upper) for wall in walls)
    return False
