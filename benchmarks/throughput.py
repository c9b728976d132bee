"""How fast is a step? Explicit steps of a free elastic block, beside MLS-MPM in Taichi, in Warp, and by hand in C++.

    python benchmarks/throughput.py            # this package alone
    python benchmarks/throughput.py --peers    # needs: python -m pip install -e ".[peers]"
    python benchmarks/throughput.py --json --quick
    python benchmarks/throughput.py --device gpu

Scenes: A, 3-D, 97 336 particles on 64³ nodes and, in float32 alone, 1 000 000 and 4 019 679 on 128³, 8 a cell; C, 2-D,
10 000 on 128² and 99 856 on 256², 4 a cell. All codes: neo-Hookean, quadratic kernel, APIC, moving least squares, the
same initial particles, gravity, no walls reached. This package is timed with the native sums and by XLA alone. Before
anything is timed, centres of mass and energies after some steps must agree to what the precision allows.
The codes take turns, and medians are compared as ratios: seconds on a shared machine mean little. What an iteration of
the implicit solve costs, in all blocks but the largest, is told from semi-implicit steps of two lengths; and from the
bytes that any explicit step has to move, the fraction of the memory's bandwidth, which is that of a copy. Memory
is that of the compiled program: what it is given, what it returns, and its temporaries.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

sys.path.append(str(Path(__file__).parent))
jax.config.update("jax_enable_x64", True)

E_MODULUS, NU, DENSITY, GRAVITY = 1e5, 0.3, 1e3, 9.81
SCENES = {"A 100k": (3, 100_000, 64, 8), "C 10k": (2, 10_000, 128, 4), "C 100k": (2, 100_000, 256, 4)}
LARGE = {"A 1M": (3, 1_000_000, 128, 8), "A 4M": (3, 4_000_000, 128, 8)}
QUICK = {"A 5k": (3, 5_000, 32, 8), "C 2k": (2, 2_000, 64, 4)}
ITERATIONS = 4, 44
Code = Callable[[], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Goes on by the timed steps and returns x, v, F."""


class Block(NamedTuple):
    """A scene in terms that every code understands."""

    x: np.ndarray
    v: np.ndarray
    mass: float
    volume: float
    nodes: int
    spacing: float
    dt: float
    dtype: str


def block(d: int, particles: int, nodes: int, per_cell: int, dtype: str) -> Block:
    """A cube of particles in the middle of the unit box, slightly stirred so that it deforms."""
    spacing = 1 / nodes
    side = round(per_cell ** (1 / d))
    along = round(particles ** (1 / d))
    places = (np.arange(along) + 0.5) * spacing / side
    x = np.stack(np.meshgrid(*[places] * d, indexing="ij"), axis=-1).reshape(-1, d)
    x += (0.5 - along * spacing / side / 2) // spacing * spacing
    v = 0.1 * np.sin(2 * np.pi * x[:, ::-1])
    volume = (spacing / side) ** d
    law = mpm.NeoHookean(E_MODULUS, NU)
    speed = float(np.sqrt((law.lame_lambda + 2 * law.shear_modulus) / DENSITY))
    return Block(x, v, DENSITY * volume, volume, nodes, spacing, 0.3 * spacing / speed, dtype)


def prepared(
    b: Block, law: Any = mpm.NeoHookean(E_MODULUS, NU), wider: tuple[int, ...] = (1, 1, 1), **choices: Any
) -> tuple[mpm.Scene, mpm.Particles]:
    """The block in this package, in a window so many times as wide along each axis."""
    d, one = b.x.shape[1], jnp.ones(len(b.x), b.dtype)
    grid = mpm.Grid(tuple(b.nodes * times for times in wider[:d]), b.spacing)
    scene = mpm.Scene(grid, law, **{"gravity": (*[0.0] * (d - 1), -GRAVITY)} | choices)
    x, v = jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype)
    return scene, mpm.prepare(scene, mpm.Particles(x, v, b.mass * one, b.volume * one))


@contextmanager
def summed_by(backend: str | None) -> Iterator[None]:
    """Programs that are compiled within take this back end, and keep it. None: that of the environment."""
    asked = os.environ.get("MPMJAX_BACKEND")
    if backend is not None:
        os.environ["MPMJAX_BACKEND"] = backend
    yield
    os.environ.pop("MPMJAX_BACKEND", None)
    if asked is not None:
        os.environ["MPMJAX_BACKEND"] = asked


