"""The log of a fit: whatever ends it, it is continued to the same bits; and what is said while a fit runs."""

import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpmjax as mpm
from mpmjax.fitting import _search
from mpmjax.fitting._log import _Log, described, iterations_left

fit = partial(mpm.fit, discretisation=False)  # most of these tests are of the search

DT, STEPS = 4e-3, 12
PARAMETERS = {
    "E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=1.6e5, unit="Pa"),
    "speed": mpm.Unbounded(update=lambda e, s: eqx.tree_at(lambda e: e.particles.v, e, s * e.particles.v), start=0.7),
}


def bar(E=7e4):
    grid = mpm.Grid((12,), 0.1, origin=(-4,))
    particles = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3)
    particles = eqx.tree_at(lambda q: q.v, particles, 1.5 * (particles.x - 0.2))
    return mpm.Scene(grid, mpm.NeoHookean(E, 0.3)), particles


def experiment():
    """A bar that vibrates, seen twice with noise that is not known: the fit takes rounds."""
    scene, particles = bar()
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=1)
    random, x = np.random.default_rng(0), np.asarray(run.frames.x)[1:]
    seen = x[:, ::3] + 1e-4 * random.normal(size=x[:, ::3].shape)
    front = x.max(axis=1)[:, 0] + 1e-3 * random.normal(size=STEPS)
    times = np.arange(1, STEPS + 1) * DT
    observed = [
        mpm.Tracks(times, seen, which=np.arange(0, particles.count, 3)),
        mpm.Series(times, front, mpm.fitting.Extent(0), name="front"),
    ]
    return mpm.Experiment(scene, particles, t1=STEPS * DT, dt=DT, observations=observed)


@pytest.fixture(scope="module")
def seen():
    return experiment()


@pytest.fixture(scope="module")
def whole(seen, tmp_path_factory):
    """The fit, its log, and what it said."""
    path, lines = tmp_path_factory.mktemp("log") / "fit.h5", []
    return fit(seen, PARAMETERS, log=path, progress=lines.append), path, lines


def stop_after(lines):
    """Progress that is Ctrl-C at a line."""

    def progress(line):
        nonlocal lines
        lines -= 1
        if lines == 0:
            raise KeyboardInterrupt

    return progress


def assert_same(a, b):
    """All numbers of two results, bit for bit."""
    names = {f.name for f in fields(a)} - {"problem", "experiments", "runs"}  # functions; a log holds no run
    one, other = ({name: getattr(r, name) for name in names} for r in (a, b))
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert np.array_equal(x, y, equal_nan=not isinstance(x, str))


def test_a_fit_is_the_same_with_a_log_and_takes_rounds(whole, seen):
    found, path, _ = whole
    assert sum(i.number == 0 for i in found.history) > 2
    assert_same(fit(seen, PARAMETERS), found)
    assert os.listdir(path.parent) == ["fit.h5"]


@pytest.mark.parametrize("after", [1, 3, 9])
def test_an_interrupted_fit_is_continued_to_the_same_bits(whole, seen, tmp_path, after):
    """Ctrl-C after iterations of the first and of a later round of the noise."""
    with pytest.warns(UserWarning, match="was interrupted"):
        part = fit(seen, PARAMETERS, log=tmp_path / "fit.h5", progress=stop_after(1 + after))
    assert part.interrupted
    assert len(part.history) == after < len(whole[0].history)
    assert eqx.tree_equal(part.history, whole[0].history[:after])
    assert_same(fit(seen, PARAMETERS, log=tmp_path / "fit.h5", resume=True), whole[0])


def test_a_fit_that_was_done_is_its_result_at_once(whole, seen, monkeypatch):
    monkeypatch.setattr(_search, "iterate", None)
    lines = []
    assert_same(fit(seen, PARAMETERS, log=whole[1], resume=True, progress=lines.append), whole[0])
    assert f"after {len(whole[0].history)} iterations of the log" in lines[0]


def test_a_log_without_iterations_begins_the_fit(whole, seen, tmp_path, monkeypatch):
    """As of a process that was killed while it compiled."""
    with monkeypatch.context() as patched:
        patched.setattr(_search, "iterate", None)
        with pytest.raises(TypeError):
            fit(seen, PARAMETERS, log=tmp_path / "fit.h5")
    assert_same(fit(seen, PARAMETERS, log=tmp_path / "fit.h5", resume=True), whole[0])


