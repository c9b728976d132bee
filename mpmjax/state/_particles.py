"""The particles: the state of a simulation."""

import operator
from collections.abc import Sequence
from dataclasses import fields, replace
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from mpmjax import linalg as la
from mpmjax._types import Array, Deformation, ParticleMatrix, ParticleScalar, ParticleVector, Scalar, components
from mpmjax.checks import checked, is_traced, require, require_fields, require_finite, require_that

Deformations = tuple[Float[Array, "..."] | None, ...]


class Particles(eqx.Module):
    """A set of particles. `fill` makes x, v, mass and volume; `prepare` adds what the scene needs.

    Only x, v, C, deformations and histories change with time, and in a run with a control mass and volume: particles
    with none are not there (see `mpmjax.extensions.Inlet`). Every leaf is a float array of one dtype. Particles of
    several materials lie group after group (see `join`). Deformations and histories have one entry a material, None
    until they are known; `F` and `history` are those of the only material.
    """

    x: ParticleVector  # positions [m], shape (p, d)
    v: ParticleVector  # velocities [m/s], shape (p, d)
    mass: ParticleScalar  # masses [kg], shape (p,)
    volume: ParticleScalar  # undeformed volumes V0 [m^d], shape (p,)
    deformations: Deformations = ()
    """For each material the deformation gradients F [-], for laws that yield their elastic part, shape (q, d, d); for
    laws that depend on J = det F only, J, shape (q,)."""
    C: ParticleMatrix | None = None
    """Velocity gradients ∇_x v [1/s], in the total description ∇_X v, shape (p, d, d): the affine velocities of APIC,
    and what viscosity resists."""
    X: ParticleVector | None = None  # reference positions [m], shape (p, d), in the total description
    histories: tuple[Any, ...] = ()
    """For each material the history of a law that yields, a pytree of arrays of shape (q,) each (see the law); else
    None."""
    counts: tuple[int, ...] | None = eqx.field(static=True, default=None)
    """Number of particles of each of several materials; None if there is one."""

    def __post_init__(self):
        materials = len(self.counts) if isinstance(self.counts, tuple) else 1  # what it is is checked below
        for name in ("deformations", "histories"):
            value = getattr(self, name)
            if isinstance(value, tuple) and not jax.tree.leaves(value):
                setattr(self, name, (None,) * materials)

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
        alike = len(dtypes) == 1 and dtypes <= {"float32", "float64"}
        require(alike, f"Particles need arrays of one precision, float32 or float64, got {', '.join(sorted(dtypes))}.")
        fits = self.counts is None or (sum(self.counts) == p and min(self.counts) > 0)
        require(fits, f"The counts of the materials' particles must be positive and add up to {p}, got {self.counts}.")
        lengths = len(self.deformations), len(self.histories)
        require(
            lengths == (len(self.sizes),) * 2,
            f"Particles of {len(self.sizes)} materials need as many deformations and histories, got {lengths[0]} and "
            f"{lengths[1]}: give the counts of all materials, or drop deformations and histories.",
        )
        require_finite("Particle masses [kg]", self.mass)
        require_finite("Particle volumes [m^d]", self.volume)
        require_that(
            "Particle masses [kg] and volumes [m^d] must be greater than zero, or both zero of one that is not there",
            lambda m, v: ((m > 0) & (v > 0)) | ((m == 0) & (v == 0)),
            self.mass,
            self.volume,
        )

    @property
    def count(self) -> int:
        """Number of particles p."""
        return self.x.shape[0]

    @property
    def dim(self) -> int:
        """Space dimension d."""
        return self.x.shape[1]

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of particles of each material."""
        return self.counts or (self.count,)

    @property
    def F(self) -> Any:  # noqa: N802
        """The deformation of the only material: F, shape (p, d, d), or J, shape (p,); None until it is known.

        Raises:
            ValueError: the particles are of several materials.
        """
        return _only(self.deformations, "F", "deformations")

    @property
    def history(self) -> Any:
        """The history of the only material; a ValueError if there are several."""
        return _only(self.histories, "history", "histories")

    @property
    def groups(self) -> tuple["Group", ...]:
        """The particles of each material."""
        ends = pairwise(accumulate(self.sizes, initial=0))
        each = zip(ends, self.deformations, self.histories, strict=True)
        return tuple(Group(slice(*rows), stored, history) for rows, stored, history in each)


def _only(each: tuple, name: str, field: str) -> Any:
    if len(each) != 1:
        raise ValueError(
            f"The particles are of {len(each)} materials, each with its own {name}: take {field}, one entry a material."
        )
    return each[0]


class Group(NamedTuple):
    """The particles of one material."""

    rows: slice  # from the first particle to the one after the last
    stored: Any  # their entry of `Particles.deformations`
    history: Any  # leaves of shape (q,)

    def deformation(self) -> Deformation:
        """F component first, shape (d, d, q), or J, shape (q,); a ValueError if the particles are not prepared."""
        if self.stored is None:
            raise ValueError("The particles have no deformation gradient yet: call prepare(scene, particles) first.")
        return components(self.stored)

    def volume_ratio(self) -> Float[Array, "q"]:
        """J = det F [-], shape (q,)."""
        deformation = self.deformation()
        return deformation if deformation.ndim == 1 else la.determinant(deformation)


def moves_as_one(particles: Particles) -> bool:
    """Whether all velocities are known and alike."""
    return not is_traced(particles.v) and bool((np.ptp(np.asarray(particles.v), axis=0) == 0).all())


@checked
def join(*sets: Particles, material: int | None = None) -> Particles:
    """Join several sets of particles. In a scene with as many laws, each set has the law in its place; with one law,
    all sets have that one.

    Prepared particles, such as those of a run's end, are joined with what they have of F, C, X and history, so that
    material can be added to a run between two calls.

    Args:
        sets: particles of one dimension and precision, either none of them prepared, or all for scenes alike: of one
            description, with the velocity gradient or without. Sets that move as one may lack it: theirs is zero.
        material: the number of the material of the first set, from 0, that all other sets are more of; particles of
            later materials then have other numbers. Default: the sets are materials of their own.

    Raises:
        ValueError: sets that differ in dimension, precision or in what they have, or of other laws than a material's.
    """
    require(len(sets) > 0, "There must be particles to join.")
    kinds = {(q.dim, str(q.x.dtype)) for q in sets}
    require(len(kinds) == 1, f"Joined particles must have one dimension and precision, got {sorted(kinds)}.")
    if any(q.C is not None for q in sets):
        shape = (sets[0].dim,) * 2
        sets = tuple(
            replace(q, C=jnp.zeros((q.count, *shape), q.x.dtype)) if q.C is None and moves_as_one(q) else q
            for q in sets
        )
    for name, values in (
        ("deformations", [F is not None for q in sets for F in q.deformations]),
        ("a velocity gradient C", [q.C is not None for q in sets]),
        ("reference positions X", [q.X is not None for q in sets]),
    ):
        require(
            all(values) or not any(values),
            f"All joined particles must have {name} or none: prepare each for a scene like that of the others.",
        )
    materials = [[(q, group)] for q in sets for group in q.groups]  # the members of each
    if material is not None:
        first, more = materials[: len(sets[0].sizes)], materials[len(sets[0].sizes) :]
        require(
            0 <= material < len(first) and len(more) == len(sets) - 1,
            f"join needs the number of one of the first set's {len(first)} materials and others of one material each, "
            f"got material={material} and {len(more)} materials in {len(sets) - 1} sets.",
        )
        first[material] += [member for members in more for member in members]
        materials = first
    xp: Any = jnp if is_traced(sets) else np  # each operation of JAX by itself is a program to compile
    arrays: dict[str, Any] = {}
    for name in ("x", "v", "mass", "volume", "C", "X"):
        if getattr(sets[0], name) is not None:
            each = [xp.asarray(getattr(q, name))[group.rows] for members in materials for q, group in members]
            arrays[name] = jax.device_put(xp.concatenate(each))
    counts = tuple(sum(group.rows.stop - group.rows.start for _, group in members) for members in materials)
    return Particles(
        **arrays,
        deformations=tuple(of_one_material([group.stored for _, group in members]) for members in materials),
        histories=tuple(of_one_material([group.history for _, group in members]) for members in materials),
        counts=counts if len(counts) > 1 else None,
    )


def of_one_material(parts: Sequence[Any]) -> Any:
    """The deformations or histories of several sets of particles of one material, as those of one set; a ValueError if
    they are of several laws."""
    kinds = {(jax.tree.structure(part), tuple(leaf.shape[1:] for leaf in jax.tree.leaves(part))) for part in parts}
    require(len(kinds) == 1, "Joined particles of one material must have been prepared for one law.")
    if len(parts) == 1:
        return parts[0]
    xp: Any = jnp if is_traced(parts) else np
    return jax.tree.map(lambda *leaves: jax.device_put(xp.concatenate(leaves)), *parts)


class State(eqx.Module):
    """The part of the particles that evolves."""

    x: Float[Array, "*f p d"]  # positions [m], shape (p, d), of a run (f, p, d)
    v: Float[Array, "*f p d"]  # velocities [m/s], shape (p, d)
    C: Float[Array, "*f p d d"] | None  # velocity gradients [1/s], shape (p, d, d)
    deformations: Deformations  # F or J of each material (see `Particles`)
    histories: tuple[Any, ...]  # what the law of each material remembers
    mass: Float[Array, "*f p"] | None = None  # masses [kg], shape (p,); None where no control may change them
    volume: Float[Array, "*f p"] | None = None  # undeformed volumes [m^d], likewise

    F, history, groups = Particles.F, Particles.history, Particles.groups

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of particles of each material."""
        return tuple(len(F) for F in self.deformations if F is not None)


