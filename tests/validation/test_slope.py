"""The Coulomb block on a slope: x = ½ g t² (sin θ − tan φ cos θ), on a floor that no grid line follows."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import thorough

import mpmjax as mpm

G, DX, DENSITY = 9.81, 0.1, 1e3
THETA, PHI = np.deg2rad(24.0), np.deg2rad(15.0)
DOWN, UP = np.array([np.cos(THETA), -np.sin(THETA)]), np.array([np.sin(THETA), np.cos(THETA)])
METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit()}


def place(scene, particles):
    """The block's middle."""
    del scene
    return particles.x.mean(axis=0)


def slid(name, friction, *, number, time, stiffness, speed=0.0):
    """The largest error of the distance slid over the time, as a share of ½ a t², and the run.

    The block is four cells by one, laid along the slope. Its initial velocity is that of half a step before, symplectic
    Euler being leap-frog, so that a rigid one would follow ½ a t² to rounding.
    """
    law = mpm.FixedCorotated(stiffness, 0.3)
    c = np.sqrt(float(law.lame_lambda + 2 * law.shear_modulus) / DENSITY)
    dt = number * DX / c
    steps = round(time / dt)
    a = G * (np.sin(THETA) - friction * np.cos(THETA))
    foot = DX * np.array([0.513, 0.237])
    along, above = (DX / 2 * (np.arange(n) + 0.5) for n in (8, 2))
    x = foot + (along[:, None, None] * DOWN + above[:, None] * UP).reshape(-1, 2)
    volume = np.full(len(x), DX**2 / 4)
    v = np.broadcast_to((speed - a * dt / 2) * DOWN, x.shape)
    block = mpm.Particles(*map(jnp.asarray, (x, v, DENSITY * volume, volume)))
    slope = mpm.SeparatingCollider(mpm.HalfSpace(tuple(foot), tuple(UP)), friction=friction)
    grid = mpm.Grid((16, 14), DX, follow=True)
    scene = mpm.Scene(grid, law, gravity=(0.0, -G), boundary=slope)
    run = mpm.simulate(scene, block, t1=steps * dt, dt=dt, method=METHODS[name], observe=place)
    t = dt * np.arange(steps + 1)
    distance = (np.asarray(run.observed) - x.mean(axis=0)) @ DOWN - speed * t
    return np.abs(distance - a * t**2 / 2).max() / (a * t[-1] ** 2 / 2), run


@pytest.mark.parametrize("name", thorough("explicit", "semi_implicit"))
def test_without_friction_a_block_slides_as_a_point_does(name):
    """The floor's push has no part along it: the solver's tolerance, or rounding."""
    error, run = slid(name, 0.0, number={"explicit": 0.3, "semi_implicit": 3.0}[name], time=0.2, stiffness=1e6)
    assert int(run.statistics.violations) == 0
    assert error < {"explicit": 1e-12, "semi_implicit": 1e-7}[name]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "number"), [("explicit", 0.4), pytest.param("semi_implicit", 0.7, marks=pytest.mark.slow)]
)
def test_a_block_slides_down_a_slope_as_coulomb_says(name, number):
    """From rest, over eight spacings, within 1e-3. The block is elastic: until its shear has grown to what friction
    takes, the foot sticks, for a time of its height over its wave speed, and what is missing then stays missing."""
    error, run = slid(name, np.tan(PHI), number=number, time=1.0, stiffness=1e8)
    assert int(run.statistics.violations) == 0
    assert error < 1e-3


@pytest.mark.thorough
def test_the_foot_sticks_for_as_long_as_a_wave_takes():
    """A block of a hundredth of the stiffness has ten times the error."""
    soft, stiff = (slid("explicit", np.tan(PHI), number=0.4, time=1.0, stiffness=E)[0] for E in (1e6, 1e8))
    assert soft / stiff == pytest.approx(10, rel=0.3)


@pytest.mark.slow
def test_a_semi_implicit_block_that_slides_already_follows_coulomb_at_larger_steps():
    """At three times the explicit limit; friction lags the solve by a step, which costs a block at rest some steps."""
    error, run = slid("semi_implicit", np.tan(PHI), number=3.0, time=0.5, stiffness=1e8, speed=1.0)
    assert int(run.statistics.violations) == 0
    assert error < 1e-3
