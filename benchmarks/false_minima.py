"""Where a fit to all data ends in a false minimum: horizons that grow, and windows from observed states.

    python benchmarks/false_minima.py [vibration] [bounces]

vibration: Young's modulus of a bar, from the exact motion over four periods with noise of 2 % of its amplitude, by
`fit` and by `fit_staged` from several first guesses.

bounces: Young's modulus of a disk that is thrown among round pegs, from tracks of all its particles with noise of
1 mm, made by the same scene with E = 1e5 Pa, from 4e4 Pa: by `fit` to all data, by `fit_staged`, and by one `fit` to
four windows. A window starts in free flight from the state that was observed: positions at a frame, velocities by
central differences of the two beside it, one deformation gradient and one velocity gradient by least squares.
"""

import sys
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm
from mpmjax.verification import VibratingBar, discretise

PERIODS, FRAMES = 4, 40
DT, STEPS, EVERY, NOISE, TRUE = 1e-3, 1200, 20, 1e-3, 1e5
PEGS = ((0.75, 0.55), (0.2, 0.95), (0.85, 1.15), (0.3, 0.2), (1.2, 0.2), (1.3, 0.9))


def modulus(start: float) -> dict[str, mpm.Positive]:
    """Young's modulus from a first guess [Pa]."""
    return {"E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, start=start)}


def vibration() -> None:
    exact = VibratingBar()
    scene, particles = discretise(exact, 1)
    which = np.arange(1, particles.count, 5)
    times = np.arange(1, FRAMES + 1) * PERIODS * exact.duration / FRAMES
    x = np.asarray(jax.vmap(jax.vmap(exact.position, (0, None)), (None, 0))(particles.X[which], jnp.asarray(times)))
    x = x + 2e-3 * np.random.default_rng(0).normal(size=x.shape)
    seen = mpm.Tracks(times, x, which=which, sigma=2e-3)
    swing = mpm.Experiment(scene, particles, t1=PERIODS * exact.duration, dt=0.05, observations=seen)
    for share in (0.69, 0.57, 0.3, 1.7, 2.5):
        alone, staged = mpm.fit(swing, modulus(100 * share)), mpm.fit_staged(swing, modulus(100 * share))
        print(
            f"vibration from {100 * share:.0f} Pa: fit {alone['E'].value:.4g} Pa; staged {staged['E'].value:.6g} Pa, "
            f"first until {staged.stages[0].horizon / exact.duration:.2f} periods, {len(staged.stages) + 1} stages",
            flush=True,
        )


def thrown(E: float) -> tuple[mpm.Scene, mpm.Particles]:
    """A disk among pegs, in a box."""
    grid = mpm.Grid((40, 40), 0.05, origin=(-4, -4))
    pegs = tuple(mpm.SeparatingCollider(mpm.Ball(peg, 0.12)) for peg in PEGS)
    box = mpm.SeparatingBox((0.0, 0.0), (1.5, 1.4))
    scene = mpm.Scene(grid, mpm.NeoHookean(E, 0.3), boundary=(box, *pegs))
    particles = mpm.fill(mpm.Ball((0.2, 0.6), 0.12), grid, particles_per_cell=4, density=1e3)
    return scene, eqx.tree_at(lambda q: q.v, particles, jnp.asarray([2.0, 0.1]) + 0 * particles.v)


def state(particles: mpm.Particles, x: np.ndarray, frame: int) -> mpm.Particles:
    """The particles as they were seen at a frame, x of shape (frames, p, d)."""
    X, here = np.asarray(particles.x), x[frame]
    v = (x[frame + 1] - x[frame - 1]) / (2 * EVERY * DT)
    arms, now = X - X.mean(axis=0), here - here.mean(axis=0)
    F = np.linalg.lstsq(arms, now, rcond=None)[0].T
    C = np.linalg.lstsq(now, v - v.mean(axis=0), rcond=None)[0].T
    v = v.mean(axis=0) + now @ C.T  # as smooth as F
    spread = tuple(jnp.asarray(np.broadcast_to(a, (len(X), 2, 2))) for a in (F, C))
    return mpm.Particles(
        jnp.asarray(here), jnp.asarray(v), particles.mass, particles.volume, deformations=(spread[0],), C=spread[1]
    )


def bounces() -> None:
    scene, particles = thrown(TRUE)
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=EVERY)
    assert run.frames is not None
    times, x = np.asarray(run.times), np.asarray(run.frames.x)
    x = x + NOISE * np.random.default_rng(0).normal(size=x.shape)
    speed = np.asarray(jnp.linalg.norm(run.frames.v.mean(axis=1), axis=1))
    print("speed of the disk at each frame [m/s]:", np.round(speed, 2), flush=True)
    which, guess = np.arange(particles.count), 0.4 * TRUE
    scene, particles = thrown(guess)
    growth = mpm.sensitivity(scene, particles, t1=STEPS * DT, dt=DT, warn_at=1e9)
    print("growth of derivatives at each tenth:", np.round(np.asarray(growth.growth)[9::10], 1), flush=True)

    def seen(first: int, last: int, start: mpm.Particles) -> mpm.Experiment:
        tracks = mpm.Tracks(
            times[first + 1 : last + 1] - times[first], x[first + 1 : last + 1], which=which, sigma=NOISE
        )
        return mpm.Experiment(scene, start, t1=(last - first) * EVERY * DT, dt=DT, observations=tracks)

    whole = seen(0, len(x) - 1, particles)

    def told(name: str, found: mpm.FitResult, more: str = "") -> None:
        e, rms = found["E"], found.noise[0].misfit
        print(f"bounces, {name}: E = {e.value:.5g} ± {e.error:.2g} Pa, misfit {rms:.3g} σ{more}", flush=True)

    told("all data", mpm.fit(whole, modulus(guess)))
    staged = mpm.fit_staged(whole, modulus(guess))
    until = f", data until {staged.horizons[0]:.3g} s, stages until {[round(s.horizon, 3) for s in staged.stages]}"
    told("staged", staged.result, until)
    starts = [1, *range(15, len(x) - 1, 15)]
    ends = [*starts[1:], len(x) - 1]
    windows = [seen(a, b, state(thrown(guess)[1], x, a)) for a, b in zip(starts, ends, strict=True)]
    told(f"{len(windows)} windows", mpm.fit(windows, modulus(guess)))
    told(f"{len(windows)} windows, staged", mpm.fit_staged(windows, modulus(guess)).result)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for part in sys.argv[1:] or ["vibration", "bounces"]:
        {"vibration": vibration, "bounces": bounces}[part]()
