"""The projection on the components of velocity that nothing holds."""

from functools import reduce

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Mask, NodeScalar, NodeVector, Scalar


class Projection(eqx.Module):
    """The projection Q of node vectors on the components that nothing holds. At a node with held normals n it also
    removes the components along them, I − Σ n nᵀ.

    Without normals it is a mask.
    """

    free: Mask
    """Whether nothing prescribes a component, shape (n, d)."""
    normals: tuple[NodeVector, ...] = ()
    """Held unit normals, each (n, d), at right angles where a node has several; zero in components that are not free,
    and at nodes without one."""

    def combine(self, a: NodeVector | Scalar, b: NodeVector | Scalar) -> NodeVector:
        """Q a + (I − Q) b."""
        if not self.normals:
            return jnp.where(self.free, a, b)
        gap = jnp.where(self.free, b - a, 0)
        held = reduce(jnp.add, (normal * (normal * gap).sum(axis=1, keepdims=True) for normal in self.normals))
        return jnp.where(self.free, a + held, b)

    def commuting_weight(self, weight: NodeVector) -> NodeVector:
        """A positive diagonal weight made to commute with Q: 1 in components that are not free, and the mean over its
        components at a node with a held normal."""
        for normal in self.normals:
            oblique = (normal != 0).any(axis=1, keepdims=True)
            weight = jnp.where(oblique, weight.mean(axis=1, keepdims=True), weight)
        return jnp.where(self.free, weight, 1)

    def identity_rows(self, vector: NodeVector, mass: NodeScalar) -> Array:
        """The part of an operator's product outside of the range of Q: the vector itself, and along a held normal the
        vector times the nodal mass. An inner product of the mass or more then does not enlarge it, at light nodes
        too."""
        return jnp.where(self.free, mass[:, None], 1) * vector if self.normals else vector
