"""Small-matrix algebra against NumPy; the rotation of the polar decomposition and its derivatives of two orders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import assert_close, rotation_matrix, thorough

from mpmjax import linalg as la

EACH_DIM = pytest.mark.parametrize("d", [*thorough(1, 2), 3])
EACH_FAMILY = pytest.mark.parametrize("family", STRETCHES)
REPEATED = {"identity": (1.0, 1.0, 1.0), "uniform": (1.2, 1.2, 1.2), "pair": (1.2, 1.2, 0.9)}

rotation = jax.jit(la.rotation)
principal_frame = jax.jit(la.principal_frame)
symmetric_eigen = jax.jit(la.symmetric_eigen)


@jax.jit
def first(F, dF):
    """δR."""
    return jax.jvp(la.rotation, (F,), (dF,))[1]


@jax.jit
def second(F, dF, dG):
    """δ²R in two directions, by a jvp of a jvp."""
    return jax.jvp(lambda F: jax.jvp(la.rotation, (F,), (dF,))[1], (F,), (dG,))[1]


def matrices(d, n=20, seed=0):
    """n random matrices, (d, d, n)."""
    return np.random.default_rng(seed).normal(size=(d, d, n))


def on_batch(f, *arrays):
    """A NumPy function of (n, d, d) arrays, applied to (d, d, n) ones."""
    result = f(*(np.moveaxis(a, -1, 0) for a in arrays))
    return np.moveaxis(result, 0, -1)


def svd_rotation(F):
    """U diag(1, .., det(U Vᵀ)) Vᵀ, for (n, d, d)."""
    U, _, Vt = np.linalg.svd(F)
    U[..., -1] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt


def frechet(F, dF):
    """δR = U (Ω ∘ (UᵀδF V − VᵀδFᵀU)) Vᵀ with Ω_ij = 1/(s_i + s_j), by an SVD with signed stretches, for (n, d, d)."""
    U, s, Vt = np.linalg.svd(F)
    sign = np.linalg.det(U @ Vt)
    U[..., -1] *= sign[:, None]
    s[..., -1] *= sign
    D = U.swapaxes(1, 2) @ dF @ Vt.swapaxes(1, 2)
    total = s[:, :, None] + s[:, None, :]
    off = ~np.eye(F.shape[-1], dtype=bool)
    return U @ (off * (D - D.swapaxes(1, 2)) / np.where(off, total, 1)) @ Vt


@EACH_DIM
def test_products_and_invariants_agree_with_numpy(d):
    """Product, transpose, trace, double dot, determinant, identity."""
    A, B = matrices(d), matrices(d, seed=1)
    assert_close(la.matmul(jnp.asarray(A), jnp.asarray(B)), on_batch(np.matmul, A, B), 1e-15)
    np.testing.assert_array_equal(la.transpose(jnp.asarray(A)), A.swapaxes(0, 1))
    assert_close(la.trace(jnp.asarray(A)), np.einsum("iin->n", A), 1e-15)
    assert_close(la.double_dot(jnp.asarray(A), jnp.asarray(B)), np.einsum("ijn,ijn->n", A, B), 1e-15)
    assert_close(la.determinant(jnp.asarray(A)), on_batch(np.linalg.det, A), 1e-14)
    eye = la.identity_like(jnp.asarray(A, jnp.float32))
    assert eye.dtype == jnp.float32
    np.testing.assert_array_equal(eye, np.broadcast_to(np.eye(d)[..., None], A.shape))


@EACH_DIM
def test_cofactor_is_determinant_times_inverse_transpose(d):
    """cof A = det(A) A⁻ᵀ, it is the gradient of det, and it is finite and right for singular A."""
    A = matrices(d)
    cofactor = la.cofactor(jnp.asarray(A))
    expected = on_batch(lambda A: np.linalg.det(A)[:, None, None] * np.linalg.inv(A).swapaxes(1, 2), A)
    assert_close(cofactor, expected, 1e-13)
    gradient = jax.grad(lambda A: la.determinant(A).sum())(jnp.asarray(A))
    assert_close(cofactor, gradient, 1e-14)
    flat = np.diag([2.0, 3.0, 0.0][-d:])
    np.testing.assert_array_equal(la.cofactor(jnp.asarray(flat)), np.diag({1: [1.0], 2: [0.0, 3.0], 3: [0, 0, 6]}[d]))


@EACH_DIM
def test_cofactor_differential_is_the_derivative_of_the_cofactor(d):
    """δ(J A⁻ᵀ) against `jax.jvp` and central differences, also for singular A; it is linear in δA and in A."""
    A, B, dA = (jnp.asarray(matrices(d, seed=seed)) for seed in range(3))
    A = A.at[:, :, 0].set(0)
    d_cofactor = la.cofactor_differential(A, dA)
    assert_close(d_cofactor, jax.jvp(la.cofactor, (A,), (dA,))[1], 1e-14)
    # the cofactor is a polynomial of degree d − 1 ≤ 2, for which central differences of any width are exact
    assert_close(d_cofactor, (la.cofactor(A + dA) - la.cofactor(A - dA)) / 2, 1e-13)
    if d == 3:
        assert_close(d_cofactor, la.cofactor_differential(dA, A), 1e-14)
        sum_of_parts = 2 * d_cofactor - 3 * la.cofactor_differential(B, dA)
        assert_close(la.cofactor_differential(2 * A - 3 * B, dA), sum_of_parts, 1e-13)
        assert_close(la.cofactor_differential(A, A), 2 * la.cofactor(A), 1e-14)
    assert_close(
        la.cofactor_differential(A, 2 * dA - 3 * B), 2 * d_cofactor - 3 * la.cofactor_differential(A, B), 1e-13
    )


@EACH_DIM
@EACH_FAMILY
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-12), (np.float32, 1e-5)], ids=["float64", "float32"])
def test_rotation_is_the_polar_decompositions(dtype, rtol, family, d):
    """R against the SVD's with a sign fix and against the stretches F was made of; det R = +1, S = RᵀF symmetric."""
    F, made_of = deformations(family, d)
    R = np.asarray(rotation(jnp.asarray(F, dtype)))
    assert R.dtype == dtype
    assert_close(R, made_of, rtol)
    assert_close(on_batch(np.linalg.det, R), 1.0, rtol)
    S = np.einsum("kin,kjn->ijn", R, F.astype(dtype))
    np.testing.assert_allclose(S, S.swapaxes(0, 1), atol=rtol * np.abs(F).max())
    if d > 1:
        assert_close(R, on_batch(svd_rotation, F), rtol)


