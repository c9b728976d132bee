"""Contact springs: the energy ½ Σ_p k_p g_p² of the gaps g_p that are shut, for a displacement of the nodes.

The gap is that of a particle's face, linear in the displacement u of the nodes about the start of the step,

    g_p(u) = g_p(0) + n_p · Σ_i (w_ip − b_p · g_ip) u_i,

where n is the surface's unit normal and x_p − b_p the particle's face, which moves by u − ∇u b. The force on the nodes,
−k_p g_p (w_ip − b_p · g_ip) n_p, acts at the face: its moment is that of −k_p g_p n_p there.
"""

from collections.abc import Sequence
from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector
from mpmjax.boundary._mirror import Mirror
from mpmjax.discretisation import Stencil, gather, scatter


class Springs(eqx.Module):
    """The springs between one surface, or two that face each other, and the particles: s is 1 or 2."""

    gap: Float[Array, "s p"]
    """g_p at u = 0 [m], shape (s, p); zero where nothing is held."""
    stiffness: Float[Array, "s p"]
    """k_p [N/m], shape (s, p); zero where nothing is held."""
    normal: Float[Array, "d p"]
    """n_p [-], out of the first surface, shape (d, p); the second one's is the opposite."""
    arm: Float[Array, "d p"]
    """b_p [m], from the face at the first surface to the centre, shape (d, p); the second one's is the opposite."""

    def opened(self, moved: tuple[Array, Array] | None) -> Float[Array, "s p"]:
        """The gap [m], shape (s, p), at a displacement of the nodes gathered at the particles, with its gradient; None
        for no displacement."""
        return self.gap if moved is None else self.gap + self.opening(moved)

    def opening(self, moved: tuple[Array, Array]) -> Float[Array, "s p"]:
        """n · (u − ∇u b) [m], shape (s, p)."""
        value, slopes = moved
        shift = (self.normal * value).sum(axis=0)
        growth = (self.normal[None] * self.arm[:, None] * slopes).sum(axis=(0, 1))
        return jnp.stack([sign * shift - growth for sign in SIGNS[: len(self.gap)]])

    def push(self, amount: Float[Array, "s p"]) -> tuple[Array, Array]:
        """What scattered is the force on the nodes by an amount along the normal at each face [N], shape (s, p)."""
        return along(amount) * self.normal, -amount.sum(axis=0) * self.arm[:, None] * self.normal[None]


SIGNS = (1, -1)
"""The directions of two surfaces that face each other, along the normal of the first."""


def along(amount: Float[Array, "s p"]) -> Float[Array, "p"]:
    """The sum of amounts along the normal of each surface, along that of the first."""
    return amount[0] if len(amount) == 1 else amount[0] - amount[1]


def spring_energy(springs: Sequence[Springs], moved: tuple[Array, Array]) -> Float[Array, ""]:
    """½ Σ_p k_p g_p² [J]."""
    parts = [0.5 * (one.stiffness * one.opened(moved) ** 2).sum() for one in springs]
    return sum(parts[1:], parts[0])


def spring_force(
    springs: Sequence[Springs], stencil: Stencil, mirror: Mirror, u: NodeVector | None, size: int
) -> NodeVector:
    """The force of springs on the nodes [N], shape (n, d), at a displacement [m]; None for no displacement."""
    moved = None if u is None else gather(stencil, mirror.unfold(u))
    pushes = _added([one.push(-one.stiffness * one.opened(moved)) for one in springs])
    return mirror.fold(scatter(stencil, *pushes, size))


def spring_resistance(springs: Sequence[Springs], stencil: Stencil, mirror: Mirror, du: NodeVector) -> NodeVector:
    """The springs' Hessian times a change of the displacement [N], shape (n, d)."""
    answer = spring_answer(springs, gather(stencil, mirror.unfold(du)))
    return mirror.fold(scatter(stencil, *answer, du.shape[0]))


def spring_answer(springs: Sequence[Springs], moved: tuple[Array, Array]) -> tuple[Array, Array]:
    """What scattered is the springs' Hessian times a displacement, from that displacement gathered at the particles."""
    return _added([one.push(one.stiffness * one.opening(moved)) for one in springs])


def spring_diagonal(springs: Sequence[Springs], stencil: Stencil, mirror: Mirror, size: int) -> NodeVector:
    """An approximation of the diagonal of their Hessian [N/m], shape (n, d), without the products of weights and their
    derivatives."""
    parts = []
    for one in springs:
        k = one.stiffness.sum(axis=0)
        parts.append((k * one.normal**2, k * (one.arm[:, None] * one.normal[None]) ** 2))
    value, slopes = _added(parts)
    nodes = scatter(stencil.squared, value, slopes, size)
    return mirror.fold_scalars(nodes)


def _added(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    values, slopes = zip(*parts, strict=True)
    return reduce(jnp.add, values), reduce(jnp.add, slopes)
