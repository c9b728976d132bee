"""Description of a fit in words, by which two fits can be told apart."""

import enum
import hashlib
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from types import CodeType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax.fitting._optimiser import AbstractOptimiser
from mpmjax.fitting._parameter import AbstractParameter
from mpmjax.fitting._problem import FitProblem

_MOST = 8
"""Numbers of an array that are written out."""
_FREE = ("optimiser.max_steps",)
"""Choices that may differ in a fit that is continued: it may go on for longer."""


def described(problem: FitProblem, optimiser: AbstractOptimiser) -> dict[str, str]:
    """Every number, choice and function of a fit by its dotted path.

    Arrays stand as a digest, functions as their name and a digest of their code, and the `where` of a parameter as the
    numbers that change with it.
    """
    texts = dict(_texts(optimiser, "optimiser"))
    for k, experiment in enumerate(problem.experiments):
        texts |= dict(_texts(experiment, f"experiments.{k}"))
    for name, parameter, start in zip(problem.names, problem.parameters, problem.starts, strict=True):
        texts[f"parameters.{name}"] = _changed(problem, parameter, start)
        texts |= dict(_texts(parameter, f"parameters.{name}"))
    return {name: text for name, text in texts.items() if name not in _FREE}


def _changed(problem: FitProblem, parameter: AbstractParameter, start: Any) -> str:
    """The numbers of an experiment that change with a parameter."""
    experiment = problem.experiments[0 if parameter.only is None else parameter.only[0]]
    put = parameter.put(experiment, start + 1 + jnp.abs(start))
    before, after = (jax.tree_util.tree_leaves_with_path(tree) for tree in (experiment, put))
    names = [
        jax.tree_util.keystr(path).lstrip(".")
        for (path, a), (_, b) in zip(before, after, strict=False)
        if eqx.is_array_like(a) and not np.array_equal(a, b)
    ]
    return f"{type(parameter).__name__} of {', '.join(names)}"


def _texts(value: Any, path: str) -> Iterator[tuple[str, str]]:
    """The text of everything within a value."""
    match value:
        case AbstractParameter():
            for f in fields(value):
                if f.name not in ("where", "update", "unit"):
                    yield from _texts(getattr(value, f.name), f"{path}.{f.name}")
        case eqx.Module() if is_dataclass(value):
            yield path, type(value).__name__
            for f in fields(value):
                yield from _texts(getattr(value, f.name, None), f"{path}.{f.name}")
        case Mapping():
            for key, part in value.items():
                yield from _texts(part, f"{path}.{key}")
        case tuple() | list() if len(value) > 0 and not all(isinstance(part, (bool, int, float)) for part in value):
            yield path, f"{len(value)} of them"
            for k, part in enumerate(value):
                yield from _texts(part, f"{path}.{k}")
        case None | bool() | str():
            yield path, repr(value)
        case partial():
            yield from _texts((value.func, *value.args, *value.keywords.values()), path)
        case _ if eqx.is_array_like(value) or isinstance(value, (tuple, list)):
            yield path, _array(np.asarray(value))
        case _ if callable(value):
            code = getattr(value, "__code__", None)
            digest = f" of code {_digest(_code(code))}" if code is not None else ""
            name = getattr(value, "__qualname__", type(value).__qualname__)
            yield path, f"{getattr(value, '__module__', '')}.{name}{digest}"
            held = inspect.getclosurevars(value).nonlocals if code is not None else {}
            yield from _texts({key: v for key, v in held.items() if not callable(v)}, path)
        case enum.Enum():
            yield path, repr(value.value)
        case _:
            yield path, type(value).__qualname__


def _array(data: np.ndarray) -> str:
    if data.size <= _MOST:
        return repr(data.tolist())
    return (
        f"an array of shape {data.shape} ({_digest(repr(data.dtype).encode() + np.ascontiguousarray(data).tobytes())})"
    )


def _code(code: CodeType) -> bytes:
    """The code of a function, without the place where it stands."""
    constants = [_code(c) if isinstance(c, CodeType) else repr(_ordered(c)).encode() for c in code.co_consts]
    return b"\0".join([code.co_code, repr(code.co_names).encode(), *constants])


def _ordered(constant: Any) -> Any:
    """A constant whose text is the same in each process."""
    return sorted(constant, key=repr) if isinstance(constant, frozenset) else constant


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:12]
