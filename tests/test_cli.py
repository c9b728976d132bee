"""Each command of the shell, on good input and on bad: one clear line, exit code 2, no traceback, nothing lost."""

import csv
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from operator import ge, gt, le, lt
from pathlib import Path

import equinox as eqx
import h5py
import jax
import numpy as np
import pytest
from disk import full_beyond
from shell import refused, shell

import mpmjax as mpm
from mpmjax._tables import scene_table
from mpmjax.cli import scene_schema
from mpmjax.cli._commands import _summary
from mpmjax.cli._fit_file import leaf_of, read_fit
from mpmjax.cli._scene_file import read_scene_file, read_simulation
from mpmjax.fitting._columns import read_columns
from mpmjax.io import _schema
from mpmjax.simulation._simulate import integrate
from mpmjax.viz import COLOURS

EXAMPLES = Path(__file__).parents[1] / "examples"
SCENE = """
gravity = [0.0, -9.81]

[grid]
shape = [10, 14]
spacing = 0.1
origin = [-3, -3]

[material]
kind = "FixedCorotated"
youngs_modulus = 1e5
poisson_ratio = 0.3

[[boundary]]
kind = "SlipBox"
lower = [-0.2, 0.0]
upper = [0.6, inf]

[[particles]]
region = { kind = "Box", lower = [0.0, 0.1], upper = [0.3, 0.4] }
density = 1e3

[output]
fields = ["stress", "particle"]

[run]
t1 = 0.06
dt = 1e-2
method = { kind = "SemiImplicit" }
save_every = 2
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with a scene file and the file of its run."""
    folder = tmp_path_factory.mktemp("shell")
    (folder / "scene.toml").write_text(SCENE)
    code, out, err = shell("run", folder / "scene.toml", "-o", folder / "run.h5")
    assert code == 0, err
    (folder / "summary").write_text(out)
    return folder


@pytest.mark.thorough
def test_summary_says_how_many_steps_were_indefinite(folder):
    """And is silent where none was."""
    start, run = read_simulation(folder / "scene.toml").particles, mpm.load(folder / "run.h5")
    assert "indefinite" not in (folder / "summary").read_text()
    run = eqx.tree_at(lambda r: r.statistics.indefinite, run, run.statistics.indefinite + 5)
    assert dict(_summary(start, run, 6, 1.0))["indefinite"].startswith("the system of 5 of 6 steps")


def test_run_writes_the_frames_and_a_summary(folder):
    run = mpm.load(folder / "run.h5")
    np.testing.assert_array_equal(run.steps, [0, 2, 4, 6])
    with h5py.File(folder / "run.h5") as file:  # with the fields that its scene asks for
        assert {"stress", "particle"} <= set(file["VTKHDF/PointData"])
        assert "pressure" not in file["VTKHDF/PointData"]
    summary = (folder / "summary").read_text()
    assert re.search(r"steps +6 of 0.01 s with SemiImplicit", summary)
    assert re.search(
        r"\nstages +\S+ s set-up, \S+ s compiling, \S+ s steps\nend +t = 0.06 s, 4 frames\nwritten", summary
    )
    for word in ("particle-steps per second", "iterations a step", "total energy", "mass"):
        assert word in summary
    lost = re.search(r"relative error of the grid's mass ([-+.e\d]+)", summary)
    assert lost is not None
    assert abs(float(lost[1])) < 1e-14


@pytest.mark.thorough
def test_run_reports_what_simulate_returns(folder):
    """The recorded run is the simulated one."""
    from mpmjax.cli._scene_file import read_simulation

    simulation = read_simulation(folder / "scene.toml")
    run = mpm.simulate(
        simulation.scene, simulation.particles, t1=simulation.t1, dt=simulation.dt, method=simulation.method
    )
    np.testing.assert_array_equal(mpm.load(folder / "run.h5").final.x, run.final.x)


