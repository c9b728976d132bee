"""The native sums are those of XLA to rounding, whatever they are given, and one place chooses between them."""

import itertools
import os
import platform
import subprocess
import sys
import warnings
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NEEDS_LIBRARY, assert_close, block, slow, thorough

import mpmjax as mpm
from mpmjax.discretisation import Stencil, _fused_sums, _sums as sums, _transfer, basis_attributes, make_stencil
from mpmjax.discretisation._stencil import basis_of
from mpmjax.discretisation._sums import Group
from mpmjax.implicit import ImplicitOperator, ParticleStiffness, Projection, _solver as solver
from mpmjax.implicit._operator import active_blocks, combine_onto, rest_of_product
from mpmjax.native import AbstractBackend, _backend, _library
from mpmjax.potential import Mirror

ROOT = Path(__file__).parents[1]
SIDE = 6


@pytest.fixture(autouse=True)
def as_if_nothing_were_asked(monkeypatch):
    monkeypatch.delenv("MPMJAX_BACKEND", raising=False)


def basis_for(d, s, *, side=SIDE, periodic=False):
    """Of s nodes along an axis, with the gradient of moving least squares."""
    kernel = mpm.BSpline(s - 1)
    return basis_of(kernel, mpm.Grid((side,) * d, 1.0, periodic=periodic), kernel.moments)


def problem(d, s, c, p, dtype, seed=0, *, wild=True, side=SIDE):
    """Places, what particles give, and node values. With `wild` some particles reach over the window's edges, and one
    is far from it."""
    rng = np.random.default_rng(seed)
    first = rng.integers(-wild, side - s + 1 + wild, size=(d, p)).astype("int32")
    if wild and p > 3:
        first[:, 3] = rng.integers(-(2**30), 2**30, size=d)
    xi = (first + rng.uniform(0, 1, (d, p)) + (s - 2) / 2).astype(dtype)
    given, nodes = (rng.normal(size=shape).astype(dtype) for shape in ((d + 1, c, p), (side**d, c)))
    return tuple(jnp.asarray(a, a.dtype) for a in (xi, given, nodes))  # without a dtype: a program each


def first_in_window(xi, s):
    """Places moved by whole windows, so that the first of s nodes lies in it."""
    return (xi - (s - 2) / 2) % SIDE + (s - 2) / 2


