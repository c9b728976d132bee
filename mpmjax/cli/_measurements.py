"""The `[[fit.observation]]` tables of a scene file: what was measured. `docs/scene_files.md` is the schema in words."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import numpy as np

from mpmjax._types import Array, Scalar
from mpmjax.analysis import energy_of
from mpmjax.checks import Mark, finite, positive, require, require_positive, require_that
from mpmjax.cli._scene_file import Simulation, marked_arguments
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
    Shown,
    StressStretch,
    Torque,
    Tracks,
    after,
    read_arrays,
    stated_unit,
)
from mpmjax.geometry import AbstractRegion
from mpmjax.state import Particles, Scene

_POSITIVE = Mark("positive", lambda name, value: require_positive(f"scale = -1 turns a direction; {name}", value))
_NOT_ZERO = Mark("not zero", lambda name, value: require_that(f"{name} must not be zero", lambda a: a != 0, value))


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """The keys of a table that the kinds of observation share; each kind says which of them it is without."""

    simulation: Simulation
    folder: Path  # where the scene file lies
    data: str
    unit: Annotated[Scalar, _POSITIVE] = 1.0
    scale: Annotated[Scalar, finite, _NOT_ZERO] = 1.0  # beside the unit: -1 turns a direction, 2 is of half a model
    time: str
    time_unit: Annotated[Scalar, positive] = 1.0
    length_unit: Annotated[Scalar, positive] = 1.0
    sigma: Scalar | None = None
    weight: Scalar = 1.0
    robust: Scalar | None = None
    name: str | None = None

    @property
    def dim(self) -> int:
        """Number of dimensions of the run."""
        return self.simulation.particles.dim

    def named(self, name: str) -> dict[str, Any]:
        """Noise, weight and name of the observation, which has this name if the file gives none."""
        name = name if self.name is None else self.name
        return {"sigma": self.sigma, "weight": self.weight, "robust": self.robust, "name": name}

    def columns(self, *names: str) -> Columns:
        """Columns of the CSV file."""
        require(len(set(names)) == len(names), f"{_HEADER} names a column twice: {', '.join(names)}.")
        return Columns(self.folder / self.data, *names)

    def times(self, columns: Columns, *, grow: bool = True) -> np.ndarray:
        """The times of the rows [s], which must lie in the run and, with `grow`, grow from row to row."""
        name, unit, t1 = self.time, float(self.time_unit), self.simulation.t1
        times = columns.scaled(name, unit, "time_unit")
        read, advice = (f", with time_unit = {unit:g},", "") if unit != 1 else ("", ", or give time_unit")
        columns.require(times >= 0, f"{name} {{{name}}} lies before the run, which begins at 0: leave the row out.")
        beyond = f"after the end of the run, t1 = {t1:g} s: raise [run] t1, leave the row out{advice}."
        columns.require(~after(times, t1), f"{name} {{{name}}}{read} lies {beyond}")
        if grow:
            late = f"{name} {{{name}}} must be later than in the row before: sort the rows by time."
            columns.require(np.diff(times, prepend=-np.inf) > 0, late)
        return times

    def scaled(self, columns: Columns, name: str) -> np.ndarray:
        """A column in SI units, by its factor."""
        return columns.scaled(name, float(self.unit)) * float(self.scale)

    def places(self, place: tuple[str, ...], *others: str, grid: Grid | None = None) -> tuple[Columns, np.ndarray]:
        """The columns, and the places in them [m], shape (rows, d)."""
        d = self.dim
        require(len(place) == d, f"{_HEADER} place must be {d} columns, got {place}.")
        require(grid is None or grid.dim == d, f"{_HEADER} grid must have {d} dimensions, got {grid and grid.dim}.")
        columns = self.columns(*others, *place)
        x = {name: self.scaled(columns, name) for name in place}
        self.check_window(columns, x, list(range(d)), grid)
        return columns, np.stack(list(x.values()), axis=1)

    def components(self, names: tuple[str, ...], count: int) -> tuple[np.ndarray, np.ndarray]:
        """Times, and components in columns, "" for one that was not measured."""
        require(len(names) == count and any(names), f'{_HEADER} needs {count} columns, "" for none, got {names}.')
        columns = self.columns(self.time, *(name for name in names if name))
        t = self.times(columns)
        blank = np.full(len(t), np.nan)
        return t, np.stack([self.scaled(columns, name) if name else blank for name in names], axis=1)

    def check_window(
        self, columns: Columns, x: dict[str, np.ndarray], axes: list[int], grid: Grid | None = None
    ) -> None:
        """Check that places lie in the window of the scene's grid, if that stays in its place, or on a lattice."""
        window, what = grid or self.simulation.scene.grid, "the grid's window" if grid is None else "the picture's grid"
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


