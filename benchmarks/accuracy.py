"""How accurate is which choice? Errors on problems with exact motions, under refinement in space and in time.

    python benchmarks/accuracy.py [--quick] [--pulse]
    python benchmarks/accuracy.py --column
    python benchmarks/accuracy.py --bent

Prints each series with its observed orders, and writes docs/accuracy.csv and docs/accuracy.png. `--quick` leaves out
the finest grids and writes nothing; `--pulse` measures the panel of the free end alone and
keeps the other rows. `--column` prints the table of a column under its own weight, by gradient operator,
`--bent` that of a bar held at one end, by what holds it.
"""

import argparse
import csv
import itertools
import math
import time
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import NullLocator

import mpmjax as mpm
from mpmjax.verification import (
    AbstractProblem,
    AxisAligned,
    BentBar,
    Column,
    Ends,
    StandingWave,
    Vortex,
    errors,
    orders,
)

DOCS = Path(__file__).parents[1] / "docs"
FLIP, SPLINE = mpm.FLIP(1.0), mpm.SplineGradient()
TOTAL, MLS = mpm.TotalLagrangian(), mpm.MLSGradient()


class Pulse(AbstractProblem):
    """A pulse A cos⁴(πX/w), w = 0.25 m, runs to the free end of a bar of 1 m and half its length back: u = f(X − ct) +
    f(2 − X − ct) by d'Alembert, exact since P = E (F − 1) in one dimension with ν = 0. It is 0.091 m wide at half its
    height; its RMS over the bar is 1e-4 m."""

    forced: ClassVar[bool] = False
    material: Any = mpm.FixedCorotated(1e4, 0.0)
    density: float = 1e3
    dim: int = 1

    @property
    def duration(self) -> float:
        """The time of one metre [s]."""
        return 1 / self.wave_speed

    def position(self, X: Any, t: Any) -> Any:
        """The two waves; the pulse starts in the middle."""
        width, way = 0.25, self.wave_speed * t
        place = jnp.clip(jnp.stack([X - 0.5 - way, 1.5 - X - way]) / width, -0.5, 0.5)
        return X + 1e-4 / math.sqrt(35 / 128 * width) * (jnp.cos(jnp.pi * place) ** 4).sum(axis=0)

    def box(self) -> tuple[tuple[float, ...], tuple[float, ...], Ends]:
        """One metre."""
        return (0.0,), (1.0,), Ends.MIRRORED

    def boundary(self) -> tuple[mpm.SymmetryPlane]:
        """The other end is held."""
        return (mpm.SymmetryPlane(0, 0.0),)


class Series(NamedTuple):
    """One line of a panel."""

    panel: str
    name: str
    x: np.ndarray
    error: np.ndarray
    seconds: float
    """Of the finest run, compilation left out."""


PANELS = {
    "kernels and transfers": ("cells", "axis-aligned, A = 0.05, 2-D"),
    "walls": ("cells", "the same between walls"),
    "quadrature": ("cells", "vortex, A = 0.3"),
    "dissipation": ("Δt c/dx", "axis-aligned, 16 cells"),
    "free end": ("cells", "pulse of RMS 1e-4 m, 1-D"),
    "time": ("Δt c/dx", "standing wave, 32 cells, FLIP(1)"),
}


def refined(panel, name, problem, cells, courant, staggered=False, **choices) -> Series:
    """A series over grids."""
    e = errors(problem, cells, courant=courant, staggered=staggered, **choices)
    begun = time.perf_counter()
    errors(problem, cells[-1:], courant=courant, staggered=staggered, **choices)
    return Series(panel, name, np.array(cells), e, time.perf_counter() - begun)


def over_steps(panel, name, problem, cells, numbers, **choices) -> Series:
    """A series over Δt c/dx on one grid."""
    e = np.array([errors(problem, (cells,), courant=c, **choices)[0] for c in numbers])
    begun = time.perf_counter()
    errors(problem, (cells,), courant=numbers[-1], **choices)
    return Series(panel, name, np.array(numbers), e, time.perf_counter() - begun)


