"""What does accuracy cost? Error against seconds on six problems, by update, description, transfer, kernel, precision.

    python benchmarks/work_precision.py            # this package alone
    python benchmarks/work_precision.py --peers    # needs: python -m pip install -e ".[peers]"
    python benchmarks/work_precision.py --quick --only wave

Prints for each problem what the cheapest run within one per cent is and what the cheapest of the other kind, explicit
or implicit, takes; writes docs/work_precision.csv and docs/work_precision.png. `--only` some problems replaces theirs.
`--quick` runs a few lines on the coarse grids and writes nothing.

The error is that of `mpmjax.analysis.work_precision`: the largest over eight times of the RMS over particles of the
distance to the reference, over the largest RMS displacement. The reference is the exact motion where there is one, or
else a run of TR-BDF2 refined in space and time together, whose last change is the estimate of its own error. Seconds
are wall time without compilation, the least of three rounds in which the settings take turns. Explicit steps are tried
at 2, √2, 1 and ½ times `stable_dt` of the whole motion, implicit ones from eight in all to ever more, until the error
falls no further. What would take longer than a limit is not run: its time is foreseen from fewer steps.

A small error between two large ones is where the error changes its sign. So a run counts, in the sentences and for the
lines of the charts, with the larger of its own error and that of the next smaller step.

All methods start from the same state, but for the wave: there, those whose velocities stand half a step before the
positions (explicit, semi-implicit, backward Euler) start with such, which makes explicit steps second order.

With `--peers`, MLS-MPM in Taichi and in Warp (`peers/`) runs the two problems it can, from the same particles, on the
same grids, with the same steps. Before that is timed, centre of mass and energy after some steps without a wall must
agree with this package's to what the precision allows. Walls of the peers hold nodes, those of this package faces.
"""

import argparse
import csv
import dataclasses
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm
from mpmjax.analysis._bench import FRAMES, Bench, Displacements, name_of, settle
from mpmjax.verification import AbstractProblem, StandingWave, discretise

sys.path.append(str(Path(__file__).parent))
jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[1] / "docs"
TABLE = DOCS / "work_precision.csv"
UPDATES = {
    "explicit": mpm.Explicit(),
    "semi-implicit β = ½": mpm.SemiImplicit(beta=0.5),
    "semi-implicit β = 1": mpm.SemiImplicit(),
    "backward Euler": mpm.BackwardEuler(),
    "midpoint": mpm.ImplicitMidpoint(),
    "TR-BDF2": mpm.TRBDF2(),
}
CHOICES = {
    "total": {"description": mpm.TotalLagrangian(), "gradient": mpm.MLSGradient()},
    "updated": {"description": mpm.UpdatedLagrangian()},
    "FLIP": {"transfer": mpm.FLIP(1.0)},
    "PIC": {"transfer": mpm.PIC()},
    "linear": {"kernel": mpm.BSpline(1)},
    "cubic": {"kernel": mpm.BSpline(3)},
    "mirrored wall": {"wall": "mirrored"},
    "float32": {"dtype": "float32"},
}
"""Besides quadratic kernel, APIC, the moving-least-squares gradient, float64."""
COLOURS = dict(zip([*UPDATES, "Taichi", "Warp"], ["C0", "C1", "C3", "C4", "C2", "C9", "C5", "C7"], strict=True))
MARKERS = {"FLIP": "^", "PIC": "v", "linear": "D", "cubic": "P", "mirrored wall": "s"}
DASHES = {"total": "-", "updated": "--"}
EXPLICIT_STEPS = 2.0, 2**0.5, 1.0, 0.5
"""In units of `stable_dt`."""
IDLE = 2
"""Halvings that bring nothing before an implicit line ends."""
QUICK_PROBLEMS = "wave", "pull", "spin"
TELLING = 3
"""Lines of a problem that run on its finest grid too."""
CLOSE = {"float32": 1e-5, "float64": 1e-9}
"""How closely codes must agree."""


class Limits(NamedTuple):
    """How far to go."""

    lines: int | None
    """How many of a problem; None for all."""
    grids: int
    reference_seconds: float
    """What a reference may take."""
    run_seconds: float
    """The longest run of a line."""
    rounds: int
    """How often a short run is timed."""


