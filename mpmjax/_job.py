"""Scene files: TOML in, a scene with its particles and run settings out. `docs/scene_files.md` is the schema in
words."""

import csv
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._checks import require, require_positive
from mpmjax._fit import FitResult, fit_curve, gauge
from mpmjax._method import Explicit, Method
from mpmjax._particles import Particles
from mpmjax._region import AbstractRegion
from mpmjax._sample import fill
from mpmjax._scene import Scene, prepare
from mpmjax._schema import arguments, decode
from mpmjax._simulate import number_of_steps
from mpmjax._types import Scalar


class RunSettings(NamedTuple):
    """The `[run]` table."""

    t1: float
    dt: float
    method: Method
    save_every: int
    dtype: str


class CurveSettings(NamedTuple):
    """The `[fit]` table of kind "curve", its data read."""

    stretch: np.ndarray
    stress: np.ndarray
    fitted: np.ndarray
    parameter: str
    report: str | None
    axis: int
    gauge: AbstractRegion


class Job(NamedTuple):
    """Everything that a scene file says."""

    scene: Scene
    particles: Particles
    run: RunSettings
    fit: CurveSettings | None


def read_job(path: Path) -> Job:
    """Read a scene file.

    Raises:
        ValueError: no such file, no TOML, a key that is unknown, missing or unfit, particles outside of the window: one
            line that names the place.
    """
    table = _toml(path)
    for name in ("particles", "run"):
        require(name in table, f"{path}: needs the table [{name}]. See docs/scene_files.md.")
    fit_table = table.pop("fit", None)
    groups, run_table = table.pop("particles"), table.pop("run")
    try:
        run = _run_settings(**arguments(_run_settings, run_table, "[run]"))
        scene = decode(table, Scene)
        groups = groups if isinstance(groups, list) else [groups]
        filled = [_fill(scene, group, i, run.dtype) for i, group in enumerate(groups, 1)]
        fit = None if fit_table is None else _curve_settings(fit_table, path.parent)
        particles = prepare(scene, _joined(filled))
        number_of_steps(run.t1, run.dt, 0, particles.x.dtype)
        if fit is not None:
            gauge(fit.gauge, particles, fit.axis)
            _check_paths(fit, scene)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Job(scene, particles, run, fit)


def fit_job(job: Job) -> FitResult:
    """Carry out the fit that a scene file asks for.

    Raises:
        ValueError: it asks for none, or see `fit_curve`.
    """
    fit, run = job.fit, job.run
    if fit is None:
        raise ValueError("The scene file has no [fit] table, so there is nothing to fit. See docs/scene_files.md.")
    report = fit.report
    return fit_curve(
        job.scene,
        job.particles,
        t1=run.t1,
        dt=run.dt,
        method=run.method,
        curve=gauge(fit.gauge, job.particles, fit.axis),
        measured_x=fit.stretch,
        measured_y=fit.stress,
        fitted=fit.fitted,
        parameter=lambda scene: leaf_of(fit.parameter, scene),
        report=None if report is None else lambda scene: leaf_of(report, scene),
    )


def leaf_of(path: str, scene: Scene) -> Any:
    """The value at a dotted path such as "material.youngs_modulus" or "boundary.0.friction"."""
    value: Any = scene
    for name in path.split("."):
        try:
            value = value[int(name)] if name.isdecimal() else getattr(value, name)
        except (AttributeError, IndexError, TypeError):
            raise ValueError(f"[fit] names {path!r}, but the scene has no {name!r} there.") from None
    return value


def _check_paths(fit: CurveSettings, scene: Scene) -> None:
    """The fitted parameter must be a positive number of the scene's own, and what is reported a number."""
    value, (owner, _, name) = leaf_of(fit.parameter, scene), fit.parameter.rpartition(".")
    parent = leaf_of(owner, scene) if owner else scene
    known = [f.name for f in fields(parent)] if is_dataclass(parent) else []
    require(
        not known or name in known,
        f"[fit] parameter {fit.parameter!r} follows from others and cannot be fitted; name one of {', '.join(known)}.",
    )
    require(
        not isinstance(value, eqx.Module) and np.ndim(value) == 0 and np.all(np.asarray(value) > 0),
        f"[fit] parameter {fit.parameter!r} must be one positive number, but is {value}.",
    )
    if fit.report is not None:
        reported = leaf_of(fit.report, scene)
        require(
            not isinstance(reported, eqx.Module) and np.ndim(reported) == 0,
            f"[fit] report {fit.report!r} must be one number, but is {reported}.",
        )


def read_columns(path: Path, *names: str) -> list[np.ndarray]:
    """Columns of a CSV file with a header; lines that start with # are comments.

    Raises:
        ValueError: no such file or column, or an entry that is no number.
    """
    try:
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"Cannot read the data file {path}: {_reason(error)}.") from None
    reader = csv.DictReader(lines)
    known = reader.fieldnames or []
    for name in names:
        require(name in known, f"{path} has no column {name!r}, it has {', '.join(known)}.")
    columns: list[list[float]] = [[] for _ in names]
    for row, record in enumerate(reader, 1):
        for column, name in zip(columns, names, strict=True):
            try:
                column.append(float(record[name]))
            except (TypeError, ValueError):
                raise ValueError(f"{path}, data row {row}: {name} must be a number, got {record[name]!r}.") from None
    return [np.asarray(column) for column in columns]


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"Cannot read the scene file {path}: {_reason(error)}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a TOML file: {error}.") from None


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).lower()


def _run_settings(
    *,
    t1: Scalar,
    dt: Scalar,
    method: Method = Explicit(),
    save_every: int = 1,
    precision: str = "float64",
) -> RunSettings:
    require_positive("[run] t1", t1)
    require_positive("[run] dt", dt)
    require(save_every >= 1, f"[run] save_every must be at least 1, got {save_every}.")
    require(precision in ("float32", "float64"), f'[run] precision must be "float32" or "float64", got {precision!r}.')
    return RunSettings(float(t1), float(dt), method, save_every, precision)


def _fill(scene: Scene, table: Any, number: int, dtype: str) -> Particles:
    where = f"[[particles]] {number}"
    given = arguments(fill, table, where, given=("grid", "dtype"))
    try:
        return fill(grid=scene.grid, dtype=dtype, **given)
    except ValueError as error:
        raise ValueError(f"{where}: {error}") from None


def _joined(groups: list[Particles]) -> Particles:
    return jax.tree.map(lambda *a: jnp.concatenate(a), *groups)


def _curve_settings(table: Any, folder: Path) -> CurveSettings:
    def curve(
        *,
        kind: str,
        data: str,
        stretch: str,
        nominal_stress: str,
        unit: Scalar = 1.0,
        range: tuple[float, ...],  # noqa: A002 (the key in the file)
        parameter: str,
        report: str | None = None,
        gauge: AbstractRegion,
        axis: int,
    ) -> CurveSettings:
        require(kind == "curve", f'[fit] kind must be "curve", got {kind!r}.')
        require(len(range) == 2 and range[0] < range[1], f"[fit] range must be two growing stretches, got {range}.")
        require_positive("[fit] unit [Pa]", unit)
        x, y = read_columns(folder / data, stretch, nominal_stress)
        fitted = (x >= range[0]) & (x <= range[1])
        require(fitted.sum() >= 2, f"[fit] range {range} holds {int(fitted.sum())} of {len(x)} points; two are needed.")
        return CurveSettings(x, y * float(unit), fitted, parameter, report, axis, gauge)

    return curve(**arguments(curve, table, "[fit]"))
