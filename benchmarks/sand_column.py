"""A column of dry sand collapses: how far does it run and how high does it stay, against experiments and their laws?

    python benchmarks/sand_column.py            # writes docs/sand_column.png and docs/sand_column.csv
    python benchmarks/sand_column.py --quick    # coarse, writes nothing
    python benchmarks/sand_column.py --factors  # what the runout of a round column hangs on; writes nothing

Plane strain, half of a column of half-width L0 and height a L0 between a mirror plane and air, on a floor with the
sand's own friction. Density, gravity and L0 are one; the sand is at first without stress, with a Young's modulus of 100
ρ g a L0. Time is 2 √(2 a L0/g) + 2.5 √(L0/g), after which the deposit is at rest.

Friction: experiments tell Coulomb's angle φ. The law's angle is that of triaxial compression; where sand flows in plane
strain without change of volume the third principal stress is the mean of the others, so that q = M p is
(σ1 − σ3)/(σ1 + σ3) = M/√3 with M = 6 sin ψ/(3 − sin ψ) for the law's angle ψ. Each run has the ψ whose M/√3 is sin φ:
22.2 degrees for φ = 30. With ψ = 30 degrees plane strain sees φ = 44.

Rules: the front L∞ is the farthest particle that no empty column of cells parts from the deposit, and half a particle;
the height H∞ the highest particle within two cells of the axis, and half a particle; the slope is that of a line
through the highest particles of columns of cells between 20 and 80 % of the height. In the bulk are 99 % of the
mass: in a wedge it lies a tenth of its length behind the front.

Published, with r = (L∞ − L0)/L0 and h = H∞/L0, for columns in two dimensions:

- grains in a channel: r = 1.2 a for a < 1.8, 1.9 a^(2/3) for a > 2.8; h = a for a < 1.15, then a^0.4 (G. Lube,
  H. E. Huppert, R. S. J. Sparks, A. Freundt, Phys. Rev. E 72 (2005) 041301, doi 10.1103/PhysRevE.72.041301), repose
  29 to 31 degrees; and r = 1.2 a, then 1.9 a^(2/3) for a > 3; h = a, then a^(1/3) above 0.7 (E. Lajeunesse,
  J. B. Monnier, G. M. Homsy, Phys. Fluids 17 (2005) 103302, doi 10.1063/1.2087687), glass beads of repose 22 degrees;
- disks, computed: r = 2.5 a for a < 2, 3.25 a^0.7 above (L. Staron, E. J. Hinch, J. Fluid Mech. 545 (2005) 1, doi
  10.1017/S0022112005006415); 1.67 a for a < 2.3, 2.5 a^(2/3) above (K. Kumar, thesis, Cambridge 2015), φ = 22 degrees;
- aluminium rods: r = 3.25 a^0.96 for 0.65 < a < 1.5, 3.8 a^0.73 above; h = a for a < 0.65, then a^(1/3)/1.42
  ("Failure mechanism of true 2D granular flows", arXiv 1512.05180).

Read in the source itself: Kumar's and the rods' laws, Lajeunesse's angle (in Kumar) and transition at 0.7 (likewise).
The other numbers are quoted from memory of the papers, and so are only as good, as is that of round columns, r = 1.24 a
for a < 1.7 (G. Lube, H. E. Huppert, R. S. J. Sparks, M. A. Hallworth, J. Fluid Mech. 508 (2004) 175, doi
10.1017/S0022112004009036). The band for the runout is that of the grains and disks, r between 1.2 a or 1.9 a^(2/3) (the
lesser) and Staron's, for the height between the rods' and Lube's with 5 % at either end.

Further, at a = 1: what the grid, the stiffness, the transfer, the particles a cell and the law's angle change, and
where the energy goes. The height is settled at 8 cells; the runout is not at 32: 1.21, 1.34, 1.52 with 8, 16 and 32
cells, as the transfers' share of the energy falls and the toe thins; 16 particles a cell instead of 4 move the front
from 1.34 to 1.49 and the bulk by 0.01. A stiffer sand takes more and shorter steps, each with a transfer that
dissipates: 1.34, 1.29, 1.28 with E of 100, 300 and 1000. PIC stops the column at 0.41 and FLIP(0.999) never lets it
rest. In the budget `plastic` and `time_integration` are large and opposite: a step's strain is first stored and then
returned; what friction within the sand takes is their difference.
"""

import argparse
import csv
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[1] / "docs"
PHI = 30.0
STIFFNESS = 100.0


def in_plane_strain(phi: float) -> float:
    """The law's angle ψ with M/√3 = sin φ, both in radians."""
    sine = np.sin(phi)
    return float(np.arcsin(3 * np.sqrt(3) * sine / (6 + np.sqrt(3) * sine)))


