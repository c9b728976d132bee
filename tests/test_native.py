"""The native sums are those of XLA to rounding, whatever they are given, and one place chooses between them."""

import dataclasses
import warnings
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NEEDS_LIBRARY, assert_close, block, thorough

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.discretisation import Stencil, _average, _resistance, _transfer_sums as sums, make_stencil, resist
from mpmjax.implicit import ImplicitOperator, ParticleStiffness, Projection, _conjugate_residual as residuals
from mpmjax.implicit._operator import product_p
from mpmjax.native import _library
from mpmjax.potential import Mirror

ROOT = Path(__file__).parents[1]
SIDE = 6


@pytest.fixture(autouse=True)
def as_if_nothing_were_asked(monkeypatch):
    monkeypatch.delenv("MPMJAX_BACKEND", raising=False)


def problem(d, s, c, p, dtype, seed=0, *, wild=True, side=SIDE):
    """Index factors, weights and derivatives, what particles give, and node values. With `wild` some particles reach
    over the window's edges, and one has indices without meaning."""
    rng = np.random.default_rng(seed)
    strides = side ** np.arange(d)[::-1]
    along = rng.integers(-wild, side - s + 1 + wild, size=(d, 1, p)) + np.arange(s)[:, None]
    index = (along * strides[:, None, None]).astype("int32")
    if wild and p > 3:
        index[..., 3] = rng.integers(-(2**31), 2**31, size=(d, s))
    w, g, given, nodes = (
        rng.normal(size=shape).astype(dtype) for shape in ((d, s, p), (d, s, p), (d + 1, c, p), (side**d, c))
    )
    return tuple(jnp.asarray(a) for a in (index, w, g, given, nodes))


