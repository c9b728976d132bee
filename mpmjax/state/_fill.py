"""Filling a region with particles."""

import jax.numpy as jnp
import numpy as np

from mpmjax._types import Point, Scalar
from mpmjax.checks import checked, coordinates, require, require_memory, require_positive, shortened
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractRegion
from mpmjax.state._particles import Particles


@checked
def fill(
    region: AbstractRegion,
    grid: Grid,
    *,
    particles_per_cell: int | tuple[int, ...] | list[int] | None = None,
    density: Scalar,
    velocity: Point | None = None,
    dtype: type | str | None = None,
) -> Particles:
    """Fill a region with a lattice of particles at cell centres of a subdivided grid.

    In a box the lattice is fitted to the box (its counts are rounded, its spacing then is the box's side over the
    count), so that the particles' total mass and volume are the box's exactly. Any other region keeps the lattice
    points inside it, each with the volume of a lattice cell.

    Args:
        region: what to fill.
        grid: sets the spacing.
        particles_per_cell: a d-th power (4 in 2-D is 2 x 2), or a count for each direction. Default: two in each, 2^d.
        density: mass density [kg/m^d].
        velocity: initial velocity [m/s], (d,). Default: rest.
        dtype: float32 or float64. Default: jax's own, float32 unless 64-bit mode is on.

    Raises:
        ValueError: a count that is no d-th power, a region of another dimension, or one that holds no particle.
    """
    d = grid.dim
    try:
        precision = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    except TypeError:
        precision = None
    require(precision in (jnp.float32, jnp.float64), f"dtype must be float32 or float64, got {shortened(repr(dtype))}.")
    require_positive("density [kg/m^d]", density)
    if particles_per_cell is None:
        counts = np.full(d, 2)
    elif isinstance(particles_per_cell, (int, np.integer)):
        root = round(max(0, particles_per_cell) ** (1 / d))
        require(
            root >= 1 and root**d == particles_per_cell,
            f"particles_per_cell must be the {d}-th power of a whole number (or a tuple of {d} counts), got "
            f"{particles_per_cell}.",
        )
        counts = np.full(d, root)
    else:
        counts = np.asarray(particles_per_cell)
        require(
            counts.shape == (d,) and (counts >= 1).all() and counts.dtype.kind == "i",
            f"particles_per_cell must be one or {d} positive whole numbers, got {particles_per_cell}.",
        )
    velocity = (0.0,) * d if velocity is None else velocity
    require(coordinates("velocity", velocity) == d, f"velocity must have {d} components, got {velocity}.")
    lower, upper = region.bounds()
    require(lower.shape == (d,), f"The region is {lower.size}-dimensional, the grid {d}-dimensional.")
    require(
        np.isfinite(lower) & np.isfinite(upper), "A region to fill must be finite; infinite corners are for grips only."
    )
    size = upper - lower
    with np.errstate(over="ignore"):
        number = np.maximum(np.rint(size * counts / float(grid.spacing)), 1)
        total = number.prod()
    require_memory(
        f"A lattice of {total:.3g} particles",
        total * d * 2 * 8,  # the coordinates and the points made of them
        f"take a smaller region (it reaches from {lower} to {upper} m), a larger spacing (it is {grid.spacing} m) or "
        "fewer particles_per_cell.",
    )
    number = number.astype(int)
    cell = size / number
    axes = [low + (np.arange(n) + 0.5) * c for low, n, c in zip(lower, number, cell, strict=True)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, d)
    if not region.fills_bounds:
        lattice = lattice[np.asarray(region.contains(jnp.asarray(lattice)))]
    require(len(lattice) > 0, f"{region} holds no particle at this spacing: refine the grid or enlarge the region.")
    x = jnp.asarray(lattice, dtype=precision)
    v = jnp.broadcast_to(jnp.asarray(velocity, dtype=precision), x.shape)
    volume = jnp.asarray(np.full(len(lattice), np.prod(cell)), dtype=precision)
    return Particles(x=x, v=v, mass=jnp.asarray(density, precision) * volume, volume=volume)
