"""The fluid that knows J alone: its equation of state, what it stores, and that its surface parts."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import FLUIDS, assert_close, block, ids, thorough

import mpmjax as mpm
from mpmjax.material._fluid import Tait

EXPONENTS = (0.5, 1.0, 1.0 + 1e-5, 1.4, 7.0)


@eqx.filter_jit
def response(law, J):
    """Energy, stress and tangent of stretches, and the same by differentiation of the energy, the stress once more."""
    gradient = jax.grad(lambda J: law.energy(J).sum())
    curvature = jax.jvp(gradient, (J,), (jnp.ones_like(J),))[1]
    return law.energy(J), law.stress(J), law.stress_differential(J)(jnp.ones_like(J)), gradient(J), curvature


@pytest.mark.parametrize("exponent", EXPONENTS)
def test_stress_and_tangent_are_derivatives_of_the_energy(exponent):
    """p = K/γ (J^−γ − 1), Ψ'' = K J^(−1−γ); Ψ is the integral of −p by Gauss's rule, zero and finite at J = 1."""
    K, J = 3e4, np.r_[1.0, np.linspace(0.5, 2.0, 16)]
    law = Tait(jnp.asarray(K), jnp.asarray(exponent))
    energy, stress, tangent, gradient, curvature = (np.ravel(a) for a in response(law, jnp.asarray(J)))
    pressure = lambda J: K / exponent * (J**-exponent - 1)  # noqa: E731
    np.testing.assert_allclose(stress, -pressure(J), rtol=1e-13, atol=1e-11 * K)
    np.testing.assert_allclose(gradient, stress, rtol=1e-12, atol=1e-12 * K)
    np.testing.assert_allclose(tangent, K * J ** (-1 - exponent), rtol=1e-13)
    np.testing.assert_allclose(curvature, tangent, rtol=1e-11)
    places, weights = np.polynomial.legendre.leggauss(40)
    middle, half = (J + 1) / 2, (J - 1) / 2
    work = -half * (weights[:, None] * pressure(middle + half * places[:, None])).sum(axis=0)
    np.testing.assert_allclose(energy, work, rtol=1e-9, atol=1e-10 * K)
    assert energy[0] == 0


def test_without_tension_there_is_none():
    """Ψ and p as with it up to J = 1, zero beyond; at J = 1 the tangent is that of compression, by both routes."""
    J = jnp.asarray([0.8, 0.99, 1.0, 1.01, 1.5])
    whole, cut = (response(Tait(jnp.asarray(2e4), jnp.asarray(7.0), tension), J) for tension in (True, False))
    for a, b in zip(whole, cut, strict=True):
        assert_close(a[..., :3], b[..., :3], 1e-14)
        np.testing.assert_array_equal(b[..., 3:], 0)


def test_the_energy_has_its_derivative_by_the_exponent_also_where_it_is_one():
    """∂Ψ/∂γ against central differences, across the switch to the series and at γ = 1."""
    J = jnp.asarray([0.7, 1.3])
    energy = jax.jit(lambda g: Tait(2e4, g).energy(J))
    for exponent in (1.0, 1.0 + 2e-3, 0.9901, 1.02, 7.0):
        found = jax.jvp(energy, (jnp.asarray(exponent),), (jnp.ones(()),))[1]
        difference = (energy(exponent + 1e-4) - energy(exponent - 1e-4)) / 2e-4
        np.testing.assert_allclose(found, difference, rtol=1e-6)


def test_parameters_are_positive_scalars_or_one_per_particle():
    K, J = jnp.asarray([1e4, 2e4, 3e4]), jnp.asarray([0.9, 1.0, 1.1])
    several = response(Tait(K, jnp.asarray(7.0)), J)
    for i in range(3):
        alone = response(Tait(K[i], jnp.asarray(7.0)), J[i : i + 1])
        for a, b in zip(several, alone, strict=True):
            assert_close(a[..., i], b[..., 0], 1e-14)
    with pytest.raises(ValueError, match="Fluid's bulk_modulus"):
        mpm.Fluid(-1.0)
    with pytest.raises(ValueError, match="Fluid's exponent"):
        mpm.Fluid(1e4, 0.0)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_particles_store_one_number_in_the_place_of_deformation(d):
    """J = 1, shape (p,), and in two groups each its own; a full F is refused, and so is the total description."""
    scene, particles = block(d, material=mpm.Fluid(1e4))
    prepared = mpm.prepare(scene, particles)
    assert prepared.F.shape == (particles.count,)
    assert not jax.tree.leaves(prepared.history)
    both = eqx.tree_at(lambda s: s.material, scene, (mpm.Fluid(1e4), mpm.NeoHookean(1e4, 0.3)))
    groups = mpm.prepare(both, mpm.join(particles, particles)).deformations
    assert [own.shape[1:] for own in groups] == [(), (d, d)]
    with pytest.raises(ValueError, match="Fluid needs J of shape"):
        mpm.prepare(scene, eqx.tree_at(lambda q: q.F, prepared, groups[1]))
    with pytest.raises(ValueError, match="use the updated one for Fluid"):
        mpm.Scene(scene.grid, mpm.Fluid(1e4), description=mpm.TotalLagrangian())


@pytest.mark.parametrize("law", **ids(FLUIDS, "fluid"))
def test_a_step_follows_the_density(law):
    """J ← J (1 + Δt tr ∇v), and not beyond 1 without tension: in a flow that shears and turns besides."""
    scene, particles = block(2, material=law)
    for rate in (-2.0, 2.0):
        C = jnp.broadcast_to(jnp.asarray([[0.7 * rate, 3.0], [-1.0, 0.3 * rate]]), (particles.count, 2, 2))
        moving = eqx.tree_at(lambda q: (q.v, q.C), particles, (particles.x @ C[0].T, C), is_leaf=lambda a: a is None)
        after, _ = mpm.step(scene, moving, 0.0, 1e-3)
        J = 1 + 1e-3 * rate
        assert_close(after.F, np.full(after.F.shape, J if law.tension else min(1, J)), 1e-13)


@pytest.mark.parametrize("method", [mpm.Explicit(), *thorough(mpm.BackwardEuler())])
def test_what_expands_flies_apart_unless_there_is_tension(method):
    """A block that expands evenly: with FLIP(1) each particle keeps its velocity, to rounding; with tension it is
    pulled back."""
    dt, steps = 1e-3, 100
    for law in FLUIDS.values():
        scene, particles = block(2, material=law, transfer=mpm.FLIP(1.0))
        v = particles.x - particles.x.mean(axis=0)
        flying = eqx.tree_at(lambda q: q.v, particles, v)
        final = mpm.rollout(scene, flying, steps=steps, dt=dt, method=method)
        if law.tension:
            assert float(jnp.abs(final.v - v).max() / jnp.abs(v).max()) > 0.1
        else:
            assert_close(final.v, v, 1e-11)


def test_shear_costs_nothing():
    """A uniform shear goes on as it is."""
    scene, particles = block(2, material=mpm.Fluid(1e4, tension=True))
    shear = jnp.asarray([[0.0, 1.0], [0.0, 0.0]])
    C = jnp.broadcast_to(shear, (particles.count, 2, 2))
    sheared = eqx.tree_at(lambda q: (q.v, q.C), particles, (particles.x @ shear.T, C), is_leaf=lambda a: a is None)
    final = mpm.rollout(scene, sheared, steps=50, dt=2e-3)
    assert_close(final.v, sheared.v, 1e-11)
    assert_close(final.F, np.ones_like(final.F), 1e-13)
