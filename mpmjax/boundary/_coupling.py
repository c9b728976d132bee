"""Springs between two bodies: the energy ½ Σ_i k_i g_i² of the gaps g_i between their surfaces at the nodes.

Both bodies have a layer of nodes at the same places. The gap is linear in the displacement u of the nodes about the
start of the step,

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


class Patch(eqx.Module):
    """The node itself and its neighbours, 3^d nodes around each node of one layer, with a weight each."""

    weight: Float[Array, "m"]
    """μ_j ≥ 0, in any unit, shape (m,)."""
    shape: tuple[int, ...] = eqx.field(static=True)
    """The grid's shape."""
    periodic: tuple[bool, ...] = eqx.field(static=True)
    """Its periodic directions."""
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
        """The same with the squares of the shares."""
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
