"""The `[fit]` table of a scene file: what is fitted, and what was measured. `docs/scene_files.md` is the schema in
words."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import equinox as eqx
import numpy as np

from mpmjax._types import Scalar
from mpmjax.checks import require, require_positive, shortened
from mpmjax.cli._scene_file import Simulation, read_simulation
from mpmjax.fitting import (
    AbstractObservation,
    AbstractParameter,
    Bounded,
    CentreOfMass,
    Curve,
    Experiment,
    Extent,
    Gaussian,
    Markers,
    Positive,
    Series,
    StressStretch,
    Tracks,
    Unbounded,
    read_columns,
)
from mpmjax.geometry import AbstractRegion
from mpmjax.io import arguments
from mpmjax.state import Particles


class FitFile(NamedTuple):
    """What a `[fit]` table asks for."""

    experiments: tuple[Experiment, ...]
    parameters: dict[str, AbstractParameter]
    report: dict[str, Callable[[Experiment], Any]]
    level: float
    whole: tuple[Experiment, ...]
    """The experiments over the whole of their runs, with all that was measured: also what is not fitted."""


def read_fit(path: Path, read: Callable[[Path], Simulation] = read_simulation) -> FitFile:
    """Read a scene file with its `[fit]` table, and the scene files of other experiments that it names.

    Args:
        path: the file.
        read: reads each scene file.

    Raises:
        ValueError: as `read_simulation`; no `[fit]` table, or one that does not fit: one line that names the place.
    """
    simulation = read(path)
    table = _fit_table(path, simulation)
    sources = [(path, simulation, table)] if "observation" in table else []
    try:
        _require_keys(table, "[fit]", _KEYS)
        for other in _tables(table, "experiment"):
            _require_keys(other, "[[fit.experiment]]", {"scene"})
            file = path.parent / _text(other, "scene", "[[fit.experiment]]")
            own = read(file)
            sources.append((file, own, _fit_table(file, own)))
            _require_keys(sources[-1][2], f"[fit] of {file}", _KEYS)
        require(len(sources) > 0, "[fit] needs an [[fit.observation]], or an [[fit.experiment]] whose scene has one.")
        parts = [_experiments(*source) for source in sources]
        tables = _tables(table, "parameter")
        require(len(tables) > 0, "[fit] needs a [[fit.parameter]].")
        named = [_parameter(t, parts[0][0]) for t in tables]
        names = [name for name, _ in named]
        require(len(set(names)) == len(names), f"[[fit.parameter]] {', '.join(names)}: each needs a name of its own.")
        report = table.get("report", {})
        require(isinstance(report, dict), "[fit.report] must be a table of names and paths.")
        for name, where in report.items():
            value = leaf_of(_path(where, "[fit.report]"), parts[0][0])
            one = not isinstance(value, eqx.Module) and np.ndim(value) == 0
            require(one, f"[fit.report] {name} = {where!r} must be one number, but is {value}.")
        level = table.get("level", 0.95)
        require(isinstance(level, float) and 0 < level < 1, f"[fit] level must lie between 0 and 1, got {level!r}.")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    found = {name: _getter(where) for name, where in report.items()}
    fitted, whole = zip(*parts, strict=True)
    return FitFile(fitted, dict(named), found, level, whole)


_KEYS = {"parameter", "observation", "experiment", "report", "level", "t1"}


def _require_keys(table: dict[str, Any], where: str, known: set[str]) -> None:
    unknown = sorted(set(table) - known)
    require(not unknown, f"{where} has the unknown key {unknown[:1]}; known are {', '.join(sorted(known))}.")


def leaf_of(path: str, experiment: Experiment) -> Any:
    """The value at a dotted path, such as "scene.material.youngs_modulus" or "scene.boundary.0.friction".

    Raises:
        ValueError: there is none.
    """
    value: Any = experiment
    for name in path.split("."):
        try:
            value = value[int(name)] if name.isdecimal() else getattr(value, name)
        except (AttributeError, IndexError, TypeError):
            raise ValueError(f"[fit] names {path!r}, but there is no {name!r} there.") from None
    return value


def _getter(path: str) -> Callable[[Experiment], Any]:
    return lambda experiment: leaf_of(path, experiment)


def _path(path: Any, where: str) -> str:
    first = path.split(".")[0] if isinstance(path, str) else ""
    require(
        first in ("scene", "particles", "method"),
        f"{where} must name a number by a dotted path that begins with scene, particles or method, such as "
        f'"scene.material.youngs_modulus", got {shortened(repr(path))}.',
    )
    return path


def _fit_table(path: Path, simulation: Simulation) -> dict[str, Any]:
    require(
        simulation.fit is not None,
        f"{path} has no [fit] table, so there is nothing to fit. See docs/scene_files.md.",
    )
    return simulation.fit or {}


def _tables(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    found = table.get(name, [])
    tables = isinstance(found, list) and all(isinstance(t, dict) for t in found)
    require(tables, f"[[fit.{name}]] must be tables with double brackets.")
    return found


def _text(table: dict[str, Any], key: str, where: str) -> str:
    text = table.get(key)
    require(isinstance(text, str), f"{where} needs the key {key!r}, a string.")
    return text or ""


def _parameter(table: dict[str, Any], experiment: Experiment) -> tuple[str, AbstractParameter]:
    def parameter(
        *,
        path: str,
        name: str | None = None,
        kind: Literal["Positive", "Bounded", "Unbounded"] = "Positive",
        lower: Scalar | None = None,
        upper: Scalar | None = None,
        start: Scalar | None = None,
        mean: Scalar | None = None,
        sigma: Scalar | None = None,
        unit: str = "",
    ) -> tuple[str, AbstractParameter]:
        where = f"[[fit.parameter]] {path!r}"
        value, (owner, _, last) = leaf_of(_path(path, where), experiment), path.rpartition(".")
        parent = leaf_of(owner, experiment)
        known = [f.name for f in fields(parent)] if is_dataclass(parent) else []
        require(
            not known or last in known,
            f"{where} follows from others and cannot be fitted; name one of {', '.join(known)}.",
        )
        number = eqx.is_array_like(value) and np.issubdtype(np.asarray(value).dtype, np.floating)
        require(number, f"{where} must be a number, but is {shortened(repr(value))}.")
        require((mean is None) == (sigma is None), f"{where} takes mean and sigma of a prior together.")
        require(
            (kind == "Bounded") == (lower is not None or upper is not None),
            f'{where}: lower and upper go with kind = "Bounded".',
        )
        prior = None if mean is None or sigma is None else Gaussian(mean, sigma)
        common: dict[str, Any] = {"where": _getter(path), "start": start, "prior": prior, "unit": unit}
        if kind == "Bounded":
            require(lower is not None and upper is not None, f"{where} needs lower and upper.")
            return name or last, Bounded(lower=float(lower or 0.0), upper=float(upper or 0.0), **common)
        return name or last, (Positive if kind == "Positive" else Unbounded)(**common)

    return parameter(**arguments(parameter, table, "[[fit.parameter]]"))


def _experiments(path: Path, simulation: Simulation, table: dict[str, Any]) -> tuple[Experiment, Experiment]:
    """The experiment that is fitted, which ends at [fit] t1, and the one of all that was measured."""
    t1 = table.get("t1", simulation.t1)
    require_positive("[fit] t1", t1)
    require(t1 <= simulation.t1, f"[fit] t1 must not lie after that of [run], got {t1} and {simulation.t1}.")
    tables = _tables(table, "observation")
    require(len(tables) > 0, f"{path} needs an [[fit.observation]].")
    pairs = [_observation(t, path.parent, simulation.particles, t1) for t in tables]
    fitted, whole = zip(*pairs, strict=True)

    def experiment(observations: tuple[AbstractObservation, ...], t1: float) -> Experiment:
        return Experiment(
            simulation.scene,
            simulation.particles,
            t1=t1,
            dt=simulation.dt,
            method=simulation.method,
            observations=observations,
            name=path.stem,
        )

    return experiment(fitted, t1), experiment(whole, simulation.t1)


def _observation(
    table: dict[str, Any], folder: Path, particles: Particles, t1: float
) -> tuple[AbstractObservation, AbstractObservation]:
    """An observation as it is fitted, until t1 [s], and with all that was measured."""
    kind = _text(table, "kind", "[[fit.observation]]")
    kinds = {"StressStretch": _stress_stretch, "Extent": _extent, "CentreOfMass": _centre_of_mass, "Tracks": _tracks}
    require(kind in kinds, f"[[fit.observation]] kind must be one of {', '.join(kinds)}, got {kind!r}.")
    make = kinds[kind](folder, particles)
    given = {key: value for key, value in table.items() if key != "kind"}
    found = make(**arguments(make, given, f"[[fit.observation]] {kind}"))
    return found if isinstance(found, tuple) else (found.until(t1), found)


def _stress_stretch(folder: Path, particles: Particles) -> Callable[..., Any]:
    def observation(
        *,
        data: str,
        stretch: str,
        nominal_stress: str,
        unit: Scalar = 1.0,
        range: tuple[float, ...] = (0.0, 1e9),  # noqa: A002 (the key in the file)
        gauge: AbstractRegion,
        axis: int,
        sigma: Scalar | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "nominal stress [Pa]",
    ) -> tuple[Curve, Curve]:
        require(len(range) == 2 and range[0] < range[1], f"range must be two growing stretches, got {range}.")
        require_positive("unit [Pa]", unit)
        x, y = read_columns(folder / data, stretch, nominal_stress)
        y = y * float(unit)
        inside = (x >= range[0]) & (x <= range[1])
        require(inside.sum() > 0, f"[[fit.observation]] range {range} holds none of the {len(x)} points.")
        of = StressStretch.of(gauge, particles, axis)
        noise: dict[str, Any] = {"sigma": sigma, "weight": weight, "robust": robust, "name": name, "x_name": "stretch"}
        return Curve(x[inside], y[inside], of, **noise), Curve(x, y, of, **noise)

    return observation


def _extent(folder: Path, particles: Particles) -> Callable[..., Any]:
    def observation(
        *,
        data: str,
        time: str,
        value: str,
        axis: int,
        side: Literal["upper", "lower"] = "upper",
        unit: Scalar = 1.0,
        sigma: Scalar | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "extent",
    ) -> Series:
        require(0 <= axis < particles.dim, f"[[fit.observation]] axis must be below {particles.dim}, got {axis}.")
        t, x = read_columns(folder / data, time, value)
        return Series(t, x * float(unit), Extent(axis, side), sigma=sigma, weight=weight, robust=robust, name=name)

    return observation


def _centre_of_mass(folder: Path, particles: Particles) -> Callable[..., Any]:
    def observation(
        *,
        data: str,
        time: str,
        place: tuple[str, ...],
        unit: Scalar = 1.0,
        sigma: Scalar | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "centre of mass",
    ) -> Series:
        require(len(place) == particles.dim, f"[[fit.observation]] place must be {particles.dim} columns, got {place}.")
        t, *x = read_columns(folder / data, time, *place)
        places = np.stack(x, axis=1) * float(unit)
        return Series(t, places, CentreOfMass(), sigma=sigma, weight=weight, robust=robust, name=name)

    return observation


def _tracks(folder: Path, particles: Particles) -> Callable[..., Any]:
    def observation(
        *,
        data: str,
        time: str,
        marker: str,
        place: tuple[str, ...],
        unit: Scalar = 1.0,
        sigma: Scalar | None = None,
        weight: Scalar = 1.0,
        robust: Scalar | None = None,
        name: str = "tracks",
    ) -> Tracks:
        require(len(place) == particles.dim, f"[[fit.observation]] place must be {particles.dim} columns, got {place}.")
        t, number, *x = read_columns(folder / data, time, marker, *place)
        times, frame = np.unique(t, return_inverse=True)
        numbers, which = np.unique(number, return_inverse=True)
        positions = np.full((len(times), len(numbers), particles.dim), np.nan)
        require(
            len(set(zip(frame.tolist(), which.tolist(), strict=True))) == len(t),
            f"{folder / data} has a marker twice at one time.",
        )
        positions[frame, which] = np.stack(x, axis=1) * float(unit)
        known = bool(times[0] == 0 and np.isfinite(positions[0]).all())
        require(
            known, f"{folder / data} must have the places of all markers at time 0, where they tell which they are."
        )
        require(len(times) > 1, f"{folder / data} has no time after 0: there is nothing to fit.")
        markers = Markers.at(particles, positions[0])
        return Tracks(times[1:], positions[1:], which=markers, sigma=sigma, weight=weight, robust=robust, name=name)

    return observation
