"""Faults that reviews found, each seen to fail before it was mended."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import block

import mpmjax as mpm
from mpmjax._conjugate_residual import LARGEST_RESIDUAL
from mpmjax._diagnostics import _energy
from mpmjax._kernel import in_window


def bar(**options):
    """Scene and particles of a 1-D neo-Hookean bar."""
    return block(1, material=mpm.NeoHookean(1e4, 0.3), **options)


def test_newton_never_accepts_a_residual_of_order_one():
    """In float32, far beyond the explicit limit, where rounding exceeds the right-hand side."""
    grid = mpm.Grid((10, 12), 0.1, origin=(-3, -3))
    jelly = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3, dtype="float32")
    walls = mpm.SlipBox((-0.2, 0.0), (0.6, np.inf))
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e7, 0.3), gravity=(0.0, -9.81), boundary=walls)
    particles = jelly
    for n in range(4):
        particles, info = mpm.step(scene, particles, n * 5e-3, 5e-3, method=mpm.BackwardEuler())
        assert bool(info.solve.converged) <= (float(info.solve.residual) <= LARGEST_RESIDUAL)


def test_newton_keeps_a_good_guess_where_the_grip_alone_would_invert():
    """A bar that moves rigidly with its grip: v^n is the answer, and rest is inadmissible."""
    grip = mpm.Grip(mpm.Box((-1.0,), (0.05,)), mpm.Motion((0.0, 1.0), ((0.0,), (1.0,))))
    scene, particles = bar(boundary=grip)
    moving = eqx.tree_at(lambda q: q.v, particles, jnp.ones_like(particles.v))
    after, info = mpm.step(scene, moving, 0.0, 0.2, method=mpm.BackwardEuler())
    assert bool(info.solve.converged)
    np.testing.assert_allclose(after.v, 1, rtol=1e-10)


def test_contact_starts_from_the_chosen_guess_and_counts_its_sweeps():
    """Guesses differ in their iterations, and every sweep's are in the report."""
    wall = mpm.SeparatingBox((-1.0,), (1.0,))
    scene, particles = bar(boundary=wall, gravity=(-50.0,))
    shaken = jnp.asarray(np.random.default_rng(0).normal(size=particles.v.shape))
    particles, iterations = eqx.tree_at(lambda q: q.v, particles, shaken), []
    for guess in mpm.Guess:
        _, info = mpm.step(scene, particles, 0.0, 0.05, method=mpm.SemiImplicit(guess=guess))
        assert int(info.contact.sweeps) >= 1
        iterations.append(int(info.solve.iterations))
    assert len(set(iterations)) > 1
    assert min(iterations) > 0


def test_breakdown_is_not_a_small_increment():
    """rᵀAr = 0 at the start, with the increment test on."""
    operator = lx.MatrixLinearOperator(jnp.asarray([[0.0, 1.0], [1.0, 0.0]]), lx.symmetric_tag)
    solver = mpm.ConjugateResidual(increment_rtol=1e-3)
    _, result, _ = solver.compute(solver.init(operator, {}), jnp.asarray([1.0, 0.0]), {})
    assert result == lx.RESULTS.breakdown


@pytest.mark.parametrize("x", [1e9, -1e9, 1e20])
def test_what_is_very_far_outside_is_outside(x):
    """Beyond what an integer node index can count."""
    grid = mpm.Grid((8,), 0.1, origin=(1,))
    assert not in_window(mpm.BSpline(), grid, grid.window(jnp.zeros((1, 1))), jnp.asarray([[x]])).any()


def test_points_may_hold_traced_numbers():
    """Gravity and a grip's displacement given as tuples inside a gradient."""
    material = mpm.FixedCorotated(1e4, 0.3)
    _, particles = bar()

    def place(g):
        grip = mpm.Grip(mpm.Box((-1.0,), (0.05,)), mpm.Motion((0.0, 1.0), ((0.0,), (g,))))
        scene = mpm.Scene(mpm.Grid((9,), 0.1, origin=(-3,)), material, gravity=(g,), boundary=grip)
        return mpm.rollout(scene, particles, steps=2, dt=1e-3).x.mean()

    assert float(jax.grad(place)(1.0)) > 0


def test_simulate_works_inside_jit_on_what_is_known():
    """Nothing passed is traced, yet all that is computed is."""
    scene, particles = bar(gravity=(1.0,))
    inside = jax.jit(lambda: mpm.simulate(scene, particles, t1=2e-3, dt=1e-3).final.x)()
    np.testing.assert_allclose(inside, mpm.simulate(scene, particles, t1=2e-3, dt=1e-3).final.x, rtol=1e-14)


def test_energy_compiles_once_for_all_moduli():
    scene, particles = bar()
    before = _energy._cached._cache_size()
    for modulus in (1e4, 2e4, 3e4):
        mpm.energy(eqx.tree_at(lambda s: s.material.youngs_modulus, scene, modulus), particles)
    assert _energy._cached._cache_size() <= before + 1


def test_particles_of_mixed_precision_are_refused():
    one = jnp.ones(2)
    with pytest.raises(ValueError, match="one precision"):
        mpm.Particles(jnp.ones((2, 1), jnp.float32), jnp.ones((2, 1)), one, one)


def test_the_run_of_an_error_holds_only_frames_that_were_reached():
    """An explicit run that blows up; what diffrax would have filled is cut off."""
    scene, particles = block(2, gravity=(0.0, -9.81), boundary=mpm.SlipBox((-0.2, 0.0), (0.5, 0.5)))
    with pytest.raises(mpm.SimulationError) as caught:
        mpm.simulate(scene, particles, t1=40.0, dt=0.1, save_every=1)
    run = caught.value.run
    assert 0 < len(run) < 400
    assert float(run.steps[-1]) == float(run.final_step)
    assert np.isfinite(run.frames.x).all()