def resistance(d, p, dtype, seed=0, *, wild=True, side=SIDE):
    """What `resist` is given: places, upper triangles and a displacement."""
    xi, _, u = problem(d, 3, d, p, dtype, seed, wild=wild, side=side)
    upper = np.random.default_rng(seed + 1).normal(size=(d * d * (d * d + 1) // 2, p)).astype(dtype)
    return xi, jnp.asarray(upper, dtype), u


def resisted(xi, upper, u):
    side = round(len(u) ** (1 / len(xi)))
    return _fused_sums.resist_sum(xi, upper, u, basis=basis_for(len(xi), 3, side=side))


def resisted_in_parts(xi, upper, u):
    """By a gather, a matrix a particle and a scatter."""
    side = round(len(u) ** (1 / len(xi)))
    return _fused_sums.resist_sum.function(xi, upper, u, basis=basis_for(len(xi), 3, side=side))


def summed(basis, xi, given, nodes, valued=True, graded=True):
    """All three sums, of the value and the gradients, either or both; with `graded` a number of columns, only so many
    of these."""
    gradients = given[1:] if graded is True else given[1:, :graded]
    rows = [given[:1]] * valued + [gradients] * (graded is not False)
    groups = (Group(basis.value),) * valued + (Group(basis.gradient),) * (graded is not False)
    both = Group(basis.value), Group(basis.gradient)
    return (
        sums.gather_sum(xi, None, nodes, basis=basis, groups=both),
        sums.scatter_sum(xi, None, rows, basis=basis, groups=groups, size=len(nodes)),
        sums.pull_sum(xi, nodes, rows, basis=basis, groups=groups, gathered=True),
    )


def by_each(choose, function, *args):
    """What a function gives by the library, and by XLA."""
    found = []
    for name in ("native", "xla"):
        choose(name)
        found.append(jax.jit(lambda *args: function(*args))(*args))
    return found


def agree(found, expected, dtype, roundings=100):
    """Equal to so many roundings of the largest number."""
    jax.tree.map(lambda a, b: assert_close(a, b, roundings * float(jnp.finfo(dtype).eps)), found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "s", "c"), [(2, 3, 3), *thorough((1, 2, 1), (1, 4, 5), (2, 4, 4), (3, 2, 2), (3, 3, 6))])
def test_back_ends_agree(choose, d, s, c, dtype):
    """Over random inputs, whichever part is given, also gradients of fewer columns, with nodes beyond the window;
    around periodic axes; of squares; and in a batch."""
    args = problem(d, s, c, 45, dtype)
    basis, around = basis_for(d, s), basis_for(d, s, periodic=True)
    choices = ({}, {"graded": False}, {"valued": False}, {"graded": c - 1})

    def each(*args):
        inside = (first_in_window(args[0], s), *args[1:])
        squared = Stencil(inside[0], jnp.ones(()), jnp.ones(45, bool), basis).squared.basis
        return [summed(basis, *args, **which) for which in choices], [summed(of, *inside) for of in (around, squared)]

    agree(*by_each(choose, each, *args), dtype)
    other = problem(d, s, c, 45, dtype, seed=1)
    both = [jnp.stack(pair) for pair in zip(args, other, strict=True)]
    choose("native")
    alone = [jax.jit(each)(*one) for one in (args, other)]
    together = jax.jit(jax.vmap(each))(*both)
    jax.tree.map(lambda a, *b: np.testing.assert_array_equal(a, jnp.stack(b)), together, *alone)


@NEEDS_LIBRARY
@pytest.mark.parametrize(
    ("d", "graded", "orders"),
    [(1, 1, 6), *thorough((1, True, 6), (2, True, 6), (2, 1, 3), (3, True, 3)), *slow((2, 1, 6), (3, True, 6))],
)
def test_derivatives_agree(choose, d, graded, orders):
    """First in both modes and second in all four orders of modes, of which the first stands for all where they take
    long to compile, by everything, gradients of fewer columns too. All within the window: beyond it, where a gather
    clips, its derivative drops."""
    floats = problem(d, 3, 2, 9, "float64", wild=False)
    of = partial(summed, basis_for(d, 3), graded=graded)
    to = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), of(*floats))
    along = [jnp.sin(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in floats]

    def derivatives(*floats):
        def loss(*args):
            parts = jax.tree.map(lambda t, s: (t * s**2).sum(), to, of(*args))
            return sum(jax.tree.leaves(parts))

        def slope(f):
            return lambda *args: jax.jvp(f, args, tuple(along))[1]

        by = (0, 1, 2)
        grad = jax.grad(loss, by)
        back = jax.grad(lambda *a: sum((g * b).sum() for g, b in zip(grad(*a), along, strict=True)), by)
        each = slope(loss), grad, slope(grad), slope(slope(loss)), jax.grad(slope(loss), by), back
        return [f(*floats) for f in each[:orders]]

    agree(*by_each(choose, derivatives, *floats), "float64", 500)  # slopes along all at once are sums that cancel


@NEEDS_LIBRARY
@pytest.mark.parametrize("order", [1, 2, 3])
def test_small_weights_are_right(choose, order):
    """Of particles that hardly reach a node, in single precision: each weight, not only their largest."""
    grid = mpm.Grid((12,), 1.0)
    edge = 4.0 + (order + 1) % 2 / 2
    x = jnp.asarray(edge + np.array([-1, 1]) * np.logspace(-6, -2, 20)[:, None], "float32").reshape(-1, 1)
    stencil = make_stencil(mpm.BSpline(order), mpm.MLSGradient(), grid, grid.window(x), x)
    choose("native")
    found = sums.scatter(stencil, jnp.eye(len(x), dtype="float32"), None, grid.size)  # of each particle at each node
    expected = np.zeros(found.shape)
    np.put_along_axis(expected, np.asarray(stencil.index), np.asarray(stencil.weight), axis=0)
    assert (expected[expected > 0] < 1e-2).any()
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def averaged(xi, given, gradients, k=2, side=SIDE, s=3):
    """Whole weights and averages of k columns, of positive numbers: some nodes are light, and some are empty."""
    basis = basis_for(len(xi), s, side=side)
    rows, groups = [jnp.abs(given[None, : k + 1])], [Group(basis.value)]
    if gradients is not None:
        rows, groups = [*rows, gradients[:, :k]], [*groups, Group(basis.gradient)]
    params = {"basis": basis, "groups": tuple(groups), "size": 2 * side ** len(xi)}
    return _fused_sums.average_sum(xi, jnp.asarray(0.3, xi.dtype), rows, **params)


@NEEDS_LIBRARY
@pytest.mark.parametrize("p", [45, *thorough(3000)])
def test_wide_windows_agree(p, choose):
    """Of more nodes than a cache holds the library looks at those alone that particles reach: other ones each time."""
    problems = [problem(3, 3, 3, p, "float32", seed, side=70) for seed in (0, 1, 0)]
    assert all(nodes.nbytes > 2**21 for *_, nodes in problems)

    def both(xi, given, nodes):
        averages = averaged(xi, given[0], given[1:], side=70)
        return summed(basis_for(3, 3, side=70), xi, given, nodes), averages

    found = []
    for name in ("native", "xla"):
        choose(name)
        found.append(list(itertools.starmap(jax.jit(both), problems)))
    agree(*found, "float32")


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "k"), [(2, 2), *thorough((1, 1), (2, 4), (3, 3))])
def test_averages_agree(d, k, dtype, choose):
    """With gradients and without, with nodes that are empty, nodes beyond the window, for no particle, in a batch."""
    of = partial(averaged, k=k)
    for p in (45, 1, 0):
        xi, given, _ = problem(d, 3, k + 1, p, dtype)
        for gradients in (given[1:], None):
            found, expected = by_each(choose, of, xi, given[0], gradients)
            agree(found, expected, dtype)
            assert (found[0] == 0).any()
    choose("native")
    pair = [problem(d, 3, k + 1, 45, dtype, seed=seed) for seed in (0, 1)]
    each = [(xi, given[0], given[1:]) for xi, given, _ in pair]
    together = jax.jit(jax.vmap(of))(*map(jnp.stack, zip(*each, strict=True)))
    alone = [jax.jit(of)(*one) for one in each]
    jax.tree.map(lambda a, *b: np.testing.assert_array_equal(a, jnp.stack(b)), together, *alone)


