"""Fits: parameters, observations, errors, and what is refused."""

import html
from functools import partial
from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mpmjax as mpm
from mpmjax.fitting._evaluation import Kept, costs_at, evaluated, parts_kept
from mpmjax.fitting._observation import between
from mpmjax.fitting._problem import FitProblem, first_noise
from mpmjax.fitting._result import Estimate, NoiseEstimate
from mpmjax.fitting._search import jacobian, search, search_many
from mpmjax.fitting._sequence import _extrapolate, _missed

fit = partial(mpm.fit, discretisation=False)  # most of these tests are of the search

DT, STEPS, NOISE = 4e-3, 15, 1e-4


def bar(E=7e4, nu=0.3, density=1e3, n=1):
    """A free bar that is stretched as it starts, n-dimensional."""
    grid = mpm.Grid((12,) * n, 0.1, origin=(-4,) * n)
    particles = mpm.fill(mpm.Box((0.0,) * n, (0.4,) * n), grid, particles_per_cell=2**n, density=density)
    rates = jnp.asarray([1.5, -1.0][:n])
    particles = eqx.tree_at(lambda q: q.v, particles, rates * (particles.x - 0.2))
    return mpm.Scene(grid, mpm.NeoHookean(E, nu)), particles


def tracks(n=1, sigma=NOISE, seed=0, **material):
    """What markers of a bar did, with noise."""
    scene, particles = bar(n=n, **material)
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=1)
    which = np.arange(0, particles.count, 3)
    x = np.asarray(run.frames.x)[1:, which]
    return np.asarray(run.times)[1:], x + (sigma or 0) * np.random.default_rng(seed).normal(size=x.shape), which


def experiment(observations, n=1, steps=STEPS, **material):
    scene, particles = bar(n=n, **material)
    return mpm.Experiment(scene, particles, t1=steps * DT, dt=DT, observations=observations)


STIFFNESS = mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=1e5, unit="Pa")
RATIO = mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.0, 0.49, start=0.2)


@pytest.fixture(scope="module")
def both():
    """E and ν of a square from noisy tracks."""
    times, x, which = tracks(n=2)
    x[3, 1] = np.nan
    x[5:, 2] = np.nan
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    shear = {"mu": lambda e: e.scene.material.shear_modulus}
    return fit(experiment(seen, n=2), {"E": STIFFNESS, "nu": RATIO}, report=shear)


@pytest.mark.thorough
def test_notebooks_show_the_table_and_the_picture_of_a_fit(both):
    assert mpm.render  # loads the room that gives the view, as a notebook does
    shown = both._repr_html_()
    assert html.escape(str(both)) in shown
    assert "data:image/png;base64,iVBOR" in shown


def test_an_energy_as_analysis_says_it_is_an_observation():
    """`mpm.energy` takes the particles of a run that is traced as it takes those of one that is done."""

    def stored(scene, particles):
        return mpm.energy(scene, particles).elastic

    scene, particles = bar()
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=3, observe=stored)
    seen = mpm.Series(np.asarray(run.times)[1:], np.asarray(run.observed)[1:], stored, sigma=1e-4)
    assert fit(experiment(seen), {"E": STIFFNESS}).values["E"] == pytest.approx(7e4, rel=1e-6)


def test_tracks_fix_stiffness_and_poissons_ratio(both):
    """Within four standard errors, of which they are few per cent; missing markers count as none."""
    assert both.converged
    for name, true in (("E", 7e4), ("nu", 0.3)):
        found = both[name]
        assert abs(found.value - true) < 4 * found.error
        assert found.error < 0.05 * true
        assert found.interval[0] < found.value < found.interval[1]
    lost = 2 * (1 + STEPS - 5)
    assert both.noise[0].points == both.experiments[0].observations[0].data.size - lost
    assert 0.01 < both.p_value < 0.99


def test_what_is_reported_has_the_error_that_follows(both):
    """μ = E / (2 (1 + ν)): its error by the covariance of log E and the logit of ν."""
    E, nu = both["E"].value, both["nu"].value
    assert both["mu"].value == pytest.approx(E / (2 * (1 + nu)))
    share = nu / 0.49
    slope = both["mu"].value * np.array([1, -0.49 * share * (1 - share) / (1 + nu)])
    assert both["mu"].error == pytest.approx(np.sqrt(slope @ both.uncertainty.covariance @ slope), rel=1e-6)


def test_the_table_and_the_fitted_scene(both):
    text = str(both)
    assert "E [Pa]" in text
    assert "95 % interval" in text
    assert "degrees of freedom" in text
    assert float(both.scene.material.youngs_modulus) == pytest.approx(both["E"].value)
    with pytest.raises(KeyError, match="no estimate 'G'"):
        both["G"]


