"""Forces on planes that move and torques on grips that turn, against closed forms.

python benchmarks/boundary_forces.py             # a block pressed, a rod twisted, and docs/boundary_forces.png
python benchmarks/boundary_forces.py --quick     # coarser, no picture
python benchmarks/boundary_forces.py --square    # a square bar twisted alone, by grips and clamps

The block lies between four smooth plates, of which one moves and comes back. Its strain is even to first order, so that
of the force of inertia m a/2, with a the plate's acceleration, the plate itself carries m a/3 and the opposite one
m a/6, beside the law's own stress. The rod is held at one end and turned at the other, without inertia.
"""

import itertools
import sys
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

import mpmjax as mpm

SIDE, DENSITY, LAW = 0.1, 1e3, mpm.NeoHookean(1e6, 0.3)
RADIUS, LENGTH, ANGLE = 0.25, 1.0, 1.0  # of the rod; the angle [rad] by which it is twisted
MU, LAM = float(LAW.shear_modulus), float(LAW.lame_lambda)
SPEED = ((LAM + 2 * MU) / DENSITY) ** 0.5  # of pressure waves [m/s]
PRESSED, TIME = 0.2, 16 * SIDE / SPEED  # the largest strain, and how long it takes to come and go [s]


def way(t: np.ndarray) -> np.ndarray:
    """How far the plate has come at time t over the block's side."""
    return PRESSED * np.sin(np.pi * t / TIME) ** 4


def pressed(cells: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Times, the forces of the block on the four plates, shape (f, 4, 2), and the largest difference between their sum
    and the change of momentum."""
    dx = SIDE / cells
    grid = mpm.Grid((cells + 6,) * 2, dx, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (SIDE, SIDE)), grid, density=DENSITY)
    t = np.linspace(0, TIME, 801)
    plates = (
        mpm.SymmetryPlane(1, SIDE, "below", mpm.Motion(t, np.stack([0 * t, -SIDE * way(t)], axis=1))),
        mpm.SymmetryPlane(1, 0.0),
        mpm.SymmetryPlane(0, 0.0),
        mpm.SymmetryPlane(0, SIDE, "below"),
    )
    scene = mpm.Scene(grid, LAW, boundary=plates, boundary_forces=True, description=mpm.TotalLagrangian())
    run = mpm.simulate(scene, block, t1=TIME, dt=TIME / 800, method=mpm.ImplicitMidpoint(), save_every=8)
    times, force, _ = (np.asarray(a) for a in run.boundary_forces())
    momentum = np.asarray((block.mass[:, None] * run.frames.v).sum(axis=1))
    changed = np.diff(momentum, axis=0) / np.diff(np.asarray(run.times))[:, None]
    return times, force, float(np.abs(force.sum(axis=1) + changed).max())


def closed(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces on the moving plate, on the one below and on one at a side, along the normals out of the block [N]."""
    s, h = 1 - way(t), 1e-3 * TIME
    stress = MU * (s - 1 / s) + LAM * np.log(s) / s
    inertia = DENSITY * SIDE**3 * -(way(t + h) - 2 * way(t) + way(t - h)) / h**2  # m a, a upwards
    return -SIDE * stress - inertia / 3, -SIDE * stress + inertia / 6, -SIDE * LAM * np.log(s)


def twisted(
    across: int, order: int, clamped: bool, *, square: bool = False, per_side: int = 2
) -> tuple[np.ndarray, np.ndarray, int]:
    """Angles, the torques on both grips or clamps, shape (f, 2), and the number of particles, of the rod or of a square
    bar as wide."""
    dx = 2 * RADIUS / across
    half = across // 2 + 3
    grid = mpm.Grid((2 * half, 2 * half, round(LENGTH / dx) + 6), dx, origin=(-half, -half, -3))
    region = mpm.geometry.Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, LENGTH), RADIUS)
    still, steps, angle, t1 = ((0.0, 0.0, 0.0),) * 2, 10, ANGLE, 1e3
    if square:
        region, steps, angle = mpm.Box((-RADIUS, -RADIUS, 0.0), (RADIUS, RADIUS, LENGTH)), 2, 0.02
    rod = mpm.fill(region, grid, particles_per_cell=per_side**3, density=DENSITY)
    turn = mpm.RigidMotion((0.0, t1), still, ((0.0, 0.0, 0.0), (0.0, 0.0, angle)), (0.0, 0.0, LENGTH))
    grips = (
        mpm.Grip(mpm.Box((-9.0, -9.0, -9.0), (9.0, 9.0, 0.0)), mpm.Motion((0.0, t1), still)),
        mpm.Grip(mpm.Box((-9.0, -9.0, LENGTH), (9.0, 9.0, 9.0)), turn),
    )
    if clamped:
        grips = mpm.ClampPlane(2, 0.0), mpm.ClampPlane(2, LENGTH, "below", turn)
    choices = {"kernel": mpm.BSpline(order), "gradient": mpm.SplineGradient(), "description": mpm.TotalLagrangian()}
    scene = mpm.Scene(grid, LAW, boundary=grips, boundary_forces=True, **choices)
    run = mpm.simulate(scene, rod, t1=t1, dt=t1 / steps, method=mpm.BackwardEuler(), save_every=1)
    torque = np.asarray(run.boundary_forces().torque[:, :, 2])
    return angle * np.arange(1, steps + 1) / steps, torque, rod.count


