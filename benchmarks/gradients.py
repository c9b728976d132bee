"""Which gradient operator, which kernel, which description? Errors of displacement and stress where surfaces do not
follow the grid.

    python benchmarks/gradients.py [--fine] [ring] [vortex] [disks] [column] [tube] [flat]

Prints rows of docs/accuracy.md, of all problems or of those named. `--fine` adds a grid of twice the resolution.

- ring: the expanding ring with free edges, filled by cells that the surface cuts; displacement over that of the inner
  edge, stress over that at it.
- vortex: A = 0.1, its edges held; displacement in metres, stress over that at the edges.
- disks: two of them, filled by cells that the surface cuts or fitted to it, collide and part. No motion is known, so
  what is left of the kinetic energy is shown, and the largest growth of the energy. In the total description bodies do
  not meet.
- column: Hencky's law under four times its stiffness, the free end 0.3 of a cell beyond a node.
- tube: thick-walled, under a pressure in its bore, at rest, against G. Lamé in plane strain, on 4, 8 (and 16) cells
  across its wall in the total description: a section of it as a body of revolution, or whole, filled by cells that its
  surfaces cut. Displacement over the largest, radial stress over the pressure, both RMS.
- flat: a bar that is bent, at rest, and a column under a small load whose end is off nodes, in the total description.
"""

import argparse
import itertools
import math
from collections.abc import Iterable, Iterator

import jax
import numpy as np

import mpmjax as mpm
from mpmjax.verification import (
    AbstractProblem,
    BentBar,
    Column,
    ExpandingRing,
    HenckyColumn,
    TwoDisks,
    Vortex,
    displacement_error,
    errors,
    orders,
    stress_error,
)

TOTAL, UPDATED = mpm.TotalLagrangian(), mpm.UpdatedLagrangian()
SPLINE, MLS = mpm.SplineGradient(), mpm.MLSGradient()
NAMES = {SPLINE: "spline", MLS: "moving least squares"}


def choices(kernels: tuple[int, ...] = (2, 3), finer: int = 4) -> Iterator[tuple[str, dict]]:
    """Each choice, with its name; those of the defaults, and the cubic spline in motion, again with more particles."""
    for description in (TOTAL, UPDATED):
        place = "total" if description is TOTAL else "updated"
        for order in kernels:
            for gradient in (SPLINE, MLS):
                name = f"{place}, {NAMES[gradient]}, {'quadratic' if order == 2 else 'cubic'}"
                yield name, {"description": description, "gradient": gradient, "kernel": mpm.BSpline(order)}
    for description, gradient, order in ((TOTAL, SPLINE, 2), (UPDATED, MLS, 2), (UPDATED, SPLINE, 3)) if finer else ():
        place = "total" if description is TOTAL else "updated"
        name = f"{place}, {NAMES[gradient]}, {'quadratic' if order == 2 else 'cubic'}, {finer} a side"
        yield name, {"description": description, "gradient": gradient, "kernel": mpm.BSpline(order), "per_side": finer}


def moving(
    title: str,
    problem: AbstractProblem,
    length: float,
    stress: float,
    cells: tuple[int, ...],
    each: Iterable[tuple[str, dict]],
) -> None:
    """Rows of a problem in motion."""
    for name, chosen in each:
        strained: list[float] = []

        def measure(problem, particles, run, strained=strained):
            strained.append(float(stress_error(problem, particles, run).max()) / stress)
            return displacement_error(problem, particles, run) / length

        row(
            f"{title}: {name}",
            errors(problem, cells, courant=0.3, measure=measure, **chosen),
            np.array(strained),
            cells,
        )


def row(name: str, displacement: np.ndarray, stress: np.ndarray, cells: tuple[int, ...]) -> None:
    """Errors and observed orders."""
    shown = [
        f"{', '.join(f'{e:.1e}' for e in field)} | {', '.join(f'{o:.1f}' for o in orders(field, cells))}"
        for field in (displacement, stress)
    ]
    print(f"| {name} | {' | '.join(shown)} |", flush=True)


def column(cells: tuple[int, ...]) -> None:
    """Rows of the column under four times its stiffness (accuracy.py has those of small loads)."""
    for name, chosen in choices(kernels=(2,)):
        e = np.array([HenckyColumn(4.0, 0.3).errors(n, **chosen) for n in cells])
        row(f"column: {name}", e[:, 0], e[:, 1], cells)