FULL, QUICK = Limits(None, 3, 120.0, 15.0, 3), Limits(2, 1, 10.0, 2.0, 2)


class Problem(NamedTuple):
    """A scene to be moved and how."""

    title: str
    build: Callable[..., tuple[mpm.Scene, mpm.Particles]]
    """From a refinement and choices of the scene to the scene and its particles."""
    t1: float
    lines: tuple[str, ...]
    """Update, description and other choices, the most telling ones first."""
    grids: tuple[int, ...] = (1, 2)
    target: float = 1e-2
    """The error of which the sentence speaks."""
    exact: AbstractProblem | None = None
    """What knows the motion."""
    peers: str | None = None
    """The line that does what peers do."""


class Point(NamedTuple):
    """A run, what it cost and how good it was."""

    problem: str
    line: str
    refinement: int
    dt: float
    steps: int
    seconds: float
    error: float
    """Infinite where the run failed, NaN where it was foreseen to take too long."""

    def __str__(self) -> str:
        spacing = f", spacing / {self.refinement}" if self.refinement > 1 else ""
        return f"{self.line}, dt = {self.dt:.2g} s ({self.steps} steps{spacing})"

    @property
    def is_explicit(self) -> bool:
        """Whether it is an explicit run of this package."""
        return self.line.startswith("explicit")


class Reference(NamedTuple):
    """What runs are compared with."""

    limit: float
    """`stable_dt` of the whole motion on the coarsest grid [s]."""
    error: float
    """The estimate of its own."""
    truth: Callable[[int], Displacements]
    """From a refinement to the motion, of the same particles or of finer ones."""


WAVE = StandingWave(0.1, dim=2)


def wave(n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A standing pressure wave on 32 n cells."""
    return discretise(WAVE, 32 * n, **choices)


def smoothly(displacement: tuple[float, float], seconds: float) -> mpm.Motion:
    """From rest to rest, as half a cosine."""
    share = np.linspace(0, 1, 65)
    return mpm.Motion(seconds * share, np.outer((1 - np.cos(np.pi * share)) / 2, displacement))


def pull(n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """The rubber strip of examples/rubber.toml, drawn to one and a half times its length."""
    grid = mpm.Grid((4 * n + 8, 28 * n + 8), 2.5e-3 / n, origin=(-4, -4))
    strip = mpm.fill(mpm.Box((0.0, 0.0), (0.01, 0.04)), grid, density=930.0)
    clamp = mpm.Grip(mpm.Box((-0.1, 0.035), (0.1, 0.1)), smoothly((0.0, 0.02), 1.0))
    planes = mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0)
    return mpm.Scene(grid, mpm.NeoHookean(1.6e6, 0.49), boundary=(*planes, clamp), **choices), strip


def bend(n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A beam, one end held, the other moved across by a quarter of its length, from rest to rest.

    In the total description alone: in the updated one the guide would hold a place, which the beam's end slips out of.
    """
    grid = mpm.Grid((32 * n + 12, 14 * n + 12), 0.0125 / n, origin=(-6, -10 * n - 6))
    beam = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.05)), grid, density=1e3)
    guide = mpm.Grip(mpm.Box((0.375, -1.0), (1.0, 1.0)), smoothly((0.0, -0.1), 2.0), axes=(False, True))
    held = mpm.StickyBox((0.0, -math.inf), (math.inf, math.inf))
    return mpm.Scene(grid, mpm.NeoHookean(1e7, 0.3), boundary=(held, guide), **choices), beam


