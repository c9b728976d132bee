# %% [markdown]
# What a measured front says of a dam break: friction on the floor, and when the clock began. J. C. Martin and
# W. J. Moyce (1952) let a column of water go, a = 1.125 in wide and 2a high, by the rupture of a diaphragm.

# %%
from pathlib import Path

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

A, G, DENSITY = 0.028575, 9.81, 1e3  # a [m], g [m/s²], ρ [kg/m³]
SECOND = np.sqrt(2 * G / A)  # T of a second
CELLS, LAST = 10, 3.6  # cells to a, of the coarser grid; the last T that is fitted

table = np.loadtxt(Path(__file__).parent / "data/martin_moyce_1952_dam_break.csv", delimiter=",", skiprows=3)
T, Z = table[table[:, 0] <= LAST].T


# %%
def front(scene, particles):
    """Z, the place of the foremost particle and half its width over a."""
    return (particles.x[:, 0].max() + scene.grid.spacing / 4) / A


def dam(n):
    """The column on n times CELLS cells, with what was measured."""
    cells = CELLS * n
    grid = mpm.Grid((6 * cells + 7, int(2.2 * cells) + 7), A / cells, origin=(-3, -3))
    water = mpm.fill(mpm.Box((0.0, 0.0), (A, 2 * A)), grid, particles_per_cell=4, density=DENSITY)
    walls = mpm.SymmetryPlane(0, 0.0), mpm.ContactPlane(1, 0.0, friction=0.15)
    scene = mpm.Scene(grid, mpm.Fluid(200 * DENSITY * G * A), gravity=(0.0, -G), boundary=walls)
    end = (LAST + 0.2) / SECOND  # later than the last measurement, so that the clock may be moved either way
    steps = int(np.ceil(end / float(mpm.stable_dt(scene, water, safety=0.5))))
    seen = mpm.Series(T / SECOND, Z, front, name="front / a")
    return mpm.Experiment(scene, water, t1=end, dt=end / steps, observations=seen)


def released(e, late):
    """The experiment with a release at this T of the measurement's clock."""
    return eqx.tree_at(lambda e: e.observations[0].times, e, (T - late) / SECOND)


parameters = {
    "friction": mpm.Positive(lambda e: e.scene.boundary[1].friction),
    "release": mpm.Unbounded(update=released, start=0.1, scale=0.1, unit="of T"),
}
found = mpm.fitting.fit_refined(dam, parameters, optimiser=mpm.fitting.LevenbergMarquardt(rtol=1e-4), progress=print)
print(found)
finest = found.fits[-1]
print(f"correlation of friction and release: {finest.uncertainty.correlation[0, 1]:.2f}")
print(finest.noise[0])

# %%
own = dam(2)
figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
run = finest.experiments[0].run()
time = np.arange(own.steps + 1) * own.dt * SECOND
axis.plot(time + finest["release"].value, run.observed[0], label="fitted friction and release")
free = eqx.tree_at(lambda e: e.scene.boundary[1].friction, own, 0.0).run()
axis.plot(time, free.observed[0], ":", label="neither")
axis.plot(*table.T, "ko", label="Martin and Moyce 1952")
axis.set(xlabel="T = t √(2g/a)", ylabel="Z, front / a", xlim=(0, LAST + 0.1), ylim=(0.9, 5.5))
axis.legend(frameon=False)
figure.savefig("dam_break_fit.png", dpi=130)
for fit in found.fits:
    assert fit.converged
    assert fit.noise[0].misfit * fit.noise[0].sigma < 0.1  # of a, where the front without either is off by 0.4
