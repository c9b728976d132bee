"""Snow by explicit and by semi-implicit steps: do they agree, and from which hardening on is the explicit one dearer?

    python benchmarks/snow.py            # writes docs/snow.png and docs/snow.csv
    python benchmarks/snow.py --quick    # coarse, writes nothing

Four scenes as in the reference of `mpmjax.Snow`, in two dimensions: a snowball dropped on the ground, thrown at a wall,
two snowballs that collide, and a wedge driven through a block. Each is run with semi-implicit steps of 5e-4 s, and its
energy is accounted for: what the walls, friction, the return map and each approximation took.

Agreement: the first hundredth of a second after touching, before fragments go their ways, with steps of both kinds that
are halved. What is left between them is the ground's spring, which is stiffer in implicit steps. Each of them goes on
changing a little with the step, alike in both: a transfer smooths, once a step, what the grid does not resolve.

Hardening: with ξ the packed snow stiffens by e^{ξ (1 − J_P)}, and the explicit step is that of its stiffest particle at
any time of the run (`stable_dt` then), where the semi-implicit one stays.
"""

import argparse
import csv
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[1] / "docs"
DENSITY = 400.0
RADIUS = 0.15
SEMI_IMPLICIT = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-3))
DT = 5e-4
HARDENINGS = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0)

Case = tuple[mpm.Scene, mpm.Particles, float]
"""Scene, particles, and the time to run for [s]."""


def ball(grid: mpm.Grid, centre: tuple[float, float], velocity: tuple[float, float]) -> mpm.Particles:
    """A snowball."""
    region = mpm.Ball(centre, RADIUS)
    return mpm.fill(region, grid, particles_per_cell=4, density=DENSITY, velocity=velocity)


