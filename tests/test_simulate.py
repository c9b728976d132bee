"""Rollouts: the same as a plain scan, saved where they should be, compiled once, and stopped with a word."""

from contextlib import nullcontext
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DESCRIPTIONS,
    ELASTIC,
    FLUIDS,
    LAWS,
    PLASTIC,
    RUBBER,
    VISCOUS,
    assert_close,
    block,
    explicit_limit,
    ids,
)

import mpmjax as mpm
from mpmjax.simulation import _simulate
from mpmjax.simulation._diffrax import Problem, faulty_particles, initial_state, run_to
from mpmjax.simulation._faults import advise, disallowed, raise_faults
from mpmjax.simulation._run import Fault, no_steps
from mpmjax.state import state_of

DT = 5e-3
METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit(), "backward_euler": mpm.BackwardEuler()}


def pulled(d=1, **options):
    """A block held at its left by a moving grip, under gravity, and stirred."""
    motion = mpm.Motion((0.0, 1.0), ((0.0,) * d, (-0.4, 0.1)[:d]))
    grip = mpm.Grip(mpm.Box((-1.0,) * d, (0.05, 1.0)[:d]), motion)
    scene, particles = block(d, side=3, gravity=(-9.81,) * d, boundary=grip, **options)
    v = 0.1 * np.random.default_rng(0).normal(size=particles.x.shape)
    return scene, eqx.tree_at(lambda p: p.v, particles, jnp.asarray(v))


def height(scene, particles):
    """What a run observes: the mean height and the scene's gravity."""
    return particles.x[:, 0].mean(), jnp.asarray(scene.gravity)[0]


def assert_equal(a, b):
    """Bit for bit, leaf by leaf."""
    jax.tree.map(np.testing.assert_array_equal, a, b)


def state(particles):
    """What evolves."""
    return particles.x, particles.v, particles.F, particles.C


EQUAL = [
    ("explicit", "updated", 2),
    ("semi_implicit", "total", 2),
    pytest.param("backward_euler", "updated", 1, marks=pytest.mark.slow),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "description", "d"), EQUAL)
def test_simulate_equals_the_plain_rollout(method, description, d):
    """diffrax's loop against lax.scan, bit for bit, at every saved frame."""
    scene, particles = pulled(d, description=DESCRIPTIONS[description])
    method = METHODS[method]
    run = mpm.simulate(scene, particles, t1=8 * DT, dt=DT, method=method, save_every=4)
    for frame, steps in [(run.frame(1), 4), (run.final, 8)]:
        assert_equal(state(frame), state(mpm.rollout(scene, particles, steps=steps, dt=DT, method=method)))
    assert_equal(state(run.frame(2)), state(run.final))
    assert int(run.statistics.steps) == 8


def test_frames_are_saved_at_the_start_every_so_many_steps_and_at_the_end():
    """Also where save_every does not divide the number of steps; times are steps times dt."""
    scene, particles = pulled()
    run = mpm.simulate(scene, particles, t1=10 * DT, dt=DT, save_every=4)
    np.testing.assert_array_equal(run.steps, [0, 4, 8, 10])
    assert_close(run.times, np.array([0, 4, 8, 10]) * DT, 1e-15)
    assert len(run) == 4
    assert_equal(state(run.frame(0)), state(mpm.prepare(scene, particles)))
    assert_equal(state(run.frame(2)), state(mpm.rollout(scene, particles, steps=8, dt=DT)))
    assert_equal(state(run.frame(3)), state(run.final))
    with pytest.raises(ValueError, match="save_every"):
        mpm.simulate(scene, particles, t1=10 * DT, dt=DT).frame(0)


def test_observations_are_curves():
    """One value of the function a saved step, of scene and particles, and no frames."""
    scene, particles = pulled()
    run = mpm.simulate(scene, particles, t1=6 * DT, dt=DT, observe=height)
    frames = mpm.simulate(scene, particles, t1=6 * DT, dt=DT, save_every=1).frames
    assert run.frames is None
    np.testing.assert_array_equal(run.steps, range(7))
    assert_close(run.observed[0], np.asarray(frames.x)[:, :, 0].mean(axis=1), 1e-15)
    np.testing.assert_array_equal(run.observed[1], np.full(7, -9.81))
    coarse = mpm.simulate(scene, particles, t1=6 * DT, dt=DT, observe=height, save_every=4)
    assert_equal(coarse.observed[0], run.observed[0][np.array([0, 4, 6])])


