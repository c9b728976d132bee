"""The native eigenvectors and rotations of 3 x 3 matrices are those of XLA to rounding, whatever they are given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import NEEDS_LIBRARY, assert_close, thorough

import mpmjax as mpm
from mpmjax import linalg as la

pytestmark = NEEDS_LIBRARY


def decomposed(F):
    """R of F = R S; of a symmetric matrix its eigenvalues w in their order, and V diag(w) Vᵀ and VᵀV, since V itself is
    not unique."""
    w, V = la.symmetric_eigen(F + la.transpose(F))
    rebuilt = la.matmul(V, w[:, None] * la.transpose(V))
    return la.rotation(F), jnp.sort(w, axis=0), rebuilt, la.matmul(la.transpose(V), V)


def by_both(choose, f, *args):
    """What a function returns by the native library and by XLA, each compiled anew."""
    found = []
    for name, called in (("native", True), ("xla", False)):
        choose(name)
        program = jax.jit(f)
        assert ("mpmjax_" in program.lower(*args).as_text()) == called
        found.append(jax.block_until_ready(program(*args)))
    return found


@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize("size", [1.0, *thorough(1e-15, 1e15)])
def test_back_ends_agree(choose, dtype, size):
    """On matrices of every kind of stretch and magnitude; zero among them."""
    every = [deformations(family, 3)[0] for family in STRETCHES]
    F = np.concatenate([*every, np.zeros((3, 3, 1))], axis=-1)
    native, xla = by_both(choose, decomposed, jnp.asarray(size * F, dtype))
    tolerance = 200 * float(jnp.finfo(dtype).eps)
    for a, b in zip(native, xla, strict=True):
        assert_close(a, b, tolerance)


@pytest.mark.parametrize("p", [0, 1, 5])
def test_batches_and_few_particles(choose, p):
    """A member of a batch has the bits that it has alone."""
    choose("native")
    F = jnp.asarray(np.random.default_rng(p).normal(size=(2, 3, 3, p)))
    together, alone = jax.jit(jax.vmap(decomposed))(F), [jax.jit(decomposed)(one) for one in F]
    jax.tree.map(lambda a, *b: np.testing.assert_array_equal(a, jnp.stack(b)), together, *alone)


def test_what_is_not_finite_spoils_its_own_particle_alone(choose):
    """NaN and infinity."""
    F = np.random.default_rng(0).normal(size=(3, 3, 40))
    spoilt = F.copy()
    spoilt[0, 1, 3], spoilt[2, 2, 20] = np.nan, np.inf
    choose("native")
    clean, found = jax.jit(decomposed)(jnp.asarray(F)), jax.jit(decomposed)(jnp.asarray(spoilt))
    others = np.delete(np.arange(40), [3, 20])
    for a, b in zip(found, clean, strict=True):
        np.testing.assert_array_equal(a[..., others], b[..., others])
    for a in found[:3]:  # R, w and V diag(w) Vᵀ; V itself may be the identity
        assert not jnp.isfinite(a[..., [3, 20]]).all(axis=tuple(range(a.ndim - 1))).any()


@pytest.mark.parametrize("law", [mpm.VonMises(1e4, 0.3, yield_stress=10.0), *thorough(mpm.Snow(1e4, 0.2))])
def test_laws_and_their_derivatives_agree(choose, law):
    """A return map and the stress after it, their first derivatives in both modes and a second one."""
    F = jnp.asarray(np.eye(3)[..., None] + 0.05 * np.random.default_rng(0).normal(size=(3, 3, 8)))
    to, along = jnp.cos(jnp.arange(72.0)).reshape(F.shape), jnp.sin(jnp.arange(72.0)).reshape(F.shape)

    def stress(F):
        F, history = law.return_map(F, law.initial_history(F), jnp.asarray(1e-3))
        return law.elastic(history).stress(F)

    def derivatives(F):
        def slope(F):
            return jax.jvp(stress, (F,), (along,))[1]

        return stress(F), slope(F), jax.grad(lambda F: (to * stress(F)).sum())(F), jax.jvp(slope, (F,), (to,))[1]

    native, xla = by_both(choose, derivatives, F)
    for a, b in zip(native, xla, strict=True):
        assert_close(a, b, 1e-10)
