"""Two bodies that touch: where contact is felt, by which normals, and what slides, rolls and is pressed.

python benchmarks/bodies.py                     all tables, and docs/bodies.png (minutes)
python benchmarks/bodies.py --only slope        one of rest, normals, slope, roll, hertz, rings, balls, work
python benchmarks/bodies.py --quick             the same, coarser, without a picture
"""

import argparse
import dataclasses
from collections.abc import Callable
from itertools import product
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import qmc

import mpmjax as mpm
from mpmjax.checks import canonical
from mpmjax.stepping import AbstractIntegrator, start_nodes

jax.config.update("jax_enable_x64", True)
DOCS = Path(__file__).parents[1] / "docs"
G = 10.0  # m/s²
DENSITY = 1e3  # kg/m²
HELD = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))
IMPLICIT = {
    "semi-implicit": mpm.SemiImplicit(),
    "backward Euler": mpm.BackwardEuler(),
    "midpoint": mpm.ImplicitMidpoint(),
    "TR-BDF2": mpm.TRBDF2(),
}


def contact_of(scene: mpm.Scene, particles: mpm.Particles, t: float = 0.0) -> tuple:
    """The contact of two bodies as it is felt, and the places of its nodes."""
    scene = canonical(scene, particles.x.dtype)
    particles = mpm.prepare(scene, particles)
    nodes = start_nodes(scene, particles, t, jnp.asarray(1e-3), scene.stencil(particles, t))
    return nodes.contacts[-1], np.asarray(scene.grid.nodes(scene.window(particles)))[: len(nodes.contacts[-1].gap)]


def moved(body: mpm.Particles, by: tuple[float, float]) -> mpm.Particles:
    return dataclasses.replace(body, x=body.x + jnp.asarray(by))


def rest(quick: bool) -> None:
    """A block that has come to rest on another: the gap between faces, by place on the lattice."""
    law, dx = mpm.NeoHookean(1e6, 0.3), 0.1
    print("block at rest on a block: gap of the faces in spacings, less what the load presses in")
    for place in (0.0, 0.37) if quick else (0.0, 0.13, 0.25, 0.37, 0.5):
        grid = mpm.Grid((18, 22), dx, origin=(-3, -3))
        low = mpm.fill(mpm.Box((0.0, 0.0), (1.0, 0.4 + place * dx)), grid, density=DENSITY)
        top = 0.4 + place * dx
        high = mpm.fill(mpm.Box((0.2, top), (0.8, top + 0.6)), grid, density=DENSITY)
        scene = mpm.Scene(grid, (law, law), gravity=(0.0, -G), boundary=HELD, bodies=mpm.Bodies(0.3))
        run = mpm.simulate(scene, mpm.join(low, high), t1=4.0, dt=0.1, method=mpm.BackwardEuler())
        contact, x = contact_of(scene, run.final, 4.0)
        inside = np.isfinite(contact.gap) & (np.abs(x[:, 0] - 0.5) < 0.11) & (np.asarray(contact.stiffness) > 0)
        seen = np.average(np.asarray(contact.gap)[inside], weights=np.asarray(contact.stiffness)[inside]) / dx
        pressed = DENSITY * G * 0.6 / 1.346e6  # α M/2 = M a spacing, of two bodies in a row
        print(f"  {place:4.2f} spacings from a node: {seen:+.4f} ({pressed:.4f} by the load)")


