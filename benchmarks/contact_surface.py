"""Where contact is felt: the place of rest, the onset of an impact and the bounce of a block, of contact at the nodes,
as it was, and of contact at the particles' faces, as it is.

    python benchmarks/contact_surface.py            prints the tables (minutes)
    python benchmarks/contact_surface.py --quick    one grid (a minute)
    python benchmarks/contact_surface.py --only block    one of rest, bar, block, ball

A bar, or a square block, falls on a plain wall that lies anywhere between nodes. Its mean velocity tells
when the wall has given 2 and 98 % of its impulse; by the exact solution of the bar, the time between is 0.96 of 2L/c,
and the first comes 0.04 L/c after its face is at the wall. The reference of the block is the same block at four times
the resolution. A ball, in its section, is thrown at a plane and compared with Hertz's contact and finite elements.
"""

import argparse
import itertools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers.finite_elements import Mesh, simulate as by_elements

import mpmjax as mpm
from mpmjax._types import Array

jax.config.update("jax_enable_x64", True)
INF = np.inf
SPEED = 0.01
"""Of the impact, in wave speeds."""


class NodeContact(mpm.boundary.AbstractContact):
    """Contact at nodes: each node at or beyond the wall is held where it would enter, and released where it is
    pulled."""

    beyond: Array

    def gap_velocity(self, held, v):
        return jnp.where(self.beyond, v[:, 0], 0)

    def normal_impulse(self, held, residual):
        return held.impulse(residual)[:, 0]

    def fixed(self, active, shape):
        return active[:, None] & (jnp.arange(shape[1]) == 0)


class NodeWall(mpm.boundary.AbstractBoundary):
    """The wall of contact at nodes, across the first axis."""

    position: float | Array

    @property
    def dim(self):
        return None

    def conditions(self, nodes, spacing, t, dt, *, reference):
        return mpm.boundary.Conditions(jnp.zeros(nodes.shape, bool), jnp.zeros_like(nodes))

    def contacts(self, faces, grid, window, t, dt):
        return (NodeContact(grid.nodes(window)[:, 0] <= self.position + 1e-3 * grid.spacing),)


WALLS: dict[str, Callable[[float, int], mpm.boundary.AbstractBoundary]] = {
    "at nodes, as it was": lambda at, d: NodeWall(at),
    "SeparatingBox": lambda at, d: mpm.SeparatingBox((at, *(-INF,) * (d - 1)), (INF,) * d),
    "SeparatingCollider": lambda at, d: mpm.SeparatingCollider(
        mpm.HalfSpace((at, *(0.0,) * (d - 1)), (1.0, *(0.0,) * (d - 1)))
    ),
    "ContactPlane": lambda at, d: mpm.ContactPlane(0, at),
}
EXACT = {"onset": 0, "time": 1, "return": 1}
METHODS = {
    "explicit": (mpm.Explicit(), 0.3),
    "midpoint": (mpm.ImplicitMidpoint(), 0.6),
    "TR-BDF2": (mpm.TRBDF2(), 0.6),
    "backward Euler": (mpm.BackwardEuler(), 0.6),
}


def scene_of(cells: int, d: int, wall: str, at: float, gap: float, nu: float, **choices) -> tuple:
    """A block of side one, `gap` spacings above a wall that lies `at` spacings from a node, and the speed of its
    waves."""
    dx = 1.0 / cells
    grid = mpm.Grid((cells + 16,) + (cells + 8,) * (d - 1), dx, origin=(-6,) + (-4,) * (d - 1))
    law = mpm.FixedCorotated(1.0, nu)
    c = float(jnp.sqrt(law.lame_lambda + 2 * law.shear_modulus))
    body = mpm.fill(mpm.Box((0.0,) * d, (1.0,) * d), grid, density=1.0, particles_per_cell=2**d)
    body = eqx.tree_at(lambda b: b.x, body, body.x.at[:, 0].add((at + gap) * dx))
    return mpm.Scene(grid, law, boundary=WALLS[wall](at * dx, d), **choices), body, dx, c


