"""The README and the documentation say what happens: links lead somewhere, snippets run, equations exist."""

import ast
import dataclasses
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from textwrap import dedent

import pytest

from mpmjax.io._schema import decode, saved_classes

ROOT = Path(__file__).parents[1]
PAGES = {p.relative_to(ROOT).as_posix(): p for p in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))}
SNIPPET = re.compile(r"^( *)```python\n(.*?)^ *```$", re.DOTALL | re.MULTILINE)
"""A block of Python: every one runs as it stands."""
TOML = re.compile(r"```toml\n(.*?)```", re.DOTALL)
CONTINUED = {
    "docs/features.md": "README.md",
    "docs/fitting.md": "docs/tutorial_fit.md",
    "docs/notes/file_format.md": "docs/scene_files.md",
}
"""Pages whose snippets continue those of another page, as they say."""


def snippets(page):
    return [dedent(code) for _, code in SNIPPET.findall(PAGES[page].read_text(encoding="utf-8"))]


def anchors(path):
    """Ids of a page: those written as HTML, and of headings as GitHub makes them."""
    text = re.sub(r"```.*?```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = (re.sub(r"\[(.*?)\]\(.*?\)", r"\1", h).lower() for h in re.findall(r"^#+ (.*)$", text, re.MULTILINE))
    return {re.sub(r"[^\w\- ]", "", h).replace(" ", "-") for h in headings} | set(re.findall(r'<a id="(.*?)">', text))


def equations_cited(text):
    """Numbers of the derivation's equations that a text cites; "eqs. 7 to 12" cites 7 and 12."""
    cited = re.findall(r"derivation\b[^.;()]{0,20}?\beqs?\.\s+(\d+)(?:\s+(?:to|and)\s+(\d+))?", text)
    return {number for pair in cited for number in pair if number}


@pytest.mark.thorough
def test_quick_start_runs_as_written_and_ends_in_a_gradient(tmp_path):
    """The README's Python block, run as a fresh program, prints the gradient that the README states."""
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert abs(float(ran.stdout) + 6.18e-7) < 0.03e-7
    assert (tmp_path / "jelly.vtkhdf").exists()


def test_scene_files_documentation_names_every_class_and_key():
    """What a scene file can say stands in its documentation."""
    text = (ROOT / "docs" / "scene_files.md").read_text(encoding="utf-8")
    words = set(re.findall(r"\w+", text))
    # of each of these one class fits the key, so none is named
    by_key = {"Scene", "Grid", "Bodies", "Motion", "BSpline", "ConjugateResidual"}
    names = {c.__name__ for c in saved_classes()} - by_key
    keys = {f.name for c in saved_classes() for f in dataclasses.fields(c)}
    assert names | keys <= words, (names | keys) - words


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_to_files_and_headings(page):
    """Every relative link of a page, pictures included, with its anchor."""
    text = re.sub(r"```.*?```|`[^`\n]*`", "", PAGES[page].read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if "://" in target:
            continue
        name, _, anchor = target.partition("#")
        path = (PAGES[page].parent / name).resolve() if name else PAGES[page]
        assert path.exists(), f"{page} links to {target}"
        assert not anchor or anchor in anchors(path), f"{page} links to {target}"


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_exist(page):
    """Tests, scripts and examples, by their path from the root; NAME stands for any."""
    text = PAGES[page].read_text(encoding="utf-8")
    named = set(re.findall(r"\b(?:tests|benchmarks|examples|mpmjax)/[\w/]+\.(?:py|toml|md|ipynb)\b", text))
    assert not {name for name in named if "NAME" not in name and not (ROOT / name).exists()}


def test_equations_that_are_cited_stand_in_the_derivation():
    """Those of docstrings and of pages; a number that is gone would send the reader astray."""
    files = [
        *ROOT.glob("mpmjax/**/*.py"),
        *ROOT.glob("native/*.h"),
        *ROOT.glob("native/*.cc"),
        *ROOT.glob("benchmarks/*.py"),
        *PAGES.values(),
    ]
    cited = {f"eq-{n}": path.name for path in files for n in equations_cited(path.read_text(encoding="utf-8"))}
    assert len(cited) > 12
    there = anchors(PAGES["docs/derivation.md"])
    assert not {number: name for number, name in cited.items() if number not in there}


def test_every_block_of_python_is_one_that_runs():
    for page, path in PAGES.items():
        assert len(re.findall("```python", path.read_text(encoding="utf-8"))) == len(snippets(page)), page


@pytest.mark.thorough
@pytest.mark.parametrize("page", [page for page in PAGES if page not in CONTINUED.values() and snippets(page)])
def test_the_snippets_of_a_page_run_in_their_order(page, tmp_path):
    """As one program, in an empty folder beside the examples; a TOML block with laws then names what is there."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    code = "\n".join((*(snippets(CONTINUED[page]) if page in CONTINUED else ()), *snippets(page)))
    laws = [tomllib.loads(text)["material"] for text in TOML.findall(PAGES[page].read_text("utf-8")) if "[mat" in text]
    code += "".join(
        f"\nfrom mpmjax.io import decode\ndecode({law!r}, mpm.AbstractMaterial, '[material]')" for law in laws
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.thorough
def test_the_notebook_runs_and_shows_what_it_makes(tmp_path):
    """Its cells as one program without a display; that a notebook imports the package is enough for the views."""
    cells = json.loads((ROOT / "examples/first_steps.ipynb").read_text(encoding="utf-8"))["cells"]
    code = "import sys\nsys.modules['marimo'] = sys\n"
    code += "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    code += "\nassert all(thing._repr_html_()[0] == '<' for thing in (scene, run, result))"
    environment = os.environ | {"MPLBACKEND": "Agg"}
    ran = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr


def test_toml_blocks_say_what_files_can_say():
    """Those of the tutorial of fits stand in examples/rubber.toml, that of docs/extending.md names a law which its
    snippets register; no page has others."""

    def within(part, whole):
        if isinstance(part, dict):
            return isinstance(whole, dict) and all(k in whole and within(part[k], whole[k]) for k in part)
        tables = isinstance(part, list) and part and isinstance(part[0], dict)
        return all(any(within(a, b) for b in whole) for a in part) if tables else part == whole

    tables = {page: list(map(tomllib.loads, TOML.findall(p.read_text("utf-8")))) for page, p in PAGES.items()}
    example = tomllib.loads((ROOT / "examples/rubber.toml").read_text(encoding="utf-8"))
    assert all(within(table, example) for table in tables["docs/tutorial_fit.md"])
    laws = [f"class {table['material']['kind']}(" for table in tables["docs/extending.md"]]
    assert all(any(law in code for code in snippets("docs/extending.md")) for law in laws)
    counts = {page: len(each) for page, each in tables.items() if each}
    assert counts == {"docs/tutorial_fit.md": 2, "docs/extending.md": 1}


@pytest.mark.parametrize("page", PAGES)
def test_tables_within_a_line_can_be_read(page):
    """Each `{ kind = "...", ... }` without dots, of a kind that is the package's, makes an object."""
    kinds = {c.__name__: c for c in saved_classes()}
    for text in re.findall(r"`(\{ kind = [^`]*\})`", PAGES[page].read_text(encoding="utf-8")):
        if "..." not in text:
            table = tomllib.loads(f"table = {text}")["table"]
            assert isinstance(decode(table, kinds[table["kind"]]), kinds[table["kind"]]), text


def test_the_page_of_a_step_names_files_and_functions_that_exist():
    """Each "`file.py`: `function`, ..." of its tables, and each line of its call tree."""
    text = (ROOT / "docs" / "step.md").read_text(encoding="utf-8")
    named = re.findall(r"`(\w+/_\w+\.py)`((?:: `\w+`(?:, `\w+`)*)?)", text)
    tree = [(path, f"`{name}`") for name, path in re.findall(r"(\w+)(?: °)?(?: \(for it\))? +(\w+/_\w+\.py)", text)]
    assert len(named) > 15
    assert len(tree) > 15
    for path, functions in (*named, *tree):
        source = (ROOT / "mpmjax" / path).read_text(encoding="utf-8")
        for name in re.findall(r"`(\w+)`", functions):
            assert re.search(rf"(def|class) {name}\b", source), f"{name} is not in {path}"


def test_messages_that_are_explained_are_said():
    """Each that docs/faq.md quotes stands in a string of the package."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in ROOT.glob("mpmjax/**/*.py"))
    nodes = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Constant))
    texts = [" ".join(node.value.split()) for node in nodes if isinstance(node.value, str)]
    quoted = re.findall(r'\*\*"(.*?)"\*\*', " ".join(PAGES["docs/faq.md"].read_text(encoding="utf-8").split()))
    assert len(quoted) > 10
    assert not [text for text in quoted if not any(text in each for each in texts)]
