"""Errors of fits: profiles, bands of predictions, and words for what the data cannot tell."""

import functools
import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import slow, thorough
from matplotlib import pyplot as plt
from scipy.integrate import quad
from scipy.optimize import least_squares, lsq_linear
from scipy.stats import norm, t

import mpmjax as mpm
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import Minimum, fit_result, minimum_of
from mpmjax.fitting._search import Search, search, search_many
from mpmjax.fitting._uncertainty import _mean_square, at_bound, banded, noise, seen_together, uncertainty
from mpmjax.viz import write_fit

fit = partial(mpm.fit, discretisation=False)  # most of these tests are of the search

GIVEN_NOISE = [(jnp.ones(()), 1.0, 0.0)]

DT, STEPS, NOISE = 4e-3, 15, 2e-3
G, V = 9.81, 0.3


def thrown(observations, steps=STEPS, **options):
    """A bar that falls freely: its places are linear in gravity and speed."""
    grid = mpm.Grid((14,), 0.1, origin=(-6,))
    bar = mpm.fill(mpm.Box((0.0,), (0.3,)), grid, particles_per_cell=2, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(7e4, 0.3), gravity=(-5.0,))
    return mpm.Experiment(scene, bar, t1=steps * DT, dt=DT, observations=observations, **options)


GRAVITY = mpm.Positive(update=lambda e, g: eqx.tree_at(lambda e: e.scene.gravity, e, -g[None]), start=5.0, unit="m/s²")
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
    return mpm.Series(times, middle[:, None], mpm.fitting.CentreOfMass(), **options)


def twice_as_long(e):
    """Where the middle is after twice the time."""
    run = mpm.simulate(e.scene, e.particles, t1=2 * STEPS * DT, dt=DT, adjoint=diffrax.ForwardMode())
    return run.final.x.mean()


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
    return seen, fit(thrown(seen), {"g": GRAVITY, "v": SPEED})


def test_profiles_of_a_linear_problem_are_students_intervals_in_any_coordinate(fall):
    """Gravity is searched by its logarithm, in which the interval of the standard error is not symmetric."""
    seen, result = fall
    found, covariance, reach, _ = exact(seen)
    for k, label in enumerate(("g", "v")):
        profile = mpm.fitting.profile(result, label)
        half = reach * np.sqrt(covariance[k, k])
        assert np.allclose(profile.interval, [found[k] - half, found[k] + half], rtol=0, atol=2e-3 * half)
        statistic = (profile.values - found[k]) ** 2 / covariance[k, k]
        assert np.allclose(profile.statistic, statistic, rtol=1e-3, atol=1e-3)
        other = found[1 - k] + covariance[0, 1] / covariance[k, k] * (profile.values - found[k])
        assert np.allclose(profile.along("vg"[k]), other, rtol=1e-2)
        assert profile.degrees_of_freedom == pytest.approx(STEPS - 2)
        assert profile.threshold == pytest.approx(reach**2)
        assert not profile.warnings
    assert abs(result["g"].interval[1] - found[0] - reach * np.sqrt(covariance[0, 0])) > 0.03 * half


def test_the_profiles_of_a_fit_are_one_program(fall, caplog):
    _, result = fall
    mpm.fitting.profile(result, "g", points=1)
    with jax.log_compiles():
        mpm.fitting.profile(result, "v", points=1, level=0.8)
    assert not [record for record in caplog.records if "compilation of jit(_run)" in record.getMessage()]


def test_the_band_of_a_linear_problem_is_students(fall):
    """Of the mean, and of a new measurement; the same by a function, and with other times."""
    seen, result = fall
    found, covariance, reach, variance = exact(seen)
    A = design()
    middle, error = 0.15 + A @ found, np.sqrt(np.einsum("mi,ij,mj->m", A, covariance, A))
    (band,) = mpm.fitting.predict_observations(result)
    assert np.allclose(band.value[:, 0], middle, atol=1e-6)
    assert np.allclose(band.error[:, 0], error, rtol=1e-3)
    assert np.allclose(band.upper[:, 0] - middle, reach * error, rtol=2e-2)
    assert np.allclose(band.new_upper[:, 0] - middle, reach * np.sqrt(variance + error**2), rtol=1e-2)
    assert np.allclose(band.new_lower + band.new_upper, 2 * band.value)

    last = design(2 * STEPS)[-1]
    later = mpm.fitting.predict(result, twice_as_long)
    assert later.value == pytest.approx(0.15 + last @ found, abs=1e-5)
    assert later.error == pytest.approx(np.sqrt(last @ covariance @ last), rel=1e-3)


