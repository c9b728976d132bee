"""Where a fit to all data ends in a false minimum: horizons that grow, and windows from observed states.

    python benchmarks/false_minima.py [vibration] [windows]

vibration: Young's modulus of a bar, from the exact motion over four periods with noise of 2 % of its amplitude, by
`fit` and by `fit_staged` from several first guesses.

windows: the same from tracks of all particles, by `fit` to all data, by `fit_staged`, and by one `fit` to windows of
a period each, which start from the state that was observed: positions at a frame, velocities by central differences of
the frames beside it, deformation and velocity gradients by differences of neighbours.
"""

import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm
from mpmjax.verification import VibratingBar, discretise

PERIODS, FRAMES = 4, 40
WINDOW_FRAMES, NOISE = 25, 2e-3


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
    for share in (0.69, 0.57, 0.3, 2.5):
        alone, staged = (
            mpm.fit(swing, modulus(100 * share), starts=1),
            mpm.fitting.fit_staged(swing, modulus(100 * share)),
        )
        print(
            f"vibration from {100 * share:.0f} Pa: fit {alone['E'].value:.4g} Pa; staged {staged['E'].value:.6g} Pa, "
            f"{len(staged.remarks)} stages: {staged.remarks[0]}",
            flush=True,
        )


def windows() -> None:
    exact = VibratingBar()
    scene, particles = discretise(exact, 1)
    X, period = np.asarray(particles.X), exact.duration
    assert particles.X is not None
    times = np.arange(PERIODS * WINDOW_FRAMES + 2) * period / WINDOW_FRAMES
    x = np.asarray(jax.vmap(jax.vmap(exact.position, (0, None)), (None, 0))(particles.X, jnp.asarray(times)))
    x = x + NOISE * np.random.default_rng(0).normal(size=x.shape)

    def state(frame: int) -> mpm.Particles:
        """The particles as they were seen at a frame: velocities and deformations by central differences."""
        v = (x[frame + 1] - x[frame - 1]) / (times[frame + 1] - times[frame - 1])
        F = np.gradient(x[frame, :, 0], X[:, 0])[:, None, None]
        C = np.gradient(v[:, 0], x[frame, :, 0])[:, None, None]
        at, of = jnp.asarray(x[frame]), (jnp.asarray(F),)
        return mpm.Particles(at, jnp.asarray(v), particles.mass, particles.volume, deformations=of, C=jnp.asarray(C))

    def window(first: int, last: int, start: mpm.Particles) -> mpm.Experiment:
        own = slice(first + 1, last + 1)
        seen = mpm.Tracks(times[own] - times[first], x[own], which=np.arange(len(X)), sigma=NOISE)
        return mpm.Experiment(scene, start, t1=round(times[last] - times[first], 9), dt=0.05, observations=seen)

    def told(name: str, share: float, found: mpm.fitting.FitResult) -> None:
        e, rms = found["E"], np.mean([n.misfit for n in found.noise])
        print(f"{name} from {100 * share:.0f} Pa: {e.value:.5g} ± {e.error:.2g} Pa, misfit {rms:.3g} σ", flush=True)

    end = PERIODS * WINDOW_FRAMES
    whole = window(0, end, particles)
    parts = [window(k, k + WINDOW_FRAMES, state(k)) for k in range(1, end, WINDOW_FRAMES)]
    for share in (0.57, 0.3):
        told("all data", share, mpm.fit(whole, modulus(100 * share), starts=1))
        told("staged", share, mpm.fitting.fit_staged(whole, modulus(100 * share)))
        told(f"{len(parts)} windows of a period", share, mpm.fit(parts, modulus(100 * share), starts=1))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for part in sys.argv[1:] or ["vibration", "windows"]:
        {"vibration": vibration, "windows": windows}[part]()
