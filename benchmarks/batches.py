"""What does a member of a batch cost, beside a run of its own? The README's scene, with a stiffness for each member.

    python benchmarks/batches.py [--quick] [--members 8 64] [--only explicit value] [--json]

The jelly starts where it meets the floor, with the velocity that it has there, so that members differ from the start.
Values and gradients of the mean height at the end, of explicit and of semi-implicit steps, by `rollout` and by
`simulate(throw=False)`: `eqx.filter_vmap` of a compiled function, against the same function called for one member after
the other, in turns. Both must agree before anything is timed. Medians as milliseconds a member and as their ratio, the
ratio of the processor's time, and the seconds of the first call of each, which compiles, in float32 as users run it.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

sys.path.append(str(Path(__file__).parent))
from throughput import medians

jax.config.update("jax_enable_x64", False)

FLOOR, GRAVITY = 0.125, 9.81
SOFTEST, STIFFEST = 5e4, 2e5
METHODS = {"explicit": (mpm.Explicit(), 1e-3), "semi-implicit": (mpm.SemiImplicit(), 5e-3)}
AGREES = 1e-3
"""Largest relative difference of a batch's values and gradients from those of runs one after the other: solves of
tolerance 1e-5 end after other roundings."""


def scene_and_jelly() -> tuple[mpm.Scene, mpm.Particles]:
    """The README's, after the fall."""
    grid = mpm.Grid(shape=(48, 48), spacing=1 / 32)
    fallen = 0.5 - FLOOR
    jelly = mpm.fill(
        mpm.Box((0.3, 0.5 - fallen), (0.7, 0.9 - fallen)),
        grid,
        particles_per_cell=4,
        density=1e3,
        velocity=(0.0, -((2 * GRAVITY * fallen) ** 0.5)),
    )
    walls = mpm.SlipBox((FLOOR, FLOOR), (1.375, 1.375))
    return mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -GRAVITY), boundary=walls), jelly


def heights(method: Any, steps: int, dt: float) -> dict[str, Callable[[Any], Any]]:
    """The mean height at the end as a function of the stiffness, by each way to run a scene."""
    scene, jelly = scene_and_jelly()

    def with_stiffness(stiffness: Any) -> mpm.Scene:
        return eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)

    def rolled(stiffness: Any) -> Any:
        return mpm.rollout(with_stiffness(stiffness), jelly, steps=steps, dt=dt, method=method).x[:, 1].mean()

    def simulated(stiffness: Any) -> Any:
        run = mpm.simulate(with_stiffness(stiffness), jelly, t1=steps * dt, dt=dt, method=method, throw=False)
        return run.final.x[:, 1].mean()

    return {"rollout": rolled, "simulate": simulated}


def processor(call: Callable[[], Any]) -> float:
    """The processor's seconds of a call, of all threads, which another program on the machine hardly changes."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What a call returns, and its seconds."""
    begun = time.perf_counter()
    found = jax.block_until_ready(call())
    return found, time.perf_counter() - begun


def compare(function: Callable[[Any], Any], counts: list[int], repeats: int) -> list[dict[str, Any]]:
    """A batch of each size against its members one after the other: milliseconds a member, and their ratio."""
    one, many, rows = eqx.filter_jit(function), eqx.filter_jit(eqx.filter_vmap(function)), []
    first = timed(lambda: one(jnp.float32(SOFTEST)))[1]
    for members in counts:
        stiffness = jnp.asarray(np.geomspace(SOFTEST, STIFFEST, members), jnp.float32)

        def batch(stiffness: Any = stiffness) -> Any:
            return jax.block_until_ready(many(stiffness))

        def alone(stiffness: Any = stiffness) -> Any:
            return jax.block_until_ready([one(each) for each in stiffness])

        found, first_batch = timed(batch)
        expected = np.asarray(alone())
        if not np.allclose(found, expected, rtol=AGREES, atol=AGREES * np.abs(expected).max()):
            raise SystemExit(f"A batch of {members} disagrees: {found} and {expected}.")
        seconds = medians({"batch": batch, "alone": alone}, repeats)
        rows.append(
            {
                "members": members,
                "milliseconds": {name: 1e3 * s / members for name, s in seconds.items()},
                "ratio": seconds["batch"] / seconds["alone"],
                "processor_ratio": processor(batch) / processor(alone),
                "first_call": {"batch": first_batch, "alone": first},
            }
        )
    return rows


def said(found: dict[str, Any]) -> str:
    """A row of the report in words."""
    ms, first = found["milliseconds"], found["first_call"]
    return (
        f"{found['members']} members: {ms['batch']:.2f} ms a member, alone {ms['alone']:.2f} ms, ratio "
        f"{found['ratio']:.2f}, of the processor's time {found['processor_ratio']:.2f}; "
        f"first call {first['batch']:.1f} s, alone {first['alone']:.1f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="few steps, one repeat, by default 4 members")
    parser.add_argument("--members", type=int, nargs="+", help="sizes of the batches; default 8 and 64")
    parser.add_argument("--only", nargs="+", default=[], help="rows whose names have all of these words")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    counts = options.members or ([4] if options.quick else [8, 64])
    steps, repeats = (10, 1) if options.quick else (100, 3)
    report: dict[str, Any] = {"jax": jax.__version__, "device": str(jax.devices()[0]), "steps": steps, "rows": {}}
    for name, (method, dt) in METHODS.items():
        for way, height in heights(method, steps, dt).items():
            for kind, function in (("value", height), ("gradient", jax.grad(height))):
                row = f"{name}, {way}, {kind}"
                if not all(word in row.replace(",", "").split() for word in options.only):
                    continue
                report["rows"][row] = compare(function, counts, repeats)
                if options.json:
                    continue
                for found in report["rows"][row]:
                    print(f"{row}, {said(found)}", flush=True)
    if options.json:
        print(json.dumps(report))


if __name__ == "__main__":
    main()