def test_a_fit_draws_itself(fall):
    """Into axes of its own or others, a colour for each component that was measured, by its name."""
    _, result = fall
    (axis,) = result.plot()
    (band,) = mpm.fitting.predict_observations(result)
    (model,) = (line for line in axis.lines if line.get_label() == "fit")
    assert np.allclose(model.get_ydata(), band.value[:, 0])
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("time [s]", "series")
    assert axis.get_legend_handles_labels()[1] == ["95 % of the mean", "fit", "measured"]
    assert result.plot(axis) == (axis,)
    with pytest.raises(ValueError, match="got 2 axes and 1 predictions for 1"):
        result.plot([axis, axis])
    plt.close()


def test_what_a_fit_says_follows_from_its_residuals(fall):
    """With large ones drawn nearer too: the same by the runs of other experiments."""
    _, result = fall
    (e,) = result.problem.experiments
    (o,) = e.observations
    drawn = eqx.tree_at(lambda o: (o.weight, o.robust), o, (0.5, 0.7), is_leaf=lambda a: a is None)
    (value,), (J,) = result.fitted
    r, column = jax.jvp(
        lambda p: drawn.residuals(p, result.problem.sigmas[0]), (jnp.asarray(value),), (jnp.asarray(J[..., 0]),)
    )
    parts = {"residuals": np.asarray(r), "jacobian": np.asarray(column)[:, None]}
    moved = replace(result, experiments=(replace(e, observations=(drawn,)),), **parts)
    assert np.allclose(moved.fitted[0][0], value)
    assert np.allclose(moved.fitted[1][0], J[..., :1])
    given = replace(result, noise=tuple(n._replace(estimated=False) for n in result.noise))
    assert 0 < given.p_value < 1
    assert np.isnan([p.p_value for p in (result, moved, replace(given, experiments=moved.experiments))]).all()


@pytest.mark.thorough
def test_an_interval_that_the_data_do_not_close_is_open():
    """Gravity from noise as large as the fall: zero is within the exact interval, no positive number is its lower end;
    with the noise given, the threshold is that of χ²."""
    sigma = 0.05
    seen = measured(sigma, seed=1, sigma=sigma)
    result = fit(thrown(seen), {"g": GRAVITY, "v": SPEED})
    found, covariance, reach, _ = exact(seen, sigma)
    half = reach * np.sqrt(covariance[0, 0])
    assert found[0] - half < 0 < found[0]
    with pytest.warns(UserWarning, match="g: the interval is open below"):
        profile = mpm.fitting.profile(result, "g")
    assert profile.interval == (0, pytest.approx(found[0] + half, abs=2e-3 * half))
    assert np.isinf(profile.degrees_of_freedom)
    assert profile.threshold == pytest.approx(norm.ppf(0.975) ** 2)


def test_the_report_holds_bands_and_profiles(fall, tmp_path):
    _, result = fall
    profiles = (mpm.fitting.profile(result, "g"),)
    numbers = json.loads(write_fit(result, tmp_path / "fit.png", profiles=profiles).read_text(encoding="utf-8"))
    (band,) = mpm.fitting.predict_observations(result)
    assert np.allclose(numbers["predictions"][0]["new_upper"], band.new_upper)
    assert numbers["profiles"][0]["interval"] == list(profiles[0].interval)
    assert (tmp_path / "fit.png").stat().st_size > 10_000
    assert "95 % interval by its profile" in str(profiles[0])


REFUSED = {
    "no parameter": (lambda r: mpm.fitting.profile(r, "G"), "a fitted number: g, v. Got 'G'"),
    "level": (lambda r: mpm.fitting.profile(r, "g", level=1.5), "between 0 and 1"),
    "points": (lambda r: mpm.fitting.profile(r, "g", points=0), "points"),
    "experiment": (
        lambda r: mpm.fitting.predict(r, lambda e: e.scene.gravity[0], experiment=3),
        "experiments 0 to 0, got 3",
    ),
    "too few": (lambda r: mpm.fitting.predict_observations(r, ()), "as many observations"),
}


@pytest.mark.parametrize(("call", "says"), REFUSED.values(), ids=REFUSED)
def test_bad_questions_get_one_line(fall, call, says):
    with pytest.raises(ValueError, match=says):
        call(fall[1])


