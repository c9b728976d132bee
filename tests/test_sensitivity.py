"""The health report of long rollouts: exact where flight is free, bounded where motion is stable, growing and warned of
where it is not."""

import functools
import warnings

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, block, explicit_limit

import mpmjax as mpm
from mpmjax.state._particles import state_of, with_state
from mpmjax.stepping._step import step_unchecked


def quiet(scene, particles, **options):
    """The report, which must not warn but of what is thin."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message="The body is .* cells thick")
        return mpm.analysis.sensitivity(scene, particles, **options)


@functools.cache
def bar():
    """A bar at rest, and the spectral radius of one explicit step's Jacobian as a function of dt."""
    scene, particles = block(1)
    rest = mpm.prepare(scene, particles)
    flat, unflatten = jax.flatten_util.ravel_pytree(state_of(rest))

    def after(flat, dt):
        return jax.flatten_util.ravel_pytree(
            state_of(step_unchecked(scene, with_state(rest, unflatten(flat)), 0.0, dt, mpm.Explicit())[0])
        )[0]

    jacobian = jax.jit(jax.jacfwd(after))
    return scene, particles, lambda dt: np.abs(np.linalg.eigvals(jacobian(flat, jnp.asarray(dt)))).max()


@functools.cache
def bar_limit():
    """The largest stable dt of the bar's explicit steps [s], by bisection on the spectral radius; rounding splits the
    double eigenvalue of free flight, 1, by its square root."""
    scene, _, radius = bar()
    low, high = 0.5 * explicit_limit(scene), 2 * explicit_limit(scene)
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (low, middle) if radius(middle) > 1 + 1e-6 else (middle, high)
    return low


@pytest.mark.thorough
def test_free_flight_has_growth_one():
    """To rounding: a bar thrown as a whole, and a single particle, whatever its velocity."""
    scene, particles, _ = bar()
    report = quiet(scene, particles, t1=400 * 5e-3, dt=5e-3, direction=jnp.full_like(particles.v, 7.0))
    assert_close(report.growth, np.ones(100), 1e-12)
    assert abs(float(report.rate)) < 1e-12
    np.testing.assert_array_equal(report.steps, np.arange(4, 401, 4))
    assert_close(report.times, 5e-3 * np.arange(4, 401, 4), 1e-15)
    one = jax.tree.map(lambda a: a[:1], particles)
    assert_close(quiet(scene, one, t1=400 * 5e-3, dt=5e-3, seed=3).growth, np.ones(100), 1e-12)


@pytest.mark.thorough
def test_growth_is_that_of_a_finite_change():
    """δx against the central difference of the positions, at every saved step of a bounce off a wall."""
    wall = mpm.SeparatingBox((0.0,), (np.inf,))
    scene, particles = block(1, boundary=wall)
    v = -1.0 + 0.1 * np.random.default_rng(0).normal(size=particles.x.shape)
    particles = mpm.prepare(scene, eqx.tree_at(lambda p: p.v, particles, jnp.asarray(v)))  # its C stays as it is
    change = jnp.asarray(np.random.default_rng(1).normal(size=v.shape))
    run = {"t1": 0.32, "dt": 5e-3, "save_every": 5}
    h = 1e-6

    def flown(sign):
        thrown = eqx.tree_at(lambda p: p.v, particles, particles.v + sign * h * change)
        return mpm.simulate(scene, thrown, **run).frames.x[1:]

    report = quiet(scene, particles, direction=change, **run)
    moved = (flown(1) - flown(-1)) / (2 * h)
    times = np.array([*5e-3 * 5 * np.arange(1, 13), 0.32])
    size = np.sqrt((moved**2).sum(axis=(1, 2))) / float(jnp.sqrt((change**2).sum()))
    assert_close(report.growth, size / times, 1e-7)


def test_a_stable_oscillation_does_not_grow():
    """At 0.95 of the explicit limit growth stays below one, and its rate is not positive."""
    scene, particles, _ = bar()
    dt = 0.95 * bar_limit()
    report = quiet(scene, particles, t1=400 * dt, dt=dt)
    assert 0 < float(report.worst) <= 1
    assert float(report.rate) < 1e-3
    assert len(report.steps) == 100


