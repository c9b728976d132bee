"""Points of a body's surface or inside of it, attached to its particles, with which they move; and those points in a
step: how the nodes move them, and how forces on them reach the nodes."""

import abc
from dataclasses import replace
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int, NodeVector, Scalar
from mpmjax.checks import is_traced, positive, require, require_fields, require_that, shape_of, warn
from mpmjax.discretisation import Stencil, gather, scatter
from mpmjax.geometry import AbstractRegion, surface_pieces
from mpmjax.material import AbstractLaw
from mpmjax.potential import Displacement
from mpmjax.state._particles import Particles

Rows = Float[Array, "s d"] | Float[np.ndarray, "s d"] | tuple | list
Numbers = Float[Array, "s"] | Float[np.ndarray, "s"] | tuple[float | int | Array, ...] | list[float | int]

_NARROW = 1.999  # a patch narrower than so many particle spacings is not resolved
_FAR = 2.0  # how many particle spacings a point may lie off the nearest particle
_ROUNDED = 1e-4  # how far the sum of shares may be from one, for rounding's sake
_DEEP = 4  # particles of a column; with two the stress next to a pressed surface is twice as far off
_BESIDE = 0.3  # share of its length and of its volume by which a cell of a column may differ from the first one


class AbstractPlace(eqx.Module):
    """Where a load acts."""

    @property
    @abc.abstractmethod
    def dim(self) -> int:
        """Space dimension d."""

    @abc.abstractmethod
    def attached(self, particles: Particles) -> "AttachedPoints":
        """The points of it, attached to the particles; a ValueError if there are none, or one lies off the body."""


class AttachedPoints(AbstractPlace):
    """Points that move with the nearest particle, x_s = x_p + F_p R_s. `Patch` and `PointsAt` make them.

    Args:
        particle: the number of each point's particle, as a float, as all numbers of a scene are, shape (s,); with a
            column also those of the k − 1 particles below it, shape (k, s).
        offset: R_s = F_p⁻¹ (x_s − x_p) [m], shape (s, d).
        weight: the undeformed area of the surface that each stands for [m^(d−1)], or its share of a whole [-], shape
            (s,).
        place: where they were when they were attached [m], shape (s, d).
        area: outward normal times area of the undeformed surface [m^(d−1)], shape (s, d); None of points.
        share: of a force on a point, on each particle of its column [-], (k, s), which sum to one; zero on those behind
            its end. Default: no columns.
        moment: of a force on a point, its arm about each of these particles times the share, undeformed [m], (k, s, d).
    """

    particle: Float[Array, "*k s"] | Float[np.ndarray, "*k s"]
    offset: Float[Array, "s d"] | Float[np.ndarray, "s d"]
    weight: Float[Array, "s"] | Float[np.ndarray, "s"]
    place: Float[Array, "s d"] | Float[np.ndarray, "s d"]
    area: Float[Array, "s d"] | Float[np.ndarray, "s d"] | None = None
    share: Float[Array, "k s"] | Float[np.ndarray, "k s"] | None = None
    moment: Float[Array, "k s d"] | Float[np.ndarray, "k s d"] | None = None

    def __check_init__(self):
        require_fields(self)
        k, s = shape_of(self.particle), shape_of(self.weight)
        rows = [shape_of(a) for a in (self.offset, self.place, self.area) if a is not None]
        columns = [None if a is None else shape_of(a)[:2] for a in (self.share, self.moment)]
        alike = len(s) == 1 and all(r[:1] == s for r in rows) and s[0] > 0 and k in (s, (*k[:1], *s))
        require(alike, f"AttachedPoints need one row a point in each of their arrays, got {k}, {s} and {rows}.")
        require(
            columns == [None if k == s else k] * 2,
            f"AttachedPoints with columns need a share and a moment for each particle {k}, others none, got {columns}.",
        )

    @property
    def dim(self) -> int:
        return shape_of(self.offset)[1]

    def attached(self, particles: Particles) -> "AttachedPoints":
        return self

    def revolved(self, particles: Particles) -> "AttachedPoints":
        """The points of a surface in a section as rings: with 2πr0 times the area."""
        if self.area is None:
            return self
        rows, groups = np.atleast_2d(np.asarray(self.particle))[0].astype(int), particles.groups
        sizes = zip(groups, particles.sizes, strict=True)
        hoop = np.concatenate([np.ones(n) if q.stored is None else q.stored[:, 2, 2] for q, n in sizes])
        length = 2 * np.pi * np.asarray(self.place)[:, 0] / hoop[rows]
        return eqx.tree_at(lambda p: (p.weight, p.area), self, (self.weight * length, self.area * length[:, None]))