def free_end(quick: bool):
    """The series of a pulse at a free end."""
    cells = (32, 64) if quick else (32, 64, 128)
    for name, choices in {
        "default, Δt = 0.5 dx/c": {},
        "default, Δt = 0.95 dx/c": {"courant": 0.95},
        "total, cubic, 0.5": {"description": TOTAL, "kernel": mpm.BSpline(3), "gradient": MLS},
        "total, linear, 0.95": {"description": TOTAL, "kernel": mpm.BSpline(1), "courant": 0.95},
        "total, linear, 0.5": {"description": TOTAL, "kernel": mpm.BSpline(1)},
        "FLIP(1), 0.5": {"transfer": FLIP},
        "implicit midpoint, 1": {"method": mpm.ImplicitMidpoint(), "courant": 1.0},
    }.items():
        yield refined("free end", name, Pulse(), cells, staggered=None, **({"courant": 0.5} | choices))


def measure(quick: bool):
    """All series, one after the other."""
    cells, rings = ((8, 16), (10, 20)) if quick else ((8, 16, 32), (10, 20, 40))
    numbers = (0.4, 0.1) if quick else (0.4, 0.2, 0.1, 0.05, 0.025)
    for name, choices in {
        "quadratic APIC": {},
        "quadratic APIC, spline gradient": {"gradient": SPLINE},
        "quadratic APIC, total": {"description": TOTAL, "gradient": MLS},
        "cubic APIC": {"kernel": mpm.BSpline(3)},
        "quadratic FLIP(1)": {"transfer": FLIP},
        "quadratic PIC": {"transfer": mpm.PIC()},
        "linear FLIP(1)": {"kernel": mpm.BSpline(1), "transfer": FLIP},
    }.items():
        yield refined("kernels and transfers", name, AxisAligned(0.05), cells, 0.3, **choices)
    for name, ends in {"none (periodic)": Ends.PERIODIC, "mirrored": Ends.MIRRORED, "plain": Ends.PLAIN}.items():
        yield refined("walls", name, AxisAligned(0.05, ends=ends), cells, 0.3)
    for name, choices in {
        "updated, 2 x 2 a cell": {},
        "updated, 4 x 4 a cell": {"per_side": 4},
        "total, 2 x 2 a cell": {"description": TOTAL, "gradient": MLS},
    }.items():
        yield refined("quadrature", name, Vortex(0.3), rings, 0.5, **choices)
    for name, transfer in {"PIC": mpm.PIC(), "APIC": mpm.APIC(), "FLIP(1)": FLIP}.items():
        yield over_steps("dissipation", name, AxisAligned(0.05), 16, numbers, transfer=transfer)
    yield from free_end(quick)
    for name, method in {
        "explicit": mpm.Explicit(),
        "semi-implicit, β = 1/2": mpm.SemiImplicit(beta=0.5),
        "semi-implicit, β = 1": mpm.SemiImplicit(),
        "backward Euler": mpm.BackwardEuler(),
        "implicit midpoint": mpm.ImplicitMidpoint(),
        "TR-BDF2": mpm.TRBDF2(),
    }.items():
        longer = numbers if name == "explicit" else (6.4, 1.6, *numbers)
        yield over_steps("time", name, StandingWave(0.05), 32, longer, method=method, transfer=FLIP)


def column(quick: bool) -> None:
    """Print errors and orders of displacement and stress, as rows of docs/accuracy.md."""
    cells = (8, 16) if quick else (16, 32, 64)
    for load, order, description, gradient, shift in itertools.product(
        (0.04,) if quick else (0.04, 0.49), (2, 3), (TOTAL, mpm.UpdatedLagrangian()), (SPLINE, MLS), (0.0, 0.3)
    ):
        choices = {"kernel": mpm.BSpline(order), "description": description, "gradient": gradient}
        e = np.array([Column(load, shift).errors(n, **choices) for n in cells])
        name = f"{type(description).__name__}, {type(gradient).__name__}, order {order}, load {load}, shift {shift}"
        print_orders(name, e, cells)