def test_who_asks_or_errs_does_not_wait_for_jax(tmp_path):
    """Help, the version, examples, and refusals of what needs no room to be seen: in one fresh interpreter, which has
    imported the package, as `python -m mpmjax` does."""
    (tmp_path / "scene.toml").write_text(SCENE)
    (tmp_path / "bad.toml").write_text("[grid")
    (tmp_path / "fit.toml").write_text(SCENE + '[fit]\n[[fit.parameter]]\npth = "a"\n')
    refusals = {
        "run none.toml -o a.h5": "Cannot read the scene file none.toml",
        "run bad.toml -o a.h5": "is not a TOML file",
        "run scene.toml -o scene.toml": "scene.toml exists",
        "run scene.toml -o no/a.h5": "no folder no",
        "run scene.toml -o a.h5 --set grid": "--set must be KEY=VALUE",
        "run scene.toml -o a.h5 --set particles.density.x=1": "has no such place",
        "run scene.toml -o a.h5 --steps 0": "--steps must be positive",
        "run scene.toml -o a.h5 --steps 2 --t1 1": "give one of them",
        "run scene.toml --vary run.dt=1:2": "--vary must be KEY=A:B:N",
        "run scene.toml --vary run.dt=0:2:3:log": "--vary must be KEY=A:B:N",
        "run scene.toml --vary run.dt=1:2:3 -o a.h5": "writes a table",
        "run scene.toml --vary run.dt.x=1:2:3": "has no such place",
        "run scene.toml --vary grid.spacing=1:2:3 --method auto": "--vary needs a method",
        "run scene.toml -o a.h5 --set grid.spacng=1": "[grid]: unknown key 'spacng', did you mean 'spacing'?",
        "run scene.toml -o a.h5 --set material={kind='NeoHookean'}": "[material] needs the key 'youngs_modulus'",
        "run scene.toml -o a.h5 --set boundary.0.kind=Slip": "[[boundary]] 1: unknown kind 'Slip', did you mean 'SlipB",
        "run scene.toml --vary run.tt=1:2:3": "[run]: unknown key 'tt'",
        "run scene.toml -o a.h5 --dt 0": "[run] dt [s] must be greater than zero, got 0.",
        "run scene.toml -o a.h5 --set particles.0.particles_per_cell=0": "particles_per_cell must be at least 1",
        "run scene.toml -o a.h5 --set run.save_every=0": "save_every must be a whole number of at least 1, got 0.",
        "run scene.toml --vary material.poisson_ratio=0.5:0.4:2": "must be strictly between -1 and 0.5, got 0.5.",
        "check scene.toml --set material.youngs_modulus=[1e5,0.0]": "[material] youngs_modulus [Pa] must be greater th",
        "check scene.toml --set run.method.beta=-1": "[run.method] beta must be from 0 to 1, got -1.",
        "check scene.toml --set particles.0.density=0": "[[particles]] 1 density [kg/m^d] must be greater than zero",
        "check scene.toml --set material.youngs_modulus=soft": "must be a number or a list of numbers, got 'soft'.",
        "check scene.toml --set material.youngs_modulus=nan": "[material] youngs_modulus must be finite, got nan.",
        "check scene.toml --set run.dt=sable": "[run] dt must be a number or 'stable' or 'auto', got 'sable'.",
        "check scene.toml --set run.save_every=1.5": "[run] save_every must be a whole number, got 1.5.",
        "check scene.toml --set gravity=-9.8": "gravity must be a list of numbers, got -9.8.",
        "check scene.toml --set grid.shape=[9,3]": "[grid] shape must be at least 4, got [9, 3].",
        "fit scene.toml --set fit.level=1": "[fit] level must be strictly between 0 and 1, got 1.",
        "check scene.toml --set particles.0.region.kind=Bocks": "[[particles]] 1 [region]: unknown kind 'Bocks'",
        "check fit.toml": "[[fit.parameter]] 1: unknown key 'pth'",
        "fit fit.toml": "[[fit.parameter]] 1: unknown key 'pth', did you mean 'path'?",
        "schema": "",
        "run scene.toml -o a.h5 --import none.py": "there is no file none.py",
        "check none.toml": "Cannot read the scene file none.toml",
        "fit scene.toml": "has no [fit] table",
        "fit scene.toml --set grid.spacng=1": "[grid]: unknown key 'spacng', did you mean 'spacing'?",
        "fit scene.toml --set fit.levl=0.9": "[fit]: unknown key 'levl', did you mean 'level'?",
        "fit scene.toml --resume": "name it by --log",
        "render none.h5 -o a.png": "none.h5 does not exist",
        "info none.h5": "none.h5 does not exist",
        "example none": "There is no example 'none'",
        "run --help": "",
        "--help": "",
        "--version": "",
        "example": "",
    }
    script = f"""
import sys
import mpmjax
from mpmjax_command import app
for words in {list(refusals)}:
    try:
        app(words.split())
    except SystemExit as error:
        print(words, "->", error.code)
print(sorted({{"jax", "numpy", "h5py", "mpmjax.cli"}} & set(sys.modules)))
"""
    ran = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "[]"
    for words, says in refusals.items():
        assert f"{words} -> {2 if says else 0}" in ran.stdout, words
        assert says in ran.stderr
    assert ran.stderr.count("mpmjax: ") == sum(map(bool, refusals.values()))
    assert f"mpmjax {mpm.__version__}" in ran.stdout


@pytest.mark.thorough
def test_the_shell_keeps_compiled_programs(tmp_path):
    """For the next command on such a processor, which takes them without a word, started by a program with JAX too."""
    (tmp_path / "scene.toml").write_text(SCENE)
    command = [sys.executable, "-m", "mpmjax", "run", "scene.toml", "--quiet", "--overwrite"]
    places = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    places |= {"XDG_CACHE_HOME": str(tmp_path), "TF_CPP_MIN_LOG_LEVEL": "1"}  # as JAX sets it when imported
    for _ in range(2):
        ran = subprocess.run(command, cwd=tmp_path, env=places, capture_output=True, text=True, check=True)
        assert ran.stderr == ""
        assert list(tmp_path.glob("mpmjax/*/jit_integrate-*"))


def test_help_names_the_colours():
    assert not {name for name in COLOURS if name not in shell("render", "--help")[1]}


def test_a_change_is_made_at_its_place(folder):
    changes = (
        "material.youngs_modulus=2e5",
        "boundary.0.lower=[0.0, 0.0]",
        "run.method=Explicit",
        "particles.0.material=a b",
    )
    table = scene_table(folder / "scene.toml", changes)
    assert table["material"]["youngs_modulus"] == 2e5
    assert table["boundary"][0] == {"kind": "SlipBox", "lower": [0.0, 0.0], "upper": [0.6, np.inf]}
    assert table["run"]["method"] == "Explicit"
    assert table["particles"][0]["material"] == "a b"
    assert "unknown" in refused("check", folder / "scene.toml", "--set", "grid.spacng=1")


def test_options_of_run_stand_for_keys_of_the_file(folder, tmp_path):
    options = ("--dt", 2e-3, "--steps", 4, "--method", "Explicit", "--set", "material.youngs_modulus=2e5")
    code, _, err = shell("run", folder / "scene.toml", "-o", tmp_path / "run.h5", "--quiet", *options)
    assert code == 0, err
    run = mpm.load(tmp_path / "run.h5")
    assert (float(run.dt), int(run.final_step), type(run.method)) == (2e-3, 4, mpm.Explicit)
    assert float(run.scene.material.youngs_modulus) == 2e5


