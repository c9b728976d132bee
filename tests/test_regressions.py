"""Faults that reviews found, each seen to fail before it was mended."""

import re
from dataclasses import fields, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import block

import mpmjax as mpm
from mpmjax.analysis._budget import _energy
from mpmjax.discretisation._stencil import in_window


def bar(**options):
    """Scene and particles of a 1-D neo-Hookean bar."""
    return block(1, material=mpm.NeoHookean(1e4, 0.3), **options)


@pytest.mark.thorough
def test_newton_never_accepts_a_residual_of_order_one():
    """None above a twentieth: in float32, far beyond the explicit limit, where rounding exceeds the right-hand side."""
    grid = mpm.Grid((10, 12), 0.1, origin=(-3, -3))
    jelly = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3, dtype="float32")
    walls = mpm.SlipBox((-0.2, 0.0), (0.6, np.inf))
    scene = mpm.Scene(grid, mpm.FixedCorotated(1e7, 0.3), gravity=(0.0, -9.81), boundary=walls)
    particles = jelly
    for n in range(4):
        particles, info = mpm.step(scene, particles, n * 5e-3, 5e-3, method=mpm.BackwardEuler())
        assert bool(info.solve.converged) <= (float(info.solve.residual) <= 0.05)


@pytest.mark.thorough
def test_newton_keeps_a_good_guess_where_the_grip_alone_would_invert():
    """A bar that moves rigidly with its grip: v^n is the answer, and rest is inadmissible."""
    grip = mpm.Grip(mpm.Box((-1.0,), (0.05,)), mpm.Motion((0.0, 1.0), ((0.0,), (1.0,))))
    scene, particles = bar(boundary=grip)
    moving = eqx.tree_at(lambda q: q.v, particles, jnp.ones_like(particles.v))
    after, info = mpm.step(scene, moving, 0.0, 0.2, method=mpm.BackwardEuler())
    assert bool(info.solve.converged)
    np.testing.assert_allclose(after.v, 1, rtol=1e-10)


@pytest.mark.thorough
def test_contact_starts_from_the_chosen_guess():
    """Guesses differ in their iterations."""
    wall = mpm.SeparatingBox((-1.0,), (1.0,))
    scene, particles = bar(boundary=wall, gravity=(-50.0,))
    shaken = jnp.asarray(np.random.default_rng(0).normal(size=particles.v.shape))
    particles, iterations = eqx.tree_at(lambda q: q.v, particles, shaken), []
    for guess in mpm.implicit.Guess:
        method = mpm.SemiImplicit(
            guess=guess, preconditioner=mpm.implicit.MassPreconditioner()
        )  # which tells guesses apart in so small a bar
        _, info = mpm.step(scene, particles, 0.0, 0.05, method=method)
        iterations.append(int(info.solve.iterations))
    assert len(set(iterations)) > 1
    assert min(iterations) > 0


def test_breakdown_is_not_a_small_increment():
    """rᵀAr = 0 at the start, with the increment test on."""
    operator = lx.MatrixLinearOperator(jnp.asarray([[0.0, 1.0], [1.0, 0.0]]), lx.symmetric_tag)
    solver = mpm.implicit.ConjugateResidual(increment_rtol=1e-3)
    _, result, _ = solver.compute(solver.init(operator, {}), jnp.asarray([1.0, 0.0]), {})
    assert result == lx.RESULTS.breakdown


@pytest.mark.parametrize("x", [1e9, -1e9, 1e20])
def test_what_is_very_far_outside_is_outside(x):
    """Beyond what an integer node index can count."""
    grid = mpm.Grid((8,), 0.1, origin=(1,))
    assert not in_window(mpm.BSpline(), grid, grid.window(jnp.zeros((1, 1))), jnp.asarray([[x]])).any()


@pytest.mark.thorough
def test_points_may_hold_traced_numbers():
    """Gravity and a grip's displacement given as tuples inside a gradient."""
    material = mpm.FixedCorotated(1e4, 0.3)
    _, particles = bar()

    def place(g):
        grip = mpm.Grip(mpm.Box((-1.0,), (0.05,)), mpm.Motion((0.0, 1.0), ((0.0,), (g,))))
        scene = mpm.Scene(mpm.Grid((9,), 0.1, origin=(-3,)), material, gravity=(g,), boundary=grip)
        return mpm.rollout(scene, particles, steps=2, dt=1e-3).x.mean()

    assert float(jax.grad(place)(1.0)) > 0