def bent(quick: bool) -> None:
    """Print errors and orders of displacement and stress of a bar that is bent, as rows of docs/accuracy.md."""
    cells = (2, 4) if quick else (2, 4, 8, 16)
    grip = mpm.Grip(mpm.Box((-9.0, -9.0), (0.0, 9.0)), mpm.Motion((0.0,), ((0.0, 0.0),)))
    for order, held in itertools.product((2, 3), (grip, mpm.ClampPlane(0, 0.0))):
        print_orders(
            f"{type(held).__name__}, order {order}",
            np.array([BentBar().errors(n, held, kernel=mpm.BSpline(order)) for n in cells]),
            cells,
        )


def print_orders(name: str, e: np.ndarray, cells: tuple[int, ...]) -> None:
    """Print errors of displacement and stress, shape (g, 2), and their orders."""
    shown = [
        f"{', '.join(f'{x:.1e}' for x in field)} | {', '.join(f'{o:.1f}' for o in orders(field, cells))}"
        for field in e.T
    ]
    print(f"| {name} | {' | '.join(shown)} |", flush=True)


def kept() -> list[Series]:
    """The series of docs/accuracy.csv but for those of the free end."""
    with (DOCS / "accuracy.csv").open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["panel"] != "free end"]
    lines = [list(line) for _, line in itertools.groupby(rows, key=lambda row: (row["panel"], row["series"]))]
    return [
        Series(
            line[0]["panel"],
            line[0]["series"],
            np.array([float(row["x"]) for row in line]),
            np.array([float(row["error_m"]) for row in line]),
            float(line[0]["seconds_of_finest"]),
        )
        for line in lines
    ]


def draw(series: list[Series]) -> None:
    """One panel a question."""
    figure, axes = plt.subplots(1, len(PANELS), figsize=(4 * len(PANELS), 5.5), constrained_layout=True)
    for axis, (panel, (label, problem)) in zip(axes, PANELS.items(), strict=True):
        for s in series:
            if s.panel == panel:
                name = f"{s.name} ({s.seconds:.2g} s)" if panel == "quadrature" else s.name
                axis.loglog(s.x, s.error, "o-", label=name)
        axis.set(title=f"{panel}\n{problem}", xlabel=label, ylabel="largest RMS displacement error [m]")
        axis.set_xticks(sorted({x for s in series if s.panel == panel for x in s.x}))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_locator(NullLocator())
        axis.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.15), frameon=False)
        axis.grid(visible=True, which="both", alpha=0.2)
    figure.savefig(DOCS / "accuracy.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave out the finest grids, write nothing")
    parser.add_argument("--column", action="store_true", help="the table of a column under its own weight alone")
    parser.add_argument("--bent", action="store_true", help="the table of a bar that is bent alone")
    parser.add_argument("--pulse", action="store_true", help="the panel of a pulse at a free end alone")
    given = parser.parse_args()
    quick = given.quick
    jax.config.update("jax_enable_x64", True)
    if given.column or given.bent:
        column(quick) if given.column else bent(quick)
        return
    series = kept() if given.pulse else []
    for s in free_end(quick) if given.pulse else measure(quick):
        slope = np.log(s.error[1:] / s.error[:-1]) / np.log(s.x[1:] / s.x[:-1])
        order = slope if PANELS[s.panel][0] != "cells" else -slope
        figures = " ".join(f"{e:.2e}" for e in s.error)
        shown = " ".join(f"{o:5.2f}" for o in order)
        print(f"{s.panel:>22}, {s.name:>32}: {figures}, order {shown}, {s.seconds:.2g} s", flush=True)
        series.append(s)
    if quick:
        return
    with (DOCS / "accuracy.csv").open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["panel", "series", "x", "error_m", "seconds_of_finest"])
        rows.writerows(
            [s.panel, s.name, f"{x:g}", f"{e:.6e}", f"{s.seconds:.3g}"]
            for s in series
            for x, e in zip(s.x, s.error, strict=True)
        )
    draw(series)


if __name__ == "__main__":
    main()
