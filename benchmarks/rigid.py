"""A rigid disk that spins is dropped on a soft block, with friction.

python benchmarks/rigid.py                     what its spin turns into, and docs/rigid.png
python benchmarks/rigid.py --quick             the same without a picture
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import ListedColormap

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
    print(f"after 0.6 s: velocity {np.round(np.asarray(body.velocity), 2)} m/s, spin {float(body.spin[0]):.2f} rad/s")
    if not quick:
        draw(run, first)


def draw(run: mpm.Run, first: int) -> None:
    """The block and the disk at four times, the half of the disk that was above in another colour."""
    frames, F = np.asarray(run.frames.x), np.concatenate([np.asarray(a) for a in run.frames.deformations], axis=1)
    side = np.sqrt(np.asarray(run.final.volume))[:, None, None] / 2 * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    squares = frames[:, :, None] + np.einsum("tpij,pkj->tpki", F, side)
    kind = np.where(frames[0, :, 1] > frames[0, first:, 1].mean(), 1.0, 2.0)
    kind[:first] = 0
    look = {"cmap": ListedColormap(["silver", "C0", "C1"]), "clim": (0, 2)}
    figure, axes = plt.subplots(1, len(frames), figsize=(9, 1.9), layout="constrained", sharey=True)
    for axis, x, square, t in zip(axes, frames, squares, np.asarray(run.times), strict=True):
        axis.add_collection(PolyCollection(square, array=kind, antialiaseds=False, **look))
        axis.tripcolor(*x[first:].T, kind[first:], **look)  # between the squares of the disk's rings
        axis.set(aspect="equal", title=f"t = {t:.1f} s", xlim=(-0.1, 2.1), ylim=(0, 1.3), xlabel="x [m]")
    axes[0].set_ylabel("y [m]")
    figure.savefig(DOCS / "rigid.png", dpi=130)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    drop(parser.parse_args().quick)
