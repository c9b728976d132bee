"""Cells fitted to a body: their centroids and volumes."""

import itertools

import numpy as np

Cells = tuple[np.ndarray, np.ndarray]
"""Centroids [m], shape (m, d), and volumes [m^d], shape (m,)."""


def box_cells(lower: np.ndarray, upper: np.ndarray, size: np.ndarray) -> Cells:
    """Equal cells of a box, near `size` [m] in each direction."""
    number = np.maximum(np.rint((upper - lower) / size), 1).astype(int)
    cell = (upper - lower) / number
    axes = [low + (np.arange(n) + 0.5) * c for low, n, c in zip(lower, number, cell, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(lower))
    return centres, np.full(len(centres), np.prod(cell))


def polar_cells(inner: float, outer: float, size: np.ndarray) -> Cells:
    """The sectors of concentric rings that fill inner ≤ R ≤ outer [m] about the origin of a plane.

    The rings are of equal thickness, near size[0]; each is cut into a multiple of four equal sectors, of a length near
    size[1] at its middle. With r₁, r₂ the radii of a ring and α the angle of a sector, its area is α (r₂² − r₁²)/2 and
    the radius of its centroid 2 (r₂³ − r₁³)/(3 (r₂² − r₁²)) sin(α/2)/(α/2).
    """
    rings = max(1, round((outer - inner) / size[0]))
    edges = np.linspace(inner, outer, rings + 1)
    centroids, areas = [], []
    for r1, r2 in itertools.pairwise(edges):
        number = 4 * max(1, round(np.pi * (r1 + r2) / size[1] / 4))
        half = np.pi / number
        radius = 2 * (r2**3 - r1**3) / (3 * (r2**2 - r1**2)) * np.sin(half) / half
        angle = (2 * np.arange(number) + 1) * half
        centroids.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))
        areas.append(np.full(number, half * (r2**2 - r1**2)))
    return np.concatenate(centroids), np.concatenate(areas)


def round_cells(start: np.ndarray, end: np.ndarray, inner: float, outer: float, size: np.ndarray) -> Cells:
    """`polar_cells` about the axis from `start` to `end` [m], shape (3,), in equal slices of thickness near size[2]."""
    height = np.linalg.norm(end - start)
    axis = (end - start) / height
    first = np.eye(3)[np.abs(axis).argmin()]
    first = np.cross(axis, first) / np.linalg.norm(np.cross(axis, first))
    across = np.stack([first, np.cross(axis, first)])
    plane, area = polar_cells(inner, outer, size)
    along, thickness = box_cells(np.zeros(1), np.array([height]), size[2:])
    centroids = start + (plane @ across)[:, None] + along * axis
    return centroids.reshape(-1, 3), np.outer(area, thickness).reshape(-1)
