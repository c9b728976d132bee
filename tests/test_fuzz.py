"""Scene files that nobody would write: each is read, or refused in one line and with exit code 2, and soon."""

import tomllib
from pathlib import Path
from unittest import mock

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import thorough
from mutations import spoilt, toml
from shell import refused
from test_cli import SCENE

import mpmjax as mpm
from mpmjax import _tables
from mpmjax.checks import _values
from mpmjax.cli._scene_file import read_scene_file
from mpmjax.io import _schema

EXAMPLES = Path(__file__).parents[1] / "examples"
SPOILT = [("jelly", range(40)), *thorough(("rubber", range(200, 220)))]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "seeds"), SPOILT, ids=["jelly", "rubber"])
def test_a_spoilt_scene_is_read_or_refused_in_one_line(name, seeds, tmp_path, monkeypatch):
    """Whatever its values have become; the shell says the same as `read_scene_file`, which refuses also without its
    first look at keys and kinds."""
    monkeypatch.setattr(_schema, "_registered", {})
    scene = tomllib.loads((EXAMPLES / f"{name}.toml").read_text(encoding="utf-8"))
    (tmp_path / "data").symlink_to(EXAMPLES / "data")
    path, told = tmp_path / "scene.toml", []
    for seed in seeds:
        path.write_text(toml(spoilt(scene, seed)))
        try:
            read_scene_file(path)
        except ValueError as error:
            told.append(str(error))
            with mock.patch.object(_tables, "_check_keys"), pytest.raises(ValueError):  # noqa: PT011
                read_scene_file(path)
            if len(told) % 4 == 0:
                assert refused("run", path, "-o", tmp_path / "run.h5") == f"mpmjax: {' '.join(told[-1].split())}"
    assert len(told) > len(seeds) / 2
    assert all("\n" not in line and len(line) < 700 for line in told)


HUGE = {
    "a grid": ("shape = [10, 14]", "shape = [100000, 100000]", "fewer than 2^31 nodes"),
    "a window of another world": ("origin = [-3, -3]", "origin = [2147483648, 0]", "origin must be of fewer than 2^31"),
    "millimetres": (
        "lower = [0.0, 0.1], upper = [0.3, 0.4]",
        "lower = [0.0, 100.0], upper = [300.0, 400.0]",
        "does not fit into the grid's window",
    ),
    "a fine grid": ("spacing = 0.1", "spacing = 1e-4", "does not fit into the grid's window"),
    "particles": ("density = 1e3", "density = 1e3\nparticles_per_cell = 10000000000000000", "A lattice of 9e+16 part"),
    "fewer than none": ("density = 1e3", "density = 1e3\nparticles_per_cell = -4", "got -4"),
    "rare frames": ("save_every = 2", f"save_every = {10**30}", "save_every must be a whole number"),
    "a long time": ("t1 = 0.06", "t1 = 1e308", "at most 2147483647 steps"),
    "a short step": ("dt = 1e-2", "dt = 1e-300", "at most 2147483647 steps"),
    "a far wall": ("upper = [0.6, inf]", f"upper = [0.6, {10**400}]", "upper must be finite"),
    "a number that no text holds": ("spacing = 0.1", f"spacing = 0x1{'0' * 9000}", "spacing must be finite|Exceeds"),
    "nested lists": ("gravity = [0.0, -9.81]", f"gravity = {'[' * 5000}{']' * 5000}", "nested too deeply"),
    "nested tables": (
        "lower = [0.0, 0.1], upper = [0.3, 0.4] }",
        "lower = [0.0, 0.1], upper = [0.3, 0.4] }\nx = " + "{ a = " * 5000 + "1" + " }" * 5000,
        "nested too deeply",
    ),
    "a long word": ('"SlipBox"', f'"{"x" * 10**6}"', "unknown kind 'xxx"),
}


@pytest.mark.parametrize(("old", "new", "says"), HUGE.values(), ids=HUGE)
def test_a_huge_number_gets_one_line(tmp_path, old, new, says):
    """Before anything is made of it."""
    assert old in SCENE
    (tmp_path / "huge.toml").write_text(SCENE.replace(old, new, 1))
    line = refused("run", tmp_path / "huge.toml", "-o", tmp_path / "run.h5")
    assert any(part in line for part in says.split("|")), line
    assert len(line) < 700


TETRAHEDRON = (
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
GRID = mpm.Grid((1000, 1000, 100), 0.1)
LITTLE = mpm.fill(mpm.Ball((5.0, 5.0, 5.0), 0.3), mpm.Grid((9, 9, 9), 0.1), density=1.0)
SMALL = mpm.Scene(mpm.Grid((100, 100, 100), 0.1), mpm.NeoHookean(1e5, 0.3))
TOO_MUCH = {
    "samples of a mesh": (lambda: mpm.geometry.sample_mesh(TETRAHEDRON, 1e-5), "A lattice of 1e\\+15 samples"),
    "samples of a region": (
        lambda: mpm.geometry.sample_distance(mpm.Ball((0.0, 0.0), 1.0), 1e-9),
        "A lattice of 4e\\+18 samples",
    ),
    "a lattice": (
        lambda: mpm.fill(mpm.Box((0.0,) * 3, (2.0,) * 3), GRID, particles_per_cell=200**3, density=1.0),
        "A lattice of 6.4e\\+10 particles takes at least 3.07e\\+03 GB",
    ),
    "nodes": (
        lambda: mpm.prepare(mpm.Scene(GRID, SMALL.material), LITTLE),
        "on a grid of 100000000 nodes",
    ),
    "frames": (
        lambda: mpm.simulate(SMALL, LITTLE, t1=2e6, dt=1.0, save_every=1),
        "2000002 frames .* save less often than every 1 steps",
    ),
}


@pytest.mark.parametrize(("make", "says"), TOO_MUCH.values(), ids=TOO_MUCH)
def test_what_does_not_fit_into_memory_is_not_begun(make, says, monkeypatch):
    """On a machine with 4 GB to spare."""
    monkeypatch.setattr(_values, "available_memory", lambda *, device: 4 * 10**9)
    with pytest.raises(ValueError, match=says):
        make()


def test_the_memory_that_there_is_is_known():
    """More than this process has asked for, less than a planet's; not known without /proc, it is a stated number."""
    assert 2**27 < _values.available_memory() < 2**50
    assert _values.available_memory(device=True) > 2**27


def test_zero_particles_are_refused():
    """Where they are given."""
    none = jnp.zeros((0, 2))
    with pytest.raises(ValueError, match="a particle at least"):
        mpm.Particles(x=none, v=none, mass=none[:, 0], volume=none[:, 0])
