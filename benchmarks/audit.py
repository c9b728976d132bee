"""Scenes with an exact answer in which an earlier version was wrong without a word: water at rest, a fluid that is
thrown at a wall, a block on a rough floor, a fit of a cylinder, a gradient in float32, a film of Bingham's fluid,
clouds, a spinning disk.

    python benchmarks/audit.py                   prints the tables (some twenty minutes alone on two cores)
    python benchmarks/audit.py --only film       one of rest, long, down, splash, walls, askew, maps, thrown,
                                                 friction, cylinder, gradient, film, clouds, disk
"""

import argparse
import dataclasses
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import mpmjax as mpm

jax.config.update("jax_enable_x64", True)
INF = np.inf
WATER, G = 1e3, 10.0


def walls_of(
    kind: str, lower: float, upper: float, motion: mpm.Motion | None = None
) -> tuple[mpm.boundary.AbstractBoundary, ...]:
    """A vessel that is open above; planes and a `SeparatingBox` do not move."""
    wall: Any = getattr(mpm, kind)
    if kind.endswith("Box"):
        return (wall((lower, lower), (upper, INF), **({"motion": motion} if motion else {})),)
    if kind.endswith("Plane"):
        return wall(0, lower), wall(0, upper, keep="below"), wall(1, lower)
    sides = ((lower, 0.0), (1.0, 0.0)), ((upper, 0.0), (-1.0, 0.0)), ((0.0, lower), (0.0, 1.0))
    return tuple(wall(mpm.HalfSpace(point, normal), motion) for point, normal in sides)


def pressure(law: mpm.material.AbstractLaw, F: jax.Array, history: object) -> jax.Array:
    """The mean stress in the plane [Pa], below zero, at an F or J, component first."""
    P = law.elastic(history).stress(F)
    return -P if F.ndim == 1 else -(P * F).sum(axis=(0, 1)) / (2 * mpm.linalg.determinant(F))


def squeezed(law: mpm.material.AbstractLaw, wanted: np.ndarray) -> tuple[jax.Array, object]:
    """F or J, component first, and the history of particles squeezed alike in all directions to a pressure [Pa]."""

    def at(stretch: np.ndarray) -> tuple[jax.Array, object]:
        F = jnp.asarray(law.measure.undeformed(2))[..., None] * stretch
        history = law.initial_history(F)
        if isinstance(law, mpm.material.AbstractHenckyPlasticity):
            history = dataclasses.replace(history, transverse_strain=jnp.log(stretch))
        return F, history

    low, high = np.full_like(wanted, 0.8), np.ones_like(wanted)
    for _ in range(50):
        middle = (low + high) / 2
        short = np.asarray(pressure(law, *at(middle))) < wanted
        low, high = np.where(short, low, middle), np.where(short, middle, high)
    return at(high)


