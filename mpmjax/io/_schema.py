"""The schema of scenes and methods in files: the package's objects as plain data, both ways.

An object is a table whose `kind` names its class and whose other keys are its constructor's arguments:

    {"kind": "FixedCorotated", "youngs_modulus": 1e5, "poisson_ratio": 0.3}

A key with a default may be left out, and so may `kind` where the package has one class that fits; an object without
other keys may be written as its kind alone (transfer = "PIC"). What a key takes follows from the constructor's
annotation, so a new public class of the package costs nothing here, and one of a user's own a call of `register`.
Numbers come back bit for bit. A TOML scene is such data, and so is the JSON in a run's file. Reading it calls
constructors of known classes and executes nothing else.
"""

import enum
import inspect
import typing
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray

import mpmjax.extensions  # noqa: F401  # whose classes files hold as others
from mpmjax._tables import (
    ONE,
    are_named,
    fits,
    in_words,
    kind_in,
    place_in_list,
    place_of,
    require_in,
    require_keys,
    short,
)
from mpmjax._types import MAY_BE_INFINITE, Scalar
from mpmjax.checks import alternatives, choices, is_abstract, is_class, is_own, marks_of, require
from mpmjax.geometry import SampledDistance, sample_mesh
from mpmjax.state import Scene
from mpmjax.stepping import AbstractIntegrator

_registered: dict[str, type] = {}  # the registered classes that files can hold, by name

Registered = TypeVar("Registered", bound=type)


def register(cls: Registered) -> Registered:
    """Let objects of a class of one's own stand in scene files and be saved and loaded.

        @mpm.register
        class Gent(mpm.AbstractMaterial):
            modulus: float | jax.Array
            limit: float | jax.Array
            ...

    In a file such an object is a table of its `kind`, the class's name, and its constructor's arguments. So each must
    be a field of the same name, annotated with what files can hold: float, int, bool, str, an array, an enumeration, an
    equinox module whose class is the package's, of `equinox.nn` or registered, a function of `jax.nn` or a compiled one
    of `jax.numpy`, or tuples of such. So a law may hold a network, `network: eqx.nn.MLP`, whose weights only a run's
    file has. Numbers in files are finite, but for those annotated as `mpmjax.geometry.Corner`.

    A file never executes code: import the module that registers a class before reading a file with one, in the shell by
    `mpmjax run SCENE.toml --import MODULE`. A class that is defined anew, as in a notebook, replaces the one before.

    Args:
        cls: an `equinox.Module`, such as a law, a boundary, a body force or a region; it is returned.

    Raises:
        ValueError: no such class, a name that another class has, or an argument that files cannot hold.
    """
    require(is_class(cls, eqx.Module), f"register takes a class, an equinox.Module, got {short(cls)}.")
    name = cls.__name__
    other = next((c for c in known_classes() if c.__name__ == name), cls)
    require(
        (other.__module__, other.__qualname__) == (cls.__module__, cls.__qualname__),  # which one defined anew keeps
        f"register: the name {name!r} is taken by {other.__module__}.{other.__qualname__}; choose another.",
    )
    names = {f.name for f in fields(cls)}
    for key, (hint, _) in parameters_of(cls).items():
        what = f"register: {name}'s argument {key!r}"
        require(key in names, f"{what} is not a field of {name}, from which a file would take its value: make it one.")
        require(_can_be_held(hint), f"{what} is annotated as {hint!r}, which files cannot hold (see its docstring).")
    _registered[name] = cls
    return cls


@cache
def saved_classes() -> tuple[type, ...]:
    """The package's own classes that files can hold: those public ones of which scenes and integrators are made."""
    reached: dict[type, None] = {}
    hints: list[Any] = [Scene, AbstractIntegrator]
    while hints:
        new = [c for c in choices(hints.pop()).values() if isinstance(c, type) and is_own(c) and c not in reached]
        reached |= dict.fromkeys(new)
        hints += [hint for c in new for hint in _field_types(c).values()]
    return tuple(reached)


def _mesh(file: str, spacing: Scalar, scale: Scalar = 1.0) -> SampledDistance:
    return sample_mesh(file, float(spacing), scale=float(scale))


MADE: dict[str, tuple[Callable[..., Any], type]] = {"Mesh": (_mesh, SampledDistance)}
"""Kinds that scene files may name beside classes: functions, and what they make, which a run's file then holds."""


def known_classes() -> tuple[type, ...]:
    """The classes that files can hold, the registered ones among them, but for those of `equinox.nn`."""
    return (*saved_classes(), *_registered.values())