def lube(a: Any) -> tuple[Any, Any]:
    """Runout and height of grains in a channel; the runout is the lesser of the two regimes'."""
    return np.minimum(1.2 * a, 1.9 * a ** (2 / 3)), np.where(a < 1.15, a, np.maximum(a, 1.0) ** 0.4)


def lajeunesse(a: Any) -> tuple[Any, Any]:
    """Runout and height of glass beads; the height continuous at the transition."""
    return np.minimum(1.2 * a, 1.9 * a ** (2 / 3)), np.minimum(a, a ** (1 / 3))


def staron(a: Any) -> Any:
    """Runout of disks."""
    return np.where(a < 2, 2.5 * a, 3.25 * a**0.7)


def kumar(a: Any) -> Any:
    """Runout of disks."""
    return np.where(a < 2.3, 1.67 * a, 2.5 * a ** (2 / 3))


def rods(a: Any) -> tuple[Any, Any]:
    """Runout and height of aluminium rods."""
    return np.where(a < 1.5, 3.25 * a**0.96, 3.8 * a**0.73), np.minimum(a, a ** (1 / 3) / 1.42)


class Dilating(mpm.DruckerPrager):
    """Sand that gains `dilatancy` in volume for each ‖Δe‖ it slides, and none that it has to lose again."""

    dilatancy: float = 0.1

    def flow(self, history: Any, mean: Any, deviation: Any, dt: Any) -> tuple[Any, Any, Any]:
        """To the cone of slope k at the volume that is left: ‖e‖ = −k (tr ε − b (‖e₀‖ − ‖e‖))."""
        ratio, held, gap = super().flow(history, mean, deviation, dt)
        sine, nu = jnp.sin(self.friction_angle), self.poisson_ratio
        slope = (2 / 3) ** 0.5 * 2 * sine / (3 - sine) * (1 + nu) / (1 - 2 * nu)
        slides = (ratio < 1) & (held < 0)
        slid = slope * (self.dilatancy * deviation - 3 * held) / (1 + slope * self.dilatancy)
        loosened = held - self.dilatancy * (deviation - slid) / 3
        return jnp.where(slides, slid / jnp.where(slides, deviation, 1), ratio), jnp.where(slides, loosened, held), gap


class Forgetful(mpm.DruckerPrager):
    """Sand that does not remember how far it came apart."""

    def flow(self, history: Any, mean: Any, deviation: Any, dt: Any) -> tuple[Any, Any, Any]:
        """Without a gap."""
        ratio, held, gap = super().flow(history, mean, deviation, dt)
        return ratio, held, jnp.zeros_like(gap)


def column(
    a: float,
    n: int,
    *,
    phi: float = PHI,
    psi: float | None = None,
    stiffness: float = STIFFNESS,
    transfer: Any = None,
    per_cell: int = 4,
    law: Any = mpm.DruckerPrager,
    floor: Any = None,
    axisymmetric: bool = False,
    kernel: Any = mpm.BSpline(2),
) -> tuple[mpm.Scene, mpm.Particles, float]:
    """Scene, particles and the time to run, with n cells to L0.

    Args:
        a: aspect ratio.
        n: cells to L0.
        phi: φ of sand and floor [degrees].
        psi: the law's angle [degrees]. Default: that of φ.
        stiffness: E in units of ρ g a L0.
        transfer: default APIC.
        per_cell: particles a cell.
        law: of E, ν and ψ.
        floor: default a contact plane with the sand's friction.
        axisymmetric: whether the column is round, of radius L0.
        kernel: default quadratic.
    """
    angle = np.deg2rad(phi)
    room = 1 + 1.2 * float(staron(a)) * (1.5 if phi < 25 else 1.0)
    grid = mpm.Grid((int(room * n) + 6, int(1.05 * a * n) + 8), 1 / n, origin=(-3, -3), axisymmetric=axisymmetric)
    floor = mpm.ContactPlane(1, 0.0, friction=np.tan(angle)) if floor is None else floor
    scene = mpm.Scene(
        grid,
        law(stiffness * a, 0.3, in_plane_strain(angle) if psi is None else np.deg2rad(psi)),
        gravity=(0.0, -1.0),
        boundary=(floor,) if axisymmetric else (mpm.SymmetryPlane(0, 0.0), floor),
        kernel=kernel,
        transfer=mpm.APIC() if transfer is None else transfer,
    )
    particles = mpm.fill(mpm.Box((0.0, 0.0), (1.0, a)), grid, particles_per_cell=per_cell, density=1.0)
    return scene, particles, 2 * np.sqrt(2 * a) + 2.5