def settled(
    law: mpm.material.AbstractLaw,
    kind: str,
    at: float,
    times: float,
    seconds: float,
    cells: int = 8,
    crossed: float = 0.0,
    per_cell: int = 4,
    **choices: Any,
) -> str:
    """A vessel that starts in its exact state, so many cells wide and half as deep, with walls at so many spacings from
    a node, in steps of so many times the explicit limit; it moves sideways by so many spacings; with choices of the
    scene."""
    dx, wide, deep, low = 1 / 16, cells / 16, cells / 32, at / 16
    load = WATER * G * deep
    grid = mpm.Grid((cells + 10, cells + 12), dx, origin=(-4, -4))
    box = mpm.Box((low, low), (low + wide, low + deep))
    water = mpm.fill(box, grid, particles_per_cell=per_cell, density=WATER)
    way = (crossed * dx, 0.0)
    motion = mpm.Motion((0.0, seconds), ((0.0, 0.0), way)) if crossed else None
    water = dataclasses.replace(water, v=water.v + jnp.asarray(way) / seconds)
    scene = mpm.Scene(grid, law, gravity=(0.0, -G), boundary=walls_of(kind, low, low + wide, motion), **choices)
    F, history = squeezed(law, np.asarray(WATER * G * (deep + low - water.x[:, 1])))
    volume = water.volume / law.measure.determinant(F)
    stored = jnp.moveaxis(F, -1, 0)
    water = dataclasses.replace(water, deformations=(stored,), histories=(history,), volume=volume, mass=WATER * volume)
    floor = np.asarray(water.x[:, 1]) < low + dx / 2

    def observe(scene, now):
        at_particles = pressure(scene.laws[0], jnp.moveaxis(now.F, 0, -1), now.groups[0].history)
        error = jnp.sqrt(((at_particles - WATER * G * (deep + low - now.x[:, 1])) ** 2).mean()) / load
        return error, at_particles[floor].mean() / (load - WATER * G * dx / 4)

    dt = times * float(mpm.stable_dt(mpm.Scene(grid, scene.laws), water, safety=1.0))
    method, steps = mpm.Explicit() if times < 1 else mpm.SemiImplicit(), round(seconds / dt)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = mpm.simulate(scene, water, t1=steps * dt, dt=dt, method=method, observe=observe)
    error, bottom = (np.asarray(each)[-max(steps // 4, 1) :] for each in run.observed)
    level = float((run.final.x[:, 1].mean() - low) / (water.x[:, 1].mean() - low))
    return f"{at:5.2f} {times:4.1f} | {100 * np.sqrt((error**2).mean()):6.2f} {level:6.3f} {bottom.mean():6.3f}"


def rest(cells: int = 8) -> None:
    """Water that starts in its exact state stays in it: the error of the pressure and the centre's height."""
    print("water at rest, K = 40 ρgH, after 2 s: wall, spacings from a node, times the explicit limit;")
    print("rms error of the pressure over the last half second [% of ρgH], height of the centre over the exact one,")
    print("pressure of the lowest row over its own")
    law = mpm.Fluid(40 * WATER * G * cells / 32)
    for kind, at, times in (
        *(("SeparatingBox", at, times) for at in (0.0, 0.1, 0.25, 0.5) for times in (0.7, 9.0)),
        *((kind, at, times) for kind in ("ContactPlane", "SymmetryPlane") for at in (0.0, 0.5) for times in (0.7, 9.0)),
    ):
        print(f"{kind:>14}", settled(law, kind, at, times, 2.0, cells), flush=True)


def long() -> None:
    """The same for longer: particles near nodes and knots of the kernel stir by the default gradient."""
    print("\nthe same, 16 by 8 cells, after 10 s: wall, gradient, particles a cell")
    law, spline = mpm.Fluid(2e5), mpm.SplineGradient()
    cases: list[tuple[Any, ...]] = [(kind, 0.25, None, 4) for kind in ("SlipBox", "SeparatingBox")]
    cases += [("SlipBox", at, None, 4) for at in (0.1, 0.2, 0.3, 0.4)]
    cases += [("SlipBox", 0.25, None, 9), ("SlipBox", 0.25, None, 16)]
    cases += [(kind, 0.25, spline, 4) for kind in ("SlipBox", "SeparatingBox")] + [("SlipBox", 0.1, spline, 4)]
    for kind, at, gradient, per_cell in cases:
        row = settled(law, kind, at, 20.0, 10.0, 16, per_cell=per_cell, gradient=gradient)
        print(f"{kind:>14} {'spline' if gradient else 'default':>7} {per_cell:2}", row, flush=True)
    print(
        "the force of a uniform pressure p, in p ∂²u/∂x², in a displacement that keeps volume: lattice by its distance"
    )
    print("from the nodes [spacings], particles along a cell, moving least squares, spline")
    for n, s in ((n, s) for n in (2, 3, 4) for s in (0.0, 0.1, 0.15, 0.25)):
        print(
            f"{s:5.2f} {n} | {still_force(s, n, least_squares=True):7.3f} {still_force(s, n, least_squares=False):7.3f}"
        )


def still_force(shift: float, count: int, *, least_squares: bool) -> float:
    """½ Σ_p V ∂g/∂x x² − (Σ_p V g x) (Σ_p V w' y) of node 0 for particles V = 1/count apart and u_x = x²/2, u_y = −x y,
    in spacings: the force on it over p, which is zero where sums are integrals."""

    def weight(y: jax.Array) -> jax.Array:
        a = jnp.abs(y)
        return jnp.where(a < 0.5, 0.75 - a**2, jnp.where(a < 1.5, (1.5 - a) ** 2 / 2, 0))

    slope = jax.vmap(jax.grad(weight))
    g = (lambda y: -4 * y * weight(y)) if least_squares else slope
    x = shift + 1e-9 + jnp.arange(-3 * count, 3 * count + 1) / count  # off the knots, where the slope has a kink
    small = 1e-6
    along = (g(x + small * x**2 / 2) - g(x - small * x**2 / 2)).sum() / (2 * small) / count
    return float(along - (x * g(x)).sum() * (x * slope(x)).sum() / count**2)


def down() -> None:
    """Water that is let down, from J = 1, half as deep as wide: what a wall that sticks leaves of its pressure."""
    print("\nwater let down, after 4 s: wall, spacings from a node, cells, K/ρgH, viscosity [Pa s], particles a cell;")
    print("rms error of the pressure, of its `smoothed`, and of the worst particle [% of ρgH], the last over")
    print("the distance of that particle from the corner [spacings]")
    cases: list[tuple[Any, ...]] = [("StickyBox", 0.1, cells, 40.0, 0.0, 4) for cells in (8, 16, 32)]
    cases += [("StickyBox", at, 16, 40.0, 0.0, 4) for at in (0.0, 0.25, 0.5)]
    cases += [("StickyBox", 0.1, 8, 400.0, 0.0, 4), ("StickyBox", 0.1, 8, 40.0, 10.0, 4)]
    cases += [("StickyBox", 0.1, 16, 40.0, 0.0, 9), ("SlipBox", 0.1, 16, 40.0, 0.0, 4)]
    for kind, at, cells, stiff, viscosity, per_cell in cases:
        dx, low, wide, deep = 1 / 16, at / 16, cells / 16, cells / 32
        load = WATER * G * deep
        grid = mpm.Grid((cells + 10, cells + 12), dx, origin=(-4, -4))
        box = mpm.Box((low, low), (low + wide, low + deep))
        water = mpm.fill(box, grid, particles_per_cell=per_cell, density=WATER)
        fluid = mpm.Fluid(stiff * load)
        law = mpm.Viscous(fluid, viscosity) if viscosity else fluid
        scene = mpm.Scene(grid, law, gravity=(0.0, -G), boundary=walls_of(kind, low, low + wide))
        dt = 20.0 * float(mpm.stable_dt(mpm.Scene(grid, law), water, safety=1.0))
        steps = round(4.0 / dt)
        final = mpm.rollout(scene, mpm.prepare(scene, water), steps=steps, dt=dt, method=mpm.SemiImplicit())
        start = np.linspace(-deep / 2, deep, 3001)  # the height of what is at a height at rest
        J = np.asarray(squeezed(fluid, WATER * G * (deep - start))[0])
        height = np.concatenate([[0.0], np.cumsum((J[1:] + J[:-1]) / 2 * np.diff(start))])
        height -= np.interp(0.0, start, height)
        exact = WATER * G * (deep - np.interp(final.x[:, 1] - low, height, start))
        error = (pressure(law, jnp.moveaxis(final.F, 0, -1), None) - exact) / load
        smooth = mpm.analysis.smoothed(scene, final, error)
        worst = int(jnp.abs(error).argmax())
        x = final.x[worst] - low
        away = float(jnp.hypot(jnp.minimum(x[0], wide - x[0]), x[1])) / dx
        rms = [100 * float(jnp.sqrt((each**2).mean())) for each in (error, smooth)]
        print(
            f"{kind:>14} {at:4.2f} {cells:2} {stiff:4.0f} {viscosity:4.0f} {per_cell:2} | "
            f"{rms[0]:5.2f} {rms[1]:5.2f} {100 * float(error[worst]):6.1f} {away:5.2f}",
            flush=True,
        )


def splash() -> None:
    """A dam that breaks in a closed vessel: the level that it keeps, by particles a cell, corrected or not."""
    print(
        "\na dam, 0.5 m x 1 m, breaks in a vessel 1 m wide, K = 20 ρgH: wall, gradient, step over the longest explicit"
    )
    print("one, cells a metre, particles along a cell; height of the water's centre, less v²/2g of its particles, over")
    print("0.25 m, means of the fourth and the eighth second; the same with extensions.DensityCorrection")
    gradients = {"default": None, "spline": mpm.SplineGradient()}
    cases = [("SlipBox", "default", times, 16, n) for times in (0.35, 5.0) for n in (2, 3)]
    cases += [("SlipBox", "default", 0.35, 16, 4), ("SlipBox", "default", 0.35, 32, 2)]
    cases += [("SlipBox", "spline", 0.35, 16, n) for n in (2, 3)]
    cases += [("SeparatingBox", "default", 0.35, 16, n) for n in (2, 3)]
    for kind, gradient, times, cells, n in cases:
        grid = mpm.Grid((cells + 10, 4 * cells + 12), 1 / cells, origin=(-4, -4))
        law = mpm.Fluid(20 * WATER * G)
        water = mpm.fill(mpm.Box((0.0, 0.0), (0.5, 1.0)), grid, particles_per_cell=n**2, density=WATER)
        free = mpm.Scene(grid, law, gravity=(0.0, -G), gradient=gradients[gradient])
        dt = 8.0 / round(8.0 / float(mpm.stable_dt(free, water, safety=times)))
        method = mpm.Explicit() if times < 1 else mpm.SemiImplicit()
        levels = []
        for correction in (None, mpm.extensions.DensityCorrection(mpm.Box((0.0, 0.0), (1.0, INF)))):
            scene = dataclasses.replace(free, boundary=walls_of(kind, 0.0, 1.0), correction=correction)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                seen = mpm.simulate(scene, water, t1=8.0, dt=dt, method=method, observe=rest_height).observed
            seconds = np.array_split(np.asarray(seen) / 0.25, 8)
            levels.append(f"{seconds[3].mean():6.3f} {seconds[7].mean():6.3f}")
        print(f"{kind:>14} {gradient:>7} {times:4} {cells} {n} | {' | '.join(levels)}", flush=True)


def rest_height(scene: mpm.Scene, water: mpm.Particles) -> jax.Array:
    """The height at which the centre of what sloshes would rest, half of whose energy is kinetic [m]."""
    return water.x[:, 1].mean() - (water.v**2).sum(axis=1).mean() / (2 * G)


def walls() -> None:
    """Every law that flows or yields, at every kind of wall, on nodes."""
    print("\nthe same after 1 s, by law; of sand, clay and snow the level alone is unique")
    K, load = 1e5, 2.5e3
    E = 3 * K * (1 - 2 * 0.45)
    boxes, others = ("StickyBox", "SlipBox", "SeparatingBox"), ("ContactPlane", "SymmetryPlane")
    colliders = ("SlipCollider", "SeparatingCollider")
    for law in (mpm.Fluid(K), mpm.Viscous(mpm.Fluid(K), 10.0), mpm.HerschelBulkley(E, 0.45, load / 100, 10.0)):
        for kind, times in ((kind, times) for kind in (*boxes, *colliders, *others) for times in (0.7, 9.0)):
            print(f"{type(law).__name__:>16} {kind:>18}", settled(law, kind, 0.0, times, 1.0), flush=True)
    print("a fluid in a vessel that moves sideways by two spacings")
    for kind, times in ((kind, times) for kind in ("SlipBox", "StickyCollider", colliders[1]) for times in (0.7, 9.0)):
        print(f"{kind:>35}", settled(mpm.Fluid(K), kind, 0.1, times, 1.0, crossed=2.0), flush=True)
    for law in (mpm.DruckerPrager(E, 0.45, 0.5), mpm.CamClay(E, 0.45, 1.0, 2 * load), mpm.Snow(E, 0.45)):
        for kind in boxes:
            print(f"{type(law).__name__:>16} {kind:>18}", settled(law, kind, 0.0, 9.0, 1.0), flush=True)


def askew() -> None:
    """Water in two colliders at right angles, turned by an angle, and in a bowl, from its exact state."""
    print(
        "\nwater at rest, K = 40 ρgH, H cells deep, after 2 s, at so many times the explicit limit: wall, vessel, cells"
    )
    print("rms error of the pressure over the last second [% of ρgH], change of the centre's height [% of H]")
    at, dx = np.array([0.013, 0.021]), 1 / 16
    cases = [(mpm.SeparatingCollider, k, n, s) for k in (20.0, 37.0, "bowl") for n in (8, 16) for s in (0.7, 9.0)]
    cases += [(wall, k, 8, 0.7) for wall in (mpm.SlipCollider, mpm.StickyCollider) for k in (20.0, 37.0, "bowl")]
    for wall, kind, cells, times in cases:
        deep = cells * dx
        if isinstance(kind, str):
            ball = mpm.Ball((at[0], deep), deep)
            shapes: tuple[Any, ...] = (mpm.geometry.Complement(ball),)
            inside, top = mpm.geometry.Intersection((ball, mpm.Box((-2.0 * deep, -deep), (2.0 * deep, deep)))), deep
        else:
            a, b = np.sin(np.deg2rad(kind)), np.cos(np.deg2rad(kind))
            shapes, top, reach = (
                tuple(mpm.HalfSpace(at, n) for n in ((-a, b), (b, a))),
                at[1] + deep,
                deep * b / a + 0.1,
            )
            outside = map(mpm.geometry.Complement, shapes)
            inside = mpm.geometry.Intersection((*outside, mpm.Box((-reach, -0.1), (reach, top))))
        lower, upper = (np.floor(np.asarray(corner) / dx).astype(int) for corner in inside.bounds())
        grid = mpm.Grid(tuple(upper - lower + 10), dx, origin=tuple(lower - 4))
        law, water = mpm.Fluid(40 * WATER * G * deep), mpm.fill(inside, grid, density=WATER)
        F, history = squeezed(law, np.asarray(WATER * G * (top - water.x[:, 1])))
        part, volume = water.volume / water.volume.sum(), water.volume / F
        water = dataclasses.replace(
            water, deformations=(F,), histories=(history,), volume=volume, mass=WATER * water.volume
        )

        def observe(scene, now, part=part, load=WATER * G * deep, top=top):
            error = pressure(scene.laws[0], now.F, None) - WATER * G * (top - now.x[:, 1])
            return jnp.sqrt(part @ error**2) / load, part @ now.x[:, 1]

        dt = times * float(mpm.stable_dt(mpm.Scene(grid, law), water, safety=1.0))
        method, steps = mpm.Explicit() if times < 1 else mpm.SemiImplicit(), round(2.0 / dt)
        scene = mpm.Scene(grid, law, gravity=(0.0, -G), boundary=tuple(map(wall, shapes)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            run = mpm.simulate(scene, water, t1=steps * dt, dt=dt, method=method, observe=observe)
        error, height = map(np.asarray, run.observed)
        rise = 100 * float(height[-1] - part @ water.x[:, 1]) / deep
        print(
            f"{wall.__name__:18} {kind:>5} {cells:3d} {times:4.1f} | "
            f"{100 * np.sqrt((error[-steps // 2 :] ** 2).mean()):6.2f} {rise:7.3f}",
            flush=True,
        )


def maps() -> None:
    """What a fluid at colliders costs: at three half-spaces across axes, and askew."""
    print("\nwater at three half-spaces: collider, where, method, seconds of CPU to compile 50 steps, ms a step")
    grid = mpm.Grid((80, 80), 1 / 64, origin=(-8, -8))
    water = mpm.fill(mpm.Box((0.05, 0.05), (0.9, 0.5)), grid, density=WATER)
    places, across = ((0.05, 0.05), (0.05, 0.05), (0.9, 0.02)), ((0.0, 1.0), (1.0, 0.0), (-1.0, 0.0))
    tilted = tuple((a + 0.03 * b, b + 0.03 * abs(a)) for a, b in across)
    for wall in (mpm.SlipCollider, mpm.StickyCollider, mpm.SeparatingCollider):
        for where, normals in (("across axes", across), ("askew", tilted)):
            walls = tuple(wall(mpm.HalfSpace(*each)) for each in zip(places, normals, strict=True))
            scene = mpm.Scene(grid, mpm.Fluid(1e5), gravity=(0.0, -G), boundary=walls)
            particles = mpm.prepare(scene, water)
            for method in (mpm.Explicit(), mpm.SemiImplicit()):
                begun, seconds = time.process_time(), []
                steps = jax.jit(lambda s, q, method=method: mpm.rollout(s, q, steps=50, dt=5e-4, method=method))
                compiled = steps.lower(scene, particles).compile()
                took = time.process_time() - begun
                for _ in range(20):
                    begun = time.perf_counter()
                    jax.block_until_ready(compiled(scene, particles))
                    seconds.append(time.perf_counter() - begun)
                name = f"{wall.__name__:18} {where:11} {type(method).__name__:12}"
                print(f"{name} {took:5.1f} {1e3 * min(seconds) / 50:7.2f}", flush=True)


def thrown() -> None:
    """A fluid that falls on the floor of a vessel at its own speed of sound, without gravity."""
    print("\na fluid thrown at 1 c on a SeparatingBox: step over dx/c, deepest centre [spacings behind it], least J")
    dx = 1 / 32
    low, high = 3 * dx, 37 * dx
    grid = mpm.Grid((41, 41), dx)
    fluid = mpm.fill(mpm.Box((0.4, 0.4), (0.8, 0.8)), grid, density=WATER, velocity=(0.0, -10.0))
    scene = mpm.Scene(grid, mpm.Fluid(1e5), boundary=mpm.SeparatingBox((low, low), (high, high)))
    for dt in (5e-4, 1e-4, 5e-5, 5e-6):
        try:
            run = mpm.simulate(
                scene, fluid, t1=0.08, dt=dt, observe=lambda _, now: jnp.stack([now.x[:, 1].min(), now.F.min()])
            )
            lowest, least = np.asarray(run.observed).min(axis=0)
            print(f"{dt * 10 / dx:8.4f} | {(low - lowest) / dx:6.3f} {least:6.3f}", flush=True)
        except mpm.SimulationError as error:
            print(f"{dt * 10 / dx:8.4f} | {error}", flush=True)


def friction() -> None:
    """A block that friction holds, or that slides, pushed along the floor."""
    print("\na block of 1e6 Pa on a rough floor, pushed by at most μ it should rest: method, step [s], μ, push [g];")
    print("creep [mm/s], friction over weight")
    grid = mpm.Grid((24, 12), 0.05, origin=(-4, -4))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.15)), grid, density=WATER)
    for method in (mpm.SemiImplicit(), mpm.BackwardEuler(), mpm.ImplicitMidpoint(), mpm.TRBDF2()):
        for dt, mu, push in ((0.01, 0.15, 0.12), (0.005, 0.15, 0.12), (0.01, 0.3, 0.12), (0.01, 0.15, 0.2)):
            floor = mpm.SeparatingBox((-INF, 0.0), (INF, INF), friction=mu)
            scene = mpm.Scene(grid, mpm.NeoHookean(1e6, 0.3), gravity=(push * 9.81, -9.81), boundary=floor)
            steps = round(0.5 / dt)
            before = mpm.rollout(scene, mpm.prepare(scene, block), steps=steps, dt=dt, method=method)
            after = mpm.rollout(scene, before, steps=steps, dt=dt, method=method)
            creep = float((after.x - before.x)[:, 0].mean()) / 0.5 * 1e3
            rubbed = push - float((after.v - before.v)[:, 0].mean()) / 0.5 / 9.81
            print(
                f"{type(method).__name__:>16} {dt:6.3f} {mu:5.2f} {push:5.2f} | {creep:8.3f} {rubbed:7.4f}", flush=True
            )


def pressed(law: mpm.NeoHookean, stretches: np.ndarray, area: float) -> np.ndarray:
    """The force [N] of a bar of a section that is free at its sides, by its stretch: the closed form."""

    def force(stretch):
        def side(_, wide):
            def pull(wide):
                return law.stress(jnp.diag(jnp.stack([wide, stretch, wide]))[..., None])[0, 0, 0]

            return wide - pull(wide) / jax.grad(pull)(wide)

        wide = jax.lax.fori_loop(0, 20, side, stretch**-0.5)
        return area * law.stress(jnp.diag(jnp.stack([wide, stretch, wide]))[..., None])[1, 1, 0]

    return np.asarray(jax.vmap(force)(jnp.asarray(stretches)))


def cylinder() -> None:
    """A silicone cylinder between smooth plates, pressed by a fifth of its height, and the fit of its modulus: what is
    left is the error of the linearisation, of second order in the step. It has the same deformation on every grid."""
    print(
        "\na silicone cylinder, 300 kPa in the closed form of its force: method, cells a radius, steps, the fit [kPa]"
    )
    for method, cells, steps in (
        *((mpm.SemiImplicit(), cells, steps) for cells, steps in ((2, 10), (4, 10), (2, 20), (2, 40))),
        *((mpm.ImplicitMidpoint(), 2, steps) for steps in (10, 40)),
    ):
        radius, height = 0.0145, 0.03
        dx = radius / cells
        high = round(height / dx)  # whole cells
        motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0, 0.0), (0.0, -0.2 * high * dx, 0.0)))
        plates = [mpm.SymmetryPlane(axis, 0.0) for axis in range(3)]
        plates.append(mpm.SymmetryPlane(1, high * dx, keep="below", motion=motion))
        grid = mpm.Grid((2 * cells + 6, high + 6, 2 * cells + 6), dx, origin=(-cells - 3, -3, -cells - 3))
        region = mpm.geometry.Cylinder((0.0, 0.0, 0.0), (0.0, high * dx, 0.0), radius)
        whole = mpm.fill(region, grid, particles_per_cell=8, density=1e3)
        quarter = np.asarray((whole.x[:, 0] > 0) & (whole.x[:, 2] > 0))
        silicone = mpm.Particles(whole.x[quarter], whole.v[quarter], whole.mass[quarter], whole.volume[quarter])
        grid = mpm.Grid((cells + 6, high + 6, cells + 6), dx, origin=(-3, -3, -3))
        area = float(silicone.volume.sum()) / (high * dx)
        times = np.linspace(0.2, 0.95, 16)
        force = -pressed(mpm.NeoHookean(3e5, 0.45), 1 - 0.2 * times, area)  # up, on the plate
        seen = mpm.fitting.Force(times, np.stack([0 * force, force, 0 * force], axis=1), boundary=3, sigma=0.01)
        scene = mpm.Scene(
            grid,
            mpm.NeoHookean(2e5, 0.45),
            boundary=tuple(plates),
            boundary_forces=True,
            description=mpm.TotalLagrangian(),
        )
        experiment = mpm.Experiment(scene, silicone, t1=1.0, dt=1.0 / steps, method=method, observations=seen)
        result = mpm.fit(experiment, {"E": mpm.Positive(lambda e: e.scene.material.youngs_modulus)})
        (E,) = result.estimates
        name = type(method).__name__
        print(f"{name:>16} {cells:2} {steps:3} | {E.value / 1e3:8.2f} ± {E.error / 1e3:.2f}", flush=True)