@pytest.mark.thorough
def test_the_jacobian_is_that_of_differences():
    """By all parameters, of tracks and a series together."""
    times, x, which = tracks()
    seen = [
        mpm.Tracks(times, x, which=which, sigma=NOISE),
        mpm.Series(times[::2] - DT / 3, x[::2, -1, 0], mpm.fitting.Extent(0), sigma=1e-3),
    ]
    speed = mpm.Unbounded(update=lambda e, s: eqx.tree_at(lambda e: e.particles.v, e, s * e.particles.v), start=1.0)
    problem = FitProblem((experiment(seen),), {"E": STIFFNESS, "speed": speed})
    z = jnp.asarray([0.1, -0.05])
    r, J = eqx.filter_jit(problem.jacobian)(z)
    assert r.shape == (x.size + len(times[::2]),)
    h = 1e-5
    for k in range(2):
        step = h * jnp.eye(2)[k]
        ends = [eqx.filter_jit(problem.jacobian)(z + s * step)[0] for s in (1, -1)]
        difference = (ends[0] - ends[1]) / (2 * h)
        assert np.abs(J[:, k] - difference).max() < 1e-6 * np.abs(difference).max()


class Line(FitProblem):
    """y = a x of data with noise, in the place of a simulation: what is estimated is known in closed form."""

    x: np.ndarray

    def __init__(self, x, observations, prior=None):
        (scene, particles), t1 = bar(), STEPS * DT
        self.experiments = (mpm.Experiment(scene, particles, t1=t1, dt=DT, observations=observations),)
        self.names, self.parameters = ("a",), (mpm.Unbounded(lambda e: e.scene.gravity[0], start=1.0, prior=prior),)
        self.starts, self.x, self.sigmas = (jnp.asarray(1.0),), x, first_noise(self.experiments)

    def residuals(self, z, adjoint):
        parts = [o.residuals((1 + z[0]) * self.x, s) for o, s in zip(self.observations, self.sigmas, strict=True)]
        prior = self.parameters[0].prior
        return jnp.concatenate(parts + ([] if prior is None else [prior.residuals(1 + z, 1 + z)])), jnp.zeros(1)


def fitted_line(monkeypatch, y, prior=None, **options):
    times = np.linspace(0.001, 0.05, len(y))
    seen = mpm.Series(times, y, mpm.fitting.Extent(0), **options)
    monkeypatch.setattr("mpmjax.fitting._fit.FitProblem", lambda *_: Line(times * 20, seen, prior))
    return fit([], {})


@pytest.mark.thorough
def test_a_prior_and_outliers_are_weighed_by_the_estimated_noise(monkeypatch):
    """Slope 2 with noise 0.01: a prior of 1 ± 0.3 hardly counts, outliers hardly count with a robust loss, and the
    estimate of σ is right with a weight and with a robust loss."""
    rng = np.random.default_rng(0)
    x = np.linspace(0.02, 1, 400)
    y = 2 * x + 0.01 * rng.normal(size=400)
    exact = (x @ y) / (x @ x)
    with_prior = fitted_line(monkeypatch, y, prior=mpm.fitting.Gaussian(1.0, 0.3))
    assert with_prior["a"].value == pytest.approx(exact, abs=2e-4)
    assert fitted_line(monkeypatch, y, weight=0.25).noise[0].sigma == pytest.approx(0.01, rel=0.1)
    robust = fitted_line(monkeypatch, y, robust=1.0)
    assert robust.noise[0].sigma == pytest.approx(0.01, rel=0.1)
    assert np.isnan(robust.p_value)
    y[::40] += 3.0
    assert fitted_line(monkeypatch, y, robust=1.0)["a"].value == pytest.approx(2, abs=0.01)
    assert abs(fitted_line(monkeypatch, y)["a"].value - 2) > 0.05


@pytest.mark.parametrize("steps", [7, 60, 999, 10**6])
def test_times_of_a_run_in_single_precision_lie_in_it(steps):
    """Those of its frames as they are, also where they round to times after t1; later ones do not."""
    scene, particles = bar()
    for dt in (1e-3, 3e-4, 1 / 7, 0.06 / 60):
        t1, short = steps * dt, np.float32(dt)
        times = np.arange(steps - 2, steps + 1, dtype=np.float32) * short
        seen = mpm.Series(times, np.zeros(3), mpm.fitting.Extent(0))
        seen.check(scene, particles, t1)
        assert seen.part_until(t1).count == 3
        with pytest.raises(ValueError, match="must lie in the run"):
            seen.check(scene, particles, 0.99 * t1)
        run = Mock(spec=mpm.Run, dt=jnp.asarray(short), steps=range(steps + 1))
        predicted = seen.predict(jnp.arange(steps + 1, dtype=jnp.float32), run)
        assert np.asarray(predicted) == pytest.approx(np.arange(steps - 2, steps + 1), rel=3e-7)
        run.steps = range(int(0.99 * steps))
        assert np.isnan(seen.predict(jnp.zeros(len(run.steps), jnp.float32), run)[-1])


@pytest.mark.thorough
def test_fits_in_single_precision_converge_and_large_moduli_are_numbers():
    """E = 1e9 Pa of a bar in float32, whose residuals are never still."""
    grid = mpm.Grid((12,), 0.1, origin=(-4,))
    q = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3, dtype="float32")
    q = eqx.tree_at(lambda q: q.v, q, jnp.asarray(1.5, jnp.float32) * (q.x - 0.2))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e9, 0.3))
    run = mpm.simulate(scene, q, t1=15 * 3e-5, dt=3e-5, save_every=1)
    seen = mpm.Tracks(np.asarray(run.times)[1:], np.asarray(run.frames.x)[1:], which=np.arange(q.count), sigma=1e-6)
    softer = mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=8e8)
    found = fit(mpm.Experiment(scene, q, t1=15 * 3e-5, dt=3e-5, observations=seen), {"E": softer})
    assert found.converged
    assert found["E"].value == pytest.approx(1e9, rel=2e-2)


