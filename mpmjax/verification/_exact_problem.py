"""Problems with an exact motion, their discretisation, their errors, and these under refinement; columns under their
own weight, whose static states are exact."""

import abc
import enum
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, ParticleVector, Scalar
from mpmjax.boundary import AbstractBoundary, SlipBox, SymmetryPlane
from mpmjax.checks import require
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractRegion, Box
from mpmjax.material import AbstractMaterial, FixedCorotated, Hencky
from mpmjax.simulation import Run, simulate
from mpmjax.state import AbstractBodyForce, Particles, Scene, State, UpdatedLagrangian, fill
from mpmjax.stepping import AbstractIntegrator, BackwardEuler, Explicit, SemiImplicit

_MARGIN = 4  # nodes beyond the domain, for the widest stencil and some motion
_SAMPLES = 10


class Ends(enum.Enum):
    """The boundary of a problem whose exact motion is odd at the faces of its box."""

    PERIODIC = "periodic"  # no wall; twice the box is a period
    MIRRORED = "mirrored"  # symmetry planes
    PLAIN = "plain"  # slip walls: the normal velocity of the nodes at and beyond them is zero


class AbstractProblem(eqx.Module):
    """An exact motion x(X, t) of a body with a law and a density, with the body force that makes it exact.

    A subclass has the motion of one point. Velocity, deformation gradient and the manufactured body force
    b = ẍ − Div P / ρ0 follow by automatic differentiation.
    """

    material: eqx.AbstractVar[AbstractMaterial]
    density: eqx.AbstractVar[float]
    dim: eqx.AbstractVar[int]
    forced: ClassVar[bool] = True  # whether the motion needs the body force

    @abc.abstractmethod
    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        """x(X, t) [m] of one point X [m], shape (d,)."""

    @property
    def duration(self) -> float:
        """Duration of the run [s]. Default: 2/c, one period of waves of the bar's speed in a metre."""
        return 2 / float(self.bar_speed)

    @abc.abstractmethod
    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        """The corners of the box that the grid covers [m], whose sides are whole numbers of cells, and how it ends."""

    def grid(self, cells: int) -> Grid:
        """The grid, with `cells` cells to a metre: one period of the box, or the box with a margin."""
        lower, upper, ends = self.box()
        counts = tuple(round((b - a) * cells) for a, b in zip(lower, upper, strict=True))
        first = tuple(round(a * cells) for a in lower)
        if ends is Ends.PERIODIC:
            return Grid(counts, 1 / cells, origin=first, periodic=True)
        room = 2 * _MARGIN + 1
        return Grid(tuple(n + room for n in counts), 1 / cells, origin=tuple(i - _MARGIN for i in first))

    def body(self, cells: int) -> AbstractRegion:
        """The region of the body at rest, on this grid. Default: the box."""
        return Box(*self.box()[:2])

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

    @property
    def bar_speed(self) -> Any:
        """Speed of waves in a thin bar at rest, c = √(E / ρ0) [m/s]."""
        law: Any = self.material
        return (law.youngs_modulus / self.density) ** 0.5

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

    problem: AbstractProblem  # the problem whose force it is
    X: ParticleVector  # reference positions [m], shape (p, d)

    def acceleration(self, x: ParticleVector, t: Scalar) -> ParticleVector:
        return jax.vmap(lambda X: self.problem.body_force(X, t))(self.X)


def box_boundary(lower: tuple[float, ...], upper: tuple[float, ...], ends: Ends) -> tuple[AbstractBoundary, ...]:
    """The boundaries of a box whose faces do not move along their normals."""
    if ends is Ends.MIRRORED:
        sides = itertools.product(range(len(lower)), ((lower, "above"), (upper, "below")))
        return tuple(SymmetryPlane(axis, corner[axis], keep=keep) for axis, (corner, keep) in sides)
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
    force = Manufactured(problem, X) if problem.forced else None
    scene = Scene(grid, problem.material, boundary=problem.boundary(), body_force=force, **choices)
    return scene, Particles(x, v, rest.mass, rest.volume, deformations=(F,), C=C, X=X)


