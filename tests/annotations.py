"""Checks of shapes and types at every call, by the annotations of the package."""

import functools
import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import jaxtyping
from beartype import beartype
from jaxtyping import install_import_hook, jaxtyped

__name__ = "jaxtyping.tests"  # the package warns of the line that called it, and passes over frames of jaxtyping


def checked(function: Callable) -> Callable:
    """A function with checks of its arguments and its result, in one call of beartype. Jaxtyping's decorator makes two,
    to say more of what was wrong: a twentieth of the tests' time."""
    checks = beartype(function)

    @functools.wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        with jaxtyped("context"):
            return checks(*args, **kwargs)

    return called


def checks_of_imports(package: str) -> AbstractContextManager[Any]:
    """A context in which modules of a package are imported with checks of their functions and classes. Functions within
    functions have none: they are defined at each call, and to compile their checks each time took another twentieth."""

    def decorator(*, typechecker: Any) -> Callable:
        def decorated(defined: Any) -> Any:
            if not inspect.isclass(defined):
                return defined if "<locals>" in defined.__qualname__ else checked(defined)
            written = hasattr(defined.__init__, "__wrapped__")  # and so has checks
            return defined if written else jaxtyped(defined, typechecker=typechecker)

        return decorated

    jaxtyping.jaxtyped = decorator  # which modules that the hook has changed call, when they define something
    return install_import_hook(package, "beartype.beartype")
