"""What a film of a falling body tells of its material: elastic, fluid, paste, plasticine and sand, each from clouds
of points of which nobody knows which is which.

The families are those of X. Li et al., "PAC-NeRF", ICLR 2023. Each body falls on a floor and is seen in eight frames,
as points with noise. Its parameters are fitted on two grids and extrapolated. The film is made by another
discretisation: a grid four times finer than the finer of the two, with another kernel, transfer, gradient and step, and
for the elastic body and the fluid another integrator.

    python examples/video_families.py                  # all of them
    python examples/video_families.py --family sand    # one of them

Either puts its rows into video_families.csv. With --third a third grid is fitted too, of which the film's is twice
as fine; these rows are only printed.
"""

# %% The bodies
import argparse
import csv
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

DENSITY, SPEED = 1000.0, 1.0  # kg/m³, m/s at the start
HALF, HEIGHT, WIDTH, TOP = 0.2, 0.4, 1.0, 0.48  # of the body's right half, and of the window [m]
FRAMES = np.arange(1, 9) / 20  # s
NOISE = 2e-3  # m, of a point's coordinate
POINTS = 4000
PICTURE = mpm.fitting.Density(mpm.Grid((23, 14), 0.05, origin=(-2, -2)))  # as wide as what may be seen, and a margin
STEP = 2.5e-3  # s, of the fit on the coarsest grid
SHARED = 1 / 3.6  # neighbouring pixels share points: so many of them are worth one


class Family(NamedTuple):
    """A law, what is looked for of it, and where the search starts."""

    law: Callable[..., Any]
    truth: dict[str, float]
    start: dict[str, float]
    parameters: dict[str, Any]
    friction: float = 0.0  # of the floor
    filmed_by: mpm.stepping.AbstractIntegrator = mpm.Explicit()  # implicit steps stiffen what yields
    film_steps: int = 25  # a frame, on the coarsest grid


def young(mu: Any, kappa: Any) -> tuple[Any, Any]:
    """Young's modulus [Pa] and Poisson's ratio, from the moduli of shear and of volume [Pa]."""
    return 9 * kappa * mu / (3 * kappa + mu), (3 * kappa - 2 * mu) / (2 * (3 * kappa + mu))


def set_angle(e: mpm.Experiment, degrees: Any) -> mpm.Experiment:
    """The experiment with another friction angle."""
    return eqx.tree_at(lambda e: law_of(e).friction_angle, e, jnp.deg2rad(degrees))


def set_modulus(name: str) -> Callable[[mpm.Experiment, Any], mpm.Experiment]:
    """The experiment with another mu or kappa of a law that has E and nu."""

    def update(e: mpm.Experiment, value: Any) -> mpm.Experiment:
        E, nu = e.scene.material.youngs_modulus, e.scene.material.poisson_ratio
        moduli = {"mu": E / (2 * (1 + nu)), "kappa": E / (3 * (1 - 2 * nu)), name: value}
        return eqx.tree_at(lambda e: (law_of(e).youngs_modulus, law_of(e).poisson_ratio), e, young(**moduli))

    return update


def law_of(e: mpm.Experiment) -> Any:
    return e.scene.material


YOUNG = mpm.Positive(lambda e: law_of(e).youngs_modulus, unit="Pa")
POISSON = mpm.Bounded(lambda e: law_of(e).poisson_ratio, lower=0.0, upper=0.49)
YIELD = mpm.Positive(lambda e: law_of(e).yield_stress, unit="Pa")
FAMILIES = {
    "elastic": Family(
        mpm.NeoHookean,
        {"E": 2e4, "nu": 0.3},
        {"E": 3e4, "nu": 0.2},
        {"E": YOUNG, "nu": POISSON},
        filmed_by=mpm.SemiImplicit(beta=0.5),
        film_steps=6,
    ),
    "newtonian": Family(
        lambda eta, kappa: mpm.Viscous(mpm.Fluid(kappa), eta),
        {"eta": 50.0, "kappa": 2e4},
        {"eta": 80.0, "kappa": 3e4},
        {
            "eta": mpm.Positive(lambda e: law_of(e).shear_viscosity, unit="Pa s"),
            "kappa": mpm.Positive(lambda e: law_of(e).law.bulk_modulus, unit="Pa"),
        },
        friction=0.5,
        filmed_by=mpm.SemiImplicit(beta=0.5),
        film_steps=6,
    ),
    "non-newtonian": Family(
        lambda mu, kappa, tau_Y, eta: mpm.HerschelBulkley(*young(mu, kappa), yield_stress=tau_Y, consistency=eta),
        {"mu": 4e3, "kappa": 2e4, "tau_Y": 600.0, "eta": 40.0},
        {"mu": 6e3, "kappa": 3e4, "tau_Y": 400.0, "eta": 60.0},
        {
            "mu": mpm.Positive(update=set_modulus("mu"), start=6e3, unit="Pa"),
            "kappa": mpm.Positive(update=set_modulus("kappa"), start=3e4, unit="Pa"),
            "tau_Y": YIELD,
            "eta": mpm.Positive(lambda e: law_of(e).consistency, unit="Pa s"),
        },
        friction=0.5,
    ),
    "plasticine": Family(
        mpm.VonMises,
        {"E": 2e4, "nu": 0.3, "tau_Y": 1500.0},
        {"E": 3e4, "nu": 0.2, "tau_Y": 2250.0},
        {"E": YOUNG, "nu": POISSON, "tau_Y": YIELD},
    ),
    "sand": Family(
        lambda theta: mpm.DruckerPrager(2e4, 0.3, friction_angle=np.deg2rad(theta)),
        {"theta": 30.0},
        {"theta": 20.0},
        {"theta": mpm.Bounded(update=set_angle, lower=5.0, upper=60.0, start=20.0, unit="degrees")},
        friction=0.5,
    ),
}


