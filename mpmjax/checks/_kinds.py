"""The kind that a value must be of, by its annotation: a number, an array with so many axes, an object of a class.

`require_fields` checks a module's fields, `checked` a function's arguments, so that what is wrong is said where it is
given, with what is known there. Numbers may be Python's, NumPy's or JAX's, traced ones too.
"""

import difflib
import enum
import inspect
import os
import sys
import typing
from collections.abc import Callable
from dataclasses import fields
from functools import cache, wraps
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import AbstractArray

from mpmjax.checks._values import InputError, shortened

Function = TypeVar("Function", bound=Callable)

_LARGEST = 2**63  # arrays hold no whole number beyond
_WORDS: dict[Any, str] = {
    float: "a number",
    np.floating: "a number",
    np.integer: "a number",
    jax.Array: "a number",
    int: "a whole number",
    bool: "True or False",
    str: "a string",
    os.PathLike: "a path",
    None: "None",
    NoneType: "None",
    tuple: "rows of numbers",
    list: "rows of numbers",
}


def checked(function: Function) -> Function:
    """Decorate a public function to check the kinds and marks of its arguments (see `require_fields`; else a
    ValueError), and to allow broadcasting of different ranks, whatever `jax_numpy_rank_promotion` says outside."""
    signature = inspect.signature(function)
    hints = {p.name: p.annotation for p in signature.parameters.values() if p.annotation is not p.empty}
    owner = function.__qualname__.removesuffix(".__init__")

    @wraps(function)
    def guarded(*args: Any, **kwargs: Any) -> Any:
        try:
            arguments = signature.bind(*args, **kwargs).arguments
        except TypeError as error:  # which names no function
            raise TypeError(f"{owner} takes {', '.join(signature.parameters)}: {error}.") from None
        for name, argument in arguments.items():
            several = signature.parameters[name].kind is inspect.Parameter.VAR_POSITIONAL
            for value in argument if several else (argument,) if name in hints else ():
                require_kind(f"{owner}'s {name}", value, hints[name])
                require_marks(f"{owner}'s {name}", value, marks_of(hints[name]))
        with jax.numpy_rank_promotion("allow"):
            return function(*args, **kwargs)

    return cast(Function, guarded)


def require_fields(module: eqx.Module) -> None:
    """Check that every field of a module is of the kind that its annotation names, can fix a program if it is static,
    and has the values that marks ask for. They are functions of a name and a value that raise `ValueError`s, and a unit
    for the name: `Annotated[PerParticle, positive, "Pa"]`. None and words have no values."""
    for name, hint, static, marks in _hints(type(module)):
        value, what = getattr(module, name), f"{type(module).__name__}'s {name}"
        require_kind(what, value, hint)
        try:
            hash(value if static else None)
        except TypeError:
            shown = shortened(repr(value))
            raise InputError(f"{what} fixes a program: give a known number or a tuple, got {shown}.") from None
        require_marks(what, value, marks)


@cache
def _hints(module: type) -> tuple[tuple[str, Any, bool, list[Any]], ...]:
    return tuple((f.name, f.type, f.metadata.get("static", False), marks_of(f.type)) for f in fields(module))


def require_kind(name: str, value: Any, hint: Any) -> None:
    """Raise a `ValueError` with the kinds that an annotation names if a value is of none, and what may be meant."""
    if not _takes(hint, value):
        shown = f"the class {value.__name__}" if isinstance(value, type) else shortened(repr(value))
        raise InputError(f"{name} must be {_in_words(hint)}, got {shown}{_meant(hint, value)}")


def require_marks(name: str, value: Any, marks: list[Any]) -> None:
    """Call the functions among an annotation's marks on a value but None and words, its name with the unit of these."""
    name += "".join(f" [{unit}]" for unit in marks if isinstance(unit, str))
    for check in (mark for mark in marks if callable(mark) and not isinstance(value, (str, NoneType))):
        check(name, value)


def alternatives(hint: Any) -> list[Any]:
    """The members of a union; of any other annotation, the annotation alone. Marks and aliases' names are left out."""
    hint = getattr(hint, "__value__", hint)
    if get_origin(hint) is Annotated:
        return alternatives(get_args(hint)[0])
    if get_origin(hint) in (typing.Union, UnionType):
        return [a for member in get_args(hint) for a in alternatives(member)]
    return [hint]


def marks_of(hint: Any) -> list[Any]:
    """The marks of an annotation (see `Annotated`), and those of the members of its union."""
    hint = getattr(hint, "__value__", hint)
    if get_origin(hint) is Annotated:
        inner, *marks = get_args(hint)
        return [*marks_of(inner), *marks]
    return [m for a in get_args(hint) for m in marks_of(a)] if get_origin(hint) in (typing.Union, UnionType) else []


def is_class(hint: Any, base: type) -> bool:
    """Whether an annotation is a class of a base, such as `eqx.Module`."""
    return isinstance(hint, type) and issubclass(hint, base)


def is_abstract(hint: Any) -> bool:
    """Whether an annotation is a base class of modules, by its methods or, if all have defaults, by its name."""
    return is_class(hint, eqx.Module) and (inspect.isabstract(hint) or hint.__name__.startswith("Abstract"))


def shape_of(value: Any) -> Any:
    """The shape of a number, an array or nested sequences of numbers; None if it is none of these, or ragged."""
    if isinstance(value, np.ma.MaskedArray):  # NumPy drops the mask wherever it converts one
        return None
    if isinstance(value, (np.ndarray, np.generic, jax.Array)):
        real = jnp.issubdtype(value.dtype, jnp.integer) or jnp.issubdtype(value.dtype, jnp.floating)
        return np.shape(value) if real else None
    if isinstance(value, (tuple, list)):
        shapes = {shape_of(v) for v in value}
        inner = shapes.pop() if shapes else ()
        return None if shapes or inner is None else (len(value), *inner)
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return () if number and (isinstance(value, float) or abs(value) < _LARGEST) else None


