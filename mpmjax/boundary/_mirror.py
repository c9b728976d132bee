"""Planes whose far side is a mirror image: mass and tangential velocity even, normal velocity odd.

Nodes beyond such a plane are signed copies of those before it. With B the map from true nodes to all nodes, masses,
momenta and forces are folded with Bᵀ and velocities unfolded with B, so that every system keeps its symmetry: the
implicit one is Bᵀ(M + βΔt²H)B. The transfers know nothing of it. At a `SymmetryPlane` B is always that of the plane; at
a `ContactPlane` only in the *columns* (lines of nodes along the normal) that it holds.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Float, Int, NodeScalar, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._walls import ON_THE_WALL, AbstractBoundary, Conditions, crossed
from mpmjax.checks import require, require_between, require_fields, require_finite
from mpmjax.discretisation import Grid


def _check_plane(name: str, axis: int, position: Scalar, keep: str) -> None:
    require_finite(f"{name}'s position", position)
    require(axis in (0, 1, 2), f"{name}'s axis must be 0, 1 or 2, got {axis}.")
    require(keep in ("above", "below"), f'{name} keeps "above" or "below", got {keep!r}.')


def _through_plane(plane: "Plane", start: ParticleVector, end: ParticleVector, spacing: Scalar) -> Bool[Array, "p"]:
    """Which particles passed a plane: half a spacing is the deepest that they may be."""
    inward = 1 if plane.keep == "above" else -1
    place = inward * jnp.asarray(plane.position, end.dtype)
    return crossed(inward * start[:, plane.axis], inward * end[:, plane.axis], place, place - spacing / 2, spacing)


class SymmetryPlane(AbstractBoundary):
    """A plane of mirror symmetry: nodes beyond it are mirror images. It is also a frictionless wall that holds.

    Exact inside the implicit solve, and second order in the spacing, where a wall that fixes the velocity of its nodes
    is first.

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
        require_fields(self)
        _check_plane("SymmetryPlane", self.axis, self.position, self.keep)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v·n = 0 on the plane's own nodes."""
        del t, dt, reference
        on = jnp.abs(nodes[:, self.axis] - self.position) <= ON_THE_WALL * spacing
        return Conditions(jnp.zeros(nodes.shape, dtype=bool).at[:, self.axis].set(on), jnp.zeros_like(nodes))

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        del t, dt, reach
        return _through_plane(self, start, end, spacing)


class ContactPlane(AbstractBoundary):
    """A rigid plane that the material may leave, and along which it slides with Coulomb friction.

    Where it touches, nodes beyond the plane are mirror images, as at a `SymmetryPlane`; where it does not, they are
    nodes like any other. Which it is, is decided for each column of nodes along the normal: either the wall holds the
    column and pushes, or the column moves inward and the wall does nothing (the rule is in `_contact.py`). Friction is
    an impulse applied after the solve, opposed to the tangential velocity and at most `friction` times the column's
    normal impulse: it lags the solve by one step's elastic response.

    Second order in the spacing while contact lasts without friction; first order where friction shears the material at
    the wall (the mirrored tangential velocity has no slope there), and in the moment of touching and leaving.

    *When it breaks*: as a `SymmetryPlane`. Contact is felt as soon as a particle's stencil reaches the plane, a half to
    two spacings early, as in every contact on the grid. PIC and FLIP carry no velocity gradient to the grid, so with
    them a fast stretch of what touches the wall is taken for leaving it; APIC knows better.

    Args:
        axis: direction of the normal, 0 to d − 1.
        position: coordinate of the plane [m].
        keep: which side holds the material: "above" or "below" the plane.
        friction: Coulomb coefficient [-], at least 0.
    """

    axis: int = eqx.field(static=True)
    position: Scalar
    keep: str = eqx.field(static=True, default="above")
    friction: Scalar = 0.0

    @property
    def dim(self) -> None:
        """Any that has the axis."""
        return None

    def __check_init__(self):
        require_fields(self)
        _check_plane("ContactPlane", self.axis, self.position, self.keep)
        require_between("ContactPlane's friction", self.friction, 0, 1e6)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """None that holds always."""
        del spacing, t, dt, reference
        return Conditions(jnp.zeros(nodes.shape, dtype=bool), jnp.zeros_like(nodes))

    def passed(
        self, start: ParticleVector, end: ParticleVector, spacing: Scalar, t: Scalar, dt: Scalar, reach: float
    ) -> Bool[Array, "p"]:
        del t, dt, reach
        return _through_plane(self, start, end, spacing)


Plane = SymmetryPlane | ContactPlane


def fits(position: Any, spacing: Any) -> Any:
    """Whether a plane lies at a multiple of half a spacing."""
    halves = 2 * position / spacing
    return abs(halves - halves.round()) < ON_THE_WALL