def test_an_observation_has_a_derivative():
    """A curve of a function of one's own, by gravity, against a central difference."""
    scene, particles = pulled()

    def area(gravity):
        weighed = eqx.tree_at(lambda s: s.gravity, scene, (gravity,))
        return mpm.simulate(weighed, particles, t1=4 * DT, dt=DT, observe=height).observed[0].sum()

    (low, _), (_, slope), (high, _) = map(jax.jit(jax.value_and_grad(area)), (-9.82, -9.81, -9.80))
    assert float(slope) == pytest.approx(float(high - low) / 0.02, rel=1e-6)


@pytest.mark.thorough
def test_a_run_continues_from_its_end():
    """With start = final_step a moving grip is where it should be: two halves equal the whole, bit for bit."""
    scene, particles = pulled()
    method = mpm.SemiImplicit()
    first = mpm.simulate(scene, particles, t1=4 * DT, dt=DT, method=method)
    second = mpm.simulate(
        scene, first.final, t1=8 * DT, dt=DT, method=method, start=int(first.final_step), save_every=2
    )
    np.testing.assert_array_equal(second.steps, [4, 6, 8])
    whole = mpm.simulate(scene, particles, t1=8 * DT, dt=DT, method=method)
    assert float(second.final_step) == 8
    assert_equal(state(second.final), state(whole.final))
    assert_equal(state(mpm.rollout(scene, first.final, steps=4, dt=DT, method=method, start=4)), state(whole.final))


def test_no_float_compiles_anew():
    """Material, gravity, wall, grip, spacing, β, tolerance, dt, start: one compilation; the number of steps may."""
    scene, particles = pulled()
    wall = mpm.SlipBox((-5.0,), (5.0,))
    scene = eqx.tree_at(lambda s: s.boundary, scene, (*scene.boundary, wall))
    method = mpm.SemiImplicit(beta=1.0, solver=mpm.implicit.ConjugateResidual(rtol=1e-8))
    count = []

    def run(scene=scene, particles=particles, method=method, steps=3, dt=DT, start=0):
        before = _simulate.integrate._cached._cache_size()
        mpm.simulate(scene, particles, t1=(start + steps) * dt, dt=dt, method=method, start=start)
        count.append(_simulate.integrate._cached._cache_size() - before)

    run(steps=4)
    count.clear()
    change = {
        "Young's modulus": (lambda s: s.material.youngs_modulus, 2e4),
        "an integer": (lambda s: s.material.youngs_modulus, 20_000),
        "NumPy": (lambda s: s.material.poisson_ratio, np.float64(0.25)),
        "float32": (lambda s: s.material.poisson_ratio, jnp.float32(0.25)),
        "gravity": (lambda s: s.gravity, (-1.62,)),
        "wall": (lambda s: s.boundary[1].lower, (-4.0,)),
        "grip": (lambda s: s.boundary[0].motion.displacement, ((0.0,), (0.2,))),
        "times": (lambda s: s.boundary[0].motion.times, (0.0, 2.0)),
        "region": (lambda s: s.boundary[0].region.upper, (0.06,)),
        "spacing": (lambda s: s.grid.spacing, 0.11),
    }
    for where, value in change.values():
        run(eqx.tree_at(where, scene, value), steps=4)
    run(method=mpm.SemiImplicit(beta=0.5, solver=mpm.implicit.ConjugateResidual(rtol=1e-6)), steps=4)
    run(method=mpm.SemiImplicit(beta=1, solver=mpm.implicit.ConjugateResidual(rtol=1e-6)), steps=4)
    run(dt=2e-3, steps=4)
    run(start=7, steps=4)
    run(particles=eqx.tree_at(lambda p: p.v, particles, 2 * particles.v), steps=4)
    assert count == [0] * len(count)
    run(steps=5)
    assert count[-1] == 1


