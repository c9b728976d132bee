"""Every public name says what it is, in plain words; an override may leave that to what it overrides."""

import ast
import importlib
import inspect
import pkgutil
import re
from pathlib import Path

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


PACKAGE = Path(mpmjax.__file__).parent
FILES = {path.relative_to(PACKAGE).as_posix(): ast.parse(path.read_text()) for path in sorted(PACKAGE.rglob("*.py"))}
NAMELESS = {"found", "own", "known", "given", "said"}
"""Names that say how a value came about, and not what it is."""


@pytest.mark.parametrize("name", FILES)
def test_docstrings_start_with_their_subject(name):
    """And not with a pronoun or a relative clause."""
    documented = (node for node in ast.walk(FILES[name]) if isinstance(getattr(node, "body", None), list))
    statements = (statement for node in documented for statement in node.body)  # attributes' docstrings too
    texts = (s.value.value for s in statements if isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
    openings = re.compile(r"\s*(What|That|Those|Of|Its|The same|And)\b")
    left = [text for text in texts if isinstance(text, str) and openings.match(text)]
    assert not left


@pytest.mark.parametrize("name", FILES)
def test_variables_are_named_for_what_they_are(name):
    """No variable, argument or field is called found, own, known, given or said."""
    nodes = list(ast.walk(FILES[name]))
    bound = {node.id for node in nodes if isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load)}
    assert not (bound | {node.arg for node in nodes if isinstance(node, ast.arg)}) & NAMELESS