def _at_frames(error: Callable[..., Array], particles: Particles, run: Run) -> Array:
    """The error at each frame, shape (f,), by its state and time, X [m] and the share of each particle in the volume,
    shape (p,)."""
    if run.frames is None or particles.X is None:
        raise ValueError("The error needs a run with frames (pass save_every to simulate) and particles with X.")
    X, share = particles.X, particles.volume / particles.volume.sum()
    return jax.lax.map(lambda frame: error(*frame, X, share), (run.frames, run.times))


def displacement_error(problem: AbstractProblem, particles: Particles, run: Run) -> Float[Array, "f"]:
    """√(Σ V0 ‖x − x(X, t)‖² / Σ V0) [m] at each saved frame, shape (f,), by the particles from `discretise`, with X,
    and a run with frames."""

    def error(state: State, t: Array, X: Array, share: Array) -> Array:
        exact = jax.vmap(lambda Y: problem.position(Y, t))(X)
        return jnp.sqrt((share * ((state.x - exact) ** 2).sum(axis=1)).sum())

    return _at_frames(error, particles, run)


def stress_error(problem: AbstractProblem, particles: Particles, run: Run) -> Float[Array, "f"]:
    """Σ V0 ‖P − P(X, t)‖ / Σ V0 [Pa] at each saved frame, shape (f,), with P the first Piola-Kirchhoff stress,
    by the particles from `discretise`, with X, and a run with frames."""

    def error(state: State, t: Array, X: Array, share: Array) -> Array:
        exact = jax.vmap(lambda Y: problem.deformation(Y, t))(X)
        miss = jax.vmap(problem.material.stress)(state.F) - jax.vmap(problem.material.stress)(exact)
        return (share * jnp.sqrt((miss**2).sum(axis=(1, 2)))).sum()

    return _at_frames(error, particles, run)


Measure = Callable[[AbstractProblem, Particles, Run], Float[Array, "f"]]
"""The error of a run of a problem at each saved frame, shape (f,)."""


def errors(
    problem: AbstractProblem,
    cells: Sequence[int],
    *,
    courant: float | Sequence[float],
    method: AbstractIntegrator = Explicit(),
    staggered: bool | None = None,
    measure: Measure = displacement_error,
    **discretisation: Any,
) -> np.ndarray:
    """The displacement error on each grid [m], or another: the largest at ten times, evenly spaced over the duration.

    The error of a run that fails is infinite.

    Args:
        problem: the problem.
        cells: grid cells to a metre, for each grid.
        courant: Δt c/dx with c the pressure-wave speed at rest, for all grids or for each. It is rounded down so that
            ten whole numbers of steps fill the duration.
        method: the integrator.
        staggered: whether initial velocities are those half a step before the start (see `discretise`). Default: yes,
            except with methods of second order, whose velocities are at the time of the positions.
        measure: the error of a run at each saved frame: `displacement_error`, `stress_error`, or one's own.
        discretisation: further arguments of `discretise`, with `rest` particles of one's own.
    """

    def error(n: int, number: float) -> float:
        longest = number / (n * problem.wave_speed)
        every = max(1, math.ceil(problem.duration / _SAMPLES / longest - 1e-9))
        dt = problem.duration / (_SAMPLES * every)
        start = -dt / 2 if staggered or (staggered is None and method.body_force_at == 0) else 0.0
        scene, particles = discretise(problem, n, velocity_time=start, **discretisation)
        run = simulate(scene, particles, t1=problem.duration, dt=dt, method=method, save_every=every, throw=False)
        worst = float(measure(problem, particles, run).max())
        return worst if bool(run.statistics.healthy) and math.isfinite(worst) else math.inf

    numbers = [courant] * len(cells) if isinstance(courant, (int, float)) else courant
    return np.array([error(n, number) for n, number in zip(cells, numbers, strict=True)])


def orders(errors: np.ndarray, cells: Sequence[int]) -> np.ndarray:
    """The observed order between successive grids, log(e₁/e₂) / log(n₂/n₁)."""
    return np.log(errors[:-1] / errors[1:]) / np.log(np.divide(cells[1:], cells[:-1]))


_LOADING, _HOLDING = 20, 8  # steps, of which each is a Newton step towards equilibrium
_HALLEY = 6  # iterations, of third order, from a good start
_STEP = 1e5  # [s], long enough for inertia not to matter


