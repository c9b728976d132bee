"""Many searches at once: starts, data sets, draws, and what is refused."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_fit import DT, NOISE, STEPS, STIFFNESS, bar, experiment, tracks

import mpmjax as mpm
from mpmjax.fitting._evaluation import costs_at
from mpmjax.fitting._problem import FitProblem, first_noise
from mpmjax.fitting._search import search, search_many
from mpmjax.fitting._starts import critical_distance, linked, starting_points, unit_points

fit = partial(mpm.fit, discretisation=False)  # most of these tests are of the search

LM, Starts = mpm.fitting.LevenbergMarquardt(), mpm.fitting.Starts
TIMES = np.linspace(0.001, 0.05, 40)


class Oscillation(FitProblem):
    """cos ωt of data with noise, in the place of a simulation that fails beyond ω = 2000, and has no derivative within
    15 of `gap`: its minima lie a period apart."""

    gap: float

    def __init__(self, experiments, parameters, memory=None, gap=np.inf):
        del experiments, memory
        scene, particles = bar()
        rng = np.random.default_rng(0)
        seen = mpm.Series(TIMES, np.cos(400 * TIMES) + 0.01 * rng.normal(size=40), mpm.fitting.Extent(0), sigma=0.01)
        self.experiments = (mpm.Experiment(scene, particles, t1=STEPS * DT, dt=DT, observations=seen),)
        self.names, self.parameters = ("omega",), tuple(parameters.values())
        self.starts = (jnp.asarray(self.parameters[0].start),)
        self.gap, self.sigmas = gap, first_noise(self.experiments)

    def residuals(self, z, adjoint):
        (omega,) = self.values(z)
        predicted = jnp.cos(jnp.where(omega < 2000, omega, jnp.nan) * jnp.asarray(TIMES))
        predicted += jnp.where(abs(omega - self.gap) < 15, jnp.sqrt(0 * omega), 0)  # zero, without a derivative there
        return self.observations[0].residuals(predicted, self.sigmas[0]), jnp.zeros(1)


OMEGA = mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=500.0)


@pytest.fixture
def oscillation(monkeypatch):
    def fitted(gap=np.inf, **options):
        monkeypatch.setattr("mpmjax.fitting._fit.FitProblem", partial(Oscillation, gap=gap))
        return fit([], {"omega": OMEGA}, starts=Starts(**options))

    return fitted


RANGES = {"omega": (100.0, 4000.0)}
NO_DERIVATIVE = "there is no derivative"


@pytest.mark.parametrize("fraction", [0.375, 1.0])
def test_many_starts_find_the_least_of_many_minima(oscillation, fraction):
    """ω = 400 from 500, from which a fit ends at 549. Simulations fail beyond 2000, a search from 804 has no
    derivative, and they hinder no other. Searches from fewer than half of the points stand for all, or all are."""
    found = oscillation(gap=795.0, count=32, fraction=fraction, ranges=RANGES, batch=5)
    with pytest.warns(UserWarning, match="times the noise given"):
        alone = fit([], {"omega": OMEGA}, starts=1)
    assert abs(alone["omega"].value - 400) > 100
    assert found["omega"].value == pytest.approx(400, abs=4 * found["omega"].error)
    look = found.screening
    assert len(look.minima) > 2
    ends = [float(m.values["omega"]) for m in look.minima]
    misfits = [m.misfit for m in look.minima]
    assert misfits == sorted(misfits)
    assert min(abs(alone["omega"].value / end - 1) for end in ends) < 2e-3
    counted = sorted(k for m in look.minima for k in m.members) + list(look.failures) + list(look.unfinished)
    assert sorted(counted) == list(range(32))
    started = look.points["omega"]
    assert len(started) == 32
    assert started[0] == pytest.approx(500)
    (gap,) = np.flatnonzero(abs(started - 795) < 15)
    assert {k for k, why in look.failures.items() if why == NO_DERIVATIVE} == {gap}
    assert set(look.failures) == {gap, *np.flatnonzero(started >= 2000)}
    assert {0, gap} <= set(look.searched)
    assert sum(m.searches for m in look.minima) == len(set(look.searched) - set(look.failures))
    assert len(look.searched) == 32 if fraction == 1 else len(look.searched) < 16
    assert f"32 points, {len(look.searched)} searches" in str(found)


def test_points_are_linked_anew_where_a_search_fails(oscillation):
    """The best point, 362, stands for all that lead to ω = 400, and has no derivative."""
    with pytest.warns(UserWarning, match="found by one search of"):
        found = oscillation(gap=362.0, count=32, fraction=0, ranges=RANGES, batch=5)
    look = found.screening
    (best,) = np.flatnonzero(abs(look.points["omega"] - 362) < 15)
    assert best in look.searched
    assert look.failures[best] == NO_DERIVATIVE
    assert found["omega"].value == pytest.approx(400, abs=4 * found["omega"].error)
    assert len(look.searched) < 10


@pytest.mark.thorough
def test_searches_from_few_points_find_what_searches_from_all_find():
    """The least minimum of the oscillation, for each of ten scramblings of 63 points, by half of the searches."""
    problem = Oscillation([], {"omega": OMEGA})
    found = []
    for seed in range(10):
        shares = unit_points(63, 1, seed)
        points = starting_points(problem, shares, Starts(ranges={"omega": (100.0, 750.0)}))[1:]
        members = search_many([problem], LM, dict(enumerate(points)), batch=63)
        least = np.array([m.cost for m in members.values()])
        stands = linked(shares, costs_at(problem, points, 63), fraction=0.375)
        assert least[np.unique(stands)].min() == pytest.approx(least.min(), rel=1e-3)
        found.append((len(np.unique(stands)), np.median(least) / least.min()))
    searches, worse = np.array(found).T
    assert worse.min() > 100  # most searches end at false minima
    assert searches.mean() < 63 / 2


@pytest.mark.parametrize(("size", "volume"), [(1, 2.0), (2, np.pi), (3, 4 / 3 * np.pi)])
def test_the_critical_ball_holds_a_known_part_of_the_points(size, volume):
    """2 ln k of k even points of the unit cube."""
    for count in (8, 64, 1000):
        assert volume * critical_distance(count, size) ** size * count == pytest.approx(2 * np.log(count))


def test_points_are_linked_to_better_neighbours():
    """Of two basins and a failure: searches start from the best eighth, and from the bottom of the other basin."""
    shares = unit_points(255, 2, 0)
    centres, depths = np.array([[0.2, 0.3], [0.8, 0.7]]), np.array([1.0, 0.8])
    bowls = ((shares[:, None] - centres) ** 2).sum(-1) + 1 - depths
    costs, right = bowls.min(1), bowls.argmin(1) == 1
    costs[7] = np.nan
    stands = linked(shares, costs, fraction=1 / 8)
    own = np.flatnonzero(stands == np.arange(255))
    assert stands[7] == -1
    assert set(np.argsort(costs)[:32]) <= set(own)
    distances = np.linalg.norm(shares[:, None] - shares, axis=-1)
    for k in set(np.flatnonzero(costs > np.sort(costs[np.isfinite(costs)])[31])):
        nearer = distances[k] <= critical_distance(255, 2)
        assert (k in own) == (not (costs[nearer] < costs[k]).any())
        assert costs[stands[k]] <= costs[k]
    deep, bottom = (np.flatnonzero(side)[np.nanargmin(costs[side])] for side in (~right, right))
    assert {deep, bottom} <= set(own)
    assert len(own) < 40
    assert linked(shares[:0], costs[:0], fraction=1 / 8).shape == (0,)
    assert np.flatnonzero(linked(shares, costs, fraction=1) != np.arange(255)) == [7]


def test_a_search_among_many_goes_where_it_goes_alone():
    """Iteration by iteration, whoever its neighbours are and wherever its place is."""
    problem = Oscillation([], {"omega": OMEGA})
    starts = np.linspace(-1.0, 0.3, 7)[:, None]
    members = search_many([problem], LM, dict(enumerate(starts)), batch=3)
    for start, member in zip(starts, members.values(), strict=True):
        alone = search(problem, LM, jnp.asarray(start))
        assert member.converged == alone.converged
        assert [i.cost for i in member.history] == pytest.approx([i.cost for i in alone.history], rel=1e-6)
        assert np.allclose(member.z, alone.z, atol=1e-9)


def test_starting_points_fill_what_is_known_of_each_parameter():
    """A prior's quantiles, the bounds, a range of a logarithm; the first is the first guess."""
    times, x, which = tracks()
    one = experiment(mpm.Tracks(times, x, which=which, sigma=NOISE))
    parameters = {
        "E": STIFFNESS,
        "nu": mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.1, 0.4),
        "v": mpm.Unbounded(lambda e: e.particles.v, prior=mpm.fitting.Gaussian(2.0, 0.5)),
        "m": mpm.Positive(lambda e: e.particles.mass, prior=mpm.fitting.Gaussian(0.01, 0.01)),
    }
    problem = FitProblem((one,), parameters)
    points = starting_points(problem, unit_points(128, problem.size, 0), Starts(ranges={"E": (1e3, 1e6)}))
    assert points.shape == (129, problem.size)
    assert not points[0].any()
    values = dict(zip(problem.names, jax.jit(jax.vmap(problem.values))(jnp.asarray(points[1:])), strict=True))
    assert np.isfinite(points).all()
    assert np.histogram(np.log10(values["E"]), 4, (3, 6))[0] == pytest.approx([32] * 4, abs=1)
    assert np.histogram(values["nu"], 4, (0.1, 0.4))[0] == pytest.approx([32] * 4, abs=1)
    assert values["v"].mean() == pytest.approx(2, abs=0.02)
    assert values["v"].std() == pytest.approx(0.5, abs=0.02)
    assert values["m"].min() > 0


