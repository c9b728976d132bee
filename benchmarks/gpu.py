"""Is the package right on this card, and how fast? Everything in one go and one table, in ten minutes.

    python benchmarks/gpu.py                # with jax[cuda12] or jax[cuda13]
    python benchmarks/gpu.py --quick        # small scenes, few steps: on a CPU too, where it checks this script
    python benchmarks/gpu.py --only checks

Checks come first: states and gradients by the initial velocity after some steps of a small block, of all laws and
integrators, transfers, kernels and dimensions, in both precisions, against the same on the CPU by XLA. What differs by
more than a tolerance is named at the end, and the exit status is 1. Then times, by the device's own back end and by XLA
alone in turns: explicit steps of the blocks of `throughput.py`, an iteration of the solve, the gradient of a hundred
steps, and a batch of 1024 members. Medians; memory is that of the compiled program. The default tests come last.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

# Loops are then part of CUDA graphs. Read when JAX starts; what is set already stays.
os.environ.setdefault("XLA_FLAGS", "--xla_gpu_enable_command_buffer=+WHILE,+CONDITIONAL")

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

sys.path.append(str(Path(__file__).parent))
from laws import LAWS
from throughput import E_MODULUS, ITERATIONS, LARGE, NU, SCENES, Ours, block, iterations, medians, prepared, summed_by

jax.config.update("jax_enable_x64", True)

STEPS = 5
TOLERANCES = {"float32": 1e-3, "float64": 1e-6}
"""Largest relative difference from the CPU of states and gradients: solves end within 1e-5, and others by rounding."""
METHODS: dict[str, tuple[Any, float]] = {
    "semi-implicit": (mpm.SemiImplicit(), 5.0),
    "backward Euler": (mpm.BackwardEuler(), 5.0),
    "implicit midpoint": (mpm.ImplicitMidpoint(), 5.0),
    "TR-BDF2": (mpm.TRBDF2(), 5.0),
}
"""Integrators, and their step over the explicit one's."""
Row = dict[str, Any]


def cases() -> Iterator[tuple[str, int, Any, dict[str, Any], Any, float]]:
    """Name, dimension, law, choices of the scene, method, and the step over the explicit one's."""
    elastic = mpm.NeoHookean(E_MODULUS, NU)
    for name, law in LAWS.items():
        yield name, 3, law, {}, mpm.Explicit(), 1.0
    for name, (method, factor) in METHODS.items():
        yield name, 3, elastic, {}, method, factor
    for d in (1, 2):
        yield f"{d}-D", d, elastic, {}, mpm.Explicit(), 1.0
    choices = {
        "linear kernel": {"kernel": mpm.BSpline(1)},
        "cubic kernel": {"kernel": mpm.BSpline(3)},
        "spline gradient": {"gradient": mpm.SplineGradient()},
        "FLIP": {"transfer": mpm.FLIP(0.95)},
        "PIC": {"transfer": mpm.PIC()},
        "total": {"description": mpm.TotalLagrangian()},
    }
    for name, chosen in choices.items():
        yield name, 2, elastic, chosen, mpm.Explicit(), 1.0


def outcome(d: int, law: Any, choices: dict, method: Any, factor: float, dtype: str) -> Callable[[], tuple]:
    """State and gradient of a small block after some steps."""
    b = block(d, (12, 36, 216)[d - 1], 16, 2**d, dtype)

    def run() -> tuple:
        scene, start = prepared(b, law, **choices)

        def height(v: jax.Array) -> tuple[jax.Array, tuple]:
            begun = eqx.tree_at(lambda q: q.v, start, v)
            end = mpm.rollout(scene, begun, steps=STEPS, dt=factor * b.dt, method=method)
            return (end.x[:, -1] ** 2).sum() + (end.F**2).sum(), (end.x, end.v, end.F)

        (_, state), slope = jax.jit(jax.value_and_grad(height, has_aux=True))(start.v)
        return *(np.asarray(a) for a in state), np.asarray(slope)

    return run


def apart(ours: tuple, theirs: tuple) -> float:
    """The largest difference, over the largest number of each array; infinite for what is not finite."""
    return max(
        float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-30)) if np.isfinite(a).all() else float("inf")
        for a, b in zip(ours, theirs, strict=True)
    )


def outcomes(quick: bool) -> dict[str, tuple]:
    """State and gradient of each case in both precisions, compiled by several threads."""
    of = {
        f"{name}, {dtype}": outcome(d, law, choices, method, factor, dtype)
        for name, d, law, choices, method, factor in cases()
        if not quick or name == "2-D"
        for dtype in TOLERANCES
    }
    with ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as threads:
        return dict(zip(of, threads.map(lambda run: run(), of.values()), strict=True))


def checks(quick: bool) -> Iterator[Row]:
    """Each case against the CPU by XLA, which a process of its own computes meanwhile."""
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "MPMJAX_BACKEND": "xla"}
    with TemporaryDirectory() as folder:
        path = Path(folder) / "reference.npz"
        command = [sys.executable, __file__, "--reference", str(path), *(["--quick"] if quick else [])]
        with subprocess.Popen(command, env=environment) as other, summed_by(kinds()[0]):
            ours = outcomes(quick)
        if other.returncode:
            raise SystemExit("The reference on the CPU failed.")
        with np.load(path) as reference:
            for what, arrays in ours.items():
                theirs = tuple(reference[f"{what} {k}"] for k in range(len(arrays)))
                difference = apart(arrays, theirs)
                right = difference <= TOLERANCES[what.rpartition(", ")[2]]
                yield {"what": what, "apart": difference, "right": right}


