"""What velocities a system is solved for, and what is prescribed of the rest."""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Mask, NodeScalar, NodeVector, Scalar


class Projection(eqx.Module):
    """The projection Q of node vectors on the components that nothing holds; at a node with a held normal n, on those
    of them at right angles to it, I − n nᵀ.

    Without normals it is a mask, and nothing else is compiled.
    """

    free: Mask
    """Components that nothing prescribes, shape (n, d)."""
    normal: NodeVector | None = None
    """Held normals of length one, zero in components that are not free and where none is held, shape (n, d)."""

    def combine(self, a: NodeVector | Scalar, b: NodeVector | Scalar) -> NodeVector:
        """Q a + (I − Q) b."""
        if self.normal is None:
            return jnp.where(self.free, a, b)
        gap = (self.normal * jnp.where(self.free, b - a, 0)).sum(axis=1, keepdims=True)
        return jnp.where(self.free, a + self.normal * gap, b)

    def commuting_weight(self, weight: NodeVector) -> NodeVector:
        """A positive diagonal weight, changed so that it commutes with Q: 1 on components that are not free, and at a
        node with a held normal the mean over its components."""
        if self.normal is not None:
            oblique = (self.normal != 0).any(axis=1, keepdims=True)
            weight = jnp.where(oblique, weight.mean(axis=1, keepdims=True), weight)
        return jnp.where(self.free, weight, 1)

    def identity_rows(self, vector: NodeVector, mass: NodeScalar) -> Array:
        """What an operator has in the rows of I − Q: the vector, and along a held normal the vector times the node's
        mass, so that in an inner product of the mass or more it is not enlarged, however little a node has."""
        return vector if self.normal is None else jnp.where(self.free, mass[:, None], 1) * vector