@pytest.mark.thorough
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


@pytest.mark.thorough
def test_the_run_of_an_error_holds_only_frames_that_were_reached():
    """An explicit run that blows up; what diffrax would have filled is cut off."""
    scene, particles = block(2, gravity=(0.0, -9.81), boundary=mpm.SlipBox((-0.2, 0.0), (0.5, 0.5)))
    with pytest.raises(mpm.SimulationError) as caught:
        mpm.simulate(scene, particles, t1=40.0, dt=0.1, save_every=1)
    run = caught.value.run
    assert 0 < len(run) < 400
    assert float(run.steps[-1]) == float(run.final_step)
    assert np.isfinite(run.frames.x).all()


@pytest.mark.thorough
def test_a_frame_that_is_not_there_is_an_error():
    """Where an array's index would be clamped."""
    run = mpm.simulate(*block(2), t1=2e-3, dt=1e-3, save_every=1)
    assert np.array_equal(run.frame(-1).x, run.frame(2).x)
    for i in (3, -4):
        with pytest.raises(IndexError, match="3 frames"):
            run.frame(i)


def test_the_stable_step_does_not_leave_broken_particles_out():
    """NaN is no stiffness of zero."""
    scene, particles = block(2, material=mpm.NeoHookean(1e4, 0.3))
    particles = mpm.prepare(scene, particles)
    for bad in (jnp.nan, -1.0):
        broken = eqx.tree_at(lambda q: q.F, particles, particles.F.at[0, 0, 0].set(bad))
        with pytest.raises(ValueError, match="their law allows"):
            mpm.stable_dt(scene, broken)


def test_a_deformation_needs_the_places_that_it_is_measured_from():
    """In the total description."""
    scene, particles = block(2, description=mpm.TotalLagrangian())
    strained = eqx.tree_at(
        lambda q: q.F, particles, jnp.tile(1.1 * jnp.eye(2), (particles.count, 1, 1)), is_leaf=lambda leaf: leaf is None
    )
    with pytest.raises(ValueError, match="give X, or drop F"):
        mpm.prepare(scene, strained)


def test_particles_of_another_law_are_refused():
    """By what they remember, and by the shape of their F."""
    sand, metal = mpm.DruckerPrager(1e4, 0.3, friction_angle=0.6), mpm.VonMises(1e4, 0.3, yield_stress=1e2)
    scene, particles = block(2, material=sand)
    prepared = mpm.prepare(scene, particles)
    for other, says in ((metal, "history of its own"), (mpm.Fluid(1e4), "J of shape"), ((sand, metal), "2 laws")):
        scene = block(2, material=other)[0]
        for refusing in (mpm.prepare, mpm.stable_dt):
            with pytest.raises(ValueError, match=says):
                refusing(scene, prepared)
    several = mpm.join(particles, particles)
    both = mpm.prepare(block(2, material=(sand, metal))[0], several)
    with pytest.raises(ValueError, match="counts of all materials"):
        mpm.prepare(block(2, material=sand)[0], replace(both, counts=None))


@pytest.mark.parametrize("law", [mpm.NeoHookean(1e4, 0.3), mpm.CamClay(1e4, 0.3, 1.0, 300.0)])
@pytest.mark.parametrize("shape", [(3,), (36, 1), (1, 1)])
def test_parameters_of_a_wrong_shape_are_refused(law, shape):
    """Also where a law's history is made of them."""
    for name in [f.name for f in fields(law)]:
        scene, particles = block(2, material=replace(law, **{name: np.full(shape, getattr(law, name))}))
        got = re.escape(f"one for each of its 36 particles, got shapes [{shape}]")
        with pytest.raises(ValueError, match=got):
            mpm.prepare(scene, particles)


def test_a_budget_needs_a_step():
    with pytest.raises(ValueError, match="dt"):
        mpm.budget(*block(2), steps=1, dt=-1e-3)


def test_prepare_compiles_once_for_all_moduli_and_spacings():
    scene, particles = block(2)
    mpm.prepare(scene, particles)
    before = in_window._cached._cache_size()
    for change in (1.0, 1.001, 1.002):
        numbers = (change * float(scene.material.youngs_modulus), change * float(scene.grid.spacing))
        changed = eqx.tree_at(lambda s: (s.material.youngs_modulus, s.grid.spacing), scene, numbers)
        mpm.prepare(changed, particles)
    assert in_window._cached._cache_size() == before
