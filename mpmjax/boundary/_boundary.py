"""The interface of boundaries, and the boundaries of a scene together.

Every boundary acts on the grid alone; the transfers know nothing of it. What holds material acts on the nodes at and
beyond it; a node within a thousandth of a spacing of a wall counts as on it. Where such walls, planes and grips lie
only selects nodes, so derivatives with respect to it are zero; but a mirrored plane takes the lattice along, and has
derivatives by its place (see `carried_by`). What pushes material and may be left acts where the particles' faces touch
its surface (`surfaces`), and has derivatives by its place and size.
"""

import abc
from dataclasses import replace
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._conditions import Conditions, no_conditions
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._plane_contact import FlatWall, wall_images
from mpmjax.boundary._surface_contact import Faces, Surface, surface_contact
from mpmjax.discretisation import Grid, scatter
from mpmjax.geometry import AbstractMotion
from mpmjax.potential import Image, Mirror, MirrorPlace, SurfaceImage, Tie, WallImage

ON_THE_WALL = 1e-3  # distance within which a node is on a wall, in spacings


class Wall(NamedTuple):
    """A wall at right angles to an axis."""

    axis: int  # the axis
    position: float  # coordinate [m]
    inward: int  # the sign of the inward normal's component, +1 or −1
    mirrored: bool = False  # whether nodes beyond it are mirror images, so that no particle may start there


