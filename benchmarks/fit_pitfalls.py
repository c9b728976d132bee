"""What goes wrong in a fit? A picture for each: identifiability, false minima, chaos, the law, the discretisation.

    python benchmarks/fit_pitfalls.py [--only NAME] [--quick]

The body is a bar, held at one end, that vibrates; its exact motion (`mpmjax.verification.VibratingBar`) with noise is
the data. For chaos they are disks that collide in a box.

- identifiability: Σ r² over E and the density, without and with a prior;
- false-minima: Σ r² over E for data of half a period, two, and six; where searches end;
- chaos: the growth of derivatives, and the centre of mass over E, early and late;
- law: the estimate of E by a neo-Hookean law for a linear bar that moves farther and farther;
- discretisation: the estimate of E and its error from noise over the spacing, and the extrapolated one.

Prints the numbers and writes docs/pitfall_NAME.png. `--quick` is smaller and writes nothing.
"""

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.interpolate import RectBivariateSpline

import mpmjax as mpm
from mpmjax.verification import VibratingBar, discretise

jax.config.update("jax_enable_x64", True)
DOCS = Path(__file__).parents[1] / "docs"
E, DENSITY, CELLS, STEPS = 1e4, 1e3, 10, 80
"""Young's modulus [Pa], density [kg/m], cells of the bar of one metre, steps a period."""
SOFT = 5e4
"""Young's modulus of the disks [Pa]."""
STIFFNESS = mpm.Positive(lambda e: e.scene.material.youngs_modulus, unit="Pa")


def bar(amplitude: float = 0.02, law: Any = None) -> VibratingBar:
    """The bar, whose free end moves by so many metres."""
    exact = VibratingBar(length=1.0, density=DENSITY, material=law or mpm.FixedCorotated(E, 0.0))
    return eqx.tree_at(lambda b: b.speed, exact, amplitude * exact.frequency)


def seen(exact: VibratingBar, periods: float, sigma: float, markers: int = 8, frames: int = 24) -> mpm.Tracks:
    """Noisy tracks of the exact motion."""
    X = (np.arange(markers) + 0.5)[:, None] / markers
    times = np.linspace(0, periods * exact.duration, frames + 1)[1:]
    x = jax.vmap(lambda t: jax.vmap(lambda Y: exact.position(Y, t))(jnp.asarray(X)))(jnp.asarray(times))
    noise = sigma * np.random.default_rng(0).normal(size=x.shape)
    _, particles = discretise(exact, CELLS)
    return mpm.Tracks(times, np.asarray(x) + noise, which=mpm.fitting.Markers.at(particles, X), sigma=sigma)


def vibration(exact: VibratingBar, data: mpm.Tracks, cells: int = CELLS, start: float = 1.0) -> mpm.Experiment:
    """The bar simulated, its stiffness first guessed as a multiple of the true one."""
    scene, particles = discretise(exact, cells)
    _, coarse = discretise(exact, CELLS)
    fine = mpm.fitting.Markers.at(particles, np.asarray(data.which(scene, coarse)))
    tracks = mpm.Tracks(data.times, data.data, which=data.which if cells == CELLS else fine, sigma=data.sigma)
    scene = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, jnp.asarray(start * E))
    steps = int(np.ceil(data.times[-1] / exact.duration * STEPS * cells / CELLS))
    dt = float(data.times[-1]) / steps
    return mpm.Experiment(scene, particles, t1=steps * dt, dt=dt, observations=tracks)


def misfit(experiment: mpm.Experiment) -> Callable[[Any, Any], Any]:
    """Σ r² as a function of factors of E and the density."""
    (tracks,) = experiment.observations

    def cost(stiffness: Any, density: Any) -> Any:
        changed = eqx.tree_at(
            lambda e: (e.scene.material.youngs_modulus, e.particles.mass),
            experiment,
            (stiffness * E, density * experiment.particles.mass),
        )
        run = changed.run(throw=False)
        (predicted,) = changed.predictions(run)
        return (tracks.residuals(predicted, tracks.sigma) ** 2).sum()

    return cost


