"""Where walls that move and grips that turn break: the figures of docs/boundaries.md.

python benchmarks/moving_boundaries.py             # a few minutes
python benchmarks/moving_boundaries.py --quick     # one case of each

Three problems: a bar of unit density and modulus whose end is set in motion at once; one that a wall presses slowly, or
draws back from; one in two dimensions that a grip turns slowly by a right angle, which should not strain it.
"""

import sys
import warnings
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import mpmjax as mpm

Wall = Callable[[mpm.Motion], mpm.boundary.AbstractBoundary]
WALLS: dict[str, Wall] = {
    "SymmetryPlane": lambda m: mpm.SymmetryPlane(0, 0.0, motion=m),
    "SlipBox": lambda m: mpm.SlipBox((0.0,), (np.inf,), m),
    "Grip": lambda m: mpm.Grip(mpm.Box((-1.0,), (0.0,)), m),
    "SeparatingCollider": lambda m: mpm.SeparatingCollider(mpm.HalfSpace((0.0,), (1.0,)), m),
}
DESCRIPTIONS = {"updated": mpm.UpdatedLagrangian(), "total": mpm.TotalLagrangian()}


def bar(cells: int, boundary: Any, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A bar from 0 to 1."""
    grid = mpm.Grid((cells + 16,), 1 / cells, origin=(-4,))
    particles = mpm.fill(mpm.Box((0.0,), (1.0,)), grid, particles_per_cell=2, density=1.0)
    law = mpm.FixedCorotated(1.0, 0.0)
    return mpm.Scene(grid, law, boundary=boundary, boundary_forces=True, **choices), particles


def jump(wall: str, number: float, ramp: int) -> str:
    """The end of a bar of 40 cells is moved at V from t = 0, or after a ramp of some cells, in steps of `number` dx/c:
    the impulse of the first step over ρ dx V, the largest force and that after 0.3 L/c over ρcV."""
    cells, V, t1 = 40, 0.01, 0.6
    t = np.linspace(0, max(ramp, 1) / cells, 201)
    d = V * t**2 / (2 * t[-1]) if ramp else V * t
    motion = mpm.Motion(np.append(t, 10.0), np.append(d, d[-1] + V * (10 - t[-1]))[:, None])
    scene, particles = bar(cells, WALLS[wall](motion), description=mpm.TotalLagrangian())
    dt = t1 / round(t1 / number * cells)
    run = mpm.simulate(scene, particles, t1=t1, dt=dt, save_every=1)
    times, force, _ = (np.asarray(a) for a in run.boundary_forces())
    F = -force[:, 0, 0] / V
    late = F[times > 0.3]
    return (
        f"impulse {F[0] * dt * cells:.2f}, peak {F.max():.2f}, later {late.mean():.3f} ± {np.abs(late - 1).max():.3f}"
    )


def press(wall: str, description: str, travel: float) -> str:
    """A bar of 20 cells held at its far end is pressed slowly by so many cells: the force at every third of a cell over
    that of an even strain, and the range of J."""
    cells, t1 = 20, 1e4
    motion = mpm.Motion((0.0, t1), ((0.0,), (travel / cells,)))
    held = WALLS[wall](motion), mpm.SlipBox((-np.inf,), (1.0,))
    scene, particles = bar(cells, held, description=DESCRIPTIONS[description])
    run = mpm.simulate(scene, particles, t1=t1, dt=t1 / 400, method=mpm.BackwardEuler(), save_every=5)
    times, force, _ = (np.asarray(a) for a in run.boundary_forces())
    share = -force[:, 0, 0] / (times / t1 * travel / cells)
    J = np.asarray(run.final.F)
    shown = " ".join(f"{share[round(80 * n / 3 / abs(travel)) - 1]:.2f}" for n in range(1, round(3 * abs(travel)) + 1))
    return f"{shown}; J {J.min():.2f} to {J.max():.2f}"


def turn(method: Any, step: float) -> str:
    """A bar that a grip turns by a right angle in steps of about so many radians: the largest strain, and the speed of
    a particle in the grip over that of the circle."""
    grid = mpm.Grid((40, 40), 0.1, origin=(-20, -20))
    particles = mpm.fill(mpm.Box((-0.3, -0.2), (1.0, 0.2)), grid, density=1.0)
    n, angle = round(np.pi / 2 / step), np.pi / 2
    t1 = 100.0 * n
    motion = mpm.RigidMotion((0.0, t1), ((0.0, 0.0),) * 2, (0.0, angle), (0.0, 0.0))
    grip = mpm.Grip(mpm.Box((-9.0, -9.0), (0.0, 9.0)), motion)
    scene = mpm.Scene(grid, mpm.NeoHookean(1e6, 0.3), boundary=grip, description=mpm.TotalLagrangian())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = mpm.simulate(scene, particles, t1=t1, dt=t1 / n, method=method)
    F = np.asarray(run.final.F)
    strain = np.abs(np.einsum("pki,pkj->pij", F, F) - np.eye(2)).max() / 2
    speed = np.linalg.norm(np.asarray(run.final.v)[0]) / (angle / t1 * np.linalg.norm(np.asarray(particles.x)[0]))
    return f"strain {strain:.1e}, speed {speed:.4f}"


def main(quick: bool) -> None:
    """Print the three tables."""
    plane = "SymmetryPlane"
    jumps = [(plane, 0.4, 0), (plane, 0.1, 0), (plane, 0.02, 0), ("SlipBox", 0.4, 0), ("Grip", 0.4, 0)]
    jumps += [(plane, 0.1, 4), (plane, 0.1, 8)]
    for wall, number, ramp in jumps[: 1 if quick else None]:
        print(f"jump: {wall}, {number} dx/c, ramp of {ramp} cells: {jump(wall, number, ramp)}", flush=True)
    presses = [("SlipBox", "updated", 3.0), ("SlipBox", "updated", -3.0), ("SlipBox", "total", 3.0)]
    presses += [("SeparatingCollider", "updated", 3.0)]
    for wall, description, travel in presses[: 1 if quick else None]:
        print(f"press: {wall}, {description}, by {travel:g} cells: {press(wall, description, travel)}", flush=True)
    for method in (mpm.SemiImplicit(), mpm.BackwardEuler(), mpm.ImplicitMidpoint(solution=mpm.implicit.Newton())):
        for step in (0.1,) if quick else (0.02, 0.1, 0.3, 0.8):
            print(f"turn: {type(method).__name__}, steps of {step} rad: {turn(method, step)}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main("--quick" in sys.argv)
