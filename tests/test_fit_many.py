"""Fits of many parameters: optimisers on reverse mode, Jacobians in batches, fields and their priors."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from helpers import assert_close
from test_fit import DT, NOISE, STEPS, STIFFNESS, bar, experiment, tracks

import mpmjax as mpm
from mpmjax.fitting._fit import MOST_COLUMNS, chosen_optimiser
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._search import NO_DERIVATIVE, iterate_alone, search

fit = partial(mpm.fit, discretisation=False)  # most of these tests are of the search

BANDS = mpm.Positive(
    update=lambda e, E: eqx.tree_at(lambda e: e.scene.material.youngs_modulus, e, jnp.repeat(E, 2)),
    start=jnp.full(4, 1e5),
    prior=mpm.fitting.Smooth(0.5),
)


def seen(**material):
    times, x, which = tracks(**material)
    return mpm.Tracks(times, x, which=which, sigma=NOISE)


class Valley(FitProblem):
    """Rosenbrock's function: r = (10 (y_{i+1} − y_i²), 1 − y_i), y = z − 1, whose minimum is at z = 2. A simulation
    fails beyond 2.5, and where it says so has no derivative beyond 2.2."""

    broken: bool = eqx.field(static=True, default=False)

    def __init__(self, n, dtype="float64", broken=False):
        self.experiments, self.names, self.broken = (), ("z",), broken
        self.parameters, self.starts = (mpm.Unbounded(lambda e: e.scene.gravity),), (jnp.zeros(n, dtype),)

    @property
    def dtype(self):
        return self.starts[0].dtype

    def residuals(self, z, adjoint):
        y = jnp.where((z < 2.5).all(), z, jnp.nan) - 1
        if self.broken:
            one = jnp.where((z > 2.2).any(), 0.0, 1.0)  # the root of zero has no derivative
            y = y + jnp.sqrt(one + jnp.abs(y - jax.lax.stop_gradient(y))) - jnp.sqrt(one)
        return jnp.concatenate([10 * (y[1:] - y[:-1] ** 2), 1 - y[:-1]]), jnp.zeros(1)


OPTIMISERS = {"LBFGS": (mpm.fitting.LBFGS(), 1e-4), "Adam": (mpm.fitting.Adam(max_steps=4000), 1e-3)}


@pytest.mark.parametrize(("optimiser", "near"), OPTIMISERS.values(), ids=OPTIMISERS)
@pytest.mark.parametrize(
    ("dtype", "broken"),
    [
        ("float64", False),
        pytest.param("float32", False, marks=pytest.mark.thorough),
        pytest.param("float64", True, marks=pytest.mark.thorough),
    ],
)
def test_a_curved_valley_is_followed_and_what_fails_is_not_taken(optimiser, near, dtype, broken):
    """To the minimum, from where the first steps go beyond what can be simulated; the cost never grows."""
    found = search(Valley(2, dtype, broken), optimiser, jnp.zeros(2, dtype))
    assert found.converged
    assert np.abs(np.asarray(found.z) - 2).max() < near
    assert np.diff([iteration.cost for iteration in found.history]).max() <= 1e-9


def test_next_to_nothing_is_less_than_the_square_of_rtol_standard_errors():
    """Their number squared, times σ²; that is Σ r² here, where a fit has no degree of freedom but one."""
    end = search(Valley(2), mpm.fitting.LBFGS(rtol=0.1, max_steps=2), jnp.zeros(2))
    assert_close(end.inner.decrease_tolerance, np.asarray(0.1**2 * 2 * end.history[-2].cost))


def test_a_start_that_fails_says_so_and_no_derivative_is_an_error():
    """The cost of the first iteration is then not finite; a derivative that is not raises."""
    for optimiser in (mpm.fitting.LBFGS(), mpm.fitting.Adam()):
        end = search(Valley(2, broken=True), optimiser, jnp.asarray([2.3, 2.3]))
        assert end.failure == NO_DERIVATIVE


@pytest.mark.thorough
def test_adam_takes_a_schedule():
    found = search(Valley(2), mpm.fitting.Adam(optax.exponential_decay(0.1, 100, 0.9), max_steps=4000), jnp.zeros(2))
    assert np.abs(np.asarray(found.z) - 2).max() < 1e-2


@pytest.mark.thorough
def test_the_gradient_and_all_jacobians_agree_with_differences():
    """By reverse mode, by forward mode at once and in batches, by rows."""
    problem = FitProblem((experiment(seen()),), {"E": BANDS})
    z = jnp.asarray([0.1, -0.1, 0.2, 0.0])
    r, cost, slope = eqx.filter_jit(problem.gradient)(z)
    small = FitProblem((experiment(seen()),), {"E": BANDS}, memory=3 * 16 * 8 * 8 * 4)
    assert 1 <= small.at_once < 4
    modes = ((problem, "forward"), (small, "forward"), (problem, "reverse"))
    (r1, J), *others = (eqx.filter_jit(p.jacobian)(z, mode) for p, mode in modes)
    assert J.shape == (problem.measured + 3, 4)
    for r2, other in [*others, (r, J)]:
        assert np.allclose(r2, r1, rtol=1e-9, atol=1e-9)
        assert np.abs(other - J).max() < 1e-7 * np.abs(J).max()
    assert float(cost) == pytest.approx(float((r**2).sum() / 2))
    assert np.allclose(slope, J.T @ r, rtol=1e-7)
    evaluate, h = eqx.filter_jit(problem.residuals), 1e-5
    ends = [evaluate(z + s * h * jnp.eye(4)[1], None)[0] for s in (1, -1)]
    assert np.abs((ends[0] - ends[1]) / (2 * h) - J[:, 1]).max() < 1e-6 * np.abs(J).max()


@pytest.mark.thorough
def test_lbfgs_reaches_the_minimum_of_levenberg_marquardt():
    """Four stiffnesses of a bar: the same values and errors, and the table says who found them."""
    of = experiment(seen())
    least = fit(of, {"E": BANDS})
    found = fit(of, {"E": BANDS}, optimiser=mpm.fitting.LBFGS())
    assert found.converged
    assert np.allclose(found.z, least.z, atol=1e-2 * least.uncertainty.error.min())
    assert np.allclose(found.uncertainty.error, least.uncertainty.error, rtol=1e-2)
    assert isinstance(least.optimiser, mpm.fitting.LevenbergMarquardt)
    assert "found by LBFGS" in str(found)


@pytest.mark.thorough
def test_adam_reaches_it_too():
    of = experiment(seen())
    least = fit(of, {"E": STIFFNESS})
    found = fit(of, {"E": STIFFNESS}, optimiser=mpm.fitting.Adam())
    assert found.converged
    assert abs(found.z - least.z) < 0.1 * least.uncertainty.error


@pytest.mark.thorough
def test_fits_by_lbfgs_converge_in_single_precision():
    """Whose costs are never still: to a fifth of a standard error of what double precision finds."""
    scene, q = bar()
    single = jax.tree.map(lambda a: a.astype("float32"), q)
    of, exact = (mpm.Experiment(scene, p, t1=STEPS * DT, dt=DT, observations=seen()) for p in (single, q))
    found = fit(of, {"E": BANDS}, optimiser=mpm.fitting.LBFGS())
    least = fit(exact, {"E": BANDS}, optimiser=mpm.fitting.LevenbergMarquardt())
    assert found.converged
    assert (np.abs(found.z - least.z) < 0.2 * least.uncertainty.error).all()


@pytest.mark.thorough
def test_an_adjoint_solve_that_does_not_converge_is_reported():
    """One iteration of the adjoint's solver is too few."""
    few = mpm.SemiImplicit(adjoint_solver=mpm.implicit.ConjugateResidual(rtol=1e-12, max_steps=1))
    scene, q = bar(n=2)
    of = mpm.Experiment(scene, q, t1=STEPS * DT, dt=DT, method=few, observations=seen(n=2))
    for optimiser in (mpm.fitting.LBFGS(), mpm.fitting.Adam()):
        with pytest.raises(RuntimeError, match="has no derivative"):
            fit(of, {"E": STIFFNESS}, optimiser=optimiser)


