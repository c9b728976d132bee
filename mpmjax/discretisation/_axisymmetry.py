"""Axisymmetry: bodies of revolution on a grid of their section, with coordinates (r, z) and the axis at r = 0.

In the Material Point Method: D. Sulsky, H. L. Schreyer, Comput. Methods Appl. Mech. Eng. 139 (1996) 409, doi
10.1016/S0045-7825(96)01091-2. A particle is a ring of section A: V0 = 2π r0 A and m = ρ V0, which `fill` gives it, so
masses and forces are those of the whole circle. Its gradient operator has a component more, the hoop's w_ip/r_p:

    ∇u = Σ_i u_i ⊗ ∇w_ip + (Σ_i w_ip u_i,r / r_p) e_θ ⊗ e_θ,    f_i = −Σ_p V0 (τ_p ∇w_ip + τ_p,θθ w_ip/r_p e_r).

f is the derivative of Σ V0 Ψ(F) by u, so that work, the symmetry of the Hessian and momentum along z are kept. F is a
3x3 matrix whose hoop entry stays r/r0 exactly in both descriptions, since a particle moves with what stretches it, and
every law is that of three dimensions. r_p is taken where the stencil stands: now, or in the total description at the
start. Of particles all is done here: a matrix of theirs is (3, 3, p), and what the nodes are given and give is (2, p)
and (2, 2, p). The mirror that a scene puts at the axis keeps u_r/r finite there, u_r being odd in r.
"""

import jax.numpy as jnp

from mpmjax._types import Array, Float


def in_space(
    radius: Float[Array, "p"], value: Float[Array, "2 p"], slopes: Float[Array, "2 2 p"]
) -> Float[Array, "3 3 p"]:
    """The slopes of a field in space, from its value and slopes in the section: with u_r/r around the axis."""
    return jnp.pad(slopes, ((0, 1), (0, 1), (0, 0))).at[2, 2].set(value[0] / radius)


def in_section(
    radius: Float[Array, "p"], slopes: Float[Array, "3 3 p"]
) -> tuple[Float[Array, "2 p"], Float[Array, "2 2 p"]]:
    """The transpose of `in_space`: what particles give to the value and to the slopes in the section."""
    hoop = slopes[2, 2] / radius
    return jnp.stack([hoop, jnp.zeros_like(hoop)]), slopes[:2, :2]
