"""Do fits find what other codes and closed forms made, and do their intervals hold it?

    python benchmarks/wild_fits.py [--only twist,sand] [--draws 2] [--finer 4] [--one-grid] [--refine]
    python benchmarks/wild_fits.py --false-minima [--draws 20]

Motions of a square by an MLS-MPM in NumPy (`peers/numpy_mpm.py`) on a grid `--finer` times as fine as the fit's:
stretched, sheared or twisted as it starts, dropped on a floor, slumping on one that holds it, as two elastic solids;
stretched for four periods; of a disc that is dropped (fitted once more with the floor's height), a tower that sways, an
L, a ring and a cross that spin and stretch, a plank that bends; a fluid and sand that collapse. By closed forms: a
standing wave, a bar that vibrates, a block that is pressed. Markers (of the press force and width) are seen with noise
of 1 % of the amplitude. `mpm.fit` finds E and ν (E alone of wave and bar, the viscosity, the friction angle), from
starts within half a decade, as it does by default; with --one-grid it does not look at twice the spacing; with --refine
`fit_refined` fits on twice as many cells too.

A line a number: the truth, the estimate, its error, both intervals, and the width of the first over the error. Then,
for all and for the motions that the rule of the intervals was not developed on, how many hold the truth.

`--false-minima`: four periods of the stretched square from starts within a decade, how often a single search and the
default end where a fit from the truth does.
"""

import argparse
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers import numpy_mpm

import mpmjax as mpm
from mpmjax.verification import StandingWave, VibratingBar, discretise

E, NU, DENSITY, SIDE, CELLS, DT, STEPS = 5e4, 0.3, 1e3, 0.4, 8, 2e-3, 60
ETA, PHI = 20.0, np.radians(30.0)
MU, LAM = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
CORNER, EVERY, GRAVITY = 0.4, 4, 9.81
MARKERS = np.array([[a, b] for a in (0.05, 0.15, 0.25, 0.35) for b in (0.05, 0.2, 0.35, 0.5, 0.65)])
DEVELOPED = "stretch", "shear", "bounce", "bar"
ON_A_FLOOR, SMOOTH = ("bounce", "disc", "slump", "tower", "fluid", "sand"), ("bounce", "disc", "fluid")
DISC = mpm.Ball((SIDE / 2, SIDE / 2), SIDE / 2)
SHAPES: dict[str, mpm.geometry.AbstractRegion] = {
    "disc": DISC,
    "tower": mpm.Box((0.0, 0.0), (SIDE / 2, 2 * SIDE)),
    "ell": mpm.geometry.Union((mpm.Box((0.0, 0.0), (SIDE, SIDE / 2)), mpm.Box((0.0, SIDE / 2), (SIDE / 2, SIDE)))),
    "ring": mpm.geometry.Intersection((DISC, mpm.geometry.Complement(mpm.Ball(DISC.centre, SIDE / 4)))),
    "cross": mpm.geometry.Union((mpm.Box((0.1, 0.0), (0.3, SIDE)), mpm.Box((0.0, 0.1), (SIDE, 0.3)))),
    "plank": mpm.Box((0.0, 0.0), (SIDE / 4, 1.75 * SIDE)),
}
Build = Callable[[int], mpm.Experiment]


class Case(NamedTuple):
    """A fit to be made."""

    name: str
    build: Build  # the experiment on n times as many cells
    parameters: dict[str, Any]
    truths: dict[str, float]


def stiffness(e: mpm.Experiment) -> Any:
    return e.scene.material.youngs_modulus


def ratio(e: mpm.Experiment) -> Any:
    return e.scene.material.poisson_ratio


def start(scene: str, x: Any) -> Any:
    """The velocity at places in the square [m/s]."""
    s = jnp.pi * (jnp.asarray(x) / SIDE - 0.5)
    if scene in ("stretch", "vibration"):
        return 0.4 * jnp.sin(s) * jnp.asarray([1.0, -0.6])
    if scene == "shear":
        return 0.4 * jnp.stack([jnp.sin(s[:, 1]), jnp.sin(s[:, 0])], axis=1)
    if scene == "twist":
        return 0.8 * jnp.stack([-jnp.cos(s[:, 0]) * jnp.sin(s[:, 1]), jnp.sin(s[:, 0]) * jnp.cos(s[:, 1])], axis=1)
    if scene == "tower":
        return jnp.stack([1.5 * (jnp.asarray(x)[:, 1] / (2 * SIDE)) ** 2, 0 * s[:, 1]], axis=1)
    if scene == "plank":
        return jnp.stack([0.6 * (jnp.sin(jnp.pi * jnp.asarray(x)[:, 1] / (1.75 * SIDE)) - 2 / jnp.pi), 0 * s[:, 1]], 1)
    if scene in ("ell", "ring", "cross"):
        return s / jnp.pi * SIDE @ jnp.asarray([[1.5, 2.0], [-2.0, -1.0]])
    return jnp.zeros_like(s) - jnp.asarray([0.0, 1.2 if scene in ("bounce", "disc") else 0.0])