@pytest.mark.thorough
def test_what_has_no_influence_is_refused_without_a_jacobian():
    """And what has is not, also where the gradient vanishes: at the truth, with exact data."""
    times, x, which = tracks(sigma=None)
    exact = mpm.Tracks(times, x, which=which, sigma=NOISE)
    true = mpm.Positive(STIFFNESS.where)
    found = fit(experiment(exact), {"E": true}, optimiser=mpm.fitting.LBFGS())
    assert found["E"].value == pytest.approx(7e4, rel=1e-6)
    unseen = mpm.Series(times, np.zeros(len(times)), lambda s, p: p.mass.sum(), sigma=1.0)
    with pytest.raises(ValueError, match="do not depend on E"):
        fit(experiment(unseen), {"E": STIFFNESS}, optimiser=mpm.fitting.LBFGS())


@pytest.mark.thorough
def test_fits_by_lbfgs_with_new_data_do_not_compile_anew():
    of = seen()
    fit(experiment(of), {"E": STIFFNESS}, optimiser=mpm.fitting.LBFGS())
    known = iterate_alone._cached._cache_size()
    again = mpm.fitting.LBFGS(rtol=2e-3)
    fit(experiment(eqx.tree_at(lambda o: o.data, of, of.data + 1e-5)), {"E": STIFFNESS}, optimiser=again)
    assert iterate_alone._cached._cache_size() == known