@pytest.mark.thorough
def test_what_the_data_do_see_of_a_pair_has_an_error():
    """Of E and density only the ratio is seen: it is reported with the error of E alone."""
    times, x, which = tracks()
    start = np.asarray(bar()[1].mass)
    heavier = mpm.Positive(
        update=lambda e, f: eqx.tree_at(lambda e: e.particles.mass, e, f * jnp.asarray(start)), start=1.0
    )
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    ratio = {"ratio": lambda e: e.scene.material.youngs_modulus / e.particles.mass[0] * start[0]}
    alone = fit(experiment(seen), {"E": STIFFNESS})
    with pytest.warns(UserWarning, match="only their ratio"):
        both = fit(experiment(seen), {"E": STIFFNESS, "density": heavier}, report=ratio)
    assert both["ratio"].value == pytest.approx(alone["E"].value, rel=1e-4)
    assert both["ratio"].error == pytest.approx(alone["E"].error, rel=1e-2)
    assert both["E"].interval == (0, np.inf)


def test_a_force_is_said_in_the_run_and_nowhere_else():
    """Those of the midpoint rule stand at the middles of steps; a time that a parameter moves out of the run is not
    predicted."""
    forces = Mock(force=jnp.asarray([1.0, 3.0, 7.0])[:, None, None])
    run = Mock(spec=mpm.Run, dt=0.1, steps=np.arange(4), method=mpm.ImplicitMidpoint(), forces=lambda: forces)
    seen = mpm.fitting.Force([0.0, 0.05, 0.1, 0.3], np.ones((4, 1)))
    assert np.allclose(seen.predict(None, run)[:, 0], [0, 1, 2, 9])
    late = eqx.tree_at(lambda o: o.times, seen, seen.times + 0.2)
    assert np.isfinite(late.predict(None, run)[:, 0]).tolist() == [True, True, True, False]


def test_between_steps_a_series_is_interpolated_linearly():
    seen = jnp.asarray([[0.0], [1.0], [4.0]])
    assert np.allclose(between(seen, jnp.asarray([0.0, 0.25, 1.0, 1.5, 2.0]))[:, 0], [0, 0.25, 1, 2.5, 4])


@pytest.mark.thorough
def test_the_force_on_a_collider_fixes_the_density_of_what_rests_on_it():
    """A block on a plate presses with its weight; the estimate is that of the forces' mean."""
    grid = mpm.Grid((10, 12), 0.1, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=800.0)
    plate = mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0)))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), gravity=(0.0, -9.81), boundary=plate)
    at = {"t1": 0.06, "dt": 2e-3}
    forces = mpm.simulate(scene, block, save_every=1, **at).forces()
    mass = np.asarray(block.mass)
    scale = mpm.Positive(update=lambda e, f: eqx.tree_at(lambda e: e.particles.mass, e, f * mass), start=0.7)
    seen = mpm.fitting.Force(np.asarray(forces.times)[::2], np.asarray(forces.force)[::2, 0], sigma=0.1)
    found = fit(mpm.Experiment(scene, block, observations=seen, **at), {"density": scale})
    assert found["density"].value == pytest.approx(1, rel=1e-4)
    with pytest.raises(ValueError, match="the scene has 1"):
        mpm.Experiment(scene, block, observations=mpm.fitting.Force([0.01], [[0.0, 0.0]], collider=3), **at)


@pytest.mark.parametrize(
    ("parameter", "start"), [(STIFFNESS, 3.0), (RATIO, 0.2), (mpm.Unbounded(lambda e: e.scene.gravity), -2.0)]
)
def test_coordinates_start_at_zero_and_keep_to_the_bounds(parameter, start):
    start = jnp.asarray(start)
    assert float(parameter.value(start, jnp.zeros(()))) == pytest.approx(float(start))
    far = [float(parameter.value(start, jnp.asarray(z))) for z in (-40.0, 40.0)]
    lower, upper = {mpm.Positive: (0, np.inf), mpm.Bounded: (0, 0.49)}.get(type(parameter), (-np.inf, np.inf))
    assert lower <= far[0] < far[1] <= upper


@pytest.mark.thorough
def test_unknown_noise_is_estimated_and_errors_are_students():
    """The same data with σ given: the estimate is σ but for chance, the errors in proportion, the interval by t."""
    times, x, which = tracks()
    given = fit(experiment(mpm.Tracks(times, x, which=which, sigma=NOISE)), {"E": STIFFNESS})
    found = fit(experiment(mpm.Tracks(times, x, which=which)), {"E": STIFFNESS})
    sigma = np.sqrt(given.chi_squared / (x.size - 1)) * NOISE
    assert found.noise[0].sigma == pytest.approx(sigma, rel=1e-4)
    assert found["E"].value == pytest.approx(given["E"].value, rel=1e-6)
    assert found["E"].error == pytest.approx(given["E"].error * sigma / NOISE, rel=1e-4)
    from scipy.stats import t

    half = np.log(found["E"].interval[1] / found["E"].value) / (found["E"].error / found["E"].value)
    assert half == pytest.approx(t.ppf(0.975, x.size - 1), rel=1e-6)


