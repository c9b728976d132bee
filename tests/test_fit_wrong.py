"""Fits that are wrong, and say so: false minima, residuals with a shape, grids too coarse, numbers that data cannot
part."""

import warnings
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import thorough
from scipy.stats import t as student
from test_fit import DT, NOISE, RATIO, experiment, tracks

import mpmjax as mpm
from mpmjax.fitting._estimate import improbable, shape_of, strongest_mode
from mpmjax.fitting._evaluation import CoarseGrid, Evaluation, look_at_coarse_grid, unexplained
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import Minimum, _judged, fit_result
from mpmjax.fitting._search import Search
from mpmjax.verification import StandingWave, discretise

E, SIDE = 7e4, 0.4


def block(n=1):
    """A free square that is stretched as it starts and vibrates, of 4n cells."""
    grid = mpm.Grid((8 * n, 8 * n), 0.1 / n, origin=(-2 * n, -2 * n))
    q = mpm.fill(mpm.Box((0.0, 0.0), (SIDE, SIDE)), grid, particles_per_cell=4, density=1e3)
    q = eqx.tree_at(lambda q: q.v, q, jnp.asarray([0.3, -0.2]) * jnp.sin(np.pi * (q.x / SIDE - 0.5)))
    return mpm.Scene(grid, mpm.NeoHookean(E, 0.3)), q


def spread(scene, q):
    """Root mean square of the places along each axis."""
    return jnp.sqrt(((q.x - q.x.mean(axis=0)) ** 2).mean(axis=0))


def motion(n, steps):
    """Times and spreads of the block on 4n cells."""
    scene, q = block(n)
    run = mpm.simulate(scene, q, t1=steps * DT, dt=DT / n, save_every=n, observe=spread)
    return np.asarray(run.times)[1:], np.asarray(run.observed)[1:]


def swing(times, values, n=1, sigma=NOISE):
    scene, q = block(n)
    t1 = float(np.round(times[-1] / DT)) * DT
    return mpm.Experiment(scene, q, t1=t1, dt=DT / n, observations=mpm.Series(times, values, spread, sigma=sigma))


@pytest.fixture(scope="module")
def both_grids():
    """Five periods of the block on four cells, and on sixteen."""
    return {n: motion(n, 80) for n in (1, 4)}


def modulus(e):
    return e.scene.material.youngs_modulus


def stiffness(start):
    return {"E": mpm.Positive(modulus, start=start, unit="Pa")}


def test_other_starts_are_tried_where_the_misfit_is_beyond_the_noise(both_grids):
    """E of a vibration of five periods, from twice the truth: a single search ends at a false minimum, and says that
    its misfit is no noise; others are tried until one is, and the table says so. A fit that is right tries none."""
    times, exact = both_grids[1]
    seen = swing(times, exact + NOISE * np.random.default_rng(0).normal(size=exact.shape))
    with pytest.warns(UserWarning, match="times the noise given"):
        alone = mpm.fit(seen, stiffness(1.5e5), starts=1)
    assert alone.is_beyond
    assert alone["E"].value > 1.3e5
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = mpm.fit(seen, stiffness(1.5e5))
    assert abs(found["E"].value - E) < 4 * found["E"].error
    assert not found.is_beyond
    assert found.screening.minima[0].values["E"] == pytest.approx(found["E"].value, rel=1e-2)
    assert found.screening.minima[-1].values["E"] == pytest.approx(alone["E"].value, rel=1e-2)
    assert "24 points, " in str(found)
    assert len(found.screening.searched) < 8
    right = mpm.fit(seen, stiffness(6e4))
    assert right.screening is None
    assert "points, " not in str(right)


def autoregressive(rng, count, phi):
    """Noise of variance one with a correlation φ of neighbours."""
    noise = [rng.normal()]
    for _ in range(count - 1):
        noise.append(phi * noise[-1] + np.sqrt(1 - phi**2) * rng.normal())
    return np.array(noise)


