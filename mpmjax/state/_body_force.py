"""Body forces that vary in space or time: uniform gravity is the scene's own."""

import abc

import equinox as eqx

from mpmjax._types import ParticleVector, Scalar


class AbstractBodyForce(eqx.Module):
    """A force per unit mass, b(x, t).

    A subclass may hold arrays, one row a particle too: a force that follows the material, such as that of a
    manufactured solution, holds the reference positions.
    """

    @abc.abstractmethod
    def acceleration(self, x: ParticleVector, t: Scalar) -> ParticleVector:
        """b [m/s²] at the particles' positions x [m] at the start of the step, time t [s]. Shape (p, d)."""
