"""Boundary conditions: functions of node position that prescribe grid velocities, mirror them, or mark contact.

Every condition acts on the grid alone; the transfers know nothing of it. A wall acts on the nodes at and beyond it; a
node within a thousandth of a spacing of a wall counts as on it. Where walls, planes and regions lie only selects
nodes, so derivatives with respect to it are zero.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._checks import coordinates, is_traced, require, require_between, require_finite
from mpmjax._grid import Grid
from mpmjax._motion import Motion
from mpmjax._region import AbstractRegion
from mpmjax._types import Array, Float, Int, Mask, NodeVector, Point, Scalar

_ON_THE_WALL = 1e-3  # of a spacing


class Conditions(eqx.Module):
    """What boundaries ask of the window's nodes."""

    fixed: Mask
    """Components of velocity that are prescribed, shape (n, d)."""
    velocity: NodeVector
    """Their values [m/s], shape (n, d); zero elsewhere."""
    side: NodeVector | None = None
    """Inward normal (+1 or −1) of a separating wall in each direction, 0 where there is none; None without any."""
    friction: NodeVector | None = None
    """Coulomb coefficient of that wall [-]."""


class AbstractBoundary(eqx.Module):
    """A boundary condition."""

    @property
    @abc.abstractmethod
    def dim(self) -> int | None:
        """The space dimension it is made for; None where it fits any."""

    @abc.abstractmethod
    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """The conditions on nodes at the given positions for the step from t to t + dt.

        With `reference`, the nodes are those of the reference configuration and a region that moves stays where it was.
        """


def _walls(lower: Point, upper: Point, nodes: NodeVector, spacing: Scalar) -> NodeVector:
    """The inward normal's component in each direction: +1 at and below `lower`, −1 at and above `upper`, else 0."""
    margin = _ON_THE_WALL * spacing
    below = nodes <= jnp.asarray(lower, nodes.dtype) + margin
    above = nodes >= jnp.asarray(upper, nodes.dtype) - margin
    return jnp.where(below, 1, jnp.where(above, -1, 0)).astype(nodes.dtype)


def _check_box(name: str, lower: Point, upper: Point) -> None:
    require(
        coordinates(f"{name}'s lower corner", lower) == coordinates(f"{name}'s upper corner", upper),
        f"{name} needs two corners with as many coordinates, got {lower} and {upper}.",
    )
    if not is_traced((lower, upper)):
        a, b = np.asarray(lower, float), np.asarray(upper, float)
        require(
            (a < b) & ~np.isnan(a) & ~np.isnan(b),
            f"{name}'s lower corner must lie below its upper one in each direction (infinite means no wall), "
            f"got {lower} and {upper}.",
        )


class StickyBox(AbstractBoundary):
    """Walls that hold what touches them: the whole velocity is zero at and beyond them, exactly, also after a solve.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
    """

    lower: Point
    upper: Point

    def __check_init__(self):
        _check_box("StickyBox", self.lower, self.upper)

    @property
    def dim(self) -> int:
        """That of the corners."""
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = 0."""
        del t, dt, reference
        held = (_walls(self.lower, self.upper, nodes, spacing) != 0).any(axis=1, keepdims=True)
        return Conditions(jnp.broadcast_to(held, nodes.shape), jnp.zeros_like(nodes))


class SlipBox(AbstractBoundary):
    """Walls along which the material slides freely and from which it cannot part: the normal velocity is zero at and
    beyond them, exactly, also after a solve.

    Accurate to first order in the spacing; for a plane of symmetry `SymmetryPlane` is second order.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
    """

    lower: Point
    upper: Point

    def __check_init__(self):
        _check_box("SlipBox", self.lower, self.upper)

    @property
    def dim(self) -> int:
        """That of the corners."""
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = 0."""
        del t, dt, reference
        return Conditions(_walls(self.lower, self.upper, nodes, spacing) != 0, jnp.zeros_like(nodes))


