"""The `[[fit.observation]]` tables of a scene file: what was measured. `docs/scene_files.md` is the schema in words."""

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.analysis import energy_of
from mpmjax.checks import require, require_positive
from mpmjax.discretisation import Grid
from mpmjax.fitting import (
    AbstractObservation,
    CentreOfMass,
    Columns,
    Curve,
    Density,
    Extent,
    Force,
    Markers,
    Series,
    StressStretch,
    Torque,
    Tracks,
    after,
    read_arrays,
)
from mpmjax.geometry import AbstractRegion
from mpmjax.io import arguments
from mpmjax.state import Particles, Scene


class Source(NamedTuple):
    """The run that an observation is of."""

    folder: Path
    """Where the scene file lies."""
    scene: Scene
    particles: Particles
    t1: float
    """End of the run [s]."""


class Trust(NamedTuple):
    """Noise, weight and name of an observation."""

    sigma: Scalar | None
    weight: Scalar
    robust: Scalar | None
    name: str | None

    def __call__(self, name: str) -> dict[str, Any]:
        """The arguments of an observation, which has this name if the file gives none."""
        return {**self._asdict(), "name": name if self.name is None else self.name}


_kinds: dict[str, Callable[..., Any]] = {}
_HEADER = "[[fit.observation]]"


def observation(table: dict[str, Any], source: Source, t1: float) -> tuple[AbstractObservation, AbstractObservation]:
    """An observation as it is fitted, until t1 [s], and with all that was measured.

    Raises:
        ValueError: a table that does not fit, or a data file that does not: one line that names the place.
    """
    kind = table.get("kind")
    there = isinstance(kind, str) and kind in _kinds
    require(there, f"{_HEADER} kind must be one of {', '.join(_kinds)}, got {kind!r}.")
    make = _kinds[str(kind)]
    keys = {k: v for k, v in table.items() if k != "kind"}
    made = make(source, **arguments(make, keys, f"{_HEADER} {kind}", without=["source"]))
    return made if isinstance(made, tuple) else (made.until(t1), made)


def _trust(
    *, sigma: Scalar | None = None, weight: Scalar = 1.0, robust: Scalar | None = None, name: str | None = None
) -> Trust:
    return Trust(sigma, weight, robust, name)


