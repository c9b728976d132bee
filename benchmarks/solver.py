"""What should the implicit solve be asked for, and helped with?

    python benchmarks/solver.py [--quick]

An elastic square of N² cells, 4 particles a cell, one side held, thrown upwards, semi-implicit steps of multiples of
the explicit limit, float64:

- *tolerance*: error of the motion and of its gradient, and seconds, against the solver's relative tolerance and where
  it starts, beside the error that the step itself makes;
- *preconditioning*: iterations and seconds of conjugate gradients preconditioned by the mass or the diagonal (the
  package's two inner products), by each node's block, a Chebyshev polynomial and a multilevel V-cycle;
- *break-even*: the multiple of the explicit limit from which on an implicit second of motion is the cheaper one,
  against resolution, tolerance and stiffness contrast.

Writes docs/solver.png and docs/solver_*.csv; `--quick` takes small squares and writes nothing.
"""

import argparse
import csv
import sys
from collections.abc import Callable
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import mpmjax as mpm
from mpmjax.implicit import ImplicitOperator
from mpmjax.stepping import Nodes, start_nodes

sys.path.append(str(Path(__file__).parent))
from gradient import best_of

jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[1] / "docs"
E_MODULUS, NU, DENSITY, SIDE = 1e5, 0.3, 1e3, 1.0
SPEED = float(np.sqrt(E_MODULUS * (1 - NU) / ((1 + NU) * (1 - 2 * NU)) / DENSITY))
MARGIN = 16  # cells around the square
PRECONDITIONERS = {"diagonal": mpm.implicit.DiagonalPreconditioner(), "mass": mpm.implicit.MassPreconditioner()}
GUESSES = mpm.implicit.Guess.GRID_VELOCITY, mpm.implicit.Guess.EXPLICIT, mpm.implicit.Guess.ZERO
Row = dict[str, Any]


class Square(NamedTuple):
    """The scene, its particles, and its explicit limit [s]."""

    scene: mpm.Scene
    particles: mpm.Particles
    limit: float


