"""An observation of a user's own, written in one file outside of the package: the largest extension in a run."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

DT, T1 = 4e-3, 0.06


class LargestExtension(mpm.fitting.AbstractObservation):
    """The largest distance between the outermost particles during the run [m], one number."""

    data: np.ndarray
    name: str = "largest extension [m]"

    def observe(self, scene, particles):
        return particles.x[:, 0].max() - particles.x[:, 0].min()

    def predict(self, seen, run):
        return seen.max()[None]


def bar(stiffness):
    """A free bar that is stretched as it starts."""
    grid = mpm.Grid((12,), 0.1, origin=(-4,))
    particles = mpm.fill(mpm.Box((0.0,), (0.4,)), grid, density=1e3)
    particles = eqx.tree_at(lambda q: q.v, particles, 1.5 * (particles.x - 0.2))
    return mpm.Scene(grid, mpm.NeoHookean(stiffness, 0.3)), particles


def test_a_stiffness_is_fitted_to_an_observation_of_ones_own():
    """From a first guess that is 20 % off, to the stiffness of the run that was observed."""
    scene, particles = bar(7e4)
    run = mpm.simulate(scene, particles, t1=T1, dt=DT, save_every=1)
    x = run.frames.x[..., 0]
    measured = np.asarray((x.max(axis=1) - x.min(axis=1)).max())[None]
    assert measured[0] > 1.01 * float(jnp.ptp(x[0]))
    scene, particles = bar(8.4e4)
    pull = mpm.Experiment(scene, particles, t1=T1, dt=DT, observations=LargestExtension(measured, sigma=1e-4))
    result = mpm.fit(pull, {"E": mpm.Positive(lambda e: e.scene.material.youngs_modulus, unit="Pa")})
    np.testing.assert_allclose(result.values["E"], 7e4, rtol=1e-4)
