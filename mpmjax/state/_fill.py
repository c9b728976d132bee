"""Filling a region with particles."""

import itertools
from collections.abc import Callable
from typing import Annotated, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Point, Scalar
from mpmjax.checks import between, checked, coordinates, is_traced, positive, require, require_memory, shortened
from mpmjax.discretisation import Grid
from mpmjax.geometry import AbstractMotion, AbstractRegion, Box, box_cells, inside_parts
from mpmjax.state._particles import Particles

Velocity = Point | AbstractMotion | Callable[[Float[Array, "d"]], Float[Array, "d"]]

_ALIKE = 1e-6  # part of a cell by which a region may reach into the next for rounding's sake
_SMALL = 0.02  # the least share of a cell that is a particle of its own


@checked
def fill(
    region: AbstractRegion,
    grid: Grid,
    *,
    particles_per_cell: Annotated[int | tuple[int, ...] | list[int], between(1, np.inf)] | None = None,
    density: Annotated[Scalar, positive, "kg/m^d"],
    velocity: Velocity | None = None,
    dtype: type | str | None = None,
    fitted: bool = False,
) -> Particles:
    """Fill a region with a lattice of particles at cell centres of a subdivided grid.

    In a box the lattice is fitted to the box (its counts are rounded, its spacing then is the box's side over the
    count), so that the particles' total mass and volume are the box's exactly. In any other region the lattice is that
    of the grid, subdivided. A cell that the surface cuts has a particle too: at the centroid of the part that lies
    inside, with the volume of that part. So volume, mass and centre of mass are of second order in the spacing. A part
    smaller than a fiftieth of a cell is given to the neighbour with the largest part.

    With `fitted` the cells follow the surface instead: rings of equal sectors in a `Ball` of 2-D, an `Annulus`, and in
    3-D a `Cylinder` and a `Tube`. Volume and mass are then exact, and all particles nearly alike.

    Args:
        region: what to fill.
        grid: sets the spacing.
        particles_per_cell: a d-th power (4 in 2-D is 2 x 2), or a count for each direction. Default: two in each, 2^d.
            In fitted cells the directions are: across the rings, around, along the axis.
        density: mass density [kg/m^d].
        velocity: initial velocity [m/s], (d,); or a motion, of which the velocity at t = 0 is taken; or a function of
            one point [m], (d,), written with jax.numpy. The last two give the gradient C too. Default: rest.
        dtype: float32 or float64. Default: jax's own, float32 unless 64-bit mode is on.
        fitted: whether the cells follow the region's surface.

    Raises:
        ValueError: a count that is no d-th power, a region of another dimension, one that holds no particle, or one to
            which no cells can be fitted.
    """
    d = grid.dim
    precision = _precision(dtype)
    if particles_per_cell is None:
        counts = np.full(d, 2)
    elif isinstance(particles_per_cell, (int, np.integer)):
        root = round(particles_per_cell ** (1 / d))
        require(
            root**d == particles_per_cell,
            f"particles_per_cell must be the {d}-th power of a whole number (or a tuple of {d} counts), got "
            f"{particles_per_cell}.",
        )
        counts = np.full(d, root)
    else:
        counts = _counts("particles_per_cell must be one or", particles_per_cell, d)
    field = _velocity(velocity, d)
    lower, upper = region.bounds()
    require(lower.shape == (d,), f"The region is {lower.size}-dimensional, the grid {d}-dimensional.")
    bounded = np.isfinite(lower) & np.isfinite(upper)
    require(bounded, "A region to fill must be finite; infinite corners are for grips only.")
    cell = float(grid.spacing) / counts
    with np.errstate(over="ignore"):
        total = np.maximum(np.rint((upper - lower) / cell), 1).prod()
    require_memory(
        f"A lattice of {total:.3g} particles",
        total * d * 2 * 8,  # the coordinates and the points made of them
        f"take a smaller region (it reaches from {lower} to {upper} m), a larger spacing (it is {grid.spacing} m) or "
        "fewer particles_per_cell.",
    )
    cells = region.fitted(cell) if fitted or region.fills_bounds else _cut_cells(region, cell)
    if cells is None:
        raise ValueError(
            f"No cells can be fitted to {region}: leave out fitted, for a lattice cut by the surface, or map one by "
            "fill_mapped."
        )
    require(len(cells[0]) > 0, f"{region} holds no particle at this spacing: refine the grid or enlarge the region.")
    x, volume = cells
    if grid.axisymmetric and not region.fills_bounds:
        x, volume = x[x[:, 0] > 0], volume[x[:, 0] > 0]  # a ball or disk around the axis by its half
    return _particles(x, volume, density, field, precision, revolved=grid.axisymmetric)


