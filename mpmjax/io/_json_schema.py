"""The JSON schema of a function's arguments, and of classes that files hold."""

import enum
import inspect
from collections.abc import Callable, Iterable
from typing import Any, Literal, get_args, get_origin

from mpmjax.checks import alternatives, is_class
from mpmjax.io._schema import MADE, classes_for, forms_of, known_classes, parameters_of


def table_schema(function: Callable, without: Iterable[str] = (), kind: str | None = None) -> dict[str, Any]:
    """The JSON schema of a table of a function's arguments (see `arguments`), which editors read; `kind` is its key of
    that name. Classes are references to `class_schemas`."""
    parameters = {name: p for name, p in parameters_of(function).items() if name not in without}
    properties = {name: _value_schema(hint) for name, (hint, _) in parameters.items()}
    required = [name for name, (_, default) in parameters.items() if default is inspect.Parameter.empty]
    text = " ".join((function.__doc__ or "").split("\n\n")[0].split())
    named = {} if kind is None else {"kind": {"const": kind}}
    table = {"type": "object", "properties": named | properties, "additionalProperties": False}
    return table | {"description": text, "required": required}


def class_schemas(*bases: type) -> dict[str, Any]:
    """The JSON schemas, by name, of all classes that files can hold, of further bases, and of what is `MADE`."""
    classes = {c.__name__: c for c in (*known_classes(), *classes_for(bases))}
    made = {name: make for name, (make, _) in MADE.items()}
    return {name: table_schema(c, kind=name) for name, c in (classes | made).items()}


def _value_schema(hint: Any) -> dict[str, Any]:
    """The JSON schema of what an annotation takes."""
    json, options = {float: "number", int: "integer", bool: "boolean", str: "string"}, alternatives(hint)
    words = [word for a in options if get_origin(a) is Literal for word in get_args(a)]
    choices: list[dict[str, Any]] = [{"enum": words}] if words else []
    for kind, depth in sorted(forms_of(hint), key=str):
        if words and (kind, depth) == (str, 0):
            continue
        value: dict[str, Any] = {"type": json[kind]}
        for _ in range(depth):
            value = {"type": "array", "items": value}
        choices.append(value)
    for cls in classes_for(options):
        choices.append({"$ref": f"#/$defs/{cls.__name__}"})
        if all(default is not inspect.Parameter.empty for _, default in parameters_of(cls).values()):
            choices.append({"const": cls.__name__})  # its kind alone
        choices += [{"$ref": f"#/$defs/{name}"} for name, (_, result) in MADE.items() if result is cls]
    for a in options:
        if get_origin(a) is dict:  # of objects by their names
            choices.append({"type": "object", "additionalProperties": _value_schema(get_args(a)[1])})
        if is_class(a, enum.Enum):
            choices.append({"enum": [member.value for member in a]})
        elif get_origin(a) in (tuple, list) and (item := _value_schema(get_args(a)[0])) and not forms_of(a):
            choices += [{"type": "array", "items": item}, item]
    return {"anyOf": choices} if choices else {}