@pytest.mark.thorough
def test_a_prediction_takes_any_run_that_has_a_forward_derivative(fall):
    """A run as it is has the one of `ForwardMode`. One whose checkpoints move has none, and it is said what to do."""

    def middle(adjoint):
        return mpm.fitting.predict(fall[1], lambda e: e.run(adjoint=adjoint).final.x.mean())

    plain, forward = middle(None), middle(diffrax.ForwardMode())
    assert np.allclose([plain.value, plain.lower], [forward.value, forward.lower], rtol=1e-12)
    with pytest.raises(ValueError, match="ForwardMode"):
        middle(diffrax.RecursiveCheckpointAdjoint(checkpoints=2))


class Abrupt(FitProblem):
    """Δχ² = z²/4 until z = 1, in the place of a simulation; from there on what `beyond` says."""

    beyond: jnp.ndarray
    slope: float

    def __init__(self, beyond, slope=0.5):
        whole = FitProblem((thrown(measured(sigma=1.0)),), {"v": SPEED})
        self.experiments, self.names = whole.experiments, whole.names
        self.parameters, self.starts, self.sigmas = whole.parameters, whole.starts, whole.sigmas
        self.beyond, self.slope = jnp.asarray(beyond), slope

    def residuals(self, z, adjoint):
        return jnp.where(z < 1, z, self.beyond) * jnp.ones(STEPS) * self.slope / np.sqrt(STEPS), jnp.zeros(1)

    def result(self):
        """The fit, at z = 0."""
        column = jnp.full((STEPS, 1), self.slope / np.sqrt(STEPS))
        seen = mpm.fitting.Evaluation(jnp.zeros(()), jnp.zeros(1), jnp.zeros(STEPS), column)
        found = Search(jnp.zeros(1), None, seen, (), converged=True)
        return fit_result(Minimum(self, found, GIVEN_NOISE, moves=False), mpm.fitting.LevenbergMarquardt(), {}, 0.95)


@pytest.mark.parametrize(
    ("beyond", "upper", "says"),
    [
        (np.nan, np.inf, "the interval is open above. At 1.9.* the simulation fails"),
        (30.0, 2.0, "ends above at (2|1.99.*), where Δχ² jumps from 0.25 to 2.2e\\+02"),
        (1.0, np.inf, "the interval is open above. At .* Δχ² is 0.25, less than 3.84"),
    ],
    ids=["fails", "jumps", "saturates"],
)
def test_an_end_that_is_not_the_datas_is_said(beyond, upper, says):
    """Below, the end is that of z = −1.96·2; the value is 1 + z."""
    with pytest.warns(UserWarning, match=says):
        profile = mpm.fitting.profile(Abrupt(beyond).result(), "v")
    assert profile.interval == pytest.approx((1 + 2 * norm.ppf(0.025), upper), abs=5e-3)


def test_a_number_that_is_known_to_its_eighth_digit_has_a_profile():
    profile = mpm.fitting.profile(Abrupt(1.0, slope=1e8).result(), "v")
    assert np.subtract(profile.interval, 1) * 1e8 == pytest.approx(norm.ppf([0.025, 0.975]), rel=2e-3)


class Kinked(Abrupt):
    """3 |z − 0.3| + 1 and noise ±1, as where friction begins to stick: a straight line asks for steps across z = 0.3,
    of 1/3, which no step finds."""

    def residuals(self, z, adjoint):
        return 3 * jnp.abs(z - 0.3) + 1 + jnp.asarray(np.arange(STEPS) % 2 * 2.0 - 1), jnp.zeros(1)


def test_a_search_that_meets_a_kink_ends_soon_says_so_and_holds_the_step_left_undone():
    lm, problem = mpm.fitting.LevenbergMarquardt(), Kinked(0.0)
    found = search_many([problem], lm, {0: np.zeros(1)})[0]
    assert not found.converged
    assert len(found.history) < 25
    assert float(found.z[0]) == pytest.approx(0.3, abs=1e-2)
    result = fit_result(Minimum(problem, found, GIVEN_NOISE, moves=False), lm, {}, 0.95)
    assert any("kink" in text for text in result.warnings)
    (estimate,) = result.estimates
    assert estimate.interval[0] < 1.3 - 0.3 < 1.3 + 0.3 < estimate.interval[1]
    assert np.ptp(estimate.noise_interval) < 0.4