class SeparatingBox(AbstractBoundary):
    """Walls that the material may leave, and along which it slides with Coulomb friction.

    At a wall node either the normal velocity is zero and the wall pushes, or the node moves inward and the wall does
    nothing (the rule is in `_contact.py`). Friction is an impulse applied after the solve, opposed to the tangential
    velocity and at most `friction` times the normal impulse: it lags the solve by one step's elastic response.

    Args:
        lower: position of the lower wall in each direction [m], (d,); −inf for none.
        upper: position of the upper wall in each direction [m], (d,); inf for none.
        friction: Coulomb coefficient [-], at least 0.
    """

    lower: Point
    upper: Point
    friction: Scalar = 0.0

    def __check_init__(self):
        _check_box("SeparatingBox", self.lower, self.upper)
        require_between("SeparatingBox's friction", self.friction, 0, 1e6)

    @property
    def dim(self) -> int:
        """That of the corners."""
        return len(self.lower)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n ≥ 0 ⟂ reaction ≥ 0."""
        del t, dt, reference
        nothing = jnp.zeros(nodes.shape, dtype=bool)
        side = _walls(self.lower, self.upper, nodes, spacing)
        return Conditions(nothing, jnp.zeros_like(nodes), side, jnp.abs(side) * self.friction)


class Grip(AbstractBoundary):
    """A region of nodes with a prescribed velocity, which moves as it prescribes.

    In the total description the region is that of the reference configuration. In a periodic direction the region does
    not wrap: it must stay within the window's extent. The region only selects nodes, so its floats have no derivative;
    those of the motion have.

    Args:
        region: region at zero displacement.
        motion: displacement of the grip in time.
        axes: the directions in which it holds, one bool each. Default: all of them.
    """

    region: AbstractRegion
    motion: Motion
    axes: tuple[bool, ...] | None = eqx.field(
        static=True, default=None, converter=lambda a: a if a is None else tuple(a)
    )

    @property
    def dim(self) -> int:
        """That of the motion."""
        return jnp.shape(jnp.asarray(self.motion.displacement))[1]

    def __check_init__(self):
        d = self.dim
        require(
            len(self.region.bounds()[0] if not is_traced(self.region) else range(d)) == d,
            "A grip's region and motion must have the same dimension.",
        )
        require(
            self.axes is None or (len(self.axes) == d and any(self.axes)),
            f"A grip's axes must be {d} bools, at least one of them true, got {self.axes}.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v = that of the motion."""
        place = nodes if reference else nodes - self.motion.at(t)
        held = self.region.contains(place, _ON_THE_WALL * spacing)[:, None]
        axes = jnp.ones(nodes.shape[1], dtype=bool) if self.axes is None else jnp.asarray(self.axes)
        fixed = held & axes
        return Conditions(fixed, jnp.where(fixed, self.motion.velocity(t, dt), 0))


class SymmetryPlane(AbstractBoundary):
    """A plane of mirror symmetry: nodes beyond it are mirror images (mass and tangential velocity even, normal odd).

    Exact inside the implicit solve: with B the map from true nodes to all nodes, the system is Bᵀ(M + βΔt²H)B. Second
    order, where a wall that fixes the velocity of its nodes is first.

    *When it breaks*: particles must start on the kept side, and the plane must lie at a multiple of half a spacing.

    Args:
        axis: direction of the normal, 0 to d − 1.
        position: coordinate of the plane [m].
        keep: which side holds the material: "above" or "below" the plane.
    """

    axis: int = eqx.field(static=True)
    position: Scalar
    keep: str = eqx.field(static=True, default="above")

    @property
    def dim(self) -> None:
        """Any that has the axis."""
        return None

    def __check_init__(self):
        require_finite("A symmetry plane's position", self.position)
        require(self.axis in (0, 1, 2), f"A symmetry plane's axis must be 0, 1 or 2, got {self.axis}.")
        require(self.keep in ("above", "below"), f'A symmetry plane keeps "above" or "below", got {self.keep!r}.')

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = 0 on the plane's own nodes."""
        del t, dt, reference
        on = jnp.abs(nodes[:, self.axis] - self.position) <= _ON_THE_WALL * spacing
        return Conditions(jnp.zeros(nodes.shape, dtype=bool).at[:, self.axis].set(on), jnp.zeros_like(nodes))

    def fits(self, grid: Grid) -> bool:
        """Whether the plane lies at a multiple of half a spacing (true while either is not known)."""
        if is_traced((self.position, grid.spacing)):
            return True
        halves = 2 * float(self.position) / float(grid.spacing)
        return abs(halves - round(halves)) < _ON_THE_WALL

    def image(self, grid: Grid, window: Int[Array, "d"]) -> "Image":
        """The plane's map from true nodes to all nodes of the window."""
        length = grid.shape[self.axis]
        j = jnp.arange(length, dtype=jnp.int32)
        plane = jnp.round(2 * jnp.asarray(self.position) / grid.spacing).astype(jnp.int32) - 2 * window[self.axis]
        ghost = 2 * j < plane if self.keep == "above" else 2 * j > plane
        source = jnp.where(ghost, plane - j, j)
        known = (source >= 0) & (source < length)
        even = jnp.where(known, 1, 0)
        odd = jnp.where(known & (2 * j != plane), jnp.where(ghost, -1, 1), 0)
        return Image(grid.shape, self.axis, jnp.clip(source, 0, length - 1), even, odd)


