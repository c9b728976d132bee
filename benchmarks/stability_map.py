"""Where does a step hold? Growth over Δt, β, stiffness contrast and compression, with the closed forms laid over it.

    python benchmarks/stability_map.py [--quick]

Sweeps of the real step, in float64, fixed corotated, quadratic APIC, 2-D; Δt in units of `stable_dt(safety=1)`:

- particle: one alone, at rest. |λ| of the Jacobian of a semi-implicit step over Δt and β; the edge is 1/√(1 − 2β).
- spin: a free block of three cells a side, compressed, turning slowly. What one step makes of the spin; the plain
  semi-implicit step should multiply it by 1/(1 − (Δt/Δ̂t)²), Δ̂t from the lowest eigenvalue of the assembled Hessian.
- block: the same block with random velocities, particles alternately soft and stiff, at rest size or compressed. The
  largest energy (kinetic and elastic) of a short run, over that at its start.
- slack: the explicit limit of random clouds (those of `tests/validation/test_stability.py`, in 1-, 2- and 3-D), by
  bisection on the eigenvalues of the step's Jacobian, over the bound.

Prints how the measured edges agree with the closed forms, and writes docs/stability_map.csv, docs/slack.csv and
docs/stability_map.png. `--quick` sweeps more coarsely and writes nothing.
"""

import argparse
import csv
import sys
import time
from itertools import pairwise, product
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm
from mpmjax._types import components
from mpmjax.boundary import mirror
from mpmjax.discretisation._transfer import p2g
from mpmjax.implicit import ElasticPotential

sys.path += [str(Path(__file__).parents[1] / "tests" / folder) for folder in ("", "validation")]
jax.config.update("jax_enable_x64", True)

DX, DENSITY, E, NU, SIDE = 0.1, 1e3, 1e4, 0.3, 3
DOCS = Path(__file__).parents[1] / "docs"
SOLVER = mpm.implicit.ConjugateResidual(max_steps=300)
PLAIN, PROJECTED = mpm.implicit.AnalyticHessian(), mpm.implicit.AnalyticHessian(projected=True)
METHODS = {
    "explicit": lambda beta: mpm.Explicit(),
    "semi-implicit": lambda beta: mpm.SemiImplicit(beta, SOLVER, hessian=PLAIN, adjoint_solver=SOLVER),
    "projected": lambda beta: mpm.SemiImplicit(beta, SOLVER, hessian=PROJECTED, adjoint_solver=SOLVER),
    "backward Euler": lambda beta: mpm.BackwardEuler(mpm.implicit.Newton(max_steps=15), hessian=PROJECTED),
    "implicit midpoint": lambda beta: mpm.ImplicitMidpoint(
        mpm.implicit.Linearised(SOLVER), hessian=PLAIN, adjoint_solver=SOLVER
    ),
    "TR-BDF2": lambda beta: mpm.TRBDF2(0.0, mpm.implicit.Linearised(SOLVER), hessian=PLAIN, adjoint_solver=SOLVER),
}
IMPLICIT = tuple(METHODS)[1:]
FIELDS = ("sweep", "method", "beta", "contrast", "compression", "dt_over_bound", "growth")


def scene_of(contrast=1.0) -> tuple[mpm.Scene, mpm.Particles]:
    """The block at rest; every other particle is `contrast` times as stiff."""
    grid = mpm.Grid((SIDE + 6,) * 2, DX, origin=(-3, -3))
    block = mpm.fill(mpm.Box((0.0, 0.0), (SIDE * DX,) * 2), grid, particles_per_cell=4, density=DENSITY)
    stiff = (jnp.arange(block.count) + jnp.round(block.x[:, 0] / DX * 2 - 0.5).astype(int)) % 2 == 0
    return mpm.Scene(grid, mpm.FixedCorotated(jnp.where(stiff, E * contrast, E), NU)), block


def compressed(block, compression, velocity, C) -> mpm.Particles:
    """The block shrunk about its centre."""
    centre, scale = block.x.mean(axis=0), 1 - compression
    x = centre + scale * (block.x - centre)
    F = jnp.broadcast_to(scale * jnp.eye(2), (block.count, 2, 2))
    return mpm.Particles(x, velocity(x - centre), block.mass, block.volume, (F,), C=jnp.broadcast_to(C, F.shape))