def identifiability(quick: bool) -> plt.Figure:
    """Only the ratio of E to the density is seen; a body that was weighed has both."""
    n, sigma = (7 if quick else 31), 5e-3
    experiment = vibration(bar(), seen(bar(), 1.0, sigma))
    factors = np.linspace(0.7, 1.4, n)
    cost = jax.jit(lambda rho: jax.lax.map(lambda s: misfit(experiment)(s, rho), jnp.asarray(factors), batch_size=8))
    chi = np.stack([np.asarray(cost(rho)) for rho in factors])
    prior = mpm.fitting.Gaussian(1.0, 0.03)
    densities = jnp.asarray(factors)
    weighed = np.asarray(prior.residuals(densities, densities) ** 2)[:, None]
    mass = experiment.particles.mass
    heavier = mpm.Positive(update=lambda e, f: eqx.tree_at(lambda e: e.particles.mass, e, f * mass), start=1.1)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        alone = mpm.fit(experiment, {"E": STIFFNESS, "density": heavier}, starts=1)
    print("without a prior:", alone, *(str(w.message) for w in said), sep="\n")
    known = mpm.Positive(update=heavier.update, start=1.1, prior=prior)
    both = mpm.fit(experiment, {"E": STIFFNESS, "density": known})
    print("weighed to 3 %:", both, sep="\n")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained", sharey=True)
    for axis, values, title in zip(axes, (chi, chi + weighed), ("motion alone", "and weighed to 3 %"), strict=True):
        fine = np.linspace(factors[0], factors[-1], 10 * n)
        smooth = RectBivariateSpline(factors, factors, values)(fine, fine)
        axis.contourf(fine, fine, smooth - smooth.min(), levels=[0, 2.3, 6.2, 11.8], cmap="Blues_r")
        axis.plot(1, 1, "k+")
        axis.set(xlabel="E / true E", title=title)
    axes[0].set_ylabel("density / true density")
    return figure


def false_minima(quick: bool) -> plt.Figure:
    """The more periods, the more minima."""
    n, sigma = (15 if quick else 121), 1e-3
    factors = np.linspace(0.3, 2.2, n)
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for periods in (0.5, 2.0, 6.0):
        experiment = vibration(bar(), seen(bar(), periods, sigma))
        values = jax.jit(lambda f, e=experiment: jax.lax.map(lambda s: misfit(e)(s, 1.0), f))(jnp.asarray(factors))
        axes[0].semilogy(factors, values, label=f"{periods:g} periods")
        starts = np.linspace(0.4, 2.0, 3 if quick else 17)
        ends = []
        for start in starts:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                ends.append(
                    mpm.fit(vibration(bar(), seen(bar(), periods, sigma), start=start), {"E": STIFFNESS}, starts=1)["E"]
                )
        found = np.array([e.value / E for e in ends])
        axes[1].plot(starts, found, "o-", markersize=3, linewidth=0.8, label=f"{periods:g} periods")
        right = np.abs(found - 1) < 0.02
        print(
            f"{periods:g} periods: {right.sum()} of {len(starts)} searches find E, from {starts[right].min():.2g} to "
            f"{starts[right].max():.2g} of it"
        )
    axes[0].set(xlabel="E / true E", ylabel="Σ r²")
    axes[1].set(xlabel="first guess / true E", ylabel="found / true E")
    axes[0].legend()
    return figure


def billiard() -> tuple[mpm.Scene, mpm.Particles]:
    """Disks that fly in a box."""
    grid = mpm.Grid((28, 28), 0.05, origin=(-4, -4))
    places = [(0.2, 0.2), (0.5, 0.25), (0.8, 0.2), (0.25, 0.55), (0.6, 0.6), (0.8, 0.85), (0.35, 0.85)]
    velocities = 2 * np.random.default_rng(3).normal(size=(len(places), 2))
    disks = [
        mpm.fill(mpm.Ball(place, 0.1), grid, particles_per_cell=4, density=DENSITY, velocity=tuple(velocity))
        for place, velocity in zip(places, velocities, strict=True)
    ]
    particles = jax.tree.map(lambda *a: jnp.concatenate(a), *disks)
    return mpm.Scene(grid, mpm.NeoHookean(SOFT, 0.3), boundary=mpm.SeparatingBox((0.0, 0.0), (1.0, 1.0))), particles


def chaos(quick: bool) -> plt.Figure:
    """After many collisions derivatives are right and say nothing."""
    scene, particles = billiard()
    dt, early, late = 2e-3, *((0.1, 0.2) if quick else (1.0, 20.0))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        grown = mpm.analysis.sensitivity(scene, particles, t1=late, dt=dt)
    print(*(str(w.message) for w in said), sep="\n")
    factors = np.linspace(0.98, 1.02, 5 if quick else 41)

    def place(factor: Any) -> Any:
        changed = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, SOFT * factor)
        run = mpm.simulate(changed, particles, t1=late, dt=dt, save_every=round(early / dt), throw=False)
        return run.frames.x[jnp.asarray([1, -1]), :, 0].mean(axis=1)

    centre = np.asarray(jax.jit(lambda f: jax.lax.map(place, f))(jnp.asarray(factors)))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    axes[0].semilogy(grown.times, grown.growth)
    axes[0].axhline(1e3, color="0.6", linewidth=0.8, linestyle="--")
    axes[0].set(xlabel="time [s]", ylabel="growth of a derivative [-]")
    for k, t in enumerate((early, late)):
        axes[1].plot(factors, centre[:, k], ".-", markersize=3, label=f"t = {t:g} s")
        print(f"centre of mass at {t:g} s: {np.abs(np.diff(centre[:, k])).max():.2g} m from one E to the next at most")
    axes[1].set(xlabel=f"E / {SOFT / 1e3:g} kPa", ylabel="centre of mass [m]")
    axes[1].legend()
    return figure