def test_a_study_has_a_row_for_each_combination(folder, tmp_path):
    """With the numbers of a run of its own; one that fails says why; nothing compiles for another number."""
    out = tmp_path / "study.csv"
    words = ("run", folder / "scene.toml", "-o", out, "--vary")
    counted = integrate._cached._cache_size()
    spans = "material.poisson_ratio=0.1:0.5:2", "--vary", "material.youngs_modulus=1e4:1e6:3:log"
    code, said, err = shell(*words, *spans)
    assert code == 0, err
    assert integrate._cached._cache_size() <= counted + 1
    assert "6 of 6: material.poisson_ratio=0.5" in said
    assert f"written {out} (6 rows, 3 of runs that failed)" in said
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    stiffness = [float(row["material.youngs_modulus"]) for row in rows]
    np.testing.assert_allclose(stiffness, [1e4, 1e5, 1e6] * 2)
    assert [bool(row["failure"]) for row in rows] == [False] * 3 + [True] * 3
    assert "poisson_ratio must be strictly between" in rows[-1]["failure"]
    changes = [f"--set={key}={rows[1][key]}" for key in ("material.poisson_ratio", "material.youngs_modulus")]
    assert shell("run", folder / "scene.toml", "-o", tmp_path / "one.vtkhdf", *changes)[0] == 0
    for name, column in mpm.table(tmp_path / "one.vtkhdf").items():
        assert float(rows[1][name]) == column[-1] or np.isnan(column[-1]), name
    assert "exists: choose another name" in refused(*words, "material.poisson_ratio=0.1:0.2:2")
    assert "must be a whole number" in refused(*words, "run.save_every=1:2:2", "--overwrite")
    assert "change neither particles nor nodes" in refused(
        *words, "particles.0.region.upper.0=0.3:0.5:2", "--overwrite"
    )
    moving = "--set", "particles.0.velocity=[0.0, 0.0]", "--overwrite"
    code, said, _ = shell(*words, "particles.0.velocity.0=0:1e4:2", *moving)
    assert code == 0
    assert re.search(r"\n2 of 2: particles.0.velocity.0=10000.0: .*particle", said)


def test_check_says_what_a_scene_takes_and_what_looks_wrong(folder, tmp_path):
    scene, picture = folder / "scene.toml", tmp_path / "setup.png"
    code, out, err = shell("check", scene, "--plot", picture)
    assert code == 0, err
    assert picture.stat().st_size > 1000
    file = read_scene_file(scene)
    bound = float(mpm.stable_dt(file.scene, file.particles))
    for line in (
        rf"particles +{file.particles.count} of float64, 4 a cell, 90 kg",
        r"grid +10 x 14 = 140 nodes, 0\.1 m apart",
        rf"longest step +Explicit\(\) {bound:.3g} s\n",
        rf"steps +6 of 0\.01 s with SemiImplicit\(beta=1\), {0.01 / bound:.3g} of Explicit's longest",
        r"a step takes +\S+ s once compiled",
        r"memory +\S+ kB in a step",
    ):
        assert re.search(line, out), (line, out)
    assert "warning" not in err
    still = ("--set", "gravity=[0.0, 0.0]", "--set", "run.method=Explicit", "--set", "run.dt=0.06")
    code, _, err = shell("check", scene, *still)
    assert code == 0, err
    assert re.search(rf"the step is {0.06 / bound:.3g} times the longest stable one", err)
    assert "nothing moves in the first step" in err
    assert "cells in a step" in shell("check", scene, "--set", "particles.0.velocity=[0.0, 30.0]")[2]


def test_info_describes_a_file(folder):
    code, out, err = shell("info", folder / "run.h5", "--table", folder / "run.csv")
    written = np.genfromtxt(folder / "run.csv", delimiter=",", names=True, deletechars="")
    np.testing.assert_allclose(written["time_[s]"], [0, 0.02, 0.04, 0.06])
    assert written["iterations"][-1] > written["iterations"][0] == 0
    assert code == 0, err
    assert re.search(
        r"frames +4, from t = 0 s to 0\.06 s\nmaterials +FixedCorotated\nparticles +36\nsteps +6 of 0\.01 s", out
    )
    assert "total energy" in out
    assert "jaxlib" in shell("info")[1]


