"""How well is a round body filled? Volumes of disks and balls, and a picture of the particles.

    python benchmarks/filling.py

Prints the relative error of the volume, 2 particles to the side of a cell, for whole cells (those whose centres are
inside), for `fill`, and for `fill(fitted=True)`: the largest over eight places of the body in a cell, as rows of
docs/accuracy.md. Writes docs/filling.png.
"""

from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm
from mpmjax.geometry import box_cells

DOCS = Path(__file__).parents[1] / "docs"


def whole(ball: mpm.Ball, grid: mpm.Grid) -> tuple[np.ndarray, np.ndarray]:
    """The cells of the grid's lattice whose centres are inside."""
    cell, (lower, upper) = float(grid.spacing) / 2, ball.bounds()
    centres, volume = box_cells(np.floor(lower / cell) * cell, np.ceil(upper / cell) * cell, np.full(len(lower), cell))
    inside = np.asarray(ball.contains(jax.numpy.asarray(centres)))
    return centres[inside], volume[inside]


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    for d, exact in ((2, np.pi / 4), (3, np.pi / 6)):
        for cells in (5, 10, 20, 40):
            grid, worst = mpm.Grid((9,) * d, 1 / cells), np.zeros(3)
            for centre in rng.uniform(0, 1 / cells, (8, d)):
                ball = mpm.Ball(tuple(centre), 0.5)
                volumes = [whole(ball, grid)[1].sum(), float(mpm.fill(ball, grid, density=1.0).volume.sum())]
                volumes.append(float(mpm.fill(ball, grid, density=1.0, fitted=True).volume.sum()) if d == 2 else np.nan)
                worst = np.maximum(worst, np.abs(np.array(volumes) / exact - 1))
            print(f"| {d} | {cells} | {' | '.join(f'{e:.1e}' for e in worst)} |", flush=True)
    grid, ring = mpm.Grid((9, 9), 0.1), mpm.geometry.Annulus((0.0, 0.0), 0.4, 0.6)
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.6), constrained_layout=True)
    for axis, fitted in zip(axes, (False, True), strict=True):
        q = mpm.fill(ring, grid, density=1.0, fitted=fitted)
        axis.scatter(*np.asarray(q.x).T, s=np.asarray(q.volume) * 2.4e4, c="tab:blue", alpha=0.6, linewidths=0)
        for radius in (0.4, 0.6):
            axis.add_patch(plt.Circle((0, 0), radius, fill=False, color="black", lw=0.8))
        axis.set(aspect="equal", xticks=np.arange(-0.6, 0.7, 0.1), yticks=np.arange(-0.6, 0.7, 0.1))
        axis.set(
            title=f"fill({'fitted=True' if fitted else ''}): {q.count} particles",
            xlim=(-0.05, 0.65),
            ylim=(-0.05, 0.65),
        )
        axis.grid(visible=True, alpha=0.3)
    figure.savefig(DOCS / "filling.png", dpi=100)


if __name__ == "__main__":
    main()
