"""What a film of a falling body tells of its material: elastic, fluid, paste, plasticine and sand, each from clouds of
points of which nobody knows which is which.

The five families are those of X. Li et al., "PAC-NeRF", ICLR 2023. Each body falls on a floor, is seen in a few frames as
points with noise, and its parameters are fitted on two grids and extrapolated. The film is made by another discretisation:
a grid four times finer than the finer of the two, with another kernel, transfer, gradient and integrator.

    python examples/video_families.py                  # all, a few minutes; writes docs/video_families.csv
    python examples/video_families.py --family sand    # one of them
"""

# %% The bodies
import argparse
import csv
import time
from collections.abc import Callable
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
PICTURE = mpm.Density(mpm.Grid((17, 13), 0.05, origin=(0, 0)))
STEP = 2.5e-3  # s, on the coarsest grid
SHARED = 1 / 3.6  # neighbouring pixels share points: so many of them are worth one


class Family(NamedTuple):
    """A law, what is looked for of it, and where the search starts."""

    law: Callable[..., Any]
    truth: dict[str, float]
    start: dict[str, float]
    parameters: dict[str, mpm.Positive | mpm.Bounded]
    friction: float = 0.0  # of the floor


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
POISSON = mpm.Bounded(lambda e: law_of(e).poisson_ratio, 0.0, 0.49)
YIELD = mpm.Positive(lambda e: law_of(e).yield_stress, unit="Pa")
FAMILIES = {
    "elastic": Family(
        mpm.NeoHookean, {"E": 2e4, "nu": 0.3}, {"E": 3e4, "nu": 0.2}, {"E": YOUNG, "nu": POISSON}
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
    choices = {"kernel": mpm.BSpline(3), "gradient": mpm.SplineGradient(), "transfer": mpm.FLIP(0.95)}
    scene, particles = scene_of(family, family.truth, n, **choices)
    dt, method = 8e-3 / n, mpm.SemiImplicit(beta=0.5)
    every = round(FRAMES[0] / dt)
    run = mpm.simulate(scene, particles, t1=float(FRAMES[-1]), dt=FRAMES[0] / every, method=method, save_every=every)
    rng, clouds = np.random.default_rng(0), []
    for x in np.asarray(run.frames.x)[1:]:
        seen = rng.choice(len(x), min(POINTS, len(x)), replace=False)
        clouds.append(x[seen] + NOISE * rng.normal(size=(len(seen), 2)))
    return clouds


# %% The fit
def fitted(family: Family, clouds: list[np.ndarray], refinements: tuple[int, ...], progress: Any = None) -> mpm.RefinedFit:
    """The parameters from the clouds, on several grids, extrapolated."""
    pictures = [PICTURE.of_points(cloud, DENSITY * HALF * HEIGHT) for cloud in clouds]
    seen = mpm.Series(FRAMES, pictures, PICTURE, weight=SHARED, name="pictures")

    def build(n: int) -> mpm.Experiment:
        scene, particles = scene_of(family, family.start, n)
        return mpm.Experiment(scene, particles, t1=float(FRAMES[-1]), dt=STEP / n, observations=seen)

    return mpm.fit_refined(build, family.parameters, refinements=refinements, rtol=1e-4, progress=progress)


# %% The table
HEAD = ["family", "parameter", "unit", "start", "true", "found", "lower", "upper", "noise", "discretisation", "seconds"]


def table(name: str, refinements: tuple[int, ...]) -> list[list[Any]]:
    """The rows of a family: seconds are those of its fits, without the film."""
    family = FAMILIES[name]
    clouds = film(family, 4 * refinements[-1])
    begun = time.perf_counter()
    result = fitted(family, clouds, refinements)
    seconds = round(time.perf_counter() - begun)
    print(f"{name}\n{result}\n", flush=True)
    parts = zip(family.truth, result.estimates, result.from_noise, result.from_discretisation, strict=True)
    return [
        [name, label, e.unit, family.start[label], family.truth[label], e.value, *e.interval, noise, left, seconds]
        for label, e, noise, left in parts
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--family", choices=list(FAMILIES))
    parser.add_argument("--small", action="store_true", help="grids twice as coarse, for a quick look")
    asked = parser.parse_args()
    grids = (1, 2) if not asked.small else (1, 2)
    rows = [row for name in ([asked.family] if asked.family else FAMILIES) for row in table(name, grids)]
    if asked.family is None and not asked.small:
        with (Path(__file__).parents[1] / "docs" / "video_families.csv").open("w", newline="") as file:
            csv.writer(file).writerows([HEAD, *([f"{x:.5g}" if isinstance(x, float) else x for x in row] for row in rows)])
