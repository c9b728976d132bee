"""The README says what happens."""

import dataclasses
import re
import subprocess
import sys
from pathlib import Path

from mpmjax.io._schema import saved_classes

ROOT = Path(__file__).parents[1]


def test_quick_start_runs_as_written_and_ends_in_a_gradient(tmp_path):
    """The README's Python block, run as a fresh program, prints the gradient that the README states."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert abs(float(ran.stdout) + 6.18e-7) < 0.03e-7
    assert (tmp_path / "jelly.h5").exists()


def test_scene_files_documentation_names_every_class_and_key():
    """What a scene file can say stands in its documentation."""
    text = (ROOT / "docs" / "scene_files.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    # of each of these one class fits the key, so none is named
    by_key = {"Scene", "Grid", "Bodies", "Motion", "BSpline", "ConjugateResidual"}
    names = {c.__name__ for c in saved_classes()} - by_key
    keys = {f.name for c in saved_classes() for f in dataclasses.fields(c)}
    assert names | keys <= words, (names | keys) - words
