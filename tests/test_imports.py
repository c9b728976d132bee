"""Imports run one way, files stay small, and importing the package does nothing else."""

import ast
import re
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import mpmjax as mpm

PACKAGE = Path(__file__).parents[1] / "mpmjax"
MAP = PACKAGE.parent / "CONTRIBUTING.md"
FILES = {path.relative_to(PACKAGE).as_posix(): path for path in sorted(PACKAGE.rglob("*.py"))}

# Each room may import from those before it.
ROOMS = (
    "checks",
    "native",
    "autodiff",
    "linalg",
    "material",
    "discretisation",
    "geometry",
    "potential",
    "boundary",
    "state",
    "implicit",
    "stepping",
    "extensions",
    "simulation",
    "analysis",
    "io",
    "fitting",
    "viz",
    "cli",
    "verification",
)
STEP = ROOMS[: ROOMS.index("stepping") + 1]
STEP_MAY_NOT_KNOW = {"diffrax", "h5py", "matplotlib", "optax", "optimistix", "time", "datetime", "tqdm", "typer"}
MODULES = {f"mpmjax.{name.removesuffix('.py').replace('/', '.')}" for name in FILES}
INSIDE = [name for name in FILES if "/" in name]


def imported(path: Path) -> set[str]:
    """The modules that a file imports, also inside functions; `from mpmjax import linalg` counts as `mpmjax.linalg`."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import"
            whole = node.module != "mpmjax"
            names |= {node.module} if whole else {f"mpmjax.{alias.name}" for alias in node.names}
    return names


def test_the_rooms_are_the_folders():
    """Every folder is one of `ROOMS`, and every room a folder."""
    assert {name.split("/")[0] for name in INSIDE} == set(ROOMS)
    assert set(FILES) - set(INSIDE) == {"__init__.py", "__main__.py", "_jax.py", "_tables.py", "_types.py"}


@pytest.mark.parametrize("name", INSIDE)
def test_imports_run_one_way(name):
    """A file imports from its own room's files, and from the face (`__init__.py`) of the rooms before it."""
    room = name.split("/")[0]
    above = {f"mpmjax.{name.removesuffix('.py')}" for name in set(FILES) - set(INSIDE) if name[1] != "_"}
    known = above | {f"mpmjax.{earlier}" for earlier in ROOMS[: ROOMS.index(room)]}
    own = {module for module in imported(FILES[name]) if module.split(".")[0] == "mpmjax"}
    beyond = {module for module in own - known if not module.startswith(f"mpmjax.{room}.")}
    assert not beyond


@pytest.mark.parametrize("name", sorted(FILES))
def test_names_beyond_the_stable_interface_of_jax_stand_in_one_file(name):
    """Releases of JAX remove and rename them: `_jax.py` lists them with the versions that they were tried on."""
    beyond = ("jax._src", "jax.core", "jax.experimental", "jax.extend", "jax.interpreters", "jax.lib")
    touched = {module for module in imported(FILES[name]) if module.startswith(beyond)}
    assert bool(touched) == (name == "_jax.py")


def test_no_file_imports_itself_through_others():
    """There is no cycle within a room; between rooms there is an order."""
    graph = {
        f"mpmjax.{name.removesuffix('.py').replace('/', '.')}": imported(path) & MODULES for name, path in FILES.items()
    }
    TopologicalSorter(graph).prepare()


@pytest.mark.parametrize("name", [name for name in INSIDE if name.split("/")[0] in STEP])
def test_the_step_knows_no_driver_no_file_no_clock_no_screen(name):
    """`stepping` and the rooms below it know neither diffrax nor h5py, matplotlib, tqdm, time."""
    assert not {module.split(".")[0] for module in imported(FILES[name])} & STEP_MAY_NOT_KNOW


def test_the_map_names_the_rooms():
    """CONTRIBUTING.md explains every room, in the order of their imports."""
    layout, _ = MAP.read_text(encoding="utf-8").split("\n## Rules\n")
    assert re.findall(r"^- `(\w+)/`", layout, flags=re.MULTILINE) == list(ROOMS)


def test_no_file_name_stands_twice():
    """The name of a file says in which room it is."""
    names = [name.split("/")[1] for name in INSIDE]
    assert not {name for name in names if names.count(name) > 1} - {"__init__.py"}


@pytest.mark.parametrize("name", FILES)
def test_files_are_small(name):
    """One noun a file, of at most 420 lines."""
    assert len(FILES[name].read_text().splitlines()) <= 420


def test_a_name_of_a_room_is_not_found_at_the_top_and_says_where_it_is():
    with pytest.raises(AttributeError, match=r"no attribute 'Union'; mpm\.geometry\.Union is one$"):
        mpm.Union  # noqa: B018
    with pytest.raises(AttributeError, match=r"no attribute 'Onion'$"):
        mpm.Onion  # noqa: B018
    code = "import mpmjax, sys; hasattr(mpmjax, 'Union'); sys.exit('jax' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_importing_changes_no_configuration_and_computes_nothing():
    """In a fresh interpreter: a room loads with the first name that is used of it, jax's configuration is as before,
    and no device has been started."""
    script = """
import sys
import mpmjax as mpm
assert not {"jax", "numpy"} & set(sys.modules), "the package loads before it is used"
import jax, equinox, lineax
from jax._src import xla_bridge
before = dict(jax.config.values)
assert not xla_bridge.backends_are_initialized(), "a dependency starts a device"
mpm.step, mpm.extensions
late = {"diffrax", "h5py", "matplotlib", "optax", "optimistix", "PIL", "scipy", "tqdm", "typer"}
assert not late & set(sys.modules), f"{late & set(sys.modules)} take long to import, and are for what uses them"
for name in dir(mpm):
    assert getattr(mpm, name) is getattr(mpm, name), name
late = {"h5py", "matplotlib", "typer", *(f"scipy.{part}" for part in "linalg ndimage sparse spatial special".split())}
assert not late & set(sys.modules), f"{late & set(sys.modules)} take long to import, and are for what uses them"
changed = {k: v for k, v in jax.config.values.items() if before.get(k) != v}
assert not changed, f"mpmjax changes {changed}"
assert not xla_bridge.backends_are_initialized(), "mpmjax runs a computation"
assert not hasattr(mpm, "fitt")
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=PACKAGE.parent)
    assert done.returncode == 0, done.stderr


def test_files_hold_the_classes_of_rooms_that_nobody_has_used():
    """In a fresh interpreter, where a scene file names one."""
    script = """
from mpmjax.io import known_classes
print(*(c.__name__ for c in known_classes()))
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert {"Active", "Rigid", "VolumePreconditioner"} <= set(done.stdout.split())