class Ours:
    """This package's `rollout`, compiled for one back end, in a window so many times as wide along each axis. A call
    goes on by the timed steps."""

    memory: int
    """What the program is given, what it returns, and its temporaries [B]."""

    def __init__(
        self,
        b: Block,
        description: Any,
        steps: int,
        method: Any = mpm.Explicit(),
        backend: str | None = None,
        wider: tuple[int, ...] = (1, 1, 1),
    ):
        scene, self._state = prepared(b, wider=wider, description=description, gradient=mpm.MLSGradient())
        self._given = scene, jnp.asarray(b.dt, b.dtype)
        go_on = jax.jit(lambda scene, dt, state: mpm.rollout(scene, state, steps=steps, dt=dt, method=method))
        with summed_by(backend):
            self._program = go_on.lower(*self._given, self._state).compile()
        said = self._program.memory_analysis()
        self.memory = said.argument_size_in_bytes + said.output_size_in_bytes + said.temp_size_in_bytes

    def further(self) -> mpm.Particles:
        """Goes on by the timed steps, and leaves the state on the device."""
        self._state = jax.block_until_ready(self._program(*self._given, self._state))
        return self._state

    def __call__(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        state = self.further()
        return np.asarray(state.x), np.asarray(state.v), np.asarray(state.F)


def peer(b: Block, make: Callable[..., Any]) -> Any:
    """The block in a peer's code."""
    law, d = mpm.NeoHookean(E_MODULUS, NU), b.x.shape[1]
    return make(
        b.x,
        b.v,
        mass=b.mass,
        volume=b.volume,
        shape=(b.nodes,) * d,
        spacing=b.spacing,
        shear_modulus=float(law.shear_modulus),
        lame_lambda=float(law.lame_lambda),
        gravity=(*[0.0] * (d - 1), -GRAVITY),
        dtype=b.dtype,
    )


def energies(b: Block, x: np.ndarray, v: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre of mass, and kinetic (without the affine part), elastic and potential energy added up, in double."""
    law = mpm.NeoHookean(E_MODULUS, NU)
    stored = np.asarray(law.energy(jnp.moveaxis(jnp.asarray(F, "float64"), 0, -1)))
    v, x = v.astype("float64"), x.astype("float64")
    return x.mean(axis=0), float(
        (b.mass * (v**2 / 2).sum(axis=1) + b.volume * stored + b.mass * GRAVITY * x[:, -1]).sum()
    )


def codes_of(b: Block, steps: int, peers: bool) -> dict[str, Code]:
    """The codes that run this block."""
    found = {
        "mpmjax": Ours(b, mpm.UpdatedLagrangian(), steps),
        "total": Ours(b, mpm.TotalLagrangian(), steps),
    }
    if mpm.native.backend().name == "native":
        found["XLA"] = Ours(b, mpm.UpdatedLagrangian(), steps, backend="xla")
    if peers:
        from peers.taichi_mpm import TaichiMPM
        from peers.vectorised_mpm import VectorisedMPM
        from peers.warp_mpm import WarpMPM

        found["C++"] = partial(peer(b, VectorisedMPM).run, steps, b.dt)
        found["Taichi"] = partial(peer(b, TaichiMPM).run, steps, b.dt)
        if b.dtype == "float32":
            found["Warp"] = partial(peer(b, WarpMPM).run, steps, b.dt)
    return found


def medians(codes: dict[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Seconds of each, called in turn."""
    seconds: dict[str, list[float]] = {code: [] for code in codes}
    for _ in range(repeats):
        for code, go in codes.items():
            begun = time.perf_counter()
            go()
            seconds[code].append(time.perf_counter() - begun)
    return {code: float(np.median(s)) for code, s in seconds.items()}


def check(name: str, b: Block, codes: dict[str, Code]) -> None:
    """That all codes compute the same motion."""
    outcomes = {code: energies(b, *go()) for code, go in codes.items()}
    (centre, total), tolerance = outcomes["mpmjax"], {"float32": 1e-5, "float64": 1e-9}[b.dtype]
    for code, (other, energy) in outcomes.items():
        allowed = tolerance if code != "total" else 1e-4  # another discretisation: X for x
        if np.abs(other - centre).max() > allowed or abs(energy / total - 1) > allowed:
            raise SystemExit(
                f"{name}, {b.dtype}: {code} disagrees: centre {other} and {centre}, energy {energy}, {total}."
            )


def iterations(b: Block, backend: str | None = None, wider: tuple[int, ...] = (1, 1, 1)) -> tuple[Ours, Ours]:
    """Semi-implicit steps of twenty times the block's own, cut off after few and after more iterations."""

    def cut(most: int) -> Ours:
        method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-30, max_steps=most))
        return Ours(b._replace(dt=20 * b.dt), mpm.UpdatedLagrangian(), 1, method, backend, wider)

    few, more = ITERATIONS
    return cut(few), cut(more)