def square(n: int, *, contrast: float = 1.0, factor: Any = 1.0, coarser: int = 0) -> Square:
    """N² cells, the upper half stiffer by the contrast, on a grid coarsened so many times: of a spacing 2^m of the
    cells', its nodes half of the former spacing further up at each time, where the quadratic splines are nested."""
    dx, low = SIDE / n, MARGIN * SIDE / n
    box = mpm.Box((low, low), (low + SIDE, low + SIDE))
    particles = mpm.fill(box, mpm.Grid((n + 2 * MARGIN,) * 2, dx), particles_per_cell=4, density=DENSITY)
    along, height = particles.x.T - low
    v = jnp.stack([0 * along, jnp.sin(np.pi / 2 * along / SIDE)], axis=1)
    shift = (2**coarser - 1) / 2 * dx
    particles = mpm.Particles(particles.x - shift, v, particles.mass, particles.volume)
    stiffness = jnp.where(height > SIDE / 2, contrast, 1.0) * E_MODULUS * factor
    grid = mpm.Grid(((n + 2 * MARGIN) // 2**coarser,) * 2, 2**coarser * dx)
    held = mpm.StickyBox((low - shift, -10.0), (10.0, 10.0))
    scene = mpm.Scene(grid, mpm.NeoHookean(stiffness, NU), boundary=held)
    return Square(scene, mpm.prepare(scene, particles), dx / SPEED / float(np.sqrt(contrast)))


def tolerances(n: int, multiple: float, steps: int, rtols: tuple[float, ...]) -> list[Row]:
    """Errors and seconds, and in the first row the errors of the step: its difference from a quarter of it."""
    _, particles, limit = square(n)

    def final(factor: Any, rtol: Any, guess: mpm.implicit.Guess, refined: int) -> Any:
        solver = mpm.implicit.ConjugateResidual(rtol=rtol, max_steps=5000)
        method = mpm.SemiImplicit(solver=solver, adjoint_solver=solver, guess=guess)
        dt = multiple * limit
        scene = square(n, factor=factor).scene
        return mpm.simulate(scene, particles, t1=steps * dt, dt=dt / refined, method=method, throw=False).final.x

    def functions(guess: mpm.implicit.Guess, refined: int = 1) -> tuple[Callable[..., Any], Callable[..., Any]]:
        motion = partial(final, guess=guess, refined=refined)
        slope = jax.grad(lambda factor, rtol: motion(factor, rtol)[:, 1].mean())
        return jax.jit(partial(motion, 1.0)), jax.jit(partial(slope, 1.0))

    exact, exact_slope = (f(1e-13) for f in functions(GUESSES[0]))
    size = float(jnp.abs(exact - particles.x).max())

    def row(guess: str, rtol: float, motion: Any, slope: Any, seconds: float) -> Row:
        error = float(jnp.abs(motion - exact).max()) / size
        slope_error = abs(float(slope / exact_slope) - 1)
        return {"guess": guess, "rtol": rtol, "motion": error, "gradient": slope_error, "seconds": seconds}

    motion, slope = functions(GUESSES[0], 4)
    rows = [row("the step", 0.0, motion(1e-10), slope(1e-10), float("nan"))]
    for guess in GUESSES:
        motion, slope = functions(guess)
        for rtol in rtols:
            rows.append(row(guess.value, rtol, motion(rtol), slope(rtol), best_of(motion, rtol)))
    return rows


class Level(NamedTuple):
    """The operator on one grid, its diagonal mass, the largest eigenvalue of M⁻¹A, and the grid's shape."""

    operator: ImplicitOperator
    weight: Any
    radius: Any
    shape: tuple[int, ...]


def level(n: int, dt: float, coarser: int, contrast: float) -> tuple[Level, Nodes]:
    """Of one semi-implicit step with β = 1."""
    scene, particles, _ = square(n, coarser=coarser, contrast=contrast)
    nodes = start_nodes(scene, particles, 0.0, jnp.asarray(dt), scene.stencil(particles))
    action = mpm.implicit.AnalyticHessian().at(nodes.potential, None)
    operator = ImplicitOperator(nodes.mass, jnp.asarray(dt) ** 2, action, nodes.projection)
    weight = mpm.implicit.MassPreconditioner().inner_product(operator).weight

    def power(_: int, v: Any) -> Any:
        v = operator.mv(v) / weight
        return v / jnp.linalg.norm(v)

    v = jax.lax.fori_loop(0, 30, power, jax.random.normal(jax.random.key(0), weight.shape))
    return Level(operator, weight, 1.1 * (v * operator.mv(v)).sum() / (v * weight * v).sum(), scene.grid.shape), nodes


def chebyshev(level: Level, b: Any, degree: int, least: float) -> Any:
    """A polynomial of M⁻¹A applied to M⁻¹b that is near A⁻¹ from `least` times the largest eigenvalue on."""
    middle, half = level.radius * (1 + least) / 2, level.radius * (1 - least) / 2
    x, p, alpha = jnp.zeros_like(b), jnp.zeros_like(b), 1 / middle
    for k in range(degree):
        r = (b - level.operator.mv(x)) / level.weight
        beta = 0.0 if k == 0 else (half * alpha / 2) ** 2 * (2 if k == 1 else 1)
        alpha = 1 / middle if k == 0 else 1 / (middle - beta / alpha)
        p = r + beta * p
        x = x + alpha * p
    return x


def blocks(level: Level) -> Any:
    """The operator's 2 x 2 block of each node, from one application for each node of a 5 x 5 patch and direction."""
    i, j = np.unravel_index(np.arange(level.weight.shape[0]), level.shape)
    columns = []
    for a in range(2):
        total = jnp.zeros_like(level.weight)
        for colour in range(25):
            here = ((i % 5) * 5 + j % 5 == colour)[:, None]
            total = total + here * level.operator.mv(jnp.asarray(here * np.eye(2)[a]))
        columns.append(total)
    return jnp.stack(columns, axis=2)


def prolongation(fine: int, coarse: int) -> Any:
    """Along one axis: the refinement of the quadratic spline, weights ¼ ¾ ¾ ¼ at fine nodes 2I − 1 to 2I + 2."""
    P = np.zeros((fine, coarse))
    for column in range(coarse):
        for k, weight in enumerate((0.25, 0.75, 0.75, 0.25)):
            if 0 <= 2 * column - 1 + k < fine:
                P[2 * column - 1 + k, column] = weight
    return jnp.asarray(P)


def v_cycle(levels: list[Level], b: Any) -> Any:
    """One V-cycle, smoothed by Chebyshev polynomials of degree 3."""
    here, *coarser = levels
    if not coarser:
        return chebyshev(here, b, 12, 1 / 100)
    smooth = partial(chebyshev, here, degree=3, least=1 / 10)
    P = prolongation(here.shape[0], coarser[0].shape[0])
    x = smooth(b)
    r = jnp.where(here.operator.projection.free, b - here.operator.mv(x), 0).reshape(*here.shape, 2)
    restricted = jnp.einsum("iI,jJ,ijc->IJc", P, P, r).reshape(-1, 2)
    e = v_cycle(coarser, jnp.where(coarser[0].operator.projection.free, restricted, 0)).reshape(*coarser[0].shape, 2)
    x = x + jnp.where(here.operator.projection.free, jnp.einsum("iI,jJ,IJc->ijc", P, P, e).reshape(-1, 2), 0)
    return x + smooth(b - here.operator.mv(x))


def conjugate_gradients(level: Level, precondition: Callable[[Any], Any], b: Any, rtol: float) -> tuple[Any, Any]:
    """Solution and iterations, to a relative residual in the norm of the inverse mass."""

    def norm(r: Any) -> Any:
        return jnp.sqrt((r**2 / level.weight).sum())

    def step(state: tuple) -> tuple:
        x, r, p, rz, k = state
        q = level.operator.mv(p)
        alpha = rz / (p * q).sum()
        x, r = x + alpha * p, r - alpha * q
        z = precondition(r)
        new = (r * z).sum()
        return x, r, z + new / rz * p, new, k + 1

    z = precondition(b)
    start = jnp.zeros_like(b), b, z, (b * z).sum(), 0
    x, _, _, _, k = jax.lax.while_loop(lambda s: (norm(s[1]) > rtol * norm(b)) & (s[4] < 3000), step, start)
    return x, k


def preconditioners(n: int, multiple: float, *, contrast: float = 1.0, rtol: float = 1e-6) -> list[Row]:
    """Iterations and seconds of each, set-up of diagonals and coarse levels left out, for the step's own right-hand
    side and for a random one."""
    dt = multiple * square(n, contrast=contrast).limit
    depth = max(1, int(np.log2(n / 8)))
    made = [level(n, dt, m, contrast) for m in range(depth + 1)]
    levels, nodes = [here for here, _ in made], made[0][1]
    fine = levels[0]
    diagonal = mpm.implicit.DiagonalPreconditioner().inner_product(fine.operator).weight
    inverse = jnp.linalg.inv(blocks(fine))
    noise = jax.random.normal(jax.random.key(1), fine.weight.shape)
    sides = {
        "step": jnp.where(fine.operator.projection.free, nodes.mass[:, None] * nodes.explicit_velocity(), 0),
        "random": jnp.where(fine.operator.projection.free, fine.weight * noise, 0),
    }
    kinds = {
        "mass": lambda r: r / fine.weight,
        "diagonal": lambda r: r / diagonal,
        "block": lambda r: (inverse * r[:, None]).sum(axis=2),
        "Chebyshev 4": lambda r: chebyshev(fine, r, 4, 1 / 40),
        "V-cycle": lambda r: v_cycle(levels, r),
    }
    rows = []
    for kind, precondition in kinds.items():
        solve = jax.jit(lambda b, precondition=precondition: conjugate_gradients(fine, precondition, b, rtol))
        for side, b in sides.items():
            counted = {"n": n, "multiple": multiple, "contrast": contrast, "preconditioner": kind, "side": side}
            rows.append(counted | {"iterations": int(solve(b)[1]), "seconds": best_of(solve, b)})
    return rows


@cache
def explicit_seconds(n: int, contrast: float) -> float:
    """Of an explicit step."""
    scene, particles, limit = square(n, contrast=contrast)
    return best_of(lambda: mpm.rollout(scene, particles, steps=40, dt=limit / 4).x) / 40


def break_even(n: int, contrast: float, rtol: float, preconditioner: str, multiples: tuple[float, ...]) -> Row:
    """The multiple of the limit at which a semi-implicit step costs as many explicit ones, by interpolation."""
    scene, particles, limit = square(n, contrast=contrast)
    method = mpm.SemiImplicit(
        solver=mpm.implicit.ConjugateResidual(rtol=rtol, max_steps=5000), preconditioner=PRECONDITIONERS[preconditioner]
    )
    costs = []
    for multiple in multiples:
        run = partial(mpm.rollout, scene, particles, steps=4, dt=multiple * limit, method=method)
        costs.append(best_of(lambda run=run: run().x) / 4 / explicit_seconds(n, contrast))
    gain = np.log(np.asarray(multiples) / costs)  # grows with the multiple, though not always steadily
    above = np.flatnonzero(gain > 0)
    found = float("inf")
    if above.size and above[0] > 0:
        i = above[0]
        found = float(np.exp(np.interp(0, gain[i - 1 : i + 1], np.log(multiples[i - 1 : i + 1]))))
    elif above.size:
        found = multiples[0]
    return {"n": n, "contrast": contrast, "rtol": rtol, "preconditioner": preconditioner, "break_even": found} | {
        f"cost_{m:g}": c for m, c in zip(multiples, costs, strict=True)
    }


def write(name: str, rows: list[Row]) -> None:
    """docs/solver_NAME.csv."""
    with (DOCS / f"solver_{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def draw(swept: list[Row], helped: list[Row], even: list[Row]) -> None:
    """docs/solver.png."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 5.2), layout="constrained")
    step, *swept = swept
    for i, guess in enumerate(GUESSES):
        line = [row for row in swept if row["guess"] == guess.value]
        for key, style in (("motion", "-"), ("gradient", "--")):
            x, y = ([row[k] for row in line] for k in ("rtol", key))
            axes[0].loglog(x, y, style, color=f"C{i}", marker="o", ms=4, lw=1, label=f"{key}, from {guess.value}")
    for key, style in (("motion", "-"), ("gradient", "--")):
        axes[0].axhline(step[key], color="0.6", ls=style, lw=1)
    axes[0].set(xlabel="solver's relative tolerance", ylabel="relative error", title="error (grey: the step's own)")
    finest = max(row["n"] for row in helped)
    for i, kind in enumerate(dict.fromkeys(row["preconditioner"] for row in helped)):
        for contrast, style in ((1.0, "-"), (100.0, "--")):
            chosen = {"preconditioner": kind, "n": finest, "side": "step"}
            line = [row for row in helped if all(row[k] == v for k, v in (chosen | {"contrast": contrast}).items())]
            x, y = ([row[k] for row in line] for k in ("multiple", "seconds"))
            axes[1].loglog(x, y, style, color=f"C{i}", marker="o", ms=4, lw=1, label=f"{kind}, contrast {contrast:g}")
    axes[1].set(xlabel="Δt over the explicit limit", ylabel="seconds a solve", title=f"preconditioning, {finest}²")
    cases = [(row["contrast"], row["preconditioner"], row["rtol"]) for row in even]
    for contrast, preconditioner, rtol in dict.fromkeys(cases):
        line = [row for row, case in zip(even, cases, strict=True) if case == (contrast, preconditioner, rtol)]
        x, y = ([row[k] for row in line] for k in ("n", "break_even"))
        style, marker = "-" if contrast == 1 else "--", "o" if rtol == 1e-3 else "s"
        label = f"{preconditioner}, contrast {contrast:g}, rtol {rtol:g}"
        axes[2].loglog(x, y, style, color=f"C{preconditioner != 'mass':d}", marker=marker, ms=4, lw=1, label=label)
    sizes = sorted({row["n"] for row in even})
    axes[2].set(xlabel="cells a side", ylabel="Δt over the explicit limit", title="break-even")
    axes[2].set_xticks(sizes, [f"{n}" for n in sizes], minor=False)
    axes[2].set_xticks([], minor=True)
    for ax in axes:
        ax.legend(frameon=False, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
    figure.savefig(DOCS / "solver.png", dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small squares, no chart")
    quick = parser.parse_args().quick
    sizes = (8,) if quick else (16, 32, 64)
    rtols = (1e-1, 1e-3) if quick else (1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-8)
    swept = tolerances(sizes[0] if quick else 32, 5.0, 4 if quick else 40, rtols)
    for row in swept:
        shown = "{guess:>14}, rtol {rtol:7.1e}: motion {motion:.1e}, gradient {gradient:.1e}, {seconds:.3f} s"
        print(shown.format(**row), flush=True)
    helped = []
    for n in sizes[-2:]:
        cases = ((5.0, 1.0), (20.0, 1.0), (100.0, 1.0), (20.0, 100.0), (100.0, 100.0), (100.0, 1e4))
        for multiple, contrast in ((20.0, 1.0),) if quick else cases:
            for row in preconditioners(n, multiple, contrast=contrast):
                helped.append(row)
                print(
                    "{n:3d}², {multiple:g} times the limit, contrast {contrast:g}, {side:>6}, {preconditioner:>11}: "
                    "{iterations:4d} iterations, {seconds:.4f} s".format(**row),
                    flush=True,
                )
    even = []
    for n in sizes:
        for contrast, preconditioner in product((1.0, 100.0), PRECONDITIONERS):
            for rtol in (1e-2,) if quick else (1e-3, 1e-5):
                multiples = (5.0, 50.0) if quick else (5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0)
                row = break_even(n, contrast, rtol, preconditioner, multiples)
                even.append(row)
                shown = (
                    "{n:3d}², contrast {contrast:g}, {preconditioner}, rtol {rtol:g}: {break_even:.0f} times the limit"
                )
                print(shown.format(**row), flush=True)
    if not quick:
        write("tolerance", swept)
        write("preconditioning", helped)
        write("break_even", even)
        draw(swept, helped, even)


if __name__ == "__main__":
    main()
