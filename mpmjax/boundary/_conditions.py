"""The conditions of boundaries on the nodes: prescribed velocities, and those of colliders."""

from dataclasses import replace
from functools import reduce
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector

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