def are_registered() -> bool:
    """Whether there are classes that files can hold beside the package's."""
    return len(_registered) > 0


def classes_for(options: Iterable[Any]) -> list[type]:
    """The classes of an annotation's members that files can hold; of bases that no scene has, all public ones."""
    taken = tuple(a for a in options if is_class(a, eqx.Module))
    held = [c for c in known_classes() if issubclass(c, taken)]
    others = [c for a in taken if is_abstract(a) for c in choices(a).values() if is_own(c)]
    return sorted(held or others, key=lambda c: c.__name__)


def is_open(options: Iterable[Any]) -> bool:
    """Whether an annotation's members are open to classes that are registered."""
    return any(map(is_abstract, options))


def evident_kinds(options: Iterable[Any]) -> list[str]:
    """The class of an annotation's members that a file need not name: the one that is named by itself beside base
    classes, or the package's only one; several if none is evident."""
    plain = [a.__name__ for a in options if is_class(a, eqx.Module) and not is_abstract(a)]
    return plain if len(plain) == 1 else [c.__name__ for c in classes_for(options) if is_own(c)]


def _can_be_held(hint: Any) -> bool:
    def can(a: Any) -> bool:
        if is_class(a, eqx.Module):  # a class of one's own is made of its fields
            return is_abstract(a) or _is_network(a) or set(parameters_of(a)) <= {f.name for f in fields(a)}
        items = [a for a in get_args(a) if a is not Ellipsis] if get_origin(a) in (tuple, list) else []
        return is_class(a, enum.Enum) or _is_callable(a) or any(map(_can_be_held, items))

    return bool(forms_of(hint)) or any(can(a) for a in alternatives(hint))


_FUNCTIONS: dict[str, Callable] = {
    f"{module.__name__}.{name}": f
    for module, attribute in ((jax.nn, "__call__"), (jnp, "lower"))  # what is compiled reads and writes no files
    for name, f in vars(module).items()
    if name[0] != "_" and hasattr(f, attribute)
}
"""Functions that files name, such as the activation of a network."""


def _is_network(cls: type) -> bool:
    """Whether a class is one of `equinox.nn`. Files have its fields: its constructor takes sizes and a key."""
    return getattr(eqx.nn, cls.__name__, None) is cls


def _is_callable(hint: Any) -> bool:
    return Callable in (hint, get_origin(hint))


_SMALL = 64  # most numbers that are written out, and that are read as a tuple where both are taken
_MOST_AXES = 3  # of what is annotated as an array and nothing more


def encode(value: Any, arrays: dict[str, np.ndarray] | None = None, path: str = "") -> Any:
    """An object at a dotted path as plain data: dict, list, float, int, bool and str. `arrays` takes those of more
    than 64 numbers, each under its path; {"array": path} stands in their place. A ValueError names a class that is
    neither the package's own nor registered."""
    match value:
        case _ if type(value) in known_classes():
            parts = {name: getattr(value, name) for name in parameters_of(type(value))}
            keys = {k: encode(v, arrays, f"{path}.{k}".lstrip(".")) for k, v in parts.items() if v is not None}
            return {"kind": type(value).__name__, **keys}
        case _ if _is_network(type(value)):
            return _network_data(value, arrays, path)
        case _ if name := next((name for name, f in _FUNCTIONS.items() if f is value), None):
            return {"function": name}
        case enum.Enum():
            return value.value
        case bool() | int() | float() | str() if not isinstance(value, np.generic):
            return value
        case tuple() | list():
            return [encode(v, arrays, f"{path}.{i}") for i, v in enumerate(value)]
        case np.ndarray() | np.generic() | jax.Array():
            a = np.asarray(value)
            if arrays is None or a.size <= _SMALL:
                return a.tolist()
            arrays[path] = a
            return {"array": path}
        case _:
            raise ValueError(
                f"{path or 'The object'} is a {type(value).__name__}, which files cannot hold: they know the package's "
                "own classes, those of equinox.nn, those that are registered, and functions of jax.nn and jax.numpy. "
                "Put @mpm.register before the class."
            )


