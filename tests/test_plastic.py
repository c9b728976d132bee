"""Plastic laws: the yield condition holds after a return, energy falls, plane strain is three-dimensional, derivatives
are right, and single particles follow closed forms."""

import functools
import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
from helpers import assert_close, rotation_matrix, thorough

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.checks._values import canonical

E, NU = 1e4, 0.3
MU, K = E / (2 * (1 + NU)), E / (3 * (1 - 2 * NU))
DT = 1e-3
PLASTIC = {
    "von_mises": mpm.VonMises(E, NU, yield_stress=100.0, hardening_modulus=500.0),
    "drucker_prager": mpm.DruckerPrager(E, NU, friction_angle=0.6),
    "cam_clay": mpm.CamClay(E, NU, friction=1.2, preconsolidation=300.0, cohesion=0.3, hardening=2.0),
    "herschel_bulkley": mpm.HerschelBulkley(E, NU, yield_stress=60.0, consistency=5.0, exponent=0.6),
}
EACH_LAW = pytest.mark.parametrize("name", list(PLASTIC))
EACH_DIM = pytest.mark.parametrize("d", [2, *thorough(1, 3)])


def law_of(name):
    """A law of arrays, so that other values are no compilation."""
    return canonical(PLASTIC[name], jnp.float64)


@eqx.filter_jit
def return_map(law, F, history):
    """The return map, and energy density before and after."""
    after, new = law.return_map(F, history, DT)
    return after, new, law.elastic(history).energy(F), law.elastic(new).energy(after)


@eqx.filter_jit
def driven(law, F, history, L):
    """The states after each F ← (I + L_n) F and its return: F, the history and the Kirchhoff stress, steps first."""

    def body(state, L):
        F, history = law.return_map(state[0] + la.matmul(L, state[0]), state[1], DT)
        return (F, history), (F, history, la.matmul(law.elastic(history).stress(F), la.transpose(F)))

    return jax.lax.scan(body, (F, history), L)[1]


def undeformed(law, d, p=1):
    """F = I and the history of it."""
    F = jnp.repeat(jnp.eye(d)[..., None], p, axis=-1)
    return F, law.initial_history(F)


def strained(d, mean, deviation, rng, *, rotated=True):
    """F and ε_t of particles of given mean and size of the deviator in three dimensions, (p,), in random frames; the
    deviator random in 3-D and 2-D, of either sign in 1-D."""
    p = len(mean)
    e = rng.normal(size=(3, p))
    if d == 1:
        e[2] = e[1]
    e -= e.mean(axis=0)
    e *= deviation / np.linalg.norm(e, axis=0)
    principal = mean + e
    V = np.stack([rotation_matrix(d, rng) for _ in range(p)], axis=-1)
    R = np.stack([rotation_matrix(d, rng) if rotated else np.eye(d) for _ in range(p)], axis=-1)
    U = np.einsum("ikp,kp,jkp->ijp", V, np.exp(principal[:d]), V)
    return jnp.asarray(np.einsum("ikp,kjp->ijp", R, U)), None if d == 3 else jnp.asarray(principal[2])


def with_history(history, transverse, **scalars):
    """A history with the given values."""
    for name, value in scalars.items():
        history = eqx.tree_at(lambda h, name=name: getattr(h, name), history, jnp.asarray(value))
    if transverse is not None:
        history = eqx.tree_at(lambda h: h.transverse_strain, history, transverse)
    return history


def invariants(F, transverse):
    """m and ‖e‖ in three dimensions, by NumPy's singular values."""
    s = np.log(np.linalg.svd(np.moveaxis(np.asarray(F), -1, 0), compute_uv=False)).T
    d = len(s)
    rest = [np.asarray(transverse)] * (3 - d)
    principal = np.stack([*s, *rest])
    mean = principal.mean(axis=0)
    return mean, np.linalg.norm(principal - mean, axis=0)


def scalar_of(history):
    """What a history holds besides ε_t."""
    return np.asarray(
        jax.tree.leaves(eqx.tree_at(lambda h: h.transverse_strain, history, None, is_leaf=lambda x: x is None))[0]
    )


