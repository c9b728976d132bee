"""A floor's friction in bands, from where particles of a collapsing column of water go.

    python benchmarks/published/friction_bands.py [--coarse] [--start 2e-6,0.5,0.1,0.4]
    python benchmarks/published/friction_bands.py ground_truth_trajectory.npy

As H. Du and Q. He invert it (arXiv:2507.04192, section 5.1.3; JAX-MPM at baddd99,
examples/dam_break_friction_inversion): 500 of 6000 particles are followed for 0.4 s. They follow a run with the bands
that are sought, here with noise of 1 mm, or the trajectory that the source's `generate_data.py` writes. There Adam
takes 500 gradients. The last band, which the water does not reach, is held at 0. --coarse: 1500 particles. --start:
first guesses, from which alone it is then searched.
"""

import argparse
import time
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("trajectory", nargs="?", help="of the source's code")
parser.add_argument("--coarse", action="store_true", help="twice the spacing and step")
parser.add_argument("--start", help="first guesses, parted by commas; default: 0.2 each, and others if need be")
asked = parser.parse_args()
TRUE, BAND, COARSER = (0.0, 0.5, 0.1, 0.2), 0.4, 1 + asked.coarse  # coefficients [-]; width of a band [m]
DENSITY, SOUND, END, NOISE, FRAMES, STEPS = 1e3, 35.0, 0.4, 1e-3, 40, 2880 // COARSER  # kg/m³, m/s, s, m


class BandedPlane(mpm.ContactPlane):
    """A floor whose coefficient of friction changes from band to band of x."""

    coefficients: Sequence[float | jax.Array] = ()  # of the bands from x = 0 on [-]

    def contacts(self, faces, grid, window, t, dt):
        band = jnp.floor(grid.nodes(window)[:, 0] / BAND + 1e-6).reshape(grid.shape)[:, :1, None].astype(int)
        of_column = jnp.stack([jnp.asarray(mu) for mu in self.coefficients])[jnp.clip(band, 0, len(TRUE))]
        plane = eqx.tree_at(lambda plane: plane.friction, self, of_column)
        return super(BandedPlane, plane).contacts(faces, grid, window, t, dt)


grid = mpm.Grid((200 // COARSER + 7, 40 // COARSER + 7), 0.01 * COARSER, origin=(-3, -3))
water = mpm.fill(mpm.Box((0.0, 0.0), (0.5, 0.3)), grid, particles_per_cell=4, density=DENSITY)
law, walls = mpm.Fluid(DENSITY * SOUND**2), (mpm.SymmetryPlane(0, 0.0), BandedPlane(1, 0.0, coefficients=(*TRUE, 0.0)))
scene = mpm.Scene(grid, law, gravity=(0.0, -9.8), boundary=walls)
chance, times = np.random.default_rng(0), np.linspace(0, END, FRAMES + 1)[1:]
which = chance.choice(water.count, 500, replace=False)
if asked.trajectory:
    theirs = np.load(asked.trajectory)  # (f, p, 2), every tenth step of 3e-5 s
    places = np.asarray(water.x)[which]
    same = np.abs(theirs[0][None] - places[:, None]).max(axis=2).argmin(axis=1)
    seen = theirs[np.rint(times / 3e-4).astype(int)][:, same]
else:
    run = mpm.simulate(scene, water, t1=END, dt=END / STEPS, save_every=STEPS // FRAMES)
    seen = np.asarray(run.frames.x)[1:, which]
    seen = seen + NOISE * chance.normal(size=seen.shape)
first = [float(mu) for mu in asked.start.split(",")] if asked.start else [0.2] * len(TRUE)
guess = eqx.tree_at(lambda s: s.boundary[1].coefficients, scene, (*first, 0.0))
tracks = mpm.Tracks(times, seen, which=which, sigma=NOISE)
experiment = mpm.Experiment(guess, water, t1=END, dt=END / STEPS, observations=tracks)
bands = {f"band {k}": mpm.Positive(lambda e, k=k: e.scene.boundary[1].coefficients[k]) for k in range(len(TRUE))}
begun = time.perf_counter()
starts = 1 if asked.start else "auto"
print(mpm.fit(experiment, bands, starts=starts, discretisation=False, progress=print))
print(f"asked {TRUE}; {time.perf_counter() - begun:.0f} s")
