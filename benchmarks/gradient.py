"""Are gradients right? Reverse-mode gradients of whole rollouts against central differences, in float64.

    python benchmarks/gradient.py

Prints the quick start's gradient, and the relative error of a directional derivative (Young's modulus, Poisson's ratio,
initial velocities and gravity together) for every update, law and description, with the worst of them.
"""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

TIGHT = mpm.ConjugateResidual(rtol=1e-12)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi-implicit": mpm.SemiImplicit(solver=TIGHT, adjoint_solver=TIGHT),
    "backward Euler": mpm.BackwardEuler(rtol=1e-12, adjoint_solver=TIGHT),
}
LAWS = {"fixed corotated": mpm.FixedCorotated, "neo-Hookean": mpm.NeoHookean}
DESCRIPTIONS = {"updated": mpm.UpdatedLagrangian(), "total": mpm.TotalLagrangian()}


def quick_start() -> tuple[float, float]:
    """The README's gradient, at the default solver tolerance of 1e-8, and a central difference of 1 Pa."""
    grid = mpm.Grid(shape=(48, 48), spacing=1 / 32)
    jelly = mpm.fill(mpm.Box((0.3, 0.5), (0.7, 0.9)), grid, particles_per_cell=4, density=1e3)
    walls = mpm.SlipBox((0.125, 0.125), (1.375, 1.375))
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.3), gravity=(0.0, -9.81), boundary=walls)

    def height(stiffness):
        softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
        return mpm.simulate(softer, jelly, t1=0.5, dt=5e-3, method=mpm.SemiImplicit()).final.x[:, 1].mean()

    return float(jax.grad(height)(1e5)), float(height(1e5 + 1) - height(1e5 - 1)) / 2


def directional(method, law, description, steps=20) -> float:
    """Relative error of one directional derivative of a bouncing block's final positions."""
    grid = mpm.Grid((12, 12), 0.1, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3)
    rng = np.random.default_rng(0)
    weights = jnp.asarray(rng.normal(size=block.x.shape))
    wall = mpm.SymmetryPlane(1, 0.0)
    dt = 2e-3 if isinstance(method, mpm.Explicit) else 2e-2

    def outcome(theta):
        E, nu, v, g = theta
        scene = mpm.Scene(grid, law(E, nu), gravity=g, boundary=wall, description=description)
        thrown = eqx.tree_at(lambda q: q.v, block, v)
        return (weights * mpm.simulate(scene, thrown, t1=steps * dt, dt=dt, method=method).final.x).sum()

    v0 = jnp.asarray(0.3 * rng.normal(size=block.v.shape))
    theta = (jnp.asarray(1e5), jnp.asarray(0.3), v0, jnp.asarray([0.5, -2.0]))
    direction = (jnp.asarray(1e4), jnp.asarray(0.02), jnp.asarray(rng.normal(size=v0.shape)), jnp.asarray([0.3, 0.2]))
    exact = sum(jax.tree.leaves(jax.tree.map(lambda g, u: (g * u).sum(), jax.grad(outcome)(theta), direction)))
    h = 1e-4
    value = jax.jit(outcome)
    ends = [value(jax.tree.map(lambda a, u, s=s: a + s * h * u, theta, direction)) for s in (1, -1, 2, -2)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)  # fourth order
    return abs(float(exact / difference) - 1)


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    begun = time.perf_counter()
    exact, difference = quick_start()
    print(f"quick start: gradient {exact:.9e}, central difference {difference:.9e} m/Pa, ", end="")
    print(f"relative difference {abs(exact / difference - 1):.1e}")
    worst = 0.0
    for method_name, method in METHODS.items():
        for law_name, law in LAWS.items():
            for description_name, description in DESCRIPTIONS.items():
                error = directional(method, law, description)
                worst = max(worst, error)
                print(f"{method_name:>15}, {law_name:>15}, {description_name:>8}: {error:.1e}")
    print(f"worst relative error of a gradient: {worst:.1e} ({time.perf_counter() - begun:.0f} s in all)")


if __name__ == "__main__":
    main()
