"""MLS-MPM in Warp, as its users write it: explicit, APIC, quadratic kernel, neo-Hookean. A peer to compare with.

The same scheme, in the same order of operations, as `mpmjax.Explicit` with the default scene; see `taichi_mpm.py`.
Three dimensions and float32 alone; Warp's CPU back end runs on one thread.
"""

import numpy as np
import warp as wp


@wp.func
def weights(f: wp.vec3):
    """Rows: the three nodes' weights in each direction."""
    near = wp.vec3(1.5) - f
    mid = f - wp.vec3(1.0)
    far = f - wp.vec3(0.5)
    return wp.matrix_from_rows(
        0.5 * wp.cw_mul(near, near), wp.vec3(0.75) - wp.cw_mul(mid, mid), 0.5 * wp.cw_mul(far, far)
    )


@wp.kernel
def spread(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
    mass: wp.array3d(dtype=float),
    momentum: wp.array3d(dtype=wp.vec3),
    m: float,
    volume: float,
    mu: float,
    lam: float,
    dx: float,
    dt: float,
):
    """P2G of mass, momentum and stress at once."""
    q = wp.tid()
    inv_dx = 1.0 / dx
    xi = x[q] * inv_dx
    i = int(xi[0] - 0.5)
    j = int(xi[1] - 0.5)
    k = int(xi[2] - 0.5)
    f = xi - wp.vec3(float(i), float(j), float(k))
    w = weights(f)
    b = F[q] * wp.transpose(F[q])
    tau = mu * b + (lam * wp.log(wp.determinant(F[q])) - mu) * wp.identity(n=3, dtype=float)
    affine = m * C[q] - (4.0 * dt * volume * inv_dx * inv_dx) * tau
    for a in range(3):
        for c in range(3):
            for e in range(3):
                weight = w[a, 0] * w[c, 1] * w[e, 2]
                arm = (wp.vec3(float(a), float(c), float(e)) - f) * dx
                wp.atomic_add(momentum, i + a, j + c, k + e, weight * (m * v[q] + affine * arm))
                wp.atomic_add(mass, i + a, j + c, k + e, weight * m)


@wp.kernel
def update(mass: wp.array3d(dtype=float), momentum: wp.array3d(dtype=wp.vec3), gravity: wp.vec3, dt: float):
    """The grid's velocity, in the place of its momentum."""
    i, j, k = wp.tid()
    if mass[i, j, k] > 0.0:
        momentum[i, j, k] = momentum[i, j, k] / mass[i, j, k] + dt * gravity


@wp.kernel
def collect(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    F: wp.array(dtype=wp.mat33),
    velocity: wp.array3d(dtype=wp.vec3),
    dx: float,
    dt: float,
):
    """G2P."""
    q = wp.tid()
    inv_dx = 1.0 / dx
    xi = x[q] * inv_dx
    i = int(xi[0] - 0.5)
    j = int(xi[1] - 0.5)
    k = int(xi[2] - 0.5)
    f = xi - wp.vec3(float(i), float(j), float(k))
    w = weights(f)
    new = wp.vec3()
    gradient = wp.mat33()
    for a in range(3):
        for c in range(3):
            for e in range(3):
                node = (w[a, 0] * w[c, 1] * w[e, 2]) * velocity[i + a, j + c, k + e]
                new += node
                gradient += wp.outer(node, wp.vec3(float(a), float(c), float(e)) - f)
    gradient = 4.0 * inv_dx * gradient
    v[q] = new
    C[q] = gradient
    x[q] = x[q] + dt * new
    F[q] = F[q] + dt * gradient * F[q]


class WarpMPM:
    """A free body under gravity in a box whose walls it does not touch; arguments as `TaichiMPM`'s."""

    def __init__(
        self,
        x: np.ndarray,
        v: np.ndarray,
        *,
        mass: float,
        volume: float,
        shape: tuple[int, ...],
        spacing: float,
        shear_modulus: float,
        lame_lambda: float,
        gravity: tuple[float, ...],
        dtype: str,
    ):
        if x.shape[1] != 3 or dtype != "float32":
            raise ValueError(f"This peer is written for three dimensions and float32, got {x.shape[1]} and {dtype}.")
        wp.config.quiet = True
        wp.init()
        p = len(x)
        on = {"device": "cpu"}
        self._x, self._v = wp.array(x, dtype=wp.vec3, **on), wp.array(v, dtype=wp.vec3, **on)
        self._C = wp.zeros(p, dtype=wp.mat33, **on)
        self._F = wp.array(np.broadcast_to(np.eye(3), (p, 3, 3)), dtype=wp.mat33, **on)
        self._mass, self._momentum = wp.zeros(shape, dtype=float, **on), wp.zeros(shape, dtype=wp.vec3, **on)
        self._constants = [float(mass), float(volume), float(shear_modulus), float(lame_lambda), float(spacing)]
        self._gravity, self._on = wp.vec3(*gravity), on

    def run(self, steps: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Go on for some steps. Returns x, v and F."""
        particles = [self._x, self._v, self._C, self._F]
        for _ in range(steps):
            self._mass.zero_()
            self._momentum.zero_()
            grid = [self._mass, self._momentum]
            wp.launch(spread, len(self._x), [*particles, *grid, *self._constants, dt], **self._on)
            wp.launch(update, self._mass.shape, [*grid, self._gravity, dt], **self._on)
            wp.launch(collect, len(self._x), [*particles, self._momentum, self._constants[-1], dt], **self._on)
        return tuple(a.numpy() for a in (self._x, self._v, self._F))