@checked
def fill_mapped(
    mapping: Callable[[Float[Array, "d"]], Float[Array, "d"]],
    box: Box,
    counts: tuple[int, ...] | list[int],
    *,
    density: Annotated[Scalar, positive, "kg/m^d"],
    velocity: Velocity | None = None,
    dtype: type | str | None = None,
    axisymmetric: bool = False,
) -> Particles:
    """Fill the image of a box under a smooth map x(ξ) with the images of equal cells: a lattice fitted to any boundary
    that such a map has.

        def quarter(xi):  # of a ring, by radius and angle
            return jnp.stack([xi[0] * jnp.cos(xi[1]), xi[0] * jnp.sin(xi[1])])

        mpm.fill_mapped(quarter, mpm.Box((0.4, 0.0), (0.6, jnp.pi / 2)), (8, 32), density=1e3)

    A particle is the centroid of its cell's image and has its volume, ∫ |det ∂x/∂ξ| dξ, by three Gauss points in each
    direction.

    Args:
        mapping: x(ξ) [m], shape (d,), of one point ξ of the box, shape (d,), written with jax.numpy.
        box: the box of ξ, in the units of ξ.
        counts: number of cells along each axis of the box.
        density, velocity, dtype: as for `fill`.
        axisymmetric: whether the image is a section of a body of revolution, by r and z.

    Raises:
        ValueError: a map whose Jacobian vanishes or changes its sign in the box, counts that are no whole numbers, or
            a box without bounds.
    """
    d, precision = box.dim, _precision(dtype)
    number = _counts("counts must be", counts, d)
    field = _velocity(velocity, d)
    lower, upper = box.bounds()
    require(np.isfinite(lower) & np.isfinite(upper), "A box to map must be finite.")
    require_memory(
        f"A lattice of {number.prod():.3g} particles", float(number.prod()) * 3**d * 2 * d * 8, "take smaller counts."
    )
    size = (upper - lower) / number
    centres, volume = box_cells(lower, upper, size)
    nodes, weights = np.polynomial.legendre.leggauss(3)
    offsets = np.array(list(itertools.product(nodes / 2, repeat=d))) * size
    share = np.array(list(itertools.product(weights / 2, repeat=d))).prod(axis=1)
    points = (centres[:, None] + offsets).reshape(-1, d)
    mapped, slopes = eqx.filter_jit(jax.vmap(lambda xi: (mapping(xi), jax.jacfwd(mapping)(xi))))(points)
    require(mapped.shape == points.shape, f"A map must take {d} coordinates to {d}, got {mapped.shape[1:]} of them.")
    jacobian = np.linalg.det(np.asarray(slopes, float))
    require(
        (jacobian > 0).all() or (jacobian < 0).all(),
        "A map must not fold: its Jacobian det ∂x/∂ξ must have one sign in the box, got values from "
        f"{jacobian.min():.3g} to {jacobian.max():.3g}.",
    )
    part = np.abs(jacobian).reshape(-1, len(share)) * share
    x = np.einsum("mq,mqd->md", part, np.asarray(mapped, float).reshape(*part.shape, d))
    x, volume = x / part.sum(axis=1)[:, None], part.sum(axis=1) * volume
    return _particles(x, volume, density, field, precision, revolved=axisymmetric)


def _precision(dtype: type | str | None) -> Any:
    try:
        precision = jnp.result_type(float) if dtype is None else jnp.dtype(dtype)
    except TypeError:
        precision = None
    require(precision in (jnp.float32, jnp.float64), f"dtype must be float32 or float64, got {shortened(repr(dtype))}.")
    return precision