CASES = {
    # name of the history's scalar; then by case: mean, size of the deviator, that scalar
    "von_mises": (
        "plastic_strain",
        {"elastic": (0.1, 0.009, 0.0), "yielding": (-0.1, 0.05, 0.03), "far": (0.05, 0.8, 0.0)},
    ),
    "drucker_prager": (
        "gap",
        {
            "elastic": (-0.05, 0.03, 0.0),
            "sliding": (-0.05, 0.3, 0.0),
            "apart": (0.04, 0.1, 0.02),
            "closing": (-0.05, 0.2, 0.06),
            "still apart": (-0.05, 0.02, 0.3),
        },
    ),
    "cam_clay": (
        "volume_strain",
        {
            "elastic": (-0.006, 0.004, -0.03),
            "crushing": (-0.05, 0.02, -0.03),
            "tearing": (0.02, 0.01, -0.03),
            "contracting": (-0.015, 0.2, -0.03),
            "dilating": (-0.002, 0.2, -0.03),
            "apart": (0.01, 0.03, 0.02),
            "closing": (-0.05, 0.03, 0.02),
        },
    ),
    "herschel_bulkley": (
        "plastic_strain",
        {"elastic": (0.1, 0.009, 0.0), "yielding": (-0.1, 0.05, 0.03), "far": (0.05, 0.8, 0.0)},
    ),
}


def cases(name, d, seed=0):
    """Ten particles, each of a case that it is named after, away from all kinks."""
    rng = np.random.default_rng(seed)
    scalar, table = CASES[name]
    names = list(itertools.islice(itertools.cycle(table), 10))
    mean, deviation, value = np.array([table[case] for case in names]).T
    F, transverse = strained(d, mean, deviation, rng)
    return names, F, with_history(law_of(name).initial_history(F), transverse, **{scalar: value})


def random_states(name, d, p=300, seed=3):
    """Trial states of all cases at random."""
    rng = np.random.default_rng(seed)
    F, transverse = strained(d, 0.1 * rng.normal(size=p), 10 ** rng.uniform(-4, 0, p), rng)
    scalar = CASES[name][0]
    value = 0.1 * rng.normal(size=p)
    value = value if name == "cam_clay" else np.abs(value) * (rng.uniform(size=p) > 0.5)
    return F, with_history(law_of(name).initial_history(F), transverse, **{scalar: value})


def yield_excess(name, mean, deviation, before, after, flowed=0.0):
    """By how much the yield condition is exceeded, in strains, for Cam clay in their squares: with the strength after
    the return, for Cam clay before, for Herschel and Bulkley's law at the rate at which the deviator has flowed."""
    if name == "herschel_bulkley":
        return deviation - (60 + 5 * (np.sqrt(2) * flowed / DT) ** 0.6) / (np.sqrt(2) * MU)
    if name == "von_mises":
        return deviation - np.sqrt(2 / 3) * (100 + 500 * after) / (2 * MU)
    p = -3 * mean
    if name == "drucker_prager":
        M = 6 * np.sin(0.6) / (3 - np.sin(0.6))
        return deviation - M * p * K / (np.sqrt(6) * MU)
    p0, q = np.sinh(2.0 * np.maximum(-before, 0)), np.sqrt(6) * MU / K * deviation
    return 1.6 * q**2 + 1.2**2 * (p + 0.3 * p0) * (p - p0)


def remembered(name, mean, deviation, before, after_mean, flowed):
    """The history's scalar after a return from a trial state: what has flowed, or the volume that was given up; for Cam
    clay that on the straight way to the ellipse's centre where e is shortened."""
    if name in {"von_mises", "herschel_bulkley"}:
        return before + np.sqrt(2 / 3) * flowed
    change = 3 * (mean - after_mean)
    if name == "cam_clay":
        p0 = np.sinh(2.0 * np.maximum(-before, 0))
        centre, inside, outside = -(1 - 0.3) * p0 / 6, 0.0, 1.0
        for _ in range(60):
            way = (inside + outside) / 2
            beyond = yield_excess(name, centre + way * (mean - centre), way * deviation, before, before) > 0
            inside, outside = np.where(beyond, inside, way), np.where(beyond, way, outside)
        change = np.where((-3 * mean > p0) | (-3 * mean < -0.3 * p0), change, 3 * (1 - outside) * (mean - centre))
    return before + change


@EACH_LAW
@EACH_DIM
def test_a_return_meets_the_yield_condition_and_lowers_the_energy(name, d):
    """From 300 random trial states: the condition holds after it, by NumPy's singular values; Ψ has not grown, the
    history remembers what flowed, and F and history are to the last bit as before where the condition held."""
    law = law_of(name)
    F, history = random_states(name, d)
    after, new, energy_before, energy = return_map(law, F, history)
    before, then = scalar_of(history), scalar_of(new)
    mean, deviation = invariants(after, new.transverse_strain)
    tried = invariants(F, history.transverse_strain)
    flowed = np.maximum(tried[1] - deviation, 0)
    assert (yield_excess(name, mean, deviation, before, then, flowed) < 1e-14).all()
    assert (energy <= energy_before * (1 + 1e-13)).all()
    np.testing.assert_allclose(then, remembered(name, *tried, before, mean, flowed), rtol=0, atol=1e-12)
    trial = yield_excess(name, *tried, before, before)
    elastic = (trial < -1e-13) & ((before == 0) if name == "drucker_prager" else True)
    assert 10 < elastic.sum() < 290
    for a, b in zip(jax.tree.leaves((after, new)), jax.tree.leaves((F, history)), strict=True):
        np.testing.assert_array_equal(np.asarray(a)[..., elastic], np.asarray(b)[..., elastic])
    assert (np.asarray(after) != np.asarray(F)).any(axis=(0, 1))[trial > 1e-13].all()