def bounce(cells: int, d: int, wall: str, *, at=0.0, gap=1.8, nu=0.0, method="explicit", **choices) -> dict[str, float]:
    """Onset [spacings before the face is at the wall], time of contact [2L/c], velocity of return [of that before], the
    energy at the end and the most of it, of that before, and the mean error of the velocity while a bar is at the wall,
    which is -v0 (1 - t c/L) exactly [v0]."""
    scene, body, dx, c = scene_of(cells, d, wall, at, gap, nu, **choices)
    v0 = SPEED * c
    body = eqx.tree_at(lambda b: b.v, body, body.v.at[:, 0].set(-v0))
    update, courant = METHODS[method]
    dt = courant * dx / c
    steps = int((gap * dx / v0 + 5 / c) / dt)

    def watch(scene, particles):
        return jnp.stack([particles.v[:, 0].mean(), mpm.energy(scene, particles).total])

    run = mpm.simulate(scene, body, t1=steps * dt, dt=dt, method=update, observe=watch)
    v, energy = np.asarray(run.observed).T
    t = np.arange(steps + 1) * dt
    part = (v + v0) / (v[-1] + v0)
    first, last = (np.interp(share, part[: (k := int(np.argmax(part > share)) + 1)], t[:k]) for share in (0.02, 0.98))
    touching = t * c - gap * dx / v0 * c  # [L]
    at_wall = (touching > 0) & (touching < 2)
    return {
        "error": np.abs(v / v0 + 1 - touching)[at_wall].mean(),
        "onset": (gap * dx / v0 + 0.04 / c - first) * v0 / dx,
        "time": (last - first) / 0.96 / (2 / c),
        "return": v[-1] / v0,
        "energy": energy[-1] / energy[0],
        "most": energy.max() / energy[0],
    }


def rest(cells: int, d: int, wall: str, *, at=0.0, strain=2e-3) -> float:
    """How far above the wall the lower face of a block comes to rest that is let down on it [spacings], its own weight
    straining it by `strain` at its foot: of the mean of its particles, less what that has by the exact solution."""
    scene, body, dx, c = scene_of(cells, d, wall, at, 1.4, 0.0, gravity=(-strain, *(0.0,) * (d - 1)))
    dt = 20 * dx / c
    run = mpm.simulate(scene, body, t1=100 * dt, dt=dt, method=mpm.BackwardEuler())
    exact = at * dx + 0.5 - strain / 3  # centre of a bar under its own weight
    return float(run.final.x[:, 0].mean() - exact) / dx


def _print(rows: list[tuple], names: tuple[str, ...]) -> None:
    print(" | ".join(f"{name:>22}" if k == 0 else f"{name:>10}" for k, name in enumerate(names)))
    for row in rows:
        print(" | ".join(f"{v:>22}" if isinstance(v, str) else f"{v:10.4f}" for v in row), flush=True)


def places(wall: str, *some: float) -> list[float]:
    """Those at which a wall may lie, in spacings from a node."""
    return [a for a in some if wall != "ContactPlane" or (2 * a).is_integer()]


def rests(quick: bool) -> None:
    print("Rest: height of the face over the wall [spacings], worst over the wall's places; a bar, a square, a cube")
    rows = []
    for cells, d in ((16, 1),) if quick else ((16, 1), (6, 2), (4, 3)):
        for wall in WALLS:
            heights = [rest(cells, d, wall, at=a) for a in places(wall, 0.3, 0.5)]
            rows.append((f"{wall[:18]} {cells}, {d}-D", max(heights, key=abs)))
    _print(rows, ("wall, cells", "height"))


def bars(quick: bool) -> None:
    print("\nA bar on a wall, v = 0.01 c, ν = 0: worst over the wall's places; exact: 0, 1, 1")
    rows = []
    for method, cells, wall in (
        *itertools.product(("explicit",), (16,) if quick else (8, 16, 32, 64), WALLS),
        *itertools.product(("midpoint",), (16,), WALLS),
        *itertools.product(("TR-BDF2", "backward Euler"), (16,), ("SeparatingBox",)),
    ):
        some = places(wall, 0.3, 0.5) if quick else places(wall, 0.0, 0.3, 0.5, 0.8)
        found = [bounce(cells, 1, wall, at=a, method=method) for a in some]
        worst = (max((f[k] - e for f in found), key=abs) for k, e in EXACT.items())
        rows.append(
            (f"{wall[:12]} {cells} {method[:4]}", *worst, *(max(f[k] for f in found) for k in ("most", "error")))
        )
    _print(rows, ("wall, cells", "onset", "time − 1", "return − 1", "energy", "error"))