def _counts(what: str, counts: tuple[int, ...] | list[int], d: int) -> np.ndarray:
    number = np.asarray(counts)
    whole = number.shape == (d,) and number.dtype.kind == "i" and (number >= 1).all()
    require(whole, f"{what} {d} positive whole numbers, got {counts}.")
    return number


def _velocity(velocity: Velocity | None, d: int) -> Velocity:
    """The velocity as d numbers, zero by default, or as a function of a point."""
    velocity = (0.0,) * d if velocity is None else velocity
    if isinstance(velocity, AbstractMotion):
        require(velocity.dim == d, f"velocity must be a motion in {d} dimensions, got one in {velocity.dim}.")

        def at_start(x: Float[Array, "d"], motion: AbstractMotion = velocity) -> Float[Array, "d"]:
            """The velocity of the point of the moving body that is at x at t = 0 [m/s], shape (d,)."""
            zero = jnp.zeros((), x.dtype)
            X = motion.origin(x[None], zero)
            return jax.jvp(lambda t: motion.place(X, t), (zero,), (jnp.ones_like(zero),))[1][0]

        return at_start
    if not callable(velocity):
        require(coordinates("velocity", velocity) == d, f"velocity must have {d} components, got {velocity}.")
    return velocity


def _cut_cells(region: AbstractRegion, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroids [m], (m, d), and volumes [m^d], (m,), of the parts inside a region of the cells of the subdivided
    grid."""
    lower, upper = region.bounds()
    first, last = np.floor(lower / size + _ALIKE), np.ceil(upper / size - _ALIKE)
    number = np.maximum(last - first, 1).astype(int)
    centres, volume = box_cells(first * size, (first + number) * size, size)
    share, centroid = inside_parts(region, centres, size)
    share, centroid = share.reshape(number), centroid.reshape(*number, -1)
    # parts smaller than `_SMALL` go to the neighbour, across a face, of the largest part; without one they stay
    small = (share > 0) & (share < _SMALL)
    padded = np.pad(share, 1)
    middle = (slice(1, -1),) * share.ndim
    shifts = [step * np.eye(share.ndim, dtype=int)[a] for a in range(share.ndim) for step in (-1, 1)]
    beside = np.stack([np.roll(padded, tuple(-shift), axis=tuple(range(share.ndim)))[middle] for shift in shifts])
    small &= beside.max(axis=0) >= _SMALL
    target = tuple((np.argwhere(small) + np.array(shifts)[beside.argmax(axis=0)[small]]).T)
    total, moment = np.where(small, 0, share), np.where(small[..., None], 0, share[..., None] * centroid)
    np.add.at(total, target, share[small])
    np.add.at(moment, target, share[small][:, None] * centroid[small])
    kept = total > 0
    return moment[kept] / total[kept][:, None], total[kept] * volume[kept.reshape(-1)]


def _particles(
    x: np.ndarray, volume: np.ndarray, density: Scalar, velocity: Velocity, dtype: Any, *, revolved: bool
) -> Particles:
    """Particles at x [m], (p, d), of volumes [m^d], (p,), alike in density; if `revolved`, rings of these sections."""
    if revolved:  # exact, x being the centroid (Pappus)
        require(x[:, 0] > 0, f"Bodies of revolution must lie at r > 0, got a particle at r = {x[:, 0].min():g} m.")
        volume = 2 * np.pi * x[:, 0] * volume
    x, volume, C = np.asarray(x, dtype), np.asarray(volume, dtype), None
    xp = jnp if is_traced((density, velocity)) else np  # each operation of JAX by itself is a program to compile
    if callable(velocity):
        v, C = eqx.filter_jit(jax.vmap(lambda y: (velocity(y), jax.jacfwd(velocity)(y))))(x)
        require(v.shape == x.shape, f"velocity must give {x.shape[1]} components, got {v.shape[1:]}.")
        v, C = v.astype(dtype), C.astype(dtype)
    else:
        v = xp.broadcast_to(xp.asarray(velocity, dtype), x.shape)
    return Particles(*jax.device_put((x, v, xp.asarray(density, dtype) * volume, volume)), C=C)
