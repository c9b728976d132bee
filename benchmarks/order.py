"""What does the order of particles in memory cost? Explicit steps of one state in several orders of its particles, in
turns.

    python benchmarks/order.py            # blocks of throughput.py, and dam breaks
    python benchmarks/order.py --quick

A block is in the order of `fill`, row by row, which is near that of the cells. A dam break has been in motion: a column
of water has run against the far wall of a tank and come back. By cell is the order that a counting sort makes, some
steps ago that of one so many steps before, and shuffled the worst that motion can make. Own order against these is what
sorting saves before its own cost, of which numpy's sort of the cells and the permutation of all the particles' arrays
are an estimate. Of dam breaks, runs of a hundred steps follow, as the package takes them, which sorts particles on the
way, and with MPMJAX_ORDER=given, which does not. Milliseconds are those of all threads together, on which other work on
the machine has less influence than on the clock.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from throughput import E_MODULUS, NU, block

import mpmjax as mpm

BLOCKS = {"A 100k": (3, 100_000, 64, 8), "C 100k": (2, 100_000, 256, 4), "A 1M": (3, 1_000_000, 128, 8)}
QUICK_BLOCKS = {"A 5k": (3, 5_000, 32, 8), "C 2k": (2, 2_000, 64, 4)}
DAMS = {"dam 3-D": (3, 74, 8), "dam 2-D": (2, 448, 4)}
QUICK_DAMS = {"dam 3-D": (3, 24, 8), "dam 2-D": (2, 64, 4)}
SECONDS = 1.5  # of a dam break: by then the front has been at the far wall and back
STEPS = 3  # that are timed
OWN = "own order"
AGE = 50  # steps since an older sort
RUN = 100  # steps of a run that is sorted on the way
WATER = mpm.Fluid(1e5)  # 20 ρ g h


def given(d: int, particles: int, nodes: int, per_cell: int) -> tuple[mpm.Scene, mpm.Particles, Any]:
    """A block as it is filled, with its step."""
    b = block(d, particles, nodes, per_cell, "float32")
    one = jnp.ones(len(b.x), b.dtype)
    state = mpm.Particles(jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype), b.mass * one, b.volume * one)
    scene = mpm.Scene(mpm.Grid((b.nodes,) * d, b.spacing), mpm.NeoHookean(E_MODULUS, NU), gradient=mpm.MLSGradient())
    return scene, mpm.prepare(scene, state), b.dt


def mixed(d: int, cells: int, per_cell: int) -> tuple[mpm.Scene, mpm.Particles, Any]:
    """A dam break after some time, with its step: a column half as high as the tank, which is so many cells long."""
    dx = np.float32(1 / cells)
    extent, column = ((1.0, 0.25, 1.0), (0.25, 0.25, 0.5)) if d == 3 else ((1.0, 1.0), (0.25, 0.5))
    grid = mpm.Grid(tuple(round(length * cells) + 7 for length in extent), dx, origin=(-3,) * d)
    tank = mpm.SlipBox((0.0,) * d, extent)
    scene = mpm.Scene(grid, WATER, gravity=(*[0.0] * (d - 1), -9.81), boundary=(tank,))
    water = mpm.fill(mpm.Box((0.0,) * d, column), grid, particles_per_cell=per_cell, density=1e3)
    steps = int(np.ceil(SECONDS / float(mpm.stable_dt(scene, water, safety=0.5))))
    return scene, mpm.rollout(scene, water, steps=steps, dt=SECONDS / steps), SECONDS / steps


def cells_of(scene: mpm.Scene, state: mpm.Particles) -> np.ndarray:
    """The number of each particle's cell, in the order of the nodes."""
    at = np.floor(np.asarray(state.x) / np.asarray(scene.grid.spacing)).astype("int32") - scene.grid.origin
    return np.ravel_multi_index(tuple(at.T), scene.grid.shape)


@jax.jit
def permuted(state: mpm.Particles, order: jax.Array) -> mpm.Particles:
    """The particles in another order."""
    return jax.tree.map(lambda each: each[order], state)


