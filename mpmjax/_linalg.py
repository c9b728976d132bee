"""Small-matrix algebra by components: products, determinant, cofactor and the rotation of the polar decomposition.

Every matrix has shape (d, d, *batch), d = 1, 2 or 3, with its two matrix axes first. The expressions are unrolled over
the components, so that XLA sees plain elementwise arithmetic over the batch: on a CPU that is some twenty times faster
than batched LAPACK or tiny `dot_general`s, and its derivatives are as cheap.
"""

import jax
import jax.numpy as jnp

from mpmjax._types import Array, Compliance, Matrix

_NEWTON_STEPS = 16  # on the quartic of the 3-D rotation: halves the error until near, then squares it
_POLISH_STEPS = 2  # on the rotation itself


def assemble(rows: list[list[Array]]) -> Matrix:
    """A matrix from its components, `rows[i][j]` having the shape of the batch."""
    return jnp.stack([jnp.stack(row) for row in rows])


def identity_like(A: Matrix) -> Matrix:
    """The identity in the shape and dtype of `A`."""
    d = A.shape[0]
    eye = jnp.eye(d, dtype=A.dtype).reshape((d, d) + (1,) * (A.ndim - 2))
    return jnp.broadcast_to(eye, A.shape)


def transpose(A: Matrix) -> Matrix:
    """Aᵀ."""
    return jnp.swapaxes(A, 0, 1)


def matmul(A: Matrix, B: Matrix) -> Matrix:
    """A B."""
    d = A.shape[0]
    return assemble(
        [[sum((A[i, k] * B[k, j] for k in range(1, d)), A[i, 0] * B[0, j]) for j in range(d)] for i in range(d)]
    )


def trace(A: Matrix) -> Array:
    """tr A, shape (*batch)."""
    return sum((A[i, i] for i in range(1, A.shape[0])), A[0, 0])


def double_dot(A: Matrix, B: Matrix) -> Array:
    """The Frobenius inner product A : B, shape (*batch)."""
    d = A.shape[0]
    pairs = [A[i, j] * B[i, j] for i in range(d) for j in range(d)]
    return sum(pairs[1:], pairs[0])


def determinant(A: Matrix) -> Array:
    """det A, shape (*batch)."""
    C = cofactor(A)
    return sum((A[0, j] * C[0, j] for j in range(1, A.shape[0])), A[0, 0] * C[0, 0])


def cofactor(A: Matrix) -> Matrix:
    """The cofactor matrix det(A) A⁻ᵀ = ∂ det A / ∂A, polynomial in A and so defined for singular A."""
    match A.shape[0]:
        case 1:
            return jnp.ones_like(A)
        case 2:
            return assemble([[A[1, 1], -A[1, 0]], [-A[0, 1], A[0, 0]]])
        case _:
            return _cross_cofactor(A, A)


def cofactor_differential(A: Matrix, dA: Matrix) -> Matrix:
    """δ(J A⁻ᵀ), the differential of the cofactor matrix at A in the direction dA (reference, after eq. 11)."""
    match A.shape[0]:
        case 1:
            return jnp.zeros_like(dA)
        case 2:
            return cofactor(dA)
        case _:
            return _cross_cofactor(A, dA) + _cross_cofactor(dA, A)


def _cross_cofactor(A: Matrix, B: Matrix) -> Matrix:
    """In 3-D, the bilinear form whose value at (A, A) is the cofactor matrix of A."""

    def minor(i: int, j: int) -> Array:
        i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
        return A[i1, j1] * B[i2, j2] - A[i1, j2] * B[i2, j1]

    return assemble([[minor(i, j) for j in range(3)] for i in range(3)])


@jax.custom_jvp
def rotation(F: Matrix) -> Matrix:
    """The rotation R of the polar decomposition F = R S, with det R = +1.

    R maximises tr(RᵀF) over the rotations. S = RᵀF is symmetric; where det F < 0 it is indefinite, its smallest
    principal stretch negative. In 1-D R = 1.

    2-D: the closed form. 3-D: λ = tr S is the largest root of (λ² − ‖F‖²)² − 8 det(F) λ − 4 ‖cof F‖², the
    characteristic polynomial of a symmetric 4 x 4 matrix (N. J. Higham, V. Noferini, Numer. Algorithms 73 (2016) 349,
    doi 10.1007/s11075-016-0098-7), found by Newton's method from above; then, with κ = (λ² − ‖F‖²)/2,
    R = ((κ + ‖F‖²) F + λ cof F − F Fᵀ F) / (κλ − det F) (F. L. Markley, J. Astronaut. Sci. 41 (1993) 261), polished by
    orthonormalisation and Newton steps of eq. 12 of the reference.

    *When it breaks*: where two signed principal stretches sum to zero R is not unique; its derivative grows like the
    inverse of that sum and is not finite at zero.

    The derivative is the rule of `rotation_differential`, never that of the iterations, so it is finite at F = I and
    at repeated stretches, to every order.

    Args:
        F: shape (d, d, *batch).
    Returns:
        R, same shape.
    """
    match F.shape[0]:
        case 1:
            return jnp.ones_like(F)
        case 2:
            return _rotation_2d(F)
        case _:
            return _rotation_3d(F)


