"""Walls along the axes: boxes that hold, let slide, or let go."""

from dataclasses import replace
from functools import reduce
from itertools import chain
from typing import Annotated, ClassVar

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Corner, Float, Int, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary, Wall, crossed
from mpmjax.boundary._conditions import Conditions, no_conditions, prescribed
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._plane_contact import SHUT, FlatWall, plane_contact, wall_images
from mpmjax.boundary._surface_contact import SIGNS, Faces, Surface, refuse_contact, surface_contact
from mpmjax.checks import between, require, require_fields
from mpmjax.discretisation import Grid, scatter
from mpmjax.geometry import Motion, check_corners


class AbstractBox(AbstractBoundary):
    """Walls around a box."""

    lower: Corner  # position of the lower wall in each direction [m], (d,); −inf for none
    upper: Corner  # position of the upper wall in each direction [m], (d,); inf for none

    def __check_init__(self):
        require_fields(self)
        check_corners(type(self).__name__, self.lower, self.upper, " (infinite means no wall)")

    @property
    def dim(self) -> int:
        return len(self.lower)

    def displacement(self, t: Scalar) -> Float[Array, "d"] | float:
        """How far the walls have moved at time t [m], shape (d,). Default: they rest."""
        return 0.0

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        shift = self.displacement(t + dt)
        start, end = start - self.displacement(t), end - shift

        def beyond(inward: int, corner: Corner) -> list[Array]:
            """Whether particles passed the wall of each axis, along its inward normal."""
            walls = inward * jnp.asarray(corner, end.dtype)
            moved = inward * jnp.asarray(shift, end.dtype)  # past the nodes, which rest
            place = walls, self.deepest(walls + moved, spacing, reach) - moved
            return [crossed(*along, spacing) for along in zip(inward * start.T, inward * end.T, *place, strict=True)]

        # axis by axis: of a reduction over them XLA would make a loop within its loop over the particles
        return reduce(jnp.logical_or, beyond(1, self.lower) + beyond(-1, self.upper))

    def deepest(self, wall: Array, spacing: Scalar, reach: float) -> Array:
        """How deep a lower wall [m] lets a particle come [m]: to where no node of its stencil is free, which reaches so
        many spacings."""
        first_free = jnp.floor(wall / spacing + ON_THE_WALL) + 1
        return (first_free - reach - ON_THE_WALL) * spacing

    def across(self, axis: int) -> tuple[FlatWall, FlatWall]:
        """The two walls across an axis."""
        lower, upper = jnp.asarray(self.lower)[axis], jnp.asarray(self.upper)[axis]
        return (axis, lower, 1), (axis, upper, -1)

    def walls(self) -> tuple[Wall, ...]:
        return tuple(
            Wall(axis, float(at), inward)
            for inward, corner in ((1, self.lower), (-1, self.upper))
            for axis, at in enumerate(np.asarray(corner))
            if np.isfinite(at)
        )