def normals(quick: bool) -> None:
    """Root mean square of the angle between normals and the true one, weighted with the springs' stiffness."""
    law, dx, rng = mpm.NeoHookean(1e6, 0.3), 0.1, np.random.default_rng(0)
    grid = mpm.Grid((40, 40), dx, origin=(-20, -20))

    def beside(k: int) -> tuple:
        """A block, somewhere on a wider one."""
        low = mpm.fill(mpm.Box((-1.0, -0.6), (1.0, 0.0)), grid, density=DENSITY)
        high = mpm.fill(mpm.Box((-0.3, 0.0), (0.3, 0.6)), grid, density=DENSITY)
        by = rng.uniform(-0.05, 0.05, 2)
        return moved(low, by), moved(high, (*(by[:1] + rng.uniform(-0.05, 0.05)), by[1] - 0.002)), lambda x: (0.0, -1.0)

    def flush(k: int) -> tuple:
        """Two blocks of one width, edge on edge."""
        low = mpm.fill(mpm.Box((-0.4, -0.6), (0.4, 0.0)), grid, density=DENSITY)
        high = mpm.fill(mpm.Box((-0.4, 0.0), (0.4, 0.6)), grid, density=DENSITY)
        by = rng.uniform(-0.05, 0.05, 2)
        return moved(low, by), moved(high, (by[0] + rng.uniform(-0.05, 0.05), by[1] - 0.002)), lambda x: (0.0, -1.0)

    def disks(k: int) -> tuple:
        """Two disks of ten cells' radius that overlap a little, in some direction."""
        angle, R = rng.uniform(0, 2 * np.pi), 0.8
        n, by = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(-0.05, 0.05, 2)
        pair = [mpm.fill(mpm.Ball((0.0, 0.0), R), grid, density=DENSITY, fitted=True) for _ in range(2)]
        a, b = by - (R - 0.01) * n, by + (R - 0.01) * n
        return (
            moved(pair[0], a),
            moved(pair[1], b),
            lambda x: _unit((a - x) / np.hypot(*(x - a)) - (b - x) / np.hypot(*(x - b))),
        )

    print("angle of normals at the nodes held, degrees (root mean square, by stiffness)")
    for name, make in {"block on a wider one": beside, "edge on edge": flush, "two disks": disks}.items():
        errors: dict[str, list] = {}
        for k in range(3 if quick else 20):
            a, b, true = make(k)
            scene = mpm.Scene(grid, (law, law), bodies=mpm.Bodies())
            contact, x = contact_of(scene, mpm.join(a, b))
            stiffness = np.asarray(contact.stiffness)
            for i in np.flatnonzero((stiffness > 0) & (np.asarray(contact.gap) < 0.02 * dx)):
                found = {"of the sheet (taken)": np.asarray(contact.normal)[i], **_others(a, b, x[i], dx)}
                for method, n in found.items():
                    angle = np.degrees(np.arccos(np.clip(np.dot(n, true(x[i])), -1, 1)))
                    errors.setdefault(method, []).append((stiffness[i], angle))
        parts = (
            f"{m} {np.sqrt(np.average(np.array(e)[:, 1] ** 2, weights=np.array(e)[:, 0])):.1f}"
            for m, e in errors.items()
        )
        print(f"  {name}: " + ", ".join(parts))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _others(a: mpm.Particles, b: mpm.Particles, node: np.ndarray, dx: float) -> dict[str, np.ndarray]:
    """Normals at a node by other methods, from the particles in its reach."""
    arms = [(np.asarray(body.x) - node) / dx for body in (a, b)]
    weights = [
        np.where(np.abs(r) < 0.5, 0.75 - r**2, 0.5 * np.maximum(1.5 - np.abs(r), 0) ** 2).prod(axis=1) for r in arms
    ]
    volumes = [np.asarray(body.volume) / dx**2 for body in (a, b)]
    moments = [(w * v) @ r for w, v, r in zip(weights, volumes, arms, strict=True)]
    found = {
        "gradient of one mass": _unit(moments[0]),
        "difference of gradients": _unit(moments[0] - moments[1]),
    }
    x, w = np.concatenate(arms), np.concatenate([w * v for w, v in zip(weights, volumes, strict=True)])
    label = np.repeat([1.0, -1.0], [len(r) for r in arms])
    near = w > 0
    found["logistic regression"] = _unit(_logistic(x[near], w[near], label[near]))
    return found


