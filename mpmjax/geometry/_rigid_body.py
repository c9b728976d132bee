"""Rigid bodies: mass, centre, inertia and motion of a set of particles, and how it turns."""

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, ParticleVector, Scalar
from mpmjax.geometry._motion import turn

_NEWTON = 6
"""Steps of Newton's method for the mean angular momentum in a body's frame, and for the rotation of chords. The first
error is of the order of the angle of a step, and squared by each; three would do at a tenth of a radian."""


class RigidBody(eqx.Module):
    """A set of particles that move as one: r = 0, 1 or 3 numbers of rotation in one, two and three dimensions."""

    mass: Float[Array, ""]  # M [kg]
    centre: Float[Array, "d"]  # c, the centre of mass [m]
    velocity: Float[Array, "d"]  # V [m/s], that of the centre
    spin: Float[Array, "r"]  # ω [rad/s]
    inertia: Float[Array, "r r"]  # I about the centre [kg m²]
    arms: ParticleVector  # x_p − c [m], shape (p, d)

    def root(self) -> Float[Array, "r r"]:
        """G [m] with GᵀG = I/M, so that the energy ½ ω·Iω is ½ M ‖Gω‖²."""
        scaled = self.inertia / self.mass
        return jnp.sqrt(scaled) if len(scaled) < 2 else jnp.linalg.cholesky(scaled).T


def rigid_body(x: ParticleVector, v: ParticleVector, mass: Float[Array, "p"], volume: Float[Array, "p"]) -> RigidBody:
    """The rigid body of some particles. Its momentum is theirs; its spin is that which has their angular momentum
    Σ r × m v. To its inertia that of each particle's cell about its own middle is added, of m a²/6.

    Args:
        x: positions [m], shape (p, d), not all of them on one line in 3-D, nor at one point in 2-D.
        v: velocities [m/s], shape (p, d).
        mass: masses [kg], shape (p,).
        volume: volumes [m^d], shape (p,), a cube of side a each.
    """
    total, d = mass.sum(), x.shape[1]
    centre = (mass[:, None] * x).sum(axis=0) / total
    velocity = (mass[:, None] * v).sum(axis=0) / total
    arms = x - centre
    momentum = moment(arms, mass[:, None] * (v - velocity)).sum(axis=0)
    axes, of_points = jnp.eye(len(momentum), dtype=x.dtype), inertia(arms, mass)
    of_cells = (mass * volume ** (2 / d)).sum() / 6
    spin = momentum if d == 1 else jnp.linalg.solve(of_points, momentum)
    return RigidBody(total, centre, velocity, spin, of_points + of_cells * axes, arms)