def _takes(hint: Any, value: Any) -> bool:
    """Whether a value is of a kind that an annotation names; True if that cannot be told."""
    hint = getattr(hint, "__value__", hint)
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _takes(args[0], value)
    if origin in (typing.Union, UnionType):
        return any(_takes(a, value) for a in args)
    if origin in (tuple, list):
        array = isinstance(value, np.ndarray) and value.ndim == 1 and not isinstance(value, np.ma.MaskedArray)
        sequence = array or isinstance(value, (tuple, list))
        wanted = args[:1] * len(value) if sequence and (origin is list or Ellipsis in args) else args
        return sequence and len(value) == len(wanted) and all(_takes(a, v) for a, v in zip(wanted, value, strict=True))
    if origin is dict:
        return isinstance(value, dict) and all(_takes(args[0], k) and _takes(args[1], v) for k, v in value.items())
    if origin is Literal:
        return isinstance(value, str) and value in args
    if origin is Callable:
        return callable(value)
    if not isinstance(hint, type) or hint in (Any, type, object):
        return hint is not None or value is None
    if issubclass(hint, AbstractArray):
        shape, (least, more) = None if isinstance(value, (tuple, list)) else shape_of(value), _axes(hint)
        return shape is not None and (len(shape) == least or (more and len(shape) > least))
    if hint in (tuple, list):  # of numbers, however nested
        return isinstance(value, (tuple, list)) and shape_of(value) is not None
    if hint in (float, jax.Array):
        return shape_of(value) == ()
    if hint is bool:
        return isinstance(value, (bool, np.bool_))
    if hint is int:
        return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and abs(int(value)) < _LARGEST
    return isinstance(value, hint)


def _axes(hint: type[AbstractArray]) -> tuple[int, bool]:
    """How many axes an array of jaxtyping's has, and whether it may have more."""
    named = [axis for axis in hint.dim_str.split() if axis != "..." and not axis.startswith("*")]
    return len(named), len(named) < len(hint.dim_str.split())


def choices(hint: Any) -> dict[str, Any]:
    """The public classes of objects that an annotation takes, of a base class those below it in alphabetical order, a
    user's own among them, and the members of its enumerations, by their names."""

    def below(kind: type) -> dict[str, Any]:
        if is_abstract(kind):
            return {name: c for sub in kind.__subclasses__() for name, c in below(sub).items()}
        room = ".".join(kind.__module__.split(".")[:2])
        internal = is_own(kind) and not hasattr(sys.modules[room], kind.__name__)
        return {} if internal else {kind.__name__: kind}

    names: dict[str, Any] = {}
    for a in alternatives(hint):
        if get_origin(a) in (tuple, list):
            names |= {name: c for item in get_args(a) for name, c in choices(item).items()}
        elif is_class(a, enum.Enum):
            names |= {str(member): member for member in a}
        elif is_class(a, eqx.Module):
            names |= dict(sorted(below(a).items()))
    return names


def is_own(kind: type) -> bool:
    """Whether a class is the package's own. Problems of `mpmjax.verification`, which only a user imports, are not."""
    package, _, place = kind.__module__.partition(".")
    return package == "mpmjax" and not place.startswith("verification")


def _in_words(hint: Any) -> str:
    """The kinds that an annotation takes, in words: classes by their names, then numbers and the rest."""
    names = list(choices(hint))
    words = [f"one of {', '.join(names)}" if len(names) > 1 else names[0]] if names else []
    for a in alternatives(hint):
        if get_origin(a) in (tuple, list) and choices(a):
            words.append("several of them")
        elif not choices(a):
            words.append(_plain(a))
    *most, last = [w for w in dict.fromkeys(words) if not (w == _WORDS[int] and _WORDS[float] in words)]
    return f"{', '.join(most)} or {last}" if most else last


def _plain(hint: Any) -> str:
    """The kind that an annotation of numbers, strings or other plain values takes, in words."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(repr(word) for word in args)
    if origin in (tuple, list):
        inner = [a for item in args for a in alternatives(item)]
        return f"a sequence of {'whole numbers' if inner[0] is int else 'bools' if inner[0] is bool else 'numbers'}"
    if origin is Callable:
        return "a function"
    if origin is dict:
        return f"a dict with {_in_words(args[1])} for each name"
    if is_class(hint, AbstractArray):
        axes, more = _axes(hint)
        return "an array of numbers" if more else ("a number", "a sequence of numbers", "rows of numbers")[min(axes, 2)]
    return _WORDS.get(hint, f"of a class derived from {getattr(hint, '__name__', hint)}")


def _meant(hint: Any, value: Any) -> str:
    """The end of a message that names the object which was probably meant."""
    word = value.__name__ if isinstance(value, type) else value[:60] if isinstance(value, str) else ""
    options = {name.rsplit(".", 1)[-1].lower(): (name, kind) for name, kind in choices(hint).items()}
    key = word.replace(" ", "").replace("_", "").lower()
    inside = [k for k in options if len(key) > 2 and (key in k or k in key)]
    close = inside if len(inside) == 1 else difflib.get_close_matches(key, options, 1)
    if not close:
        return "."
    name, kind = options[close[0]]
    if not isinstance(kind, type):
        return f", did you mean {name}?"
    parameters = list(inspect.signature(kind.__init__).parameters.values())[1:]
    return f", did you mean {name}({'...' if any(p.default is p.empty for p in parameters) else ''})?"
