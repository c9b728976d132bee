"""Regions on lattices: the parts of cells that lie inside, and the surface as small flat pieces."""

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import canonical, require, require_memory
from mpmjax.geometry._region import AbstractRegion

_BATCH = 4096  # points that are computed together: one compiled program serves any number of them
_HALVINGS = 2
"""How often a cell that the surface cuts is halved in each direction, before the surface is taken as a plane."""
_LINES = 4  # lines across a cell, in each direction, along which the plane is cut
_FAR = 1e30  # what a distance without end counts as, so that differences are numbers
_ON_IT = 1e-9  # distance within which a point is on a surface, in spacings
_ROUNDINGS = 8.0  # the least such distance, in roundings of the greatest coordinate


def _batched(function: Callable[[AbstractRegion, Array], Any], region: AbstractRegion, x: np.ndarray) -> Any:
    """The array, or several, that a compiled function of a region and of points [m], shape (m, d), gives, a row for
    each point."""
    dtype = jnp.result_type(float)
    batches = np.zeros((max(1, -(-len(x) // _BATCH)), _BATCH, x.shape[1]), dtype)
    batches.reshape(-1, x.shape[1])[: len(x)] = x
    region = canonical(region, dtype)
    results = [function(region, jax.device_put(batch)) for batch in batches]
    return jax.tree.map(lambda *parts: np.concatenate(parts).astype(float)[: len(x)], *results)


@eqx.filter_jit
def _distance_and_gradient(
    region: AbstractRegion, x: Float[Array, "m d"]
) -> tuple[Float[Array, "m"], Float[Array, "m d"]]:
    distance, pull = jax.vjp(region.distance, x)
    return distance, pull(jnp.ones_like(distance))[0]


@eqx.filter_jit
def _sides_and_slopes(
    region: AbstractRegion, x: Float[Array, "m d"]
) -> tuple[Float[Array, "m k"], Float[Array, "m k d"]]:
    return region.sides(x), jax.vmap(jax.jacfwd(lambda at: region.sides(at[None])[0]))(x)


_sides = eqx.filter_jit(lambda region, x: region.sides(x))
_joined = eqx.filter_jit(lambda region, behind: region.joined((behind > 0).astype(behind.dtype)))


def inside_parts(region: AbstractRegion, centres: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The share of each cell that lies inside a region, and the centroid of that part.

    Cells cut by the surface are halved in each direction, again where they are still cut; in the smallest the surface
    is the tangent plane φ + ∇φ·y = 0. A surface of mean curvature κ is then off by about κ (h/4)²/24 for cells of size
    h, and an edge by a part of the smallest cells along it: volumes are of second order in h.

    Args:
        region: the region.
        centres: the centres of the cells [m], shape (m, d).
        size: the sides of a cell [m], shape (d,).

    Returns:
        share of each cell [-], shape (m,), and centroids [m], shape (m, d), of cells without a part their centres.
    """
    moments = _moments(region, centres, size, _HALVINGS)
    share = np.clip(moments[:, 0], 0, 1)
    return share, centres + moments[:, 1:] / np.where(share > 0, share, 1)[:, None]


def _moments(region: AbstractRegion, centres: np.ndarray, size: np.ndarray, halvings: int) -> np.ndarray:
    """∫ (1, y) dy over the part of each cell that is inside, over its volume, shape (m, 1 + d); y from the centre."""
    d = len(size)
    distance, normal = _batched(_distance_and_gradient, region, centres)
    reach = np.linalg.norm(size) / 2
    moments = np.zeros((len(centres), 1 + d))
    moments[distance <= -reach, 0] = 1
    cut = np.abs(distance) < reach
    if not cut.any():
        return moments
    if halvings == 0:
        moments[cut] = _by_plane(distance[cut], normal[cut] * size, size)
        return moments
    offsets = np.array(list(itertools.product((-0.25, 0.25), repeat=d))) * size
    children = (centres[cut, None] + offsets).reshape(-1, d)
    parts = _moments(region, children, size / 2, halvings - 1).reshape(-1, 2**d, 1 + d)
    parts[..., 1:] += parts[..., :1] * offsets
    moments[cut] = parts.mean(axis=1)
    return moments


def _by_plane(distance: np.ndarray, normal: np.ndarray, size: np.ndarray) -> np.ndarray:
    """`_moments` of cells in which the surface is a plane, along lines in the direction nearest to its normal, by φ at
    the centres [m], shape (m,), and ∇φ [-] times the sides of the cell [m], shape (m, d)."""
    d = len(size)
    rows, along = np.arange(len(distance)), np.abs(normal).argmax(axis=1)
    places = (np.arange(_LINES) + 0.5) / _LINES - 0.5
    across = np.array(list(itertools.product(places, repeat=d - 1))).reshape(_LINES ** (d - 1), d - 1)  # in sides
    beside = np.array([[b for b in range(d) if b != a] for a in range(d)], int)[along]
    slope = normal[rows, along]
    height = distance[:, None] + np.einsum("mb,lb->ml", np.take_along_axis(normal, beside, axis=1), across)
    crossing = np.clip(-height / np.where(slope == 0, 1, slope)[:, None], -0.5, 0.5)
    up = (slope > 0)[:, None]  # inside lies below the crossing
    length = np.where(up, crossing + 0.5, 0.5 - crossing)
    moment = np.where(up, 1, -1) * (crossing**2 - 0.25) / 2
    flat = (slope == 0)[:, None]  # no direction: inside as its centre is
    length, moment = np.where(flat, distance[:, None] <= 0, length), np.where(flat, 0, moment)
    moments = np.zeros((len(distance), 1 + d))
    moments[:, 0] = length.mean(axis=1)
    moments[rows, 1 + along] = moment.mean(axis=1) * size[along]
    for number in range(d - 1):
        axis = beside[:, number]
        moments[rows, 1 + axis] = (length * across[:, number]).mean(axis=1) * size[axis]
    return moments


class Pieces(NamedTuple):
    """Flat pieces of a surface: points, segments or triangles."""

    corners: np.ndarray  # their corners [m], shape (s, d, d)
    normal: np.ndarray  # their outward unit normals, shape (s, d)
    inner: np.ndarray  # whether a piece lies off the boundary of the regions that clipped it, shape (s,)

    @property
    def middle(self) -> np.ndarray:
        """Their centroids [m], shape (s, d)."""
        return self.corners.mean(axis=1)

    @property
    def size(self) -> np.ndarray:
        """Their areas [m^(d−1)], shape (s,)."""
        return np.sqrt((_area(self.corners) ** 2).sum(axis=1))

    @property
    def area(self) -> np.ndarray:
        """Their outward normals times their areas [m^(d−1)], shape (s, d)."""
        return self.size[:, None] * self.normal

    def of(self, rows: np.ndarray) -> "Pieces":
        """The pieces with these numbers, or where a mask is true."""
        return Pieces(*(a[rows] for a in self))


def surface_pieces(
    region: AbstractRegion,
    spacing: float,
    lower: np.ndarray | None = None,
    upper: np.ndarray | None = None,
    within: AbstractRegion | None = None,
) -> Pieces:
    """The surface of a region between two corners, by marching simplices: each cube of a lattice is divided into d!
    simplices (H. W. Kuhn, IBM J. Res. Dev. 4 (1960) 518, doi 10.1147/rd.45.0518). Each of the region's `sides` is taken
    as linear in each simplex and cut along the others, and those of `within`. Second order in the spacing, also at the
    edges of what is composed; exact of boxes, and of the parts of them in a box.

    Args:
        region: whose surface.
        spacing: of the lattice, whose points are the multiples of it [m].
        lower: lower corner [m], shape (d,). Default: the region's.
        upper: upper corner [m], shape (d,).
        within: the region in which it is wanted. Default: everywhere.

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
        float(np.prod(counts.astype(float))) * 3 * d * 8,
        f"take a longer spacing than {spacing:.3g} m.",
    )
    axes = [(low + np.arange(n)) * spacing for low, n in zip(start, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    near = max(_ON_IT * spacing, _ROUNDINGS * float(jnp.finfo(float).eps) * np.abs(points).max())
    values = _rounded(_batched(_sides, region, points.reshape(-1, d)), near)
    of_sides = []
    for side in range(values.shape[1]):
        parts = [_cut(*corners) for corners in _simplices(points, values[:, side].reshape(counts))]
        corners, outward = (np.concatenate(part) for part in zip(*parts, strict=True))
        pieces = _sized(Pieces(corners, outward, np.ones(len(corners), bool)), spacing)
        of_sides.append(_bounding(pieces, side, region, within, near))
    return _sized(Pieces(*(np.concatenate(part) for part in zip(*of_sides, strict=True))), spacing)


def _sized(pieces: Pieces, spacing: float) -> Pieces:
    """The pieces whose area is more than rounding, with normals of length one."""
    pieces = pieces.of(pieces.size > _ON_IT * spacing ** (pieces.normal.shape[1] - 1))
    return pieces._replace(normal=pieces.normal / np.sqrt((pieces.normal**2).sum(axis=1, keepdims=True)))


def _rounded(distance: np.ndarray, near: float) -> np.ndarray:
    """Distances, zero where they are not more than `near`, and none without end."""
    return np.where(np.abs(distance) <= near, 0, np.clip(distance, -_FAR, _FAR))


def _simplices(points: np.ndarray, values: np.ndarray):
    """The corners (m, d + 1, d) and their values (m, d + 1) of the simplices that the surface cuts: one set for each
    way from a cube's first corner to its last, a step along one axis after another."""
    d = points.shape[-1]
    inside = values <= 0
    corners = [
        inside[tuple(slice(o, o + n - 1) for o, n in zip(offset, inside.shape, strict=True))]
        for offset in itertools.product((0, 1), repeat=d)
    ]
    cubes = np.argwhere(np.any(corners, axis=0) & ~np.all(corners, axis=0))
    for order in itertools.permutations(range(d)):
        offsets = np.concatenate([np.zeros((1, d), int), np.cumsum(np.eye(d, dtype=int)[list(order)], axis=0)])
        at = tuple(np.moveaxis(cubes[:, None] + offsets, -1, 0))
        cut = inside[at].any(axis=1) & ~inside[at].all(axis=1)
        yield points[at][cut], values[at][cut]


def _cut(corners: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The flat pieces of the surface in simplices, by their corners, and directions out of it."""
    d = corners.shape[-1]
    corners, values, within = _sorted(corners, values)
    inside = (np.arange(d + 1) < within[:, None])[:, :, None]
    outward = (corners * np.where(inside, -1 / within[:, None, None], 1 / (d + 1 - within)[:, None, None])).sum(axis=1)
    simplices, directions = [np.zeros((0, d, d))], [np.zeros((0, d))]
    for count in range(1, d + 1):
        rows = np.flatnonzero(within == count)
        pieces = [list(itertools.product(range(count), range(count, d + 1)))]  # corners, by the ends of their edges
        if len(pieces[0]) > d:  # two corners inside and two outside, in 3-D
            first, second, third, fourth = pieces[0]
            pieces = [[first, second, fourth], [first, fourth, third]]
        for piece in pieces:
            vertices = _crossings(corners[rows], values[rows], piece)
            area = _area(vertices)
            simplices.append(vertices)
            directions.append(np.sign((area * outward[rows]).sum(axis=1, keepdims=True)) * area)
    return np.concatenate(simplices), np.concatenate(directions)


def _bounding(pieces: Pieces, side: int, region: AbstractRegion, within: AbstractRegion | None, near: float) -> Pieces:
    """The parts of the pieces of one side of a region that bound it, in another region.

    Corners are moved onto the side; then pieces are cut along all other sides, which are linear in each. A part is on
    the surface if the region holds what is behind it and not what is before it, and inside of `within` if that holds
    both. A side on which all of a piece lies divides the two; of several that face alike the first has the piece.
    """
    m, d, _ = pieces.corners.shape
    both = (region,) if within is None else (region, within)
    x = pieces.corners.reshape(-1, d)
    each = [_batched(_sides_and_slopes, other, x) for other in both]
    values, slopes = (np.concatenate(part, axis=1) for part in zip(*each, strict=True))
    values = _rounded(values, near)
    step = -(values[:, side] / np.maximum((slopes[:, side] ** 2).sum(axis=1), 0.25))[:, None] * slopes[:, side]
    values = _rounded(values + (slopes * step[:, None]).sum(axis=2), near)
    values[:, side] = 0
    corners, values = (x + step).reshape(m, d, d), values.reshape(m, d, slopes.shape[1])
    area = _area(corners)
    area *= np.sign((area * pieces.normal).sum(axis=1, keepdims=True))
    alike = np.einsum("ma,mka->mk", area, slopes.reshape(m, d, *slopes.shape[1:]).sum(axis=1)) > 0
    flat = (values == 0).all(axis=1)

    points, piece = np.concatenate([corners, values], axis=2), np.arange(m)
    for column in range(d, points.shape[2]):
        points, piece = _split(points, piece, column)
    behind, flat, alike = points[:, :, d:].mean(axis=1) <= 0, flat[piece], alike[piece]
    places = np.where(flat, alike, behind), np.where(flat, ~alike, behind)  # behind each piece, and before it
    k = each[0][0].shape[1]
    here, there = (_batched(_joined, region, place[:, :k]) > 0 for place in places)
    bounds, inner = here & ~there & ~(flat & alike)[:, :side].any(axis=1), np.ones(len(points), bool)
    if within is not None:
        here, there = (_batched(_joined, within, place[:, k:]) > 0 for place in places)
        bounds, inner = bounds & (here | there), here & there
    return Pieces(points[:, :, :d], area[piece], inner).of(bounds)


def _split(points: np.ndarray, piece: np.ndarray, column: int) -> tuple[np.ndarray, np.ndarray]:
    """Corners with linear fields, in columns, of pieces that are cut where a field is zero, and the pieces' numbers."""
    d, values = points.shape[1], points[:, :, column]
    cut = (values > 0).any(axis=1) & (values < 0).any(axis=1)
    parts, numbers = [points[~cut]], [piece[~cut]]
    for sign in (1, -1):
        corners, heights, within = _sorted(points[cut], sign * values[cut])
        for count in range(1, d):
            rows = within == count
            for last in range(count):  # the corners inside up to it, and the crossings from it on
                edges = [(i, i) for i in range(last + 1)]
                edges += [(i, j) for i in range(last, count) for j in range(count, d)]
                parts.append(_crossings(corners[rows], heights[rows], edges))
                numbers.append(piece[cut][rows])
    return np.concatenate(parts), np.concatenate(numbers)


def _sorted(corners: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners and their values with those inside first, and how many these are."""
    order = np.argsort(values > 0, axis=1, kind="stable")
    corners, values = np.take_along_axis(corners, order[:, :, None], axis=1), np.take_along_axis(values, order, axis=1)
    return corners, values, (values <= 0).sum(axis=1)


def _crossings(corners: np.ndarray, values: np.ndarray, edges: list[tuple[int, int]]) -> np.ndarray:
    """Points at which edges cross the surface [m], shape (m, number of edges, d). An edge has the numbers of a corner
    inside and one outside; from a corner to itself it gives the corner."""

    def crossing(i: int, j: int) -> np.ndarray:
        a, b = values[:, i, None], values[:, j, None]
        return corners[:, i] if i == j else corners[:, i] + a / (a - b) * (corners[:, j] - corners[:, i])

    return np.stack([crossing(i, j) for i, j in edges], axis=1)


def _area(corners: np.ndarray) -> np.ndarray:
    """The area vectors of points, segments or triangles, of either sign, by their corners, shape (m, d, d)."""
    d = corners.shape[-1]
    if d == 1:
        return np.ones_like(corners[:, 0])
    along = corners[:, 1] - corners[:, 0]
    if d == 2:
        return np.stack([along[:, 1], -along[:, 0]], axis=1)
    return np.cross(along, corners[:, 2] - corners[:, 0]) / 2