def test_an_explicit_blow_up_is_stopped_and_named():
    """Step, time and the first bad particle are told, and the last finite state is kept."""
    scene, particles = pulled()
    dt = 3 * explicit_limit(scene)
    with pytest.raises(mpm.SimulationError, match=r"At step \d+ \(t = [\d.]+ s\) particle \d+") as caught:
        mpm.simulate(scene, particles, t1=400 * dt, dt=dt, save_every=1)
    run = caught.value.run
    step = int(run.final_step)
    assert_equal(run.frames.x[-1], run.final.x)
    np.testing.assert_array_equal(run.steps, np.arange(step + 1))
    assert f"At step {step + 1} " in str(caught.value)
    assert f"t = {(step + 1) * dt:.6g} s" in str(caught.value)
    assert all(np.isfinite(leaf).all() for leaf in state(run.final))
    assert_equal(state(run.final), state(mpm.rollout(scene, particles, steps=step, dt=dt)))


def test_a_particle_that_is_not_finite_is_named():
    """One overflowing velocity: that particle, at the first step."""
    scene, particles = pulled()
    particles = eqx.tree_at(lambda p: p.v, particles, particles.v.at[5].set(1e308))
    with pytest.raises(mpm.SimulationError, match=r"At step 1 .* particle \d+ is no longer finite") as caught:
        mpm.simulate(scene, particles, t1=10 * DT, dt=DT)
    assert int(caught.value.run.statistics.fault) == Fault.NOT_FINITE
    assert_equal(caught.value.run.final.x, particles.x)


@pytest.mark.thorough
def test_a_particle_that_leaves_the_window_is_named():
    """With the step after which its stencil is outside, and what to do."""
    grid = mpm.Grid((12,), 0.1, origin=(-2,))
    x, v = jnp.array([[0.2], [0.5]]), jnp.array([[0.1], [0.99]])
    particles = mpm.Particles(x, v, jnp.ones(2), jnp.full(2, 1e-6))
    scene = mpm.Scene(grid, LAWS["neo_hookean"])
    # the last node is at 0.9: a quadratic stencil ends beyond 0.85, which the second particle passes at step 36
    with pytest.raises(mpm.SimulationError, match=r"At step 36 .*particle 1 left the grid's window") as caught:
        mpm.simulate(scene, particles, t1=0.5, dt=0.01)
    assert "Enlarge the grid's shape, or use follow=True." in str(caught.value)
    assert "limit" not in str(caught.value)  # dt is far below it
    assert_close(caught.value.run.final.x[1, 0], 0.5 + 35 * 0.0099, 1e-12)


def test_a_particle_that_a_moving_grid_leaves_behind_is_named():
    """By where the window is at the end of the step: with its plane it goes 0.1 m a step down, from 0.85 m."""
    grid, away = mpm.Grid((12,), 0.1, origin=(-2,)), mpm.Motion((0.0, 1.0), ((0.0,), (-10.0,)))
    particles = mpm.Particles(jnp.array([[0.2], [0.5]]), jnp.zeros((2, 1)), jnp.ones(2), jnp.full(2, 1e-6))
    scene = mpm.Scene(grid, LAWS["neo_hookean"], boundary=mpm.SymmetryPlane(0, 0.0, motion=away))
    problem = Problem(scene, mpm.prepare(scene, particles), jnp.asarray(0.01), mpm.Explicit())
    state, fault = initial_state(problem), {"fault": jnp.asarray(Fault.OUTSIDE), "fault_step": jnp.asarray(4)}
    run = run_to(problem, state, 4, replace(no_steps(float), **fault))
    with pytest.raises(mpm.SimulationError, match=r"At step 4 \(t = 0.04 s\) particle 1 left the grid's window"):
        raise_faults(run, problem, lambda: state, 0)


def breathing(law, d=2, **choices):
    """One particle whose affine velocity sets off a vibration, in a window with room for it."""
    grid = mpm.Grid((8,) * d, 0.1, origin=(-3,) * d)
    x, C = jnp.full((1, d), 0.13), jnp.zeros((1, d, d)).at[0, :2, :2].set([[0.5, 0.1], [-0.2, -0.3]])
    one = mpm.Particles(x, 0 * x, jnp.full(1, 1e3 * 0.05**d), jnp.full(1, 0.05**d), C=C)
    return mpm.Scene(grid, law, **choices), one