def test_a_reader_who_has_enough_ends_a_command_quietly():
    """Such as `mpmjax example | head -1`, whose pipe breaks when it is written or flushed."""
    command = [sys.executable, "-m", "mpmjax", "example"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def valid(value, schema, defs):
    """Whether a value is what a JSON schema says, in the words that `mpmjax schema` uses."""
    types = {"object": dict, "array": list, "number": int | float, "integer": int, "boolean": bool, "string": str}
    schema = defs[schema["$ref"].removeprefix("#/$defs/")] if "$ref" in schema else schema
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if kinds and not any(isinstance(value, types[kind]) for kind in kinds):
        return False
    if isinstance(value, dict) and "properties" in schema:
        known = schema["properties"]
        inside = all(valid(v, known[k], defs) for k, v in value.items() if k in known)
        others = set() if schema.get("additionalProperties", True) is False else set(value) - set(known)
        return inside and set(schema["required"]) <= set(value) <= set(known) | others
    if isinstance(value, dict) and isinstance(schema.get("additionalProperties"), dict):
        return all(valid(v, schema["additionalProperties"], defs) for v in value.values())
    if isinstance(value, list) and "items" in schema:
        return all(valid(v, schema["items"], defs) for v in value)
    ends = {"minimum": ge, "maximum": le, "exclusiveMinimum": gt, "exclusiveMaximum": lt}
    inside = all(holds(value, schema[end]) for end, holds in ends.items() if end in schema)
    fits = inside and value == schema.get("const", value) and value in schema.get("enum", [value])
    return fits and ("anyOf" not in schema or any(valid(value, each, defs) for each in schema["anyOf"]))


def test_the_schema_holds_the_examples_and_no_slip(monkeypatch):
    """It is derived from what reads the files, so that editors know each key."""
    code, out, err = shell("schema")
    assert code == 0, err
    schema = json.loads(out)
    monkeypatch.setattr(_schema, "_registered", {})
    anew = "write it anew: mpmjax schema --import mpmjax > mpmjax/scene.schema.json"
    assert out == json.dumps(scene_schema(), separators=(",", ":")) + "\n", anew
    assert {"Intersection", "Mesh", "NeoHookean", "Newton", "Rigid", "VolumePreconditioner"} <= set(schema["$defs"])
    assert schema["$defs"]["NeoHookean"]["required"] == ["youngs_modulus", "poisson_ratio"]
    for path in EXAMPLES.glob("*.toml"):
        assert valid(tomllib.loads(path.read_text()), schema, schema["$defs"]), path
    table = tomllib.loads(SCENE)
    assert valid(table, schema, schema["$defs"])
    for slip in (
        {"gravitty": [0.0, 1.0]},
        {"grid": {"shape": [8, 8]}},
        {"material": {"kind": "NeoHookean", "youngs_modulus": "soft", "poisson_ratio": 0.3}},
        {"material": {"kind": "NeoHookean", "youngs_modulus": [1e5, 0.0], "poisson_ratio": 0.3}},
        {"material": {"kind": "NeoHookean", "youngs_modulus": 1e5, "poisson_ratio": 0.5}},
        {"boundary": [{"kind": "SlipBox", "lower": [0.0], "upper": [1.0], "friction": 0.1}]},
        {"run": {"dt": 0.1}},
        {"material": {"gel": {"kind": "NeoHookean", "youngs_modulus": 1e5}}},
        {"fit": {"levl": 0.9}},
        {"fit": {"optimiser": "Newton"}},
        {"fit": {"parameter": [{"path": "scene.material.youngs_modulus", "kind": "positive"}]}},
        {"fit": {"observation": [{"kind": "Extent", "data": "a.csv", "time": "t", "axis": 0, "side": "upper"}]}},
    ):
        assert not valid(table | slip, schema, schema["$defs"]), slip
    named = {"material": {"gel": table["material"]}, "fit": {"optimiser": {"kind": "LBFGS", "rtol": 1e-4}}}
    assert valid(table | named, schema, schema["$defs"])


def test_an_example_is_copied_with_its_data(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert shell("example")[1].count("\n") == len([*EXAMPLES.glob("*.toml"), *EXAMPLES.glob("*.py")])
    for _ in range(2):  # a copy that is there already is no fault
        code, out, err = shell("example", "rubber")
        assert code == 0, err
    assert out.splitlines()[-2:] == [
        "mpmjax fit examples/rubber.toml",
        "mpmjax run examples/rubber.toml -o rubber.vtkhdf",
    ]
    assert read_fit(tmp_path / "examples/rubber.toml").experiments
    with open("examples/rubber.toml", "a") as file:
        file.write("# mine")
    assert "examples/rubber.toml exists and differs" in refused("example", "rubber.toml")


def test_a_scene_of_python_is_a_scene_file(tmp_path):
    """With its particles in any state: what is loaded is what was saved, bit for bit. Nothing that is there is
    replaced, and refinement has no region to fill."""
    grid = mpm.Grid((12, 14), 0.1, origin=(-3, -3))
    lower, upper = mpm.Box((0.0, 0.0), (0.3, 0.3)), mpm.Box((0.0, 0.35), (0.3, 0.6))
    particles = mpm.join(*(mpm.fill(box, grid, particles_per_cell=4, density=1e3) for box in (lower, upper)))
    laws = {"soft": mpm.NeoHookean(1e5, 0.3), 'clay 😀 \\ "wet"': mpm.VonMises(2e5, 0.3, 1e2, 0.0)}
    boundary = mpm.SlipBox((-0.2, -np.inf), (0.6, np.inf)), mpm.Grip(lower, mpm.Motion((0.0, 1.0), ((0, 0), (0.1, 0))))
    loads = mpm.Traction(mpm.Patch(upper, within=mpm.Box((-1.0, 0.55), (1.0, 0.7))), (0.0, 9.0))
    scene = mpm.attach(mpm.Scene(grid, laws, gravity=(0.0, -9.81), boundary=boundary, loads=loads), particles)
    settings = {"t1": 5e-4, "dt": 1e-4, "method": mpm.Explicit(), "save_every": 5}
    start = mpm.prepare(scene, particles)
    rng = np.random.default_rng(0)
    deformations = tuple(F + rng.normal(size=F.shape) * 1e-3 for F in start.deformations)
    start = replace(start, v=jax.numpy.asarray(rng.normal(size=start.v.shape)), deformations=deformations)
    path = tmp_path / "made.toml"
    mpm.save_scene(path, scene, start, **settings)
    loaded, same, told = mpm.load_scene(path)
    assert told == settings
    for saved, read in ((scene, loaded), (start, same)):
        assert jax.tree.structure(saved) == jax.tree.structure(read)
        for a, b in zip(jax.tree.leaves(saved), jax.tree.leaves(read), strict=True):
            np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match=r"made\.toml exists"):
        mpm.save_scene(path, scene, start, **settings)
    with pytest.raises(ValueError, match="cannot be refined"):
        read_scene_file(path).build(2)
    text = path.read_text()
    path.write_text(text.replace("start.vtkhdf", "lost.vtkhdf"))
    assert "made.lost.vtkhdf" in refused("check", path)
    method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-9))
    mpm.save_scene(tmp_path / "implicit.toml", scene, start, t1=1.0, dt="stable", method=method)
    assert read_scene_file(tmp_path / "implicit.toml").run.method == method


def test_a_scene_is_loaded_as_the_shell_runs_it(folder):
    """The arguments of `simulate`; in JAX's own precision if the file names none. Its run is read in that too."""
    scene, particles, settings = mpm.load_scene(folder / "scene.toml")
    run = mpm.simulate(scene, particles, **settings)
    recorded = mpm.load(folder / "run.h5")
    np.testing.assert_array_equal(run.frames.x, recorded.frames.x)
    with jax.enable_x64(False):
        assert mpm.load_scene(folder / "scene.toml")[1].x.dtype == np.float32
        (folder / "double.toml").write_text(SCENE.replace("t1 =", 'precision = "float64"\nt1 ='))
        with pytest.raises(ValueError, match="jax_enable_x64"):
            mpm.load_scene(folder / "double.toml")
        with pytest.warns(UserWarning, match="read in float32"):
            rounded = mpm.load(folder / "run.h5")
        later = mpm.simulate(scene, rounded.final, **settings | {"t1": 0.08}, start=int(rounded.final_step))
        np.testing.assert_allclose(later.final.x[:, 0], recorded.final.x[:, 0], atol=0.05)