def test_the_rule_weighs_parameters_and_numbers():
    """Few of either: Levenberg-Marquardt, in the mode that costs less; many of both: L-BFGS."""

    class Counted(Valley):
        size: int = eqx.field(static=True, default=0)
        measured: int = eqx.field(static=True, default=0)

        def __init__(self, size, measured):
            super().__init__(2)
            self.size, self.measured = size, measured

    cases = {(2, 500): "forward", (MOST_COLUMNS, 500): "forward", (1000, 10): "reverse"}
    for case, mode in cases.items():
        assert isinstance(chosen_optimiser(Counted(*case)), mpm.fitting.LevenbergMarquardt)
        assert Counted(*case).cheaper_mode == mode
    assert isinstance(chosen_optimiser(Counted(1000, 500)), mpm.fitting.LBFGS)


LATTICE = mpm.Grid((6, 5), 0.1, origin=(-1, 0))
MODULUS = mpm.Positive(lambda e: e.scene.material.youngs_modulus, prior=mpm.fitting.Smooth(0.5), unit="Pa")


def in_a_square(**options):
    """A square, nothing of which was measured but a number."""
    scene, q = bar(n=2)
    centre = mpm.Series([DT], np.zeros((1, 2)), mpm.fitting.CentreOfMass(), sigma=1.0)
    return mpm.Experiment(options.get("scene", scene), options.get("q", q), t1=DT, dt=DT, observations=centre)


def test_a_field_takes_its_nodes_values_and_is_linear_between():
    of, field = in_a_square(), mpm.fitting.Field(MODULUS, LATTICE)
    place = LATTICE.nodes(LATTICE.window(of.particles.x)).reshape(6, 5, 2)
    put = field.put(of, 1 + 2 * place[..., 0] - 3 * place[..., 1])
    x = of.particles.x
    assert np.allclose(put.scene.material.youngs_modulus, 1 + 2 * x[:, 0] - 3 * x[:, 1])
    assert np.allclose(field.first_guess(of), 7e4)
    assert field.first_guess(of).shape == (6, 5)
    around = mpm.fitting.Field.lattice_around(of.particles, 0.1)
    assert around.shape == (5, 5)
    mpm.fitting.Field(MODULUS, around).check_experiment("E", of)
    with pytest.raises(ValueError, match="must hold all particles"):
        mpm.fitting.Field(MODULUS, mpm.Grid((4, 4), 0.05)).check_experiment("E", of)
    with pytest.raises(ValueError, match="stay where it is"):
        mpm.fitting.Field(MODULUS, mpm.Grid((6, 5), 0.1, follow=True))


