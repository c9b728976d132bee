"""What do 64 starts cost, beside searches from all of them and beside 64 fits? What do they miss?

    python benchmarks/multistart.py [--starts 64] [--rounds 2] [--scene explicit]
    python benchmarks/multistart.py --reliability
    python benchmarks/multistart.py --default

E and ν of a free square that is stretched as it starts, from tracks of all its particles with noise, made by the same
scene; once with explicit steps, once with semi-implicit ones. Fits one by one and one with `Starts`, with `fraction=1`,
which searches from all points, and with its default, start from the same Sobol points, E over two decades, ν between
its bounds. Printed are seconds of the processor and of the clock, compilation left out by a first call of each, the
three interleaved; and of one iteration, per search, against how many run together.

`--reliability`: how often searches find the best minimum, and how many they are, of 40 scramblings of the Sobol points,
for several fractions. The problems are oscillations whose frequency, amplitude, damping and phase are searched, the
better known the longer they last, and sums of two and three of them.

`--default`: seconds of the explicit scene's fit from one start, of the default where the noise explains its misfit and
where it does not (other starts and twice the spacing are looked at), and of one from 24 points: the first time, and
again with other data.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._search import iterate_together
from mpmjax.fitting._starts import linked, starting_points, unit_points

NOISE = 1e-4
PARAMETERS = {
    "E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=1e5),
    "nu": mpm.Bounded(lambda e: e.scene.material.poisson_ratio, lower=0.0, upper=0.49, start=0.2),
}
OSCILLATIONS = {
    "frequency, 5 periods": ((1.0,), (1.0,), 30.0, 0),
    "frequency, 13 periods": ((1.0,), (1.0,), 80.0, 0),
    "and amplitude, 10 periods": ((1.0,), (1.0,), 60.0, 1),
    "and damping, 10 periods": ((1.0,), (1.0,), 60.0, 2),
    "and phase, 6 periods": ((1.0,), (1.0,), 40.0, 3),
    "two frequencies, 1.6 and 4 periods": ((1.0, 0.5), (1.0, 2.7), 10.0, 0),
    "three frequencies, 1 to 5 periods": ((1.0, 0.6, 0.4), (1.0, 2.2, 5.0), 6.0, 0),
}
FRACTIONS = {64: (0.0, 0.125, 0.375, 0.5, 1.0), 256: (0.125,)}
SCENES = {"explicit": (mpm.Explicit(), 2e-3, 100), "semi-implicit": (mpm.SemiImplicit(), 1e-2, 20)}


def experiment(method: Any, dt: float, steps: int) -> mpm.Experiment:
    """What is fitted, and what a run of it with E = 7e4 Pa and ν = 0.3 says with noise, in five frames."""
    grid = mpm.Grid((12, 12), 0.1, origin=(-4, -4))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.4)), grid, particles_per_cell=4, density=1e3)
    particles = eqx.tree_at(lambda q: q.v, particles, jnp.asarray([1.5, -1.0]) * (particles.x - 0.2))
    scene = mpm.Scene(grid, mpm.NeoHookean(7e4, 0.3))
    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=method, save_every=steps // 5)
    assert run.frames is not None
    x = np.asarray(run.frames.x)[1:]
    x = x + NOISE * np.random.default_rng(0).normal(size=x.shape)
    seen = mpm.Tracks(np.asarray(run.times)[1:], x, which=np.arange(particles.count), sigma=NOISE)
    return mpm.Experiment(scene, particles, t1=steps * dt, dt=dt, method=method, observations=seen)


def timed(call: Callable[[], Any]) -> tuple[float, float, Any]:
    """Seconds of the processor and of the clock, and what it returns."""
    clock, processor = time.perf_counter(), time.process_time()
    out = jax.block_until_ready(call())
    return time.process_time() - processor, time.perf_counter() - clock, out


def default() -> None:
    """What the default fit costs beside a single one, and 24 starts."""
    right = experiment(*SCENES["explicit"])
    seen: Any = right.observations[0]
    missed = seen.data * (1 + 0.02 * np.sin(40 * seen.times))[:, None, None]
    wrong = eqx.tree_at(lambda e: e.observations[0].data, right, missed)
    single: dict[str, Any] = {"starts": 1, "discretisation": False}
    base = [1.0, 1.0]
    print("fit: seconds of the processor (of the clock), and over the single fit's; the first time, and again")
    for name, of, options in (
        ("from one start", right, single),
        ("default, misfit within the noise", right, {}),
        ("from one start, misfit beyond", wrong, single),
        ("default, misfit beyond", wrong, {}),
        ("24 starts", right, {"starts": 24}),
    ):
        jax.clear_caches()
        told = []
        for k in range(2):
            again = eqx.tree_at(lambda e: e.observations[0].data, of, of.observations[0].data + 1e-6 * k)
            processor, clock, _ = timed(partial(mpm.fit, again, PARAMETERS, **options))
            base[k] = processor if options is single else base[k]
            told.append(f"{processor:.1f} s ({clock:.1f} s), {processor / base[k]:.2f}")
        print(f"{name}: {'; '.join(told)}", flush=True)


def one_by_one(pull: mpm.Experiment, points: np.ndarray) -> list[float]:
    """The misfit of a fit from each point; NaN where it fails."""
    problem, misfits = FitProblem((pull,), PARAMETERS), []
    for z in points:
        values = problem.values(jnp.asarray(z))
        starts = {
            name: eqx.tree_at(lambda p: p.start, p, v) for (name, p), v in zip(PARAMETERS.items(), values, strict=True)
        }
        try:
            misfits.append(mpm.fit(pull, starts, starts=1).chi_squared)
        except (ValueError, RuntimeError):
            misfits.append(float("nan"))
    return misfits


def iteration(pull: mpm.Experiment, points: np.ndarray, batch: int) -> Callable[[], Any]:
    """An iteration of so many searches together."""
    problem, optimiser = FitProblem((pull,), PARAMETERS), mpm.fitting.LevenbergMarquardt()
    none = jax.tree.map(lambda _: None, problem)
    states = [optimiser.begin(problem, jnp.asarray(z)) for z in points[:batch]]
    arrays, rest = zip(*(eqx.partition(s, eqx.is_array) for s in states), strict=True)
    state = eqx.combine(jax.tree.map(lambda *a: np.stack(a), *arrays), rest[0])
    return lambda: eqx.filter(
        iterate_together(none, problem, optimiser, state),
        eqx.is_array,
    )


def oscillations(
    amplitudes: tuple[float, ...], frequencies: tuple[float, ...], duration: float, others: int
) -> tuple[Callable[[np.ndarray], np.ndarray], np.ndarray, np.ndarray]:
    """The residuals of a sum of oscillations a e^{-dt} cos(ωt + φ), beside its values with noise of 0.01, shape (k, m)
    of coordinates (k, n); and the ends of their ranges. Searched are the logarithms of the frequencies, from a quarter
    to ten, and so many of: logarithm of a scale of the amplitudes, logarithm of the damping, phase."""
    t = np.linspace(duration / 80, duration, 80)
    number, damping = len(frequencies), 0.3 / duration
    lowest = np.array([np.log(0.25)] * number + [np.log(0.3), np.log(0.1 * damping), -1.0][:others])
    highest = np.array([np.log(10.0)] * number + [np.log(3.0), np.log(30 * damping), 1.0][:others])

    def signal(z: np.ndarray) -> np.ndarray:
        rest = np.concatenate([z[:, number:], np.tile([0.0, np.log(damping), 0.0][others:], (len(z), 1))], axis=1)
        scale, rate, phase = rest.T[:, :, None]
        omega = np.exp(z[:, :number, None])
        waves = np.array(amplitudes)[:, None] * np.cos(omega * t + phase[:, None])
        return np.exp(scale - np.exp(rate) * t) * waves.sum(1)

    true = np.array([[*np.log(frequencies), *[0.0, np.log(damping), 0.0][:others]]])
    seen = signal(true) + 0.01 * np.random.default_rng(1).normal(size=80)
    return lambda z: (signal(z) - seen) / 0.01, lowest, highest


def ends(residuals: Callable[[np.ndarray], np.ndarray], z: np.ndarray) -> np.ndarray:
    """Where Levenberg-Marquardt searches from each of z, shape (k, n), end: their Σ r², shape (k,)."""
    damping, step = np.ones(len(z)), 1e-6 * np.eye(z.shape[1])
    r = residuals(z)
    for _ in range(60):
        J = np.stack([(residuals(z + h) - residuals(z - h)) / 2e-6 for h in step], axis=-1)
        hessian = J.swapaxes(1, 2) @ J + damping[:, None, None] * np.eye(z.shape[1])
        tried = z - np.linalg.solve(hessian, (J * r[:, :, None]).sum(1)[..., None])[..., 0]
        new = residuals(np.clip(tried, -20, 20))
        better = (new**2).sum(1) < (r**2).sum(1)
        z, r = np.where(better[:, None], tried, z), np.where(better[:, None], new, r)
        damping = np.clip(np.where(better, damping / 3, damping * 4), 1e-9, 1e12)
    return (r**2).sum(1)


def reliability(scramblings: int = 40) -> None:
    """How often the best minimum is found, and by how many searches."""
    columns = ", ".join(f"{f:g} of {count}" for count, fractions in FRACTIONS.items() for f in fractions)
    print(f"problem, unknowns: found of {scramblings} (searches) by a fraction of {columns}")
    for text, (amplitudes, frequencies, duration, others) in OSCILLATIONS.items():
        residuals, lowest, highest = oscillations(amplitudes, frequencies, duration, others)
        told = []
        for count, fractions in FRACTIONS.items():
            found, searches = (dict.fromkeys(fractions, 0) for _ in range(2))
            for seed in range(scramblings):
                shares = unit_points(count - 1, len(lowest), seed)
                z = lowest + shares * (highest - lowest)
                costs = (residuals(z) ** 2).sum(1)
                own = {f: np.unique(linked(shares, costs, f)) for f in fractions}
                most = own[max(fractions)]
                best = set(most[ends(residuals, z[most]) < 2 * 80])
                for f in fractions:
                    found[f] += not best.isdisjoint(own[f])
                    searches[f] += len(own[f])
            told += [f"{found[f]} ({searches[f] / scramblings:.0f})" for f in fractions]
        print(f"{text}, {len(lowest)}: {', '.join(told)}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--scene", choices=SCENES, action="append")
    parser.add_argument("--reliability", action="store_true")
    parser.add_argument("--default", action="store_true")
    given = parser.parse_args()
    if given.reliability:
        return reliability()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    if given.default:
        return default()
    for name in given.scene or SCENES:
        method, dt, steps = SCENES[name]
        pull = experiment(method, dt, steps)
        problem = FitProblem((pull,), PARAMETERS)
        points = starting_points(problem, unit_points(given.starts - 1, problem.size, 0), mpm.fitting.Starts())
        calls = {batch: iteration(pull, points, batch) for batch in (1, 8, 32) if batch <= given.starts}
        seconds: dict[int, list[float]] = {batch: [] for batch in calls}
        for _ in range(2 + given.rounds):
            for batch, call in calls.items():
                seconds[batch].append(timed(call)[0] / batch)
        told = ", ".join(f"{batch}: {1e3 * np.median(s[1:]):.1f} ms" for batch, s in seconds.items())
        print(f"{name}: an iteration of a search of so many together, processor: {told}", flush=True)
        mpm.fit(pull, PARAMETERS, starts=9)
        for _ in range(given.rounds):
            processor, clock, alone = timed(partial(one_by_one, pull, points))
            print(f"{name}: {given.starts} fits: {processor:.1f} s of the processor, {clock:.1f} s", flush=True)
            for fraction in (1.0, 0.375):
                call = partial(mpm.fit, pull, PARAMETERS, starts=mpm.fitting.Starts(given.starts, fraction))
                own, own_clock, result = timed(call)
                found = result.screening
                print(
                    f"{name}: fraction {fraction:g}: {own:.1f} s of the processor, {own_clock:.1f} s; "
                    f"ratio {processor / own:.1f}; {len(found.searched)} searches, {found.iterations} iterations; "
                    f"{len(found.minima)} minima, the best of {len(found.minima[0].members)} points, "
                    f"{len(found.failures)} failed; χ² {result.chi_squared:.6g}, the fits' best "
                    f"{np.nanmin(alone):.6g} ({sum(np.isclose(alone, np.nanmin(alone), rtol=1e-3))} of them), "
                    f"{sum(np.isnan(alone))} failed",
                    flush=True,
                )


if __name__ == "__main__":
    main()
