"""What do the native sums save? Scenes of `throughput.py`, and gradients, with them and without, in turns.

    python benchmarks/native.py            # needs the native library: mpmjax info
    python benchmarks/native.py --quick

Each back end has a process of its own, for a program keeps the one that it was compiled with; the processes take turns,
and medians are compared as ratios. The states after some steps must agree to rounding before anything is timed. The
rest is that of a semi-implicit step without its iterations. `resist` is a gather, a matrix for each particle and a
scatter in one call, and in parts they are three, each called 20 times; an iteration is one of them and vectors over the
grid. A gradient is that of 20 steps by all initial velocities.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

SCENES = {"A 100k": (3, 100_000, 64, 8), "C 10k": (2, 10_000, 128, 4), "C 100k": (2, 100_000, 256, 4)}
QUICK = {"A 5k": (3, 5_000, 32, 8), "C 2k": (2, 2_000, 64, 4)}
TASKS = ("step", "iteration", "rest", "resist", "in parts", "gradient")
MEASURED = ("step", "few", "more", "resist", "in parts", "gradient")
STEPS = 20


def tasks(numbers: tuple[int, int, int, int], dtype: str) -> dict:
    """What is timed, each with the steps or iterations that its seconds are divided by."""
    import jax
    import jax.numpy as jnp
    from throughput import E_MODULUS, NU, Ours, block, iterations

    import mpmjax as mpm

    b = block(*numbers, dtype)
    d = b.x.shape[1]
    scene = mpm.Scene(mpm.Grid((b.nodes,) * d, b.spacing), mpm.NeoHookean(E_MODULUS, NU), gradient=mpm.MLSGradient())
    one = jnp.ones(len(b.x), dtype)
    x, v = jnp.asarray(b.x, dtype), jnp.asarray(b.v, dtype)

    def height(v: jax.Array) -> jax.Array:
        particles = mpm.prepare(scene, mpm.Particles(x, v, b.mass * one, b.volume * one))
        return mpm.rollout(scene, particles, steps=STEPS, dt=b.dt).x[:, -1].mean()

    slope = jax.jit(jax.value_and_grad(height))
    few, more = iterations(b)
    whole, parts = resistances(b)
    return {
        "step": (Ours(b, mpm.UpdatedLagrangian(), STEPS), STEPS),
        "few": (few, 1),
        "more": (more, 40),
        "resist": (whole, STEPS),
        "in parts": (parts, STEPS),
        "gradient": (lambda: (np.asarray(slope(v)[1]),), STEPS),
    }


def resistances(b: Any) -> tuple[Callable[[], tuple], Callable[[], tuple]]:
    """Resistances by one call each and by three, with matrices of no meaning."""
    import jax
    import jax.numpy as jnp

    import mpmjax as mpm
    from mpmjax import linalg as la
    from mpmjax.discretisation import gather, make_stencil, resist, scatter

    p, d = b.x.shape
    grid, window = mpm.Grid((b.nodes,) * d, b.spacing), jnp.zeros(d, "int32")
    make = jax.jit(lambda x: make_stencil(mpm.BSpline(2), mpm.MLSGradient(), grid, window, x))
    stencil = make(jnp.asarray(b.x, b.dtype))
    random = np.random.default_rng(0)
    upper = jnp.asarray(random.normal(size=(d * d * (d * d + 1) // 2, p)), b.dtype)
    u = jnp.asarray(random.normal(size=(b.nodes**d, d)), b.dtype)

    def in_parts(stencil: Any, upper: jax.Array, u: jax.Array) -> jax.Array:
        slopes = jax.lax.optimization_barrier(gather(stencil, u)[1])
        flux = la.matmul(la.symmetric(upper), slopes.reshape(d * d, 1, p)).reshape(d, d, p)
        return scatter(stencil, None, flux, len(u))

    def of(function: Callable[..., jax.Array]) -> Callable[[], tuple]:
        compiled = jax.jit(function)
        return lambda: tuple(jax.block_until_ready([compiled(stencil, upper, u) for _ in range(STEPS)])[-1:])

    return of(resist), of(in_parts)


def work(name: str, dtype: str) -> None:
    """A back end's process: warms up, writes where the block is, then times what it is asked for."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import mpmjax as mpm

    todo = tasks((SCENES | QUICK)[name], dtype)
    print(mpm.native.backend(), flush=True)
    for go, _ in todo.values():
        last = go()
    state = np.concatenate([np.ravel(a) for a in (*todo["step"][0](), *last)]).astype("float64")
    np.save(sys.stdin.readline().strip(), state)
    print("saved", flush=True)
    for line in sys.stdin:
        go, share = todo[line.strip()]
        begun = time.perf_counter()
        go()
        print((time.perf_counter() - begun) / share, flush=True)


def compare(name: str, dtype: str, repeats: int, folder: Path) -> None:
    """Starts both processes, checks that they agree, and prints medians and ratios."""
    workers, states = {}, {}
    for kind in ("native", "xla"):
        command = [sys.executable, __file__, "--work", name, dtype]
        environment = os.environ | {"MPMJAX_BACKEND": kind}
        workers[kind] = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
        )

    def ask(kind: str, what: str) -> str:
        worker = workers[kind]
        worker.stdin.write(f"{what}\n")
        worker.stdin.flush()
        return worker.stdout.readline().strip()

    said = {kind: worker.stdout.readline().strip() for kind, worker in workers.items()}
    for kind in workers:
        ask(kind, str(folder / f"{kind}.npy"))
        states[kind] = np.load(folder / f"{kind}.npy")
    apart = np.abs(states["native"] - states["xla"]).max() / np.abs(states["xla"]).max()
    if not apart < {"float32": 1e-4, "float64": 1e-11}[dtype]:
        raise SystemExit(f"{name}, {dtype}: the back ends differ by {apart:.1e}.")
    seconds: dict = {kind: {what: [] for what in MEASURED} for kind in workers}
    for _ in range(repeats):
        for what in seconds["xla"]:
            for kind in workers:
                seconds[kind][what].append(float(ask(kind, what)))
    for worker in workers.values():
        worker.stdin.close()
        worker.wait()
    found = {kind: {what: float(np.median(s)) for what, s in own.items()} for kind, own in seconds.items()}
    for own in found.values():
        own["iteration"] = own["more"] - own["few"] / 40
        own["rest"] = own["few"] - 4 * own["iteration"]
    print(f"{name}, {dtype}: {said['native']}; apart by {apart:.0e}")
    for what in TASKS:
        one, other = (1e3 * found[kind][what] for kind in ("native", "xla"))
        print(f"    {what:>9}: {one:8.2f} ms, XLA {other:8.2f} ms, {other / one:.2f} times faster", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--scene", help="one scene alone")
    parser.add_argument("--dtype", choices=("float32", "float64"), help="one precision alone")
    parser.add_argument("--work", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(*options.work)
        return
    from tempfile import TemporaryDirectory

    with TemporaryDirectory() as folder:
        for name in QUICK if options.quick else SCENES:
            for dtype in ("float32", "float64"):
                if options.scene in (None, name) and options.dtype in (None, dtype):
                    compare(name, dtype, 3 if options.quick else 7, Path(folder))


if __name__ == "__main__":
    main()
