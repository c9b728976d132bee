"""Quantities that are often measured of a body, as functions of (scene, particles)."""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, ParticleScalar, ParticleVector, Scalar
from mpmjax.checks import canonical, checked, is_traced, require, require_fields
from mpmjax.discretisation import BSpline, Grid, SplineGradient, make_stencil, scatter
from mpmjax.geometry import AbstractRegion
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
        require(
            places.ndim == 2 and places.shape[1] == d and len(places) > 0,
            f"Markers need places of shape (m, {d}), got {places.shape}.",
        )
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
        require(
            F.ndim == 3, f"The curve of a tension test needs a law of F, got {type(points.law).__name__}, of J alone."
        )
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
        require(
            points.ndim == 2 and points.shape[1] == self.grid.dim and len(points) > 0,
            f"A cloud needs points of shape (m, {self.grid.dim}), got {points.shape}.",
        )
        return np.asarray(self._picture(points, jnp.full(len(points), mass / len(points))))

    def _picture(self, x: ParticleVector, mass: ParticleScalar) -> Array:
        grid = canonical(self.grid, x.dtype)
        stencil = make_stencil(BSpline(2), SplineGradient(), grid, grid.window(x), x)
        (on_nodes,) = scatter(stencil, jnp.where(stencil.inside, mass, 0)[None], None, grid.size).T
        return (on_nodes / grid.spacing**grid.dim).reshape(grid.shape)
