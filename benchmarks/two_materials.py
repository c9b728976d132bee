"""What is wrong where a soft and a stiff material meet on one grid, and what helps? Statics with exact solutions.

    python benchmarks/two_materials.py           # rows of docs/notes/figures.md
    python benchmarks/two_materials.py --quick   # on one grid

Two blocks of about a metre, of 1e4 and 1e7 Pa, stand one on the other under their own weight, so that every section
carries the weight above it, whatever the stiffness. The interface is on a node, a quarter or half a spacing above one;
particles are fitted to each block, two along a cell.

- column: one grid, one dimension, small strains, by the package's weights and gradients: the mean stress of either
  block and the settlement of the top, less the exact ones [%], on each grid; the largest error of stresses of particles
  within 1.5 spacings of the interface over the exact one, raw and as `analysis.smoothed` averages, on the finest.
- plane: scenes in plane strain, 8 cells a metre, ν = 0 between smooth walls or ν = 0.3 with free sides, by
  `BackwardEuler` and on by explicit steps: the means, and the largest error in the soft block's two rows beside the
  interface, by what may help.
- side by side: two columns under one plate, of equal strain: the force on it and the means.
"""

import itertools
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm
from mpmjax.discretisation import make_stencil

SOFT, STIFF, DENSITY = 1e4, 1e7, 1e3
GRAVITY = 0.01 * SOFT / DENSITY  # presses a metre of the soft material by half a percent
GRADIENTS = {"spline": mpm.SplineGradient(), "least squares": mpm.MLSGradient()}
KERNELS = (2, "spline"), (2, "least squares"), (3, "spline"), (3, "least squares"), (1, "spline")


CASES = (0.0, 0.0, 0), (0.5, 0.0, 0), (0.5, 0.0, 1000), (0.0, 0.3, 0), (0.5, 0.3, 0)
"""Place of the interface, ν and explicit steps."""


def lattice(start: float, end: float, dx: float) -> tuple[np.ndarray, np.ndarray]:
    """Middles and lengths of particles fitted between two ends, two a cell."""
    count = round(2 * (end - start) / dx)
    width = (end - start) / count
    return start + (np.arange(count) + 0.5) * width, np.full(count, width)


def column(cells: int, shift: float, order: int, gradient: str, *, soft_above: bool) -> np.ndarray:
    """Means of the upper and lower block, settlement, worst stress, raw and smoothed, with so many cells a metre."""
    dx = 1 / cells
    face = 1 + shift * dx
    (low, short), (high, long) = lattice(0, face, dx), lattice(face, 2, dx)
    x, volume = np.r_[low, high], np.r_[short, long]
    upper = x > face
    E = np.where(upper == soft_above, SOFT, STIFF)
    x, V, E = np.r_[-x[::-1], x], np.r_[volume[::-1], volume], np.r_[E[::-1], E]  # with its image below the floor
    half = 2 * cells + 6
    grid = mpm.Grid((2 * half + 1,), dx, origin=(-half,))

    def matrices(kernel: int, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        stencil = make_stencil(mpm.BSpline(kernel), GRADIENTS[gradient], grid, jnp.array([-half]), jnp.asarray(places))
        dense = np.zeros((2, len(places), grid.size))
        for values, matrix in zip((stencil.weight, stencil.gradient[:, 0]), dense, strict=True):
            for index, value in zip(np.asarray(stencil.index), np.asarray(values), strict=True):
                np.add.at(matrix, (np.arange(len(places)), index), value)
        return dense[0], dense[1]

    W, G = matrices(order, x[:, None])
    weight, there = -np.sign(x) * DENSITY * GRAVITY, W.sum(axis=0) > 1e-12
    u = np.zeros(grid.size)
    u[there] = np.linalg.lstsq((G.T * (V * E) @ G)[np.ix_(there, there)], (W.T @ (V * weight))[there], rcond=1e-13)[0]
    stress, exact = E * (G @ u), -DENSITY * GRAVITY * (2 - np.abs(x))

    def settled(top: float) -> float:
        below, above = (STIFF, SOFT) if soft_above else (SOFT, STIFF)
        force = [2 * y - y**2 / 2 for y in (face, top)]
        return -DENSITY * GRAVITY * (force[0] / below + (force[1] - force[0]) / above)

    mine = x > 0
    blocks = [(mine & (x > face)), (mine & (x < face))]
    means = [100 * ((stress * V)[b].sum() / (exact * V)[b].sum() - 1) for b in blocks]
    beside = mine & (np.abs(x - face) < 1.5 * dx)
    less = max(order - 1, 1)
    hats = matrices(less, x[:, None] + (dx / 2 if order > 1 else 0))[0]  # see analysis.smoothed
    filled = hats.T @ V
    smoothed = hats @ np.divide(hats.T @ (V * stress), filled, out=np.zeros(grid.size), where=filled > 0)
    worst = [np.abs(each / exact - 1)[beside].max() for each in (stress, smoothed)]
    return np.array([*means, 100 * ((W @ u)[-1] / settled(x[-1]) - 1), *worst])


def columns(cells: tuple[int, ...]) -> None:
    """The table of one grid."""
    for soft_above in (True, False):
        for (order, gradient), shift in itertools.product(KERNELS, (0.0, 0.25, 0.5)):
            errors = np.array([column(n, shift, order, gradient, soft_above=soft_above) for n in cells]).T
            percent = [", ".join(f"{e:.1f}" for e in row) for row in errors[:3]]
            name = f"{'soft' if soft_above else 'stiff'} above, order {order}, {gradient}, {shift}"
            print("|", " | ".join([name, *percent, *(f"{row[-1]:.2f}" for row in errors[3:])]), "|", flush=True)


def plane(cells: int, shift: float, *, ratio: float = 0.0, steps: int = 0, **choices) -> tuple[list[float], float]:
    """Means of the upper, soft and the lower block, and the worst stress of the former beside the interface."""
    dx = 1 / cells
    wide, face = 4 * dx, 1 + shift * dx
    grid = mpm.Grid((12, 2 * cells + 8), dx, origin=(-4, -4))
    boxes = mpm.Box((0.0, face), (wide, 2.0)), mpm.Box((0.0, 0.0), (wide, face))
    particles = mpm.join(*(mpm.fill(box, grid, density=DENSITY) for box in boxes))
    laws = tuple(mpm.FixedCorotated(E, ratio) for E in (SOFT, STIFF))
    walls = () if ratio else (mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, wide, "below"))
    scene = mpm.Scene(grid, laws, gravity=(0.0, -GRAVITY), boundary=(mpm.SymmetryPlane(1, 0.0), *walls), **choices)
    start = mpm.prepare(scene, particles)
    final = mpm.simulate(scene, start, t1=1e4, dt=2.5e3, method=mpm.BackwardEuler()).final
    if steps:
        final = replace(final, v=0 * final.v, C=0 * final.C)
        dt = float(mpm.stable_dt(scene, final))
        final = mpm.simulate(scene, final, t1=steps * dt, dt=dt).final
    stress, V = np.asarray(mpm.stress(scene, final))[:, 1, 1], np.asarray(final.volume)
    exact = -DENSITY * GRAVITY * (2 - np.asarray(start.x)[:, 1])
    groups = [group.rows for group in final.groups]
    means = [100 * ((stress * V)[g].sum() / (exact * V)[g].sum() - 1) for g in groups]
    beside = np.asarray(start.x)[groups[0], 1] < face + dx
    return means, float(np.abs(stress / exact - 1)[groups[0]][beside].max())


