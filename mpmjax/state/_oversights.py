"""Warnings of what is no error but most likely not meant, given when particles are first prepared for a scene.

Only certain cases are warned of: not a collider that the body may meet later, but a grip or collider that can never
touch a node with mass.
"""

import itertools
from collections.abc import Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, NodeVector, ParticleVector, Scalar
from mpmjax.boundary import (
    ON_THE_WALL,
    AbstractBoundary,
    AbstractCollider,
    Grip,
    Plane,
    SeparatingBox,
    SlipBox,
    StickyBox,
)
from mpmjax.checks import warn
from mpmjax.discretisation import BSpline, Grid
from mpmjax.geometry import Motion, RigidMotion
from mpmjax.state._particles import Particles

_THIN = 2.0
"""A body thinner than so many cells is not resolved."""
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
    bodies = [] if total else [c for c in boundary if isinstance(c, AbstractCollider)]
    fixed = [c for c in boundary if isinstance(c, Grip | AbstractCollider) and (total or _rests(c, grid))]
    covers, holds = {}, {}
    if bodies or fixed:
        margin = jnp.asarray(ON_THE_WALL * grid.spacing, particles.x.dtype)
        nodes = grid.nodes(grid.window(particles.x)).astype(particles.x.dtype)
        inside, held = _probed(tuple(bodies), tuple(fixed), particles.x, nodes, margin, total)
        covers = {id(c): int(count) for c, count in zip(bodies, inside, strict=True)}
        holds = {id(c): np.asarray(mask) for c, mask in zip(fixed, held, strict=True)}
    for number, condition in enumerate(boundary, 1):
        name = f"{type(condition).__name__} (boundary {number})"
        covered = covers.get(id(condition), 0)
        if isinstance(condition, StickyBox | SlipBox | SeparatingBox):
            covered = _beyond(condition, grid, particles.x)
        if covered:
            warn(
                f"{covered} of {particles.count} particles lie in or beyond the {name} at the start: nodes there do "
                "not move freely. Move one of them; to hold a body on purpose take a Grip."
            )
        if id(condition) in holds:
            may_meet = not total and not isinstance(condition, Grip)  # the body comes to it: any node will do
            mask = holds[id(condition)]
            if not (mask if may_meet else mask[_reached(grid, kernel, particles.x)]).any():
                where = "of the window lies in it" if may_meet else "that a particle reaches lies in it"
                warn(f"The {name} touches nothing, since no node {where}: move it, or enlarge it to a spacing or more.")
    for text in _thin(grid, boundary, particles):
        warn(text)


@eqx.filter_jit
def _probed(
    bodies: tuple[AbstractCollider, ...],
    fixed: tuple[Grip | AbstractCollider, ...],
    x: ParticleVector,
    nodes: NodeVector,
    margin: Scalar,
    total: bool,
) -> tuple[list[Int[Array, ""]], list[Bool[Array, "n"]]]:
    """How many particles lie in each of `bodies` at the start, and which nodes lie in each of `fixed`."""
    start = jnp.zeros((), x.dtype)

    def depth(condition: Grip | AbstractCollider) -> Float[Array, "n"]:
        if isinstance(condition, Grip):
            return condition.region.distance(nodes if total else nodes - condition.motion.at(start))
        return condition.shape.distance(nodes) if total else condition.distance(nodes, start)

    return [(body.distance(x, start) < -margin).sum() for body in bodies], [depth(c) <= margin for c in fixed]


def _beyond(box: StickyBox | SlipBox | SeparatingBox, grid: Grid, x: ParticleVector) -> int:
    """How many particles lie beyond the walls."""
    margin, places = ON_THE_WALL * float(grid.spacing), np.asarray(x)
    outside = (places < np.asarray(box.lower) - margin) | (places > np.asarray(box.upper) + margin)
    return int(outside.any(axis=1).sum())


def _rests(condition: Grip | AbstractCollider, grid: Grid) -> bool:
    """Whether neither the boundary condition nor the window moves."""
    motion = condition.motion
    if grid.follow or not isinstance(motion, Motion | RigidMotion):
        return motion is None and not grid.follow
    rows = [motion.displacement] + ([motion.rotation] if isinstance(motion, RigidMotion) else [])
    return all((np.ptp(np.asarray(values), axis=0) == 0).all() for values in rows)


def _reached(grid: Grid, kernel: BSpline, x: ParticleVector) -> np.ndarray:
    """Which nodes of the window, (n,), lie in a particle's stencil."""
    shape = np.asarray(grid.shape)
    first = np.asarray(kernel.base(x / grid.spacing)) - np.asarray(grid.window(x))
    reached = np.zeros(grid.shape, dtype=bool)
    for offset in itertools.product(range(kernel.order + 1), repeat=grid.dim):
        reached[tuple(((first + offset).astype(int) % shape).T)] = True
    return reached.reshape(-1)


def _thin(grid: Grid, boundary: Boundaries, particles: Particles) -> Iterator[str]:
    """Warnings of materials less than two cells thick in a direction in which no wall or plane lies beside them."""
    dx, places = float(grid.spacing), np.asarray(particles.x)
    side = np.asarray(particles.volume) ** (1 / grid.dim)
    ends = np.cumsum([0, *particles.sizes])
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