def steps_of(scene: str) -> int:
    """Steps of a fit's run; what flows takes longer, and a vibration of some periods."""
    return STEPS * {"fluid": 2, "sand": 2, "disc": 2, "tower": 4, "plank": 4, "vibration": 4}.get(scene, 1)


def region(scene: str) -> mpm.geometry.AbstractRegion:
    """What moves: a square if nothing else."""
    return SHAPES.get(scene, mpm.Box((0.0, 0.0), (SIDE, SIDE)))


def markers(scene: str) -> np.ndarray:
    """Those of the markers that lie in what moves."""
    return MARKERS[np.asarray(region(scene).distance(jnp.asarray(MARKERS))) < 0]


def truth(scene: str, law: str, finer: int) -> tuple[np.ndarray, np.ndarray]:
    """Times and places of the markers by the peer, on so much finer a grid."""
    count, spacing = 2 * CELLS * finer, SIDE / CELLS / finer
    line = (np.arange(2 * count) + 0.5) * SIDE / count
    X = np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
    X = X[np.asarray(region(scene).distance(jnp.asarray(X))) < 0]
    laws: dict[str, Callable[[], Any]] = {
        "NeoHookean": lambda: numpy_mpm.NeoHookean(MU, LAM),
        "FixedCorotated": lambda: numpy_mpm.FixedCorotated(MU, LAM),
        "fluid": lambda: numpy_mpm.Fluid(E, ETA),
        "sand": lambda: numpy_mpm.Sand(MU, LAM, PHI, len(X)),
    }
    frames = numpy_mpm.simulate(
        X + CORNER * np.array([2, 1]),
        np.asarray(start(scene, X)),
        density=DENSITY,
        volume=(SIDE / count) ** 2,
        spacing=spacing,
        law=laws[law](),
        dt=DT / finer,
        steps=steps_of(scene) * finer,
        every=EVERY * finer,
        gravity=GRAVITY if scene in ON_A_FLOOR else 0.0,
        floor=CORNER if scene in ON_A_FLOOR else None,
        sticks=scene not in SMOOTH,
    )
    # Each marker lies in the middle of four particles.
    near = np.argsort(np.linalg.norm(X - markers(scene)[:, None], axis=-1), axis=1)[:, :4]
    times = EVERY * DT * np.arange(1, steps_of(scene) // EVERY + 1)
    return times, frames[1:, near].mean(axis=2) - CORNER * np.array([2, 1])


def moved(scene: str, law: str, times: np.ndarray, data: np.ndarray, sigma: float, n: int) -> mpm.Experiment:
    """The same on n times eight cells to the square's side."""
    grid = mpm.Grid((40 * n, 32 * n), SIDE / CELLS / n, origin=(-16 * n, -8 * n))
    q = mpm.fill(region(scene), grid, particles_per_cell=4, density=DENSITY)
    q = eqx.tree_at(lambda q: q.v, q, start(scene, q.x))
    flowing: dict[str, Callable[[], Any]] = {
        "fluid": lambda: mpm.Viscous(mpm.Fluid(E), ETA),
        "sand": lambda: mpm.DruckerPrager(E, NU, PHI),
    }
    law_of = flowing[law]() if law in flowing else getattr(mpm, law)(E, NU)
    # The peer's floor acts on its nodes, and so half a cell of its own early, which the fit is not told.
    smooth, rough = mpm.ContactPlane(1, 0.0), mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))
    floor = () if scene not in ON_A_FLOOR else (smooth,) if scene in SMOOTH else (rough,)
    gravity = (0.0, -GRAVITY if scene in ON_A_FLOOR else 0.0)
    seen = mpm.Tracks(times, data, which=mpm.fitting.Markers.at(q, markers(scene)), sigma=sigma)
    of = mpm.Scene(grid, law_of, gravity=gravity, boundary=floor)
    return mpm.Experiment(of, q, t1=steps_of(scene) * DT, dt=DT / n, observations=seen)


