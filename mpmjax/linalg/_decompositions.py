"""Decompositions of small matrices: eigenvalues and eigenvectors, the polar decomposition, signed singular values."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

import mpmjax.linalg._matrices as la
from mpmjax._types import Array, Compliance, Float, Matrix
from mpmjax.autodiff import custom_derivative

_SWEEPS = {1: 0, 2: 1, 3: 4}  # by dimension: in 2-D one rotation is the closed form; 3-D converges quadratically
_NEWTON_STEPS = 30  # on the quartic of the 3-D rotation: halves the error at a double root, else squares it
_POLISH_STEPS = 2  # on the rotation itself


def pairs(d: int) -> list[tuple[int, int]]:
    """The d (d − 1)/2 pairs of directions i < j, in the order of arrays over pairs: (0, 1), (0, 2), (1, 2)."""
    return [(i, j) for i in range(d) for j in range(i + 1, d)]


def symmetric_eigen(S: Matrix) -> tuple[Array, Matrix]:
    """The eigenvalues w of a symmetric matrix, in no order, and a rotation V of eigenvectors: S = V diag(w) Vᵀ.

    Jacobi's cyclic method (G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, section 8.5), which in 2-D
    is one exact rotation. All eigenvalues are accurate to rounding of ‖S‖, repeated ones too. Only the upper triangle
    is read.

    *When it breaks*: it must not be differentiated, since V is not differentiable where eigenvalues coincide; in 3-D
    JAX refuses.

    S and V have shape (d, d, *batch), w has shape (d, *batch); det V = +1.
    """
    if len(S) != 3:
        w, V = _jacobi(S)
    else:
        w, V = _eigen_3d(S.reshape(3, 3, -1))
    return w.reshape(S.shape[1:]), V.reshape(S.shape)


def _jacobi(S: Matrix) -> tuple[Array, Matrix]:
    d = len(S)

    def sweep(_: Array | int, state: tuple[Matrix, Matrix]) -> tuple[Matrix, Matrix]:
        A, V = map(la.entries, state)
        for p, q in pairs(d):
            gap, twice = A[q][q] - A[p][p], 2 * A[p][q]
            # the smaller of the two angles, below 45 degrees, with which sweeps converge; its quotient cancels nowhere
            scale = jnp.abs(gap) + jnp.hypot(gap, twice)
            tan = jnp.where(gap < 0, -twice, twice) / jnp.where(scale == 0, 1, scale)
            cos = 1 / jnp.sqrt(1 + tan * tan)
            sin = tan * cos
            A[p][p], A[q][q] = A[p][p] - tan * A[p][q], A[q][q] + tan * A[p][q]
            A[p][q] = jnp.zeros_like(gap)
            for r in set(range(d)) - {p, q}:
                (a, b), (e, f) = sorted((r, p)), sorted((r, q))
                A[a][b], A[e][f] = cos * A[a][b] - sin * A[e][f], sin * A[a][b] + cos * A[e][f]
            for row in V:
                row[p], row[q] = cos * row[p] - sin * row[q], sin * row[p] + cos * row[q]
        return la.assemble(A), la.assemble(V)

    A, V = jax.lax.fori_loop(0, _SWEEPS[d], sweep, (S, la.identity_like(S)))
    return jnp.stack([A[i, i] for i in range(d)]), V


_eigen_3d = custom_derivative(
    _jacobi, kernel="eigen", results=lambda S: (jax.ShapeDtypeStruct(S.shape[1:], S.dtype), S)
)


@custom_derivative
def rotation(F: Matrix) -> Matrix:
    """The rotation R of the polar decomposition F = R S, with det R = +1.

    R maximises tr(RᵀF) over the rotations. S = RᵀF is symmetric. If det F < 0 it is indefinite, with its smallest
    principal stretch negative. In 1-D R = 1.

    In 2-D R is in closed form. In 3-D λ = tr S is the largest root of (λ² − ‖F‖²)² − 8 det(F) λ − 4 ‖cof F‖², the
    characteristic polynomial of a symmetric 4 x 4 matrix K linear in F, whose eigenvector is the quaternion of R
    (N. J. Higham, V. Noferini, Numer. Algorithms 73 (2016) 349, doi 10.1007/s11075-016-0098-7). λ is found by Newton's
    method, and the quaternion as a column of adj(K − λI), which Newton steps of the derivation's eq. 12 refine. It is
    normalised, so the result is a rotation to rounding for every F.

    The derivative is `rotation_differential`, not that of the iterations. It is finite at F = I and at repeated
    stretches, to every order.

    *When it breaks*: where two signed principal stretches sum to zero, R is not unique, and one of the maximisers is
    returned. Near there the error grows like rounding over that sum, and the derivative like its inverse.

    F and R have shape (d, d, *batch).
    """
    match F.shape[0]:
        case 1:
            return jnp.ones_like(F)
        case 2:
            return _rotation_2d(F)
        case _:
            return _rotation_3d(F.reshape(3, 3, -1)).reshape(F.shape)


@rotation.defjvp
def _rotation_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    (F,), (dF,) = primals, tangents
    R = rotation(F)
    return R, rotation_differential(R, spin_compliance(la.matmul(la.transpose(R), F)), dF)


def spin_compliance(S: Matrix) -> Compliance:
    """(tr(S) I − S)⁻¹, which maps the vector of RᵀδF − δFᵀR to the spin ω of `rotation_differential` (derivation,
    eq. 12).

    S is the stretch RᵀF, shape (d, d, *batch), the result of shape (3, 3, *batch) in 3-D; 1/tr S, shape
    (1, 1, *batch), in 2-D; zero, shape (1, 1, *batch), in 1-D, where nothing rotates.
    """
    match S.shape[0]:
        case 1:
            return jnp.zeros_like(S)
        case 2:
            return (1 / la.trace(S))[None, None]
        case _:
            system = la.trace(S) * la.identity_like(S) - S
            return la.transpose(la.cofactor(system)) / la.determinant(system)


def rotation_differential(R: Matrix, compliance: Compliance, dF: Matrix) -> Matrix:
    """δR = R [ω]ₓ with (tr(S) I − S) ω = vee(RᵀδF − δFᵀR) (derivation, eq. 12), by the rotation R of F, its
    `spin_compliance(RᵀF)` and δF, shape (d, d, *batch)."""
    d = R.shape[0]
    if d == 1:
        return jnp.zeros_like(dF)
    if d == 2:
        V, r = la.entries(la.matmul(la.transpose(R), dF)), la.entries(R)
        omega = compliance[0, 0] * (V[1][0] - V[0][1])
        return omega * la.assemble([[r[0][1], -r[0][0]], [r[1][1], -r[1][0]]])
    x, y, z = _spin(R, compliance, dF)
    zero = jnp.zeros_like(x)
    return la.matmul(R, la.assemble([[zero, -z, y], [z, zero, -x], [-y, x, zero]]))


def _spin(R: Matrix, compliance: Compliance, dF: Matrix) -> tuple[Array, Array, Array]:
    """ω in 3-D."""
    V = la.entries(la.matmul(la.transpose(R), dF))
    v = (V[2][1] - V[1][2], V[0][2] - V[2][0], V[1][0] - V[0][1])
    x, y, z = (la.dot(row, v) for row in la.entries(compliance))
    return x, y, z


def _rotation_2d(F: Matrix) -> Matrix:
    (a, b), (c, d) = la.entries(F)
    cos, sin = a + d, c - b
    unit = jnp.hypot(cos, sin)
    singular = unit == 0
    cos = jnp.where(singular, 1, cos) / jnp.where(singular, 1, unit)
    sin = sin / jnp.where(singular, 1, unit)
    return la.assemble([[cos, -sin], [sin, cos]])


@partial(custom_derivative, kernel="rotation", results=lambda F: F)
def _rotation_3d(F: Matrix) -> Matrix:
    size = jnp.sqrt(la.double_dot(F, F))
    F = F / jnp.where(size == 0, 1, size)  # ‖F‖ = 1 from here on
    q = _dominant_quaternion(F, _largest_root(F))
    for _ in range(_POLISH_STEPS):
        R = _rotation_of(q)
        x, y, z = _spin(R, spin_compliance(la.matmul(la.transpose(R), F)), F)
        near = x * x + y * y + z * z < 0.1  # not where R is hardly determined
        a, b, c, d = q
        # the quaternion product of q with (0, ω)
        turned = [-b * x - c * y - d * z, a * x + c * z - d * y, a * y + d * x - b * z, a * z + b * y - c * x]
        q = _normalised([old + jnp.where(near, new / 2, 0) for old, new in zip(q, turned, strict=True)])
    return _rotation_of(q)


def _largest_root(F: Matrix) -> Array:
    """tr S for ‖F‖ = 1, by Newton's method from √3 ≥ tr S, from where it falls monotonically until rounding."""
    cof = la.cofactor(F)
    J, cof2 = la.determinant(F), la.double_dot(cof, cof)

    def step(_: Array, root: Array) -> Array:
        square = root * root - 1
        slope = 4 * root * square - 8 * J
        lower = root - (square * square - 8 * J * root - 4 * cof2) / jnp.where(slope == 0, 1, slope)
        # where rounding would raise it, it has converged
        return jnp.where(lower < root, lower, root)

    return jax.lax.fori_loop(0, _NEWTON_STEPS, step, jnp.full_like(J, jnp.sqrt(3.0).astype(F.dtype)))