def deposit(particles: mpm.Particles, n: int) -> dict[str, float]:
    """Front, bulk, height and slope by the rules above, and the root mean square of the speed."""
    x, half = np.asarray(particles.x), 0.25 / n
    order = np.argsort(x[:, 0])
    mass = np.asarray(particles.mass)[order]
    before = np.cumsum(mass) - mass
    cell = np.floor(x[:, 0] * n).astype(int)
    empty = np.setdiff1d(np.arange(cell.max() + 2), cell).min()
    top = np.array([x[cell == i, 1].max() + half for i in range(empty)])
    height = x[cell < 2, 1].max() + half
    face = (top > 0.2 * height) & (top < 0.8 * height)
    return {
        "runout": x[cell < empty, 0].max() + half - 1,
        "bulk": float(np.interp(0.99, before / before[-1], x[order, 0])) - 1,
        "height": height,
        "slope_deg": np.rad2deg(np.arctan(-np.polyfit(np.flatnonzero(face) / n, top[face], 1)[0])),
        "speed": float(np.sqrt((np.asarray(particles.v) ** 2).sum(axis=1).mean())),
        "gap": float(particles.history.gap.mean()),
    }


def collapse(case: str, a: float, n: int, **options: Any) -> dict[str, Any]:
    """One run, measured and printed. The step is that of the state at rest, held against the least on the way."""
    scene, particles, t1 = column(a, n, **options)
    limit = float(mpm.stable_dt(scene, particles))
    steps = int(np.ceil(t1 / limit))
    begun = time.perf_counter()
    run = mpm.simulate(scene, particles, t1=t1, dt=t1 / steps, observe=mpm.stable_dt, save_every=max(1, steps // 20))
    least = float(run.observed.min()) * steps / t1
    row = {"case": case, "a": a, "cells": n, "steps": steps, "seconds": time.perf_counter() - begun}
    row |= deposit(run.final, n) | {"least_dt_over_dt": least}
    print(
        f"{case}: a = {a:g}, {n} cells, {steps} steps, {row['seconds']:.1f} s with compilation; runout "
        f"{row['runout']:.3f} (bulk {row['bulk']:.3f}), height {row['height']:.3f}, slope {row['slope_deg']:.1f} "
        f"degrees, speed {row['speed']:.1e}, mean gap {row['gap']:.4f}; least stable step {least:.2f} of the one taken",
        flush=True,
    )
    return row


def factors() -> None:
    """Print how far a round column runs, by each choice, as rows of docs/notes/experiments.md."""
    holding = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))
    grids, middle = (8, 16, 32), (16,)
    cases: dict[str, tuple[tuple[int, ...], dict[str, Any]]] = {
        "ψ of plane strain": (grids, {}),
        "ψ = φ, triaxial compression": (grids, {"psi": PHI}),
        "a floor that holds (`StickyBox`)": (grids, {"floor": holding}),
        "friction of the floor tan 45°": (middle, {"floor": mpm.ContactPlane(1, 0.0, friction=1.0)}),
        "no rule for gaps": (middle, {"law": Forgetful}),
        "dilatancy 0.1": (middle, {"law": Dilating}),
        "E ten times as large": (middle, {"stiffness": 10 * STIFFNESS}),
        "16 particles a cell": (middle, {"per_cell": 16}),
        "`FLIP(0.99)`": (middle, {"transfer": mpm.FLIP(0.99)}),
        "linear kernel": (middle, {"kernel": mpm.BSpline(1)}),
        "a floor that holds, E = 30 ρ g h": (grids, {"floor": holding, "stiffness": 30.0}),
    }
    a = 0.7
    rows = []
    for name, (cells, options) in cases.items():
        runs = [collapse(name, a, n, axisymmetric=True, **options) for n in cells]
        rows.append([", ".join(f"{r[key]:.2f}" for r in runs) for key in ("runout", "bulk", "height")])
    print(f"measured: runout {1.24 * a:.2f}")
    for name, row in zip(cases, rows, strict=True):
        print(f"| {name} | {' | '.join(row)} |")


def account(a: float, n: int) -> None:
    """Where the energy of a run went, in shares of the potential energy that was lost."""
    scene, particles, t1 = column(a, n)
    steps = int(np.ceil(t1 / float(mpm.stable_dt(scene, particles))))
    _, budget = mpm.budget(scene, particles, steps=steps, dt=t1 / steps)
    energy = budget.energy
    fall = -float(energy.potential.sum())
    names = ("friction", "boundary", "time_integration", "plastic", "p2g", "g2p", "elastic", "kinetic")
    index_factors = {name: float(getattr(energy, name).sum()) / fall for name in names}
    closing = float(abs(energy.change - energy.explained).max()) / fall
    print(
        f"energy at a = {a:g}, {n} cells: {fall:.4f} ρ g L0³ of potential energy lost; in shares of it "
        + ", ".join(f"{name} {share:.3f}" for name, share in index_factors.items())
        + f"; each step closes to {closing:.0e}"
    )


def draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Runout, height and slope."""
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    a = np.geomspace(0.4, 7, 200)
    own = [r for r in rows if r["case"] == "aspect"]
    bands = ((left, lube(a)[0], staron(a)), (middle, rods(a)[1], lube(a)[1]))
    for axes, low, high in bands:
        axes.fill_between(a, low, high, color="0.9", label="band")
    left.plot(a, lube(a)[0], "k-", lw=1, label="Lube et al., Lajeunesse et al.")
    left.plot(a, kumar(a), "k--", lw=1, label="Kumar")
    left.plot(a, staron(a), "k:", lw=1, label="Staron, Hinch")
    middle.plot(a, lube(a)[1], "k-", lw=1, label="Lube et al.")
    middle.plot(a, lajeunesse(a)[1], "k--", lw=1, label="Lajeunesse et al.")
    middle.plot(a, rods(a)[1], "k:", lw=1, label="rods")
    left.plot([r["a"] for r in own], [r["runout"] for r in own], "o", color="tab:red", label="mpmjax")
    middle.plot([r["a"] for r in own], [r["height"] for r in own], "o", color="tab:red", label="mpmjax")
    left.set(xscale="log", yscale="log", xlabel="aspect ratio a", ylabel="(L∞ − L0)/L0", title="runout")
    middle.set(xscale="log", yscale="log", xlabel="aspect ratio a", ylabel="H∞/L0", title="height")
    piles = [r for r in rows if r["case"] == "repose"]
    right.plot([10, 45], [10, 45], "k-", lw=1, label="φ")
    right.plot([r["phi_deg"] for r in piles], [r["slope_deg"] for r in piles], "o", color="tab:red", label="mpmjax")
    right.set(xlabel="φ [degrees]", ylabel="final slope [degrees]", title="slope, a = 0.7")
    for axes in (left, middle):
        axes.set_xticks([0.5, 1, 2, 3, 4, 6], ["0.5", "1", "2", "3", "4", "6"])
        axes.set_xticks([], minor=True)
    for axes, ticks in ((left, (0.5, 1, 2, 5, 10)), (middle, (0.4, 0.6, 0.8, 1, 1.5, 2))):
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.set_yticks([], minor=True)
    for axes in (left, middle, right):
        axes.grid(alpha=0.3, which="both")
        axes.legend(fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    """Run all, print, and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, write nothing")
    parser.add_argument("--factors", action="store_true", help="what a round column's runout hangs on alone")
    options = parser.parse_args()
    if options.factors:
        factors()
        return
    n, ratios = (8, (1.0, 3.0)) if options.quick else (16, (0.5, 1.0, 2.0, 3.0, 4.0, 6.0))
    rows = [collapse("aspect", a, n) | {"phi_deg": PHI} for a in ratios]
    for r in rows:
        a = r["a"]
        low, high = float(lube(a)[0]), float(staron(a))
        short, tall = float(rods(a)[1]), float(lube(a)[1])
        print(
            f"   a = {a:g}: runout {r['runout']:.2f} in {low:.2f} to {high:.2f}: {low <= r['runout'] <= high}, "
            f"{r['runout'] / low:.2f} of the lower end; height {r['height']:.2f} in {short:.2f} to {tall:.2f}: "
            f"{0.95 * short <= r['height'] <= 1.05 * tall}"
        )
    rows += [collapse("repose", 0.7, n, phi=phi) | {"phi_deg": phi} for phi in (20.0, 30.0, 40.0)]
    account(1.0, n)
    if options.quick:
        return
    rows += [collapse("grid", 1.0, cells) for cells in (8, 16, 32)]
    rows += [collapse(f"stiffness {e:g}", 1.0, n, stiffness=e) for e in (100.0, 300.0, 1000.0)]
    transfers = {"FLIP(0.99)": mpm.FLIP(0.99), "FLIP(0.999)": mpm.FLIP(0.999), "PIC": mpm.PIC()}
    rows += [collapse(name, 1.0, n, transfer=transfer) for name, transfer in transfers.items()]
    rows += [collapse("16 a cell", 1.0, n, per_cell=16)]
    rows += [collapse("psi 30", 1.0, n, psi=30.0)]
    draw(DOCS / "sand_column.png", rows)
    with open(DOCS / "sand_column.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows([{k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows])
    print(f"written {DOCS / 'sand_column.png'}, {DOCS / 'sand_column.csv'}")


if __name__ == "__main__":
    main()
