"""Coulomb friction at nodes: an impulse after the solve, opposed to what slides.

It takes the share min(1, limit/(m ‖s‖)) of the slip s. Where that is 1 the node sticks, and the derivative is that of
sticking: d(s after)/ds = 0, at rest too, where s = 0. At the kink, limit = m ‖s‖, it is the one on the side of
sticking. Where nothing pushes there is no friction and no derivative of it.
"""

import jax.numpy as jnp

from mpmjax._types import NodeScalar, NodeVector
from mpmjax.boundary._conditions import PARALLEL
from mpmjax.boundary._contact import ConstrainedNodes


def friction_across(held: ConstrainedNodes, axis: int, limit: NodeScalar, v: NodeVector) -> NodeVector:
    """The change of velocity by friction on walls at right angles to an axis [m/s], shape (n, d).

    Args:
        held: the nodes with an active set held.
        axis: the wall's normal.
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
        v: velocity of all nodes [m/s], shape (n, d).
    """
    tangent = jnp.arange(v.shape[1]) != axis
    slip = _across(jnp.where(tangent, v, 0), [jnp.where(tangent, normal, 0) for normal in held.normals])
    free = tangent & ~held.unheld.conditions.fixed
    return -jnp.where(free, share_taken(slip, held.mass, limit)[:, None] * slip, 0)


def friction_along(
    held: ConstrainedNodes, normal: NodeVector, moving: NodeVector, limit: NodeScalar, v: NodeVector
) -> NodeVector:
    """The change of velocity by friction on a surface of any direction [m/s], shape (n, d): −min(1, limit/(m ‖s‖)) s
    with the slip s, the tangential part of v − v_c.

    Args:
        held: the nodes with an active set held.
        normal: a multiple of the surface's normal at each node, shape (n, d); zero where it does not push.
        moving: velocity v_c of the surface [m/s], shape (n, d).
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
        v: velocity of all nodes [m/s], shape (n, d).
    """
    square = (normal**2).sum(axis=1)
    unit = normal / jnp.sqrt(jnp.where(square == 0, 1, square))[:, None]
    free = held.nodes.free
    slip = _across(jnp.where(free, v - moving, 0), [*held.normals, jnp.where(free, unit, 0)])
    pushed = jnp.where(square > 0, limit, 0)
    return -share_taken(slip, held.nodes.mass, pushed)[:, None] * slip


def _across(v: NodeVector, directions: list[NodeVector]) -> NodeVector:
    """A velocity without its parts along some directions, each (n, d), of length one or less. One that lies within a
    hundredth of those before it changes nothing."""
    earlier = []
    for along in directions:
        for unit in earlier:
            along = along - unit * (unit * along).sum(axis=1, keepdims=True)
        square = (along**2).sum(axis=1, keepdims=True)
        some = square > PARALLEL**2
        unit = jnp.where(some, along / jnp.sqrt(jnp.where(some, square, 1)), 0)
        v = v - unit * (unit * v).sum(axis=1, keepdims=True)
        earlier.append(unit)
    return v


def share_taken(slip: NodeVector, mass: NodeScalar, limit: NodeScalar) -> NodeScalar:
    """The share of the slip that friction takes, min(1, limit/(m ‖s‖)), shape (n,).

    Args:
        slip: s [m/s], shape (n, d).
        mass: the mass that slides at each node [kg], shape (n,).
        limit: the largest impulse of friction at each node [kg m/s], shape (n,).
    """
    square = (slip**2).sum(axis=1)
    moves = (square > 0) & (mass > 0)
    stopping = mass * jnp.sqrt(jnp.where(moves, square, 1))
    slides = moves & (stopping > limit)
    return jnp.where(slides, limit / jnp.where(slides, stopping, 1), jnp.where((limit > 0) & (mass > 0), 1, 0))
