"""One step in plain NumPy, written from the formulas with loops, and a look at the grid inside a step.

Nothing here but the scene's numbers comes from the package: kernels are evaluated on every node, D_p is summed, R comes
from an SVD, the cofactor from an inverse, and H is assembled column by column and solved densely.
"""

import itertools

import equinox as eqx
import jax
import numpy as np

import mpmjax as mpm
from mpmjax.boundary import ConstrainedNodes
from mpmjax.checks._values import canonical
from mpmjax.stepping import GridUpdate as Update, Nodes, StepInfo, reaction, start_nodes, step_unchecked, update


def kernel(order: int, u: float) -> tuple[float, float]:
    """The centred B-spline and its slope at a distance u, in spacings."""
    a, sign = abs(u), np.sign(u)
    match order:
        case 1:
            return (1 - a, -sign) if a < 1 else (0.0, 0.0)
        case 2 if a < 0.5:
            return 0.75 - a**2, -2 * u
        case 2:
            return (0.5 * (1.5 - a) ** 2, -sign * (1.5 - a)) if a < 1.5 else (0.0, 0.0)
        case _ if a < 1:
            return a**3 / 2 - a**2 + 2 / 3, sign * (1.5 * a**2 - 2 * a)
        case _:
            return ((2 - a) ** 3 / 6, -sign * (2 - a) ** 2 / 2) if a < 2 else (0.0, 0.0)


def rotation(F: np.ndarray) -> np.ndarray:
    """R of F = R S with det R = +1."""
    U, _, Vt = np.linalg.svd(F)
    U[:, -1] *= np.sign(np.linalg.det(U @ Vt))
    return U @ Vt


def rotation_differential(F: np.ndarray, dF: np.ndarray) -> np.ndarray:
    """δR in the principal frame: off-diagonal entries of R'δF − δF'R over the sum of the two stretches."""
    U, s, Vt = np.linalg.svd(F)
    flip = np.sign(np.linalg.det(U @ Vt))
    U[:, -1] *= flip
    s[-1] *= flip
    A = U.T @ dF @ Vt.T
    return U @ np.where(np.eye(len(s), dtype=bool), 0, (A - A.T) / np.add.outer(s, s)) @ Vt


def stress(law, mu: float, lam: float, F: np.ndarray) -> np.ndarray:
    """First Piola-Kirchhoff stress."""
    J, inverse = np.linalg.det(F), np.linalg.inv(F).T
    if isinstance(law, mpm.FixedCorotated):
        return 2 * mu * (F - rotation(F)) + lam * (J - 1) * J * inverse
    return mu * (F - inverse) + lam * np.log(J) * inverse


def stress_differential(law, mu: float, lam: float, F: np.ndarray, dF: np.ndarray) -> np.ndarray:
    """Its derivative in a direction."""
    J, inverse = np.linalg.det(F), np.linalg.inv(F).T
    rate = (inverse * dF).sum()
    d_inverse = -inverse @ dF.T @ inverse
    if isinstance(law, mpm.FixedCorotated):
        turned = 2 * mu * (dF - rotation_differential(F, dF))
        return turned + lam * (2 * J - 1) * J * rate * inverse + lam * (J - 1) * J * d_inverse
    return mu * dF + (lam * np.log(J) - mu) * d_inverse + lam * rate * inverse


