"""A stiffness that changes from place to place is found from motions that another discretisation made."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import mpmjax as mpm

SIZE = (0.8, 0.4)
SOFT, STIFF, BORDER = 5e4, 1e5, 0.43
SPACING, STEP, STEPS = 0.05, 2e-3, 30
SIGMA = 2e-4
"""Of a coordinate of a marker [m]; the motion is some centimetres."""


def block(n, **choices):
    """A free block that is stretched, sheared and bent as it starts, on n times as many cells a direction."""
    grid = mpm.Grid((28 * n, 20 * n), SPACING / n, origin=(-6 * n, -6 * n))
    particles = mpm.fill(mpm.Box((0.0, 0.0), SIZE), grid, particles_per_cell=4, density=1e3)
    x, y = (particles.x / jnp.asarray(SIZE) - 0.5).T
    v = jnp.stack([jnp.sin(jnp.pi * x) + 0.3 * y, -0.5 * y + 0.4 * jnp.cos(2 * jnp.pi * x)], axis=1)
    particles = eqx.tree_at(lambda q: q.v, particles, v)
    law = mpm.NeoHookean(jnp.full(particles.count, 7e4), 0.3)
    return mpm.Scene(grid, law, description=mpm.TotalLagrangian(), **choices), particles


def tracks():
    """Four times the resolution, with another kernel, transfer, gradient operator and integrator, and noise."""
    scene, q = block(4, kernel=mpm.BSpline(3), transfer=mpm.FLIP(1.0), gradient=mpm.SplineGradient())
    stiffness = jnp.where(q.x[:, 0] < BORDER, SOFT, STIFF)
    scene = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
    places = np.stack(np.meshgrid(np.arange(0.05, 0.8, 0.1), np.arange(0.05, 0.4, 0.1), indexing="ij"), -1)
    places = places.reshape(-1, 2)
    run = mpm.simulate(
        scene,
        q,
        t1=STEP * STEPS,
        dt=STEP / 4,
        method=mpm.ImplicitMidpoint(),
        save_every=8,
        observe=mpm.fitting.Markers.at(q, places),
    )
    noise = SIGMA * np.random.default_rng(0).normal(size=run.observed[1:].shape)
    return np.asarray(run.times)[1:], np.asarray(run.observed)[1:] + noise, places


def problem(times, seen, places):
    """The experiment on the coarse grid, and the field to be found on nodes a cell apart."""
    scene, q = block(1, gradient=mpm.MLSGradient())
    observed = mpm.Tracks(times, seen, which=mpm.fitting.Markers.at(q, places), sigma=SIGMA)
    pull = mpm.Experiment(scene, q, t1=STEP * STEPS, dt=STEP, observations=observed)
    modulus = mpm.Positive(
        lambda e: e.scene.material.youngs_modulus, prior=mpm.fitting.Smooth(0.2, robust=0.3), unit="Pa"
    )
    return pull, mpm.fitting.Field(modulus, mpm.fitting.Field.lattice_around(q, 0.1))


def judged(field, found):
    """Where the field crosses the mean of the logarithms, and its median levels on both sides, of particles."""
    _, q = block(1)
    x, E = np.asarray(q.x[:, 0]), np.asarray(found.scene.material.youngs_modulus)
    columns = np.unique(x.round(6))
    level = np.array([np.exp(np.log(E[np.abs(x - c) < 1e-5]).mean()) for c in columns])
    border = np.interp(np.log(SOFT * STIFF) / 2, np.log(level), columns)
    away = np.abs(x - BORDER) > 0.1
    soft, stiff = (np.median(E[away & side]) for side in (x < BORDER, x > BORDER))
    return border, soft, stiff


@pytest.mark.slow
def test_a_field_of_two_regions_is_found():
    """Its border within a cell, both levels within 5 %."""
    pull, field = problem(*tracks())
    found = mpm.fit(pull, {"E": field})
    border, soft, stiff = judged(field, found)
    assert found.converged
    assert isinstance(found.optimiser, mpm.fitting.LBFGS)
    assert abs(border - BORDER) < SPACING
    assert soft == pytest.approx(SOFT, rel=0.05)
    assert stiff == pytest.approx(STIFF, rel=0.05)
