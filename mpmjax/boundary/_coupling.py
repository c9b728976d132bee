"""Springs between two bodies: the energy ½ Σ_i k_i g_i² of the gaps g_i between their surfaces at the nodes.

Both bodies have a layer of nodes at the same places. The gap is linear in the displacement u of the nodes about the
start of the step,

    g_i(u) = g_i(0) + n_i · Σ_j q_ij (u_j^a − u_j^b),    Σ_j q_ij = 1,

where n is the unit normal from the body b to the body a and q_ij the mean over the patch of nodes around i. The gap is
that of the particles around, which do not follow a node that moves by itself: with u_i in place of the mean the forces
would do work that the gap knows nothing of. The forces on the two nodes of a place are opposite, so that they have
neither sum nor moment.
"""

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Float, NodeVector
from mpmjax.boundary._patch import Patch


class Coupling(eqx.Module):
    """The springs between two bodies."""

    gap: Float[Array, "m"]
    """g_i at u = 0 [m], shape (m,); zero where nothing is held."""
    stiffness: Float[Array, "m"]
    """k_i [N/m], shape (m,); zero where nothing is held."""
    normal: Float[Array, "m d"]
    """n_i [-], shape (m, d)."""
    patch: Patch
    """The nodes over which displacements are averaged, by c_a c_b/(c_a + c_b) of the two bodies."""
    pair: tuple[int, int] = eqx.field(static=True)
    """The numbers of the bodies a and b."""

    def opening(self, u: NodeVector) -> Float[Array, "m"]:
        """n_i · Σ_j q_ij (u_j^a − u_j^b) [m], shape (m,), for a displacement of the nodes of all layers, (n, d)."""
        layers = u.reshape(-1, *self.normal.shape)
        first, second = self.pair
        return (self.normal * self.patch.mean(layers[first] - layers[second])).sum(axis=1)

    def opened(self, u: NodeVector | None) -> Float[Array, "m"]:
        """The gap [m], shape (m,), at a displacement of the nodes; None for no displacement."""
        return self.gap if u is None else self.gap + self.opening(u)

    def energy(self, u: NodeVector) -> Float[Array, ""]:
        """½ Σ_i k_i g_i² [J]."""
        return 0.5 * (self.stiffness * self.opened(u) ** 2).sum()

    def force(self, u: NodeVector | None, size: int) -> NodeVector:
        """The force on the nodes of all layers [N], shape (n, d), at a displacement; None for no displacement."""
        return self.pushed(-self.stiffness * self.opened(u), size)

    def resistance(self, du: NodeVector) -> NodeVector:
        """Their Hessian times a change of the displacement [N], shape (n, d)."""
        return self.pushed(self.stiffness * self.opening(du), len(du))

    def diagonal(self, size: int) -> NodeVector:
        """The diagonal of their Hessian [N/m], shape (n, d)."""
        return self._on_both(self.patch.spread_square(self.stiffness[:, None] * self.normal**2), 1, size)

    def pushed(self, amount: Float[Array, "m"], size: int) -> NodeVector:
        """An amount along the normal at each place, spread on the nodes of the first body, and against it on those of
        the second, shape (n, d)."""
        return self._on_both(self.patch.spread(amount[:, None] * self.normal), -1, size)

    def _on_both(self, own: Float[Array, "m d"], sign: int, size: int) -> NodeVector:
        first, second = self.pair
        nodes = jnp.zeros((size // len(own), *own.shape), own.dtype)
        return nodes.at[first].add(own).at[second].add(sign * own).reshape(size, -1)