@EACH_DIM
@EACH_FAMILY
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-14), (np.float32, 1e-5)], ids=["float64", "float32"])
def test_principal_frame_is_the_singular_value_decomposition_with_signs(dtype, rtol, family, d):
    """F = U diag(s) Vᵀ with rotations U and V; |s| the singular values, at most the smallest negative."""
    F, _ = deformations(family, d)
    U, s, V = map(np.asarray, principal_frame(jnp.asarray(F, dtype)))
    assert U.dtype == s.dtype == V.dtype == dtype
    rtol = rtol * d**3
    for Q in (U, V):
        assert_close(np.einsum("kin,kjn->ijn", Q, Q), np.broadcast_to(np.eye(d)[..., None], Q.shape), rtol)
        assert_close(on_batch(np.linalg.det, Q), 1.0, rtol)
    assert_close(np.einsum("ikn,kn,jkn->ijn", U, s, V), F, rtol)
    singular = on_batch(lambda F: np.linalg.svd(F, compute_uv=False), F)
    assert_close(np.sort(np.abs(s), axis=0), singular[::-1], rtol)
    assert ((s < 0).sum(axis=0) == (on_batch(np.linalg.det, F) < 0)).all()
    assert (np.abs(s).min(axis=0) == np.where(s.min(axis=0) < 0, -s.min(axis=0), np.abs(s).min(axis=0))).all()


EIGENVALUES = {
    "generic": (3.0, -1.0, 0.5),
    "equal": (2.0, 2.0, 2.0),
    "pair": (2.0, -1.0, -1.0),
    "nearly equal": (1.0, 1.0 + 1e-13, 1.0 - 1e-13),
    "far apart": (1e8, 1.0, 1e-8),
    "zero": (0.0, 0.0, 0.0),
}


@EACH_DIM
@pytest.mark.parametrize("eigenvalues", EIGENVALUES.values(), ids=EIGENVALUES)
def test_symmetric_eigen_agrees_with_numpy(eigenvalues, d):
    """S = V diag(w) Vᵀ to rounding of ‖S‖, V a rotation, for distinct, repeated and diagonal ones."""
    rng = np.random.default_rng(0)
    Q = np.stack([np.eye(d), *(rotation_matrix(d, rng) for _ in range(9))], axis=-1)
    S = np.einsum("ikn,k,jkn->ijn", Q, np.array(eigenvalues[:d]), Q)
    w, V = map(np.asarray, symmetric_eigen(jnp.asarray(S)))
    size = np.abs(eigenvalues[:d]).max()
    np.testing.assert_allclose(np.einsum("ikn,kn,jkn->ijn", V, w, V), S, rtol=0, atol=2e-15 * d * size)
    np.testing.assert_allclose(np.sort(w, axis=0), np.sort(eigenvalues[:d])[:, None] + 0 * w, atol=4e-15 * size)
    assert_close(np.einsum("kin,kjn->ijn", V, V), np.broadcast_to(np.eye(d)[..., None], V.shape), 4e-15)
    assert_close(on_batch(np.linalg.det, V), 1.0, 4e-15)


