"""What does an empty window cost? The same block in its window, and in windows of four times as many nodes, in turns.

    python benchmarks/windows.py            # scenes of throughput.py
    python benchmarks/windows.py --quick

A semi-implicit step is one of twenty times the block's own; what an iteration of it costs is told from steps cut off
after few and after more of them. A gradient is that of some explicit steps by all initial velocities. Medians are
compared as ratios, which would all be one if cost followed material alone; the ratio of the fastest is in brackets.
Times are those of all threads together, on which other work on the machine has less influence than on the clock.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from throughput import E_MODULUS, ITERATIONS, NU, Block, Ours, block, iterations

import mpmjax as mpm

SCENES = {"A 100k": (3, 100_000, 64, 8), "C 100k": (2, 100_000, 256, 4)}
QUICK = {"A 5k": (3, 5_000, 32, 8), "C 2k": (2, 2_000, 64, 4)}
WIDER = {"its own": (1, 1, 1), "2 x 2": (2, 2, 1), "4 x 1": (4, 1, 1), "1 x 4": (1, 4, 1)}
STEPS = {"explicit step": 40, "semi-implicit step": 12, "gradient, a step": 20}
"""Enough in a call that its first touch of memory, which windows share out too, does not matter."""


def gradient(b: Block, wider: tuple[int, ...]) -> Callable[[], tuple[np.ndarray, ...]]:
    """Value and gradient of the mean height after some steps."""
    d, one = b.x.shape[1], jnp.ones(len(b.x), b.dtype)
    grid = mpm.Grid(tuple(b.nodes * times for times in wider[:d]), b.spacing)
    scene = mpm.Scene(grid, mpm.NeoHookean(E_MODULUS, NU), gradient=mpm.MLSGradient())
    x, v = jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype)

    def height(v: jax.Array) -> jax.Array:
        particles = mpm.prepare(scene, mpm.Particles(x, v, b.mass * one, b.volume * one))
        return mpm.rollout(scene, particles, steps=STEPS["gradient, a step"], dt=b.dt).x[:, -1].mean()

    slope = jax.jit(jax.value_and_grad(height))
    return lambda: (np.asarray(slope(v)[1]),)


def tasks(b: Block, wider: tuple[int, ...]) -> dict[str, Callable[[], tuple[np.ndarray, ...]]]:
    """What is timed in a window so many times as wide along each axis."""
    few, more = iterations(b, wider=wider)
    updated, slow = mpm.UpdatedLagrangian(), b._replace(dt=20 * b.dt)
    return {
        "explicit step": Ours(b, updated, STEPS["explicit step"], wider=wider),
        "semi-implicit step": Ours(slow, updated, STEPS["semi-implicit step"], mpm.SemiImplicit(), wider=wider),
        "few": few,
        "more": more,
        "gradient, a step": gradient(b, wider),
    }


def told(seconds: dict[str, np.ndarray]) -> dict[str, Any]:
    """Milliseconds of each row, from the seconds of each task in each window and turn, (windows, turns)."""
    few, more = ITERATIONS
    rows = {what: 1e3 * seconds[what] / steps for what, steps in STEPS.items()}
    return rows | {"an iteration of it": 1e3 * (seconds["more"] - seconds["few"]) / (more - few)}


def main() -> None:
    """Print milliseconds and ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--scene", help="one scene alone")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each window")
    options = parser.parse_args()
    print(mpm.native.backend())
    for name, numbers in (QUICK if options.quick else SCENES).items():
        if options.scene not in (None, name):
            continue
        b = block(*numbers, "float32")
        windows = {window: tasks(b, wider) for window, wider in WIDER.items()}
        for what in windows["its own"]:
            own, *others = (go[what]()[0] for go in windows.values())
            assert all(np.abs(own - other).max() < 1e-4 for other in others), f"{what}: the window changes the motion"
        seconds = {what: np.empty((len(windows), options.rounds)) for what in windows["its own"]}
        for turn in range(options.rounds):
            for what, taken in seconds.items():
                for k, go in enumerate(windows.values()):
                    began = time.process_time()
                    go[what]()
                    taken[k, turn] = time.process_time() - began
        for what, ms in told(seconds).items():
            median, least = np.median(ms, axis=1), ms.min(axis=1)
            wide = zip(windows, median / median[0], least / least[0], strict=True)
            ratios = ", ".join(f"{window} {ratio:.2f} ({fast:.2f})" for window, ratio, fast in list(wide)[1:])
            print(f"{name:8} {what:20} {median[0]:8.2f} ms, {ratios}", flush=True)


if __name__ == "__main__":
    main()
