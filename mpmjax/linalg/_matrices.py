"""Small-matrix algebra by components: products, determinant, cofactor.

Every matrix has shape (d, d, *batch), d = 1, 2 or 3. With the matrix axes first, XLA sees elementwise arithmetic over
the batch. On a CPU that is some twenty times faster than batched LAPACK or tiny `dot_general`s, and its derivatives are
as cheap. A product is one multiplication and one sum over an axis, which XLA vectorises; it would not vectorise a
product by components, and an explicit step would take a tenth to a third longer. Other expressions are unrolled over
the components. `entries` splits a matrix in one operation, since in reverse mode each indexed component would be added
to a whole matrix of zeros. `assemble` stacks row by row, since XLA does not fuse one stack of nine components with
their computation, which doubles the time of a Hessian's action.
"""

import math
from collections.abc import Callable, Sequence
from functools import reduce

import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Bool, Float, Matrix


def assemble(rows: list[list[Array]]) -> Matrix:
    """The matrix with components `rows[i][j]`, each of the shape of the batch."""
    return jnp.stack([jnp.stack(row) for row in rows])


def entries(A: Float[Array, "a b *p"]) -> list[list[Array]]:
    """The components of a matrix as `rows[i][j]`, each of the shape of the batch."""
    a, b, *batch = A.shape
    flat = jnp.unstack(A.reshape(a * b, *batch))
    return [list(flat[i * b : (i + 1) * b]) for i in range(a)]


def identity_like(A: Matrix) -> Matrix:
    """The identity matrix, in the shape and dtype of `A`."""
    d = A.shape[0]
    eye = jnp.eye(d, dtype=A.dtype).reshape((d, d) + (1,) * (A.ndim - 2))
    return jnp.broadcast_to(eye, A.shape)


def diagonal(s: Float[Array, "m *p"]) -> Float[Array, "m m *p"]:
    """The diagonal matrix of s, shape (m, m, *batch) from (m, *batch)."""
    return s * jnp.eye(len(s), dtype=s.dtype).reshape((len(s), len(s)) + (1,) * (s.ndim - 1))


def transpose(A: Matrix) -> Matrix:
    """Aᵀ."""
    return jnp.swapaxes(A, 0, 1)


def matmul(A: Float[Array, "a k *p"], B: Float[Array, "k b *p"]) -> Float[Array, "a b *p"]:
    """The product A B of matrices of any sizes."""
    return (A[:, :, None] * B[None]).sum(axis=1)


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    """The sum of the products of two lists of components."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def matrix_of(linear: Callable[[Matrix], Matrix], like: Matrix) -> Float[Array, "m m *p"]:
    """The matrix of a symmetric linear map between matrices of the shape (d, d, *p) of `like`, on their d² components
    in C order, shape (d², d², *p). Row m, which equals column m, is the image of the m-th unit matrix."""
    d, batch = like.shape[0], like.shape[2:]
    units = jnp.eye(d * d, dtype=like.dtype).reshape(d * d, d, d, *[1] * len(batch))
    return jax.vmap(lambda unit: linear(jnp.broadcast_to(unit, like.shape)))(units).reshape(d * d, d * d, *batch)


def upper_triangle(A: Float[Array, "m m *p"]) -> Float[Array, "t *p"]:
    """The upper triangle of a symmetric matrix, row by row: its m(m+1)/2 different components."""
    return A[np.triu_indices(len(A))]


def symmetric(upper: Float[Array, "t *p"]) -> Float[Array, "m m *p"]:
    """The symmetric matrix with this upper triangle."""
    m = (math.isqrt(8 * len(upper) + 1) - 1) // 2
    place = np.zeros((m, m), int)
    place[np.triu_indices(m)] = np.arange(len(upper))
    return upper[np.maximum(place, place.T)]


def trace(A: Matrix) -> Array:
    """tr A, shape (*batch)."""
    first, *others = (row[i] for i, row in enumerate(entries(A)))
    return sum(others, first)


def double_dot(A: Float[Array, "a b *p"], B: Float[Array, "a b *p"]) -> Array:
    """The Frobenius inner product A : B = Σ_ij A_ij B_ij of matrices of equal size, shape (*batch)."""
    return dot(*([entry for row in entries(M) for entry in row] for M in (A, B)))


def determinant(A: Matrix) -> Array:
    """det A, shape (*batch)."""
    a = entries(A)
    return a[0][0] * a[1][1] - a[0][1] * a[1][0] if len(a) == 2 else dot(a[0], cofactors(a)[0])


def cofactor(A: Matrix) -> Matrix:
    """The cofactor matrix det(A) A⁻ᵀ = ∂ det A / ∂A. It is a polynomial in A, defined for singular A too.

    In 2-D it is A turned by half a turn, with two signs: XLA does not vectorise a stack in what its derivative is fused
    with.
    """
    if A.shape[0] != 2:
        return assemble(cofactors(entries(A)))
    signs = np.array([[1, -1], [-1, 1]], A.dtype).reshape(2, 2, *[1] * (A.ndim - 2))
    return jnp.flip(A, axis=(0, 1)) * signs


def cofactor_differential(A: Matrix, dA: Matrix) -> Matrix:
    """δ(J A⁻ᵀ), the differential of the cofactor matrix at A in the direction dA (derivation, after eq. 11)."""
    match A.shape[0]:
        case 1:
            return jnp.zeros_like(dA)
        case 2:
            return cofactor(dA)
        case _:
            a, da = entries(A), entries(dA)
            return assemble(_cross_cofactors(a, da)) + assemble(_cross_cofactors(da, a))


def cofactors(a: list[list[Array]]) -> list[list[Array]]:
    """The cofactor matrix by components."""
    match len(a):
        case 1:
            return [[jnp.ones_like(a[0][0])]]
        case 2:
            return [[a[1][1], -a[1][0]], [-a[0][1], a[0][0]]]
        case _:
            return _cross_cofactors(a, a)


def _cross_cofactors(a: list[list[Array]], b: list[list[Array]]) -> list[list[Array]]:
    """The bilinear form in 3-D whose value at (A, A) is the cofactor matrix of A."""

    def minor(i: int, j: int) -> Array:
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        return a[i1][j1] * b[i2][j2] - a[i1][j2] * b[i2][j1]

    return [[minor(i, j) for j in range(3)] for i in range(3)]


def finite(a: Array) -> Bool[Array, "p"]:
    """Whether each particle's numbers are finite, of any shape (..., p): their sum, each times zero, then is zero, and
    else it is not a number. That is one operation a number, where asking each is three. Unrolled: of a reduction XLA
    would make a loop within its loop over the particles."""
    return reduce(jnp.add, [a[i] * 0 for i in np.ndindex(a.shape[:-1])]) == 0