def history_arrays(held: Particles | State) -> list[tuple[str, slice, Any]]:
    """Name, rows and values of each array of the laws' histories, in the order of the leaves of `histories`."""
    return [
        (path[-1].name, group.rows, leaf)
        for group in held.groups
        for path, leaf in jax.tree_util.tree_leaves_with_path(group.history)
    ]


def dusted(a: ParticleScalar, otherwise: Scalar = 1.0) -> ParticleScalar:
    """Masses or volumes, where they are zero the square of the precision's rounding of their largest, or of another
    where all are zero: below the rounding of sums over particles, above the smallest numbers."""
    most = jax.lax.stop_gradient(a.max(initial=0))
    return jnp.where(a > 0, a, jnp.finfo(a.dtype).eps ** 2 * jnp.where(most > 0, most, otherwise))


def with_dust(particles: Particles) -> Particles:
    """The particles, with those that have no mass as dust of about the density of others of their material: no quotient
    is then 0/0, and all sums stay as they are to the last digit."""

    def some(a: ParticleScalar) -> ParticleScalar:
        most = jax.lax.stop_gradient(a.max())
        most = jnp.where(most > 0, most, 1)
        return jnp.concatenate([dusted(a[group.rows], most) for group in particles.groups])

    return eqx.tree_at(lambda q: (q.mass, q.volume), particles, (some(particles.mass), some(particles.volume)))


def state_of(particles: Particles, *, masses: bool = False) -> State:
    """The evolving part of prepared particles, with masses and volumes if a control may change them."""
    changing = (particles.mass, particles.volume) if masses else ()
    return State(particles.x, particles.v, particles.C, particles.deformations, particles.histories, *changing)


def with_state(particles: Particles, state: State) -> Particles:
    """The particles with their evolving part replaced. It is of their shapes and dtype, so nothing is checked again."""
    names = (field.name for field in fields(State))
    evolving = operator.attrgetter(*(name for name in names if getattr(state, name) is not None))
    return eqx.tree_at(evolving, particles, evolving(state), is_leaf=lambda a: a is None)