KINDS: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {}  # what makes a kind, and shared keys it is without
_HEADER = "[[fit.observation]]"


def observation(
    table: dict[str, Any], folder: Path, simulation: Simulation, t1: float
) -> tuple[AbstractObservation, AbstractObservation]:
    """An observation of a simulation as it is fitted, until t1 [s], and with all that was measured in a folder."""
    kind = table.get("kind")
    there = isinstance(kind, str) and kind in KINDS
    require(there, f"{_HEADER} kind must be one of {', '.join(KINDS)}, got {kind!r}.")
    keys, shared = keys_of(str(kind))
    values = marked_arguments(keys, {k: v for k, v in table.items() if k != "kind"}, f"{_HEADER} {kind}")
    chosen: dict[str, Any] = {"time": ""} | {name: values.pop(name) for name in shared if name in values}
    measurement = Measurement(simulation=simulation, folder=folder, **chosen)
    made = KINDS[str(kind)][0](measurement, **values)
    if isinstance(made, tuple):
        return _shown(made[0], measurement, values), _shown(made[1], measurement, values)
    made = _shown(made, measurement, values)
    part = made.part_until(t1)
    require(part is not None, f"{made.title} begins at {made.times[0]:g} s, after t1 = {t1:g} s.")
    return part, made


def keys_of(kind: str) -> tuple[Callable[..., None], list[str]]:
    """A function of all keys that the table of a kind takes, and those of them that kinds share."""
    make, without = KINDS[kind]
    (_, *special), common = (inspect.signature(of).parameters.values() for of in (make, Measurement))
    shared = [p for p in common if p.name not in ("simulation", "folder", *without)]

    def keys(**_: Any) -> None: ...

    keys.__signature__ = inspect.Signature([*special, *shared])  # pyright: ignore[reportFunctionMemberAccess]
    return keys, [p.name for p in shared]


_SI = {"place": "m", "force": "N", "torque": "N m", "nominal_stress": "Pa"}  # of columns that keys name


def _shown(made: Any, m: Measurement, keys: dict[str, Any]) -> Any:
    """An observation that pictures show as its file has it."""
    key = next((key for key in (*_SI, "value") if key in keys), None)
    if key is None or "grid" in keys:  # a picture
        return made
    heads = (keys[key],) if isinstance(keys[key], str) else keys[key]
    si = _SI.get(key, "m" if isinstance(getattr(made, "of", None), Extent) else "J")

    def named(head: str, factor: float, of: str) -> str:
        unit = of if factor == 1 else f"{factor:g} {of}"
        return head if stated_unit(head) is not None else f"{head} [{unit}]"

    measured = [head for head in heads if head]
    y = named(measured[0] if len(measured) == 1 else made.name.split(" [")[0], float(m.unit), si)
    path, x_unit = None, float(m.time_unit)
    if "displacement" in keys:
        x = named(keys["displacement"], float(m.length_unit), "m")
        rows = Columns(m.folder / m.data, keys["displacement"])[keys["displacement"]]
        path = np.stack([made.times, rows])
    else:
        x = keys["stretch"] if "stretch" in keys else named(m.time, x_unit, "s")
    columns = tuple(heads) if made.data.shape[1:] == (len(heads),) else ()
    return eqx.tree_at(lambda o: o.shown, made, Shown(x, y, columns, x_unit, float(m.unit) * float(m.scale), path))


