"""Derivatives of whole rollouts with respect to everything at once; `derivatives.py` has the scenes and measures."""

import itertools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import (
    DT,
    KINKED,
    STEPS,
    TAYLOR,
    TIGHT,
    TOLERANCES,
    UPDATES,
    Case,
    along,
    cotangent,
    difference_error,
    direction,
    linearised,
    model,
    outcome,
    parameters,
    quickly_compiled,
    rolled,
    same_branches,
    taylor_slope,
    tolerance_sweep,
    transpose_error,
)
from helpers import DESCRIPTIONS, LAWS, METHODS, SECOND_ORDER, assert_close

import mpmjax as mpm

DEFAULT = {"semi_implicit-fixed_corotated-updated-1d"}
THOROUGH = {
    "explicit-fixed_corotated-updated-2d-contact",
    "explicit-fixed_corotated-total-1d",
    "explicit-fixed_corotated-updated-2d",
    "backward_euler-fixed_corotated-total-1d",
    "implicit_midpoint-fixed_corotated-updated-1d",
    "trbdf2-fixed_corotated-total-1d",
    "explicit-fluid_in_tension-updated-2d",
    "explicit-viscous_solid-updated-2d",
    "explicit-snow-updated-2d",
}


def marked(case):
    """A case as a parameter: slow, unless its name is in `DEFAULT` or `THOROUGH`."""
    further = pytest.mark.thorough if str(case) in THOROUGH else pytest.mark.slow
    return pytest.param(case, marks=() if str(case) in DEFAULT else further, id=str(case))


def held_cases():
    """Every update × law × description × dimension, but that in three dimensions semi-implicit steps have one law for
    each description and backward Euler has one case, and that the updates of second order, whose stages are of one form
    with those of the others, have one law for each description in one and two, and one case in three. Hencky's law,
    whose derivatives are of a kind of their own, has an explicit and a semi-implicit case, and one in three dimensions;
    so has the fluid, updated, and one of backward Euler. Viscosity, which each update takes in its own way, has one
    case for each, of a fluid and of a solid."""
    for update, law, description in itertools.product(UPDATES, LAWS, DESCRIPTIONS):
        turn = (list(UPDATES).index(update) + list(LAWS).index(law) + list(DESCRIPTIONS).index(description)) % 2
        solid = {"explicit": True, "semi_implicit": turn, "backward_euler": turn and law == "neo_hookean"}
        dims = (1, 2) if update in METHODS or turn else ()
        for d in (*dims, 3) if solid.get(update) else dims:
            yield marked(Case(update, law, description, d))
    for update in SECOND_ORDER:
        yield marked(Case(update, "neo_hookean", "total", 3))
    for update, description, d in (("explicit", "updated", 2), ("explicit", "total", 3), ("semi_implicit", "total", 2)):
        yield marked(Case(update, "hencky", description, d))
    for update, d in (("explicit", 2), ("semi_implicit", 2), ("backward_euler", 2), ("explicit", 3)):
        yield marked(Case(update, "fluid_in_tension", "updated", d))
    for update, (law, description) in itertools.product(
        UPDATES, (("viscous_fluid", "updated"), ("viscous_solid", "updated"), ("viscous_solid", "total"))
    ):
        yield marked(Case(update, law, description, 2))


def contact_cases():
    """Sliding on a floor, in two dimensions; there is no contact in the total description. Of the fluid an explicit and
    a semi-implicit case."""
    second_order = itertools.product(SECOND_ORDER, ["fixed_corotated"])
    fluid = itertools.product(("explicit", "semi_implicit"), ["fluid_in_tension"])
    for update, law in [*itertools.product(METHODS, LAWS), *second_order, *fluid]:
        yield marked(Case(update, law, "updated", 2, contact=True))


@pytest.mark.parametrize("case", list(held_cases()))
def test_derivatives_of_a_rollout_are_right(case):
    """Of twenty steps from F = I, along all parameters at once: a Taylor remainder of slope 2; along each of them as
    well: Jᵀ is J's transpose to 1e-10, J t the central difference to 1e-6."""
    q = parameters(case)
    assert abs(taylor_slope(case, q, direction(q)) - 2) < 0.1
    for name in (None, *q):
        t = direction(q, only=name)
        assert transpose_error(case, q, t) < 1e-10, name
        assert difference_error(case, q, t) < 1e-6, name


@pytest.mark.parametrize("case", list(contact_cases()))
def test_derivatives_across_contact_are_right_while_the_active_set_stays(case):
    """As above, on a floor that the block hits, slides on, sticks to and leaves: along random directions, compared only
    where each step holds and stops the same nodes at all the points used."""
    q = parameters(case)
    here = linearised(case)(q, direction(q), cotangent(case)).branches
    least = 2 if "fluid" in case.law else 3  # planes hold or leave all columns of a fluid at once
    for changing in here:  # nodes come and go, stick and slip, within the rollout
        assert len({np.asarray(step).tobytes() for step in changing}) >= least
    compared = {"difference": 0, "slope": 0}
    for seed in range(6):
        t = direction(q, seed)
        assert transpose_error(case, q, t) < 1e-10
        if same_branches(case, q, t, (1e-5, -1e-5)):
            compared["difference"] += 1
            assert difference_error(case, q, t) < 1e-6
        smooth = [hs for hs in (TAYLOR, *TAYLORS) if same_branches(case, q, t, hs)]
        if smooth:
            compared["slope"] += 1
            assert min(abs(taylor_slope(case, q, t, hs) - 2) for hs in smooth) < 0.1
    assert compared["difference"] >= 4
    assert compared["slope"] >= 1


