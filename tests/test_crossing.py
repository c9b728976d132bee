"""`gather` and `scatter`: the sums they say, and that each is the other's transpose to every order and in batches."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DIMS, GRADIENTS, KERNELS, assert_close, ids, thorough

import mpmjax as mpm
from mpmjax.discretisation import Stencil, _sums, gather, make_stencil, scatter
from mpmjax.discretisation._stencil import basis_of

P = 17
EACH_KERNEL = pytest.mark.parametrize("kernel", **ids(KERNELS))
EACH_DIM = pytest.mark.parametrize("d", DIMS)
to_nodes, from_nodes = eqx.filter_jit(scatter), eqx.filter_jit(gather)
QUADRATIC, MLS = mpm.BSpline(), mpm.MLSGradient()


def place(x, kernel=QUADRATIC, gradient=MLS):
    """The stencil at x in a periodic window of 5 nodes, of which the cubic kernel's stencil has 4."""
    d = x.shape[1]
    return make_stencil(kernel, gradient, mpm.Grid((5,) * d, 1.0, periodic=True), jnp.zeros(d, jnp.int32), x)


@cache
def example(d, c=3, kernel=QUADRATIC, gradient=MLS, seed=0):
    """Positions, their stencil, what particles give (d + 1, c, P), and node values."""
    rng = np.random.default_rng(seed)
    x = jnp.asarray(rng.uniform(0, 5, (P, d)))
    given, nodes = (jnp.asarray(rng.normal(size=shape)) for shape in ((d + 1, c, P), (5**d, c)))
    return x, eqx.filter_jit(place)(x, kernel, gradient), given, nodes


@pytest.mark.parametrize("kernel", **ids(KERNELS, "quadratic"))
@pytest.mark.parametrize("d", [*thorough(1, 2), 3])
@pytest.mark.parametrize("gradient", **ids(GRADIENTS, "mls"))
@pytest.mark.parametrize("c", [3, *thorough(1, 6)])
def test_they_are_the_sums_that_weights_and_gradients_say(c, gradient, d, kernel):
    """Σ_p (w a + Σ_b g_b a_b) and Σ_i w n, Σ_i g n, term by term in NumPy, whichever part of a is given."""
    _, stencil, given, nodes = example(d, c, kernel, gradient)
    basis = np.concatenate([stencil.weight[:, None], stencil.gradient], axis=1)
    index = np.asarray(stencil.index)
    for value, slopes in ((given[0], given[1:]), (given[0], None), (None, given[1:])):
        a = np.concatenate(
            [0 * given[:1] if value is None else value[None], 0 * given[1:] if slopes is None else slopes]
        )
        expected = np.zeros_like(nodes)
        np.add.at(expected, index, np.einsum("kbp,bcp->kpc", basis, a))
        assert_close(to_nodes(stencil, value, slopes, 5**d), expected, 1e-13)
    value, slopes = from_nodes(stencil, nodes)
    expected = np.einsum("kbp,kpc->bcp", basis, np.asarray(nodes)[index])
    assert_close(jnp.concatenate([value[None], slopes]), expected, 1e-13)


def test_what_goes_to_no_node_is_dropped():
    """Beyond either end; the rest arrives. Nothing else is touched."""
    xi = jnp.asarray([[-1.0, 0, 3, 4, 2**30]])  # each on its first node
    stencil = Stencil(xi, jnp.asarray(1.0), xi[0] > 0, basis_of(mpm.BSpline(1), mpm.Grid((4,), 1.0)))
    np.testing.assert_array_equal(scatter(stencil, jnp.ones((3, 5)), None, 4), np.tile([[1.0], [0], [0], [1]], 3))


def sums(x, given, nodes):
    """Both sums, as functions of everything."""
    stencil = place(x)
    value, slopes = gather(stencil, nodes)
    return scatter(stencil, given[0], given[1:], nodes.shape[0]), jnp.concatenate([value[None], slopes])


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_each_is_the_others_transpose(d):
    """By `linear_transpose` and in reverse mode, each by one call of the other and none of itself."""
    _, stencil, given, nodes = example(d)
    (back,) = jax.linear_transpose(lambda a: scatter(stencil, a[0], a[1:], 5**d), given)(nodes)
    value, slopes = gather(stencil, nodes)
    np.testing.assert_array_equal(back, jnp.concatenate([value[None], slopes]))
    pull = jax.vjp(lambda n: gather(stencil, n), nodes)[1]
    assert_close(pull((given[0], given[1:]))[0], scatter(stencil, given[0], given[1:], 5**d), 1e-15)
    program = str(jax.make_jaxpr(pull)((given[0], given[1:])))
    assert (program.count("function=scatter"), program.count("function=gather")) == (1, 0)


