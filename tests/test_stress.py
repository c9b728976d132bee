"""The stress of particles, for every law and description, by closed forms and by the energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, ELASTIC, FLUIDS, PLASTIC, RUBBER, assert_close, block, ids

import mpmjax as mpm
from mpmjax import analysis

STRAIN = np.array([[1.1, 0.07, -0.02], [0.04, 0.93, 0.03], [0.01, -0.05, 1.04]])


def deformed(d, law, F, description=mpm.UpdatedLagrangian()):
    """A block whose particles all have this deformation."""
    scene, particles = block(d, material=law, description=description)
    particles = mpm.prepare(scene, particles)
    stored = jnp.broadcast_to(jnp.asarray(F), particles.deformations[0].shape)
    return scene, eqx.tree_at(lambda q: q.deformations, particles, (stored,))


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("law", **ids(ELASTIC | RUBBER, "neo_hookean"))
def test_stress_is_the_slope_of_the_energy_in_every_direction(d, law):
    """σ = P Fᵀ/J by the energy of the law in the plane, and normal to it by that of a thickness that grows."""
    F = STRAIN[:d, :d]
    sigma = mpm.stress(*deformed(d, law, F))

    def energy(F):
        return law.energy(F[..., None])[0]

    P = jax.grad(energy)(jnp.asarray(F))
    assert_close(sigma[:, :d, :d], np.broadcast_to(P @ F.T / np.linalg.det(F), (len(sigma), d, d)), 1e-10, 1e-9)
    np.testing.assert_array_equal(sigma[:, :d, d:], 0)
    whole = jnp.eye(3).at[:d, :d].set(F)
    assert_close(energy(whole), energy(jnp.asarray(F)))  # two dimensions are plane strain
    for i in range(d, 3):
        slope = jax.grad(lambda s, i=i: energy(whole.at[i, i].set(s)))(1.0)
        assert_close(sigma[:, i, i], np.full(len(sigma), slope / np.linalg.det(F)), 1e-10, 1e-9)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("name", ["stress", "pressure", "von_mises", "density"])
def test_both_descriptions_say_the_same(d, name):
    """The quantities of a body do not depend on where its gradients are taken."""
    of = mpm.stress if name == "stress" else getattr(analysis, name)
    values = [of(*deformed(d, RUBBER["ogden"], STRAIN[:d, :d], kind)) for kind in DESCRIPTIONS.values()]
    assert_close(values[0], values[1])


def test_closed_forms_of_an_even_and_a_uniaxial_strain():
    """K tr ε and 2μ ε in small strains; Tait's pressure and ρ0/J of a fluid."""
    E, nu, e = 1e4, 0.3, 1e-6
    lam, mu = E * nu / (1 + nu) / (1 - 2 * nu), E / 2 / (1 + nu)
    scene, particles = deformed(2, mpm.NeoHookean(E, nu), np.diag([1 + e, 1.0]))
    assert_close(mpm.stress(scene, particles)[0] / e, np.diag([lam + 2 * mu, lam, lam]), 1e-5)
    assert_close(analysis.pressure(scene, particles)[0] / e, np.asarray(-(lam + 2 / 3 * mu)), 1e-5)
    assert_close(analysis.von_mises(scene, particles)[0] / e, np.asarray(2 * mu), 1e-5)
    assert_close(analysis.density(scene, particles), particles.mass / particles.volume / (1 + e))
    for d in (1, 2, 3):
        law = mpm.Fluid(1e4, exponent=7.0)
        scene, particles = deformed(d, law, 0.9)
        pressure = np.full(particles.count, 1e4 / 7 * (0.9**-7 - 1))
        assert_close(analysis.pressure(scene, particles), pressure)
        assert_close(mpm.stress(scene, particles), -pressure[:, None, None] * np.eye(3))
        assert_close(analysis.density(scene, particles), particles.mass / particles.volume / 0.9)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_what_has_yielded_is_at_its_yield_stress(d):
    """In plane strain the stress out of the plane belongs to it: J √(3/2) ‖dev σ‖ is the yield stress of the law."""
    law = mpm.VonMises(1e4, 0.3, yield_stress=400.0, hardening_modulus=0.0)
    scene, particles = deformed(d, law, np.eye(d) - 0.2 * np.eye(d)[0] * np.eye(d)[:, :1])
    after = scene.return_map(particles, 1e-3)
    J = 0.8  # which yielding keeps
    assert_close(analysis.von_mises(scene, after), np.full(after.count, 400.0 / J), 1e-9)
    assert_close(analysis.density(scene, after), after.mass / after.volume / J, 1e-9)