@NEEDS_LIBRARY
@pytest.mark.parametrize("gradients", [True, *thorough(False)])
def test_derivatives_of_averages_agree(gradients, choose):
    """First in both modes and second, by everything, and of a batch."""
    xi, given, _ = problem(2, 3, 3, 45, "float64", wild=False)
    floats = xi, given[0], given[1:] if gradients else None
    along = jax.tree.map(lambda a: jnp.sin(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), floats)

    def derivatives(floats):
        def loss(floats):
            return sum((jnp.cos(jnp.arange(a.size)).reshape(a.shape) * a**2).sum() for a in averaged(*floats))

        def slope(f):
            return lambda floats: jax.jvp(f, (floats,), (along,))[1]

        every = slope(loss), jax.grad(loss), slope(slope(loss)), slope(jax.grad(loss)), jax.grad(slope(loss))
        both = jax.tree.map(lambda a: jnp.stack([a, 1.5 * a]), floats)
        return [f(floats) for f in every], jax.vmap(jax.grad(loss))(both)

    agree(*by_each(choose, derivatives, floats), "float64", 500)


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_resistances_agree(d, dtype):
    """With indices beyond the window, for one particle and none, and in a batch that shares its matrices."""
    run, parts = jax.jit(resisted), jax.jit(resisted_in_parts)
    for p in (45, 1, 0):
        args = resistance(d, p, dtype)
        agree(run(*args), parts(*args), dtype)
    *rest, u = resistance(d, 45, dtype)
    both = jnp.stack([u, resistance(d, 45, dtype, seed=7)[-1]])
    together = jax.jit(jax.vmap(resisted, in_axes=(None, None, 0)))(*rest, both)
    np.testing.assert_array_equal(together, jnp.stack([run(*rest, one) for one in both]))


def transfers(d, order, dtype):
    """P2G with each of its terms and with a push, and G2P with an F and without, as a function, and its arguments, of
    which the first is a spacing, a step and a factor."""
    rng = np.random.default_rng(0)
    numbers = [jnp.asarray(rng.normal(size=shape), dtype) for shape in ((d, 45), *[(d, d, 45)] * 3, (SIDE**d, d))]
    scale, place = jnp.asarray(0.7, dtype), jnp.asarray(rng.uniform(1.5, 2.5, (d, 45)), dtype)

    def moved(scale, place, v, A, B, C, nodes):
        grid, window = mpm.Grid((SIDE,) * d, scale), jnp.zeros(d, "int32")
        stencil = make_stencil(mpm.BSpline(order), mpm.MLSGradient(), grid, window, place.T)
        mass, params = 1 + v[0] ** 2, {"basis": stencil.basis, "size": grid.size}
        terms = (C, (scale, A, B), v[:, 0]), (None, (scale, A, None), None), (C, None, v[:, 1])
        terms += (C, (scale, (mass, v[0]), B), None), (C, (scale, (None, mass), None), v[:, 2])
        sums = [_transfer.p2g_sum(stencil, 1e-3 * scale, mass, v, *some, **params) for some in terms]
        return sums, [_transfer.g2p_sum(stencil, nodes, scale, v, F, basis=stencil.basis) for F in (A, None)]

    return moved, (scale, place, *numbers)


