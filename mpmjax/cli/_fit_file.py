"""The `[fit]` table of a scene file (docs/scene_files.md): what is fitted, and what was measured."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._tables import require_keys, shortened
from mpmjax._types import Scalar
from mpmjax.checks import between, require, require_positive, whole
from mpmjax.cli._measurements import observation
from mpmjax.cli._scene_file import Simulation, marked_arguments, read_simulation
from mpmjax.fitting import (
    AbstractOptimiser,
    AbstractParameter,
    Bounded,
    Experiment,
    Gaussian,
    Positive,
    Starts,
    Unbounded,
)
from mpmjax.io import decode


class FitFile(NamedTuple):
    """The content of a `[fit]` table."""

    experiments: tuple[Experiment, ...]
    parameters: dict[str, AbstractParameter]
    report: dict[str, Callable[[Experiment], Any]]
    level: float
    optimiser: AbstractOptimiser | None
    starts: Literal["auto"] | Starts  # from where it is searched
    horizons: tuple[float, ...] | bool  # until which times it is fitted first [s]; true to choose them, false for none
    refine: tuple[int, ...]  # on how many times as many cells a direction it is fitted besides; empty for none
    discretisation: bool  # whether a single grid's fit looks at twice the spacing
    whole: tuple[Experiment, ...]  # the experiments until the ends of their runs, with all that was measured
    refined: Callable[[int], tuple[tuple[Experiment, ...], tuple[Experiment, ...]]]
    """The experiments and the whole ones on n times as many cells a direction, with steps n times shorter, from n."""


def read_fit(path: Path, read: Callable[[Path], Simulation] = read_simulation) -> FitFile:
    """Read a scene file with its `[fit]` table, and the scene files of other experiments that it names, each by `read`.

    Raises:
        ValueError: as `read_simulation`; no `[fit]` table, or one that does not fit: one line that names the place.
    """
    simulation = read(path)
    table = _fit_table(path, simulation)
    sources = [(path, simulation, table)] if "observation" in table else []
    try:
        require_keys(table, _KEYS, "[fit]")
        for named_scene in _tables(table, "experiment"):
            require_keys(named_scene, ("scene",), "[[fit.experiment]]")
            scene = named_scene.get("scene")
            require(isinstance(scene, str), "[[fit.experiment]] needs the key 'scene', a string.")
            file = path.parent / str(scene)
            other = read(file)
            sources.append((file, other, _fit_table(file, other)))
            require_keys(sources[-1][2], _KEYS, f"[fit] of {file}")
        require(len(sources) > 0, "[fit] needs an [[fit.observation]], or an [[fit.experiment]] whose scene has one.")
        parts = [_experiments(*source) for source in sources]
        chosen = {key: value for key, value in table.items() if key in _SETTINGS}
        settings = fit_settings(**marked_arguments(fit_settings, chosen, "[fit]"))
        tables = _tables(table, "parameter")
        require(len(tables) > 0, "[fit] needs a [[fit.parameter]].")
        first = [fitted for fitted, _ in parts]
        keys = [marked_arguments(fit_parameter, t, "[[fit.parameter]]", without=("experiments",)) for t in tables]
        named = [fit_parameter(first, **each) for each in keys]
        names = [name for name, _ in named]
        require(len(set(names)) == len(names), f"[[fit.parameter]] {', '.join(names)}: each needs a name of its own.")
        report = table.get("report", {})
        require(isinstance(report, dict), "[fit.report] must be a table of names and paths.")
        for name, where in report.items():
            value = leaf_of(_path(where, "[fit.report]"), parts[0][0])
            one = not isinstance(value, eqx.Module) and np.ndim(value) == 0
            require(one, f"[fit.report] {name} = {where!r} must be one number, but is {value}.")
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None

    def refined(n: int) -> tuple[tuple[Experiment, ...], tuple[Experiment, ...]]:
        finer = [_experiments(file, _refined(one, n), fit_table) for file, one, fit_table in sources]
        fitted, whole = zip(*finer, strict=True)
        return fitted, whole

    reported = {name: partial(leaf_of, where) for name, where in report.items()}
    fitted, whole = zip(*parts, strict=True)
    return FitFile(fitted, dict(named), reported, whole=whole, refined=refined, **settings)


_TABLES = ("parameter", "observation", "experiment", "report")
_SETTINGS = ("level", "starts", "fraction", "horizons", "refine", "discretisation", "optimiser")
_KEYS = ("t1", *_SETTINGS, *_TABLES)


def fit_settings(
    *,
    level: Annotated[Scalar, between(0, 1, open_ends=True)] = 0.95,
    starts: Annotated[int, whole(1)] | Literal["auto"] = "auto",
    fraction: Annotated[Scalar, between(0, 1)] | None = None,
    horizons: tuple[float, ...] | bool = False,
    refine: int | tuple[int, ...] = (),
    discretisation: bool = True,
    optimiser: AbstractOptimiser | None = None,
) -> dict[str, Any]:
    """How to fit, of a [fit] table."""
    many = starts != "auto" and starts > 1
    require(many or fraction is None, "[fit] fraction is one of starts: give these too.")
    fraction = 0.375 if fraction is None else fraction
    require(not (many and horizons), "[fit] takes either starts or horizons.")
    finer = refinements(refine if isinstance(refine, tuple) else (refine,), "[fit] refine")
    places = starts if starts == "auto" else Starts(starts, float(fraction))
    sequence = {"starts": places, "horizons": horizons, "refine": finer}
    return sequence | {"level": float(level), "discretisation": discretisation, "optimiser": optimiser}


def refinements(numbers: tuple[int, ...], where: str) -> tuple[int, ...]:
    """The refinements of a fit on several grids, which must grow, from one; empty for none."""
    finer = tuple(n for n in numbers if n != 1)
    grow = all(a < b for a, b in zip((1, *finer), finer, strict=False))
    require(grow, f"{where} must be growing whole numbers of two at least, such as 2, got {list(numbers)}.")
    return (1, *finer) if finer else ()


def _refined(simulation: Simulation, n: int) -> Simulation:
    """A simulation on n times as many cells a direction, with steps n times shorter."""
    if n == 1:
        return simulation
    scene, particles = simulation.build(n)
    return replace(simulation, scene=scene, particles=particles, dt=simulation.dt / n)


def leaf_of(path: str, experiment: Experiment) -> Any:
    """The value at a dotted path, such as "scene.material.youngs_modulus" or "scene.boundary.0.friction"."""
    value: Any = experiment
    materials = {name: str(i) for i, name in enumerate(experiment.scene.names)}
    for name in path.split("."):
        name = materials.get(name, name) if value is experiment.scene.material else name
        try:
            value = value[int(name)] if name.isdecimal() else getattr(value, name)
        except (AttributeError, IndexError, TypeError):
            one = ": name one of several before it, by its number from 0" if isinstance(value, tuple) else ""
            one += f" or as {', '.join(materials)}" if materials and value is experiment.scene.material else ""
            raise ValueError(f"[fit] names {path!r}, but there is no {name!r} there{one}.") from None
    return value


def _path(path: Any, where: str) -> str:
    first = path.split(".")[0] if isinstance(path, str) else ""
    require(
        first in ("scene", "particles", "method"),
        f"{where} must name a number by a dotted path that begins with scene, particles or method, such as "
        f'"scene.material.youngs_modulus", got {shortened(repr(path))}.',
    )
    return path


def _fit_table(path: Path, simulation: Simulation) -> dict[str, Any]:
    table = simulation.fit
    require(table is not None, f"{path} has no [fit] table, so there is nothing to fit. See docs/scene_files.md.")
    return table or {}


def _tables(table: dict[str, Any], name: str) -> list[dict[str, Any]]:
    tables = table.get(name, [])
    several = isinstance(tables, list) and all(isinstance(t, dict) for t in tables)
    require(several, f"[[fit.{name}]] must be tables with double brackets.")
    return tables


def fit_parameter(
    experiments: list[Experiment],
    *,
    path: str | None = None,
    name: str | None = None,
    kind: Literal["Positive", "Bounded", "Unbounded", "Velocity", "Spin"] = "Positive",
    lower: Scalar | None = None,
    upper: Scalar | None = None,
    start: Scalar | tuple[float, ...] | None = None,
    mean: Scalar | tuple[float, ...] | None = None,
    sigma: Scalar | tuple[float, ...] | None = None,
    unit: str = "",
    only: tuple[int, ...] | None = None,
) -> tuple[str, AbstractParameter]:
    """Name and parameter of a [[fit.parameter]] table, of these experiments."""
    where = f"[[fit.parameter]] {path or kind!r}"
    numbers = (0,) if only is None else only
    there = len(numbers) > 0 and all(0 <= k < len(experiments) for k in numbers)
    require(there, f"{where}: only must name experiments from 0 to {len(experiments) - 1}, got {only}.")
    require((mean is None) == (sigma is None), f"{where} takes mean and sigma of a prior together.")
    prior = None if mean is None or sigma is None else Gaussian(mean, sigma)
    common: dict[str, Any] = {"start": None if start is None else jnp.asarray(start, float), "prior": prior}
    common |= {"unit": unit, "only": only}
    bounds = lower is not None or upper is not None
    require((kind == "Bounded") == bounds, f'{where}: lower and upper go with kind = "Bounded".')
    if kind in _OF_THE_BODY:
        require(path is None, f"{where}: {kind} is of all particles and takes no path.")
        return name or kind.lower(), _of_the_body(kind, where, experiments[min(numbers)], common)
    require(path is not None, f'{where} needs a path, such as "scene.material.youngs_modulus".')
    owner, _, last = _path(path, where).rpartition(".")
    value, parent = (leaf_of(of, experiments[min(numbers)]) for of in (str(path), owner))
    names = [f.name for f in fields(parent)] if is_dataclass(parent) else [last]
    fault = f"{where} follows from others and cannot be fitted; name one of {', '.join(names)}."
    require(last in names, fault)
    number = eqx.is_array_like(value) and np.issubdtype(np.asarray(value).dtype, np.floating)
    require(number, f"{where} must be a number, but is {shortened(repr(value))}.")
    common |= {"where": partial(leaf_of, str(path))}
    if kind == "Bounded":
        require(lower is not None and upper is not None, f"{where} needs lower and upper.")
        return name or last, Bounded(lower=float(lower or 0.0), upper=float(upper or 0.0), **common)
    return name or last, (Positive if kind == "Positive" else Unbounded)(**common)


_OF_THE_BODY = ("Velocity", "Spin")  # parameters of the initial motion of all particles


def _of_the_body(kind: str, where: str, experiment: Experiment, common: dict[str, Any]) -> Unbounded:
    """The velocity of the centre of mass at the start [m/s], or a rate of turning about it besides [rad/s]."""
    particles = experiment.particles
    d = particles.dim
    if kind == "Velocity":
        first, update, unit = np.asarray(particles.mass @ particles.v / particles.mass.sum()), _moved, "m/s"
    else:
        require(d > 1, f"{where}: a body in one dimension does not turn.")
        first, update, unit = np.zeros(() if d == 2 else 3), _turned, "rad/s"
    start = first if common["start"] is None else np.asarray(common["start"])
    require(start.shape == first.shape, f"{where} start must have shape {first.shape}, got {start.shape}.")
    return Unbounded(update=update, **(common | {"start": jnp.asarray(start), "unit": common["unit"] or unit}))


def _moved(experiment: Experiment, velocity: Any) -> Experiment:
    """The experiment with this velocity of the centre of mass."""
    particles = experiment.particles
    mean = particles.mass @ particles.v / particles.mass.sum()
    return eqx.tree_at(lambda e: e.particles.v, experiment, particles.v + (velocity - mean))


def _turned(experiment: Experiment, spin: Any) -> Experiment:
    """The experiment with the velocities, and their gradients, of a rotation about the centre of mass added."""
    q = experiment.particles
    zero = jnp.zeros((), q.x.dtype)
    if q.dim == 2:
        W = jnp.array([[zero, -spin], [spin, zero]])
    else:
        a, b, c = spin
        W = jnp.array([[zero, -c, b], [c, zero, -a], [-b, a, zero]])
    arms = q.x - q.mass @ q.x / q.mass.sum()
    turned = eqx.tree_at(lambda e: e.particles.v, experiment, q.v + arms @ W.T)
    return turned if q.C is None else eqx.tree_at(lambda e: e.particles.C, turned, q.C + W)


def _experiments(path: Path, simulation: Simulation, table: dict[str, Any]) -> tuple[Experiment, Experiment]:
    """The experiment that is fitted, which ends at [fit] t1, and the one of all that was measured."""
    t1 = decode(table.get("t1", simulation.t1), Scalar, "[fit] t1")
    require_positive("[fit] t1", t1)
    require(t1 <= simulation.t1, f"[fit] t1 must not lie after that of [run], got {t1} and {simulation.t1}.")
    tables = _tables(table, "observation")
    require(len(tables) > 0, f"{path} needs an [[fit.observation]].")
    pairs = [observation(t, path.parent, simulation, t1) for t in tables]
    fitted, whole = zip(*pairs, strict=True)

    experiment = partial(
        Experiment, simulation.scene, simulation.particles, dt=simulation.dt, method=simulation.method, name=path.stem
    )
    return experiment(t1=t1, observations=fitted), experiment(t1=simulation.t1, observations=whole)
