"""Error against seconds: the errors are those of `simulate`, the reference knows its own, the verdict names the
cheapest."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import mpmjax as mpm
from mpmjax.analysis import Trial, WorkPrecision
from mpmjax.analysis._bench import FRAMES, Bench, Timed, settle
from mpmjax.verification import StandingWave, discretise
from mpmjax.viz import draw_chart, write_trials

WAVE = StandingWave(0.05)


def wave(n):
    """A standing wave on 16 n cells."""
    return discretise(WAVE, 16 * n, description=mpm.TotalLagrangian())


def pulled(n):
    """A stiff bar, pulled slowly: an explicit run of it takes some hundred million steps."""
    grid = mpm.Grid((8 * n,), 0.1 / n, origin=(-2 * n,))
    bar = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3)
    motion = mpm.Motion((0.0, 10.0), ((0.0,), (0.1,)))
    ends = (mpm.SymmetryPlane(0, 0.0), mpm.Grip(mpm.Box((0.39,), (1.0,)), motion))
    law = mpm.NeoHookean(youngs_modulus=1e15, poisson_ratio=0.3)
    return mpm.Scene(grid, law, boundary=ends, description=mpm.TotalLagrangian()), bar


@pytest.fixture(scope="module")
def waves():
    """Of a quarter of a period."""
    methods = (mpm.Explicit(), mpm.ImplicitMidpoint())
    own = ((mpm.SemiImplicit(), WAVE.duration / 16),)
    return mpm.analysis.work_precision(wave, t1=WAVE.duration / 2, error=1e-2, methods=methods, also=own)


def displacements(trial):
    """Initial places and the way from them, at the times of comparison, by `simulate`."""
    scene, particles = wave(trial.refinement)
    run = mpm.simulate(
        scene, particles, t1=WAVE.duration / 2, dt=trial.dt, method=trial.method, save_every=trial.steps // FRAMES
    )
    return np.asarray(particles.X), np.asarray(particles.x), np.asarray(run.frames.x[1:])


def rms(a):
    return np.sqrt((a**2).sum(axis=2).mean(axis=1))


@pytest.mark.slow
def test_errors_are_those_of_simulate(waves):
    """Of the best trial on each grid, against the mean of the reference's particles in its place, in plain NumPy."""
    _, fine0, fine = displacements(waves.reference)
    size = rms(fine - fine0).max()
    for n in (1, 2):
        best = min((t for t in waves.trials if t.refinement == n), key=lambda t: t.error)
        _, x0, x = displacements(best)
        near = np.abs(x0 - fine0.T).argsort(axis=1)[:, : len(fine0) // len(x0)]
        mean = (fine - fine0)[:, near].mean(axis=2)
        assert_close(best.error, rms(x - x0 - mean).max() / size, 1e-9)


@pytest.mark.slow
def test_the_reference_is_as_good_as_it_says(waves):
    """Against the exact motion, and so are the trials."""
    reference = waves.reference
    X, x0, x = displacements(reference)
    t = WAVE.duration / 2 * np.arange(1, FRAMES + 1) / FRAMES
    exact = X + 0.05 * np.sin(np.pi * X) * np.cos(np.pi * WAVE.wave_speed * t)[:, None, None]
    true = rms(x - exact).max() / rms(x - x0).max()
    assert true < reference.error <= 1e-2 / 3
    assert reference.refinement >= 2


@pytest.mark.slow
def test_trials_refine_until_they_are_good(waves):
    """The midpoint rule's errors fall to the target and stop there; β = 1 is far from it at sixteen steps a half
    period."""
    for n in (1, 2):
        own = [t for t in waves.trials if (type(t.method), t.refinement) == (mpm.ImplicitMidpoint, n)]
        assert [t.steps for t in own] == [FRAMES * 2**k for k in range(len(own))]
        assert own[0].error > own[-1].error <= 1e-2
    assert 1e-2 < waves.trials[-1].error < 1


@pytest.mark.thorough
def test_a_slow_pull_of_a_stiff_bar_is_not_run_explicitly():
    """It is foreseen to take too long, and the verdict says so; an explicit step of an implicit one's length fails."""
    tried = {"methods": (mpm.Explicit(), mpm.SemiImplicit()), "also": ((mpm.Explicit(), 1.25),)}
    found = mpm.analysis.work_precision(pulled, t1=10.0, error=0.1, refinements=(1,), **tried)
    explicit, *implicit, wild = found.trials
    assert wild.error == math.inf
    assert math.isnan(explicit.error)
    assert explicit.seconds > 30
    good = [trial for trial in implicit if trial.error < 0.1]
    cheapest = found.cheapest()
    assert cheapest == min(good, key=lambda trial: trial.seconds)
    assert f"SemiImplicit(beta=1), dt = {cheapest.dt:.3g} s ({cheapest.steps} steps)" in found.verdict()
    assert "Explicit()" in found.verdict()
    assert "would need" in found.verdict()


def test_a_reference_that_takes_too_long_is_foreseen_and_refused():
    """Before it is run, with what to change; not after the time is up."""

    def falling(n):
        _, bar = pulled(n)
        bar = eqx.tree_at(lambda p: p.v, bar, bar.v + 1.0)
        return mpm.Scene(mpm.Grid((64,), 0.1, origin=(-20,)), mpm.NeoHookean(1e4, 0.3)), bar

    bench = Bench.of(falling, 1, 1.0)
    with pytest.raises(ValueError, match=r"more than the 1e-06 s .*most_seconds in \[run\], --most-seconds"):
        settle(falling, bench, 1e-2, 1e-6)


def test_what_a_call_takes_is_not_foreseen_for_every_step(monkeypatch):
    """With 5 ms a call and 50 µs a step, a million steps are foreseen to take 50 s to a few per cent."""
    monkeypatch.setattr(Bench, "timed", lambda self, method, steps, frames, each: Timed(None, 0.0, 5e-3 + 50e-6 * each))
    bench = Bench.of(pulled, 1, 10.0)
    assert_close(bench.foresee(mpm.Explicit(), 10**6), 50.0, 0.03)


def trial(method, seconds, error, refinement=1):
    return Trial(method, refinement, 0.1, 10, seconds, error)


MIDPOINT, EXPLICIT = mpm.ImplicitMidpoint(), mpm.Explicit()
REFERENCE = trial(mpm.TRBDF2(), 9.0, 1e-3, 4)


def test_the_cheapest_is_the_fastest_that_is_good_enough():
    trials = (
        trial(EXPLICIT, 1.0, math.inf),
        trial(EXPLICIT, 8.0, 2e-3),
        trial(MIDPOINT, 2.0, 2e-2),
        trial(MIDPOINT, 4.0, 9e-3, 2),
        trial(MIDPOINT, 5.0, 1e-3),
        trial(MIDPOINT, 0.1, math.nan),
    )
    found = WorkPrecision(trials, REFERENCE, 1e-2, 1.0)
    assert found.cheapest() == trials[3]
    assert found.cheapest(explicit=True) == trials[1]
    assert found.verdict() == (
        "ImplicitMidpoint(), dt = 0.1 s, spacing / 2 (10 steps): 4 s, error 0.009; Explicit(), dt = 0.1 s needs 8 s."
    )


def test_an_explicit_step_beyond_the_limit_is_never_the_cheapest():
    """On any grid, however well it went in a short run."""
    trials = (trial(EXPLICIT, 1.0, 1e-3), trial(EXPLICIT, 1.0, 1e-3, 2), trial(MIDPOINT, 2.0, 5e-3))
    assert WorkPrecision(trials, REFERENCE, 1e-2, 0.2).cheapest() == trials[0]
    assert WorkPrecision(trials[1:], REFERENCE, 1e-2, 0.19).cheapest() == trials[2]
    assert WorkPrecision(trials, REFERENCE, 1e-2, 0.09).cheapest() == trials[2]


def test_luck_does_not_count():
    """A small error between two large ones is where the error changes its sign."""
    steps = [(0.4, 1.0, 0.5), (0.2, 2.0, 0.005), (0.1, 4.0, 0.02), (0.05, 8.0, 0.009), (0.025, 16.0, 0.004)]
    trials = tuple(Trial(MIDPOINT, 1, dt, 10, seconds, error) for dt, seconds, error in steps)
    assert WorkPrecision(trials, REFERENCE, 1e-2, 1.0).cheapest() == trials[3]
    assert WorkPrecision(trials[:3], REFERENCE, 1e-2, 1.0).cheapest() == trials[1]  # as good as what follows it


def test_where_the_grid_allows_no_better_the_cheapest_is_as_good_as_it_allows():
    trials = (trial(MIDPOINT, 1.0, 0.1), trial(MIDPOINT, 2.0, 0.049), trial(MIDPOINT, 4.0, 0.04))
    found = WorkPrecision(trials, REFERENCE, 1e-2, 1.0)
    assert found.cheapest() == trials[1]
    assert "None reached 0.01" in found.verdict()
    assert "the errors are those of the step alone" not in found.verdict()
    alone = WorkPrecision(trials, trial(mpm.Explicit(), 9.0, 1e-3, 1), 1e-2, 1.0, skipped=("TRBDF2(rho=0)",))
    assert "There was no time for a finer grid: the errors are those of the step alone." in alone.verdict()
    assert alone.verdict().endswith("There was no time for TRBDF2(rho=0).")
    doubtful = WorkPrecision(trials, trial(mpm.TRBDF2(), 9.0, 2e-2, 2), 1e-2, 1.0)
    assert "The reference is known to 0.02 only" in doubtful.verdict()
    failed = WorkPrecision((trial(EXPLICIT, 1.0, math.inf),), REFERENCE, 1e-2, 1.0)
    assert failed.cheapest() is None
    assert "No run ended well" in failed.verdict()


def test_errors_below_that_of_the_reference_are_not_told_apart():
    """Of a reference known to 4 %, no trial is better than that: the fastest of those that may be as good is taken."""
    trials = (trial(EXPLICIT, 1.0, 0.03), trial(MIDPOINT, 9.0, 0.002))
    assert WorkPrecision(trials, trial(mpm.TRBDF2(), 9.0, 4e-2, 2), 1e-2, 1.0).cheapest() == trials[0]
    assert WorkPrecision(trials, trial(mpm.TRBDF2(), 9.0, 2e-3, 2), 1e-2, 1.0).cheapest() == trials[1]


@pytest.mark.slow
def test_the_chart_and_its_numbers_are_written(waves, tmp_path):
    assert draw_chart(waves, tmp_path / "chart.png").stat().st_size > 1000
    header, *rows = write_trials(waves, tmp_path / "chart.csv").read_text().splitlines()
    assert header == "method,refinement,dt_s,steps,seconds,error"
    assert len(rows) == len(waves.trials)
    assert rows[-1].startswith("SemiImplicit(beta=1),1,")


@pytest.mark.thorough
def test_a_scene_in_which_nothing_moves_is_refused():
    def still(n):
        scene, bar = pulled(n)
        return mpm.Scene(scene.grid, scene.material, gravity=(jnp.zeros(()),)), bar

    with pytest.raises(ValueError, match="Nothing moves"):
        mpm.analysis.work_precision(still, t1=1.0)


def test_a_scene_that_fails_at_every_step_is_refused_and_not_tried_for_ever():
    """The bar leaves the window."""

    def leaving(n):
        scene, bar = pulled(n)
        bar = eqx.tree_at(lambda p: p.v, bar, bar.v + 1.0)
        return mpm.Scene(scene.grid, mpm.NeoHookean(1e4, 0.3)), bar

    with pytest.raises(ValueError, match=r"fails, and half .*At step \d+ .*left the grid's window"):
        mpm.analysis.work_precision(leaving, t1=1.0)
