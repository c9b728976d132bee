"""The result of P2G besides the mass: velocity and force of the nodes, apart or joined."""

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, NodeScalar, NodeVector, Scalar

Fold = Callable[[NodeVector], NodeVector]
"""A map from a nodal vector to its sum with its images at mirrors."""


def per_mass(impulse: NodeVector, mass: NodeScalar) -> NodeVector:
    """An impulse or force divided by the nodes' mass; zero on empty nodes."""
    occupied = (mass > 0)[:, None]
    return jnp.where(occupied, impulse / jnp.where(occupied, mass[:, None], 1), 0)


class SeparateSums(eqx.Module):
    """The result of P2G that sums momentum and force separately."""

    separate: ClassVar[bool] = True
    velocity: NodeVector
    """v_i^n [m/s], shape (n, d); zero on empty nodes."""
    force: NodeVector
    """Internal force at the start of the step [N], shape (n, d): the elastic one, and for integrators with explicit
    viscosity the viscous one."""
    viscous_force: NodeVector | None
    """The viscous part of `force` [N], shape (n, d); None unless it was asked for."""
    acceleration: Array
    """Body acceleration g [m/s²], shape (d,), or (n, d) where it varies."""

    def inertial_velocity(self, mass: NodeScalar, dt: Scalar) -> NodeVector:
        """v^n + Δt g [m/s], shape (n, d)."""
        return jnp.where((mass > 0)[:, None], self.velocity + dt * self.acceleration, 0)

    def explicit_velocity(self, mass: NodeScalar, dt: Scalar) -> NodeVector:
        """v^n + Δt g + Δt f/m [m/s], shape (n, d)."""
        return self.inertial_velocity(mass, dt) + dt * per_mass(self.force, mass)

    def with_force(self, force: NodeVector, mass: NodeScalar, dt: Scalar) -> "SeparateSums":
        """The sums with a force on the nodes added [N], shape (n, d)."""
        del mass, dt
        return replace(self, force=self.force + force)

    def moved_by(self, change: NodeVector) -> "SeparateSums":
        """The sums with a velocity [m/s], shape (n, d), added to that of the nodes."""
        return replace(self, velocity=self.velocity + change)

    def folded(self, velocity: Fold, force: Fold) -> "SeparateSums":
        """The same, with velocities, accelerations and forces folded at mirrors."""
        viscous = None if self.viscous_force is None else force(self.viscous_force)
        return SeparateSums(velocity(self.velocity), force(self.force), viscous, velocity(self.acceleration))


class JoinedSum(eqx.Module):
    """The result of P2G that adds the impulses of forces to the momentum in one sum, at half the cost."""

    separate: ClassVar[bool] = False
    viscous_force: ClassVar[None] = None
    velocity_with_force: NodeVector
    """v^n + Δt (g + f/m) [m/s], shape (n, d); zero on empty nodes."""

    @property
    def velocity(self) -> NodeVector:
        """Not known.

        Raises:
            ValueError: always.
        """
        raise ValueError(_NOT_KNOWN_APART)

    @property
    def force(self) -> NodeVector:
        """Not known.

        Raises:
            ValueError: always.
        """
        raise ValueError(_NOT_KNOWN_APART)

    @property
    def acceleration(self) -> Array:
        """Not known.

        Raises:
            ValueError: always.
        """
        raise ValueError(_NOT_KNOWN_APART)

    def inertial_velocity(self, mass: NodeScalar, dt: Scalar) -> NodeVector:
        """Not known.

        Raises:
            ValueError: always.
        """
        raise ValueError(_NOT_KNOWN_APART)

    def explicit_velocity(self, mass: NodeScalar, dt: Scalar) -> NodeVector:
        """v^n + Δt (g + f/m) [m/s], shape (n, d)."""
        del mass, dt
        return self.velocity_with_force

    def moved_by(self, change: NodeVector) -> "JoinedSum":
        """The sum with a velocity [m/s], shape (n, d), added to that of the nodes."""
        return JoinedSum(self.velocity_with_force + change)

    def with_force(self, force: NodeVector, mass: NodeScalar, dt: Scalar) -> "JoinedSum":
        """The sums with a force on the nodes added [N], shape (n, d)."""
        return JoinedSum(self.velocity_with_force + dt * per_mass(force, mass))

    def folded(self, velocity: Fold, force: Fold) -> "JoinedSum":
        """The same, with velocities and forces folded at mirrors."""
        del force
        return JoinedSum(velocity(self.velocity_with_force))


_NOT_KNOWN_APART = (
    "P2G summed momentum and forces in one, so v^n, g and the force are not known apart: only "
    "nodes.explicit_velocity() is. An integrator that uses them must have needs_separate_force = True."
)
