"""`mpmjax fit`: the [fit] table of a scene file, the table it prints, its picture and its numbers."""

import csv
import dataclasses
import json
import re
import tomllib
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from shell import refused, shell

import mpmjax as mpm
from mpmjax.checks import warn
from mpmjax.cli._fit_file import read_fit
from mpmjax.fitting import _result, read_columns
from mpmjax.fitting._columns import stated_unit
from mpmjax.simulation import _simulate

RUBBER = Path(__file__).parents[1] / "examples" / "rubber.toml"
BAR = """
gravity = [0.0]
[grid]
shape = [12]
spacing = 0.1
origin = [-4]
[material]
kind = "NeoHookean"
youngs_modulus = 1e5
poisson_ratio = 0.3
[[boundary]]
kind = "Grip"
region = { kind = "Box", lower = [-1.0], upper = [0.1] }
motion = { times = [0.0, 0.03, 1.0], displacement = [[0.0], [0.01], [0.01]] }
[[particles]]
region = { kind = "Box", lower = [0.0], upper = [0.4] }
particles_per_cell = 2
density = 1e3
[run]
t1 = 0.06
dt = 4e-3
"""
FIT = """
[fit]
t1 = 0.048
report = { mu = "scene.material.shear_modulus" }
[[fit.parameter]]
path = "scene.material.youngs_modulus"
name = "E"
start = 9e4
unit = "Pa"
[[fit.observation]]
kind = "Tracks"
data = "tracks.csv"
time = "time"
marker = "marker"
place = ["x"]
sigma = 1e-5
[[fit.observation]]
kind = "Extent"
data = "front.csv"
time = "time"
value = "x"
axis = 0
sigma = 1e-5
"""


@pytest.fixture(scope="module")
def bar(tmp_path_factory):
    """A bar that is pulled, in a file with what a stiffer one did."""
    folder = tmp_path_factory.mktemp("fit")
    (folder / "bar.toml").write_text(BAR + FIT)
    (folder / "plain.toml").write_text(BAR)
    from mpmjax.cli._scene_file import read_simulation

    made = read_simulation(folder / "plain.toml")
    law = mpm.NeoHookean(1.2e5, 0.3)
    scene = mpm.Scene(made.scene.grid, law, gravity=(0.0,), boundary=made.scene.boundary)
    run = mpm.simulate(scene, made.particles, t1=0.06, dt=4e-3, save_every=1)
    times, x = np.asarray(run.times), np.asarray(run.frames.x)[:, :, 0]
    tracks = [(t, k, row[k]) for t, row in zip(times, x, strict=True) for k in (3, 5, 7) if k != 5 or t < 0.03]
    for name, head, rows in (
        ("tracks.csv", ("time", "marker", "x"), tracks),
        ("front.csv", ("time", "x"), zip(times, x.max(axis=1), strict=True)),
    ):
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([head, *rows])
    return folder


def test_the_command_fits_prints_and_writes(bar, monkeypatch):
    """A table on standard output, progress and what is said of the fitted run beside it, a picture and its numbers."""
    inaccurate = lambda run: warn(f"inaccurate at E = {float(run.scene.material.youngs_modulus):.3g}")  # noqa: E731
    monkeypatch.setattr(_result, "warn_of_inaccuracy", inaccurate)
    monkeypatch.setattr(_simulate, "warn_of_inaccuracy", lambda run: warn("a run besides those of the search"))
    code, out, err = shell("fit", bar / "bar.toml", "--plot", bar / "fit.png")
    assert code == 0, err
    found = re.search(r"E \[Pa\]\s+(\S+) ± (\S+)", out)
    assert found is not None, out
    assert float(found[1]) == pytest.approx(1.2e5, rel=2e-3)
    assert re.search(r"mu\s+\S+ ± ", out)
    assert "misfit" in err
    assert "warning: inaccurate at E = 1.2e+05" in err
    assert "a run besides" not in err
    assert (bar / "fit.png").stat().st_size > 10_000
    numbers = json.loads((bar / "fit.json").read_text())
    assert numbers["estimates"][0]["label"] == "E"
    assert numbers["estimates"][0]["value"] == pytest.approx(float(found[1]), rel=1e-5)
    assert numbers["converged"]
    assert [n["name"] for n in numbers["noise"]] == ["tracks", "extent"]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("starts = 3\nfraction = 1", "3 points, 3 searches"),
        ("horizons = [0.02]", "until"),
        ("discretisation = false", "found by LevenbergMarquardt"),
    ],
)
def test_a_file_asks_for_a_better_start(bar, line, says):
    """Then for the fit from there, and the profile that the option names."""
    (bar / "start.toml").write_text(BAR + FIT.replace("[fit]\n", f"[fit]\n{line}\n"))
    code, out, err = shell("fit", bar / "start.toml", "--plot", bar / "start.png", "--profile", "E")
    assert code == 0, err
    assert says in out
    assert ("on twice the spacing: " in out) == ("discretisation" not in line)
    assert "interval by its profile" in out
    numbers = json.loads((bar / "start.json").read_text())
    assert numbers["estimates"][0]["value"] == pytest.approx(1.2e5, rel=2e-3)
    assert [p["label"] for p in numbers["profiles"]] == ["E"]