def test_viscosity_is_part_of_it():
    """2η dev D + ζ tr D I of a known velocity gradient, in both descriptions."""
    law = mpm.Viscous(ELASTIC["neo_hookean"], 20.0, 5.0)
    L = np.array([[0.3, 0.1], [-0.2, 0.5]])
    for kind, C in ((DESCRIPTIONS["updated"], L), (DESCRIPTIONS["total"], L @ STRAIN[:2, :2])):
        scene, particles = deformed(2, law, STRAIN[:2, :2], kind)
        particles = eqx.tree_at(lambda q: q.C, particles, jnp.broadcast_to(jnp.asarray(C), (particles.count, 2, 2)))
        D = np.zeros((3, 3))
        D[:2, :2] = (L + L.T) / 2
        viscous = 40 * (D - np.trace(D) / 3 * np.eye(3)) + 5 * np.trace(D) * np.eye(3)
        elastic = mpm.stress(*deformed(2, law.law, STRAIN[:2, :2], kind))
        assert_close(mpm.stress(scene, particles) - elastic, np.broadcast_to(viscous, elastic.shape), 1e-8, 1e-10)


def test_stress_is_differentiable():
    """By a parameter, against a difference; and at rest, where the von Mises stress has a corner."""
    scene, particles = deformed(2, ELASTIC["neo_hookean"], STRAIN[:2, :2])

    def mean(E, particles=particles):
        return analysis.von_mises(eqx.tree_at(lambda s: s.material.youngs_modulus, scene, E), particles).mean()

    slope = jax.grad(mean)(1e4)
    assert_close(slope, (mean(1.01e4) - mean(0.99e4)) / 200, 1e-6)
    assert jax.grad(mean)(1e4, deformed(2, ELASTIC["neo_hookean"], np.eye(2))[1]) == 0


@pytest.mark.parametrize("law", **ids(PLASTIC | FLUIDS, "snow"))
def test_every_law_has_a_finite_symmetric_stress(law):
    scene, particles = block(2, material=law)
    sigma = mpm.stress(scene, particles)
    assert np.isfinite(sigma).all()
    assert_close(sigma, jnp.swapaxes(sigma, 1, 2), 1e-12, 1e-9)


@pytest.mark.parametrize("d", [1, 3])
def test_smoothing_keeps_a_constant_and_takes_what_alternates(d):
    """Two particles along a cell's edge that alternate have no mean."""
    scene, particles = block(d, side=4)
    assert_close(analysis.smoothed(scene, particles, jnp.full(particles.count, 3.0)), np.full(particles.count, 3.0))
    sign = jnp.where(jnp.round(particles.x[:, 0] / 0.05 - 0.5) % 2 == 0, 1.0, -1.0)
    inside = np.abs(np.asarray(particles.x[:, 0]) - 0.2) < 0.1
    assert np.abs(analysis.smoothed(scene, particles, sign))[inside].max() < 0.1


@pytest.mark.parametrize("order", [2, 3])
def test_smoothing_is_even_where_nodes_are_in_balance_however_stresses_scatter(order):
    """As they do where materials of different stiffness share nodes."""
    cells, kernel = 12, mpm.BSpline(order)
    grid = mpm.Grid((cells + 8,), 1.0, origin=(-4,))
    particles = mpm.fill(mpm.Box((0.0,), (float(cells),)), grid, particles_per_cell=2, density=1.0)
    choices = {"kernel": kernel, "gradient": mpm.SplineGradient()}
    scene = mpm.Scene(grid, mpm.Hencky(1.0, 0.0), **choices)
    stencil = scene.stencil(mpm.prepare(scene, particles))
    forces = np.zeros((grid.size, particles.count))  # of a stress at each particle on each node
    np.add.at(forces, (stencil.index, np.arange(particles.count)), stencil.gradient[:, 0] * particles.volume)
    within = forces[6 : cells + 3]  # nodes that no end is near
    stress = np.random.default_rng(0).uniform(-1, 1, particles.count)
    stress = 1 + stress - np.linalg.pinv(within) @ (within @ stress)  # those parts that leave these nodes at rest
    mean = np.asarray(analysis.smoothed(scene, particles, stress))[6:-6]
    assert np.ptp(stress) > 1
    assert_close(mean, np.full_like(mean, mean[0]), 1e-12)
