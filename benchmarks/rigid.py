"""Rigid bodies: one that tumbles, one that rolls on a soft slab, a plate that presses, one that is dropped.

python benchmarks/rigid.py                     all tables, and docs/rigid.png (minutes)
python benchmarks/rigid.py --only roll         one of tumble, roll, plate, drop
python benchmarks/rigid.py --quick             the same, shorter, without a picture
"""

import argparse
import dataclasses
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm
from mpmjax.geometry import RigidBody, rigid_body, spinning

jax.config.update("jax_enable_x64", True)
DOCS = Path(__file__).parents[1] / "docs"
G = 10.0  # m/s²
DENSITY = 1e3  # kg/m^d
HELD = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))


def body_of(particles: mpm.Particles, first: int = 0) -> RigidBody:
    """The rigid body of the particles from the first one on."""
    return rigid_body(*(getattr(particles, name)[first:] for name in ("x", "v", "mass", "volume")))


def tumble(quick: bool) -> None:
    """A block of 4 x 3 x 2 half cells that spins about none of its principal axes, for about two turns."""
    grid = mpm.Grid((12,) * 3, 0.1, origin=(-6,) * 3)
    block = mpm.fill(mpm.Box((-0.2, -0.15, -0.1), (0.2, 0.15, 0.1)), grid, density=DENSITY)
    block = dataclasses.replace(block, v=spinning(jnp.array([1.0, 3.0, 0.5]), block.x))
    scene, start, ends = mpm.Scene(grid, mpm.Rigid(1e6)), body_of(block), []
    for steps in (50, 100, 200) if quick else (50, 100, 200, 400):
        end = body_of(mpm.simulate(scene, block, t1=4.0, dt=4.0 / steps).final)
        energy = (end.spin @ end.inertia @ end.spin) / (start.spin @ start.inertia @ start.spin) - 1
        momentum = end.inertia @ end.spin - start.inertia @ start.spin
        print(f"  {steps} steps: energy {energy:+.0e}, angular momentum {jnp.abs(momentum).max():.0e}")
        ends.append(np.asarray(end.arms))
    changes = [np.sqrt(((b - a) ** 2).sum(axis=1).mean()) for a, b in pairwise(ends)]
    print(f"  where it is, from each to the next [m]: {', '.join(f'{c:.1e}' for c in changes)}")


def roll(quick: bool) -> None:
    """A rigid disk of ten cells' diameter on a slab of 0.1 radians, with friction."""
    R, angle = 0.5, 0.1
    grid = mpm.Grid((46, 22), 0.1, origin=(-3, -3))
    slab = mpm.fill(mpm.Box((0.0, 0.0), (4.0, 0.4)), grid, density=DENSITY)
    disk = mpm.fill(mpm.Ball((0.9, 0.4 + R), R), grid, density=DENSITY, fitted=True)
    gravity = (G * np.sin(angle), -G * np.cos(angle))
    laws = mpm.NeoHookean(1e6, 0.3), mpm.Rigid(1e7)
    scene = mpm.Scene(grid, laws, gravity=gravity, boundary=HELD, bodies=mpm.Bodies(0.5))
    t1 = 0.3 if quick else 1.0
    for name, method, steps in (("explicit", mpm.Explicit(), 1200), ("semi-implicit", mpm.SemiImplicit(), 200)):
        run = mpm.simulate(scene, mpm.join(slab, disk), t1=t1, dt=t1 / steps, method=method)
        body, start = body_of(run.final, slab.count), body_of(disk)
        gyration = float(start.inertia[0, 0] / start.mass) / R**2
        exact = G * np.sin(angle) * t1**2 / 2 / (1 + gyration)
        way = float(body.centre[0] - start.centre[0])
        slips = float(-body.spin[0] * R / body.velocity[0])
        print(f"  {name}: way over that of rolling {way / exact:.4f}, −ωR/v {slips:.3f}")


