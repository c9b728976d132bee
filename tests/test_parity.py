"""docs/parity.md says what works with what: its ticks are asked for by the tests that it names, and what it refuses is
refused."""

import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

import mpmjax as mpm

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs/parity.md").read_text(encoding="utf-8")
HEAD, *ROWS = [[cell.strip() for cell in line.split("|")[1:-1]] for line in PAGE.splitlines() if line.startswith("| ")]
PARITY = {row[0]: dict(zip(HEAD, row, strict=True)) for row in ROWS}
ASKED = {
    "reverse": r"\bgrad\(|value_and_grad\b|\bvjp\(|jacrev\(|\bfit\(|import derivatives|from derivatives",
    "forward": r"\bjvp\(|jacfwd\(|hessian\(|ForwardMode|\bfit\(|from derivatives",
    "float32": "float32",
    "total": "TotalLagrangian|DESCRIPTIONS",
}
"""The words in which a test asks for each column of the parity page."""


@pytest.mark.parametrize("row", PARITY)
def test_tests_that_the_parity_page_names_ask_for_what_it_ticks(row):
    """Of each row, one of those in the last column."""
    cells = PARITY[row]
    named = re.findall(r"`(\w+)`", cells[HEAD[-1]])
    text = "".join((ROOT / f"tests/test_{name}.py").read_text(encoding="utf-8") for name in named)
    for column, words in ASKED.items():
        assert not cells[column].startswith("✓") or re.search(words, text), column


GRID, LAW = mpm.Grid((12, 12), 0.1), mpm.NeoHookean(1e4, 0.3)
HALF = mpm.HalfSpace((0.0, 0.2), (0.0, 1.0))
PARTS: dict[str, dict[str, Any]] = {
    "kernels": {"kernel": mpm.BSpline(3)},
    "FixedCorotated": {"material": mpm.FixedCorotated(1e4, 0.3)},
    "rubber": {"material": mpm.MooneyRivlin(1e4, 1e3, 1e5)},
    "Snow": {"material": mpm.Snow()},
    "other laws that yield": {"material": mpm.VonMises(1e4, 0.3, 1e2)},
    "Fluid": {"material": mpm.Fluid(1e4)},
    "Viscous": {"material": mpm.Viscous(LAW, 1.0)},
    "AveragedVolume": {"volume": mpm.AveragedVolume()},
    "axisymmetric": {"grid": mpm.Grid((12, 12), 0.1, axisymmetric=True)},
    "SlipBox": {"boundary": mpm.SlipBox((0.2, 0.2), (0.8, 0.8))},
    "SymmetryPlane": {"boundary": mpm.SymmetryPlane(1, 0.2)},
    "Grip": {"boundary": mpm.Grip(mpm.Box((0.0, 0.0), (1.0, 0.3)), mpm.geometry.still(2))},
    "ContactPlane": {"boundary": mpm.ContactPlane(1, 0.2)},
    "SeparatingBox": {"boundary": mpm.SeparatingBox((0.2, 0.2), (0.8, 0.8))},
    "colliders": {"boundary": mpm.StickyCollider(HALF)},
    "Bodies": {"material": (LAW, LAW), "bodies": mpm.Bodies()},
    "Rigid`": {"material": mpm.Rigid(1e8)},
    "RigidPart": {"boundary": mpm.RigidPart(mpm.Box((0.2, 0.2), (0.5, 0.3)))},
    "loads": {"loads": mpm.Traction(mpm.Patch(mpm.Box((0.2, 0.2), (0.8, 0.8))), (1.0, 0.0))},
}
"""Parts of a scene by words of the rows that they stand for."""


@pytest.mark.parametrize("name", PARTS)
def test_scenes_have_the_descriptions_that_the_parity_page_says(name):
    """And refuse the others."""
    (cells,) = (cells for row, cells in PARITY.items() if name in row)
    for column, description in (("updated", mpm.UpdatedLagrangian()), ("total", mpm.TotalLagrangian())):
        refused = cells[column].startswith("–")
        with pytest.raises(ValueError, match=r"total description|updated one") if refused else nullcontext():
            mpm.Scene(**({"grid": GRID, "material": LAW, "description": description} | PARTS[name]))
