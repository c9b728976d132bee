"""Contact springs: the energy ½ Σ_p k_p g_p² of the gaps g_p that are shut, for a displacement of the nodes.

The gap is that of a particle's face, linear in the displacement u of the nodes about the start of the step,

    g_p(u) = g_p(0) + n_p · Σ_i w_ip u_i − B_p : Σ_i u_i g_ipᵀ,

where n is the surface's unit normal and B : ∇u the growth of the particle's half-width along it. The force on the
nodes, −k_p g_p (w_ip n_p − B_p g_ip), acts at the particle's face: its moment is that of −k_p g_p n_p there.
"""

from collections.abc import Sequence
from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, Matrix, NodeVector
from mpmjax.boundary._mirror import Mirror
from mpmjax.discretisation import Stencil, gather, scatter


class Springs(eqx.Module):
    """The springs between one surface and the particles."""

    gap: Float[Array, "p"]
    """g_p at u = 0 [m], shape (p,); zero where nothing is held."""
    stiffness: Float[Array, "p"]
    """k_p [N/m], shape (p,); zero where nothing is held."""
    normal: Float[Array, "d p"]
    """n_p [-], out of the surface, shape (d, p)."""
    widening: Matrix
    """B_p [m], shape (d, d, p)."""

    def opened(self, moved: tuple[Array, Array] | None) -> Float[Array, "p"]:
        """The gap [m], shape (p,), at a displacement of the nodes gathered at the particles, with its gradient; None
        for no displacement."""
        return self.gap if moved is None else self.gap + self.opening(moved)

    def opening(self, moved: tuple[Array, Array]) -> Float[Array, "p"]:
        """n·u − B : ∇u [m], shape (p,)."""
        value, slopes = moved
        return (self.normal * value).sum(axis=0) - (self.widening * jnp.swapaxes(slopes, 0, 1)).sum(axis=(0, 1))

    def push(self, amount: Float[Array, "p"]) -> tuple[Array, Array]:
        """What scattered is the force on the nodes by an amount along the normal at each face [N], shape (p,)."""
        return amount * self.normal, -amount * jnp.swapaxes(self.widening, 0, 1)


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
    parts = [(one.stiffness * one.normal**2, one.stiffness * jnp.swapaxes(one.widening, 0, 1) ** 2) for one in springs]
    value, slopes = _added(parts)
    nodes = scatter(stencil.squared, value, slopes, size)
    return mirror.fold_scalars(nodes)


def _added(parts: list[tuple[Array, Array]]) -> tuple[Array, Array]:
    values, slopes = zip(*parts, strict=True)
    return reduce(jnp.add, values), reduce(jnp.add, slopes)