def swirl(n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A nearly incompressible square in a slippery mould, stirred."""
    grid = mpm.Grid((8 * n + 9,) * 2, 1 / (8 * n), origin=(-4, -4))
    square = mpm.fill(mpm.Box((0.0, 0.0), (1.0, 1.0)), grid, density=1e3)
    X, Y = square.x.T
    sin, cos, pi = jnp.sin, jnp.cos, jnp.pi
    v = 0.4 * jnp.stack([sin(pi * X) * cos(pi * Y), -cos(pi * X) * sin(pi * Y)], axis=1)
    mould = [mpm.SymmetryPlane(a, place, keep) for a in (0, 1) for place, keep in ((0.0, "above"), (1.0, "below"))]
    square = mpm.Particles(square.x, v, square.mass, square.volume)
    return mpm.Scene(grid, mpm.NeoHookean(1e4, 0.49), boundary=mould, **choices), square


def spin(n: int, **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A block thrown up, spinning once in its flight; its ends move at a quarter of the speed of sound."""
    grid = mpm.Grid((16 * n + 1, 20 * n + 1), 1 / (16 * n))
    block = mpm.fill(mpm.Box((0.25, 0.375), (0.75, 0.625)), grid, density=1e3)
    arm = block.x - jnp.asarray([0.5, 0.5])
    v = 10 * jnp.stack([-arm[:, 1], arm[:, 0]], axis=1) + jnp.asarray([0.0, 0.5])
    C = jnp.broadcast_to(jnp.asarray([[0.0, -10.0], [10.0, 0.0]]), (block.count, 2, 2))
    block = mpm.Particles(block.x, v, block.mass, block.volume, C=C)
    return mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), gravity=(0.0, -1.5), **choices), block


def impact(n: int, wall: str = "plain", **choices: Any) -> tuple[mpm.Scene, mpm.Particles]:
    """A block hits a floor and leaves it."""
    grid = mpm.Grid((20 * n + 1, 16 * n + 1), 1 / (16 * n))
    block = mpm.fill(mpm.Box((0.375, 0.25), (0.875, 0.75)), grid, density=1e3, velocity=(0.0, -2.5))
    plain = mpm.SeparatingBox((-math.inf, 0.25), (math.inf, math.inf))
    floor = {"mirrored": mpm.ContactPlane(1, 0.25), "plain": plain}[wall]
    return mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), gravity=(0.0, -9.81), boundary=floor, **choices), block


PROBLEMS = {
    "wave": Problem(
        "one period of a standing wave (exact)",
        wave,
        2 * WAVE.duration,
        (
            "explicit, total",
            "semi-implicit β = 1, total",
            "midpoint, total",
            "semi-implicit β = ½, total",
            "backward Euler, total",
            "TR-BDF2, total",
            "explicit, updated",
            "explicit, total, float32",
            "explicit, total, PIC",
            "explicit, total, linear",
            "explicit, updated, linear, FLIP",
        ),
        grids=(1, 2, 4),
        exact=WAVE,
    ),
    "pull": Problem(
        "a rubber strip pulled slowly",
        pull,
        1.0,
        (
            "explicit, total",
            "semi-implicit β = 1, total",
            "semi-implicit β = ½, total",
            "semi-implicit β = 1, updated",
            "semi-implicit β = 1, total, float32",
            "backward Euler, total",
            "midpoint, total",
            "TR-BDF2, total",
            "explicit, updated",
            "explicit, total, float32",
        ),
    ),
    "bend": Problem(
        "a beam bent slowly",
        bend,
        2.0,
        (
            "explicit, total",
            "semi-implicit β = 1, total",
            "semi-implicit β = ½, total",
            "semi-implicit β = 1, total, float32",
            "backward Euler, total",
            "midpoint, total",
            "TR-BDF2, total",
            "explicit, total, float32",
        ),
    ),
    "swirl": Problem(
        "a nearly incompressible square, ν = 0.49, stirred",
        swirl,
        0.5,
        (
            "explicit, total",
            "midpoint, total",
            "semi-implicit β = 1, total",
            "TR-BDF2, total",
            "midpoint, updated",
            "explicit, updated",
            "explicit, total, FLIP",
            "explicit, total, PIC",
            "explicit, total, cubic",
        ),
        grids=(1, 2, 4),
    ),
    "spin": Problem(
        "a free block that spins once",
        spin,
        2 * math.pi / 10,
        (
            "explicit, updated",
            "midpoint, total",
            "explicit, updated, float32",
            "explicit, total",
            "semi-implicit β = 1, total",
            "TR-BDF2, total",
            "explicit, updated, FLIP",
            "explicit, updated, PIC",
        ),
        grids=(1, 2, 4),
        peers="explicit, updated",
    ),
    "impact": Problem(
        "a block hits a floor and leaves it",
        impact,
        0.15,
        (
            "explicit, updated",
            "midpoint, updated",
            "explicit, updated, mirrored wall",
            "TR-BDF2, updated",
            "semi-implicit β = 1, updated",
            "explicit, updated, float32",
            "explicit, updated, FLIP",
        ),
        grids=(1, 2, 4),
        target=5e-2,
        peers="explicit, updated",
    ),
}