@pytest.mark.thorough
@EACH_LAW
@pytest.mark.parametrize("d", [1, 2])
def test_plane_and_uniaxial_strain_are_three_dimensional(name, d):
    """Along random plastic paths F, stress and history are those of the law in 3-D with L = 0 in the other directions,
    to 1e-12, and exp ε_t is the elastic stretch there."""
    law, steps, p = law_of(name), 80, 6
    rng = np.random.default_rng(7)
    L = 0.02 * rng.normal(size=(steps, d, d, p))
    whole = np.zeros((steps, 3, 3, p))
    whole[:, :d, :d] = L
    F, history, stress = driven(law, *undeformed(law, d, p), jnp.asarray(L))
    F3, history3, stress3 = driven(law, *undeformed(law, 3, p), jnp.asarray(whole))
    assert_close(F, F3[:, :d, :d], 1e-12)
    np.testing.assert_allclose(stress / E, stress3[:, :d, :d] / E, rtol=0, atol=1e-12)
    np.testing.assert_allclose(scalar_of(history), scalar_of(history3), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.exp(history.transverse_strain), F3[:, 2, 2], rtol=1e-12)
    assert np.abs(history.transverse_strain).max() > 1e-3
    if d == 1:
        np.testing.assert_allclose(F3[:, 1, 1], F3[:, 2, 2], rtol=1e-12)


def flat(law, F, history):
    """All that a return gives, as a vector; F in its place, the rest in strains."""
    after, new = law.return_map(F, history, DT)
    return jnp.concatenate([a.reshape(-1, F.shape[-1]) for a in jax.tree.leaves((after, new))])


@functools.partial(jax.jit, static_argnames="twice")
def linearised(q, t, w, *, twice):
    """The return, its derivative along t and its adjoint at w; with `twice` the gradient of its squares and that
    gradient's derivative along t."""
    if twice:
        return jax.jvp(jax.grad(lambda q: (w * flat(*q) ** 2).sum()), (q,), (t,))
    y, pushed = jax.jvp(lambda q: flat(*q), (q,), (t,))
    return y, pushed, jax.vjp(lambda q: flat(*q), q)[1](w)[0]


ORDERS = [
    (2, False),
    *thorough((1, False), (3, False), (2, True)),
    *(pytest.param(d, True, marks=pytest.mark.slow) for d in (1, 3)),
]
EACH_ORDER = pytest.mark.parametrize(("d", "twice"), ORDERS)


def directions(q, rng):
    """A random tangent, in the size of each parameter, and a cotangent."""

    def random(a):
        size = jnp.abs(a).max() if a.ndim == 0 else 1e-1
        return size * jnp.asarray(rng.normal(size=a.shape))

    return jax.tree.map(random, q), jnp.asarray(rng.normal(size=jax.eval_shape(flat, *q).shape))