@pytest.mark.thorough
def test_several_unknown_noises_are_estimated_each():
    """The good data rule: the estimate is that of the good ones with their own noise."""
    times, x, which = tracks()
    rng = np.random.default_rng(4)
    bad = x + 30 * NOISE * rng.normal(size=x.shape)
    seen = [mpm.Tracks(times, x, which=which, name="good"), mpm.Tracks(times, bad, which=which, name="bad")]
    found = fit(experiment(seen), {"E": STIFFNESS})
    assert found.noise[0].sigma == pytest.approx(NOISE, rel=0.3)
    assert found.noise[1].sigma == pytest.approx(30 * NOISE, rel=0.3)
    assert abs(found["E"].value - 7e4) < 4 * found["E"].error


@pytest.mark.thorough
def test_intervals_cover_the_truth_as_often_as_they_say():
    """200 fits with new noise: 95 % intervals of E hold the truth between 184 and 196 times."""
    times, exact, which = tracks(sigma=None)
    held, seen = 0, mpm.Tracks(times, exact, which=which)
    rng = np.random.default_rng(7)
    for _ in range(200):
        data = exact + NOISE * rng.normal(size=exact.shape)
        result = fit(experiment(eqx.tree_at(lambda o: o.data, seen, data)), {"E": STIFFNESS})
        held += result["E"].interval[0] < 7e4 < result["E"].interval[1]
    assert 184 <= held <= 196


def test_a_marker_between_particles_follows_any_affine_motion():
    scene, particles = bar(n=2)
    places = np.array([[0.13, 0.21], [0.3, 0.05], [0.39, 0.39]])
    markers = mpm.fitting.Markers.at(particles, places)
    A, b = np.array([[1.2, 0.3], [-0.4, 0.8]]), np.array([0.1, -2.0])
    moved = eqx.tree_at(lambda q: q.x, particles, particles.x @ A.T + b)
    assert np.allclose(markers(scene, moved), places @ A.T + b, atol=1e-12)
    with pytest.raises(ValueError, match="must lie on the body"):
        mpm.fitting.Markers.at(particles, np.array([[2.0, 2.0]]))


def test_a_picture_keeps_the_mass_and_needs_no_correspondence():
    scene, particles = bar(n=2)
    picture = mpm.fitting.Density(mpm.Grid((16, 16), 0.1, origin=(-6, -6)))
    image = picture(scene, particles)
    assert float(image.sum()) * 0.1**2 == pytest.approx(float(particles.mass.sum()))
    shuffled = np.random.default_rng(0).permutation(np.asarray(particles.x))
    assert np.allclose(picture.of_points(shuffled, float(particles.mass.sum())), image)
    cut = mpm.fitting.Density(mpm.Grid((6, 6), 0.1, origin=(-4, -4)))(scene, particles)
    assert float(cut.sum()) * 0.1**2 < 0.5 * float(particles.mass.sum())


@pytest.mark.thorough
def test_a_prior_acts_as_one_more_measurement():
    """E = 5e4 ± 1 Pa rules over noisy tracks."""
    times, x, which = tracks()
    known = mpm.Positive(STIFFNESS.where, start=1e5, prior=mpm.fitting.Gaussian(5e4, 1.0))
    found = fit(experiment(mpm.Tracks(times, x, which=which, sigma=10 * NOISE)), {"E": known})
    assert found["E"].value == pytest.approx(5e4, rel=1e-3)
    assert found["E"].error == pytest.approx(1.0, rel=0.05)


@pytest.mark.thorough
def test_outliers_count_little_with_a_robust_loss():
    times, x, which = tracks()
    x[4, 1] += 0.05
    plain, robust = (
        fit(experiment(mpm.Tracks(times, x, which=which, sigma=NOISE, robust=limit)), {"E": STIFFNESS})
        for limit in (None, 2.0)
    )
    assert abs(robust["E"].value / 7e4 - 1) < 0.05 * abs(plain["E"].value / 7e4 - 1)
    assert any("times the noise given" in text for text in plain.warnings)


@pytest.mark.thorough
def test_what_the_data_cannot_tell_apart_is_named():
    """A free bar's motion depends on E over its density alone."""
    times, x, which = tracks()
    start = np.asarray(bar()[1].mass)
    heavier = mpm.Positive(
        update=lambda e, f: eqx.tree_at(lambda e: e.particles.mass, e, f * jnp.asarray(start)), start=1.0
    )
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    with pytest.warns(UserWarning, match="E and density: only their ratio is seen"):
        found = fit(experiment(seen), {"E": STIFFNESS, "density": heavier})
    assert np.isinf(found["E"].error)


@pytest.mark.thorough
def test_two_experiments_share_a_parameter():
    """Each alone has √2 times the error."""
    times, x, which = tracks()
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    one = fit(experiment(seen), {"E": STIFFNESS})
    two = fit([experiment(seen), experiment(seen)], {"E": STIFFNESS})
    assert two["E"].value == pytest.approx(one["E"].value, rel=1e-5)
    assert two["E"].error * np.sqrt(2) == pytest.approx(one["E"].error, rel=1e-4)