def _logistic(x: np.ndarray, w: np.ndarray, label: np.ndarray) -> np.ndarray:
    """The normal of the plane that tells two sets of points apart: least Σ w log(1 + exp(−label z)) + 1e-6 ‖β‖²."""
    X, beta = np.concatenate([x, np.ones((len(x), 1))], axis=1), np.zeros(3)
    for _ in range(30):
        p = 1 / (1 + np.exp(np.clip(label * (X @ beta), -50, 50)))
        H = (X * (w * p * (1 - p))[:, None]).T @ X + 1e-6 * np.eye(3)
        step = np.linalg.solve(H, X.T @ (w * p * label) - 1e-6 * beta)
        beta = beta + step * min(1, 20 / np.linalg.norm(step))
    return beta[:2]


def on_slope(angle: float, friction: float) -> tuple[mpm.Scene, mpm.Particles, slice]:
    """A scene of a block of 6 by 4 cells on a slab that is so steep, the particles, and the rows of the block's."""
    grid, law = mpm.Grid((46, 16), 0.1, origin=(-3, -3)), mpm.NeoHookean(1e6, 0.3)
    slab = mpm.fill(mpm.Box((0.0, 0.0), (4.0, 0.4)), grid, density=DENSITY)
    block = mpm.fill(mpm.Box((0.43, 0.4), (1.03, 0.8)), grid, density=DENSITY)
    gravity = (G * np.sin(angle), -G * np.cos(angle))
    scene = mpm.Scene(grid, (law, law), gravity=gravity, boundary=HELD, bodies=mpm.Bodies(friction))
    return scene, mpm.join(slab, block), slice(slab.count, None)


class Tilting(mpm.state.AbstractBodyForce):
    """The weight of what is put down in 0.3 s, and then with all below it tilted to an angle in 1 s, without jerks."""

    angle: float

    def acceleration(self, x: jax.Array, t: jax.Array) -> jax.Array:
        (put, turned) = (s**3 * (10 - 15 * s + 6 * s**2) for s in jnp.clip(jnp.stack([t / 0.3, t - 0.3]), 0, 1))
        angle = self.angle * turned
        return jnp.broadcast_to(G * put * jnp.stack([jnp.sin(angle), -jnp.cos(angle)]), x.shape)


def tilted(method: AbstractIntegrator, friction: float = 0.8) -> tuple[float, float]:
    """How far a block moves [mm] on a slab that is tilted to 30 degrees, and then in half a second at rest: by its mean
    place in a quarter of a second, in which it has swung four times."""
    scene, start, rows = on_slope(0.0, friction)
    scene = dataclasses.replace(scene, gravity=(0.0, 0.0), body_force=Tilting(np.pi / 6))
    run = mpm.simulate(scene, start, t1=2.05, dt=0.01, method=method, observe=lambda _, p: p.x[rows, 0].mean())
    x = 1e3 * np.asarray(run.observed)
    return x[-75:-50].mean() - x[30], x[-25:].mean() - x[-75:-50].mean()