def pairs_of(args):
    """Two members of a batch, the second with other numbers."""
    return [jnp.stack([a, 0.9 * a if a.ndim == 0 else a[..., ::-1]]) for a in args]


@NEEDS_LIBRARY
@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
@pytest.mark.parametrize(("d", "order"), [(3, 2), (2, 3), *thorough((1, 1), (2, 1))])
def test_transfers_agree(d, order, dtype, choose):
    """One call each, in batches, with derivatives."""
    moved, args = transfers(d, order, dtype)
    along = tuple(jnp.cos(3 * a) for a in args)
    agree(*by_each(choose, moved, *args), dtype)
    agree(*by_each(choose, lambda *args: jax.jvp(moved, args, along)[1], *args), dtype, roundings=1000)
    agree(*by_each(choose, jax.vmap(moved), *pairs_of(args)), dtype)
    choose("native")
    text = jax.jit(lambda *args: moved(*args)).lower(*args).as_text()
    assert [text.count(f"@mpmjax_{kernel}(") for kernel in ("p2g", "g2p", "gather", "average")] == [5, 2, 0, 0]


@NEEDS_LIBRARY
@pytest.mark.parametrize("d", [1, *thorough(2, 3)])
def test_derivatives_of_resistances_agree(d):
    """First in both modes, second, and under remat, by everything."""
    floats = resistance(d, 9, "float64", wild=False)
    to, *along = (jnp.sin(3 + jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape) for a in (floats[-1], *floats))

    def derivatives(of):
        def loss(*args):
            return (to * of(*args) ** 2).sum()

        def slope(f):
            return lambda *args: jax.jvp(f, args, tuple(along))[1]

        by = (0, 1, 2)
        grad = jax.grad(jax.checkpoint(loss), by)
        every = slope(loss), grad, slope(slope(loss)), slope(grad), jax.grad(slope(loss), by)
        return jax.jit(lambda *a: [f(*a) for f in every])(*floats)

    agree(derivatives(resisted), derivatives(resisted_in_parts), "float64")