class Bent(Kinked):
    """100 z and 100 + 95 z²/2: Σ r² is 1.95 times as curved as straight lines say, so that each of their steps ends
    nearly as far beyond the minimum as it began before it."""

    def residuals(self, z, adjoint):
        return 100 * jnp.zeros(STEPS).at[0].set(z[0]).at[1].set(1 + 0.95 * z[0] ** 2 / 2), jnp.zeros(1)


def test_a_search_does_not_swing_from_side_to_side_of_a_minimum():
    lm = mpm.fitting.LevenbergMarquardt()
    found = search_many([Bent(0.0)], lm, {0: np.ones(1)})[0]
    assert found.converged
    assert float(found.z[0]) == pytest.approx(0.0, abs=1e-3)
    assert len(found.history) < 15


class Line(FitProblem):
    """A straight line in the place of a simulation: y = A (a, b), σ = 1."""

    y: jnp.ndarray
    A: np.ndarray

    def __init__(self, parameter, y):
        seen = measured(sigma=1.0)
        whole = FitProblem((thrown(seen),), {"a": parameter, "b": SPEED})
        self.experiments, self.names = whole.experiments, whole.names
        self.parameters, self.starts, self.sigmas = whole.parameters, whole.starts, whole.sigmas
        self.y, self.A, self.plane = jnp.asarray(y), LINE, None

    def residuals(self, z, adjoint):
        return jnp.asarray(self.A, z.dtype) @ self.numbers(z) - jnp.asarray(self.y, z.dtype), jnp.zeros(1)


LINE = np.stack([np.ones(STEPS), np.linspace(0, 1, STEPS)], axis=1)
ERROR = float(np.sqrt(np.linalg.inv(LINE.T @ LINE)[0, 0]))
PUT = lambda e, g: eqx.tree_at(lambda e: e.scene.gravity, e, -g[None])  # noqa: E731
BY_A_BOUND = {
    "lower": (mpm.Bounded(lower=4.0, upper=4 + 20 * ERROR, update=PUT, start=4 + 8 * ERROR), 4.0, 1),
    "upper": (mpm.Bounded(lower=4.0, upper=4 + 20 * ERROR, update=PUT, start=4 + ERROR), 4 + 20 * ERROR, -1),
    "zero": (mpm.Positive(update=PUT, start=ERROR), 0.0, 1),
}


@functools.lru_cache(maxsize=3)
def beside_a_bound(name, offset, count):
    """Fits of a line to many draws of noise, the truth so many standard errors from a bound."""
    parameter, bound, side = BY_A_BOUND[name]
    truth = np.array([bound + side * offset * ERROR, 0.3])
    y = LINE @ truth + np.random.default_rng(7 + int(10 * offset)).normal(size=(count, STEPS))
    one = Line(parameter, y[0])
    problems = [eqx.tree_at(lambda line: line.y, one, jnp.asarray(own)) for own in y]
    lm = mpm.fitting.LevenbergMarquardt()
    ends = search_many(problems, lm, dict.fromkeys(range(count), np.zeros(2)), batch=count)
    minima = (Minimum(problem, ends[k], GIVEN_NOISE, moves=False) for k, problem in enumerate(problems))
    results = [fit_result(minimum, lm, {}, 0.95) for minimum in minima]
    return truth, y, results


@pytest.mark.parametrize("name", BY_A_BOUND)
@pytest.mark.parametrize("off", [0.0, 1.0])
def test_a_search_comes_back_from_a_bound_that_hides_the_minimum(name, off):
    """From where the value is e⁻³⁰ from its bound, and its coordinate changes nothing, also with the other number
    off. The truth is seven standard errors from the bound."""
    parameter, bound, side = BY_A_BOUND[name]
    truth = np.array([bound + side * 7 * ERROR, 0.3])
    y = LINE @ truth + np.random.default_rng(3).normal(size=STEPS)
    start = np.array([-30.0 * side, off])
    found = search(Line(parameter, y), mpm.fitting.LevenbergMarquardt(), start)
    assert found.converged
    values = np.asarray(Line(parameter, y).numbers(found.z))
    assert values == pytest.approx(np.linalg.lstsq(LINE, y)[0], abs=1e-3 * ERROR)


