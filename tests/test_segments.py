"""Reverse mode by segments: the derivative of the plain loop, of any kind, in the memory that is asked for."""

import functools
import math

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NEEDS_LIBRARY, assert_close, thorough

import mpmjax as mpm
from mpmjax.autodiff import materialised
from mpmjax.simulation._diffrax import SegmentAdjoint, checkpointed

STEPS, DT = 12, 2e-3
GRID = mpm.Grid((16, 16), 1 / 16)
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {"explicit": mpm.Explicit(), "backward_euler": mpm.BackwardEuler(adjoint_solver=TIGHT)}
LENGTHS = [(5, 3), *thorough(((12,),), ((3, 4),), ((2, 2, 3),), ((13,),))]
"""Of 12 steps: in segments of which the last is short, at once (which the test of memory compares with segments), in
segments, in segments of segments."""


def size(q, adjoint=None, method="explicit", **options):
    """A number of all that a run saves, by two numbers of its scene."""
    box = mpm.Box((0.3, 0.3), (0.6, 0.5))
    block = mpm.fill(box, GRID, particles_per_cell=4, density=1e3, velocity=(0.5, 1.0))
    scene = mpm.Scene(
        GRID,
        mpm.NeoHookean(1e4 * q[0], 0.3),
        gravity=(0.0, -9.81 * q[1]),
        boundary=mpm.SlipBox((0.2, 0.25), (0.8, 0.8)),
    )
    run = mpm.simulate(
        scene,
        block,
        t1=STEPS * DT,
        dt=DT,
        method=METHODS[method],
        adjoint=adjoint,
        throw=False,
        save_every=5,
        **options,
    )
    return (run.frames.x**2).sum() + (run.final.v**2).sum()


Q = jnp.asarray([1.0, 1.2])


@functools.cache
def plain(method):
    """The number and its derivative in forward mode, by the plain loop."""
    return jax.jvp(lambda q: size(q, diffrax.ForwardMode(), method), (Q,), (jnp.ones(2),))


@pytest.mark.parametrize("method", ["explicit", *thorough("backward_euler")])
@pytest.mark.parametrize("lengths", LENGTHS)
def test_segments_have_the_derivative_of_the_plain_loop(lengths, method):
    """Value, reverse and forward mode, with frames that do not end with segments."""
    adjoint = SegmentAdjoint(lengths)
    y, pushed = plain(method)
    again, gradient = jax.jit(jax.value_and_grad(lambda q: size(q, adjoint, method)))(Q)
    assert_close(again, y, 1e-12)
    assert_close(gradient.sum(), pushed, 1e-10)
    assert_close(jax.jvp(lambda q: size(q, adjoint, method), (Q,), (jnp.ones(2),))[1], pushed, 1e-12)


@pytest.mark.thorough
def test_segments_have_second_derivatives():
    """The Hessian by reverse mode twice, by forward mode over it, and by differences of the gradient."""
    gradient = jax.grad(lambda q: size(q, SegmentAdjoint((5, 3))))
    twice, over = (jax.jit(ways(gradient))(Q) for ways in (jax.jacrev, jax.jacfwd))
    assert_close(twice, over, 1e-9)
    h = 1e-5
    change = (gradient(Q.at[0].add(h)) - gradient(Q.at[0].add(-h))) / (2 * h)
    assert_close(twice[0], change, 1e-5)


@pytest.mark.parametrize("steps", [1, 2, 7, 100, 101, 5000])
@pytest.mark.parametrize("budget", [10, 100, 1000])
def test_the_memory_is_that_asked_for(steps, budget):
    """Of states of one byte and steps of two: loops that take all steps within the budget, or as many checkpoints."""
    adjoint = checkpointed(steps, 1, 2, budget)
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        assert adjoint.checkpoints == budget
        return
    *outer, inner = adjoint.lengths
    assert steps <= math.prod(adjoint.lengths) <= 2 * steps
    assert sum(outer) + 2 * inner <= budget
    if 2 * steps <= budget:
        assert adjoint.lengths == (steps,)


@pytest.mark.thorough
def test_less_memory_is_taken_where_less_is_given():
    """By the compiled program, of the same derivative."""

    def program(memory):
        return jax.jit(jax.value_and_grad(lambda q: size(q, checkpoint_bytes=memory))).lower(Q).compile()

    much, little = program(2**28), program(60_000)
    assert little.memory_analysis().temp_size_in_bytes < 0.8 * much.memory_analysis().temp_size_in_bytes
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-12), much(Q), little(Q))


def test_what_is_stored_is_the_same():
    """In and out of compiled programs, in a batch, and of both kinds of derivative; of whole numbers too."""
    tree = {"a": jnp.arange(3.0), "n": jnp.arange(2), "none": None, "text": "as it is"}

    def f(a):
        kept = materialised(tree | {"a": a})
        assert kept["text"] == "as it is"
        return (kept["a"] ** 2).sum() + kept["n"].sum().astype(a.dtype)

    a = jnp.asarray([1.0, 2.0, 3.0])
    for way in (lambda f: f, jax.jit):
        assert way(f)(a) == 15
        np.testing.assert_array_equal(way(jax.grad(f))(a), 2 * a)
        np.testing.assert_array_equal(way(jax.jacfwd(f))(a), 2 * a)
        np.testing.assert_array_equal(way(jax.hessian(f))(a), 2 * np.eye(3))
        np.testing.assert_array_equal(way(jax.vmap(f))(jnp.stack([a, 2 * a])), [15, 57])


@NEEDS_LIBRARY
def test_what_is_stored_is_stored_once(choose):
    """By one call for all arrays of a tree, beside which XLA computes nothing again; by XLA alone none."""

    def program():
        return (
            jax.jit(lambda a: jax.tree.map(jnp.sin, materialised((2 * a, 3 * a))))
            .lower(jnp.ones(64))
            .compile()
            .as_text()
        )

    for name, calls in (("native", 1), ("xla", 0)):
        choose(name)
        assert program().count('custom_call_target="mpmjax_stored"') == calls
