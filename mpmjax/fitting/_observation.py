"""Kinds of observation: against another quantity, against time, of markers, forces and torques; and quantities that are
often measured of a body, as functions of (scene, particles)."""

from collections.abc import Callable
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, ParticleScalar, ParticleVector, Scalar
from mpmjax.checks import as_floats, canonical, checked, is_traced, require, require_fields, require_finite
from mpmjax.discretisation import BSpline, Grid, SplineGradient, make_stencil, scatter
from mpmjax.fitting._columns import ROUNDED, after
from mpmjax.fitting._experiment import AbstractObservation
from mpmjax.geometry import AbstractRegion
from mpmjax.simulation import Run
from mpmjax.state import Particles, Scene

Rows = Float[Array, "m d"] | Float[np.ndarray, "m d"] | tuple | list

_NEIGHBOURS = 3  # particles that carry a marker, in each direction


class Markers(eqx.Module):
    """Where some material points are: means of the particles beside them. Make them by `Markers.of` or `Markers.at`."""

    which: np.ndarray  # numbers of the particles that carry each marker, shape (m, k)
    share: np.ndarray  # their shares in its place, shape (m, k); they add up to one

    @classmethod
    @checked
    def of(cls, which: Any) -> "Markers":
        """Markers that are particles, by their numbers, shape (m,); a ValueError if not whole. Markers stay."""
        if isinstance(which, Markers):
            return which
        numbers = np.asarray(which)
        require(
            numbers.ndim == 1 and numbers.size > 0 and np.issubdtype(numbers.dtype, np.integer),
            f"Markers must be whole numbers of particles, shape (m,), got {numbers.shape} of {numbers.dtype}; for "
            "places between particles take Markers.at(particles, places).",
        )
        return cls(numbers[:, None], np.ones((len(numbers), 1)))

    @classmethod
    @checked
    def at(cls, particles: Particles, places: Rows) -> "Markers":
        """Markers painted on places of a body as it starts [m], shape (m, d); a ValueError if one does not lie on it.
        Each moves as the mean of its nearest particles, by shares of least squares: exact of affine motion."""
        x, places = np.asarray(particles.x, float), np.asarray(places, float)
        d = particles.dim
        fits = places.ndim == 2 and places.shape[1] == d and len(places) > 0
        require(fits, f"Markers need places of shape (m, {d}), got {places.shape}.")
        k = min(_NEIGHBOURS**d, particles.count)
        require(k > d, f"Markers between particles need more than {d} of them, got {particles.count}.")
        from scipy.spatial import KDTree  # here, since it takes long to import

        nearest = np.asarray(KDTree(x).query(places, k)[1])
        arms = x[nearest] - places[:, None]
        far = np.sqrt((arms**2).sum(axis=-1).max(axis=1, keepdims=True))
        weight = np.exp(-4 * (arms**2).sum(axis=-1) / far**2)
        conditions = np.concatenate([np.ones((len(places), k, 1)), arms / far[..., None]], axis=-1)
        matrix = np.einsum("mki,mk,mkj->mij", conditions, weight, conditions)
        target = np.zeros((len(places), d + 1, 1))
        target[:, 0] = 1
        share = weight * (conditions @ np.linalg.pinv(matrix) @ target)[..., 0]
        missed = np.abs(np.einsum("mk,mkd->md", share, arms)).max(axis=1) > 1e-6 * far[:, 0]
        outside = missed | (np.abs(share.sum(axis=1) - 1) > 1e-6) | (np.abs(share).sum(axis=1) > 2)
        require(
            ~outside,
            f"Markers must lie on the body as it starts; {int(outside.sum())} do not, the first at "
            f"{places[outside][:1].tolist()}.",
        )
        return cls(nearest, share)

    @property
    def count(self) -> int:
        """Number of markers m."""
        return len(self.which)

    def check(self, name: str, particles: int) -> None:
        """Check that the particles are there."""
        which, fault = np.asarray(self.which), f"The markers of {name!r} must be numbers of the {particles} particles, "
        require((which >= 0) & (which < particles), f"{fault}from 0.")

    def __call__(self, scene: Scene, particles: Particles) -> Float[Array, "m d"]:
        """Positions [m], shape (m, d)."""
        if not is_traced(self.which):
            self.check("markers", particles.count)
        return (jnp.asarray(self.share, particles.x.dtype)[..., None] * particles.x[self.which]).sum(axis=1)