def test_a_script_reads_the_log(whole):
    """As docs/fitting.md says."""
    found, path, _ = whole
    with h5py.File(path) as f:
        rows, values = f["iterations"][:], f["values"][:]
        labels = json.loads(f["values"].attrs["labels"])
        assert f["noise/1"].attrs["name"] == "front"
        noise = f["noise/1"][:]
        z = f["coordinates"][:]
    assert labels == ["E", "speed"]
    assert rows["number"].tolist() == [i.number for i in found.history]
    assert rows["cost"].tolist() == [i.cost for i in found.history]
    assert rows["gradient"].tolist() == [i.gradient for i in found.history]
    assert rows["accepted"].tolist() == [i.accepted for i in found.history]
    assert (np.diff(rows["seconds"]) > 0).all()
    assert np.array_equal(z, [i.z for i in found.history])
    assert values[-1] == pytest.approx([found["E"].value, found["speed"].value])
    assert values[0] == pytest.approx([1.6e5, 0.7])
    assert len(noise) == rows["round"][-1] + 1
    assert noise[-1] == pytest.approx(found.noise[1].sigma, rel=1e-2)


def other_data(e):
    return replace(e, observations=eqx.tree_at(lambda o: o.data, e.observations[0], e.observations[0].data + 1e-9))


OTHERS = {
    "data": (other_data, {}, {}, r"observations"),
    "law": (
        lambda e: eqx.tree_at(lambda e: e.scene.material.poisson_ratio, e, jnp.asarray(0.31)),
        {},
        {},
        r"experiments\.0\.scene\.material\.poisson_ratio is 0\.3 there and 0\.31 here",
    ),
    "start": (lambda e: e, {"E": replace(PARAMETERS["E"], start=2e5)}, {}, r"parameters\.E\.start is 160000\.0 there"),
    "parameter": (
        lambda e: e,
        {"E": replace(PARAMETERS["E"], where=lambda e: e.scene.material.poisson_ratio)},
        {},
        r"parameters\.E is Positive of scene\.material\.youngs_modulus there and Positive of scene\.material\.poisson",
    ),
    "update": (
        lambda e: e,
        {"speed": mpm.Unbounded(lambda e: e.particles.x, start=0.7)},
        {},
        r"The parameter 'speed' must name",
    ),
    "method": (
        lambda e: e,
        {},
        {"optimiser": mpm.fitting.LevenbergMarquardt(rtol=1e-7)},
        r"optimiser\.rtol is 1e-06 there and 1e-07 here",
    ),
}


@pytest.mark.parametrize(("change", "parameters", "others", "says"), OTHERS.values(), ids=OTHERS)
def test_the_log_of_another_fit_is_refused_in_one_line(whole, seen, change, parameters, others, says):
    before = whole[1].read_bytes()
    with pytest.raises(ValueError, match=says):
        fit(change(seen), PARAMETERS | parameters, log=whole[1], resume=True, **others)
    assert whole[1].read_bytes() == before


@pytest.mark.thorough
def test_a_fit_that_was_too_short_goes_on(whole, seen, tmp_path):
    """With more iterations allowed."""
    path = tmp_path / "fit.h5"
    with pytest.warns(UserWarning, match="did not converge"):
        fit(seen, PARAMETERS, log=path, optimiser=mpm.fitting.LevenbergMarquardt(max_steps=2))
    assert_same(fit(seen, PARAMETERS, log=path, resume=True), whole[0])


def test_what_is_no_log_is_refused_and_stays(whole, seen, tmp_path):
    path = tmp_path / "fit.h5"
    for resume, says in ((True, "does not exist"), (False, "exists: choose another name")):
        with pytest.raises(ValueError, match=says):
            fit(seen, PARAMETERS, log=path, resume=resume)
        path.write_bytes(whole[1].read_bytes())
    with pytest.raises(ValueError, match="no folder"):
        fit(seen, PARAMETERS, log=tmp_path / "nowhere" / "fit.h5")
    with pytest.raises(ValueError, match="name it by log"):
        fit(seen, PARAMETERS, resume=True)
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = 1.0
    with pytest.raises(ValueError, match="is not the log of a fit"):
        fit(seen, PARAMETERS, log=tmp_path / "other.h5", resume=True)


