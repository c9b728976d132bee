"""Means over the nodes around each node."""

from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float


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