def test_the_principal_frame_refuses_to_be_differentiated():
    """Where stretches coincide it is no function of F: an error, never NaN."""
    F = jnp.eye(2)
    with pytest.raises(NotImplementedError, match="no derivative where stretches coincide"):
        jax.jvp(la.principal_frame, (F,), (F,))
    with pytest.raises(NotImplementedError, match="no derivative where stretches coincide"):
        jax.grad(lambda F: la.principal_frame(F)[1].sum())(F)


@EACH_DIM
@EACH_FAMILY
def test_rotation_differential_agrees_with_the_svds(family, d):
    """The jvp rule and derivation, eq. 12, against δR by an SVD; δR in the tangent space of the rotations."""
    F, _ = deformations(family, d)
    dF = matrices(d, seed=3)
    dR = first(jnp.asarray(F), jnp.asarray(dF))
    if d == 1:
        np.testing.assert_array_equal(dR, 0)
        return
    assert_close(dR, on_batch(frechet, F, dF), 1e-12)
    R = rotation(jnp.asarray(F))
    compliance = la.spin_compliance(la.matmul(la.transpose(R), jnp.asarray(F)))
    assert_close(la.rotation_differential(R, compliance, jnp.asarray(dF)), dR, 1e-13)
    U = np.einsum("kin,kjn->ijn", R, dR)
    np.testing.assert_allclose(U, -U.swapaxes(0, 1), atol=1e-12 * np.abs(U).max())


@EACH_DIM
@EACH_FAMILY
def test_rotation_differential_agrees_with_central_differences(family, d):
    """δR and δ²R against central differences of R and δR."""
    F, _ = deformations(family, d)
    size = np.abs(F).max(axis=(0, 1))
    dF, dG = (jnp.asarray(size * matrices(d, seed=seed)) for seed in (3, 4))
    F, h = jnp.asarray(F), 1e-6
    assert_close(first(F, dF), (rotation(F + h * dF) - rotation(F - h * dF)) / (2 * h), 1e-8)
    assert_close(second(F, dF, dG), (first(F + h * dG, dF) - first(F - h * dG, dF)) / (2 * h), 1e-7)
    assert_close(second(F, dF, dG), second(F, dG, dF), 1e-11)


@pytest.mark.parametrize("stretches", REPEATED.values(), ids=REPEATED)
@EACH_DIM
def test_derivatives_at_repeated_stretches_are_exact(stretches, d):
    """At F = diag(s), δR_ij = (δF_ij − δF_ji)/(s_i + s_j) to rounding; second derivatives are finite and right.

    At F = I, with ω the skew and ε the symmetric part of δF, δ²R = ω² − ωε − εω.
    """
    s = np.array(stretches[:d])
    dF = matrices(d, seed=5)
    F = np.broadcast_to(np.diag(s)[..., None], dF.shape)
    w, e = (dF - dF.swapaxes(0, 1)) / 2, (dF + dF.swapaxes(0, 1)) / 2
    np.testing.assert_allclose(first(jnp.asarray(F), jnp.asarray(dF)), 2 * w / (s[:, None] + s)[..., None], atol=1e-15)
    twice = np.asarray(second(jnp.asarray(F), *[jnp.asarray(dF)] * 2))
    if d > 1:
        h = 1e-5
        assert_close(twice, (on_batch(frechet, F + h * dF, dF) - on_batch(frechet, F - h * dF, dF)) / (2 * h), 1e-8)
    if stretches == REPEATED["identity"]:
        w, e = np.moveaxis(w, -1, 0), np.moveaxis(e, -1, 0)
        np.testing.assert_allclose(np.moveaxis(twice, -1, 0), w @ w - w @ e - e @ w, atol=1e-14)


@EACH_DIM
def test_reverse_mode_and_batches_agree_with_forward_mode(d):
    """⟨u, δR⟩ by `jax.vjp` and by `jax.jvp`; a `vmap` over single matrices; each particle as if it were alone."""
    F, dF, u = (jnp.asarray(a) for a in (deformations("random", d)[0], matrices(d, seed=3), matrices(d, seed=4)))
    (back,) = jax.jit(lambda F, u: jax.vjp(la.rotation, F)[1](u))(F, u)
    np.testing.assert_allclose((back * dF).sum(), (u * first(F, dF)).sum(), rtol=1e-12, atol=1e-14)
    mapped = jax.jit(jax.vmap(first, in_axes=-1, out_axes=-1))(F, dF)
    assert_close(mapped, first(F, dF), 1e-13)
    np.testing.assert_array_equal(rotation(F[..., ::-1])[..., ::-1], rotation(F))


