"""Loads on a body's surface and at points of it, and springs and dashpots to the ground."""

import abc
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, ClassVar

import equinox as eqx
import jax.numpy as jnp

from mpmjax import linalg as la
from mpmjax._types import Array, Float, NodeVector, ParticleVector, Point, Scalar, components
from mpmjax.checks import require, require_fields, require_that, shape_of
from mpmjax.discretisation import Stencil, in_space
from mpmjax.geometry import (
    AbstractMotion,
    Changing,
    ChangingVector,
    Motion,
    TimeSeries,
    inertia,
    require_some,
    spinning,
    value_at,
    vector_size,
)
from mpmjax.material import AbstractLaw
from mpmjax.potential import AbstractSpring, AbstractTerm, Displacement, Forces
from mpmjax.state._attachment import AbstractPlace, AttachedPoints, LoadedPoints, keeps_deformation
from mpmjax.state._particles import Particles


class AbstractLoad(eqx.Module):
    """A force on points that are attached to a body.

    One of one's own says `on` which points, and gives their `force`, or a `term` with an energy of their displacement,
    or both.
    """

    on: eqx.AbstractVar[AbstractPlace]  # where it acts
    moves_points_on: ClassVar[bool] = True
    """Whether `force` has the points where they are at its time t; else where they are as the step begins."""
    may_be_revolved: ClassVar[bool] = True  # whether it may act on bodies of revolution, points of which are rings

    @abc.abstractmethod
    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"] | None:
        """The force on each point [N], shape (d, s), at time t, in a step of dt, or None for none; constant over it."""

    def term(self, points: LoadedPoints, t: Scalar) -> AbstractTerm | None:
        """The term of the potential that it adds in a step, with the ground as at time t: part of implicit solves,
        `stable_dt` and budgets. Default: None."""
        return None

    def check(self, dim: int) -> None:
        """Raise a `ValueError` if it cannot stand in a scene of a dimension. Default: the place has another one."""
        name = type(self).__name__
        fits = self.on.dim == dim
        require(fits, f"{name} must be on a place with {dim} coordinates, as the grid, got {self.on.dim}.")

    def needs_deformation(self) -> bool:
        """Whether `force` needs the whole deformation gradient, which laws that yield or flow do not keep. Default:
        False."""
        return False


class AbstractDeadLoad(AbstractLoad):
    """A force a weight of the points that keeps its direction. Linear, and so exact inside an implicit solve."""

    on: AbstractPlace
    value: ClassVar[str]  # the field with the force, (d,), or a `TimeSeries` of it
    __check_init__ = require_fields

    def check(self, dim: int) -> None:
        AbstractLoad.check(self, dim)
        size, name = vector_size(getattr(self, self.value)), f"{type(self).__name__}'s {self.value}"
        fits = size == dim
        require(fits, f"{name} must have {dim} components, as the grid has directions, got {size or 'a number'}.")

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        return points.weight * value_at(getattr(self, self.value), t)[:, None]


class Traction(AbstractDeadLoad):
    """A dead traction on a surface: a force per undeformed area that keeps its direction. Linear, and so exact inside
    an implicit solve.

    Args:
        on: the surface, a `Patch`.
        traction: force per undeformed area [N/m^(d−1)], (d,), or a `TimeSeries` of it.
    """

    traction: Annotated[ChangingVector, require_some, "N/m²"]
    value: ClassVar[str] = "traction"


class PointLoad(AbstractDeadLoad):
    """A force at a point, or shared by several, as by those of a line. It keeps its direction. Linear, and so exact
    inside an implicit solve.

    *When it breaks*: the stress at a force on a point is infinite, so that the displacement there grows as the grid is
    refined.

    Args:
        on: the points, `PointsAt`.
        total: the whole force [N], (d,), or a `TimeSeries` of it; in 2-D per metre of thickness.
    """

    total: Annotated[ChangingVector, require_some, "N"]
    value: ClassVar[str] = "total"