def decode(data: Any, expected: Any, where: str = "", arrays: dict[str, np.ndarray] | None = None) -> Any:
    """The object that plain data describe, those of `encode` or a table of a TOML file. `expected` is the class,
    abstract class, union or annotation of numbers that it must be of, `where` the place in the file that errors
    name, such as "[material]", `arrays` what `encode` put aside. A ValueError says in one line what is unknown,
    missing or unfit, or what the constructor refuses."""
    options: list[Any] = alternatives(expected)
    if any(map(_is_callable, options)) and isinstance(data, dict):
        if "kind" not in data:
            name = str(data.get("function"))
            require_in(where, name in _FUNCTIONS, f"must be a function of jax.nn or jax.numpy, got {short(name)}")
            return _FUNCTIONS[name]
        options = [eqx.Module]
    if isinstance(data, dict) and str(data.get("kind")).startswith("equinox.nn."):
        return _network(data, options, where, arrays)
    fitting = classes_for(options)
    classes: dict[str, Callable[..., Any]] = {c.__name__: c for c in fitting}
    if arrays is None:  # a file that a person writes
        classes |= {name: make for name, (make, cls) in MADE.items() if cls.__name__ in classes}
    items = [get_args(a)[0] for a in options if get_origin(a) in (tuple, list)]
    if items and isinstance(data, list) and (classes or not forms_of(expected)):  # of objects, or of arrays
        return tuple(decode(d, items[0], place_in_list(where, i), arrays) for i, d in enumerate(data, 1))
    named = [get_args(a)[1] for a in options if get_origin(a) is dict]
    if named and are_named(data):  # of objects
        return {name: decode(d, named[0], place_of(name, d, where), arrays) for name, d in data.items()}
    number = isinstance(data, (int, float)) and not isinstance(data, bool) and (float, 0) in forms_of(expected)
    if any(is_class(a, eqx.Module) for a in options) and not number:
        opened = is_open(options)
        require_in(where, classes or opened, "takes an object of Python, which files cannot hold: leave it out")
        kind, table = kind_in(data, classes, evident_kinds(options), where, opened=opened)
        keywords = arguments(classes[kind], table, where, arrays)
        try:
            return classes[kind](**keywords)
        except ValueError as error:
            raise ValueError(f"{where}: {error}" if where else str(error)) from None
    if enums := [a for a in options if is_class(a, enum.Enum)]:
        words = [member.value for member in enums[0]]
        require_in(where, data in words, f"must be one of {', '.join(map(repr, words))}, got {short(data)}")
        return enums[0](data)
    return _numbers(data, expected, where, arrays)


def _network_data(network: Any, arrays: dict[str, np.ndarray] | None, path: str) -> dict[str, Any]:
    """The fields of a module of `equinox.nn`. Their annotations do not say what is a tuple and what an array, so all
    arrays stand beside. Functions that it has by default are left out: those may have no name."""

    def part(value: Any, path: str) -> Any:
        if value is None:
            return None
        if isinstance(value, (tuple, list)):
            return [part(v, f"{path}.{i}") for i, v in enumerate(value)]
        if not isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return encode(value, arrays, path)
        if arrays is None:
            raise ValueError(f"{path} is a network's: only a run's file holds its weights.")
        arrays[path] = np.asarray(value)
        return {"array": path}

    kind, usual = type(network), _usual_functions(type(network))
    parts = {f.name: getattr(network, f.name) for f in fields(kind)}
    keys = {name: part(v, f"{path}.{name}") for name, v in parts.items() if not (name in usual and v is usual[name])}
    return {"kind": f"equinox.nn.{kind.__name__}", **keys}


def _network(data: dict[str, Any], options: list[Any], where: str, arrays: dict[str, np.ndarray] | None) -> Any:
    """The module of `equinox.nn` that `_network_data` describes, without its constructor, which draws weights."""

    def part(data: Any) -> Any:
        if isinstance(data, list):
            return tuple(map(part, data))
        if not isinstance(data, dict):
            return data
        if "array" not in data:
            return decode(data, Callable, where, arrays)
        require_in(where, data["array"] in (arrays or {}), f"has lost its array {data['array']!r}")
        return (arrays or {})[data["array"]]

    kind: Any = getattr(eqx.nn, data["kind"].removeprefix("equinox.nn."), None)
    fits = isinstance(kind, type) and any(is_class(a, eqx.Module) and issubclass(kind, a) for a in options)
    require_in(where, fits, f"cannot be the kind {short(data['kind'])}")
    parts = _usual_functions(kind) | {name: part(value) for name, value in data.items() if name != "kind"}
    same = {f.name for f in fields(kind)} == parts.keys()
    require_in(where, same, f"has other fields than a {kind.__name__} of this version of equinox")
    network = object.__new__(kind)
    for name, value in parts.items():
        object.__setattr__(network, name, value)
    return network


