"""Parameters of what yields and flows, found again from motions that the fitted discretisation did not make."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

import mpmjax as mpm

HALF, HEIGHT, SPEED, NOISE = 0.2, 0.4, 1.0, 1e-3
TIMES = np.arange(1, 11) / 40
PLACES = np.stack(np.meshgrid([0.05, 0.1, 0.15], [0.05, 0.15, 0.25, 0.35]), axis=-1).reshape(-1, 2)


class Case(NamedTuple):
    law: Any
    """The law with the true value, and where that stands in it."""
    where: Callable[[Any], Any]
    start: float
    within: float
    """What the estimate may be off, in the parameter's unit."""
    filmed_by: mpm.AbstractIntegrator = mpm.Explicit()
    """The data's integrator: explicit for what yields, which implicit steps, with the elastic law in them, stiffen."""
    steps: int = 100
    """Of the data, from one time to the next."""


CASES = {
    "friction angle": Case(
        mpm.DruckerPrager(2e4, 0.3, np.deg2rad(30.0)), lambda law: law.friction_angle, 0.4, np.deg2rad(1.0)
    ),
    "yield stress": Case(mpm.VonMises(2e4, 0.3, yield_stress=1500.0), lambda law: law.yield_stress, 2500.0, 45.0),
    "viscosity": Case(
        mpm.Viscous(mpm.Fluid(2e4), 50.0), lambda law: law.shear_viscosity, 80.0, 1.5, mpm.SemiImplicit(beta=0.5), 50
    ),
}


def fallen(law, n, **choices):
    """The right half of a square body, 5n by 10n cells, as it reaches a rough floor."""
    dx = HALF / (5 * n)
    grid = mpm.Grid((round(0.7 / dx) + 6, round(0.44 / dx) + 6), dx, origin=(-3, -3))
    walls = mpm.SymmetryPlane(0, 0.0), mpm.ContactPlane(1, 0.0, friction=0.5)
    scene = mpm.Scene(grid, law, gravity=(0.0, -9.81), boundary=walls, **choices)
    body = mpm.Box((0.0, 0.0), (HALF, HEIGHT))
    return scene, mpm.fill(body, grid, particles_per_cell=4, density=1e3, velocity=(0.0, -SPEED))


def followed(case):
    """Where twelve markers are seen, with noise: on a grid four times finer than the finest that is fitted, by another
    kernel, gradient, transfer, step and, where that can be, integrator."""
    choices = {"kernel": mpm.BSpline(3), "gradient": mpm.SplineGradient(), "transfer": mpm.FLIP(0.99)}
    scene, particles = fallen(case.law, 8, **choices)
    markers = mpm.Markers.at(particles, PLACES)
    dt = float(TIMES[0]) / case.steps
    run = mpm.simulate(
        scene,
        particles,
        t1=float(TIMES[-1]),
        dt=dt,
        method=case.filmed_by,
        save_every=case.steps,
        observe=markers,
    )
    seen = np.asarray(run.observed)[1:]
    return seen + NOISE * np.random.default_rng(0).normal(size=seen.shape)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(CASES))
def test_a_parameter_is_found_again(name):
    """From tracks of twelve markers with 1 mm noise, on two grids extrapolated: an angle to 1 degree, yield stress and
    viscosity to 3 %, the truth in the interval."""
    case = CASES[name]
    positions = followed(case)

    def build(n):
        scene, particles = fallen(case.law, n)
        seen = mpm.Tracks(TIMES, positions, which=mpm.Markers.at(particles, PLACES))
        return mpm.Experiment(scene, particles, t1=float(TIMES[-1]), dt=2.5e-3 / n, observations=seen)

    parameter = mpm.Positive(lambda e: case.where(e.scene.material), start=case.start)
    result = mpm.fit_refined(build, {name: parameter}, rtol=1e-4)
    print(result)
    found, truth = result[name], float(case.where(case.law))
    assert abs(found.value - truth) < case.within
    assert found.interval[0] < truth < found.interval[1]
    assert found.interval[1] - found.interval[0] < 12 * case.within