def _dominant_quaternion(F: Matrix, root: Array) -> list[Array]:
    """The unit quaternion that maximises tr(RᵀF) = qᵀ K q: the largest column of adj(K − λI), λ the largest root."""
    t, f = la.trace(F), la.entries(F)
    z = [f[2][1] - f[1][2], f[0][2] - f[2][0], f[1][0] - f[0][1]]
    K = [[t, *z], *([z[i], *(f[i][j] + f[j][i] - (t if i == j else 0) for j in range(3))] for i in range(3))]
    K = [[K[i][j] - (root if i == j else 0) for j in range(4)] for i in range(4)]

    def signed_minor(i: int, j: int) -> Array:
        rows, columns = ([k for k in range(4) if k != skip] for skip in (i, j))
        minor = [[K[r][c] for c in columns] for r in rows]
        return (-1) ** (i + j) * la.dot(minor[0], la.cofactors(minor)[0])

    # every column is a multiple of the eigenvector: the one of the largest entry is not made of rounding
    upper = {(i, j): signed_minor(i, j) for i in range(4) for j in range(i, 4)}
    columns = [[upper[min(i, j), max(i, j)] for i in range(4)] for j in range(4)]
    best, size = columns[0], jnp.abs(columns[0][0])
    for j in range(1, 4):
        larger = jnp.abs(columns[j][j]) > size
        best = [jnp.where(larger, a, b) for a, b in zip(columns[j], best, strict=True)]
        size = jnp.where(larger, jnp.abs(columns[j][j]), size)
    return _normalised(best)


