"""Checks of shapes and types at every call, by the annotations of the package."""

from collections.abc import Callable
from typing import Any

from beartype import beartype

_checks: dict[Any, Callable] = {}


def checked(stub: Callable) -> Callable:
    """Add beartype's checks to an empty function that has the signature of one of the package's.

    Functions within functions are defined anew at each call, some thousands of times in a file of tests, and compiling
    their checks took a fifteenth of its time. Checks depend on nothing but the signature, so they are compiled once.
    """
    code = stub.__code__
    names = (stub.__module__, stub.__qualname__, code.co_varnames, code.co_flags)
    defaults = (len(stub.__defaults__ or ()), *(stub.__kwdefaults__ or ()))
    key = (names, code.co_argcount, code.co_posonlyargcount, defaults, *stub.__annotations__.items())
    if key not in _checks:
        _checks[key] = beartype(stub)
    return _checks[key]