class Patch(AbstractPlace):
    """The surface of a region, or the part of it in another region.

    It is made of flat pieces (see `surface_pieces`), of second order in the spacing, and exact of boxes. Pieces on one
    particle that look along the same axis count as one, at their common centroid.

    Args:
        region: the body, or any region whose surface is that of the body where it counts.
        within: the region in which the surface belongs to the patch. Surface that lies on the boundary of this region
            does not: a box around a body's end that is as wide as the body leaves out the body's sides. Default:
            everywhere.
        spacing: the size of the pieces [m]. Default: the distance between particles.
    """

    region: AbstractRegion
    within: AbstractRegion | None = None
    spacing: Annotated[Scalar, positive, "m"] | None = None

    def __check_init__(self):
        require_fields(self)
        require(
            self.within is None or self.within.dim == self.region.dim,
            "A Patch's regions must have the same dimension, got "
            f"{self.region.dim} and {self.within and self.within.dim}.",
        )

    @property
    def dim(self) -> int:
        return self.region.dim

    def attached(self, particles: Particles) -> AttachedPoints:
        x, apart = _positions(particles, self)
        spacing = apart if self.spacing is None else float(self.spacing)
        margin = _FAR * apart
        surface = surface_pieces(self.region, spacing, x.min(axis=0) - margin, x.max(axis=0) + margin, self.within)
        pieces = surface.of(surface.inner)
        require(
            len(pieces.normal) > 0,
            f"The {self} has no surface at the particles, or only on the boundary of `within`: move or enlarge it.",
        )
        if self.within is not None:
            kept, whole = pieces.size.sum(), surface.size.sum()
            wide = np.ptp(pieces.corners.reshape(-1, self.dim), axis=0)
            if (wide >= _NARROW * apart).sum() < self.dim - 1:
                warn(
                    f"The Patch is {' x '.join(f'{a:.3g}' for a in wide)} m wide, less than two particles, "
                    f"{apart:.3g} m apart: its force and moment are right, but the grid spreads them further. Refine "
                    "the grid, or enlarge the patch."
                )
            if whole > 2 * kept:
                warn(
                    f"Of the surface in a Patch's `within`, {whole - kept:.3g} m^{self.dim - 1} lie on its boundary "
                    f"and do not count, {kept:.3g} lie inside: enlarge `within` beyond what is meant."
                )
        middle, area = pieces.middle, pieces.area
        weight = np.sqrt((area**2).sum(axis=1))
        particle = _nearest(x, middle, apart, self)
        axis = np.abs(area).argmax(axis=1)
        facing = 2 * axis + (np.take_along_axis(area, axis[:, None], axis=1)[:, 0] > 0)
        # a corner has pieces of several faces on one particle, whose normals a single point would average
        one, piece = np.unique(np.stack([particle, facing]), axis=1, return_inverse=True)
        summed = np.zeros((one.shape[1], 1 + 2 * self.dim))
        np.add.at(summed, piece.reshape(-1), np.column_stack([weight, weight[:, None] * middle, area]))
        whole, moment, area = np.split(summed, [1, 1 + self.dim], axis=1)
        middle = moment / whole
        rows, *column = self._columns(particles, one[0], middle, area)
        return _attached(particles, rows, middle, whole[:, 0], area, *column)

    def _columns(
        self, particles: Particles, particle: np.ndarray, middle: np.ndarray, area: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Particles, shares and moments [m] of a force on each point, (k, s), (k, s) and (k, s, d).

        A column goes down from a point through cells as high as that of its particle, up to the first that is beside
        its particle, of another volume or outside the region. Cell j takes the share b_j ∝ j + ½ in its middle y_j, and
        what is left for those below passes as a stress: m_j = b_j (y_j − x_j) + h (b_j/2 + Σ_k>j b_k) n. So the stress
        that balances the load is smooth there, which sums over particles need, and Σ_j b_j x_j + m_j is the point.
        """
        x, volume = np.asarray(particles.x, float), np.asarray(particles.volume, float)
        normal = area / np.sqrt((area**2).sum(axis=1))[:, None]
        height = 2 * ((middle - x[particle]) * normal).sum(axis=1)
        along = np.arange(_DEEP)[:, None] + 0.5
        y = middle - (along * height)[:, :, None] * normal
        far, rows = _tree(x).query(y)
        inside = np.asarray(self.region.contains(jnp.asarray(y.reshape(-1, self.dim)))).reshape(far.shape)
        alike = (far < _BESIDE * height) & (abs(volume[rows] / volume[particle] - 1) < _BESIDE) & inside
        rows[0], alike[0] = particle, True
        alike = np.logical_and.accumulate(alike)
        share = along * alike
        share /= share.sum(axis=0)
        through = (share[::-1].cumsum(axis=0)[::-1] - share / 2) * height * alike
        k = alike.any(axis=1).sum()
        moment = share[:, :, None] * (y - x[rows]) + through[:, :, None] * normal
        return np.where(alike, rows, particle)[:k], share[:k], moment[:k]


class PointsAt(AbstractPlace):
    """Single points in or on the body, or those of a line.

    Args:
        positions: where they are at the start [m], (s, d).
        weights: the share of each in the load [-], (s,), which sum to one. Default: equal shares.
    """

    positions: Rows
    weights: Numbers | None = None

    def __check_init__(self):
        require_fields(self)
        shape = shape_of(self.positions)
        require(len(shape) == 2 and shape[0] > 0, f"PointsAt need positions of shape (s, d), got {shape}.")
        if self.weights is not None:
            require(shape_of(self.weights) == shape[:1], f"PointsAt need one weight a position, got {self.weights}.")
            require_that(
                "PointsAt's weights are shares of the load and must sum to one (divide them by their sum)",
                lambda w: abs(w.sum() - 1) < _ROUNDED,
                self.weights,
            )

    @property
    def dim(self) -> int:
        return shape_of(self.positions)[1]

    def attached(self, particles: Particles) -> AttachedPoints:
        x, apart = _positions(particles, self)
        at = np.asarray(self.positions, float)
        weight = np.full(len(at), 1 / len(at)) if self.weights is None else np.asarray(self.weights, float)
        return _attached(particles, _nearest(x, at, apart, self)[None], at, weight)


def _positions(particles: Particles, place: AbstractPlace) -> tuple[np.ndarray, float]:
    """The particles' positions, and the distance between them [m]."""
    concrete = not is_traced((particles.x, particles.volume, particles.deformations, place))
    require(concrete, "Loads are attached to particles that are known: call attach outside of the jax transformation.")
    fits = place.dim == particles.dim
    require(fits, f"{type(place).__name__} must have {particles.dim} coordinates, as the particles, got {place.dim}.")
    volume = np.asarray(particles.volume)
    return np.asarray(particles.x, float), float(np.median(volume[volume > 0]) ** (1 / particles.dim))


def _tree(x: np.ndarray) -> Any:
    """The search tree for the nearest of positions."""
    from scipy.spatial import KDTree  # here, since it takes long to import

    return KDTree(x)


def _nearest(x: np.ndarray, positions: np.ndarray, apart: float, place: AbstractPlace) -> np.ndarray:
    """The number of the particle nearest to each position."""
    far, particle = _tree(x).query(positions)
    require(
        far <= _FAR * apart,
        f"The {type(place).__name__} has a point at {positions[far.argmax()]} m, {far.max():.3g} m off the nearest "
        "particle: place it on the body.",
    )
    return np.asarray(particle)


def _attached(
    particles: Particles,
    rows: np.ndarray,
    positions: np.ndarray,
    weight: np.ndarray,
    area: np.ndarray | None = None,
    share: np.ndarray | None = None,
    moment: np.ndarray | None = None,
) -> AttachedPoints:
    """Points at positions [m] on particles, (k, s), with undeformed offsets, moments and areas (Nanson's formula):
    A = Fᵀ a / det F."""
    dtype = particles.x.dtype
    exact = particles.count < 2 ** (jnp.finfo(dtype).nmant + 1)
    require(exact, f"{dtype} counts particles exactly only below {2 ** (jnp.finfo(dtype).nmant + 1)}: use float64.")
    if len(rows) == 1:
        share = moment = None
    offset = positions - np.asarray(particles.x, float)[rows[0]]
    kept = [np.asarray(F, float) for F in particles.deformations if F is not None and F.ndim == 3]
    if len(kept) == len(particles.deformations):
        d = particles.dim
        every = np.concatenate(kept)[rows, :d, :d]
        F = every[0]
        offset = np.linalg.solve(F, offset[:, :, None])[:, :, 0]
        if moment is not None:
            moment = np.asarray(np.linalg.solve(every, moment[..., None]))[..., 0]
        if area is not None:
            turned: np.ndarray = (np.swapaxes(F, 1, 2) @ area[:, :, None])[:, :, 0] / np.linalg.det(F)[:, None]
            area, weight = turned, np.sqrt((turned**2).sum(axis=1))
    arrays = (rows[0] if moment is None else rows, offset, weight, positions, area, share, moment)
    return AttachedPoints(*jax.device_put([a if a is None else np.asarray(a, dtype) for a in arrays]))


class LoadedPoints(eqx.Module):
    """s points that move with particles: u_s = Σ_i N_is u_i with N_is = w_ip + g_ip·r_s, the particle's own motion at
    the arm r_s. So a force reaches no node that its particle does not reach, its sum is right and so is its moment.
    Forces that are given act by their columns where there are any, Σ_j b_j w_ij + m_j·g_ij, with the same two."""

    x: Float[Array, "d s"]  # where they are [m]
    v: Float[Array, "d s"]  # their velocity, v_p + C_p r_s, without a C v_p [m/s]
    deformation: Float[Array, "k k s"] | None  # F of their particles [-], (d, d, s), of bodies of revolution (3, 3, s);
    # None where a law does not keep it
    rate: Float[Array, "k k s"] | None  # rate of F [1/s]; None without a velocity gradient
    place: Float[Array, "d s"]  # where they were when they were attached [m]
    weight: Float[Array, "s"]  # their undeformed areas [m^(d−1)], or shares [-]
    area: Float[Array, "d s"] | None  # outward normal times area of the undeformed surface [m^(d−1)]; None of points
    arm: Float[Array, "d s"]  # r_s [m]: F_p R_s, in the total description R_s
    stencil: Stencil  # nodes, weights and derivatives of the particle that each point is attached to
    particle: Int[Array, "s"]  # the number of that particle, shape (s,)
    column: Stencil | None = None  # of the k particles of each column, one after the other; None without columns
    share: Float[Array, "m s"] | None = None  # b [-]
    moment: Float[Array, "d m s"] | None = None  # m [m]: F_p m, in the total description m

    def after(self, time: Scalar) -> "LoadedPoints":
        """The points moved on by a time [s] with their velocity, and turned with its gradient."""
        F = self.deformation
        if F is not None and self.rate is not None:
            F = F + time * self.rate
        return replace(self, x=self.x + time * self.v, deformation=F)

    def displacement(self, moved: Displacement) -> Float[Array, "d s"]:
        """Σ_i N_is u_i, of a displacement or velocity of the nodes."""
        if moved.at_rest:
            return jnp.zeros_like(self.x)
        value, slopes = gather(self.stencil, moved.nodes)
        return value + sum(r * slope for r, slope in zip(self.arm, slopes, strict=True))

    def nodal(self, force: Float[Array, "d s"], size: int) -> NodeVector:
        """Σ_s N_is f_s, the transpose of `displacement`, shape (n, d)."""
        return scatter(self.stencil, force, self.arm[:, None] * force, size)

    def loaded(self, force: Float[Array, "d s"], size: int) -> NodeVector:
        """The forces on nodes by given forces on the points, through their columns, shape (n, d)."""
        if self.column is None or self.share is None or self.moment is None:
            return self.nodal(force, size)
        d, each = len(force), force[:, None]
        slopes = (self.moment[:, None] * each).reshape(d, d, -1)
        return scatter(self.column, (self.share * each).reshape(d, -1), slopes, size)

    def diagonal(self, coefficient: Float[Array, "d s"], size: int) -> NodeVector:
        """Σ_s (w_ip² + Σ_b g_ip,b² r_sb²) k_s [N/m], shape (n, d): a non-negative approximation of the diagonal of
        Σ_s N_is k_s N_js, exact where the arms are zero."""
        return scatter(self.stencil.squared, coefficient, self.arm[:, None] ** 2 * coefficient, size)

    def at_particles(
        self, rates: Float[Array, "s"], mass: Float[Array, "p"], steepness: Float[Array, "p"]
    ) -> Float[Array, "p"]:
        """Σ_s k_s (1 + A_p r_s²)/m_p of each particle, shape (p,), from k_s of each point: a bound of Σ_i N_is² k_s/m_i
        for a particle alone on the grid."""
        reach = 1 + (self.arm**2).sum(axis=0) * steepness[self.particle]
        return jnp.zeros_like(mass).at[self.particle].add(rates * reach) / mass


def keeps_deformation(law: AbstractLaw) -> bool:
    """Whether particles of a law keep the whole deformation gradient."""
    return law.allows_total and law.measure.undeformed(2).ndim == 2
