"""MLS-MPM in Taichi, as its users write it: explicit, APIC, quadratic kernel, neo-Hookean. A peer to compare with.

The same scheme, in the same order of operations, as `mpmjax.Explicit` with the default scene: mass, momentum and stress
are spread at once (Y. Hu et al., ACM Trans. Graph. 37 (2018) 150), the grid is updated, particles collect.
"""

from typing import Any

import numpy as np
import taichi as ti


class TaichiMPM:
    """A body under gravity in a box whose walls it does not touch, above a floor.

    Args:
        x, v: positions [m] and velocities [m/s], shape (p, d).
        mass, volume: of each particle [kg], [m^d].
        shape, spacing: the grid's nodes, the first of them at the origin, and its spacing [m].
        shear_modulus, lame_lambda: of the neo-Hookean law ½μ(tr FᵀF − d − 2 ln J) + ½λ ln²J [Pa].
        gravity: [m/s²], shape (d,).
        dtype: "float32" or "float64".
        C: affine velocities at the start [1/s], shape (p, d, d). Default: none.
        floor: height of a floor without friction, which pushes and does not pull [m]. Default: none.
    """

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
        real = getattr(ti, {"float32": "f32", "float64": "f64"}[dtype])
        ti.init(arch=ti.cpu, default_fp=real, log_level=ti.ERROR, fast_math=True)
        p, d = x.shape
        identity = ti.Matrix(np.eye(d).tolist(), real)
        self._x, self._v = (ti.Vector.field(d, real, p) for _ in range(2))
        self._C, self._F = (ti.Matrix.field(d, d, real, p) for _ in range(2))
        self._momentum, self._mass = ti.Vector.field(d, real, shape), ti.field(real, shape)
        start = x, v, np.zeros((p, d, d)) if C is None else C, np.broadcast_to(np.eye(d), (p, d, d))
        self._start = [a.astype(dtype) for a in start]
        self.restart()
        lowest = -1 if floor is None else round(floor / spacing)
        dx, inv_dx, g = float(spacing), 1 / float(spacing), ti.Vector(list(gravity))
        m, volume0, mu, lam = float(mass), float(volume), float(shear_modulus), float(lame_lambda)

        @ti.kernel
        def scatter(dt: real):
            for q in self._x:
                base = (self._x[q] * inv_dx - 0.5).cast(int)
                f = self._x[q] * inv_dx - base.cast(real)
                w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
                F = self._F[q]
                J = F.determinant()
                tau = mu * (F @ F.transpose()) + (lam * ti.log(J) - mu) * identity
                affine = m * self._C[q] - (4 * dt * volume0 * inv_dx * inv_dx) * tau
                for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * d)))):
                    arm = (offset.cast(real) - f) * dx
                    weight = real(1.0)
                    for a in ti.static(range(d)):
                        weight *= w[offset[a]][a]
                    self._momentum[base + offset] += weight * (m * self._v[q] + affine @ arm)
                    self._mass[base + offset] += weight * m

        @ti.kernel
        def update(dt: real):
            for i in ti.grouped(self._mass):
                if self._mass[i] > 0:
                    velocity = self._momentum[i] / self._mass[i] + dt * g
                    if i[d - 1] <= lowest:
                        velocity[d - 1] = ti.max(velocity[d - 1], 0)
                    self._momentum[i] = velocity

        @ti.kernel
        def gather(dt: real):
            for q in self._x:
                base = (self._x[q] * inv_dx - 0.5).cast(int)
                f = self._x[q] * inv_dx - base.cast(real)
                w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
                v, C = ti.Vector.zero(real, d), ti.Matrix.zero(real, d, d)
                for offset in ti.static(ti.grouped(ti.ndrange(*((3,) * d)))):
                    arm = offset.cast(real) - f
                    weight = real(1.0)
                    for a in ti.static(range(d)):
                        weight *= w[offset[a]][a]
                    node = self._momentum[base + offset]
                    v += weight * node
                    C += 4 * inv_dx * weight * node.outer_product(arm)
                self._v[q], self._C[q] = v, C
                self._x[q] += dt * v
                self._F[q] = (identity + dt * C) @ self._F[q]

        self._kernels = scatter, update, gather

    def restart(self) -> None:
        """Back to the initial state."""
        for field, values in zip((self._x, self._v, self._C, self._F), self._start, strict=True):
            field.from_numpy(values)

    def run(self, steps: int, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Go on for some steps. Returns x, v and F."""
        scatter, update, gather = self._kernels
        for _ in range(steps):
            self._momentum.fill(0)
            self._mass.fill(0)
            scatter(dt)
            update(dt)
            gather(dt)
        ti.sync()
        state: tuple[Any, ...] = tuple(a.to_numpy() for a in (self._x, self._v, self._F))
        return state
