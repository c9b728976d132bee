"""What do particles at a surface that the grid does not follow need? Statics of a ring, small strains, compared.

    python benchmarks/surface_stress.py [--fine]

The displacement U(R) of `verification.ExpandingRing` (ν = 0, free edges) is the exact equilibrium under a body force.
It is solved for with the weights and gradients of the package's kernels, by sparse factorisation, on 20 and 40 cells a
metre (and 80 with `--fine`), for three places of the ring in a cell each. Printed, as rows of docs/notes/figures.md:
errors of the displacement (RMS, over that of the inner edge) and of the strain (mean, over the largest) of all
particles, of those within half a cell of the surface, of the others, and the worst; then the least mass of a node over
that of a full one. All are means over the three places.

- whole: a lattice point inside has a whole cell (what `fill` did); parts: the part of its cell inside; filled: parts
  below a fiftieth of a cell given to a neighbour (what `fill` does); beside: filled with a lattice that does not follow
  the grid; fitted: cells fitted to the ring.
- ghost: a stiffness γ E dx^(d−2) Σ (Δ³u)² is added, over all four nodes in a row of which one is not full: what the
  second derivative of a quadratic spline jumps by (E. Burman, C. R. Math. 348 (2010) 1217,
  doi 10.1016/j.crma.2010.10.006); light: times the least share of the four, so that an explicit step stays as long.
- extended: nodes of less than a share of the full mass are no unknowns, but extrapolated by parabolas from the nearest
  3 x 3 nodes above it (K. Höllig, U. Reif, J. Wipper, SIAM J. Numer. Anal. 39 (2001) 442,
  doi 10.1137/S0036142900373208).
"""

import argparse
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as sl

import mpmjax as mpm
from mpmjax.discretisation import make_stencil
from mpmjax.geometry import inside_parts
from mpmjax.verification import ExpandingRing

PROBLEM = ExpandingRing()
INNER, OUTER = PROBLEM.inner, PROBLEM.outer
SHIFTS = (0.0, 0.13, 0.31)
"""Places of the ring in a cell."""
SCALE = 1 / (INNER**2 * (3 * OUTER - INNER))
LARGEST = 1 / INNER
"""The strain around the inner edge, for a displacement of one there."""


def radial(R):
    """U, U′ and U″ [m, -, 1/m]."""
    a, b = INNER, OUTER
    return (
        SCALE * (6 * a * b * R - 3 * (a + b) * R**2 + 2 * R**3),
        SCALE * (6 * a * b - 6 * (a + b) * R + 6 * R**2),
        SCALE * (-6 * (a + b) + 12 * R),
    )


