"""The published scenes stay files that the package reads, each with a row of the table."""

import ast
from pathlib import Path

import pytest

import mpmjax as mpm

FOLDER = Path(__file__).parents[1] / "benchmarks" / "published"
FILES = sorted(FOLDER.glob("*.toml"))


@pytest.mark.filterwarnings("ignore:The body is 1 cells thick")
@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_a_published_scene_is_read_and_says_where_it_is_from(file):
    """Its particles lie in its grid, its run ends at a whole step, and its first lines name a source and an answer."""
    _, particles, settings = mpm.load_scene(file)
    assert particles.count > 10
    assert settings["t1"] > 0
    head = file.read_text(encoding="utf-8").split("\n\n")[0]
    assert "# Asked: " in head


def test_the_table_has_a_row_for_each_published_scene():
    tree = ast.parse((FOLDER / "table.py").read_text(encoding="utf-8"))
    (scenes,) = (node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "SCENES")
    assert sorted(key.value for key in scenes.keys) == [file.stem for file in FILES]
