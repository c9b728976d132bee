"""Bodies that touch, against closed forms: Hertz's contact of two cylinders, and a disk that rolls on a block."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import bodies


@pytest.mark.slow
def test_the_contact_of_two_cylinders_is_as_wide_as_hertz_says():
    """At the load that the grip feels, within 5 %: by where the faces of the particles part, which asks nothing of the
    contact, and by the pressure of its springs. Four cells to the half-width."""
    found = bodies.pressed(32, 0.05)
    assert 3.5 < found["hertz"] / found["dx"] < 4.5
    for name in ("faces", "springs"):
        assert abs(found[name] / found["hertz"] - 1) < 0.05, name


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(bodies.IMPLICIT))
def test_a_block_that_rests_on_a_slope_does_not_creep(name):
    """Tilted to 30 degrees at μ = 0.8 it moves by what it and the slab give, 5.4 to 6.1 mm, and then, the swings of
    methods of second order apart, by 0.14 mm at most in half a second. With friction after the solve alone it moves by
    10 to 22 mm."""
    by, then = bodies.tilted(bodies.IMPLICIT[name])
    assert by < 7
    assert abs(then) < 0.15


@pytest.mark.thorough
def test_a_block_slides_beyond_the_angle_of_friction_from_rest():
    """Tilted to 30 degrees at μ = 0.5, the friction of 26.6, a rigid one slides by 190 mm in this half second. A
    seventh of friction drives it, so that what friction is off counts seven times. With springs that hold beyond μ
    times the push it stayed where it was."""
    _, then = bodies.tilted(bodies.IMPLICIT["semi-implicit"], friction=0.5)
    assert 150 < then < 250


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(bodies.ROLLS))
def test_a_disk_rolls_on_a_soft_block_as_the_closed_form_says(name):
    """The way of a rigid one, g sin θ t²/3, within 2 %, and the angle of one that does not slip, within 5 %, since
    friction creeps. Without friction it slides half as far again, and hardly turns."""
    way, turned = bodies.rolled(name)
    assert abs(way - 1) < 0.02
    assert abs(turned - 1) < 0.05
    if name == "semi-implicit":
        way, turned = bodies.rolled(name, friction=0.0)
        assert abs(way / 1.5 - 1) < 0.01
        assert abs(turned) < 0.05
