"""Ways to decide where a body meets a wall, on a bar that bounces: the comparison of docs/notes/alternatives.md.

    python benchmarks/contact_methods.py                        prints the table (a minute), of 16 cells
    python benchmarks/contact_methods.py --chart docs/contact_bounce.png    draws the bar's velocity against time too

A bar of length, density and modulus one (c = 1, ν = 0) hits a rigid wall at v. By the exact solution it leaves after 2
as fast as it came. Each way is written out here in one dimension, with explicit APIC on quadratic splines, apart from
the package, whose way is the last. Of each: how many spacings before its face is at the wall the bar is stopped
(*onset*, when it has 2 % of the impulse), the time of contact less 2 over 2, the velocity of return less that before,
and how far the mean face of the lowest particle comes behind the wall or stays before it, in spacings: the mean square
over four places of the wall between nodes and two of the bar.
"""

import argparse
import itertools

import numpy as np

PLACES, PHASES = (0.0, 0.3, 0.5, 0.8), (0.0, 0.37)
WAYS = {
    "velocity of nodes": "a node at or beyond the wall is held where it would enter (Bardenhagen, Brackbill, Sulsky)",
    "nodes, if a face is near": "the same, only if the nearest face around it comes to the wall (Huang et al.; Nairn)",
    "... moved to the wall": "the same, and the node moves with the gap over Δt",
    "penalty at centres": "springs on particles' centres, half a particle long, as stiff as that half",
    "barrier at faces": "a logarithmic barrier a tenth of a spacing thick (after Li, Fang, Li, Jiang)",
    "springs at faces": "the package's way: springs on the faces, as stiff as half a spacing",
}


def bounce(way: str, cells: int, v0: float, place: float, phase: float, *, courant=0.2, per_cell=2) -> dict:
    """Time, the wall's force over ρcv, and the figures of one bounce."""
    dx = 1.0 / cells
    l0, wall, dt = dx / per_cell, (8 + place) * dx, courant * dx
    gap = (1.8 + phase) * dx
    x = wall + gap + (np.arange(cells * per_cell) + 0.5) * l0
    v, C, F, mass = np.full(x.shape, -v0), np.zeros(x.shape), np.ones(x.shape), np.full(x.shape, l0)
    size = cells + 40
    nodes = np.arange(size) * dx
    beyond = nodes <= wall + 1e-3 * dx
    steps = int((gap / v0 + 4.2) / dt)
    impulse, velocity = np.zeros(steps), np.zeros(steps)
    nearest = np.inf
    for step in range(steps):
        base = np.floor(x / dx - 0.5).astype(int)
        f = x / dx - base
        w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        index, arm = base + np.arange(3)[:, None], (np.arange(3)[:, None] - f) * dx
        g = 4 / dx**2 * w * arm

        def scatter(values, index=index):
            return np.bincount(index.ravel(), np.broadcast_to(values, index.shape).ravel(), size)

        m, momentum = scatter(w * mass), scatter(w * mass * (v + C * arm))
        force = -scatter(l0 * (F - 1) * F * g)
        face = x - l0 / 2 * F - wall
        push = np.zeros(size)
        if way == "springs at faces":
            push = scatter(np.where(face < 0, -2 / dx * face, 0) * (w - l0 / 2 * F * g))
        elif way == "penalty at centres":
            centre = x - l0 / 2 - wall
            push = scatter(np.where(centre < 0, -2 / l0 * centre, 0) * w)
        elif way == "barrier at faces":
            thick = 0.1 * dx
            s = np.clip(face, 1e-6 * dx, thick)
            push = scatter((2 * (s - thick) * np.log(s / thick) + (s - thick) ** 2 / s) / thick * (w - l0 / 2 * F * g))
        held = m > 1e-14
        start = np.where(held, momentum / np.where(held, m, 1), 0)
        end = np.where(held, start + dt * (force + push) / np.where(held, m, 1), 0)
        free = end.copy()
        if way == "velocity of nodes":
            end[beyond & (free < 0)] = 0
        elif way.startswith(("nodes", "...")):
            around = np.full(size, np.inf)
            for k in range(3):
                np.minimum.at(around, index[k], np.where(w[k] > 0, face, np.inf))
            stopped = beyond & held & (free < 0) & (around + dt * free < 0)
            end[stopped] = np.where(around > 0, -around / dt, 0)[stopped] if way.startswith("...") else 0
        impulse[step] = dt * push.sum() + (m * (end - free)).sum()
        carried = (w * end[index]).sum(axis=0)
        x, v, C = x + dt * carried, carried, (g * end[index]).sum(axis=0)
        F = F * (1 + dt * C)
        velocity[step] = v.mean()
        nearest = min(nearest, (x - l0 / 2 * F - wall)[0] / dx)
    t = dt * np.arange(1, steps + 1)
    total = np.cumsum(impulse)
    first, last = (t[np.searchsorted(total, share * total[-1])] for share in (0.02, 0.98))
    return {
        "t": t - gap / v0,
        "velocity": velocity / v0,
        "onset": (gap / v0 + 0.04 - first) * v0 / dx,
        "time": (last - first) / 0.96 / 2 - 1,
        "return": velocity[-1] / v0 - 1,
        "nearest": nearest,
    }


def chart(path: str, cells: int) -> None:
    """The mean velocity of the bar against time, of three ways and the exact one."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 3.6), layout="constrained")
    for way, colour in (("velocity of nodes", "C1"), ("nodes, if a face is near", "C2"), ("springs at faces", "C0")):
        found = bounce(way, cells, 0.01, 0.3, 0.0)
        axes.plot(found["t"], found["velocity"], colour, label=way)
    exact = np.array([-2.0, 0.0, 2.0, 4.0])
    axes.plot(exact, [-1, -1, 1, 1], "k:", label="exact")
    axes.set(xlim=(-2, 4), xlabel="time since the face is at the wall [L/c]", ylabel="mean velocity [that before]")
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=16)
    parser.add_argument("--speed", type=float, default=0.01)
    parser.add_argument("--chart", metavar="PNG")
    given = parser.parse_args()
    print(f"{'way':>26} |    onset |     time |   return |  nearest     ({given.cells} cells, v = {given.speed} c)")
    for way in WAYS:
        runs = [bounce(way, given.cells, given.speed, *case) for case in itertools.product(PLACES, PHASES)]
        errors = (np.sqrt(np.mean([r[k] ** 2 for r in runs])) for k in ("onset", "time", "return", "nearest"))
        print(f"{way:>26} | " + " | ".join(f"{e:8.4f}" for e in errors), flush=True)
    if given.chart:
        chart(given.chart, given.cells)


if __name__ == "__main__":
    main()
