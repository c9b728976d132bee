"""The impulse that colliders receive from the material in a step."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector
from mpmjax.boundary._conditions import ColliderConditions, Given
from mpmjax.geometry import moment
from mpmjax.linalg import pairs


class ColliderImpulse(eqx.Module):
    """Linear and angular impulse on each of k colliders. Divided by the step they are its mean force and torque.

    At a symmetry plane only the true nodes count, not their images; but springs push
    the faces of particles, and so all nodes.
    """

    impulse: Float[Array, "*f k d"]
    """Impulse [kg m/s], friction included."""
    angular: Float[Array, "*f k r"]
    """Angular impulse [kg m²/s] about the centre of the collider's rotation, or where it has none about its shape's
    middle, as it moves: of r = 1 component in 2-D, 3 in 3-D, none in 1-D. Nodes and centre are taken where they are at
    the time of the step's forces, t_n + θΔt. About these places the forces of the material have no moment."""

    def plus(self, later: "ColliderImpulse") -> "ColliderImpulse":
        """The sum of both."""
        return jax.tree.map(jnp.add, self, later)


def no_impulse(colliders: int, dim: int, dtype: Any) -> ColliderImpulse:
    """No impulse yet on a number of colliders."""
    return ColliderImpulse(jnp.zeros((colliders, dim), dtype), jnp.zeros((colliders, len(pairs(dim))), dtype))


def impulse_on_colliders(
    colliders: ColliderConditions,
    reaction: NodeVector,
    along_normals: tuple[Given, ...] = (),
    pushes: tuple[tuple[int, NodeVector], ...] = (),
) -> ColliderImpulse:
    """The impulse on each collider: minus what it gives the nodes by prescribed components, along normals, by springs
    and friction.

    Args:
        colliders: the conditions of the colliders, with which node and component is whose.
        reaction: the impulse of all that holds nodes, without springs and friction [kg m/s], shape (n, d).
        along_normals: the parts of it by colliders, along their normals.
        pushes: impulses by springs and friction on the nodes [kg m/s], shape (n, d), each with its collider's number.
    """
    impulse, angular = [], []
    for number, pivot in enumerate(colliders.pivots):
        given = jnp.where(colliders.holder == number, reaction, 0)
        given = sum((jnp.where(part.owner == number, part.impulse, 0) for part in along_normals), start=given)
        given = sum((push for owner, push in pushes if owner == number), start=given)
        impulse.append(-given.sum(axis=0))
        angular.append(-moment(colliders.position - pivot, given).sum(axis=0))
    return ColliderImpulse(jnp.stack(impulse), jnp.stack(angular))
