"""A differentiable Material Point Method in JAX, with explicit and implicit grid updates.

What a first scene and a first fit need is here. Solvers and preconditioners are in `mpm.implicit`, the rarer shapes in
`mpm.geometry`, quantities, priors and strategies of fits in `mpm.fitting`, small matrices for laws in `mpm.linalg`;
docs/features.md lists every name.
"""

import ast as _ast
import sys as _sys
from importlib import import_module as _import_module
from pathlib import Path as _Path

__version__ = "0.1.0"

_HOMES = {
    alias.name: f"{__name__}.{alias.name}" if node.module == __name__ else str(node.module)
    for node in _ast.parse(_Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, _ast.ImportFrom)
    for alias in node.names
}
"""The module that each name is of, or is, by the imports of `__init__.pyi`. It loads when the name is first used."""


def __getattr__(name: str):
    if name not in _HOMES:
        # read, not imported: whoever asks whether there is a name does not load JAX
        rooms = {r: _Path(__file__).with_name(r) for r, home in _HOMES.items() if home == f"{__name__}.{r}"}
        homes = [r for r, at in rooms.items() if f" {name} as {name}" in (at / "__init__.py").read_text("utf-8")]
        there = "".join(f"; mpm.{room}.{name} is one" for room in homes)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}{there}")
    module = _import_module(_HOMES[name])
    globals()[name] = module if module.__name__ == f"{__name__}.{name}" else getattr(module, name)
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})


if {"IPython", "marimo"} & _sys.modules.keys():  # notebooks show scenes, runs and fits by what this adds to them
    _import_module(f"{__name__}.viz")
