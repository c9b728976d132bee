"""Errors of fits: profiles, bands of predictions, and words for what the data cannot tell."""

import json

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import norm, t

import mpmjax as mpm
from mpmjax.fitting._search import iterate
from mpmjax.fitting._uncertainty import seen_together, uncertainty
from mpmjax.viz import draw_fit, write_fit

DT, STEPS, NOISE = 4e-3, 15, 2e-3
G, V = 9.81, 0.3


def thrown(observations, steps=STEPS, **options):
    """A bar that falls freely: its places are linear in gravity and speed."""
    grid = mpm.Grid((14,), 0.1, origin=(-6,))
    bar = mpm.fill(mpm.Box((0.0,), (0.3,)), grid, particles_per_cell=2, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(7e4, 0.3), gravity=(-5.0,))
    return mpm.Experiment(scene, bar, t1=steps * DT, dt=DT, observations=observations, **options)


GRAVITY = mpm.Positive(
    update=lambda e, g: eqx.tree_at(lambda e: e.scene.gravity, e, -g[None]), start=5.0, unit="m/s²"
)
SPEED = mpm.Unbounded(
    update=lambda e, v: eqx.tree_at(lambda e: e.particles.v, e, jnp.full_like(e.particles.v, v)), start=1.0
)


def design(steps=STEPS):
    """Places of the middle, less that at the start, by gravity and speed: x_k = v k Δt − g Δt² k (k + 1)/2."""
    k = np.arange(1, steps + 1)
    return np.stack([-(DT**2) * k * (k + 1) / 2, k * DT], axis=1)


def measured(noise=NOISE, seed=0, **options):
    """The place of the middle with noise."""
    middle = 0.15 + design() @ [G, V] + noise * np.random.default_rng(seed).normal(size=STEPS)
    times = DT * np.arange(1, STEPS + 1)
    return mpm.Series(times, middle[:, None], mpm.CentreOfMass(), **options)


def exact(seen, sigma=None, level=0.95):
    """Estimates of gravity and speed, their covariance and the reach of the interval, by linear regression."""
    A, y = design(), seen.data[:, 0] - 0.15
    found, squares, *_ = np.linalg.lstsq(A, y)
    variance = squares[0] / (len(y) - 2) if sigma is None else sigma**2
    p = (1 + level) / 2
    return found, variance * np.linalg.inv(A.T @ A), t.ppf(p, len(y) - 2) if sigma is None else norm.ppf(p), variance


@pytest.fixture(scope="module")
def fall():
    """Gravity and speed, the noise estimated."""
    seen = measured()
    return seen, mpm.fit(thrown(seen), {"g": GRAVITY, "v": SPEED})


def test_profiles_of_a_linear_problem_are_students_intervals_in_any_coordinate(fall):
    """Gravity is searched by its logarithm, in which the interval of the standard error is not symmetric."""
    seen, result = fall
    found, covariance, reach, _ = exact(seen)
    for k, label in enumerate(("g", "v")):
        profile = mpm.profile(result, label)
        half = reach * np.sqrt(covariance[k, k])
        assert np.allclose(profile.interval, [found[k] - half, found[k] + half], rtol=0, atol=2e-3 * half)
        statistic = (profile.values - found[k]) ** 2 / covariance[k, k]
        assert np.allclose(profile.statistic, statistic, rtol=1e-3, atol=1e-3)
        other = found[1 - k] + covariance[0, 1] / covariance[k, k] * (profile.values - found[k])
        assert np.allclose(profile.along("vg"[k]), other, rtol=1e-2)
        assert profile.degrees_of_freedom == STEPS - 2
        assert profile.threshold == pytest.approx(reach**2)
        assert not profile.warnings
    assert abs(result["g"].interval[1] - found[0] - reach * np.sqrt(covariance[0, 0])) > 0.03 * half


def test_the_profiles_of_a_fit_are_one_program(fall):
    _, result = fall
    mpm.profile(result, "g", points=1)
    known = iterate._cached._cache_size()
    mpm.profile(result, "v", points=1, level=0.8)
    assert iterate._cached._cache_size() == known


def test_the_band_of_a_linear_problem_is_students(fall):
    """Of the mean, and of a new measurement; the same by a function, and with other times."""
    seen, result = fall
    found, covariance, reach, variance = exact(seen)
    A = design()
    middle, error = 0.15 + A @ found, np.sqrt(np.einsum("mi,ij,mj->m", A, covariance, A))
    (band,) = mpm.predict_observations(result)
    assert np.allclose(band.value[:, 0], middle, atol=1e-6)
    assert np.allclose(band.error[:, 0], error, rtol=1e-3)
    assert np.allclose(band.upper[:, 0] - middle, reach * error, rtol=2e-2)
    assert np.allclose(band.new_upper[:, 0] - middle, reach * np.sqrt(variance + error**2), rtol=1e-2)
    assert np.allclose(band.new_lower + band.new_upper, 2 * band.value)

    def end(e):
        run = mpm.simulate(e.scene, e.particles, t1=2 * STEPS * DT, dt=DT, adjoint=diffrax.ForwardMode())
        return run.final.x.mean()

    last = design(2 * STEPS)[-1]
    later = mpm.predict(result, end)
    assert later.value == pytest.approx(0.15 + last @ found, abs=1e-5)
    assert later.error == pytest.approx(np.sqrt(last @ covariance @ last), rel=1e-3)


@pytest.mark.thorough
def test_an_interval_that_the_data_do_not_close_is_open():
    """Gravity from noise as large as the fall: zero is within the exact interval, no positive number is its lower end;
    with the noise given, the threshold is that of χ²."""
    sigma = 0.05
    seen = measured(sigma, seed=1, sigma=sigma)
    result = mpm.fit(thrown(seen), {"g": GRAVITY, "v": SPEED})
    found, covariance, reach, _ = exact(seen, sigma)
    half = reach * np.sqrt(covariance[0, 0])
    assert found[0] - half < 0 < found[0]
    with pytest.warns(UserWarning, match="g: the interval is open below"):
        profile = mpm.profile(result, "g")
    assert profile.interval == (0, pytest.approx(found[0] + half, abs=2e-3 * half))
    assert np.isinf(profile.degrees_of_freedom)
    assert profile.threshold == pytest.approx(norm.ppf(0.975) ** 2)