def tube(cells: int, *, cut: bool, **chosen) -> tuple[float, float]:
    """Errors of displacement and radial stress of a tube of radii 0.5 and 1 m."""
    a, b, pressure, nu, dx = 0.5, 1.0, 1.0, 0.3, 0.5 / cells
    if cut:
        centre = np.full(2, 0.13 * dx)
        body, planes = mpm.geometry.Annulus(tuple(centre), a, b), ()
        grid, bore = mpm.Grid((4 * cells + 10,) * 2, dx, origin=(-2 * cells - 4,) * 2), mpm.Ball(tuple(centre), 0.75)
    else:
        centre, end, body = np.zeros(2), 2 * dx, mpm.Box((a, 0.0), (b, 2 * dx))
        planes = mpm.SymmetryPlane(1, 0.0), mpm.SymmetryPlane(1, end, keep="below")
        grid = mpm.Grid((cells + 6, 8), dx, origin=(cells - 3, -3), axisymmetric=True)
        bore = mpm.Box((0.4, 0.0), (0.51, end))
    particles = mpm.fill(body, grid, particles_per_cell=4, density=1.0)
    scene = mpm.Scene(
        grid,
        mpm.FixedCorotated(1e5, nu),
        boundary=planes,
        description=TOTAL,
        loads=mpm.Pressure(mpm.Patch(body, bore), pressure, following=False),
        **chosen,
    )
    scene = mpm.attach(scene, particles)
    method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-10, max_steps=20_000))
    rest, _ = mpm.step(scene, mpm.prepare(scene, particles), 0.0, 1e3, method=method)
    X, moved, volume = np.asarray(particles.x) - centre, np.asarray(rest.x - particles.x), np.asarray(particles.volume)
    if not cut:
        X = X * (1.0, 0.0)
    r = np.sqrt((X**2).sum(axis=1))
    n, scale = X / r[:, None], pressure * a**2 / (b**2 - a**2)
    u = scale * 1.3 / 1e5 * ((1 - 2 * nu) * r + b**2 / r)
    radial = np.einsum("pa,pab,pb->p", n, np.asarray(mpm.stress(scene, rest))[:, :2, :2], n)
    wrong = (moved * n).sum(axis=1) / u.max() - u / u.max(), radial / pressure - scale * (1 - b**2 / r**2) / pressure
    displacement, stress = (float(np.sqrt(np.average(e**2, weights=volume))) for e in wrong)
    return displacement, stress


def tubes(cells: tuple[int, ...]) -> None:
    """Rows of the tube."""
    for cut, order, gradient in itertools.product((False, True), (2, 3), (SPLINE, MLS)):
        e = np.array([tube(n, cut=cut, kernel=mpm.BSpline(order), gradient=gradient) for n in cells])
        name = f"tube, {'cut' if cut else 'section'}: {NAMES[gradient]}, {'quadratic' if order == 2 else 'cubic'}"
        row(name, e[:, 0], e[:, 1], cells)


def flat(cells: tuple[int, ...]) -> None:
    """Rows of the bar that is bent and of the column whose end is off nodes, in the total description."""
    for order, gradient in itertools.product((2, 3), (SPLINE, MLS)):
        chosen = {"kernel": mpm.BSpline(order), "gradient": gradient}
        bar = np.array([BentBar().errors(n, mpm.ClampPlane(0, 0.0), **chosen) for n in cells])
        end = np.array([Column(shift=0.3).errors(n, description=TOTAL, **chosen) for n in cells])
        for name, e in (("bent bar", bar), ("column's end", end)):
            row(f"{name}: {NAMES[gradient]}, {'quadratic' if order == 2 else 'cubic'}", e[:, 0], e[:, 1], cells)


def disks(cells: tuple[int, ...]) -> None:
    """What is left of the kinetic energy when the disks have parted, and the largest growth of energy."""
    for fitted in (False, True):
        for gradient in (SPLINE, MLS):
            left, most = [], []
            for n in cells:
                scene, particles = TwoDisks().discretise(n, fitted=fitted, gradient=gradient)
                law = scene.material
                speed = math.sqrt((law.lame_lambda + 2 * law.shear_modulus) / 1e3)
                steps = math.ceil(3.0 * speed * n / 0.3 / 30) * 30
                run = mpm.simulate(scene, particles, t1=3.0, dt=3.0 / steps, save_every=steps // 30, observe=mpm.energy)
                kinetic, total = np.asarray(run.observed.kinetic), np.asarray(run.observed.total)
                left.append(kinetic[-1] / kinetic[0])
                most.append(total.max() / total[0] - 1)
            shown = ", ".join(f"{e:.4f}" for e in left), ", ".join(f"{e:.1e}" for e in most)
            print(
                f"| disks, {'fitted' if fitted else 'cut'}: updated, {NAMES[gradient]} | {' | '.join(shown)} |",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fine", action="store_true", help="a grid of twice the resolution besides")
    parser.add_argument("problems", nargs="*", help="ring, vortex, disks, column, tube, flat; default: all")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    unknown = set(given.problems) - {"ring", "vortex", "disks", "column", "tube", "flat"}
    if unknown:
        parser.error(f"no such problem: {', '.join(sorted(unknown))}")

    def grids(*cells: int) -> tuple[int, ...]:
        return (*cells, 2 * cells[-1]) if given.fine else cells

    for problem in given.problems or ("ring", "vortex", "disks", "column", "tube", "flat"):
        match problem:
            case "ring":
                moving("ring", ExpandingRing(), 0.1, 1e7 * 0.25, grids(20, 40), choices())
            case "vortex":
                moving("vortex", Vortex(0.1), 1.0, 1e3 / 2.6 * 0.7, grids(10, 20), choices((2,), 0))
            case "disks":
                disks(grids(20, 40))
            case "tube":
                tubes(grids(4, 8))
            case "flat":
                flat(grids(4, 8))
            case _:
                column(grids(16, 32))


if __name__ == "__main__":
    main()