def blocks(quick: bool) -> None:
    print("\nA block, ν = 0.3, less the same of four times the resolution: root mean squares over the wall's places,")
    print("and the mean of the return's error with its sign; then root mean squares over all sizes too")
    rows, over_sizes = [], {wall: [] for wall in list(WALLS)[:2]}
    for cells in (8,) if quick else (6, 8, 12, 16):
        reference = bounce(4 * cells, 2, "SeparatingBox", at=0.3, nu=0.3)
        rows.append(
            (f"reference {4 * cells}", *(reference[k] for k in ("onset", "time", "return")), 0.0, reference["most"])
        )
        for wall in WALLS if cells == 8 and not quick else over_sizes:
            found = [bounce(cells, 2, wall, at=a, nu=0.3) for a in places(wall, 0.0, 0.3, 0.5, 0.8)]
            errors = np.array([[f[k] - reference[k] for k in ("time", "return")] for f in found])
            onset = max((f["onset"] for f in found), key=abs)
            rows.append(
                (f"{wall[:18]} {cells}", onset, *_rms(errors), errors[:, 1].mean(), max(f["most"] for f in found))
            )
            if wall in over_sizes:
                over_sizes[wall].append(_rms(errors))
    before, now = (_rms(np.array(errors)) for errors in over_sizes.values())
    _print(rows, ("wall, cells", "onset", "time", "return", "with sign", "energy"))
    summary = {"all sizes, before": before, "all sizes, now": now, "nearer, times": before / now}
    _print([(name, *found) for name, found in summary.items()], ("over all sizes", "time", "return"))


def _rms(errors: np.ndarray) -> np.ndarray:
    return np.sqrt((errors**2).mean(axis=0))


def ball(cells: int, wall: str, *, at=0.0, gap=0.6, nu=0.3, depth=0.05, fitted=True) -> dict[str, float]:
    """A ball of so many cells a radius, `gap` spacings above a plane `at` spacings from a node, that hits it so fast
    that by Hertz's F = 4/3 E* √R d^1.5 it is pressed in by `depth` radii: the peak force, as a mean over an eighth of
    the time of contact, and the time between 2 and 98 % of the impulse, over Hertz's."""
    dx, law = 1.0 / cells, mpm.NeoHookean(1.0, nu)
    grid = mpm.Grid((int(1.15 * cells) + 5, int(2.3 * cells) + 10), dx, origin=(-2, -4), axisymmetric=True)
    v0, lasts = _hertz(nu, depth)
    whole = mpm.Ball((0.0, 1 + (at + gap) * dx), 1.0)
    body = mpm.fill(whole, grid, density=1.0, velocity=(0.0, -v0), fitted=fitted)
    floor = {
        "SeparatingBox": mpm.SeparatingBox((-INF, at * dx), (INF, INF)),
        "SeparatingCollider": mpm.SeparatingCollider(mpm.HalfSpace((0.0, at * dx), (0.0, 1.0))),
        "ContactPlane": mpm.ContactPlane(1, at * dx),
    }[wall]
    dt = 0.3 * dx / np.sqrt((1 - nu) / (1 + nu) / (1 - 2 * nu))
    steps = int((gap * dx / v0 + 1.4 * lasts) / dt)
    run = mpm.simulate(
        mpm.Scene(grid, law, boundary=floor),
        body,
        t1=steps * dt,
        dt=dt,
        observe=lambda _, now: (now.mass * now.v[:, 1]).sum() / now.mass.sum(),
    )
    return _over_hertz(np.arange(steps + 1) * dt, -np.asarray(run.observed), nu, depth)