class AbstractColumn(AbstractProblem):
    """A column 0 ≤ X ≤ 1 m of ν = 0 on a symmetry plane, under its weight, which is applied slowly. Particles fill it
    exactly; the free end needs no condition."""

    load: float = 0.04  # a, weight over stiffness
    shift: float = 0.0
    """Distance of the free end beyond a node, as a fraction of a cell: with it the particles' place in the cell differs
    from cell to cell."""
    material: AbstractMaterial = FixedCorotated(1.0, 0.0)  # the law, with ν = 0
    density: float = 1.0  # ρ0 [kg/m^d]
    dim: int = eqx.field(static=True, default=1)  # space dimension
    method: ClassVar[AbstractIntegrator]  # the integrator that finds the equilibrium

    @property
    def duration(self) -> float:
        """Duration of the run [s], so long that inertia is negligible."""
        return _STEP * (_LOADING + _HOLDING)

    def acting(self, t: Scalar) -> Array:
        """The part of the load that acts at time t."""
        return self.load * jnp.minimum(t / (_STEP * (_LOADING - 1)), 1)

    def grid(self, cells: int) -> Grid:
        return Grid((cells + 8,), 1 / (cells + self.shift), origin=(-3,))

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        return (0.0,), (1.0,), Ends.MIRRORED

    def rest(self, cells: int, per_side: int, *, fitted: bool = False) -> Particles:
        del fitted  # they always are
        n = cells * per_side
        X, volume = jnp.asarray((np.arange(n) + 0.5)[:, None] / n), jnp.full(n, 1 / n)
        return Particles(X, jnp.zeros_like(X), self.density * volume, volume)

    def boundary(self) -> tuple[AbstractBoundary, ...]:
        return (SymmetryPlane(0, 0.0),)

    def errors(self, cells: int, *, per_side: int = 2, **choices: Any) -> tuple[float, float]:
        """The relative errors under full load: of the displacement, over that of the top, and of the stress, over
        that at the bottom a E; with `cells` grid cells over the height of the column, `per_side` particles to a
        cell, and choices of kernel, gradient, transfer and description."""
        scene, particles = discretise(self, cells, per_side=per_side, **choices)
        t1, steps = self.duration, _LOADING + _HOLDING
        run = simulate(scene, particles, t1=t1, dt=t1 / steps, method=self.method, save_every=steps)
        top = 1 - float(self.position(jnp.ones(1), t1)[0])
        bottom = self.load * float(self.material.youngs_modulus)  # pyright: ignore[reportAttributeAccessIssue]
        u, P = displacement_error(self, particles, run)[-1], stress_error(self, particles, run)[-1]
        return float(u) / top, float(P) / bottom


class Column(AbstractColumn):
    """A column of P = E (F − 1), exact at any load below E. At full load P = −a E (1 − X) and x = X − a (X − X²/2)."""

    method: ClassVar[AbstractIntegrator] = SemiImplicit()

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        return X - self.acting(t) * (X - X**2 / 2)


class HenckyColumn(AbstractColumn):
    """A column of Hencky's law, at any load.

    At full load the Cauchy stress is σ = P = −a E (1 − X) (with ν = 0 the section stays). From E ln F/F = σ follow,
    with Lambert's W and s = a (1 − X), F = W(s)/s and x = (Φ(a) − Φ(s))/a, Φ = W + W²/2. A load of 0.04 is that of a
    column of 50 m, 80 kg/m³, 1 MPa and g = 10 m/s², the convergence test of AMPLE (W. M. Coombs, C. E. Augarde,
    https://wmcoombs.github.io/tests); a load of 4 that of one of 10 kPa, which is pressed to 0.30 at the bottom.
    """

    method: ClassVar[AbstractIntegrator] = BackwardEuler()
    load: float = 4.0
    material: AbstractMaterial = Hencky(1.0, 0.0)

    def position(self, X: Float[Array, "d"], t: Scalar) -> Float[Array, "d"]:
        a = self.acting(t)
        none = a == 0
        a = jnp.where(none, 1.0, a)
        return jnp.where(none, X, (_potential(a) - _potential(a * (1 - X))) / a)


def _potential(s: Array) -> Array:
    """Φ = W + W²/2 with W(s) of Lambert, s ≥ 0: Halley's iteration for W e^W = s."""
    w = jnp.log1p(s)
    for _ in range(_HALLEY):
        e = jnp.exp(w)
        miss = w * e - s
        w = w - miss / (e * (w + 1) - (w + 2) * miss / (2 * w + 2))
    return w + w**2 / 2