def test_run_does_not_replace_a_file_unasked_and_resumes_it(folder):
    before = (folder / "run.h5").read_bytes()
    assert "exists" in refused("run", folder / "scene.toml", "-o", folder / "run.h5")
    assert (folder / "run.h5").read_bytes() == before
    longer = folder / "longer.toml"
    longer.write_text(SCENE.replace("t1 = 0.06", "t1 = 0.08"))
    copy = folder / "copy.h5"
    copy.write_bytes(before)
    assert "give one of them" in refused("run", longer, "-o", copy, "--resume", "--overwrite")
    assert shell("run", longer, "-o", copy, "--resume", "--quiet")[0] == 0
    np.testing.assert_array_equal(mpm.load(copy).steps, [0, 2, 4, 6, 8])


def test_the_file_is_named_after_the_scene(folder, tmp_path, monkeypatch):
    """It is the one that is resumed, too."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.vtkhdf").write_bytes((folder / "run.h5").read_bytes())
    assert shell("run", folder / "scene.toml", "--resume", "--quiet")[0] == 0
    assert "scene.vtkhdf exists" in refused("run", folder / "scene.toml")


def test_a_complete_run_is_resumed_with_success(folder, tmp_path):
    """Nothing is left to do, and the file stays as it is."""
    before = (folder / "run.h5").read_bytes()
    code, out, err = shell("run", folder / "scene.toml", "-o", folder / "run.h5", "--resume", "--quiet")
    assert code == 0, err
    assert re.search(r"run\.h5 \(\S+ kB\) complete already: it reaches t = 0\.06 s\n$", out)
    assert (folder / "run.h5").read_bytes() == before


@pytest.mark.parametrize("choice", ["--overwrite", "--resume"])
def test_what_is_no_run_is_neither_replaced_nor_continued(folder, choice):
    """Such as the scene itself; it is said before anything is run."""
    scene = folder / "scene.toml"
    assert re.search(r"scene\.toml is not a(n HDF5 file| run)", refused("run", scene, "-o", scene, choice))
    assert scene.read_text() == SCENE


@pytest.mark.thorough
def test_a_full_disk_leaves_no_half_picture(folder, tmp_path):
    """The picture that was there stays."""
    (tmp_path / "run.h5").write_bytes((folder / "run.h5").read_bytes())
    for name in ("a.png", "a.pdf", "a.svg", "a.gif"):
        (tmp_path / name).write_text("there before")
        with full_beyond(500):
            line = refused("render", tmp_path / "run.h5", "-o", tmp_path / name, "--dpi", 40)
        assert re.search(rf"{name} could not be written: .*", line), line
        assert (tmp_path / name).read_text() == "there before"
    assert len(list(tmp_path.iterdir())) == 5


SECRET = "root:x:0:0:administrator:/secret:/bin/sh"


UNFIT_DATA = {
    "no table": (f"{SECRET}\nbin:{SECRET}\n", r"has no column 'stretch' among its 1\.$"),
    "a typing error": (f"strech,stress,{SECRET}\n1,1,1\n", r"has no column 'stretch', did you mean 'strech'\?$"),
    "a long cell": (
        f"stretch,stress\n1,'{SECRET * 9}\n",
        r"line 2: stress must be a finite number, got \"'root.*\.\.\.\"\.$",
    ),
    "an open quote": (f'stretch,stress\n1,"{SECRET}\n{SECRET}\n', r"line 2: stress .*, got 'root.*\.\.\.'\.$"),
    "a short row": (f"{SECRET},stretch,stress\n{SECRET},1\n", r"line 2: 2 fields, but the header has 3\.$"),
    "not finite": ("stretch,stress\n1,nan\n", r"line 2: stress must be a finite number, got 'nan'\.$"),
    "a cell beyond csv's limit": ("stretch,stress\n1," + "1" * 200_000, r"line 2: not CSV: field larger than"),
    "empty": ("", r"is empty: it needs a header that names its columns, and rows\.$"),
}


@pytest.mark.parametrize(("content", "says"), UNFIT_DATA.values(), ids=UNFIT_DATA)
def test_of_a_data_file_no_more_is_shown_than_a_cell(content, says, tmp_path):
    """Another file may have been named than was meant."""
    path = tmp_path / "data.csv"
    path.write_text(content)
    with pytest.raises(ValueError, match=says) as caught:
        read_columns(path, "stretch", "stress")
    assert "secret" not in str(caught.value)
    assert len(str(caught.value).replace(str(path), "")) < 150


@pytest.mark.parametrize("name", ["still.png", "moving.gif"])
def test_render_draws_a_picture(folder, name):
    options = ("--colour", "energy", "--dpi", 40, "--view=-140,25")
    code, _, err = shell("render", folder / "run.h5", "-o", folder / name, *options)
    assert code == 0, err
    assert (folder / name).stat().st_size > 1000


@pytest.mark.parametrize("view", ["30", "30,high", "1,2,3"])
def test_an_angle_that_is_none_gets_a_hint(folder, view):
    code, _, err = shell("render", folder / "run.h5", "-o", folder / "a.png", "--view", view)
    assert code == 2
    assert "is not AZIMUTH,ELEVATION" in err


BAD_OPTIONS = {
    "--fps 0": r"fps must be from 1 to 100, got 0",
    "--fps -1": r"fps must be from 1 to 100, got -1",
    "--dpi 1e9": r"dpi must be from 1 to \d+, got 1000000000",
    "--dpi nan": r"dpi must be finite, got nan",
    "--dpi 0": r"dpi must be from 1 to",
    "--import os.nope": r"--import os\.nope: ModuleNotFoundError: No module named 'os\.nope'",
    "--import {}/bad.py": r"--import .*bad\.py: SyntaxError: .*bad\.py, line 1",
    "--import {}/fails.py": r"--import .*fails\.py: ZeroDivisionError: .*fails\.py, line 2",
}


@pytest.mark.parametrize("options", BAD_OPTIONS)
def test_a_bad_option_gets_one_line(folder, options):
    (folder / "bad.py").write_text("def (:\n")
    (folder / "fails.py").write_text("\n1 / 0\n")
    line = refused("render", folder / "run.h5", "-o", folder / "a.gif", *options.format(folder).split())
    assert re.search(BAD_OPTIONS[options], line), line


def test_a_fit_on_a_grid_that_cannot_be_does_not_begin(tmp_path):
    (tmp_path / "front.csv").write_text("t,x\n0.02,0.3\n0.04,0.29\n")
    observed = '[[fit.observation]]\nkind = "Extent"\ndata = "front.csv"\ntime = "t"\nvalue = "x"\naxis = 1\n'
    fitted = '[fit]\n[[fit.parameter]]\npath = "scene.material.youngs_modulus"\nstart = 3e4\n'
    (tmp_path / "scene.toml").write_text(SCENE + fitted + observed)
    line = refused("fit", tmp_path / "scene.toml", "--refine", "2,1000000")
    assert re.search(r"A lattice of 9e\+12 particles|fewer than 2\^31 nodes", line), line


BAD_SCENES = {
    "wrong key": ("spacing = 0.1", "spacng = 0.1", r"\[grid\].*spacng.*spacing"),
    "wrong kind": ('"SlipBox"', '"SlideBox"', r"\[\[boundary\]\].*SlideBox"),
    "bad number": ("youngs_modulus = 1e5", "youngs_modulus = -1e5", r"youngs_modulus.*greater than zero"),
    "not whole steps": ("dt = 1e-2", "dt = 0.7e-2", r"whole number of steps"),
    "outside the window": ("lower = [0.0, 0.1]", "lower = [-0.5, 0.1]", r"window; particle 0 at"),
    "no TOML": ("[grid]", "[grid", r"not a TOML file"),
    "missing table": ("[run]", "[rum]", r"\[run\]"),
    "automatic method, given step": ('method = { kind = "SemiImplicit" }', 'method = "auto"', r'goes with dt = "auto"'),
    "no time for pilot runs": ("dt = 1e-2", 'dt = "auto"\nmost_seconds = 0', r"\[run\] most_seconds"),
    "unknown field": ('"stress"', '"strain"', r"\[output\] fields must be some of .*, got 'strain'"),
    "no step": ("dt = 1e-2", "", r"\[run\] needs the key 'dt'"),
    "a step in words": ("dt = 1e-2", 'dt = "small"', r"\[run\] dt must be a number or 'stable' or 'auto', got 'small'"),
    "counts": ("density = 1e3", "density = 1e3\nparticles_per_cell = 3", r"\[\[particles\]\] 1.*2-th power"),
}


@pytest.mark.parametrize(("old", "new", "says"), BAD_SCENES.values(), ids=BAD_SCENES)
def test_a_bad_scene_gets_one_line(tmp_path, old, new, says):
    assert old in SCENE
    scene = tmp_path / "bad.toml"
    scene.write_text(SCENE.replace(old, new, 1))
    line = refused("run", scene, "-o", tmp_path / "run.h5")
    assert re.search(says, line), line
    assert not (tmp_path / "run.h5").exists()


TWO = SCENE.replace(
    """[material]
