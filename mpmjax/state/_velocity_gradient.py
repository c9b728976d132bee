"""The velocity gradient of particles that have velocities and no gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import ParticleMatrix, components, particle_first
from mpmjax.discretisation import APIC, average, gather
from mpmjax.state._particles import Particles
from mpmjax.state._scene import Scene

_FLAT_POWER = 0.6
"""Power of the rounding ε: neighbours whose spread in a direction is ε^0.6 of a whole stencil's say nothing of it."""
_ROUNDING = 1e3
"""Changes of velocity over a spacing below so many roundings are set to zero."""


@eqx.filter_jit
def velocity_gradient(scene: Scene, particles: Particles) -> ParticleMatrix:
    """The velocity gradient C [1/s] of prepared particles by the velocities of their neighbours, shape (p, d, d).

    It is the slope of the linear field that fits, by least squares, the mean velocities v̄_i that the nodes of a
    particle's stencil have at the middle x̄_i of their mass,

        C = Q M⁻¹,    Q = Σ_i w_ip v̄_i (x̄_i − ȳ)ᵀ,    M = Σ_i w_ip (x̄_i − ȳ)(x̄_i − ȳ)ᵀ,    ȳ = Σ_i w_ip x̄_i,

    so that it is that of a linear field at free surfaces too, and linear in the velocities. In directions in which the
    neighbours do not spread, it is zero.
    """
    affine = eqx.tree_at(lambda s: s.transfer, scene, APIC())  # for the gradient of moving least squares
    stencil, size = affine.stencil(particles).least_squares, scene.grid.size
    v = components(particles.v)
    d, D, at_rest = len(v), stencil.moment, jnp.zeros_like(v)
    axes = la.identity_like(jnp.zeros((d, *v.shape), v.dtype))

    # at the nodes v̄_i less the velocity of one particle, and s_i = x̄_i − x_i, where w_ip (x_i − x_p) = D g_ip
    mass = particles.mass
    rows, slopes = jnp.concatenate([v - v[:, :1], at_rest]), jnp.concatenate([jnp.zeros_like(axes), -D * axes])
    least = jnp.finfo(v.dtype).eps * mass.min()
    _, nodes = average(stencil, mass, mass * rows, jnp.swapaxes(mass * slopes, 0, 1), least, size)
    products = nodes[:, :, None] * nodes[:, None, d:]
    value, gradient = gather(stencil, jnp.concatenate([nodes, products.reshape(size, -1)], axis=1))

    # Σ_i w a_i (x̄_i − x_p)ᵀ of a = v̄ and s, where Σ_i w a_i (x_i − x_p)ᵀ = ∇a D
    mean, shift = value[: 2 * d], value[d : 2 * d]
    along = jnp.swapaxes(gradient[:, : 2 * d], 0, 1) * D
    moments = along + value[2 * d :].reshape(2 * d, d, -1) - mean[:, None] * shift
    Q, M = moments[:d], moments[d:] + la.transpose(along[d:]) + D * axes
    M = M / scene.grid.spacing**2
    square = la.matmul(M, M) + (jnp.finfo(v.dtype).eps ** _FLAT_POWER / 4) ** 2 * axes
    inverse = la.matmul(M, la.cofactor(square)) / la.determinant(square)  # M⁻¹, and zero where M is
    C = la.matmul(Q, inverse) / scene.grid.spacing**2
    small = jnp.abs(C) * scene.grid.spacing <= _ROUNDING * jnp.finfo(v.dtype).eps * jnp.abs(v).max()
    return particle_first(C - jax.lax.stop_gradient(jnp.where(small, C, 0)))