def _kind(name: str, without: tuple[str, ...] = ("length_unit",)) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorate a function (measurement, keys of its own) to make the observations of a kind."""

    def registered(make: Callable[..., Any]) -> Callable[..., Any]:
        KINDS[name] = make, without
        return make

    return registered


@_kind("StressStretch", without=("time", "time_unit", "length_unit"))
def _stress_stretch(
    m: Measurement,
    *,
    stretch: str,
    nominal_stress: str,
    range: tuple[float, ...] = (0.0, 1e9),  # noqa: A002 (the key in the file)
    gauge: AbstractRegion,
    axis: int,
) -> tuple[Curve, Curve]:
    require(len(range) == 2 and range[0] < range[1], f"range must be two growing stretches, got {range}.")
    columns = m.columns(stretch, nominal_stress)
    x, y = columns[stretch], m.scaled(columns, nominal_stress)
    columns.require(x > 0, f"{stretch} must be positive, got {{{stretch}}}: lengths over first lengths.")
    inside = (x >= range[0]) & (x <= range[1])
    require(inside.sum() > 0, f"{_HEADER} range {range} holds none of the {len(x)} points.")
    of = StressStretch.of(gauge, m.simulation.particles, axis)
    names: dict[str, Any] = m.named("nominal stress [Pa]") | {"x_name": "stretch"}
    return Curve(x[inside], y[inside], of, **names), Curve(x, y, of, **names)


@_kind("Extent")
def _extent(m: Measurement, *, value: str, axis: int, side: Literal["upper", "lower"] = "upper") -> Series:
    require(0 <= axis < m.dim, f"{_HEADER} axis must be below {m.dim}, got {axis}.")
    columns = m.columns(m.time, value)
    x = m.scaled(columns, value)
    m.check_window(columns, {value: x}, [axis])
    return Series(m.times(columns), x, Extent(axis, side), **m.named("extent"))


@_kind("CentreOfMass")
def _centre_of_mass(m: Measurement, *, place: tuple[str, ...]) -> Series:
    columns, x = m.places(place, m.time)
    return Series(m.times(columns), x, CentreOfMass(), **m.named("centre of mass"))


@_kind("Tracks")
def _tracks(m: Measurement, *, marker: str, place: tuple[str, ...]) -> Tracks:
    columns, x = m.places(place, m.time, marker)
    t = m.times(columns, grow=False)
    times, frame = np.unique(t, return_inverse=True)
    numbers, which = np.unique(columns[marker], return_inverse=True)
    _, first, pair = np.unique(frame * len(numbers) + which, return_index=True, return_inverse=True)
    columns.require(first[pair] == np.arange(len(t)), f"marker {{{marker}}} is there twice at {m.time} {{{m.time}}}.")
    begins = np.isin(numbers, numbers[which[t == 0]])
    columns.require(
        begins[which],
        f"marker {{{marker}}} has no row at time 0, which would tell which point it is: add one, or leave it out.",
    )
    require(len(times) > 1, f"{columns.path} has no time after 0: there is nothing to fit.")
    positions = np.full((len(times), len(numbers), m.dim), np.nan)
    positions[frame, which] = x
    for k in np.flatnonzero(t == 0):  # one by one, so that the line is known
        try:
            Markers.at(m.simulation.particles, x[k : k + 1])
        except ValueError as error:
            columns.require(np.arange(len(t)) != k, f"{error} Give unit if {' and '.join(place)} are not in metres.")
    return Tracks(times[1:], positions[1:], which=Markers.at(m.simulation.particles, positions[0]), **m.named("tracks"))


@_kind("Force")
def _force(m: Measurement, *, force: tuple[str, ...], collider: int = 0, boundary: int | None = None) -> Force:
    return Force(*m.components(force, m.dim), collider=collider, boundary=boundary, **m.named("force [N]"))


@_kind("Torque")
def _torque(m: Measurement, *, torque: tuple[str, ...], collider: int = 0, boundary: int | None = None) -> Torque:
    require(m.dim > 1, f"{_HEADER} Torque needs two or three dimensions.")
    series = m.components(torque, m.dim * (m.dim - 1) // 2)
    return Torque(*series, collider=collider, boundary=boundary, **m.named("torque [N m]"))


@_kind("ForceDisplacement", without=("time", "time_unit"))
def _force_displacement(
    m: Measurement,
    *,
    displacement: str,
    length_scale: Scalar = 1.0,
    force: str,
    axis: int,
    collider: int = 0,
    boundary: int | None = None,
) -> Force:
    what, number, bodies = "collider", collider, [b for b in m.simulation.scene.boundary if b.is_collider]
    if boundary is not None:
        what, number, bodies = "boundary", boundary, m.simulation.scene.boundary
    require(0 <= axis < m.dim, f"{_HEADER} axis must be below {m.dim}, got {axis}.")
    require(0 <= number < len(bodies), f"{_HEADER} {what} must be from 0 to {len(bodies) - 1}, got {number}.")
    motion: Any = getattr(bodies[number], "motion", None)
    require(motion is not None, f"{_HEADER} ForceDisplacement needs a {what} that moves, but {number} is at rest.")
    columns = m.columns(displacement, force)
    times, path = np.asarray(motion.times, float), np.asarray(motion.displacement, float)[:, axis]
    last, t1 = np.searchsorted(times, m.simulation.t1), m.simulation.t1
    times, path = np.append(times[:last], t1), np.append(path[:last], np.interp(t1, times, path))
    way = np.sign(path[-1] - path[0])
    grows = way * np.diff(path)
    moves = np.append(grows > 0, True) | np.append(False, grows > 0)
    require((grows >= 0).all() and way != 0, f"{_HEADER} the {what} must move one way along axis {axis}.")
    x = columns.scaled(displacement, float(m.length_unit), "length_unit") * float(length_scale)
    columns.require(
        (way * x >= way * path[0]) & (way * x <= way * path[-1] * (1 + 1e-9)),
        f"{displacement} {{{displacement}}} is not reached: the {what} moves from {path[0]:g} to {path[-1]:g} m.",
    )
    t = np.interp(way * x, way * path[moves], times[moves])
    columns.require(np.diff(t, prepend=-1) > 0, f"{displacement} {{{displacement}}} must go on: sort the rows.")
    values = np.full((len(t), m.dim), np.nan)
    values[:, axis] = m.scaled(columns, force)
    return Force(t, values, collider=collider, boundary=boundary, **m.named("force [N]"))


@_kind("Energy")
def _energy(
    m: Measurement, *, value: str, part: Literal["kinetic", "elastic", "potential", "total"] = "total"
) -> Series:
    columns = m.columns(m.time, value)
    return Series(m.times(columns), m.scaled(columns, value), _EnergyPart(part), **m.named(f"{part} energy [J]"))


class _EnergyPart(eqx.Module):
    """A part of the energy [J]."""

    part: str = eqx.field(static=True)

    def __call__(self, scene: Scene, particles: Particles) -> Array:
        return getattr(energy_of(scene, particles), self.part)


@_kind("Density", without=("time", "length_unit"))
def _density(m: Measurement, *, grid: Grid, time: str = "times", value: str = "density") -> Series:
    path = m.folder / m.data
    t, pictures = read_arrays(path, time, value)
    t, pictures = t * float(m.time_unit), pictures * float(m.unit) * float(m.scale)
    shape = tuple(int(n) for n in grid.shape)
    require(
        t.ndim == 1 and len(t) > 0 and pictures.shape == (len(t), *shape),
        f"{path}: {value} must have the shape {(len(t) if t.ndim == 1 else 'f', *shape)} of {time} and the grid's "
        f"nodes, got {pictures.shape} and {time} of shape {t.shape}.",
    )
    fine = np.isfinite(t)
    require(fine.all(), f"{path}: {time} must be finite, but picture {np.flatnonzero(~fine)[:1]} has none.")
    t1 = m.simulation.t1
    late = np.flatnonzero((t < 0) | after(t, t1))
    require(len(late) == 0, f"{path}: picture {late[:1]} is of a time outside of the run, from 0 to {t1:g} s.")
    back = np.flatnonzero(np.diff(t) <= 0) + 1
    require(len(back) == 0, f"{path}: picture {back[:1]} is not later than the one before: sort them by time.")
    return Series(t, pictures, Density(grid), **m.named("density [kg/m^d]"))


@_kind("Cloud")
def _cloud(
    m: Measurement, *, place: tuple[str, ...], grid: Grid, mass: Annotated[Scalar, positive, "kg"] | None = None
) -> Series:
    columns, x = m.places(place, m.time, grid=grid)
    t = m.times(columns, grow=False)
    columns.require(
        np.diff(t, prepend=-np.inf) >= 0, f"{m.time} {{{m.time}}} comes after a later one: sort the rows by time."
    )
    total = float(m.simulation.particles.mass.sum() if mass is None else mass)
    picture, times = Density(grid), np.unique(t)
    pictures = np.stack([picture.of_points(x[t == now], total) for now in times])
    return Series(times, pictures, picture, **m.named("cloud"))