class AbstractBoundary(eqx.Module):
    """A boundary condition.

    One of your own needs `dim` and `conditions`. What holds material only while that pushes, a contact, is brought by
    `contacts`. The rest has defaults.
    """

    is_collider: ClassVar[bool] = False  # whether it is a rigid body, the impulse on which is recorded
    pushes: ClassVar[bool] = False  # whether it has `surfaces` that push material away
    sees_faces: ClassVar[bool] = False  # whether its `contacts` need the faces of particles though it does not push
    sticks: ClassVar[bool] = False  # whether it holds the whole velocity, and not the normal one alone
    holds_fluids: ClassVar[bool] = False  # whether it has `fluid_walls`
    meets_constraints: ClassVar[bool] = True
    """Whether it may stand in a scene with constrained bodies, such as rigid ones. What it prescribes of a node it
    prescribes of the body."""

    @property
    @abc.abstractmethod
    def dim(self) -> int | None:
        """Space dimension d of the condition; None if it fits any."""

    @abc.abstractmethod
    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """The conditions on nodes at the given positions for the step from t to t + dt.

        With `reference`, the nodes are those of the reference configuration and a region that moves stays where it was.
        """

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"] | None:
        """Which particles passed the boundary in the step from t to t + dt; None if it keeps nothing out.

        A particle that moves less than a spacing in a step stops before a wall, or so little beyond it that a node of
        its stencil is still free. A particle has passed if it is deeper than that, or if it moved more than a spacing
        towards the wall in the step and ended beyond it. One that began beyond has not passed.

        Args:
            start: positions at t [m], shape (p, d).
            end: positions at t + dt [m], shape (p, d).
            spacing: dx [m].
            t: time [s].
            dt: step [s].
            reach: half the kernel's width in spacings.
        """
        return None

    def contacts(
        self, faces: Faces | None, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[AbstractContact, ...]:
        """The contacts that it brings in the step from t to t + dt (see `AbstractContact`). Default: those of its
        `surfaces`.

        Args:
            faces: the faces of the particles; None if no boundary of the scene pushes or sees them.
            grid: the grid; `grid.nodes(window)` are the positions of the nodes [m], shape (n, d).
            window: lattice index of the window's first node, shape (d,).
            t: time [s].
            dt: step [s].
        """
        if faces is None or not self.pushes:
            return ()
        return tuple(surface_contact(each, faces) for each in self.surfaces(faces.x, t, dt, faces.push_time))

    def planes(self, t: Scalar) -> tuple[FlatWall, ...]:
        """The planes across an axis at time t that what flows never leaves. Default: none."""
        del t
        return ()

    def wall_velocity(self, nodes: NodeVector, t: Scalar, dt: Scalar) -> NodeVector | None:
        """Their velocity from t to t + dt at the nodes [m/s], shape (n, d). Default: None, they rest."""
        del nodes, t, dt
        return None

    def fluid_walls(
        self, faces: Faces, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[WallImage | SurfaceImage, ...]:
        """The maps by which it holds the nodes around what flows at all times (see `wall_image` and `surface_image`).
        Default: those of its planes."""
        velocity = self.wall_velocity(grid.nodes(window), t, dt)
        walls = wall_images(self.planes(t), faces, grid, window, sticks=self.sticks, velocity=velocity)
        if not walls or faces.flowing.all():
            return walls
        flowing = jnp.asarray(faces.flowing, faces.x.dtype)
        around = scatter(faces.stencil, flowing[None], None, grid.size)[:, 0]
        return tuple(replace(wall, held=wall.columns_around(around)) for wall in walls)

    def surfaces(self, x: ParticleVector, t: Scalar, dt: Scalar, push_time: Scalar) -> tuple[Surface, ...]:
        """The rigid surfaces that push the faces of particles in the step from t to t + dt, if it `pushes`. Default:
        none.

        Args:
            x: the particles' positions at t [m], shape (p, d).
            t: time [s].
            dt: step [s].
            push_time: the time at which they push [s]: t in an explicit step, else t + dt.
        """
        return ()

    def mirror_images(self, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar) -> tuple[Image | Tie, ...]:
        """The mirrors that it puts in the window in the step from t to t + dt (see `mirror_image`). Default: none."""
        return ()

    def mirror(self) -> MirrorPlace | None:
        """Where its mirror is. Default: None, it has none.

        In the updated description the grid moves with a mirror, so that it lies on nodes or half-way between them.
        """
        return None

    def check(self, grid: Grid, *, total: bool) -> None:
        """Check that it can stand in a scene with this grid, in the total description or not. Default: it can.

        Raises:
            ValueError: it cannot; why, and what to do.
        """

    def walls(self) -> tuple[Wall, ...]:
        """The walls at right angles to an axis, for pictures and for warnings of what lies beyond or beside them.
        Default: none. It is asked only while numbers are known."""
        return ()

    def distance(self, x: Float[Array, "m d"], t: Scalar) -> Float[Array, "m"] | None:
        """The signed distance [m] of points x [m], shape (m, d), from the body that it is at time t, for pictures and
        for warnings of what lies in it. Default: None, it is no body."""
        return None

    def extend_to_body(self, fixed: Mask, value: Array, nodes: NodeVector, spacing: Scalar) -> tuple[Mask, Array]:
        """Conditions on single nodes, the components prescribed and a value of each, (n, d), extended to the whole of a
        rigid part. Default: as they are."""
        return fixed, value

    def carried(self, nodes: NodeVector, t: Scalar) -> NodeVector | None:
        """Where components that it holds of reference nodes at these positions are at time t [m], shape (n, d).
        Default: None, that is not known."""
        return None

    def pivot(self, t: Scalar) -> Float[Array, "d"] | None:
        """The point at time t [m], shape (d,), about which its torque is taken. Default: None, the origin of the
        coordinates."""
        return None

    def reach(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The corners of a box [m], each of shape (d,), that holds the body at all times. Default: None, it is no body.
        It is asked only while numbers are known."""
        return None

    def rests(self, *, total: bool) -> bool:
        """Whether it acts on the same nodes at all times and is meant to act on some, so that it is an oversight if it
        touches none. Default: False. It is asked only while numbers are known."""
        return False


def carried_by_motion(motion: AbstractMotion | None, nodes: NodeVector, t: Scalar) -> NodeVector:
    """Where nodes that have moved with a body are at time t [m], shape (n, d)."""
    return nodes if motion is None else nodes + motion.place(nodes, t) - motion.place(nodes, 0.0)


def crossed(
    start: Array, end: Array, wall: Array | Scalar, deepest: Array | Scalar, spacing: Scalar
) -> Bool[Array, "..."]:
    """Whether a coordinate that moved from `start` to `end` passed a wall that keeps material above it: it moved by
    more than a spacing and ended below the wall, or it ended below `deepest`."""
    fast = (start >= wall) & (end < wall) & (start - end > spacing)
    return fast | ((start >= deepest) & (end < deepest))


def combined_conditions(
    boundaries: tuple[AbstractBoundary, ...],
    nodes: NodeVector,
    spacing: Scalar,
    t: Scalar,
    dt: Scalar,
    *,
    reference: bool,
) -> Conditions:
    """The conditions of all boundaries of a scene. Where two prescribe the same component, the earlier one holds.

    Contact acts on components that nothing prescribes. A node may have components that are prescribed and, besides
    them, normals of several colliders: all hold (see `Nodes.free_normals`). A normal that lies within a hundredth of
    the prescribed components and of earlier normals asks for nothing more.
    """
    total, owner = no_conditions(nodes), jnp.full(nodes.shape, -1, jnp.int32)
    for number, boundary in enumerate(boundaries):
        new = boundary.conditions(nodes, spacing, t, dt, reference=reference)
        owner = jnp.where(new.fixed & ~total.fixed, number, owner)
        total = Conditions(
            fixed=total.fixed | new.fixed,
            velocity=jnp.where(total.fixed, total.velocity, new.velocity),
            slides=total.slides + tuple(replace(slide, number=number) for slide in new.slides),
            holds=total.holds or new.holds,
            moves=total.moves or new.moves,
        )
    for boundary in boundaries:
        owner = boundary.extend_to_body(total.fixed, owner, nodes, spacing)[1]
        fixed, velocity = boundary.extend_to_body(total.fixed, total.velocity, nodes, spacing)
        total = replace(total, fixed=fixed, velocity=velocity)
    return replace(total, owner=owner)


def mirror(
    boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"], t: Scalar = 0.0, dt: Scalar = 1.0
) -> Mirror:
    """The mirror images that the boundaries of a scene put in the window; t and dt matter for velocities alone."""
    return Mirror(tuple(image for boundary in boundaries for image in boundary.mirror_images(grid, window, t, dt)))
