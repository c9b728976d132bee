"""Scene files (docs/scene_files.md): TOML in, a scene with its particles and run settings out."""

import itertools
import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._tables import scene_table
from mpmjax._types import Scalar
from mpmjax.analysis import METHODS, Build, Trial, work_precision
from mpmjax.checks import canonical, checked, marks_of, positive, require, require_marks, shortened, warn, whole
from mpmjax.geometry import AbstractRegion
from mpmjax.io import are_registered, arguments, check_fields, decode, load, parameters_of, save
from mpmjax.simulation import number_of_steps
from mpmjax.state import Particles, Scene, attach, fill, join, prepare
from mpmjax.stepping import AbstractIntegrator, Explicit, stable_dt

_FRAMES = 50  # number of frames that are saved if neither it nor the step is given


class RunSettings(eqx.Module):
    """The `[run]` table of a scene file."""

    t1: Annotated[float, positive, "s"] = eqx.field(converter=float)  # end time
    dt: Annotated[Scalar, positive, "s"] | Literal["stable", "auto"] | None = None  # step; None for "auto"
    method: AbstractIntegrator | None = None  # None for "auto"
    save_every: Annotated[int, whole(1)] | None = None  # steps from frame to frame; None if the file does not say
    precision: Literal["float32", "float64"] | None = None  # None for JAX's own, in the shell float64
    error: Annotated[float, positive] = eqx.field(converter=float, default=1e-2)  # relative one that "auto" aims at
    most_seconds: Annotated[float, positive] = eqx.field(converter=float, default=60.0)  # that its pilot runs may take

    def __check_init__(self):
        double = jnp.result_type(float) == jnp.float64 or self.precision != "float64"
        require(double, '[run] precision = "float64" needs jax.config.update("jax_enable_x64", True) first.')


@dataclass(frozen=True)
class SceneFile:
    """A scene file as it was read: "auto" and "stable" are left to be resolved."""

    scene: Scene
    particles: Particles
    run: RunSettings
    output: dict[str, Any]  # the `[output]` table, as arguments of `record` and `save`
    fit: dict[str, Any] | None  # the `[fit]` table, not read yet; None without one
    build: Build  # makes the scene and its particles on n times as many cells a direction, from n