def test_residuals_that_are_no_noise_are_named(both_grids):
    """A sensor that drifts, and noise that is correlated: the table names them, and what they do to the error, which
    the first interval has, whether σ is given or estimated. White noise is called nothing."""
    times, exact = both_grids[1]
    rng = np.random.default_rng(0)
    drift = 5 * NOISE * np.linspace(0, 1, 80)[:, None]
    correlated = NOISE * np.stack([autoregressive(rng, 80, 0.8) for _ in range(2)], axis=1)
    white = NOISE * rng.normal(size=exact.shape)
    for shape, noise in {"a ramp": drift + white, "correlated": correlated, "": white}.items():
        for sigma in (None, NOISE):
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                seen = swing(times, exact + noise, sigma=sigma)
                found = mpm.fit(seen, stiffness(6e4), starts=1, discretisation=False)
            (seen,), stiff, table = found.noise, found["E"], str(found)
            assert seen.shape == shape
            texts = [str(w.message) for w in caught]
            assert any("residuals of 'series'" in text for text in texts) == bool(shape)
            assert ("by noise alone" in table) == bool(shape)
            assert stiff.interval[0] < E < stiff.interval[1]
            r = found.residuals.reshape(80, 2)
            strongest = np.linalg.eigvalsh(r.T @ r)[-1] - (np.sqrt(80) + np.sqrt(2)) ** 2
            mode, alike = strongest if seen.is_beyond else 1, 160 / seen.worth * min(seen.misfit, 1) ** 2
            assert stiff.error == pytest.approx(np.sqrt(max(mode, alike) if shape else 1) * stiff.noise_error, rel=0.01)
            # a correlation is known from few numbers, the strongest mode is a size
            few, reach = shape and alike > mode, np.log(stiff.interval[1] / stiff.interval[0]) / 2
            freedom = max(seen.worth, 4) if few else 1e9 if sigma else 159
            assert reach * stiff.value == pytest.approx(student.ppf(0.975, freedom) * stiff.error, rel=0.01)
            assert f"{seen.worth:.2g} independent numbers" in table or not shape
            assert seen.is_beyond == (bool(shape) if sigma is None else shape == "a ramp")
            again = partial(fit_again, found)
            if sigma is None:  # a weight of all data alike changes no error, whatever the misfit
                problem = eqx.tree_at(lambda p: p.experiments[0].observations[0].weight, found.problem, 4.0)
                assert again(problem, 2.0)["E"].error == pytest.approx(stiff.error, rel=1e-6)
            if not shape:  # a misfit that is smaller than the noise makes no error smaller
                small = again(found.problem, 0.5)["E"]
                assert small.error == pytest.approx(small.noise_error, rel=1e-9)
            if not (shape or sigma):  # nor does the grid, with more freedom than the noise, an interval narrower
                coarse = CoarseGrid(np.array([2 * found.uncertainty.error, [0.0]]), found.residuals)
                more = again(found.problem, 1.0, coarse, freedom=1.0)["E"]
                assert more.error == pytest.approx(np.sqrt(2) * more.noise_error, rel=1e-6)
                assert more.interval == more.noise_interval
            if seen.is_beyond:  # what twice the spacing explains of the residuals is no strongest mode
                coarse = CoarseGrid(np.zeros((2, 1)), np.concatenate([2 * r[:, :1], r[:, 1:]], axis=1).reshape(-1))
                rest = unexplained(found.residuals, found.jacobian, coarse).reshape(80, 2)
                left = np.linalg.eigvalsh(rest.T @ rest)[-1] - (np.sqrt(80) + np.sqrt(2)) ** 2
                assert left < 0.9 * strongest
                error = again(found.problem, 1.0, coarse)["E"].error
                assert error == pytest.approx(np.sqrt(max(alike, left)) * stiff.noise_error, rel=0.01)


def fit_again(found, problem, factor, coarse=None, freedom=None):
    """The result at the same minimum, of another problem whose residuals are those of the fit times a factor."""
    known = Evaluation(0.0, found.z, factor * found.residuals, factor * found.jacobian)
    end = Search(jnp.asarray(found.z), None, known, (), converged=True)
    freedom = float(found.degrees_of_freedom) if freedom is None else freedom
    minimum = Minimum(problem, end, [(*found.problem.sigmas, 1.0, freedom)], moves=False)
    return fit_result(minimum, found.optimiser, {}, found.level, coarse)