@pytest.mark.parametrize("name", BY_A_BOUND)
def test_a_minimum_beyond_a_bound_is_found_at_it_with_a_one_sided_interval(name):
    """Against the bounded least squares of SciPy, and where Δχ² of the line reaches its threshold."""
    _, bound, side = BY_A_BOUND[name]
    _, y, results = beside_a_bound(name, 0.5, 24)
    q, bounds = (
        norm.ppf(0.975),
        [(bound, np.inf), (-np.inf, np.inf)] if side > 0 else [(-np.inf, bound), (-np.inf, np.inf)],
    )
    beyond = beside = 0
    for data, result in zip(y, results, strict=True):
        free = side * (np.linalg.lstsq(LINE, data)[0][0] - bound) / ERROR
        wanted = lsq_linear(LINE, data, np.transpose(bounds)).x
        a, b = result.estimates
        assert result.converged
        assert np.allclose([a.value - wanted[0], b.value - wanted[1]], 0, atol=2e-3 * ERROR)
        assert a.at_bound == (free < 0)
        assert a.error == pytest.approx(ERROR, rel=1e-3)
        assert result.degrees_of_freedom == STEPS - 2 + a.at_bound
        far = free + np.sqrt(min(free, 0) ** 2 + q**2)
        near = max(free - q, 0)
        ends = np.sort(bound + side * ERROR * np.array([near, far]))
        if near == 0:
            assert np.allclose(a.interval, ends, rtol=0, atol=5e-3 * ERROR)
        elif free < 3 * q:  # beside the bound, all of the line's and what the coordinate's has besides
            assert a.interval[0] < ends[0] + 5e-3 * ERROR
            assert ends[1] - 5e-3 * ERROR < a.interval[1]
        beyond += a.at_bound
        beside += near > 0
    assert 0 < beyond < 24
    assert beside > 0 or name != "lower"


@pytest.mark.parametrize(
    ("name", "offset"),
    [
        *thorough(*(("zero", offset) for offset in (0.0, 1.0, 4.2))),
        *slow(("zero", 0.5), ("zero", 2.3)),
        *slow(*((name, offset) for name in ("lower", "upper") for offset in (0.0, 0.5, 1.0, 2.3, 4.2))),
    ],
)
def test_intervals_cover_a_truth_beside_its_bound(name, offset):
    """Of 300 draws of noise, the truth so many standard errors from the bound: 93 in a hundred or more, of the other
    number too, and all have converged."""
    truth, _, results = beside_a_bound(name, offset, 300)
    for k in range(2):
        held = [r.estimates[k].interval for r in results]
        assert np.mean([a <= truth[k] <= b for a, b in held]) >= 0.93, k
    assert all(r.converged for r in results)


def test_a_number_at_its_bound_has_a_profile_from_there():
    result = next(r for r in beside_a_bound("lower", 0.5, 24)[2] if r.estimates[0].at_bound)
    with pytest.warns(UserWarning, match="a: the interval is open below"):
        profile = mpm.fitting.profile(result, "a")
    assert profile.interval == pytest.approx(result["a"].interval, abs=5e-3 * ERROR)
    assert profile.symmetric == result["a"].interval


a, b, c, d = np.random.default_rng(0).normal(size=(4, 50))
WORDS = {
    "ratio": ([a, -a], ["E and nu: only their ratio is seen."]),
    "power": ([a, -2 * a], ["E and nu: only E·nu^-2 is seen."]),
    "unlike lengths": ([a, 1e4 * a], ["E and nu: only E·nu^1e+04 is seen."]),
    "none": ([a, 0 * a, b], ["nu: the data do not see it."]),
    "two": ([a, a, -a], ["E and nu: only their product is seen.", "nu and rho: only their ratio is seen."]),
    "three": ([a, b, a + b], ["E, nu, rho: a change in the proportion +1 : +1 : -1 of their logarithms is not seen"]),
    "hardly two": ([a, a + 0.01 * c, b], ["E and nu: 0.99995 correlated, a change of both in opposite directions"]),
    "hardly three": (
        [a, b, a + b + 0.02 * c, d],
        ["E, nu, rho: a change in the proportion +1 : +1 : -1 of their logarithms is hardly seen, 1e+02 times"],
    ),
    "well": ([a, b, c, d], []),
}


@pytest.mark.parametrize(("columns", "wanted"), WORDS.values(), ids=WORDS)
def test_what_the_data_cannot_tell_is_said_of_all_that_take_part(columns, wanted):
    """Of three coordinates that are seen only together no two alone are named."""
    labels = ("E", "nu", "rho", "v")[: len(columns)]
    said = seen_together(labels, uncertainty(np.stack(columns, axis=1), 2e-16, ()), (True,) * len(labels))
    assert len(said) == len(wanted)
    assert all(text.startswith(words) for words, text in zip(wanted, said, strict=True)), said