def gradient() -> None:
    """A gradient in float32 of ten steps of a stiff block that stands beside a wall."""
    print("\nd(height)/dE in float32, a block of 1e7 Pa between walls: rtol of the adjoint solves; relative error")
    grid = mpm.Grid((16, 16), 0.05, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.4)), grid, particles_per_cell=4, density=1e3)
    walls = mpm.SlipBox((0.0, 0.0), (INF, INF))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e7, 0.45), gravity=(0.0, -9.81), boundary=walls)

    def slope(dtype, **solvers):
        particles = jax.tree.map(lambda a: jnp.asarray(a, dtype), block)

        def height(E):
            changed = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, E)
            method = mpm.SemiImplicit(**solvers)
            return mpm.rollout(changed, particles, steps=10, dt=2e-2, method=method).x[:, 1].mean()

        return float(jax.grad(height)(jnp.asarray(1e7, dtype)))

    tight = mpm.implicit.ConjugateResidual(rtol=1e-12)
    exact = slope(jnp.float64, solver=tight, adjoint_solver=tight)
    for rtol in (1e-6, 1e-7, 1e-8):  # the first is the default
        error = slope(jnp.float32, adjoint_solver=mpm.implicit.ConjugateResidual(rtol=rtol)) / exact - 1
        print(f"{rtol:8.0e} | {error:9.1e}", flush=True)


