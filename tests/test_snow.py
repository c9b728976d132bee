"""Snow: its return map against the singular values, closed forms of element tests, and its derivatives."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, block, rotation_matrix, thorough

import mpmjax as mpm
from mpmjax.material import SnowHistory

SNOW = mpm.Snow(1.4e5, 0.2, critical_compression=2.5e-2, critical_stretch=7.5e-3, hardening=10.0)
DT = 1e-3


def trials(d, n=200, size=0.05, seed=0):
    """Trial deformations with stretches around the yield limits, shape (d, d, n), and a random history."""
    rng = np.random.default_rng(seed)
    stretches = 1 + size * rng.normal(size=(n, d))
    F = np.stack([rotation_matrix(d, rng) * s @ rotation_matrix(d, rng) for s in stretches], axis=-1)
    return jnp.asarray(F), SnowHistory(jnp.asarray(rng.uniform(0.8, 1.1, n)))


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_the_return_map_clamps_the_singular_values(d):
    """U clip(s) Vᵀ by LAPACK, to rounding; J_E J_P does not change."""
    F, history = trials(d)
    U, s, Vt = np.linalg.svd(np.moveaxis(np.asarray(F), -1, 0))
    expected = U * np.clip(s, 1 - 2.5e-2, 1 + 7.5e-3)[:, None] @ Vt
    clamped, after = jax.jit(SNOW.return_map)(F, history, DT)
    assert_close(np.moveaxis(np.asarray(clamped), -1, 0), expected, 1e-14)
    volume = np.linalg.det(np.moveaxis(np.asarray(F), -1, 0)) * history.plastic_volume
    assert_close(np.linalg.det(expected) * after.plastic_volume, volume, 1e-13)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_what_does_not_yield_comes_back_bit_for_bit(d):
    """And its history too."""
    F, history = trials(d, size=2e-3)
    clamped, after = jax.jit(SNOW.return_map)(F, history, DT)
    assert np.array_equal(clamped, F)
    assert np.array_equal(after.plastic_volume, history.plastic_volume)


def squeezed(d, rates, steps):
    """F_E, history and total stretches of one particle strained along its axes by F ← (1 + rate) F, step by step."""
    F, total = jnp.eye(d)[..., None], np.ones(d)
    history = SNOW.initial_history(F)
    returned = jax.jit(SNOW.return_map)
    for _ in range(steps):
        F = F * (1 + jnp.asarray(rates))[:, None, None]
        total = total * (1 + np.asarray(rates))
        F, history = returned(F, history, DT)
    return F, history, total


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_uniaxial_compression_hardens_as_its_closed_form(d):
    """The stretch along the axis is 1 − θ_c, the others 1; J_P = total/(1 − θ_c); the stress is that of fixed corotated
    there, times e^{ξ (1 − J_P)}."""
    F, history, total = squeezed(d, [-1e-3] + [0.0] * (d - 1), 150)
    assert_close(jnp.diagonal(F[..., 0]), jnp.asarray([1 - 2.5e-2] + [1.0] * (d - 1)), 1e-13)
    packed = total[0] / (1 - 2.5e-2)
    assert float(history.plastic_volume[0]) == pytest.approx(packed, rel=1e-12)
    modulus = 1.4e5 * np.exp(10 * (1 - packed))
    mu, lam = modulus / 2.4, modulus * 0.2 / (1.2 * 0.6)
    stress = SNOW.elastic(history).stress(F)[0, 0, 0]
    assert float(stress) == pytest.approx(-(2 * mu + lam) * 2.5e-2, rel=1e-10)


def test_isotropic_extension_tears():
    """Beyond 1 + θ_s the stretch stays and the moduli fall like e^{ξ (1 − J_P)}."""
    F, history, total = squeezed(3, [2e-3] * 3, 40)
    assert_close(jnp.diagonal(F[..., 0]), jnp.full(3, 1 + 7.5e-3), 1e-13)
    torn = total.prod() / (1 + 7.5e-3) ** 3
    assert float(history.plastic_volume[0]) == pytest.approx(torn, rel=1e-11)
    assert float(SNOW.elastic(history).youngs_modulus[0]) == pytest.approx(1.4e5 * np.exp(10 * (1 - torn)), rel=1e-9)


def test_simple_shear_turns_and_yields():
    """The principal stretches of a sheared particle reach both limits, and J_P = 1/((1 − θ_c)(1 + θ_s)) from then on:
    shear keeps the volume, J_E J_P = 1."""
    returned = jax.jit(SNOW.return_map)
    F, history = jnp.eye(2)[..., None], SNOW.initial_history(jnp.eye(2)[..., None])
    step = jnp.asarray([[0.0, 1e-3], [0.0, 0.0]])
    for _ in range(200):
        F, history = returned(F + jnp.einsum("ij,jkp->ikp", step, F), history, DT)
    s = np.linalg.svd(np.asarray(F[..., 0]))[1]
    assert_close(s, np.array([1 + 7.5e-3, 1 - 2.5e-2]), 1e-12)
    assert float(history.plastic_volume[0]) == pytest.approx(1 / ((1 - 2.5e-2) * (1 + 7.5e-3)), rel=1e-12)


@pytest.mark.thorough
def test_plane_strain_is_three_dimensional_strain_with_a_stretch_of_one():
    F, history = trials(2)
    solid = jnp.zeros((3, 3, F.shape[-1])).at[:2, :2].set(F).at[2, 2].set(1.0)
    flat, thick = jax.jit(SNOW.return_map)(F, history, DT), jax.jit(SNOW.return_map)(solid, history, DT)
    assert_close(thick[0][:2, :2], flat[0], 1e-14)
    assert_close(thick[1].plastic_volume, flat[1].plastic_volume, 1e-14)
    stress = [SNOW.elastic(after).stress(E) for E, after in (flat, thick)]
    assert_close(stress[1][:2, :2], stress[0], 1e-11)


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_the_return_map_creates_no_energy(d):
    """Ψ after it, hardened, is at most Ψ before it, where snow is packed; with a hundred times the hardening it is not.
    Torn snow gains little, since it has little."""

    def gain(snow):
        F, history = trials(d, n=2000, size=0.02)
        after, later = jax.jit(snow.return_map)(F, history, DT)
        before = snow.elastic(history).energy(F)
        return float((snow.elastic(later).energy(after) / before - 1).max())

    assert gain(SNOW) <= 1e-12
    assert gain(mpm.Snow(hardening=1e3)) > 0.1
    F, _ = trials(d, n=2000, size=0.02)
    for torn in (1.5, 2.0, 3.0):
        history = SnowHistory(jnp.full(F.shape[2:], torn))
        after, later = jax.jit(SNOW.return_map)(F, history, DT)
        more = SNOW.elastic(later).energy(after) - SNOW.elastic(history).energy(F)
        first = 1 - SNOW.critical_compression
        yielding = SNOW.elastic(SNOW.initial_history(F)).energy(first * jnp.eye(d)[..., None])
        assert float(more.max()) < 1e-2 * float(yielding[0])


def test_inverted_snow_is_a_fault():
    """The clamp would keep it inverted."""
    scene, particles = block(2, material=SNOW)
    F = jnp.broadcast_to(jnp.eye(2), (particles.count, 2, 2)).at[3, 0, 0].set(-0.5)
    with pytest.raises(ValueError, match="does not allow the F of particle 3"):
        mpm.prepare(scene, eqx.tree_at(lambda q: q.F, particles, F, is_leaf=lambda leaf: leaf is None))


def outcome(snow, F, history):
    after, later = snow.return_map(F, history, DT)
    return jnp.concatenate([after.reshape(-1), later.plastic_volume])


@jax.jit
def derivatives(place, t, u):
    """The outcome, its first and second derivatives along t, and its first one in reverse mode."""

    def push(q):
        return jax.jvp(lambda q: outcome(*q), (q,), (t,))

    (value, pushed), (_, twice) = jax.jvp(push, (place,), (t,))
    return value, pushed, twice, jax.grad(lambda q: (u * outcome(*q)).sum())(place)


EXACTLY = {"stretched alike": (1.02, 1.02, 1.02), "pressed alike": (0.95, 0.95, 0.95), "at rest": (1.0, 1.0, 1.0)}


BEYOND_BOTH = (0.9997, 1.0003, 0.9996)  # the limits of snow that yields at once


@pytest.mark.parametrize("stretches", [*EXACTLY.values(), (0.94, 1.0, 1.03), (0.93, 0.95, 0.99), BEYOND_BOTH])
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_derivatives_of_the_return_map_are_central_differences(d, stretches):
    """By F, history and all parameters, at repeated stretches too, and at near ones that are clamped to either limit;
    the transpose is the transpose, and second derivatives are differences of first ones."""
    rng = np.random.default_rng(4)
    F = jnp.asarray(rotation_matrix(d, rng) * np.array(stretches[:d]) @ rotation_matrix(d, rng))[..., None]
    snow = dataclasses.replace(SNOW, critical_compression=1e-4, critical_stretch=1e-4)
    place = (snow if stretches is BEYOND_BOTH else SNOW, F, SnowHistory(jnp.asarray([0.9])))
    place = jax.tree.map(lambda a: jnp.asarray(a, float), place)
    t = jax.tree.map(lambda a: jnp.asarray(a * rng.normal(size=a.shape) * 0.3), place)
    t = (t[0], jnp.asarray(0.1 * rng.normal(size=F.shape)), t[2])

    def moved(h):
        return jax.tree.map(lambda a, b: a + h * b, place, t)

    u = jnp.asarray(rng.normal(size=F.size + 1))
    h = 1e-6
    (before, pushed_before, _, _), (_, pushed, twice, pulled), (after, pushed_after, _, _) = (
        derivatives(moved(s), t, u) for s in (-h, 0.0, h)
    )
    assert_close(pushed, (after - before) / (2 * h), 1e-8)
    dot = sum(float((a * b).sum()) for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(t), strict=True))
    assert dot == pytest.approx(float((u * pushed).sum()), rel=1e-11)
    assert_close(twice, (pushed_after - pushed_before) / (2 * h), 1e-6, atol=1e-8)


def test_snow_refuses_what_makes_no_sense():
    for given, what in (
        ({"critical_compression": 1.0}, "critical_compression"),
        ({"critical_stretch": 0.0}, "critical_stretch"),
        ({"hardening": -1.0}, "hardening"),
        ({"youngs_modulus": -1.0}, "youngs_modulus"),
    ):
        with pytest.raises(ValueError, match=what):
            mpm.Snow(**given)


def test_dust_has_a_modulus():
    """Of snow torn to many times its volume, in single precision."""
    particles = SnowHistory(jnp.full(2, 30.0, jnp.float32))
    law = mpm.Snow(*(jnp.float32(a) for a in (1.4e5, 0.2, 2.5e-2, 7.5e-3, 10.0))).elastic(particles)
    assert (np.asarray(law.youngs_modulus) > 0).all()
