"""Fits to growing horizons: how these are chosen, and the minimum that they lead to."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_fit import DT, NOISE, STEPS, STIFFNESS, bar, experiment, tracks

import mpmjax as mpm
from mpmjax.fitting._problem import FitProblem, first_noise
from mpmjax.fitting._sequence import _first_horizon, _limits
from mpmjax.verification import VibratingBar, discretise

EXACT, PERIODS, FRAMES = VibratingBar(), 4, 40


def vibration():
    """Four periods of a bar by the exact solution, with noise of 2 % of its amplitude."""
    scene, particles = discretise(EXACT, 1)
    which = np.arange(1, particles.count, 5)
    times = np.arange(1, FRAMES + 1) * PERIODS * EXACT.duration / FRAMES
    at = jax.vmap(jax.vmap(EXACT.position, (0, None)), (None, 0))
    x = np.asarray(at(particles.X[which], jnp.asarray(times)))
    x = x + 2e-3 * np.random.default_rng(0).normal(size=x.shape)
    seen = mpm.Tracks(times, x, which=which, sigma=2e-3)
    return mpm.Experiment(scene, particles, t1=PERIODS * EXACT.duration, dt=0.05, observations=seen)


def from_part(share):
    """Young's modulus, of which the first guess is a share of the truth, 100 Pa."""
    return {"E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=100.0 * share)}


@pytest.mark.thorough
@pytest.mark.parametrize("share", [0.57, pytest.param(0.3, marks=pytest.mark.slow)])
def test_a_vibration_is_found_from_far_off(share):
    """From −43 % and −70 %, where a fit to all data ends at half of E; what is left is the grid's error."""
    whole = vibration()
    with pytest.warns(UserWarning, match="The misfit is"):
        alone = mpm.fit(whole, from_part(share), starts=1)
    assert alone["E"].value < 60
    found = mpm.fitting.fit_staged(whole, from_part(share))
    assert found["E"].value == pytest.approx(100, rel=2e-3)
    horizons = [float(text.split()[1]) for text in found.remarks if text.startswith("until ")]
    assert 0.3 * EXACT.duration < horizons[0] < 1.5 * EXACT.duration
    assert np.allclose(np.diff(np.log2(horizons)), 1, atol=1e-2)
    assert found.experiments[0].t1 == pytest.approx(PERIODS * EXACT.duration)
    assert f"until {horizons[0]:.4g} s" in str(found)


def test_an_experiment_until_a_time_ends_there():
    """With what was measured until then; a curve has no times and is left out, and alone keeps all."""
    times, x, which = tracks()
    curve = mpm.Curve([0.5], [1.0], lambda s, p: (p.x.max(), p.x.min()))
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    both = experiment([seen, curve])
    short = both.until(4.5 * DT)
    assert short.steps == 5
    assert [o.name for o in short.observations] == ["tracks"]
    assert np.array_equal(short.observations[0].data, x[:4])
    assert both.until(STEPS * DT) is both
    alone = experiment(curve)
    assert alone.until(DT) is alone
    late = experiment(mpm.Tracks(times[5:], x[5:], which=which, sigma=NOISE))
    assert late.until(2 * DT) is late


class Known(FitProblem):
    """y = sin ωt or y = g t²/2 of one parameter, its derivative by hand."""

    def __init__(self, shape):
        times = np.linspace(0, STEPS * DT, 61)
        scene, particles = bar()
        y, by = shape(times)
        seen = mpm.Series(times, y, mpm.fitting.Extent(0), sigma=0.1)
        self.experiments = (mpm.Experiment(scene, particles, t1=STEPS * DT, dt=DT, observations=seen),)
        self.names, self.parameters, self.starts = ("a",), (STIFFNESS,), (jnp.asarray(1.0),)
        self.sigmas = first_noise(self.experiments)
        self.derivative = jnp.asarray(by / 0.1)

    derivative: jax.Array

    def jacobian(self, z, mode=None):
        return 0 * self.derivative + 1.0, self.derivative[:, None]


def test_the_first_horizon_is_where_the_data_cease_to_be_linear():
    """Of sin ωt by log ω, against sums over a fine line; of free fall by log g the ratio is one at all times, and the
    horizon is the end."""
    omega = 200.0
    phase = np.linspace(1e-3, omega * STEPS * DT, 100_000)
    ratio = np.sqrt(np.cumsum((phase * np.cos(phase)) ** 2) / np.cumsum(np.sin(phase) ** 2))
    expected = phase[np.flatnonzero(ratio <= max(1, 1.2 * ratio.min()))[-1]] / omega
    z = jnp.zeros(1)
    swing = Known(lambda t: (np.sin(omega * t), omega * t * np.cos(omega * t)))
    assert _first_horizon(swing, z) == pytest.approx(expected, abs=2 * DT / 4)
    fall = Known(lambda t: (5 * t**2, 5 * t**2))
    assert _first_horizon(fall, z) == pytest.approx(STEPS * DT)


@pytest.mark.thorough
def test_data_beyond_the_growth_of_derivatives_are_left_out():
    """Growth is below the limit until there, and above it after; without a limit all data are used."""
    times, x, which = tracks()
    whole = experiment(mpm.Tracks(times, x, which=which, sigma=NOISE))
    growth = np.asarray(mpm.analysis.sensitivity(whole.scene, whole.particles, t1=whole.t1, dt=DT).growth)
    bound = float(np.median(growth))
    (limit,) = _limits([whole], bound)
    last = round(limit / DT)
    assert 0 < last < STEPS
    assert last == 1 or (growth[:last] <= bound).all()
    assert (growth[: last + 1] > bound).any()
    assert _limits([whole], np.inf) == [whole.t1]


REFUSED = {
    "shrinking": ({"horizons": [0.02, 0.01]}, "must grow"),
    "negative": ({"horizons": [-1.0]}, "greater than zero"),
    "no growth": ({"growth": 0.0}, "growth must be positive"),
}


@pytest.mark.parametrize(("options", "says"), REFUSED.values(), ids=REFUSED)
def test_bad_horizons_get_one_line(options, says):
    times, x, which = tracks()
    whole = experiment(mpm.Tracks(times, x, which=which, sigma=NOISE))
    with pytest.raises(ValueError, match=says):
        mpm.fitting.fit_staged(whole, {"E": STIFFNESS}, **options)