def film(cells: int = 8) -> None:
    """A film of Bingham's fluid on a floor that holds it, pulled along it: steady, its upper half is a plug."""
    print("\na film of Bingham's fluid: steps over the explicit limit, speed of its surface over the exact one")
    grid = mpm.Grid((4, cells + 8), 1 / cells, origin=(0, -4), periodic=(True, False))
    law = mpm.HerschelBulkley(2e4, 0.3, yield_stress=50.0, consistency=50.0)  # ρ g h = 100 Pa at the floor
    floor = mpm.StickyBox((-INF, 0.0), (INF, INF))
    scene = mpm.Scene(grid, law, gravity=(0.1, 0.0), boundary=floor)
    rest = mpm.fill(mpm.Box((0.0, 0.0), (4 / cells, 1.0)), grid, particles_per_cell=4, density=1e3)
    exact = 1e3 * 0.1 * 0.5**2 / (2 * 50)
    for times, method in ((0.7, mpm.Explicit()), (1.0, mpm.SemiImplicit()), (5.0, mpm.SemiImplicit())):
        dt = times * float(mpm.stable_dt(scene, rest, safety=1.0))
        with warnings.catch_warnings(record=True) as heard:
            warnings.simplefilter("always")
            run = mpm.simulate(scene, rest, t1=round(20 / dt) * dt, dt=dt, method=method)
        surface = float(run.final.v[np.asarray(run.final.x[:, 1]) > 0.8, 0].mean()) / exact
        print(f"{times:4.1f} | {surface:6.3f}", *(f"\n     {w.message}" for w in heard), flush=True)


