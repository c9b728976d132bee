"""The scene: everything that a step needs and does not change, with its description and its bodies."""

import abc
from dataclasses import replace
from typing import Annotated, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int, NodeVector, Point, Scalar, particle_first
from mpmjax.boundary import AbstractBoundary, mirror, refuse_contact
from mpmjax.checks import as_plain, between, checked, coordinates, is_traced, require, require_fields, require_finite
from mpmjax.discretisation import (
    APIC,
    AbstractGradient,
    AbstractTransfer,
    BSpline,
    Grid,
    MLSGradient,
    SplineGradient,
    Stencil,
    make_stencil,
    without_empty,
)
from mpmjax.geometry import AbstractMotion
from mpmjax.material import AbstractLaw
from mpmjax.potential import MirrorPlace, carried_by
from mpmjax.state._axis import check_axis, with_axis
from mpmjax.state._constraint import AbstractConstraint
from mpmjax.state._loads import AbstractBodyForce, AbstractLoad
from mpmjax.state._material_points import AveragedVolume, MaterialPoints, VolumeAverage, volume_average
from mpmjax.state._particles import Particles, State, dusted, with_state


class AbstractDescription(eqx.Module):
    """Where stencils stand and with respect to what gradients are taken: one of the two below."""

    total: ClassVar[bool]
    """Whether gradients are with respect to the reference positions X, and stencils are computed once."""


class UpdatedLagrangian(AbstractDescription):
    """Stencils at the current positions, h_ip = F_pᵀ ∇_x w_ip: for anything that moves, meets or separates."""

    total: ClassVar[bool] = False


class TotalLagrangian(AbstractDescription):
    """Stencils at the reference positions, h_ip = ∇_X w_ip, computed once.

    For a body that neither separates nor meets anything but what it was attached to from the start: no cell crossing,
    no numerical fracture, second order at every amplitude. Boundaries act at reference nodes.
    """

    total: ClassVar[bool] = True