def resistance(d, p, dtype, seed=0, *, wild=True, side=SIDE):
    """What `resist` is given: factors, upper triangles and a displacement."""
    index, w, g, _, u = problem(d, 3, d, p, dtype, seed, wild=wild, side=side)
    upper = np.random.default_rng(seed + 1).normal(size=(d * d * (d * d + 1) // 2, p)).astype(dtype)
    return index, w, g, jnp.asarray(upper), u


def resisted(*args):
    """By the primitive."""
    return _resistance._resist_p.bind(*args, batched=0)[0]


def resisted_in_parts(index, w, g, upper, u):
    """By a gather, a matrix a particle and a scatter, as they are written in JAX."""
    d = len(index)
    slopes = sums._gather(index, w, g, u, unroll=False)[1].reshape(d * d, -1)
    flux = jnp.einsum("ijp,jp->ip", la.symmetric(upper), slopes).reshape(d, d, -1)
    return sums.written_scatter(index, w, g, flux, valued=False, size=len(u), unroll=False)[0]


def parts_of(given, valued, graded):
    """The value and the gradients (d, c, p), either or both; with `graded` a number of columns, only so many."""
    gradients = given[1:] if graded is True else given[1:, :graded]
    return [given[0]] * valued + [gradients] * (graded is not False)


def native(index, w, g, given, nodes, valued=True, graded=True):
    """All three sums by the primitives."""
    parts = parts_of(given, valued, graded)
    params = {"valued": valued, "batched": 0}
    return (
        sums.gather_p.bind(index, w, g, nodes, batched=0),
        sums.scatter_p.bind(index, w, g, *parts, size=nodes.shape[0], **params),
        sums.pull_p.bind(index, w, g, nodes, *parts, **params),
    )


def written(index, w, g, given, nodes, valued=True, graded=True):
    """The same as they are written in JAX."""
    parts = parts_of(given, valued, graded)
    return (
        sums._gather(index, w, g, nodes, unroll=False),
        sums.written_scatter(index, w, g, *parts, valued=valued, size=nodes.shape[0], unroll=False),
        sums._pull(index, w, g, nodes, *parts, valued=valued, unroll=False),
    )


def agree(found, expected, dtype, roundings=100):
    """Equal to so many roundings of the largest number."""
    jax.tree.map(lambda a, b: assert_close(a, b, roundings * float(jnp.finfo(dtype).eps)), found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "s", "c"), [(2, 3, 3), *thorough((1, 2, 1), (1, 4, 5), (2, 4, 4), (3, 2, 2), (3, 3, 6))])
def test_back_ends_agree(d, s, c, dtype):
    """Over random inputs, whichever part is given, also gradients of fewer columns, with indices beyond the window; and
    in a batch."""
    args = problem(d, s, c, 45, dtype)
    for which in ({}, {"graded": False}, {"valued": False}, {"graded": c - 1}):
        agree(jax.jit(partial(native, **which))(*args), jax.jit(partial(written, **which))(*args), dtype)
    other = problem(d, s, c, 45, dtype, seed=1)
    both = [jnp.stack(pair) for pair in zip(args, other, strict=True)]
    alone = [jax.jit(native)(*each) for each in (args, other)]
    together = jax.jit(jax.vmap(native))(*both)
    jax.tree.map(lambda a, *b: np.testing.assert_array_equal(a, jnp.stack(b)), together, *alone)


@NEEDS_LIBRARY
@pytest.mark.parametrize(("d", "graded"), [(1, 1), *thorough((1, True), (2, True), (2, 1), (3, True))])
def test_derivatives_agree(d, graded):
    """First in both modes and second in all four orders of modes, by everything, gradients of fewer columns too. All
    within the window: beyond it, where a gather clips, its derivative drops."""
    index, *floats = problem(d, 3, 2, 9, "float64", wild=False)
    to = jax.tree.map(
        lambda a: jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), native(index, *floats, graded=graded)
    )
    along = tuple(jnp.sin(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in floats)

    def derivatives(of):
        def loss(*args):
            parts = jax.tree.map(lambda t, s: (t * s**2).sum(), to, of(index, *args))
            return sum(jax.tree.leaves(parts))

        def slope(f):
            return lambda *args: jax.jvp(f, args, along)[1]

        by = (0, 1, 2, 3)
        grad = jax.grad(loss, by)
        back = jax.grad(lambda *a: sum((g * b).sum() for g, b in zip(grad(*a), along, strict=True)), by)
        every = slope(loss), grad, slope(slope(loss)), slope(grad), jax.grad(slope(loss), by), back
        return jax.jit(lambda *a: [f(*a) for f in every])(*floats)

    native_, written_ = (partial(of, graded=graded) for of in (native, written))
    agree(derivatives(native_), derivatives(written_), "float64", 500)  # slopes along all at once are sums that cancel


@NEEDS_LIBRARY
@pytest.mark.parametrize(("d", "order"), [(2, 2), *thorough((1, 1), (3, 2), (2, 3))])
def test_sums_by_places_agree(d, order):
    """With those of the factors: values, also in a batch and of no particles, and derivatives, those of the linear
    functions that the sums are to the last bit. What is differentiated has the values by places too."""
    rng, side, p = np.random.default_rng(3), 8, 45
    grid = mpm.Grid((side,) * d, 0.1)
    a, b, nodes = (jnp.asarray(rng.normal(size=shape)) for shape in ((2, p), (d, 2, p), (side**d, 2)))
    weight = jnp.asarray(rng.uniform(0.5, 1.5, p))
    upper, u = (jnp.asarray(rng.normal(size=shape)) for shape in ((d * d * (d * d + 1) // 2, p), (side**d, d)))

    def stencil(x, placed):
        made = make_stencil(mpm.BSpline(order), mpm.MLSGradient(), grid, grid.window(x), x, affine=True)
        return made if placed else dataclasses.replace(made, places=None)

    def all_sums(placed, x, weight, a, b, nodes):
        of = stencil(x, placed)
        averages = _average.average(of, weight, a, b, jnp.asarray(1e-9), side**d)
        return sums.gather(of, nodes), sums.scatter(of, a, b, side**d), averages, resist(of, upper[:, : len(x)], u)

    def slopes(placed, *args):
        return jax.grad(lambda *args: sum((s**2).sum() for s in jax.tree.leaves(all_sums(placed, *args))), range(5))(
            *args
        )

    def transposed(placed, x, weight, a, b, nodes):
        del weight, nodes
        of = stencil(x, placed)
        return jax.linear_transpose(lambda a: sums.scatter(of, a, None, side**d), a)(jnp.ones((side**d, 2)))

    x = jnp.asarray(rng.uniform(0.25, 0.45, (p, d)))
    args = x, weight, a, b, nodes
    others = jax.tree.map(lambda v: v[..., ::-1], args)
    batch = jax.tree.map(lambda *v: jnp.stack(v), args, others)
    nobody = x[:0], weight[:0], a[:, :0], b[..., :0], nodes
    for through, given in ((jax.jit, args), (lambda of: jax.jit(jax.vmap(of)), batch)):
        agree(*(through(partial(all_sums, placed))(*given) for placed in (True, False)), "float64")
    agree(*(jax.jit(partial(slopes, placed))(*args) for placed in (True, False)), "float64", 10)
    value = jax.jit(partial(all_sums, True))
    jax.tree.map(np.testing.assert_array_equal, jax.jit(partial(jax.jvp, value))(args, args)[0], value(*args))
    for of, given in ((transposed, args), (all_sums, nobody)):
        found, expected = (jax.jit(partial(of, placed))(*given) for placed in (True, False))
        jax.tree.map(np.testing.assert_array_equal, found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("order", [1, 2, 3])
def test_small_weights_are_right_by_places(order):
    """Of particles that hardly reach a node, in single precision: each weight, not only their largest."""
    grid = mpm.Grid((12,), 1.0)
    edge = 4.0 + (order + 1) % 2 / 2
    x = jnp.asarray(edge + np.array([-1, 1]) * np.logspace(-6, -2, 20)[:, None], "float32").reshape(-1, 1)
    stencil = make_stencil(mpm.BSpline(order), mpm.MLSGradient(), grid, grid.window(x), x, affine=True)

    def weights(of):
        """Of each particle at each node."""
        one = jnp.eye(len(x), dtype="float32")
        return sums.scatter(of, one, None, grid.size)

    found, expected = (
        np.asarray(jax.jit(weights)(dataclasses.replace(stencil, places=p))) for p in (stencil.places, None)
    )
    assert (expected[expected > 0] < 1e-2).any()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def averaged(of, index, w, g, given, gradients, k=2, side=SIDE):
    """Whole weights and averages of k columns, of positive numbers: some nodes are light, and some are empty."""
    positive = index, jnp.abs(w), g, jnp.asarray(0.3, w.dtype), jnp.abs(given[: k + 1])
    parts = positive if gradients is None else (*positive, gradients[:, :k])
    return of(*parts, size=2 * side ** len(index))


averaged_by_library = partial(averaged, partial(_average._average_p.bind, batched=0))
averaged_as_written = partial(averaged, partial(_average._average, unroll=False))


@NEEDS_LIBRARY
@pytest.mark.parametrize("p", [45, *thorough(3000)])
def test_wide_windows_agree(p, choose):
    """Of more nodes than a cache holds the library looks at those alone that particles reach: other ones each time."""
    choose("native")
    wide = {"k": 2, "side": 70}
    pairs = [tuple(map(jax.jit, (native, written)))]
    pairs.append(tuple(jax.jit(partial(of, **wide)) for of in (averaged_by_library, averaged_as_written)))
    for seed in (0, 1, 0):
        index, w, g, given, nodes = problem(3, 3, 3, p, "float32", seed, side=70)
        assert nodes.nbytes > 2**21
        for (library, plain), args in zip(pairs, ((given, nodes), (given[0], given[1:])), strict=True):
            agree(library(index, w, g, *args), plain(index, w, g, *args), "float32")


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "k"), [(2, 2), *thorough((1, 1), (2, 4), (3, 3))])
def test_averages_agree(d, k, dtype, choose):
    """With gradients and without, with nodes that are empty, indices beyond the window, for no particle, in a batch."""
    choose("native")
    library, plain = (jax.jit(partial(of, k=k)) for of in (averaged_by_library, averaged_as_written))
    for p in (45, 1, 0):
        index, w, g, given, _ = problem(d, 3, k + 1, p, dtype)
        for gradients in (given[1:], None):
            found = library(index, w, g, given[0], gradients)
            agree(found, plain(index, w, g, given[0], gradients), dtype)
            assert (found[0] == 0).any()
    pair = [problem(d, 3, k + 1, 45, dtype, seed=seed) for seed in (0, 1)]
    each = [(index, w, g, given[0], given[1:]) for index, w, g, given, _ in pair]
    together = jax.jit(jax.vmap(partial(averaged_by_library, k=k)))(*map(jnp.stack, zip(*each, strict=True)))
    jax.tree.map(
        lambda a, *b: np.testing.assert_array_equal(a, jnp.stack(b)), together, *(library(*one) for one in each)
    )


@NEEDS_LIBRARY
@pytest.mark.parametrize("gradients", [True, *thorough(False)])
def test_derivatives_of_averages_agree(gradients, choose):
    """First in both modes and second, by everything, and of a batch."""
    choose("native")
    index, w, g, given, _ = problem(2, 3, 3, 45, "float64", wild=False)
    floats = w, g, given[0], given[1:] if gradients else None
    along = jax.tree.map(lambda a: jnp.sin(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), floats)

    def derivatives(of):
        def loss(floats):
            return sum((jnp.cos(jnp.arange(a.size)).reshape(a.shape) * a**2).sum() for a in of(index, *floats))

        def slope(f):
            return lambda floats: jax.jvp(f, (floats,), (along,))[1]

        every = slope(loss), jax.grad(loss), slope(slope(loss)), slope(jax.grad(loss)), jax.grad(slope(loss))
        both = jax.tree.map(lambda a: jnp.stack([a, 1.5 * a]), floats)
        return jax.jit(lambda a: [f(a) for f in every])(floats), jax.jit(jax.vmap(jax.grad(loss)))(both)

    agree(derivatives(averaged_by_library), derivatives(averaged_as_written), "float64", 500)


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_resistances_agree(d, dtype):
    """With indices beyond the window, for one particle and none, and in a batch that shares its matrices."""
    run, parts = jax.jit(resisted), jax.jit(resisted_in_parts)
    for p in (45, 1, 0):
        args = resistance(d, p, dtype)
        agree(run(*args), parts(*args), dtype)
    index, w, g, upper, u = resistance(d, 45, dtype)
    both = jnp.stack([u, resistance(d, 45, dtype, seed=7)[-1]])
    together = jax.jit(jax.vmap(resisted, in_axes=(None, None, None, None, 0)))(index, w, g, upper, both)
    np.testing.assert_array_equal(together, jnp.stack([run(index, w, g, upper, one) for one in both]))


@NEEDS_LIBRARY
@pytest.mark.parametrize("d", [1, *thorough(2, 3)])
def test_derivatives_of_resistances_agree(d):
    """First in both modes, second, and under remat, by everything."""
    index, *floats = resistance(d, 9, "float64", wild=False)
    to, *along = (jnp.sin(3 + jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in (floats[-1], *floats))

    def derivatives(of):
        def loss(*args):
            return (to * of(index, *args) ** 2).sum()

        def slope(f):
            return lambda *args: jax.jvp(f, args, tuple(along))[1]

        by = (0, 1, 2, 3)
        grad = jax.grad(jax.checkpoint(loss), by)
        every = slope(loss), grad, slope(slope(loss)), slope(grad), jax.grad(slope(loss), by)
        return jax.jit(lambda *a: [f(*a) for f in every])(*floats)

    agree(derivatives(resisted), derivatives(resisted_in_parts), "float64")


@NEEDS_LIBRARY
def test_a_resistance_is_one_call_and_symmetric(choose):
    """Forward and transposed: no gather or scatter is left, and ⟨a, H b⟩ = ⟨H a, b⟩."""
    choose("native")
    index, w, g, upper, a = resistance(2, 30, "float64", wild=False)

    def back(a):
        return jax.vjp(lambda u: resisted(index, w, g, upper, u), a)[1](a)[0]

    for program in (lambda a: resisted(index, w, g, upper, a), back):
        text = jax.jit(program).lower(a).as_text()
        assert "mpmjax_resist" in text
        assert "mpmjax_gather" not in text
        assert "mpmjax_scatter" not in text
    agree(jax.jit(back)(a), resisted(index, w, g, upper, a), "float64")


@NEEDS_LIBRARY
def test_combined_vectors_agree(choose):
    """In place or not, with blocks of zeros passed over, in a batch, and their derivative; two sums and a norm."""
    choose("native")
    rng = np.random.default_rng(0)
    a, b, c, d, weight = rng.normal(size=(5, 2, 1000))
    some = np.arange(1000) % 500 < 100
    a, b, c, d = (jnp.asarray(v * some) for v in (a, b, c, d))
    weight, (s, t) = jnp.asarray(weight), jnp.asarray([0.3, -2.0])

    def combined(onto):
        def of(a, b, c, d, weight, s):
            active = residuals.active_blocks(a != 0, b != 0, c != 0, d != 0)
            assert active.shape == (16,)
            return tuple(residuals.combine_p[onto].bind(a, b, c, d, jnp.stack([s, t]), weight, active, batched=0))

        return of

    def expected(a, b, c, d, weight, s):
        z = c + t * d
        return a + s * b, z, (weight * z**2).sum()

    over = partial(jax.vmap, in_axes=(0, 0, 0, 0, 0, None))
    args = a, b, c, d, weight, s
    along = tuple(jnp.cos(v) for v in args)
    for onto in (0, 1):
        assert "mpmjax_combine" in jax.jit(combined(onto)).lower(*(v[0] for v in args[:5]), s).as_text()
        agree(jax.jit(over(combined(onto)))(*args), over(expected)(*args), "float64")
        agree(*(jax.jvp(jax.jit(over(f)), args, along)[1] for f in (combined(onto), expected)), "float64")


@NEEDS_LIBRARY
@pytest.mark.parametrize("each", [1, 2, 3])
def test_products_of_vectors_agree(choose, each):
    """W⁻¹A v and vᵀA v, with nodes that are held and empty, in a batch, and their derivatives; a force that is not
    finite where it is held is not felt."""
    choose("native")
    rng = np.random.default_rng(each)
    force, v, weight = rng.normal(size=(3, 2, 400 * each))
    some = np.arange(400 * each) % 300 < 100
    free = some & (rng.uniform(size=some.shape) < 0.7)
    force[:, ~free] = np.nan
    v, mass, weight = v * some, rng.uniform(1, 2, size=(2, 400)), 1 + weight**2
    some, free = jnp.asarray(some), jnp.asarray(free)

    def agreeing(*args):
        return tuple(product_p.bind(*args[:4], free, args[4], residuals.active_blocks(some), batched=0))

    def expected(force, v, mass, factor, weight):
        image = jnp.where(free, jnp.repeat(mass, each) * v + factor * jnp.where(free, force, 0), v)
        return image / weight, (v * image).sum()

    args = tuple(map(jnp.asarray, (force, v, mass, 0.3, weight)))
    over = partial(jax.vmap, in_axes=(0, 0, 0, None, 0))
    assert "mpmjax_product" in jax.jit(agreeing).lower(*(a[0] if a.ndim else a for a in args)).as_text()
    agree(jax.jit(over(agreeing))(*args), over(expected)(*args), "float64")
    finite = (jnp.where(free, args[0], 0), *args[1:])
    along = tuple(jnp.cos(a) for a in finite)
    agree(*(jax.jvp(jax.jit(over(f)), finite, along)[1] for f in (agreeing, expected)), "float64")


@NEEDS_LIBRARY
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_solves_agree(choose, d):
    """Native and by XLA, in a batch whose members end after other numbers of steps: at the tolerance, after restarts
    from a guess far off, at the most steps, at once, at the limit of the precision. Each is bit for bit what it is
    alone, beside one that is not finite too."""
    rng = np.random.default_rng(d)
    index, w, g, upper, u = resistance(d, 30, "float64", wild=False, side=8)
    size = u.size
    row, column = np.triu_indices(d * d)
    upper = jnp.asarray(np.where((row == column)[:, None], 2.0, 0.1) * np.ones((len(upper), 30)))
    mass, free = jnp.asarray(rng.uniform(1, 2, len(u))), jnp.asarray(rng.uniform(size=size) < 0.7)
    r, weight = jnp.where(free, jnp.asarray(rng.normal(size=size)), 0), jnp.asarray(rng.uniform(1, 2, size))
    active = residuals.active_blocks(free)

    def run(factor, steps, r, rtol, far):
        stencil = Stencil(index, w, g, None, w[:, 0], index[0, 0] >= 0)
        stiffness = ParticleStiffness(upper, stencil, Mirror(()))
        matrices = ImplicitOperator(mass, factor, stiffness, Projection(free.reshape(u.shape)))
        space = residuals._DiagonalSpace(matrices.product, weight, active)
        return residuals.solve_particle_matrices(matrices, space, r, far * x, rtol, steps)

    x = jnp.where(free, jnp.asarray(rng.normal(size=size)), 0)
    given = (
        jnp.asarray([1e-2, 1e-4, 1e-2, 1.0, 1.0, 1.0, 0.1]),
        jnp.asarray([500.0, 500, 500, 5, 0, 500, 500]),
        jnp.stack([r] * 6 + [r / 0]),
        jnp.asarray([1e-6, 1e-6, 1e-12, 1e-6, 1e-6, 1e-18, 1e-6]),
        jnp.asarray([0.0, 0, 1e9, 0, 1, 0, 0]),
    )
    found = {}
    for backend in ("native", "xla"):
        choose(backend)
        together, alone = jax.jit(jax.vmap(run)), jax.jit(run)
        assert ("mpmjax_solve" in together.lower(*given).as_text()) == (backend == "native")
        found[backend] = together(*given)
        if backend == "native":
            for k in range(7):
                ended = alone(*(a[k] for a in given))
                for one, member in zip(jax.tree.leaves(ended), jax.tree.leaves(found[backend]), strict=True):
                    np.testing.assert_array_equal(one, member[k])
    native, xla = found["native"], found["xla"]
    assert native.k[0] > native.k[1] > 0
    assert list(native.k[3:5]) == [5, 0]
    assert native.stalled[5]
    assert not native.stalled[:3].any()
    assert np.isfinite(native.x[:6]).all()
    assert (np.sqrt(native.rr) <= given[3] * native.b_norm)[:3].all()
    for name in ("x", "rr", "k", "radius", "breakdown", "indefinite", "b_norm", "x_norm"):
        ours, theirs = (np.asarray(getattr(one, name)) for one in (native, xla))
        assert_close(ours[[0, 1, 3, 4]], theirs[[0, 1, 3, 4]], rtol=1e-9)
    for k in (2, 5):  # down to rounding the steps are not the same
        assert_close(native.x[k], xla.x[k], rtol=1e-9)


@NEEDS_LIBRARY
def test_the_library_is_called_and_only_on_a_cpu(choose):
    """By default on a CPU, not when XLA is asked for, not for another platform, not for a program that XLA divides."""
    args = problem(2, 3, 3, 10, "float32")

    def program(platform):
        return jax.jit(native).trace(*args).lower(lowering_platforms=(platform,)).as_text()

    for name, called in (("native", True), ("xla", False), ("", True)):
        choose(name)
        assert [f"mpmjax_{kind}" in program("cpu") for kind in ("gather", "scatter", "pull")] == 3 * [called]
        assert "mpmjax_" not in program("cuda")


@NEEDS_LIBRARY
@pytest.mark.parametrize("p", [0, 1])
def test_few_particles(p):
    """None gives nodes of zero and arrays of no length; one is summed as among others."""
    args = problem(2, 3, 3, p, "float32", wild=False)
    found, expected = jax.jit(native)(*args), jax.jit(written)(*args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-5), found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("place", ["one cell", "anywhere"])
def test_many_particles_on_many_threads(place):
    """Enough for several threads, all in one cell or disordered: right, and with the same bits in every run."""
    index, *floats = problem(2, 3, 3, 30_000, "float32")
    if place == "one cell":
        index = jnp.broadcast_to(index[..., :1], index.shape)
    run = jax.jit(native)
    found = [run(index, *floats) for _ in range(5)]
    for again in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, again, found[0])
    wide = jax.jit(written)(index, *(a.astype("float64") for a in floats))
    jax.tree.map(lambda a, b: assert_close(a.astype("float64"), b, 2e-4), found[0], wide)


@NEEDS_LIBRARY
@pytest.mark.parametrize("place", ["in order", "anywhere"])
def test_resistances_of_many_particles_on_many_threads(place):
    """In one pass, and with what particles give stored first, where ranges of nodes share most of them."""
    index, w, g, upper, u = resistance(2, 30_000, "float32", side=40)
    if place == "in order":
        order = jnp.argsort(index[0, 0])
        index, w, g, upper = (a[..., order] for a in (index, w, g, upper))
    run = jax.jit(resisted)
    found = [run(index, w, g, upper, u) for _ in range(5)]
    for again in found[1:]:
        np.testing.assert_array_equal(again, found[0])
    wide = jax.jit(resisted_in_parts)(index, *(a.astype("float64") for a in (w, g, upper, u)))
    assert_close(found[0].astype("float64"), wide, 2e-4)


@NEEDS_LIBRARY
def test_a_particle_that_is_not_finite_spoils_its_own_nodes_alone():
    """As in XLA: the same entries are finite."""
    index, w, g, given, nodes = problem(2, 3, 3, 20, "float32")
    args = index, w.at[..., 5].set(jnp.nan), g.at[..., 5].set(jnp.nan), given, nodes
    found, expected = jax.jit(native)(*args), jax.jit(written)(*args)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(jnp.isfinite(a), jnp.isfinite(b)), found, expected)


@NEEDS_LIBRARY
def test_wrong_arrays_are_refused():
    """By the library itself: arrays whose shapes do not fit each other end in an error, not in a read beyond them."""
    index, w, g, _, nodes = problem(2, 3, 3, 10, "float32")
    bad = jax.ffi.ffi_call("mpmjax_gather", [jax.ShapeDtypeStruct((3, 10), "float32")] * 3)
    assert mpm.native.backend().name == "native"
    with pytest.raises(Exception, match="shapes do not fit"):
        jax.block_until_ready(
            jax.jit(lambda *a: bad(*a, placed=np.bool_(False), differential=np.bool_(False)))(
                index, w[..., :9], g, nodes
            )
        )


@NEEDS_LIBRARY
@pytest.mark.parametrize("method", [mpm.Explicit(), *thorough(mpm.SemiImplicit())])
def test_runs_agree(choose, method):
    """A few steps and their gradient by both back ends."""
    scene, particles = block(2)

    start = mpm.prepare(scene, particles)
    v = jnp.asarray(np.random.default_rng(0).normal(size=particles.v.shape))

    def outcome(v):
        end = mpm.rollout(scene, eqx.tree_at(lambda p: p.v, start, v), steps=3, dt=1e-3, method=method)
        return (end.x**2).sum() + (end.F**2).sum(), end.x

    found = {}
    for name in ("native", "xla"):
        choose(name)
        found[name] = jax.value_and_grad(outcome, has_aux=True)(v)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-10), found["native"], found["xla"])


