"""Hooks of MkDocs: the pages as GitHub shows them, formulas as MathML, and a page of the reference for each room."""

import ast
import re
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
OUTSIDE = {"README.md": "index.md", "CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
"""Pages that stand beside docs/, and what the site calls them."""
REFERENCE = {
    "scene": ("state", "discretisation", "geometry", "boundary", "extensions"),
    "laws": ("material", "linalg"),
    "steps": ("stepping", "implicit", "potential"),
    "running": ("simulation", "analysis", "io", "viz", "cli", "native"),
    "fitting": ("fitting",),
    "testing": ("verification", "autodiff"),
}
"""The rooms on each page of the reference."""


def _exported(room: str) -> list[str]:
    """The public names of a room, by the imports of its `__init__.py`, or of the package, by those of its stub."""
    stub = "__init__.py" if room else "__init__.pyi"
    tree = ast.parse((ROOT / "mpmjax" / room / stub).read_text(encoding="utf-8"))
    aliases = [a for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for a in node.names]
    return [a.name for a in aliases if a.asname == a.name and not (ROOT / "mpmjax" / a.name).is_dir()]


def _reference(title: str, rooms: tuple[str, ...], first: set[str]) -> str:
    """The page of some rooms; each name stands once, as `mpmjax` or else its room exports it."""
    names = [(name not in first, room, name) for room in rooms for name in _exported(room)]
    names.sort(key=lambda each: each[0])  # what first scenes need comes first
    lines = [f"::: mpmjax.{f'{room}.' if rare else ''}{name}" for rare, room, name in names]
    return "\n\n".join([f"# Reference: {title}", *lines])


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that stand outside of docs/, and those of the reference."""
    for name, page in OUTSIDE.items():
        text = (ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    for name in ("LICENSE", "CITATION.cff"):
        files.append(File.generated(config, name, abs_src_path=str(ROOT / name)))
    first = set(_exported(""))
    for page, rooms in REFERENCE.items():
        files.append(File.generated(config, f"reference/{page}.md", content=_reference(page, rooms, first)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Formulas as MathML, which needs no script, and links to pages outside of docs/ by their names here."""

    def formula(block: re.Match) -> str:
        number = re.search(r"\\tag\{(\d+)\}", block[1])
        label = f'<span class="number">({number[1]})</span>' if number else ""
        # the converter has another name for aligned lines, and browsers have no script letters but Unicode's
        text = re.sub(r"\\tag\{\d+\}", "", block[1]).replace("{aligned}", "{split}").replace(r"\mathcal E", "𝓔")
        return f'<div class="formula">{convert(text, display="block")}{label}</div>\n'

    markdown = re.sub(r"^```math\n(.*?)^```\n", formula, markdown, flags=re.DOTALL | re.MULTILINE)
    for name, page in OUTSIDE.items():
        markdown = re.sub(rf"\]\((?:\.\./)?((?:\.\./)*){name}", rf"](\1{page}", markdown)
    return markdown
