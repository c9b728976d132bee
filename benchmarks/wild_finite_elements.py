"""Do fits of a stranger's motions hold the truth? Motions of neo-Hookean solids by finite elements, finer than the fit.

    python benchmarks/wild_finite_elements.py [--only plate,bar] [--draws 2]

A cantilever that begins to sag, of one and of two layers, and a short one that is thrown; a plate with a hole that
starts stretched and spinning; a block that falls on a corner, and springs back from a smooth floor; in three dimensions
a bar, held at its foot, that starts with a twist. Noise, starts and the lines are those of `wild_closed_forms.py`;
Poisson's ratio is fitted too where it is named.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from peers.finite_elements import Mesh, simulate
from wild_closed_forms import DENSITY, Case, G, fit_all

import mpmjax as mpm

FRAMES = 20
E = lambda e: e.scene.material.youngs_modulus  # noqa: E731
NU = lambda e: e.scene.material.poisson_ratio  # noqa: E731


def moved(mesh: Mesh, E: Any, nu: float, t1: float, dt: float, **options: Any) -> Any:
    """Places at the frames' times as the elements move, by places at the start."""
    steps = FRAMES * round(t1 / FRAMES / dt)
    u = simulate(mesh, E, nu, DENSITY, dt=t1 / steps, steps=steps, every=steps // FRAMES, **options)
    return lambda t, X: X + mesh.at(u, X)


def filled(region: Any, grid: mpm.Grid, velocity: Any = None) -> mpm.Particles:
    return mpm.fill(region, grid, particles_per_cell=2**grid.dim, density=DENSITY, velocity=velocity)


def cantilever(moduli: tuple[float, ...]) -> Case:
    """Begins to sag, of layers of equal heights with these moduli, the lowest first."""
    length, height, t1, nu, n = 0.6, 0.12, 0.24, 0.3, len(moduli)
    mesh = Mesh.box((length, height), (96, 20))
    each = np.asarray(moduli)[(n * mesh.X[mesh.elements].mean(axis=1)[:, 1] / height).astype(int)]
    foot = lambda X: X[:, 0] < 1e-9  # noqa: E731
    grid, line = mpm.Grid((46, 25), height / 6, origin=(-6, -17)), np.linspace(0, height, n + 1)
    layers = [filled(mpm.Box((0.0, line[k]), (length, line[k + 1])), grid) for k in range(n)]
    laws = tuple(mpm.NeoHookean(modulus, nu) for modulus in moduli)
    scene = mpm.Scene(
        grid,
        laws if n > 1 else laws[0],
        gravity=(0.0, -G),
        boundary=mpm.ClampPlane(0, 0.0),
        description=mpm.TotalLagrangian(),
    )
    fitted: dict[str, Any] = {f"E{k}": (lambda e, k=k: e.scene.material[k].youngs_modulus, moduli[k]) for k in range(n)}
    if n == 1:
        fitted = {"E": (E, moduli[0])}
    sags = moved(mesh, each, nu, t1, 1.5e-5, gravity=(0.0, -G), held=foot)
    return Case(scene, mpm.join(*layers) if n > 1 else layers[0], t1, 2e-4, sags, fitted)


def thrown() -> Case:
    """A short cantilever in nodes that are held, with a velocity at the start: it bends, shears and stretches."""
    length, height, t1, modulus, nu = 0.4, 0.16, 0.3, 5e4, 0.3
    mesh = Mesh.box((length, height), (80, 32))
    speed = lambda x: jnp.stack([0.0 * x[..., 0], -6.0 * jnp.maximum(x[..., 0], 0.0) ** 2], axis=-1)  # noqa: E731
    grid = mpm.Grid((30, 34), height / 4, origin=(-9, -9))
    body = filled(mpm.Box((-3 * height / 4, 0.0), (length, height)), grid, speed)
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, nu), boundary=mpm.StickyBox((0.0, -np.inf), (np.inf, np.inf)))
    bends = moved(mesh, modulus, nu, t1, 5e-5, v=np.asarray(speed(mesh.X)), held=lambda X: X[:, 0] < 1e-9)
    stays = lambda t, X: np.where(X[:, :1] > 0, bends(t, X), X)  # noqa: E731
    return Case(scene, body, t1, 1e-3, stays, {"E": (E, modulus), "nu": (NU, nu)})