def inner(a, b):
    return sum(float((x * y).sum()) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


@pytest.mark.parametrize("name", ["von_mises", *thorough("drucker_prager", "cam_clay", "herschel_bulkley")])
@EACH_ORDER
def test_derivatives_are_central_differences(name, d, twice):
    """By F, history and all parameters at once and in each case apart, to 1e-7; the adjoint is the transpose, to 1e-12;
    second derivatives are differences of first ones, to 1e-6. Where nothing yields the derivative is the identity."""
    law, rng, h = law_of(name), np.random.default_rng(1), 1e-5
    names, F, history = cases(name, d)
    q = (law, F, history)
    t, w = directions(q, rng)
    elastic = names.index("elastic")
    if name == "drucker_prager":  # a gap closes at once
        t = eqx.tree_at(lambda t: t[2].gap, t, t[2].gap.at[elastic].set(0))
    ahead, behind = (
        linearised(jax.tree.map(lambda a, b, s=s: a + s * h * b, q, t), t, w, twice=twice)[0] for s in (1, -1)
    )
    if twice:
        _, curved = linearised(q, t, w, twice=True)
        for exact, a, b in zip(jax.tree.leaves(curved), jax.tree.leaves(ahead), jax.tree.leaves(behind), strict=True):
            assert_close(exact, (a - b) / (2 * h), 1e-6)
        return
    _, pushed, pulled = linearised(q, t, w, twice=False)
    for n in range(len(names)):
        assert_close(pushed[:, n], ((ahead - behind) / (2 * h))[:, n], 1e-7)
    same = np.concatenate([a.reshape(-1, len(names)) for a in jax.tree.leaves(t[1:])])
    np.testing.assert_array_equal(pushed[:, elastic], same[:, elastic])
    np.testing.assert_allclose(inner(pulled, t), inner(w, pushed), rtol=1e-12)


@pytest.mark.thorough
@EACH_LAW
@EACH_ORDER
def test_derivatives_are_finite_where_stretches_coincide(name, d, twice):
    """Forwards and backwards, at F = I, at F = s I, at two equal stretches, the deviator zero or not, whether or not it
    has yielded."""
    law, rng = law_of(name), np.random.default_rng(2)
    diagonals = np.repeat([(1, 1, 1), (0.9, 0.9, 0.9), (1.1, 1.1, 1.1), (1.2, 1.2, 0.8), (0.7, 0.7, 0.8)], 2, axis=0)
    F = jnp.asarray(np.einsum("pi,ij->ijp", diagonals[:, :d], np.eye(d)))
    history = law.initial_history(F)
    scalar = CASES[name][0]
    yielded = np.where(np.arange(len(diagonals)) % 2 == 0, getattr(history, scalar), 0.04)
    transverse = None if d == 3 else jnp.log(diagonals[:, 2])
    q = (law, F, with_history(history, transverse, **{scalar: yielded}))
    for leaf in jax.tree.leaves(linearised(q, *directions(q, rng), twice=twice)):
        assert np.isfinite(leaf).all()


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["drucker_prager", "cam_clay"])
@EACH_DIM
def test_what_has_come_apart_feels_no_strain(name, d):
    """F = 1.05 I, its deviator exactly zero, is at the tip with all its neighbours: no change of it changes the elastic
    strain after the return, in the space or out of it, and its volume goes to the gap."""
    law = law_of(name)
    F = 1.05 * undeformed(law, d)[0]
    history = with_history(
        law.initial_history(F), None if d == 3 else jnp.log(jnp.array([1.05])), **{CASES[name][0]: [0.02]}
    )
    dF = jnp.asarray(np.random.default_rng(0).normal(size=F.shape))

    def after(F):
        F, new = law.return_map(F, history, DT)
        return la.matmul(la.transpose(F), F), new

    (squared, new), (change, rates) = jax.jvp(after, (F,), (dF,))
    assert_close(squared, la.identity_like(F), 1e-14)
    np.testing.assert_allclose(change, 0, atol=1e-14)
    np.testing.assert_allclose(getattr(rates, CASES[name][0]), la.trace(dF) / 1.05, rtol=1e-12)
    for out_of_plane in (new.transverse_strain, rates.transverse_strain):
        np.testing.assert_allclose(0 if d == 3 else out_of_plane, 0, atol=1e-14)


@pytest.mark.thorough
@EACH_LAW
@EACH_DIM
def test_single_precision_stays_single(name, d):
    """F, history and stress in float32, and near those of double precision."""
    law = canonical(PLASTIC[name], jnp.float32)
    _, F, history = cases(name, d)
    exact = return_map(law_of(name), F, history)
    single = return_map(law, *jax.tree.map(lambda a: a.astype(jnp.float32), (F, history)))
    for a, b in zip(jax.tree.leaves(single), jax.tree.leaves(exact), strict=True):
        assert a.dtype == jnp.float32
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-6)
    assert all(a.dtype == jnp.float32 for a in jax.tree.leaves(law.initial_history(F.astype(jnp.float32))))


def with_parameters(name, **values):
    """A law of the registry with other parameters."""
    law = law_of(name)
    for parameter, value in values.items():
        law = eqx.tree_at(lambda law, parameter=parameter: getattr(law, parameter), law, jnp.asarray(value))
    return law


def stretched(law, strains):
    """The states of one particle that is strained by these principal logarithmic increments, (steps, d), from rest."""
    d = strains.shape[1]
    L = np.einsum("ni,ij->nij", np.expm1(strains), np.eye(d))[..., None]
    return driven(law, *undeformed(law, d), jnp.asarray(L))