class Extent(eqx.Module):
    """How far particles with mass reach: a front or height [m], whose derivative is that of the farthest one."""

    axis: int = eqx.field(static=True)  # the direction
    side: Literal["upper", "lower"] = eqx.field(static=True, default="upper")  # the largest coordinate, or the smallest
    __check_init__ = require_fields

    def __call__(self, scene: Scene, particles: Particles) -> Float[Array, ""]:
        """The coordinate [m]."""
        require(0 <= self.axis < particles.dim, f"Extent's axis must be below {particles.dim}, got {self.axis}.")
        along, there = particles.x[:, self.axis], particles.mass > 0
        if self.side == "upper":
            return along.max(where=there, initial=-jnp.inf)
        return along.min(where=there, initial=jnp.inf)


class CentreOfMass(eqx.Module):
    """The centre of mass of all particles [m], shape (d,)."""

    def __call__(self, scene: Scene, particles: Particles) -> Float[Array, "d"]:
        """Σ m x / Σ m."""
        return particles.mass @ particles.x / particles.mass.sum()


class StressStretch(eqx.Module):
    """The curve of a tension test: mean stretch F_aa and mean nominal stress P_aa [Pa] of a gauge section."""

    weight: ParticleScalar  # share of each particle in the means, summing to one, shape (p,)
    axis: int = eqx.field(static=True)  # direction a of the pull

    @classmethod
    @checked
    def of(cls, region: AbstractRegion, particles: Particles, axis: int) -> "StressStretch":
        """Over the particles that start in a region, by their volumes; a ValueError if none does, or of no axis."""
        inside = np.asarray(region.contains(particles.x))
        require(inside.any(), f"The gauge {region} holds no particle at the start: enlarge or move it.")
        require(0 <= axis < particles.dim, f"The gauge's axis must be below {particles.dim}, got {axis}.")
        weight = jnp.where(jnp.asarray(inside), particles.volume, 0)
        return cls(weight / weight.sum(), axis)

    def __call__(self, scene: Scene, particles: Particles) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Stretch [-] and nominal stress [Pa]."""
        (points,) = scene.material_points(particles)
        F, a = points.deformation, self.axis
        of_F = F.ndim == 3
        require(of_F, f"The curve of a tension test needs a law of F, got {type(points.law).__name__}, of J alone.")
        P = points.stress(F)
        return (self.weight * F[a, a]).sum(), (self.weight * P[a, a]).sum()


class Density(eqx.Module):
    """A picture of the body: its density on the nodes of a lattice, smoothed by a quadratic B-spline.

    For measured pictures, and for clouds of points whose correspondence is not known, which become pictures. The
    lattice's spacing is the distance over which points are told apart: wide enough that shifted clouds still overlap, a
    tenth of the body or so, and wider than the points' spacing.

        picture = mpm.fitting.Density(mpm.Grid((40, 40), 0.05))
        seen = mpm.Series(times, [picture.of_points(cloud, mass) for cloud in clouds], picture)

    A series of it keeps a picture for each step, and for each parameter a derivative of that.
    """

    grid: Grid  # the lattice; the picture ends with it
    __check_init__ = require_fields

    def __call__(self, scene: Scene, particles: Particles) -> Array:
        """The density [kg/m^d], of the grid's shape."""
        return self._picture(particles.x, particles.mass)

    @checked
    def of_points(self, points: Rows, mass: Scalar) -> np.ndarray:
        """The picture of points [m], shape (m, d), which share the body's mass [kg] evenly."""
        points = jnp.asarray(points, float)
        fits = points.ndim == 2 and points.shape[1] == self.grid.dim and len(points) > 0
        require(fits, f"A cloud needs points of shape (m, {self.grid.dim}), got {points.shape}.")
        return np.asarray(self._picture(points, jnp.full(len(points), mass / len(points))))

    def _picture(self, x: ParticleVector, mass: ParticleScalar) -> Array:
        grid = canonical(self.grid, x.dtype)
        stencil = make_stencil(BSpline(2), SplineGradient(), grid, grid.window(x), x)
        (on_nodes,) = scatter(stencil, jnp.where(stencil.inside, mass, 0)[None], None, grid.size).T
        return (on_nodes / grid.spacing**grid.dim).reshape(grid.shape)