def particle_sweep(count: int) -> list[dict]:
    """|λ| of one particle's step, by `jax.jacfwd` of `step`."""
    scene = mpm.Scene(mpm.Grid((6, 6), DX), mpm.FixedCorotated(E, NU))
    x = jnp.full((1, 2), 0.2637)
    one = mpm.prepare(scene, mpm.Particles(x, 0 * x, jnp.full(1, DENSITY * 1e-3), jnp.full(1, 1e-3)))
    bound = mpm.stable_dt(scene, one, safety=1.0)
    tight = mpm.implicit.ConjugateResidual(rtol=1e-12)

    @jax.jit
    @jax.vmap
    def radius(dt, beta):
        method = mpm.SemiImplicit(beta=beta, solver=tight, adjoint_solver=tight)

        def after(y):
            F, C = jnp.eye(2) + y[0], y[1] / dt
            moved = eqx.tree_at(lambda q: (q.F, q.C), one, (F[None], C[None]))
            new = mpm.rollout(scene, moved, steps=1, dt=dt, method=method)
            return jnp.stack([new.F[0] - jnp.eye(2), dt * new.C[0]])

        return jax.jacfwd(after)(jnp.zeros((2, 2, 2))).reshape(8, 8)

    times, betas = np.meshgrid(np.geomspace(0.5, 8, count), np.linspace(0, 1, count // 2 + 1))
    maps = np.asarray(radius(jnp.asarray(times.ravel()) * bound, jnp.asarray(betas.ravel())))
    growth = np.abs(np.linalg.eigvals(maps)).max(axis=1)
    return [
        row("particle", "semi-implicit", b, 1, 0, t, g) for b, t, g in zip(betas.flat, times.flat, growth, strict=True)
    ]


def singular_step(compression: float) -> float:
    """The first Δ̂t [s] at which M + Δ̂t²H is singular, M and H assembled column by column."""
    scene, block = scene_of()
    q = compressed(block, compression, jnp.zeros_like, jnp.zeros((2, 2)))
    stencil = scene.stencil(q)
    mass = p2g(stencil, q.mass, components(q.v), None, scene.grid.size)[0]
    images = mirror((), scene.grid, scene.window(q))
    potential = ElasticPotential(scene.material_points(q), stencil, images, scene.grid.size)
    at_rest = jnp.zeros((scene.grid.size, 2))
    hessian = jax.jacfwd(lambda u: -potential.force(u))(at_rest).reshape(2 * len(mass), -1)
    keep = np.repeat(np.asarray(mass) > 1e-12 * float(mass.max()), 2)
    root = np.sqrt(np.repeat(np.asarray(mass), 2)[keep])
    return 1 / np.sqrt(-np.linalg.eigvalsh(np.asarray(hessian)[np.ix_(keep, keep)] / np.outer(root, root))[0])


def spin_sweep(count: int) -> tuple[list[dict], dict[float, float]]:
    """Spin after one step over that before it, and Δ̂t in units of the bound, by compression."""
    scene, block = scene_of()
    bound = mpm.stable_dt(scene, block, safety=1.0)
    turn = 1e-4 * jnp.asarray([[0.0, -1.0], [1.0, 0.0]])

    def spin(q):
        r = q.x - q.x.mean(axis=0)
        return (q.mass * (r[:, 0] * q.v[:, 1] - r[:, 1] * q.v[:, 0])).sum()

    rows, singular = [], {}
    times = np.geomspace(0.5, 12, count)
    for name in IMPLICIT:

        @jax.jit
        @jax.vmap
        def gain(dt, compression, name=name):
            q = compressed(block, compression, lambda r: r @ turn.T, turn)
            return spin(mpm.rollout(scene, q, steps=1, dt=dt, method=METHODS[name](1.0))) / spin(q)

        for compression in (0.02, 0.05, 0.1, 0.2):
            singular.setdefault(compression, singular_step(compression) / float(bound))
            gains = np.asarray(gain(jnp.asarray(times) * bound, jnp.full(count, compression)))
            rows += [row("spin", name, 1.0, 1, compression, t, g) for t, g in zip(times, gains, strict=True)]
    return rows, singular


def block_sweep(count: int, steps: int) -> list[dict]:
    """The largest energy of a short run over that at its start."""
    noise = jnp.asarray(np.random.default_rng(0).normal(size=(4 * SIDE**2, 2)))
    rows = []
    points = np.stack(
        [a.ravel() for a in np.meshgrid((1.0, 100.0), (0.0, 0.1), np.geomspace(0.7, 20, count), indexing="ij")]
    )
    for name, make in METHODS.items():

        @jax.jit
        @jax.vmap
        def growth(contrast, compression, times, beta, make=make):
            scene, block = scene_of(contrast)
            bound = mpm.stable_dt(scene, block, safety=1.0)
            q = mpm.prepare(scene, compressed(block, compression, lambda r: 1e-4 * noise, jnp.zeros((2, 2))))

            def energy(q):
                e = mpm.energy(scene, q)
                return e.kinetic + e.elastic

            def advance(q, _):
                q = mpm.rollout(scene, q, steps=1, dt=times * bound, method=make(beta))
                return q, energy(q)

            return jax.lax.scan(advance, q, length=steps)[1].max() / energy(q)

        for beta in (0.0, 0.25, 0.5, 1.0) if name in ("semi-implicit", "projected") else (0.0,):
            found = np.asarray(growth(*jnp.asarray(points), jnp.full(points.shape[1], beta)))
            found = np.where(np.isfinite(found), np.minimum(found, 1e12), 1e12)
            rows += [row("block", name, beta, *point, g) for point, g in zip(points.T, found, strict=True)]
    return rows


def slack_sweep(seeds: int) -> list[dict]:
    """The explicit limit of random clouds over the bound, by description, dimension and largest strain."""
    from test_stability import slack

    law = mpm.FixedCorotated(E, NU)
    descriptions = {"updated": mpm.UpdatedLagrangian(), "total": mpm.TotalLagrangian()}
    rows = []
    for (name, description), d in product(descriptions.items(), (1, 2, 3)):
        for strain, seed in product((0.0, 0.03, 0.1, 0.2, 0.3), range(seeds)):
            found = slack(d, seed, strain, material=law, description=description, gradient=mpm.MLSGradient())
            rows.append(
                {
                    "description": name,
                    "dimension": d,
                    "strain": strain,
                    "seed": seed,
                    "limit_over_bound": round(found, 3),
                }
            )
    return rows


def row(*values) -> dict:
    return dict(zip(FIELDS, (v if isinstance(v, str) else round(float(v), 9) for v in values), strict=True))


def edge(rows: list[dict], limit: float) -> float:
    """The smallest Δt at which growth passes a limit, halfway (geometrically) to the last good one before it."""
    rows = sorted(rows, key=lambda r: r["dt_over_bound"])
    for good, bad in pairwise(rows):
        if bad["growth"] > limit:
            return float(np.sqrt(good["dt_over_bound"] * bad["dt_over_bound"]))
    return np.inf


def report(rows: list[dict], singular: dict[float, float], slacks: list[dict]) -> None:
    """Measured edges against the closed forms, and the bound's slack."""
    particle = [r for r in rows if r["sweep"] == "particle"]
    times = np.unique([r["dt_over_bound"] for r in particle])
    grid = np.sqrt(times[1] / times[0]) - 1
    worst = 0.0
    for beta in np.unique([r["beta"] for r in particle]):
        found = edge([r for r in particle if r["beta"] == beta], 1 + 1e-6)
        theory = 1 / np.sqrt(1 - 2 * beta) if beta < 0.5 else np.inf
        if theory < times[-1] / (1 + grid) ** 2:
            worst = max(worst, abs(found / theory - 1))
        else:
            assert found == np.inf, (beta, found)
    print(f"particle: edges agree with 1/sqrt(1 - 2 beta) to {worst:.1%} (the grid's own resolution {grid:.1%})")
    z, beta = (np.array([r[k] for r in particle]) for k in ("dt_over_bound", "beta"))
    roots = [np.abs(np.roots([1 + b * q, q - 2 - b * q, 1])).max() for b, q in zip(beta, 4 * z**2, strict=True)]
    exact = np.maximum(roots, 1)  # the other modes neither grow nor decay
    print(f"particle: |lambda| against its closed form: {np.abs([r['growth'] for r in particle] - exact).max():.1e}")
    for name in IMPLICIT:
        for compression, dt in singular.items():
            here = [r for r in rows if (r["sweep"], r["method"], r["compression"]) == ("spin", name, compression)]
            gains = np.array([r["growth"] for r in here])
            line = f"spin, {name:>17}, {compression:4.0%} compressed: gain {gains.min():8.3g} to {gains.max():8.3g}"
            if name == "semi-implicit":
                t = np.array([r["dt_over_bound"] for r in here])
                ratio = (gains - 1) / (1 / (1 - (t / dt) ** 2) - 1)
                turned = t[gains < 0].min() if (gains < 0).any() else np.inf
                line += f"; singular at {dt:.3f}, sign turns by {turned:.3f}; (gain - 1)/theory "
                line += f"{ratio.min():.2f} to {ratio.max():.2f}"
            print(line)
    steps = np.unique([r["dt_over_bound"] for r in rows if r["sweep"] == "block"])
    fine = np.sqrt(steps[1] / steps[0]) - 1
    for contrast in (1.0, 100.0):
        at = [r for r in rows if (r["sweep"], r["contrast"], r["compression"]) == ("block", contrast, 0.0)]
        base = edge([r for r in at if r["method"] == "explicit"], 10)
        low = edge([r for r in at if (r["method"], r["beta"]) == ("semi-implicit", 0.25)], 10)
        print(
            f"block, contrast {contrast:g}: explicit holds to {base:.2f} of stable_dt's bound; beta = 1/4 to "
            f"{low:.2f}, {low / base:.2f} times that (theory {np.sqrt(2):.2f}; each to the grid's {fine:.0%})"
        )
    for name in METHODS:
        own = [r for r in rows if r["sweep"] == "block" and r["method"] == name]
        beta = max(r["beta"] for r in own)
        worst = {c: max(r["growth"] for r in own if (r["beta"], r["compression"]) == (beta, c)) for c in (0.0, 0.1)}
        print(f"block, {name}, beta = {beta:g}: largest energy {worst[0.0]:.3g}, compressed {worst[0.1]:.3g}")
    for name, strain in sorted({(r["description"], r["strain"]) for r in slacks}):
        found = [r["limit_over_bound"] for r in slacks if (r["description"], r["strain"]) == (name, strain)]
        print(f"slack, {name:>7}, strains to {strain:g}: {min(found):.2f} to {max(found):.2f}")


def draw(rows: list[dict], singular: dict[float, float], slacks: list[dict], path: Path) -> None:
    figure = plt.figure(figsize=(16, 10), constrained_layout=True)
    above, below = figure.subfigures(2, 1)
    a, b, e = above.subplots(1, 3)
    c, d = below.subplots(1, 2, sharey=True)
    particle = [r for r in rows if r["sweep"] == "particle"]
    times, betas = (np.unique([r[k] for r in particle]) for k in ("dt_over_bound", "beta"))
    growth = np.array([r["growth"] for r in particle]).reshape(len(betas), len(times))
    colours = a.pcolormesh(times, betas, np.log10(growth), vmin=-1, vmax=1, cmap="RdBu_r", shading="nearest")
    above.colorbar(colours, ax=a, label="log10 |λ|")
    conditional = np.linspace(0, 0.492, 200)
    a.plot(1 / np.sqrt(1 - 2 * conditional), conditional, "k", label="1/√(1 − 2β)")
    a.axhline(0.5, color="k", ls=":")
    a.set(xscale="log", xlim=(times[0], times[-1]), ylabel="β", title="one particle, semi-implicit: |λ|")
    a.legend(loc="lower right")
    styles = dict(zip(IMPLICIT, "os^vD", strict=True))
    here = [r for r in rows if r["sweep"] == "spin" and r["compression"] == 0.1]
    for name, mark in styles.items():
        own = [r for r in here if r["method"] == name]
        b.plot([r["dt_over_bound"] for r in own], [abs(r["growth"]) for r in own], mark, ms=4, label=name)
    t = np.geomspace(0.5, 12, 2000)
    b.plot(t, np.abs(1 / (1 - (t / singular[0.1]) ** 2)), "k", lw=0.8, label="1/|1 − (Δt/Δ̂t)²|")
    b.axvline(singular[0.1], color="k", ls=":")
    b.set(xscale="log", yscale="log", ylim=(1e-2, 1e3), title="10 % compressed: spin after one step over before")
    b.legend()
    for axis, compression in ((c, 0.0), (d, 0.1)):
        lines = [(m, beta, k) for k in (1.0, 100.0) for m in METHODS for beta in (0.0, 0.25, 0.5, 1.0)]
        table, labels = [], []
        for name, beta, contrast in lines:
            own = [r for r in rows if r["sweep"] == "block" and (r["method"], r["beta"]) == (name, beta)]
            own = [r for r in own if (r["contrast"], r["compression"]) == (contrast, compression)]
            if own:
                table.append([np.log10(r["growth"]) for r in own])
                shown = f" β = {beta:g}" if name in ("semi-implicit", "projected") else ""
                labels.append(f"{name}{shown}, contrast {contrast:g}")
                times = [r["dt_over_bound"] for r in own]
        colours = axis.pcolormesh(
            times, np.arange(len(labels)), table, vmin=-3, vmax=3, cmap="RdBu_r", shading="nearest"
        )
        axis.set_yticks(np.arange(len(labels)), labels, fontsize=7)
        for k, label in enumerate(labels):
            beta = float(label.split("β = ")[1].split(",")[0]) if "β" in label else 0.0
            if beta < 0.5 and ("β" in label or "explicit" in label):
                axis.plot([1 / np.sqrt(1 - 2 * beta)] * 2, [k - 0.5, k + 0.5], "k", lw=1.5)
        axis.set(xscale="log", title=f"block, {compression:.0%} compressed: largest energy over the first")
        below.colorbar(colours, ax=axis, label="log10 growth")
    for axis in (a, b, c, d):
        axis.xaxis.set_minor_formatter("")
        axis.set_xlabel("Δt / stable_dt(safety=1)")
    names = sorted({(r["dimension"], r["description"]) for r in slacks})
    for k, (dimension, name) in enumerate(names):
        own = [r for r in slacks if (r["dimension"], r["description"]) == (dimension, name)]
        mark, colour = {"updated": "o", "total": "x"}[name], f"C{dimension - 1}"
        x = [r["strain"] + 0.003 * (k - len(names) / 2) for r in own]
        e.plot(x, [r["limit_over_bound"] for r in own], mark, color=colour, ms=4, label=f"{name}, {dimension}-D")
    e.axhline(1, color="k", lw=0.8)
    e.axhline(0.7, color="k", ls=":", label="default safety")
    e.set(title="random clouds: explicit limit over the bound", xlabel="largest strain", ylabel="slack")
    e.set_ylim(top=2.6)
    e.legend(fontsize=8, ncols=2, loc="upper right")
    figure.savefig(path, dpi=110)


def write(rows: list[dict], path: Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a coarser sweep, write nothing")
    quick = parser.parse_args().quick
    begun = time.perf_counter()
    rows = particle_sweep(40 if quick else 120)
    spins, singular = spin_sweep(16 if quick else 60)
    rows += spins + block_sweep(*(8, 30) if quick else (24, 60))
    slacks = slack_sweep(3 if quick else 8)
    report(rows, singular, slacks)
    if not quick:
        write(rows, DOCS / "stability_map.csv")
        write(slacks, DOCS / "slack.csv")
        draw(rows, singular, slacks, DOCS / "stability_map.png")
    print(f"{time.perf_counter() - begun:.0f} s in all")


if __name__ == "__main__":
    main()
