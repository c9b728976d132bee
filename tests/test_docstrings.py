"""Every public class, function and method says what it is; an override may leave that to what it overrides."""

import importlib
import inspect
import pkgutil

import pytest

import mpmjax

MODULES = [module.name for module in pkgutil.walk_packages(mpmjax.__path__, "mpmjax.") if "__main__" not in module.name]


def undocumented(module):
    """The dotted names of a module's public classes, functions and methods that nothing documents."""
    for name, value in vars(module).items():
        if name.startswith("_") or getattr(value, "__module__", None) != module.__name__:
            continue
        if (inspect.isclass(value) or inspect.isfunction(value)) and not value.__doc__:
            yield name
        if inspect.isclass(value):
            for method, function in vars(value).items():
                public = not method.startswith("_") and isinstance(function, (property, classmethod, staticmethod))
                public = public or (not method.startswith("_") and inspect.isfunction(function))
                if public and not any(getattr(vars(base).get(method), "__doc__", None) for base in value.__mro__):
                    yield f"{name}.{method}"


@pytest.mark.parametrize("name", MODULES)
def test_every_public_name_says_what_it_is(name):
    """In its own docstring or, of a method that overrides another, in that of a base class."""
    assert not list(undocumented(importlib.import_module(name)))
