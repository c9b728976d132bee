"""Scenes of Python as scene files."""

import inspect
import json
import os
import re
from pathlib import Path
from typing import Any, Literal

from mpmjax._types import Scalar
from mpmjax.checks import canonical, checked, is_traced, require
from mpmjax.io import encode, known_classes, parameters_of, replacing, save
from mpmjax.simulation import Problem, initial_state, no_steps, run_to
from mpmjax.state import Particles, Scene, prepare
from mpmjax.stepping import AbstractIntegrator, Explicit


@checked
def save_scene(
    path: str | os.PathLike,
    scene: Scene,
    particles: Particles,
    *,
    t1: Scalar,
    dt: Scalar | Literal["stable"],
    method: AbstractIntegrator = Explicit(),
    save_every: int = 1,
) -> None:
    """Write a scene as a TOML file for the shell, editors and `load_scene`, with the particles in a run file beside it,
    `NAME.start.vtkhdf`. Arguments with their default are left out; numbers come back bit for bit.

        mpm.save_scene("heap.toml", scene, particles, t1=0.5, dt=1e-3)
        scene, particles, settings = mpm.load_scene("heap.toml")

    Args:
        path: the file to be, NAME.toml, which must not be there.
        scene: the scene, of the package's own classes and of registered ones.
        particles: the particles at the start, with all of their state.
        t1, dt, method, save_every: the `[run]` table, see `simulate`.

    Raises:
        ValueError: a file that is there, a scene that files cannot hold or inside a jax transformation, and what `save`
            refuses.
        OSError: the disk refused.
    """
    path = Path(path)
    require(path.suffix == ".toml", f"A scene file's name must end in .toml, got {path}.")
    start = path.with_suffix(".start.vtkhdf")
    concrete = not is_traced((scene, particles))
    require(concrete, "A scene inside a jax transformation has no values yet: save it outside.")
    for place in (path, start):
        require(not place.exists(), f"{place} exists: remove it, or choose another name.")
    prepared = prepare(scene, particles)
    dtype = prepared.x.dtype
    step = 1.0 if isinstance(dt, str) else dt  # that of the run file, which takes none
    problem = Problem(*canonical((scene, prepared, step, method), dtype))
    table = {key: value for key, value in _chosen(encode(scene)).items() if key not in ("kind", "names")}
    if scene.names:
        table["material"] = dict(zip(scene.names, table["material"], strict=True))
    run = {"t1": encode(t1), "dt": encode(dt), "method": _chosen(encode(method)), "save_every": save_every}
    table |= {"particles": {"file": start.name}, "run": run | {"precision": str(dtype)}}
    with replacing(path) as aside:  # which is put in place when the particles are on the disk
        aside.write_text("\n".join([*_lines(table), ""]), encoding="utf-8")
        save(start, run_to(problem, initial_state(problem), 0, no_steps(dtype)))


def _chosen(data: Any) -> Any:
    """Plain data without the arguments that have their default."""
    if isinstance(data, list):
        return [_chosen(item) for item in data]
    if not isinstance(data, dict):
        return data
    cls = next((c for c in known_classes() if c.__name__ == data.get("kind")), None)
    defaults = {name: default for name, (_, default) in parameters_of(cls).items()} if cls else {}
    usual = {k: encode(v) for k, v in defaults.items() if v is not None and v is not inspect.Parameter.empty}
    return {key: _chosen(value) for key, value in data.items() if key not in usual or usual[key] != value}


def _lines(table: dict[str, Any], owner: str = "") -> list[str]:
    """The lines of a TOML table: its values, then the tables in it under their headers."""
    lines, within = [], []
    for key, value in table.items():
        header = f"{owner}{key}" if re.fullmatch(r"[\w-]+", key, re.ASCII) else f"{owner}{_text(key)}"
        if isinstance(value, dict):
            within += ["", f"[{header}]", *_lines(value, f"{header}.")]
        elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
            within += [line for item in value for line in ("", f"[[{header}]]", *_lines(item, f"{header}."))]
        else:
            lines.append(f"{key} = {_text(value)}")
    return lines + within


def _text(value: Any) -> str:
    """A value as TOML writes it, in one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_text(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(_text, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, (str, bool)) else repr(value)