class Bodies(eqx.Module):
    """Which materials are bodies of their own, that may touch, slide on each other and part.

        particles = mpm.join(block, slab)
        scene = mpm.Scene(grid, (rubber, steel), bodies=mpm.Bodies(friction=0.3))

    Each body has a layer of nodes of its own, and moves as if it were alone but for push and friction (see
    `BodyContact`). Without it all materials of a scene share the nodes and stick to each other. Bodies of one law are
    several materials with this law.

    *When it breaks*: not in the total description, nor with the linear kernel. Bodies that come nearer to each other by
    more than half a spacing in a step pass through each other.

    Args:
        friction: Coulomb coefficient between any two bodies [-], at least 0. With a large one, such as 1e3, they stick
            while they are pressed together.
        of_materials: the number of each material's body, from 0. Default: each material is a body.
    """

    friction: Annotated[Scalar, between(0, 1e6)] = 0.0
    of_materials: tuple[int, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    def __check_init__(self):
        require_fields(self)
        require(
            self.of_materials is None or len(self.of_materials) > 0,
            "The of_materials of Bodies must be one number for each material, got none: leave it out to make each "
            "material a body.",
        )

    def numbers(self, count: int) -> tuple[int, ...]:
        """The number of the body of each of so many materials.

        Raises:
            ValueError: not one number a material, a number left out, fewer than two bodies.
        """
        numbers = tuple(range(count)) if self.of_materials is None else self.of_materials
        require(
            len(numbers) == count and set(numbers) == set(range(max(numbers) + 1)),
            f"The of_materials of Bodies must be one number for each of the scene's {count} materials, from 0 and none "
            f"left out, got {numbers}.",
        )
        require(
            max(numbers) > 0,
            f"Bodies must be two or more to touch, got one of {count} material(s): give each body a law of its own in "
            "material, or drop bodies.",
        )
        return numbers


class AbstractCorrection(eqx.Module):
    """A change of the particles at the start of each step, such as `extensions.DensityCorrection`."""

    @abc.abstractmethod
    def check(self, scene: "Scene") -> None:
        """Raise a `ValueError` if it cannot stand in a scene."""

    @abc.abstractmethod
    def corrected(self, scene: "Scene", particles: Particles, stencil: Stencil, t: Scalar, dt: Scalar) -> Particles:
        """Prepared particles as the step from t to t + dt is to find them, where they are, from their stencil."""


class Scene(eqx.Module):
    """Grid, law, gravity, boundaries and the choices of discretisation.

    Every float in it is a leaf that can be differentiated and batched; what the scene does not contain is not compiled.

    Args:
        grid: the background grid.
        material: the law; or several, each for a group of the particles (see `join`); or a dict of them by the names
            that files and pictures are to call them.
        gravity: body acceleration [m/s²], (d,). Default: none.
        boundary: one boundary condition or several; where two prescribe the same component, the earlier holds.
        kernel: B-spline. Default: quadratic.
        gradient: gradient operator of force and deformation. Default: the spline's in the total description, where
            stresses have a higher order with it, else moving least squares.
        transfer: PIC, FLIP or APIC. Default: APIC.
        description: updated (default) or total Lagrangian.
        body_force: a force per mass that varies in space or time, besides gravity. Default: none.
        loads: forces on the body's surface or at points of it, springs and dashpots; see `attach`.
        bodies: which materials are bodies of their own, that touch each other. Default: all share the nodes.
        volume: `AveragedVolume()` for nearly incompressible bodies. Default: each particle has its own volume.
        correction: a change of the particles at the start of each step. Default: none.
        boundary_forces: whether steps compute the force and torque on each boundary (see `Run.boundary_forces`).
        names: names of the materials, where `material` is no dict. Default: none.

    Raises:
        ValueError: dimensions that differ, a mirrored plane off the half-spacing lattice, or what the total description
            cannot do (a window that follows, walls that separate, colliders along which it would slide around, laws
            that yield or flow), or laws of which volumes cannot be averaged.
    """

    grid: Grid
    material: AbstractLaw | tuple[AbstractLaw, ...]
    gravity: Point
    boundary: tuple[AbstractBoundary, ...]
    kernel: BSpline
    gradient: AbstractGradient
    transfer: AbstractTransfer
    description: AbstractDescription
    body_force: AbstractBodyForce | None
    boundary_forces: bool = eqx.field(static=True)
    loads: tuple[AbstractLoad, ...]
    bodies: Bodies | None
    volume: AveragedVolume | None
    correction: AbstractCorrection | None
    names: tuple[str, ...] = eqx.field(static=True)

    @checked
    def __init__(
        self,
        grid: Grid,
        material: AbstractLaw | tuple[AbstractLaw, ...] | list[AbstractLaw] | dict[str, AbstractLaw],
        *,
        gravity: Point | None = None,
        boundary: AbstractBoundary | tuple[AbstractBoundary, ...] | list[AbstractBoundary] = (),
        kernel: BSpline = BSpline(),
        gradient: AbstractGradient | None = None,
        transfer: AbstractTransfer = APIC(),
        description: AbstractDescription = UpdatedLagrangian(),
        body_force: AbstractBodyForce | None = None,
        boundary_forces: bool = False,
        loads: AbstractLoad | tuple[AbstractLoad, ...] | list[AbstractLoad] = (),
        bodies: Bodies | None = None,
        volume: AveragedVolume | None = None,
        correction: AbstractCorrection | None = None,
        names: tuple[str, ...] = (),
    ):
        if isinstance(material, dict):
            names, material = tuple(material), list(material.values())
        self.material, self.names = tuple(material) if isinstance(material, list) else material, names
        layers = 1 if bodies is None else 1 + max(bodies.numbers(len(self.laws)))
        self.grid = grid if grid.layers == layers else grid.with_layers(layers)
        self.gravity = (0.0,) * grid.dim if gravity is None else gravity
        self.boundary = (boundary,) if isinstance(boundary, AbstractBoundary) else tuple(boundary)
        if grid.axisymmetric:
            self.boundary = with_axis(self.boundary, grid)
        self.kernel = kernel
        self.gradient = gradient or (SplineGradient() if description.total else MLSGradient())
        self.transfer, self.description = transfer, description
        self.body_force, self.boundary_forces = body_force, boundary_forces
        self.loads = (loads,) if isinstance(loads, AbstractLoad) else tuple(loads)
        self.bodies, self.volume, self.correction = bodies, volume, correction

    def __check_init__(self):
        d = self.grid.dim
        require(coordinates("gravity", self.gravity) == d, f"gravity must have {d} components, got {self.gravity}.")
        require_finite("gravity", self.gravity)
        require(len(self.laws) > 0, "A scene needs at least one law, got none.")
        require(
            len(set(self.names)) == len(self.names) and len(self.names) in (0, len(self.laws)),
            f"The names must be one for each of the scene's {len(self.laws)} materials and differ, or none, got "
            f"{self.names}.",
        )
        require(
            not self.boundary_forces or len(self.boundary) + len(self.guides) > 0,
            "A scene with boundary_forces needs a boundary at least, or a Rigid body with guides, got none: give one, "
            "or leave boundary_forces out.",
        )
        for boundary in self.boundary:
            fits = boundary.dim in (None, d)
            require(fits, f"{type(boundary).__name__} must have {d} coordinates, as the grid has, got {boundary.dim}.")
            boundary.check(self.grid, total=self.total)
        for load in self.loads:
            load.check(d)
        if self.grid.axisymmetric:
            several = self.bodies is not None or len(self.constraints) > 0
            check_axis(self.gravity, self.loads, bodies=several)
        for axis in range(d if not self.total else 0):
            motions = [mirror.motion for mirror in self.mirrors if mirror.axis == axis]
            require(
                all(is_traced((m, motions[0])) or bool(eqx.tree_equal(m, motions[0])) for m in motions),
                f"In the updated description the grid moves with the planes across axis {axis}, so that all of them "
                "must move alike: give them one motion, take the total description, or a SlipCollider of a HalfSpace.",
            )
        if self.bodies is not None:
            refuse_contact(self.total)
            require(
                self.kernel.order > 1,
                "Bodies that touch need a kernel that sees their surface: take BSpline(2), the default, or BSpline(3).",
            )
        if self.total:
            require(not self.grid.follow, "In the total description the window cannot follow: drop follow=True.")
            flowing = [law.title() for law in self.laws if not law.allows_total]
            require(
                not flowing,
                "The total description keeps the deformation from the start, which what yields or flows does not know: "
                f"use the updated one for {', '.join(flowing)}.",
            )
        if self.volume is not None:
            self.volume.check(self.laws)
        if self.correction is not None:
            self.correction.check(self)
        for constraint in self.constraints:
            constraint.check(self)

    @property
    def laws(self) -> tuple[AbstractLaw, ...]:
        """The laws, one for each material."""
        return self.material if isinstance(self.material, tuple) else (self.material,)

    @property
    def titles(self) -> tuple[str, ...]:
        """The materials in words: their names, if they have some, and their laws."""
        laws = tuple(law.title() for law in self.laws)
        return tuple(f"{name} ({law})" for name, law in zip(self.names, laws, strict=True)) if self.names else laws

    @property
    def layers(self) -> tuple[int, ...]:
        """The number of the layer of nodes of each material."""
        return (0,) * len(self.laws) if self.bodies is None else self.bodies.numbers(len(self.laws))

    @property
    def constraints(self) -> tuple[AbstractConstraint, ...]:
        """The constraints on how bodies move, which their laws bring."""
        constrained = [n for n, law in enumerate(self.laws) if law.constraint is not None]
        return tuple(self.laws[n].constraint(n, self.layers[n]) for n in constrained)

    @property
    def guides(self) -> dict[int, int]:
        """Report index of each constraint that holds its body, keyed by material; they follow the boundaries."""
        guided = [constraint.number for constraint in self.constraints if constraint.guided]
        return {number: len(self.boundary) + i for i, number in enumerate(guided)}

    @property
    def keeps_gradient(self) -> bool:
        """Whether particles keep the velocity gradient C: for the transfer, or for a viscosity."""
        return self.transfer.affine or any(law.viscosity is not None for law in self.laws)

    def material_points(self, particles: Particles, t: Scalar = 0.0) -> tuple[MaterialPoints, ...]:
        """The materials of prepared particles at time t [s], with the elastic laws in force."""
        materials = ()
        for law, q in zip(self.laws, particles.groups, strict=True):
            volume, elastic, rows = particles.volume[q.rows], law.elastic(q.history), (q.rows.start, q.rows.stop)
            materials += (MaterialPoints(elastic, volume, q.deformation(), self.total, rows, law.viscosity),)
        if (averaged := self.volume) is None:
            return materials
        grid, window, positions = self.grid.with_layers(1), self.window(particles), self.on_grid(particles, t)
        images = mirror(self.boundary, grid, window).without_ties()

        def average(points: MaterialPoints) -> VolumeAverage:
            return volume_average(grid, window, positions[slice(*points.rows)], dusted(points.volume), images)

        return tuple(replace(q, average=average(q)) if averaged.covers(i) else q for i, q in enumerate(materials))

    def return_map(self, particles: Particles, dt: Scalar) -> Particles:
        """The particles after the return maps of laws that yield: from the trial deformation to one that the law
        admits after a step dt [s]."""
        groups = zip(self.laws, particles.groups, strict=True)
        mapped = [law.return_map(group.deformation(), group.history, dt) for law, group in groups]
        deformations, histories = zip(*mapped, strict=True)
        after = State(particles.x, particles.v, particles.C, tuple(map(particle_first, deformations)), histories)
        return with_state(particles, after)

    @property
    def collider_count(self) -> int:
        """Number of colliders."""
        return sum(boundary.is_collider for boundary in self.boundary)

    @property
    def total(self) -> bool:
        """Whether the description is total Lagrangian."""
        return self.description.total

    @property
    def moving_mirrors(self) -> dict[int, AbstractMotion]:
        """The motions of mirrors that move, by the axis across which they are."""
        return {mirror.axis: mirror.motion for mirror in self.mirrors if mirror.motion is not None}

    @property
    def mirrors(self) -> tuple[MirrorPlace, ...]:
        """Where the mirrors of the boundaries are."""
        return tuple(plane for boundary in self.boundary if (plane := boundary.mirror()) is not None)

    def shift(self, t: Scalar) -> Float[Array, "d"] | None:
        """How far the grid has moved at time t [m], shape (d,), with planes that move, and with the derivative by the
        places of all mirrored ones (see `carried_by`); None where it rests."""
        if not self.mirrors:
            return None
        along = {} if self.total else {axis: motion.at(t)[axis] for axis, motion in self.moving_mirrors.items()}
        for axis in range(self.grid.dim):
            positions = [mirror.position for mirror in self.mirrors if mirror.axis == axis]
            if is_traced(positions):
                along[axis] = along.get(axis, 0) + carried_by(*positions)
        if not along:
            return None
        rest = jnp.zeros_like(next(iter(along.values())))
        return jnp.stack([along.get(axis, rest) for axis in range(self.grid.dim)])

    def nodes(self, particles: Particles, t: Scalar) -> NodeVector:
        """Positions of the window's nodes at time t [m], shape (n, d)."""
        x, shift = self.grid.nodes(self.window(particles)), self.shift(t)
        return x if shift is None else x + shift

    def window(self, particles: Particles) -> Int[Array, "d"]:
        """Lattice index of the grid window's first node."""
        return self.grid.window(self.anchor(particles))

    def anchor(self, particles: Particles) -> Array:
        """The positions at which stencils stand [m], shape (p, d): x, or X in the total description (x of particles
        that are not prepared)."""
        return particles.X if self.total and particles.X is not None else particles.x

    def on_grid(self, particles: Particles, t: Scalar) -> Array:
        """The `anchor` relative to the grid at time t [m], shape (p, d)."""
        x, shift = self.anchor(particles), self.shift(t)
        return x if shift is None else x - shift

    def stencil(self, particles: Particles, t: Scalar = 0.0) -> Stencil:
        """The particles' stencil at time t, with the moving-least-squares gradient where the transfer needs it."""
        window, layer = self.window(particles), None
        if self.bodies is not None:  # each body has a layer of nodes of its own
            layer = np.repeat(self.layers, particles.sizes).astype(np.int32)
        x = self.on_grid(particles, t)
        stencil = make_stencil(self.kernel, self.gradient, self.grid, window, x, layer=layer)
        if self.kernel.order > 1:
            return stencil
        images = mirror(self.boundary, self.grid, window).without_ties()
        return without_empty(stencil, particles.mass, lambda m: images.unfold_scalar(images.fold_scalar(m)), self.grid)