def codes(scene: mpm.Scene, state: mpm.Particles, dt: Any) -> dict[str, Callable[[], Any]]:
    """What is timed: steps of the state, some steps on, in each order; the sort, and the permutation."""
    step = jax.jit(lambda state: mpm.rollout(scene, state, steps=STEPS, dt=dt))
    older = np.argsort(cells_of(scene, state), kind="stable")
    state = mpm.rollout(scene, state, steps=AGE, dt=dt)
    cells = cells_of(scene, state)
    orders = {
        OWN: np.arange(len(cells)),
        "by cell": np.argsort(cells, kind="stable"),
        f"by cell {AGE} steps ago": older,
        "shuffled": np.random.default_rng(0).permutation(len(cells)),
    }
    states = {name: permuted(state, order) for name, order in orders.items()}
    ends = {name: np.asarray(step(one).x) for name, one in states.items()}  # compiles too
    for name, order in orders.items():
        assert np.abs(ends[OWN][order] - ends[name]).max() < 1e-5, "the order changes the motion"
    steps = {name: lambda one=one: step(one).x for name, one in states.items()}
    return steps | {
        "sort": lambda: np.argsort(cells, kind="stable"),
        "permutation": lambda: permuted(state, orders["by cell"]),
    }


def sorted_runs(scene: mpm.Scene, state: mpm.Particles, dt: Any, rounds: int) -> None:
    """Print what a step takes in runs that sort particles and in runs that do not, in turns."""
    programs = {}
    for name, asked in (("as given", "given"), ("sorted on the way", "")):
        os.environ["MPMJAX_ORDER"] = asked
        jax.clear_caches()  # which do not know of the variable
        programs[name] = jax.jit(lambda state: mpm.rollout(scene, state, steps=RUN, dt=dt)).lower(state).compile()
    ends = [np.asarray(program(state).x) for program in programs.values()]
    assert np.abs(ends[0] - ends[1]).max() < 1e-3 * np.abs(ends[0] - np.asarray(state.x)).max(), (
        "sorting moves particles"
    )
    seconds = {name: np.empty((rounds, 2)) for name in programs}
    for turn in range(rounds):
        for name, program in programs.items():
            began = time.process_time(), time.perf_counter()
            jax.block_until_ready(program(state))
            seconds[name][turn] = time.process_time() - began[0], time.perf_counter() - began[1]
    first = np.median(seconds["as given"], axis=0)
    for name, taken in seconds.items():
        threads, clock = median = np.median(taken, axis=0)
        ratios = " ".join(f"{ratio:.2f}" for ratio in median / first)
        print(f"    {name:22} {1e3 * threads / RUN:8.2f} {1e3 * clock / RUN:8.2f} by the clock   {ratios}", flush=True)


def main() -> None:
    """Print milliseconds, and ratios to a step in the order that the state has."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--scene", help="one scene alone")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each order")
    options = parser.parse_args()
    print(mpm.native.backend())
    scenes = {name: (given, numbers) for name, numbers in (QUICK_BLOCKS if options.quick else BLOCKS).items()}
    scenes |= {name: (mixed, numbers) for name, numbers in (QUICK_DAMS if options.quick else DAMS).items()}
    for name, (make, numbers) in scenes.items():
        if options.scene not in (None, name):
            continue
        scene, state, dt = make(*numbers)
        runs = codes(scene, state, dt)
        seconds = {what: np.empty(options.rounds) for what in runs}
        random = np.random.default_rng(0)
        for turn in range(options.rounds):
            for what in random.permutation(list(runs)):  # no order always follows the same one in the caches
                began = time.process_time()
                jax.block_until_ready(runs[what]())
                seconds[what][turn] = time.process_time() - began
        print(f"{name}, {state.count} particles: ms of all threads, medians and fastest; ratios to a step in own order")
        own = seconds[OWN] / STEPS
        for what, taken in seconds.items():
            each = taken / (1 if what in ("sort", "permutation") else STEPS)
            median, least = np.median(each), each.min()
            ratios = f"{median / np.median(own):.2f} {least / own.min():.2f}"
            print(f"    {what:22} {1e3 * median:8.2f} {1e3 * least:8.2f}   {ratios}", flush=True)
        if make is mixed:
            sorted_runs(scene, state, dt, options.rounds)


if __name__ == "__main__":
    main()
