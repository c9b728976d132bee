"""What do the derivatives of a fit cost, against the number of parameters?

    python benchmarks/fit_cost.py [--quick]

A free 2-D block of 900 particles, float32, its stiffness a parameter in each of n bands; 16 markers are followed. As
ratios to the simulation alone:

- misfit and gradient by reverse mode;
- residuals and Jacobian by forward mode, a tangent a parameter, all at once;
- residuals and Jacobian by reverse mode, a pass back a measured number, against their number in the place of n.

40 explicit steps, and 10 semi-implicit ones of twenty times the explicit limit, tolerance 1e-5. Medians of interleaved
calls, compilation left out; megabytes are the compiled program's temporaries. docs/fit_cost.png and .csv. The rule by
which `mpmjax.fit` chooses an optimiser and a mode follows from it (docs/fitting.md).
"""

import argparse
import csv
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import FixedLocator, NullLocator

import mpmjax as mpm
from mpmjax.fitting._problem import FitProblem

sys.path.append(str(Path(__file__).parent))
from throughput import E_MODULUS, NU, Block, block, medians

DOCS = Path(__file__).parents[1] / "docs"
TIMES_EXPLICIT, LIMIT = 20, 0.3
SOLVER = mpm.implicit.ConjugateResidual(rtol=1e-5)
METHODS = {
    "explicit": (mpm.Explicit(), 40, 1.0),
    "semi-implicit": (mpm.SemiImplicit(solver=SOLVER, adjoint_solver=SOLVER), 10, TIMES_EXPLICIT / LIMIT),
}
ALL = 2**40
"""Memory for tangents [B]: all at once."""
KINDS = {
    "gradient, reverse": "misfit and gradient, against parameters",
    "Jacobian, forward": "Jacobian by forward mode, against parameters",
    "Jacobian, reverse": "Jacobian by reverse mode, against measured numbers",
}


def problem(b: Block, method: str, bands: int, numbers: int) -> FitProblem:
    """A stiffness in each of so many bands, and so many measured numbers, at most 32 of the markers a frame."""
    integrator, steps, longer = METHODS[method]
    one = jnp.ones(len(b.x), b.dtype)
    q = mpm.Particles(jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype), b.mass * one, b.volume * one)
    scene = mpm.Scene(mpm.Grid((b.nodes,) * 2, b.spacing), mpm.NeoHookean(E_MODULUS, NU))
    dt = longer * b.dt
    markers = max(1, min(16, numbers // 2))
    frames = max(1, numbers // (2 * markers))
    which = np.linspace(0, len(b.x) - 1, markers).astype(int)
    times = np.linspace(0, steps * dt, frames + 1)[1:]
    still = np.broadcast_to(b.x[which], (frames, markers, 2))
    band = np.arange(len(b.x)) * bands // len(b.x)
    stiffness = mpm.Positive(
        update=lambda e, E: eqx.tree_at(lambda e: e.scene.material.youngs_modulus, e, E[band]),
        start=jnp.full(bands, E_MODULUS),
        prior=mpm.fitting.Gaussian(E_MODULUS, E_MODULUS),
    )
    seen = mpm.Tracks(times, still, which=which, sigma=b.spacing)
    experiment = mpm.Experiment(scene, q, t1=steps * dt, dt=dt, method=integrator, observations=seen)
    return FitProblem((experiment,), {"E": stiffness}, memory=ALL)


def compiled(f: Callable[..., Any], z: Any) -> tuple[Callable[[], Any], float]:
    """A call, made once already, and the megabytes of its temporaries."""
    program = jax.jit(f).lower(z).compile()

    def call() -> Any:
        return jax.block_until_ready(program(z))

    found = call()
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(found)), "A derivative is not finite."
    return call, program.memory_analysis().temp_size_in_bytes / 1e6


def measure(
    b: Block, method: str, count: int, repeats: int, simulation: Callable[[], Any], least: float
) -> list[dict[str, Any]]:
    """The three derivatives with so many parameters, or measured numbers, beside the simulation and its megabytes."""
    of = problem(b, method, count, 512)
    few = problem(b, method, 1, count)
    z, one = jnp.zeros(count, b.dtype), jnp.zeros(1, b.dtype)
    programs = {
        "gradient, reverse": compiled(lambda z: of.gradient(z), z),
        "Jacobian, forward": compiled(lambda z: of.jacobian(z, "forward"), z),
        "Jacobian, reverse": compiled(lambda z: few.jacobian(z, "reverse"), one),
    }
    seconds = medians({"simulation": simulation} | {kind: call for kind, (call, _) in programs.items()}, repeats)
    particles = len(b.x) * (2 * 2 + 1 + 1 + 2 * 4) * np.dtype(b.dtype).itemsize / 1e6
    return [
        {
            "method": method,
            "derivative": kind,
            "numbers": few.measured if kind == "Jacobian, reverse" else count,
            "ratio": seconds[kind] / seconds["simulation"],
            "megabytes": megabytes,
            "states": (megabytes - least) / particles,
        }
        for kind, (_, megabytes) in programs.items()
    ]


def draw(rows: list[dict[str, Any]]) -> None:
    """The chart and its numbers."""
    with (DOCS / "fit_cost.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(row | {k: f"{row[k]:.4g}" for k in ("ratio", "megabytes", "states")} for row in rows)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained", sharey=True)
    for axis, method in zip(axes, METHODS, strict=True):
        for kind, label in KINDS.items():
            line = [row for row in rows if row["method"] == method and row["derivative"] == kind]
            axis.plot([row["numbers"] for row in line], [row["ratio"] for row in line], "o-", ms=4, label=label)
        axis.set(xscale="log", yscale="log", xlabel="parameters, or measured numbers", title=method)
        for ticks, places in ((axis.xaxis, sorted({row["numbers"] for row in rows})), (axis.yaxis, (3, 5, 10, 20, 50))):
            ticks.set_major_locator(FixedLocator(places))
            ticks.set_minor_locator(NullLocator())
            ticks.set_major_formatter("{x:g}")
    axes[0].set_ylabel("seconds over those of the simulation")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False, fontsize=7)
    figure.savefig(DOCS / "fit_cost.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few parameters, no chart")
    options = parser.parse_args()
    b = block(2, 900, 48, 4, "float32")
    rows = []
    for method in METHODS:
        of = problem(b, method, 1, 512)
        alone = compiled(lambda z: of.residuals(z, diffrax.ForwardMode())[0], jnp.zeros(1, b.dtype))  # noqa: B023
        for count in (2, 8) if options.quick else (2, 8, 32):
            rows += measure(b, method, count, 3 if options.quick else 5, *alone)
            for row in rows[-3:]:
                print(
                    f"{row['method']}, {row['derivative']}, {row['numbers']}: {row['ratio']:.2f} simulations, "
                    f"{row['megabytes']:.1f} MB, {row['states']:.1f} sizes of the particles",
                    flush=True,
                )
    if not options.quick:
        draw(rows)


if __name__ == "__main__":
    main()