@rotation.defjvp
def _rotation_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    (F,), (dF,) = primals, tangents
    R = rotation(F)
    return R, rotation_differential(R, spin_compliance(matmul(transpose(R), F)), dF)


def spin_compliance(S: Matrix) -> Compliance:
    """(tr(S) I − S)⁻¹, which turns the vector of a skew matrix into a spin (eq. 12 of the reference, solved for U).

    Shape (3, 3, *batch) in 3-D; in 2-D the scalar 1 / tr S as (1, 1, *batch); in 1-D there is no spin and the result,
    (1, 1, *batch), is zero.
    """
    match S.shape[0]:
        case 1:
            return jnp.zeros_like(S)
        case 2:
            return (1 / trace(S))[None, None]
        case _:
            system = trace(S) * identity_like(S) - S
            return transpose(cofactor(system)) / determinant(system)


def rotation_differential(R: Matrix, compliance: Compliance, dF: Matrix) -> Matrix:
    """δR = R [ω]ₓ with (tr(S) I − S) ω = vee(RᵀδF − δFᵀR) (eq. 12 of the reference).

    Args:
        R: rotation of F, shape (d, d, *batch).
        compliance: `spin_compliance(RᵀF)`.
        dF: δF, shape (d, d, *batch).
    """
    d = R.shape[0]
    if d == 1:
        return jnp.zeros_like(dF)
    V = matmul(transpose(R), dF)
    if d == 2:
        omega = compliance[0, 0] * (V[1, 0] - V[0, 1])
        return omega * assemble([[R[0, 1], -R[0, 0]], [R[1, 1], -R[1, 0]]])
    v = (V[2, 1] - V[1, 2], V[0, 2] - V[2, 0], V[1, 0] - V[0, 1])
    w = [sum((compliance[i, j] * v[j] for j in range(1, 3)), compliance[i, 0] * v[0]) for i in range(3)]
    return matmul(R, _skew(w))


def _skew(w: list[Array]) -> Matrix:
    """[w]ₓ, with [w]ₓ a = w × a."""
    zero = jnp.zeros_like(w[0])
    return assemble([[zero, -w[2], w[1]], [w[2], zero, -w[0]], [-w[1], w[0], zero]])


def _rotation_2d(F: Matrix) -> Matrix:
    cos, sin = F[0, 0] + F[1, 1], F[1, 0] - F[0, 1]
    unit = jnp.hypot(cos, sin)
    singular = unit == 0
    cos = jnp.where(singular, 1, cos) / jnp.where(singular, 1, unit)
    sin = sin / jnp.where(singular, 1, unit)
    return assemble([[cos, -sin], [sin, cos]])


def _rotation_3d(F: Matrix) -> Matrix:
    size = jnp.sqrt(double_dot(F, F))
    F = F / jnp.where(size == 0, 1, size)  # ‖F‖ = 1 from here on
    cof = cofactor(F)
    J, cof2 = determinant(F), double_dot(cof, cof)
    root = jnp.full_like(J, jnp.sqrt(3.0).astype(F.dtype))  # tr S ≤ √3 ‖F‖: above the root, where Newton is monotone
    for _ in range(_NEWTON_STEPS):
        square = root * root - 1
        slope = 4 * root * square - 8 * J
        root = root - (square * square - 8 * J * root - 4 * cof2) / jnp.where(slope == 0, 1, slope)
    kappa = (root * root - 1) / 2
    zeta = kappa * root - J  # (s₁+s₂)(s₂+s₃)(s₃+s₁)
    numerator = (kappa + 1) * F + root * cof - matmul(F, matmul(transpose(F), F))
    R = numerator / jnp.where(zeta == 0, 1, zeta)
    R = _orthonormalised(R)
    for _ in range(_POLISH_STEPS):
        compliance = spin_compliance(matmul(transpose(R), F))
        R = _orthonormalised(R + rotation_differential(R, compliance, F))
    return R


def _orthonormalised(R: Matrix) -> Matrix:
    """One Newton-Schulz step towards the nearest orthogonal matrix: the error is squared."""
    return matmul(R, 1.5 * identity_like(R) - 0.5 * matmul(transpose(R), R))