def copied() -> float:
    """Bytes a second that a copy reads and writes."""
    field = jnp.zeros(2**26, "float32")
    copies = jax.jit(lambda a: jax.lax.fori_loop(0, 10, lambda _, a: a + 1, a))
    seconds = medians({"copy": lambda: jax.block_until_ready(copies(field))}, 4)["copy"]
    return 10 * 2 * field.nbytes / seconds


def least_bytes(b: Block) -> int:
    """What an explicit step has to move: x, v, C and F of the particles read and written, their mass and volume read,
    and the mass and velocity of as many nodes as their cells have, written and read."""
    d, p = b.x.shape[1], len(b.x)
    nodes = p * b.volume / b.spacing**d
    return round(np.dtype(b.dtype).itemsize * (p * (2 * (2 * d + 2 * d * d) + 2) + 2 * nodes * (d + 1)))


def compare(name: str, b: Block, *, steps: int, repeats: int, peers: bool, solve: bool) -> dict[str, Any]:
    """Agreement first, then medians of interleaved runs."""
    codes = codes_of(b, steps, peers)
    check(name, b, codes)
    solves = {
        (kind, most): go
        for kind in ("mpmjax", "XLA")
        if kind in codes and solve
        for most, go in zip(ITERATIONS, iterations(b, "xla" if kind == "XLA" else None), strict=True)
    }
    for go in solves.values():
        go()
    seconds = medians(codes | solves, repeats)
    few, more = ITERATIONS
    iteration = {
        kind: (seconds[kind, more] - seconds[kind, few]) / (more - few) for kind, most in solves if most == few
    }
    step = {code: seconds[code] / steps for code in codes}
    return {
        "scene": name,
        "dtype": b.dtype,
        "particles": len(b.x),
        "milliseconds": {code: 1e3 * s for code, s in step.items()},
        "iteration": {kind: 1e3 * s for kind, s in iteration.items()},
        "bandwidth_fraction": least_bytes(b) / step["mpmjax"] / copied(),
        "megabytes": codes["mpmjax"].memory / 1e6,
    }


def shown(row: dict[str, Any]) -> str:
    """A row in words, with each time over ours in brackets."""
    ms, iteration = row["milliseconds"], row["iteration"]
    each = ", ".join(f"{code} {t:.2f} ms ({t / ms['mpmjax']:.2f})" for code, t in ms.items())
    bytes_moved = f"{row['bandwidth_fraction']:.1%} of a copy's rate, {row['megabytes']:.0f} MB"
    found = f"{row['scene']}, {row['dtype']}, {row['particles']} particles: {each}\n    {bytes_moved}"
    if not iteration:
        return found
    solve = ", ".join(f"{kind} {t:.2f} ms" for kind, t in iteration.items())
    return f"{found}; an iteration of the solve: {solve}, {iteration['mpmjax'] / ms['mpmjax']:.2f} of a step"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peers", action="store_true", help="C++, Taichi and Warp too")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--scene", help="one scene alone")
    parser.add_argument("--device", choices=("cpu", "gpu"), help="where this package runs; peers run on the CPU")
    options = parser.parse_args()
    if options.device:
        jax.config.update("jax_platforms", {"cpu": "cpu", "gpu": "cuda"}[options.device])
    rows = []
    for name, numbers in (QUICK if options.quick else SCENES | LARGE).items():
        if options.scene not in (None, name):
            continue
        for dtype in ("float32",) if name in LARGE else ("float32", "float64"):
            steps, repeats = 10 if options.quick else 20, 3 if options.quick or name in LARGE else 7
            options_of = {"steps": steps, "repeats": repeats, "peers": options.peers, "solve": name not in LARGE}
            rows.append(compare(name, block(*numbers, dtype), **options_of))
            if not options.json:
                print(shown(rows[-1]), flush=True)
    if options.json:
        print(json.dumps({"jax": jax.__version__, "device": str(jax.devices()[0]), "rows": rows}))


if __name__ == "__main__":
    main()