kind""",
    """[[material]]
kind = "VonMises"
youngs_modulus = 2e5
poisson_ratio = 0.25
yield_stress = 1e2

[[material]]
kind""",
).replace(
    """density = 1e3
""",
    """density = 1e3
material = 2

[[particles]]
region = { kind = "Box", lower = [0.0, 0.5], upper = [0.3, 0.6] }
density = 2e3

[[particles]]
region = { kind = "Ball", centre = [0.4, 0.8], radius = 0.1 }
density = 500.0
material = 2
""",
)


@pytest.mark.thorough
def test_a_file_may_name_several_materials(tmp_path):
    """Particles stand by material, in the laws' order, whatever that of their tables; each obeys its own law."""
    (tmp_path / "two.toml").write_text(TWO)
    simulation = read_simulation(tmp_path / "two.toml")
    metal, jelly = simulation.scene.laws
    assert type(metal) is mpm.VonMises
    assert type(jelly) is mpm.FixedCorotated
    assert simulation.particles.counts is not None
    first, second = simulation.particles.counts
    assert first == 12
    density = np.asarray(simulation.particles.mass / simulation.particles.volume)
    np.testing.assert_allclose(density[:first], 2e3)
    np.testing.assert_allclose(density[first:], [1e3] * 36 + [500.0] * (second - 36))
    code, out, err = shell("run", tmp_path / "two.toml", "-o", tmp_path / "two.h5", "--quiet")
    assert code == 0, err
    assert re.search(rf"particles +{first + second}\n", out)
    run = mpm.load(tmp_path / "two.h5")
    np.testing.assert_array_equal(run.final.counts, simulation.particles.counts)
    plain = mpm.simulate(
        simulation.scene, simulation.particles, t1=simulation.t1, dt=simulation.dt, method=simulation.method
    )
    np.testing.assert_array_equal(run.final.x, plain.final.x)


NAMED = (
    TWO.replace('[[material]]\nkind = "VonMises"', '[material.metal]\nkind = "VonMises"')
    .replace("[[material]]\nkind", "[material.jelly]\nkind")
    .replace("material = 2", 'material = "jelly"')
)