@eqx.filter_jit
def triaxial(law, F, history, axial, confinement):
    """One particle in three dimensions, strained along its first axis by logarithmic increments, (steps,), and in the
    others, by Newton's method, so that the Kirchhoff stress there is minus the confinement: F, history, stress and
    lateral increments."""

    def strained(state, a, x):
        F, history = law.return_map(jnp.exp(jnp.stack([a, x, x]))[:, None, None] * state[0], state[1], DT)
        return F, history, la.matmul(law.elastic(history).stress(F), la.transpose(F))

    def body(state, a):
        def residual(x):
            return strained(state, a, x)[2][1, 1, 0] + confinement

        def newton(_, x):
            value, slope = jax.jvp(residual, (x,), (jnp.ones_like(x),))
            return x - value / slope

        x = jax.lax.fori_loop(0, 12, newton, -law.poisson_ratio * a)
        F, history, stress = strained(state, a, x)
        return (F, history), (F, history, stress, x)

    return jax.lax.scan(body, (F, history), axial)[1]


def pressure_and_shear(stress):
    """p = −tr τ/3 and q = √(3/2) ‖dev τ‖ of stresses (steps, 3, 3, 1)."""
    stress = np.asarray(stress)[..., 0]
    p = -np.trace(stress, axis1=1, axis2=2) / 3
    return p, np.sqrt(1.5) * np.linalg.norm(stress + p[:, None, None] * np.eye(3), axis=(1, 2))


def isotropic(law, p):
    """One particle in three dimensions under a pressure, by its elastic law: F and the history."""
    F, history = undeformed(law, 3)
    return jnp.exp(-p / (3 * K)) * F, history


def test_von_mises_in_tension():
    """τ = E ε to σ_y; beyond, dε = dτ/E + dα and dτ = H dα give the slope E H/(E + H), α = (τ − σ_y)/H, and a lateral
    strain −ν τ/E − α/2; to 1e-12."""
    law, axial = law_of("von_mises"), np.full(60, 1e-3)
    _, history, stress, lateral = triaxial(law, *undeformed(law, 3), jnp.asarray(axial), 0.0)
    strain = np.cumsum(axial)
    tau = np.minimum(E * strain, 100 + E * 500 / (E + 500) * (strain - 100 / E))
    alpha = np.maximum(tau - 100, 0) / 500
    np.testing.assert_allclose(stress[:, 0, 0, 0], tau, rtol=1e-12)
    np.testing.assert_allclose(stress[:, 1:, 1:], 0, atol=1e-11)
    np.testing.assert_allclose(history.plastic_strain[:, 0], alpha, rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.cumsum(lateral), -NU * tau / E - alpha / 2, rtol=1e-11)


def test_von_mises_in_uniaxial_strain():
    """‖e‖ = √(2/3) ε yields at ε = σ_y/2μ; the slope falls from K + 4μ/3 to K + (4μ/3) H/(3μ + H), since ‖s‖ grows by
    2μ d‖e‖ less 2μ Δγ; to 1e-12."""
    strain = np.full((60, 1), -1e-3)
    stress = stretched(law_of("von_mises"), strain)[2][:, 0, 0, 0]
    total = np.cumsum(-strain)
    beyond = np.maximum(total - 100 / (2 * MU), 0)
    tau = (K + 4 / 3 * MU) * total - 4 / 3 * MU * (1 - 500 / (3 * MU + 500)) * beyond
    np.testing.assert_allclose(stress, -tau, rtol=1e-12)


@pytest.mark.thorough
def test_von_mises_in_pure_shear():
    """Stretched by e^ε and e^−ε in the plane: τ = 2μ ε to σ_y/√3, and then the slope 2μ H/(3μ + H); to 1e-12."""
    strain = np.outer(np.full(60, 1e-3), (1, -1))
    stress = stretched(law_of("von_mises"), strain)[2][..., 0]
    total = np.cumsum(strain[:, 0])
    first = 100 / np.sqrt(3) / (2 * MU)
    tau = 2 * MU * np.minimum(total, first) + 2 * MU * 500 / (3 * MU + 500) * np.maximum(total - first, 0)
    np.testing.assert_allclose(stress[:, 0, 0], tau, rtol=1e-12)
    np.testing.assert_allclose(stress[:, 1, 1], -tau, rtol=1e-12)


def sheared(law, F, history, gamma, steps):
    """The last state of one particle in simple shear."""
    d = F.shape[0]
    L = np.zeros((steps, d, d, 1))
    L[:, 0, 1] = gamma / steps
    return jax.tree.map(lambda a: a[-1], driven(law, F, history, jnp.asarray(L)))


