"""Herschel and Bulkley's law by single particles: stress against rate, relaxation, and the limits in which it is
another law. What all laws that yield have in common is tested in `test_plastic.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.checks._values import canonical
from mpmjax.material._hencky import _share_of_flow

E, NU = 1e4, 0.3
MU = E / (2 * (1 + NU))


def law_of(**values):
    """Bingham's law with other parameters, as arrays, so that other values are no compilation."""
    known = {"youngs_modulus": E, "poisson_ratio": NU, "yield_stress": 60.0, "consistency": 5.0}
    return canonical(mpm.HerschelBulkley(**(known | values)), jnp.float64)


@eqx.filter_jit
def driven(law, F, L, dt, steps):
    """F, the Kirchhoff stress and α after each of some steps F ← (I + Δt L) F and its return."""

    def body(state, _):
        F, history = law.return_map(state[0] + dt * la.matmul(L, state[0]), state[1], dt)
        stress = la.matmul(law.elastic(history).stress(F), la.transpose(F))
        return (F, history), (F, stress, history.plastic_strain)

    return jax.lax.scan(body, (F, law.initial_history(F)), None, length=steps)[1]


def at_rest(d, p):
    """F = I of p particles."""
    return jnp.repeat(jnp.eye(d)[..., None], p, axis=-1)


def shear_stress(stress):
    """τ = ‖dev τ‖/√2 of stresses in three dimensions (..., 3, 3, p), shape (..., p)."""
    mean = np.trace(stress, axis1=-3, axis2=-2)[..., None, None, :] / 3
    return np.sqrt((np.asarray(stress - mean * np.eye(3)[..., None]) ** 2).sum(axis=(-3, -2)) / 2)


RATES = np.repeat([0.1, 1.0, 5.0], 3)
EXPONENTS = np.tile([0.4, 1.0, 1.6], 3)


@pytest.mark.parametrize("dt", [1e-2, 5e-2])
def test_steady_shear_has_the_stress_of_its_rate(dt):
    """Pulled along x and pressed along y at γ̇/2: τ = τ_Y + η γ̇ⁿ, for three rates and three exponents, at either step,
    to 1e-10; before, it rises as the elastic law."""
    rates, steps = jnp.asarray(RATES), 400
    law = law_of(exponent=EXPONENTS, youngs_modulus=E / RATES)
    half = jnp.expm1(rates * dt / 2 * jnp.asarray([1.0, -1.0])[:, None]) / dt
    L = jnp.zeros((3, 3, len(rates))).at[0, 0].set(half[0]).at[1, 1].set(half[1])
    _, stress, alpha = driven(law, at_rest(3, len(rates)), L, dt, steps)
    tau = shear_stress(stress)
    yielded = 60 + 5 * RATES**EXPONENTS
    if MU * dt < 60:
        np.testing.assert_allclose(tau[0], MU * dt, rtol=1e-12)
    np.testing.assert_allclose(tau[-1], yielded, rtol=1e-10)
    np.testing.assert_allclose(np.sqrt(3) * (alpha[-1] - alpha[-2]), RATES * dt, rtol=1e-10)


@pytest.mark.thorough
def test_steady_simple_shear_lies_on_binghams_line():
    """F ← (I + Δt γ̇ e₁₂) F: τ₁₂ = τ_Y + η γ̇ but for the square of the elastic strain, at strains of 1e-2 and 1e-3."""
    errors = []
    for stiffer in (1, 10):
        law = law_of(youngs_modulus=E * stiffer)
        rates = np.array([0.5, 1.0, 4.0])
        L = jnp.zeros((3, 3, 3)).at[0, 1].set(jnp.asarray(rates))
        stress = np.asarray(driven(law, at_rest(3, 3), L, 1e-4, 3000)[1][-1])
        errors.append(np.abs(stress[0, 1] / (60 + 5 * rates) - 1))
    assert (errors[0] < 2e-3).all()
    assert (errors[1] < errors[0] / 20).all()