class Failing(FitProblem):
    """r = 100 (0.3 + z)³ − 50, NaN from an end on."""

    end: float

    def __init__(self, end):
        self.experiments, self.names, self.parameters, self.starts = (), ("z",), (STIFFNESS,), (jnp.zeros(()),)
        self.memory, self.end = 2**28, end

    @property
    def dtype(self):
        return jnp.float64

    def jacobian(self, z, mode=None):
        far = jnp.where(z < self.end, z, jnp.nan)
        return 100 * ((0.3 + far) ** 3 - 0.5), 100 * (3 * (0.3 + far) ** 2)[:, None]


def test_a_step_at_which_the_simulation_fails_is_not_taken():
    """The first Gauss-Newton step goes beyond z = 1."""
    found = search(Failing(1.0), mpm.fitting.LevenbergMarquardt(), jnp.zeros(1))
    assert found.converged
    assert not all(iteration.accepted for iteration in found.history)
    assert float(found.z[0]) == pytest.approx(0.5 ** (1 / 3) - 0.3, rel=1e-5)


def test_a_search_that_ends_where_simulations_begin_to_fail_has_not_converged():
    """The minimum, z = 0.494, lies beyond z = 0.4, where they fail; among others it ends as alone."""
    lm = mpm.fitting.LevenbergMarquardt(max_steps=200)
    alone = search(Failing(0.4), lm, jnp.zeros(1))
    assert not alone.converged
    assert len(alone.history) < 200
    assert float(alone.z[0]) == pytest.approx(0.4, abs=1e-2)
    among = search_many([Failing(0.4)], lm, dict.fromkeys(range(2), np.zeros(1)), batch=2)[1]
    assert (among.converged, len(among.history)) == (False, len(alone.history))


class Saturated(Failing):
    """r = 100 (z_0 + 1), 100 (s(z_1) − ½) with a sigmoid s that has a slope of 0.0017 at the start."""

    def __init__(self):
        super().__init__(jnp.inf)
        self.names, self.parameters, self.starts = ("a", "b"), (STIFFNESS,) * 2, (jnp.ones(()),) * 2

    def jacobian(self, z, mode=None):
        residuals = lambda z: 100 * jnp.stack([z[0] + 1, jax.nn.sigmoid(3 * (z[1] + 2.5)) - 0.5])  # noqa: E731
        return residuals(z), jax.jacfwd(residuals)(z)


def test_no_step_goes_where_a_straight_line_cannot_know():
    """The first Gauss-Newton step, to z = −300, would lower Σ r² by the other number, where this one is not seen."""
    found = search(Saturated(), mpm.fitting.LevenbergMarquardt(), jnp.zeros(2))
    assert found.converged
    assert np.allclose(found.z, [-1, -2.5], atol=1e-5)
    assert len(found.history) < 15


class Rounded(Failing):
    """r = 100 + x (z − 1) + z²/1000 and a rounding of single precision that its derivative does not know."""

    @property
    def dtype(self):
        return jnp.float32

    def jacobian(self, z, mode=None):
        x, z = jnp.linspace(-1.0, 1.0, 400), z.astype("f4").astype(float)
        rounding = 5e-4 * jnp.cos(1e7 * z * x)
        return (100 + x * (z - 1) + z**2 / 1000 + rounding).astype("f4"), (x + z / 500)[:, None].astype("f4")


def test_a_search_ends_where_no_step_can_lower_the_sum_of_squares_by_more_than_its_rounding():
    """The misfit is large, as that of a law which does not explain the data, and so is its rounding. The standard error
    of z is 8.7."""
    found = search(Rounded(jnp.inf), mpm.fitting.LevenbergMarquardt(), jnp.zeros(1))
    z, squares = np.linspace(0.0, 1.0, 100_001), (np.linspace(-1.0, 1.0, 400) ** 2).sum()
    least = z[np.argmin(400 * (100 + z**2 / 1000) ** 2 + squares * (z - 1) ** 2)]
    assert found.converged
    assert len(found.history) < 20
    assert float(found.z[0]) == pytest.approx(least, abs=0.1)


@pytest.mark.thorough
def test_a_simulation_at_fault_has_residuals_of_nan():
    times, x, which = tracks()
    problem = FitProblem((experiment(mpm.Tracks(times, x, which=which, sigma=NOISE)),), {"E": STIFFNESS})
    beyond, _ = eqx.filter_jit(problem.jacobian)(jnp.asarray([8.0]), (jnp.asarray(NOISE),))
    assert np.isnan(beyond).all()


def ones(shape):
    return np.ones(shape)


SERIES = (np.array([0.01, 0.02]), np.ones(2))
REFUSED = {
    "no number": ({"E": mpm.Positive(lambda e: e.scene.material.stiffness)}, {}, "must name a number"),
    "no influence": ({"E": STIFFNESS}, {}, "do not depend on E"),
    "negative": ({"E": mpm.Positive(STIFFNESS.where, start=-1.0)}, {}, "must start from positive"),
    "beyond": ({"nu": mpm.Bounded(RATIO.where, 0.0, 0.2, start=0.3)}, {}, "between its bounds"),
    "no such experiment": ({"E": mpm.Positive(STIFFNESS.where, only=(3,))}, {}, "experiments .3."),
    "nothing": ({}, {}, "needs a parameter"),
}