def test_an_unknown_profile_is_refused_before_the_fit(bar):
    code, out, err = shell("fit", bar / "bar.toml", "--profile", "nu")
    assert (code, out) == (2, "")
    assert "what is fitted is E" in err


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ("starts = 3\nhorizons = true", "either starts or horizons"),
        ("starts = 3\nfraction = 1.5", "fraction must be from 0 to 1, got 1.5"),
        ("fraction = 0.5", "fraction is one of starts"),
    ],
)
def test_starts_that_do_not_fit_get_one_line(bar, lines, says):
    (bar / "start.toml").write_text(BAR + FIT.replace("[fit]\n", f"[fit]\n{lines}\n"))
    code, _, err = shell("fit", bar / "start.toml")
    assert code == 2
    assert says in err


def test_another_scene_file_is_another_experiment(bar):
    (bar / "both.toml").write_text(BAR + FIT + '[[fit.experiment]]\nscene = "bar.toml"\n')
    found = read_fit(bar / "both.toml")
    assert [e.name for e in found.experiments] == ["both", "bar"]
    assert len(found.experiments[1].observations) == 2
    assert found.experiments[0].t1 == 0.048
    assert found.whole[0].t1 == 0.06
    assert found.experiments[0].observations[1].times[-1] == pytest.approx(0.048)
    assert found.whole[0].observations[1].times[-1] == pytest.approx(0.06)


def test_a_marker_that_is_lost_is_no_data(bar):
    seen = read_fit(bar / "bar.toml").experiments[0].observations[0]
    assert seen.data.shape == (12, 3, 1)
    assert np.isnan(seen.data[7:, 1]).all()
    assert np.isfinite(seen.data[:, [0, 2]]).all()


DATA = {
    "not a number": ("front.csv", 3, "0.008,wide", r"front\.csv, line 3: x must be a finite number, got 'wide'"),
    "not finite": ("front.csv", 3, "0.008,inf", r"line 3: x must be a finite number, got 'inf'"),
    "a field too many": ("tracks.csv", 5, "0.004,3,0.1,0.2", r"tracks\.csv, line 5: 4 fields, but the header has 3"),
    "a field too few": ("tracks.csv", 5, "0.004,3", r"tracks\.csv, line 5: 2 fields, but the header has 3"),
    "unsorted": ("front.csv", 4, "0.004,0.4", r"line 4: time 0\.004 must be later than in the row before: sort"),
    "after the run": (
        "front.csv",
        17,
        "60,0.4",
        r"line 17: time 60 lies after the end of the run, t1 = 0\.06 s.*time_un",
    ),
    "before the run": ("front.csv", 2, "-0.1,0.4", r"front\.csv, line 2: time -0\.1 lies before the run"),
    "millimetres": (
        "front.csv",
        6,
        "0.02,410",
        r"line 6: x 410 lies outside of the grid's window, from -0\.4 to 0\.7 m",
    ),
    "a marker twice": ("tracks.csv", 6, "0.004,3,0.1", r"tracks\.csv, line 6: marker 3 is there twice at time 0\.004"),
    "a marker beside the body": ("tracks.csv", 2, "0.0,3,-0.2", r"tracks\.csv, line 2: Markers must lie on the body"),
    "a new marker": ("tracks.csv", 6, "0.004,9,0.1", r"tracks\.csv, line 6: marker 9 has no row at time 0"),
}
"""A file, one of its lines, what stands there instead, and what is said."""


