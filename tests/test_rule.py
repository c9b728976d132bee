"""Rules of differentiation in every nest of transformations, on a function whose code has another derivative."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import thorough

from mpmjax.autodiff import custom_derivative, is_unknown


@custom_derivative
def cube(x):
    """x³ by a loop of no derivative in x."""
    return jax.lax.while_loop(lambda c: c[0] < 1, lambda c: (c[0] + 1, c[1] ** 3), (0, jax.lax.stop_gradient(x)))[1]


@cube.defjvp
def _(primals, tangents):
    (x,), (dx,) = primals, tangents
    return cube(x), scaled(3.0, x, x, dx)


@custom_derivative
def scaled(factor, x, y, z):
    """factor x y z, the factor fixed in the program where it is a plain number."""
    return factor * jax.lax.stop_gradient(x * y * z)


@scaled.defjvp
def _(primals, tangents):
    factor, *vectors = primals
    changes = [scaled(factor, *vectors[:k], t, *vectors[k + 1 :]) for k, t in enumerate(tangents[1:]) if t is not None]
    return scaled(*primals), sum(changes)


@scaled.deftranspose
def _(cotangent, args):
    factor, *vectors = args
    pulled = scaled(factor, *(cotangent if is_unknown(a) else a for a in vectors))
    return (None, *(pulled if is_unknown(a) else None for a in vectors))


def in_scan(f):
    return lambda x: jax.lax.scan(lambda _, y: (None, f(y)), None, x[None])[1][0]


WAYS = {"plain": lambda f: f, "jit": jax.jit, "scan": in_scan, "checkpoint": jax.checkpoint}
X = 1.5


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("outer", [jax.jacfwd, *thorough(jax.jacrev)])
@pytest.mark.parametrize("inner", [*thorough(jax.jacfwd), jax.jacrev])
def test_the_rule_holds_in_every_nest(inner, outer, way):
    """x³ to its third derivative, also in batches; the code's derivative is zero."""
    f = WAYS[way](cube)
    once = inner(f)
    twice = outer(WAYS[way](once))
    x = jnp.asarray(X)
    np.testing.assert_allclose([f(x), once(x), twice(x)], [X**3, 3 * X**2, 6 * X], rtol=1e-15)
    np.testing.assert_allclose([jax.jacfwd(twice)(x), jax.jacrev(inner(inner(f)))(x)], 6, rtol=1e-15)
    np.testing.assert_allclose(jax.vmap(twice)(jnp.array([X, 2.0])), [6 * X, 12], rtol=1e-15)


def test_a_batch_may_share_an_argument():
    """And its cotangent is the sum over the members, at every level."""
    x, y = jnp.arange(1.0, 4.0), jnp.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])

    def total(z):
        inner = jax.vmap(partial(scaled, 2.0), in_axes=(0, 0, None))
        return jax.vmap(lambda row: inner(x, row, z))(y).sum()

    np.testing.assert_allclose(jax.grad(total)(jnp.asarray(0.5)), 2 * (x * y).sum(), rtol=1e-15)


def test_arguments_are_pytrees_of_which_what_is_no_array_is_fixed():
    """A result may have no derivative: an integer."""

    @custom_derivative
    def picked(choice, number):
        return {"value": choice["a"] * (2 if choice["name"] == "twice" else 1), "number": number}

    @picked.defjvp
    def _(primals, tangents):
        assert tangents[0]["name"] is None
        assert tangents[1] is None
        return picked(*primals), {"value": 2 * tangents[0]["a"], "number": None}

    f = lambda a: picked({"name": "twice", "a": a}, jnp.asarray(3))  # noqa: E731
    out, change = jax.jvp(f, (jnp.asarray(2.0),), (jnp.asarray(1.0),))
    assert (float(out["value"]), int(out["number"]), float(change["value"])) == (4.0, 3, 2.0)
    assert jax.vmap(f)(jnp.arange(3.0))["number"].shape == (3,)


def test_what_has_no_rule_says_so():
    @custom_derivative
    def bare(x):
        return x

    with pytest.raises(NotImplementedError, match="bare has no derivative"):
        jax.grad(bare)(1.0 * jnp.ones(()))


def test_what_has_no_transpose_says_so():
    """A function with a derivative that reverse mode must transpose: forward mode works."""

    @custom_derivative
    def doubled(x):
        return 2 * x

    @doubled.defjvp
    def _(primals, tangents):
        return doubled(*primals), doubled(*tangents)

    x = jnp.asarray(X)
    np.testing.assert_array_equal(jax.jvp(doubled, (x,), (x,)), [2 * X, 2 * X])
    with pytest.raises(NotImplementedError, match=r"^doubled has no transpose\."):
        jax.grad(doubled)(x)
