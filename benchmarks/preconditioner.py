"""Claim: how many iterations the diagonal preconditioner saves depends on the scene, its contrast and the step.

Prints the mean iterations of three semi-implicit steps by the mass and by the diagonal, and their ratio, for blocks
whose stiff parts lie in various ways, at 20 and 100 times the explicit limit.

    python benchmarks/preconditioner.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)
SOFT, DENSITY, RATIO = 1e5, 1e3, 0.3
PARTS = {
    "halves": lambda x: x[:, 0] > 0.5,
    "stiff inclusion": lambda x: ((x - 0.5) ** 2).sum(axis=1) < 0.04,
    "soft inclusion": lambda x: ((x - 0.5) ** 2).sum(axis=1) > 0.04,
    "layers": lambda x: np.floor(8 * x[:, -1]) % 2 == 0,
    "homogeneous": lambda x: np.full(len(x), fill_value=True),
}
PRECONDITIONERS = mpm.implicit.MassPreconditioner(), mpm.implicit.DiagonalPreconditioner()


def block(d: int, n: int, part: str, contrast: float) -> tuple[mpm.Scene, mpm.Particles, float]:
    """A unit block of n cells a side on a sticky floor, and the explicit limit dx/c of its stiff part [s]."""
    dx = 1 / n
    grid = mpm.Grid((n + 8,) * d, dx, origin=(-4,) * d)
    particles = mpm.fill(mpm.Box((0.0,) * d, (1.0,) * d), grid, particles_per_cell=2**d, density=DENSITY)
    E = jnp.asarray(np.where(PARTS[part](np.asarray(particles.x)), SOFT * contrast, SOFT))
    floor = mpm.StickyBox((-np.inf,) * (d - 1) + (dx,), (np.inf,) * d)
    scene = mpm.Scene(grid, mpm.NeoHookean(E, RATIO), gravity=(0.0,) * (d - 1) + (-9.81,), boundary=floor)
    modulus = SOFT * contrast * (1 - RATIO) / ((1 + RATIO) * (1 - 2 * RATIO))
    return scene, particles, dx / (modulus / DENSITY) ** 0.5


def iterations(
    scene: mpm.Scene, particles: mpm.Particles, dt: float, preconditioner: mpm.implicit.AbstractPreconditioner
) -> float:
    """Of each of three steps from rest, on average."""
    method = mpm.SemiImplicit(preconditioner=preconditioner, solver=mpm.implicit.ConjugateResidual(max_steps=20000))
    total = 0
    for _ in range(3):
        particles, info = mpm.step(scene, particles, 0.0, dt, method=method)
        total += int(info.solve.iterations)
    return total / 3


def main() -> None:
    """All scenes."""
    for d, n in ((2, 32), (3, 10)):
        for part in PARTS:
            for contrast in (1.0,) if part == "homogeneous" else (10.0, 100.0, 1e4):
                scene, particles, limit = block(d, n, part, contrast)
                row = f"{d}-D, {part:15}, contrast {contrast:7g}:"
                for times in (20, 100):
                    mass, diagonal = (iterations(scene, particles, times * limit, p) for p in PRECONDITIONERS)
                    row += f"  {times:3}x {mass:5.0f} {diagonal:4.0f} ({diagonal / mass:.2f})"
                print(row, flush=True)


if __name__ == "__main__":
    main()
