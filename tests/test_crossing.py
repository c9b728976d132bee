"""`gather` and `scatter`: what they sum, and that each is the other's transpose to every order and in batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

from mpmjax._crossing import gather, scatter

S, P, SIZE = 3, 17, 40
COLUMNS = pytest.mark.parametrize("c", [1, 2, 3, 4, 6])
EACH_DIM = pytest.mark.parametrize("d", [1, 2])


def shares(d, seed=0, batch=()):
    """Of which some lead to the same node."""
    return jnp.asarray(np.random.default_rng(seed).integers(0, SIZE // d, (*batch, S, d, P)), jnp.int32)


def values(d, c, seed=1, batch=()):
    """One array for each stencil node."""
    return list(jnp.asarray(np.random.default_rng(seed).normal(size=(S**d, *batch, c, P))))


def grid(c, seed=2, batch=()):
    """Node values."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=(*batch, SIZE, c)))


def node_of(index):
    """Node numbers, stencil nodes in C order, (S^d, P)."""
    index = np.asarray(index)
    return np.stack([sum(index[i, a] for a, i in enumerate(at)) for at in np.ndindex((S,) * index.shape[1])])


@COLUMNS
@EACH_DIM
def test_they_read_and_add_at_the_nodes(d, c):
    index = shares(d)
    for read, at in zip(gather(index, grid(c)), node_of(index), strict=True):
        np.testing.assert_array_equal(read.T, grid(c)[at])
    expected = np.zeros((SIZE, c))
    for value, at in zip(values(d, c), node_of(index), strict=True):
        np.add.at(expected, at, value.T)
    assert_close(jax.jit(scatter, static_argnums=2)(index, values(d, c), SIZE), expected, 1e-14)


def test_what_goes_to_no_node_is_dropped():
    """Beyond either end; the rest arrives."""
    index = jnp.asarray([-1, 0, SIZE - 1, SIZE, 2**30], jnp.int32)[None, None]
    given = scatter(index, [jnp.ones((3, 5))], SIZE)
    np.testing.assert_array_equal(given, np.zeros((SIZE, 3)) + np.isin(np.arange(SIZE), [0, SIZE - 1])[:, None])


@COLUMNS
@EACH_DIM
def test_each_is_the_others_transpose(d, c):
    """By `linear_transpose` and by reverse mode, in one call each and not one a stencil node."""
    index = shares(d)
    (back,) = jax.linear_transpose(lambda v: scatter(index, v, SIZE), values(d, c))(grid(c))
    jax.tree.map(np.testing.assert_array_equal, back, gather(index, grid(c)))
    pull = jax.vjp(lambda n: gather(index, n), grid(c))[1]
    assert_close(pull(values(d, c))[0], scatter(index, values(d, c), SIZE), 1e-15)
    assert str(jax.make_jaxpr(pull)(values(d, c))).count("stencil_scatter") == 1


@EACH_DIM
def test_derivatives_of_every_order_and_mode(d):
    """Of a cubic form: the Hessian forward over reverse, reverse over forward and reverse over reverse agree with the
    one in closed form."""
    index, n = shares(d), grid(2)[:, :1]

    def form(n):
        squared = [v * v * v for v in gather(index, n)]
        return (scatter(index, squared, SIZE) * jnp.arange(float(SIZE))[:, None]).sum() / 6

    expected = np.zeros(SIZE)
    at = node_of(index)
    for k in at:
        np.add.at(expected, k, np.asarray(n)[k, 0] * k)
    for outer in (jax.jacfwd, jax.jacrev):
        for inner in (jax.jacfwd, jax.jacrev):
            assert_close(outer(inner(form))(n).reshape(SIZE, SIZE), np.diag(expected), 1e-12)


@pytest.mark.parametrize("mapped", [(0, 0), (None, 0), (0, None)])
@EACH_DIM
def test_a_batch_is_its_members(mapped, d):
    """Whichever of index and values is batched, also nested, and differentiated outside of the batch."""
    index = shares(d, batch=(4,) if mapped[0] == 0 else ())
    n = grid(3, batch=(4,) if mapped[1] == 0 else ())
    v = jnp.stack(values(d, 3, batch=(4,) if mapped[1] == 0 else ()), axis=1 if mapped[1] == 0 else 0)
    member = [(index[i] if mapped[0] == 0 else index, n[i] if mapped[1] == 0 else n) for i in range(4)]
    for i, read in enumerate(jnp.stack(jax.vmap(gather, mapped)(index, n), axis=1)):
        np.testing.assert_array_equal(read, jnp.stack(gather(*member[i])))
    added = jax.vmap(lambda i, v: scatter(i, list(v), SIZE), mapped)(index, v)
    for i, nodes in enumerate(added):
        assert_close(nodes, scatter(member[i][0], list(v[i] if mapped[1] == 0 else v), SIZE), 1e-14)

    def loss(n):
        return sum((r**3).sum() for r in jax.vmap(gather, mapped)(index, n))

    alone = [jax.grad(lambda n, i=i: sum((r**3).sum() for r in gather(i, n)))(n) for i, n in member]
    assert_close(jax.grad(loss)(n), jnp.stack(alone) if mapped[1] == 0 else sum(alone), 1e-12)
    nested = jax.vmap(jax.vmap(gather, mapped))(*(a[None] for a in (index, n)))
    assert_close(jnp.stack(nested)[:, 0], jnp.stack(jax.vmap(gather, mapped)(index, n)), 1e-15)