def plate(quick: bool) -> None:
    """A rigid plate of 400 kg with a force of 500 N on a soft column, at rest: how far it sinks."""
    for cells in (8,) if quick else (8, 16):
        dx = 0.8 / cells
        grid = mpm.Grid((10, cells + 12), dx, origin=(-4, -4))
        foam = mpm.fill(mpm.Box((0.0, 0.0), (2 * dx, 0.8)), grid, density=1.0)
        top = mpm.fill(mpm.Box((0.0, 0.8), (2 * dx, 0.8 + 3 * dx)), grid, density=1.0)
        width = 2 * dx
        top = dataclasses.replace(top, mass=top.mass * 400.0 * width / top.mass.sum())
        sides = mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, width, keep="below"), mpm.SymmetryPlane(1, 0.0)
        push = mpm.PointLoad(mpm.PointsAt(((0.75 * dx, 0.8 + 2.75 * dx),)), (0.0, -500.0 * width))
        laws, particles = (mpm.NeoHookean(1e5, 0.0), mpm.Rigid(1e8)), mpm.join(foam, top)
        scene = mpm.Scene(
            grid, laws, gravity=(0.0, -G), boundary=sides, bodies=mpm.Bodies(), loads=push, boundary_forces=True
        )
        scene = mpm.attach(scene, particles)
        run = mpm.simulate(scene, particles, t1=6.0, dt=0.1, method=mpm.SemiImplicit(), save_every=60)
        force = float(run.boundary_forces().force[-1, 2, 1]) / (-width * (500.0 + 400.0 * G + 0.8 * G))
        stretch = -4500.0 / 1e5 + np.sqrt((4500.0 / 1e5) ** 2 + 1)  # μ (λ − 1/λ) = −4500 Pa, with μ = E/2
        sunk = float((particles.x - run.final.x)[-1, 1])
        spring = 4500.0 / (2 * 1e5 / dx)  # what the contact's springs give
        print(
            f"  {cells} cells: force on the ground over the weights' {force:.8f}, sinking over the column's and the ",
            end="",
        )
        print(f"springs' {sunk / (0.8 * (1 - stretch) + spring):.4f}")


def dropped() -> tuple[mpm.Run, int]:
    """A disk that spins falls on a soft block, with friction."""
    grid = mpm.Grid((26, 20), 0.1, origin=(-3, -3))
    soft = mpm.fill(mpm.Box((0.0, 0.0), (2.0, 0.5)), grid, density=DENSITY)
    disk = mpm.fill(mpm.Ball((0.6, 0.88), 0.3), grid, density=DENSITY, fitted=True)
    centre = disk.x.mean(axis=0)
    disk = dataclasses.replace(disk, v=jnp.array([0.0, -1.0]) + spinning(jnp.array([-10.0]), disk.x - centre))
    laws = mpm.NeoHookean(5e4, 0.3), mpm.Rigid(5e5)
    scene = mpm.Scene(grid, laws, gravity=(0.0, -G), boundary=HELD, bodies=mpm.Bodies(0.5))
    return mpm.simulate(scene, mpm.join(soft, disk), t1=0.6, dt=1e-3, save_every=200), soft.count


def drop(quick: bool) -> None:
    """What the spin of a dropped disk turns into."""
    run, first = dropped()
    body = body_of(run.final, first)
    print(f"  after 0.6 s: velocity {np.round(np.asarray(body.velocity), 2)} m/s, spin {float(body.spin[0]):.2f} rad/s")
    if not quick:
        draw(run, first)


def draw(run: mpm.Run, first: int) -> None:
    """The block and the disk at four times, the half of the disk that was above in another colour."""
    frames = np.asarray(run.frames.x)
    above = frames[0, first:, 1] > frames[0, first:, 1].mean()
    figure, axes = plt.subplots(1, len(frames), figsize=(9, 2.3), layout="constrained", sharey=True)
    for axis, x, t in zip(axes, frames, np.asarray(run.times), strict=True):
        axis.plot(*x[:first].T, ".", color="0.7", markersize=2)
        for half, colour in ((above, "C0"), (~above, "C1")):
            axis.plot(*x[first:][half].T, ".", color=colour, markersize=3)
        axis.set(aspect="equal", title=f"{t:.1f} s", xlim=(-0.1, 2.1), ylim=(-0.05, 1.3))
    figure.savefig(DOCS / "rigid.png", dpi=130)


TABLES: dict[str, Callable] = {"tumble": tumble, "roll": roll, "plate": plate, "drop": drop}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=TABLES)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.only in (None, name):
            print(table.__doc__)
            table(options.quick)