def test_correlated_numbers_are_worth_what_theory_says():
    """N (1 − φ)/(1 + φ) of noise whose neighbours have the correlation φ; all of white noise; those of one sequence
    where many are the same."""
    rng = np.random.default_rng(1)
    for phi in (0.5, 0.8):
        each = [shape_of(autoregressive(rng, 400, phi))[0] for _ in range(60)]
        assert np.median(each) == pytest.approx((1 + phi) / (1 - phi), rel=0.2)
    white = [shape_of(rng.normal(size=(40, 20))) for _ in range(200)]
    assert sum(kind != "" for _, kind in white) < 5
    common = rng.normal(size=(40, 1)) + 0.1 * rng.normal(size=(40, 20))
    assert shape_of(common)[0] == pytest.approx(20, rel=0.2)


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_what_a_misfit_adds_to_errors_goes_with_the_weight_of_its_squares(weight):
    """Sequences that err alike, by the strongest mode of what twice the spacing does not explain; one whose neighbours
    do, by what it is worth."""
    rng = np.random.default_rng(2)
    common = rng.normal(size=(40, 1)) + 0.1 * rng.normal(size=(40, 20))
    for r, wanted in ((common, strongest_mode(0.8 * common)), (autoregressive(rng, 60, 0.9)[:, None], None)):
        seen = mpm.Series(np.arange(1.0, len(r) + 1), 0 * r, spread, weight=weight)
        problem = SimpleNamespace(observations=[seen], rows=[slice(0, r.size)], dtype=np.float64)
        weighed, J = np.sqrt(weight) * r.reshape(-1), np.sqrt(weight) * np.ones((r.size, 1))
        _, _, (_, wider, _) = _judged(problem, 0, [(0.1, 1.0, r.size - 1.0)], weighed, J, 0.8 * weighed)
        if wanted is None:
            wanted = shape_of(r)[0] * min((r**2).sum() / (r.size - 1), 1)
        assert wanted > 3
        assert wider == pytest.approx(weight * wanted)


def test_misfit_that_is_like_the_change_on_twice_the_spacing_is_explained():
    """A third of that change, as of the order two, and noise leave the noise; a misfit of another kind stays whole, and
    so does one that is more than the change. A change that parameters make up for explains nothing."""
    rng = np.random.default_rng(0)
    J, change, noise = rng.normal(size=(400, 2)), 9 * rng.normal(size=400), rng.normal(size=400)
    change, noise = (a - J @ np.linalg.lstsq(J, a)[0] for a in (change, noise))
    for r, by, left in (
        (change / 3 + noise, change + J @ [5.0, -3.0], noise),
        (noise, change, noise),
        (-change / 3, change, -change / 3),
        (2 * change, change, change),
        (noise, J @ [5.0, -3.0], noise),
    ):
        rest = unexplained(r, J, CoarseGrid(np.zeros((2, 2)), r + by))
        assert np.linalg.norm(rest - left) < 0.1 * np.linalg.norm(left)
    assert np.array_equal(unexplained(noise, J, "unknown"), noise)


def test_the_strongest_mode_is_that_of_a_discrepancy_and_none_of_noise():
    """Of a discrepancy that noise hides from χ² too, more often than not."""
    rng = np.random.default_rng(0)
    mode, white = np.outer(np.sin(np.arange(80)), np.ones(12)), rng.normal(size=(500, 80, 12))
    assert sum(strongest_mode(rows) > 0 for rows in white) <= 2
    hidden = [0.5 * mode + rows for rows in white[:40]]
    assert sum(improbable((rows**2).sum(), rows.size) for rows in hidden) < 20
    assert sum(strongest_mode(rows) > 0 for rows in hidden) > 30
    assert strongest_mode(5 * mode + white[0]) == pytest.approx(25 * (mode**2).sum(), rel=0.05)


@pytest.mark.parametrize("steps", [80, *thorough(20)])
def test_the_first_interval_holds_what_the_grid_gets_wrong(both_grids, steps):
    """Of data made on a grid four times finer: that of the noise alone is many times too narrow."""
    times, fine = both_grids[4]
    data = fine + NOISE * np.random.default_rng(1).normal(size=fine.shape)
    with pytest.warns(UserWarning, match="times the noise given"):
        found = mpm.fit(swing(times[:steps], data[:steps]), stiffness(6e4), starts=1)["E"]
    assert found.interval[0] < E < found.interval[1]
    assert abs(found.value - E) > 4 * found.noise_error
    assert found.interval[1] - found.interval[0] < 16 * abs(found.value - E)


class Lattice(eqx.Module):
    """A grid of which nothing is known but how coarse it is."""

    spacing: float = eqx.field(static=True, default=1.0)

    def coarsened(self):
        return Lattice(2 * self.spacing)


class Bench(eqx.Module):
    """A scene of that grid alone."""

    grid: Lattice = Lattice()


class Ran(eqx.Module):
    """An experiment of five steps."""

    scene: Bench = Bench()
    t1: float = eqx.field(static=True, default=1.0)
    dt: float = eqx.field(static=True, default=0.2)
    steps = 5