def shear_by_integration(gamma):
    """Deviator s of τ and α by von Mises' law in simple shear, F = I + γ e₁₂, from where the elastic law yields: with
    b = F_E F_Eᵀ, s = dev μ log b and n = s/‖s‖, b' = L b + b Lᵀ − 2 λ n b and α' = √(2/3) λ (Simo 1992), where
    λ = 2μ (n : L)/(2μ + 2H/3) keeps ‖s‖ = √(2/3) (σ_y + H α): n commutes with b, so n : (log b)' = 2 n : (L − λ n)."""
    L = np.zeros((3, 3))
    L[0, 1] = 1

    def deviator(b):
        s, V = np.linalg.eigh(b)
        e = (V * np.log(s) / 2) @ V.T
        return 2 * MU * (e - np.trace(e) / 3 * np.eye(3))

    def at(g):
        return (np.eye(3) + g * L) @ (np.eye(3) + g * L).T

    first = scipy.optimize.brentq(
        lambda g: np.linalg.norm(deviator(at(g))) - np.sqrt(2 / 3) * 100, 0, gamma, xtol=1e-15
    )

    def rate(_, y):
        b = y[:9].reshape(3, 3)
        n = deviator(b) / np.linalg.norm(deviator(b))
        flow = 2 * MU * (n * L).sum() / (2 * MU + 1000 / 3)
        return np.r_[(L @ b + b @ L.T - 2 * flow * n @ b).ravel(), np.sqrt(2 / 3) * flow]

    y = scipy.integrate.solve_ivp(rate, (first, gamma), np.r_[at(first).ravel(), 0], rtol=1e-11, atol=1e-13).y[:, -1]
    return deviator(y[:9].reshape(3, 3)), y[9]


@pytest.mark.thorough
def test_von_mises_in_simple_shear():
    """To γ = 0.6, against integration of the rate equations: error in proportion to the step, and 1e-6 once that is
    extrapolated."""
    law = law_of("von_mises")
    deviator, alpha = shear_by_integration(0.6)
    found = []
    for steps in (500, 1000, 2000):
        _, history, stress = sheared(law, *undeformed(law, 3), 0.6, steps)
        found.append(np.r_[np.asarray(stress).ravel(), 100 * history.plastic_strain])
    expected = np.r_[deviator.ravel(), 100 * alpha]
    errors = [np.linalg.norm(a - expected) / np.linalg.norm(expected) for a in found]
    assert errors[2] < 1e-3
    np.testing.assert_allclose(2 * found[2] - found[1], expected, rtol=0, atol=1e-6 * np.linalg.norm(expected))


SLOPE = 6 * np.sin(0.6) / (3 - np.sin(0.6))


def test_sand_in_triaxial_compression():
    """At the confining stress σ: E in slope, to q/p = 6 sin φ/(3 − sin φ) = M, where p = σ + q/3 gives q = M σ/(1 −
    M/3); sliding keeps the volume; to 1e-10."""
    law, sigma = law_of("drucker_prager"), 100.0
    axial = jnp.asarray(np.full(80, -2e-3))
    F, _, stress, lateral = triaxial(law, *isotropic(law, sigma), axial, sigma)
    p, q = pressure_and_shear(stress)
    strain = -np.cumsum(axial)
    np.testing.assert_allclose(q, np.minimum(E * strain, SLOPE * sigma / (1 - SLOPE / 3)), rtol=1e-10)
    np.testing.assert_allclose(p, sigma + q / 3, rtol=1e-10)
    np.testing.assert_allclose((axial + 2 * lateral)[40:], 0, atol=1e-12)
    np.testing.assert_allclose(np.log(np.linalg.det(F[..., 0])), -p / K, rtol=1e-10)


@pytest.mark.thorough
def test_sand_parts_and_closes():
    """Compressed it is elastic, p = −K tr ε; pulled apart it carries nothing and keeps the gap, the logarithm of the
    volume; pushed together it resists once the gap is closed, with the pressure of the total volume."""
    law = law_of("drucker_prager")
    steps = np.r_[np.full(20, -1e-3), np.full(60, 1e-3), np.full(60, -1e-3)]
    F, history, stress = stretched(law, np.outer(steps, np.ones(3)))
    total = 3 * np.cumsum(steps)
    np.testing.assert_allclose(F[:20, 0, 0, 0], np.exp(total / 3)[:20], rtol=1e-14)
    p, q = pressure_and_shear(stress)
    apart = np.maximum(total, 0)
    np.testing.assert_allclose(p, K * (apart - total), atol=1e-10)
    np.testing.assert_allclose(history.gap[:, 0], apart, atol=1e-14)
    np.testing.assert_allclose(q, 0, atol=1e-10)
    assert total.max() > 0.11


