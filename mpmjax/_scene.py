"""The scene: what a step needs and does not change."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._body_force import AbstractBodyForce
from mpmjax._boundary import AbstractBoundary, SeparatingBox
from mpmjax._checks import coordinates, is_traced, require, require_finite
from mpmjax._grid import Grid
from mpmjax._kernel import BSpline, Gradient, MLSGradient, Stencil, in_window, make_stencil
from mpmjax._mirror import ContactPlane, Plane, SymmetryPlane, fits
from mpmjax._particles import Particles
from mpmjax._transfer import APIC, Transfer
from mpmjax._types import Array, Int, Point
from mpmjax.material import AbstractMaterial


class UpdatedLagrangian(eqx.Module):
    """Stencils at the current positions, h_ip = F_pᵀ ∇_x w_ip: for anything that moves, meets or separates."""


class TotalLagrangian(eqx.Module):
    """Stencils at the reference positions, h_ip = ∇_X w_ip, computed once.

    For a body that neither separates nor meets anything but what it was attached to from the start: no cell crossing,
    no numerical fracture, second order at every amplitude. Boundaries act at reference nodes.
    """


Description = UpdatedLagrangian | TotalLagrangian


class Scene(eqx.Module):
    """Grid, law, gravity, boundaries and the choices of discretisation.

    Every float in it is a leaf that can be differentiated and batched; what the scene does not contain is not compiled.

    Args:
        grid: the background grid.
        material: the elastic law.
        gravity: body acceleration [m/s²], (d,). Default: none.
        boundary: one boundary condition or several; where two prescribe the same component, the earlier holds.
        kernel: B-spline. Default: quadratic.
        gradient: gradient operator of force and deformation. Default: moving least squares.
        transfer: PIC, FLIP or APIC. Default: APIC.
        description: updated (default) or total Lagrangian.
        body_force: a force per mass that varies in space or time, besides gravity. Default: none.

    Raises:
        ValueError: dimensions that differ, a mirrored plane off the half-spacing lattice, or what the total description
            cannot do (a window that follows, walls that separate).
    """

    grid: Grid
    material: AbstractMaterial
    gravity: Point
    boundary: tuple[AbstractBoundary, ...]
    kernel: BSpline
    gradient: Gradient
    transfer: Transfer
    description: Description
    body_force: AbstractBodyForce | None

    def __init__(
        self,
        grid: Grid,
        material: AbstractMaterial,
        *,
        gravity: Point | None = None,
        boundary: AbstractBoundary | tuple[AbstractBoundary, ...] | list[AbstractBoundary] = (),
        kernel: BSpline = BSpline(),
        gradient: Gradient = MLSGradient(),
        transfer: Transfer = APIC(),
        description: Description = UpdatedLagrangian(),
        body_force: AbstractBodyForce | None = None,
    ):
        self.grid = grid
        self.material = material
        self.gravity = (0.0,) * grid.dim if gravity is None else gravity
        self.boundary = (boundary,) if isinstance(boundary, AbstractBoundary) else tuple(boundary)
        self.kernel = kernel
        self.gradient = gradient
        self.transfer = transfer
        self.description = description
        self.body_force = body_force

    def __check_init__(self):
        d = self.grid.dim
        require(coordinates("gravity", self.gravity) == d, f"gravity must have {d} components, got {self.gravity}.")
        require_finite("gravity", self.gravity)
        for boundary in self.boundary:
            require(
                boundary.dim in (None, d),
                f"{type(boundary).__name__} must have {d} coordinates, as the grid has, got {boundary.dim}.",
            )
            if isinstance(boundary, Plane):
                self._check_plane(boundary)
        if self.total:
            require(not self.grid.follow, "In the total description the window cannot follow: drop follow=True.")
            require(
                not any(isinstance(b, SeparatingBox | ContactPlane) for b in self.boundary),
                "In the total description there is no contact: use the updated one, or SymmetryPlane or SlipBox "
                "for a wall that is never left.",
            )

    def _check_plane(self, plane: Plane) -> None:
        name = type(plane).__name__
        require(plane.axis < self.grid.dim, f"{name}'s axis must be below {self.grid.dim}, got {plane.axis}.")
        require(
            not self.grid.periodic[plane.axis],
            f"Direction {plane.axis} is periodic and cannot have a {name}: drop one of them.",
        )
        require(
            fits(plane, self.grid),
            f"A {name} must lie at a multiple of half the grid's spacing ({self.grid.spacing}), got "
            f"{plane.position}: move it, or use {'SlipBox' if isinstance(plane, SymmetryPlane) else 'SeparatingBox'}.",
        )

    @property
    def total(self) -> bool:
        """Whether the description is total Lagrangian."""
        return isinstance(self.description, TotalLagrangian)

    def window(self, particles: Particles) -> Int[Array, "d"]:
        """Lattice index of the grid window's first node."""
        return self.grid.window(self.anchor(particles))

    def anchor(self, particles: Particles) -> Array:
        """The positions at which stencils stand: x, or X in the total description. Shape (p, d)."""
        return particles.X if self.total and particles.X is not None else particles.x

    def stencil(self, particles: Particles) -> Stencil:
        """The particles' stencil, with the moving-least-squares gradient where the transfer needs it."""
        return make_stencil(
            self.kernel,
            self.gradient,
            self.grid,
            self.window(particles),
            self.anchor(particles),
            affine=self.transfer.affine,
        )


