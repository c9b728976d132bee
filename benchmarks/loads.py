"""Loads against closed forms: a tube under pressure (Lamé), and a bar that is pulled at its end.

python benchmarks/loads.py            # measures, and draws docs/loads.png
python benchmarks/loads.py --quick    # two resolutions, no picture
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import mpmjax as mpm
from mpmjax._types import Array, Float

E, NU, INNER, OUTER, PRESSURE = 1e5, 0.3, 0.5, 1.0, 10.0
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-10, max_steps=20_000)


class Ring(mpm.geometry.AbstractRegion):
    """Between two circles about the origin."""

    inner: float = INNER
    outer: float = OUTER

    @property
    def dim(self) -> int:
        return 2

    def distance(self, x: Float[Array, "m d"]) -> Float[Array, "m"]:
        r = jnp.sqrt((x**2).sum(axis=1) + 1e-30)
        return jnp.maximum(self.inner - r, r - self.outer)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return np.full(2, -self.outer), np.full(2, self.outer)

    def middle(self) -> Float[Array, "d"]:
        return jnp.zeros(2)


def radial(r: np.ndarray) -> np.ndarray:
    """u_r(r) of a tube under internal pressure, in plane strain (G. Lamé)."""
    scale = (1 + NU) * PRESSURE * INNER**2 / (E * (OUTER**2 - INNER**2))
    return scale * ((1 - 2 * NU) * r + OUTER**2 / r)


def tube(cells: int) -> tuple[mpm.Scene, mpm.Particles]:
    """A quarter of the tube with so many cells through its wall, its inner surface under a following pressure."""
    dx = (OUTER - INNER) / cells
    grid = mpm.Grid((2 * cells + 6,) * 2, dx, origin=(-3, -3))
    whole = mpm.fill(mpm.Box((0.0, 0.0), (OUTER, OUTER)), grid, particles_per_cell=16, density=1.0)
    kept = np.asarray(Ring().contains(whole.x))
    particles = mpm.Particles(whole.x[kept], whole.v[kept], whole.mass[kept], whole.volume[kept])
    bore = mpm.Patch(Ring(), mpm.Box((0.0, 0.0), (0.75 * OUTER / 2**0.5,) * 2))
    scene = mpm.Scene(
        grid,
        mpm.FixedCorotated(E, NU),
        boundary=(mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0)),
        description=mpm.TotalLagrangian(),
        loads=mpm.Pressure(bore, PRESSURE),
        boundary_forces=True,
    )
    return mpm.attach(scene, particles), particles


def at_rest(cells: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Radii, radial displacements, and the force on a plane of symmetry over p a, which must be 1 by balance: by one
    step so long that inertia does not count, after which the body is stopped."""
    scene, particles = tube(cells)
    dt = 1e3
    after, _ = mpm.step(scene, particles, 0.0, dt, method=mpm.SemiImplicit(solver=TIGHT))
    still = eqx.tree_at(lambda q: (q.v, q.C), after, (0 * after.v, 0 * after.C))
    _, info = mpm.step(scene, still, 0.0, dt, method=mpm.SemiImplicit(solver=TIGHT))
    r = np.linalg.norm(np.asarray(particles.x), axis=1)
    u = ((np.asarray(after.x) - np.asarray(particles.x)) * np.asarray(particles.x)).sum(axis=1) / r
    return r, u, float(info.boundaries.impulse[0, 0] / dt / (PRESSURE * INNER))


def bar(cells: int) -> float:
    """The greatest error of the displacement of a bar pulled at its end by σ(t) = S sin²(πt/T), over the greatest
    displacement, after half the time that a wave takes along it: u(x, t) = ∫σ(s) ds c/M up to s = t − (L − x)/c."""
    dx, modulus = 1 / cells, 1e4
    law = mpm.FixedCorotated(modulus, 0.0)
    grid = mpm.Grid((cells + 8,), dx, origin=(-3,))
    particles = mpm.fill(mpm.Box((0.0,), (1.0,)), grid, particles_per_cell=2, density=1.0)
    c, S, T = modulus**0.5, 1e-3 * modulus, 0.5 / modulus**0.5
    times = np.linspace(0, T, 400)
    pull = mpm.TimeSeries(times, (S * np.sin(np.pi * times / T) ** 2)[:, None])
    end = mpm.Patch(mpm.Box((0.0,), (1.0,)), mpm.Box((0.9,), (1.1,)))
    scene = mpm.Scene(
        grid, law, boundary=mpm.SymmetryPlane(0, 0.0), description=mpm.TotalLagrangian(), loads=mpm.Traction(end, pull)
    )
    t1 = 0.8 / c
    dt = t1 / max(1, round(t1 / (0.3 * dx / c)))
    run = mpm.simulate(mpm.attach(scene, particles), particles, t1=t1, dt=dt, method=mpm.ImplicitMidpoint())
    X = np.asarray(particles.x[:, 0])
    s = np.clip(t1 - (1 - X) / c, 0, T)
    exact = S * (s / 2 - T / (4 * np.pi) * np.sin(2 * np.pi * s / T)) * c / modulus
    return float(np.abs(np.asarray(run.final.x[:, 0]) - X - exact).max() / exact.max())


def main(quick: bool) -> None:
    """Print the errors, and draw them."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    errors = []
    for cells in (4, 8) if quick else (4, 8, 16, 32):
        r, u, balance = at_rest(cells)
        error = float(np.sqrt(((u - radial(r)) ** 2).mean() / (radial(r) ** 2).mean()))
        errors.append((cells, error, bar(4 * cells)))
        print(
            f"{cells:3} cells through the wall: displacement wrong by {error:.2e}, plane's force over p a "
            f"{balance:+.5f}; bar of {4 * cells} cells: {errors[-1][2]:.2e}",
            flush=True,
        )
        left.plot(r, u / radial(np.array([INNER])), ".", ms=2, label=f"{cells} cells")
    fine = np.linspace(INNER, OUTER)
    left.plot(fine, radial(fine) / radial(np.array([INNER])), "k-", lw=1, label="Lamé")
    left.set(xlabel="radius [m]", ylabel="radial displacement / that of the bore", title="tube under pressure")
    left.legend(markerscale=4)
    cells, tubes, bars = (np.array(a) for a in zip(*errors, strict=True))
    right.loglog(cells, tubes, "o-", label="tube, particles on a lattice")
    right.loglog(cells, bars, "s-", label="bar pulled at its end")
    right.loglog(cells, bars[0] * (cells / cells[0]) ** -2.0, "k:", label="second order")
    right.set(xlabel="cells", ylabel="relative error of displacement")
    right.legend()
    if not quick:
        figure.savefig(Path(__file__).parents[1] / "docs" / "loads.png", dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main("--quick" in sys.argv)