@pytest.mark.thorough
@EACH_DIM
def test_derivatives_by_everything_are_those_of_the_sums_written_out(d):
    """First and second, by x as well: against the same sums as dense products, in forward and in reverse mode."""
    x, _, given, nodes = example(d)
    to = [jnp.asarray(np.random.default_rng(9).normal(size=a.shape)) for a in (nodes, given)]

    def loss(sums, x, given, nodes):
        return sum((t * s**2).sum() for t, s in zip(to, sums(x, given, nodes), strict=True))

    def dense(x, given, nodes):
        stencil = place(x)
        basis = jnp.concatenate([stencil.weight[:, None], stencil.gradient], axis=1)
        at = jax.nn.one_hot(stencil.index, nodes.shape[0], dtype=x.dtype)  # (k, p, n)
        return jnp.einsum("kbp,bcp,kpn->nc", basis, given, at), jnp.einsum("kbp,kpn,nc->bcp", basis, at, nodes)

    here, there = (jax.grad(lambda *a, f=f: loss(f, *a), (0, 1, 2)) for f in (sums, dense))
    args = x, given, nodes
    along = tuple(jnp.asarray(np.random.default_rng(i).normal(size=a.shape)) for i, a in enumerate(args))

    @jax.jit
    def derivatives(args, along):
        found = []
        for grad, f in ((here, sums), (there, dense)):
            slope = jax.jvp(lambda *a, f=f: loss(f, *a), args, along)[1]
            curved = jax.jvp(grad, args, along)[1]
            twice = jax.grad(lambda a, grad=grad: sum((g * b).sum() for g, b in zip(grad(*a), along, strict=True)))(
                args
            )
            found.append((grad(*args), slope, curved, twice))
        return found

    one, other = derivatives(args, along)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-11), one, other)


@pytest.mark.parametrize("of_nodes", **ids({"nodes": True, "stencil": False}, "nodes"))
@pytest.mark.parametrize("d", [1, *thorough(2)])
def test_a_batch_is_its_members(d, of_nodes):
    """Batched in what is summed or in the stencil, nested, and differentiated outside of the batch."""
    x, _, given, nodes = example(d)
    whole = (x, *(jnp.stack([a, 2 * a, a**2]) for a in (given, nodes)))
    axes = (None, 0, 0)
    if not of_nodes:
        whole, axes = (jnp.stack([x, x + 0.3, x - 1.7]), given, nodes), (0, None, None)
    members = [tuple(a if ax is None else a[i] for a, ax in zip(whole, axes, strict=True)) for i in range(3)]
    batch, one = jax.vmap(sums, axes), jax.jit(sums)
    together = jax.jit(batch)(*whole)
    for i, member in enumerate(members):
        jax.tree.map(lambda a, b, i=i: assert_close(a[i], b, 1e-14), together, one(*member))
    nested = jax.jit(jax.vmap(batch))(*(a[None] for a in whole))
    jax.tree.map(lambda a, b: assert_close(a[0], b, 1e-14), nested, together)

    def slopes(f):
        return jax.jit(jax.grad(lambda *args: sum((s**3).sum() for s in f(*args)), (0, 1, 2)))

    of_one = slopes(sums)
    alone = [of_one(*member) for member in members]
    for found, each, axis in zip(slopes(batch)(*whole), zip(*alone, strict=True), axes, strict=True):
        assert_close(found, sum(each) if axis is None else jnp.stack(each), 1e-12)


def test_a_member_that_is_not_finite_leaves_the_others_as_they_are():
    """NaN positions make node numbers of no meaning: they reach no other member's grid."""
    x, _, given, nodes = example(2)
    args = jnp.stack([x, x]), jnp.stack([given, given]), jnp.stack([nodes, nodes])
    batch = jax.jit(jax.vmap(sums))
    whole, broken = (batch(xs, *args[1:]) for xs in (args[0], args[0].at[0].set(jnp.nan)))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1], b[1]), whole, broken)


@pytest.mark.parametrize("d", [1, *thorough(2, 3)])
def test_the_program_for_other_platforms_is_the_same_sum(d, monkeypatch):
    """Where it is not for a CPU nothing is left of XLA's loops: the same numbers, in one kernel a sum."""
    monkeypatch.setenv("MPMJAX_BACKEND", "xla")
    _, stencil, given, nodes = example(d)
    groups, rows = _sums.given_rows(stencil, given[0], given[1:])
    at, params = (stencil.xi, None), {"basis": stencil.basis, "groups": groups}
    loops, kernel = (_sums.gather_sum.function(*at, nodes, **params, unroll=unroll) for unroll in (False, True))
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-15), loops, kernel)
    loops, kernel = (_sums.scatter_sum.function(*at, rows, **params, size=5**d, unroll=u) for u in (False, True))
    assert_close(loops[0], kernel[0], 1e-14)
    traced = jax.jit(lambda given, nodes: (scatter(stencil, given[0], given[1:], 5**d), gather(stencil, nodes)))
    programs = {p: traced.trace(given, nodes).lower(lowering_platforms=(p,)).as_text() for p in ("cpu", "cuda")}
    assert ("while" in programs["cpu"]) == (d > 1)
    assert "while" not in programs["cuda"]