def test_a_damaged_log_is_refused(whole, seen, tmp_path):
    """Whatever bit of a scalar is wrong, whatever stands at zero, and bits all over; a log of before is named."""
    path, data, (problem, method) = tmp_path / "fit.h5", whole[1].read_bytes(), (whole[0].problem, whole[0].optimiser)
    flipped, zeros = list(range(8, len(data), len(data) // 40)), []
    with h5py.File(whole[1]) as file:

        def add(_, item):
            if isinstance(item, h5py.Dataset) and item.ndim == 0:
                flipped.append(item.id.get_offset() + item.dtype.itemsize - 1)
            elif isinstance(item, h5py.Dataset) and item.size:
                zeros.append((item.id.get_offset(), bytes(item.id.get_storage_size())))

        file.visititems(add)
    assert len(zeros) > 5 <= len(flipped) - 40  # five scalars
    for at, damage in [*zeros, *((at, bytes([data[at] ^ 1 << at % 8])) for at in flipped)]:
        path.write_bytes(data[:at] + damage + data[at + len(damage) :])
        with pytest.raises(ValueError, match=rf"^{path} (is damaged|is not the log)"):
            _Log(problem, described(problem, method)).read(path, method)
    with h5py.File(path, "w") as file:
        file.attrs["kind"], file.attrs["format"] = np.bytes_("mpmjax fit log"), 1
    with pytest.raises(ValueError, match=r"is a log of format 1, this mpmjax reads 4: begin the fit anew"):
        fit(seen, PARAMETERS, log=path, resume=True)


def test_a_log_has_one_writer(seen, tmp_path):
    path, said = tmp_path / "fit.h5", []

    def progress(line):
        if not said and line.lstrip().startswith("1 "):
            with pytest.raises(ValueError, match="is being written by another run") as refused:
                fit(seen, PARAMETERS, log=path, resume=True)
            said.append(str(refused.value))

    fit(seen, PARAMETERS, log=path, progress=progress)
    assert said


def test_a_log_that_was_replaced_meanwhile_is_left_alone(seen, tmp_path):
    """One that was removed is written anew, whole."""
    path = tmp_path / "fit.h5"

    def progress(line):
        if line.lstrip().startswith("1 "):
            path.unlink()
        elif line.lstrip().startswith("2 "):
            with h5py.File(path) as f:
                assert len(f["iterations"]) == 3
            path.unlink()
            path.write_text("another")

    with pytest.raises(OSError, match=r"fit\.h5 was replaced by another file while it was written"):
        fit(seen, PARAMETERS, log=path, progress=progress)
    assert path.read_text() == "another"


def test_a_full_disk_leaves_the_log_as_it_was(whole, seen, tmp_path, monkeypatch):
    path, full = tmp_path / "fit.h5", OSError(28, "No space left on device")

    def progress(line):
        if line.lstrip().startswith("2 "):
            monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(full))

    with pytest.raises(OSError, match=r"No space left on device.*make room, then resume"):
        fit(seen, PARAMETERS, log=path, progress=progress)
    monkeypatch.undo()
    with h5py.File(path) as f:
        assert len(f["iterations"]) == 3
    assert os.listdir(tmp_path) == ["fit.h5"]
    assert_same(fit(seen, PARAMETERS, log=path, resume=True), whole[0])


PROGRAM = """
import os, signal, sys
sys.path.insert(0, {folder!r})
import jax
jax.config.update("jax_enable_x64", True)
from test_fit_log import PARAMETERS, experiment
import mpmjax as mpm
left = {after} + 1
def progress(line):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
mpm.fit(experiment(), PARAMETERS, discretisation=False, log={log!r}, progress=progress)
"""


@pytest.mark.thorough
@pytest.mark.parametrize("after", [2, 7])
def test_a_killed_fit_is_continued_to_the_same_bits(whole, seen, tmp_path, after):
    """By another process."""
    program = PROGRAM.format(folder=str(Path(__file__).parent), after=after, log=str(tmp_path / "fit.h5"))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert done.returncode == -signal.SIGKILL, done.stderr
    with h5py.File(tmp_path / "fit.h5") as f:
        assert len(f["iterations"]) == after
    assert_same(fit(seen, PARAMETERS, log=tmp_path / "fit.h5", resume=True), whole[0])


def test_progress_tells_what_is_going_on(whole):
    """Before the first iteration, at each with the same figures as the history, and how long it may take."""
    found, _, lines = whole
    assert lines[0] == "compiling the fit of 2 numbers (E, speed) to 48 that were measured"
    assert len(lines) == 1 + len(found.history)
    for line, iteration in zip(lines[1:], found.history, strict=True):
        shown = re.match(r" *(\d+)  misfit +(\S+)  gradient +(\S+)  E (\S+), speed (\S+)  (\S+) s(.*)$", line)
        assert shown is not None, line
        assert int(shown[1]) == iteration.number
        assert float(shown[2]) == pytest.approx(2 * iteration.cost, rel=1e-3)
        assert float(shown[4]) == pytest.approx(1.6e5 * np.exp(iteration.z[0]), rel=1e-4)
        assert re.fullmatch(r"(, (at most|about) \S+ (s|min|h) left)?", shown[7])
    assert "left" not in lines[1]
    assert ", at most " in lines[2]
    assert any(", about " in line for line in lines)


def test_time_left_follows_the_rate_at_which_the_distance_falls():
    """A distance that falls by ten an iteration from 10⁴ needs four; one that grows says nothing."""
    assert iterations_left([1e6, 1e5, 1e4]) == 4
    assert iterations_left([1e9, 1e6, 1e5, 2e4]) == 6  # of the last three: √50 an iteration, √50⁵ < 2·10⁴ < √50⁶
    assert iterations_left([1e5, 1e4]) is None
    assert iterations_left([1e3, 1e4, 1e5]) is None
    assert iterations_left([np.nan, 1e4, 1e3]) is None
