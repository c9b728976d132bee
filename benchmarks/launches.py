"""What is a program on a card made of? Compiled for an H200 where there is none: launches of a turn of each loop, and
memory.

    python -m pip install "jax[cuda12]"
    python benchmarks/launches.py            # by the CUDA kernels and by XLA alone
    python benchmarks/launches.py --quick    # small scenes

Loops are counted in the order in which they end, those within others first: a step, or an iteration of a solve and its
restarts, or a step and its way back. A turn is the kernels that XLA makes of its fusions and copies, the condition, and
for each call of this package's kernels what native/launches.h launches. Nothing runs: how long a launch takes is not
told, nor that results are right (`gpu.py`, on a card).
"""

import argparse
import ctypes
import os
import re
from collections.abc import Callable, Iterator
from typing import Any

os.environ["JAX_PLATFORMS"] = "cpu"  # the plugin for cards is loaded, and looks for no driver

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.experimental import topologies
from jax.sharding import SingleDeviceSharding
from laws import LAWS
from throughput import GRAVITY, LARGE, QUICK, SCENES, Block, block, summed_by

import mpmjax as mpm
from mpmjax.native import BACKENDS, _library

jax.config.update("jax_enable_x64", False)

H200 = """
gpu_device_info {
  threads_per_block_limit: 1024 threads_per_warp: 32 shared_memory_per_block: 49152 shared_memory_per_core: 233472
  threads_per_core_limit: 2048 core_count: 132 fpus_per_core: 128 block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535 block_dim_limit_z: 65535 memory_bandwidth: 4800000000000 l2_cache_size: 62914560
  clock_rate_ghz: 1.98 device_memory_size: 150000000000 shared_memory_per_block_optin: 232448
  cuda_compute_capability { major: 9 } registers_per_core_limit: 65536 registers_per_block_limit: 65536
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


def programs(quick: bool) -> Iterator[tuple[str, Block, Any, Callable[..., Any]]]:
    """Name, block, law and function of scene, step and state of each."""

    def steps(method: Any = mpm.Explicit(), count: int = 50) -> Callable[..., Any]:
        return lambda scene, dt, state: mpm.rollout(scene, state, steps=count, dt=dt, method=method)

    def slope(scene: Any, dt: Any, state: Any) -> Any:
        def height(v: jax.Array) -> jax.Array:
            return steps()(scene, dt, eqx.tree_at(lambda q: q.v, state, v)).x[:, -1].mean()

        return jax.value_and_grad(height)(state.v)

    every = {name: block(*numbers, "float32") for name, numbers in (QUICK if quick else SCENES | LARGE).items()}
    for name, b in every.items():
        yield f"explicit steps, {name}", b, LAWS["neo-Hookean"], steps()
    name, b = next(iter(every.items()))
    for law in LAWS:
        yield f"{law}, {name}", b, LAWS[law], steps()
    yield f"a semi-implicit step, {name}", b, LAWS["neo-Hookean"], steps(mpm.SemiImplicit(), 1)
    for name, b in every.items():
        if b.x.shape[1] == 2:
            yield f"gradient of steps, {name}", b, LAWS["neo-Hookean"], slope


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small scenes")
    options = parser.parse_args()
    card = topologies.get_topology_desc("h200", platform="cuda", topology="1x1x1", target_config=H200)
    place = SingleDeviceSharding(card.devices[0])
    can_use_cuda()
    for name, b, law, function in programs(options.quick):
        d, one = b.x.shape[1], jnp.ones(len(b.x), "float32")
        x, v = jnp.asarray(b.x, "float32"), jnp.asarray(b.v, "float32")
        scene = mpm.Scene(mpm.Grid((b.nodes,) * d, b.spacing), law, gravity=(*[0.0] * (d - 1), -GRAVITY))
        given = scene, jnp.asarray(b.dt), mpm.prepare(scene, mpm.Particles(x, v, b.mass * one, b.volume * one))
        shapes = jax.tree.map(
            lambda a: jax.ShapeDtypeStruct(a.shape, a.dtype, sharding=place) if eqx.is_array(a) else a, given
        )
        told = []
        for kind in ("cuda", "xla"):
            jax.clear_caches()
            with summed_by(kind):
                program = jax.jit(function).trace(*shapes).lower(lowering_platforms=("cuda",)).compile()
            said = program.memory_analysis()
            memory = said.argument_size_in_bytes + said.output_size_in_bytes + said.temp_size_in_bytes
            turns = ", ".join(map(str, loops(program.as_text())))
            told.append(f"{kind}: {turns} launches, {memory / 1e6:.0f} MB")
        print(f"{name:<35} {'; '.join(told)}", flush=True)


if __name__ == "__main__":
    main()