def ball_of_elements(count: int, *, nu=0.3, depth=0.05) -> dict[str, float]:
    """`ball` by finite elements, so many along a radius."""
    mesh, (v0, lasts) = Mesh.half_disc(count), _hertz(nu, depth)
    every, dt = 20, 0.03 / count
    steps = int((0.02 / v0 + 1.4 * lasts) / dt / every) * every
    fall = np.tile([0.0, -v0], (len(mesh.X), 1))
    u = by_elements(mesh, 1.0, nu, 1.0, dt=dt, steps=steps, every=every, v=fall, floor=-1.02, revolved=True)
    m = mesh.volumes(revolved=True)
    sunk = np.append(0.0, -(u[..., 1] * m).sum(axis=1) / m.sum())
    return _over_hertz((np.arange(steps // every) + 0.5) * every * dt, np.diff(sunk) / (every * dt), nu, depth)


def _hertz(nu: float, depth: float) -> tuple[float, float]:
    """The speed of a ball that is pressed in so deep, and how long it touches."""
    v0 = float(np.sqrt(4 / 5 * 4 / 3 / (1 - nu**2) * depth**2.5 / (4 / 3 * np.pi)))
    return v0, 2.943 * depth / v0


def _over_hertz(t: np.ndarray, v: np.ndarray, nu: float, depth: float) -> dict[str, float]:
    """Peak force and time of a velocity towards the plane over those of Hertz's motion, m ẍ = −K x^1.5."""
    (v0, lasts), x = _hertz(nu, depth), 0.0
    fine, exact = lasts / 20000, [v0]
    while x >= 0:
        exact.append(exact[-1] - fine / (1 - nu**2) / np.pi * x**1.5)
        x += fine * exact[-1]
    ratios = _impact(t, v, lasts / 8) / _impact(np.arange(len(exact)) * fine, np.array(exact), lasts / 8)
    return dict(zip(("force", "time"), ratios, strict=True))


def _impact(t: np.ndarray, v: np.ndarray, width: float) -> np.ndarray:
    """The largest mean deceleration over a `width` of time, and the time between 2 and 98 % of the impulse."""
    part, starts = (v[0] - v) / (v[0] - v[-1]), np.linspace(t[0], t[-1] - width, 4000)
    first, last = (np.interp(share, part[: (k := int(np.argmax(part > share)) + 1)], t[:k]) for share in (0.02, 0.98))
    return np.array([(np.interp(starts, t, v) - np.interp(starts + width, t, v)).max() / width, last - first])


def balls(quick: bool) -> None:
    print("\nA ball on a plane, over Hertz's; pressed in by a twentieth of its radius, ν = 0.3, but where said:")
    print("the range over the plane's places between nodes, of a ball on a lattice over its own too")
    choices = {"fitted": {}, "lattice": {"fitted": False}, "ν = 0.45": {"nu": 0.45}, "a tenth": {"depth": 0.1}}
    for name, choice in choices.items():
        rows = []
        for cells, wall in itertools.product((8,) if quick else (4, 8, 16, 32), list(WALLS)[1:]):
            some = places(wall, 0.0, 0.25, 0.5) if name == "fitted" and cells < 16 else [0.0]
            gaps = (0.6, 0.7, 0.85, 0.95) if name == "lattice" and cells < 16 else (0.6,)
            found = [ball(cells, wall, at=a, gap=gap, **choice) for a in some for gap in gaps]
            ranges = (w([f[k] for f in found]) for k in ("force", "time") for w in (min, max))
            rows.append((f"{wall} {cells}", *ranges))
        _print(rows, (name, "force from", "to", "time from", "to"))
    rows = [
        (f"pressed in by {depth}", *ball_of_elements(8 if quick else 32, depth=depth).values())
        for depth in (1 / 80, 1 / 40, 1 / 20, 1 / 10)
    ]
    _print(rows, ("finite elements", "force", "time"))


TABLES = {"rest": rests, "bar": bars, "block": blocks, "ball": balls}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one grid")
    parser.add_argument("--only", choices=TABLES, help="one table")
    options = parser.parse_args()
    for name, table in TABLES.items():
        if options.only in (None, name):
            table(options.quick)
