"""Viscosity: its stress, the operator it adds to a solve, and what it conserves."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, FLUIDS, LAWS, VISCOUS, assert_close, block, cloud, rotation_matrix, thorough

import mpmjax as mpm
from mpmjax.boundary import mirror
from mpmjax.implicit import ElasticPotential, ImplicitOperator, Projection
from mpmjax.material import Viscosity


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_the_stress_is_newtons(d):
    """2η dev D + ζ tr(D) I of D in plane strain, in three dimensions and with zeros; symmetric, dissipating, without
    part in turning, and turning with the frame. Its largest eigenvalue is what the bound takes."""
    rng, eta, zeta = np.random.default_rng(0), 3.0, 0.7
    L = rng.normal(size=(d, d))
    full = np.zeros((3, 3))
    full[:d, :d] = (L + L.T) / 2
    exact = (2 * eta * (full - np.trace(full) / 3 * np.eye(3)) + zeta * np.trace(full) * np.eye(3))[:d, :d]
    viscosity = Viscosity(jnp.asarray(eta), jnp.asarray(zeta))
    stress = lambda L: np.asarray(viscosity.stress(jnp.asarray(L)[..., None]))[..., 0]  # noqa: E731
    assert_close(stress(L), exact, 1e-14)
    assert (stress(L) * L).sum() > 0
    Q = rotation_matrix(d, rng)
    assert_close(stress(Q @ L @ Q.T), Q @ exact @ Q.T, 1e-13)
    np.testing.assert_allclose(stress(L - L.T), 0, atol=1e-15)
    for pair in ((3.0, 0.7), (0.2, 5.0)):
        viscosity = Viscosity(*map(jnp.asarray, pair))
        matrix = np.stack([stress(e.reshape(d, d)).ravel() for e in np.eye(d * d)])
        np.testing.assert_allclose(viscosity.stiffest(d), np.linalg.eigvalsh(matrix).max(), rtol=1e-13)


def potential_of(law, d, description="updated"):
    """Of a random cloud at a mirror, and a random node vector."""
    grid, particles = cloud(d)
    walls = mpm.SymmetryPlane(0, 0.0)
    scene = mpm.Scene(grid, law, boundary=walls, description=DESCRIPTIONS[description])
    if isinstance(law.law, mpm.Fluid):
        particles = eqx.tree_at(lambda q: q.F, particles, jnp.linalg.det(particles.F))
    scene, particles = jax.tree.map(jnp.asarray, (scene, mpm.prepare(scene, particles)))
    images = mirror(scene.boundary, grid, scene.window(particles))
    u = jnp.asarray(np.random.default_rng(1).normal(size=(2, grid.size, d)))
    return ElasticPotential(scene.material_points(particles), scene.stencil(particles), images, grid.size), u


CASES = [("viscous_solid", "updated"), *thorough(("viscous_solid", "total"), ("viscous_fluid", "updated"))]


@eqx.filter_jit
def applied(potential, u, hessian):
    """D u, both powers, and H + 3D through the law and assembled."""
    size, d = u.shape[1:]
    free, viscosity = Projection(jnp.ones((size, d), bool)), (potential, jnp.asarray(3.0))
    matrix = ImplicitOperator(jnp.zeros(size), 1.0, hessian.at(potential, None), free, viscosity)
    elastic = hessian.at(potential, None)(u[0])
    drags, powers = jax.vmap(potential.viscous_resistance)(u), jax.vmap(potential.power)(u)
    return drags, powers, elastic, matrix.unconstrained(u[0]), matrix.precomputed().unconstrained(u[0])


@pytest.mark.parametrize(("law", "description"), CASES)
@pytest.mark.parametrize(
    ("hessian", "d"),
    [
        *thorough((mpm.implicit.JvpHessian(), 1), (mpm.implicit.JvpHessian(), 2), (mpm.implicit.AnalyticHessian(), 1)),
        (mpm.implicit.AnalyticHessian(), 2),
        *thorough((mpm.implicit.AnalyticHessian(), 3)),
    ],
    ids=["jvp-1", "jvp-2", "analytic-1", "analytic-2", "analytic-3"],
)
def test_the_operator_is_symmetric_and_dissipates(law, description, hessian, d):
    """⟨a, D b⟩ = ⟨D a, b⟩, a·D a = the power ≥ 0; H + rD is one matrix a particle, as through the law."""
    potential, u = potential_of(VISCOUS[law], d, description)
    drags, powers, elastic, action, assembled = map(np.asarray, applied(potential, u, hessian))
    work = np.einsum("anc,bnc->ab", u, drags)
    np.testing.assert_allclose(work[0, 1], work[1, 0], rtol=0, atol=1e-12 * work[0, 0])
    np.testing.assert_allclose(np.diag(work), powers, rtol=1e-12)
    assert (powers > 0).all()
    assert_close(action, elastic + 3 * drags[0], 1e-12)
    assert_close(assembled, action, 1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("description", DESCRIPTIONS)
def test_both_descriptions_resist_the_same_flow_alike(description):
    """A flow uniform in space, ∇_X v = L F: the flux Jσ_v(L) in space, or that times F⁻ᵀ."""
    rng = np.random.default_rng(4)
    potential, _ = potential_of(VISCOUS["viscous_solid"], 3, description)
    (points,) = potential.material_points
    F, L = np.asarray(points.deformation), rng.normal(size=(3, 3))
    gradient = np.broadcast_to(L[..., None], F.shape)
    gradient = np.einsum("ij,jkp->ikp", L, F) if description == "total" else gradient
    flux = np.asarray(points.weighted_viscous_stress(jnp.asarray(gradient)))
    flux = np.einsum("ijp,kjp->ikp", flux, F) if description == "total" else flux
    stress = np.asarray(points.viscosity.stress(jnp.asarray(L)[..., None]))
    assert_close(flux, np.abs(np.linalg.det(F.T)) * np.asarray(points.volume) * stress, 1e-12)


def angular_momentum(particles, moment):
    """Σ m (x × v + that of the affine motion), in two dimensions."""
    (x, y), (u, v) = particles.x.T, particles.v.T
    return float((particles.mass * (x * v - y * u + moment * (particles.C[:, 1, 0] - particles.C[:, 0, 1]))).sum())


@pytest.mark.parametrize(
    ("name", "method"),
    [
        *thorough(
            ("viscous_solid", mpm.Explicit()),
            ("viscous_fluid", mpm.Explicit()),
            ("viscous_fluid", mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(rtol=1e-13))),
        ),
    ],
)
def test_momentum_is_conserved_and_turning_is_free(name, method):
    """A spinning, shaken block keeps linear and angular momentum; one that only spins feels no viscosity. (The linear
    solve of a solid keeps angular momentum to its linearisation only, with viscosity or without.)"""
    law = VISCOUS[name]
    scene, particles = block(2, material=law)
    spin = jnp.asarray([[0.0, -3.0], [3.0, 0.0]])
    C = jnp.broadcast_to(spin, (particles.count, 2, 2))
    spinning = eqx.tree_at(lambda q: (q.v, q.C), particles, (particles.x @ spin.T, C), is_leaf=lambda a: a is None)
    shaken = eqx.tree_at(lambda q: q.v, spinning, spinning.v + np.random.default_rng(2).normal(size=spinning.v.shape))
    moment, settings = scene.grid.spacing**2 / 4, {"steps": 20, "dt": 1e-3, "method": method}
    final = mpm.rollout(scene, shaken, **settings)
    # C's own angular momentum is the grid's, at the places before the move
    size = float(jnp.abs(shaken.mass[:, None] * shaken.v).sum())
    np.testing.assert_allclose(mpm.momentum(final), mpm.momentum(shaken), atol=1e-12 * size)
    np.testing.assert_allclose(angular_momentum(final, moment), angular_momentum(shaken, moment), atol=1e-11 * size)
    one = mpm.step(scene, spinning, 0.0, 1e-3, method=method)[0]
    other = mpm.step(eqx.tree_at(lambda s: s.material, scene, law.law), spinning, 0.0, 1e-3, method=method)[0]
    assert_close(one.v, other.v, 1e-12)


@pytest.mark.thorough
def test_only_what_is_viscous_keeps_a_gradient():
    """FLIP and PIC store C for it, group beside group, and give none of it to the grid."""
    laws = LAWS["neo_hookean"], VISCOUS["viscous_fluid"]
    for transfer in (mpm.PIC(), mpm.FLIP()):
        scene, particles = block(2, transfer=transfer, material=laws)
        both = mpm.join(particles, eqx.tree_at(lambda q: q.x, particles, particles.x + 0.02))
        prepared = mpm.prepare(scene, both)
        assert prepared.C is not None
        after, _ = mpm.step(scene, both, 0.0, 1e-4)
        assert after.C.shape == (both.count, 2, 2)
        plain = mpm.prepare(eqx.tree_at(lambda s: s.material, scene, (laws[0], FLUIDS["fluid"])), both)
        assert plain.C is None
        still = mpm.prepare(scene, eqx.tree_at(lambda q: q.v, both, jnp.zeros_like(both.v)))
        spin = jnp.broadcast_to(jnp.asarray([[0.0, 1.0], [-1.0, 0.0]]), still.C.shape)
        turned = eqx.tree_at(lambda q: q.C, still, spin)
        assert_close(mpm.step(scene, turned, 0.0, 1e-4)[0].v, np.zeros_like(still.v))


def test_viscosities_are_not_negative_and_not_stacked():
    with pytest.raises(ValueError, match="shear_viscosity"):
        mpm.Viscous(LAWS["neo_hookean"], -1.0)
    with pytest.raises(ValueError, match="bulk_viscosity"):
        mpm.Viscous(LAWS["neo_hookean"], 1.0, -1.0)
