"""Tables in files: their keys, kinds and bounds, and the words for what is wrong with these.

No room is imported here, which takes a second: a scene file is checked by `scene.schema.json`, made of the package's
own classes and their marks. `mpmjax schema --import mpmjax > mpmjax/scene.schema.json` writes it anew.
"""

import difflib
import json
import math
import tomllib
from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import reduce
from operator import and_, ge, gt, le, lt, or_
from pathlib import Path
from typing import Any, TypeGuard

SCHEMA = Path(__file__).with_name("scene.schema.json")
OPEN = "A class of your own may stand here."  # which the schema says of a place
ONE = {float: "a number", int: "a whole number", bool: "true or false", str: "a string"}
_MANY = {float: "numbers", int: "whole numbers", bool: "true and false", str: "strings"}
_TYPES = {"number": float, "integer": int, "boolean": bool, "string": str}
_HOLDS = {"minimum": ge, "maximum": le, "exclusiveMinimum": gt, "exclusiveMaximum": lt}


def scene_table(path: Path, changes: Sequence[str] = (), *, fit: bool = False, more: bool = False) -> dict[str, Any]:
    """The table in a scene file, after changes "KEY=VALUE" with a dotted key and a value as TOML writes it (a string
    may lack its quotes). A ValueError says in one line what is not one of these, what key or kind is unknown or
    missing, what number is out of bounds, also in `[fit]` with `fit`. Where there may be `more` kinds than the
    package's own it leaves them."""
    try:
        table: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"Cannot read the scene file {path}: {str(error.strerror).lower()}.") from None
    except RecursionError:
        raise ValueError(f"{path} is not a scene file: it is nested too deeply to be read.") from None
    except ValueError as error:  # TOML's and UTF-8's among them
        text = " ".join(str(error)[:800].split())
        raise ValueError(f"{path} is not a TOML file: {text if len(text) < 80 else text[:77] + '...'}.") from None
    for name in ("particles", "run"):
        require_in(f"{path}:", name in table, f"needs the table [{name}]. See docs/scene_files.md")
    for change in changes:
        _change(table, change, path)
    schema = json.loads(SCHEMA.read_text(encoding="utf-8"))
    try:
        _check_keys(table if fit else table | {"fit": {}}, schema, "", schema["$defs"], more)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}: tables are nested too deeply to be read.") from None
    return table


def _change(table: dict[str, Any], change: str, path: Path) -> None:
    """Change one value of the table in a scene file."""
    key, equals, text = change.partition("=")
    if not (key and equals):
        raise ValueError(f"--set must be KEY=VALUE, such as material.youngs_modulus=2e5, got {change!r}.")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *owners, last = key.strip().split(".")
    owner: Any = table
    try:
        for name in owners:
            owner = owner[int(name)] if isinstance(owner, list) else owner.setdefault(name, {})
        owner[int(last) if isinstance(owner, list) else last] = value
    except (AttributeError, IndexError, TypeError, ValueError):
        raise ValueError(f"{key}: {path} has no such place; tables of a list have numbers from 0.") from None


def _check_keys(table: dict[str, Any], schema: dict[str, Any], where: str, kinds: dict[str, Any], more: bool) -> None:
    """Check the keys of a table, and the tables within it, by its schema and those of all kinds."""
    properties = _without_kind(schema["properties"])
    require_keys(table, properties, where, needed=schema["required"])
    for key, value in table.items():
        _check_tables(value, properties[key], place_of(key, value, where), kinds, more)