def test_reference_system_of_eq_12_gives_the_same_differential():
    """The 3 x 3 system below eq. 12 of the derivation, for U₀₁, U₀₂, U₁₂ of U = RᵀδR, written out."""
    F, R = deformations("random", 3)
    dF = matrices(3, seed=3)
    S, V = np.einsum("kin,kjn->ijn", R, F), np.einsum("kin,kjn->ijn", R, dF)
    V = V - V.swapaxes(0, 1)
    system = np.array(
        [
            [S[0, 0] + S[1, 1], S[2, 1], -S[0, 2]],
            [S[1, 2], S[0, 0] + S[2, 2], S[0, 1]],
            [-S[0, 2], S[1, 0], S[1, 1] + S[2, 2]],
        ]
    )
    rhs = np.stack([V[0, 1], V[0, 2], V[1, 2]])
    a, b, c = np.linalg.solve(system.transpose(2, 0, 1), rhs.T[..., None])[..., 0].T
    zero = np.zeros_like(a)
    U = np.array([[zero, a, b], [-a, zero, c], [-b, -c, zero]])
    assert_close(first(jnp.asarray(F), jnp.asarray(dF)), np.einsum("ikn,kjn->ijn", R, U), 1e-12)


@pytest.mark.parametrize("gap", [1e-2, 1e-4, 1e-6])
@pytest.mark.parametrize("d", [2, 3])
def test_derivative_grows_like_the_inverse_gap_where_stretches_nearly_cancel(d, gap):
    """With s_i + s_j = gap R is a rotation, right to rounding over gap, and a twist of norm 1 turns it by 2 / gap."""
    rng = np.random.default_rng(1)
    U, V = (np.stack([rotation_matrix(d, rng) for _ in range(20)]) for _ in range(2))
    s, twist = np.diag([1.5, 0.5, gap - 0.5][-d:]), np.zeros((d, d))
    twist[-2, -1], twist[-1, -2] = np.sqrt(0.5), -np.sqrt(0.5)
    F, dF = (jnp.asarray(np.moveaxis(U @ a @ V.swapaxes(1, 2), 0, -1)) for a in (s, twist))
    R = np.moveaxis(np.asarray(rotation(F)), -1, 0)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(d), R.shape), atol=1e-13)
    np.testing.assert_allclose(R, U @ V.swapaxes(1, 2), atol=1e-14 / gap)
    np.testing.assert_allclose(np.linalg.norm(np.asarray(first(F, dF)), axis=(0, 1)), 2 / gap, rtol=1e-8)


@pytest.mark.parametrize("d", [2, 3])
def test_rotation_where_stretches_cancel_is_one_of_the_rotations(d):
    """At s_i + s_j = 0, and at F = 0, R is not unique; the value given is a rotation, and finite."""
    F = np.zeros((d, d, 20))
    F[:, :, 1:] = np.diag([1.0, 0.5, -0.5][-d:])[..., None]
    R = np.moveaxis(np.asarray(rotation(jnp.asarray(F))), -1, 0)
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(d), R.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1, rtol=1e-12)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_the_matrix_of_a_map_applies_it(d):
    """M, of A ↦ S A T with S and T symmetric, times the components of A in C order."""
    A, S, T = (jnp.asarray(a) for a in np.random.default_rng(5).normal(size=(3, d, d, 4)))
    S, T = S + la.transpose(S), T + la.transpose(T)
    matrix, image = la.matrix_of(lambda A: la.matmul(la.matmul(S, A), T), A), la.matmul(la.matmul(S, A), T)
    np.testing.assert_allclose(la.matmul(matrix, A.reshape(d * d, 1, 4)).reshape(A.shape), image, atol=1e-13)


def test_a_particle_is_finite_if_all_of_its_numbers_are():
    """Of the largest and the smallest numbers too."""
    a = np.ones((2, 3, 10), np.float32)
    for p, (place, number) in enumerate(zip(np.ndindex(2, 3), [np.nan, np.inf, -np.inf] * 2, strict=True)):
        a[(*place, p)] = number
    a[:, 0, 6], a[:, 1, 6] = np.finfo(a.dtype).max, np.finfo(a.dtype).min
    a[:, 0, 7], a[:, 1, 8], a[:, 2, 9] = 1e-45, -0.0, 3e38
    for ask in (la.finite, jax.jit(la.finite)):
        np.testing.assert_array_equal(ask(jnp.asarray(a)), [False] * 6 + [True] * 4)
