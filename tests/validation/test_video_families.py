"""The five families of `examples/video_families.py`, small: one coarse grid, and films on one four times finer."""

import importlib.util
from pathlib import Path

import pytest

import mpmjax as mpm

SCRIPT = Path(__file__).parents[2] / "examples" / "video_families.py"
FAMILIES = ("elastic", "newtonian", "non-newtonian", "plasticine", "sand")
WITHIN = {
    "elastic": {"E": 0.05, "nu": 0.1},
    "newtonian": {"eta": 0.35, "kappa": 0.15},
    "non-newtonian": {"kappa": 0.1, "tau_Y": 0.35},
    "plasticine": {"E": 0.3, "nu": 0.2, "tau_Y": 0.12},
    "sand": {"theta": 0.12},
}
"""What a parameter may be off, of itself, on a body of 5 by 10 cells, which damps as the paste's mu and eta do."""


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("video_families", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_a_family_is_found_from_clouds_without_correspondence(script, name):
    """Each parameter that so coarse a grid can tell within a stated part of itself, from a start a third or more off,
    which does not explain the film."""
    family = script.FAMILIES[name]
    clouds = script.film(family, 4)
    result = mpm.fit(
        script.experiment(family, clouds, 1), family.parameters, optimiser=mpm.fitting.LevenbergMarquardt(rtol=1e-4)
    )
    print(result)
    assert set(script.FAMILIES) == set(FAMILIES)
    for label, within in WITHIN[name].items():
        assert abs(result[label].value - family.truth[label]) < within * family.truth[label]
    assert result.history[-1].cost < 0.6 * result.history[0].cost
