# %% [markdown]
# A friction angle from how far columns of dry grains run out, with what the grid makes of it. The runouts are those of
# the published laws, for columns 0.75 and 1.5 times as high as long: data/README.md has the sources and their doubts.

# %%
import argparse
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

CELLS, SCATTER = 8, 0.05  # cells to the length of the column, of the coarser grid; scatter about the laws, assumed
REPOSE = {"sand": (29, 31), "beads": (22, 22)}  # degrees, published

parser = argparse.ArgumentParser()
parser.add_argument("--quick", action="store_true", help="coarser, no picture")
quick = parser.parse_args().quick
CELLS = 4 if quick else CELLS

table = np.loadtxt(Path(__file__).parent / "data/column_collapse_runout.csv", delimiter=",", skiprows=3)
runouts = {"sand": table[:, :2], "beads": table[:, [0, 2]]}


# %%
def runout(scene, particles):
    """How far the front lies beyond the column's length, which is one: the mean place of the foremost eight particles,
    two cells of the start, with half a particle's width. The foremost alone jumps from one angle to the next."""
    return jnp.sort(particles.x[:, 0])[-8:].mean() + scene.grid.spacing / 4 - 1


def column(n, a, measured):
    """A column a high, on n times CELLS cells to its length. Density and gravity are one, E is 100 ρ g a."""
    cells = CELLS * n
    grid = mpm.Grid((int((1.5 + 3 * a) * cells) + 6, int(1.05 * a * cells) + 8), 1 / cells, origin=(-3, -3))
    walls = mpm.SymmetryPlane(0, 0.0), mpm.ContactPlane(1, 0.0, friction=0.5)
    scene = mpm.Scene(grid, mpm.DruckerPrager(100 * a, 0.3, 0.4), gravity=(0.0, -1.0), boundary=walls)
    grains = mpm.fill(mpm.Box((0.0, 0.0), (1.0, a)), grid, particles_per_cell=4, density=1.0)
    end = 2 * np.sqrt(2 * a) + 2.5  # at rest
    steps = int(np.ceil(end / float(mpm.stable_dt(scene, grains))))
    seen = mpm.Series([end], [measured], runout, sigma=SCATTER * measured, name=f"runout, a = {a:g}")
    return mpm.Experiment(scene, grains, t1=end, dt=end / steps, observations=seen)


def rough(e, degrees):
    """The experiment with Coulomb's angle φ for grains and floor. The law's angle is that of triaxial compression: in
    plane strain sin φ = M/√3, see `DruckerPrager`."""
    phi = jnp.deg2rad(degrees)
    law = jnp.arcsin(3 * 3**0.5 * jnp.sin(phi) / (6 + 3**0.5 * jnp.sin(phi)))
    places = lambda e: (e.scene.material.friction_angle, e.scene.boundary[1].friction)  # noqa: E731
    return eqx.tree_at(places, e, (law, jnp.tan(phi)))


angle = {"friction angle": mpm.Bounded(update=rough, lower=5.0, upper=60.0, start=28.0, unit="degrees")}
found = {}
for grains, rows in runouts.items():
    print(grains)
    found[grains] = mpm.fitting.fit_refined(
        lambda n, rows=rows: [column(n, *row) for row in rows],
        angle,
        optimiser=mpm.fitting.LevenbergMarquardt(rtol=1e-3),  # the front is rough: other particles lead
        progress=print,
    )
    print(found[grains])

# %%
if not quick:
    figure, axis = plt.subplots(figsize=(5.5, 3.2), layout="constrained")
    for place, (grains, refined) in enumerate(found.items()):
        each = [fit["friction angle"] for fit in refined.fits] + [refined["friction angle"]]
        for k, estimate in enumerate(each):
            reach = np.abs(np.array(estimate.interval) - estimate.value)[:, None]
            axis.errorbar([place + 0.15 * (k - 1)], [estimate.value], reach, fmt="o", color=f"C{k}", capsize=4)
        low, high = REPOSE[grains]
        axis.fill_between([place - 0.3, place + 0.3], low - 0.2, high + 0.2, color="0.8")
    axis.set_xticks(range(len(found)), found)
    axis.set(ylabel="friction angle [degrees]", title=f"{CELLS}, {2 * CELLS} cells, extrapolated; grey: repose")
    figure.savefig("sand_fit.png", dpi=130)
sand, beads = (refined["friction angle"] for refined in found.values())
assert beads.value < sand.value
assert all(fit.converged for refined in found.values() for fit in refined.fits)
