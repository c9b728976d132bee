"""The particles: the state of a simulation."""

import equinox as eqx
import jax
from jaxtyping import Float

from mpmjax._checks import require, require_positive
from mpmjax._types import Array, Matrix, ParticleMatrix, ParticleScalar, ParticleVector, components, particle_first


class Particles(eqx.Module):
    """A set of particles. `fill` makes x, v, mass and volume; `prepare` adds what the scene's choices need.

    Of these only x, v, C and F change in time. Every leaf is a float array of one dtype.
    """

    x: ParticleVector
    """Positions [m], shape (p, d)."""
    v: ParticleVector
    """Velocities [m/s], shape (p, d)."""
    mass: ParticleScalar
    """Masses [kg], shape (p,)."""
    volume: ParticleScalar
    """Undeformed volumes V0 [m^d], shape (p,)."""
    F: ParticleMatrix | None = None
    """Deformation gradients [-], shape (p, d, d)."""
    C: ParticleMatrix | None = None
    """Affine velocities of APIC [1/s], shape (p, d, d): ∇_x v, in the total description ∇_X v."""
    X: ParticleVector | None = None
    """Reference positions [m], shape (p, d), in the total description."""

    def __check_init__(self):
        p = self.x.shape[0]
        require(
            self.x.ndim == 2 and self.v.shape == self.x.shape and self.mass.shape == self.volume.shape == (p,),
            "Particles need x and v of shape (p, d), mass and volume of shape (p,), got "
            f"{self.x.shape}, {self.v.shape}, {self.mass.shape}, {self.volume.shape}.",
        )
        dtypes = {str(leaf.dtype) for leaf in jax.tree.leaves(self)}
        require(
            len(dtypes) == 1 and dtypes <= {"float32", "float64"},
            f"Particles need arrays of one precision, float32 or float64, got {', '.join(sorted(dtypes))}.",
        )
        require_positive("Particle masses [kg]", self.mass)
        require_positive("Particle volumes [m^d]", self.volume)

    @property
    def count(self) -> int:
        """Number of particles p."""
        return self.x.shape[0]

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return self.x.shape[1]

    def deformation(self) -> Matrix:
        """F component first, shape (d, d, p).

        Raises:
            ValueError: the particles are not prepared.
        """
        if self.F is None:
            raise ValueError("The particles have no deformation gradient yet: call prepare(scene, particles) first.")
        return components(self.F)


class State(eqx.Module):
    """The part of the particles that evolves."""

    x: Float[Array, "*f p d"]
    v: Float[Array, "*f p d"]
    C: Float[Array, "*f p d d"] | None
    F: Float[Array, "*f p d d"]


def state_of(particles: Particles) -> State:
    """The evolving part of prepared particles."""
    return State(particles.x, particles.v, particles.C, particle_first(particles.deformation()))


def with_state(particles: Particles, state: State) -> Particles:
    """The particles with their evolving part replaced."""
    return Particles(
        x=state.x, v=state.v, mass=particles.mass, volume=particles.volume, F=state.F, C=state.C, X=particles.X
    )
