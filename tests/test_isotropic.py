"""Functions of symmetric matrices: against LAPACK, and their derivatives against central differences, at repeated and
nearly repeated eigenvalues too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, ids, rotation_matrix, thorough

from mpmjax.linalg._spectral import Logarithm, PowerBeyondLine, PowerLessOne

POWERS = (-0.4, 0.3), (-1e-9, 1e-8), (1.7, -0.2)
FUNCTIONS = {f"power {a}": PowerLessOne(jnp.array([a]), jnp.array([c])) for a, c in POWERS}
FUNCTIONS |= {"logarithm": Logarithm(), "beyond line": PowerBeyondLine(jnp.array([0.3]), jnp.array([-0.2]))}
EIGENVALUES = {
    "all one": (1.0, 1.0, 1.0),
    "two equal": (1.3, 1.3, 0.4),
    "three distinct": (0.3, 1.1, 2.7),
    "two nearly equal": (1.0, 1.0 + 1e-9, 2.0),
    "all close": (1.0, 1.0 + 3e-5, 1.0 - 2e-5),
    "some decades": (1e-3, 1.0, 8.0),
}
EACH = [
    pytest.mark.parametrize("f", **ids(FUNCTIONS)),
    pytest.mark.parametrize("d", [*thorough(1, 2), 3]),
    pytest.mark.parametrize("eigenvalues", **ids(EIGENVALUES)),
]


def each(test):
    for mark in EACH:
        test = mark(test)
    return test


def symmetric(A):
    return (A + A.swapaxes(0, 1)) / 2


def case(eigenvalues, d, seed=0):
    """A matrix of these eigenvalues, three symmetric directions, all with a batch axis of one."""
    rng = np.random.default_rng(seed)
    Q = rotation_matrix(d, rng)
    S = symmetric(Q * np.array(eigenvalues[:d]) @ Q.T)
    return tuple(jnp.asarray(a[..., None]) for a in (S, *(symmetric(rng.normal(size=(d, d))) for _ in range(3))))


@jax.jit
def evaluated(f, S, A, B, W):
    """f(S), Df[A], D²f[A, B], and the cotangent W pulled back through f and through Df[A]."""
    once = lambda S: jax.jvp(f, (S,), (A,))[1]  # noqa: E731
    value, first = jax.jvp(f, (S,), (A,))
    second = jax.jvp(once, (S,), (B,))[1]
    pulled = [jax.grad(lambda S, g=g: (W * g(S)).sum())(S) for g in (f, once)]
    return value, first, second, *pulled


@each
def test_values_are_those_of_lapacks_eigenvectors(eigenvalues, d, f):
    """To rounding, whatever the eigenvalues."""
    S, *directions = case(eigenvalues, d)
    value = evaluated(f, S, *directions)[0]
    s, V = np.linalg.eigh(S[..., 0])
    y = np.log(s) if isinstance(f, Logarithm) else np.asarray(f.exponent[0] * np.log(s) + f.shift[0])
    of = y if isinstance(f, Logarithm) else np.expm1(y) - (y if isinstance(f, PowerBeyondLine) else 0)
    assert_close(value[..., 0], (V * of) @ V.T, 1e-13, atol=4e-15 if isinstance(f, Logarithm) else 0)


@each
def test_derivatives_are_central_differences(eigenvalues, d, f):
    """The first of the values, the second of the first, at a step of 1e-5 of the smallest eigenvalue."""
    S, A, B, W = case(eigenvalues, d)
    _, first, second, *_ = evaluated(f, S, A, B, W)
    h = 1e-4 * min(eigenvalues[:d])
    ahead, behind = (evaluated(f, S + s * A, A, B, W)[0] for s in (h, -h))
    assert_close(first, (ahead - behind) / (2 * h), 1e-7)
    ahead, behind = (evaluated(f, S + s * B, A, B, W)[1] for s in (h, -h))
    assert_close(second, (ahead - behind) / (2 * h), 1e-6)


@each
def test_reverse_mode_is_the_transpose(eigenvalues, d, f):
    """⟨W, Df[A]⟩ = ⟨DfᵀW, A⟩ and ⟨W, D²f[A, B]⟩ likewise, to 1e-12."""
    S, A, B, W = case(eigenvalues, d)
    _, first, second, once, twice = evaluated(f, S, A, B, W)
    for forward, backward, direction in ((first, once, A), (second, twice, B)):
        size = float(jnp.abs(W * forward).sum())
        np.testing.assert_allclose((backward * direction).sum(), (W * forward).sum(), rtol=0, atol=1e-12 * size)


@jax.jit
def parametric(f, df, S, A):
    """f(S), its change by the parameters of f, and Df[A]; and the changes of these three by them."""

    def three(f):
        value, change = jax.jvp(lambda f: f(S), (f,), (df,))
        return value, change, jax.jvp(f, (S,), (A,))[1]

    return jax.jvp(three, (f,), (df,))


@pytest.mark.parametrize("d", [*thorough(1, 2), 3])
@pytest.mark.parametrize("eigenvalues", **ids(EIGENVALUES))
def test_derivatives_in_the_parameters_are_central_differences(eigenvalues, d):
    """Of values, once and twice, and of first derivatives; the adjoint is the transpose to 1e-12."""
    S, A, _, W = case(eigenvalues, d)
    f, df = FUNCTIONS["power -0.4"], PowerLessOne(jnp.array([0.7]), jnp.array([-0.3]))
    _, changes = parametric(f, df, S, A)
    h = 1e-5
    ahead, behind = (parametric(jax.tree.map(lambda a, b, s=s: a + s * b, f, df), df, S, A)[0] for s in (h, -h))
    for exact, a, b in zip(changes, ahead, behind, strict=True):
        assert_close(exact, (a - b) / (2 * h), 1e-7)
    pulled = jax.grad(lambda f: (W * f(S)).sum())(f)
    found = sum((a * b).sum() for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(df), strict=True))
    size = float(jnp.abs(W * changes[0]).sum())
    np.testing.assert_allclose(found, (W * changes[0]).sum(), rtol=0, atol=1e-12 * size)


def test_a_power_of_nothing_is_nothing():
    """e⁰ S⁰ − I = 0 to the last bit."""
    S, *_ = case(EIGENVALUES["three distinct"], 3)
    assert not np.any(PowerLessOne(jnp.zeros(1), jnp.zeros(1))(S))


def test_batches_of_any_shape_are_taken():
    """As one by one."""
    rng = np.random.default_rng(4)
    A = jnp.asarray(rng.normal(size=(3, 3, 4, 5)))
    S = jnp.einsum("ki...,kj...->ij...", A, A) + 0.1 * jnp.eye(3)[..., None, None]
    log = jax.jit(Logarithm().__call__)
    assert_close(log(S).reshape(3, 3, -1), log(S.reshape(3, 3, -1)), 1e-15)


@pytest.mark.parametrize("eigenvalues", **ids(EIGENVALUES, ()))
def test_third_derivatives_are_central_differences(eigenvalues):
    """Of the second ones, of a power, in three dimensions."""
    f = FUNCTIONS["power -0.4"]
    S, A, *_ = case(eigenvalues, 3)
    third = jax.jit(lambda f, S, A: nth(f, 3, S, A))
    second = jax.jit(lambda f, S, A: nth(f, 2, S, A))
    h = 1e-4 * min(eigenvalues)
    assert_close(third(f, S, A), (second(f, S + h * A, A) - second(f, S - h * A, A)) / (2 * h), 1e-6)


def nth(f, n, S, A):
    """Dⁿf[A, ..., A]."""
    return f(S) if n == 0 else jax.jvp(lambda S: nth(f, n - 1, S, A), (S,), (A,))[1]
