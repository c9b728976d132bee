"""The linearisation error of one linear solve a step, beside what it makes wrong.

    python benchmarks/linearisation.py            # the table, and docs/linearisation.png
    python benchmarks/linearisation.py --quick    # the longest steps alone, no picture

Each run is compared with Newton's method at the same step. Of a sheet of rubber that is pulled in two directions by 3 %
the error is that of the nominal stress at the end, of free motions and impacts that of the positions, over how far the
particles moved.
"""

import sys
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)
EDGE, STRETCH = 0.01, 1.03
NEWTON = {
    mpm.SemiImplicit: mpm.BackwardEuler(),
    mpm.ImplicitMidpoint: mpm.ImplicitMidpoint(solution=mpm.implicit.Newton()),
}


def sheet(nu: float) -> tuple[mpm.Scene, mpm.Particles]:
    """A cell of rubber that two of its faces pull."""
    grid = mpm.Grid((4, 4, 4), EDGE, origin=(-1, -1, -1))
    particles = mpm.fill(mpm.Box((0.0,) * 3, (EDGE,) * 3), grid, particles_per_cell=8, density=930.0)
    pull = EDGE * (STRETCH - 1)
    motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (pull, pull, 0.0)))
    faces = [mpm.Box(tuple(EDGE if a == axis else -1.0 for a in range(3)), (1.0,) * 3) for axis in range(2)]
    grips = [mpm.Grip(face, motion, tuple(a == axis for a in range(3))) for axis, face in enumerate(faces)]
    walls = (mpm.SlipBox((0.0,) * 3, (np.inf,) * 3), *grips)
    choices: dict[str, Any] = {"kernel": mpm.BSpline(1), "description": mpm.TotalLagrangian()}
    return mpm.Scene(grid, mpm.NeoHookean(1e6, nu), boundary=walls, **choices), particles


def block(motion: str) -> tuple[mpm.Scene, mpm.Particles]:
    """A square that is stretched as it starts, spins, or falls on a floor."""
    grid = mpm.Grid((24, 24), 0.1, origin=(-2, -2))
    particles = mpm.fill(mpm.Box((0.5, 0.5), (1.3, 1.3)), grid, particles_per_cell=4, density=1e3)
    x, y = (particles.x - 0.9).T
    v = {"stretched": (3 * x, -3 * y), "spinning": (-2 * y, 2 * x), "falling": (0 * x, -2 + 0 * y)}[motion]
    floor = (mpm.ContactPlane(1, 0.4),) if motion == "falling" else ()
    scene = mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), gravity=(0.0, 0.0), boundary=floor)
    return scene, eqx.tree_at(lambda q: q.v, particles, jnp.stack(v, axis=1))


def compare(
    name: str, scene: mpm.Scene, particles: mpm.Particles, t1: float, dt: float, method: Any
) -> tuple[float, float]:
    """The linearisation error, and the error against Newton's method, printed as a row."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run, exact = (mpm.simulate(scene, particles, t1=t1, dt=dt, method=m) for m in (method, NEWTON[type(method)]))
    if name.startswith("sheet"):
        one, other = (scene.material.stress(jnp.moveaxis(r.final.F, 0, -1))[0, 0].mean() for r in (run, exact))
        error = float(abs(one / other - 1))
    else:
        apart, moved = run.final.x - exact.final.x, exact.final.x - particles.x
        error = float(jnp.sqrt((apart**2).sum() / (moved**2).sum()))
    linearisation = float(run.statistics.linearisation_error)
    print(f"| {name} | `{type(method).__name__}` | {dt:.2g} | {linearisation:.1e} | {error:.1e} |", flush=True)
    return linearisation, error


def draw(series: dict[tuple[str, str], list[tuple[float, float]]]) -> None:
    """The error over the linearisation error, a line a motion and method, from long steps to short ones."""
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    names = list(dict.fromkeys(name for name, _ in series))
    for (name, method), points in series.items():
        style = "o-" if method == "SemiImplicit" else "s--"
        axes.loglog(*zip(*points, strict=True), style, color=f"C{names.index(name)}", label=f"{name}, {method}")
    ends = np.array([3e-4, 0.3])
    axes.loglog(ends, ends, "k:", lw=1, label="error = linearisation error")
    axes.axvline(0.05, color="k", lw=1, label="warning beyond")
    axes.set(xlabel="linearisation error, largest of any step [-]", ylabel="error against Newton's method [-]")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    figure.savefig(Path(__file__).parents[1] / "docs" / "linearisation.png", dpi=110)


def main(quick: bool) -> None:
    """Print the table, and draw it."""
    print("| motion | method | Δt [s] | linearisation error | error |\n|---|---|---|---|---|")
    series = {}
    for nu in (0.3, 0.49):
        name, case = f"sheet, ν = {nu}", sheet(nu)
        steps = (3,) if quick else (3, 10)
        series[name, "SemiImplicit"] = [compare(name, *case, 1.0, 1 / n, mpm.SemiImplicit()) for n in steps]
    for motion in ("stretched", "spinning", "falling"):
        for method in (mpm.SemiImplicit(), mpm.ImplicitMidpoint()):
            steps = (0.02,) if quick else (0.02, 0.005)
            points = [compare(motion, *block(motion), 0.2, dt, method) for dt in steps]
            series[motion, type(method).__name__] = points
    if not quick:
        draw(series)


if __name__ == "__main__":
    main("--quick" in sys.argv)