def kinds() -> list[str]:
    """The back ends that take turns: this device's own, where it can be used, and XLA."""
    platform = "cpu" if jax.default_backend() == "cpu" else "cuda"
    return [*(kind.name for kind in mpm.native.BACKENDS if kind.platform == platform and not kind.absence()), "xla"]


def taken(what: str, codes: dict[str, Callable[[], Any]], repeats: int, share: float = 1, **more: Any) -> Row:
    for go in codes.values():
        go()
    seconds = medians(codes, repeats)
    return {"what": what} | {f"{kind} [ms]": 1e3 * s / share for kind, s in seconds.items()} | more


def steps(quick: bool) -> Iterator[Row]:
    """Explicit steps, and iterations of a solve from semi-implicit steps of two lengths."""
    scenes = {"C 400": (2, 400, 32, 4)} if quick else SCENES | LARGE
    for name, numbers in scenes.items():
        for dtype in ("float32",) if quick or name in LARGE else ("float32", "float64"):
            b, count = block(*numbers, dtype), 2 if quick else 50
            ours = {kind: Ours(b, mpm.UpdatedLagrangian(), count, backend=kind) for kind in kinds()}
            codes = {kind: go.further for kind, go in ours.items()}
            megabytes = {f"{kind} [MB]": go.memory / 1e6 for kind, go in ours.items()}
            yield taken(f"step {name}, {dtype}", codes, 2 if quick else 7, count, **megabytes)
    name, numbers = next(iter(scenes.items()))
    few, more = ITERATIONS
    cut = {kind: iterations(block(*numbers, "float32"), kind) for kind in kinds()}
    each = [{kind: both[k].further for kind, both in cut.items()} for k in (0, 1)]
    rows = [taken("", codes, 2 if quick else 7) for codes in each]
    per = {key: (rows[1][key] - rows[0][key]) / (more - few) for key in rows[0] if key != "what"}
    yield {"what": f"iteration of a solve {name}, float32"} | per


def programs(quick: bool) -> Iterator[Row]:
    """A gradient beside its run, and a batch."""
    b = block(2, 400 if quick else 10_000, 128, 4, "float32")
    count, members, small = (3, 4, 100) if quick else (100, 1024, 2500)
    for what, of, batch in (("one run", b, None), (f"{members} runs", block(2, small, 64, 4, "float32"), members)):
        scene, start = prepared(of, gravity=(0.0, 0.0))
        length = count if batch is None else max(count // 2, 1)

        def height(v: jax.Array, scene=scene, start=start, of=of, length=length) -> jax.Array:
            end = mpm.rollout(scene, eqx.tree_at(lambda q: q.v, start, v), steps=length, dt=of.dt)
            return end.x[:, -1].mean()

        v = start.v
        given = v if batch is None else v * jnp.linspace(0.5, 1, batch, dtype="float32")[:, None, None]
        for name, function in (("run", height), ("value and gradient", jax.value_and_grad(height))):
            codes = {}
            for kind in kinds():
                mapped = jax.jit((lambda f: lambda v: f(v))(function if batch is None else jax.vmap(function)))
                with summed_by(kind):
                    program = mapped.lower(given).compile()
                codes[kind] = lambda program=program, given=given: jax.block_until_ready(program(given))
                jax.clear_caches()
            yield taken(f"{name} of {length} steps, {what} of {len(of.x)}", codes, 2 if quick else 5)


def tests(quick: bool) -> Iterator[Row]:
    """The default tests, on the device."""
    if quick:
        return
    command = [sys.executable, "-m", "pytest", "-q", "-n", str(min(12, os.cpu_count() or 1))]
    # each worker would else take most of the card's memory, of which this process has a share already
    environment = os.environ | {"MPMJAX_BACKEND": kinds()[0], "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    environment.pop("XLA_FLAGS")  # as users run them
    done = subprocess.run(command, cwd=Path(__file__).parents[1], env=environment, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    failed = [line for line in lines if line.startswith("FAILED")]
    yield {"what": "\n".join([*failed, *lines[-1:]]), "right": done.returncode == 0}


def environment() -> Row:
    """Device, versions and back end."""
    device = jax.devices()[0]
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        card = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        card = "no nvidia-smi"
    versions = {"jax": jax.__version__, "python": sys.version.split()[0], "mpmjax": mpm.__version__}
    return versions | {"device": device.device_kind, "card": card, "sums": kinds()[0]}


def shown(row: Row) -> str:
    """A row of the table."""
    numbers = [f"{key} {value:.3g}" for key, value in row.items() if key not in ("what", "right")]
    return f"{row['what']:<55} {', '.join(numbers)}{'' if row.get('right', True) else '  WRONG'}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--only", choices=("checks", "steps", "programs", "tests"), help="one part alone")
    parser.add_argument("--json", type=Path, help="a file for the rows")
    parser.add_argument("--reference", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.reference:
        found = outcomes(options.quick).items()
        np.savez(options.reference, **{f"{what} {k}": a for what, arrays in found for k, a in enumerate(arrays)})
        return
    begun, told = time.perf_counter(), environment()
    print(", ".join(f"{key} {value}" for key, value in told.items()), flush=True)
    rows = []
    for part in (checks, steps, programs, tests):
        if options.only not in (None, part.__name__):
            continue
        for row in part(options.quick):
            rows.append(row)
            print(shown(row), flush=True)
    print(f"{time.perf_counter() - begun:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(told | {"rows": rows}, indent=1) + "\n")
    wrong = [row["what"] for row in rows if not row.get("right", True)]
    if wrong:
        raise SystemExit(f"Not as on the CPU: {'; '.join(wrong)}.")


if __name__ == "__main__":
    main()
