"""The particles: the state of a simulation."""

from dataclasses import replace
from itertools import accumulate, pairwise
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from mpmjax._types import Array, Matrix, ParticleMatrix, ParticleScalar, ParticleVector, components
from mpmjax.checks import checked, require, require_fields, require_positive

Deformations = Float[Array, "*f _ _ _"] | tuple[Float[Array, "*f _ _ _"], ...]


class Particles(eqx.Module):
    """A set of particles. `fill` makes x, v, mass and volume; `prepare` adds what the scene needs.

    Only x, v, C, F and history change with time. Every leaf is a float array of one dtype. Particles
    of several materials lie group after group (see `join`), and F and history have one entry a group.
    """

    x: ParticleVector
    """Positions [m], shape (p, d)."""
    v: ParticleVector
    """Velocities [m/s], shape (p, d)."""
    mass: ParticleScalar
    """Masses [kg], shape (p,)."""
    volume: ParticleScalar
    """Undeformed volumes V0 [m^d], shape (p,)."""
    F: Deformations | None = None
    """Deformation gradients [-], for laws that yield their elastic part, shape (p, d, d); J = det F, shape (p, 1, 1),
    for laws that depend on J only."""
    C: ParticleMatrix | None = None
    """Velocity gradients ∇_x v [1/s], in the total description ∇_X v, shape (p, d, d): the affine velocities of APIC,
    and what viscosity resists."""
    X: ParticleVector | None = None
    """Reference positions [m], shape (p, d), in the total description."""
    history: Any = None
    """The history of laws that yield, a pytree of arrays of shape (p,) each; see the law."""
    counts: tuple[int, ...] | None = eqx.field(static=True, default=None)
    """Number of particles of each of several materials; None if there is one."""

    def __check_init__(self):
        require_fields(self)
        p = self.x.shape[0]
        require(
            self.x.ndim == 2 and self.v.shape == self.x.shape and self.mass.shape == self.volume.shape == (p,),
            "Particles need x and v of shape (p, d), mass and volume of shape (p,), got "
            f"{self.x.shape}, {self.v.shape}, {self.mass.shape}, {self.volume.shape}.",
        )
        require(p > 0, "There must be a particle at least, got none.")
        dtypes = {str(getattr(leaf, "dtype", type(leaf).__name__)) for leaf in jax.tree.leaves(self)}
        require(
            len(dtypes) == 1 and dtypes <= {"float32", "float64"},
            f"Particles need arrays of one precision, float32 or float64, got {', '.join(sorted(dtypes))}.",
        )
        some = not isinstance(self.F, tuple) or len(self.F) > 0
        require(some, "F of several materials must be a sequence of arrays, one a material, got none.")
        require(
            self.counts is None or (sum(self.counts) == p and min(self.counts) > 0),
            f"The counts of the materials' particles must be positive and add up to {p}, got {self.counts}.",
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

    @property
    def groups(self) -> tuple["Group", ...]:
        """The particles of each material."""
        if self.counts is None:
            if isinstance(self.F, tuple):
                raise ValueError("F is that of several materials: give their counts, or drop F and history.")
            return (Group(None, self.F, self.history),)
        ends = pairwise(accumulate(self.counts, initial=0))
        F, history = ((None,) * len(self.counts) if a is None else a for a in (self.F, self.history))
        return tuple(Group(*group) for group in zip(ends, F, history, strict=True))

    def deformation(self) -> Matrix:
        """F component first, shape (d, d, p).

        Raises:
            ValueError: the particles are not prepared, or of several materials.
        """
        if self.counts is not None:
            raise ValueError("The particles are of several materials, with an F each: ask one of their groups.")
        return self.groups[0].deformation()


class Group(eqx.Module):
    """The particles of one material."""

    rows: tuple[int, int] | None = eqx.field(static=True)
    """First particle, and the one after the last; None for all particles."""
    F: Float[Array, "*f q e e"] | None
    """Shape (q, e, e)."""
    history: Any
    """Leaves of shape (q,)."""

    def deformation(self) -> Matrix:
        """F component first, shape (e, e, q).

        Raises:
            ValueError: the particles are not prepared.
        """
        if self.F is None:
            raise ValueError("The particles have no deformation gradient yet: call prepare(scene, particles) first.")
        return components(self.F)


@checked
def join(*sets: Particles) -> Particles:
    """Join several sets of particles. In a scene with as many laws, each set has the law in its place; with one law,
    all sets have that one.

    Args:
        sets: particles of one dimension and precision, as `fill` makes them: F, C, X and history are not joined.

    Raises:
        ValueError: sets that differ in dimension or precision, or that are prepared.
    """
    require(len(sets) > 0, "There must be particles to join.")
    plain = all(leaf is None for q in sets for leaf in (q.F, q.C, q.X, q.history))
    require(plain, "Join particles before they are prepared: F, C, X and history follow from the scene.")
    kinds = {(q.dim, str(q.x.dtype)) for q in sets}
    require(len(kinds) == 1, f"Joined particles must have one dimension and precision, got {sorted(kinds)}.")
    arrays: dict[str, Any] = {
        name: jnp.concatenate([getattr(q, name) for q in sets]) for name in ("x", "v", "mass", "volume")
    }
    counts = tuple(n for q in sets for n in (q.counts or (q.count,)))
    return Particles(**arrays, counts=counts if len(counts) > 1 else None)


class State(eqx.Module):
    """The part of the particles that evolves."""

    x: Float[Array, "*f p d"]
    v: Float[Array, "*f p d"]
    C: Float[Array, "*f p d d"] | None
    F: Deformations
    history: Any = None


def by_material(held: Particles | State) -> list[tuple[slice, Any, Any]]:
    """Rows, F and history of each material, of prepared particles or of a state of them."""
    groups, several = jax.tree.leaves(held.F), isinstance(held.F, tuple)
    ends = pairwise(accumulate((len(F) for F in groups), initial=0))
    return [
        (slice(*rows), F, held.history[i] if several else held.history)
        for i, (rows, F) in enumerate(zip(ends, groups, strict=True))
    ]


def histories(held: Particles | State) -> list[tuple[str, slice, Any]]:
    """Name, rows and values of each array of the laws' histories, in the order of the leaves of `history`."""
    return [
        (path[-1].name, rows, leaf)
        for rows, _, history in by_material(held)
        for path, leaf in jax.tree_util.tree_leaves_with_path(history)
    ]


def state_of(particles: Particles) -> State:
    """The evolving part of prepared particles."""
    assert particles.F is not None
    return State(particles.x, particles.v, particles.C, particles.F, particles.history)


def with_state(particles: Particles, state: State) -> Particles:
    """The particles with their evolving part replaced."""
    return replace(particles, x=state.x, v=state.v, C=state.C, F=state.F, history=state.history)
