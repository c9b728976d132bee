"""Published scenes that any code can enter: what was asked, and what mpmjax answers with its defaults.

    python benchmarks/published/table.py                      # all
    python benchmarks/published/table.py hanging_bar twist    # some
    python benchmarks/published/table.py pressed_disk --finer 2    # on half the spacing, in steps half as long

Each scene is a file beside this one, which says where it was published and what its source does otherwise. Nothing is
tuned to the answers: kernel, transfer and contact are the defaults, but for the linear kernel where the source has
linear elements in line with the body. Seconds include compiling.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm
from mpmjax.cli._scene_file import read_simulation

HERE = Path(__file__).parent


def mean(run, scene, start):
    """The mean position of the particles [m]."""
    return np.asarray(run.final.x).mean(axis=0)


def slid(run, scene, start):
    """How far the particles have moved along x [m]."""
    return np.asarray(run.final.x - start.x).mean(axis=0)[:1]


def height(run, scene, start):
    """Mean height [m]."""
    return mean(run, scene, start)[1:2]


def corner(run, scene, start):
    """The change of height of the lower corner at (4, 0) [m]: of its particle and of that particle's own corner."""
    p = int(np.argmin(np.hypot(*(np.asarray(start.x) - [4.0, 0.0]).T)))
    F, half = np.asarray(run.final.F)[p], np.array([1.0, -1.0]) * np.sqrt(float(start.volume[p])) / 2
    return (np.asarray(run.final.x)[p] + F @ half - np.asarray(start.x)[p] - half)[1:]


def length(run, scene, start):
    """The length of the bar [mm]: its highest particles, and half the distance that particles had there."""
    z, layers = np.asarray(run.final.x)[:, 2], np.round(np.asarray(start.x)[:, 2], 9)
    below, top = (z[layers == layer].mean() for layer in np.unique(layers)[-2:])
    return np.array([1e3 * (1.5 * top - 0.5 * below)])


def force(run, scene, start):
    """The mean force of the clay on the disk over the last hundred steps, its sign turned [N/m]."""
    return -np.asarray(run.boundary_forces().force)[-1, 2]


def stresses(run, scene, F):
    """Cauchy's stress of an elastic law [Pa], shape (d, d, p)."""
    F = jnp.moveaxis(jnp.asarray(F), 0, -1)
    P = scene.material.stress(F)
    return np.asarray(jnp.einsum("iap,jap->ijp", P, F) / jnp.linalg.det(jnp.moveaxis(F, -1, 0)))


def foot(run, scene, start):
    """The vertical stress of the lowest particles [Pa]."""
    return np.array([stresses(run, scene, run.final.F)[1, 1].min()])


def pulled(run, scene, start):
    """The least and the largest axial stress after 0.3 s and after 0.75 s [Pa]."""
    frames = [int(np.argmin(np.abs(np.asarray(run.times) - t))) for t in (0.3, 0.75)]
    each = [stresses(run, scene, run.frame(k).F)[0, 0] for k in frames]
    return np.array([f(axial) for axial in each for f in (np.min, np.max)])


def pressed(run, scene, start):
    """The inward displacement of the tube's outer surface [nm]: Lamé's, times the mean over the particles of their
    radial displacement over his."""
    x, (inner, outer) = np.asarray(start.x), (0.0125, 0.0375)
    r = np.hypot(*x.T)
    share = ((np.asarray(run.final.x) - x) * x).sum(axis=1) / r / -(r + inner**2 / r)
    return np.array([1e9 * share.mean() * (outer + inner**2 / outer)])


SCENES = {
    "hanging_bar": ("Tesserae.jl", "-1.2187 m", height),
    "taylor_bar": ("Kamoulakos 1990", "21.42 to 21.5 mm", length),
    "implicit_beam": ("Tesserae.jl", "-0.8391 m", corner),
    "twist": ("Tesserae.jl", "0.7284, 0, 0 m", mean),
    "sand_column": ("Tesserae.jl", "0.1184 m", height),
    "pressed_disk": ("Tesserae.jl", "23, -80 N/m", force),
    "dam_break": ("Tesserae.jl", "0.611, 0.288 m", mean),
    "thick_walled_cylinder": ("cb-geo", "23.44 nm exact", pressed),
    "sliding_block": ("cb-geo", "1.987 m exact, 1.620 m", slid),
    "hydrostatic_column": ("cb-geo", "-1748.1 Pa exact, -1680.2 Pa", foot),
    "uniaxial_traction": ("cb-geo", "0.593, 0.597, 1.000, 1.000 Pa", pulled),
}
"""Where a scene was published, what is asked, and how ours is measured."""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="default: all")
    parser.add_argument("--finer", type=int, default=1, help="how many times as fine a grid, and as many steps")
    wanted = parser.parse_args()
    n = wanted.finer
    jax.config.update("jax_enable_x64", True)
    print("| scene | source | asked | ours | particles | cells of the grid | steps | seconds |\n" + 8 * "|---" + "|")
    for name in wanted.names or SCENES:
        source, asked, measure = SCENES[name]
        file = read_simulation(HERE / f"{name}.toml")
        scene, particles = file.build(n)
        settings = {**file.settings, "dt": file.dt / n, "save_every": n * file.save_every}
        begun = time.perf_counter()
        run = mpm.simulate(scene, particles, **settings)
        ours = ", ".join(f"{number:.5g}" for number in measure(run, scene, particles))
        seconds, cells = time.perf_counter() - begun, " x ".join(str(n - 1) for n in scene.grid.shape)
        steps = round(settings["t1"] / float(run.dt))
        size = f"{particles.count} | {cells} | {steps} | {seconds:.0f}"
        print(f"| `{name}` | {source} | {asked} | {ours} | {size} |", flush=True)


if __name__ == "__main__":
    main()