def slope(quick: bool) -> None:
    """The block on a slope of 30 degrees, and tilted to it."""
    angle = np.pi / 6
    for name in list(IMPLICIT)[: 1 if quick else 4]:
        by, then = tilted(IMPLICIT[name])
        print(f"a block tilted to 30 degrees at μ = 0.8, {name}: {by:.1f} mm, then {then:+.2f} mm")
    print("a block on a slope of 30 degrees, from 0.25 to 0.5 s: what it gains over what the closed form says")
    for name, friction in product(("explicit", *IMPLICIT), (0.0, 0.3, 0.8)):
        method, steps = (mpm.Explicit(), 420) if name == "explicit" else (IMPLICIT[name], 60)
        scene, particles, rows = on_slope(angle, friction)
        run = mpm.simulate(scene, particles, t1=0.5, dt=0.5 / steps, method=method, save_every=steps // 2)
        v = np.asarray(run.frames.v)[1:, rows].mean(axis=1)
        gained = v[1] - v[0]
        if friction > np.tan(angle):
            print(
                f"  {name}, μ = {friction}: slides at {v[1, 0]:+.4f} m/s where it would at {G / 4:.2f} without friction"
            )
            continue
        push = G * np.cos(angle) / 4 + gained[1]
        exact = G * np.sin(angle) / 4 - friction * push
        print(f"  {name}, μ = {friction}: {gained[0] / exact - 1:+.2%}")


ROLLS = {"explicit": (mpm.Explicit(), 900), "semi-implicit": (mpm.SemiImplicit(), 200)}


def rolled(name: str, friction: float = 0.5, t1: float = 1.0, cells: int = 10) -> tuple[float, float]:
    """A disk of so many cells' diameter on a slab of its own softness, 0.1 radians steep: its way over that of a rigid
    one that rolls, g sin θ t²/3, and what it has turned over its way by its radius."""
    R, angle, law = 0.5, 0.1, mpm.NeoHookean(1e6, 0.3)
    grid = mpm.Grid((4 * cells + 6, 8 * cells // 5 + 6), 1 / cells, origin=(-3, -3))
    slab = mpm.fill(mpm.Box((0.0, 0.0), (4.0, 0.4)), grid, density=DENSITY)
    disk = mpm.fill(mpm.Ball((0.9, 0.4 + R), R), grid, density=DENSITY, fitted=True)
    gravity = (G * np.sin(angle), -G * np.cos(angle))
    scene = mpm.Scene(grid, (law, law), gravity=gravity, boundary=HELD, bodies=mpm.Bodies(friction))
    method, steps = ROLLS[name]
    steps = steps * cells // 10
    run = mpm.simulate(scene, mpm.join(slab, disk), t1=t1, dt=t1 / steps, method=method)
    before, after = np.asarray(disk.x), np.asarray(run.final.x)[slab.count :]
    way = (after - before).mean(axis=0)[0]
    turn = (after - after.mean(axis=0)).T @ (before - before.mean(axis=0))
    turned = np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1])  # clockwise, the rotation nearest to it
    return float(way / (G * np.sin(angle) * t1**2 / 3)), float(turned * R / way)


def roll(quick: bool) -> None:
    """A disk that rolls, by integrators."""
    for cells, name in product((10,) if quick else (10, 20), ROLLS):
        way, turned = rolled(name, t1=0.3 if quick else 1.0, cells=cells)
        print(
            f"a disk of {cells} cells rolls, {name}: way over g sin θ t²/3 {way:.4f}, R angle/way {turned:.4f}",
            flush=True,
        )


def pressed(cells: int, press: float) -> dict:
    """Two equal cylinders, of so many cells to the radius of 1 m, whose middles are brought nearer to each other by
    `press` [m]: Hertz's half-width of the contact at the load that the grip feels, a² = 4PR*/(πE*), and the half-width
    by three measures. By where the faces of the outermost particles part, which asks nothing of the contact; by the
    pressure of the springs, and by the forces that they spread on the nodes around, whose second moments are a²/4."""
    E, nu, R = 1e5, 0.3, 1.0
    dx = R / cells
    grid = mpm.Grid((int(1.05 * cells) + 6, 2 * cells + 6), dx, origin=(-3, -3))
    whole = mpm.fill(
        mpm.Ball((0.0, 0.0), R),
        mpm.Grid((2 * cells + 8,) * 2, dx, origin=(-cells - 4,) * 2),
        density=DENSITY,
        fitted=True,
    )
    quarter = np.asarray((whole.x > 0).all(axis=1))
    low = mpm.Particles(*(getattr(whole, name)[quarter] for name in ("x", "v", "mass", "volume")))
    high = dataclasses.replace(low, x=jnp.stack([low.x[:, 0], 2 * R - low.x[:, 1]], axis=1))
    down = mpm.Motion((0.0, 16.0, 20.0), ((0.0, 0.0), (0.0, -press), (0.0, -press)))
    top = mpm.Grip(mpm.HalfSpace((0.0, 2 * R - 1e-9), (0.0, -1.0)), down, axes=(False, True))
    walls = mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0), top
    law = mpm.NeoHookean(E, nu)
    scene = mpm.Scene(grid, (law, law), boundary=walls, bodies=mpm.Bodies(), boundary_forces=True)
    run = mpm.simulate(scene, mpm.join(low, high), t1=20.0, dt=2.0, method=mpm.BackwardEuler(), save_every=2)
    load = 2 * abs(float(run.boundary_forces().force[-1, 1, 1]))
    contact, x = contact_of(scene, run.final, 20.0)
    push = np.maximum(-np.where(np.isfinite(contact.gap), contact.gap, 0) * np.asarray(contact.stiffness), 0)
    spread = np.asarray(contact.patch.spread(jnp.asarray(push)[:, None]))[:, 0]
    last = np.split(np.asarray(run.final.x), 2)
    centres = (0.0, 0.0), (0.0, 2 * R)
    faces, others = map(faces_of, (low.x, high.x), centres, last, run.final.deformations)
    return {
        "hertz": float(np.sqrt(4 * load * (R / 2) / (np.pi * E / (2 * (1 - nu**2))))),
        "faces": parting(faces, others, R / 2),
        **{name: 2 * np.sqrt((p * x[:, 0] ** 2).sum() / p.sum()) for name, p in (("springs", push), ("nodes", spread))},
        "at": x[push > 0, 0],
        "push": push[push > 0],
        "dx": dx,
    }


