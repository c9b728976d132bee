"""How long does a new process wait? Import, then the first `simulate` and the first gradient of the README's example.

    python benchmarks/cold_start.py [--json]

Each in fresh processes, medians of three: without a cache of compiled programs, and with JAX's persistent one
(`JAX_COMPILATION_CACHE_DIR`) filled by a former process.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile

QUICK_START = """
import time
begun = time.perf_counter()
import mpmjax as mpm
imported = time.perf_counter()
import equinox as eqx
import jax
jax.config.update("jax_enable_x64", True)
grid = mpm.Grid(shape=(48, 48), spacing=1 / 32)
jelly = mpm.fill(mpm.Box((0.3, 0.5), (0.7, 0.9)), grid, particles_per_cell=4, density=1e3)
walls = mpm.SlipBox((0.125, 0.125), (1.375, 1.375))
scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -9.81), boundary=walls)

def height(stiffness):
    softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
    return mpm.simulate(softer, jelly, t1=0.5, dt=5e-3, method=mpm.SemiImplicit()).final.x[:, 1].mean()

start = time.perf_counter()
height(1e5).block_until_ready()
simulated = time.perf_counter()
jax.grad(height)(1e5).block_until_ready()
done = time.perf_counter()
print(imported - begun, simulated - start, done - simulated)
"""
PARTS = "import", "simulate", "gradient"


def one(cache: str | None) -> list[float]:
    """Seconds of the parts in a new process."""
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    if cache:
        env |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    ran = subprocess.run([sys.executable, "-c", QUICK_START], env=env, capture_output=True, text=True, check=True)
    return [float(word) for word in ran.stdout.split()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    report = {}
    with tempfile.TemporaryDirectory() as folder:
        one(folder)
        for name, cache in (("no cache", None), ("compilation cache", folder)):
            columns = zip(*(one(cache) for _ in range(3)), strict=True)
            report[name] = dict(zip(PARTS, map(statistics.median, columns), strict=True))
    if options.json:
        print(json.dumps(report))
        return
    for name, seconds in report.items():
        shown = ", ".join(f"{part} {s:.2f} s" for part, s in seconds.items())
        print(f"{name}: {shown}; simulate and gradient {seconds['simulate'] + seconds['gradient']:.2f} s")


if __name__ == "__main__":
    main()
