"""Symmetry, clamp and contact planes, beyond which nodes are mirror images."""

from dataclasses import replace
from typing import Annotated, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary, Wall, carried_by_motion, crossed
from mpmjax.boundary._conditions import Conditions, no_conditions, prescribed
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._plane_contact import SHUT, plane_contact
from mpmjax.boundary._surface_contact import Faces, Surface, refuse_contact, surface_contact
from mpmjax.checks import between, require, require_fields, require_finite, require_that
from mpmjax.discretisation import Grid, scatter
from mpmjax.geometry import AbstractMotion, Motion
from mpmjax.potential import Image, MirrorPlace, mirror_image, wall_image

FAR = 0.1  # how far behind a contact plane a face is held whatever is beside it, in spacings


class AbstractPlane(AbstractBoundary):
    """A plane beyond which nodes are mirror images."""

    axis: int = eqx.field(static=True)  # direction of the normal, 0 to d − 1
    position: Scalar  # coordinate of the plane [m]
    keep: eqx.AbstractVar[str]  # which side holds the material: "above" or "below" the plane
    motion: eqx.AbstractVar[Any]  # how it moves; None for not at all
    plain_box: ClassVar[str]  # the box that is the same wall anywhere, to first order

    def __check_init__(self):
        require_fields(self)
        name = type(self).__name__
        require_finite(f"{name}'s position", self.position)
        require(self.axis in (0, 1, 2), f"{name}'s axis must be 0, 1 or 2, got {self.axis}.")
        require(self.keep in ("above", "below"), f'{name} keeps "above" or "below", got {self.keep!r}.')

    @property
    def dim(self) -> int | None:
        return None if self.motion is None else self.motion.dim

    def displacement(self, t: Scalar) -> Scalar:
        """How far the plane has moved along its axis at time t [m]. Default: it does not move."""
        return 0.0

    @property
    def inward(self) -> int:
        """The inward normal's component: +1 or −1."""
        return 1 if self.keep == "above" else -1

    def check(self, grid: Grid, *, total: bool) -> None:
        """Check that the axis is not periodic, and that the plane lies at a multiple of half a spacing."""
        name = type(self).__name__
        require(self.axis < grid.dim, f"{name}'s axis must be below {grid.dim}, got {self.axis}.")
        require(
            not grid.periodic[self.axis],
            f"Direction {self.axis} is periodic and cannot have a {name}: drop one of them.",
        )

        def fits(position: Any, spacing: Any) -> Any:
            halves = 2 * position / spacing
            return abs(halves - halves.round()) < ON_THE_WALL

        require_that(
            f"A {name} must lie at a multiple of half the grid's spacing (elsewhere use {self.plain_box})",
            fits,
            self.position,
            grid.spacing,
        )

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"] | None:
        """Which particles passed the plane: those that end more than half a spacing beyond it, among others
        (`crossed`)."""
        place = self.inward * jnp.asarray(self.position, end.dtype)
        start, end = start[:, self.axis] - self.displacement(t), end[:, self.axis] - self.displacement(t + dt)
        coordinates = self.inward * start, self.inward * end
        return crossed(*coordinates, place, place - spacing / 2, spacing)

    def mirror(self) -> MirrorPlace:
        return MirrorPlace(self.axis, self.position, self.motion)

    def walls(self) -> tuple[Wall, ...]:
        """Where it starts."""
        return (Wall(self.axis, float(self.position), self.inward, mirrored=self.motion is None),)


