"""What does the gradient of a rollout cost, in seconds and in bytes?

    python benchmarks/gradient_cost.py [--quick] [--peers] [--json]

Of the mean of ‖x‖² after some steps, by a factor of the stiffness, in float32:

- scene D: 100 explicit steps of a free 2-D block of 10 000 particles on 128² nodes, beside the tapes of Taichi and Warp
  (`--peers`), whose value and derivative must agree with ours before anything is timed;
- a semi-implicit rollout of the same block, 100 steps of twenty times the explicit limit, solver tolerance 1e-5;
- memory and seconds against the number of steps and the memory that is asked for: docs/gradient_cost.png and .csv.

Medians of interleaved calls, compilation left out; bytes are the compiled program's temporaries.
"""

import argparse
import csv
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt

import mpmjax as mpm

sys.path.append(str(Path(__file__).parent))
from throughput import E_MODULUS, GRAVITY, NU, QUICK, SCENES, Block, block, medians, peer

DOCS = Path(__file__).parents[1] / "docs"
TIMES_EXPLICIT = 20
ENOUGH = 2**28
"""Bytes in which the gradients of scene D take no step twice."""
LIMIT = 0.3
"""The explicit step of `block` over dx/c."""


def rollout(b: Block, method: mpm.Explicit | mpm.SemiImplicit, steps: int, dt: float) -> Callable[..., Any]:
    """The mean of ‖x‖² as a function of a factor of the stiffness, and of the memory for its derivative [B]."""
    one = jnp.ones(len(b.x), b.dtype)
    particles = mpm.Particles(jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype), b.mass * one, b.volume * one)
    grid = mpm.Grid((b.nodes,) * 2, b.spacing)

    def size(factor: Any, memory: int = ENOUGH) -> Any:
        scene = mpm.Scene(grid, mpm.NeoHookean(E_MODULUS * factor, NU), gravity=(0.0, -GRAVITY))
        run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=method, checkpoint_bytes=memory, throw=False)
        return (run.final.x**2).sum(axis=1).mean()

    return size


def compiled(f: Callable[..., Any]) -> tuple[Callable[[], Any], int]:
    """A call at the factor one, made once already, and the bytes of its temporaries."""
    program = jax.jit(f).lower(jnp.float32(1)).compile()

    def call() -> Any:
        return jax.block_until_ready(program(jnp.float32(1)))

    call()
    return call, program.memory_analysis().temp_size_in_bytes


def with_gradient(size: Callable[..., Any], memory: int = ENOUGH) -> Callable[..., Any]:
    """Value and gradient, of which what is stored of steps takes so many bytes."""
    return jax.value_and_grad(lambda factor: size(factor, memory))


def scene_d(b: Block, steps: int, repeats: int, peers: bool) -> dict[str, Any]:
    """Explicit steps, with all memory, and with as much as two and three loops take."""
    size = rollout(b, mpm.Explicit(), steps, b.dt)
    budgets = {f"gradient in {n} MB": n * 10**6 for n in (16, 11)}
    programs = {"forward": compiled(size), "gradient": compiled(with_gradient(size))}
    programs |= {name: compiled(with_gradient(size, n)) for name, n in budgets.items()}
    calls = {name: call for name, (call, _) in programs.items()}
    megabytes = {name: size / 1e6 for name, (_, size) in programs.items()}
    if peers:
        from peers.taichi_gradient import TaichiGradient
        from peers.warp_gradient import WarpGradient

        value, slope = (float(a) for a in calls["gradient"]())
        for name, kind in (("Taichi", TaichiGradient), ("Warp", WarpGradient)):
            tape = peer(b, partial(kind, steps=steps, dt=b.dt))
            other, other_slope = tape.gradient()
            if abs(other / value - 1) > 1e-5 or abs(other_slope / slope - 1) > 1e-2:
                raise SystemExit(f"{name} disagrees: {other} and {value}, derivative {other_slope} and {slope}.")
            calls |= {f"{name}, forward": tape.forward, f"{name}, tape": tape.gradient}
            megabytes[f"{name}, tape"] = tape.bytes() / 1e6
    return {"steps": steps, "seconds": medians(calls, repeats), "megabytes": megabytes}


