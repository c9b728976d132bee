"""Families of deformation gradients, made from their principal stretches."""

import numpy as np
from helpers import rotation_matrix


def _random(d, rng):
    return rng.uniform(0.5, 1.5, d)


def _near_identity(d, rng):
    return 1 + 10.0 ** rng.uniform(-12, -3) * rng.normal(size=d)


def _repeated(d, rng):
    return rng.choice([np.full(d, 1.0), np.full(d, 1.2), np.r_[1.2, 1.2, 0.9][:d], np.r_[0.8, 1.3, 1.3][:d]])


def _compressed(d, rng):
    return rng.uniform(0.02, 0.15, d)


def _inverted(d, rng):
    """One negative stretch, and no two that nearly cancel; in 1-D, where R = 1, the sign is all there is."""
    s = rng.uniform(0.8, 1.5, d)
    s[-1] = -rng.uniform(0.1, 0.5)
    return s


STRETCHES = {
    "random": _random,
    "near_identity": _near_identity,
    "repeated": _repeated,
    "compressed": _compressed,
    "inverted": _inverted,
}


def deformations(family: str, d: int, *, n: int = 20, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """n deformation gradients F = U diag(s) Vᵀ of a family and their rotations R = U Vᵀ, both (d, d, n)."""
    rng = np.random.default_rng(seed)
    U, V = (np.stack([rotation_matrix(d, rng) for _ in range(n)], axis=-1) for _ in range(2))
    if family == "repeated":  # rotations split stretches by rounding: every other F is turned by none
        U[..., ::2] = V[..., ::2] = np.eye(d)[..., None]
    s = np.stack([STRETCHES[family](d, rng) for _ in range(n)], axis=-1)
    return np.einsum("ikn,kn,jkn->ijn", U, s, V), np.einsum("ikn,jkn->ijn", U, V)