def _kind(name: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a function (source, trust, keys of its own) to make the observations of a kind."""

    def registered(make: Callable[..., Any]) -> Callable[..., Any]:
        special, common = (inspect.signature(function).parameters for function in (make, _trust))

        @wraps(make)
        def whole(source: Source, **keys: Any) -> Any:
            trust = _trust(**{key: keys.pop(key) for key in list(keys) if key in common})
            return make(source, trust, **keys)

        parameters = [p for key, p in special.items() if key != "trust"]
        whole.__signature__ = inspect.Signature([*parameters, *common.values()])  # pyright: ignore[reportAttributeAccessIssue]
        _kinds[name] = whole
        return whole

    return registered


@_kind("StressStretch")
def _stress_stretch(
    source: Source,
    trust: Trust,
    *,
    data: str,
    stretch: str,
    nominal_stress: str,
    unit: Scalar = 1.0,
    range: tuple[float, ...] = (0.0, 1e9),  # noqa: A002 (the key in the file)
    gauge: AbstractRegion,
    axis: int,
) -> tuple[Curve, Curve]:
    require(len(range) == 2 and range[0] < range[1], f"range must be two growing stretches, got {range}.")
    columns = _columns(source, data, unit, 1.0, stretch, nominal_stress)
    x, y = columns[stretch], columns.scaled(nominal_stress, float(unit))
    columns.require(x > 0, f"{stretch} must be positive, got {{{stretch}}}: lengths over first lengths.")
    inside = (x >= range[0]) & (x <= range[1])
    require(inside.sum() > 0, f"{_HEADER} range {range} holds none of the {len(x)} points.")
    of = StressStretch.of(gauge, source.particles, axis)
    names: dict[str, Any] = trust("nominal stress [Pa]") | {"x_name": "stretch"}
    return Curve(x[inside], y[inside], of, **names), Curve(x, y, of, **names)


@_kind("Extent")
def _extent(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    value: str,
    axis: int,
    side: Literal["upper", "lower"] = "upper",
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Series:
    d = source.particles.dim
    require(0 <= axis < d, f"{_HEADER} axis must be below {d}, got {axis}.")
    columns = _columns(source, data, unit, time_unit, time, value)
    x = columns.scaled(value, float(unit))
    _require_window(columns, source, {value: x}, [axis])
    return Series(columns.times(time, float(time_unit), source.t1), x, Extent(axis, side), **trust("extent"))


@_kind("CentreOfMass")
def _centre_of_mass(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    place: tuple[str, ...],
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Series:
    columns, x = _places(source, data, unit, time_unit, place, time)
    return Series(columns.times(time, float(time_unit), source.t1), x, CentreOfMass(), **trust("centre of mass"))


@_kind("Tracks")
def _tracks(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    marker: str,
    place: tuple[str, ...],
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Tracks:
    columns, x = _places(source, data, unit, time_unit, place, time, marker)
    t = columns.times(time, float(time_unit), source.t1, grow=False)
    times, frame = np.unique(t, return_inverse=True)
    numbers, which = np.unique(columns[marker], return_inverse=True)
    _, first, pair = np.unique(frame * len(numbers) + which, return_index=True, return_inverse=True)
    columns.require(first[pair] == np.arange(len(t)), f"marker {{{marker}}} is there twice at {time} {{{time}}}.")
    begins = np.isin(numbers, numbers[which[t == 0]])
    columns.require(
        begins[which],
        f"marker {{{marker}}} has no row at time 0, which would tell which point it is: add one, or leave it out.",
    )
    require(len(times) > 1, f"{columns.path} has no time after 0: there is nothing to fit.")
    positions = np.full((len(times), len(numbers), source.particles.dim), np.nan)
    positions[frame, which] = x
    for k in np.flatnonzero(t == 0):  # one by one, so that the line is known
        try:
            Markers.at(source.particles, x[k : k + 1])
        except ValueError as error:
            columns.require(np.arange(len(t)) != k, f"{error} Give unit if {' and '.join(place)} are not in metres.")
    return Tracks(times[1:], positions[1:], which=Markers.at(source.particles, positions[0]), **trust("tracks"))


@_kind("Force")
def _force(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    force: tuple[str, ...],
    collider: int = 0,
    boundary: int | None = None,
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Force:
    d = source.particles.dim
    t, values = _components(source, data, time, force, d, unit, time_unit)
    return Force(t, values, collider=collider, boundary=boundary, **trust("force [N]"))


@_kind("Torque")
def _torque(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    torque: tuple[str, ...],
    collider: int = 0,
    boundary: int | None = None,
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Torque:
    d = source.particles.dim
    require(d > 1, f"{_HEADER} Torque needs two or three dimensions.")
    t, values = _components(source, data, time, torque, d * (d - 1) // 2, unit, time_unit)
    return Torque(t, values, collider=collider, boundary=boundary, **trust("torque [N m]"))


@_kind("ForceDisplacement")
def _force_displacement(
    source: Source,
    trust: Trust,
    *,
    data: str,
    displacement: str,
    force: str,
    axis: int,
    collider: int = 0,
    boundary: int | None = None,
    unit: Scalar = 1.0,
    length_unit: Scalar = 1.0,
) -> Force:
    d, what, number = source.particles.dim, "collider", collider
    bodies = [b for b in source.scene.boundary if b.collider_count]
    if boundary is not None:
        what, number, bodies = "boundary", boundary, source.scene.boundary
    require(0 <= axis < d, f"{_HEADER} axis must be below {d}, got {axis}.")
    require(0 <= number < len(bodies), f"{_HEADER} {what} must be from 0 to {len(bodies) - 1}, got {number}.")
    motion: Any = getattr(bodies[number], "motion", None)
    require(motion is not None, f"{_HEADER} ForceDisplacement needs a {what} that moves, but {number} is at rest.")
    columns = _columns(source, data, unit, length_unit, displacement, force, sign=True)
    times, path = np.asarray(motion.times, float), np.asarray(motion.displacement, float)[:, axis]
    last = np.searchsorted(times, source.t1)
    times, path = np.append(times[:last], source.t1), np.append(path[:last], np.interp(source.t1, times, path))
    way = np.sign(path[-1] - path[0])
    grows = way * np.diff(path)
    moves = np.append(grows > 0, True) | np.append(False, grows > 0)
    require((grows >= 0).all() and way != 0, f"{_HEADER} the {what} must move one way along axis {axis}.")
    x = columns.scaled(displacement, float(length_unit), "length_unit")
    columns.require(
        (way * x >= way * path[0]) & (way * x <= way * path[-1] * (1 + 1e-9)),
        f"{displacement} {{{displacement}}} is not reached: the {what} moves from {path[0]:g} to {path[-1]:g} m.",
    )
    t = np.interp(way * x, way * path[moves], times[moves])
    columns.require(np.diff(t, prepend=-1) > 0, f"{displacement} {{{displacement}}} must go on: sort the rows.")
    values = np.full((len(t), d), np.nan)
    values[:, axis] = columns.scaled(force, float(unit))
    return Force(t, values, collider=collider, boundary=boundary, **trust("force [N]"))


@_kind("Energy")
def _energy(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    value: str,
    part: Literal["kinetic", "elastic", "potential", "total"] = "total",
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Series:
    require(part in ("kinetic", "elastic", "potential", "total"), f"{_HEADER} Energy has no part {part!r}.")
    columns = _columns(source, data, unit, time_unit, time, value)
    t, values = columns.times(time, float(time_unit), source.t1), columns.scaled(value, float(unit))
    return Series(t, values, _EnergyPart(part), **trust(f"{part} energy [J]"))


class _EnergyPart(eqx.Module):
    """A part of the energy [J]."""

    part: str = eqx.field(static=True)

    def __call__(self, scene: Scene, particles: Particles) -> Array:
        return getattr(energy_of(scene, particles), self.part)


@_kind("Density")
def _density(
    source: Source,
    trust: Trust,
    *,
    data: str,
    grid: Grid,
    time: str = "times",
    value: str = "density",
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Series:
    path = source.folder / data
    for key, factor in (("unit", unit), ("time_unit", time_unit)):
        require_positive(f"{_HEADER} {key}", factor)
    t, pictures = read_arrays(path, time, value)
    t, pictures = t * float(time_unit), pictures * float(unit)
    shape = tuple(int(n) for n in grid.shape)
    require(
        t.ndim == 1 and len(t) > 0 and pictures.shape == (len(t), *shape),
        f"{path}: {value} must have the shape {(len(t) if t.ndim == 1 else 'f', *shape)} of {time} and the grid's "
        f"nodes, got {pictures.shape} and {time} of shape {t.shape}.",
    )
    fine = np.isfinite(t)
    require(fine.all(), f"{path}: {time} must be finite, but picture {np.flatnonzero(~fine)[:1]} has none.")
    late = np.flatnonzero((t < 0) | after(t, source.t1))
    require(len(late) == 0, f"{path}: picture {late[:1]} is of a time outside of the run, from 0 to {source.t1:g} s.")
    back = np.flatnonzero(np.diff(t) <= 0) + 1
    require(len(back) == 0, f"{path}: picture {back[:1]} is not later than the one before: sort them by time.")
    return Series(t, pictures, Density(grid), **trust("density [kg/m^d]"))


@_kind("Cloud")
def _cloud(
    source: Source,
    trust: Trust,
    *,
    data: str,
    time: str,
    place: tuple[str, ...],
    grid: Grid,
    mass: Scalar | None = None,
    unit: Scalar = 1.0,
    time_unit: Scalar = 1.0,
) -> Series:
    columns, x = _places(source, data, unit, time_unit, place, time, grid=grid)
    t = columns.times(time, float(time_unit), source.t1, grow=False)
    columns.require(
        np.diff(t, prepend=-np.inf) >= 0, f"{time} {{{time}}} comes after a later one: sort the rows by time."
    )
    if mass is not None:
        require_positive(f"{_HEADER} mass [kg]", mass)
    total = float(source.particles.mass.sum() if mass is None else mass)
    picture, times = Density(grid), np.unique(t)
    return Series(times, np.stack([picture.of_points(x[t == now], total) for now in times]), picture, **trust("cloud"))


def _columns(source: Source, data: str, unit: Scalar, other_unit: Scalar, *names: str, sign: bool = False) -> Columns:
    """Columns of a CSV file, after a look at the units; with `sign` the first may be negative, to turn a direction."""
    require_positive(f"{_HEADER} unit", abs(unit) if sign else unit)
    require_positive(f"{_HEADER} time_unit or length_unit", other_unit)
    require(len(set(names)) == len(names), f"{_HEADER} names a column twice: {', '.join(names)}.")
    return Columns(source.folder / data, *names)


def _places(
    source: Source,
    data: str,
    unit: Scalar,
    time_unit: Scalar,
    place: tuple[str, ...],
    *others: str,
    grid: Grid | None = None,
) -> tuple[Columns, np.ndarray]:
    """The columns, and the places in them [m], shape (rows, d)."""
    d = source.particles.dim
    require(len(place) == d, f"{_HEADER} place must be {d} columns, got {place}.")
    require(grid is None or grid.dim == d, f"{_HEADER} grid must have {d} dimensions, got {grid and grid.dim}.")
    columns = _columns(source, data, unit, time_unit, *others, *place)
    x = {name: columns.scaled(name, float(unit)) for name in place}
    _require_window(columns, source, x, list(range(d)), grid)
    return columns, np.stack(list(x.values()), axis=1)


def _components(
    source: Source, data: str, time: str, names: tuple[str, ...], count: int, unit: Scalar, time_unit: Scalar
) -> tuple[np.ndarray, np.ndarray]:
    """Times, and components in columns, "" for one that was not measured."""
    require(len(names) == count and any(names), f'{_HEADER} needs {count} columns, "" for none, got {names}.')
    columns = _columns(source, data, unit, time_unit, time, *(name for name in names if name), sign=True)
    t = columns.times(time, float(time_unit), source.t1)
    blank = np.full(len(t), np.nan)
    return t, np.stack([columns.scaled(name, float(unit)) if name else blank for name in names], axis=1)


def _require_window(
    columns: Columns, source: Source, x: dict[str, np.ndarray], axes: list[int], grid: Grid | None = None
) -> None:
    """Check that places lie in the window of the scene's grid, if that stays in its place, or on a lattice.

    Raises:
        ValueError: one does not; its line is named.
    """
    window, what = (source.scene.grid, "the grid's window") if grid is None else (grid, "the picture's grid")
    if window.follow:
        return
    for axis, (name, values) in zip(axes, x.items(), strict=True):
        first, nodes = float(window.origin[axis]) * float(window.spacing), int(window.shape[axis])
        last = first + (nodes - 1) * float(window.spacing)
        columns.require(
            ((values >= first) & (values <= last)) | bool(np.asarray(window.periodic)[axis]),
            f"{name} {{{name}}} lies outside of {what}, from {first:g} to {last:g} m: give unit if it is not in "
            "metres.",
        )
