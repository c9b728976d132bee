"""Does a column of water collapse as it was measured? The front against J. C. Martin and W. J. Moyce, 1952.

    python benchmarks/dam_break.py [--quick]

A column a wide and 2a high (a = 1.125 in) is let go on a dry plane, in two dimensions, float64, quadratic APIC,
explicit steps at half of the stability limit (`stable_dt(safety=0.5)`), K = 200 ρ g a. Z is the place of the foremost
particle, with half its width, over a, and T = t √(2g/a).

- resolution: 10, 20, 40 and 80 cells to a, inviscid, on a mirrored plane.
- stiffness: K ten times as large, without tension and with, at 20 cells.
- viscosity: η of water, 10 and 100 times that, at 40 cells.
- friction: a contact plane with Coulomb's μ of 0, 0.05 and 0.1, at 40 cells. (No grid here resolves the boundary
  layer of a plane on which water does not slip, √(νt) = 0.4 mm deep at the end.)

In the experiment the column stood behind a waxed diaphragm that a current ruptured, which takes a time that is not in
an instant's release: each run is shown as it is, and with one shift of the time origin, ΔT = 0.22, for all.

Prints how far the front is ahead of the measured one in per cent, at the measured T up to 3.6, and writes
docs/dam_break.csv and docs/dam_break.png. `--quick` runs 10 and 20 cells and writes nothing.
"""

import argparse
import csv
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

ROOT = Path(__file__).parents[1]
A, G, DENSITY, WATER = 0.028575, 9.81, 1e3, 1e-3  # a [m], g [m/s²], ρ [kg/m³], η [Pa s]
K = 200 * DENSITY * G * A
LAST, SHIFT = 3.6, 0.22
FLOOR = mpm.SymmetryPlane(1, 0.0)


def measured() -> np.ndarray:
    """T and Z up to the last T that is compared, shape (n, 2)."""
    table = np.loadtxt(ROOT / "examples/data/martin_moyce_1952_dam_break.csv", delimiter=",", skiprows=3)
    return table[table[:, 0] <= LAST]


def front(scene, particles) -> jax.Array:
    """Where the foremost particle ends [m]."""
    return particles.x[:, 0].max() + scene.grid.spacing / 4


def collapse(cells: int, law=None, floor=FLOOR) -> tuple[np.ndarray, np.ndarray, mpm.Run]:
    """T, Z and the run."""
    dx = A / cells
    grid = mpm.Grid((6 * cells + 7, int(2.2 * cells) + 7), dx, origin=(-3, -3))
    column = mpm.fill(mpm.Box((0.0, 0.0), (A, 2 * A)), grid, particles_per_cell=4, density=DENSITY)
    law = mpm.Fluid(K) if law is None else law
    scene = mpm.Scene(grid, law, gravity=(0.0, -G), boundary=(mpm.SymmetryPlane(0, 0.0), floor))
    end, frames = LAST / np.sqrt(2 * G / A), 72
    every = int(np.ceil(end / frames / float(mpm.stable_dt(scene, column, safety=0.5))))
    run = mpm.simulate(scene, column, t1=end, dt=end / (frames * every), save_every=every, observe=front)
    return np.asarray(run.times) * np.sqrt(2 * G / A), np.asarray(run.observed) / A, run


def ahead(T: np.ndarray, Z: np.ndarray, shift: float) -> np.ndarray:
    """By how much the front is further than measured [%], at each measured T; before it starts Z = 1."""
    data = measured()
    return 100 * (np.interp(data[:, 0] - shift, T, Z) / data[:, 1] - 1)


def cases(quick: bool) -> dict[str, tuple]:
    """Label to the arguments of `collapse`."""
    fine = 20 if quick else 40
    found = {f"{n} cells": (n,) for n in ((10, 20) if quick else (10, 20, 40, 80))}
    found["10 K"] = (20, mpm.Fluid(10 * K))
    found["tension"] = (20, mpm.Fluid(K, tension=True))
    for factor in (1, 10, 100):
        found[f"{factor} η"] = (fine, mpm.Viscous(mpm.Fluid(K), factor * WATER))
    for friction in (0.0, 0.05, 0.1):
        found[f"μ = {friction:g}"] = (fine, None, mpm.ContactPlane(1, 0.0, friction=friction))
    return found


def main(quick: bool) -> None:
    """Run all cases, print and write."""
    data, rows, curves = measured(), [], {}
    print("front ahead of the measured one [%] at T =", *data[:, 0], flush=True)
    for label, arguments in cases(quick).items():
        start = time.perf_counter()
        T, Z, run = collapse(*arguments)
        curves[label] = T, Z
        J = mpm.prepare(run.scene, run.final).F
        for shift in (0.0, SHIFT):
            percent = ahead(T, Z, shift)
            rows += [
                {"case": label, "shift": shift, "T": t, "measured": z, "ahead_percent": round(float(p), 2)}
                for (t, z), p in zip(data, percent, strict=True)
            ]
            print(f"{label:>12}  shift {shift:.2f}", *(f"{p:6.1f}" for p in percent), flush=True)
        print(
            f"{'':>12}  {run.final.count} particles, {int(run.final_step)} steps, {time.perf_counter() - start:.0f} s, "
            f"J {float(jnp.min(J)):.3f} to {float(jnp.max(J)):.3f}",
            flush=True,
        )
    if not quick:
        write(rows, curves)


def write(rows: list[dict], curves: dict) -> None:
    """docs/dam_break.csv and docs/dam_break.png."""
    with open(ROOT / "docs/dam_break.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.5), sharey=True, layout="constrained")
    panels = (
        ("resolution", [k for k in curves if k.endswith("cells")]),
        ("viscosity and friction, 40 cells", ["40 cells", "10 η", "100 η", "μ = 0.05", "μ = 0.1"]),
    )
    data = measured()
    for axis, (title, labels) in zip(axes, panels, strict=True):
        for i, label in enumerate(labels):
            T, Z = curves[label]
            axis.plot(T, Z, ":", color=f"C{i}", lw=1)
            axis.plot(T + SHIFT, Z, color=f"C{i}", label=label)
        axis.plot(*data.T, "ko", label="Martin and Moyce 1952")
        axis.set(title=title, xlabel="T = t √(2g/a)", xlim=(0, LAST), ylim=(0.9, 5))
        axis.legend(frameon=False)
    axes[0].set_ylabel(f"Z, front / a (dotted: as run, solid: ΔT = {SHIFT})")
    figure.savefig(ROOT / "docs/dam_break.png", dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    main(parser.parse_args().quick)