def particles(kind: str, dx: float, per_side: int, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and volumes of the ring about (shift dx, shift dx)."""
    ring = mpm.geometry.Annulus((shift * dx,) * 2, INNER, OUTER)
    if kind in ("filled", "fitted"):
        grid = mpm.Grid((9, 9), dx)
        q = mpm.fill(ring, grid, particles_per_cell=per_side**2, density=1.0, fitted=kind == "fitted")
        return np.asarray(q.x) - shift * dx, np.asarray(q.volume)
    n, cell = int(np.ceil(1.3 * per_side / dx / 2)) * 2, dx / per_side
    axis = (np.arange(n) + 0.5 - n / 2 + (0.4 if kind == "beside" else 0)) * cell
    x = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    if kind == "whole":
        x = x[np.asarray(ring.contains(jnp.asarray(x)))]
        return x - shift * dx, np.full(len(x), cell**2)
    share, x = inside_parts(ring, x, np.full(2, cell))
    return x[share > 0] - shift * dx, share[share > 0] * cell**2


class Discretisation:
    """The ring's stiffness and what its particles see, with the nodes that have mass."""

    def __init__(self, kind="filled", per_side=2, order=2, gradient="spline", *, dx, shift):
        x, self.volume = particles(kind, dx, per_side, shift)
        self.x, self.dx = x, dx
        self.n = n = 2 * (int(np.ceil(OUTER / dx)) + 6) + 1
        grid = mpm.Grid((n, n), dx, origin=(-(n // 2),) * 2)
        operator = mpm.SplineGradient() if gradient == "spline" else mpm.MLSGradient()
        places = jnp.asarray(x + shift * dx)
        stencil = make_stencil(mpm.BSpline(order), operator, grid, jnp.asarray(grid.origin), places)
        column, row = np.asarray(stencil.index), np.broadcast_to(np.arange(len(x)), stencil.index.shape)
        slopes = np.asarray(stencil.gradient)

        def matrix(values):
            return sp.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=(len(x), n * n))

        W = matrix(np.asarray(stencil.weight))
        mass = W.T @ self.volume
        self.nodes = np.flatnonzero(mass > 1e-14 * dx**2)
        self.mass = mass[self.nodes]
        self.W, self.Gx, self.Gy = (m[:, self.nodes] for m in (W, matrix(slopes[:, 0]), matrix(slopes[:, 1])))
        self.number = -np.ones(n * n, int)
        self.number[self.nodes] = np.arange(len(self.nodes))
        self.place = np.stack(np.divmod(self.nodes, n), axis=1) * dx - (n // 2) * dx - shift * dx

    def stiffness(self):
        """Of E = 1, ν = 0: Σ V ε : ε."""
        V = sp.diags(self.volume)
        Gx, Gy = self.Gx, self.Gy
        xx, yy, xy = Gx.T @ V @ Gx, Gy.T @ V @ Gy, Gy.T @ V @ Gx / 2
        return sp.bmat([[xx + yy / 2, xy], [xy.T, yy + xx / 2]]).tocsr()

    def load(self):
        """Nodal forces of the exact body force, −div ε."""
        R = np.linalg.norm(self.x, axis=1)
        U, slope, curve = radial(R)
        b = (-(curve + slope / R - U / R**2) / R)[:, None] * self.x
        return np.concatenate([self.W.T @ (self.volume * b[:, a]) for a in range(2)])

    def ghost(self, gamma: float, *, light: bool):
        """γ (Δ³)ᵀ Δ³ over nodes in a row of which one is not full, each row times the least share if `light`."""
        share = np.minimum(self.mass / self.dx**2, 1)
        rows = []
        for step in (self.n, 1):
            line = np.stack([self.number[self.nodes + k * step] for k in range(4)], axis=1)
            rows.append(line[(line >= 0).all(axis=1) & (share[np.maximum(line, 0)] < 0.999).any(axis=1)])
        lines = np.concatenate(rows)
        weight = np.sqrt(gamma * (share[lines].min(axis=1) if light else np.ones(len(lines))))
        values = weight[:, None] * np.array([-1.0, 3.0, -3.0, 1.0])
        at = np.repeat(np.arange(len(lines)), 4), lines.ravel()
        jump = sp.csr_matrix((values.ravel(), at), shape=(len(lines), len(self.nodes)))
        return sp.block_diag([jump.T @ jump] * 2)

    def extension(self, least: float):
        """The map from the nodes of at least this share of the full mass to all nodes."""
        n, N = self.n, len(self.nodes)
        inner = self.mass >= least * self.dx**2
        held = np.zeros(n * n, bool)
        held[self.nodes[inner]] = True
        held = held.reshape(n, n)
        block = np.lib.stride_tricks.sliding_window_view(held, (3, 3)).all(axis=(2, 3))
        corners = np.argwhere(block)
        at, own = np.stack(np.divmod(self.nodes, n), axis=1), -np.ones(N, int)
        own[inner] = np.arange(inner.sum())
        found = [(i, own[i], 1.0) for i in np.flatnonzero(inner)]
        for i in np.flatnonzero(~inner):
            corner = corners[((corners + 1 - at[i]) ** 2).sum(axis=1).argmin()]
            s = at[i] - corner
            along = np.stack([(s - 1) * (s - 2) / 2, -s * (s - 2), s * (s - 1) / 2])  # parabola through 0, 1, 2
            for j, k in itertools.product(range(3), repeat=2):
                source = self.number[(corner[0] + j) * n + corner[1] + k]
                found.append((i, own[source], along[j, 0] * along[k, 1]))
        row, column, value = zip(*found, strict=True)
        one = sp.csr_matrix((value, (row, column)), shape=(N, inner.sum()))
        return sp.block_diag([one, one]).tocsr()


def solve(*, ghost=0.0, light=False, least=0.0, **chosen) -> np.ndarray:
    """The errors of one discretisation, and the least mass."""
    q = Discretisation(**chosen)
    N, m = len(q.nodes), q.mass
    K = q.stiffness() + (q.ghost(ghost, light=light) if ghost else 0)
    E = q.extension(least) if least else sp.identity(2 * N, format="csr")
    none = np.zeros(N)
    rigid = np.stack([np.r_[m, none], np.r_[none, m], np.r_[-m * q.place[:, 1], m * q.place[:, 0]]], axis=1)
    K, rigid = (E.T @ K @ E).tocsc(), E.T @ rigid
    lightest = (E.T @ np.r_[m, m]).min() / q.dx**2
    system = sp.bmat([[K, rigid], [rigid.T, None]]).tocsc()
    u = E @ sl.spsolve(system, np.r_[E.T @ q.load(), np.zeros(3)])[:-3]
    ux, uy = u[:N], u[N:]
    R = np.linalg.norm(q.x, axis=1)
    U, slope, _ = radial(R)
    c, s = q.x.T / R
    a, b = slope, U / R
    miss = np.stack([q.Gx @ ux - a * c**2 - b * s**2, q.Gy @ uy - a * s**2 - b * c**2])
    shear = (q.Gy @ ux + q.Gx @ uy) / 2 - (a - b) * c * s
    strain = np.sqrt((miss**2).sum(axis=0) + 2 * shear**2) / LARGEST
    moved = ((np.stack([q.W @ ux, q.W @ uy]) - q.x.T * b) ** 2).sum(axis=0)
    edge = np.minimum(R - INNER, OUTER - R) < q.dx / 2
    means = [np.average(strain[rows], weights=q.volume[rows]) for rows in (edge | ~edge, edge, ~edge)]
    return np.array([np.sqrt(np.average(moved, weights=q.volume)), *means, strain.max(), lightest])


CASES = {
    "whole cells": {"kind": "whole"},
    "parts of cells": {"kind": "parts"},
    "parts, lattice beside the grid's": {"kind": "beside"},
    "filled: parts, the smallest merged": {},
    "the same, moving least squares": {"gradient": "moving least squares"},
    "the same, cubic kernel": {"order": 3},
    "the same, 4 x 4 a cell": {"per_side": 4},
    "fitted cells": {"kind": "fitted"},
    "fitted cells, 4 x 4 a cell": {"kind": "fitted", "per_side": 4},
    "filled, ghost 0.01": {"ghost": 0.01},
    "filled, ghost 0.1": {"ghost": 0.1},
    "filled, light ghost 0.1": {"ghost": 0.1, "light": True},
    "fitted, ghost 0.1": {"kind": "fitted", "ghost": 0.1},
    "filled, extended 0.05": {"least": 0.05},
    "filled, extended 0.2": {"least": 0.2},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fine", action="store_true", help="a third grid, of 80 cells a metre")
    cells = (20, 40, 80) if parser.parse_args().fine else (20, 40)
    jax.config.update("jax_enable_x64", True)
    for name, chosen in CASES.items():
        errors = [np.mean([solve(**chosen, dx=1 / n, shift=s) for s in SHIFTS], axis=0) for n in cells]
        shown = " | ".join(", ".join(f"{e:.1e}" for e in each) for each in np.transpose(errors))
        print(f"| {name} | {shown} |", flush=True)


if __name__ == "__main__":
    main()