class AbstractHoldingBox(AbstractBox):
    """Walls from which material cannot part. They hold the nodes at and behind them, and what flows by columns of nodes
    (see `wall_image`), so that it stays at rest."""

    motion: Motion | None = None  # how the walls move together; None for not at all
    holds_fluids: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        require(
            self.motion is None or self.motion.dim == self.dim,
            f"{type(self).__name__}'s motion must have {self.dim} coordinates, got {self.motion and self.motion.dim}.",
        )

    def displacement(self, t: Scalar) -> Float[Array, "d"] | float:
        return 0.0 if self.motion is None else self.motion.at(t)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = V·n or, where it sticks, v = V."""
        place = nodes if reference or self.motion is None else nodes - self.displacement(t)
        below = place <= jnp.asarray(self.lower, nodes.dtype) + ON_THE_WALL * spacing
        fixed = below | (place >= jnp.asarray(self.upper, nodes.dtype) - ON_THE_WALL * spacing)
        if self.sticks:
            fixed = jnp.broadcast_to(fixed.any(axis=1, keepdims=True), nodes.shape)
        return prescribed(fixed, self.wall_velocity(nodes, t, dt), nodes.dtype)

    def planes(self, t: Scalar) -> tuple[FlatWall, ...]:
        """Two an axis."""
        walls = chain.from_iterable(map(self.across, range(self.dim)))
        shift = jnp.broadcast_to(self.displacement(t), self.dim)
        return tuple((axis, at + shift[axis], inward) for axis, at, inward in walls)

    def wall_velocity(self, nodes: NodeVector, t: Scalar, dt: Scalar) -> NodeVector | None:
        return None if self.motion is None else self.motion.velocity_of(nodes, t, dt)


class StickyBox(AbstractHoldingBox):
    """Walls that hold what touches them: the whole velocity is zero at and beyond them, exactly, also after a solve.

    A fluid is held by columns of nodes, as in a `SlipBox`.

    *When it breaks*: in a corner nothing can move, so that a fluid's volume stays there what it was: let down, its
    pressure in the corner's cell is half of what it should be. What `analysis.smoothed` makes of it is right.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
        motion: how the walls move together, in any direction. Default: not at all.
    """

    sticks: ClassVar[bool] = True


class SlipBox(AbstractHoldingBox):
    """Walls along which the material slides freely and from which it cannot part: the normal velocity is zero at and
    beyond them, exactly, also after a solve.

    Accurate to first order in the spacing. A wall at a multiple of half a spacing is better written as a
    `SymmetryPlane`, which is the same wall to second order: frictionless, and never left.

    A fluid is held by columns of nodes whose normal velocity is linear across the wall and zero on it, wherever that
    lies, so that it stays at rest; its motion has no derivative by a wall's place.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
        motion: how the walls move together; of it the component along each wall's normal counts. Default: not at all.
    """


class SeparatingBox(AbstractBox):
    """Walls that the material may leave, and along which it slides with Coulomb friction.

    A wall pushes where a particle's face, half its width behind its centre, is behind the wall (see `SurfaceContact`):
    a pressure p presses faces p dx/(αM) into it, with M the material's wave modulus, and α = 2 in explicit steps and 20
    in implicit ones. Friction is an impulse applied after the solve, opposed to the tangential velocity and at
    most `friction` times the normal impulse: it lags the solve by one step's elastic response.

    Walls lie anywhere, and have derivatives by their place.

    A fluid is held as by a `ContactPlane`, but with walls anywhere, so that it stays at rest: its impact is without
    bounce, and its motion has no derivative by a wall's place.

    *When it breaks*: particles that start nearer to a wall than half their width are pushed away as if they were
    compressed by that much. A pressure of 0.04 M, in implicit steps of 0.4 M, presses by 2 % of a spacing.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
        friction: Coulomb coefficient [-], at least 0.
    """

    friction: Annotated[Scalar, between(0, 1e6)] = 0.0
    pushes: ClassVar[bool] = True

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        return no_conditions(nodes)

    def surfaces(self, x: ParticleVector, t: Scalar, dt: Scalar, push_time: Scalar) -> tuple[Surface, ...]:
        """Two an axis, which face each other: what is squeezed is pushed by both."""
        above = (x - jnp.asarray(self.lower, x.dtype)).T
        below = (jnp.asarray(self.upper, x.dtype) - x).T
        normals = [jnp.zeros_like(x.T).at[axis].set(1) for axis in range(x.shape[1])]
        return tuple(
            Surface(above[axis], normal, self.friction, axis=axis, opposite=below[axis])
            for axis, normal in enumerate(normals)
        )

    def contacts(
        self, faces: Faces | None, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[AbstractContact, ...]:
        """Springs, and for what flows two walls an axis that hold the columns of nodes whose gap is shut; as at a
        `ContactPlane` springs push it in the implicit step that would bring its faces behind a wall."""
        assert faces is not None  # as it `pushes`
        springs = tuple(surface_contact(each, faces) for each in self.surfaces(faces.x, t, dt, faces.push_time))
        if not any(shape.flows for shape in faces.shapes):
            return springs
        flowing = faces.flowing
        shut = jnp.stack([flowing & (spring.gap <= SHUT * faces.spacing) for spring in springs])
        # one sum at the nodes for all walls
        around = scatter(faces.stencil, shut.reshape(-1, len(flowing)).astype(faces.x.dtype), None, grid.size)
        contacts: list[AbstractContact] = []
        for axis, spring in enumerate(springs):
            if not (faces.explicit and flowing.all()):
                contacts.append(replace(spring, near=spring.near & ~shut[axis]))
            walls = wall_images(self.across(axis), faces, grid, window)
            contacts.append(plane_contact(walls, SIGNS, self.friction, around[:, 2 * axis : 2 * axis + 2]))
        return tuple(contacts)

    def deepest(self, wall: Array, spacing: Scalar, reach: float) -> Array:
        """A spacing beyond the wall: what is deeper is not pushed."""
        return wall - spacing

    def check(self, grid: Grid, *, total: bool) -> None:
        refuse_contact(total)
