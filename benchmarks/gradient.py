"""Claim: gradients of whole rollouts are right, and their error is what the solvers' tolerance allows (float64).

    python benchmarks/gradient.py            # ten minutes
    python benchmarks/gradient.py --quick    # fewer cases, no chart
    python benchmarks/gradient.py --json     # one JSON object

Prints the quick start's gradient; for every update, law, description and dimension the worst errors over twenty steps
(Taylor slope, dot product, central difference; the problems are those of `tests/derivatives.py`); what a gradient costs
in seconds and, in as little memory as is asked for, in bytes. Draws `docs/gradient_error.png`, the error of a gradient
against solver tolerance, with its numbers in `docs/gradient_error.csv`.
"""

import argparse
import csv
import itertools
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp

import mpmjax as mpm

sys.path.append(str(Path(__file__).parents[1] / "tests"))
jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[1] / "docs"


def quick_start(t1=0.5):
    """The README's scene and particles, and its height by stiffness, method, step and memory of reverse mode."""
    grid = mpm.Grid(shape=(48, 48), spacing=1 / 32)
    jelly = mpm.fill(mpm.Box((0.3, 0.5), (0.7, 0.9)), grid, particles_per_cell=4, density=1e3)
    walls = mpm.SlipBox((0.125, 0.125), (1.375, 1.375))
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -9.81), boundary=walls)

    def height(stiffness, method=mpm.SemiImplicit(), dt=5e-3, memory=2**28):
        softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
        run = mpm.simulate(softer, jelly, t1=t1, dt=dt, method=method, checkpoint_bytes=memory, throw=False)
        return run.final.x[:, 1].mean()

    return height


def readme_gradient() -> dict[str, float]:
    """At the default solver tolerance of 1e-8, and a central difference of 1 Pa."""
    height = jax.jit(quick_start())
    exact = float(jax.jit(jax.grad(quick_start()))(1e5))
    difference = float(height(1e5 + 1) - height(1e5 - 1)) / 2
    return {"gradient": exact, "central_difference": difference, "relative_error": abs(exact / difference - 1)}


def errors(quick: bool) -> list[dict]:
    """Worst errors of each update, law, description and dimension. Of the updates of second order one law for each
    description, of three dimensions only explicit steps, and half of them (the slow tests have the rest); --quick takes
    one dimension of half of all."""
    from derivatives import UPDATES, Case, difference_error, direction, parameters, taylor_slope, transpose_error
    from helpers import DESCRIPTIONS, LAWS, METHODS

    def measure(case: Case) -> dict:
        q = parameters(case)
        along = [direction(q, only=name) for name in (None, *q)]
        return {
            "case": str(case),
            "taylor_slope": taylor_slope(case, q, along[0]),
            "dot_product": max(transpose_error(case, q, t) for t in along),
            "central_difference": max(difference_error(case, q, t) for t in along),
        }

    cases: dict[str, list[Case]] = {update: [] for update in UPDATES}
    for (i, update), (j, law), (k, description) in itertools.product(
        enumerate(UPDATES), enumerate(LAWS), enumerate(DESCRIPTIONS)
    ):
        first = (i + j + k) % 2 == 0
        dims = (1,) if quick else (1, 2, 3) if update == "explicit" else (1, 2)
        if not first:
            dims = (1, 2) if update in METHODS and not quick else ()
        cases[update] += [Case(update, law, description, d) for d in dims]
    rows = []
    for group in cases.values():
        with ThreadPoolExecutor(2) as pool:  # the time is compilation, which runs beside Python
            rows += pool.map(measure, group)
        jax.clear_caches()  # compiled programs hold memory maps, of which a process may have 65530
    return rows


COSTED = {
    "explicit": (mpm.Explicit(), 2e-3),
    "semi_implicit": (mpm.SemiImplicit(), 5e-3),
    "backward_euler": (mpm.BackwardEuler(), 5e-3),
}


def best_of(f, *args, repeats=3) -> float:
    """Seconds of the fastest of a few calls, compiled before."""
    jax.block_until_ready(f(*args))
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(f(*args))
        seconds.append(time.perf_counter() - begun)
    return min(seconds)


