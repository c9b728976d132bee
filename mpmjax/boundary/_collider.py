"""Colliders: rigid bodies of any shape that move as prescribed, and hold the nodes that lie in them, or push the
particles' faces.

A node lies in a collider up to a thousandth of a spacing off its surface; its normal there is the gradient of the
shape's distance, and its velocity that of the collider's own point, the chord over the step. Which nodes lie in it has
no derivative; normals and velocities have, with respect to the motion and the shape. Where two bodies share a node, the
rules of `combine` apply. All this is of what holds nodes: `SeparatingCollider` pushes faces, and has derivatives by its
place and size.
"""

from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary
from mpmjax.boundary._conditions import ColliderConditions, Conditions, Slide, no_conditions
from mpmjax.boundary._surface_contact import Surface, refuse_contact
from mpmjax.checks import canonical, require, require_between, require_fields
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractMotion, AbstractRegion, length, still

_LOOKS = 4  # places of a particle's way in which a collider is looked for


class AbstractCollider(AbstractBoundary):
    """A rigid body in the way of the material."""

    shape: eqx.AbstractVar[AbstractRegion]
    """The body before its motion."""
    motion: eqx.AbstractVar[AbstractMotion | None]
    """How it moves; None for not at all."""
    collider_count: ClassVar[int] = 1

    def __check_init__(self):
        motion, d = self.motion, self.dim
        require(
            motion is None or motion.dim == d,
            f"A collider's shape and motion must have the same dimension, got {d} and {motion and motion.dim}.",
        )

    @property
    def dim(self) -> int:
        return self.shape.dim

    def distance(self, x: Float[Array, "m d"], t: Scalar) -> Float[Array, "m"]:
        """The signed distance [m] of each of the points x [m], shape (m, d), from the body as it is at time t."""
        return self.shape.distance(x if self.motion is None else self.motion.origin(x, t))

    def pivot(self, t: Scalar) -> Float[Array, "d"]:
        """The centre of the rotation or, without one, the shape's middle."""
        middle = jnp.asarray(self.shape.middle())
        return middle if self.motion is None else self.motion.pivot(middle, t)

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


class StickyCollider(AbstractCollider):
    """A body to which the material sticks: nodes in it have its velocity, exactly, also after a solve.

    In the total description it holds the reference nodes that lie in it before its motion: a grip that can turn.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
    """

    shape: AbstractRegion
    motion: AbstractMotion | None = None
    meets_rigid_bodies: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = v_c."""
        body = _Body(self, nodes, t, dt, reference)
        inside = body.holds(spacing)[:, None]
        fixed = jnp.broadcast_to(inside, nodes.shape)
        holder = jnp.where(fixed, 0, -1).astype(jnp.int32)
        touched = eqx.tree_at(lambda c: c.holder, body.nothing_held(), holder)
        velocity = jnp.where(fixed, body.velocity, 0)
        return Conditions(fixed, velocity, touched, moves=self.motion is not None)


class SlipCollider(AbstractCollider):
    """A body along which the material slides freely and from which it cannot part: nodes in it have its velocity along
    the normal, exactly, also after a solve.

    In the total description only a half-space without rotation: elsewhere the normal of a reference node changes as it
    slides.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
    """

    shape: AbstractRegion
    motion: AbstractMotion | None = None
    meets_rigid_bodies: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)

    def check(self, grid: Grid, *, total: bool) -> None:
        """In the total description its normal must be the same everywhere and always."""
        del grid
        require(
            not total or (self.shape.flat and (self.motion is None or not self.motion.turns)),
            "In the total description material can slide along a half-space that does not turn and nothing else, its "
            "nodes being those of the start: use the updated one, or StickyCollider.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = v_c·n."""
        body = _Body(self, nodes, t, dt, reference)
        touched = replace(body.nothing_held(), slides=(body.slide(spacing),))
        return replace(no_conditions(nodes), colliders=touched, holds=True, moves=self.motion is not None)