DIFFERENCES = (1e-5, 1e-6, 1e-7)
"""The steps of a central difference, of which the first is taken that meets no kink of yielding: the shorter, the more
rounding."""
TAYLORS = (1e-3, 3e-4, 1e-4, 3e-5), (1e-4, 3e-5, 1e-5, 3e-6)
"""Those of a Taylor test: of the longer ones the third order may show, of the shorter ones rounding. Of a wrong
derivative the slope is 1 for both."""


def plastic_cases():
    """Each law that yields, in two dimensions by explicit and semi-implicit steps and in three by explicit ones."""
    for law, (update, d) in itertools.product(KINKED, (("explicit", 2), ("semi_implicit", 2), ("explicit", 3))):
        yield marked(Case(update, law, "updated", d))


@pytest.mark.parametrize("case", list(plastic_cases()))
def test_derivatives_of_what_yields_are_right_while_the_same_particles_yield(case):
    """As above, of a block that is torn and pressed beyond yielding; its history is part of the outcome."""
    q = parameters(case)
    here = linearised(case)(q, direction(q), cotangent(case)).branches
    for changing in here:  # particles begin or cease to yield within the rollout
        assert len({np.asarray(step).tobytes() for step in changing}) >= 2
    compared = {"difference": 0, "slope": 0}
    for only, seed in itertools.product((None, *q), range(2)):
        t = direction(q, seed, only)
        assert transpose_error(case, q, t) < 1e-10, only
        smooth = [h for h in DIFFERENCES if same_branches(case, q, t, (h, -h))]
        if smooth:
            compared["difference"] += 1
            assert difference_error(case, q, t, smooth[0]) < 1e-6, only
        smooth = [hs for hs in TAYLORS if same_branches(case, q, t, hs)]
        if smooth:
            compared["slope"] += 1
            assert min(abs(taylor_slope(case, q, t, hs) - 2) for hs in smooth) < 0.1, only
    assert compared["difference"] >= 6
    assert compared["slope"] >= 2


@pytest.mark.slow
def test_derivatives_are_right_at_rest_in_three_dimensions():
    """F = I and no motion, where derivatives through an SVD are NaN."""
    case = Case("explicit", "fixed_corotated", "updated", 3)
    q = parameters(case)
    q["v"], q["gravity"], q["displacement"] = (jnp.zeros_like(q[k]) for k in ("v", "gravity", "displacement"))
    here = linearised(case)(q, direction(q), cotangent(case))
    assert_close(here.y, outcome(mpm.prepare(*model(q, case)[:2])), 1e-12)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(here))
    assert transpose_error(case, q, direction(q)) < 1e-10
    assert difference_error(case, q, direction(q)) < 1e-6


def simulated(q, case, adjoint=None):
    """The outcome by `simulate`."""
    scene, particles, method = model(q, case)
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, method=method, adjoint=adjoint, throw=False)
    return outcome(run.final)


SIMULATED = [
    pytest.param(Case("explicit", "neo_hookean", "updated", 1), marks=pytest.mark.slow),
    Case("semi_implicit", "fixed_corotated", "updated", 1),
    pytest.param(Case("backward_euler", "fixed_corotated", "total", 1), marks=pytest.mark.slow),
]


@pytest.mark.thorough
@pytest.mark.parametrize("case", SIMULATED, ids=str)
def test_simulate_has_the_derivatives_of_the_plain_scan(case):
    """Value, J t by ForwardMode and Jᵀ u by three checkpoints for twenty steps, to 1e-12."""
    q, u = parameters(case), cotangent(case)
    t = direction(q)

    @quickly_compiled
    def evaluate(q, t, u):
        y, pushed = jax.jvp(lambda q: simulated(q, case, diffrax.ForwardMode()), (q,), (t,))
        again, pull = jax.vjp(lambda q: simulated(q, case, diffrax.RecursiveCheckpointAdjoint(checkpoints=3)), q)
        return y, again, pushed, pull(u)[0]

    expected = linearised(case)(q, t, u)
    expected = expected.y, expected.y, expected.pushed, expected.pulled
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-12), evaluate(q, t, u), expected)


def scalar(q, case):
    """A random scalar of the final state."""
    return (cotangent(case) * simulated(q, case)).sum()


RUIN = {
    "a velocity that overflows": (tuple(UPDATES), lambda q: q | {"v": q["v"].at[0].set(1e308)}),
    "a velocity that inverts": (("explicit",), lambda q: q | {"v": q["v"] + 20.0}),  # implicit steps resist it
}