def test_one_variable_chooses(choose):
    """MPMJAX_BACKEND is native, xla or nothing; native where there is no library is an error that says why."""
    choose("xla")
    assert mpm.native.backend().name == "xla"
    assert "MPMJAX_BACKEND=xla" in str(mpm.native.backend())
    choose("cuda")
    with pytest.raises(ValueError, match="must be native or xla"):
        mpm.native.backend()


@pytest.fixture
def other_library(monkeypatch):
    """Another library, or none, in the place of the installed one."""
    yield lambda path: (monkeypatch.setattr(_library, "PATH", path), _library.library.cache_clear())
    monkeypatch.undo()
    _library.library.cache_clear()
    jax.clear_caches()


def test_without_a_library_xla_sums(other_library, choose, tmp_path):
    """It says why, and does not warn; asked for, it is an error."""
    other_library(tmp_path / "none.so")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "found no C++ compiler" in str(mpm.native.backend())
    choose("native")
    with pytest.raises(ValueError, match="no library of them"):
        mpm.native.backend()


def test_a_library_that_does_not_fit_is_warned_of_once(other_library, tmp_path):
    """What is no library at all."""
    broken = tmp_path / "broken.so"
    broken.write_bytes(b"not a library")
    other_library(broken)
    with pytest.warns(UserWarning, match="are not used"):
        assert mpm.native.backend().name == "xla"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert mpm.native.backend().name == "xla"


@NEEDS_LIBRARY
def test_a_library_of_another_version_is_not_used(other_library, monkeypatch):
    """Its interface has another number."""
    monkeypatch.setattr(_library, "INTERFACE", -1)
    other_library(_library.PATH)
    with pytest.warns(UserWarning, match="interface"):
        assert mpm.native.backend().name == "xla"


def test_numbers_that_have_to_be_equal_are():
    """The interface of the library and of the package."""
    assert f"MPMJAX_INTERFACE={_library.INTERFACE})" in (ROOT / "native" / "CMakeLists.txt").read_text()
