"""Batches on several devices: divided by XLA itself, and within `shard_map`. Two processors stand for them."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from helpers import NEEDS_LIBRARY, thorough

PROGRAM = """
import json, re, sys
import jax, jax.numpy as jnp, equinox as eqx
from jax.sharding import AxisType, NamedSharding, PartitionSpec
import mpmjax as mpm

way, method = sys.argv[1], {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit()}[sys.argv[2]]
mesh = jax.make_mesh((2,), ("i",), axis_types=(AxisType.Auto,))
divided = NamedSharding(mesh, PartitionSpec("i"))
grid = mpm.Grid((16, 16), 1 / 16)
scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), gravity=(0.0, -9.81), boundary=mpm.SlipBox((0.2, 0.25), (0.8, 0.8)))
block = mpm.fill(mpm.Box((0.3, 0.3), (0.6, 0.5)), grid, density=1e3, velocity=(0.0, 1.0))

def size(factor):
    thrown = eqx.tree_at(lambda p: p.v, block, factor * block.v)
    return (mpm.simulate(scene, thrown, t1=1e-2, dt=1e-3, method=method, throw=False).final.x**2).sum()

both, factors = jax.value_and_grad(size), jnp.asarray([1.0, 2.0, 3.0, 4.0])
together = jax.vmap(both)
if way == "shard_map":
    together = jax.shard_map(
        together, mesh=mesh, in_specs=PartitionSpec("i"), out_specs=PartitionSpec("i"), check_vma=False
    )
program = jax.jit(together, in_shardings=divided, out_shardings=divided).lower(factors).compile()
text = program.as_text()
print(json.dumps({
    "together": [a.tolist() for a in program(jax.device_put(factors, divided))],
    "alone": [[float(a) for a in jax.jit(both)(f)] for f in factors],
    "gathers whole arrays": "all-gather" in text,
    "native": sorted(set(re.findall(r'custom_call_target="(mpmjax_\\w+)"', text))),
}))
"""


def told(way: str, method: str, program: str = PROGRAM) -> str:
    """What a program prints in a process of its own."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    env = os.environ | {"XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    done = subprocess.run([sys.executable, "-c", program, way, method], env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("method", thorough("explicit", "semi_implicit"))
def test_a_program_that_xla_divides_gathers_nothing(method):
    """It calls no library, which would need whole arrays, and each member has its own value and derivative."""
    found = json.loads(told("divided", method))
    assert not found["gathers whole arrays"]
    assert not found["native"]
    np.testing.assert_allclose(np.transpose(found["together"]), found["alone"], rtol=1e-9)


@NEEDS_LIBRARY
@pytest.mark.thorough
@pytest.mark.parametrize("method", ["explicit", "semi_implicit"])
def test_within_shard_map_each_device_calls_the_library(method):
    """With the value and derivative of each member."""
    found = json.loads(told("shard_map", method))
    assert not found["gathers whole arrays"]
    assert {"mpmjax_gather", "mpmjax_average"} <= set(found["native"])
    np.testing.assert_allclose(np.transpose(found["together"]), found["alone"], rtol=1e-9)


REFUSED = (
    PROGRAM.split("both, factors =")[0]
    + """
both, factors = jax.value_and_grad(size), jnp.asarray([1.0, 2.0])
explicit = jax.make_mesh((2,), ("i",), axis_types=(AxisType.Explicit,))
for together, given in (
    (jax.shard_map(jax.vmap(both), mesh=mesh, in_specs=PartitionSpec("i"), out_specs=PartitionSpec("i")), factors),
    (jax.vmap(both), jax.device_put(factors, NamedSharding(explicit, PartitionSpec("i")))),
):
    try:
        jax.jit(together)(given)
    except ValueError as error:
        print(error)
"""
)


@pytest.mark.thorough
def test_what_neither_loops_nor_sums_know_is_refused_in_own_words():
    """A shard_map that checks what varies, and explicit axes."""
    checked, explicit = told("refused", "explicit", REFUSED).splitlines()
    assert "check_vma=False" in checked
    assert "AxisType.Auto" in explicit