@pytest.mark.thorough
def test_materials_may_have_names(tmp_path):
    """The same scene as by numbers; names are in the file, in what is said of it, and in dotted paths."""
    (tmp_path / "two.toml").write_text(TWO)
    (tmp_path / "named.toml").write_text(NAMED)
    two, named = (read_simulation(tmp_path / f"{name}.toml") for name in ("two", "named"))
    assert named.scene.names == ("metal", "jelly")
    assert eqx.tree_equal(two.particles, named.particles)
    assert eqx.tree_equal(two.scene.laws, named.scene.laws)
    again = mpm.Scene(named.scene.grid, dict(zip(named.scene.names, named.scene.laws, strict=True)))
    assert again.titles == named.scene.titles == ("metal (VonMises)", "jelly (FixedCorotated)")
    seen = mpm.Curve([0.01], [0.1], lambda run: run.final.x[:1, 0], sigma=0.01)
    experiment = mpm.Experiment(named.scene, named.particles, t1=0.01, dt=0.01, observations=seen)
    assert leaf_of("scene.material.metal.yield_stress", experiment) == 1e2
    changed = read_simulation(tmp_path / "named.toml", ["material.metal.yield_stress=2e2"])
    assert changed.scene.laws[0].yield_stress == 2e2
    run = mpm.simulate(named.scene, named.particles, t1=1e-4, dt=1e-4, save_every=1)
    mpm.save(tmp_path / "named.h5", run)
    assert mpm.load(tmp_path / "named.h5").scene.names == named.scene.names
    assert "metal (VonMises), jelly (FixedCorotated)" in shell("info", tmp_path / "named.h5")[1]
    with h5py.File(tmp_path / "named.h5") as file:
        assert file["mpmjax"].attrs["materials"] == b"metal (VonMises), jelly (FixedCorotated)"
        assert set(file["VTKHDF/PointData/material"][:12]) == {1}
        assert set(file["VTKHDF/PointData/material"][12:]) == {1, 2}  # of two frames


BAD_MATERIALS = {
    "no such name": (NAMED, 'material = "jelly"', 'material = "gel"', r"name of a .* metal, jelly, .* got 'gel'"),
    "a name left over": (NAMED, "density = 2e3", 'density = 2e3\nmaterial = "jelly"', r"\[material\.metal\] has no"),
    "key of a named law": (
        NAMED,
        "poisson_ratio = 0.3",
        "poison_ratio = 0.3",
        r"\[material\.jelly\]: .*'poisson_ratio'",
    ),
    "no such material": (TWO, "material = 2", "material = 3", r"\[\[particles\]\] 1 material .* from 1 to 2, got 3"),
    "material zero": (TWO, "material = 2", "material = 0", r"\[\[particles\]\] 1 material .* from 1 to 2, got 0"),
    "no number": (TWO, "material = 2", 'material = "jelly"', r"\[\[particles\]\] 1 material .*, got 'jelly'"),
    "a switch": (TWO, "material = 2", "material = true", r"\[\[particles\]\] 1 material .*, got True"),
    "second of one": (
        SCENE,
        "density = 1e3",
        "density = 1e3\nmaterial = 2",
        r"\[\[particles\]\] 1 material .* to 1, got 2",
    ),
    "left over": (TWO, "density = 2e3", "density = 2e3\nmaterial = 2", r"\[\[material\]\] 1 has no particles"),
    "key of the second law": (
        TWO,
        "poisson_ratio = 0.3",
        "poison_ratio = 0.3",
        r"\[\[material\]\] 2: .*'poisson_ratio'",
    ),
    "number of the first law": (TWO, "yield_stress = 1e2", "yield_stress = -1", r"\[\[material\]\] 1 yield_stress"),
    "key of a later table": (TWO, "density = 500.0", "denstiy = 500.0", r"\[\[particles\]\] 3: .*'density'"),
}


@pytest.mark.parametrize(("scene", "old", "new", "says"), BAD_MATERIALS.values(), ids=BAD_MATERIALS)
def test_a_bad_material_gets_one_line(tmp_path, scene, old, new, says):
    assert old in scene
    (tmp_path / "bad.toml").write_text(scene.replace(old, new, 1))
    with pytest.raises(ValueError, match=says) as caught:
        read_scene_file(tmp_path / "bad.toml")
    assert "\n" not in str(caught.value)


def test_a_missing_file_gets_one_line(tmp_path):
    assert "none.toml" in refused("run", tmp_path / "none.toml", "-o", tmp_path / "run.h5")
    assert "none.h5" in refused("render", tmp_path / "none.h5", "-o", tmp_path / "a.png")


