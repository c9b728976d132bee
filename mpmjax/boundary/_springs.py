"""Contact springs on the faces of particles: the energy ½ Σ_p k_p g_p² of the gaps g_p that are shut.

The gap is that of a particle's face, linear in the displacement u of the nodes about the start of the step,

    g_p(u) = g_p(0) + n_p · Σ_i (w_ip − b_p · g_ip) u_i,

where n is the surface's unit normal and x_p − b_p the particle's face, which moves by u − ∇u b. The force on the nodes,
−k_p g_p (w_ip − b_p · g_ip) n_p, acts at the face: its moment is that of −k_p g_p n_p there.
"""

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
