"""Symmetry and contact planes."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, NodeVector, ParticleVector, Scalar
from mpmjax.boundary._conditions import ON_THE_WALL, AbstractBoundary, Conditions, crossed
from mpmjax.checks import require, require_between, require_fields, require_finite


def _check_plane(name: str, axis: int, position: Scalar, keep: str) -> None:
    require_finite(f"{name}'s position", position)
    require(axis in (0, 1, 2), f"{name}'s axis must be 0, 1 or 2, got {axis}.")
    require(keep in ("above", "below"), f'{name} keeps "above" or "below", got {keep!r}.')


def _through_plane(plane: "Plane", start: ParticleVector, end: ParticleVector, spacing: Scalar) -> Bool[Array, "p"]:
    """Which particles passed a plane: those that end more than half a spacing beyond it, among others (`crossed`)."""
    inward = 1 if plane.keep == "above" else -1
    place = inward * jnp.asarray(plane.position, end.dtype)
    return crossed(inward * start[:, plane.axis], inward * end[:, plane.axis], place, place - spacing / 2, spacing)


class SymmetryPlane(AbstractBoundary):
    """A plane of mirror symmetry: nodes beyond it are mirror images. It is also a frictionless wall that
    material cannot leave.

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
    column and pushes, or the column moves inward and the wall does nothing (see `AbstractContact`). Friction is
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
        return None

    def __check_init__(self):
        require_fields(self)
        _check_plane("ContactPlane", self.axis, self.position, self.keep)
        require_between("ContactPlane's friction", self.friction, 0, 1e6)

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
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