def test_a_corrupt_file_gets_one_line(folder, tmp_path):
    whole = (folder / "run.h5").read_bytes()
    (tmp_path / "cut.h5").write_bytes(whole[: len(whole) // 2])
    refused("render", tmp_path / "cut.h5", "-o", tmp_path / "a.png")
    (tmp_path / "text.h5").write_text("no HDF5")
    refused("render", tmp_path / "text.h5", "-o", tmp_path / "a.png")
    assert "png" in refused("render", folder / "run.h5", "-o", tmp_path / "a.xyz")


@pytest.mark.thorough
def test_a_run_that_blows_up_keeps_what_was_written(tmp_path):
    """An explicit run far beyond its limit names step, time and particle; its good frames stay."""
    scene = tmp_path / "wild.toml"
    wild = SCENE.replace('{ kind = "SemiImplicit" }', '"Explicit"').replace("t1 = 0.06", "t1 = 1.0")
    scene.write_text(wild.replace("dt = 1e-2", "dt = 4e-2").replace("save_every = 2", "save_every = 1"))
    line = refused("run", scene, "-o", tmp_path / "run.h5")
    assert re.search(r"At step \d+ \(t = .* s\) particle \d+", line), line
    assert re.search(r"run\.h5 holds \d+ frames, the last of step \d+ \(t = .* s\)\. .* begin anew\.$", line), line
    run = mpm.load(tmp_path / "run.h5")
    assert len(run) >= 2
    assert np.isfinite(run.frames.x).all()


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_the_examples_can_be_run(path):
    """They are read, and name their own commands."""
    file = read_scene_file(path)
    assert file.particles.count >= 8
    assert re.search(rf"#   mpmjax (run|fit) examples/{path.name}", path.read_text(encoding="utf-8"))


def test_fit_needs_a_fit_table(folder):
    assert "[fit]" in refused("fit", folder / "scene.toml")


def test_a_change_is_made_for_a_fit(folder):
    """Of keys of [fit] and of all others."""
    words = "fit", folder / "scene.toml", "--set", "fit.observation=[]", "--set", "fit.t1=0.2"
    assert "must not lie after that of [run], got 0.2 and 0.06" in refused(*words)
    assert "must not lie after that of [run], got 0.2 and 0.1" in refused(*words, "--set", "run.t1=0.1")


def test_a_stable_step_is_taken_and_told(tmp_path):
    """The longest that divides t1; frames are then a fiftieth of the run apart."""
    scene = tmp_path / "stable.toml"
    left = SCENE.replace("dt = 1e-2", 'dt = "stable"').replace("save_every = 2", "")
    scene.write_text(left.replace('{ kind = "SemiImplicit" }', '"Explicit"'))
    code, out, err = shell("run", scene, "-o", tmp_path / "run.h5", "--quiet")
    assert code == 0, err
    chosen = re.search(r"chosen +dt = ([-.e\d]+) s \((\d+) steps\), the longest that is stable", out)
    assert chosen is not None, out
    assert re.search(r"\ndt +\S+ of the longest that is stable", out)
    run, file = mpm.load(tmp_path / "run.h5"), read_scene_file(scene)
    assert int(run.statistics.steps) == int(chosen[2])
    np.testing.assert_allclose(float(run.dt) * int(chosen[2]), 0.06)
    assert float(run.dt) <= float(mpm.stable_dt(file.scene, file.particles)) < 0.06 / (int(chosen[2]) - 1)
    scene.write_text(left)
    assert 'dt = "stable": SemiImplicit has no longest stable step' in refused("run", scene, "-o", tmp_path / "a.h5")


@pytest.mark.slow
def test_the_step_is_chosen_where_it_is_left_open(tmp_path):
    """By pilot runs, for the method that is given; the run says what and why."""
    scene = tmp_path / "auto.toml"
    left = SCENE.replace("dt = 1e-2", 'dt = "auto"\nerror = 0.1').replace("save_every = 2", "")
    scene.write_text(left.replace('{ kind = "SemiImplicit" }', '"Explicit"'))
    code, out, err = shell("run", scene, "-o", tmp_path / "run.h5", "--most-seconds", 120)
    assert code == 0, err
    assert "reference: " in err
    assert re.search(r"Explicit\(\) +1 / 1 .*\d\n", err), err  # a trial, as it is done
    chosen = re.search(r"chosen +Explicit\(\), dt = ([-.e\d]+) s \((\d+) steps\)", out)
    assert chosen is not None, out
    run = mpm.load(tmp_path / "run.h5")
    assert int(run.statistics.steps) == int(chosen[2])
    file = read_scene_file(scene)
    assert float(run.dt) <= 0.7 * float(mpm.stable_dt(file.scene, file.particles, safety=1.0))


def test_pilot_runs_are_bounded_from_file_and_shell(tmp_path):
    """By `most_seconds` in the file, and by the option, which has no use where nothing is left open."""
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    assert read_scene_file(scene).run.most_seconds == 60
    assert "--most-seconds is for pilot runs" in refused("run", scene, "-o", tmp_path / "a.h5", "--most-seconds", 5)
    scene.write_text(SCENE.replace("dt = 1e-2", 'dt = "auto"\nmost_seconds = 1e-9').replace('"SlipBox"', '"StickyBox"'))
    assert read_scene_file(scene).run.most_seconds == 1e-9


def test_a_plan_refines(tmp_path):
    """The same body at the same place, on half the spacing."""
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE)
    file = read_scene_file(scene)
    (coarse, few), (fine, many) = file.build(1), file.build(2)
    assert few.count * 4 == many.count
    np.testing.assert_allclose(few.mass.sum(), many.mass.sum(), rtol=1e-14)
    np.testing.assert_allclose(few.x.mean(axis=0), many.x.mean(axis=0), rtol=1e-14)
    assert (2 * float(fine.grid.spacing), *fine.grid.shape) == (float(coarse.grid.spacing), 20, 28)
    law = '[material]\nkind = "FixedCorotated"\nyoungs_modulus = 1e5\npoisson_ratio = 0.3\n'
    scene.write_text('material = "Snow"\n' + SCENE.replace(law, ""))
    assert read_scene_file(scene).build(2)[1].count == many.count
    each = f"youngs_modulus = {[1e5] * few.count}, poisson_ratio = 0.3"
    viscous = f'kind = "Viscous"\nshear_viscosity = 1.0\nlaw = {{ kind = "NeoHookean", {each} }}'
    for varied in (f'kind = "NeoHookean"\n{each.replace(", p", chr(10) + "p")}', viscous):
        scene.write_text(SCENE.replace(law, f"[material]\n{varied}\n"))
        with pytest.raises(ValueError, match="one number for all particles"):
            read_scene_file(scene).build(2)


@pytest.mark.slow
def test_chart_draws_and_names_the_cheapest(folder, tmp_path):
    code, out, err = shell(
        "chart", folder / "scene.toml", "--error", 0.05, "--most-seconds", 20, "-o", tmp_path / "chart.png"
    )
    assert code == 0, err
    assert (tmp_path / "chart.png").stat().st_size > 1000
    table = (tmp_path / "chart.csv").read_text().splitlines()
    assert {line.split("(")[0] for line in table[1:]} == {
        *("Explicit", "SemiImplicit", "BackwardEuler", "ImplicitMidpoint", "TRBDF2")
    }
    assert table[-1].startswith("SemiImplicit(beta=1),1,0.0")  # the scene's own setting
    assert re.search(r"\n\w+\(.*\), dt = .* s.* \(\d+ steps\): .* s, error", out)