@dataclass(frozen=True)
class Simulation(SceneFile):
    """A scene file with its step and method resolved, ready to be run."""

    t1: float
    dt: float
    method: AbstractIntegrator
    save_every: int
    choice: str | None  # the choice for "auto" or "stable", and why; None if there was none

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments of `simulate` and `record` beside scene and particles."""
        return {"t1": self.t1, "dt": self.dt, "method": self.method, "save_every": self.save_every}


@checked
def load_scene(path: str | os.PathLike) -> tuple[Scene, Particles, dict[str, Any]]:
    """The scene of a TOML file (docs/scene_files.md), its particles, and its `[run]` as arguments of `simulate` and
    `record`:

        scene, particles, settings = mpm.load_scene("examples/jelly.toml")
        run = mpm.simulate(scene, particles, **settings)

    Numbers are of the file's precision; if it names none, of JAX's, float32 unless 64-bit mode is on. The shell turns
    that on. "stable" and "auto" are resolved as there, the latter by pilot runs.

    Raises:
        ValueError: a file that is missing or not TOML; an unknown, missing or unfit key: one line with its place.
    """
    simulation = read_simulation(Path(path))
    return simulation.scene, simulation.particles, simulation.settings


def read_scene_file(path: Path, changes: Sequence[str] = ()) -> SceneFile:
    """Read a scene file after changes to it (see `scene_table`); a ValueError says in one line what is wrong where."""
    table = scene_table(path, changes, more=are_registered())
    fit_table = table.pop("fit", None)
    require(fit_table is None or isinstance(fit_table, dict), f"{path}: [fit] must be a table.")
    _find_files(table, path.parent)
    groups, run_table, output_table = table.pop("particles"), table.pop("run"), table.pop("output", {})
    groups = groups if isinstance(groups, list) else [groups]
    try:
        require(isinstance(run_table, dict), f"[run] must be a table, got {shortened(repr(run_table))}.")
        auto = {name for name in ("dt", "method") if run_table.get(name) == "auto"}
        require("dt" in run_table, '[run] needs the key \'dt\': a step in seconds, "stable" or "auto".')
        both = '[run] method = "auto" goes with dt = "auto": the cheapest of both is chosen together.'
        require(auto != {"method"}, both)
        settings: dict[str, Any] = {} if "method" in auto else {"method": Explicit()}
        settings |= marked_arguments(RunSettings, {k: v for k, v in run_table.items() if k not in auto}, "[run]")
        run = RunSettings(**settings)
        output = arguments(save, output_table, "[output]", without=("path", "run"))
        check_fields(output.get("fields", ()), "[output] fields")

        def build(n: int) -> tuple[Scene, Particles]:
            scene = decode(_refined(table, n), Scene)
            if any(isinstance(group, dict) and "file" in group for group in groups):
                require(len(groups) == 1, "[particles] file has all particles of a scene: make it the only table.")
                require(n == 1, "[particles] file: particles from a file cannot be refined, give them a region.")
                particles = particles_in(**arguments(particles_in, groups[0], "[particles]"))
                particles, overlap = canonical(particles, run.precision or particles.x.dtype), False
            else:
                particles, overlap = _filled(scene, groups, run.precision)
            scene = attach(scene, particles)
            if not overlap:
                return scene, prepare(scene, particles)
            with warnings.catch_warnings():  # of the overlap `_filled` has told, with the numbers of the tables
                warnings.filterwarnings("ignore", "Near .* particles take")
                return scene, prepare(scene, particles)

        scene, particles = build(1)
        if run.dt is not None and not isinstance(run.dt, str):
            number_of_steps(run.t1, float(run.dt), 0, particles.x.dtype)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: tables are nested too deeply to be read.") from None
    return SceneFile(scene, particles, run, output, fit_table, build)


def read_simulation(
    path: Path,
    changes: Sequence[str] = (),
    *,
    most_seconds: float | None = None,
    progress: Callable[[Trial], None] = lambda trial: None,
    say: Callable[[str], None] = lambda line: None,
) -> Simulation:
    """Read a scene file (see `read_scene_file`), its "stable" step and what "auto" leaves to pilot runs, within
    `most_seconds` or what the file says. `progress` and `say` are those of `work_precision`."""
    file = read_scene_file(path, changes)
    run, choice = file.run, None
    t1, dt, method, save_every = run.t1, step_of(path, file), run.method, run.save_every
    piloted = most_seconds is None or dt is None or method is None
    require(piloted, "--most-seconds is for pilot runs, and there are none: the file gives dt and method.")
    if dt is not None and run.dt == "stable":
        steps = round(t1 / dt)
        choice = f"dt = {dt:.6g} s ({steps} steps), the longest that is stable as the particles start"
        save_every = save_every or max(1, steps // _FRAMES)
    if dt is None or method is None:
        methods = METHODS if method is None else (method,)
        comparison = work_precision(
            file.build,
            t1=t1,
            error=run.error,
            methods=methods,
            refinements=(1,),
            most_seconds=run.most_seconds if most_seconds is None else most_seconds,
            progress=progress,
            say=say,
        )
        best, choice = comparison.cheapest(), comparison.verdict()
        if best is None:
            raise ValueError(f"{path}: {choice}")
        dt, method = best.dt, best.method
        save_every = save_every or max(1, best.steps // _FRAMES)
    return Simulation(**vars(file), t1=t1, dt=dt, method=method, save_every=save_every or 1, choice=choice)


def marked_arguments(function: Callable, table: dict[str, Any], where: str, without: Iterable[str] = ()) -> Any:
    """`arguments` of a table, whose values are those that marks of the function's annotations ask for."""
    keywords = arguments(function, table, where, without=without)
    for name, (hint, _) in parameters_of(function).items():
        require_marks(f"{where} {name}", keywords.get(name), marks_of(hint))
    return keywords


def step_of(path: Path, file: SceneFile) -> float | None:
    """The step of a scene file [s], also of dt = "stable"; None where pilot runs choose it."""
    if not isinstance(file.run.dt, str):
        return None if file.run.dt is None else float(file.run.dt)
    assert file.run.method is not None
    try:
        return float(stable_dt(file.scene, file.particles, method=file.run.method, t1=file.run.t1))
    except ValueError as error:
        raise ValueError(f'{path}: [run] dt = "stable": {error}') from None