def _check_tables(value: Any, schema: dict[str, Any], where: str, kinds: dict[str, Any], more: bool) -> None:
    """Check the tables in a value by its schema, and the form and bounds of numbers, words and switches. All else is
    left to who reads it."""
    options, bounds = schema.get("anyOf", [schema]), _bounds(schema)
    if (forms := _forms(options)) is not None:
        leaves, words = list(_leaves(value)), [word for option in options for word in option.get("enum", ())]
        listed = all(leaf in words for leaf, _ in leaves if words and isinstance(leaf, str))
        fit = listed and any(all(k == depth and fits(leaf, kind) for leaf, k in leaves) for kind, depth in forms)
        require_in(where, fit, f"must be {in_words(forms, words)}, got {short(value)}")
        require_in(where, all(leaf == leaf for leaf, _ in leaves), f"must be finite, got {short(value)}")
    inside = not bounds or all(within(number, bounds) for number in _numbers(value))
    require_in(where, inside, f"{schema.get('description')}, got {short(value)}")
    objects = {option["$ref"].removeprefix("#/$defs/"): option for option in options if "$ref" in option}
    if isinstance(value, list):
        items = next((o["items"] for o in options if {"anyOf", "properties"} & o.get("items", {}).keys()), {})
        for i, item in enumerate(value, 1):
            _check_tables(item, items, place_in_list(where, i), kinds, more)
    elif are_named(value) and (named := [o["additionalProperties"] for o in options if o.get("additionalProperties")]):
        for name, item in value.items():
            _check_tables(item, named[0], place_of(name, item, where), kinds, more)
    elif objects and isinstance(value, (dict, str)) and {"const": value} not in options:
        evident, opened = [k for k, o in objects.items() if "required" not in o], schema.get("$comment") == OPEN
        kind = value if isinstance(value, str) else value.get("kind")
        if not (more and opened) or kind in list(objects):
            kind, keys = kind_in(value, objects, evident, where, opened=opened)
            _check_keys(keys, kinds[kind], where, kinds, more)
    elif isinstance(value, dict):
        tables = [option for option in options if "properties" in option]
        alike = [table for table in tables if table["properties"].get("kind", {}).get("const") == value.get("kind")]
        whole = [table for table in alike if set(table["required"]) <= value.keys()]
        for table in (whole or alike)[:1]:
            _check_keys(_without_kind(value), table, where, kinds, more)


def _forms(options: list[dict[str, Any]]) -> set[tuple[type, int]] | None:
    """Kind and depth of lists of the numbers, words and switches that options are; None where one is another thing."""
    forms = set()
    for option in options:
        depth = 0
        while option.get("type") == "array" and "items" in option:
            option, depth = option["items"], depth + 1
        kind = str if "enum" in option else _TYPES.get(str(option.get("type")))
        if kind is None:
            return None
        forms.add((kind, depth))
    return forms or None


def _leaves(value: Any, depth: int = 0) -> Iterator[tuple[Any, int]]:
    """Each number, word or other value in lists however nested, and how deep it is."""
    if not isinstance(value, list):
        yield value, depth
    else:
        for item in value:
            yield from _leaves(item, depth + 1)


def in_words(forms: set[tuple[type, int]], words: list[str]) -> str:
    """Kinds of numbers and depths of lists in words, with the words that a string must be one of."""
    alone = ONE | ({str: " or ".join(map(repr, words))} if words else {})
    whole = {(int, depth) for kind, depth in forms if kind is float}  # a number may be whole anyway
    lists = sorted(forms - whole, key=lambda form: (form[1], form[0] is str))
    return " or ".join(f"a list of {'lists of ' * (k - 1)}{_MANY[kind]}" if k else alone[kind] for kind, k in lists)


def fits(leaf: Any, kind: type) -> bool:
    """Whether a number, word or switch is of a kind."""
    if isinstance(leaf, bool) or kind in (bool, str):
        return type(leaf) is kind
    return isinstance(leaf, (int, float)) if kind is float else isinstance(leaf, int) and abs(leaf) < 2**63


def _bounds(schema: dict[str, Any]) -> dict[str, float | int]:
    """The bounds of the numbers that a schema takes, in lists however nested."""
    inner = [*schema.get("anyOf", ()), *([schema["items"]] if "items" in schema else ())]
    return reduce(or_, map(_bounds, inner), {name: schema[name] for name in _HOLDS if name in schema})


