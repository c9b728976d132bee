"""Colliders: rigid bodies of any shape that move as prescribed, and hold the nodes that lie in them, or push the
particles' faces.

Of colliders that hold nodes, a node lies in one up to a thousandth of a spacing off its surface; its normal there is
the gradient of the shape's distance, and its velocity that of the collider's own point, the chord over the step. Which
nodes lie in it has no derivative; normals and velocities have, with respect to the motion and the shape. Where two
bodies share a node, the rules of `combined_conditions` apply.
"""

from dataclasses import replace
from typing import Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary, carried_by_motion
from mpmjax.boundary._conditions import Conditions, Slide, no_conditions, prescribed
from mpmjax.boundary._contact import AbstractContact
from mpmjax.boundary._plane_contact import SHUT, FlatWall, plane_contact, wall_images
from mpmjax.boundary._surface_contact import Faces, FlowContact, Surface, refuse_contact, surface_contact
from mpmjax.checks import between, canonical, require, require_fields
from mpmjax.discretisation import Grid, scatter
from mpmjax.geometry import AbstractMotion, AbstractRegion, HalfSpace, Motion, length, still
from mpmjax.potential import SurfaceImage, WallImage, surface_image

_ASKEW = 1e-6  # the slope to an axis up to which a half-space is across it: a turned one is so to rounding
_FAR = 0.1  # how far behind a surface what flows is pushed though nodes hold it, in spacings
_LOOKS = 4  # places of a particle's way in which a collider is looked for


