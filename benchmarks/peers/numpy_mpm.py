"""MLS-MPM in NumPy, as two pages of code: explicit, APIC, quadratic kernel, in two dimensions (plane strain), of two
elastic laws, a fluid and sand. It shares nothing with `mpmjax`, and makes motions that fits are held against.

Y. Hu et al., ACM Trans. Graph. 37 (2018) 150, doi 10.1145/3197517.3201293: mass, affine momentum and the stress of the
step before are spread at once, the grid is updated, particles collect.
"""

import itertools

import numpy as np


class NeoHookean:
    """Kirchhoff stress μ (F Fᵀ − 1) + λ ln J 1 [Pa]."""

    def __init__(self, mu: float, lam: float):
        self.mu, self.lam = mu, lam

    def stress(self, F: np.ndarray, L: np.ndarray) -> np.ndarray:
        """Kirchhoff stress [Pa] by the deformation and velocity gradients, all of shape (p, 2, 2)."""
        del L
        spherical = self.lam * np.log(np.linalg.det(F))
        return self.mu * (F @ F.transpose(0, 2, 1) - np.eye(2)) + spherical[:, None, None] * np.eye(2)

    def returned(self, F: np.ndarray) -> np.ndarray:
        """The elastic deformation gradient after a step, by the one tried."""
        return F


class FixedCorotated(NeoHookean):
    """Kirchhoff stress 2 μ (F − R) Fᵀ + λ J (J − 1) 1 [Pa]."""

    def stress(self, F: np.ndarray, L: np.ndarray) -> np.ndarray:
        del L
        U, _, Vt = np.linalg.svd(F)
        J = np.linalg.det(F)
        spherical = self.lam * (J * (J - 1))[:, None, None] * np.eye(2)
        return 2 * self.mu * (F - U @ Vt) @ F.transpose(0, 2, 1) + spherical


class Fluid:
    """Tait's pressure K/7 (J⁻⁷ − 1), where it is positive, and a Newtonian viscosity: stress 2 η dev D, in three
    dimensions. Beyond J = 1 a particle returns to it."""

    def __init__(self, bulk_modulus: float, viscosity: float):
        self.bulk_modulus, self.viscosity = bulk_modulus, viscosity

    def stress(self, F: np.ndarray, L: np.ndarray) -> np.ndarray:
        J, D = np.linalg.det(F)[:, None, None], (L + L.transpose(0, 2, 1)) / 2
        shear = D - np.trace(D, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(2)
        return J * (2 * self.viscosity * shear - self.bulk_modulus / 7 * (J**-7 - 1) * np.eye(2))

    def returned(self, F: np.ndarray) -> np.ndarray:
        return np.sqrt(np.minimum(np.linalg.det(F), 1))[:, None, None] * np.eye(2)


class Sand:
    """Hencky's elasticity, and the cone of Drucker and Prager in the three logarithmic strains of plane strain, without
    dilatancy, with the gap that must close again (G. Klár et al., ACM Trans. Graph. 35 (2016) 103; A. P. Tampubolon et
    al., ACM Trans. Graph. 36 (2017) 105)."""

    def __init__(self, mu: float, lam: float, friction_angle: float, count: int):
        self.mu, self.lam = mu, lam
        sine = np.sin(friction_angle)
        self.slope = np.sqrt(2 / 3) * 2 * sine / (3 - sine) * (3 * lam + 2 * mu) / (2 * mu)
        self.across, self.gap = np.zeros(count), np.zeros(count)

    def stress(self, F: np.ndarray, L: np.ndarray) -> np.ndarray:
        del L
        U, s, _ = np.linalg.svd(F)
        strain = np.log(s)
        principal = 2 * self.mu * strain + self.lam * (strain.sum(axis=1) + self.across)[:, None]
        return (U * principal[:, None, :]) @ U.transpose(0, 2, 1)

    def returned(self, F: np.ndarray) -> np.ndarray:
        U, s, Vt = np.linalg.svd(F)
        strain = np.concatenate([np.log(s), self.across[:, None]], axis=1)
        mean = strain.mean(axis=1)
        deviator = strain - mean[:, None]
        mean = mean + self.gap / 3
        apart, size = mean > 0, np.linalg.norm(deviator, axis=1)
        kept = np.where(apart, 0, np.minimum(1, -3 * self.slope * mean / np.maximum(size, 1e-300)))
        strain = kept[:, None] * deviator + np.where(apart, 0, mean)[:, None]
        self.gap, self.across = np.where(apart, 3 * mean, 0), strain[:, 2]
        return (U * np.exp(strain[:, None, :2])) @ Vt


def simulate(
    x: np.ndarray,
    v: np.ndarray,
    *,
    density: float,
    volume: float,
    spacing: float,
    law: NeoHookean | Fluid | Sand,
    dt: float,
    steps: int,
    every: int,
    gravity: float = 0.0,
    floor: float | None = None,
    sticks: bool = False,
) -> np.ndarray:
    """Positions [m] at the start and after each `every` steps, shape (f, p, 2).

    Args:
        x, v: positions [m], in the positive quadrant and two nodes from its border, and velocities [m/s], shape (p, 2).
        density: [kg/m²].
        volume: of a particle [m²].
        spacing: of the grid, whose first node is at the origin [m].
        law: the material.
        dt, steps, every: step [s], their number, and how often positions are kept.
        gravity: downward [m/s²].
        floor: height of a frictionless floor that pushes and does not pull, on a row of nodes [m].
        sticks: whether the floor holds the nodes in it instead.
    """
    x, v, mass = x.copy(), v.copy(), density * volume
    F, C = np.broadcast_to(np.eye(2), (len(x), 2, 2)).copy(), np.zeros((len(x), 2, 2))
    width = int(np.ceil(x.max() / spacing * 1.5)) + 4
    frames, lowest = [x.copy()], -1 if floor is None else round(floor / spacing)
    for step in range(1, steps + 1):
        base = np.floor(x / spacing - 0.5).astype(int)
        f = x / spacing - base
        weights = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2])
        affine = mass * C - dt * volume * 4 / spacing**2 * law.stress(F, C)
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
        nodes[below] = 0 if sticks else np.maximum(nodes[below], [-np.inf, 0])
        v, C = np.zeros_like(v), np.zeros_like(C)
        for at, w, arm in stencil:
            v += w[:, None] * nodes[at]
            C += 4 / spacing**2 * w[:, None, None] * nodes[at][:, :, None] * arm[:, None, :]
        F = law.returned(F + dt * C @ F)
        x = x + dt * v
        if step % every == 0:
            frames.append(x.copy())
    return np.array(frames)