def law(quick: bool) -> plt.Figure:
    """The wrong law's estimate depends on the data, by far more than its error."""
    sigma = 1e-3
    amplitudes = (0.02, 0.1) if quick else (0.02, 0.05, 0.1, 0.15)
    results = []
    for amplitude in amplitudes:
        exact = bar(amplitude)
        experiment = vibration(exact, seen(exact, 0.5, sigma), 2 * CELLS)
        experiment = eqx.tree_at(lambda e: e.scene.laws, experiment, (mpm.NeoHookean(E, 0.0),))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            results.append(mpm.fit(experiment, {"E": STIFFNESS}, starts=1))
        e = results[-1]["E"]
        print(
            f"amplitude {amplitude:g}: E = {e.value / E:.4f} ± {e.error / E:.4f} of the true one, misfit "
            f"{results[-1].noise[0].misfit:.3g} σ, probability {results[-1].p_value:.2g}"
        )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    found = np.array([[r["E"].value, 2 * r["E"].error] for r in results]) / E
    axes[0].errorbar(amplitudes, *found.T, fmt="o-", markersize=3, capsize=2)
    axes[0].axhline(1, color="0.6", linewidth=0.8)
    axes[0].set(xlabel="amplitude [m]", ylabel="E / true E, ± 2 errors")
    for k, label in ((0, f"{amplitudes[0]:g} m"), (-1, f"{amplitudes[-1]:g} m")):
        (fitted,) = results[k].experiments
        (tracks,) = fitted.observations
        (predicted,) = fitted.predictions(fitted.run())
        axes[1].plot(
            tracks.times,
            (np.asarray(predicted)[:, -1, 0] - tracks.data[:, -1, 0]) / sigma,
            "o-",
            markersize=3,
            label=label,
        )
    axes[1].axhspan(-2, 2, color="0.93")
    axes[1].set(xlabel="time [s]", ylabel="last marker: (simulated − measured) / σ")
    axes[1].legend()
    return figure


def discretisation(quick: bool) -> plt.Figure:
    """The grid moves the estimate by many times its error from noise."""
    sigma, exact = 2e-4, bar()
    data = seen(exact, 2.0, sigma)
    cells = (5, 10) if quick else (5, 10, 20, 40)
    coarse = (1, 2) if quick else (1, 2, 4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [mpm.fit(vibration(exact, data, n), {"E": STIFFNESS}, starts=1)["E"] for n in cells]
        refined = mpm.fitting.fit_refined(lambda n: vibration(exact, data, 5 * n), {"E": STIFFNESS}, refinements=coarse)
    for n, e in zip(cells, found, strict=True):
        print(f"{n} cells: E = {e.value / E:.5f} ± {e.noise_error / E:.5f} by noise of the true one")
    print(refined)
    figure, axis = plt.subplots(figsize=(5.6, 3.6), layout="constrained")
    axis.errorbar(
        [1 / n for n in cells],
        [e.value / E for e in found],
        [2 * e.noise_error / E for e in found],
        fmt="o-",
        markersize=3,
        capsize=2,
        label="one grid, ± 2 errors from noise",
    )
    best = refined["E"]
    low, high = (abs(end - best.value) / E for end in best.interval)
    axis.errorbar(
        [0],
        [best.value / E],
        [[low], [high]],
        fmt="s",
        markersize=4,
        capsize=3,
        label="extrapolated from 5, 10 and 20 cells, 95 % interval",
    )
    axis.axhline(1, color="0.6", linewidth=0.8)
    axis.set(xlabel="spacing [m]", ylabel="E / true E")
    axis.legend()
    return figure


PICTURES = {
    "identifiability": identifiability,
    "false_minima": false_minima,
    "chaos": chaos,
    "law": law,
    "discretisation": discretisation,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PICTURES)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    for name, draw in PICTURES.items():
        if options.only in (None, name):
            begun = time.perf_counter()
            print(f"== {name}")
            figure = draw(options.quick)
            if not options.quick:
                figure.savefig(DOCS / f"pitfall_{name}.png", dpi=130)
            print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