class SymmetryPlane(AbstractPlane):
    """A plane of mirror symmetry: nodes beyond it are mirror images. It is also a frictionless wall that
    material cannot leave.

    Exact inside the implicit solve, and second order in the spacing, where a wall that fixes the velocity of its nodes
    is first.

    It may move along its normal, as a smooth plate does: nodes beyond it then have twice its velocity minus their
    image's. In the updated description the grid moves with it, so that all mirrored planes across one axis must move
    alike there; in the total description each moves on its own.

    *When it breaks*: particles must start on the kept side, and the plane must start at a multiple of half a spacing.

    Args:
        axis: direction of the normal, 0 to d − 1.
        position: coordinate of the plane [m]. Derivatives by it are those of the plane and the lattice of nodes
            together; there are none between two planes across one axis.
        keep: which side holds the material: "above" or "below" the plane.
        motion: how it moves; of its displacement the component along the normal counts. Default: not at all.
    """

    keep: str = eqx.field(static=True, default="above")
    motion: Motion | None = None
    plain_box: ClassVar[str] = "SlipBox"

    def displacement(self, t: Scalar) -> Scalar:
        return 0.0 if self.motion is None else self.motion.at(t)[self.axis]

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = V·n on the plane's own nodes."""
        at = self.position if reference or self.motion is None else self.position + self.displacement(t)
        on = jnp.abs(nodes[:, self.axis] - at) <= ON_THE_WALL * spacing
        fixed = jnp.zeros(nodes.shape, dtype=bool).at[:, self.axis].set(on)
        return prescribed(fixed, self.motion and self.motion.velocity_of(nodes, t, dt), nodes.dtype)

    def check(self, grid: Grid, *, total: bool) -> None:
        """A window cannot follow the material and a plane."""
        AbstractPlane.check(self, grid, total=total)
        require(
            self.motion is None or total or not grid.follow,
            "The grid moves with a SymmetryPlane that moves, so it cannot follow the particles: drop follow=True.",
        )

    def mirror_images(self, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar) -> tuple[Image, ...]:
        """The mirror image of this plane, in all columns."""
        velocity = None if self.motion is None else self.motion.velocity(t, dt)[self.axis]
        return (replace(mirror_image(self.axis, self.position, self.keep, grid, window), velocity=velocity),)