@pytest.mark.parametrize(("parameters", "material", "says"), REFUSED.values(), ids=REFUSED)
def test_bad_parameters_get_one_line(parameters, material, says):
    series = mpm.Series(*SERIES, lambda s, p: p.x.mean(), sigma=1.0)
    with pytest.raises(ValueError, match=says):
        fit(experiment(series, **material), parameters)


BAD_DATA = {
    "another shape": (lambda: mpm.Series([0.01], ones(1), lambda s, p: p.x[3]), "but of returns shape"),
    "no axis": (lambda: mpm.Series([0.01], ones(1), mpm.fitting.Extent(5)), "axis must be below"),
    "late": (lambda: mpm.Series([0.01, 9.0], ones(2), mpm.fitting.Extent(0)), "must lie in the run"),
    "unsorted": (lambda: mpm.Series([0.02, 0.01], ones(2), mpm.fitting.Extent(0)), "must grow"),
    "empty": (lambda: mpm.Series([0.02], np.array([np.nan]), mpm.fitting.Extent(0)), "has no data"),
    "infinite": (lambda: mpm.Series([0.02], np.array([np.inf]), mpm.fitting.Extent(0)), "finite data"),
    "no noise": (lambda: mpm.Series([0.02], ones(1), mpm.fitting.Extent(0), sigma=0.0), "greater than zero"),
    "shape": (lambda: mpm.Series([0.01, 0.02], ones(3), mpm.fitting.Extent(0)), "data of shape"),
    "markers": (lambda: mpm.Tracks([0.01], ones((1, 2, 1)), which=[0]), "of the m markers"),
    "no particle": (lambda: mpm.Tracks([0.01], ones((1, 1, 1)), which=[99]), "from 0"),
    "dimension": (lambda: mpm.Tracks([0.01], ones((1, 1, 3)), which=[0]), "3-dimensional"),
}


@pytest.mark.parametrize(("observation", "says"), BAD_DATA.values(), ids=BAD_DATA)
def test_bad_data_get_one_line(observation, says):
    with pytest.raises(ValueError, match=says):
        experiment(observation())


def test_a_curve_that_the_run_does_not_reach_is_an_error_and_not_a_flat_line():
    """Nor one whose abscissa turns round."""
    scene, particles = bar()
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=1)
    curve = mpm.Curve([0.5, 9.0], [1.0, 1.0], lambda s, p: (p.x.max(), p.x.min()))
    for seen, says in (([0.4, 0.5, 0.6], "leaves out measured points"), ([0.4, 0.5, 0.45], "must grow")):
        x = jnp.asarray(seen)
        assert np.isnan(curve.predict((x, x), run)).any()
        with pytest.raises(ValueError, match=says):
            curve.explain((x, x), run)


@pytest.mark.thorough
def test_a_simulation_that_fails_at_the_first_guess_says_where():
    series = mpm.Series([0.01], ones(1), mpm.fitting.Extent(0), sigma=1.0)
    with pytest.raises(mpm.SimulationError, match="step"):
        fit(experiment(series, E=1e9), {"E": mpm.Positive(STIFFNESS.where)})


@pytest.mark.thorough
def test_an_interruption_keeps_the_best_so_far():
    """Ctrl-C after the third iteration."""
    times, x, which = tracks()
    lines = []

    def interrupt(line):
        lines.append(line)
        if len(lines) == 4:  # the first says that it compiles
            raise KeyboardInterrupt

    with pytest.warns(UserWarning, match="was interrupted"):
        found = fit(experiment(mpm.Tracks(times, x, which=which, sigma=NOISE)), {"E": STIFFNESS}, progress=interrupt)
    assert not found.converged
    assert len(found.history) == 3
    assert found["E"].value == pytest.approx(float(problem_value(found)))


def problem_value(found):
    return 1e5 * np.exp(found.history[-1].z[0])


@pytest.mark.thorough
def test_the_discretisation_stands_beside_the_noise_and_rules():
    """A bar on a grid 8 times finer, with another kernel and transfer: the extrapolated fit is less than half as far
    off as the coarse one, and its interval holds E."""
    times = np.arange(1, 13) * 5e-3

    def build(n, kernel=2, transfer=None, E=9e4, seen=None):
        grid = mpm.Grid((16 * n,), 0.1 / n, origin=(-4 * n,))
        q = mpm.fill(mpm.Box((0.0,), (0.8,)), grid, particles_per_cell=2, density=1e3)
        q = eqx.tree_at(lambda q: q.v, q, jnp.sin(np.pi * (q.x / 0.8 - 0.5)))
        scene = mpm.Scene(grid, mpm.NeoHookean(E, 0.3), kernel=mpm.BSpline(kernel), transfer=transfer or mpm.APIC())
        if seen is None:
            return scene, q
        return mpm.Experiment(scene, q, t1=0.06, dt=2.5e-3 / n, observations=seen)

    def spread(scene, q):
        return jnp.sqrt(((q.x - q.x.mean()) ** 2).mean())

    scene, q = build(8, kernel=3, transfer=mpm.FLIP(1.0), E=7e4)
    run = mpm.simulate(scene, q, t1=0.06, dt=2.5e-3 / 8, save_every=16, observe=spread)
    data = np.asarray(run.observed)[1:13] * (1 + 1e-6 * np.random.default_rng(2).normal(size=12))
    seen = mpm.Series(times, data, spread)
    stiffness = mpm.Positive(lambda e: e.scene.material.youngs_modulus)
    found = mpm.fitting.fit_refined(lambda n: build(n, seen=seen), {"E": stiffness}, order=2)
    coarse, last = found.fits[0]["E"], found["E"]
    assert abs(last.value - 7e4) < 0.5 * abs(coarse.value - 7e4)
    assert last.interval[0] < 7e4 < last.interval[1]
    assert "discretisation" in str(found)
    with pytest.raises(ValueError, match="two or more growing"):
        mpm.fitting.fit_refined(lambda n: build(n, seen=seen), {"E": stiffness}, refinements=(2, 1))


