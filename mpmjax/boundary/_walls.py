"""Walls along the axes: boxes that hold, let slide, or let go."""

from functools import reduce

import jax.numpy as jnp

from mpmjax._types import Array, Bool, Corner, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._conditions import ON_THE_WALL, AbstractBoundary, Conditions, crossed
from mpmjax.checks import coordinates, require, require_between, require_fields, require_that


def _through_box(
    lower: Corner, upper: Corner, start: ParticleVector, end: ParticleVector, spacing: Scalar, reach: float
) -> Bool[Array, "p"]:
    """Which particles passed a wall of a box: the deepest place is where a stencil has free nodes no more."""

    def through(wall: Array, start: Array, end: Array) -> Array:
        first_free = jnp.floor(wall / spacing + ON_THE_WALL) + 1
        return crossed(start, end, wall, (first_free - reach - ON_THE_WALL) * spacing, spacing)

    below, above = jnp.asarray(lower, end.dtype), jnp.asarray(upper, end.dtype)
    by_axis = zip(below, above, start.T, end.T, strict=True)
    return reduce(jnp.logical_or, [through(lo, a, b) | through(-hi, -a, -b) for lo, hi, a, b in by_axis])


def _walls(lower: Corner, upper: Corner, nodes: NodeVector, spacing: Scalar) -> NodeVector:
    """The inward normal's component in each direction: +1 at and below `lower`, −1 at and above `upper`, else 0."""
    margin = ON_THE_WALL * spacing
    below = nodes <= jnp.asarray(lower, nodes.dtype) + margin
    above = nodes >= jnp.asarray(upper, nodes.dtype) - margin
    return jnp.where(below, 1, jnp.where(above, -1, 0)).astype(nodes.dtype)


def _check_box(name: str, lower: Corner, upper: Corner) -> None:
    require(
        coordinates(f"{name}'s lower corner", lower) == coordinates(f"{name}'s upper corner", upper),
        f"{name} needs two corners with as many coordinates, got {lower} and {upper}.",
    )
    require_that(
        f"{name}'s lower corner must lie below its upper one in each direction (infinite means no wall)",
        lambda a, b: a < b,  # false of what is not a number
        lower,
        upper,
    )


class StickyBox(AbstractBoundary):
    """Walls that hold what touches them: the whole velocity is zero at and beyond them, exactly, also after a solve.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
    """

    lower: Corner
    upper: Corner

    def __check_init__(self):
        require_fields(self)
        _check_box("StickyBox", self.lower, self.upper)

    @property
    def dim(self) -> int:
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = 0."""
        del t, dt, reference
        held = (_walls(self.lower, self.upper, nodes, spacing) != 0).any(axis=1, keepdims=True)
        return Conditions(jnp.broadcast_to(held, nodes.shape), jnp.zeros_like(nodes))

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        del t, dt
        return _through_box(self.lower, self.upper, start, end, spacing, reach)


class SlipBox(AbstractBoundary):
    """Walls along which the material slides freely and from which it cannot part: the normal velocity is zero at and
    beyond them, exactly, also after a solve.

    Accurate to first order in the spacing. A wall at a multiple of half a spacing is better written as a
    `SymmetryPlane`, which is the same wall to second order: frictionless, and never left.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
    """

    lower: Corner
    upper: Corner

    def __check_init__(self):
        require_fields(self)
        _check_box("SlipBox", self.lower, self.upper)

    @property
    def dim(self) -> int:
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = 0."""
        del t, dt, reference
        return Conditions(_walls(self.lower, self.upper, nodes, spacing) != 0, jnp.zeros_like(nodes))

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        del t, dt
        return _through_box(self.lower, self.upper, start, end, spacing, reach)


class SeparatingBox(AbstractBoundary):
    """Walls that the material may leave, and along which it slides with Coulomb friction.

    At a wall node either the normal velocity is zero and the wall pushes, or the node moves inward and the wall does
    nothing (see `AbstractContact`). Friction is an impulse applied after the solve, opposed to the tangential
    velocity and at most `friction` times the normal impulse: it lags the solve by one step's elastic response.

    Accurate to first order in the spacing. A wall at a multiple of half a spacing is better written as a
    `ContactPlane`, which is the same wall to second order.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
        friction: Coulomb coefficient [-], at least 0.
    """

    lower: Corner
    upper: Corner
    friction: Scalar = 0.0

    def __check_init__(self):
        require_fields(self)
        _check_box("SeparatingBox", self.lower, self.upper)
        require_between("SeparatingBox's friction", self.friction, 0, 1e6)

    @property
    def dim(self) -> int:
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n ≥ 0 ⟂ reaction ≥ 0."""
        del t, dt, reference
        nothing = jnp.zeros(nodes.shape, dtype=bool)
        side = _walls(self.lower, self.upper, nodes, spacing)
        return Conditions(nothing, jnp.zeros_like(nodes), side, jnp.abs(side) * self.friction)

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        del t, dt
        return _through_box(self.lower, self.upper, start, end, spacing, reach)
