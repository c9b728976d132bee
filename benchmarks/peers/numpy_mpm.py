"""MLS-MPM in NumPy, as a page of code: explicit, APIC, quadratic kernel, two laws, in two dimensions. It shares nothing
with `mpmjax`, and makes motions that fits are held against.

Y. Hu et al., ACM Trans. Graph. 37 (2018) 150, doi 10.1145/3197517.3201293: mass, affine momentum and the stress of the
step before are spread at once, the grid is updated, particles collect.
"""

import itertools
from collections.abc import Callable

import numpy as np


def neo_hookean(mu: float, lam: float) -> Callable[[np.ndarray], np.ndarray]:
    """Kirchhoff stress μ (F Fᵀ − 1) + λ ln J 1 [Pa], shape (p, 2, 2)."""
    return lambda F: (
        mu * (F @ F.transpose(0, 2, 1) - np.eye(2)) + lam * np.log(np.linalg.det(F))[:, None, None] * np.eye(2)
    )


def fixed_corotated(mu: float, lam: float) -> Callable[[np.ndarray], np.ndarray]:
    """Kirchhoff stress 2 μ (F − R) Fᵀ + λ J (J − 1) 1 [Pa], shape (p, 2, 2)."""

    def stress(F: np.ndarray) -> np.ndarray:
        U, _, Vt = np.linalg.svd(F)
        J = np.linalg.det(F)
        return 2 * mu * (F - U @ Vt) @ F.transpose(0, 2, 1) + lam * (J * (J - 1))[:, None, None] * np.eye(2)

    return stress


def simulate(
    x: np.ndarray,
    v: np.ndarray,
    *,
    density: float,
    volume: float,
    spacing: float,
    stress: Callable[[np.ndarray], np.ndarray],
    dt: float,
    steps: int,
    every: int,
    gravity: float = 0.0,
    floor: float | None = None,
) -> np.ndarray:
    """Positions [m] at the start and after each `every` steps, shape (f, p, 2).

    Args:
        x, v: positions [m], in the positive quadrant and two nodes from its border, and velocities [m/s], shape (p, 2).
        density: [kg/m²].
        volume: of a particle [m²].
        spacing: of the grid, whose first node is at the origin [m].
        stress: Kirchhoff stress [Pa] of a deformation gradient.
        dt, steps, every: step [s], their number, and how often positions are kept.
        gravity: downward [m/s²].
        floor: height of a frictionless floor that pushes and does not pull, on a row of nodes [m].
    """
    x, v, mass = x.copy(), v.copy(), density * volume
    F, C = np.broadcast_to(np.eye(2), (len(x), 2, 2)).copy(), np.zeros((len(x), 2, 2))
    width = int(np.ceil(x.max() / spacing * 1.5)) + 4
    frames, lowest = [x.copy()], -1 if floor is None else round(floor / spacing)
    for step in range(1, steps + 1):
        base = np.floor(x / spacing - 0.5).astype(int)
        f = x / spacing - base
        weights = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        affine = mass * C - dt * volume * 4 / spacing**2 * stress(F)
        momentum, masses, stencil = np.zeros((width**2, 2)), np.zeros(width**2), []
        for i, j in itertools.product(range(3), repeat=2):
            w, arm = weights[i, :, 0] * weights[j, :, 1], (np.array([i, j]) - f) * spacing
            at = (base[:, 0] + i) * width + base[:, 1] + j
            stencil.append((at, w, arm))
            masses += np.bincount(at, w * mass, width**2)
            spread = w[:, None] * (mass * v + np.einsum("pij,pj->pi", affine, arm))
            momentum += np.stack([np.bincount(at, column, width**2) for column in spread.T], axis=1)
        nodes = momentum / np.where(masses > 0, masses, 1)[:, None]
        nodes[masses > 0, 1] -= dt * gravity
        below = np.arange(width**2) % width <= lowest
        nodes[below, 1] = np.maximum(nodes[below, 1], 0)
        v, C = np.zeros_like(v), np.zeros_like(C)
        for at, w, arm in stencil:
            v += w[:, None] * nodes[at]
            C += 4 / spacing**2 * w[:, None, None] * nodes[at][:, :, None] * arm[:, None, :]
        F = F + dt * C @ F
        x = x + dt * v
        if step % every == 0:
            frames.append(x.copy())
    return np.array(frames)
