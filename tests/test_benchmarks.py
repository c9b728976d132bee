"""Benchmarks and examples stay in step with the package: what they name of it exists, and each says what it does."""

import ast
import functools
import importlib
import re
from pathlib import Path

import pytest

import mpmjax as mpm

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(path for folder in ("benchmarks", "examples") for path in (ROOT / folder).rglob("*.py"))
LOCAL = {"mpmjax"} | {path.stem for path in (ROOT / "tests").rglob("*.py")}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_script_names_exists(script, monkeypatch):
    """Of the package and of the tests, inside functions too; of `mpm` down to the room's names."""
    monkeypatch.syspath_prepend(ROOT / "tests" / "validation")
    tree = ast.parse(script.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree) or "examples" in script.parts
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in LOCAL:
            module = importlib.import_module(node.module)
            missing = {alias.name for alias in node.names if not hasattr(module, alias.name)}
            assert not missing, f"{node.module} has no {missing}"
        elif isinstance(node, ast.Attribute) and re.fullmatch(r"mpm(\.\w+)+", name := ast.unparse(node)):
            functools.reduce(getattr, name.split(".")[1:3], mpm)
