"""Faults of a rollout and of its derivatives: by every transformation a named error, and alone in a batch."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FORWARD, LAWS, REVERSE, block

import mpmjax as mpm
from mpmjax.simulation._run import Fault

DT = 0.01
METHOD = mpm.SemiImplicit(
    solver=mpm.implicit.ConjugateResidual(rtol=1e-3, max_steps=4),
    adjoint_solver=mpm.implicit.ConjugateResidual(rtol=1e-12, max_steps=4),
)
"""Four iterations solve what is soft, and of what is stiffer the motion but not its derivative."""
WELL, UNDERIVED = 1.0, 7.0
FAULTS = {
    2.0: "a state that is not finite",
    3.0: "a particle outside the grid's window",
    4.0: "a deformation gradient that its law does not allow",
    5.0: "a solve that did not converge",
    6.0: r"NeoHookean's youngs_modulus \[Pa\] must be greater than zero",
}
STIFFNESS = np.array([10.0, 10.0, 10.0, 10.0, 10.0, 1e6, -1.0, 1e4])
STRETCHING = np.array([0.0, 0.0, np.nan, 1e3, -101.0, 0.0, 0.0, 0.0])


def outcome(x, adjoint=None, **options):
    """A number that is linear in a run's outcome, so that its gradient needs none of it, and the run. The whole part of
    x chooses what goes wrong; the rest stretches and hardens."""
    scene, particles = block(1, side=3, material=LAWS["neo_hookean"], gravity=(-9.81,))
    kind = jnp.floor(jnp.asarray(x)).astype(jnp.int32)
    part = x - kind.astype(float)
    stiffness, stretching = jnp.asarray(STIFFNESS)[kind], jnp.asarray(STRETCHING)[kind]
    scene = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness * (1 + part))
    places = particles.x - particles.x.mean()
    stirred = 0.1 * np.random.default_rng(0).normal(size=places.shape) + (stretching + part) * places
    particles = eqx.tree_at(lambda p: p.v, particles, stirred)
    run = mpm.simulate(scene, particles, t1=2 * DT, dt=DT, method=METHOD, adjoint=adjoint, **options)
    return run.final.x[0, 0] + 2 * run.final.v[1, 0], run


CASES = [
    *((f, None, name in ("vmap", "jit"), name) for name, f in REVERSE.items()),
    *((f, diffrax.ForwardMode(), False, name) for name, f in FORWARD.items()),
]
MARKS = {"jit_grad": (), "vmap_jit_grad": pytest.mark.thorough, "jit_jvp": pytest.mark.thorough}
"""Of the others each is slow."""


@pytest.mark.parametrize(
    ("transform", "adjoint", "primal"),
    [pytest.param(*case, id=name, marks=MARKS.get(name, pytest.mark.slow)) for *case, name in CASES],
)
def test_every_transformation_raises_every_fault(transform, adjoint, primal):
    """By its name; so does a tangent or adjoint solve that does not converge, of which numbers alone know nothing."""
    run = transform(lambda x: outcome(x, adjoint)[0])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(run(WELL)))
    for x, words in FAULTS.items():
        with pytest.raises(Exception, match=words):
            jax.block_until_ready(run(x))
    if primal:
        assert np.isfinite(run(UNDERIVED)).all()
        return
    with pytest.raises(Exception, match=f"the {'adjoint' if adjoint is None else 'tangent'} solve of a step did not"):
        jax.block_until_ready(run(UNDERIVED))


@pytest.mark.thorough
@pytest.mark.parametrize("reverse", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_member_without_a_derivative_leaves_the_others_alone(reverse):
    """With throw=False: NaN where a tangent or adjoint solve did not converge or a parameter is bad, and the others'
    numbers and derivatives are the same bit for bit; statistics and report say which."""

    def member(x):
        value, run = outcome(x, None if reverse else diffrax.ForwardMode(), throw=False)
        return value, (run.statistics.fault, run.statistics.unconverged, run.statistics.unmet, run.report)

    def both(x):
        if reverse:
            (value, (*told, _)), slope = jax.value_and_grad(member, has_aux=True)(x)
            return value, slope, *told
        (value, told), (slope, (*_, report)) = jax.jvp(member, (x,), (jnp.ones_like(x),))
        return value, slope, *told[:3], report

    batch = jax.jit(jax.vmap(both))
    good = batch(jnp.array([1.0, 1.125, 1.0, 1.0, 1.0, 1.0, 1.25]))
    value, slope, fault, unconverged, unmet, *report = bad = batch(
        jnp.array([1.0, UNDERIVED, 6.0, 3.0, 4.0, 2.0, 1.25])
    )
    for a, b in zip(good, bad, strict=True):
        np.testing.assert_array_equal(a[np.array([0, 6])], b[np.array([0, 6])])
    fine = [Fault.NONE] * 2
    assert list(fault) == [*fine, Fault.BAD_PARAMETERS, Fault.OUTSIDE, Fault.INADMISSIBLE, Fault.NOT_FINITE, Fault.NONE]
    assert list(unmet > 0) == [False, False, True, False, False, False, False]
    assert list(np.isnan(value)) == [False, False, True, False, False, True, False]
    assert list(np.isnan(slope[:3])) == [False, True, True]
    assert np.isfinite(good[1]).all()
    assert int(unconverged[1]) == 0
    if not reverse:
        assert report[0][1] > 1e-12
        assert report[0][0] == report[0][6] == 0


@pytest.mark.thorough
def test_outside_of_jit_neither_a_run_nor_its_gradient_calls_the_host(monkeypatch):
    """A callback would keep their programs out of the cache of compiled ones."""

    def refuse(*args, **options):
        raise AssertionError("a program holds a callback")

    monkeypatch.setattr(jax, "pure_callback", refuse)
    scene, particles = block(1, side=2)

    def height(stiffness):
        softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
        return mpm.simulate(softer, particles, t1=2 * DT, dt=DT, method=METHOD).final.x.sum()

    assert np.isfinite(height(10.0))
    assert np.isfinite(jax.grad(height)(10.0))
    with pytest.raises(AssertionError, match="callback"):
        jax.jit(height)(10.0)


@pytest.mark.thorough
def test_a_derivative_that_misses_its_tolerance_by_little_is_taken():
    """A tangent solve within ten times its tolerance has a solution, as the solve of a step has; beyond, it is NaN."""
    scene, particles = block(1, side=3, material=LAWS["neo_hookean"], gravity=(-9.81,))

    @jax.jit
    def tangent(rtol):
        adjoint = mpm.implicit.ConjugateResidual(rtol, max_steps=2)

        def place(stiffness):
            harder = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, stiffness)
            run = mpm.simulate(
                harder,
                particles,
                t1=DT,
                dt=DT,
                method=mpm.SemiImplicit(adjoint_solver=adjoint),
                adjoint=diffrax.ForwardMode(),
                throw=False,
            )
            return run.final.x[0, 0], run.report

        return jax.jvp(place, (1e6,), (1.0,))[1]

    slope, residual = tangent(1e-12)
    assert np.isnan(slope)
    assert residual > 1e-9
    assert [bool(np.isnan(tangent(residual / share)[0])) for share in (8.0, 12.0)] == [False, True]
    assert tangent(residual / 8.0)[1] == 0
