"""The JSON schema of scene files, by which editors complete and check them."""

import enum
import inspect
from collections.abc import Callable, Iterable
from typing import Any, get_args, get_origin

from mpmjax._tables import OPEN
from mpmjax.checks import Mark, alternatives, is_class, marks_of
from mpmjax.cli._fit_file import fit_parameter, fit_settings
from mpmjax.cli._measurements import KINDS, keys_of
from mpmjax.cli._scene_file import RunSettings, particles_in
from mpmjax.fitting import AbstractOptimiser
from mpmjax.io import MADE, classes_for, evident_kinds, forms_of, is_open, known_classes, parameters_of, save, words_of
from mpmjax.state import Scene, fill

_EMPTY = inspect.Parameter.empty


def scene_schema() -> dict[str, Any]:
    """The JSON schema of scene files."""

    def tables(each: dict[str, Any]) -> dict[str, Any]:
        return {"type": "array", "items": each}

    particles = _table(fill, without=("grid", "dtype"))
    particles["properties"]["material"] = {"type": ["integer", "string"]}
    run = _table(RunSettings)
    run["properties"]["method"]["anyOf"].append({"const": "auto"})
    fit, text = _table(fit_settings), {"type": "string"}
    fit["properties"] = {"t1": run["properties"]["t1"]} | fit["properties"]
    fit["properties"] |= {
        "report": {"type": "object", "additionalProperties": text},
        "parameter": tables(_table(fit_parameter, without=("experiments",))),
        "observation": tables({"anyOf": [_table(keys_of(kind)[0], kind=kind) for kind in KINDS]}),
        "experiment": tables({"type": "object", "properties": {"scene": text}, "required": ["scene"]}),
    }
    schema = _table(Scene)
    schema["properties"] |= {
        "particles": {"anyOf": [particles, tables(particles), _table(particles_in)]},
        "run": run,
        "output": _table(save, without=("path", "run")),
        "fit": fit,
    }
    schema["required"] += ["particles", "run"]
    classes: dict[str, Callable] = {c.__name__: c for c in (*known_classes(), *classes_for([AbstractOptimiser]))}
    classes |= {name: make for name, (make, _) in MADE.items()}
    definitions = {name: _table(c, kind=name) for name, c in classes.items()}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "$defs": definitions} | schema


def _table(function: Callable, without: Iterable[str] = (), kind: str | None = None) -> dict[str, Any]:
    """The JSON schema of a table of a function's arguments; `kind` is its key of that name."""
    parameters = {name: p for name, p in parameters_of(function).items() if name not in without}
    properties = {name: _value(hint) for name, (hint, _) in parameters.items()}
    required = [name for name, (_, default) in parameters.items() if default is _EMPTY]
    text = " ".join((function.__doc__ or "").split("\n\n")[0].split())
    named = {} if kind is None else {"kind": {"const": kind}}
    table = {"type": "object", "properties": named | properties, "additionalProperties": False}
    return table | {"description": text, "required": required}


def _value(hint: Any) -> dict[str, Any]:
    """The JSON schema of what an annotation takes."""
    json, options = {float: "number", int: "integer", bool: "boolean", str: "string"}, alternatives(hint)
    words, marks = words_of(hint), [mark for mark in marks_of(hint) if isinstance(mark, Mark) and mark.bounds]
    bounds = {name: bound for mark in marks for name, bound in mark.bounds.items()}
    choices: list[dict[str, Any]] = [{"enum": words}] if words else []
    for kind, depth in sorted(forms_of(hint), key=str):
        if words and (kind, depth) == (str, 0):
            continue
        value: dict[str, Any] = {"type": json[kind]} | (bounds if kind in (float, int) else {})
        for _ in range(depth):
            value = {"type": "array", "items": value}
        choices.append(value)
    evident, kinds = evident_kinds(options), classes_for(options)
    names = [cls.__name__ for cls in kinds]
    names += [name for name, (_, result) in MADE.items() if result in kinds]
    for name in names:
        choices.append({"$ref": f"#/$defs/{name}"} | ({} if evident == [name] else {"required": ["kind"]}))
    whole = {cls.__name__: parameters_of(cls).values() for cls in kinds}
    choices += [{"const": name} for name, keys in whole.items() if all(d is not _EMPTY for _, d in keys)]  # kind alone
    for a in options:
        if get_origin(a) is dict:  # of objects by their names
            choices.append({"type": "object", "additionalProperties": _value(get_args(a)[1])})
        if is_class(a, enum.Enum):
            choices.append({"enum": [member.value for member in a]})
        elif get_origin(a) in (tuple, list) and (item := _value(get_args(a)[0])) and not forms_of(a):
            choices += [{"type": "array", "items": item}, item]
    unique = [choice for i, choice in enumerate(choices) if choice not in choices[:i]]
    units = [f"[{mark}]" for mark in marks_of(hint) if isinstance(mark, str)]
    text = " ".join([*units, *(f"must be {mark.words}" for mark in marks)])
    schema = ({"anyOf": unique} if unique else {}) | ({"description": text} if text else {})
    return schema | ({"$comment": OPEN} if kinds and is_open(options) else {})
