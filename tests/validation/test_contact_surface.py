"""Where contact is felt: the bounce of a bar and of a block against contact at nodes, the exact one and a finer one,
and of a ball against finite elements."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import contact_surface as contact

NODES, BOX = "at nodes, as it was", "SeparatingBox"


@pytest.mark.slow
def test_a_bar_bounces_at_the_surface_of_the_wall():
    """The wall is felt within 5 % of a spacing of where it is, which is a twentieth of the way of nodes. Against the
    same bar at four times the resolution, time of contact and velocity of return are five times nearer than theirs."""
    nodes, box = (contact.bounce(16, 1, wall, at=0.3) for wall in (NODES, BOX))
    fine = contact.bounce(64, 1, BOX, at=0.3)
    assert abs(box["onset"]) < 0.05
    assert nodes["onset"] > 0.5
    for name in ("time", "return"):
        assert abs(box[name] - fine[name]) < abs(nodes[name] - fine[name]) / 5, name
    assert box["most"] < 1.005


@pytest.mark.slow
def test_a_block_bounces_five_times_nearer_to_one_of_four_times_the_resolution():
    """In two dimensions, ν = 0.3, on walls at four places between nodes: root mean squares over blocks of 6, 8 and 12
    cells of what they differ by from the same blocks of 24, 32 and 48. The time of contact is so on each grid. The
    velocity of return of contact at nodes rises with the resolution and passes the right one near 9 cells, so that on
    one grid its error may be small by its sign."""
    errors = {wall: [] for wall in (NODES, BOX)}
    for cells in (6, 8, 12):
        fine = contact.bounce(4 * cells, 2, BOX, at=0.3, nu=0.3)
        for wall, found in errors.items():
            bounces = [contact.bounce(cells, 2, wall, at=at, nu=0.3) for at in (0.0, 0.3, 0.5, 0.8)]
            if wall == BOX:
                assert max(abs(bounce["onset"]) for bounce in bounces) < 0.05
                assert max(bounce["most"] for bounce in bounces) < 1.005
            else:
                assert max(bounce["onset"] for bounce in bounces) > 0.5
            found.append(np.sqrt([np.mean([(b[k] - fine[k]) ** 2 for b in bounces]) for k in ("time", "return")]))
    before, now = (np.array(errors[wall]) for wall in (NODES, BOX))
    assert (now[:, 0] < before[:, 0] / 5).all()
    over_sizes = np.sqrt((before**2).mean(axis=0) / (now**2).mean(axis=0))
    assert (over_sizes > 5).all(), over_sizes


@pytest.mark.slow
def test_a_ball_of_eight_cells_a_radius_bounces_as_finite_elements_do():
    """Peak force and time of contact within 3 % of theirs, and the same wherever the plane lies between nodes."""
    exact = contact.ball_of_elements(16)
    for wall, places in ((BOX, (0.0, 0.25)), ("ContactPlane", (0.0, 0.5))):
        found = [contact.ball(8, wall, at=at) for at in places]
        for name, right in exact.items():
            assert max(abs(one[name] / right - 1) for one in found) < 0.03, (wall, name)
            assert abs(found[0][name] - found[1][name]) < 0.02, (wall, name)
