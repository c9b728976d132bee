"""The derivative of an MLS-MPM rollout by Taichi's tape, as its users write it: every step's state in a field of its
own. A peer to compare gradients with; the scheme is that of `TaichiMPM`."""

import numpy as np
import taichi as ti


class TaichiGradient:
    """The mean of ‖x‖² over a free body's particles after some explicit steps, and its derivative by a factor of both
    moduli.

    Args:
        x, v: positions [m] and velocities [m/s], shape (p, 2).
        mass, volume: of each particle [kg], [m²].
        shape, spacing: the grid's nodes, the first of them at the origin, and its spacing [m].
        shear_modulus, lame_lambda: of the neo-Hookean law ½μ(tr FᵀF − d − 2 ln J) + ½λ ln²J [Pa].
        gravity: [m/s²], shape (2,).
        steps, dt: how many steps of what length [s].
        dtype: "float32" or "float64".
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
        steps: int,
        dt: float,
        dtype: str,
    ):
        real = getattr(ti, {"float32": "f32", "float64": "f64"}[dtype])
        ti.init(arch=ti.cpu, default_fp=real, log_level=ti.ERROR, fast_math=True)
        p, d = x.shape
        self._steps = steps
        self._x, self._v = (ti.Vector.field(d, real, (steps + 1, p), needs_grad=True) for _ in range(2))
        self._C, self._F = (ti.Matrix.field(d, d, real, (steps + 1, p), needs_grad=True) for _ in range(2))
        self._momentum, self._velocity = (ti.Vector.field(d, real, (steps, *shape), needs_grad=True) for _ in range(2))
        self._mass = ti.field(real, (steps, *shape), needs_grad=True)
        self._scale, self._loss = (ti.field(real, (), needs_grad=True) for _ in range(2))
        self._scale[None] = 1
        dx, inv_dx, g = float(spacing), 1 / float(spacing), [float(a) for a in gravity]
        m, volume0, mu, lam = float(mass), float(volume), float(shear_modulus), float(lame_lambda)
        x0, v0 = ti.Vector.field(d, real, p), ti.Vector.field(d, real, p)
        x0.from_numpy(x.astype(dtype))
        v0.from_numpy(v.astype(dtype))

        @ti.kernel
        def start():
            for q in range(p):
                self._x[0, q], self._v[0, q] = x0[q], v0[q]
                self._C[0, q], self._F[0, q] = ti.Matrix.zero(real, d, d), ti.Matrix.identity(real, d)

        @ti.kernel
        def scatter(n: int):
            for q in range(p):
                base = (self._x[n, q] * inv_dx - 0.5).cast(int)
                f = self._x[n, q] * inv_dx - base.cast(real)
                w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
                F = self._F[n, q]
                J = F.determinant()
                tau = self._scale[None] * (
                    mu * (F @ F.transpose()) + (lam * ti.log(J) - mu) * ti.Matrix.identity(real, d)
                )
                affine = m * self._C[n, q] - (4 * dt * volume0 * inv_dx * inv_dx) * tau
                for i, j in ti.static(ti.ndrange(3, 3)):
                    offset = ti.Vector([i, j])
                    weight = w[i][0] * w[j][1]
                    arm = (offset.cast(real) - f) * dx
                    self._momentum[n, base + offset] += weight * (m * self._v[n, q] + affine @ arm)
                    self._mass[n, base + offset] += weight * m

        @ti.kernel
        def update(n: int):
            for i, j in ti.ndrange(*shape):
                if self._mass[n, i, j] > 0:
                    self._velocity[n, i, j] = self._momentum[n, i, j] / self._mass[n, i, j] + dt * ti.Vector(g)

        @ti.kernel
        def gather(n: int):
            for q in range(p):
                base = (self._x[n, q] * inv_dx - 0.5).cast(int)
                f = self._x[n, q] * inv_dx - base.cast(real)
                w = [0.5 * (1.5 - f) ** 2, 0.75 - (f - 1) ** 2, 0.5 * (f - 0.5) ** 2]
                v, C = ti.Vector.zero(real, d), ti.Matrix.zero(real, d, d)
                for i, j in ti.static(ti.ndrange(3, 3)):
                    offset = ti.Vector([i, j])
                    weight = w[i][0] * w[j][1]
                    node = self._velocity[n, base + offset]
                    v += weight * node
                    C += 4 * inv_dx * weight * node.outer_product(offset.cast(real) - f)
                self._v[n + 1, q], self._C[n + 1, q] = v, C
                self._x[n + 1, q] = self._x[n, q] + dt * v
                self._F[n + 1, q] = (ti.Matrix.identity(real, d) + dt * C) @ self._F[n, q]

        @ti.kernel
        def size():
            for q in range(p):
                self._loss[None] += self._x[steps, q].norm_sqr() / p

        self._kernels = start, scatter, update, gather, size

    def forward(self) -> float:
        """The mean of ‖x‖² [m²]."""
        self._clear()
        self._run()
        return self._loss[None]

    def gradient(self) -> tuple[float, float]:
        """The same and its derivative."""
        self._clear()
        with ti.ad.Tape(self._loss):
            self._run()
        return self._loss[None], self._scale.grad[None]

    def _clear(self) -> None:
        for field in (self._momentum, self._mass, self._velocity, self._loss):
            field.fill(0)

    def _run(self) -> None:
        start, scatter, update, gather, size = self._kernels
        start()
        for n in range(self._steps):
            scatter(n)
            update(n)
            gather(n)
        size()

    def bytes(self) -> int:
        """Memory of all fields and their adjoints [B]."""
        number = {ti.f32: 4, ti.f64: 8}[self._x.dtype]
        d, (rows, p), nodes = 2, self._x.shape, int(np.prod(self._mass.shape))
        return 2 * number * (rows * p * (2 * d + 2 * d * d) + nodes * (2 * d + 1))
