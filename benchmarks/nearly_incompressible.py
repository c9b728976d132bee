"""Nearly incompressible bodies with and without averaged volumes: Cook's membrane and a thick tube under pressure.

python benchmarks/nearly_incompressible.py              # measures, and draws docs/nearly_incompressible.png
python benchmarks/nearly_incompressible.py --quick      # 8 and 16 cells, no picture
python benchmarks/nearly_incompressible.py --swing      # a block that swings, over time
python benchmarks/nearly_incompressible.py --solves     # iterations and seconds of its preconditioners
python benchmarks/nearly_incompressible.py --solid      # the same of blocks in three dimensions
python benchmarks/nearly_incompressible.py --reference  # Cook's membrane by Taylor-Hood elements (needs scikit-fem)

Both are plane strain at small strains, in the total description with particles fitted to the body, three along a cell's
edge. One linear solve with a step so long that inertia does not count gives the state of rest.
"""

import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import KDTree

import mpmjax as mpm

TIGHT = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-9, max_steps=100_000))
CENTRE = {0.3: 21.9460, 0.49: 18.7378, 0.499: 18.5336, 0.4999: 18.5129}
"""Deflection of the middle of Cook's loaded edge for E = 1 and a total force of 1, by `--reference`: Richardson's
extrapolation of 32 and 64 elements a side."""
INNER, OUTER = 0.5, 1.0
Volume = mpm.AveragedVolume | None
PRECONDITIONERS = {"diagonal": mpm.implicit.DiagonalPreconditioner(), "volume": mpm.extensions.VolumePreconditioner()}
VOLUMES = {"own volumes": None, "averaged": mpm.AveragedVolume()}