def inertia(arms: Float[Array, "m d"], mass: Float[Array, "m"]) -> Float[Array, "r r"]:
    """Σ m (‖r‖² 1 − r rᵀ) [kg m²] of points, (1, 1) in 2-D, where it is Σ m ‖r‖², and (0, 0) in 1-D."""
    d = arms.shape[1]
    of_axes = (mass * (arms**2).sum(axis=1)).sum() * jnp.eye(d * (d - 1) // 2, dtype=arms.dtype)
    return of_axes if d < 3 else of_axes - (mass * arms.T) @ arms


def moment(arm: Float[Array, "m d"], force: Float[Array, "m d"]) -> Float[Array, "m r"]:
    """arm × force: (r_y f_z − r_z f_y, r_z f_x − r_x f_z, r_x f_y − r_y f_x), in 2-D the last alone, in 1-D nothing."""
    d = arm.shape[1]
    if d == 3:
        return jnp.cross(arm, force)
    if d == 1:
        return jnp.zeros((len(arm), 0), arm.dtype)
    return (arm[:, 0] * force[:, 1] - arm[:, 1] * force[:, 0])[:, None]


def spinning(spin: Float[Array, "r"], arms: Float[Array, "m d"]) -> Float[Array, "m d"]:
    """ω × r, shape (m, d)."""
    d = arms.shape[1]
    if d == 3:
        return jnp.cross(spin, arms)
    if d == 1:
        return jnp.zeros_like(arms)
    return spin[0] * jnp.stack([-arms[:, 1], arms[:, 0]], axis=1)


def rotation_of(body: RigidBody, momentum: Float[Array, "r"], dt: Scalar) -> Float[Array, "d d"]:
    """The rotation R in a step in which a body has a constant angular momentum [kg m²/s], shape (r,).

    In 2-D the angle is Δt L/I. In 3-D it is the midpoint rule of Euler's equations in the body's frame, Π' = Π × I⁻¹Π,

        Π_1 − Π_0 = τ Π × Ω,    Π = ½ (Π_0 + Π_1),    Ω = I⁻¹Π,    R = exp(Δt Ω),    τ = Δt tan(½ Δt ‖Ω‖)/(½ Δt ‖Ω‖),

    which keeps Π·Π and the energy ½ Π·I⁻¹Π (E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration, 2nd ed.
    2006, IV.2: it keeps quadratic invariants) with R Π_1 = Π_0, so that angular momentum in space is constant. With
    this τ for Δt rotation about a principal axis is exact; else it is of second order.
    """
    d = body.arms.shape[1]
    axes = jnp.eye(d, dtype=body.arms.dtype)
    if d == 1:
        return axes
    if d == 2:
        return turn(axes, dt * momentum / body.inertia[0]).T
    inverse = jnp.linalg.inv(body.inertia)

    def missing(mean: Array) -> Array:
        spin = inverse @ mean
        square = (dt / 2) ** 2 * (spin**2).sum()
        small = square < 1e-3  # where τ/Δt is its series, to the last digit
        half = jnp.sqrt(jnp.where(small, 1, square))
        series = 1 + square / 3 + 2 * square**2 / 15 + 17 * square**3 / 315 + 62 * square**4 / 2835
        tau = dt * jnp.where(small, series, jnp.tan(half) / half)
        return mean - momentum - tau / 2 * jnp.cross(mean, spin)

    mean = momentum
    for _ in range(_NEWTON):
        mean = mean - jnp.linalg.solve(jax.jacfwd(missing)(mean), missing(mean))
    return turn(axes, dt * inverse @ mean).T


def rotation_of_chords(
    arms: Float[Array, "m d"], chords: Float[Array, "m d"], mass: Float[Array, "m"]
) -> Float[Array, "r"]:
    """The angle or rotation vector [rad] by which points turn that move along chords, u = R r − r: that with

        Σ m r × (R r − r) = Σ m r × u.

    Of chords that are no rotation's it is one near them. Points that leave a direction open do not turn about it.

    Args:
        arms: places r before, from their middle [m], shape (m, d).
        chords: displacements u [m], less their mean, shape (m, d).
        mass: weights, shape (m,). Where all are zero nothing turns.
    """
    d, axes = arms.shape[1], jnp.eye(arms.shape[1], dtype=arms.dtype)
    torque = moment(arms, mass[:, None] * chords).sum(axis=0)
    if d == 1:
        return torque
    second = (mass * arms.T) @ arms  # Σ m r rᵀ
    size = jnp.trace(second)
    per_size = 1 / jnp.where(size > 0, size, 1)
    least = jnp.sqrt(jnp.finfo(arms.dtype).eps) if d == 3 else 0.0  # of points on one line
    second = per_size * second + jnp.where(size > 0, least, 1) * axes

    def missing(rotation: Array) -> Array:
        return moment(axes, turn(second, rotation) - second).sum(axis=0) - per_size * torque

    rotation = jnp.zeros_like(torque)
    for _ in range(_NEWTON):
        rotation = rotation - jnp.linalg.solve(jax.jacfwd(missing)(rotation), missing(rotation))
    return rotation