def clouds(count: int = 40) -> None:
    """Six particles in the square that they fill, stretched: whether the linearised step grows at `stable_dt`."""
    sys.path[:0] = [str(Path(__file__).parents[1] / path) for path in ("tests", "tests/validation")]
    from test_stability import eigenvalues

    print("\nclouds of six particles, stretched by 1 to 2.6: ν, least real eigenvalue of a step at 0.999 of stable_dt")
    rng, dx = np.random.default_rng(1), 1.0
    for nu in (0.3, 0.45, 0.49, 0.4999):
        least = []
        for _ in range(count // 4):
            stretch = np.exp(rng.uniform(0, np.log(2.6), 2))
            turn = np.linalg.qr(rng.normal(size=(2, 2)))[0]
            F = turn @ np.diag(stretch) @ turn.T
            side = np.sqrt(1.5 * stretch.prod()) * rng.uniform(1.0, 1.3)
            x, same = jnp.asarray(side * rng.uniform(-0.5, 0.5, (6, 2))), jnp.full(6, 0.25)
            scene = mpm.Scene(mpm.Grid((9, 9), dx, origin=(-4, -4)), mpm.NeoHookean(1.0, nu))
            cloud = mpm.Particles(x, 0 * x, same, same, deformations=(jnp.tile(jnp.asarray(F), (6, 1, 1)),))
            dt = 0.999 * mpm.stable_dt(scene, cloud, safety=1.0)
            least.append(eigenvalues(scene, cloud, dt).real.min())
        print(f"{nu:7.4f} | {min(least):8.4f}", flush=True)


def disk() -> None:
    """A stiff disk that is given the velocities of a spin of 2 rad/s, for 0.4 s."""
    print("\na disk that spins, by velocities alone: transfer, cells across; angle over ωt, kinetic energy left")
    omega, t1, dx = 2.0, 0.4, 0.1
    for radius in (0.3, 0.6):
        n = round(2 * radius / dx) + 10
        grid, c = mpm.Grid((n + 1, n + 1), dx), n * dx / 2
        still = mpm.fill(mpm.Ball((c, c), radius), grid, density=1e3)
        arm = np.asarray(still.x) - c
        spinning = eqx.tree_at(lambda q: q.v, still, omega * jnp.stack([-arm[:, 1], arm[:, 0]], axis=1))
        for transfer in (mpm.APIC(), mpm.FLIP(1.0)):
            scene = mpm.Scene(grid, mpm.NeoHookean(1e6, 0.3), transfer=transfer)
            start = mpm.prepare(scene, spinning)
            dt = t1 / np.ceil(t1 / float(mpm.stable_dt(scene, start)))
            final = mpm.simulate(scene, start, t1=t1, dt=dt).final
            end = np.asarray(final.x) - c
            turned = np.arctan2((arm[:, 0] * end[:, 1] - arm[:, 1] * end[:, 0]).sum(), (arm * end).sum())
            kinetic = float(mpm.energy(scene, final).kinetic / mpm.energy(scene, start).kinetic)
            name = type(transfer).__name__
            print(f"{name:>5} {2 * radius / dx:3.0f} | {turned / (omega * t1):6.4f} {kinetic:6.4f}", flush=True)


TABLES = {
    "rest": rest,
    "long": long,
    "down": down,
    "splash": splash,
    "walls": walls,
    "askew": askew,
    "maps": maps,
    "thrown": thrown,
    "friction": friction,
    "cylinder": cylinder,
    "gradient": gradient,
    "film": film,
    "clouds": clouds,
    "disk": disk,
}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=TABLES, help="one table")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.only in (None, name):
            table()