@NEEDS_LIBRARY
def test_a_resistance_is_one_call_and_symmetric(choose):
    """Forward and transposed: no gather or scatter is left, and ⟨a, H b⟩ = ⟨H a, b⟩."""
    choose("native")
    *rest, a = resistance(2, 30, "float64", wild=False)

    def back(a):
        return jax.vjp(lambda u: resisted(*rest, u), a)[1](a)[0]

    for program in (lambda a: resisted(*rest, a), back):
        text = jax.jit(program).lower(a).as_text()
        assert "mpmjax_resist" in text
        assert "mpmjax_gather" not in text
        assert "mpmjax_scatter" not in text
    agree(jax.jit(back)(a), resisted(*rest, a), "float64")


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
            active = active_blocks(a != 0, b != 0, c != 0, d != 0)
            assert active.shape == (16,)
            return tuple(combine_onto[onto](a, b, c, d, jnp.stack([s, t]), weight, active))

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
        return tuple(rest_of_product(*args[:4], free, args[4], active_blocks(some)))

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
    alone, beside one that is not finite where it is held; the third is the solution."""
    rng = np.random.default_rng(d)
    xi, upper, u = resistance(d, 30, "float64", wild=False, side=8)
    size = u.size
    row, column = np.triu_indices(d * d)
    upper = jnp.asarray(np.where((row == column)[:, None], 2.0, 0.1) * np.ones((len(upper), 30)))
    mass, free = jnp.asarray(rng.uniform(1, 2, len(u))), jnp.asarray(rng.uniform(size=size) < 0.7)
    r, weight = jnp.asarray(rng.normal(size=size)), jnp.asarray(rng.uniform(1, 2, size))
    active = active_blocks(free)

    def matrices(factor):
        stencil = Stencil(xi, jnp.asarray(1.0), xi[0] >= 0, basis_for(d, 3, side=8))
        stiffness = ParticleStiffness(upper, stencil, Mirror(()))
        return ImplicitOperator(mass, factor, stiffness, Projection(free.reshape(u.shape)))

    def run(factor, steps, r, rtol, far):
        return solver.solve_particle_matrices(matrices(factor), weight, active, r, far * x, rtol, steps)

    x = jnp.asarray(rng.normal(size=size))  # neither is zero where nothing is free
    given = (
        jnp.asarray([3.0, 1e-4, 3.0, 1.0, 1.0, 1.0, 0.1]),
        jnp.asarray([500.0, 500, 500, 5, 0, 500, 500]),
        jnp.stack([r] * 6 + [jnp.where(free, r, r / 0)]),
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
    assert np.isnan([native.rr[6], xla.rr[6]]).all()
    assert (np.sqrt(native.rr) <= given[3] * native.b_norm)[:3].all()
    for name in ("x", "rr", "k", "radius", "breakdown", "indefinite", "b_norm", "x_norm"):
        ours, theirs = (np.asarray(getattr(one, name)) for one in (native, xla))
        assert_close(ours[[0, 1, 3, 4]], theirs[[0, 1, 3, 4]], rtol=1e-9)
    solution = np.linalg.solve(matrices(given[0][2]).as_matrix(), weight * r)
    assert_close(native.x[2], solution, rtol=1e-9)
    left = r - matrices(given[0][4]).as_matrix() @ x / weight  # of the start; what is held is solved
    assert_close(native.rr[4], (weight * left**2)[free].sum(), rtol=1e-9)
    for k in (2, 5):  # down to rounding the steps are not the same
        assert_close(native.x[k], xla.x[k], rtol=1e-9)


@NEEDS_LIBRARY
def test_the_library_is_called_and_only_on_a_cpu(choose):
    """By default on a CPU, not when XLA is asked for, not for another platform, not for a program that XLA divides."""
    args = problem(2, 3, 3, 10, "float32")

    def program(platform):
        return jax.jit(partial(summed, basis_for(2, 3))).trace(*args).lower(lowering_platforms=(platform,)).as_text()

    for name, called in (("native", True), ("xla", False), ("", True)):
        choose(name)
        assert [f"mpmjax_{kind}" in program("cpu") for kind in ("gather", "scatter", "pull")] == 3 * [called]
        assert "mpmjax_" not in program("cuda")


@NEEDS_LIBRARY
@pytest.mark.parametrize("p", [0, 1])
def test_few_particles(choose, p):
    """None gives nodes of zero and arrays of no length; one is summed as among others."""
    args = problem(2, 3, 3, p, "float32", wild=False)
    found, expected = by_each(choose, partial(summed, basis_for(2, 3)), *args)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-5), found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("place", ["one cell", "anywhere"])
def test_many_particles_on_many_threads(choose, place):
    """Enough for several threads, all in one cell or disordered: right, and with the same bits in every run."""
    xi, *floats = problem(2, 3, 3, 30_000, "float32")
    if place == "one cell":
        xi = jnp.floor(xi[..., :1] - 0.5) + 0.5 + xi % 1
    of = partial(summed, basis_for(2, 3))
    run = jax.jit(of)
    found = [run(xi, *floats) for _ in range(5)]
    for again in found[1:]:
        jax.tree.map(np.testing.assert_array_equal, again, found[0])
    choose("xla")
    wide = jax.jit(of)(*(a.astype("float64") for a in (xi, *floats)))
    jax.tree.map(lambda a, b: assert_close(a.astype("float64"), b, 2e-4), found[0], wide)


@NEEDS_LIBRARY
@pytest.mark.parametrize("place", ["in order", "anywhere"])
def test_resistances_of_many_particles_on_many_threads(place):
    """In one pass, and with what particles give stored first, where ranges of nodes share most of them."""
    *rest, u = resistance(2, 30_000, "float32", side=40)
    if place == "in order":
        order = jnp.argsort(rest[0][0])
        rest = [a[..., order] for a in rest]
    run = jax.jit(resisted)
    found = [run(*rest, u) for _ in range(5)]
    for again in found[1:]:
        np.testing.assert_array_equal(again, found[0])
    wide = jax.jit(resisted_in_parts)(*(a.astype("float64") for a in (*rest, u)))
    assert_close(found[0].astype("float64"), wide, 2e-4)


@NEEDS_LIBRARY
def test_a_particle_that_is_not_finite_spoils_its_own_nodes_alone(choose):
    """As in XLA: the same entries are finite."""
    xi, given, nodes = problem(2, 3, 3, 20, "float32")
    found, expected = by_each(choose, partial(summed, basis_for(2, 3)), xi.at[:, 5].set(jnp.nan), given, nodes)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(jnp.isfinite(a), jnp.isfinite(b)), found, expected)


@NEEDS_LIBRARY
@pytest.mark.parametrize("what", ["an array", "an attribute", "coefficients"])
def test_wrong_arrays_are_refused(what):
    """By the library itself: what does not fit each other ends in an error, not in a read beyond it."""
    xi, _, nodes = problem(2, 3, 3, 10, "float32")
    change = xi
    told = basis_attributes(basis_for(2, 3)) | {"present": np.ones(3, np.int64)}
    message = {"an array": "shapes do not fit", "an attribute": "is missing", "coefficients": "of both families"}[what]
    match what:
        case "an array":
            change = xi[:, :9]
        case "an attribute":
            told.pop("knots")
        case "coefficients":
            told["slopes"] = told["slopes"][:-1]
    bad = jax.ffi.ffi_call("mpmjax_gather", [jax.ShapeDtypeStruct(a, "float32") for a in ((3, 10), (2, 3, 10))])
    assert mpm.native.backend().name == "native"
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(jax.jit(lambda *a: bad(*a, **told))(xi, change, nodes))


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
    """MPMJAX_BACKEND is native, cuda, xla or nothing; native where there is no library is an error that says why."""
    choose("xla")
    assert mpm.native.backend().name == "xla"
    assert "MPMJAX_BACKEND=xla" in str(mpm.native.backend())
    choose("other")
    with pytest.raises(ValueError, match="must be native or cuda or xla"):
        mpm.native.backend()


def test_another_back_end_is_one_class(choose, monkeypatch):
    """It is asked for by its name, has some kernels, also of a batch, and XLA does what it has not."""

    class Sevens(AbstractBackend):
        name = "sevens"
        platform = "cpu"

        def has(self, kernel, arrays, *, basis=None, **params):
            return kernel == "gather" and len(basis.shape) == 2

        def call(self, kernel, operands, results, attributes, aliases=None):
            assert len({a.ndim for a in operands if a is not None}) == 1  # with the leading axes of a batch
            return [jnp.full(a.shape, 7, a.dtype) for a in results]

    monkeypatch.setattr(_backend, "BACKENDS", (Sevens,))
    with pytest.raises(ValueError, match="must be sevens or xla, or not be set, got 'native'"):
        choose("native"), mpm.native.backend()
    of = partial(summed, basis_for(2, 3))
    args = problem(2, 3, 3, 10, "float32", wild=False)
    choose("xla")
    _, scattered, _ = jax.jit(of)(*args)
    choose("sevens")
    assert mpm.native.backend().name == "sevens"
    gathered, same, _ = jax.jit(of)(*args)
    np.testing.assert_array_equal(same, scattered)
    assert all((a == 7).all() for a in (*gathered, *jax.jit(jax.vmap(of))(*(a[None] for a in args))[0]))
    assert not (jax.jit(partial(summed, basis_for(1, 3)))(*problem(1, 3, 3, 10, "float32"))[0][0] == 7).any()


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
        assert "where there is a C++ compiler" in str(mpm.native.backend())
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


@NEEDS_LIBRARY
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="elsewhere there is one instruction set")
def test_a_processor_without_avx2_sums_by_xla():
    """The library has no kernels for it, says so, and a step is XLA's. The variable stands for such a processor."""
    code = "import mpmjax as mpm; from helpers import block; print(mpm.native.backend()); scene, particles = block(2)"
    code += "; print(mpm.rollout(scene, mpm.prepare(scene, particles), steps=1, dt=1e-3).x.shape)"
    path = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
    environment = os.environ | {"MPMJAX_INSTRUCTIONS": "baseline", "PYTHONPATH": path}
    out = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    first, second = out.stdout.splitlines()
    assert first == "XLA (no native library: it has no kernels for this processor; reinstall on it)"
    assert second == "(36, 2)"


def test_numbers_that_have_to_be_equal_are():
    """The interface of the library and of the package."""
    assert f"MPMJAX_INTERFACE={_library.INTERFACE})" in (ROOT / "native" / "CMakeLists.txt").read_text()