def faces_of(X: np.ndarray, centre: tuple[float, float], x: np.ndarray, F: np.ndarray) -> np.ndarray:
    """The faces of the outermost particles of a cylinder of radius 1 m that were at X and are at x: the points of its
    surface above them, from left to right."""
    arm = np.asarray(X) - centre
    r = np.hypot(*arm.T)
    outer = r > r.max() - 1e-9
    depth = arm[outer] / r[outer, None] * (1.0 - r[outer, None])
    faces = x[outer] + np.einsum("pij,pj->pi", np.asarray(F)[outer], depth)
    return faces[np.argsort(faces[:, 0])]


def parting(low: np.ndarray, high: np.ndarray, within: float) -> float:
    """Where two surfaces that meet at x = 0 part, by points on them."""
    low = low[low[:, 0] < within]
    gap = np.interp(low[:, 0], *high.T) - low[:, 1]
    k = np.flatnonzero(gap < 0).max()
    return float(np.interp(0.0, gap[k : k + 2], low[k : k + 2, 0]))


def hertz(quick: bool) -> dict:
    """The half-width of the contact of two cylinders over Hertz's."""
    print("two cylinders: half-width over Hertz's, by the faces of the particles, the springs, and the nodes' forces")
    found = {}
    for cells, press in ((24, 0.05),) if quick else ((32, 0.05), (48, 0.03), (64, 0.03), (48, 0.05)):
        found = pressed(cells, press)
        ratios = ", ".join(f"{found[name] / found['hertz']:.3f}" for name in ("faces", "springs", "nodes"))
        print(
            f"  {cells} cells to the radius, {found['hertz'] / found['dx']:.1f} to the half-width: {ratios}", flush=True
        )
    return found


