"""Imports run one way, files stay small, and importing the package does nothing else."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "mpmjax"
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}

# Each layer may import from itself and from those before it; what is not listed is a leaf, on top of them all.
LAYERS = (
    ("_types", "_checks", "_constraint", "_rule", "_guard", "_kinds", "_memory"),
    ("_grid", "_region", "_motion"),
    ("_kernel",),
    ("_crossing", "_sampled"),
    ("_transfer",),
    ("_linalg",),
    ("_isotropic",),
    ("material",),
    ("_boundary", "_body_force"),
    ("_mirror", "_collider", "_exchange"),
    ("_particles", "_constituent", "_oversights", "_scene"),
    ("_metric", "_potential", "_hessian"),
    ("_conjugate_residual",),
    ("_nodes", "_guess", "_problems", "_newton", "_implicit", "_contact"),
    ("_method",),
    ("_step",),
    ("_stability",),
    ("_advice", "_diffrax", "_run", "_faults", "_simulate"),
)
LEAF = len(LAYERS)
CORE_MAY_NOT_KNOW = {"diffrax", "h5py", "matplotlib", "optax", "optimistix", "time", "datetime", "tqdm", "typer"}


def noun(name: str) -> str:
    """The noun of a file or of a dotted module name below `mpmjax`: its first part."""
    return name.replace("/", ".").removesuffix(".py").split(".")[0]


def imported(path: Path) -> set[str]:
    """The modules that a file imports, also inside functions; `from mpmjax import _a` counts as `mpmjax._a`."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            whole = node.module != "mpmjax"
            names |= {node.module} if whole else {f"mpmjax.{alias.name}" for alias in node.names}
    return names


def own(path: Path) -> set[str]:
    """The nouns of this package that a file imports."""
    return {noun(name.removeprefix("mpmjax.")) for name in imported(path) if name.split(".")[0] == "mpmjax"}


GRAPH = {name: own(path) for name, path in FILES.items() if name != "__init__.py"}
BY_NOUN: dict[str, set[str]] = {}
for _name, _targets in GRAPH.items():
    BY_NOUN.setdefault(noun(_name), set()).update(_targets - {noun(_name)})


def rank(name: str) -> int:
    return next((i for i, layer in enumerate(LAYERS) if name in layer), LEAF)


def reachable(name: str) -> set[str]:
    """A noun and all it imports, directly or not."""
    seen, todo = set(), [name]
    while todo:
        current = todo.pop()
        if current not in seen:
            seen.add(current)
            todo += BY_NOUN[current]
    return seen


def test_the_layers_are_files():
    """Every noun of the table exists, and every import within the package is of one that does."""
    assert {name for layer in LAYERS for name in layer} <= BY_NOUN.keys()
    assert set().union(*BY_NOUN.values()) <= BY_NOUN.keys()


@pytest.mark.parametrize("name", FILES)
def test_imports_run_one_way(name):
    """No file imports from a later layer; leaves are imported by leaves alone."""
    later = {target for target in GRAPH.get(name, set()) if rank(target) > rank(noun(name))}
    assert not later, f"{name} imports {later}, which stand above it"


@pytest.mark.parametrize("name", sorted(BY_NOUN))
def test_no_noun_imports_itself_through_others(name):
    """There is no cycle."""
    assert all(name not in reachable(target) for target in BY_NOUN[name])


def test_the_step_knows_no_driver_no_file_no_clock_no_screen():
    """`_step.py` and all it imports know neither diffrax nor optax, h5py, tqdm, matplotlib, time."""
    core = reachable("_step")
    assert {"_kernel", "_transfer", "_hessian", "material"} <= core
    for name, path in FILES.items():
        if noun(name) in core:
            known = {module.split(".")[0] for module in imported(path)} & CORE_MAY_NOT_KNOW
            assert not known, f"{name} imports {known}"


@pytest.mark.parametrize("name", FILES)
def test_files_are_small(name):
    """One noun a file, of at most 420 lines."""
    assert len(FILES[name].read_text().splitlines()) <= 420


def test_importing_changes_no_configuration_and_computes_nothing():
    """In a fresh interpreter: jax's configuration is as before, and no device has been started."""
    script = """
import jax, equinox, lineax, diffrax, h5py
from jax._src import xla_bridge
before = dict(jax.config.values)
assert not xla_bridge.backends_are_initialized(), "a dependency starts a device"
import mpmjax
changed = {k: v for k, v in jax.config.values.items() if before.get(k) != v}
assert not changed, f"mpmjax changes {changed}"
assert not xla_bridge.backends_are_initialized(), "mpmjax runs a computation"
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=PACKAGE.parent)
    assert done.returncode == 0, done.stderr