class SeparatingCollider(AbstractCollider):
    """A body that the material may leave, and along which it slides with Coulomb friction.

    It pushes where a particle's face, half its width before its centre, is behind its surface, as the walls of a
    `SeparatingBox` do. Friction is an impulse applied after the solve, opposed to the tangential velocity relative to
    the body and at most `friction` times the normal impulse: it lags the solve by one step's elastic response.

    It has derivatives by its place and size, and those of its motion.

    *When it breaks*: as a `SeparatingBox`. A body or part of it that is thinner than two spacings does not keep
    material out, and one that moves through more than a spacing in a step leaves some behind. Not in the total
    description.

    Args:
        shape: the body before its motion.
        motion: how it moves. Default: not at all.
        friction: Coulomb coefficient [-], at least 0.
    """

    shape: AbstractRegion
    motion: AbstractMotion | None = None
    friction: Scalar = 0.0
    pushes: ClassVar[bool] = True

    def __check_init__(self):
        require_fields(self)
        require_between("SeparatingCollider's friction", self.friction, 0, 1e6)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """None on nodes: it acts on faces. Its pivot, for torques."""
        touched = _Body(self, nodes, t, dt, reference).nothing_held()
        return replace(no_conditions(nodes), colliders=touched, holds=True, moves=self.motion is not None)

    def surfaces(self, x: ParticleVector, t: Scalar, dt: Scalar, push_time: Scalar) -> tuple[Surface, ...]:
        """Unit normal of the body; zero where the distance gradient vanishes, as a sampled one may."""
        motion = canonical(still(self.dim), x.dtype) if self.motion is None else self.motion
        place = motion.origin(x, push_time)
        distance, slope = jax.vjp(self.shape.distance, place)
        (slope,) = slope(jnp.ones_like(distance))
        steepness = length(slope)
        sloping = steepness > 0
        normal = motion.turned(slope / jnp.where(sloping, steepness, 1)[:, None], push_time)
        velocity = motion.velocity_of(motion.origin(x, t), t, dt)
        return (Surface(jnp.where(sloping, distance, jnp.inf), normal.T, self.friction, velocity.T),)

    def check(self, grid: Grid, *, total: bool) -> None:
        del grid
        refuse_contact(total)


class _Body(eqx.Module):
    """A collider as the nodes see it in one step."""

    shape: AbstractRegion
    motion: AbstractMotion
    t: Scalar
    nodes: NodeVector
    place: NodeVector
    """The nodes in the shape's own frame [m], shape (n, d)."""
    velocity: NodeVector
    """Velocity of the body at the nodes [m/s], shape (n, d)."""
    position: NodeVector
    """Positions of the nodes [m], shape (n, d); in the total description moved with the body."""
    pivot: Float[Array, "d"]
    pivot_velocity: Float[Array, "d"]

    def __init__(self, collider: AbstractCollider, nodes: NodeVector, t: Scalar, dt: Scalar, reference: bool):
        motion = canonical(still(collider.dim), nodes.dtype) if collider.motion is None else collider.motion
        self.nodes, self.shape, self.motion, self.t = nodes, collider.shape, motion, t
        self.place = nodes if reference else motion.origin(nodes, t)
        self.velocity = motion.velocity_of(self.place, t, dt)
        self.position = nodes + motion.place(nodes, t) - motion.place(nodes, 0.0) if reference else nodes
        middle = jnp.asarray(collider.shape.middle(), nodes.dtype)
        self.pivot = motion.pivot(middle, t)
        self.pivot_velocity = (motion.pivot(middle, t + dt) - self.pivot) / dt

    def holds(self, spacing: Scalar) -> Bool[Array, "n"]:
        """Which nodes lie in the body, shape (n,)."""
        return self.shape.contains(self.place, ON_THE_WALL * spacing)

    def nothing_held(self) -> ColliderConditions:
        """The conditions of a body that holds no node."""
        return ColliderConditions(
            slides=(),
            holder=jnp.full(self.nodes.shape, -1, jnp.int32),
            position=self.position,
            pivots=self.pivot[None],
            pivot_velocity=self.pivot_velocity[None],
        )

    def slide(self, spacing: Scalar) -> Slide:
        """The normals of a body that holds every node in it along them, but for nodes where the distance has no slope,
        as a sampled one may have none."""
        slope = jax.grad(lambda x: self.shape.distance(x).sum())(self.place)
        steepness = length(slope)
        held = (self.holds(spacing) & (steepness > 0))[:, None]
        normal = self.motion.turned(slope / jnp.where(held, steepness[:, None], 1), self.t)
        return Slide(jnp.where(held, normal, 0), jnp.where(held, self.velocity, 0))
