"""The parts of cells that lie inside a region: their volumes and centroids."""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.checks import canonical
from mpmjax.geometry._region import AbstractRegion

_BATCH = 4096
"""Points whose distance is computed together: one compiled program for any number of them."""
_HALVINGS = 2
"""How often a cell that the surface cuts is halved in each direction, before the surface is taken as a plane."""
_LINES = 4
"""Lines across a cell, in each direction, along which the plane is cut."""


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
    moments = _moments(canonical(region, jnp.result_type(float)), centres, size, _HALVINGS)
    share = np.clip(moments[:, 0], 0, 1)
    return share, centres + moments[:, 1:] / np.where(share > 0, share, 1)[:, None]


def _moments(region: AbstractRegion, centres: np.ndarray, size: np.ndarray, halvings: int) -> np.ndarray:
    """∫ (1, y) dy over the part of each cell that is inside, over the cell's volume, shape (m, 1 + d); y from the
    centre."""
    d = len(size)
    distance, normal = _distances(region, centres)
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


def _distances(region: AbstractRegion, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [m] of points [m], shape (m, d), and their gradients."""
    dtype = jnp.result_type(float)
    padded = np.zeros((-(-len(x) // _BATCH) * _BATCH, x.shape[1]), dtype)
    padded[: len(x)] = x
    results = [_batch(region, jnp.asarray(batch)) for batch in padded.reshape(-1, _BATCH, x.shape[1])]
    distance, gradient = (np.concatenate(parts).astype(float)[: len(x)] for parts in zip(*results, strict=True))
    return distance, gradient


@eqx.filter_jit
def _batch(region: AbstractRegion, x: Float[Array, "m d"]) -> tuple[Float[Array, "m"], Float[Array, "m d"]]:
    distance, pull = jax.vjp(region.distance, x)
    return distance, pull(jnp.ones_like(distance))[0]


def _by_plane(distance: np.ndarray, normal: np.ndarray, size: np.ndarray) -> np.ndarray:
    """`_moments` of cells in which the surface is a plane, along lines in the direction nearest to its normal.

    Args:
        distance: φ at the centre [m], shape (m,).
        normal: ∇φ [-] times the sides of the cell [m], shape (m, d).
        size: the sides [m], shape (d,).
    """
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