def _usual_functions(network: type) -> dict[str, Callable]:
    """The functions that a module has as fields by default."""
    defaults = {name: default for name, (_, default) in parameters_of(network).items()}
    names = {f.name for f in fields(network)}
    return {k: f for k, f in defaults.items() if k in names and callable(f) and f is not inspect.Parameter.empty}


def arguments(
    function: Callable, table: Any, where: str, arrays: dict[str, np.ndarray] | None = None, without: Iterable[str] = ()
) -> dict[str, Any]:
    """The keyword arguments of a function or class that a table describes (see `decode`), some left out."""
    require_in(where, isinstance(table, dict), f"must be a table, got {short(table)}")
    parameters = {name: p for name, p in parameters_of(function).items() if name not in without}
    needed = [name for name, (_, default) in parameters.items() if default is inspect.Parameter.empty]
    require_keys(table, parameters, where, needed)
    return {k: decode(v, parameters[k][0], place_of(k, v, where), arrays) for k, v in table.items()}


def _numbers(data: Any, expected: Any, where: str, arrays: dict[str, np.ndarray] | None) -> Any:
    """Numbers, words and switches, single or in (nested) lists."""
    forms, words = forms_of(expected), words_of(expected)
    must_be = f"must be {in_words(forms, words)}, got"
    if isinstance(data, dict) and set(data) == {"array"} and arrays is not None:
        require_in(where, data["array"] in arrays, f"refers to the array {data['array']!r}, which is not there")
        a = arrays[data["array"]]
        require_in(where, (float, a.ndim) in forms, f"{must_be} an array of shape {a.shape}")
        kinds = {float}
    else:
        a = np.array(data, dtype=object)  # where lists are ragged, an array of lists
        kinds = {kind for kind, depth in forms if depth == a.ndim and all(fits(leaf, kind) for leaf in a.flat)}
        require_in(where, kinds - {str} if words and data not in words else kinds, f"{must_be} {short(data)}")
    if float in kinds:
        try:
            a = a if a.dtype.kind == "f" else a.astype(float)
            bad = np.isnan(a) if MAY_BE_INFINITE in marks_of(expected) else ~np.isfinite(a)
        except OverflowError:  # a whole number that no float holds
            bad = np.True_
        require_in(where, not bad.any(), f"must be finite, got {short(data)}")
    takes_tuples = any(tuple in (option, get_origin(option)) for option in alternatives(expected))
    if a.ndim and not (isinstance(data, list) and takes_tuples and a.size <= _SMALL):
        return a if float in kinds else np.array(data)
    return _plain(a.tolist())


def _plain(data: Any) -> Any:
    return tuple(map(_plain, data)) if isinstance(data, list) else data


def parameters_of(function: Callable) -> dict[str, tuple[Any, Any]]:
    """Annotation and default of each argument of a function or constructor. Where a field has a converter, equinox says
    `Any` of the argument, and the field itself says more."""
    of_class = isinstance(function, type)
    signature = inspect.signature(function.__init__ if of_class else function)
    types = _field_types(function) if of_class else {}
    return {
        p.name: (
            types.get(p.name, Any) if p.annotation is Any or isinstance(p.annotation, str) else p.annotation,
            p.default,
        )
        for p in signature.parameters.values()
        if p.name != "self"
    }


def _field_types(cls: type) -> dict[str, Any]:
    """The annotation of each field; where a module postpones them, they are read now."""
    types = {f.name: f.type for f in fields(cls)}
    return typing.get_type_hints(cls, include_extras=True) if any(isinstance(t, str) for t in types.values()) else types


def forms_of(hint: Any, *, within: bool = False) -> set[tuple[type, int]]:
    """Kind of number and depth of lists that an annotation takes, `within` that of a sequence."""
    forms: set[tuple[type, int]] = set()
    if not within and any(a in (jax.Array, np.ndarray) for a in alternatives(hint)):
        forms |= {(float, depth) for depth in range(_MOST_AXES + 1)}
    for a in alternatives(hint):
        if a in ONE:
            forms.add((a, 0))
        elif get_origin(a) is Literal:
            forms.add((str, 0))
        elif get_origin(a) in (tuple, list):
            forms |= {(kind, depth + 1) for kind, depth in forms_of(get_args(a)[0], within=True)}
        elif is_class(a, AbstractArray):
            axes = a.dim_str.split()
            forms |= {(float, len(axes)), (float, len([axis for axis in axes if not axis.startswith("*")]))}
    return forms


def words_of(hint: Any) -> list[str]:
    """The words that an annotation takes, if it takes some only."""
    return [word for a in alternatives(hint) if get_origin(a) is Literal for word in get_args(a)]