@pytest.fixture(scope="module")
def simulation(bar):
    """The bar's scene, read once."""
    from mpmjax.cli._scene_file import read_simulation

    return read_simulation(bar / "bar.toml")


@pytest.fixture
def copied(bar, tmp_path):
    for name in ("bar.toml", "tracks.csv", "front.csv"):
        (tmp_path / name).write_text((bar / name).read_text())
    return tmp_path


@pytest.mark.parametrize(("name", "line", "text", "says"), DATA.values(), ids=DATA)
def test_an_error_in_a_data_file_is_named_by_file_and_line(copied, simulation, name, line, text, says):
    lines = (copied / name).read_text().splitlines()
    (copied / name).write_text("\n".join([*lines[: line - 1], text, *lines[line:]]) + "\n")
    with pytest.raises(ValueError, match=says) as refusal:
        read_fit(copied / "bar.toml", lambda _: simulation)
    assert "\n" not in str(refusal.value)


WHOLE_FILES = {
    "empty": ("", r"front\.csv is empty"),
    "comments": ("# nothing\n", r"front\.csv is empty"),
    "no rows": ("time,x\n", r"a header and no rows"),
    "semicolons": ("time;x\n0.0;0.4\n", r"parted by ';'; part them by commas"),
    "a column twice": ("time,x,x\n0.0,0.4,0.4\n", r"line 1: the column 'x' is there twice"),
}


@pytest.mark.parametrize(("content", "says"), WHOLE_FILES.values(), ids=WHOLE_FILES)
def test_a_data_file_that_is_none_says_so(copied, simulation, content, says):
    (copied / "front.csv").write_text(content)
    with pytest.raises(ValueError, match=says):
        read_fit(copied / "bar.toml", lambda _: simulation)


def test_an_error_in_a_data_file_ends_the_command_and_keeps_what_was_written(copied):
    """One line, exit code 2, and pictures and numbers of an earlier fit stay."""
    for name in ("fit.png", "fit.json"):
        (copied / name).write_text("there before")
    (copied / "front.csv").write_text("time,x\n0.0,0.4\n0.004,?\n")
    said = refused("fit", copied / "bar.toml", "--plot", copied / "fit.png")
    assert "front.csv, line 3: x must be a finite number, got '?'" in said
    assert [(copied / name).read_text() for name in ("fit.png", "fit.json")] == ["there before"] * 2


def test_a_columns_unit_must_be_the_one_that_is_given(copied, simulation):
    """Also milliseconds, which are far beyond the run."""
    rows = (copied / "front.csv").read_text().splitlines()[1:]
    scaled = [f"{1e3 * float(t)},{1e3 * float(x)}" for t, x in (row.split(",") for row in rows)]
    (copied / "front.csv").write_text("\n".join(["time [ms],x_mm", *scaled]))
    table, old = (copied / "bar.toml").read_text(), 'time = "time"\nvalue = "x"'
    for keys, says in (
        ("", r"line 1: the column 'x_mm' states another unit than unit = 1: give unit = 0\.001"),
        ("unit = 1e-3", r"line 1: the column 'time \[ms\]' states another unit than time_unit = 1: give time_unit"),
        ("unit = 1e-3\ntime_unit = 1e-3", None),
    ):
        (copied / "bar.toml").write_text(table.replace(old, f'time = "time [ms]"\nvalue = "x_mm"\n{keys}'))
        if says is None:
            (found,) = read_fit(copied / "bar.toml", lambda _: replaced(simulation, copied)).experiments
            assert np.allclose(found.observations[1].times, np.arange(13) * 4e-3)
        else:
            with pytest.raises(ValueError, match=says):
                read_fit(copied / "bar.toml", lambda _: replaced(simulation, copied))