def higher(e: mpm.Experiment, height: Any) -> mpm.Experiment:
    """Its floor, from which what returns loses little, so much higher [m]: all else, data too, lower."""
    wall, by = mpm.SeparatingBox((-np.inf, 0.0), (np.inf, np.inf)), jnp.asarray([0.0, 1.0]) * height
    seen: Any = e.observations[0]
    return eqx.tree_at(
        lambda e: (e.scene.boundary, e.particles.x, e.observations[0].data),
        e,
        ((wall,), e.particles.x - by, seen.data - by),
    )


def vibrated(scene: str, seed: int, n: int) -> mpm.Experiment:
    """A wave on 16 n cells, or a bar on 25 n, by its closed form with noise."""
    exact: Any = StandingWave(0.05) if scene == "wave" else VibratingBar()
    of, particles = discretise(exact, 16 * n if scene == "wave" else n)
    which = np.arange(1, particles.count, 5)
    t1 = 2 * exact.duration
    times = np.arange(1, 21) * t1 / 20
    x = np.asarray(jax.vmap(jax.vmap(exact.position, (0, None)), (None, 0))(particles.X[which], jnp.asarray(times)))
    sigma = 0.01 * float(np.ptp(x - x[:1], axis=0).max())
    noise = sigma * np.random.default_rng(seed).normal(size=x.shape)
    seen = mpm.Tracks(times, x + noise, which=which, sigma=sigma)
    steps = round(t1 / (0.05 / n)) if scene == "bar" else 80 * n
    return mpm.Experiment(of, particles, t1=t1, dt=t1 / steps, observations=seen)


def pressed(seed: int, n: int) -> mpm.Experiment:
    """A quarter of a neo-Hookean block between smooth plates that close by a quarter: the force, and the place of the
    outermost particles, by the closed form of plane strain: μ (a − 1/a) + λ ln(ab)/a = 0, stretches a across and b
    along."""
    grid = mpm.Grid((10 * n, 10 * n), SIDE / CELLS / n, origin=(-2 * n, -2 * n))
    q = mpm.fill(mpm.Box((0.0, 0.0), (SIDE / 2, SIDE / 2)), grid, particles_per_cell=4, density=DENSITY)
    t1, rng = 1.0, np.random.default_rng(seed)
    close = mpm.Motion((0.0, t1), ((0.0, 0.0), (0.0, -SIDE / 8)))
    plate = mpm.SymmetryPlane(1, SIDE / 2, "below", motion=close)
    planes = (mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0), plate)
    times = np.arange(1, 21) * t1 / 20
    b, a = 1 - times / t1 / 4, np.ones(20)
    for _ in range(50):
        a = a - (MU * (a - 1 / a) + LAM * np.log(a * b) / a) / (MU * (1 + 1 / a**2) + LAM * (1 - np.log(a * b)) / a**2)
    force, width = -(MU * (b - 1 / b) + LAM * np.log(a * b) / b) * SIDE / 2, a * float(q.x[:, 0].max())
    size, noise = [0.01 * float(np.ptp(y)) for y in (force, width)], rng.normal(size=(2, 20))
    forces = np.stack([np.full(20, np.nan), force + size[0] * noise[0]], axis=1)
    seen = (
        mpm.fitting.Force(times, forces, boundary=2, sigma=size[0]),
        mpm.Series(times, width + size[1] * noise[1], mpm.fitting.Extent(0), sigma=size[1]),
    )
    of = mpm.Scene(
        grid, mpm.NeoHookean(E, NU), boundary=planes, boundary_forces=True, description=mpm.TotalLagrangian()
    )
    return mpm.Experiment(of, q, t1=t1, dt=t1 / (40 * n), method=mpm.BackwardEuler(), observations=seen)