def bench_of(problem: Problem, line: str, n: int, **start: Any) -> Bench:
    """A line's scene on the grid refined n times."""
    choices = start
    for word in line.split(", ")[1:]:
        choices = choices | CHOICES[word]
    dtype = choices.pop("dtype", "float64")

    def build(refinement: int) -> tuple[mpm.Scene, mpm.Particles]:
        scene, particles = problem.build(refinement, **choices)
        return scene, jax.tree.map(lambda a: a.astype(dtype), particles)

    return Bench.of(build, n, problem.t1)


def reference_of(problem: Problem, limits: Limits) -> Reference:
    """The exact motion, or a refined run of the first line's scene."""
    choices = CHOICES[problem.lines[0].split(", ")[1]]
    coarse = Bench.of(lambda n: problem.build(n, **choices), 1, problem.t1)
    if problem.exact is None:
        limit, trial, motion = settle(
            lambda n: problem.build(n, **choices), coarse, problem.target / 3, limits.reference_seconds
        )
        print(f"  reference: {name_of(trial.method)} in {trial.steps} steps, spacing / {trial.refinement}", end="")
        print(f", {trial.seconds:.2g} s, known to {trial.error:.1e}", flush=True)
        return Reference(limit, trial.error, lambda n: motion)
    states = coarse.run(mpm.TRBDF2(), 4 * FRAMES).states
    assert states is not None
    return Reference(coarse.limit(states), 0.0, lambda n: exact_motion(problem, n))


def exact_motion(problem: Problem, n: int) -> Displacements:
    """Of the particles of a grid."""
    _, particles = problem.build(n)
    times = problem.t1 * jnp.arange(1, FRAMES + 1) / FRAMES
    x = jax.vmap(lambda t: jax.vmap(lambda X: problem.exact.position(X, t))(particles.X))(times)
    return Displacements(np.asarray(particles.x), np.asarray(x - particles.x))