def semi_implicit(b: Block, steps: int, repeats: int) -> dict[str, Any]:
    """At twenty times the explicit limit."""
    solver = mpm.implicit.ConjugateResidual(rtol=1e-5)
    size = rollout(b, mpm.SemiImplicit(solver=solver, adjoint_solver=solver), steps, TIMES_EXPLICIT / LIMIT * b.dt)
    programs = {"forward": compiled(size), "with gradient": compiled(with_gradient(size))}
    seconds = medians({name: call for name, (call, _) in programs.items()}, repeats)
    ratio = seconds["with gradient"] / seconds["forward"]
    megabytes = {name: size / 1e6 for name, (_, size) in programs.items()}
    return {"steps": steps, "seconds": seconds, "ratio": ratio, "megabytes": megabytes}


def budgets(b: Block, lengths: tuple[int, ...], repeats: int) -> list[dict[str, Any]]:
    """Seconds and memory of value and gradient against steps and the memory asked for."""
    rows = []
    for steps in lengths:
        size = rollout(b, mpm.Explicit(), steps, b.dt)
        forward = compiled(size)[0]
        for asked in (2, 5, 16, 256):
            call, memory = compiled(with_gradient(size, asked * 10**6))
            seconds = medians({"forward": forward, "gradient": call}, repeats)
            ratio = seconds["gradient"] / seconds["forward"]
            rows.append({"steps": steps, "asked": asked, "megabytes": memory / 1e6, "ratio": ratio})
    return rows


def draw(rows: list[dict[str, Any]]) -> None:
    """The chart and its numbers."""
    with (DOCS / "gradient_cost.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(row | {k: f"{row[k]:.4g}" for k in ("megabytes", "ratio")} for row in rows)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    for asked in sorted({row["asked"] for row in rows}):
        line = [row for row in rows if row["asked"] == asked]
        for axis, key in zip(axes, ("megabytes", "ratio"), strict=True):
            axis.plot([row["steps"] for row in line], [row[key] for row in line], "o-", ms=4, label=f"{asked} MB")
    for axis, label in zip(axes, ("temporaries [MB]", "seconds over those of the forward run"), strict=True):
        axis.set(xscale="log", xlabel="steps", ylabel=label)
    axes[0].set_yscale("log")
    axes[0].legend(title="asked for", frameon=False)
    figure.savefig(DOCS / "gradient_cost.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small block, few steps, no chart")
    parser.add_argument("--peers", action="store_true", help="the tapes of Taichi and Warp too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    b = block(*(QUICK["C 2k"] if options.quick else SCENES["C 10k"]), "float32")
    steps, repeats = (20, 3) if options.quick else (100, 5)
    report = {
        "jax": jax.__version__,
        "device": str(jax.devices()[0]),
        "particles": len(b.x),
        "explicit": scene_d(b, steps, repeats, options.peers),
        "semi_implicit": semi_implicit(b, steps, repeats),
    }
    if not options.quick:
        report["budgets"] = budgets(block(*QUICK["C 2k"], "float32"), (16, 64, 256, 1024), 3)
        draw(report["budgets"])
    if options.json:
        print(json.dumps(report))
        return
    for name in ("explicit", "semi_implicit"):
        found = report[name]
        for code, seconds in found["seconds"].items():
            memory = f", {found['megabytes'][code]:.1f} MB" if code in found["megabytes"] else ""
            print(f"{name}, {found['steps']} steps, {code}: {seconds:.4f} s{memory}")
    print(f"semi_implicit: value and gradient over forward {report['semi_implicit']['ratio']:.2f}")


if __name__ == "__main__":
    main()