def rings(quick: bool) -> None:
    """Two rings that meet at 60 m/s: the energy after 0.2 s, amid the contact, and after 0.6 s, when they have parted.

    The problem, its scattered points and the energy after 0.2 s, of one velocity field, are those of a test of
    Tesserae.jl (`docs/literate/tutorials/collision.jl`, 2026).
    """
    E, nu, density, dx, speed, L, W = 1e8, 0.2, 1e3, 0.2, 30.0, 20.0, 7.5
    law, grid = mpm.NeoHookean(E, nu), mpm.Grid((201, 77), dx, origin=(-100, -38))
    wave = np.sqrt(E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / density)

    def scattered(seed: int) -> list[mpm.Particles]:
        side = dx / 2
        radius = (0.938001956 / 1.42825365**0.5 + 0.0951151 * (side / (2 * L) + side / (2 * W))) * side
        sampler = qmc.PoissonDisk(2, radius=radius, rng=np.random.default_rng(seed), l_bounds=[-L, -W], u_bounds=[L, W])
        x = sampler.fill_space()
        volume = 4 * L * W / len(x)
        found = []
        for centre in (-L / 4, L / 4):
            r = np.hypot(x[:, 0] - centre, x[:, 1])
            part = x[(r > 3.0) & (r < 4.0)]
            v = jnp.tile(jnp.asarray([-np.sign(centre) * speed, 0.0]), (len(part), 1))
            volumes = jnp.full(len(part), volume)
            found.append(mpm.Particles(jnp.asarray(part), v, density * volumes, volumes))
        return found

    def fitted(seed: int) -> list[mpm.Particles]:
        return [
            mpm.fill(
                mpm.geometry.Annulus((x, 0.0), 3.0, 4.0),
                grid,
                density=density,
                velocity=(-np.sign(x) * speed, 0.0),
                fitted=True,
            )
            for x in (-L / 4, L / 4)
        ]

    print("two rings that meet at 60 m/s: energy [J] at first and in the end")
    cases = [(scattered, seed, 0.2) for seed in range(1 if quick else 3)] + [(fitted, 0, 0.6)] * (not quick)
    for (points, seed, t1), bodies in product(cases, (None, mpm.Bodies())):
        particles = mpm.join(*points(seed))
        scene = mpm.Scene(grid, (law, law), gradient=mpm.SplineGradient(), bodies=bodies)
        steps = int(np.ceil(t1 * (wave + speed) / (0.8 * dx)))
        run = mpm.simulate(scene, particles, t1=t1, dt=t1 / steps)
        first, last = mpm.energy(scene, particles), mpm.energy(scene, run.final)
        momenta = [(body.mass[:, None] * body.v).sum(axis=0) for body in (particles, run.final)]
        momentum = float(jnp.abs(momenta[1] - momenta[0]).max())
        print(
            f"  {points.__name__} {seed}, {'bodies' if bodies else 'one field'}, {t1} s: {float(first.total):.4g} "
            f"{float(last.total):.4g}, of which kinetic {float(last.kinetic):.3g}; momentum changed by {momentum:.0e}"
        )