class Pressure(AbstractLoad):
    """A pressure on a surface, against its outward normal.

    A following pressure acts on the deformed surface, f = −p cof(F) A by Nanson's formula. An implicit solve takes it
    with the surface at the start of the step, in methods of second order half-way through it (with APIC, whose velocity
    gradient says how the surface turns): it is of the order of the method, but not part of its matrix.

    *When it breaks*: a following pressure needs F, which laws that yield or flow do not keep. Where pressure drives a
    fast turning or growth, the lag of a step limits Δt.

    Args:
        on: the surface, a `Patch`.
        pressure: [Pa], a number or a `TimeSeries`; positive presses.
        following: whether it acts on the deformed surface. Default: it does; else on the undeformed one.
    """

    on: AbstractPlace
    pressure: Annotated[Changing, require_some, "Pa"]
    following: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        require_fields(self)
        if isinstance(self.pressure, TimeSeries):
            require(vector_size(self.pressure) is None, "Pressure's pressure must be a series of numbers, got vectors.")

    def needs_deformation(self) -> bool:
        return self.following

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        """−p cof(F) A, or −p A."""
        area, F = points.area, points.deformation
        if area is None:
            raise ValueError("Pressure acts on a surface: give it a Patch, not points.")
        if self.following and F is not None:
            d = len(area)
            area = la.matmul(la.cofactor(F)[:d, :d], area[:, None])[:, 0]
        return -value_at(self.pressure, t) * area