@pytest.mark.thorough
def test_sand_in_simple_shear():
    """From a pressure, in plane strain and in 3-D: p stays as it is and q = M p, to 1e-12; in 2-D and 3-D alike."""
    law = law_of("drucker_prager")
    (F, history), p = isotropic(law, 300.0), 300.0
    _, _, stress = sheared(law, F, history, 0.8, 200)
    np.testing.assert_allclose(np.ravel(pressure_and_shear(stress[None])), [p, SLOPE * p], rtol=1e-12)
    plane = with_history(law.initial_history(F[:2, :2]), jnp.log(F[2, 2]))
    _, _, flat = sheared(law, F[:2, :2], plane, 0.8, 200)
    np.testing.assert_allclose(flat, stress[:2, :2], rtol=1e-11)


@pytest.mark.thorough
def test_sand_that_flows_in_plane_strain():
    """The third principal stress becomes the mean of the others, and with q = M p their ratio is Coulomb's for the
    angle ψ with sin ψ = M/√3, to 1e-10, which the docstring turns round."""
    phi = np.arcsin(3 * np.sqrt(3) * 0.5 / (6 + np.sqrt(3) * 0.5))  # ψ = 30 degrees
    law = canonical(mpm.DruckerPrager(E, NU, phi), jnp.float64)
    F = jnp.repeat(0.99 * jnp.eye(2)[..., None], 1, axis=-1)
    start = with_history(law.initial_history(F), jnp.log(jnp.asarray([0.99])))
    squeezed = jnp.diag(jnp.expm1(jnp.array([1e-2, -1e-2])))[..., None]
    stress = driven(law, F, start, jnp.repeat(squeezed[None], 200, axis=0))[2]
    tau = np.diagonal(np.asarray(stress)[-1, :, :, 0])
    np.testing.assert_allclose((tau[0] - tau[1]) / -(tau[0] + tau[1]), 0.5, rtol=1e-10)


