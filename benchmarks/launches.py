"""What is a program on a card made of? Compiled for an H200 where there is none: launches of a turn of each loop, and
memory.

    python -m pip install "jax[cuda12]"
    python benchmarks/launches.py            # by the CUDA kernels and by XLA alone
    python benchmarks/launches.py --quick    # small scenes
    python benchmarks/launches.py --cases    # gradients of all that gpu.py checks, in both precisions, by the kernels

Loops are counted in the order in which they end, those within others first: a step, or an iteration of a solve and its
restarts, or a step and its way back. A turn is the kernels that XLA makes of its fusions and copies, the condition, and
for each call of this package's kernels what native/launches.h launches. XLA is asked, as in gpu.py, to make CUDA graphs
of loops too: of a program that is one, with all of its loops, this is said; the host launches it once. Nothing runs, so
that neither times are told nor that results are right (gpu.py, on a card).
"""

import argparse
import ctypes
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

os.environ["JAX_PLATFORMS"] = "cpu"  # the plugin for cards is loaded, and looks for no driver

import equinox as eqx
import jax
import jax.numpy as jnp
from gpu import TOLERANCES, cases
from jax.experimental import topologies
from jax.sharding import SingleDeviceSharding
from laws import LAWS
from throughput import LARGE, QUICK, SCENES, Block, block, prepared, summed_by

import mpmjax as mpm
from mpmjax.native import BACKENDS, _library

H200 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152 shared_memory_per_core: 233472
  threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128 block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535 block_dim_limit_z: 65535 memory_bandwidth: 4800000000000 l2_cache_size: 62914560
  clock_rate_ghz: 1.98 device_memory_size: 150000000000 shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 } registers_per_core_limit: 65536 registers_per_block_limit: 65536
  driver_version: "12.9.0"
}
platform_name: "CUDA" dnn_version_info { major: 9 minor: 8 } runtime_version { major: 12 minor: 9 }
device_description_str: "NVIDIA H200"
"""
"""The card as XLA describes it: limits of compute capability 9.0, and what its maker publishes."""
CALLS = {"gather": 1, "scatter": 2, "average": 3, "pull": 2, "resist": 2, "p2g": 3, "g2p": 1, "eigen": 1, "rotation": 1}
"""Launches of a call, with those that set memory to zero, and of a pull with the gather beside it."""


def can_use_cuda() -> None:
    """Registers the library for cards, which is not asked whether there is one."""
    library = ctypes.CDLL(str(_library.CUDA_PATH))
    for name in _library.CUDA_KERNELS:
        capsule = jax.ffi.pycapsule(getattr(library, f"mpmjax_{name}"))
        jax.ffi.register_ffi_target(f"mpmjax_{name}", capsule, platform="CUDA")
    (cuda,) = (kind for kind in BACKENDS if kind.name == "cuda")
    cuda.absence = staticmethod(lambda: "")


def loops(program: str) -> list[int]:
    """The launches of a turn of each loop of a compiled program, without those of loops within it."""
    found = {}
    for text in re.split(r"\n(?=\S)", program):
        if head := re.match(r"(?:ENTRY )?%(\S+) \(", text):
            found[head[1]] = text
    turns = []
    for text in found.values():
        for body in re.findall(r" while\(.*body=%([\w.\-]+)", text):
            kernels = re.findall(r" (?:fusion|copy)\(", found[body])
            calls = re.findall(r" custom-call\(.*target=\"mpmjax_(\w+)\"", found[body])
            turns.append(1 + len(kernels) + sum(CALLS[name] for name in calls))
    return turns


def is_one_graph(folder: str) -> bool:
    """Whether a program that was compiled is one graph: what the host goes through is listed without an indent."""
    (path,) = Path(folder).glob("*thunk_sequence_after_thunk_passes.txt")
    return re.findall(r"^\d+: (\w+)", path.read_text(), re.MULTILINE) == ["kCommandBuffer"]


Program = tuple[str, Block, Any, dict[str, Any], Callable[..., Any]]
"""Name, block, law, other choices of the scene, and a function of scene, step and state."""


def steps(method: Any = mpm.Explicit(), count: int = 50) -> Callable[..., Any]:
    return lambda scene, dt, state: mpm.rollout(scene, state, steps=count, dt=dt, method=method)


def slope(run: Callable[..., Any]) -> Callable[..., Any]:
    """The gradient of a height at the end by the velocities at the start."""

    def height(v: jax.Array, scene: Any, dt: Any, state: Any) -> jax.Array:
        end = run(scene, dt, eqx.tree_at(lambda q: q.v, state, v))
        return end.x[:, -1].mean() + (end.F**2).mean()

    return lambda scene, dt, state: jax.value_and_grad(height)(state.v, scene, dt, state)


def programs(quick: bool) -> Iterator[Program]:
    every = {name: block(*numbers, "float32") for name, numbers in (QUICK if quick else SCENES | LARGE).items()}
    elastic = LAWS["neo-Hookean"]
    for name, b in every.items():
        yield f"explicit steps, {name}", b, elastic, {}, steps()
    name, b = next(iter(every.items()))
    for law in LAWS:
        yield f"{law}, {name}", b, LAWS[law], {}, steps()
    yield f"a semi-implicit step, {name}", b, elastic, {}, steps(mpm.SemiImplicit(), 1)
    for name, b in every.items():
        if b.x.shape[1] == 2:
            yield f"gradient of steps, {name}", b, elastic, {}, slope(steps())


def checked() -> Iterator[Program]:
    for name, d, law, choices, method, factor in cases():
        for dtype in TOLERANCES:
            b = block(d, (12, 36, 216)[d - 1], 16, 2**d, dtype)
            yield f"{name}, {dtype}", b._replace(dt=factor * b.dt), law, choices, slope(steps(method, 5))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    parser.add_argument("--cases", action="store_true", help="what gpu.py checks")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", options.cases)
    card = topologies.get_topology_desc("h200", platform="cuda", topology="1x1x1", target_config=H200)
    place = SingleDeviceSharding(card.devices[0])
    can_use_cuda()
    for name, b, law, choices, function in checked() if options.cases else programs(options.quick):
        scene, state = prepared(b, law, **choices)
        given = scene, jnp.asarray(b.dt, b.dtype), state
        shapes = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=place) if eqx.is_array(a) else a, given
        )
        told = []
        for kind in ("cuda",) if options.cases else ("cuda", "xla"):
            jax.clear_caches()
            with summed_by(kind), TemporaryDirectory() as folder:
                lowered = jax.jit(function).trace(*shapes).lower(lowering_platforms=("cuda",))
                program = lowered.compile({"xla_dump_to": folder})
                graph = ", one graph" if is_one_graph(folder) else ""
            said = program.memory_analysis()
            memory = said.argument_size_in_bytes + said.output_size_in_bytes + said.temp_size_in_bytes
            turns = ", ".join(map(str, loops(program.as_text())))
            told.append(f"{kind}: {turns} launches, {memory / 1e6:.0f} MB{graph}")
        print(f"{name:<35} {'; '.join(told)}", flush=True)


if __name__ == "__main__":
    main()