def prepare(scene: Scene, particles: Particles) -> Particles:
    """Add to the particles what the scene's law, transfer and description need, where it is missing.

    F = I, C = 0 with APIC (and none without), X = x in the total description (and none in the updated one).

    Raises:
        ValueError: the particles have another dimension than the grid, a particle lies outside the window or beyond a
            mirrored plane, or a deformation gradient is one the law does not allow.
    """
    p, d = particles.count, particles.dim
    require(d == scene.grid.dim, f"The particles are {d}-dimensional, the grid {scene.grid.dim}-dimensional.")
    still = jnp.zeros((p, d, d), particles.x.dtype)
    prepared = Particles(
        x=particles.x,
        v=particles.v,
        mass=particles.mass,
        volume=particles.volume,
        F=jnp.broadcast_to(jnp.eye(d, dtype=still.dtype), still.shape) if particles.F is None else particles.F,
        C=(still if particles.C is None else particles.C) if scene.transfer.affine else None,
        X=(particles.x if particles.X is None else particles.X) if scene.total else None,
    )
    if not is_traced((scene, prepared)):
        _check_placement(scene, prepared)
    return prepared


def is_prepared(scene: Scene, particles: Particles) -> bool:
    """Whether the particles have exactly what the scene needs."""
    has_affine, has_reference = particles.C is not None, particles.X is not None
    return particles.F is not None and has_affine == scene.transfer.affine and has_reference == scene.total


def _check_placement(scene: Scene, particles: Particles) -> None:
    place = scene.anchor(particles)
    require_finite("Particle positions", particles.x)
    require_finite("Particle velocities", particles.v)
    inside = np.asarray(in_window(scene.kernel, scene.grid, scene.window(particles), place))
    if not inside.all():
        first = int(np.argmin(inside))
        raise ValueError(
            f"Every particle's stencil must lie in the window; particle {first} at {np.asarray(place[first])} and "
            f"{int((~inside).sum()) - 1} others do not: enlarge the grid's shape, move its origin, or use follow=True."
        )
    for plane in scene.boundary:
        if isinstance(plane, Plane):
            name = type(plane).__name__
            depth = np.asarray(place[:, plane.axis]) - float(plane.position)
            wrong = depth < 0 if plane.keep == "above" else depth > 0
            require(
                ~wrong,
                f"Particles must lie {plane.keep} the {name} at {plane.position} on axis {plane.axis}, but "
                f"particle {int(np.argmax(wrong))} does not: move it or change the plane's keep.",
            )
    F = np.moveaxis(np.asarray(particles.F), 0, -1)
    allowed = np.asarray(scene.material.admits(jnp.asarray(F)))
    require(
        allowed,
        f"{type(scene.material).__name__} does not allow the F of particle {int(np.argmin(allowed))} "
        "(neo-Hookean needs det F > 0): start from an admissible one.",
    )