def costs(quick: bool) -> list[dict]:
    """Seconds of the quick start's scene, 0.1 s of it, forward and with the gradient, and the latter's temporary memory
    by the memory that is asked for: half a megabyte (not with --quick), and enough for every step."""
    rows = []
    for update, (method, dt) in COSTED.items():
        t1 = 0.1
        steps = round(t1 / dt)
        height = quick_start(t1)

        def value(stiffness, memory=2**28, height=height, method=method, dt=dt):
            return height(stiffness, method, dt, memory)

        forward = best_of(jax.jit(value), 1e5)
        for memory in (2**28,) if quick else (2**19, 2**28):
            gradient = jax.jit(jax.value_and_grad(lambda s, memory=memory, value=value: value(s, memory)))
            compiled = gradient.lower(jnp.asarray(1e5)).compile()
            seconds = best_of(compiled, jnp.asarray(1e5))
            rows.append(
                {
                    "update": update,
                    "steps": steps,
                    "asked_bytes": memory,
                    "forward_seconds": forward,
                    "gradient_seconds": seconds,
                    "ratio": seconds / forward,
                    "temporary_bytes": compiled.memory_analysis().temp_size_in_bytes,
                }
            )
    return rows


def sweeps() -> list[dict]:
    """Gradient error against solver tolerance."""
    from derivatives import TOLERANCES, tolerance_sweep

    return [
        {"update": update, "tolerance_of": which, "rtol": rtol, "gradient_error": float(error)}
        for update in ("semi_implicit", "backward_euler")
        for which, found in tolerance_sweep(update).items()
        for rtol, error in zip(TOLERANCES, found, strict=True)
    ]


def draw(rows: list[dict]) -> None:
    """The chart and its numbers."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    with (DOCS / "gradient_error.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows({**row, "gradient_error": f"{row['gradient_error']:.3e}"} for row in rows)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), sharey=True, layout="constrained")
    labels = {"both": "both", "forward": "forward solve alone", "adjoint": "adjoint solve alone"}
    for axis, update, title in zip(
        axes, ("semi_implicit", "backward_euler"), ("SemiImplicit", "BackwardEuler"), strict=True
    ):
        for (which, label), marker in zip(labels.items(), "os^", strict=True):
            line = [row for row in rows if (row["update"], row["tolerance_of"]) == (update, which)]
            x, y = ([row[key] for row in line] for key in ("rtol", "gradient_error"))
            axis.loglog(x, y, marker=marker, markersize=4, linewidth=1, label=label)
        axis.loglog(x, x, color="0.7", linewidth=1, zorder=0, label="slope 1")
        axis.set(title=title, xlabel="relative tolerance (the other solve: 1e-14)")
    axes[0].set_ylabel("relative error of the gradient")
    axes[0].legend(frameon=False)
    figure.savefig(DOCS / "gradient_error.png", dpi=110)


def show(report: dict) -> None:
    """For people."""
    start = report["quick_start"]
    print(
        f"quick start: gradient {start['gradient']:.9e}, central difference {start['central_difference']:.9e} m/Pa, "
        f"relative difference {start['relative_error']:.1e}"
    )
    print(f"\n{'case':>44}  Taylor slope  dot product  central difference")
    for row in (*report["errors"], {"case": "worst"} | report["worst"]):
        print(
            f"{row['case']:>44}  {row['taylor_slope']:12.4f}  {row['dot_product']:11.1e}  "
            f"{row['central_difference']:18.1e}"
        )
    print(f"\n{'update':>15}  steps   asked [MB]  forward [s]  with gradient [s]  ratio  temporary [MB]")
    for row in report["costs"]:
        print(
            f"{row['update']:>15}  {row['steps']:5d}  {row['asked_bytes'] / 1e6:11.1f}  "
            f"{row['forward_seconds']:11.4f}  {row['gradient_seconds']:17.4f}  {row['ratio']:5.1f}  "
            f"{row['temporary_bytes'] / 1e6:14.2f}"
        )
    for row in report.get("tolerance", ()):
        if row["tolerance_of"] == "both":
            print(f"{row['update']:>15} at rtol {row['rtol']:.0e}: gradient error {row['gradient_error']:.1e}")
    print(f"{report['seconds']:.0f} s in all")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="fewer cases, no chart")
    options = parser.parse_args()
    begun = time.perf_counter()
    rows = errors(options.quick)
    report = {
        "quick_start": readme_gradient(),
        "errors": rows,
        "worst": {
            "taylor_slope": max((row["taylor_slope"] for row in rows), key=lambda slope: abs(slope - 2)),
            "dot_product": max(row["dot_product"] for row in rows),
            "central_difference": max(row["central_difference"] for row in rows),
        },
        "costs": costs(options.quick),
    }
    if not options.quick:
        report["tolerance"] = sweeps()
        draw(report["tolerance"])
    report["seconds"] = time.perf_counter() - begun
    print(json.dumps(report)) if options.json else show(report)


if __name__ == "__main__":
    main()
