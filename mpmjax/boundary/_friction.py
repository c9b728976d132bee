"""Coulomb friction at nodes: an impulse after the solve, opposed to the slip.

It takes the share min(1, limit/(m ‖s‖)) of the slip s. Where that is 1 the node sticks, and the derivative is that of
sticking: d(s after)/ds = 0, at rest too, where s = 0. At the kink, limit = m ‖s‖, it is the one on the side of
sticking. Where nothing pushes there is no friction and no derivative of it.
"""

from typing import Any

import jax.numpy as jnp

from mpmjax._types import Array, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._conditions import PARALLEL


def friction_change(
    projection: Any, mass: NodeScalar, normal: Array, velocity: NodeVector | Scalar, limit: NodeScalar, v: NodeVector
) -> NodeVector:
    """The change of velocity by friction on a surface [m/s], shape (n, d): −min(1, limit/(m ‖s‖)) s with the slip s,
    the part of v − v_c along the surface and in directions that nothing else holds.

    Args:
        projection: the projection on what nothing else holds, of the nodes with the active set held.
        mass: their mass m [kg], shape (n,).
        normal: a multiple of the surface's normal, of all nodes or of shape (n, d); zero where it does not push.
        velocity: velocity v_c of the surface [m/s], shape (n, d); zero at rest.
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
        v: velocity of all nodes [m/s], shape (n, d).
    """
    square = (normal**2).sum(axis=-1, keepdims=True)
    unit = normal / jnp.sqrt(jnp.where(square == 0, 1, square))
    free, relative, earlier = projection.free, v - velocity, []
    slip = jnp.where(free, relative, 0)
    # without its parts along what colliders hold and the normal; one within a hundredth of those before changes nothing
    for along in [*projection.normals, jnp.where(free, unit, 0)]:
        for other in earlier:
            along = along - other * (other * along).sum(axis=1, keepdims=True)
        length = (along**2).sum(axis=1, keepdims=True)
        some = length > PARALLEL**2
        along = jnp.where(some, along / jnp.sqrt(jnp.where(some, length, 1)), 0)
        slip = slip - along * (along * slip).sum(axis=1, keepdims=True)
        earlier.append(along)
    # what slides along the surface as another boundary prescribes takes its part of the limit
    whole = slip + jnp.where(free | (unit != 0), 0, relative)
    share = friction_share(whole, mass, jnp.where(square[..., 0] > 0, limit, 0))
    return -share[:, None] * slip


def friction_share(slip: NodeVector, mass: NodeScalar, limit: NodeScalar) -> NodeScalar:
    """The share of the slip s [m/s], shape (n, d), that friction takes, min(1, limit/(m ‖s‖)), shape (n,), of a mass
    [kg] and a largest impulse [kg m/s], shape (n,)."""
    square = (slip**2).sum(axis=1)
    moves = (square > 0) & (mass > 0)
    stopping = mass * jnp.sqrt(jnp.where(moves, square, 1))
    slides = moves & (stopping > limit)
    return jnp.where(slides, limit / jnp.where(slides, stopping, 1), jnp.where((limit > 0) & (mass > 0), 1, 0))