BLOWN_UP = {
    "jelly": LAWS["fixed_corotated"],
    "fluid": FLUIDS["fluid_in_tension"],
    "neo_hookean": LAWS["neo_hookean"],
    "von_mises": PLASTIC["von_mises"],
}


@pytest.mark.thorough
@pytest.mark.parametrize("law", **ids(BLOWN_UP))
def test_a_blow_up_names_the_limit_and_by_how_much_the_step_is_above_it(law):
    """Whatever fault it ends in; and a law that is no elastic solid is not told to be one."""
    scene, particles = breathing(law)
    limit = float(mpm.stable_dt(scene, particles, safety=1.0))
    for times in (1.05, 1.5, 3.8):
        with pytest.raises(mpm.SimulationError) as caught:
            mpm.simulate(scene, particles, t1=200 * times * limit, dt=times * limit)
        said = str(caught.value)
        assert f"is {times:.3g} times the explicit limit at the start ({limit:.4g} s)" in said
        assert f"Take a dt of at most {0.7 * limit:.4g} s (stable_dt, safety 0.7)" in said
        assert said.index("Take a dt") < said.index("If the fault stays, ")
        assert "FixedCorotated," not in said or law is LAWS["neo_hookean"]
    run = mpm.simulate(scene, particles, t1=200 * 0.7 * limit, dt=0.7 * limit)
    assert bool(run.statistics.healthy)


@pytest.mark.thorough
def test_advice_weighs_the_step_against_the_limit_of_the_method_there_and_then():
    """Above it at the start, above it only where the body has stiffened, near it, below it, and without one."""
    scene, rest = breathing(LAWS["neo_hookean"], d=3)
    rest = mpm.prepare(scene, rest)
    stretched = eqx.tree_at(lambda p: p.F, rest, 3 * rest.F)
    limit, short = (float(mpm.stable_dt(scene, p, safety=1.0)) for p in (rest, stretched))

    def advice(dt, last=rest, method=mpm.Explicit(), scene=scene):
        return advise(scene, method, dt, rest, last, "Look there.")

    assert advice(0.69 * limit) == "Look there."
    assert advice(9 * limit, method=mpm.SemiImplicit()) == "Look there."
    near = advice(0.8 * limit)
    assert "0.8 times the explicit limit at the start" in near
    assert "from 0.7 times on, large vibrations can grow" in near
    assert near.endswith("If the fault stays, look there.")
    stiffened = advice(0.6 * limit, stretched)
    assert (
        f"{0.6 * limit / short:.3g} times that of the last good state ({short:.4g} s). Take a dt of less" in stiffened
    )
    assert "2 times the limit of SemiImplicit with beta < 1/2 at the start" in advice(
        4 * limit, method=mpm.SemiImplicit(beta=0.375)
    )
    torn = eqx.tree_at(lambda p: p.F, rest, 1e200 * rest.F)  # its limit overflows
    assert advice(0.6 * limit, torn) == "Look there."
    assert "2 times" in advice(2 * limit, torn)


def test_advice_is_by_the_shorter_of_the_limits_at_the_start_and_at_the_end(monkeypatch):
    """From seven tenths of it on; where there is none at the end, by that at the start."""
    scene, rest = breathing(LAWS["neo_hookean"])

    def advice(dt, *limits):
        left = iter(limits)
        monkeypatch.setattr("mpmjax.simulation._faults.longest_step", lambda *_: next(left))
        return advise(scene, mpm.Explicit(), dt, rest, rest, "Look there.")

    for dt, first, then in ((0.69, 1.0, 1.0), (0.34, 1.0, 0.5), (0.34, 0.5, 1.0), (0.69, 1.0, np.nan), (9, 0.0, 1.0)):
        assert advice(dt, first, then) == "Look there."
    near, late, over = advice(0.8, 1.0, 1.0), advice(0.6, 1.0, 0.5), advice(1.1, 1.0, np.nan)
    assert "0.8 times the explicit limit at the start (1 s); from 0.7 times on" in near
    assert "and 1.2 times that of the last good state (0.5 s). Take a dt of less" in late
    assert "Take a dt of at most 0.7 s" in over


