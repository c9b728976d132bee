"""Problems with an exact motion, their discretisation and their errors."""

import abc
import enum
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from mpmjax._types import Array, Float, ParticleVector, Scalar
from mpmjax.boundary import AbstractBoundary, SlipBox, SymmetryPlane
from mpmjax.checks import require
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractRegion
from mpmjax.material import AbstractMaterial
from mpmjax.simulation import Run
from mpmjax.state import AbstractBodyForce, Particles, Scene, State, UpdatedLagrangian, fill

_MARGIN = 4  # nodes beyond the domain, for the widest stencil and some motion


class Ends(enum.Enum):
    """The boundary of a problem whose exact motion is odd at the faces of its box."""

    PERIODIC = "periodic"
    """No wall; twice the box is a period."""
    MIRRORED = "mirrored"
    """Symmetry planes."""
    PLAIN = "plain"
    """Slip walls: the normal velocity of the nodes at and beyond them is zero."""


class AbstractProblem(eqx.Module):
    """An exact motion x(X, t) of a body with a law and a density, with the body force that makes it exact.

    A subclass has the motion of one point. Velocity, deformation gradient and the manufactured body force
    b = ẍ − Div P / ρ0 follow by automatic differentiation.
    """

    material: eqx.AbstractVar[AbstractMaterial]
    density: eqx.AbstractVar[float]
    dim: eqx.AbstractVar[int]
    forced: eqx.AbstractVar[bool]
    """Whether the motion needs the body force."""

    @abc.abstractmethod
    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        """x(X, t) [m] of one point X [m], shape (d,)."""

    @property
    @abc.abstractmethod
    def duration(self) -> float:
        """Duration of the run [s]."""

    @abc.abstractmethod
    def grid(self, cells: int) -> Grid:
        """The grid, with `cells` cells to a metre."""

    @abc.abstractmethod
    def body(self, cells: int) -> AbstractRegion:
        """The region of the body at rest, on this grid."""

    def rest(self, cells: int, per_side: int, *, fitted: bool = False) -> Particles:
        """The particles at rest on this grid, `per_side` to the side of a cell. Default: those of `fill`."""
        number = per_side**self.dim
        return fill(self.body(cells), self.grid(cells), particles_per_cell=number, density=self.density, fitted=fitted)

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        """The boundaries. Default: none."""
        return ()

    @property
    def wave_speed(self) -> float:
        """Speed of pressure waves at rest, c = √((λ + 2μ) / ρ0) [m/s]."""
        law: Any = self.material
        return math.sqrt(float(law.lame_lambda + 2 * law.shear_modulus) / self.density)

    def velocity(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        """∂x/∂t [m/s], shape (d,)."""
        t = jnp.asarray(t, X.dtype)
        return jax.jvp(lambda s: self.position(X, s), (t,), (jnp.ones_like(t),))[1]

    def deformation(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d d"]:
        """F = ∂x/∂X [-], shape (d, d)."""
        return jax.jacfwd(lambda Y: self.position(Y, t))(X)

    def body_force(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        """b = ẍ − Div P / ρ0 [m/s²], shape (d,), with (Div P)_i = ∂P_ij/∂X_j."""
        t = jnp.asarray(t, X.dtype)
        inertia = jax.jvp(lambda s: self.velocity(X, s), (t,), (jnp.ones_like(t),))[1]
        slope = jax.jacfwd(lambda Y: self.material.stress(self.deformation(Y, t)))(X)
        return inertia - jnp.trace(slope, axis1=1, axis2=2) / self.density


class Manufactured(AbstractBodyForce):
    """The body force of a problem, on particles with known reference positions X [m], shape (p, d)."""

    problem: AbstractProblem
    X: ParticleVector

    def acceleration(self, x: ParticleVector, t: Scalar) -> ParticleVector:
        del x
        return jax.vmap(lambda X: self.problem.body_force(X, t))(self.X)


def box_grid(lower: tuple[float, ...], upper: tuple[float, ...], cells: int, ends: Ends) -> Grid:
    """A grid for a box whose sides are whole numbers of cells: one period, or the box with a margin."""
    counts = [round((b - a) * cells) for a, b in zip(lower, upper, strict=True)]
    first = [round(a * cells) for a in lower]
    if ends is Ends.PERIODIC:
        return Grid(tuple(counts), 1 / cells, origin=tuple(first), periodic=True)
    room = 2 * _MARGIN + 1
    return Grid(tuple(n + room for n in counts), 1 / cells, origin=tuple(i - _MARGIN for i in first))


def box_boundary(lower: tuple[float, ...], upper: tuple[float, ...], ends: Ends) -> tuple[AbstractBoundary, ...]:
    """The boundaries of a box whose faces do not move along their normals."""
    if ends is Ends.MIRRORED:
        sides = (
            (a, place, keep) for a in range(len(lower)) for place, keep in ((lower[a], "above"), (upper[a], "below"))
        )
        return tuple(SymmetryPlane(axis, place, keep=keep) for axis, place, keep in sides)
    return (SlipBox(lower, upper),) if ends is Ends.PLAIN else ()


def discretise(
    problem: AbstractProblem,
    cells: int,
    *,
    per_side: int = 2,
    velocity_time: float = 0.0,
    rest: Particles | Callable[[int], Particles] | None = None,
    fitted: bool = False,
    **choices: Any,
) -> tuple[Scene, Particles]:
    """The scene of a problem, and its particles in their exact initial state.

    Args:
        problem: the problem.
        cells: grid cells to a metre.
        per_side: particles to the side of a cell.
        velocity_time: time of the initial velocities [s]. Symplectic Euler is the leap-frog method, whose velocities
            are half a step early: it is of second order in time with −Δt/2, of first order with 0.
        rest: the particles at rest, with mass and volume, or a function of `cells` that makes them: any of one's own.
            Default: the problem's.
        fitted: whether these are fitted to the body's surface (see `fill`).
        choices: kernel, gradient, transfer and description of the scene.
    """
    grid = problem.grid(cells)
    d = problem.dim
    require(grid.dim == d, f"The problem is {d}-dimensional, its grid {grid.dim}-dimensional.")
    if rest is None:
        rest = problem.rest(cells, per_side, fitted=fitted)
    elif callable(rest):
        rest = rest(cells)
    X = rest.x
    x, F = jax.vmap(lambda Y: (problem.position(Y, 0.0), problem.deformation(Y, 0.0)))(X)
    v, rate = jax.vmap(
        lambda Y: (problem.velocity(Y, velocity_time), jax.jacfwd(lambda Z: problem.velocity(Z, velocity_time))(Y))
    )(X)
    total = choices.get("description", UpdatedLagrangian()).total
    C = rate if total else rate @ jnp.linalg.inv(F)
    scene = Scene(
        grid,
        problem.material,
        boundary=problem.boundary(),
        body_force=Manufactured(problem, X) if problem.forced else None,
        **choices,
    )
    return scene, Particles(x, v, rest.mass, rest.volume, deformations=(F,), C=C, X=X)


def _frames_and_shares(particles: Particles, run: Run) -> tuple[State, Array, Array]:
    """The frames of a run, X [m] of its particles, and the share of each in the volume, shape (p,)."""
    if run.frames is None or particles.X is None:
        raise ValueError("The error needs a run with frames (pass save_every to simulate) and particles with X.")
    return run.frames, particles.X, particles.volume / particles.volume.sum()


def displacement_error(problem: AbstractProblem, particles: Particles, run: Run) -> Float[Array, "f"]:
    """√(Σ V0 ‖x − x(X, t)‖² / Σ V0) [m] at each saved frame, shape (f,).

    Args:
        problem: the problem.
        particles: the particles from `discretise`, with X.
        run: the run, with frames.
    """
    frames, X, share = _frames_and_shares(particles, run)

    def at(frame: tuple[Array, Array]) -> Array:
        x, t = frame
        exact = jax.vmap(lambda Y: problem.position(Y, t))(X)
        return jnp.sqrt((share * ((x - exact) ** 2).sum(axis=1)).sum())

    return jax.lax.map(at, (frames.x, run.times))


def stress_error(problem: AbstractProblem, particles: Particles, run: Run) -> Float[Array, "f"]:
    """Σ V0 ‖P − P(X, t)‖ / Σ V0 [Pa] at each saved frame, shape (f,), with P the first Piola-Kirchhoff
    stress.

    Args:
        problem: the problem.
        particles: the particles from `discretise`, with X.
        run: the run, with frames.
    """
    frames, X, share = _frames_and_shares(particles, run)

    def at(frame: tuple[Array, Array]) -> Array:
        F, t = frame
        exact = jax.vmap(lambda Y: problem.deformation(Y, t))(X)
        miss = jax.vmap(problem.material.stress)(F) - jax.vmap(problem.material.stress)(exact)
        return (share * jnp.sqrt((miss**2).sum(axis=(1, 2)))).sum()

    return jax.lax.map(at, (frames.F, run.times))