def square() -> None:
    """Print torques of a square bar over Saint-Venant's 0.1406 μ a⁴ θ/L, of small angles."""
    cases = (4, 2, 2), (4, 2, 3), (4, 1, 2), (8, 2, 2)  # cells across, order of the kernel, particles along an edge
    for (across, order, per_side), clamped in itertools.product(cases, (False, True)):
        angle, torque, count = twisted(across, order, clamped, square=True, per_side=per_side)
        share = np.abs(torque[-1]) / (0.1406 * MU * (2 * RADIUS) ** 4 * angle[-1] / LENGTH)
        held = "clamps" if clamped else "grips"
        print(f"square bar, {across} cells, {held}, order {order}, {count} particles: {share}", flush=True)


def main(quick: bool) -> None:
    """Print the differences, and draw the forces."""
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    t, force, unbalanced = pressed(8 if quick else 16)
    given = force[:, 0, 1], -force[:, 1, 1], force[:, 3, 0]
    exact, most = closed(t), np.abs(force).max()
    errors = ", ".join(f"{np.abs(a - b).max() / most:.4f}" for a, b in zip(given, exact, strict=True))
    print(f"pressed: forces on plates (moving, below, side) less closed forms, over the largest force: {errors}")
    print(f"pressed: sum of forces and change of momentum, over the largest force: {unbalanced / most:.1e}")
    names = "plate that moves", "plate opposite", "plate at a side"
    for name, a, b, colour in zip(names, given, exact, ("C0", "C1", "C2"), strict=True):
        left.plot(1e3 * t, a / 1e3, colour, lw=3, alpha=0.5, label=name)
        left.plot(1e3 * t, b / 1e3, "k--", lw=0.8, label="closed form" if colour == "C2" else None)
    left.set(xlabel="time [ms]", ylabel="force [kN/m]", title="block pressed by 20 % and released")
    left.legend(frameon=False, fontsize=9)
    unit = MU * np.pi * RADIUS**4 / 2 / LENGTH
    cases = ((4, 2, False), (4, 2, True)) if quick else ((4, 2, False), (8, 2, False), (8, 1, False))
    for across, order, clamped in cases if quick else (*cases, (4, 2, True), (8, 2, True)):
        angle, torque, count = twisted(across, order, clamped)
        share = torque * np.array([1, -1]) / (unit * angle[:, None])
        print(
            f"twisted by {'clamps' if clamped else 'grips'}, {across:2} cells across, kernel of order {order}, {count} "
            f"particles: torque over closed form, at rest {share[0, 0]:.4f} to {share[-1, 0]:.4f}, other "
            f"{share[0, 1]:.4f} to {share[-1, 1]:.4f}",
            flush=True,
        )
        if clamped:
            right.plot(angle, -torque[:, 1] / 1e3, "o", ms=3, mfc="none", label=f"{across} cells, clamped")
        elif order == 2:
            right.plot(angle, -torque[:, 1] / 1e3, "o", ms=3, label=f"{across} cells across")
        else:
            right.plot(angle, -torque[:, 1] / 1e3, "kx", ms=5, label=f"{across} cells, linear kernel")
    right.plot([0, ANGLE], [0, unit * ANGLE / 1e3], "k--", lw=0.8, label="µπR⁴θ/(2L)")
    right.set(xlabel="angle of the grip [rad]", ylabel="torque [kN m]", title="rod twisted by a grip that turns")
    right.legend(frameon=False, fontsize=9)
    if not quick:
        figure.savefig(Path(__file__).parents[1] / "docs" / "boundary_forces.png", dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    square() if "--square" in sys.argv else main("--quick" in sys.argv)