def _normalised(q: list[Array]) -> list[Array]:
    """q / ‖q‖, and the identity for q = 0."""
    size = jnp.sqrt(sum((a * a for a in q[1:]), q[0] * q[0]))
    nothing = size == 0
    w, *rest = (a / jnp.where(nothing, 1, size) for a in q)
    return [jnp.where(nothing, 1, w), *rest]


def _rotation_of(q: list[Array]) -> Matrix:
    """The rotation of a unit quaternion."""
    w, x, y, z = q
    return la.assemble(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@custom_derivative
def principal_frame(F: Matrix) -> tuple[Matrix, Array, Matrix]:
    """F = U diag(s) Vᵀ with rotations U and V: the singular value decomposition with signed stretches.

    V are the eigenvectors of S = RᵀF with R = `rotation(F)`, and U = R V. If det F < 0, the stretch that is smallest in
    magnitude is negative, so that s_i + s_j ≥ 0 for i ≠ j. The stretches have no order. In 1-D U = V = 1 and s = F.

    *When it breaks*: differentiating it raises, since the frame is not unique where stretches coincide, as at F = I. An
    isotropic function of F has a derivative there nevertheless: give that function a derivative rule of its own, in
    terms of this frame.

    F, U and V have shape (d, d, *batch), s has shape (d, *batch).
    """
    R = rotation(F)
    S = la.matmul(la.transpose(R), F)
    s, V = symmetric_eigen((S + la.transpose(S)) / 2)
    return la.matmul(R, V), s, V


@principal_frame.defjvp
def _principal_frame_jvp(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError(
        "The principal frame U, s, V of F has no derivative where stretches coincide, and is not differentiated: what "
        "is built on it has a rule for its first derivative, and no second one. With a projected Hessian take first "
        "derivatives only, or use AnalyticHessian() without projection."
    )


def principal_modes(U: Matrix, V: Matrix) -> Float[Array, "m d d *p"]:
    """An orthonormal basis of the d x d matrices in a frame: scalings, twists, flips, shape (d², d, d, *batch).

    With u_i, v_j the columns of U and V: u_i v_iᵀ for each direction, then (u_i v_jᵀ − u_j v_iᵀ)/√2 for each pair
    i < j, then (u_i v_jᵀ + u_j v_iᵀ)/√2.
    """
    d = U.shape[0]
    half = jnp.sqrt(0.5).astype(U.dtype)
    outer = {(i, j): U[:, None, i] * V[None, :, j] for i in range(d) for j in range(d)}
    twists = [half * (outer[i, j] - outer[j, i]) for i, j in pairs(d)]
    flips = [half * (outer[i, j] + outer[j, i]) for i, j in pairs(d)]
    return jnp.stack([*(outer[i, i] for i in range(d)), *twists, *flips])