def bar(E=7e4, nu=0.3, dtype="float64"):
    """A free bar that is stretched as it starts."""
    grid = mpm.Grid((12,), 0.1, origin=(-4,))
    particles = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3, dtype=dtype)
    v = jnp.asarray(1.5 * (np.asarray(particles.x) - 0.2), dtype)
    return mpm.Scene(grid, mpm.NeoHookean(E, nu)), eqx.tree_at(lambda q: q.v, particles, v)


def followed(sigma, noise=None, dtype="float64", seeds=(0,), **options):
    """The bar with tracks of its particles, σ their noise, once for each seed."""
    scene, particles = bar(dtype=dtype)
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=1)
    x = np.asarray(run.frames.x, float)[1:]
    times, which = DT * np.arange(1, STEPS + 1), np.arange(particles.count)
    seen = [
        mpm.Tracks(times, x + scale * np.random.default_rng(seed).normal(size=x.shape), which=which, sigma=noise)
        for seed, scale in zip(seeds, np.broadcast_to(sigma, len(seeds)), strict=True)
    ]
    return mpm.Experiment(scene, particles, t1=STEPS * DT, dt=DT, observations=seen, **options)


STIFFNESS = mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=1e5, unit="Pa")
RATIO = mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.0, 0.49, start=0.2)
PUSH = mpm.Unbounded(update=lambda e, f: eqx.tree_at(lambda e: e.particles.v, e, f * e.particles.v), start=1.2)


@pytest.mark.thorough
def test_along_a_profile_the_others_are_at_their_least():
    """Stiffness and the strength of the push from few data: at each point SciPy's least squares over the other
    parameter finds the same misfit. In single precision the interval is the same."""
    result = fit(followed(5e-3, 5e-3), {"E": STIFFNESS, "push": PUSH})
    profile = mpm.fitting.profile(result, "E", points=2)
    problem, residuals = result.problem, eqx.filter_jit(lambda p, z: p.residuals(z, None)[0])

    def misfit(E):
        def r(z):
            at = jnp.asarray([np.log(E / 1e5), z[0]])
            return np.asarray(residuals(problem, at))

        return 2 * least_squares(r, [0.0], method="lm", diff_step=1e-6).cost

    least = misfit(result["E"].value)
    for E, statistic in zip(profile.values, profile.statistic, strict=True):
        assert misfit(E) - least == pytest.approx(statistic, abs=2e-3)
    assert profile.interval[0] < result["E"].value < profile.interval[1]
    for end in profile.interval:
        assert misfit(end) - least == pytest.approx(profile.threshold, rel=5e-3)
    single = fit(followed(5e-3, 5e-3, "float32"), {"E": STIFFNESS, "push": PUSH})
    assert np.allclose(mpm.fitting.profile(single, "E", points=2).interval, profile.interval, rtol=5e-3)


@pytest.mark.thorough
def test_what_the_data_do_not_see_has_an_infinite_band_and_an_open_profile():
    """Of stiffness and density only the ratio is seen, so the stress has no band, and the motion has one."""
    mass = np.asarray(bar()[1].mass)
    heavier = mpm.Positive(update=lambda e, f: eqx.tree_at(lambda e: e.particles.mass, e, f * mass), start=1.0)
    with pytest.warns(UserWarning, match="only their ratio"):
        result = fit(followed(1e-4, 1e-4), {"E": STIFFNESS, "density": heavier})

    def both(e):
        E = e.scene.material.youngs_modulus
        return jnp.stack([E, E / e.particles.mass[0]])

    assert np.isinf(mpm.fitting.predict(result, both).error).tolist() == [True, False]
    (motion,) = mpm.fitting.predict_observations(result)
    assert np.isfinite(motion.upper).all()
    with pytest.warns(UserWarning, match="open"):
        profile = mpm.fitting.profile(result, "density", points=1)
    assert profile.interval == (0, np.inf)
    assert np.abs(profile.statistic[1:-1]).max() < 1e-2


