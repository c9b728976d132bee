"""The impulses that colliders and boundaries receive from the material in a step.

The impulses of all boundaries together are a partition of what the nodes receive besides gravity, body forces and the
material's own forces, but for the residual of the solve. So their sum is minus the change of the particles' momentum
that these leave, to rounding.

At a mirror plane the nodes' equations are folded, Bᵀ(...) (see `_mirror`). What the folding takes from the impulses of
all nodes is the plane's; what remains, on true nodes, belongs to the boundary that prescribes the component there.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int, NodeVector
from mpmjax.boundary._conditions import OwnedImpulse
from mpmjax.geometry import moment
from mpmjax.linalg import pairs
from mpmjax.potential import Image, Mirror, WallImage


class Impulses(eqx.Module):
    """Linear and angular impulse on each of a scene's k colliders, or on each of its k boundaries, in their order, the
    guides of `Rigid` bodies that have some among them, after all others. Divided by the step they are its mean force
    and torque.

    Of a collider at a symmetry plane only the true nodes count, not their images; but springs push the faces of
    particles, and so all nodes.
    """

    impulse: Float[Array, "*f k d"]  # impulse [kg m/s], friction included
    angular: Float[Array, "*f k r"]
    """Angular impulse [kg m²/s] about the `pivot` of the boundary as it moves, of a collider the centre of its rotation
    or, without one, its shape's middle: r = 1 component in 2-D, 3 in 3-D, none in 1-D. Nodes and pivot are taken where
    they are at the time of the step's forces, t_n + θΔt, and in the total description where the body has moved the
    nodes. About these places the forces of the material have no moment."""

    def plus(self, later: "Impulses") -> "Impulses":
        """The sum of both."""
        return jax.tree.map(jnp.add, self, later)


def no_impulses(count: int, dim: int, dtype: Any) -> Impulses:
    """No impulse yet on a number of colliders or boundaries."""
    zeros = np.zeros((count, dim), dtype), np.zeros((count, len(pairs(dim))), dtype)
    return Impulses(*jax.device_put(zeros))  # by NumPy: each operation of JAX by itself is a program to compile


class OwnedCouple(eqx.Module):
    """A couple on a constrained body, and the boundary that gives it."""

    moment: Float[Array, "r"]  # [kg m²/s], shape (r,)
    owner: Int[Array, ""]  # the number of the boundary, −1 for none


def received_impulses(
    parts: Sequence[OwnedImpulse],
    positions: NodeVector,
    pivots: dict[int, Float[Array, "d"]],
    couples: Sequence[OwnedCouple] = (),
) -> Impulses:
    """The impulse on some boundaries, minus the parts that each gives the nodes and the couples that it gives bodies,
    from the positions of the nodes and, by the boundaries' numbers, the points for torques [m]."""

    def on(number: int, pivot: Array) -> tuple[Array, Array]:
        total = jnp.zeros_like(positions)
        for part in parts:
            if isinstance(part.owner, int):
                total = total + part.impulse if part.owner == number else total
            else:
                total = total + jnp.where(part.owner == number, part.impulse, 0)
        angular = moment(positions - pivot, total).sum(axis=0)
        angular = sum((jnp.where(couple.owner == number, couple.moment, 0) for couple in couples), angular)
        return -total.sum(axis=0), -angular

    each = [on(number, pivot) for number, pivot in pivots.items()]
    return Impulses(jnp.stack([linear for linear, _ in each]), jnp.stack([angular for _, angular in each]))


def taken_by_mirrors(field: NodeVector, images: Sequence[tuple[Any, Any]]) -> tuple[list[OwnedImpulse], NodeVector]:
    """The part of impulses on all nodes [kg m/s], shape (n, d), that mirrors take, and the impulses that remain on true
    nodes. The mirrors come in the order in which they unfold, with their boundaries' numbers.

    Where planes meet, each takes its normal component before the others fold it, so that its torque has the places of
    all nodes.
    """
    taken, remaining = [], jnp.zeros_like(field)
    planes = all(isinstance(image, Image | WallImage) for _, image in images)  # they commute
    for axis in range(field.shape[1]) if planes else [slice(None)]:
        part = jnp.zeros_like(field).at[:, axis].set(field[:, axis])
        order = list(reversed(images))
        if planes:
            order.sort(key=lambda pair: pair[1].axis != axis)
        for number, image in order:
            folded = Mirror((image,)).fold(part)
            taken.append(OwnedImpulse(part - folded, number))
            part = folded
        remaining = remaining + part
    return taken, remaining