@pytest.mark.thorough
@pytest.mark.parametrize(
    "update",
    ["explicit", *(pytest.param(u, marks=pytest.mark.slow) for u in ("semi_implicit", "backward_euler", "trbdf2"))],
)
def test_a_batch_equals_a_loop_bit_for_bit_the_same_beside_a_member_that_turns_nan(update):
    """Value and gradient with respect to everything, by vmap of `simulate`: each of three is as alone, and when the
    middle one is driven to NaN the bits of the others do not change."""
    case = Case(update, "neo_hookean", "updated", 1)
    q = parameters(case)
    members = [along(q, h, direction(q)) for h in (0.0, 0.01, 0.02)]
    evaluate = quickly_compiled(jax.vmap(jax.value_and_grad(lambda q: scalar(q, case))))

    def batch(*members):
        return evaluate(jax.tree.map(lambda *leaves: jnp.stack(leaves), *members))

    healthy = batch(*members)
    for i, member in enumerate(members):
        alone = linearised(case)(member, direction(q), cotangent(case))
        expected = (cotangent(case) * alone.y).sum(), alone.pulled
        jax.tree.map(lambda a, b: assert_close(a[i], b, 1e-9), healthy, expected)  # noqa: B023
    for ruin, (updates, spoil) in RUIN.items():
        if update in updates:
            ruined = batch(members[0], spoil(members[1]), members[2])
            assert np.isnan(ruined[0][1]), ruin
            for a, b in zip(jax.tree.leaves(healthy), jax.tree.leaves(ruined), strict=True):
                assert np.array_equal(a[::2], b[::2]), ruin


@pytest.mark.thorough
@pytest.mark.parametrize("update", ["semi_implicit", pytest.param("backward_euler", marks=pytest.mark.slow)])
def test_gradient_error_is_proportional_to_the_solvers_tolerances(update):
    """From 1e-3 to 1e-10, to both, to the forward one alone and to the adjoint one alone: the error's logarithm falls
    with slope 1 (to 0.2), and it stays below five times the tolerance."""
    measured = (np.array(TOLERANCES) < 2e-3) & (np.array(TOLERANCES) > 0.5e-10)
    tolerance = np.array(TOLERANCES)[measured]
    for which, errors in tolerance_sweep(update).items():
        slope = np.polyfit(np.log(tolerance), np.log(errors[measured]), 1)[0]
        assert abs(slope - 1) < 0.2, (which, errors)
        assert (errors[measured] < 5 * tolerance).all(), (which, errors)


@pytest.mark.slow
def test_second_derivative_passes_through_the_implicit_solve():
    """In all the moduli's scale, forward over reverse, against differences of the first."""
    case, h = Case("semi_implicit", "fixed_corotated", "updated", 2), 1e-5
    q, u = parameters(case), cotangent(case)
    modulus, nu = q["law"]
    value = lambda scale: (u * rolled(q | {"law": [scale * modulus, nu]}, case, steps=3)[0]).sum()  # noqa: E731
    both = quickly_compiled(lambda scale: jax.jvp(jax.grad(value), (scale,), (jnp.ones(()),)))
    one = jnp.ones(())
    difference = (both(one + h)[0] - both(one - h)[0]) / (2 * h)
    assert abs(float(both(one)[1] / difference) - 1) < 1e-6


@pytest.mark.thorough
def test_an_adjoint_that_does_not_converge_gives_nan():
    """Never a wrong number."""
    case = Case("semi_implicit", "fixed_corotated", "updated", 1)
    q = parameters(case)

    def value(q, steps):
        scene, particles, _ = model(q, case)
        method = mpm.SemiImplicit(solver=TIGHT, adjoint_solver=mpm.implicit.ConjugateResidual(max_steps=steps))
        return outcome(mpm.rollout(scene, particles, steps=1, dt=DT, method=method)).sum()

    gradient = jax.jit(jax.grad(value), static_argnums=1)
    assert np.isfinite(gradient(q, 100)["law"][0]).all()
    assert np.isnan(gradient(q, 1)["law"][0]).all()


@pytest.mark.thorough
def test_a_gradient_in_float32_is_not_limited_by_the_adjoint_solve():
    """The height of a stiff block that stands between walls, by its modulus, of which a tolerance of 1e-5 left 2e-3."""
    grid = mpm.Grid((16, 16), 0.05, origin=(-3, -3))
    walls = mpm.SlipBox((0.0, 0.0), (np.inf, np.inf))
    block = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.4)), grid, particles_per_cell=4, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(1e7, 0.45), gravity=(0.0, -9.81), boundary=walls)

    def slope(dtype, method):
        particles = jax.tree.map(lambda a: jnp.asarray(a, dtype), block)

        def height(E):
            own = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, E)
            return mpm.rollout(own, particles, steps=10, dt=2e-2, method=method).x[:, 1].mean()

        return float(jax.grad(height)(jnp.asarray(1e7, dtype)))

    tight = mpm.implicit.ConjugateResidual(rtol=1e-12)
    exact = slope(jnp.float64, mpm.SemiImplicit(solver=tight, adjoint_solver=tight))
    assert slope(jnp.float32, mpm.SemiImplicit()) == pytest.approx(exact, rel=1e-3)
