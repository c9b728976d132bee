"""The benchmarks stay in step with the package: what they import exists, and each says what it does."""

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "benchmarks").glob("*.py"))
LOCAL = {"mpmjax"} | {path.stem for path in (ROOT / "tests").rglob("*.py")}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_what_a_benchmark_imports_exists(script, monkeypatch):
    """Of the package and of the tests, inside functions too."""
    monkeypatch.syspath_prepend(ROOT / "tests" / "validation")
    tree = ast.parse(script.read_text(encoding="utf-8"))
    assert ast.get_docstring(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in LOCAL:
            module = importlib.import_module(node.module)
            missing = {alias.name for alias in node.names if not hasattr(module, alias.name)}
            assert not missing, f"{node.module} has no {missing}"