def test_two_grids_that_agree_by_chance_are_not_believed():
    """Linear least squares with errors h² and h⁴ of smooth patterns: of 95 % intervals nine in ten would hold the truth
    by the change from grid to grid alone, and do so by what the misfit loses too."""
    rng, x, noise = np.random.default_rng(0), np.linspace(0, 1, 100), 1e-3
    waves = np.sin(np.pi * np.outer(x, np.arange(1, 6)))
    held = {False: 0, True: 0}
    for _ in range(60):
        A, second, fourth = (waves @ rng.normal(size=(5, k)) for k in (2, 1, 1))
        error = noise * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
        grids, data = [], noise * rng.normal(size=100)
        for h in (1.0, 0.5):
            y = data - h**2 * second[:, 0] - h**4 * fourth[:, 0]
            a = np.linalg.lstsq(A, y, rcond=None)[0]
            misfit = float(np.sqrt(((y - A @ a) ** 2).mean())) / noise
            ends = np.stack([a - 2 * error, a + 2 * error], axis=1)
            found = [Estimate(str(k), a[k], error[k], tuple(ends[k]), noise_error=error[k]) for k in (0, 1)]
            grids.append((found, (NoiseEstimate("y", noise, False, misfit, 100, 100.0, "", False),)))
        (coarse, before), (fine, after) = grids
        for told in held:
            missed = _missed(before, after, [1, 2], 2.0) if told else 0.0
            each = [_extrapolate(None, pair, [1, 2], 2.0, missed, 1.96)[0] for pair in zip(coarse, fine, strict=True)]
            held[told] += sum(e.interval[0] < 0 < e.interval[1] for e in each)
    assert held[False] < 0.93 * 120
    assert held[True] > 0.94 * 120


def test_an_order_above_the_one_that_is_asked_for_does_not_narrow_the_interval():
    """Where errors c h + e h⁴ are fitted on three grids: extrapolated with the order that they show, with the error of
    the correction with the first order. That of the order shown would miss the truth, which is 0."""
    for h4 in (10.0, 30.0, 100.0):
        values = [h + h4 * h**4 for h in (1.0, 0.5, 0.25)]
        found = tuple(Estimate(str(k), value, 0.0, (value, value), noise_error=0.0) for k, value in enumerate(values))
        last, left, p = _extrapolate(None, found, [1, 2, 4], 1.0, 0.0, 1.96)
        assert p == 2
        assert last.value == pytest.approx(values[2] - (values[1] - values[2]) / 3)
        assert left == pytest.approx(values[1] - values[2])
        assert last.interval[0] < 0 < last.interval[1]


def test_a_number_near_or_at_its_bound_is_extrapolated_no_farther_than_that():
    """Poisson's ratio, searched by its logit, in which a step from a bound is as long as one likes: extrapolated along
    a straight line in the value; and not at all from a grid on which it lies at its bound."""
    nu = mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.0, 0.49)

    def estimate(value, at_bound=False):
        ends = max(value - 4e-2, 0.0), value + 4e-2
        return Estimate("nu", value, 2e-2, ends, at_bound=at_bound, noise_error=2e-2)

    last, left, _ = _extrapolate(nu, (estimate(3e-3), estimate(5e-3)), [1, 2], 1.0, 0.0, 1.96)
    assert last.value == pytest.approx(7e-3)
    assert left == pytest.approx(2e-3)
    assert last.interval == pytest.approx((0, 7e-3 + np.hypot(4e-2, 1.96 * 2e-3)))
    last, _, _ = _extrapolate(nu, (estimate(5e-3), estimate(2e-3)), [1, 2], 1.0, 0.0, 1.96)
    assert last.value == 0
    with pytest.warns(UserWarning, match="nu lies at its bound on a grid"):
        last, left, _ = _extrapolate(nu, (estimate(1e-9, True), estimate(3e-2)), [1, 2], 1.0, 0.0, 1.96)
    assert (last.value, last.at_bound) == (3e-2, True)
    assert left == pytest.approx(3e-2)
    assert last.interval == pytest.approx((0, 3e-2 + np.hypot(4e-2, 1.96 * 3e-2)))


