"""Ctrl-C and SIGTERM end a command at any moment with their own code and one line; a live run has one writer."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import equinox as eqx
import pytest
from shell import refused, shell

import mpmjax as mpm

SCENE = """
gravity = [-0.1]

[grid]
shape = [12]
spacing = 0.1
origin = [-3]

[material]
kind = "FixedCorotated"
youngs_modulus = 1e4
poisson_ratio = 0.3

[[boundary]]
kind = "SlipBox"
lower = [0.0]
upper = [inf]

[[particles]]
region = { kind = "Box", lower = [0.1], upper = [0.4] }
density = 1e3

[run]
t1 = 1e4
dt = 1e-3
save_every = 10
"""
SIGNALS = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "told to end")}


def wait_for(condition: Callable[[], bool], process: subprocess.Popen) -> None:
    """Until the condition holds, as long as the process runs."""
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def frames_in(path: Path) -> int:
    try:
        return len(mpm.load(path))
    except ValueError:  # not there, or just being written
        return 0


@pytest.fixture
def begun(tmp_path) -> Iterator[Callable[..., subprocess.Popen]]:
    """Begins a command of the shell in a process of its own; what still runs at the end is killed."""
    processes = []

    def begin(*words: str, scene: str = SCENE) -> subprocess.Popen:
        (tmp_path / "scene.toml").write_text(scene)
        command = [sys.executable, "-u", "-c", "from mpmjax_command import main; main()", *words]
        processes.append(
            subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
        return processes[-1]

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def finish(process: subprocess.Popen) -> None:
    """Once the process has ended without a fault; `wait` does not read what it says, and a full pipe stops it."""
    _, err = process.communicate()
    assert process.returncode == 0, err


def ended(process: subprocess.Popen, number: signal.Signals) -> str:
    """The line that the process ends with when it gets the signal."""
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    code, what = SIGNALS[number]
    assert process.returncode == code, err
    lines = [line for line in err.splitlines() if line and not re.search(r"\d+/\d+ \[", line)]  # but for the bar
    assert len(lines) == 1, err
    assert lines[0].startswith(f"mpmjax: {what}. ")
    return lines[0]


@pytest.mark.thorough
def test_a_signal_ends_a_run_wherever_it_is(begun, tmp_path):
    """While its steps are compiled, and amid writing frames as fast as it can; meanwhile nobody else writes there."""
    path = tmp_path / "run.h5"
    compiling = begun("run", "scene.toml", "-o", "run.h5", "--quiet")
    wait_for(lambda: frames_in(path) > 0, compiling)
    line = ended(compiling, signal.SIGINT)
    assert re.search(r"run\.h5 holds \d+ frames?, the last of step \d+ \(t = \S+ s\)\. Resume it to continue\.$", line)

    stepping = begun("run", "scene.toml", "-o", "run.h5", "--resume")
    wait_for(lambda: frames_in(path) > 5, stepping)
    for choice in ("--resume", "--overwrite"):
        assert "is being written by another run" in refused("run", tmp_path / "scene.toml", "-o", path, choice)
    line = ended(stepping, signal.SIGTERM)
    run = mpm.load(path)
    assert f"run.h5 holds {len(run)} frames, the last of step {int(run.final_step)} (t = " in line
    assert run.steps.tolist() == list(range(0, 10 * len(run), 10))


@pytest.mark.slow
def test_a_signal_ends_a_run_at_any_moment(begun, tmp_path):
    """From the first import to the summary, whole files every time."""
    path, scene = tmp_path / "run.h5", SCENE.replace("1e4\ndt", "0.2\ndt")
    begin = time.perf_counter()
    finish(begun("run", "scene.toml", "-o", "run.h5", scene=scene))
    whole, seconds = mpm.load(path), time.perf_counter() - begin
    for i in range(10):
        path.unlink(missing_ok=True)
        process = begun("run", "scene.toml", "-o", "run.h5", scene=scene)
        time.sleep(seconds * (i + 0.5) / 10)
        number = (signal.SIGINT, signal.SIGTERM)[i % 2]
        process.send_signal(number)
        _, err = process.communicate(timeout=60)
        assert process.returncode in (0, 128 + number, -number), err  # minus: by the system, amid imports
        assert err.count("mpmjax: ") == (process.returncode > 0), err
        assert "Traceback" not in err
        if path.exists():
            assert shell("run", tmp_path / "scene.toml", "-o", path, "--resume", "--quiet")[0] == 0
            assert eqx.tree_equal(mpm.load(path), whole)


def test_a_signal_ends_what_writes_no_file(begun, tmp_path):
    process = begun("chart", "scene.toml", scene=SCENE.replace("1e4\ndt", "1.0\ndt"))
    assert process.stdout is not None
    assert "method" in process.stdout.readline()
    assert ended(process, signal.SIGTERM).endswith("No file was being written.")
    assert os.listdir(tmp_path) == ["scene.toml"]


FIT = """
[fit]
[[fit.parameter]]
path = "scene.material.youngs_modulus"
start = 3e4
[[fit.observation]]
kind = "Extent"
data = "front.csv"
time = "t"
value = "x"
axis = 0
"""


@pytest.mark.thorough
def test_a_signal_ends_a_fit_with_the_best_so_far(begun, tmp_path):
    """Its table, picture and numbers are there; killed and resumed it ends with the numbers of the whole fit, to the
    last bit."""
    (tmp_path / "front.csv").write_text("t,x\n0.5,0.361\n1.0,0.334\n1.5,0.318\n2.0,0.326\n2.5,0.340\n")
    scene = SCENE.replace("1e4\ndt", "2.5\ndt").replace("dt = 1e-3", "dt = 4e-4")
    scene += FIT.replace("[fit]\n", "[fit]\ndiscretisation = false\n")
    finish(begun("fit", "scene.toml", "--plot", "whole.png", scene=scene))

    def signalled(number, *options):
        """A fit that gets a signal after the first iteration that it tells of: its code, and what it said since."""
        process = begun("fit", "scene.toml", *options, scene=scene)
        assert process.stdout is not None
        assert process.stderr is not None
        next(said for said in process.stderr if "  misfit " in said)
        process.send_signal(number)
        err = process.stderr.read()  # not communicate(): it would miss the lines that are buffered
        return process.wait(timeout=60), process.stdout.read(), err

    for number in (signal.SIGTERM, signal.SIGINT):
        (tmp_path / "fit.h5").unlink(missing_ok=True)
        code, out, err = signalled(number, "--log", "fit.h5")
        expected, what = SIGNALS[number]
        assert code == expected, err
        _, told, after = err.partition(f"mpmjax: {what}. The fit ends after the iteration in progress")
        assert told, err
        assert after.count("  misfit ") <= 1  # the iteration in progress
        assert "NOT CONVERGED" in out
        numbers = json.loads((tmp_path / "scene_fit.json").read_text())
        assert numbers["interrupted"]
        assert 1 <= len(numbers["iterations"]) < len(json.loads((tmp_path / "whole.json").read_text())["iterations"])
        assert (tmp_path / "scene_fit.png").stat().st_size > 10_000
    signalled(signal.SIGKILL, "--log", "fit.h5", "--resume")
    finish(begun("fit", "scene.toml", "--log", "fit.h5", "--resume", scene=scene))
    assert (tmp_path / "scene_fit.json").read_text() == (tmp_path / "whole.json").read_text()


def test_a_signal_that_is_ignored_stays_ignored(tmp_path):
    """As for a command in the background of a script, or under nohup."""
    program = """
import os, signal
from mpmjax.io._transactional_file import end_on_signals
signal.signal(signal.SIGINT, signal.SIG_IGN)
end_on_signals()
os.kill(os.getpid(), signal.SIGINT)
print("alive")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, "alive\n")