def particles_in(file: str, frame: int = -1) -> Particles:
    """The particles, with all of their state, of a frame in a run's file, from 0, or from the end if negative."""
    return load(file, frame=frame).final


def _find_files(table: Any, folder: Path) -> None:
    """Names of meshes and of particles' files, which are relative to the scene file, as paths."""
    for value in table.values() if isinstance(table, dict) else table if isinstance(table, list) else ():
        _find_files(value, folder)
    if isinstance(table, dict) and isinstance(table.get("file"), str):
        table["file"] = str(folder / table["file"])


def _refined(table: dict[str, Any], n: int) -> dict[str, Any]:
    """The table of a scene on n times as many cells a direction."""
    grid = table.get("grid")
    if n == 1 or not isinstance(grid, dict):
        return table
    materials = table.get("material", {})
    for material in materials if isinstance(materials, list) else [materials]:
        lists = _lists(material)
        require(not lists, f"[material] {', '.join(lists)}: refinement needs one number for all particles.")
    finer = {key: [n * k for k in grid[key]] for key in ("shape", "origin") if key in grid}
    return table | {"grid": grid | finer | {"spacing": grid["spacing"] / n}}


def _lists(material: Any) -> list[str]:
    """The keys of a law, and of a law within it, that have one value for each particle."""
    items = material.items() if isinstance(material, dict) else ()
    return [key for key, value in items if isinstance(value, list)] + [k for _, v in items for k in _lists(v)]


def _filled(scene: Scene, tables: list[Any], dtype: str | None) -> tuple[Particles, bool]:
    """The particles of all tables, in the materials' order, and whether tables overlap, with a warning."""
    filled: list[list[Particles]] = [[] for _ in scene.laws]
    placed: list[tuple[int, AbstractRegion, np.ndarray]] = []
    grid, dx = scene.grid, float(scene.grid.spacing)
    window, first, held = np.asarray(grid.shape) - 1, np.asarray(grid.origin) * dx, ~np.asarray(grid.periodic)
    for number, table in enumerate(tables, 1):
        where = f"[[particles]] {number}"
        require(isinstance(table, dict), f"{where} must be a table, got {shortened(repr(table))}.")
        material, rest = table.get("material", 1), {key: value for key, value in table.items() if key != "material"}
        material = scene.names.index(material) + 1 if material in scene.names else material
        one = f"the number of a [[material]], from 1 to {len(scene.laws)}"
        if scene.names:
            one = f"the name of a [material.NAME], {', '.join(scene.names)}, or its number"
        fits = type(material) is int and material in range(1, len(scene.laws) + 1)
        require(fits, f"{where} material must be {one}, got {shortened(repr(material))}.")
        keys = arguments(fill, rest, where, without=("grid", "dtype"))
        region: AbstractRegion = keys["region"]
        try:
            lower, upper = region.bounds()
            if len(lower) == grid.dim:  # else `fill` refuses it
                too_large = (upper - lower > (window + 2) * dx) & held
                beside = ((upper < first) | (lower > first + window * dx)) & held & (not grid.follow)
                require(
                    ~(too_large | beside),
                    f"the region from {lower} to {upper} m does not fit into the grid's window, of {window * dx} m"
                    + ("" if grid.follow else f" from {first} m")
                    + ": all lengths are in metres; enlarge the shape, move the origin, or use follow = true.",
                )
            filled[material - 1].append(fill(grid=grid, dtype=dtype, **keys))
            placed.append((number, region, np.asarray(filled[material - 1][-1].x)))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from None
    overlap = False
    for (i, region, _), (j, _, x) in itertools.combinations(placed, 2):
        lower, upper = region.bounds()
        if ((x.min(axis=0) >= upper) | (x.max(axis=0) <= lower)).any():
            continue
        inside = int(np.asarray(region.contains(jnp.asarray(x), -1e-3 * dx)).sum())  # deeper than rounding has it
        if inside:
            overlap = True
            warn(
                f"{inside} particles of [[particles]] {j} lie in the region of [[particles]] {i}: where two fill the "
                "same place there is twice the mass."
            )
    for number, sets in enumerate(filled):
        place = f"[material.{scene.names[number]}]" if scene.names else f"[[material]] {number + 1}"
        require(len(sets) > 0, f"{place} has no particles: name it in a [[particles]] table, or leave it out.")
    return join(*(replace(join(*sets), counts=None) for sets in filled)), overlap