@pytest.mark.parametrize(
    ("law", "method", "says"),
    [
        (FLUIDS["fluid"], mpm.Explicit(), "Reduce dt: a step must keep Δt |div v| below 1."),
        (FLUIDS["fluid"], mpm.SemiImplicit(), "below 1, or take BackwardEuler()"),
        (PLASTIC["von_mises"], mpm.BackwardEuler(), "Reduce dt: a step must keep Δt |∇v| below 1."),
        (ELASTIC["hencky"], mpm.Explicit(), "Reduce dt, or use FixedCorotated, which allows inversion."),
    ],
)
def test_a_deformation_that_a_law_does_not_allow_has_advice_that_fits_the_law(law, method, says):
    what, advice = disallowed(law, method)
    assert type(law).__name__ in what
    assert says in advice


@pytest.mark.thorough
def test_the_law_that_is_named_is_the_particles_own():
    """Of two bodies the fluid one is driven to J < 0 in one step."""
    scene, particles = block(1, side=2, material=[LAWS["neo_hookean"], FLUIDS["fluid"]])
    scene = eqx.tree_at(lambda s: s.grid, scene, mpm.Grid((20,), 0.1, origin=(-3,)))
    still = replace(particles, x=particles.x + 1.0)
    both = mpm.join(still, replace(particles, v=-300.0 * (particles.x - particles.x.mean(axis=0))))
    says = r"particle [4-7] has a volume that Fluid does not allow \(J ≤ 0\)"
    with pytest.raises(mpm.SimulationError, match=says) as caught:
        mpm.simulate(scene, both, t1=0.05, dt=0.01)
    assert "Reduce dt: a step must keep Δt |div v| below 1." in str(caught.value)


@pytest.mark.thorough
def test_inversion_of_a_law_that_does_not_allow_it_is_named():
    """neo-Hookean at det F ≤ 0 stops; fixed corotated goes on."""
    scene, particles = block(1, side=2)
    v = -300.0 * (particles.x - particles.x.mean(axis=0))
    particles = eqx.tree_at(lambda p: p.v, particles, v)
    assert np.linalg.det(np.asarray(mpm.simulate(scene, particles, t1=0.01, dt=0.01).final.F)).min() < 0
    scene = eqx.tree_at(lambda s: s.material, scene, LAWS["neo_hookean"])
    with pytest.raises(mpm.SimulationError, match=r"At step 1 .*det F ≤ 0"):
        mpm.simulate(scene, particles, t1=0.05, dt=0.01)


@pytest.mark.parametrize("law", **ids(ELASTIC | RUBBER | PLASTIC | FLUIDS | VISCOUS))
def test_a_collapsed_particle_is_at_fault_in_every_law(law):
    """Flat, short in all directions, turned inside out, or as near to nothing as 1e-78: but not at a twentieth."""
    short = [[1.0, 1.0], [0.05, 2.0], [0.009, 3.0], [0.009, 0.009], [-0.005, 0.5], [1e-39, 1e-39]]
    F = jax.vmap(jnp.diag)(jnp.asarray(short))
    J, still = jnp.asarray([1.0, 0.05, 9e-3, 9e-3, -5e-3, 1e-78]), jnp.zeros((6, 2))
    place = jnp.linspace(2, 4, 6)[:, None]
    for description, expected in ((mpm.UpdatedLagrangian(), [False] * 2 + [True] * 4), (mpm.TotalLagrangian(), None)):
        if description == mpm.TotalLagrangian() and not law.allows_total:
            continue
        scene = mpm.Scene(mpm.Grid((6, 6), 1.0), law, description=description)
        particles = mpm.prepare(scene, mpm.Particles(still + place, still, jnp.ones(6), jnp.ones(6)))
        particles = replace(particles, deformations=(F if law.measure.axes else J,))
        faults = faulty_particles(Problem(scene, particles, 1.0, mpm.Explicit()), state_of(particles), 0.0)
        found = faults.get(Fault.COLLAPSED)
        assert (None if found is None else found.tolist()) == expected


def test_a_body_that_collapses_to_a_point_is_named():
    """By its own velocities, of a law whose force vanishes with F: not when det F ≤ 0, which it never is."""
    law = mpm.FixedCorotated(1e4, 0.45)
    scene, particles = block(1, material=law)
    particles = replace(particles, v=400 * (0.15 - particles.x))
    with pytest.raises(mpm.SimulationError, match="has collapsed") as caught:
        mpm.simulate(scene, particles, t1=0.1, dt=1e-4)
    assert float(jnp.abs(caught.value.run.final.F).min()) > 0.01


