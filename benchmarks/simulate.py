"""What does `simulate` cost beside the plain `rollout`, which checks and saves nothing? Explicit steps of the quick
start's block, in turns.

    python benchmarks/simulate.py
    python benchmarks/simulate.py --steps 1        # what a call costs, without the steps
    python benchmarks/simulate.py --float64
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

DT = 5e-4


def main() -> None:
    """Print milliseconds a run, of medians and of the fastest."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400, help="steps of a run")
    parser.add_argument("--rounds", type=int, default=40, help="turns of each")
    parser.add_argument("--float64", action="store_true", help="double precision")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.float64)
    grid = mpm.Grid((48, 48), 1 / 32)
    jelly = mpm.fill(mpm.Box((0.3, 0.5), (0.7, 0.9)), grid, particles_per_cell=4, density=1e3)
    walls = mpm.SlipBox((0.125, 0.125), (1.375, 1.375))
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -9.81), boundary=walls)
    particles = mpm.prepare(scene, jelly)

    def plain() -> jax.Array:
        return mpm.rollout(scene, particles, steps=options.steps, dt=DT).x

    def watched() -> jax.Array:
        return mpm.simulate(scene, particles, t1=options.steps * DT, dt=DT).final.x

    assert jnp.array_equal(plain(), watched())  # compiles too
    seconds = np.empty((options.rounds, 2))
    for taken in seconds:
        for k, run in enumerate((plain, watched)):
            began = time.perf_counter()
            jax.block_until_ready(run())
            taken[k] = time.perf_counter() - began
    print(f"{mpm.native.backend()}; {options.steps} steps of {particles.count} particles, {particles.x.dtype}")
    for what, (a, b) in (("median", np.median(seconds, axis=0)), ("fastest", seconds.min(axis=0))):
        print(f"{what:8} rollout {1e3 * a:7.2f} ms, simulate {1e3 * b:7.2f} ms, ratio {b / a:.2f}")


if __name__ == "__main__":
    main()