class Support(AbstractSpring):
    """Springs ½ k_s (e_s + N_s u)² between points and the ground, and dashpots of resistance Σ_s N_sᵀ c_s N_s v."""

    points: LoadedPoints
    stiffness: Float[Array, "d s"]  # k_s in each direction [N/m]
    stretch: Float[Array, "d s"]  # e_s [m], at the start of the step
    damping: Float[Array, "d s"] | None  # c_s [N s/m]; None without dashpots

    def elongation(self, moved: Displacement) -> Float[Array, "d s"]:
        return self.points.displacement(moved)

    def spread(self, amount: Float[Array, "d s"], size: int) -> Forces:
        return Forces(nodes=self.points.nodal(amount, size))

    def diagonal(self, stencil: Stencil, size: int) -> Forces:
        return Forces(nodes=self.points.diagonal(self.stiffness, size))

    @property
    def viscous(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.damping is not None

    def resistance(self, velocity: Displacement) -> Forces | None:
        return None if self.damping is None else self.spread(self.damping * self.elongation(velocity), velocity.size)

    def drag(self, size: int) -> tuple[Forces, Float[Array, ""]] | None:
        """At the points' velocity."""
        if self.damping is None:
            return None
        return self.spread(-self.damping * self.points.v, size), (self.damping * self.points.v**2).sum()

    def damped(self, rate: Scalar) -> "Support":
        """Springs of k + r c."""
        return self if self.damping is None else replace(self, stiffness=self.stiffness + rate * self.damping)

    def stability_rates(self, mass: Float[Array, "p"], steepness: Array) -> tuple[Array, Array | float]:
        """Twice what a particle alone feels, which covers transfers that forget the affine velocity."""
        z = self.points.at_particles(2 * self.stiffness.max(axis=0), mass, steepness)
        if self.damping is None:
            return z, 0.0
        return z, self.points.at_particles(4 * self.damping.max(axis=0), mass, steepness)


class Spring(AbstractLoad):
    """Springs and dashpots to the ground: f = −k (x − x_0 − d(t)) − c (v − ḋ(t)), with x_0 where the point was when it
    was attached, and d(t) a motion of the ground.

    Linear: part of the energy of the grid and of its viscosity, and exact inside an implicit solve. `stable_dt` knows
    it. Of points, k and c are those of all together, divided by their shares; of a surface they are per undeformed area
    (an elastic foundation).

    Args:
        on: `PointsAt`, or a `Patch`.
        stiffness: k [N/m], per area [N/m^d] of a surface: a number, or one for each direction, (d,), at least 0.
        damping: c [N s/m], likewise.
        motion: how the ground moves. Default: not at all.
    """

    on: AbstractPlace
    stiffness: Scalar | Point = 0.0
    damping: Scalar | Point | None = None
    motion: Motion | AbstractMotion | None = None

    def __check_init__(self):
        require_fields(self)
        for name, value in (("stiffness", self.stiffness), ("damping", self.damping)):
            if value is not None:
                require_some(f"A Spring's {name}", value)
                require_that(f"A Spring's {name} must be at least 0", lambda k: k >= 0, value)

    def check(self, dim: int) -> None:
        AbstractLoad.check(self, dim)
        for name, value in (("stiffness", self.stiffness), ("damping", self.damping)):
            shape = () if value is None else shape_of(value)
            require(shape in ((), (dim,)), f"A Spring's {name} must be a number or {dim} of them, got {value}.")
        fits = self.motion is None or self.motion.dim == dim
        require(fits, f"A Spring's motion must have {dim} coordinates, got {self.motion and self.motion.dim}.")

    def term(self, points: LoadedPoints, t: Scalar) -> Support:
        """The energy ½ k (x + u − x_0 − d)² and the resistance c."""
        ground = points.place if self.motion is None else self.motion.place(points.place.T, t).T
        stiffness = _along(self.stiffness, points)
        damping = None if self.damping is None else _along(self.damping, points)
        return Support(points=points, stiffness=stiffness, stretch=points.x - ground, damping=damping)

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"] | None:
        """c ḋ, with which a ground that moves drags the points along."""
        if self.motion is None or self.damping is None:
            return None
        return _along(self.damping, points) * self.motion.velocity_of(points.place.T, t, dt).T


def _along(coefficient: Scalar | Point, points: LoadedPoints) -> Float[Array, "d s"]:
    """A coefficient of each point in each direction."""
    each = jnp.broadcast_to(jnp.asarray(coefficient, points.x.dtype), points.x.shape[:1])
    return each[:, None] * points.weight


def points_of(
    loads: Sequence[AbstractLoad], laws: Sequence[AbstractLaw], particles: Particles, stencil: Stencil, *, total: bool
) -> tuple[LoadedPoints, ...]:
    """The points of each load of prepared particles at the start of a step."""
    d, dtype, F = particles.dim, particles.x.dtype, None
    if loads and any(keeps_deformation(law) for law in laws):
        still, parts = jnp.eye(stencil.strain_dim, dtype=dtype), []  # the identity where a law does not keep it
        for law, stored, count in zip(laws, particles.deformations, particles.sizes, strict=True):
            whole = keeps_deformation(law) and stored is not None
            parts.append(jnp.asarray(stored) if whole else jnp.broadcast_to(still, (count, *still.shape)))
        F = jnp.concatenate(parts)

    def at(on: AttachedPoints) -> LoadedPoints:
        column, below = jnp.asarray(on.particle, dtype).astype(jnp.int32), {}
        rows, offset = jnp.atleast_2d(column)[0], jnp.asarray(on.offset, dtype).T
        deformation = None if F is None else components(F[rows])
        arm = offset if deformation is None else la.matmul(deformation[:d, :d], offset[:, None])[:, 0]
        r = offset if total else arm
        v, rate = components(particles.v[rows]), None
        if particles.C is not None:
            C = components(particles.C[rows])
            v = v + la.matmul(C, r[:, None])[:, 0]
            L = C if stencil.radius is None else in_space(stencil.radius[rows], components(particles.v[rows]), C)
            rate = None if deformation is None else L if total else la.matmul(L, deformation)
        if on.moment is not None:
            moment = jnp.moveaxis(jnp.asarray(on.moment, dtype), -1, 0)
            if F is not None and not total:
                whole = jnp.moveaxis(F[column], (-2, -1), (0, 1))
                moment = la.matmul(whole[:d, :d], moment[:, None])[:, 0]
            below = {"column": stencil.of(column.reshape(-1)), "share": jnp.asarray(on.share, dtype), "moment": moment}
        return LoadedPoints(
            x=components(particles.x[rows]) + arm,
            v=v,
            deformation=deformation,
            rate=rate,
            place=jnp.asarray(on.place, dtype).T,
            weight=jnp.asarray(on.weight, dtype),
            area=None if on.area is None else jnp.asarray(on.area, dtype).T,
            arm=r,
            stencil=stencil.of(rows),
            particle=rows,
            **below,
        )

    return tuple(at(load.on) for load in loads if isinstance(load.on, AttachedPoints))  # `prepare` refuses others


def load_force(
    loads: tuple[AbstractLoad, ...], points: tuple[LoadedPoints, ...], t: Scalar, dt: Scalar, part: float, size: int
) -> NodeVector | None:
    """The forces of loads at their points at the fraction `part` of the step from t, on n = `size` nodes [N], shape
    (n, d), without those of their terms; None without any."""
    total = None
    for load, at in zip(loads, points, strict=True):
        later = at.after(part * dt) if part > 0 and load.moves_points_on else at
        force = load.force(later, t + part * dt if part > 0 else t, dt)
        if force is not None:
            nodal = at.loaded(force, size)
            total = nodal if total is None else total + nodal
    return total


def terms_of(loads: tuple[AbstractLoad, ...], points: tuple[LoadedPoints, ...], t: Scalar) -> tuple[AbstractTerm, ...]:
    """The terms that loads add to the potential, with the ground where it is at time t [s]."""
    each = zip(loads, points, strict=True)
    return tuple(term for load, at in each if (term := load.term(at, t)) is not None)


class AbstractBodyForce(eqx.Module):
    """A force per unit mass, b(x, t).

    A subclass may hold arrays, one row a particle too: a force that follows the material, such as that of a
    manufactured solution, holds the reference positions.
    """

    @abc.abstractmethod
    def acceleration(self, x: ParticleVector, t: Scalar) -> ParticleVector:
        """b [m/s²] at the particles' positions x [m] at the start of the step, time t [s]. Shape (p, d)."""


class Couple(AbstractLoad):
    """A couple, a torque on several points of a body by forces f_s = w_s α × r_s without a sum.

    r_s are the points' distances from their common centre, with the weights w_s, as the step begins, and
    α = (Σ w_s (‖r_s‖² 1 − r_s r_sᵀ))⁻¹ T. The torque is exact and keeps its direction; how the forces turn with the
    points is not part of an implicit solve's matrix.

    Args:
        on: the points, `PointsAt` or a `Patch`: two at least, in 3-D three that are not on one line.
        total: T [N m], a number in 2-D (per metre of thickness), (3,) in 3-D, or a `TimeSeries`.
    """

    on: AbstractPlace
    total: Annotated[Scalar | Point | TimeSeries, require_some, "N m"]
    moves_points_on: ClassVar[bool] = False  # forces act on the nodes as the step begins
    may_be_revolved: ClassVar[bool] = False

    def __check_init__(self):
        require_fields(self)
        if isinstance(self.on, AttachedPoints):
            count = shape_of(self.on.particle)[0]
            require(count >= self.on.dim, f"A Couple needs {self.on.dim} points at least, got {count}.")

    def check(self, dim: int) -> None:
        AbstractLoad.check(self, dim)
        require(dim > 1, "A Couple needs two or three dimensions, got one.")
        size = vector_size(self.total)
        require(
            size == {2: None, 3: 3}[dim],
            f"Couple's total must be {'a number in 2-D' if dim == 2 else 'three numbers in 3-D'}, got "
            f"{'a number' if size is None else f'{size} of them'}.",
        )

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        """w α × r."""
        weight, x = points.weight, points.x.T
        arms = x - (weight[:, None] * x).sum(axis=0) / weight.sum()
        alpha = jnp.linalg.solve(inertia(arms, weight), jnp.atleast_1d(value_at(self.total, t)))
        return weight * spinning(alpha, arms).T