def numpy_step(scene: mpm.Scene, particles: mpm.Particles, dt: float, beta: float | None = None) -> dict:
    """One step at t = 0, explicit without a beta, else semi-implicit; boundaries: sticky and slip boxes, box grips."""
    d, dx, law, total = scene.grid.dim, float(scene.grid.spacing), scene.material, scene.total
    x, v, F = (np.asarray(a) for a in (particles.x, particles.v, particles.F))
    C = np.zeros_like(F) if particles.C is None else np.asarray(particles.C)
    m, V = np.asarray(particles.mass), np.asarray(particles.volume)
    X = np.asarray(particles.X) if total else x
    E, nu = np.broadcast_to(law.youngs_modulus, m.shape), np.broadcast_to(law.poisson_ratio, m.shape)
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    lattice = list(itertools.product(*map(range, scene.grid.shape)))
    nodes = dx * (np.array(lattice) + np.array(scene.grid.origin))
    p, n = len(x), len(nodes)

    # weights, moving-least-squares gradients g and the material gradient h on all nodes
    w, mls, h = np.zeros((p, n)), np.zeros((p, n, d)), np.zeros((p, n, d))
    for q in range(p):
        spline = np.zeros((n, d))
        for i in range(n):
            values, slopes = zip(
                *(kernel(scene.kernel.order, (X[q, a] - nodes[i, a]) / dx) for a in range(d)), strict=True
            )
            w[q, i] = np.prod(values)
            for a in range(d):
                spline[i, a] = slopes[a] / dx * np.prod([values[b] for b in range(d) if b != a])
        arm = nodes - X[q]
        D = sum(w[q, i] * np.outer(arm[i], arm[i]) for i in range(n))
        mls[q] = w[q][:, None] * arm @ np.linalg.inv(D)
        g = spline if isinstance(scene.gradient, mpm.SplineGradient) else mls[q]
        h[q] = g if total else g @ F[q]

    # particles to grid
    mass, momentum, force = np.zeros(n), np.zeros((n, d)), np.zeros((n, d))
    for q, i in itertools.product(range(p), range(n)):
        mass[i] += w[q, i] * m[q]
        momentum[i] += w[q, i] * m[q] * (v[q] + C[q] @ (nodes[i] - X[q]))
    for q in range(p):
        force -= V[q] * h[q] @ stress(law, mu[q], lam[q], F[q]).T
    occupied = mass > 1e-15 * m.mean()
    before, after = np.zeros((n, d)), np.zeros((n, d))
    before[occupied] = momentum[occupied] / mass[occupied, None]

    # the update
    free, held = np.repeat(occupied[:, None], d, axis=1), np.zeros((n, d))
    for wall in scene.boundary:
        for i in range(n):
            if isinstance(wall, mpm.Grip):
                if (nodes[i] > np.array(wall.region.lower)).all() and (nodes[i] < np.array(wall.region.upper)).all():
                    first, second = np.array(wall.motion.displacement)
                    free[i], held[i] = False, (second - first) / (wall.motion.times[1] - wall.motion.times[0])
                continue
            beyond = (nodes[i] <= np.array(wall.lower) + 1e-9) | (nodes[i] >= np.array(wall.upper) - 1e-9)
            free[i] &= ~(beyond.any() if isinstance(wall, mpm.StickyBox) else beyond)
    after[occupied] = before[occupied] + dt * (force[occupied] / mass[occupied, None] + np.array(scene.gravity))
    if beta is not None:
        H = np.zeros((n, d, n, d))
        for q in range(p):
            for i, a in itertools.product(np.flatnonzero(w[q]), range(d)):
                dF = np.outer(np.eye(d)[a], h[q, i])
                H[:, :, i, a] += V[q] * h[q] @ stress_differential(law, mu[q], lam[q], F[q], dF).T
        A = np.diag(np.repeat(mass, d)) + beta * dt**2 * H.reshape(n * d, n * d)
        keep = np.flatnonzero(free)
        b = (mass[:, None] * after).reshape(-1)
        after = held.reshape(-1).copy()
        after[keep] = np.linalg.solve(A[np.ix_(keep, keep)], (b - A @ after)[keep])
        after = after.reshape(n, d)
    after = np.where(free, after, held)
    before = np.where(free, before, held)  # a particle takes no change from what a boundary holds

    # grid to particles
    moved = w @ after
    new_v, new_C = moved, None
    if isinstance(scene.transfer, mpm.FLIP):
        new_v = scene.transfer.alpha * (v + w @ (after - before)) + (1 - scene.transfer.alpha) * moved
    if isinstance(scene.transfer, mpm.APIC):
        new_C = np.stack([after.T @ mls[q] for q in range(p)])
    return {"x": x + dt * moved, "v": new_v, "F": F + dt * np.stack([after.T @ h[q] for q in range(p)]), "C": new_C}


class GridUpdate(eqx.Module):
    """What happened on the grid in one step."""

    nodes: Nodes
    velocity: jax.Array
    reaction: jax.Array
    info: StepInfo
    particles: mpm.Particles
    position: jax.Array
    update: Update
    held: ConstrainedNodes
    """The nodes with what contacts hold."""
    holding: jax.Array
    """The part of the reaction that holds components of velocity, without springs."""
    friction: jax.Array
    """The impulse of friction."""


def grid_update(scene: mpm.Scene, particles: mpm.Particles, dt: float, method, t: float = 0.0) -> GridUpdate:
    """One step, with the grid's problem and its solution kept."""
    scene, t, dt, method = canonical((scene, t, dt, method), particles.x.dtype)
    return _grid_update(scene, mpm.prepare(scene, particles), t, dt, method)


@eqx.filter_jit
def _grid_update(scene, particles, t, dt, method) -> GridUpdate:
    nodes = start_nodes(
        scene,
        particles,
        t,
        dt,
        scene.stencil(particles),
        body_force_at=method.body_force_at,
        force_at=method.force_at(),
    )
    new, info = step_unchecked(scene, particles, t, dt, method)
    grid = update(nodes, method)
    position = scene.grid.nodes(scene.window(particles))
    held, push = grid.held(nodes), reaction(nodes, grid.solved, grid.elastic)
    velocity, holding = grid.motion.velocity, held.without_spring_impulses(push)
    friction = nodes.mass[:, None] * (velocity - grid.solved.velocity)
    return GridUpdate(nodes, velocity, push, info, new, position, grid, held, holding, friction)