class Image(eqx.Module):
    """Signed copies of true nodes at their mirror images, along one axis of the window."""

    shape: tuple[int, ...] = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    source: Int[Array, "m"]
    even: Int[Array, "m"]
    odd: Int[Array, "m"]

    def scalar(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """B for an even scalar field."""
        return self._copy(field[:, None], self.even[:, None]).reshape(field.shape)

    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field: tangential components even, the normal one odd."""
        normal = jnp.arange(field.shape[1]) == self.axis
        return self._copy(field, jnp.where(normal, self.odd[:, None], self.even[:, None]))

    def _copy(self, field: Array, sign: Array) -> Array:
        """Copy along the axis; `sign` has one row a node of the axis and one column a component."""
        blocks = field.reshape(*self.shape, -1)
        by_axis = [1] * (len(self.shape) + 1)
        by_axis[self.axis], by_axis[-1] = sign.shape
        copied = jnp.take(blocks, self.source, axis=self.axis) * sign.reshape(by_axis).astype(field.dtype)
        return copied.reshape(field.shape)


class Mirror(eqx.Module):
    """All of a scene's symmetry planes together: `unfold` is B, from true nodes to all; `fold` its transpose Bᵀ."""

    images: tuple[Image, ...]

    def unfold(self, field: NodeVector) -> NodeVector:
        """B v: fill in the mirror images."""
        for image in self.images:
            field = image.vector(field)
        return field

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ f: bring to the true nodes what the mirror images received."""
        return jax.linear_transpose(self.unfold, field)(field)[0] if self.images else field

    def fold_scalar(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """The same for an even scalar, such as mass."""

        def unfold(a: Array) -> Array:
            for image in self.images:
                a = image.scalar(a)
            return a

        return jax.linear_transpose(unfold, field)(field)[0] if self.images else field


def mirror(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> Mirror:
    """The mirror images of a scene's symmetry planes."""
    return Mirror(tuple(b.image(grid, window) for b in boundaries if isinstance(b, SymmetryPlane)))


def combine(
    boundaries: tuple[AbstractBoundary, ...],
    nodes: NodeVector,
    spacing: Scalar,
    t: Scalar,
    dt: Scalar,
    *,
    reference: bool,
) -> Conditions:
    """All of a scene's conditions; where two prescribe one component, the earlier in the tuple holds.

    Contact is left to nodes' components that nothing prescribes.
    """
    total = Conditions(jnp.zeros(nodes.shape, dtype=bool), jnp.zeros_like(nodes))
    for boundary in boundaries:
        new = boundary.conditions(nodes, spacing, t, dt, reference=reference)
        velocity = jnp.where(total.fixed, total.velocity, new.velocity)
        side, friction = total.side, total.friction
        if new.side is not None and new.friction is not None:
            if side is None or friction is None:
                side, friction = new.side, new.friction
            else:
                friction = jnp.where(side != 0, friction, new.friction)
                side = jnp.where(side != 0, side, new.side)
        total = Conditions(total.fixed | new.fixed, velocity, side, friction)
    if total.side is None:
        return total
    return Conditions(total.fixed, total.velocity, jnp.where(total.fixed, 0, total.side), total.friction)