class ClampPlane(AbstractPlane):
    """A plane to which the body's face is fixed: a grip that holds at its surface.

    Nodes beyond it have the opposite of their image's velocity, so that the spline vanishes on the plane: second order
    in the spacing, where a `Grip` of whole nodes lets the body yield up to half a spacing beyond the face and is first.

    With a motion, in the total description, nodes on the plane have its velocity V and those beyond 2V minus their
    image's.

    *When it breaks*: the body must end at the plane; what lies beyond would be moved the other way.

    Args:
        axis: direction of the normal, 0 to d − 1.
        position: coordinate of the plane before it moves [m], a multiple of half a spacing.
        keep: which side holds the material: "above" or "below" the plane.
        motion: how it moves: a `Motion`, or a `RigidMotion`, which turns too. Default: not at all.
    """

    keep: str = eqx.field(static=True, default="above")
    motion: Motion | AbstractMotion | None = None
    plain_box: ClassVar[str] = "Grip"
    meets_constraints: ClassVar[bool] = False

    def check(self, grid: Grid, *, total: bool) -> None:
        """A motion needs the total description."""
        AbstractPlane.check(self, grid, total=total)
        require(
            self.motion is None or total,
            "A ClampPlane moves in the total description only, whose nodes stay with the body: take that, or a Grip.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = V on the plane's own nodes."""
        on = jnp.abs(nodes[:, self.axis] - self.position) <= ON_THE_WALL * spacing
        velocity = None if self.motion is None else self.motion.velocity_of(nodes, t, dt)
        return prescribed(jnp.broadcast_to(on[:, None], nodes.shape), velocity, nodes.dtype)

    def mirror_images(self, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar) -> tuple[Image, ...]:
        """The image in which all components are odd, in all columns."""
        velocity, image = None, mirror_image(self.axis, self.position, self.keep, grid, window)
        if self.motion is not None:
            nodes = grid.nodes(window)
            velocity = self.motion.velocity_of(nodes.at[:, self.axis].set(self.position), t, dt)
        return (replace(image, velocity=velocity, holds_all=True),)

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"] | None:
        """Nothing passes one that moves, being fixed to it."""
        return AbstractPlane.passed(self, start, end, spacing, t, dt, reach) if self.motion is None else None

    def carried(self, nodes: NodeVector, t: Scalar) -> NodeVector:
        return carried_by_motion(self.motion, nodes, t)

    def pivot(self, t: Scalar) -> Float[Array, "d"] | None:
        """The centre of what turns."""
        motion = self.motion
        return None if motion is None or not motion.turns else motion.pivot(jnp.zeros(motion.dim), t)


class ContactPlane(AbstractPlane):
    """A rigid plane that the material may leave, and along which it slides with Coulomb friction.

    Where it touches, nodes beyond the plane are mirror images of the first node before it; where it does not, they are
    nodes like any other. Which it is, is decided for each column of nodes along the normal: either the wall holds the
    column and pushes, or the column moves inward and the wall does nothing (see `AbstractContact`). Friction is
    an impulse applied after the solve, opposed to the tangential velocity and at most `friction` times the column's
    normal impulse: it lags the solve by one step's elastic response.

    Second order in the spacing while contact lasts without friction; first order where friction shears the material at
    the wall (the mirrored tangential velocity has no slope there), and in the moment of touching and leaving.

    A column is held while a third of the faces around it that are near, of what yields or flows any, is behind the
    plane, or less than a hundredth of a spacing before it. What it moves with when it is first held is lost, so an
    impact returns less than from a `SeparatingBox`, which is the better wall for a bounce.

    *When it breaks*: as a `SymmetryPlane`. PIC and FLIP carry no velocity gradient to the grid, so with them a fast
    stretch of what touches the wall is taken for leaving it; APIC knows better. Half-way between nodes a plane is not
    the mirror for cubic kernels: errors at it are four times as large as at one on nodes.

    Args:
        axis: direction of the normal, 0 to d − 1.
        position: coordinate of the plane [m]. Derivatives by it are those of the plane and the lattice of nodes
            together; there are none between two planes across one axis.
        keep: which side holds the material: "above" or "below" the plane.
        friction: Coulomb coefficient [-], at least 0.
    """

    keep: str = eqx.field(static=True, default="above")
    friction: Annotated[Scalar, between(0, 1e6)] = 0.0
    motion: ClassVar[None] = None  # pyright: ignore[reportIncompatibleVariableOverride]
    plain_box: ClassVar[str] = "SeparatingBox"
    sees_faces: ClassVar[bool] = True
    meets_constraints: ClassVar[bool] = False

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        return no_conditions(nodes)

    def check(self, grid: Grid, *, total: bool) -> None:
        AbstractPlane.check(self, grid, total=total)
        refuse_contact(total)

    def contacts(
        self, faces: Faces | None, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[AbstractContact, ...]:
        """A mirror in the columns around which a third of the faces is shut, by the kernel's weights, of those less
        than half a particle before the plane; of what yields or flows, or is far behind it, any. In implicit steps,
        which may close much of a gap at once, faces before the plane are pushed as by a `SeparatingBox` in the step
        that would bring them behind it."""
        assert faces is not None  # as it `sees_faces`
        normal = jnp.zeros_like(faces.x.T).at[self.axis].set(self.inward)
        distance = self.inward * (faces.x[:, self.axis] - self.position)
        landing = surface_contact(Surface(distance, normal, self.friction, axis=self.axis), faces)
        shut = landing.gap <= SHUT * faces.spacing
        # a curved face is felt where it is, and not a kernel beside its contact; twice the gap: the half-width before
        before = (2 * landing.gap < distance) & ~faces.round
        votes = jnp.where(landing.gap < -FAR * faces.spacing, 100.0, jnp.where(shut, 2.0, jnp.where(before, -1.0, 0.0)))
        around = scatter(faces.stencil, votes.astype(faces.x.dtype), None, grid.size)
        order, position = len(faces.stencil.basis.knots) - 1, jax.lax.stop_gradient(self.position)  # the lattice goes
        wall = wall_image(self.axis, position, self.inward, grid, window, order)
        plane = plane_contact((wall,), (self.inward,), self.friction, around)
        return (plane,) if faces.explicit else (replace(landing, near=landing.near & ~shut), plane)
