"""MLS-MPM in Warp, as its users write it: explicit, APIC, quadratic kernel, neo-Hookean. A peer to compare with.

The same scheme, in the same order of operations, as `mpmjax.Explicit` with the default scene; see `taichi_mpm.py`.
Two or three dimensions, float32 alone; Warp's CPU back end runs on one thread.
"""

from functools import cache

import numpy as np
import warp as wp


@cache
def kernels(d: int) -> tuple[wp.Kernel, wp.Kernel, wp.Kernel]:
    """P2G of mass, momentum and stress at once, the grid's update, G2P, in d dimensions."""
    vec, mat = wp.types.vector(length=d, dtype=float), wp.types.matrix(shape=(d, d), dtype=float)
    table = wp.types.matrix(shape=(3, d), dtype=float)
    scalars, vectors = wp.array(dtype=float, ndim=d), wp.array(dtype=vec, ndim=d)

    @wp.func
    def place(xi: vec):
        """The first node of the stencil, as floats."""
        for a in range(wp.static(d)):
            xi[a] = wp.floor(xi[a] - 0.5)
        return xi

    @wp.func
    def weights(f: vec):
        """Rows: the three nodes' weights in each direction."""
        w = table()
        for a in range(wp.static(d)):
            w[0, a] = 0.5 * (1.5 - f[a]) * (1.5 - f[a])
            w[1, a] = 0.75 - (f[a] - 1.0) * (f[a] - 1.0)
            w[2, a] = 0.5 * (f[a] - 0.5) * (f[a] - 0.5)
        return w

    if d == 2:

        @wp.func
        def to_nodes(mass: scalars, momentum: vectors, base: vec, f: vec, m: float, p: vec, affine: mat, dx: float):
            """Mass and momentum to the nodes."""
            w, i, j = weights(f), int(base[0]), int(base[1])
            for a in range(3):
                for c in range(3):
                    weight = w[a, 0] * w[c, 1]
                    arm = (vec(float(a), float(c)) - f) * dx
                    wp.atomic_add(momentum, i + a, j + c, weight * (p + affine * arm))
                    wp.atomic_add(mass, i + a, j + c, weight * m)

        @wp.func
        def from_nodes(velocity: vectors, base: vec, f: vec):
            """Velocity from the nodes, and its product with the arms."""
            w, i, j = weights(f), int(base[0]), int(base[1])
            new, gradient = vec(), mat()
            for a in range(3):
                for c in range(3):
                    node = (w[a, 0] * w[c, 1]) * velocity[i + a, j + c]
                    new += node
                    gradient += wp.outer(node, vec(float(a), float(c)) - f)
            return new, gradient

        @wp.kernel
        def update(mass: scalars, momentum: vectors, gravity: vec, dt: float, floor: int):
            """The grid's velocity, in the place of its momentum."""
            i, j = wp.tid()
            if mass[i, j] > 0.0:
                v = momentum[i, j] / mass[i, j] + dt * gravity
                if j <= floor:
                    v[1] = wp.max(v[1], 0.0)
                momentum[i, j] = v

    else:

        @wp.func
        def to_nodes(mass: scalars, momentum: vectors, base: vec, f: vec, m: float, p: vec, affine: mat, dx: float):
            """Mass and momentum to the nodes."""
            w, i, j, k = weights(f), int(base[0]), int(base[1]), int(base[2])
            for a in range(3):
                for c in range(3):
                    for e in range(3):
                        weight = w[a, 0] * w[c, 1] * w[e, 2]
                        arm = (vec(float(a), float(c), float(e)) - f) * dx
                        wp.atomic_add(momentum, i + a, j + c, k + e, weight * (p + affine * arm))
                        wp.atomic_add(mass, i + a, j + c, k + e, weight * m)

        @wp.func
        def from_nodes(velocity: vectors, base: vec, f: vec):
            """Velocity from the nodes, and its product with the arms."""
            w, i, j, k = weights(f), int(base[0]), int(base[1]), int(base[2])
            new, gradient = vec(), mat()
            for a in range(3):
                for c in range(3):
                    for e in range(3):
                        node = (w[a, 0] * w[c, 1] * w[e, 2]) * velocity[i + a, j + c, k + e]
                        new += node
                        gradient += wp.outer(node, vec(float(a), float(c), float(e)) - f)
            return new, gradient

        @wp.kernel
        def update(mass: scalars, momentum: vectors, gravity: vec, dt: float, floor: int):
            """The grid's velocity, in the place of its momentum."""
            i, j, k = wp.tid()
            if mass[i, j, k] > 0.0:
                v = momentum[i, j, k] / mass[i, j, k] + dt * gravity
                if k <= floor:
                    v[2] = wp.max(v[2], 0.0)
                momentum[i, j, k] = v

    @wp.kernel
    def scatter(
        x: wp.array(dtype=vec),
        v: wp.array(dtype=vec),
        C: wp.array(dtype=mat),
        F: wp.array(dtype=mat),
        mass: scalars,
        momentum: vectors,
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
        base = place(x[q] * inv_dx)
        b = F[q] * wp.transpose(F[q])
        tau = mu * b + (lam * wp.log(wp.determinant(F[q])) - mu) * wp.identity(n=wp.static(d), dtype=float)
        affine = m * C[q] - (4.0 * dt * volume * inv_dx * inv_dx) * tau
        to_nodes(mass, momentum, base, x[q] * inv_dx - base, m, m * v[q], affine, dx)

    @wp.kernel
    def gather(
        x: wp.array(dtype=vec),
        v: wp.array(dtype=vec),
        C: wp.array(dtype=mat),
        F: wp.array(dtype=mat),
        velocity: vectors,
        dx: float,
        dt: float,
    ):
        """G2P."""
        q = wp.tid()
        inv_dx = 1.0 / dx
        base = place(x[q] * inv_dx)
        new, gradient = from_nodes(velocity, base, x[q] * inv_dx - base)
        gradient = 4.0 * inv_dx * gradient
        v[q] = new
        C[q] = gradient
        x[q] = x[q] + dt * new
        F[q] = F[q] + dt * gradient * F[q]

    return scatter, update, gather


class WarpMPM:
    """A body under gravity in a box whose walls it does not touch, above a floor; arguments as `TaichiMPM`'s."""

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
        C: np.ndarray | None = None,
        floor: float | None = None,
    ):
        if dtype != "float32":
            raise ValueError(f"This peer is written for float32, got {dtype}.")
        wp.config.quiet = True
        wp.init()
        p, d = x.shape
        vec, mat = wp.types.vector(length=d, dtype=float), wp.types.matrix(shape=(d, d), dtype=float)
        self._start = [x, v, np.zeros((p, d, d)) if C is None else C, np.broadcast_to(np.eye(d), (p, d, d))]
        self._particles = [wp.zeros(p, dtype=kind, device="cpu") for kind in (vec, vec, mat, mat)]
        self._grid = [wp.zeros(shape, dtype=kind, device="cpu") for kind in (float, vec)]
        self._constants = [float(mass), float(volume), float(shear_modulus), float(lame_lambda), float(spacing)]
        self._gravity, self._floor = vec(*gravity), -1 if floor is None else round(floor / spacing)
        self._kernels = kernels(d)
        self.restart()

    def restart(self) -> None:
        """Back to the initial state."""
        for field, values in zip(self._particles, self._start, strict=True):
            field.assign(np.ascontiguousarray(values, dtype="float32"))

    def run(self, steps: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Go on for some steps. Returns x, v and F."""
        scatter, update, gather = self._kernels
        particles, (mass, momentum), spacing = self._particles, self._grid, self._constants[-1]
        for _ in range(steps):
            mass.zero_()
            momentum.zero_()
            wp.launch(scatter, particles[0].shape, [*particles, *self._grid, *self._constants, dt], device="cpu")
            wp.launch(update, mass.shape, [*self._grid, self._gravity, dt, self._floor], device="cpu")
            wp.launch(gather, particles[0].shape, [*particles, momentum, spacing, dt], device="cpu")
        x, v, _, F = (a.numpy().copy() for a in particles)
        return x, v, F