def beside(cells: int, **choices) -> tuple[float, ...]:
    """The force on a plate that presses a soft and a stiff column, and the mean stress of each, less the exact ones
    [%]."""
    dx, strain = 1 / cells, 1e-3
    grid = mpm.Grid((2 * cells + 8, 12), dx, origin=(-4, -4))
    boxes = mpm.Box((0.0, 0.0), (1.0, 4 * dx)), mpm.Box((1.0, 0.0), (2.0, 4 * dx))
    particles = mpm.join(*(mpm.fill(box, grid, density=DENSITY) for box in boxes))
    times = (0.0, 1e4)
    plate = mpm.SymmetryPlane(1, 4 * dx, "below", mpm.Motion(times, ((0.0, 0.0), (0.0, -strain * 4 * dx))))
    laws = tuple(mpm.FixedCorotated(E, 0.0) for E in (SOFT, STIFF))
    scene = mpm.Scene(grid, laws, boundary=(plate, mpm.SymmetryPlane(1, 0.0)), boundary_forces=True, **choices)
    run = mpm.simulate(scene, particles, t1=1e4, dt=5e3, method=mpm.BackwardEuler(), save_every=1)
    stress = np.asarray(mpm.stress(scene, run.final))[:, 1, 1]
    force = float(np.asarray(run.boundary_forces().force)[-1, 0, 1])
    groups = [group.rows for group in run.final.groups]
    means = [stress[g].mean() / (-strain * E) for g, E in zip(groups, (SOFT, STIFF), strict=True)]
    return tuple(100 * (a - 1) for a in (force / (strain * (SOFT + STIFF)), *means))


def main(quick: bool) -> None:
    """Print all tables."""
    jax.config.update("jax_enable_x64", True)
    cells = (8,) if quick else (8, 16, 32)
    columns(cells)
    total = mpm.TotalLagrangian()
    cases = {
        "updated (default)": {},
        "averaged volumes": {"volume": mpm.AveragedVolume()},
        "total, linear kernel": {"description": total, "kernel": mpm.BSpline(1)},
        "Bodies()": {"bodies": mpm.Bodies()},
        "Bodies(friction=1e3)": {"bodies": mpm.Bodies(friction=1e3)},
    }
    for name, choices in cases.items():
        for shift, ratio, steps in ((0.0, 0.0, 0), (0.5, 0.0, 0)) if quick else CASES:
            means, worst = plane(8, shift, ratio=ratio, steps=steps, **choices)
            row = f"{shift} | {ratio} | {steps} | {means[0]:+.1f}, {means[1]:+.1f} | {worst:.2f}"
            print(f"| plane, {name} | {row} |", flush=True)
    for name, choices in {"total, quadratic": {}, "total, linear": {"kernel": mpm.BSpline(1)}}.items():
        shown = ", ".join(f"{error:+.2f}" for error in beside(8, description=total, **choices))
        print(f"side by side, {name}: force, means [%] {shown}", flush=True)


if __name__ == "__main__":
    main("--quick" in sys.argv)
