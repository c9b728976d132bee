"""Springs of contact: the energy ½ Σ k g² of the gaps g that are shut.

The gap of a particle's face is linear in the displacement u of the nodes about the start of the step,

    g_p(u) = g_p(0) + n_p · Σ_i (w_ip − b_p · g_ip) u_i,

where n is the surface's unit normal and x_p − b_p the particle's face, which moves by u − ∇u b. The force on the nodes,
−k_p g_p (w_ip − b_p · g_ip) n_p, acts at the face: its moment is that of −k_p g_p n_p there.

The gap between the surfaces of two bodies, at a node, is so too. Both bodies have a layer of nodes at the same places:

    g_i(u) = g_i(0) + n_i · Σ_j q_ij (u_j^a − u_j^b),    Σ_j q_ij = 1,

where n is the unit normal from the body b to the body a and q_ij the mean over the patch of nodes around i. The gap is
that of the particles around, which do not follow a node that moves by itself: with u_i in place of the mean the forces
would do work that the gap knows nothing of. The forces on the two nodes of a place are opposite, so that they have
neither sum nor moment.
"""

from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float
from mpmjax.potential import AbstractSpring, Displacement, Forces


class Springs(AbstractSpring):
    """The springs between one surface, or two that face each other, and the particles: s is 1 or 2."""

    stretch: Float[Array, "s p"]
    """g_p at u = 0 [m], shape (s, p); zero where nothing is held."""
    stiffness: Float[Array, "s p"]
    """k_p [N/m], shape (s, p); zero where nothing is held."""
    normal: Float[Array, "d p"]
    """n_p [-], out of the first surface, shape (d, p); the second one's is the opposite."""
    arm: Float[Array, "d p"]
    """b_p [m], from the face at the first surface to the centre, shape (d, p); the second one's is the opposite."""

    def elongation(self, moved: Displacement) -> Float[Array, "s p"]:
        """n · (u − ∇u b) [m], shape (s, p)."""
        value, slopes = moved.at_particles
        shift = (self.normal * value).sum(axis=0)
        growth = (self.normal[None] * self.arm[:, None] * slopes).sum(axis=(0, 1))
        return jnp.stack([sign * shift - growth for sign in SIGNS[: len(self.stretch)]])

    def spread(self, amount: Float[Array, "s p"], size: int) -> Forces:
        del size
        return Forces(value=along(amount) * self.normal, slopes=-amount.sum(axis=0) * self.arm[:, None] * self.normal)

    def spread_square(self, amount: Float[Array, "s p"], size: int) -> Forces:
        """Without the products of weights and their derivatives."""
        del size
        k = amount.sum(axis=0)
        return Forces(value=k * self.normal**2, slopes=k * (self.arm[:, None] * self.normal) ** 2)


SIGNS = (1, -1)
"""The directions of two surfaces that face each other, along the normal of the first."""


def along(amount: Float[Array, "s p"]) -> Float[Array, "p"]:
    """The sum of amounts along the normal of each surface, along that of the first."""
    return amount[0] if len(amount) == 1 else amount[0] - amount[1]


class Patch(eqx.Module):
    """The node itself and its neighbours, 3^d nodes around each node of one layer, with a weight each."""

    weight: Float[Array, "m"]
    """μ_j ≥ 0, in any unit, shape (m,)."""
    shape: tuple[int, ...] = eqx.field(static=True)
    """The grid's shape."""
    periodic: tuple[bool, ...] = eqx.field(static=True)
    """Periodic directions."""
    whole: Float[Array, "m"]
    """Σ_j μ_j over each patch, shape (m,); 1 where it is zero."""

    def __init__(self, weight: Float[Array, "m"], shape: tuple[int, ...], periodic: tuple[bool, ...]):
        self.weight, self.shape, self.periodic = weight, shape, periodic
        whole = self.total(weight)
        self.whole = jnp.where(whole > 0, whole, 1)

    def total(self, field: Array) -> Array:
        """Σ_j f_j over the patch around each node, of shape (m,) or (m, d) as the field is."""
        blocks = field.reshape(*self.shape, -1)
        for axis, periodic in enumerate(self.periodic):
            blocks = moment(blocks, axis, 0, reach=1, periodic=periodic)
        return blocks.reshape(field.shape)

    def mean(self, field: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """Σ_j μ_j f_j/Σ_j μ_j, shape (m, d); zero where no node of the patch has weight."""
        return self.total(self.weight[:, None] * field) / self.whole[:, None]

    def spread(self, amount: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """The transpose of `mean`: what each node has [shape (m, d)], shared among its patch by the weights."""
        return self.weight[:, None] * self.total(amount / self.whole[:, None])

    def spread_square(self, amount: Float[Array, "m d"]) -> Float[Array, "m d"]:
        """The patch with the squares of the shares."""
        return self.weight[:, None] ** 2 * self.total(amount / self.whole[:, None] ** 2)


def moment(blocks: Array, axis: int, power: int, *, reach: int, periodic: bool) -> Array:
    """Σ_k k^power f_{i+k} along an axis of nodes, k from −reach to reach."""
    around = [(reach, reach) if own == axis else (0, 0) for own in range(blocks.ndim)]
    wide = jnp.pad(blocks, around, mode="wrap" if periodic else "constant")
    parts = [
        k**power * jax.lax.slice_in_dim(wide, k + reach, k + reach + blocks.shape[axis], axis=axis)
        for k in range(-reach, reach + 1)
        if k != 0 or power == 0
    ]
    return reduce(jnp.add, parts)


class Coupling(AbstractSpring):
    """The springs between two bodies."""

    stretch: Float[Array, "m"]
    """g_i at u = 0 [m], shape (m,); zero where nothing is held."""
    stiffness: Float[Array, "m"]
    """k_i [N/m], shape (m,); zero where nothing is held."""
    normal: Float[Array, "m d"]
    """n_i [-], shape (m, d)."""
    patch: Patch
    """The nodes over which displacements are averaged, by c_a c_b/(c_a + c_b) of the two bodies."""
    pair: tuple[int, int] = eqx.field(static=True)
    """The numbers of the bodies a and b."""

    def elongation(self, moved: Displacement) -> Float[Array, "m"]:
        """n_i · Σ_j q_ij (u_j^a − u_j^b) [m], shape (m,)."""
        layers = moved.nodes.reshape(-1, *self.normal.shape)
        first, second = self.pair
        return (self.normal * self.patch.mean(layers[first] - layers[second])).sum(axis=1)

    def spread(self, amount: Float[Array, "m"], size: int) -> Forces:
        return self._on_both(self.patch.spread(amount[:, None] * self.normal), -1, size)

    def spread_square(self, amount: Float[Array, "m"], size: int) -> Forces:
        return self._on_both(self.patch.spread_square(amount[:, None] * self.normal**2), 1, size)

    def _on_both(self, own: Float[Array, "m d"], sign: int, size: int) -> Forces:
        first, second = self.pair
        nodes = jnp.zeros((size // len(own), *own.shape), own.dtype)
        return Forces(nodes=nodes.at[first].add(own).at[second].add(sign * own).reshape(size, -1))
