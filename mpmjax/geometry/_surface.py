"""The surface of a region as small flat pieces, for what acts on surfaces."""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from mpmjax.checks import require, require_memory
from mpmjax.geometry._region import AbstractRegion

_ON_IT = 1e-9
"""Distance within which a lattice point is on the surface, in spacings."""


class Pieces(NamedTuple):
    """Flat pieces of a surface."""

    middle: np.ndarray
    """Their centroids [m], shape (s, d)."""
    area: np.ndarray
    """Their outward normals times their areas [m^(d−1)], shape (s, d)."""


def surface_pieces(
    region: AbstractRegion, spacing: float, lower: np.ndarray | None = None, upper: np.ndarray | None = None
) -> Pieces:
    """The surface of a region between two corners, by marching simplices: each cube of a lattice is divided into d!
    simplices (H. W. Kuhn, IBM J. Res. Dev. 4 (1960) 518, doi 10.1147/rd.45.0518), and the signed distance is taken as
    linear in each. Second order in the spacing; exact of boxes whose faces lie on the lattice.

    Args:
        region: whose surface.
        spacing: of the lattice, whose points are the multiples of it [m].
        lower: lower corner [m], shape (d,). Default: the region's.
        upper: upper corner [m], shape (d,).

    Raises:
        ValueError: a region without end between infinite corners.
    """
    d = region.dim
    first, last = region.bounds()
    first = first if lower is None else np.maximum(first, lower)
    last = last if upper is None else np.minimum(last, upper)
    require(np.isfinite(first) & np.isfinite(last), "The surface of an infinite region has no end: give corners.")
    start = np.floor(first / spacing - 0.5).astype(int)
    counts = np.ceil(last / spacing + 0.5).astype(int) - start + 1
    require_memory(
        f"The surface of a region on a lattice of {float(np.prod(counts.astype(float))):.3g} points",
        float(np.prod(counts.astype(float))) * (d + 1) * 8,
        f"take a longer spacing than {spacing:.3g} m.",
    )
    axes = [(low + np.arange(n)) * spacing for low, n in zip(start, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = np.asarray(region.distance(jnp.asarray(points.reshape(-1, d))), float).reshape(counts)
    distance = np.where(np.abs(distance) <= _ON_IT * spacing, 0, distance)
    found = [_cut(*corners) for corners in _simplices(points, distance)]
    middle, area = (np.concatenate(parts) for parts in zip(*found, strict=True))
    some = (area**2).sum(axis=1) > (_ON_IT * spacing ** (d - 1)) ** 2
    return Pieces(middle[some], area[some])


def _simplices(points: np.ndarray, distance: np.ndarray):
    """The corners (m, d + 1, d) and their distances (m, d + 1) of the simplices that the surface cuts: one set for each
    way from a cube's first corner to its last, a step along one axis after another."""
    d = points.shape[-1]

    def corner(a: np.ndarray, offset: np.ndarray) -> np.ndarray:
        return a[tuple(slice(o, o + n - 1) for o, n in zip(offset, distance.shape, strict=True))]

    for order in itertools.permutations(range(d)):
        offsets = np.concatenate([np.zeros((1, d), int), np.cumsum(np.eye(d, dtype=int)[list(order)], axis=0)])
        values = np.stack([corner(distance, o).reshape(-1) for o in offsets], axis=1)
        cut = (values <= 0).any(axis=1) & (values > 0).any(axis=1)
        yield np.stack([corner(points, o).reshape(-1, d)[cut] for o in offsets], axis=1), values[cut]


def _cut(corners: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and area vectors of the surface in simplices, those inside sorted first."""
    d = corners.shape[-1]
    order = np.argsort(values > 0, axis=1, kind="stable")
    corners = np.take_along_axis(corners, order[:, :, None], axis=1)
    values = np.take_along_axis(values, order, axis=1)
    within = (values <= 0).sum(axis=1)
    inside = (np.arange(d + 1) < within[:, None])[:, :, None]
    outward = (corners * np.where(inside, -1 / within[:, None, None], 1 / (d + 1 - within)[:, None, None])).sum(axis=1)

    def crossing(i: int, j: int, rows: np.ndarray) -> np.ndarray:
        a, b = values[rows, i], values[rows, j]
        return corners[rows, i] + (a / (a - b))[:, None] * (corners[rows, j] - corners[rows, i])

    middles, areas = [np.zeros((0, d))], [np.zeros((0, d))]
    for count in range(1, d + 1):
        rows = np.flatnonzero(within == count)
        inner, outer = range(count), range(count, d + 1)
        for piece in _pieces(d, inner, outer):
            vertices = [crossing(i, j, rows) for i, j in piece]
            area = _area(vertices)
            side = np.sign((area * outward[rows]).sum(axis=1, keepdims=True))
            middles.append(np.mean(vertices, axis=0))
            areas.append(side * area)
    return np.concatenate(middles), np.concatenate(areas)


def _pieces(d: int, inner: range, outer: range) -> list[list[tuple[int, int]]]:
    """The flat pieces of d corners each into which the surface of a simplex is divided, a corner given by the ends of
    the edge on which it lies."""
    edges = list(itertools.product(inner, outer))
    if len(edges) == d:
        return [edges]
    (a, c), (b, e) = (inner[0], outer[0]), (inner[1], outer[1])  # two corners inside and two outside, in 3-D
    return [[(a, c), (a, e), (b, e)], [(a, c), (b, e), (b, c)]]


def _area(vertices: list[np.ndarray]) -> np.ndarray:
    """The area vectors of points, segments or triangles, of either sign."""
    d = vertices[0].shape[1]
    if d == 1:
        return np.ones_like(vertices[0])
    if d == 2:
        along = vertices[1] - vertices[0]
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    return np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0]) / 2