REFUSED = {
    "no parameter": ({"ranges": {"nu": (0.1, 0.2)}}, "must be of parameters"),
    "a bound": ({"ranges": {"omega": (0.0, 2.0)}}, "positive numbers"),
    "shrinking": ({"ranges": {"omega": (3.0, 2.0)}}, "must grow"),
    "none": ({"count": 0}, "at least 1"),
    "more than all": ({"fraction": 1.5}, "from 0 to 1"),
}


@pytest.mark.parametrize(("options", "says"), REFUSED.values(), ids=REFUSED)
def test_bad_starts_get_one_line(oscillation, options, says):
    with pytest.raises(ValueError, match=says):
        oscillation(**options)


def test_data_sets_of_other_shapes_are_refused():
    times, x, which = tracks()
    sets = [experiment(mpm.Tracks(times[:n], x[:n], which=which, sigma=NOISE)) for n in (5, 6)]
    with pytest.raises(ValueError, match="number 1 has other shapes"):
        mpm.fitting.fit_ensemble(sets, {"E": STIFFNESS})


@pytest.mark.thorough
def test_an_ensemble_says_what_fits_say_one_by_one():
    """Three specimens of other stiffness and mass, one of which fails: the same estimates, errors and noise."""
    sets = []
    for k, E in enumerate((6e4, 7e4, 8e4, 7e4)):
        times, x, which = tracks(E=E, seed=k)
        seen = mpm.Tracks(times, x, which=which)
        own = experiment(seen, E=E, density=900.0 + 50 * k)
        sets.append(own)
    sets[1] = eqx.tree_at(lambda e: e.particles.v, sets[1], 1e6 * sets[1].particles.v)
    with pytest.warns(UserWarning, match="1 of 4 data sets could not be fitted: number 1"):
        found = mpm.fitting.fit_ensemble(sets, {"E": STIFFNESS}, batch=2)
    assert list(found.failures) == [1]
    assert np.isnan(found.values["E"][1])
    assert np.isnan(found.errors[1]).all()
    for k in (0, 2, 3):
        alone = fit(sets[k], {"E": STIFFNESS})
        assert found.fits[k]["E"].value == pytest.approx(alone["E"].value, rel=1e-6)
        assert found.fits[k]["E"].error == pytest.approx(alone["E"].error, rel=1e-4)
        assert found.fits[k].noise[0].sigma == pytest.approx(alone.noise[0].sigma, rel=1e-4)
    assert found.alike[0] < 1e-3
    assert "spread" in str(found)


@pytest.mark.thorough
def test_specimens_with_one_value_are_said_to_be_alike():
    """Of twelve draws of noise, the spread of the estimates is their standard error."""
    sets = [experiment(mpm.Tracks(*a[:2], which=a[2], sigma=NOISE)) for a in (tracks(seed=k) for k in range(12))]
    found = mpm.fitting.fit_ensemble(sets, {"E": STIFFNESS})
    assert 0.01 < found.alike[0] < 0.99
    assert found.values["E"].std(ddof=1) == pytest.approx(found.errors[:, 0].mean(), rel=0.6)


@pytest.mark.thorough
def test_the_bootstrap_agrees_with_the_linear_error():
    """Of a problem that is nearly linear."""
    times, x, which = tracks()
    fitted = fit(experiment(mpm.Tracks(times, x, which=which, sigma=NOISE)), {"E": STIFFNESS})
    drawn = mpm.fitting.bootstrap(fitted, repeats=200)
    assert drawn["E"].error == pytest.approx(fitted["E"].error, rel=0.15)
    assert drawn["E"].interval == pytest.approx(fitted["E"].interval, rel=0.3 * fitted["E"].error / 7e4)
    with pytest.raises(KeyError, match="no estimate 'G'"):
        drawn["G"]