def drop(n: int, snow: mpm.Snow) -> Case:
    """Onto the ground, at the speed of a fall from 1.3 m."""
    grid = mpm.Grid((n, 3 * n // 4), 1 / n)
    ground = mpm.SeparatingBox((-np.inf, 0.1), (np.inf, np.inf), friction=0.3)
    scene = mpm.Scene(grid, snow, gravity=(0.0, -9.81), boundary=ground)
    return scene, ball(grid, (0.5, 0.1 + RADIUS + 2 / n), (0.0, -5.0)), 0.1


def against_a_wall(n: int, snow: mpm.Snow) -> Case:
    """Thrown at 10 m/s."""
    grid = mpm.Grid((n, n), 1 / n)
    wall = mpm.SeparatingBox((-np.inf, 0.1), (0.8, np.inf), friction=0.3)
    scene = mpm.Scene(grid, snow, gravity=(0.0, -9.81), boundary=wall)
    return scene, ball(grid, (0.8 - RADIUS - 2 / n, 0.5), (10.0, 0.0)), 0.1


def collision(n: int, snow: mpm.Snow) -> Case:
    """Two at 6 m/s each, half a radius off centre."""
    grid = mpm.Grid((3 * n // 2, n), 1 / n)
    apart = RADIUS + 2 / n
    left = ball(grid, (0.75 - apart, 0.5 + RADIUS / 4), (6.0, 0.0))
    right = ball(grid, (0.75 + apart, 0.5 - RADIUS / 4), (-6.0, 0.0))
    return mpm.Scene(grid, snow, gravity=(0.0, -9.81)), mpm.join(left, right), 0.1


def wedge(n: int, snow: mpm.Snow) -> Case:
    """A block between two walls on the ground, and a blunt wedge that comes down through it at 2 m/s."""
    grid = mpm.Grid((n, n), 1 / n)
    block = mpm.fill(mpm.Box((0.3, 0.1), (0.7, 0.4)), grid, particles_per_cell=4, density=DENSITY)
    walls = mpm.SeparatingBox((0.1, 0.1), (0.9, np.inf), friction=0.5)
    blade = mpm.geometry.Capsule((0.5, 0.45 + 0.03), (0.5, 0.75), 0.03)
    down = mpm.Motion((0.0, 0.15), ((0.0, 0.0), (0.0, -0.3)))
    tool = mpm.SeparatingCollider(blade, down, friction=0.1)
    return mpm.Scene(grid, snow, gravity=(0.0, -9.81), boundary=(walls, tool)), block, 0.15


SCENES: dict[str, Callable[[int, mpm.Snow], Case]] = {
    "drop": drop,
    "wall": against_a_wall,
    "collision": collision,
    "wedge": wedge,
}


def account(name: str, n: int) -> dict[str, Any]:
    """A scene by semi-implicit steps of the reference's size, and where its energy went."""
    scene, particles, t1 = SCENES[name](n, mpm.Snow())
    steps = round(t1 / DT)
    after, budget = mpm.budget(scene, particles, steps=steps, dt=DT, method=SEMI_IMPLICIT)
    run = mpm.simulate(scene, particles, t1=t1, dt=DT, method=SEMI_IMPLICIT, throw=False)
    energy = budget.energy
    before = float(mpm.energy(scene, particles).kinetic)
    terms = {
        "change": energy.change,
        **{f"by {k}": getattr(energy, k) for k in ("boundary", "friction", "solver", "time_integration")},
        **{f"lost to {k}": -getattr(energy, k) for k in ("plastic", "p2g", "g2p", "implicit")},
    }
    sums = {k: float(a.sum()) for k, a in terms.items()}
    packed = np.asarray(after.history.plastic_volume)
    limit = float(mpm.stable_dt(scene, after, safety=1.0))
    statistics = run.statistics
    print(
        f"{name}: {particles.count} particles, {steps} steps of {DT / limit:.1f} times the explicit limit at the end, "
        f"{float(statistics.iterations) / steps:.1f} iterations a step, {int(statistics.unconverged)} unconverged, "
        f"fault {int(statistics.fault)}; J_P from {packed.min():.3f} to {packed.max():.3f}, in "
        f"{mpm.analysis.pieces(scene, after)} pieces; kinetic energy at the start {before:.4g} J"
    )
    print("   " + ", ".join(f"{k} {v:.3g}" for k, v in sums.items()) + " J")
    closing = float(jnp.abs(energy.change - energy.explained).max() / jnp.abs(energy.kinetic).max())
    return {"scene": name, "kinetic at start": before, **sums, "closing": closing}


def agreement(n: int, halvings: int) -> list[dict[str, Any]]:
    """How far the motions of both kinds of steps are apart at the same step, as it is halved, and how far the explicit
    one is from itself at half the step; over how far the snow has moved."""
    scene, particles, _ = drop(n, mpm.Snow())
    t1, first = 0.016, 1e-4

    def end(dt: float, method: Any) -> jax.Array:
        return mpm.simulate(scene, particles, t1=t1, dt=dt, method=method).final.x

    def size(u: jax.Array) -> float:
        return float(jnp.sqrt((u**2).sum(axis=1).mean()))

    dts = [first / 2**k for k in range(halvings + 1)]
    explicit = [end(dt, mpm.Explicit()) for dt in (*dts, dts[-1] / 2)]
    moved = size(explicit[-1] - particles.x)
    rows = []
    for dt, x, finer in zip(dts, explicit[:-1], explicit[1:], strict=True):
        row = {
            "dt_s": dt,
            "between_the_two": size(end(dt, mpm.SemiImplicit()) - x) / moved,
            "explicit_to_half_the_step": size(finer - x) / moved,
        }
        rows.append(row)
        print(
            f"dt = {dt:.3g} s: explicit and semi-implicit {row['between_the_two']:.2e} of the motion apart, explicit "
            f"and explicit of half the step {row['explicit_to_half_the_step']:.2e}"
        )
    return rows


def seconds_of(runs: dict[str, Callable[[], mpm.Run]], repeats: int) -> dict[str, float]:
    """Wall times of runs that take turns, compilation left out: the least of some."""

    def timed(go: Callable[[], mpm.Run]) -> float:
        begun = time.perf_counter()
        assert bool(jax.block_until_ready(go().statistics.healthy)), "the run failed"
        return time.perf_counter() - begun

    rounds = [{name: timed(go) for name, go in runs.items()} for _ in range(repeats + 1)][1:]
    return {name: min(each[name] for each in rounds) for name in runs}


def hardening(n: int, repeats: int, hardenings: tuple[float, ...]) -> list[dict[str, Any]]:
    """Seconds of a drop by both kinds of steps, by ξ."""
    rows = []
    for xi in hardenings:
        scene, particles, t1 = drop(n, mpm.Snow(hardening=xi))

        def limit(scene: mpm.Scene, now: mpm.Particles) -> Any:
            return mpm.stable_dt(scene, now)

        pilot = mpm.simulate(scene, particles, t1=t1, dt=DT, method=SEMI_IMPLICIT, observe=limit)
        steps = int(np.ceil(t1 / float(pilot.observed.min())))
        run = functools.partial(mpm.simulate, scene, particles, t1=t1, throw=False)
        while True:  # at its own steps snow may pack further than the pilot's
            own = run(dt=t1 / steps, observe=limit, save_every=max(1, steps // 50))
            if not own.statistics.healthy:
                steps = int(np.ceil(1.25 * steps))
                continue
            least = float(own.observed.min())
            if t1 / steps <= 1.05 * least:
                break
            steps = int(np.ceil(t1 / least))
        seconds = seconds_of(
            {
                "explicit_s": functools.partial(run, dt=t1 / steps, method=mpm.Explicit()),
                "semi_implicit_s": functools.partial(run, dt=DT, method=SEMI_IMPLICIT),
            },
            repeats,
        )
        row = {
            "hardening": xi,
            "explicit_dt_s": t1 / steps,
            "packed": float(own.final.history.plastic_volume.min()),
            **seconds,
            "iterations": float(pilot.statistics.iterations) / float(pilot.statistics.steps),
        }
        rows.append(row)
        print(
            f"ξ = {xi:g}: explicit {row['explicit_s']:.3g} s in {steps} steps, semi-implicit "
            f"{row['semi_implicit_s']:.3g} s in {round(t1 / DT)} steps of {row['iterations']:.1f} iterations; "
            f"J_P down to {row['packed']:.3f}"
        )
    return rows


def draw(path: Path, agreed: list[dict[str, Any]], costs: list[dict[str, Any]]) -> None:
    """Both as a chart."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for key, label in {
        "between_the_two": "explicit to semi-implicit",
        "explicit_to_half_the_step": "explicit to explicit of half the step",
    }.items():
        left.loglog([r["dt_s"] for r in agreed], [r[key] for r in agreed], "o-", label=label)
    for key, label in {"explicit_s": "explicit", "semi_implicit_s": "semi-implicit"}.items():
        right.semilogy([r["hardening"] for r in costs], [r[key] for r in costs], "o-", label=label)
    left.set(xlabel="Δt [s]", ylabel="distance of two motions, over the motion [-]", title="16 ms of a drop")
    right.set(xlabel="hardening ξ [-]", ylabel="seconds", title="0.1 s of a drop")
    for axes in (left, right):
        axes.grid(alpha=0.3)
        axes.legend()
    figure.savefig(path, dpi=140)
    plt.close(figure)


def main() -> None:
    """Run all three, print, and write what they found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="coarse, write nothing")
    options = parser.parse_args()
    n, halvings, repeats = (32, 2, 1) if options.quick else (64, 5, 5)
    for name in SCENES:
        account(name, n)
    agreed = agreement(n, halvings)
    costs = hardening(n, repeats, HARDENINGS[1:4:2] if options.quick else HARDENINGS)
    if options.quick:
        return
    draw(DOCS / "snow.png", agreed, costs)
    with open(DOCS / "snow.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*agreed[0], *costs[0]])
        writer.writeheader()
        writer.writerows([*agreed, *costs])
    print(f"written {DOCS / 'snow.png'}, {DOCS / 'snow.csv'}")


if __name__ == "__main__":
    main()