def test_clay_compacts():
    """In isotropic compression, exactly: where it yields p is the p₀ before the step, and tr ε + α what the total is.
    So −tr ε = sinh(−ξ α) with that sum, to the first order in the step, and to 1e-6 once extrapolated."""
    law = with_parameters("cam_clay", hardening=0.5)
    start = float(law.initial_history(jnp.eye(3)[..., None]).volume_strain[0])
    np.testing.assert_allclose(K * np.sinh(-0.5 * start), 300, rtol=1e-14)
    moved = replace(law.initial_history(jnp.eye(3)[..., None]), volume_strain=start + jnp.asarray([-0.2, 0.3]))
    np.testing.assert_allclose(law.compaction(moved), [np.exp(-0.2), 1], rtol=1e-14)  # what has loosened counts as one
    total, found = -0.6, []
    for steps in (1000, 2000):
        _, history, stress = stretched(law, np.full((steps, 3), total / 3 / steps))
        (p, q), alpha = pressure_and_shear(stress), history.volume_strain[:, 0]
        np.testing.assert_allclose(q, 0, atol=1e-9)
        np.testing.assert_allclose(-p / K + alpha - start, total / steps * np.arange(1, steps + 1), atol=1e-12)
        yields = np.asarray(alpha[1:] < alpha[:-1])
        assert yields.mean() > 0.9
        np.testing.assert_allclose(p[1:][yields], K * np.sinh(-0.5 * alpha[:-1])[yields], rtol=1e-10)
        found.append(p[-1])
    exact = scipy.optimize.brentq(lambda x: x - np.sinh(0.5 * (-start - total - x)), 0, 1)
    np.testing.assert_allclose(found[1], K * exact, rtol=2e-3)
    np.testing.assert_allclose(2 * found[1] - found[0], K * exact, rtol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("pressure", [200.0, 30.0])
@pytest.mark.parametrize("cohesion", [0.0, 0.3])
def test_clay_reaches_its_critical_state(pressure, cohesion):
    """Triaxial at constant confining stress σ, from 2/3 of p₀ it compacts, from a tenth it loosens, until it shears on
    without change at p = p_c = (1 − β) p₀/2, q = N p with N = M (1 + β)/((1 − β) √(1 + 2β)), p = σ/(1 − N/3)."""
    law = with_parameters("cam_clay", cohesion=cohesion)
    _, history, stress, _ = triaxial(law, *isotropic(law, pressure), jnp.full(800, -5e-3), pressure)
    p, q = pressure_and_shear(stress)
    alpha = np.asarray(history.volume_strain[:, 0])
    N = 1.2 * (1 + cohesion) / ((1 - cohesion) * np.sqrt(1 + 2 * cohesion))
    assert (alpha[-1] < alpha[0]) == (pressure > 100)
    np.testing.assert_allclose(q[-1], N * p[-1], rtol=1e-6)
    np.testing.assert_allclose(p[-1], pressure / (1 - N / 3), rtol=1e-6)
    np.testing.assert_allclose(K * np.sinh(-2 * alpha[-1]) * (1 - cohesion) / 2, p[-1], rtol=1e-6)


@pytest.mark.thorough
def test_clay_tears_and_closes():
    """Pulled apart evenly it holds β p₀ at most, then nothing, and α is the gap: pushed together it resists once that
    is closed."""
    law = law_of("cam_clay")
    steps = np.r_[np.full(80, 1e-3), np.full(100, -1e-3)]
    _, history, stress = stretched(law, np.outer(steps, np.ones(3)))
    p, _ = pressure_and_shear(stress)
    alpha = np.asarray(history.volume_strain[:, 0])
    total, start = 3 * np.cumsum(steps), float(law.initial_history(jnp.eye(3)[..., None]).volume_strain[0])
    np.testing.assert_allclose(p.min(), -0.3 * 300, rtol=1e-12)
    np.testing.assert_allclose(total, -p / K + alpha - start, atol=1e-12)
    held = np.where(np.r_[start, alpha[:-1]] >= 0, p, 0)
    np.testing.assert_allclose(held, 0, atol=1e-10)
    assert alpha.max() > 0.2
    assert p[-1] > 0


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        ("von_mises", {"youngs_modulus": 0.0}, r"VonMises's youngs_modulus \[Pa\] must be greater than zero"),
        ("von_mises", {"poisson_ratio": 0.5}, "VonMises's poisson_ratio must be strictly between -1 and 0.5"),
        ("von_mises", {"yield_stress": np.array([1.0, 0.0])}, r"yield_stress \[Pa\] must be greater than zero"),
        ("von_mises", {"hardening_modulus": -1.0}, r"hardening_modulus \[Pa\] must be at least 0, got -1.0"),
        ("drucker_prager", {"youngs_modulus": -1.0}, "DruckerPrager's youngs_modulus"),
        ("drucker_prager", {"poisson_ratio": -1.0}, "DruckerPrager's poisson_ratio"),
        ("drucker_prager", {"friction_angle": 30.0}, r"friction_angle \[rad\] must be strictly between 0 and 1.57"),
        ("herschel_bulkley", {"yield_stress": 0.0}, r"HerschelBulkley's yield_stress \[Pa\] must be greater than zero"),
        ("herschel_bulkley", {"consistency": -1.0}, r"consistency \[Pa s\^n\] must be at least 0, got -1.0"),
        ("herschel_bulkley", {"exponent": 0.0}, "HerschelBulkley's exponent must be greater than zero"),
        ("cam_clay", {"youngs_modulus": np.nan}, "CamClay's youngs_modulus .* must be finite"),
        ("cam_clay", {"poisson_ratio": 0.6}, "CamClay's poisson_ratio"),
        ("cam_clay", {"friction": 0.0}, "CamClay's friction must be greater than zero"),
        ("cam_clay", {"preconsolidation": -1.0}, r"preconsolidation \[Pa\] must be at least 0"),
        ("cam_clay", {"cohesion": -0.1}, "cohesion must be at least 0"),
        ("cam_clay", {"hardening": 0.0}, "hardening must be greater than zero"),
    ],
)
def test_bad_parameters_are_refused(name, values, message):
    """In a line that names the law, the parameter and its bounds."""
    law = PLASTIC[name]
    with pytest.raises(ValueError, match=message):
        type(law)(**({k: getattr(law, k) for k in vars(law)} | values))


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_sand_closes_when_the_gap_is_used_up(d):
    """The mean strain of the return map is m + v_c/3: equal strains of −0.03, and gaps that leave −0.01 and +0.01 of it
    (in plane strain the third one is the history's); likewise at rest. A further shear strains what has closed, and not
    what is apart."""
    law, gap = PLASTIC["drucker_prager"], jnp.asarray([0.06, 0.12, 0.03])
    strain = jnp.asarray([-0.03, -0.03, 0.0])
    F = jnp.exp(strain) * jnp.eye(d)[..., None]
    history = replace(law.initial_history(F), gap=gap, transverse_strain=None if d == 3 else strain)
    shear = jnp.ones(F.shape) - jnp.eye(d)[..., None]
    returned_and_strained = jax.jit(lambda F: jax.jvp(lambda F: law.return_map(F, history, 1.0), (F,), (shear,)))
    (returned, after), (strained, _) = returned_and_strained(F)
    np.testing.assert_allclose(strained, shear * jnp.asarray([np.exp(0.02), 0, 0]), atol=1e-15)
    np.testing.assert_allclose(after.gap, [0, 0.03, 0.03], atol=1e-15)
    np.testing.assert_allclose(returned[0, 0], np.exp([-0.01, 0, 0]), rtol=1e-14)
    if d == 2:
        np.testing.assert_allclose(after.transverse_strain, [-0.01, 0, 0], atol=1e-15)
