"""What FLIP keeps at plain walls and grips: the energy of a bar that vibrates, held at one end.

python benchmarks/flip_walls.py             # ten periods of 20 cells, docs/flip_walls.png
python benchmarks/flip_walls.py --quick     # two periods, no picture

A node that a wall holds has the wall's velocity before the step as well as after it, so that particles see no change of
it. *Before* is the way in which it has the velocity that the particles bring: each step they get the difference. The
energy is that averaged over the period before, within which that of explicit steps swings by 1.2 %.
"""

import sys
from pathlib import Path
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import mpmjax as mpm
from mpmjax.stepping._nodes import Nodes

CELLS, PERIOD, STEPS = 20, 4.0, 260  # the period [s] of a bar of length, density and modulus one, and its steps
WALLS = {
    "SlipBox": mpm.SlipBox((0.0,), (np.inf,)),
    "Grip": mpm.Grip(mpm.Box((-1.0,), (0.0,)), mpm.Motion((0.0,), ((0.0,),))),
    "SymmetryPlane": mpm.SymmetryPlane(0, 0.0),
}


def energy(wall: mpm.boundary.AbstractBoundary, periods: int) -> np.ndarray:
    """The energy of each step, averaged over the period before it, over that of the first period."""
    dx = 1 / CELLS
    grid = mpm.Grid((CELLS + 12,), dx, origin=(-4,))
    bar = mpm.fill(mpm.Box((0.0,), (1.0,)), grid, particles_per_cell=2, density=1.0)
    bar = mpm.Particles(bar.x, 0.01 * jnp.sin(np.pi / 2 * bar.x), bar.mass, bar.volume)
    scene = mpm.Scene(grid, mpm.FixedCorotated(1.0, 0.0), boundary=wall, transfer=mpm.FLIP(1.0))
    run = mpm.simulate(
        scene, bar, t1=periods * PERIOD, dt=PERIOD / STEPS, observe=lambda scene, bar: mpm.energy(scene, bar).total
    )
    mean = np.convolve(np.asarray(run.observed), np.full(STEPS, 1 / STEPS), "valid")
    return mean / mean[0]


def main(quick: bool) -> None:
    """Print what is lost, and draw the energy against time."""
    periods = 2 if quick else 10
    found = {name: energy(wall, periods) for name, wall in WALLS.items()}
    jax.clear_caches()
    with mock.patch.object(Nodes, "admitted_velocity", lambda nodes: nodes.velocity):
        found["SlipBox, before"] = energy(WALLS["SlipBox"], periods)
    figure = Figure(figsize=(6.5, 3.4), layout="constrained")
    axes = figure.subplots()
    styles = {"SlipBox": "C0-", "Grip": "C1:", "SymmetryPlane": "k--", "SlipBox, before": "C3-"}
    for name, share in found.items():
        print(f"{name:>16}: loses {100 * (1 - share[-1]):.2f} % of its energy in {periods} periods")
        time = 1 + np.arange(len(share)) / STEPS
        axes.plot(time, 100 * share, styles[name], lw=3 if name == "Grip" else 1.5, label=name)
    axes.set(xlabel="time [periods]", ylabel="energy, mean over a period [%]", title="a bar of 20 cells, FLIP(1)")
    axes.legend(frameon=False)
    if not quick:
        figure.savefig(Path(__file__).parents[1] / "docs" / "flip_walls.png", dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main("--quick" in sys.argv)