def cases(draws: int, only: list[str], finer: int) -> Iterator[Case]:
    """The fits whose names have one of some parts, one after the other."""
    elastic = ("stretch", "shear", "twist", "bounce", "slump")
    motions = [(scene, law) for scene in elastic for law in ("NeoHookean", "FixedCorotated")]
    motions += [(scene, "NeoHookean") for scene in ("vibration", *SHAPES)] + [("fluid", "fluid"), ("sand", "sand")]
    for scene, law in [*motions, ("press", ""), ("wave", ""), ("bar", "")]:
        exact = None
        for draw in range(draws):
            rng = np.random.default_rng(draw)
            factor, guess = 10 ** rng.uniform(-0.5, 0.5), rng.uniform(0.1, 0.4)
            name, build = f"{scene}{f', {law}' if law not in ('', scene) else ''}, draw {draw}", partial(pressed, draw)
            if not any(part in name for part in only):
                continue
            if scene in ("wave", "bar"):
                build = partial(vibrated, scene, draw)
                true = float(stiffness(build(1)))
                yield Case(name, build, {"E": mpm.Positive(stiffness, start=true * factor)}, {"E": true})
                continue
            if law:
                times, x = exact = truth(scene, law, finer) if exact is None else exact
                sigma = 0.01 * float(np.ptp(x - x[:1], axis=0).max())
                build = partial(moved, scene, law, times, x + sigma * rng.normal(size=x.shape), sigma)
            if law == "fluid":
                eta = mpm.Positive(lambda e: e.scene.material.shear_viscosity, start=ETA * factor)
                yield Case(name, build, {"eta": eta}, {"eta": ETA})
            elif law == "sand":
                phi = mpm.Bounded(lambda e: e.scene.material.friction_angle, 0.1, 1.2, start=0.2 + 2 * guess)
                yield Case(name, build, {"phi": phi}, {"phi": float(PHI)})
            else:
                both = {
                    "E": mpm.Positive(stiffness, start=E * factor),
                    "nu": mpm.Bounded(ratio, 0.0, 0.49, start=guess),
                }
                yield Case(name, build, both, {"E": E, "nu": NU})
                if scene == "disc":
                    height = mpm.Unbounded(update=higher, start=0.0, scale=0.01)
                    yield Case(f"{name}, height", build, {**both, "height": height}, {"E": E, "nu": NU})


def false_minima(draws: int, finer: int) -> None:
    """How often a vibration's fits find the minimum that a fit from the truth does."""
    times, x = truth("vibration", "NeoHookean", finer)
    sigma, held = 0.01 * float(np.ptp(x - x[:1], axis=0).max()), np.zeros(2, int)
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        seen = moved("vibration", "NeoHookean", times, x + sigma * rng.normal(size=x.shape), sigma, 1)
        ends = []
        for start, starts in ((E, 1), (first := E * 10 ** rng.uniform(-1, 1), 1), (first, "auto")):
            both = {"E": mpm.Positive(stiffness, start=start), "nu": mpm.Bounded(ratio, 0.0, 0.49, start=NU)}
            ends.append(mpm.fit(seen, both, starts=starts, discretisation=False)["E"].value)
        right = np.abs(np.log(np.array(ends[1:]) / ends[0])) < 0.02
        held += right
        print(f"from {first:8.0f}: {ends[1]:8.0f} by one search, {ends[2]:8.0f} by default, {ends[0]:8.0f} from {E:g}")
    print(f"of {draws}: {held[0]} by one search, {held[1]} by default")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="parts of the names, parted by commas")
    parser.add_argument("--draws", type=int, help="of the noise; default 2, of false minima 20")
    parser.add_argument("--finer", type=int, default=4, help="how much finer the peer's grid is; default 4")
    parser.add_argument("--false-minima", action="store_true")
    parser.add_argument("--one-grid", action="store_true")
    parser.add_argument("--refine", action="store_true")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    if asked.false_minima:
        return false_minima(asked.draws or 20, asked.finer)
    rows: list[tuple[bool, bool, bool, float]] = []
    print("motion                             number, truth, estimate: error, interval (by noise alone), width/error")
    for case in cases(asked.draws or 2, asked.only.split(","), asked.finer):
        begun = time.perf_counter()
        if asked.refine:
            result: Any = mpm.fitting.fit_refined(case.build, case.parameters)
            last = result.fits[-1]
        else:
            result = last = mpm.fit(case.build(1), case.parameters, discretisation=not asked.one_grid)
        seconds = time.perf_counter() - begun
        for name, true in case.truths.items():
            e, developed = result[name], case.name.startswith(DEVELOPED)
            (a, b), (c, d) = e.interval, last[name].noise_interval
            rows.append((developed, a <= true <= b, c <= true <= d, (b - a) / abs(e.value - true)))
            misfit, shapes = max(n.misfit for n in last.noise), " ".join(n.shape for n in last.noise)
            print(
                f"{case.name:<34} {name:<3} {true:6g} {e.value:10.5g}: {100 * (e.value / true - 1):+7.2f} %, "
                f"{a:9.5g} to {b:9.5g} ({c:9.5g} to {d:9.5g}) {'' if a <= true <= b else 'MISSED':<6} "
                f"{rows[-1][-1]:6.1f}, misfit {misfit:5.2f} {shapes}, {seconds:.0f} s",
                flush=True,
            )
    for what, some in (
        ("all", rows),
        ("not developed on", [row for row in rows if not row[0]]),
    ):
        if some:
            _, first, noise, widths = zip(*some, strict=True)
            print(
                f"{what}: {sum(first)} of {len(some)} first intervals hold the truth, {sum(noise)} of the noise alone; "
                f"width over error: median {np.median(widths):.1f}"
            )


if __name__ == "__main__":
    main()
