"""Do intervals hold? 200 measurements of one settlement with new noise, each fitted for Poisson's ratio: how often the
interval of the standard error holds the truth, and how often that of the profile.

Writes docs/fit_intervals.png and prints the counts. Run: python benchmarks/fit_intervals.py [REPETITIONS]

And beside a bound, by a bar that falls with hardly any gravity: python benchmarks/fit_intervals.py beside [DRAWS]
"""

import sys
import warnings
from pathlib import Path

import equinox as eqx
import jax
import numpy as np

import mpmjax as mpm

NU, NOISE = 0.4, 3e-3


def top(scene, particles):
    """The height of the column [m]."""
    return particles.x.max()


def column(nu):
    """A soft column between walls, which sinks under its own weight until it rests."""
    grid = mpm.Grid((10,), 0.1, origin=(-2,))
    particles = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, particles_per_cell=2, density=1e3)
    floor = mpm.StickyBox((0.0,), (10.0,))
    return mpm.Scene(grid, mpm.NeoHookean(1e5, nu), gravity=(-9.81,), boundary=floor), particles


def main(repetitions=200):
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    at = {"t1": 0.6, "dt": 0.05, "method": mpm.BackwardEuler()}
    run = mpm.simulate(*column(NU), save_every=1, observe=top, **at)
    times, height = np.asarray(run.times)[-4:], np.asarray(run.observed)[-4:]
    parameter = mpm.Bounded(lambda e: e.scene.material.poisson_ratio, 0.0, 0.499)
    profiles, own, off = [], [], []
    for seed in range(repetitions):
        data = height + NOISE * np.random.default_rng(seed).normal(size=len(height))
        seen = mpm.Series(times, data, top, sigma=NOISE)
        result = mpm.fit(mpm.Experiment(*column(0.3), observations=seen, **at), {"nu": parameter})
        off.append(data.mean() - height.mean())
        profiles.append(mpm.fitting.profile(result, "nu"))
        own.append(result["nu"].interval)
    by_profile = np.array([p.interval for p in profiles])
    print(f"{'':<24} {'holds':>6} {'all below':>10} {'all above':>10} {'median width':>13}")
    for name, intervals in (("by the profile", by_profile), ("by the standard error", np.array(own))):
        below, above = intervals[:, 1] <= NU, intervals[:, 0] >= NU
        width = np.median(intervals[:, 1] - intervals[:, 0])
        print(f"{name:<24} {(~below & ~above).sum():>6} {below.sum():>10} {above.sum():>10} {width:>13.3f}")
    beyond = np.abs(off) > 1.96 * NOISE / np.sqrt(len(height))
    print(f"means beyond 1.96 standard errors: {beyond.sum()}; settlement {1e3 * (0.375 - height.mean()):.2f} mm")
    one = profiles[0]
    end = np.interp(one.symmetric[1], one.values, one.signed_root) ** 2
    print(f"first repetition: Δχ² is {end:.2f} at the upper end of the symmetric interval, {one.symmetric[1]:.3f}")
    draw(profiles[:40], np.array(own[:40]))


def beside(draws=300):
    """Gravity, which is positive, and speed from places of a bar: how often intervals hold them, the truth so many
    standard errors from zero."""
    jax.config.update("jax_enable_x64", True)
    grid, dt, steps = mpm.Grid((14,), 0.1, origin=(-6,)), 4e-3, np.arange(1, 16)
    bar = mpm.fill(mpm.Box((0.0,), (0.3,)), grid, particles_per_cell=2, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(7e4, 0.3), gravity=(-5.0,))
    design = np.stack([-(dt**2) * steps * (steps + 1) / 2, steps * dt], axis=1)
    error = NOISE * np.sqrt(np.linalg.inv(design.T @ design)[0, 0])
    parameters = {
        "g": mpm.Positive(update=lambda e, g: eqx.tree_at(lambda e: e.scene.gravity, e, -g[None]), start=5.0),
        "v": mpm.Unbounded(update=lambda e, v: eqx.tree_at(lambda e: e.particles.v, e, v + 0 * bar.v), start=1.0),
    }
    for sigma in (NOISE, None):
        seen = mpm.Series(steps * dt, np.zeros((15, 1)), mpm.fitting.CentreOfMass(), sigma=sigma)
        one = mpm.Experiment(scene, bar, t1=15 * dt, dt=dt, observations=seen)
        for offset in (0.0, 0.5, 1.0, 2.3, 4.2):
            truth = np.array([offset * error, 0.3])
            y = 0.15 + design @ truth + NOISE * np.random.default_rng(int(10 * offset) + 1).normal(size=(draws, 15))
            sets = [eqx.tree_at(lambda e: e.observations[0].data, one, own[:, None]) for own in y]
            fits = mpm.fitting.fit_ensemble(sets, parameters, batch=draws).fits
            held = [[f[n].interval[0] <= t <= f[n].interval[1] for n, t in zip("gv", truth, strict=True)] for f in fits]
            print(f"noise {sigma}, {offset} standard errors from zero: g and v held in {np.mean(held, axis=0)}")


def draw(profiles, own):
    """One profile, and the intervals of all."""
    from matplotlib import pyplot as plt

    one = profiles[0]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 3.4), layout="constrained")
    left.plot(one.values, one.statistic, "o-", markersize=3, label="profile")
    left.axhline(one.threshold, color="0.5", linewidth=0.8, linestyle=":")
    for number, end in enumerate(one.symmetric):
        left.axvline(end, color="C1", linestyle="--", linewidth=1, label=None if number else "by its standard error")
    left.axvline(NU, color="0.3", linewidth=0.8, label="truth")
    left.set(xlabel="Poisson's ratio", ylabel="Δχ²", ylim=(0, 1.5 * one.threshold))
    left.legend(fontsize=8, frameon=False, loc="upper center")
    for row, (profile, symmetric) in enumerate(zip(profiles, own, strict=True)):
        right.plot(profile.interval, [row, row], color="C0", linewidth=1.5)
        right.plot(symmetric, [row + 0.4] * 2, color="C1", linewidth=1, alpha=0.8)
    right.axvline(NU, color="0.3", linewidth=0.8)
    right.set(xlabel="Poisson's ratio", ylabel="measurement", title="95 % intervals: profile, standard error")
    for axis in (left, right):
        axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(Path(__file__).parents[1] / "docs" / "fit_intervals.png", dpi=140)


if __name__ == "__main__":
    if sys.argv[1:2] == ["beside"]:
        beside(*map(int, sys.argv[2:]))
    else:
        main(*map(int, sys.argv[1:]))