class Runner:
    """Runs a problem's lines and keeps what it needs to time them again."""

    def __init__(self, name: str, reference: Reference, limits: Limits):
        self.name, self.problem, self.reference, self.limits = name, PROBLEMS[name], reference, limits
        self.points: list[Point] = []
        self._again: dict[int, Callable[[], float]] = {}

    def line(self, line: str, n: int) -> None:
        """Steps of a line on one grid."""
        bench, method = bench_of(self.problem, line, n), UPDATES[line.split(", ")[0]]
        truth, limit = self.reference.truth(n), self.reference.limit / n
        if isinstance(method, mpm.Explicit):
            for factor in EXPLICIT_STEPS:
                steps = bench.whole(factor * limit)
                seconds = bench.foresee(method, steps)
                if seconds < self.limits.run_seconds:
                    self._run(bench, line, steps, truth)
                elif factor == 1:
                    self._note(bench, line, steps, seconds, math.nan)
            return
        bench.timed(method, FRAMES, 1, 1)
        steps, best, idle = FRAMES, math.inf, 0
        while idle < IDLE and bench.t1 / steps > limit / 4:
            point = self._run(bench, line, steps, truth)
            idle = idle + 1 if 0.8 * best < point.error < 1 or point.error < self.problem.target / 20 else 0
            best = min(best, point.error)
            if 2 * point.seconds > self.limits.run_seconds:
                return
            steps *= 2

    def _run(self, bench: Bench, line: str, steps: int, truth: Displacements) -> Point:
        """Once, with eight calls; if it is short, it is timed again with a single one."""
        method = UPDATES[line.split(", ")[0]]
        if self.problem.exact is not None and method.body_force_at == 0:
            early = -bench.t1 / steps / 2
            start = bench_of(self.problem, line, bench.refinement, velocity_time=early)
            bench = bench._replace(particles=start.particles)
        states, _, seconds = bench.timed(method, steps, FRAMES, steps // FRAMES)
        error = math.inf if states is None else bench.motion(states).distance(truth)
        if states is not None and seconds < self.limits.run_seconds / 10:
            self._again[len(self.points)] = lambda: bench.timed(method, steps, 1, steps).seconds
        return self._note(bench, line, steps, seconds, error)

    def _note(self, bench: Bench, line: str, steps: int, seconds: float, error: float) -> Point:
        self.points.append(Point(self.name, line, bench.refinement, bench.t1 / steps, steps, seconds, error))
        return self.points[-1]

    def peer(self, code: str, make: Callable[..., Any], dtype: str, n: int) -> None:
        """A peer's runs on one grid, with the steps with which this package's line ends well.

        Peers do not watch where particles are, and one that leaves the grid crashes them.
        """
        line, truth = self.problem.peers, self.reference.truth(n)
        assert line is not None
        own = bench_of(self.problem, line, n)
        x0, peer = np.asarray(own.particles.x), peer_of(own, make, dtype)
        peer.run(1, self.reference.limit / n)
        well = [p.steps for p in self.points if (p.line, p.refinement) == (line, n) and math.isfinite(p.error)]
        for steps in well:
            dt = own.t1 / steps
            peer.restart()
            x = np.stack([peer.run(steps // FRAMES, dt)[0] for _ in range(FRAMES)])
            seconds = math.inf
            for _ in range(self.limits.rounds):
                peer.restart()
                begun = time.perf_counter()
                peer.run(steps, dt)
                seconds = min(seconds, time.perf_counter() - begun)
            self._note(own, f"{code}, {dtype}", steps, seconds, Displacements(x0, x - x0).distance(truth))

    def repeat(self) -> None:
        """Every short run, in turn, as often as there are rounds left."""
        for _ in range(self.limits.rounds - 1):
            for i, again in self._again.items():
                self.points[i] = self.points[i]._replace(seconds=min(self.points[i].seconds, again()))


def peer_of(own: Bench, make: Callable[..., Any], dtype: str) -> Any:
    """A peer with the scene of this package's bench."""
    scene, particles, law = own.scene, own.particles, own.scene.material
    floors = [float(b.lower[1]) for b in scene.boundary]
    return make(
        np.asarray(particles.x),
        np.asarray(particles.v),
        C=np.asarray(particles.C),
        mass=float(particles.mass[0]),
        volume=float(particles.volume[0]),
        shape=scene.grid.shape,
        spacing=float(scene.grid.spacing),
        shear_modulus=float(law.shear_modulus),
        lame_lambda=float(law.lame_lambda),
        gravity=tuple(scene.gravity),
        floor=floors[0] if floors else None,
        dtype=dtype,
    )


def require_agreement(problem: Problem, codes: list[tuple[str, Callable[..., Any], str]], dt: float) -> None:
    """Centre of mass and energy after ten steps, without walls: those of the peers act at nodes."""
    own = bench_of(problem, problem.peers or "", 1)
    own = own._replace(scene=dataclasses.replace(own.scene, boundary=()))
    ours = mpm.rollout(own.scene, own.particles, steps=10, dt=dt)
    centre, energy = balance(own.scene, ours, *(np.asarray(a) for a in (ours.x, ours.v, ours.F)))
    for code, make, dtype in codes:
        theirs = balance(own.scene, ours, *peer_of(own, make, dtype).run(10, dt))
        if np.abs(theirs[0] - centre).max() > CLOSE[dtype] or abs(theirs[1] / energy - 1) > CLOSE[dtype]:
            raise SystemExit(
                f"{code}, {dtype} disagrees: centre {theirs[0]} and {centre}, energy {theirs[1]}, {energy}."
            )


def balance(scene: mpm.Scene, particles: mpm.Particles, x: Any, v: Any, F: Any) -> tuple[np.ndarray, float]:
    """Centre of mass, and kinetic (without the affine part), elastic and potential energy added up, in double."""
    x, v, F = (np.asarray(a, "float64") for a in (x, v, F))
    mass, volume = np.asarray(particles.mass), np.asarray(particles.volume)
    stored = np.asarray(scene.material.energy(jnp.moveaxis(jnp.asarray(F), 0, -1)))
    kinetic, high = (v**2).sum(axis=1) / 2, -x @ np.asarray(scene.gravity)
    return x.mean(axis=0), float((mass * (kinetic + high) + volume * stored).sum())


def peer_codes() -> list[tuple[str, Callable[..., Any], str]]:
    """Name, how to make it, precision."""
    from peers.taichi_mpm import TaichiMPM
    from peers.warp_mpm import WarpMPM

    return [("Taichi", TaichiMPM, "float64"), ("Taichi", TaichiMPM, "float32"), ("Warp", WarpMPM, "float32")]


def trusted(points: list[Point]) -> list[tuple[float, Point]]:
    """Each run that ended, with the larger of its error and that of the next smaller step of its line and grid."""

    def borne_out(point: Point) -> float:
        own = [p for p in points if (p.problem, p.line, p.refinement) == (point.problem, point.line, point.refinement)]
        finer = [p for p in own if p.dt < point.dt and not math.isnan(p.error)]
        return max(point.error, max(finer, key=lambda p: p.dt, default=point).error)

    return [(borne_out(p), p) for p in points if math.isfinite(borne_out(p))]


def front(points: list[Point]) -> list[tuple[float, float]]:
    """Seconds and errors of the runs of which none is both faster and better."""
    best: list[tuple[float, float]] = []
    for error, point in sorted(trusted(points), key=lambda pair: pair[1].seconds):
        if not best or error < best[-1][1]:
            best.append((point.seconds, error))
    return best


def sentence(name: str, points: list[Point], peers: bool) -> str:
    """The cheapest run within the target, and the cheapest of the other kind."""
    target = PROBLEMS[name].target
    codes = tuple(COLOURS)[len(UPDATES) :]
    own = [p for p in points if not p.line.startswith(codes)]
    good = sorted((p.seconds, p) for error, p in trusted(own) if error <= target)
    if not good:
        error, best = min(trusted(own))
        return f"{name}: none reaches {target:.0%}; the best is {best}, error {error:.1%}, {best.seconds:.2g} s."
    best = good[0][1]
    kind = "explicit" if not best.is_explicit else "implicit"
    said = f"{name}: at {target:.0%} {best} takes {best.seconds:.2g} s"
    rivals = [p for _, p in good if p.is_explicit != best.is_explicit]
    foreseen = sorted(p.seconds for p in own if math.isnan(p.error) and p.is_explicit != best.is_explicit)
    if rivals:
        times = rivals[0].seconds / best.seconds
        said += f", the cheapest {kind} run, {rivals[0]}, {rivals[0].seconds:.2g} s ({times:.2g} times)"
    elif foreseen:
        said += f", the cheapest {kind} run would take {foreseen[0]:.2g} s ({foreseen[0] / best.seconds:.2g} times)"
    else:
        error, second = min((e, p) for e, p in trusted(own) if p.is_explicit != best.is_explicit)
        said += f"; no {kind} run is as good ({second} has {error:.1%} in {second.seconds:.2g} s)"
    for code in codes if peers else ():
        theirs = sorted((p.seconds, p) for error, p in trusted(points) if error <= target and p.line.startswith(code))
        said += f"; {theirs[0][1]} {theirs[0][0]:.2g} s" if theirs else ""
    return said + "."


def measure(name: str, limits: Limits, peers: bool) -> tuple[Reference, list[Point]]:
    """A problem's reference and all its runs."""
    problem = PROBLEMS[name]
    print(f"{name}: {problem.title}", flush=True)
    reference = reference_of(problem, limits)
    codes = peer_codes() if peers and problem.peers else []
    require_agreement(problem, codes, reference.limit)
    runner = Runner(name, reference, limits)
    lines = problem.lines if limits.lines is None else problem.lines[: limits.lines]
    for line in lines:
        telling = problem.lines.index(line) < TELLING
        for n in problem.grids[: limits.grids if telling else min(limits.grids, 2)]:
            begun = time.perf_counter()
            before = len(runner.points)
            runner.line(line, n)
            best = min((p.error for p in runner.points[before:] if p.error >= 0), default=math.nan)
            took = time.perf_counter() - begun
            print(f"  {line}, spacing / {n}: least error {best:.1e}, {took:.1f} s of work", flush=True)
    runner.repeat()
    for code, make, dtype in codes:
        for n in problem.grids[: limits.grids]:
            runner.peer(code, make, dtype, n)
    print(sentence(name, runner.points, peers), flush=True)
    return reference, runner.points


def style_of(line: str) -> dict[str, Any]:
    """The update gives the colour, the description the dashes, kernel, transfer and wall the marker; float32 is
    hollow."""
    update, *words = line.split(", ")
    marker = next((MARKERS[w] for w in words if w in MARKERS), "o")
    face = "white" if "float32" in words else COLOURS[update]
    style = {"color": COLOURS[update], "marker": marker, "markerfacecolor": face}
    return style | {"linestyle": DASHES.get(words[0], ":")}


def draw(known: dict[str, float], points: list[Point]) -> None:
    """One panel a problem."""
    columns = 3
    rows = -(-len(known) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(6.2 * columns, 6.6 * rows), layout="constrained")
    for axis, name in zip(np.ravel(axes), known, strict=False):
        draw_panel(axis, name, known[name], [p for p in points if p.problem == name])
    for axis in np.ravel(axes)[len(known) :]:
        axis.set_axis_off()
    figure.suptitle(
        "lines: each setting's best runs over step and spacing, the others faint;  × failed;  ▷ foreseen;  "
        "grey: less than the reference's own error",
        fontsize=10,
    )
    figure.savefig(DOCS / "work_precision.png", dpi=90)


def draw_panel(axis: Any, name: str, known: float, points: list[Point]) -> None:
    """A line through each setting's best runs, all its others faint, failed and foreseen ones at the right edge."""
    finite = [p.error for p in points if math.isfinite(p.error)]
    edge = 2 * max(finite)
    for line in dict.fromkeys(p.line for p in points):
        own, style = [p for p in points if p.line == line], style_of(line)
        best = front(own)
        faint = style | {"linestyle": "", "markersize": 3, "alpha": 0.25}
        axis.plot([p.error for p in own], [p.seconds for p in own], **faint)
        axis.plot([e for _, e in best], [s for s, _ in best], **style, markersize=5, linewidth=1.2, label=line)
        failed = [p.seconds for p in own if math.isinf(p.error)]
        axis.plot([edge] * len(failed), failed, "x", color=style["color"], markersize=5)
        foreseen = [p.seconds for p in own if math.isnan(p.error)]
        axis.plot([edge] * len(foreseen), foreseen, ">", color=style["color"], markersize=7, markerfacecolor="none")
    axis.axvline(PROBLEMS[name].target, color="black", linewidth=0.8)
    axis.set(xscale="log", yscale="log", xlabel="relative error of the motion", ylabel="seconds")
    axis.set_xlim(0.6 * min(finite), 1.5 * edge)
    if known > 0:
        axis.axvspan(axis.get_xlim()[0], known, color="0.9", zorder=0)
    axis.set_title(f"{name}: {PROBLEMS[name].title}", fontsize=10)
    axis.legend(fontsize=7.5, loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2, frameon=False, handlelength=3.5)
    axis.grid(alpha=0.25)


def write(known: dict[str, float], points: list[Point]) -> None:
    """All runs; an error of inf is a run that failed, of nan one that was foreseen to take too long."""
    with TABLE.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["problem", "line", "refinement", "dt_s", "steps", "seconds", "error", "error_of_reference"])
        for p in points:
            shown = [f"{p.dt:.6g}", p.steps, f"{p.seconds:.4g}", f"{p.error:.4g}"]
            rows.writerow([p.problem, p.line, p.refinement, *shown, f"{known[p.problem]:.2g}"])


def read() -> tuple[dict[str, float], list[Point]]:
    """The errors of the references and the runs that were written last."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        _, *rows = csv.reader(file)
    points = [Point(a, b, int(n), float(dt), int(k), float(s), float(e)) for a, b, n, dt, k, s, e, _ in rows]
    return {row[0]: float(row[-1]) for row in rows}, points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few lines on the coarse grids, write nothing")
    parser.add_argument("--peers", action="store_true", help="Taichi and Warp too")
    parser.add_argument("--only", nargs="+", choices=PROBLEMS, help="these problems, the others as they were written")
    options = parser.parse_args()
    known, points = read() if options.only and not options.quick else ({}, [])
    for name in options.only or (QUICK_PROBLEMS if options.quick else PROBLEMS):
        reference, found = measure(name, QUICK if options.quick else FULL, options.peers)
        known[name] = reference.error
        points = [p for p in points if p.problem != name] + found
        jax.clear_caches()
    if not options.quick:
        order = {name: known[name] for name in PROBLEMS if name in known}
        points = [p for name in order for p in points if p.problem == name]
        write(order, points)
        draw(order, points)


if __name__ == "__main__":
    main()