@pytest.mark.thorough
def test_noise_that_is_estimated_twice_has_a_threshold_of_its_own():
    """Two observations of unknown noise: between Student's of one and of both."""
    result = fit(followed([1e-3, 5e-3], seeds=(1, 2)), {"E": STIFFNESS})
    profile = mpm.fitting.profile(result, "E")
    points = result.noise[0].points
    assert t.ppf(0.975, 2 * points) ** 2 < profile.threshold < t.ppf(0.975, points - 1) ** 2 * 1.001
    half = (profile.interval[1] - profile.interval[0]) / 2
    assert np.allclose(profile.interval, profile.symmetric, rtol=0, atol=0.05 * half)


@pytest.mark.thorough
def test_bands_cover_the_truth_and_new_measurements_as_often_as_they_say():
    """200 falls with new noise of unknown size: the band of a later place, extrapolated, holds the truth between 184
    and 196 times, and the band of new measurements a new one."""
    rng, truth = np.random.default_rng(11), 0.15 + design(2 * STEPS)[-1] @ [G, V]
    held = new = 0
    for seed in range(200):
        result = fit(thrown(measured(seed=seed)), {"g": GRAVITY, "v": SPEED})
        later = mpm.fitting.predict(result, twice_as_long)
        held += later.lower < truth < later.upper
        (band,) = mpm.fitting.predict_observations(result)
        again = 0.15 + design()[7] @ [G, V] + NOISE * rng.normal()
        new += band.new_lower[7, 0] < again < band.new_upper[7, 0]
    assert 184 <= held <= 196
    assert 184 <= new <= 196


def settled(scene, particles):
    return particles.x.max()


def column(nu, observations=None):
    """A column that sinks under its own weight between walls, until it rests: what is seen of Poisson's ratio saturates
    to both sides, where it is nought and where the column is incompressible."""
    grid = mpm.Grid((10,), 0.1, origin=(-2,))
    q = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3)
    law, floor = mpm.NeoHookean(1e5, nu), mpm.StickyBox((0.0,), (10.0,))
    scene = mpm.Scene(grid, law, gravity=(-9.81,), boundary=floor)
    run = {"t1": 0.6, "dt": 0.05, "method": mpm.BackwardEuler()}
    if observations is None:
        return mpm.simulate(scene, q, save_every=1, observe=settled, **run)
    return mpm.Experiment(scene, q, observations=observations, **run)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
def test_intervals_cover_where_the_data_saturate():
    """200 measurements of a settlement of 3.9 mm with a noise of 1.5 mm of the mean, ν = 0.4: profiles, and intervals
    of the standard error, which end at the bounds, hold it between 184 and 196 times."""
    ratio = mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.0, 0.499, start=0.3)
    run = column(0.4)
    times, height = np.asarray(run.times)[-4:], np.asarray(run.observed)[-4:]
    held = np.zeros(2, int)
    for seed in range(200):
        data = height + 3e-3 * np.random.default_rng(seed).normal(size=4)
        result = fit(column(0.3, mpm.Series(times, data, settled, sigma=3e-3)), {"nu": ratio})
        intervals = mpm.fitting.profile(result, "nu", points=1, rtol=1e-2).interval, result["nu"].interval
        held += [lower < 0.4 < upper for lower, upper in intervals]
    assert ((held >= 184) & (held <= 196)).all()


@pytest.mark.parametrize("robust", [0.3, 1.0, 3.0, 1e3, None])
def test_the_mean_square_of_robust_residuals_is_that_of_normal_noise(robust):
    """∫ r² 2/(1 + √(1 + r²/δ²)) φ(r) dr; one without a limit."""
    limit = np.inf if robust is None else robust

    def squares(x):
        return 2 * x**2 / (1 + np.sqrt(1 + (x / limit) ** 2)) * norm.pdf(x)

    assert _mean_square(robust) == pytest.approx(quad(squares, -12, 12, points=[0], epsabs=1e-12)[0], rel=1e-4)


