"""The principal frame of small matrices: eigenvalues and eigenvectors, signed singular values."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.core import ShapedArray

from mpmjax._types import Array, Float, Matrix
from mpmjax.autodiff import ruled
from mpmjax.linalg._matrices import assemble, entries, identity_like, matmul, transpose
from mpmjax.linalg._rotation import matrices_fit, rotation
from mpmjax.native import native_primitive

_SWEEPS = {1: 0, 2: 1, 3: 4}  # by dimension: in 2-D one rotation is the closed form; 3-D converges quadratically


def symmetric_eigen(S: Matrix) -> tuple[Array, Matrix]:
    """The eigenvalues w of a symmetric matrix, in no order, and a rotation V of eigenvectors: S = V diag(w) Vᵀ.

    Jacobi's cyclic method (G. H. Golub, C. F. Van Loan, Matrix Computations, 4th ed., 2013, section 8.5), which in 2-D
    is one exact rotation. All eigenvalues are accurate to rounding of ‖S‖, repeated ones too. Only the upper triangle
    is read.

    *When it breaks*: it must not be differentiated, since V is not differentiable where eigenvalues coincide; in 3-D
    JAX refuses.

    Args:
        S: shape (d, d, *batch).

    Returns:
        w, shape (d, *batch), and V, shape (d, d, *batch), det V = +1.
    """
    if len(S) != 3:
        w, V = _jacobi(S)
    else:
        w, V = _eigen_p.bind(S.reshape(3, 3, -1), batched=0)
    return w.reshape(S.shape[1:]), V.reshape(S.shape)


def _jacobi(S: Matrix, *, unroll: bool = False) -> list[Array]:
    del unroll  # a sweep is many operations
    d = len(S)

    def sweep(_: Array | int, state: tuple[Matrix, Matrix]) -> tuple[Matrix, Matrix]:
        A, V = map(entries, state)
        for p, q in pairs(d):
            gap, twice = A[q][q] - A[p][p], 2 * A[p][q]
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
        return assemble(A), assemble(V)

    A, V = jax.lax.fori_loop(0, _SWEEPS[d], sweep, (S, identity_like(S)))
    return [jnp.stack([A[i, i] for i in range(d)]), V]


def _values_and_vectors(S: ShapedArray) -> list[tuple]:
    return [S.shape[-2:], S.shape[-3:]]


_eigen_p = native_primitive("matrix_eigen", _jacobi, _values_and_vectors, matrices_fit, like=0)


def pairs(d: int) -> list[tuple[int, int]]:
    """The d (d − 1)/2 pairs of directions i < j, in the order of arrays over pairs: (0, 1), (0, 2), (1, 2)."""
    return [(i, j) for i in range(d) for j in range(i + 1, d)]


@ruled
def principal_frame(F: Matrix) -> tuple[Matrix, Array, Matrix]:
    """F = U diag(s) Vᵀ with rotations U and V: the singular value decomposition with signed stretches.

    V are the eigenvectors of S = RᵀF with R = `rotation(F)`, and U = R V. If det F < 0, the stretch that is smallest in
    magnitude is negative, so that s_i + s_j ≥ 0 for i ≠ j. The stretches have no order. In 1-D U = V = 1 and s = F.

    *When it breaks*: differentiating it raises, since the frame is not unique where stretches coincide, as at F = I. An
    isotropic function of F has a derivative there nevertheless: give that function a derivative rule of its own, in
    terms of this frame.

    Args:
        F: shape (d, d, *batch).

    Returns:
        U, shape (d, d, *batch), s, shape (d, *batch), and V, shape (d, d, *batch).
    """
    R = rotation(F)
    S = matmul(transpose(R), F)
    s, V = symmetric_eigen((S + transpose(S)) / 2)
    return matmul(R, V), s, V


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


@principal_frame.defjvp
def _principal_frame_jvp(primals: Any, tangents: Any) -> Any:
    raise NotImplementedError(
        "The principal frame U, s, V of F has no derivative where stretches coincide, and is not differentiated: what "
        "is built on it has a rule for its first derivative, and no second one. With a projected Hessian take first "
        "derivatives only, or use AnalyticHessian() without projection."
    )