class AbstractCollider(AbstractBoundary):
    """A rigid body in the way of the material."""

    shape: AbstractRegion  # the body before its motion
    motion: Motion | AbstractMotion | None = None  # how it moves; None for not at all
    is_collider: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        motion, d = self.motion, self.dim
        require(
            motion is None or motion.dim == d,
            f"A collider's shape and motion must have the same dimension, got {d} and {motion and motion.dim}.",
        )

    @property
    def dim(self) -> int:
        return self.shape.dim

    def moved_by(self, dtype: Any) -> AbstractMotion:
        """The motion, of this dtype; that of a body at rest if it has none."""
        return canonical(still(self.dim), dtype) if self.motion is None else self.motion

    def distance(self, x: Float[Array, "m d"], t: Scalar) -> Float[Array, "m"]:
        return self.shape.distance(x if self.motion is None else self.motion.origin(x, t))

    def pivot(self, t: Scalar) -> Float[Array, "d"]:
        """The centre of the rotation or, without one, the shape's middle."""
        middle = jnp.asarray(self.shape.middle())
        return middle if self.motion is None else self.motion.pivot(middle, t)

    def carried(self, nodes: NodeVector, t: Scalar) -> NodeVector:
        return carried_by_motion(self.motion, nodes, t)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        bounds = self.shape.bounds()
        return bounds if self.motion is None else self.motion.swept(*bounds)

    def rests(self, *, total: bool) -> bool:
        return total or self.motion is None or self.motion.rests()

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        """Which particles entered the body: they started outside, moved more than a spacing towards it in the step,
        relative to it, and were inside at one of four points of their way. Distances are computed only if a particle
        moves that fast."""
        del reach
        if self.motion is not None:
            start, end = self.motion.origin(start, t), self.motion.origin(end, t + dt)
        way = end - start

        def look() -> Array:
            first = self.shape.distance(start)
            later = jax.lax.map(
                lambda part: self.shape.distance(start + part * way),
                jnp.arange(1, _LOOKS + 1, dtype=end.dtype) / _LOOKS,
            )
            return (first >= 0) & ((later < 0) & (first - later > spacing)).any(axis=0)

        fast = jnp.any(sum(way[:, a] ** 2 for a in range(self.dim)) > spacing**2)
        return jax.lax.cond(fast, look, lambda: jnp.zeros(len(end), bool))

    def seen_by(self, nodes: NodeVector, t: Scalar, dt: Scalar, reference: bool) -> tuple[NodeVector, NodeVector]:
        """The nodes in the shape's own frame [m] and the velocity of the body at them [m/s], both of shape (n, d)."""
        motion = self.moved_by(nodes.dtype)
        place = nodes if reference else motion.origin(nodes, t)
        return place, motion.velocity_of(place, t, dt)

    def sloped(self, place: Float[Array, "m d"], t: Scalar) -> tuple[Float[Array, "m"], Float[Array, "m d"]]:
        """The distance of points in the shape's own frame [m], and the body's unit normal there at time t: infinite and
        zero where the distance has no slope, as a sampled one may have none. In the middle of a step that turns a body
        of revolution about its axis the normal is across the chords on which the surface moves."""
        distance, slope = jax.vjp(self.shape.distance, place)
        (slope,) = slope(jnp.ones_like(distance))
        steepness = length(slope)
        sloping = steepness > 0
        normal = self.moved_by(place.dtype).turned(slope / jnp.where(sloping, steepness, 1)[:, None], t)
        return jnp.where(sloping, distance, jnp.inf), normal

    def flow_image(
        self, flowing: NodeScalar, faces: Faces, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> SurfaceImage:
        """The map of the surface for what flows, by its weights at the nodes; none follow at a half-space across an
        axis."""
        nodes, order = grid.nodes(window), len(faces.stencil.basis.knots) - 1
        distance, normal = self.sloped(self.moved_by(nodes.dtype).origin(nodes, t), t + dt / 2)
        askew = ~jnp.isfinite(jnp.array([position for _, position, _ in self.across_axes(t)])).any()
        velocity = self.wall_velocity(nodes, t, dt)
        return surface_image(distance, normal, (flowing > 0) & askew, grid, window, order, velocity, self.sticks)

    def across_axes(self, t: Scalar) -> tuple[FlatWall, ...]:
        """The planes of a half-space at time t, one across each axis, infinitely far where the normal is not along it;
        none of other bodies."""
        if not isinstance(self.shape, HalfSpace):
            return ()
        point, normal = jnp.asarray(self.shape.point), jnp.asarray(self.shape.normal)
        if self.motion is not None:
            point, normal = self.motion.place(point[None], t)[0], self.motion.turned(normal[None], t)[0]
        size = jnp.abs(normal)
        inward, along = jnp.where(normal < 0, -1, 1), size.sum() - size <= _ASKEW * size
        places = jnp.where(along, point, jnp.where(normal < 0, jnp.inf, -jnp.inf))
        return tuple((axis, places[axis], inward[axis]) for axis in range(self.dim))

    def wall_velocity(self, nodes: NodeVector, t: Scalar, dt: Scalar) -> NodeVector | None:
        return None if self.motion is None else self.motion.velocity_of(self.motion.origin(nodes, t), t, dt)


class AbstractHoldingCollider(AbstractCollider):
    """A body from which material cannot part. It holds the nodes in it; what flows it holds by nodes behind its surface
    that follow those before it, at a half-space across an axis by columns as a box does, so that it stays at rest: its
    motion has no derivative by the place and normal of such a half-space."""

    meets_constraints: ClassVar[bool] = False
    holds_fluids: ClassVar[bool] = True

    def planes(self, t: Scalar) -> tuple[FlatWall, ...]:
        return self.across_axes(t)

    def fluid_walls(
        self, faces: Faces, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[WallImage | SurfaceImage, ...]:
        flowing = scatter(faces.stencil, jnp.asarray(faces.flowing, faces.x.dtype)[None], None, grid.size)[:, 0]
        image = self.flow_image(flowing, faces, grid, window, t, dt)
        return image, *super().fluid_walls(faces, grid, window, t, dt)


class StickyCollider(AbstractHoldingCollider):
    """A body to which the material sticks: nodes in it have its velocity, exactly, also after a solve. Fluids stay at
    rest.

    In the total description it holds the reference nodes that lie in it before its motion: a grip that can turn.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
    """

    sticks: ClassVar[bool] = True

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = v_c."""
        place, velocity = self.seen_by(nodes, t, dt, reference)
        velocity = None if self.motion is None else velocity
        fixed = jnp.broadcast_to(self.shape.contains(place, ON_THE_WALL * spacing)[:, None], nodes.shape)
        return prescribed(fixed, velocity, nodes.dtype)


class SlipCollider(AbstractHoldingCollider):
    """A body along which the material slides freely and from which it cannot part: nodes in it have its velocity along
    the normal, exactly, also after a solve. Fluids stay at rest.

    In the total description only a half-space without rotation: elsewhere the normal of a reference node changes as it
    slides.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
    """

    def check(self, grid: Grid, *, total: bool) -> None:
        """In the total description its normal must be the same everywhere and always."""
        del grid
        require(
            not total or (self.shape.flat and (self.motion is None or not self.motion.turns)),
            "In the total description material can slide along a half-space that does not turn and nothing else, its "
            "nodes being those of the start: use the updated one, or StickyCollider.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = v_c·n, but at nodes where the distance has no slope, as a sampled one may have none."""
        place, velocity = self.seen_by(nodes, t, dt, reference)
        _, normal = self.sloped(place, t + dt / 2)
        held = self.shape.contains(place, ON_THE_WALL * spacing)[:, None]
        slide = Slide(jnp.where(held, normal, 0), jnp.where(held, velocity, 0))
        return replace(no_conditions(nodes), slides=(slide,), holds=True, moves=self.motion is not None)


class SeparatingCollider(AbstractCollider):
    """A body that the material may leave, and along which it slides with Coulomb friction.

    It pushes where a particle's face, half its width before its centre, is behind its surface, as the walls of a
    `SeparatingBox` do. Friction is an impulse applied after the solve, opposed to the tangential velocity relative to
    the body and at most `friction` times the normal impulse: it lags the solve by one step's elastic response.

    It has derivatives by its place and size, and those of its motion.

    A fluid is held at a half-space across an axis as by a `SeparatingBox`, elsewhere by nodes behind the surface that
    follow those before it (see `FlowContact`), so that it stays at rest: its impact is without bounce.

    *When it breaks*: as a `SeparatingBox`. At corners sharper than a right angle, and surfaces that bend within a few
    spacings, a fluid's pressure is less exact. A body or part of it that is thinner than two spacings does not keep
    material out, and one that moves through more than a spacing in a step leaves some behind. Not in the total
    description.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
        friction: Coulomb coefficient [-], at least 0.
    """

    friction: Annotated[Scalar, between(0, 1e6)] = 0.0
    pushes: ClassVar[bool] = True

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """None on nodes, which its push on faces moves all the same: with it no contact is known at the start."""
        return replace(no_conditions(nodes), holds=True, moves=self.motion is not None)

    def surfaces(self, x: ParticleVector, t: Scalar, dt: Scalar, push_time: Scalar) -> tuple[Surface, ...]:
        motion = self.moved_by(x.dtype)
        distance, normal = self.sloped(motion.origin(x, push_time), push_time)
        velocity = self.wall_velocity(x, t, dt)
        return (Surface(distance, normal.T, self.friction, None if velocity is None else velocity.T),)

    def contacts(
        self, faces: Faces | None, grid: Grid, window: Int[Array, "d"], t: Scalar, dt: Scalar
    ) -> tuple[AbstractContact, ...]:
        """Springs, and what holds the nodes around faces of what flows whose gap is shut: at a half-space across an
        axis a plane, as of a `SeparatingBox`; elsewhere a map that is less exact."""
        assert faces is not None  # as it `pushes`
        (surface,) = self.surfaces(faces.x, t, dt, faces.push_time)
        springs, flowing = surface_contact(surface, faces), faces.flowing
        if not flowing.any():
            return (springs,)
        now, gap = surface, springs.gap  # at the start, of a body that moves too
        if self.motion is not None:
            (now,) = self.surfaces(faces.x, t, dt, t)
            gap = surface_contact(now, faces).gap
        shut, planes = flowing & (gap[0] <= SHUT * faces.spacing), self.across_axes(t)
        along = jnp.isfinite(jnp.array([position for _, position, _ in planes]))
        near = jnp.stack([flowing, shut & ~along.any(), *(along[:, None] & shut)])
        around = scatter(faces.stencil, near.astype(faces.x.dtype), None, grid.size)
        image = self.flow_image(around[:, 0], faces, grid, window, t, dt)
        flow = FlowContact(image, self.friction, image.spread((around[:, 1:2] > 0).astype(faces.x.dtype))[:, 0] > 0)
        walls = wall_images(planes, faces, grid, window, velocity=image.velocity)
        each = enumerate(zip(walls, planes, strict=True), 2)
        held = [plane_contact((wall,), (plane[2],), self.friction, around[:, k, None]) for k, (wall, plane) in each]
        # an explicit step's springs push no face before the surface; of what is held only what went through a map
        pushed = ~flowing if faces.explicit else ~shut
        pushed = pushed | (~along.any() & (now.distance < -_FAR * faces.spacing))
        return replace(springs, near=springs.near & pushed), flow, *held

    def check(self, grid: Grid, *, total: bool) -> None:
        del grid
        refuse_contact(total)