def scene_of(family: Family, values: dict[str, Any], n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """The right half of a square body above a floor, 5n by 10n cells."""
    dx = HALF / (5 * n)
    cells = round(WIDTH / dx) + 6, round(TOP / dx) + 6
    grid = mpm.Grid(cells, dx, origin=(-3, -3))
    floor = mpm.ContactPlane(1, 0.0, friction=family.friction)
    walls = mpm.SymmetryPlane(0, 0.0), floor
    scene = mpm.Scene(grid, family.law(*values.values()), gravity=(0.0, -9.81), boundary=walls, **choices)
    body = mpm.Box((0.0, 0.0), (HALF, HEIGHT))
    return scene, mpm.fill(body, grid, particles_per_cell=4, density=DENSITY, velocity=(0.0, -SPEED))


# %% The film: points with noise
def film(family: Family, n: int) -> list[np.ndarray]:
    """The clouds of all frames, shape (m, 2) each, of a body of 5n by 10n cells: a part of its particles at random."""
    choices = {"kernel": mpm.BSpline(3), "gradient": mpm.SplineGradient(), "transfer": mpm.FLIP(0.99)}
    scene, particles = scene_of(family, family.truth, n, **choices)
    every = family.film_steps * n
    run = mpm.simulate(
        scene, particles, t1=float(FRAMES[-1]), dt=FRAMES[0] / every, method=family.filmed_by, save_every=every
    )
    rng, clouds = np.random.default_rng(0), []
    for x in np.asarray(run.frames.x)[1:]:
        seen = rng.choice(len(x), min(POINTS, len(x)), replace=False)
        clouds.append(x[seen] + NOISE * rng.normal(size=(len(seen), 2)))
    return clouds


# %% The fit
def experiment(family: Family, clouds: list[np.ndarray], n: int) -> mpm.Experiment:
    """The fall on n times as many cells a direction, and the pictures that the clouds are.

    A fit keeps a picture and its derivative by each parameter for each step: on the finer grid 320 steps of 322 pixels,
    for the paste with its four parameters 4 MB.
    """
    pictures = [PICTURE.of_points(cloud, DENSITY * HALF * HEIGHT) for cloud in clouds]
    seen = mpm.Series(FRAMES, pictures, PICTURE, weight=SHARED, name="pictures")
    scene, particles = scene_of(family, family.start, n)
    return mpm.Experiment(scene, particles, t1=float(FRAMES[-1]), dt=STEP / n, observations=seen)


def fitted(
    family: Family, clouds: list[np.ndarray], grids: tuple[int, ...], progress: Any = None
) -> mpm.fitting.RefinedFit:
    """The parameters from the clouds, on several grids, extrapolated."""
    build = partial(experiment, family, clouds)
    return mpm.fitting.fit_refined(
        build,
        family.parameters,
        refinements=grids,
        optimiser=mpm.fitting.LevenbergMarquardt(rtol=1e-4),
        progress=progress,
    )


# %% The table
TABLE = Path("video_families.csv")
HEAD = ["family", "parameter", "unit", "start", "true", "found", "lower", "upper", "noise", "discretisation", "seconds"]


def rows_of(name: str, result: mpm.fitting.RefinedFit, seconds: float) -> list[list[Any]]:
    """The rows of a family; seconds are those of its fits, without the film."""
    family = FAMILIES[name]
    parts = zip(family.truth, result.estimates, result.from_noise, result.from_discretisation, strict=True)
    return [
        [name, label, e.unit, family.start[label], family.truth[label]]
        + [float(f"{x:.5g}") for x in (e.value, *e.interval, noise, left)]
        + [round(seconds)]
        for label, e, noise, left in parts
    ]


def write(rows: list[list[Any]]) -> None:
    """Put the rows of families into the table, in the place of older ones."""
    known = list(csv.reader(TABLE.open(encoding="utf-8")))[1:] if TABLE.exists() else []
    new = {row[0] for row in rows}
    every = [row for row in known if row[0] not in new] + rows
    every.sort(key=lambda row: list(FAMILIES).index(row[0]))
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([HEAD, *every])


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--family", choices=list(FAMILIES))
    parser.add_argument("--third", action="store_true", help="fit on a third grid too")
    asked = parser.parse_args()
    for name in [asked.family] if asked.family else FAMILIES:
        clouds = film(FAMILIES[name], 8)
        begun = time.perf_counter()
        result = fitted(FAMILIES[name], clouds, (1, 2, 4) if asked.third else (1, 2))
        rows = rows_of(name, result, time.perf_counter() - begun)
        print(f"{name}\n{result}\n", flush=True)
        if not asked.third:
            write(rows)
        for _, label, _, _, true, _, lower, upper, *_ in rows:
            assert lower < true < upper, f"{label} is {true:.4g}, which is not from {lower:.4g} to {upper:.4g}"