def test_a_field_of_one_law_among_several_lies_on_its_particles():
    """By `material[1]` and by `laws`, and both at once."""
    scene, q = bar(n=2)
    right = mpm.fill(mpm.Box((0.4, 0.0), (0.6, 0.4)), scene.grid, particles_per_cell=4, density=1e3)
    two = mpm.Scene(scene.grid, (mpm.NeoHookean(1e5, 0.3), mpm.NeoHookean(2e5, 0.3)))
    of = in_a_square(scene=two, q=mpm.join(q, right))
    lattice = mpm.Grid((8, 5), 0.1, origin=(-1, 0))
    values = jnp.broadcast_to(jnp.arange(8.0)[:, None] + 1, (8, 5))
    x = np.asarray(of.particles.x[:, 0])
    for where in (lambda e: e.scene.material[1].youngs_modulus, lambda e: e.scene.laws[1].youngs_modulus):
        put = mpm.fitting.Field(mpm.Positive(where), lattice).put(of, values)
        assert np.allclose(put.scene.laws[1].youngs_modulus, 2 + x[q.count :] / 0.1)
        assert float(put.scene.laws[0].youngs_modulus) == 1e5
    both = mpm.Positive(lambda e: tuple(law.youngs_modulus for law in e.scene.laws), start=1e5)
    put = mpm.fitting.Field(both, lattice).put(of, values)
    assert np.allclose(np.concatenate([law.youngs_modulus for law in put.scene.laws]), 2 + x / 0.1)


def test_a_smooth_prior_is_of_neighbours():
    """Of logarithms for positive parameters; large jumps count linearly with a robust limit."""
    value = jnp.exp(jnp.asarray([[0.0, 0.2, 0.2], [0.1, 0.2, 0.5]]))
    expected = np.array([0.1, 0.0, 0.3, 0.2, 0.0, 0.1, 0.3]) / 0.5
    assert np.allclose(MODULUS.prior_residuals(value), expected)
    for start in (1.0, 7.0):
        prior = mpm.fitting.Field(MODULUS, LATTICE, start=start).prior_residuals(value)
        assert np.allclose(prior, expected)
    robust = mpm.fitting.Smooth(1.0, robust=1e-3).residuals(value, jnp.asarray([0.0, 10.0]))
    assert float(robust[0] ** 2 / 2) == pytest.approx(1e-3 * 10, rel=1e-3)
    with pytest.raises(ValueError, match="is one number"):
        FitProblem((in_a_square(),), {"E": mpm.Positive(STIFFNESS.where, prior=mpm.fitting.Smooth(0.1))})
    with pytest.raises(ValueError, match="greater than zero"):
        mpm.fitting.Smooth(0.0)


METHODS = {"explicit": mpm.Explicit(), "semi-implicit": mpm.SemiImplicit()}


@pytest.mark.thorough
@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_one_value_a_particle_one_a_material_and_a_field_are_fitted_together(method):
    """The Jacobian of each by both modes, of two materials."""
    grid = mpm.Grid((12,), 0.1, origin=(-4,))
    parts = [mpm.fill(mpm.Box((a,), (a + 0.2,)), grid, particles_per_cell=2, density=1e3) for a in (0.0, 0.2)]
    q = mpm.join(*parts)
    q = eqx.tree_at(lambda q: q.v, q, 1.5 * (q.x - 0.2))
    scene = mpm.Scene(grid, (mpm.NeoHookean(7e4, 0.3), mpm.NeoHookean(5e4, 0.3)))
    track = mpm.Tracks([0.01, 0.02, 0.04], np.zeros((3, q.count, 1)), which=np.arange(q.count), sigma=1.0)
    of = mpm.Experiment(scene, q, t1=0.04, dt=DT, method=method, observations=track)
    parameters = {
        "each": mpm.Positive(
            update=lambda e, E: eqx.tree_at(lambda e: e.scene.material[0].youngs_modulus, e, E),
            start=jnp.full(parts[0].count, 7e4),
        ),
        "nu": mpm.Bounded(lambda e: e.scene.material[1].poisson_ratio, 0.0, 0.49),
        "field": mpm.fitting.Field(
            mpm.Positive(lambda e: e.scene.material[1].youngs_modulus, prior=mpm.fitting.Smooth(1.0)),
            mpm.fitting.Field.lattice_around(q, 0.2),
        ),
    }
    problem = FitProblem((of,), parameters)
    z = 0.1 * jnp.arange(float(problem.size))
    r, forward = eqx.filter_jit(problem.jacobian)(z, "forward")
    _, reverse = eqx.filter_jit(problem.jacobian)(z, "reverse")
    assert np.isfinite(r).all()
    assert np.abs(forward - reverse).max() < 1e-6 * np.abs(forward).max()
    assert (np.abs(forward[: track.data.size, :5]).max(axis=0) > 0).all()