def test_stress_relaxes_to_the_yield_stress():
    """Held at a shear beyond it, the excess falls by 1/(1 + μ Δt/η) a step, to 1e-11, and with the step to e^{−μt/η}:
    to the first order, and to 1e-6 once that is extrapolated."""
    law, t = law_of(consistency=50.0), 0.02
    F = la.diagonal(jnp.exp(jnp.asarray([[0.02], [-0.02], [0.0]])))
    start, found = 2 * MU * 0.02 - 60, []
    for steps in (100, 200, 400):
        dt = t / steps
        excess = shear_stress(driven(law, F, jnp.zeros_like(F), dt, 400)[1])[:steps, 0] - 60
        np.testing.assert_allclose(excess, start / (1 + MU * dt / 50) ** np.arange(1, steps + 1), rtol=1e-11)
        found.append(excess[-1] / start)
    exact = np.exp(-MU * t / 50)
    ratio = (found[0] - found[1]) / (found[1] - found[2])
    assert ratio == pytest.approx(2, rel=0.02)
    once = 2 * found[1] - found[0], 2 * found[2] - found[1]
    assert (4 * once[1] - once[0]) / 3 == pytest.approx(exact, rel=1e-6)


def random_states(d, p=200):
    rng = np.random.default_rng(0)
    F = np.eye(d)[..., None] + 0.1 * rng.normal(size=(d, d, p))
    return jnp.asarray(F), jnp.asarray(0.05 * rng.normal(size=p))


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.thorough)])
def test_without_viscosity_it_is_hencky(d):
    """η = 0: F after the return is that of σ_y = √3 τ_Y, to rounding; a small η is near it, in proportion to η."""
    F, transverse = random_states(d)
    transverse = None if d == 3 else transverse
    plastic = mpm.VonMises(E, NU, yield_stress=np.sqrt(3) * 60)
    memory = eqx.tree_at(
        lambda h: h.transverse_strain, plastic.initial_history(F), transverse, is_leaf=lambda x: x is None
    )
    returned = eqx.filter_jit(lambda law, history: law.return_map(F, history, 1e-3))
    exact, after = returned(plastic, memory)

    def gap(eta, n):
        law = law_of(consistency=eta, exponent=n)
        history = eqx.tree_at(
            lambda h: h.transverse_strain, law.initial_history(F), transverse, is_leaf=lambda x: x is None
        )
        found, later = returned(law, history)
        if d < 3:
            strain = np.abs(later.transverse_strain - after.transverse_strain).max()
            assert strain < 1e-14 or eta > 0
        return float(jnp.abs(found - exact).max())

    assert (np.asarray(exact) != np.asarray(F)).any()
    for n in (0.5, 1.0, 2.0):
        assert gap(0.0, n) < 1e-14
    assert gap(1e-4, 1.0) / gap(1e-5, 1.0) == pytest.approx(10, rel=1e-3)


def test_beyond_reach_of_its_yield_stress_it_is_elastic():
    """F and history come back to the last bit; at a viscosity that lets hardly anything flow, but for that."""
    F, transverse = random_states(2)
    for law, most in ((law_of(yield_stress=1e9), 0.0), (law_of(consistency=1e12), 1e-11)):
        history = eqx.tree_at(lambda h: h.transverse_strain, law.initial_history(F), transverse)
        after, new = eqx.filter_jit(law.return_map)(F, history, 1e-3)
        assert float(jnp.abs(after - F).max()) <= most
        assert float(jnp.abs(new.transverse_strain - transverse).max()) <= most


def test_the_share_of_flow_solves_its_equation():
    """w + c wⁿ = 1 to rounding over sixteen decades of c and exponents from 0.1 to 4; 1/(1 + c) for n = 1."""
    rng = np.random.default_rng(1)
    c, n = jnp.asarray(10 ** rng.uniform(-8, 8, 20_000)), jnp.asarray(rng.uniform(0.1, 4, 20_000))
    w = np.asarray(_share_of_flow(c, n))
    np.testing.assert_allclose(w + np.asarray(c) * w ** np.asarray(n), 1, rtol=1e-13)
    assert_close(_share_of_flow(c, jnp.asarray(1.0)), 1 / (1 + c), 1e-14)
    assert (np.asarray(_share_of_flow(jnp.zeros(3), jnp.asarray(0.5))) == 1).all()