@pytest.mark.thorough
def test_a_measurements_zero_of_time_is_a_parameter():
    """A front that was read off a clock two steps late; a clock that leaves the run says so."""
    scene, particles = bar()
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=1, observe=mpm.fitting.Extent(0))
    seen = mpm.Series(np.arange(2, 11) * DT, np.asarray(run.observed)[4:13], mpm.fitting.Extent(0), sigma=NOISE)

    def late(e, by):
        return eqx.tree_at(lambda e: e.observations[0].times, e, seen.times + by)

    found = fit(experiment(seen), {"late": mpm.Unbounded(update=late, start=0.5 * DT, scale=DT)})
    assert found["late"].value == pytest.approx(2 * DT, rel=1e-3)
    with pytest.raises(ValueError, match="times of 'series' out of the run"):
        fit(experiment(seen), {"late": mpm.Unbounded(update=late, start=5.5 * DT, scale=DT)})


def test_fits_with_new_data_do_not_compile_anew(caplog):
    times, x, which = tracks()
    seen = mpm.Tracks(times, x, which=which, sigma=NOISE)
    fit(experiment(seen), {"E": STIFFNESS})
    with jax.log_compiles():
        fit(experiment(eqx.tree_at(lambda o: o.data, seen, x + 1e-5)), {"E": STIFFNESS})
    assert not [record for record in caplog.records if "compilation of" in record.getMessage()]


class Scaled(eqx.Module):
    """The place of a particle in units of its own, of which a fit may find the size."""

    unit: jnp.ndarray

    def __call__(self, scene, particles):
        return particles.x[0] / self.unit


def test_numbers_of_observations_have_derivatives_in_a_program_of_their_own():
    """Beside one of the scene, as when both are in one program."""
    times, x, _ = tracks()
    seen = mpm.Series(times, x[:, 0], Scaled(jnp.asarray(1.1)), sigma=NOISE)
    of = {"E": STIFFNESS, "unit": mpm.Positive(lambda e: e.observations[0].of.unit)}
    whole = [FitProblem(experiment(seen), of, memory) for memory in (2**28, 1)]
    z = jnp.array([0.05, -0.1])
    (r, J), (expected, by_each) = (jacobian(problem, z) for problem in whole)
    assert [parts_kept(problem, 3) is None for problem in whole] == [False, True]
    np.testing.assert_allclose(r, expected, rtol=1e-9)
    np.testing.assert_allclose(J, by_each, rtol=1e-9, atol=1e-9 * np.abs(by_each).max())
    assert (np.abs(J).max(axis=0) > 0).all()


@pytest.mark.parametrize(("sign", "start", "told"), [(1, 7.2e4, 0), (-1, 7.2e4, 1), (-1, 1e5, 0)])
def test_data_of_the_other_sign_are_told_at_the_first_guess(sign, start, told, recwarn):
    """As of a force that a machine counts the other way; a scale of -1 turns it. A guess so far off that it swings out
    of time is like neither sign."""
    times, x, which = tracks()
    x0 = x[0, -1, 0]
    pulled = mpm.Series(times, sign * (x[:, -1, 0] - x0), lambda s, p: p.x[which[-1], 0] - x0, sigma=1e-3)
    guess = mpm.Positive(STIFFNESS.where, start=start)
    mpm.fit(experiment(pulled), {"E": guess}, optimiser=mpm.fitting.LevenbergMarquardt(max_steps=1), starts=1)
    assert sum("the sign opposite to the data's. Turn the data" in str(w.message) for w in recwarn) == told


def test_a_new_observation_leaves_the_program_of_the_run_as_it_is(caplog):
    """Another function, and other parameters, of one scene; the numbers are those of observations that are a part of
    the run's program, as where memory has no room for states."""
    times, x, _ = tracks()
    of = {"E": STIFFNESS}

    def problem(function, memory=2**28):
        seen = mpm.Series(times, x[:, 0], function, sigma=NOISE)
        return FitProblem(experiment(seen, steps=STEPS + 1), of, memory)

    def first(scene, particles):
        return particles.x[0]

    z, points = jnp.zeros(1), np.linspace(-0.1, 0.1, 3)[:, None]
    assert parts_kept(problem(first), 2) == (Kept((True, False, False, False)),)  # of x, v, C and F
    with jax.log_compiles():
        at, squares = evaluated(problem(first), z), costs_at(problem(first), points, 3)
    names = [record.getMessage() for record in caplog.records]
    assert sum("compilation of jit(_run)" in name for name in names) == 2
    scarce = problem(first, 1)
    r, J = jacobian(scarce, z)
    assert parts_kept(scarce, 1) is None
    np.testing.assert_allclose(at.residuals, r, rtol=1e-9, atol=1e-9 * np.abs(r).max())
    np.testing.assert_allclose(at.jacobian, J, rtol=1e-9, atol=1e-9 * np.abs(J).max())
    np.testing.assert_allclose(squares, costs_at(scarce, points, 3), rtol=1e-9)
    assert squares[1] == pytest.approx((r**2).sum() / 2)
    of["E"] = eqx.tree_at(lambda p: p.where, STIFFNESS, lambda e: e.scene.material.youngs_modulus)
    third = problem(lambda scene, particles: particles.x[3] - particles.x[0])
    caplog.clear()
    with jax.log_compiles():
        assert np.abs(evaluated(third, z).residuals - at.residuals).max() > 1
        costs_at(third, points, 3)
    names = [record.getMessage() for record in caplog.records]
    assert sum("compilation of jit(_compared)" in name for name in names) == 2
    assert not any("compilation of jit(_run)" in name for name in names)