def test_the_noise_of_an_observation_is_that_of_its_own_residuals():
    """Two observations of a line: each by its own rows, over the degrees of freedom that the line leaves it; a weight
    of squares and a robust limit do not change it, numbers that were not measured and directions that the data do not
    see have no part in it."""
    rng, J = np.random.default_rng(3), np.vander(np.linspace(0, 1, 40), 2)
    r = np.linalg.qr(np.column_stack([J, rng.normal(size=40)]))[0][:, 2] * 7
    hat = np.einsum("mi,ij,mj->m", J, np.linalg.inv(J.T @ J), J)
    for rows in (slice(0, 25), slice(25, 40)):
        count = rows.stop - rows.start
        freedom = count - hat[rows].sum()
        plain = np.sqrt((r[rows] ** 2).sum() / freedom)
        assert noise(r, J, rows, count, 1.0, None) == pytest.approx((plain, freedom))
        # The weight 4 stands as a factor 2 in the rows of all observations, so that the line leaves the same freedom.
        assert noise(2 * r, 2 * J, rows, count, 4.0, None) == pytest.approx((plain, freedom))
        robust = plain / np.sqrt(_mean_square(0.5))
        assert noise(r, J, rows, count, 1.0, 0.5) == pytest.approx((robust, freedom))
        assert noise(r, np.column_stack([J, J[:, 0]]), rows, count, 1.0, None) == pytest.approx((plain, freedom))
        less = np.sqrt((r[rows] ** 2).sum() / (freedom - 3))
        assert noise(r, J, rows, count - 3, 1.0, None) == pytest.approx((less, freedom - 3))
    assert np.isnan(noise(r, J, slice(0, 25), 1, 1.0, None)[0])


def test_the_noise_is_that_beside_what_parameters_fit_that_no_bound_holds():
    """A line of two numbers, the first at its bound, which the data want beyond: one degree of freedom more."""
    times, rng = np.arange(1.0, 41), np.random.default_rng(0)
    seen = mpm.Series(times, 0 * times, mpm.fitting.CentreOfMass())
    J = np.vander(times / 40, 2)
    r = np.linalg.qr(np.column_stack([J, rng.normal(size=40)]))[0][:, 2] * 7
    for room, freedom in ((1e9, 38), (0.0, 39)):
        held = r + (room == 0) * 0.1 * J[:, 0]
        problem = SimpleNamespace(
            observations=[seen],
            rows=[slice(0, 40)],
            sigmas=[jnp.ones(())],
            parameters=(),
            room=lambda z, room=room: jnp.full((2, 2), 1e9).at[0, 0].set(room),
        )
        search = SimpleNamespace(failure=None, seen=SimpleNamespace(residuals=held, jacobian=J), z=jnp.zeros(2))
        ((_, factor, found),) = minimum_of(problem, search).noise
        assert found == pytest.approx(freedom)
        assert factor == pytest.approx(np.sqrt((held**2).sum() / freedom))


def test_what_moves_a_minimum_and_each_observations_noise_add_up():
    """Covariances by numbers: of two observations, the noise of one known from few residuals to be three times as
    large in its square, and Σ Δ Δᵀ/4; the degrees of freedom of an error, and of a new measurement of the second."""
    rng = np.random.default_rng(5)
    J, moved, g, sigma = rng.normal(size=(30, 2)), 0.1 * rng.normal(size=(2, 2)), np.array([1.0, -2.0]), 0.2
    rows = slice(0, 10), slice(10, 30)
    both = uncertainty(J, 2e-16, [(rows[0], 3.0, 8.0), (rows[1], 1.0, 19.0)], moved)
    whole = np.linalg.inv(J.T @ J)
    parts = [c * whole @ J[k].T @ J[k] @ whole for c, k in zip((3, 1), rows, strict=True)] + [moved.T @ moved / 4]
    assert np.allclose(both.inverse, sum(parts), rtol=1e-12)
    variances = np.array([g @ part @ g for part in parts])
    error, freedom = both.of(g)
    assert error == pytest.approx(np.sqrt(variances.sum()))
    assert freedom == pytest.approx(variances.sum() ** 2 / (variances[0] ** 2 / 8 + variances[1] ** 2 / 19))
    new = variances + np.array([0, sigma**2, 0])
    known = new.sum() ** 2 / (new[0] ** 2 / 8 + new[1] ** 2 / 19)
    band = banded(both, 0.95, 1.0, g, np.asarray(sigma), 1)
    assert band.new_upper == pytest.approx(1 + t.ppf(0.975, known) * np.sqrt(new.sum()))


def test_a_number_lies_at_a_bound_within_a_hundredth_of_its_error():
    r, J = np.array([1.0, 2.0, 0.5, 1.0]), np.ones((4, 1))
    error = np.sqrt((r**2).sum() / 3) / 2
    for share, held in ((0.9e-2, True), (1.1e-2, False)):
        assert at_bound(r, J, np.array([[share * error], [1e9]])) == held
    assert not at_bound(r, J, np.array([[1e9], [0.0]]))  # which the data do not want
