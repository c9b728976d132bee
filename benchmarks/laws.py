"""What does a law cost? Explicit steps of one block, by law, and the gradient of such steps.

    python benchmarks/laws.py
    python benchmarks/laws.py --quick

Scene A of `throughput.py` (3-D, 97 336 particles on 64³ nodes, 8 a cell, float32), strained by a hundredth or two so
that what yields does: the laws take turns, and medians are compared. What snow adds is against fixed corotated
elasticity, what metal, sand and soil add against Hencky's, their own elastic parts. The gradient is that of ten steps
of a block of 8 000 particles by the law's first parameter, a checkpoint a step.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import mpmjax as mpm

sys.path.append(str(Path(__file__).parent))
from throughput import DENSITY, E_MODULUS, NU, Block, block, medians

LAWS: dict[str, Any] = {
    "neo-Hookean": mpm.NeoHookean(E_MODULUS, NU),
    "fixed corotated": mpm.FixedCorotated(E_MODULUS, NU),
    "snow": mpm.Snow(E_MODULUS, NU),
    "Hencky": mpm.Hencky(E_MODULUS, NU),
    "von Mises": mpm.VonMises(E_MODULUS, NU, yield_stress=5e2, hardening_modulus=1e4),
    "Drucker-Prager": mpm.DruckerPrager(E_MODULUS, NU, friction_angle=0.6),
    "Cam clay": mpm.CamClay(E_MODULUS, NU, friction=1.0, preconsolidation=1e3, cohesion=0.3, hardening=2.0),
    "fluid": mpm.Fluid(E_MODULUS),
    "viscous neo-Hookean": mpm.Viscous(mpm.NeoHookean(E_MODULUS, NU), 1.0),
}


def made(b: Block, law: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """The block of a law, squeezed by two hundredths along one axis and stretched by one along another."""
    one = jnp.ones(len(b.x), b.dtype)
    particles = mpm.Particles(jnp.asarray(b.x, b.dtype), jnp.asarray(b.v, b.dtype), b.mass * one, b.volume * one)
    scene = mpm.Scene(mpm.Grid((b.nodes,) * 3, b.spacing), law, gravity=(0.0, 0.0, -9.81))
    particles = mpm.prepare(scene, particles)
    if particles.F.ndim == 3:
        strained = jnp.asarray([0.98, 1.0, 1.01], b.dtype)
        particles = eqx.tree_at(lambda q: q.F, particles, particles.F * strained)
    return scene, particles


def stepping(b: Block, law: Any, steps: int) -> Callable[[], Any]:
    """Goes on by some steps."""
    scene, particles = made(b, law)
    state = [particles]

    def go() -> None:
        state[0] = jax.block_until_ready(mpm.rollout(scene, state[0], steps=steps, dt=b.dt))

    return go


def differentiating(b: Block, law: Any, steps: int) -> Callable[[], Any]:
    """Value and gradient of some steps."""
    scene, particles = made(b, law)
    leaf = jax.tree.leaves(law)[0]

    def value(number: Any) -> Any:
        flat, tree = jax.tree.flatten(law)
        changed = eqx.tree_at(lambda s: s.material, scene, jax.tree.unflatten(tree, [number, *flat[1:]]))
        run = mpm.simulate(changed, particles, t1=steps * b.dt, dt=b.dt, throw=False)
        return (run.final.x**2).sum()

    gradient = jax.jit(jax.value_and_grad(value))
    return lambda: jax.block_until_ready(gradient(jnp.asarray(leaf, b.dtype)))


def main() -> None:
    """Time and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small block, few repeats")
    options = parser.parse_args()
    particles, nodes, steps, repeats = (5_000, 32, 5, 3) if options.quick else (100_000, 64, 10, 9)
    large, small = block(3, particles, nodes, 8, "float32"), block(3, 8_000, 32, 8, "float32")
    runs = {name: stepping(large, law, steps) for name, law in LAWS.items()}
    gradients = {name: differentiating(small, law, 10) for name, law in LAWS.items()}
    for go in (*runs.values(), *gradients.values()):
        go()
    step = {name: 1e3 * s / steps for name, s in medians(runs, repeats).items()}
    gradient = {name: 1e3 * s / 10 for name, s in medians(gradients, repeats).items()}
    own = {"snow": "fixed corotated", "von Mises": "Hencky", "Drucker-Prager": "Hencky", "Cam clay": "Hencky"}
    print(f"{len(large.x)} particles, {DENSITY:g} kg/m³; gradient of {len(small.x)}")
    for name, ms in step.items():
        added = f", {ms - step[own[name]]:+.1f} ms to {own[name]}" if name in own else ""
        print(f"{name}: {ms:.1f} ms a step{added}; value and gradient {gradient[name]:.1f} ms a step")


if __name__ == "__main__":
    main()