class Image(eqx.Module):
    """Signed copies of true nodes at their mirror images, along one axis of the window."""

    shape: tuple[int, ...] = eqx.field(static=True)
    axis: int = eqx.field(static=True)
    source: Int[Array, "m"]
    even: Int[Array, "m"]
    odd: Int[Array, "m"]
    held: Bool[Array, "n"] | None = None
    """The nodes in columns where there is a mirror; None for all of them."""

    def scalar(self, field: NodeScalar) -> NodeScalar:
        """B for an even scalar field."""
        return self._copy(field[:, None], self.even[:, None]).reshape(field.shape)

    def vector(self, field: NodeVector) -> NodeVector:
        """B for a vector field: tangential components even, the normal one odd."""
        normal = jnp.arange(field.shape[1]) == self.axis
        return self._copy(field, jnp.where(normal, self.odd[:, None], self.even[:, None]))

    def within(self, held: Bool[Array, "n"]) -> "Image":
        """The mirror in some columns alone."""
        return Image(self.shape, self.axis, self.source, self.even, self.odd, held)

    def along(self, values: Array) -> Array:
        """Values along the axis, shape (m,), at all nodes, shape (n,)."""
        by_axis = [1] * len(self.shape)
        by_axis[self.axis] = -1
        return jnp.broadcast_to(values.reshape(by_axis), self.shape).reshape(-1)

    def column(self, field: NodeScalar) -> NodeScalar:
        """The sum over each column, at all of its nodes."""
        total = field.reshape(self.shape).sum(axis=self.axis, keepdims=True)
        return jnp.broadcast_to(total, self.shape).reshape(-1)

    def _copy(self, field: Array, sign: Array) -> Array:
        """Copy along the axis; `sign` has one row a node of the axis and one column a component."""
        blocks = field.reshape(*self.shape, -1)
        by_axis = [1] * (len(self.shape) + 1)
        by_axis[self.axis], by_axis[-1] = sign.shape
        copied = jnp.take(blocks, self.source, axis=self.axis) * sign.reshape(by_axis).astype(field.dtype)
        copied = copied.reshape(field.shape)
        return copied if self.held is None else jnp.where(self.held[:, None], copied, field)


class Mirror(eqx.Module):
    """Several planes together: `unfold` is B, from true nodes to all; `fold` its transpose Bᵀ."""

    images: tuple[Image, ...]

    def unfold(self, field: NodeVector) -> NodeVector:
        """B v: fill in the mirror images."""
        for image in self.images:
            field = image.vector(field)
        return field

    def fold(self, field: NodeVector) -> NodeVector:
        """Bᵀ f: bring to the true nodes what the mirror images received."""
        return jax.linear_transpose(self.unfold, field)(field)[0] if self.images else field

    def unfold_scalar(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """B for an even scalar, such as mass."""
        for image in self.images:
            field = image.scalar(field)
        return field

    def fold_scalar(self, field: Float[Array, "n"]) -> Float[Array, "n"]:
        """Bᵀ for an even scalar."""
        return jax.linear_transpose(self.unfold_scalar, field)(field)[0] if self.images else field

    def then(self, other: "Mirror") -> "Mirror":
        """The mirror that unfolds by this one first."""
        return Mirror(self.images + other.images)


class Contact(eqx.Module):
    """A contact plane in the window, seen by columns: what is said of a column is said at all of its nodes."""

    image: Image
    inward: int = eqx.field(static=True)
    """The inward normal's component: +1 or −1."""
    before: Int[Array, "m"]
    """How many half spacings each node along the axis lies before the plane."""
    friction: Scalar

    @property
    def on_plane(self) -> Bool[Array, "n"]:
        """The nodes on the plane, if it lies on nodes."""
        return self.image.along(self.before == 0)

    @property
    def at_key(self) -> Bool[Array, "n"]:
        """One node a column: that on the plane or, where there is none, half a spacing before it."""
        return self.image.along((self.before == 0) | (self.before == 1))

    def weight(self, mass: NodeScalar) -> NodeScalar:
        """2 m m' / (m + m') [kg] at nodes beyond the plane, m on it, zero before it."""
        both = mass + self.image.scalar(mass)
        harmonic = 2 * mass * self.image.scalar(mass) / jnp.where(both == 0, 1, both)
        return jnp.where(self.image.along(self.before <= 0), harmonic, 0)

    def departure(self, mass: NodeScalar, v: NodeVector) -> NodeScalar:
        """The column's weights times what its velocity lacks of the mirror's [kg m/s], inward positive."""
        lacking = (v - self.image.vector(v))[:, self.image.axis]
        return self.inward * self.image.column(self.weight(mass) * lacking)

    def impulse(self, imbalance: NodeVector) -> NodeScalar:
        """The normal impulse [kg m/s] that holds the column, inward positive."""
        share = self.image.along(jnp.where(self.before < 0, 2, jnp.where(self.before == 0, 1, 0)))
        return self.inward * self.image.column(share.astype(imbalance.dtype) * imbalance[:, self.image.axis])


def _image(plane: Plane, grid: Grid, window: Int[Array, "d"]) -> tuple[Image, Array]:
    """The plane's map from true nodes to all nodes of the window, and how many half spacings each node along the axis
    lies before the plane."""
    length = grid.shape[plane.axis]
    j = jnp.arange(length, dtype=jnp.int32)
    halves = jnp.round(2 * jnp.asarray(plane.position) / grid.spacing).astype(jnp.int32) - 2 * window[plane.axis]
    before = 2 * j - halves if plane.keep == "above" else halves - 2 * j
    ghost = before < 0
    source = jnp.where(ghost, halves - j, j)
    known = (source >= 0) & (source < length)
    even = jnp.where(known, 1, 0)
    odd = jnp.where(known & (before != 0), jnp.where(ghost, -1, 1), 0)
    return Image(grid.shape, plane.axis, jnp.clip(source, 0, length - 1), even, odd), before


def mirror(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> Mirror:
    """The mirror images of a scene's symmetry planes."""
    return Mirror(tuple(_image(b, grid, window)[0] for b in boundaries if isinstance(b, SymmetryPlane)))


def contacts(boundaries: tuple[AbstractBoundary, ...], grid: Grid, window: Int[Array, "d"]) -> tuple[Contact, ...]:
    """A scene's contact planes."""
    found = []
    for plane in boundaries:
        if isinstance(plane, ContactPlane):
            image, before = _image(plane, grid, window)
            found.append(Contact(image, 1 if plane.keep == "above" else -1, before, plane.friction))
    return tuple(found)