def two_round(d: int, cells: int, nu: float, volume: mpm.AveragedVolume | None = None) -> tuple:
    """A scene of two disks, or balls, of so many cells a diameter that meet at 1 m/s, their particles, and how many
    particles the first of them has."""
    dx, R = 0.6 / cells, 0.3
    shape = (3 * cells + 4, *(2 * cells,) * (d - 1))
    grid, law = mpm.Grid(shape, dx, origin=[-n // 2 for n in shape]), mpm.NeoHookean(1e5, nu)
    places = [((s * 1.1 * R, s * 0.02, 0.01)[:d], (-0.5 * s, 0.0, 0.0)[:d]) for s in (-1, 1)]
    two = [mpm.fill(mpm.Ball(x, R), grid, density=DENSITY, velocity=v) for x, v in places]
    return mpm.Scene(grid, (law, law), bodies=mpm.Bodies(), volume=volume), mpm.join(*two), two[0].count


def balls(quick: bool) -> None:
    """Two disks, or balls, that meet at 1 m/s, 0.09 of the speed of sound, and part: the most energy on the way, that
    in the end, and the speed with which they part. Explicit steps, as long as `stable_dt` says."""
    print("two disks or balls: cells a diameter, most energy, energy in the end, speed [over the first], momentum")
    cases = ((2, 6, 0.3), (2, 12, 0.3), (2, 24, 0.3), (2, 6, 0.49), (3, 6, 0.3), (3, 6, 0.49))
    for (d, cells, nu), volume in product(cases[:1] if quick else cases, (None, mpm.AveragedVolume())):
        if volume and nu < 0.4:
            continue
        scene, particles, first = two_round(d, cells, nu, volume)
        steps = int(np.ceil(0.5 / float(mpm.stable_dt(scene, particles))))
        run = mpm.simulate(scene, particles, t1=0.5, dt=0.5 / steps, observe=lambda s, p: mpm.energy(s, p).total)
        energy, mass = np.asarray(run.observed), particles.mass[:, None]
        momentum = float(jnp.abs((mass * run.final.v).sum(axis=0)).max() / (mass * jnp.abs(particles.v)).sum())
        back = -float(run.final.v[:first, 0].mean()) / 0.5
        print(
            f"  {d}-D, {cells}, ν = {nu}, {'averaged' if volume else 'own'} volumes: {energy.max() / energy[0]:.3f} "
            f"{energy[-1] / energy[0]:.3f} {back:.3f} {momentum:.0e}",
            flush=True,
        )


def work(quick: bool) -> None:
    """The work of the push over the whole touch of two disks of six cells, and what the transfers take, over the energy
    that the disks bring: by the length of explicit steps, and of one other integrator."""
    print("two disks of 6 cells: steps over stable_dt, most energy, work of the push, loss of the transfers")
    methods = (mpm.Explicit(), 1.0), (mpm.Explicit(), 0.25), (mpm.Explicit(), 0.0625), (mpm.ImplicitMidpoint(), 4.0)
    scene, particles, _ = two_round(2, 6, 0.3)
    limit, start = float(mpm.stable_dt(scene, particles)), float(mpm.energy(scene, particles).total)
    for method, length in methods[:1] if quick else methods:
        steps = int(np.ceil(0.5 / (length * limit)))
        _, found = mpm.budget(scene, particles, steps=steps, dt=0.5 / steps, method=method)
        energy = found.energy
        most = 1 + np.cumsum(np.asarray(energy.change)).max() / start
        push, lost = (float(part.sum()) / start for part in (energy.boundary, energy.p2g + energy.g2p))
        print(f"  {type(method).__name__}, {length}: {most:.3f} {push:+.3f} {lost:.3f}", flush=True)


def draw(found: dict) -> None:
    """The pressure between the cylinders against Hertz's."""
    x, push, exact, dx = (found[name] for name in ("at", "push", "hertz", "dx"))
    columns = np.unique(np.round(x / dx).astype(int))
    force = np.array([push[np.round(x / dx).astype(int) == k].sum() for k in columns])
    share = np.where(columns == 0, 2, 1) * force / force.sum() / 2  # the node on the axis is half a node
    figure, axis = plt.subplots(figsize=(5, 3), layout="constrained")
    axis.plot(columns * dx / exact, share / dx * exact, "o", label="push of the nodes")
    s = np.linspace(0, 1, 200)
    axis.plot(s, 2 / np.pi * np.sqrt(1 - s**2), label="Hertz")
    axis.set(xlabel="x / a", ylabel="pressure · a / P", ylim=(0, None))
    axis.legend(frameon=False)
    figure.savefig(DOCS / "bodies.png", dpi=130)


TABLES: dict[str, Callable] = {
    "rest": rest,
    "normals": normals,
    "slope": slope,
    "roll": roll,
    "hertz": hertz,
    "rings": rings,
    "balls": balls,
    "work": work,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=TABLES)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.only in (None, name):
            found = table(options.quick)
            if name == "hertz" and not options.quick:
                draw(found)