def plate() -> Case:
    """With a hole, that starts stretched by its velocities and spinning."""
    side, radius, t1, modulus, nu = 0.4, 0.08, 0.3, 5e4, 0.35
    middle, slope = np.array([side / 2, side / 2]), np.array([[1.0, -2.0], [2.0, -0.8]])
    mesh = Mesh.box((side, side), (80, 80), hole=lambda X: np.linalg.norm(X - middle, axis=1) < radius)
    geometry = mpm.geometry
    region = geometry.Intersection(
        (mpm.Box((0.0, 0.0), (side, side)), geometry.Complement(mpm.Ball(tuple(middle), radius)))
    )
    grid = mpm.Grid((24, 24), side / 10, origin=(-7, -7))
    body = filled(region, grid, lambda x: (x - middle) @ jnp.asarray(slope.T))
    flies = moved(mesh, modulus, nu, t1, 5e-5, v=(mesh.X - middle) @ slope.T)
    return Case(
        mpm.Scene(grid, mpm.NeoHookean(modulus, nu)), body, t1, 1e-3, flies, {"E": (E, modulus), "nu": (NU, nu)}
    )


def tilted() -> Case:
    """A block that falls on its corner, and springs back from a smooth floor."""
    side, angle, t1, modulus, nu = 0.3, 0.35, 0.25, 5e4, 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    mesh, half = Mesh.box((side, side), (60, 60)), side / 2
    lift = np.array([0.0, half * (np.cos(angle) + np.sin(angle)) + 0.01])
    placed = lambda X: (X - half) @ turn.T + lift  # noqa: E731
    fall = np.tile([0.0, -1.0], (len(mesh.X), 1))
    bounces = moved(mesh, modulus, nu, t1, 2.5e-5, u=placed(mesh.X) - mesh.X, v=fall, gravity=(0.0, -G), floor=0.0)
    grid = mpm.Grid((26, 26), side / 10, origin=(-13, -5))
    region = mpm.geometry.Placed(mpm.Box((-half, -half), (half, half)), displacement=tuple(lift), rotation=angle)
    body = filled(region, grid, (0.0, -1.0))
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, nu), gravity=(0.0, -G), boundary=mpm.ContactPlane(1, 0.0))
    from_start = lambda t, x: bounces(t, (x - lift) @ turn + half)  # noqa: E731
    return Case(scene, body, t1, 5e-4, from_start, {"E": (E, modulus)})


def bar() -> Case:
    """Held at its foot, in three dimensions, that starts with a twist."""
    width, height, t1, modulus, nu, middle = 0.2, 0.4, 0.15, 1e5, 0.3, np.array([0.1, 0.1, 0.0])
    turns = lambda x: 15.0 * x[..., 2:] * (x - middle) @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 0.0]])  # noqa: E731
    mesh = Mesh.box((width, width, height), (12, 12, 24))
    foot = lambda X: X[:, 2] < 1e-9  # noqa: E731
    grid = mpm.Grid((18, 18, 22), width / 6, origin=(-6, -6, -4))
    body = filled(mpm.Box((0.0, 0.0, 0.0), (width, width, height)), grid, turns)
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, nu), boundary=mpm.ClampPlane(2, 0.0))
    twists = moved(mesh, modulus, nu, t1, 1e-4, v=turns(mesh.X), held=foot)
    return Case(scene, body, t1, 1e-3, twists, {"E": (E, modulus)})


CASES: dict[str, Callable[[], Case]] = {
    "cantilever": lambda: cantilever((1e6,)),
    "two layers": lambda: cantilever((4e5, 2e6)),
    "thrown": thrown,
    "plate": plate,
    "tilted": tilted,
    "bar": bar,
}

if __name__ == "__main__":
    fit_all(CASES, __doc__)