def test_an_unconverged_solve_is_raised():
    """With the number of steps concerned and the worst residual; throw=False leaves it to the statistics."""
    scene, particles = pulled()
    method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(max_steps=2))
    with pytest.raises(mpm.SimulationError, match="of 4 of 4 steps did not converge"):
        mpm.simulate(scene, particles, t1=4 * 0.1, dt=0.1, method=method)
    run = mpm.simulate(scene, particles, t1=4 * 0.1, dt=0.1, method=method, throw=False)
    assert int(run.statistics.unconverged) == 4
    assert float(run.statistics.worst_residual) > 1e-8
    assert int(run.statistics.most_iterations) == 2


@pytest.mark.thorough
@pytest.mark.parametrize("preconditioner", [mpm.implicit.DiagonalPreconditioner(), mpm.implicit.MassPreconditioner()])
def test_a_solve_that_misses_its_tolerance_by_little_is_a_warning(preconditioner):
    """Within ten times of it the run goes on, counted and told at its end; beyond, it is a fault. The advice names the
    preconditioner that needs fewer iterations if it is not the one in use."""
    scene, particles = pulled()

    def simulated(rtol, **options):
        method = mpm.SemiImplicit(
            solver=mpm.implicit.ConjugateResidual(rtol, max_steps=3), preconditioner=preconditioner
        )
        return mpm.simulate(scene, particles, t1=0.1, dt=0.1, method=method, **options)

    reached = float(simulated(1e-12, throw=False).statistics.worst_residual)
    for share, short in ((8.0, 1), (1.01, 1), (0.99, 0)):
        with pytest.warns(UserWarning, match="1 of 1 steps missed its tolerance") if short else nullcontext():
            statistics = simulated(reached / share).statistics
        assert int(statistics.nearly_converged) == short
        assert (int(statistics.unconverged), bool(statistics.healthy)) == (0, True)
    with pytest.raises(mpm.SimulationError, match="of 1 of 1 steps did not converge") as caught:
        simulated(reached / 12)
    assert ("DiagonalPreconditioner()" in str(caught.value)) == (preconditioner == mpm.implicit.MassPreconditioner())
    assert int(caught.value.run.statistics.nearly_converged) == 0


def test_a_rollout_from_another_step_compiles_nothing():
    """The number of the first step is an argument like any other."""
    scene, particles = pulled()
    assert_equal(
        state(mpm.rollout(scene, mpm.rollout(scene, particles, steps=2, dt=DT), steps=2, dt=DT, start=2)),
        state(mpm.rollout(scene, particles, steps=4, dt=DT)),
    )
    before = _simulate._rollout._cached._cache_size()
    for start in (3, np.int64(5), 7.0):
        mpm.rollout(scene, particles, steps=2, dt=DT, start=start)
    assert _simulate._rollout._cached._cache_size() == before


@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in ("explicit", "semi_implicit")}, "explicit"))
def test_a_batch_member_that_fails_leaves_the_others_alone(method):
    """One of three is driven to NaN: the other two are the same bit for bit as without it; the statistics say which."""
    scene, particles = pulled()

    @eqx.filter_jit
    def batch(speeds):
        def member(speed):
            moved = eqx.tree_at(lambda p: p.v, particles, speed * particles.v)
            run = mpm.simulate(scene, moved, t1=6 * DT, dt=DT, method=method, throw=False)
            return state(run.final), run.statistics.fault

        return jax.vmap(member)(speeds)

    good, faults = batch(jnp.array([1.0, 1.0, 2.0]))
    bad, faulty = batch(jnp.array([1.0, jnp.nan, 2.0]))
    assert list(faults) == [0, 0, 0]
    assert list(faulty) == [Fault.NONE, Fault.NOT_FINITE, Fault.NONE]
    for a, b in zip(good, bad, strict=True):
        assert_equal(a[np.array([0, 2])], b[np.array([0, 2])])
        assert np.isnan(b[1]).any()


