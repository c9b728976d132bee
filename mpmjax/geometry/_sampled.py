"""Regions of any shape, or of a triangle mesh, by samples of their signed distance."""

import itertools
import math
from pathlib import Path
from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import (
    checked,
    coordinates,
    finite,
    is_traced,
    positive,
    require,
    require_fields,
    require_memory,
    shape_of,
    shortened,
    warn,
)
from mpmjax.discretisation import BSpline
from mpmjax.geometry._cut_cells import inside_parts
from mpmjax.geometry._region import AbstractRegion, length

_SPLINE = BSpline(2)
_FIRST = 0.02
"""The first distance tried by which samples are moved, in spacings, so that the region has the shape's volume."""
_SECANTS = 4  # steps of the secant method that finds this distance
_ALIKE, _POOR = 1e-4, 5e-3  # relative errors of the volume at which the search ends, and beyond which it is warned of
_Spacing = Annotated[float, positive, "m"]
_PADDING = 3  # samples beyond the bounding box on each side: one and a half are the spline's


class SampledDistance(AbstractRegion):
    """A region by the signed distances of the points of a lattice, interpolated by quadratic B-splines. Its normal is
    continuous.

    Second order in the spacing h of the lattice: a surface of mean curvature κ in d dimensions moves inward by
    (d − 1)κh²/8, and edges are rounded over a spacing or two. `sample_distance` and `sample_mesh` move all samples by
    one distance of that order, with which the volume is right. Outside of the lattice, the distance to it is added.

    Args:
        lower: position of the first point of the lattice [m], (d,).
        spacing: distance h between its points [m].
        values: signed distances of its points [m], negative inside, an array of d axes of at least 4 points each. The
            lattice must reach two spacings beyond the surface.
    """

    lower: Annotated[Point, finite, "m"]
    spacing: Annotated[Scalar, positive, "m"]
    values: Annotated[
        Float[Array, "a"] | Float[Array, "a b"] | Float[Array, "a b c"] | Float[np.ndarray, "..."] | list, finite, "m"
    ]

    def __check_init__(self):
        require_fields(self)
        shape = jnp.shape(jnp.asarray(self.values))
        require(
            coordinates("SampledDistance's lower corner", self.lower) == len(shape) and len(shape) in (1, 2, 3),
            f"SampledDistance needs as many coordinates as its values have axes, got {self.lower} and shape {shape}.",
        )
        require(min(shape) >= 4, f"SampledDistance needs at least 4 samples in each direction, got {shape}.")
        inside = (jnp if is_traced(self.values) else np).asarray(self.values) < 0
        require(inside.any(), "SampledDistance's values must be negative somewhere: inside.")

    @property
    def dim(self) -> int:
        return len(self.lower)

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        """Σ_i N(x/h − i) values_i."""
        values = jnp.asarray(self.values, x.dtype)
        most = jnp.asarray(values.shape, x.dtype) - 1.5
        xi = (x - jnp.asarray(self.lower, x.dtype)) / self.spacing
        near = jnp.clip(xi, 0.5, most)
        base = jnp.clip(_SPLINE.base(near), 0, most - 1.5)
        weights = _SPLINE.weights((near - base).T)  # (d, 3, m)
        first = base.astype(jnp.int32)
        total = length(xi - near) * self.spacing
        for offset in itertools.product(range(3), repeat=self.dim):
            share = math.prod(weights[a, i] for a, i in enumerate(offset))
            total = total + share * values[tuple(first[:, a] + i for a, i in enumerate(offset))]
        return total

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The box around the sample points inside, enlarged by a spacing."""
        inside = np.argwhere(np.asarray(self.values) < 0)
        lower, h = np.asarray(self.lower, float), float(self.spacing)
        return lower + h * (inside.min(axis=0) - 1), lower + h * (inside.max(axis=0) + 1)

    def middle(self) -> Float[Array, "d"]:
        counts = jnp.asarray(jnp.shape(jnp.asarray(self.values)))
        lower = jnp.asarray(self.lower)
        return lower + (counts - 1).astype(lower.dtype) * self.spacing / 2


@checked
def sample_distance(region: AbstractRegion, spacing: _Spacing) -> SampledDistance:
    """Sample the signed distance of a bounded region.

    Args:
        region: the region.
        spacing: distance between samples [m].

    Raises:
        ValueError: a region without bounds.
    """
    points = _lattice(*region.bounds(), spacing)
    values = np.asarray(region.distance(jnp.asarray(points.reshape(-1, region.dim)))).reshape(points.shape[:-1])
    return _of_volume(_volume(region, values, points, spacing), values, points, spacing)


@checked
def sample_mesh(
    mesh: str | Path | tuple[Any, Any], spacing: _Spacing, *, scale: Annotated[float, positive] = 1.0
) -> SampledDistance:
    """Sample the signed distance from a closed surface of triangles. Needs the extra `mesh` (trimesh, rtree).

    Args:
        mesh: a file that trimesh reads (STL, OBJ, PLY, ...), or vertices, (j, 3), and faces, (k, 3).
        spacing: distance between samples [m].
        scale: factor to metres: 1e-3 of a file in millimetres.

    Raises:
        ImportError: trimesh or rtree is not installed.
        ValueError: a file that is missing or no mesh; a surface that is not closed, or whose faces do not all point
            outwards; one whose size shows, beside the spacing, that it is not in these units.
    """
    try:
        import rtree  # noqa: F401 # pyright: ignore[reportMissingImports]  # without it trimesh fails, later
        import trimesh  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError('A mesh needs trimesh and rtree: pip install "mpmjax[mesh]".') from error
    if isinstance(mesh, tuple):
        shapes = [shape_of(part) for part in mesh]
        triangles = all(shape is not None and len(shape) == 2 and shape[1] == 3 for shape in shapes)
        require(triangles, f"A mesh must be vertices of shape (j, 3) and faces of shape (k, 3), got shapes {shapes}.")
        surface: Any = trimesh.Trimesh(*mesh)
    else:
        require(Path(mesh).is_file(), f"There is no mesh {mesh}.")
        try:
            surface = trimesh.load_mesh(str(mesh))
        except Exception as error:  # of the readers of many formats, which may raise anything
            fault = shortened(" ".join(str(error).split()))
            raise ValueError(f"{mesh} is no mesh that can be read: {fault}") from None
        require(len(getattr(surface, "faces", ())) > 0, f"{mesh} holds no triangles.")
    require(
        surface.is_volume,
        "A mesh must be a closed surface whose faces all point outwards, got holes or faces that do not: repair it.",
    )
    lower, upper = np.asarray(surface.bounds) * scale
    size = f"The mesh measures {' x '.join(f'{side:.3g}' for side in upper - lower)} m"
    units = "give scale = 1e-3 for a file in millimetres, 1 for one in metres"
    require((upper - lower).max() > spacing, f"{size}, less than the spacing {spacing:.3g} m of its samples: {units}.")
    points = _lattice(lower, upper, spacing, f" {size}: {units}.")
    values = -scale * trimesh.proximity.signed_distance(surface, points.reshape(-1, 3) / scale)  # inside: positive
    return _of_volume(float(surface.volume) * scale**3, values.reshape(points.shape[:-1]), points, spacing)


def _of_volume(volume: float, values: np.ndarray, points: np.ndarray, spacing: float) -> SampledDistance:
    """The region of samples at points, all moved by the one distance with which it has this volume [m^d]."""
    lower = tuple(points[(0,) * values.ndim].tolist())

    def moved(by: float) -> tuple[SampledDistance, float]:
        region = SampledDistance(lower, spacing, values - by)
        return region, _volume(region, values - by, points, spacing) - volume

    (region, error), by = moved(0.0), _FIRST * spacing
    last = 0.0
    for _ in range(_SECANTS):
        if abs(error) <= _ALIKE * volume:
            return region
        region, new = moved(by)
        if new == error:
            break
        by, last, error = by - new * (by - last) / (new - error), by, new
    if abs(error) > _POOR * volume:
        warn(
            f"The sampled region's volume is {volume + error:.4g} m^{values.ndim}, and {volume:.4g} that of the shape: "
            f"take a smaller spacing than {spacing:.3g} m."
        )
    return region


def _volume(region: AbstractRegion, values: np.ndarray, points: np.ndarray, spacing: float) -> float:
    """The volume of a region [m^d]: the sum of the parts inside of cells of half the spacing near the surface, and of
    whole cells of the lattice elsewhere."""
    d, cells = values.ndim, tuple(slice(0, -1) for _ in range(values.ndim))
    near = np.abs(values[cells]) < (d**0.5 + 0.5) * spacing
    quarters = np.array(list(itertools.product((0.25, 0.75), repeat=d))) * spacing
    share, _ = inside_parts(region, (points[cells][near][:, None] + quarters).reshape(-1, d), np.full(d, spacing / 2))
    return float((share.mean() * near.sum() + (~near & (values[cells] < 0)).sum()) * spacing**d)


def _lattice(lower: np.ndarray, upper: np.ndarray, spacing: float, hint: str = "") -> np.ndarray:
    """The points of a lattice around a bounding box, (..., d); `hint` ends what is said of one that is too large."""
    bounded = np.isfinite(lower) & np.isfinite(upper)
    require(bounded, f"Only a region with bounds can be sampled, got {lower} to {upper}.")
    first = lower - _PADDING * spacing
    with np.errstate(over="ignore"):
        numbers = np.ceil((upper - lower) / spacing) + 2 * _PADDING + 1
        total = numbers.prod()
    require_memory(
        f"A lattice of {total:.3g} samples",
        total * (2 * len(lower) + 1) * 8,  # the coordinates, the points made of them, the distances
        f"take a larger spacing than {spacing} m for a shape from {lower} to {upper} m.{hint}",
    )
    counts = numbers.astype(int)
    axes = [a + spacing * np.arange(n) for a, n in zip(first, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
