"""Where contact is felt: the bounce of a bar against contact at nodes, the exact one and a finer one."""

import importlib
from pathlib import Path

import pytest


@pytest.mark.slow
def test_a_bar_bounces_at_the_surface_of_the_wall(monkeypatch):
    """The wall is felt within 5 % of a spacing of where it is, which is a twentieth of the way of nodes. Against the
    same bar at four times the resolution, time of contact and velocity of return are five times nearer than theirs."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    contact = importlib.import_module("contact_surface")
    nodes, box = (contact.bounce(16, 1, wall, at=0.3) for wall in ("at nodes, as it was", "SeparatingBox"))
    fine = contact.bounce(64, 1, "SeparatingBox", at=0.3)
    assert abs(box["onset"]) < 0.05
    assert nodes["onset"] > 0.5
    for name in ("time", "return"):
        assert abs(box[name] - fine[name]) < abs(nodes[name] - fine[name]) / 5, name
    assert box["most"] < 1.005
