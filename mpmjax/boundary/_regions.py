"""Regions of nodes: grips, which have a prescribed motion, and rigid parts of a body, which move freely."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary, carried_by_motion
from mpmjax.boundary._conditions import Conditions, prescribed
from mpmjax.checks import as_plain, require, require_fields
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractMotion, AbstractRegion, Motion
from mpmjax.potential import Image, Tie


class Grip(AbstractBoundary):
    """A region of nodes with a prescribed motion, which may turn. The region moves with it.

    A node has the velocity of the grip's own point that is there, the chord over the step; where the grip turns,
    material in it follows the circle and not its tangent. In the total description the region is that of the reference
    configuration. In a periodic direction the region does not wrap: it must stay within the window's extent. The region
    only selects nodes, so derivatives by its floats are zero; those by the floats of the motion are not.

    Args:
        region: region at zero displacement.
        motion: how it moves: a `Motion`, or a `RigidMotion`, which turns too.
        axes: the directions in which it holds, one bool each. Default: all of them. They do not turn.
    """

    region: AbstractRegion
    motion: Motion | AbstractMotion  # in files a Motion where no kind is given
    axes: tuple[bool, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    @property
    def dim(self) -> int:
        return self.motion.dim

    def __check_init__(self):
        require_fields(self)
        d = self.dim
        require(
            self.region.dim == d,
            f"A grip's region and motion must have the same dimension, got {self.region.dim} and {d}.",
        )
        require(
            self.axes is None or (len(self.axes) == d and any(self.axes)),
            f"A grip's axes must be {d} bools, at least one of them true, got {self.axes}.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v is the velocity of the motion."""
        place = nodes if reference else self.motion.origin(nodes, t)
        held = self.region.contains(place, ON_THE_WALL * spacing)[:, None]
        axes = jnp.ones(nodes.shape[1], dtype=bool) if self.axes is None else jnp.asarray(self.axes)
        fixed = held & axes
        return prescribed(fixed, self.motion.velocity_of(place, t, dt), nodes.dtype)

    def carried(self, nodes: NodeVector, t: Scalar) -> NodeVector:
        return carried_by_motion(self.motion, nodes, t)

    def pivot(self, t: Scalar) -> Float[Array, "d"]:
        """The region's middle."""
        return self.motion.pivot(jnp.asarray(self.region.middle()), t)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        return self.motion.swept(*self.region.bounds())

    def rests(self, *, total: bool) -> bool:
        return total or self.motion.rests()


class RigidPart(AbstractBoundary):
    """A part of a body in which all nodes have one velocity, that of their common momentum: a plate or a mass that is
    dropped, pushed by a force or hung from a spring, without turning.

    It moves as the loads on its particles, gravity and the rest of the body make it. Its mass is that of its particles:
    give them the density of the plate, and push it by a `PointLoad` or a `Traction`. The nodes are those of the
    reference configuration, in the total description. Where another boundary holds one of them, it holds all. It is a
    linear map of the nodes, as a mirror is, exact inside every implicit solve, and needs no state of its own.

    *When it breaks*: in the updated description, where nodes do not stay with the body; it says so. Material within a
    stencil of its edge is partly rigid, so that the edge is felt up to a cell early. It does not turn: the torque that
    holds it upright is its part of the scene's `boundary_forces`. A body along which its nodes would slide acts on the
    first of them alone: guide it by `free`.

    Args:
        region: the nodes of the reference configuration that are tied together.
        free: the directions in which it may move, one bool each; in the others it rests. Default: all of them.
    """

    region: AbstractRegion
    free: tuple[bool, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    def __check_init__(self):
        require_fields(self)
        require(
            self.free is None or len(self.free) == self.dim,
            f"A RigidPart's free directions must be {self.dim} bools, got {self.free}.",
        )

    @property
    def dim(self) -> int:
        return self.region.dim

    def holds(self, nodes: NodeVector, spacing: Scalar) -> Bool[Array, "n"]:
        """Which nodes are tied together, shape (n,)."""
        return self.region.contains(nodes, ON_THE_WALL * spacing)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = 0 in the directions in which it may not move."""
        guided = jnp.zeros(self.dim, bool) if self.free is None else ~jnp.asarray(self.free)
        return prescribed(self.holds(nodes, spacing)[:, None] & guided, None, nodes.dtype)

    def extend_to_body(self, fixed: Mask, value: Array, nodes: NodeVector, spacing: Scalar) -> tuple[Mask, Array]:
        """A component that is prescribed at one of its nodes is so at all of them, as at the first."""
        tied = self.holds(nodes, spacing)[:, None]
        held = tied & fixed
        first = jnp.take_along_axis(value, held.argmax(axis=0)[None], axis=0)
        means = tied & held.any(axis=0)
        return fixed | means, jnp.where(means, first, value)

    def mirror_images(self, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar) -> tuple[Image | Tie, ...]:
        """The map that gives all of its nodes the velocity of the first one."""
        return (Tie(self.holds(grid.nodes(window), grid.spacing)),)

    def check(self, grid: Grid, *, total: bool) -> None:
        require(
            not grid.axisymmetric or self.free in ((False, True), (False, False)),
            f"A RigidPart of revolution cannot grow: give it free=(False, True), along the axis, got {self.free}.",
        )
        require(
            total,
            "A RigidPart is of nodes that stay with the body: use the total description, or a stiff law for the part.",
        )
