"""The impulse that each boundary of a scene receives from the material in a step.

The impulses of all boundaries together are a partition of what the nodes receive besides gravity, body forces and the
material's own forces, but for the residual of the solve. So their sum is minus the change of the particles' momentum
that these leave, to rounding.

At a mirror plane the nodes' equations are folded, Bᵀ(...) (see `_mirror`). What the folding takes from the impulses of
all nodes is the plane's; what remains, on true nodes, belongs to the boundary that prescribes the component there.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, Int, NodeVector, Scalar
from mpmjax.boundary._boundary import AbstractBoundary
from mpmjax.boundary._conditions import Given
from mpmjax.geometry import moment
from mpmjax.linalg import pairs
from mpmjax.potential import Image, Mirror, Tie


class BoundaryImpulse(eqx.Module):
    """Linear and angular impulse on each of a scene's b boundaries, in their order, the guides of `Rigid` bodies that
    have some among them, after all others. Divided by the step they are its mean force and torque."""

    impulse: Float[Array, "*f b d"]
    """Impulse [kg m/s], friction included."""
    angular: Float[Array, "*f b r"]
    """Angular impulse [kg m²/s] about the boundary's `pivot` as it moves: r = 1 component in 2-D, 3 in 3-D, none in
    1-D. Nodes are taken where `ColliderImpulse` takes them, in the total description where the body has moved them."""

    def plus(self, later: "BoundaryImpulse") -> "BoundaryImpulse":
        """The sum of both."""
        return jax.tree.map(jnp.add, self, later)


def no_boundary_impulse(boundaries: int, dim: int, dtype: Any) -> BoundaryImpulse:
    """No impulse yet on a number of boundaries."""
    return BoundaryImpulse(jnp.zeros((boundaries, dim), dtype), jnp.zeros((boundaries, len(pairs(dim))), dtype))


def owners_of(
    boundaries: tuple[AbstractBoundary, ...],
    nodes: NodeVector,
    spacing: Scalar,
    t: Scalar,
    dt: Scalar,
    *,
    reference: bool,
) -> Int[Array, "n d"]:
    """The number of the boundary that prescribes each component of the nodes' velocity, −1 for none, by the rule of
    `combined_conditions`: the earlier one holds."""
    fixed = jnp.full(nodes.shape, -1, jnp.int32)
    for number, boundary in enumerate(boundaries):
        own = boundary.conditions(nodes, spacing, t, dt, reference=reference)
        fixed = jnp.where((fixed < 0) & own.fixed, number, fixed)
    for boundary in boundaries:
        fixed = boundary.spread(fixed >= 0, fixed, nodes, spacing)[1]
    return fixed


def taken_by_mirrors(
    field: NodeVector, images: list[tuple[int, Image]] | list[tuple[int, Image | Tie]]
) -> tuple[list[Given], NodeVector]:
    """The part of impulses on all nodes that mirrors take, each by its boundary's number, and the impulses that remain
    on true nodes.

    Where planes meet, each takes its normal component before the others fold it, so that its torque has the places of
    all nodes.

    Args:
        field: impulses on all nodes [kg m/s], shape (n, d).
        images: the mirrors in the order in which they unfold, with their boundaries' numbers.
    """
    given, remaining = [], jnp.zeros_like(field)
    planes = all(isinstance(image, Image) for _, image in images)  # they commute
    for axis in range(field.shape[1]):
        part = jnp.zeros_like(field).at[:, axis].set(field[:, axis])
        order = list(reversed(images))
        if planes:
            order.sort(key=lambda pair: pair[1].axis != axis)
        for number, image in order:
            folded = Mirror((image,)).fold(part)
            given.append(Given(part - folded, number))
            part = folded
        remaining = remaining + part
    return given, remaining


class GivenCouple(eqx.Module):
    """A couple on a rigid body, and the boundary that gives it."""

    moment: Float[Array, "r"]
    """[kg m²/s], shape (r,)."""
    owner: Int[Array, ""]
    """The number of the boundary, −1 for none."""


def impulse_on_boundaries(
    given: list[Given], couples: list[GivenCouple], places: NodeVector, pivots: Float[Array, "b d"]
) -> BoundaryImpulse:
    """The impulse on each boundary: minus what it gives the nodes.

    Args:
        given: what they give.
        couples: the couples that they give rigid bodies besides.
        places: positions of the nodes [m], shape (n, d).
        pivots: the points for torques [m], shape (b, d).
    """

    def on(number: int, pivot: Array) -> tuple[Array, Array]:
        parts = [
            (part.impulse if part.owner == number else None)
            if isinstance(part.owner, int)
            else jnp.where(part.owner == number, part.impulse, 0)
            for part in given
        ]
        total = sum((part for part in parts if part is not None), jnp.zeros_like(places))
        angular = moment(places - pivot, total).sum(axis=0)
        angular = sum((jnp.where(part.owner == number, part.moment, 0) for part in couples), angular)
        return -total.sum(axis=0), -angular

    each = [on(number, pivot) for number, pivot in enumerate(pivots)]
    return BoundaryImpulse(jnp.stack([linear for linear, _ in each]), jnp.stack([angular for _, angular in each]))