def replaced(simulation, folder):
    """The simulation with the [fit] table of a file."""
    return dataclasses.replace(simulation, fit=tomllib.loads((folder / "bar.toml").read_text())["fit"])


@pytest.mark.parametrize(
    ("head", "factor"),
    [("x [mm]", 1e-3), ("t (ms)", 1e-3), ("p_MPa", 1e6), ("x [m]", 1.0), ("x_m", None), ("x_max", None), ("x", None)],
)
def test_a_head_may_state_a_unit(head, factor):
    assert stated_unit(head) == factor


FAULTS = {
    "no file": ('"tracks.csv"', '"none.csv"', r"none\.csv"),
    "no column": ('marker = "marker"', 'marker = "number"', r"no column 'number'"),
    "no parameter": ("material.youngs_modulus", "material.stiffness", r"no 'stiffness'"),
    "no number": ('"scene.material.youngs_modulus"', '"scene.material"', r"must be a number"),
    "derived": ("material.youngs_modulus", "material.lame_lambda", r"follows from others"),
    "no root": ('"scene.material.youngs_modulus"', '"material.youngs_modulus"', r"begins with scene"),
    "several": (
        '"scene.material.youngs_modulus"',
        '"scene.boundary.position"',
        r"no 'position' there: name one of several before it, by its number from 0\.",
    ),
    "no report": ("material.shear_modulus", "material.bulk", r"no 'bulk'"),
    "kind": ('kind = "Tracks"', 'kind = "Traces"', r"kind must be one of"),
    "unknown key": ("report =", "reports =", r"unknown key"),
    "late": ("t1 = 0.048", "t1 = 0.9", r"must not lie after"),
    "no end": ("t1 = 0.048", "t1 = {}", r"t1\]? must be a number, got \{\}"),
    "many ends": ("t1 = 0.048", "t1 = [0.01, 0.02]", r"t1 must be a number, got \[0.01"),
    "a date": ("t1 = 0.048", "t1 = 2026-01-01", r"t1 must be a number, got datetime.date"),
    "bounds": ('unit = "Pa"', 'unit = "Pa"\nlower = 1.0', r"go with kind"),
    "twice": (
        'unit = "Pa"',
        'unit = "Pa"\n[[fit.parameter]]\npath = "scene.material.poisson_ratio"\nname = "E"',
        r"a name",
    ),
    "refinement": ("t1 = 0.048", "t1 = 0.048\nrefine = 0", r"refine must be growing whole numbers"),
    "optimiser": (
        "t1 = 0.048",
        't1 = 0.048\noptimiser = "Newton"',
        r"optimiser: .* 'Newton'\. It must be one of Adam, LBFGS, Lev",
    ),
    "starts": ("t1 = 0.048", 't1 = 0.048\nstarts = "many"', r"starts must be a whole number or 'auto', got 'many'"),
    "parameter": ('unit = "Pa"', 'kind = "Negative"', r"kind must be 'Positive' or .* or 'Spin', got 'Negative'"),
    "tolerance": ("t1 = 0.048", 't1 = 0.048\noptimiser = { kind = "LevenbergMarquardt", rtol = -1.0 }', r"rtol"),
    "path and kind": ('unit = "Pa"', 'kind = "Velocity"', r"takes no path"),
    "no path": ('path = "scene.material.youngs_modulus"', "", r"needs a path"),
    "an experiment": ('unit = "Pa"', "only = [3]", r"only must name experiments from 0 to 0"),
    "turning": ('path = "scene.material.youngs_modulus"', 'kind = "Spin"', r"in one dimension does not turn"),
    "unit": ("axis = 0", "axis = 0\nunit = 0.0", r"unit must be"),
    "dimension": ('place = ["x"]', 'place = ["x", "y"]', r"must be 1 columns"),
}


@pytest.mark.parametrize(("old", "new", "says"), FAULTS.values(), ids=FAULTS)
def test_a_bad_fit_table_gets_one_line(bar, old, new, says):
    assert old in FIT
    (bar / "bad.toml").write_text(BAR + FIT.replace(old, new, 1))
    assert re.search(says, refused("fit", bar / "bad.toml"))