class Along(FitProblem):
    """r = (b f(z/b), 1): b is 0.4 on twice the spacing, and 0.1 with three steps there, zero on the grid itself."""

    of: Callable = eqx.field(static=True)

    def __init__(self, of):
        self.experiments, self.names, self.parameters, self.starts = (Ran(),), ("z",), (RATIO,), (jnp.zeros(()),)
        self.of = of

    @property
    def dtype(self):
        return jnp.float64

    def residuals(self, z, adjoint):
        (e,) = self.experiments
        b = 0.4 * (e.scene.grid.spacing - 1) - 0.3 * (round(e.t1 / e.dt) == 3)
        return jnp.stack([b * self.of(z[0] / b), jnp.ones(())]), jnp.zeros(1)


@pytest.mark.parametrize(
    ("of", "by_spacing", "by_step"),
    [
        # z − b/1.2 is multiplied by 1 − 1.2 in each of three steps
        (lambda x: 1.2 * x - 1, 0.4 / 1.2 * (1 + 0.2**3), (0.1 / 1.2 - 0.336) * (1 + 0.2**3)),
        (lambda x: 3 * x - 1, 0.4, 0.1 - 3 * 0.4),
        (lambda x: jnp.interp(x, jnp.array([0.0, 0.5, 1.0]), jnp.array([-1.0, 2.0, 0.5])), 0.4, -0.05),
    ],
    ids=["falls", "rises at once", "rises then"],
)
def test_the_look_at_twice_the_spacing_takes_three_steps_while_the_misfit_falls(of, by_spacing, by_step):
    """By the Jacobian of the grid itself, 1; the first step stays in any case. The residuals are those of the start."""
    coarse = look_at_coarse_grid(Along(of), jnp.zeros(1), np.array([[1.0], [0.0]]))
    np.testing.assert_allclose(coarse.moved[:, 0], [by_spacing, by_step], rtol=1e-6)
    np.testing.assert_allclose(coarse.residuals, [-0.4, 1.0])


def wave(n):
    """Two periods of the standing wave, its exact places with noise, by 32 particles on 16/n cells."""
    exact = StandingWave(0.05)
    scene, q = discretise(exact, 16)
    t1 = 2 * exact.duration
    times = np.arange(1, 21) * t1 / 20
    which = np.arange(1, 32, 5)
    x = np.array([[exact.position(X, t) for X in q.X[which]] for t in jnp.asarray(times)])
    seen = mpm.Tracks(times, x + 1e-3 * np.random.default_rng(0).normal(size=x.shape), which=which, sigma=1e-3)
    if n > 1:
        scene = eqx.tree_at(lambda s: s.grid, scene, mpm.Grid((16,), n / 16, origin=(-4,)))
    return mpm.Experiment(scene, q, t1=t1, dt=n * t1 / 80, observations=seen)


def test_twice_the_spacing_tells_of_an_error_that_leaves_no_misfit():
    """E of the exact wave is a per cent low, many times its error by the noise, and the misfit is that of the noise.
    Spacing and step move it to opposite sides, together to where a fit on both ends; the interval holds each."""
    guess = stiffness(2e4)
    missed, found, coarse = (
        mpm.fit(wave(n), guess, discretisation=looks) for n, looks in ((1, False), (1, True), (2, False))
    )
    true, e = 1e4, found["E"]
    assert missed.moved is None
    assert missed["E"].interval == missed["E"].noise_interval == e.noise_interval
    assert not e.noise_interval[0] < true < e.noise_interval[1]
    assert e.interval[0] < true < e.interval[1]
    assert e.interval[1] - e.interval[0] < 10 * abs(e.value - true)
    by_spacing, by_step = found.moved[:, 0]
    assert by_spacing > 0 > by_step
    assert by_spacing + by_step == pytest.approx(np.log(coarse["E"].value / e.value), abs=0.03 * by_spacing)
    assert e.error == pytest.approx(np.hypot(e.noise_error, e.value * np.hypot(by_spacing, by_step) / 2), rel=1e-6)
    assert "on twice the spacing: E 1017" in str(found)
    assert mpm.fitting.predict(found, modulus).error == pytest.approx(e.error, rel=1e-6)


def test_a_wall_that_the_coarse_grid_cannot_have_is_said():
    """A plane must lie at a multiple of half a spacing: of one that does not on twice the spacing nothing is known."""
    experiment = wave(1)
    shifted = eqx.tree_at(lambda e: e.scene.boundary[1].position, experiment, jnp.asarray(1.03125))
    with pytest.warns(UserWarning, match="errors hold nothing of the grid: A SymmetryPlane must lie at a multiple"):
        found, alone = (mpm.fit(shifted, stiffness(1e4), starts=1, discretisation=looks) for looks in (True, False))
    assert found["E"].interval == alone["E"].interval
    assert "errors hold nothing of the grid" in str(found)


