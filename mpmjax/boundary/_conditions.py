"""Effects of boundaries on the nodes: prescribed velocities and those of colliders, and the impulses that colliders and
boundaries receive from the material in a step.

The impulses of all boundaries together are a partition of what the nodes receive besides gravity, body forces and the
material's own forces, but for the residual of the solve. So their sum is minus the change of the particles' momentum
that these leave, to rounding.

At a mirror plane the nodes' equations are folded, Bᵀ(...) (see `_mirror`). What the folding takes from the impulses of
all nodes is the plane's; what remains, on true nodes, belongs to the boundary that prescribes the component there.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Int, Mask, NodeScalar, NodeVector
from mpmjax.geometry import moment
from mpmjax.linalg import pairs
from mpmjax.potential import Image, Mirror, WallImage

PARALLEL = 1e-2  # length of a unit normal's part in free directions up to which it is prescribed by the others


class OwnedImpulse(eqx.Module):
    """Impulses on the nodes, and the boundaries or colliders that give them."""

    impulse: NodeVector  # [kg m/s], shape (n, d)
    owner: Int[Array, "..."] | int
    """The number of the boundary or collider, −1 for none: of all nodes, or of shape (n, 1) or (n, d)."""


class Slide(eqx.Module):
    """A collider that holds the nodes in it along its normal."""

    normal: NodeVector  # unit normal out of it, shape (n, d); zero at nodes that it does not hold
    velocity: NodeVector  # velocity of the collider at the nodes [m/s], shape (n, d)
    number: int = eqx.field(static=True, default=0)  # number of the boundary that it is


class FreeNormal(eqx.Module):
    """A collider's normal at each node, and its part in free components at right angles to those of earlier ones."""

    normal: NodeVector  # the collider's unit normal, shape (n, d)
    owner: Int[Array, "n"]  # the collider's number among the boundaries, shape (n,); −1 where there is no such part
    direction: NodeVector  # unit vector along that part, shape (n, d); zero where there is none
    length: NodeScalar  # length of that part [-], shape (n,); 1 where there is none
    speed: NodeScalar  # velocity along it [m/s], shape (n,), at which the whole normal velocity is that of the collider

    def where(self, mask: Bool[Array, "n"], other: "FreeNormal") -> "FreeNormal":
        """This one at nodes of the mask, the other one elsewhere."""
        return jax.tree.map(lambda a, b: jnp.where(mask if a.ndim == 1 else mask[:, None], a, b), self, other)


class Conditions(eqx.Module):
    """The conditions of boundaries on the window's nodes."""

    fixed: Mask  # components of velocity that are prescribed, shape (n, d)
    velocity: NodeVector  # their values [m/s], shape (n, d); zero elsewhere
    slides: tuple[Slide, ...] = ()  # the colliders that hold nodes along their normal alone, in the scene's order
    owner: Int[Array, "n d"] | None = None
    """The number of the boundary that prescribes each component, −1 for none; None of one boundary by itself."""
    holds: bool = eqx.field(static=True, default=True)
    """Whether any component may be held. What is known here costs a step nothing where the answer is no."""
    moves: bool = eqx.field(static=True, default=True)
    """Whether one may be held at another velocity than zero, by a collider too."""

    @property
    def touched(self) -> Bool[Array, "n"]:
        """The nodes of which any component is held, shape (n,)."""
        return reduce(jnp.logical_or, (slide.normal.any(axis=1) for slide in self.slides), self.fixed.any(axis=1))

    def free_normals(self, free: Mask) -> tuple[FreeNormal, ...]:
        """The parts of the colliders' normals in free components, made orthogonal in the colliders' order, as many as a
        node can have.

        With components a prescribed, n·v = n·v_c becomes Σ_free n v = n·v_c − Σ_a n_a v_a, and so for earlier parts.

        Args:
            free: the components that nothing prescribes, shape (n, d).
        """
        parts: list[FreeNormal] = []
        for slide in self.slides:
            part = jnp.where(free, slide.normal, 0)
            missing = (slide.normal * (slide.velocity - jnp.where(free, 0, self.velocity))).sum(axis=1)
            for other in parts:
                share = (part * other.direction).sum(axis=1)
                part, missing = part - share[:, None] * other.direction, missing - share * other.speed
            square = (part**2).sum(axis=1)
            some = square > PARALLEL**2
            length = jnp.sqrt(jnp.where(some, square, 1))
            new = FreeNormal(
                normal=slide.normal,
                owner=jnp.where(some, jnp.int32(slide.number), -1),
                direction=jnp.where(some[:, None], part / length[:, None], 0),
                length=length,
                speed=jnp.where(some, missing / length, 0),
            )
            # as many places as directions, whichever colliders reach a node: few of many reach the same one
            for place, old in enumerate(parts):  # goes into the first place that is empty at each node
                taken = old.owner >= 0
                parts[place] = old.where(taken, new)
                new = new.where(taken, jax.tree.map(jnp.zeros_like, new))
                new = replace(new, owner=jnp.where(taken, new.owner, -1), length=jnp.where(taken, new.length, 1))
            if len(parts) < free.shape[1]:
                parts.append(new)
        return tuple(parts)


def no_conditions(nodes: NodeVector) -> Conditions:
    """No condition on these nodes, shape (n, d)."""
    return Conditions(jnp.zeros(nodes.shape, dtype=bool), jnp.zeros_like(nodes), holds=False, moves=False)


def prescribed(fixed: Mask, velocity: NodeVector | None, dtype: Any) -> Conditions:
    """Components that are held, shape (n, d), at rest or with a velocity of all nodes [m/s], shape (n, d)."""
    if velocity is None:
        return Conditions(fixed, jnp.zeros(fixed.shape, dtype), moves=False)
    return Conditions(fixed, jnp.where(fixed, velocity, 0))


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
