"""Every public name says what it is, in plain words; an override may leave that to what it overrides."""

import ast
import importlib
import inspect
import itertools
import pkgutil
import re
import textwrap
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


def explained(cls):
    """The fields that the class explains: in its docstring, in one of their own, or by a comment behind them."""
    source = textwrap.dedent(inspect.getsource(cls))
    body = ast.parse(source).body[0].body
    told = {
        a.target.id for a in body if isinstance(a, ast.AnnAssign) and "  # " in source.splitlines()[a.end_lineno - 1]
    }
    for field, after in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
            told.add(field.target.id)
    for names in re.findall(r"^ +(\w+(?:, \w+)*)(?: \(.*?\))?:", cls.__doc__ or "", re.MULTILINE):
        told |= set(names.split(", "))
    return told


@pytest.mark.parametrize("name", [name for name in MODULES if name.count(".") == 1])
def test_every_field_of_a_public_class_is_explained(name):
    """By the class or by one that it derives from."""
    for cls in vars(importlib.import_module(name)).values():
        if inspect.isclass(cls) and cls.__module__.startswith(name):
            whole = [base for base in cls.__mro__ if base.__module__.startswith("mpmjax")]
            fields = getattr(cls, "_fields", ()) or getattr(cls, "__dataclass_fields__", ())
            assert not {f for f in fields if f[0] != "_"} - set().union(*map(explained, whole)), cls


def test_help_explains_what_a_run_holds():
    """Comments are for the pages and the source; `help(mpm.Run)` shows the docstring."""
    fields = mpmjax.Run.__dataclass_fields__
    assert not {f for f in fields if f"\n        {f}: " not in mpmjax.Run.__doc__}


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


def test_signatures_are_words():
    """Help on what is public shows no object by its address in memory."""
    for name in dir(mpmjax):
        value = getattr(mpmjax, name)
        if inspect.isclass(value) or inspect.isfunction(value):
            assert " at 0x" not in str(inspect.signature(value)), name