def test_an_unstable_step_grows_at_the_rate_of_its_jacobian_and_warns():
    """At 1.05 of the limit: ln(spectral radius)/Δt, and horizon, factor and step are told, once."""
    scene, particles, radius = bar()
    dt = 1.05 * bar_limit()
    with pytest.warns(UserWarning, match=r"Over 400 steps .* grows to .* passes 1000 by step \d+") as caught:
        report = mpm.analysis.sensitivity(scene, particles, t1=400 * dt, dt=dt)
    assert len(caught) == 1
    assert float(report.worst) > 1e3
    rate = np.log(radius(dt)) / dt
    growth, times = np.asarray(report.growth)[[50, -1]], np.asarray(report.times)[[50, -1]]
    moved = growth * times
    assert abs(np.log(moved[1] / moved[0]) / (times[1] - times[0]) / rate - 1) < 1e-2
    assert abs(float(report.rate) / rate - 1) < 0.1  # of growth, which falls like 1/t on top
    quiet(scene, particles, t1=400 * dt, dt=dt, warn_at=2 * float(report.worst))


def test_a_fault_of_the_run_ends_the_report_and_warns():
    """A particle leaves the window: the step is told, growth is as before up to there and NaN from there on."""
    scene, particles, _ = bar()
    particles = eqx.tree_at(lambda p: p.v, particles, jnp.full_like(particles.v, 0.5))
    with pytest.warns(UserWarning, match=r"the run meets a fault at step \d+") as caught:
        report = mpm.analysis.sensitivity(scene, particles, t1=2.0, dt=5e-3, direction=jnp.ones_like(particles.v))
    step = int(str(caught[0].message).split("at step ")[1].split()[0])
    good = np.asarray(report.steps) < step
    assert 0 < good.sum() < 100
    assert_close(report.growth[good], np.ones(good.sum()), 1e-12)
    assert np.isnan(report.growth[~good]).all()
    assert np.isnan(report.worst)
    assert np.isfinite(report.rate)


@pytest.mark.thorough
def test_a_run_that_is_not_solved_has_no_growth():
    """One step of conjugate residuals does not do."""
    scene, particles, _ = bar()
    stretched = mpm.Particles(particles.x, 0.1 * particles.x, particles.mass, particles.volume)
    method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(max_steps=1))
    with pytest.warns(UserWarning, match="does not solve its equations"):
        report = mpm.analysis.sensitivity(scene, stretched, t1=0.5, dt=0.1, method=method)
    assert np.isnan(report.growth).all()


@pytest.mark.thorough
def test_a_tangent_that_is_not_solved_has_no_growth_and_is_named():
    """The run itself is; one iteration does not do for its derivative."""
    scene, particles, _ = bar()
    stretched = mpm.Particles(particles.x, 0.1 * particles.x, particles.mass, particles.volume)
    method = mpm.SemiImplicit(adjoint_solver=mpm.implicit.ConjugateResidual(max_steps=1))
    with pytest.warns(UserWarning, match=r"tangent solve of a step did not converge \(relative residual"):
        report = mpm.analysis.sensitivity(scene, stretched, t1=0.2, dt=0.1, method=method)
    assert np.isnan(report.growth).all()


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_growth_is_that_of_the_reverse_mode_gradient(factor):
    """Over 100, 200 and 400 steps, stable and not: gradients of functions of the final positions grow as the tangent
    does, in the root mean square over all functions and over all directions (a batch, in which nothing is warned of);
    one random direction is within a factor of ten."""
    scene, particles, _ = bar()
    dt = factor * bar_limit()
    every = jnp.eye(particles.count)[:, :, None]
    options = {"t1": 400 * dt, "dt": dt}

    @jax.vmap
    def tangent(direction):
        return mpm.analysis.sensitivity(scene, particles, direction=direction, **options).growth

    def gradients(steps):
        def final(v):
            thrown = eqx.tree_at(lambda p: p.v, mpm.prepare(scene, particles), v)  # its C stays as it is
            return mpm.rollout(scene, thrown, steps=steps, dt=dt).x / (steps * dt)

        return jax.vmap(jax.vjp(final, particles.v)[1])(every)[0]

    reverse = np.array([np.sqrt((gradients(n) ** 2).sum() / particles.count) for n in (100, 200, 400)])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        forward = np.sqrt(np.mean(np.square(tangent(every)), axis=0))[[24, 49, 99]]
    assert (abs(forward / reverse - 1) < 1e-9).all()
    one = np.asarray(quiet(scene, particles, warn_at=1e300, **options).growth)[[24, 49, 99]]
    assert (abs(np.log(one / reverse)) < np.log(10)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"direction": jnp.ones((2, 1))}, "shape"),
        ({"direction": jnp.zeros((6, 1))}, "zero"),
        ({"warn_at": 0.0}, "warn_at"),
        ({"t1": 0.0123}, "whole number"),
    ],
)
def test_a_bad_question_is_refused(options, message):
    """With a word."""
    scene, particles = block(1)
    with pytest.raises(ValueError, match=message):
        mpm.analysis.sensitivity(scene, particles, **{"t1": 0.01, "dt": 5e-3} | options)
