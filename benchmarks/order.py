"""What does the order of particles in memory cost? Explicit steps of the same block, its particles row by row and
shuffled, in turns.

    python benchmarks/order.py            # scenes of throughput.py
    python benchmarks/order.py --quick

Row by row is the order of `fill`, near that of the cells; shuffled is the worst that motion can make of it. So their
ratio is the most that sorting could save, before its own cost.
"""

import argparse
import time

import numpy as np
from throughput import Ours, block

import mpmjax as mpm

SCENES = {"A 100k": (3, 100_000, 64, 8), "C 100k": (2, 100_000, 256, 4), "A 1M": (3, 1_000_000, 128, 8)}
QUICK = {"A 5k": (3, 5_000, 32, 8), "C 2k": (2, 2_000, 64, 4)}
STEPS = 3


def main() -> None:
    """Print milliseconds a step, of medians and of the fastest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each order")
    options = parser.parse_args()
    print(mpm.backend())
    for name, numbers in (QUICK if options.quick else SCENES).items():
        rows = block(*numbers, "float32")
        order = np.random.default_rng(0).permutation(len(rows.x))
        shuffled = rows._replace(x=rows.x[order], v=rows.v[order])
        runs = [Ours(b, mpm.UpdatedLagrangian(), STEPS) for b in (rows, shuffled)]
        (x, *_), (y, *_) = (run() for run in runs)  # compiles too
        assert np.abs(x[order] - y).max() < 1e-5, "the order changes the motion"
        seconds = np.empty((options.rounds, 2))
        for taken in seconds:
            for k, run in enumerate(runs):
                began = time.perf_counter()
                run()
                taken[k] = time.perf_counter() - began
        for what, (a, b) in (("median", np.median(seconds, axis=0)), ("fastest", seconds.min(axis=0))):
            ms = 1e3 / STEPS
            print(f"{name:8} {what:8} row by row {ms * a:8.2f} ms, shuffled {ms * b:8.2f} ms, ratio {b / a:.2f}")


if __name__ == "__main__":
    main()
