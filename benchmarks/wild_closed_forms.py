"""Do fits of a stranger's motions hold the truth? Closed forms that nothing here was made with.

    python benchmarks/wild_closed_forms.py [--only disc,film] [--draws 2]

A stiff block that slides down a slope of 30 degrees, and one that the friction holds; a disc that slips while it rolls
down it; a film of a viscous liquid that a force along its floor sets in motion; a bar of Kelvin and Voigt that settles
under gravity, and one that vibrates in its second mode; a ring that breathes; a bar that flies against a wall. Markers
are seen with noise of 1 % of what they move by (0.1 mm where nothing moves), and `mpm.fit` finds friction, viscosity
and modulus by default from starts within half a decade.

A line a number: the truth, the estimate, its error, its interval, that of the noise alone, and what the residuals look
like.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

G, SLOPE, DENSITY = 9.81, np.radians(30.0), 1e3
ALONG, ACROSS = G * np.sin(SLOPE), G * np.cos(SLOPE)


class Case(NamedTuple):
    """A motion, seen without noise, and what is fitted to it."""

    scene: mpm.Scene
    particles: mpm.Particles
    t1: float
    dt: float
    moved: Callable[[np.ndarray, np.ndarray], np.ndarray]  # places (t, m, d) by times (t, 1) and places at the start
    fitted: dict[str, tuple[Callable[[mpm.Experiment], Any], float]]  # where it is, and the truth


def on_a_slope(shape: mpm.geometry.AbstractRegion, friction: float, moved: Any, modulus: float = 1e6) -> Case:
    """A stiff body on a slope. It starts without stress, so that friction is less until it has sunk in."""
    grid = mpm.Grid((24, 14), 0.025, origin=(-4, -3))
    body = mpm.fill(shape, grid, particles_per_cell=4, density=DENSITY)
    floor = mpm.ContactPlane(1, 0.0, friction=friction)
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, 0.3), gravity=(ALONG, -ACROSS), boundary=floor)
    return Case(
        scene,
        body,
        0.25,
        2e-4 * (1e6 / modulus) ** 0.5,
        moved,
        {"mu": (lambda e: e.scene.boundary[0].friction, friction)},
    )


def block(friction: float, modulus: float = 1e6) -> Case:
    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        slid = max(ALONG - friction * ACROSS, 0.0) * t**2 / 2
        return X + np.stack([slid, 0 * slid], axis=-1)

    return on_a_slope(mpm.Box((0.0, 0.0), (0.2, 0.1)), friction, moved, modulus)


def disc() -> Case:
    radius, friction = 0.1, 0.1

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        angle, arm = -friction * ACROSS / radius * t**2, X - [radius, radius]
        slid = (ALONG - friction * ACROSS) * t**2 / 2
        turned = np.stack(
            [
                np.cos(angle) * arm[:, 0] - np.sin(angle) * arm[:, 1],
                np.sin(angle) * arm[:, 0] + np.cos(angle) * arm[:, 1],
            ],
            axis=-1,
        )
        return turned + np.stack([radius + slid, radius + 0 * slid], axis=-1)

    return on_a_slope(mpm.Ball((radius, radius), radius), friction, moved)


def film() -> Case:
    """Of depth H on a floor that holds it, pulled along it: ρ u_t = ρ g + η u_yy."""
    depth, pull, eta = 0.1, 2.0, 50.0
    grid = mpm.Grid((8, 16), depth / 8, origin=(0, -4), periodic=(True, False))
    liquid = mpm.fill(mpm.Box((0.0, 0.0), (depth, depth)), grid, particles_per_cell=4, density=DENSITY)
    law = mpm.Viscous(mpm.Fluid(2e5), eta)
    scene = mpm.Scene(grid, law, gravity=(pull, 0.0), boundary=mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf)))

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        nu, y = eta / DENSITY, X[:, 1]
        slid = pull / nu * (depth * y - y**2 / 2) * t
        for k in (np.arange(200) + 0.5) * np.pi / depth:
            slid = slid - 2 * pull / (nu * depth * k**3) * np.sin(k * y) * -np.expm1(-nu * k**2 * t) / (nu * k**2)
        return X + np.stack([slid, 0 * slid], axis=-1)

    return Case(scene, liquid, 0.2, 2.5e-4, moved, {"eta": (lambda e: e.scene.material.shear_viscosity, eta)})


def bar() -> Case:
    """Of length L on its foot, from rest: each mode a damped oscillation about where gravity brings it."""
    length, pull, modulus, poisson, eta = 1.0, 1.0, 8e5, 0.3, 9e3
    grid = mpm.Grid((28,), length / 20, origin=(-4,))
    body = mpm.fill(mpm.Box((0.0,), (length,)), grid, particles_per_cell=2, density=DENSITY)
    law = mpm.Viscous(mpm.NeoHookean(modulus, poisson), eta)
    scene = mpm.Scene(grid, law, gravity=(-pull,), boundary=mpm.StickyBox((0.0,), (np.inf,)))
    square = modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson)) / DENSITY  # c²

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        sunk = 0.0
        for k in (np.arange(200) + 0.5) * np.pi / length:
            half = 2 / 3 * eta / DENSITY * k**2  # of the damping, 4/3 η/ρ k²
            root = np.sqrt(complex(square * k**2 - half**2))
            q = np.exp((-half + 1j * root) * t) * (root - 1j * half) + np.exp((-half - 1j * root) * t) * (
                root + 1j * half
            )
            sunk = sunk + 2 * pull / (square * length * k**3) * np.sin(k * X[:, 0]) * (1 - (q / (2 * root)).real)
        return X - sunk[..., None]

    fitted = {
        "E": (lambda e: e.scene.material.law.youngs_modulus, modulus),
        "eta": (lambda e: e.scene.material.shear_viscosity, eta),
    }
    return Case(scene, body, 0.3, 1e-4, moved, fitted)


def second_mode() -> Case:
    """Of a bar of Kelvin and Voigt held at its foot, three quarters of a wave along it, that starts with a velocity."""
    length, speed, modulus, poisson, eta = 1.0, 0.3, 8e5, 0.3, 1e3
    grid = mpm.Grid((30,), length / 20, origin=(-4,))
    body = mpm.fill(mpm.Box((0.0,), (length,)), grid, particles_per_cell=2, density=DENSITY)
    k = 1.5 * np.pi / length
    body = eqx.tree_at(lambda q: q.v, body, speed * jnp.sin(k * body.x))
    law = mpm.Viscous(mpm.NeoHookean(modulus, poisson), eta)
    scene = mpm.Scene(grid, law, boundary=mpm.StickyBox((0.0,), (np.inf,)))
    square = modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson)) / DENSITY  # c²
    half = 2 / 3 * eta / DENSITY * k**2
    swing = np.sqrt(square * k**2 - half**2)

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        return X + (speed / swing * np.exp(-half * t) * np.sin(swing * t) * np.sin(k * X[:, 0]))[..., None]

    fitted = {
        "E": (lambda e: e.scene.material.law.youngs_modulus, modulus),
        "eta": (lambda e: e.scene.material.shear_viscosity, eta),
    }
    return Case(scene, body, 0.12, 2e-4, moved, fitted)


def ring() -> Case:
    """A thin one in plane strain, which breathes: a quarter between mirrors, ω² = E/((1 − ν²) ρ R²)."""
    radius, half, speed, modulus, poisson = 0.5, 0.05, 0.1, 1e5, 0.3
    grid = mpm.Grid((26, 26), 0.025, origin=(-2, -2))
    whole = mpm.geometry.Annulus((0.0, 0.0), radius - half, radius + half)
    quarter = mpm.geometry.Intersection((whole, mpm.Box((0.0, 0.0), (1.0, 1.0))))
    body = mpm.fill(quarter, grid, particles_per_cell=4, density=DENSITY)
    body = eqx.tree_at(lambda q: q.v, body, speed * body.x / jnp.linalg.norm(body.x, axis=1, keepdims=True))
    mirrors = mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0)
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, poisson), boundary=mirrors)
    swing = np.sqrt(modulus / (1 - poisson**2) / DENSITY) / radius

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        out = X / np.linalg.norm(X, axis=1, keepdims=True)
        return X + (speed / swing * np.sin(swing * t))[..., None] * out

    return Case(scene, body, 0.6, 6e-4, moved, {"E": (lambda e: e.scene.material.youngs_modulus, modulus)})


def struck() -> Case:
    """A bar that flies against a wall: a shock runs up and returns, which throws it back as fast as it came."""
    length, speed, modulus, poisson = 1.0, 0.1, 1e5, 0.3
    grid = mpm.Grid((30,), length / 20, origin=(-4,))
    body = mpm.fill(mpm.Box((0.0,), (length,)), grid, particles_per_cell=2, density=DENSITY)
    body = eqx.tree_at(lambda q: q.v, body, jnp.full_like(body.v, -speed))
    scene = mpm.Scene(grid, mpm.NeoHookean(modulus, poisson), boundary=mpm.ContactPlane(0, 0.0))
    c = np.sqrt(modulus * (1 - poisson) / ((1 + poisson) * (1 - 2 * poisson)) / DENSITY)

    def moved(t: np.ndarray, X: np.ndarray) -> np.ndarray:
        x = X[:, 0]
        return X + (speed * (np.maximum(t - (2 * length - x) / c, 0.0) - np.minimum(t, x / c)))[..., None]

    return Case(scene, body, 0.25, 5e-4, moved, {"E": (lambda e: e.scene.material.youngs_modulus, modulus)})


CASES: dict[str, Callable[[], Case]] = {
    "slides": lambda: block(0.3),
    "slides, stiffer": lambda: block(0.3, 1.6e7),
    "sticks": lambda: block(0.8),
    "disc": disc,
    "film": film,
    "bar": bar,
    "second mode": second_mode,
    "ring": ring,
    "struck": struck,
}


def fit_all(cases: dict[str, Callable[[], Case]], description: str | None) -> None:
    """Fit those that the command line asks for, and print a line a number."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="parts of the names, parted by commas")
    parser.add_argument("--draws", type=int, default=1, help="of the noise; 0: none")
    parser.add_argument("--tables", action="store_true", help="print the whole results")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for name, build in cases.items():
        if not any(part in name for part in asked.only.split(",")):
            continue
        case = build()
        which = np.arange(0, case.particles.count, max(case.particles.count // 10, 1))
        times = case.t1 * np.arange(1, 21) / 20
        at = np.asarray(case.particles.x)[which]
        x = case.moved(times[:, None], at)
        sigma = 0.01 * float(np.ptp(x - at, axis=0).max()) or 1e-4
        for draw in range(max(asked.draws, 1)):
            rng, begun = np.random.default_rng(draw), time.perf_counter()
            shaken = sigma * rng.normal(size=x.shape) * (asked.draws > 0)
            seen = mpm.Tracks(times, x + shaken, which=which, sigma=sigma)
            e = mpm.Experiment(case.scene, case.particles, t1=case.t1, dt=case.dt, observations=seen)
            numbers = {
                label: mpm.Bounded(where, upper=0.49, start=rng.uniform(0.1, 0.4))
                if label == "nu"
                else mpm.Positive(where, start=truth * 10 ** rng.uniform(-0.5, 0.5))
                for label, (where, truth) in case.fitted.items()
            }
            try:
                result = mpm.fit(e, numbers)
            except ValueError as error:
                print(f"{name}, draw {draw}: {error}")
                continue
            if asked.tables:
                print(result)
            for label, (_, truth) in case.fitted.items():
                found, noise = result[label], result.noise[0]
                (a, b), (c, d) = found.interval, found.noise_interval
                print(
                    f"{name:<15} {label:<4} {truth:7g} {found.value:10.5g}: {100 * (found.value / truth - 1):+7.2f} %, "
                    f"{a:9.4g} to {b:9.4g} ({c:9.4g} to {d:9.4g}) {'' if a <= truth <= b else 'MISSED':<6} "
                    f"misfit {noise.misfit:.2f} {noise.shape}{'' if result.converged else ' not converged'}, "
                    f"{time.perf_counter() - begun:.0f} s",
                    flush=True,
                )


if __name__ == "__main__":
    fit_all(CASES, __doc__)