class Curve(AbstractObservation):
    """A quantity measured against another one: stress against stretch, a force against a displacement.

    Args:
        x: measured abscissae, shape (m,).
        data: measured ordinates y, shape (m,).
        of: function of (scene, particles) that returns one point (x, y) of the simulated curve; x must grow in time.
        sigma, weight, robust, name, shown: see `Series`.
        x_name: the abscissa's name in pictures.
    """

    x: Float[np.ndarray, "m"] = eqx.field(converter=as_floats)
    data: Float[np.ndarray, "m"] = eqx.field(converter=as_floats)
    of: Callable[[Scene, Particles], Any]
    name: str = eqx.field(static=True, default="curve", kw_only=True)
    x_name: str = eqx.field(static=True, default="abscissa", kw_only=True)

    def __check_init__(self):
        require_fields(self)
        alike = self.x.ndim == 1 and self.x.shape == self.data.shape
        require(alike, f"{self.title} needs x and data of one shape (m,), got {self.x.shape} and {self.data.shape}.")
        require_finite(f"The abscissae of {self.title}", self.x)

    @property
    def against(self) -> tuple[str, np.ndarray]:
        return self.x_name, self.x

    def observe(self, scene: Scene, particles: Particles) -> Any:
        return self.of(scene, particles)

    def predict(self, seen: Any, run: Run) -> Array:
        x, y = seen
        reached = ~self._beyond(x, jnp.asarray(self.x, y.dtype)) & (jnp.diff(x) > 0).all()
        return jnp.where(reached, jnp.interp(jnp.asarray(self.x, y.dtype), x, y), jnp.nan)

    def explain(self, seen: Any, run: Run) -> None:
        x, y = (np.asarray(a) for a in seen)
        require(
            np.isfinite(x).all() and (np.diff(x) > 0).all(),
            f"The simulated abscissa of {self.title} must grow with every step of the run: slow the loading "
            "down, or reduce dt.",
        )
        outside = self._beyond(x, self.x)
        require(
            ~outside,
            f"The simulation covers {x[0]:.4g} to {x[-1]:.4g}, which leaves out measured points of {self.title} "
            f"({', '.join(f'{w:.4g}' for w in self.x[outside])}): pull further, or narrow the range.",
        )
        require_finite(f"The simulated ordinate of {self.title}", y)

    def _beyond(self, x: Any, measured: Any) -> Any:
        """Whether measured abscissae lie outside of those of a simulated curve."""
        slack = _SLACK * (x[-1] - x[0])
        return (measured < x[0] - slack) | (measured > x[-1] + slack)


class AbstractTimed(AbstractObservation):
    """A measurement against time; between steps it is interpolated linearly."""

    times: Float[np.ndarray, "f"] = eqx.field(converter=as_floats)
    data: Float[np.ndarray, "f ..."] = eqx.field(converter=as_floats)

    def __check_init__(self):
        require_fields(self)
        what = self.title
        require(
            self.data.shape[:1] == self.times.shape,
            f"{what} needs times of shape (f,) and data of shape (f, ...), got {self.times.shape} and "
            f"{self.data.shape}.",
        )
        require_finite(f"The times of {what} [s]", self.times)
        require(np.diff(self.times) > 0, f"The times of {what} must grow: sort the measurements by time.")

    @property
    def against(self) -> tuple[str, np.ndarray]:
        return "time [s]", self.times

    def predict(self, seen: Any, run: Run, first: Scalar = 0.0) -> Array:
        """Values at the times, from those of steps, shape (k, ...), from `first` on; NaN where a time left the run."""
        step = jnp.asarray(self.times, seen.dtype) / run.dt
        outside = (step < -_BEYOND) | (step > (len(run.steps) - 1) * (1 + ROUNDED) + _BEYOND)
        outside = outside.reshape(-1, *[1] * (seen.ndim - 1))
        return jnp.where(outside, jnp.nan, between(seen, step - first))

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        outside = (self.times < 0) | after(self.times, t1)
        require(
            ~outside,
            f"The times of {self.title} must lie in the run, from 0 to {t1:g} s, but {int(outside.sum())} do not, the "
            f"first {self.times[outside][:1]}: raise t1, or leave them out.",
        )

    def part_until(self, t1: float) -> "AbstractTimed | None":
        kept = ~after(self.times, t1)
        if not np.isfinite(self.data[kept]).any():
            return None
        part = eqx.tree_at(lambda o: (o.times, o.data), self, (self.times[kept], self.data[kept]))
        if self.sigma is None:
            return part
        return eqx.tree_at(lambda o: o.sigma, part, np.broadcast_to(self.sigma, self.data.shape)[kept])

    def explain(self, seen: Array, run: Run) -> None:
        require_finite(f"What the simulation says of {self.name!r}", seen)
        reached = np.isfinite(np.asarray(self.predict(seen, run)))
        require(reached, f"A parameter moves times of {self.name!r} out of the run: raise t1.")


class Series(AbstractTimed):
    """A quantity measured against time, anything that a state says; between steps it is interpolated linearly.

    Args:
        times: when it was measured [s], shape (f,), growing, from 0 to the experiment's t1.
        data: what was measured, shape (f, ...); NaN or masked where nothing was.
        of: function of (scene, particles) that returns it, shape (...).
        sigma: standard deviation of the noise, in the unit of the data; None to estimate it.
        weight: factor of the squares.
        robust: misfit in standard deviations beyond which squares grow but linearly.
        name: what tables and pictures call it.
        shown: how pictures show it, such as in other units.
    """

    of: Callable[[Scene, Particles], Any]
    name: str = eqx.field(static=True, default="series", kw_only=True)

    def observe(self, scene: Scene, particles: Particles) -> Any:
        return self.of(scene, particles)

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        super().check(scene, particles, t1)
        seen = eqx.filter_eval_shape(lambda *state: self.observe(*state), scene, particles)
        shape = getattr(seen, "shape", None)
        require(
            shape == self.data.shape[1:],
            f"{self.title} has data of shape {self.data.shape[1:]} at each time, but of "
            f"returns {'no array' if shape is None else f'shape {shape}'}.",
        )