def cook(cells: int, nu: float, volume: Volume, load: float = 1e-4) -> tuple[mpm.Scene, mpm.Particles]:
    """The membrane with corners (0, 0), (48, 44), (48, 60), (0, 44), with so many cells along its length."""
    dx = 48 / cells
    grid = mpm.Grid((cells + 8, int(62 / dx) + 9), dx, origin=(-4, -4))
    particles = mpm.fill_mapped(
        lambda s: jnp.stack([48 * s[0], 44 * s[0] + s[1] * (44 - 28 * s[0])]),
        mpm.Box((0.0, 0.0), (1.0, 1.0)),
        (3 * cells, 11 * cells // 4),
        density=1.0,
    )
    count = 4 * cells
    edge = [(48.0, 44 + 16 * (i + 0.5) / count) for i in range(count)]
    scene = mpm.Scene(
        grid,
        mpm.NeoHookean(1.0, nu),
        boundary=mpm.Grip(mpm.Box((-100.0, -100.0), (0.0, 100.0)), mpm.Motion((0.0,), ((0.0, 0.0),))),
        description=mpm.TotalLagrangian(),
        loads=mpm.PointLoad(mpm.PointsAt(edge), (0.0, load)),
        volume=volume,
    )
    return mpm.attach(scene, particles), particles


def tube(cells: int, nu: float, volume: Volume, load: float = 1e-4) -> tuple[mpm.Scene, mpm.Particles]:
    """A quarter of a tube with so many cells to its outer radius, under a dead pressure in its bore."""
    grid = mpm.Grid((cells + 8,) * 2, OUTER / cells, origin=(-4, -4))
    particles = mpm.fill_mapped(
        lambda s: s[0] * jnp.stack([jnp.cos(s[1]), jnp.sin(s[1])]),
        mpm.Box((INNER, 0.0), (OUTER, np.pi / 2)),
        (3 * cells // 2, 7 * cells // 2),
        density=1.0,
    )
    bore = mpm.Patch(mpm.geometry.Annulus((0.0, 0.0), INNER, OUTER), mpm.Box((0.0, 0.0), (0.75 * OUTER / 2**0.5,) * 2))
    scene = mpm.Scene(
        grid,
        mpm.NeoHookean(1.0, nu),
        boundary=(mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(1, 0.0)),
        description=mpm.TotalLagrangian(),
        loads=mpm.Pressure(bore, load, following=False),
        volume=volume,
    )
    return mpm.attach(scene, particles), particles


def deflection(particles: mpm.Particles, after: mpm.Particles, load: float = 1e-4) -> float:
    """Of the middle of Cook's loaded edge, for a force of 1: a linear fit through the particles nearest to it."""
    X, u = (np.asarray(a) for a in (particles.x, after.x - particles.x))
    near = np.argsort(((X - [48, 52]) ** 2).sum(axis=1))[:12]
    fit = np.linalg.lstsq(np.c_[np.ones(len(near)), X[near] - [48, 52]], u[near, 1], rcond=None)[0]
    return float(fit[0] / load)


def lame(r: np.ndarray, nu: float, load: float = 1e-4) -> np.ndarray:
    """u_r(r) of the tube for E = 1 (G. Lamé), in plane strain."""
    scale = load * INNER**2 / (OUTER**2 - INNER**2)
    return (1 + nu) * scale * ((1 - 2 * nu) * r + OUTER**2 / r)


def pressures(scene: mpm.Scene, after: mpm.Particles) -> np.ndarray:
    """−tr(P Fᵀ)/3 of the particles in plane strain, with the stress out of the plane of Hooke's law, which at small
    strains is ν times the sum of the others: without the average, which moves it between particles."""
    (points,) = scene.material_points(mpm.prepare(scene, after))
    F = points.strained(points.deformation)
    P = points.law.stress(F)
    (law,) = scene.laws
    return -np.asarray(P[0, 0] + P[1, 1]) * (1 + float(law.poisson_ratio)) / 3


def roughness(particles: mpm.Particles, field: np.ndarray, spacing: float) -> float:
    """The root mean square of what a field has beside its linear fits over neighbourhoods of one cell."""
    X, tree = np.asarray(particles.x), KDTree(np.asarray(particles.x))
    left = []
    for i in range(0, len(X), 3):
        near = tree.query_ball_point(X[i], spacing)
        fit = np.c_[np.ones(len(near)), X[near] - X[i]]
        left.append(field[i] - np.linalg.lstsq(fit, field[near], rcond=None)[0][0])
    return float(np.sqrt(np.mean(np.square(left))))


def measured(problem: str, cells: int, nu: float, volume: Volume) -> dict:
    """Displacement over its reference, roughness of pressure and of J, iterations."""
    scene, particles = (cook if problem == "cook" else tube)(cells, nu, volume)
    after, info = mpm.step(scene, particles, 0.0, 1e4, method=TIGHT)
    p, dx = pressures(scene, after) / 1e-4, float(scene.grid.spacing)
    J = np.linalg.det(np.asarray(after.F)) - 1
    if problem == "cook":
        ratio, size = deflection(particles, after) / CENTRE[nu], 1 / 16
    else:
        r = np.linalg.norm(np.asarray(particles.x), axis=1)
        u = ((np.asarray(after.x) - particles.x) * np.asarray(particles.x)).sum(axis=1) / r
        exact = lame(r, nu)
        ratio, size = float((u * exact).sum() / (exact**2).sum()), 1.0
    return {
        "ratio": ratio,
        "pressure": roughness(particles, p, dx) / size,
        "J": roughness(particles, J / 1e-4, dx) / size,
        "iterations": int(info.solve.iterations),
        "converged": bool(info.solve.converged),
        "p": p,
        "x": np.asarray(particles.x),
    }


def reference(n: int, nu: float) -> float:
    """The deflection by Taylor-Hood elements (displacements of second order, pressures of first), n along a side."""
    import skfem
    from scipy.sparse import bmat
    from skfem.helpers import ddot, div, sym_grad

    mesh = skfem.MeshQuad.init_tensor(np.linspace(0, 1, n + 1), np.linspace(0, 1, n + 1))
    s = mesh.p[0] ** 1.5
    mesh = skfem.MeshQuad(np.vstack([48 * s, 44 * s + mesh.p[1] * (44 - 28 * s)]), mesh.t)
    u = skfem.Basis(mesh, skfem.ElementVector(skfem.ElementQuad2()), intorder=6)
    p = u.with_element(skfem.ElementQuad1())
    mu, lam = 0.5 / (1 + nu), nu / (1 + nu) / (1 - 2 * nu)
    stiff = skfem.BilinearForm(lambda a, b, w: 2 * mu * ddot(sym_grad(a), sym_grad(b))).assemble(u)
    gap = skfem.BilinearForm(lambda a, q, w: div(a) * q).assemble(u, p)
    soft = skfem.BilinearForm(lambda q, r, w: q * r / lam).assemble(p)
    loaded = mesh.facets_satisfying(lambda x: np.isclose(x[0], 48))
    end = skfem.FacetBasis(mesh, u.elem, facets=loaded)
    force = np.concatenate([skfem.LinearForm(lambda b, w: b[1] / 16).assemble(end), np.zeros(gap.shape[0])])
    held = u.get_dofs(lambda x: np.isclose(x[0], 0)).all()
    found = skfem.solve(*skfem.condense(bmat([[stiff, -gap.T], [-gap, -soft]], "csr"), force, D=held))
    return float((u.probes(np.array([[48 - 1e-9], [52]])) @ found[: u.N])[1])


def swing(
    cells: int,
    volume: Volume,
    description: mpm.UpdatedLagrangian | mpm.TotalLagrangian,
    method: mpm.stepping.AbstractIntegrator,
    dt: float | None = None,
    nu: float = 0.4999,
    periods: float = 4.0,
) -> np.ndarray:
    """A unit block of μ = ρ = 1 in the shear wave u = A sin(ωt) (−cos kx sin ky, sin kx cos ky), k = π, ω = √2 k,
    which keeps the volume and leaves the sides free, whatever ν is. At each quarter of a period: error of displacement
    over A, roughness of the pressure and of J over k A."""
    k, size = np.pi, 5e-3
    omega = 2**0.5 * k
    grid = mpm.Grid((2 * cells, 2 * cells), 1 / cells, origin=(-cells // 2,) * 2)
    rest = mpm.fill(mpm.Box((0.0, 0.0), (1.0, 1.0)), grid, density=1.0)
    X, Y = k * np.asarray(rest.x).T
    shape = np.stack([-np.cos(X) * np.sin(Y), np.sin(X) * np.cos(Y)], axis=1)
    particles = mpm.Particles(rest.x, size * omega * jnp.asarray(shape), rest.mass, rest.volume)
    scene = mpm.Scene(grid, mpm.NeoHookean(2 * (1 + nu), nu), volume=volume, description=description)
    longest = float(mpm.stable_dt(scene, particles)) if dt is None else dt
    quarter = np.pi / omega / 2
    steps = int(np.ceil(quarter / longest))
    run = mpm.simulate(scene, particles, t1=4 * periods * quarter, dt=quarter / steps, method=method, save_every=steps)
    found = []
    for frame in range(1, len(run.times)):
        x, F, t = (np.asarray(a[frame]) for a in (run.frames.x, run.frames.F, run.times))
        u = x - np.asarray(rest.x)
        state = mpm.Particles(jnp.asarray(x), rest.v, rest.mass, rest.volume, deformations=(jnp.asarray(F),), X=rest.x)
        error = np.sqrt(((u / size - np.sin(omega * t) * shape) ** 2).sum(axis=1).mean())
        rough = [
            roughness(rest, field / (k * size), 1 / cells) for field in (pressures(scene, state), np.linalg.det(F))
        ]
        found.append((error, *rough))
    return np.array(found)


def swings() -> None:
    """Print the block's errors after one and four periods."""
    runs = (
        ("explicit, updated", mpm.UpdatedLagrangian(), mpm.Explicit(), None),
        ("midpoint, updated", mpm.UpdatedLagrangian(), mpm.ImplicitMidpoint(), 0.01),
        ("midpoint, total", mpm.TotalLagrangian(), mpm.ImplicitMidpoint(), 0.01),
    )
    for cells in (8, 16):
        for words, description, method, dt in runs if cells == 8 else runs[1:]:
            for name, volume in VOLUMES.items():
                found = swing(cells, volume, description, method, dt)
                worst = [found[part].max(axis=0) for part in (slice(0, 4), slice(12, 16))]
                print(
                    f"swing {cells:3} cells, {words}, {name:11}: "
                    + "; ".join(
                        f"period {number}: displacement {e:.3f}, roughness of p {p:.3f}, of J {J:.2e}"
                        for number, (e, p, J) in zip((1, 4), worst, strict=True)
                    ),
                    flush=True,
                )


def stepping(choice: mpm.implicit.AbstractPreconditioner, rtol: float) -> Callable:
    """A compiled step of scene, particles and Δt."""
    method = mpm.SemiImplicit(
        solver=mpm.implicit.ConjugateResidual(rtol=rtol, max_steps=100_000), preconditioner=choice
    )
    return jax.jit(lambda scene, particles, dt: mpm.step(scene, particles, 0.0, dt, method=method))


def timed(step: Callable, scene: mpm.Scene, particles: mpm.Particles, dt: float, count: int = 3) -> tuple[int, float]:
    """Iterations of a step's solve and the least processor seconds of some steps, compiled before; −1 if it fails."""
    seconds = []
    for _ in range(count + 1):
        start = time.process_time()
        _, info = jax.block_until_ready(step(scene, particles, dt))
        seconds.append(time.process_time() - start)
    return int(info.solve.iterations) if bool(info.solve.converged) else -1, min(seconds[1:])


def solves(sizes: tuple[int, ...]) -> None:
    """Print what solves take with own volumes, and with averaged ones and each preconditioner: of Cook's membrane to
    rest, to 1e-9, and in a step of five times dx/c_s, to 1e-8."""
    ways = {"own volumes": ("own volumes", "diagonal")} | {name: ("averaged", name) for name in PRECONDITIONERS}
    for cells in sizes:
        for nu in (0.3, 0.49, 0.499, 0.4999):
            scenes = {name: cook(cells, nu, volume) for name, volume in VOLUMES.items()}
            wave = 5 * float(scenes["averaged"][0].grid.spacing) * (2 * (1 + nu)) ** 0.5
            for words, dt, rtol in (("to rest", 1e4, 1e-9), ("a step ", wave, 1e-8)):
                found = [
                    (name, *timed(stepping(PRECONDITIONERS[way], rtol), *scenes[volume], dt))
                    for name, (volume, way) in ways.items()
                ]
                told = ", ".join(f"{name} {count:5} iterations {1e3 * s:8.1f} ms" for name, count, s in found)
                print(f"cook {cells:3} cells, nu {nu:6}, {words}: {told}", flush=True)


def solids(sizes: tuple[int, ...]) -> None:
    """Print what a step of five times dx/c_s takes, to 1e-8, of a free block in three dimensions with so many cells a
    side and 2 x 2 x 2 particles a cell, in a window of three more nodes around it: it is sheared and turned."""
    for cells in sizes:
        grid = mpm.Grid((cells + 6,) * 3, 0.1, origin=(-3,) * 3)
        particles = mpm.fill(mpm.Box((0.0,) * 3, (0.1 * cells,) * 3), grid, particles_per_cell=8, density=1.0)
        turned = particles.x[:, ::-1] - particles.x.mean(axis=0)
        particles = mpm.Particles(particles.x, 1e-3 * turned, particles.mass, particles.volume)
        boxed = mpm.extensions.VolumePreconditioner(largest=100_000_000, extent=(cells + 2,) * 3)
        ways = {"diagonal": mpm.implicit.DiagonalPreconditioner(), "volume, its box": boxed}
        steps = {name: stepping(way, 1e-8) for name, way in ways.items()}
        for nu in (0.49, 0.499, 0.4999):
            scene = mpm.Scene(grid, mpm.NeoHookean(1.0, nu), volume=mpm.AveragedVolume())
            dt = 5 * 0.1 * (2 * (1 + nu)) ** 0.5
            found = [(name, *timed(step, scene, particles, dt, count=1)) for name, step in steps.items()]
            told = ", ".join(f"{name} {count:5} iterations {s:7.2f} s" for name, count, s in found)
            print(f"block {cells:3} cells, nu {nu:6}: {told}", flush=True)


def main(quick: bool) -> None:
    """Print the table, and draw the pressures."""
    sizes = (8, 16) if quick else (16, 32)
    drawn = {}
    for problem in ("cook", "tube"):
        for cells in sizes:
            for nu in (0.4999,) if quick else (0.3, 0.49, 0.499, 0.4999):
                for name, volume in VOLUMES.items():
                    found = measured(problem, cells, nu, volume)
                    drawn[problem, cells, nu, name] = found
                    print(
                        f"{problem} {cells:3} cells, nu {nu:6}, {name:11}: displacement / reference "
                        f"{found['ratio']:.4f}, roughness of p {found['pressure']:.2e}, of J {found['J']:.2e}, "
                        f"{found['iterations']:6} iterations{'' if found['converged'] else ' (not converged)'}",
                        flush=True,
                    )
    if quick:
        return
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    each = {name: drawn["cook", sizes[-1], 0.4999, name] for name in VOLUMES}
    limit = np.percentile(np.abs(each["averaged"]["p"]), 99)
    for axes, (name, found) in zip(figure.subplots(1, 2), each.items(), strict=True):
        x, p = found["x"].reshape(3 * sizes[-1], -1, 2), found["p"].reshape(3 * sizes[-1], -1)
        shown = axes.pcolormesh(x[..., 0], x[..., 1], p, cmap="RdBu_r", vmin=-limit, vmax=limit)
        title = f"{name}: deflection {100 * (found['ratio'] - 1):+.1f} %"
        axes.set(title=title, aspect="equal", xlabel="x [m]", ylabel="y [m]")
    label = "p / (force / m²), to the right's 99th percentile"
    figure.colorbar(shown, cax=axes.inset_axes((1.05, 0, 0.05, 1)), extend="both", label=label)
    figure.suptitle("Cook's membrane, ν = 0.4999, 32 cells", fontsize="medium")
    figure.savefig(Path(__file__).parents[1] / "docs" / "nearly_incompressible.png", dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    if "--reference" in sys.argv:
        for nu in CENTRE:
            one, two = reference(32, nu), reference(64, nu)
            print(f"nu {nu}: {one:.4f}, {two:.4f}, extrapolated {2 * two - one:.4f}", flush=True)
    elif "--solves" in sys.argv:
        solves((16,) if "--quick" in sys.argv else (32, 16))
    elif "--solid" in sys.argv:
        solids((4, 8) if "--quick" in sys.argv else (4, 8, 12, 16, 20))
    elif "--swing" in sys.argv:
        swings()
    else:
        main("--quick" in sys.argv)
