"""Parameters of what yields and flows, found again from impacts that the fitted discretisation did not make."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

import mpmjax as mpm

LENGTH, SPEED, NOISE = 0.4, 1.0, 2e-4
TIMES = np.arange(1, 11) / 80
PLACES = np.linspace(0.03, 0.37, 8)[:, None]


class Case(NamedTuple):
    law: Any
    """The law with the true value."""
    where: Callable[[Any], Any]
    """Where that stands in it."""
    start: float
    within: float
    """What the estimate may be off, in the parameter's unit."""


CASES = {
    "friction angle": Case(
        mpm.DruckerPrager(3e4, 0.1, np.deg2rad(30.0)), lambda law: law.friction_angle, 0.4, np.deg2rad(1.0)
    ),
    "yield stress": Case(mpm.VonMises(2e4, 0.3, yield_stress=1500.0), lambda law: law.yield_stress, 2200.0, 45.0),
    "viscosity": Case(mpm.Viscous(mpm.Fluid(2e4), 100.0), lambda law: law.shear_viscosity, 150.0, 3.0),
    "consistency": Case(
        mpm.HerschelBulkley(2e4, 0.3, yield_stress=400.0, consistency=100.0), lambda law: law.consistency, 150.0, 3.0
    ),
}


def impact(law, n, **choices):
    """A layer in uniaxial strain, 20n cells thick, as it hits a wall."""
    dx = LENGTH / (20 * n)
    grid = mpm.Grid((round(0.6 / dx) + 6,), dx, origin=(-3,))
    scene = mpm.Scene(grid, law, boundary=mpm.ContactPlane(0, 0.0), **choices)
    layer = mpm.Box((0.0,), (LENGTH,))
    return scene, mpm.fill(layer, grid, particles_per_cell=2, density=1e3, velocity=(-SPEED,))


def followed(law):
    """Where eight markers are seen, with noise: on a grid four times finer than the finest that is fitted, by another
    kernel, gradient, transfer and integrator. Implicit steps, with the elastic law in them, stiffen what yields, so
    these are half as long as those of the finest fit."""
    choices = {"kernel": mpm.BSpline(3), "gradient": mpm.SplineGradient(), "transfer": mpm.FLIP(0.99)}
    scene, particles = impact(law, 16, **choices)
    markers = mpm.fitting.Markers.at(particles, PLACES)
    run = mpm.simulate(
        scene,
        particles,
        t1=float(TIMES[-1]),
        dt=6.25e-5,
        method=mpm.SemiImplicit(beta=0.5),
        save_every=200,
        observe=markers,
    )
    seen = np.asarray(run.observed)[1:]
    return seen + NOISE * np.random.default_rng(0).normal(size=seen.shape)


@pytest.mark.thorough
@pytest.mark.parametrize("name", list(CASES))
def test_a_parameter_is_found_again(name):
    """From tracks of eight markers with 0.2 mm noise, on two grids extrapolated: an angle to 1 degree, yield stress,
    viscosity and consistency to 3 %, the truth in the interval."""
    case = CASES[name]
    positions = followed(case.law)

    def build(n):
        scene, particles = impact(case.law, n)
        seen = mpm.Tracks(TIMES, positions, which=mpm.fitting.Markers.at(particles, PLACES))
        return mpm.Experiment(scene, particles, t1=float(TIMES[-1]), dt=5e-4 / n, observations=seen)

    parameter = mpm.Positive(lambda e: case.where(e.scene.material), start=case.start)
    # fronts jump, and a grid smears what jumps over more than a cell: of less than the first order
    result = mpm.fitting.fit_refined(
        build, {name: parameter}, refinements=(2, 4), order=0.5, optimiser=mpm.fitting.LevenbergMarquardt(rtol=1e-4)
    )
    print(result)
    found, truth = result[name], float(case.where(case.law))
    assert abs(found.value - truth) < case.within
    assert found.interval[0] < truth < found.interval[1]
    assert found.interval[1] - found.interval[0] < 8 * case.within