def _numbers(value: Any) -> list[float | int]:
    """The finite numbers in a value, in lists however nested."""
    return [leaf for leaf, _ in _leaves(value) if type(leaf) in (int, float) and abs(leaf) < math.inf]


def within(numbers: Any, bounds: dict[str, float | int]) -> Any:
    """Whether a number, or each of an array, lies within bounds, named as JSON schemas do."""
    return reduce(and_, (_HOLDS[name](numbers, bound) for name, bound in bounds.items()))


def _without_kind(table: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if key != "kind"}


def require_keys(table: dict[str, Any], names: Iterable[str], where: str, needed: Iterable[str] = ()) -> None:
    """Check that a table has no other keys than these, and all that are needed."""
    for key in (key for key in table if key not in names):
        unknown = f"{_named(where, 'unknown key')} {short(key)}{_close(key[:60], names)}"
        raise ValueError(f"{unknown} Known here: {', '.join(names) or 'none'}.")
    for key in needed:
        require_in(where, key in table, f"needs the key {key!r}")


def kind_in(
    data: Any, kinds: Collection[str], evident: Sequence[str], where: str, *, opened: bool
) -> tuple[str, dict[str, Any]]:
    """The kind of an object, which must be one of these, and its keys, from data that may leave out the one kind that
    is evident. Where it is `opened`, a class of a user's own may be meant."""
    choice = f"one of {', '.join(kinds)}" if len(kinds) > 1 else next(iter(kinds), "a class of your own")
    table: Any = {"kind": data} if isinstance(data, str) else data
    require_in(where, isinstance(table, dict), f"must be a table with a kind, {choice}, got {short(data)}")
    require_in(where, "kind" in table or len(evident) == 1, f"needs a kind: {choice}")
    kind, keys = table["kind"] if "kind" in table else evident[0], _without_kind(table)
    if not (isinstance(kind, str) and kind in kinds):
        registered = " A class of your own is known when the module is imported that calls mpm.register."
        unknown = f"{_named(where, 'unknown kind')} {short(kind)}{_close(short(kind), kinds)}"
        raise ValueError(f"{unknown} It must be {choice}.{registered * opened}")
    return kind, keys


def are_named(data: Any) -> TypeGuard[dict[str, dict[str, Any]]]:
    """Whether data are tables by their names, as [material.rubber] makes them."""
    return isinstance(data, dict) and len(data) > 0 and all(isinstance(value, dict) for value in data.values())


def place_of(key: str, value: Any, where: str) -> str:
    """The place of a key's value in words: tables have headers, anything else is named after that which it is in."""
    tables = value if isinstance(value, list) and value else [value]
    if not all(isinstance(v, dict) and set(v) != {"array"} for v in tables):
        return f"{where} {key}".strip()
    return f"{where[:-1]}.{key}]" if where.endswith("]") else f"{where} [{key}]".strip()


def place_in_list(where: str, number: int) -> str:
    """The place of one of a list of tables in words, that of the list in further brackets with its number from 1."""
    *outer, header = where.split(" ")
    return f"{' '.join([*outer, f'[{header}]'])} {number}"


def require_in(where: str, condition: Any, message: str) -> None:
    """Raise a `ValueError` of a place in a file unless the condition holds."""
    if not condition:
        raise ValueError(f"{where or 'The file'} {message}.")


def short(data: Any) -> str:
    """Data of a file as Python writes them, in one line of at most 60 characters."""
    return shortened(repr(data[:61] if isinstance(data, str) else data), 60)


def shortened(text: str, most: int = 80) -> str:
    """The text in one line of at most `most` characters."""
    text = " ".join(text[: 10 * most].split())
    return text if len(text) <= most else text[: most - 3] + "..."


def _close(word: str, words: Iterable[str]) -> str:
    close = difflib.get_close_matches(word, words, 1)
    return f", did you mean {close[0]!r}?" if close else "."


def _named(where: str, what: str) -> str:
    return f"{where}: {what}" if where else what.capitalize()