def lowered(e, by):
    """All but the floor [m] lower, data too: the floor as much higher."""
    return eqx.tree_at(
        lambda e: (e.particles.x, e.observations[0].data), e, (e.particles.x - by, e.observations[0].data - by)
    )


def dropped(height):
    """A bar dropped on a floor, and its motion with noise where the floor stands higher."""
    grid = mpm.Grid((14,), 0.05, origin=(-4,))
    q = mpm.fill(mpm.Box((0.02,), (0.42,)), grid, particles_per_cell=4, density=1e3)
    q = eqx.tree_at(lambda q: q.v, q, jnp.full_like(q.v, -1.2))
    scene = mpm.Scene(grid, mpm.NeoHookean(5e4, 0.3), gravity=(-9.81,), boundary=mpm.ContactPlane(0, 0.0))
    which, times = np.arange(2, q.count, 8), np.arange(1, 31) * 4e-3
    seen = mpm.Tracks(times, np.zeros((30, len(which), 1)), which=which, sigma=2e-4)
    e = mpm.Experiment(scene, q, t1=0.12, dt=2e-3, observations=seen)
    low = lowered(e, height)
    x = low.predictions(low.run())[0] + height + 2e-4 * np.random.default_rng(0).normal(size=seen.data.shape)
    return eqx.tree_at(lambda e: e.observations[0].data, e, x)


@pytest.mark.thorough
def test_a_floor_that_stands_elsewhere_is_among_what_the_fit_advises():
    """E is 44 % high, and its interval begins above the truth. With the floor's height as a parameter both are found. A
    plane must stay on the lattice: its place as a parameter makes most starts fail, and why is said."""
    seen, both = dropped(0.01), stiffness(4e4) | {"height": mpm.Unbounded(update=lowered, start=0.0, scale=0.01)}
    fit = partial(mpm.fit, discretisation=False)
    with pytest.warns(UserWarning, match=r"residuals of 'tracks' drift: .* place and friction of a wall"):
        missed = fit(seen, stiffness(4e4), starts=1)["E"]
    assert missed.interval[0] > 5e4
    found = fit(seen, both)
    assert not found.is_beyond
    for name, true in {"E": 5e4, "height": 0.01}.items():
        assert found[name].interval[0] < true < found[name].interval[1]
    place = mpm.Unbounded(lambda e: e.scene.boundary[0].position, start=0.0, scale=0.01)
    with pytest.warns(UserWarning, match="23 of 24 starts failed, the first since: A ContactPlane must lie at"):
        fit(seen, stiffness(4e4) | {"place": place})


@pytest.mark.parametrize(("drift", "says"), thorough((0.0, "falls with"), (0.02, "does not fall with")))
def test_a_fit_on_finer_grids_starts_from_all_minima_and_says_what_its_misfit_is(drift, says, both_grids):
    """From twice the truth the coarse grid has several minima, from each of which the finer one starts. Its misfit
    falls with the spacing; one of a sensor that drifts does not."""
    times, fine = both_grids[4]
    white = NOISE * np.random.default_rng(1).normal(size=fine.shape)
    data, guess = fine + white + drift * np.linspace(0, 1, 80)[:, None], stiffness(6e4 if drift else 1.5e5)
    with pytest.warns(UserWarning, match=f"{says} the spacing"):
        found = mpm.fitting.fit_refined(lambda n: swing(times, data, n), guess, order=2, starts=1 if drift else "auto")
    assert f"{says} the spacing" in str(found)
    if drift == 0:
        (coarse, finer), last = found.fits, found["E"]
        assert len(coarse.screening.minima) > 1
        assert {round(float(m.values["E"])) for m in coarse.screening.minima} <= {
            round(float(value)) for value in finer.screening.points["E"]
        }
        assert last.interval[0] < E < last.interval[1]


def test_two_numbers_that_cannot_be_parted_are_named_after_the_first_jacobian():
    """E and ν of a bar in one dimension, whose motion sees one modulus: before the first iteration, and once."""
    times, x, which = tracks()
    lines, guess = [], stiffness(1e5) | {"nu": RATIO}
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = lambda message, *_: lines.append(str(message))
        lm = mpm.fitting.LevenbergMarquardt(max_steps=2)
        seen = experiment(mpm.Tracks(times, x, which=which, sigma=NOISE))
        mpm.fit(seen, guess, starts=1, discretisation=False, optimiser=lm, progress=lines.append)
    (named,) = (k for k, line in enumerate(lines) if "E and nu: " in line)
    (first,) = (k for k, line in enumerate(lines) if line.startswith("   0  misfit"))
    assert named < first
    assert lines[named].startswith("At the first guess, ")