def test_a_fault_under_a_transformation_raises():
    """Where a particle cannot be named, equinox's runtime error."""
    scene, particles = pulled()
    run = eqx.filter_jit(
        lambda v: mpm.simulate(scene, eqx.tree_at(lambda p: p.v, particles, v), t1=4 * DT, dt=DT).final.x
    )
    assert np.isfinite(run(particles.v)).all()
    with pytest.raises(Exception, match="the rollout met a fault"):
        run(jnp.nan * particles.v)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"t1": 0.0123, "dt": 0.005}, "whole number of steps"),
        ({"t1": 0.0, "dt": 0.005}, "after the start"),
        ({"t1": 0.01, "dt": 0.005, "start": 2}, "after the start"),
        ({"t1": 0.01, "dt": -0.005}, "dt"),
        ({"t1": np.inf, "dt": 0.005}, "t1"),
        ({"t1": 0.01, "dt": 0.005, "save_every": 0}, "save_every"),
        ({"t1": 1e308, "dt": 0.005}, r"at most 2147483647 steps, got t1 / dt = 2e\+310|got t1 / dt = inf"),
        ({"t1": 0.1, "dt": 0.1 / 62.4}, r"take dt = 0\.1 / 63\."),
        ({"t1": 0.01, "dt": 0.015}, r"take dt = 0\.01 / 1\."),
        ({"t1": 0.01, "dt": "stable", "start": 1}, "give dt, which run.dt is"),
        ({"t1": 0.01, "dt": "stable", "method": mpm.SemiImplicit()}, "SemiImplicit has no longest stable step"),
        ({"t1": 0.0, "dt": "stable"}, "t1 .* greater than zero"),
        ({"t1": 0.01, "dt": 0.005, "start": 0.5}, "start must be a whole number of at least 0, got 0.5"),
    ],
)
def test_bad_times_are_refused(options, message):
    """With a ValueError that says what must hold."""
    with pytest.raises(ValueError, match=message):
        mpm.simulate(*pulled(), **options)


def test_the_number_of_steps_is_robust_to_rounding():
    """0.3 / 0.1 is three steps."""
    scene, particles = pulled()
    assert int(mpm.simulate(scene, particles, t1=0.3 / 100, dt=0.1 / 100).statistics.steps) == 3


@pytest.mark.thorough
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_stable_step_is_the_longest_of_whole_steps(dtype):
    """At or below the bound, one step fewer being above it; the run says it, and is that of the number."""
    scene, particles = pulled()
    particles = jax.tree.map(lambda a: a.astype(dtype), particles)
    bound = float(mpm.stable_dt(scene, particles))
    for t1 in (10.4 * bound, 3 * bound, 0.1 * bound):
        whole = mpm.stable_dt(scene, particles, t1=t1)
        steps = round(t1 / float(whole))
        assert float(whole) <= bound
        assert steps == 1 or t1 / (steps - 1) > bound
    t1 = 10.4 * bound
    run = mpm.simulate(scene, particles, t1=t1, dt="stable", save_every=10**18)
    assert int(run.statistics.steps) == 11
    assert len(run) == 2
    np.testing.assert_allclose(run.dt, t1 / 11, rtol=1e-6)
    assert_equal(state(run.final), state(mpm.simulate(scene, particles, t1=t1, dt=run.dt).final))


def test_the_stable_step_is_asked_for_outside_of_transformations():
    """Where it depends on what is differentiated, which without a law's numbers it does not."""
    scene, particles = pulled()

    def moved(modulus):
        softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, modulus)
        return mpm.simulate(softer, particles, t1=0.01, dt="stable").final.x.sum()

    with pytest.raises(ValueError, match="outside of the jax transformation"):
        jax.grad(moved)(1e4)


@pytest.mark.thorough
def test_progress_changes_nothing(capsys):
    """A meter is shown, and the result is the same bit for bit."""
    scene, particles = pulled()
    quiet = mpm.simulate(scene, particles, t1=8 * DT, dt=DT)
    shown = mpm.simulate(scene, particles, t1=8 * DT, dt=DT, progress=True)
    jax.effects_barrier()
    assert "100" in capsys.readouterr().err
    assert_equal(state(quiet.final), state(shown.final))