def plug_flow(cells):
    """Bingham's fluid between plates that hold it, pulled along them by g = 0.1 m/s², half of it a plug: particles'
    places across, and their velocity over that of the plug."""
    grid = mpm.Grid((4, cells + 8), 1 / cells, origin=(0, -4), periodic=(True, False))
    plates = mpm.StickyBox((-np.inf, 0.0), (np.inf, 1.0))
    law = mpm.HerschelBulkley(2e4, 0.3, yield_stress=25.0, consistency=50.0)  # ρ g h/2 = 50 Pa at the plates
    scene = mpm.Scene(grid, law, gravity=(0.1, 0.0), boundary=plates)
    rest = mpm.fill(mpm.Box((0.0, 0.0), (4 / cells, 1.0)), grid, particles_per_cell=4, density=1e3)
    steps = 2000
    final = mpm.rollout(scene, rest, steps=steps * cells // 8, dt=0.02 / cells)
    return np.asarray(final.x[:, 1]), np.asarray(final.v[:, 0]) / (100 * 0.25**2 / (2 * 50))


@pytest.mark.slow
def test_flow_between_plates_has_a_plug():
    """Steady, as Bingham's law has it: v = ρ g/2η ((h/2 − z_Y)² − (z − z_Y)²) beyond z_Y = τ_Y/ρ g from the middle, and
    a plug within; of first order, as the plates are."""
    errors = []
    for cells in (8, 16):
        y, v = plug_flow(cells)
        beyond = np.maximum(np.abs(y - 0.5) - 0.25, 0) / 0.25
        errors.append(np.abs(v - (1 - beyond**2)).max())
    assert errors[1] < 0.1
    assert errors[0] / errors[1] > 1.6


@pytest.mark.parametrize(
    ("method", "share"),
    [
        (mpm.SemiImplicit(), 1.0),
        pytest.param(mpm.BackwardEuler(), 1.0, marks=pytest.mark.thorough),
        pytest.param(mpm.ImplicitMidpoint(), 0.5, marks=pytest.mark.thorough),
        pytest.param(mpm.Explicit(), 0.0, marks=pytest.mark.thorough),
    ],
)
def test_a_step_that_leaves_the_return_map_behind_says_so(method, share):
    """Steady shear between plates that hold it: of a solve that resists the flow by the elastic law, θ μ Δt γ̇ of
    τ + θ μ Δt γ̇ is not Bingham's law. It is reported, and warned of where it is much."""
    rate, dt, width, E = 1.0, 1e-2, 0.1, 2e4
    tau, stiffness = 25.0 + 50.0 * rate, E / 2.6
    grid = mpm.Grid((4, 6), width, origin=(0, -2), periodic=(True, False))
    motion = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (rate * width, 0.0)))
    plate = mpm.Grip(mpm.Box((-np.inf, 0.99 * width), (np.inf, np.inf)), motion)
    floor = mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))
    law = mpm.HerschelBulkley(E, 0.3, yield_stress=25.0, consistency=50.0)
    scene = mpm.Scene(grid, law, boundary=(floor, plate), kernel=mpm.BSpline(1))
    layer = mpm.fill(mpm.Box((0.0, 0.0), (4 * width, width)), grid, particles_per_cell=4, density=1.0)
    if not isinstance(method, mpm.Explicit):
        with pytest.warns(UserWarning, match=r"returned only at the end of the step.*Explicit\(\)"):
            run = mpm.simulate(scene, layer, t1=10 * dt, dt=dt, method=method)
    else:
        run = mpm.simulate(scene, layer, t1=10 * dt, dt=dt, method=method)
    left = share * stiffness * dt * rate
    assert float(run.statistics.linearisation_error) == pytest.approx(left / (tau + left), rel=0.02)


def test_the_derivatives_of_the_share_of_flow_are_differences():
    """By c and by n, at shares from 0.01 to 0.99."""
    w, n, h = np.array([0.01, 0.3, 0.8, 0.99]), jnp.asarray([0.4, 0.7, 1.0, 1.6]), 1e-6
    c = jnp.asarray((1 - w) / w**n)
    _, by_c = jax.jvp(lambda c: _share_of_flow(c, n), (c,), (c,))
    _, by_n = jax.jvp(lambda n: _share_of_flow(c, n), (n,), (n,))
    differences = (_share_of_flow(c * (1 + h), n) - _share_of_flow(c * (1 - h), n)) / (2 * h)
    np.testing.assert_allclose(by_c, differences, rtol=1e-6)
    differences = (_share_of_flow(c, n * (1 + h)) - _share_of_flow(c, n * (1 - h))) / (2 * h)
    np.testing.assert_allclose(by_n, differences, rtol=1e-6)