class Tracks(AbstractTimed):
    """Places of material points that were followed: markers, or features of a video.

    Args:
        times: when they were seen [s], shape (f,), growing.
        data: where [m], shape (f, m, d); NaN where a marker was not seen.
        which: the markers: numbers of particles, shape (m,), or `Markers.at` for places between particles.
        sigma, weight, robust, name, shown: see `Series`.
    """

    which: Markers = eqx.field(converter=Markers.of, kw_only=True)
    name: str = eqx.field(static=True, default="tracks", kw_only=True)

    def __check_init__(self):
        require_fields(self)
        require(
            self.data.ndim == 3 and self.which.count == self.data.shape[1],
            f"{self.title} need positions of shape (f, m, d) of the m markers, got {self.data.shape} and "
            f"{self.which.count} markers.",
        )

    def observe(self, scene: Scene, particles: Particles) -> Array:
        return self.which(scene, particles)

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        super().check(scene, particles, t1)
        alike = self.data.shape[2] == particles.dim
        require(alike, f"{self.title} are {self.data.shape[2]}-dimensional, the particles {particles.dim}-dimensional.")
        self.which.check(self.name, particles.count)


class Force(AbstractTimed):
    """The force on a collider, such as a plate on which a body falls, or on any boundary, against time: compared with
    that of each step at its own time (see `Forces`), interpolated linearly.

    Args:
        times: when it was measured [s], shape (f,), growing.
        data: the force [N], shape (f, d); NaN where a component was not measured.
        collider: number of the collider, from 0, in the order of the scene's boundaries.
        boundary: in its place, number of the boundary, in the scene's order. The scene must have `boundary_forces`.
        sigma, weight, robust, name, shown: see `Series`.
    """

    collider: int = eqx.field(static=True, default=0, kw_only=True)
    boundary: int | None = eqx.field(static=True, default=None, kw_only=True)
    name: str = eqx.field(static=True, default="force", kw_only=True)
    _component: ClassVar = "force"

    def observe(self, scene: Scene, particles: Particles) -> Array:
        """A zero: nothing is needed of the states."""
        return jnp.zeros((), particles.x.dtype)

    def check(self, scene: Scene, particles: Particles, t1: float) -> None:
        super().check(scene, particles, t1)  # the forces' shape is checked when they are predicted
        kind, number, count = "collider", self.collider, scene.collider_count
        if self.boundary is not None:
            kind, number, count = "boundary", self.boundary, len(scene.boundary) + len(scene.guides)
        require(0 <= number < count, f"{self.title} is of {kind} {number}, from 0, but the scene has {count}.")
        require(
            self.boundary is None or scene.boundary_forces,
            f"{self.title} is of boundary {number}, on which the scene computes no force: give it "
            "boundary_forces=True.",
        )

    def predict(self, seen: Any, run: Run, first: Scalar = 0.0) -> Array:
        at = run.method.force_at()
        return super().predict(self._simulated(run), run, first if at is None else at)

    def explain(self, seen: Any, run: Run) -> None:
        super().explain(self._simulated(run), run)

    def _simulated(self, run: Run) -> Array:
        of_all, number = (run.forces, self.collider) if self.boundary is None else (run.boundary_forces, self.boundary)
        return getattr(of_all(), self._component)[:, number]


class Torque(Force):
    """The torque on a collider or boundary against time, as `Force`: [N m], shape (f, 1) in two dimensions, (f, 3) in
    three, about the centre of the collider's rotation, else its shape's middle, a grip's middle, or the origin."""

    _component: ClassVar = "torque"


def between(values: Array, place: Array) -> Array:
    """Values at row numbers `place`, shape (m,), that are not whole, by linear interpolation or extrapolation."""
    last = jnp.clip(jnp.floor(place + _ON_A_ROW), 0, len(values) - 2)
    share, at = (place - last).reshape(-1, *[1] * (values.ndim - 1)), last.astype(int)
    return (1 - share) * values[at] + share * values[at + 1]


_SLACK = 1e-6  # part of a curve's length by which a point may lie beside it, as rounding of its start has it
_ON_A_ROW = 1e-6  # part of a step by which a time may miss a step and is on it
_BEYOND = 1e-2  # part of a step by which a time may lie beyond the run, as rounding has it