def test_a_path_past_named_materials_is_told_their_names(bar):
    (bar / "named.toml").write_text(BAR.replace("[material]", "[material.gel]") + FIT)
    assert "name one of several before it, by its number from 0 or as gel." in refused("fit", bar / "named.toml")


def test_a_file_without_a_fit_says_so(bar):
    assert "has no [fit] table" in refused("fit", bar / "plain.toml")


def test_columns_name_the_row_that_is_no_number(tmp_path):
    (tmp_path / "a.csv").write_text("# comment\nx,y\n1,2\n3,four\n")
    with pytest.raises(ValueError, match=r"a\.csv, line 4: y must be a finite number, got 'four'"):
        read_columns(tmp_path / "a.csv", "x", "y")


@pytest.mark.slow
def test_the_fit_finds_rubbers_modulus(tmp_path):
    """The main job: within 3 % of 0.339 MPa, the closed form's least-squares answer, in steps of 137 dx/c."""
    code, out, err = shell("fit", RUBBER, "--plot", tmp_path / "fit.png")
    assert code == 0, err
    match = re.search(r"shear_modulus\s+(\S+) ± (\S+)", out)
    assert match is not None, out
    assert abs(float(match[1]) / 0.339e6 - 1) < 0.03
    assert 0 < float(match[2]) < 0.02e6
    found = read_fit(RUBBER).experiments[0]
    law = found.scene.material
    speed = np.sqrt(float(law.lame_lambda + 2 * law.shear_modulus) / 930)
    assert found.dt / (float(found.scene.grid.spacing) / speed) > 100


@pytest.mark.slow
def test_doubled_stresses_double_the_modulus():
    """A quasi-static curve is proportional to the modulus; on twice the spacing and step."""
    asked = read_fit(RUBBER)
    (curve,) = asked.experiments[0].observations
    grid = mpm.Grid((8, 14), 5e-3, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.01, 0.04)), grid, particles_per_cell=4, density=930.0, dtype="float64")
    fine = asked.experiments[0].scene
    scene = mpm.Scene(grid, fine.material, boundary=fine.boundary, description=mpm.TotalLagrangian())
    of = mpm.fitting.StressStretch.of(mpm.Box((0.0, 0.0), (0.01, 0.01)), particles, 1)
    once, twice = (
        mpm.fit(
            mpm.Experiment(
                scene,
                particles,
                t1=0.35,
                dt=5e-3,
                method=mpm.SemiImplicit(),
                observations=mpm.Curve(curve.x, factor * curve.data, of),
            ),
            {"E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=1e6 * factor)},
        )["E"]
        for factor in (1, 2)
    )
    assert twice.value / once.value == pytest.approx(2, rel=1e-4)
    assert twice.error / once.error == pytest.approx(2, rel=1e-3)


def test_a_gauge_weighs_by_volume_and_must_hold_particles():
    grid = mpm.Grid((10, 22), 2.5e-3, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.01, 0.04)), grid, particles_per_cell=4, density=930.0)
    curve = mpm.fitting.StressStretch.of(mpm.Box((0.0, 0.0), (0.01, 0.01)), particles, 1)
    assert float(curve.weight.sum()) == pytest.approx(1)
    law = mpm.NeoHookean(1e6, 0.4)
    F = 2 * np.broadcast_to(np.eye(2), (particles.count, 2, 2))
    scene = mpm.Scene(grid, law)
    stretched = mpm.prepare(scene, dataclasses.replace(particles, deformations=(jnp.asarray(F),)))
    stretch, stress = curve(scene, stretched)
    assert float(stretch) == pytest.approx(2)
    assert float(stress) == pytest.approx(float(law.stress(2 * jnp.eye(2)[..., None])[1, 1, 0]))
    with pytest.raises(ValueError, match="holds no particle"):
        mpm.fitting.StressStretch.of(mpm.Box((1.0, 1.0), (2.0, 2.0)), particles, 1)
    with pytest.raises(ValueError, match="axis must be below 2"):
        mpm.fitting.StressStretch.of(mpm.Box((0.0, 0.0), (0.01, 0.01)), particles, 2)
