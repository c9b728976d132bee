"""Scene files spoilt at random: values of wrong kinds and sizes, keys that are missing, unknown or misplaced."""

import copy
import json
import random
from collections.abc import Iterator
from typing import Any

WORDS = ("", "nonsense", "auto", "stable", "FixedCorotated", "x" * 5000, "\x00\n\t", "√")
NUMBERS = (0, -1, 1, 2, 3, 7, 10**9, -(10**9), 2**31, 2**63, 10**30, 10**400, -(10**400))
FLOATS = (0.0, -0.5, 1e-300, 1e-12, 1e-4, 1e4, 1e12, 1e300, 1e308, -1e308, 5e-324)
OTHERS = (float("nan"), float("inf"), -float("inf"), True, False)


def spoilt(scene: dict[str, Any], seed: int) -> dict[str, Any]:
    """A scene with one to three of its values, or of its tables, replaced, removed, added or moved."""
    rng = random.Random(seed)
    table = copy.deepcopy(scene)
    for _ in range(rng.choice((1, 1, 2, 3))):
        owner, key = rng.choice(list(_places(table)))
        match rng.randrange(8):
            case 0:
                del owner[key]
            case 1 if isinstance(owner, dict):
                owner[rng.choice(("kind", "shape", key + "s", "Ω", ""))] = _value(rng)
            case 2:
                _, other = rng.choice(list(_places(table)))
                if isinstance(owner, dict) and isinstance(other, str):
                    owner[other] = copy.deepcopy(owner[key])
            case 3 if isinstance(owner[key], (int, float)) and not isinstance(owner[key], bool):
                owner[key] = owner[key] * rng.choice((-1, 0, 1e-6, 1e-3, 1e3, 1e6, 1000, 10**12))
            case 4 if isinstance(owner[key], list):
                owner[key] = owner[key] * rng.choice((0, 2, 3))
            case _:
                owner[key] = _value(rng)
    return table


def toml(table: dict[str, Any]) -> str:
    """As TOML, tables in one line each."""
    return "\n".join(f"{_key(name)} = {_written(value)}" for name, value in table.items())


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """All of what can be replaced: its owner and its key there."""
    for key in value if isinstance(value, dict) else range(len(value)):
        yield value, key
        if isinstance(value[key], (dict, list)):
            yield from _places(value[key])


def _value(rng: random.Random) -> Any:
    """One of another kind."""
    kind = rng.choice((WORDS, NUMBERS, FLOATS, OTHERS, "list", "table", "deep"))
    if kind == "list":
        return [_value(rng) for _ in range(rng.randrange(4))]
    if kind == "table":
        return {rng.choice(("kind", "a", "shape")): _value(rng)}
    if kind == "deep":
        value: Any = 0
        for _ in range(rng.choice((3, 50))):
            value = [value] if rng.random() < 0.5 else {"regions": value}
        return value
    return rng.choice(kind)


def _key(name: str) -> str:
    return json.dumps(name, ensure_ascii=False)


def _written(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_key(k)} = {_written(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_written(v) for v in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, str) else repr(value)
