"""The derivative of an MLS-MPM rollout by Warp's tape, as its users write it: every step's state in arrays of its own.
A peer to compare gradients with; the scheme is that of `WarpMPM`, in two dimensions."""

import numpy as np
import warp as wp

vec, mat, table = wp.vec2, wp.mat22, wp.types.matrix(shape=(3, 2), dtype=float)
scalars, vectors = wp.array2d(dtype=float), wp.array2d(dtype=vec)


@wp.func
def place(xi: vec):
    """The first node of the stencil, as floats."""
    return vec(wp.floor(xi[0] - 0.5), wp.floor(xi[1] - 0.5))


@wp.func
def weights(f: vec):
    """Rows: the three nodes' weights in each direction."""
    left, middle, right = vec(1.5, 1.5) - f, f - vec(1.0, 1.0), f - vec(0.5, 0.5)
    low, high = 0.5 * wp.cw_mul(left, left), 0.5 * wp.cw_mul(right, right)
    centre = vec(0.75, 0.75) - wp.cw_mul(middle, middle)
    return table(low[0], low[1], centre[0], centre[1], high[0], high[1])


@wp.kernel
def scatter(
    x: wp.array(dtype=vec),
    v: wp.array(dtype=vec),
    C: wp.array(dtype=mat),
    F: wp.array(dtype=mat),
    scale: wp.array(dtype=float),
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
    f = x[q] * inv_dx - base
    w, i, j = weights(f), int(base[0]), int(base[1])
    tau = mu * F[q] * wp.transpose(F[q]) + (lam * wp.log(wp.determinant(F[q])) - mu) * wp.identity(n=2, dtype=float)
    affine = m * C[q] - (4.0 * dt * volume * inv_dx * inv_dx * scale[0]) * tau
    for a in range(3):
        for c in range(3):
            weight = w[a, 0] * w[c, 1]
            arm = (vec(float(a), float(c)) - f) * dx
            wp.atomic_add(momentum, i + a, j + c, weight * (m * v[q] + affine * arm))
            wp.atomic_add(mass, i + a, j + c, weight * m)


@wp.kernel
def update(mass: scalars, momentum: vectors, velocity: vectors, gravity: vec, dt: float):
    """The grid's velocity."""
    i, j = wp.tid()
    if mass[i, j] > 0.0:
        velocity[i, j] = momentum[i, j] / mass[i, j] + dt * gravity


@wp.kernel
def gather(
    x: wp.array(dtype=vec),
    F: wp.array(dtype=mat),
    velocity: vectors,
    new_x: wp.array(dtype=vec),
    new_v: wp.array(dtype=vec),
    new_C: wp.array(dtype=mat),
    new_F: wp.array(dtype=mat),
    dx: float,
    dt: float,
):
    """G2P."""
    q = wp.tid()
    inv_dx = 1.0 / dx
    base = place(x[q] * inv_dx)
    f = x[q] * inv_dx - base
    w, i, j = weights(f), int(base[0]), int(base[1])
    new, gradient = vec(), mat()
    for a in range(3):
        for c in range(3):
            node = (w[a, 0] * w[c, 1]) * velocity[i + a, j + c]
            new += node
            gradient += (4.0 * inv_dx) * wp.outer(node, vec(float(a), float(c)) - f)
    new_v[q] = new
    new_C[q] = gradient
    new_x[q] = x[q] + dt * new
    new_F[q] = F[q] + dt * gradient * F[q]


@wp.kernel
def size(x: wp.array(dtype=vec), share: float, loss: wp.array(dtype=float)):
    """The mean of ‖x‖²."""
    wp.atomic_add(loss, 0, share * wp.dot(x[wp.tid()], x[wp.tid()]))


class WarpGradient:
    """The mean of ‖x‖² over a free body's particles after some explicit steps, and its derivative by a factor of both
    moduli; arguments as `TaichiGradient`'s, in float32 alone."""

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
        if dtype != "float32" or x.shape[1] != 2:
            raise ValueError(f"This peer is written for float32 in two dimensions, got {dtype} in {x.shape[1]}.")
        wp.config.quiet = True
        wp.init()
        p = len(x)

        def array(kind: type, extent: int | tuple[int, ...], values: np.ndarray | None = None) -> wp.array:
            found = wp.zeros(extent, dtype=kind, device="cpu", requires_grad=True)
            if values is not None:
                found.assign(np.ascontiguousarray(values, dtype="float32"))
            return found

        start = (x, v, np.zeros((p, 2, 2)), np.broadcast_to(np.eye(2), (p, 2, 2)))
        kinds = (vec, vec, mat, mat)
        self._states = [[array(kind, p, values) for kind, values in zip(kinds, start, strict=True)]]
        self._states += [[array(kind, p) for kind in kinds] for _ in range(steps)]
        self._nodes = [(array(float, shape), array(vec, shape), array(vec, shape)) for _ in range(steps)]
        self._scale, self._loss = array(float, 1, np.ones(1)), array(float, 1)
        self._constants = [
            float(mass),
            float(volume),
            float(shear_modulus),
            float(lame_lambda),
            float(spacing),
            float(dt),
        ]
        self._gravity = vec(*gravity)

    def forward(self) -> float:
        """The mean of ‖x‖² [m²]."""
        self._run()
        return float(self._loss.numpy()[0])

    def gradient(self) -> tuple[float, float]:
        """The same and its derivative."""
        tape = wp.Tape()
        with tape:
            self._run()
        tape.backward(self._loss)
        found = float(self._loss.numpy()[0]), float(self._scale.grad.numpy()[0])
        tape.zero()
        return found

    def _run(self) -> None:
        for array in (self._loss, *(a for nodes in self._nodes for a in nodes)):
            array.zero_()
        dx, dt = self._constants[-2:]
        p = self._states[0][0].shape
        for (x, v, C, F), (mass, momentum, velocity), after in zip(
            self._states[:-1], self._nodes, self._states[1:], strict=True
        ):
            wp.launch(scatter, p, [x, v, C, F, self._scale, mass, momentum, *self._constants], device="cpu")
            wp.launch(update, mass.shape, [mass, momentum, velocity, self._gravity, dt], device="cpu")
            wp.launch(gather, p, [x, F, velocity, *after, dx, dt], device="cpu")
        wp.launch(size, p, [self._states[-1][0], 1 / p[0], self._loss], device="cpu")

    def bytes(self) -> int:
        """Memory of all arrays and their adjoints [B]."""
        arrays = [a for group in (*self._states, *self._nodes) for a in group]
        return 2 * sum(a.capacity for a in arrays)
