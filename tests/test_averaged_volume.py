"""Averaged volumes: the energy at F̄, its derivatives, and nearly incompressible bodies against closed and converged
values."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, block, ids, thorough

import mpmjax as mpm
from mpmjax.stepping import start_nodes

LAWS = {
    "neo_hookean": mpm.NeoHookean(1e4, 0.49),
    "fixed_corotated": mpm.FixedCorotated(1e4, 0.49),
    "yeoh": mpm.Yeoh(2e3, -50.0, 5.0, bulk_modulus=2e5),
}
AVERAGED = mpm.AveragedVolume()


def stretched(d, law=LAWS["neo_hookean"], seed=0, **choices):
    """A scene and particles of random stretches, beside a plane of symmetry."""
    grid = mpm.Grid((10,) * d, 0.1, origin=(-3,) * d)
    rest, rng = mpm.fill(mpm.Box((0.0,) * d, (0.2,) * d), grid, density=1e3), np.random.default_rng(seed)
    F = np.eye(d) + 0.1 * rng.normal(size=(rest.count, d, d))
    x = rest.x + 0.01 * rng.normal(size=rest.x.shape)
    scene = mpm.Scene(grid, law, boundary=mpm.SymmetryPlane(0, 0.0), volume=AVERAGED, **choices)
    particles = mpm.Particles(x, rest.v, rest.mass, rest.volume, deformations=(jnp.asarray(F),), X=x)
    return scene, mpm.prepare(scene, particles)


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "updated"))
@pytest.mark.parametrize("law", **ids(LAWS, "neo_hookean"))
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("precomputed", [True, *thorough(False)])
def test_force_and_hessian_are_derivatives_of_the_energy(precomputed, d, law, description):
    scene, particles = stretched(d, law, description=description)
    rng = np.random.default_rng(1)

    @jax.jit
    def found(u, w):
        potential = start_nodes(scene, particles, 0.0, 1e-3, scene.stencil(particles)).potential
        analytic, slope = mpm.implicit.AnalyticHessian().at(potential, u), jax.grad(potential.energy)
        analytic = analytic.precomputed() if precomputed else analytic
        return potential.force(u), *jax.jvp(slope, (u,), (w,)), analytic(w)

    u, w = (jnp.asarray(size * rng.normal(size=(scene.grid.size, d))) for size in (1e-3, 1.0))
    force, slope, jvp, analytic = found(u, w)
    assert np.abs(force + slope).max() < 1e-12 * np.abs(slope).max()
    assert np.abs(analytic - jvp).max() < 1e-12 * np.abs(jvp).max()


def test_a_projected_hessian_is_positive_semidefinite_and_right_without_stress():
    scene, particles = stretched(2, LAWS["fixed_corotated"])
    still = eqx.tree_at(lambda p: p.deformations, particles, (jnp.broadcast_to(jnp.eye(2), (particles.count, 2, 2)),))
    vectors = jnp.eye(2 * scene.grid.size).reshape(-1, scene.grid.size, 2)

    @jax.jit
    def matrices(state):
        potential = start_nodes(scene, state, 0.0, 1e-3, scene.stencil(state)).potential
        hessians = [
            mpm.implicit.AnalyticHessian(projected=projected).at(potential, None) for projected in (True, False)
        ]
        return [jax.vmap(hessian.precomputed())(vectors).reshape(vectors.shape[0], -1) for hessian in hessians]

    values = np.linalg.eigvalsh(np.asarray(matrices(particles)[0]))
    assert values.min() > -1e-12 * values.max()
    one, other = matrices(still)
    np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(other).max())


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_the_average_keeps_constants_and_the_volume_and_mirrors_a_body(d):
    scene, particles = stretched(d)
    V, twin = particles.volume, particles.x * jnp.array([-1.0] + [1.0] * (d - 1))
    both = mpm.Particles(
        jnp.concatenate([particles.x, twin]), *(jnp.concatenate([a] * 2) for a in (particles.v, particles.mass, V))
    )
    whole = eqx.tree_at(lambda s: s.boundary, scene, ())
    both = mpm.prepare(whole, both)

    @jax.jit
    def averages():
        (points,), (doubled,) = scene.material_points(particles), whole.material_points(both)
        J = points.volume_ratio()
        return J, points.average(jnp.ones_like(J)), points.average(J), doubled.average(jnp.concatenate([J, J]))

    J, ones, mean, twice = averages()
    np.testing.assert_allclose(ones, 1, rtol=1e-13)
    np.testing.assert_allclose((V * mean).sum(), (V * J).sum(), rtol=1e-13)
    assert np.ptp(mean) < 0.5 * np.ptp(J)
    np.testing.assert_allclose(twice, jnp.concatenate([mean, mean]), rtol=1e-12)


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_an_even_stretch_has_the_stress_of_the_law(description):
    scene, particles = stretched(2, description=description)
    F = jnp.broadcast_to(jnp.array([[1.2, 0.1], [0.0, 0.9]]), (particles.count, 2, 2))
    (points,) = scene.material_points(eqx.tree_at(lambda p: p.deformations, particles, (F,)))
    np.testing.assert_allclose(points.stress(points.deformation), points.law.stress(points.deformation), rtol=1e-9)


METHODS = {
    "explicit": (mpm.Explicit(), 2e-4),
    "implicit_midpoint": (mpm.ImplicitMidpoint(mpm.implicit.Newton()), 2e-3),
}


def flying(modulus, method, dt, d=2, steps=40, side=3, description=DESCRIPTIONS["updated"]):
    """A block that is thrown, turns and swings."""
    law = mpm.NeoHookean(modulus, 0.499)
    scene, particles = block(d, side=side, material=law, volume=AVERAGED, description=description)
    middle = particles.x.mean(axis=0)
    spin = jnp.zeros((d, d)).at[0, 1].set(-2.0).at[1, 0].set(2.0) + 0.5 * jnp.diag(jnp.array([1.0, -1.0, 0.0][:d]))
    v = jnp.ones(d) + (particles.x - middle) @ spin.T
    particles = eqx.tree_at(lambda p: p.v, particles, v)
    C = jnp.broadcast_to(spin, (particles.count, d, d))
    particles = eqx.tree_at(lambda p: p.C, particles, C, is_leaf=lambda leaf: leaf is None)
    return scene, particles, mpm.rollout(scene, particles, steps=steps, dt=dt, method=method)


@pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_momentum_is_kept_to_rounding_or_to_what_the_solve_leaves(method, d):
    def spin(scene, p):
        """Σ m (x v_y − y v_x) with the part of the affine velocity, by the diagonal moment D."""
        D = scene.stencil(p).moment
        own = D[0] * p.C[:, 1, 0] - D[1] * p.C[:, 0, 1]
        return (p.mass * (p.x[:, 0] * p.v[:, 1] - p.x[:, 1] * p.v[:, 0] + own)).sum()

    @jax.jit
    def found():
        scene, before, after = flying(1e4, *method, d=d, steps=10)
        return [(mpm.momentum(p), spin(scene, p)) for p in (before, after)]

    (momentum, turning), (momentum_after, turning_after) = found()
    missed = 1e-12 if method is METHODS["explicit"] else 1e-8  # the solve's tolerance: its residual is an impulse
    np.testing.assert_allclose(momentum_after, momentum, rtol=missed)
    if method is METHODS["explicit"]:  # what an implicit step turns is of second order in its length
        np.testing.assert_allclose(turning_after, turning, rtol=1e-11)


def outcome(method, dt, **choices):
    """The motion of a thrown block as a function of a factor of its modulus."""

    def motion(scale):
        _, _, after = flying(1e4 * scale, method, dt, **choices)
        return (after.x**2).sum() + (after.F**3).sum()

    return motion


def test_gradients_are_those_of_differences():
    value_and_gradient = jax.jit(jax.value_and_grad(outcome(*METHODS["explicit"], side=1, steps=20)))
    size = 1e-4
    (above, _), (below, _), (_, gradient) = (value_and_gradient(scale) for scale in (1 + size, 1 - size, 1.0))
    np.testing.assert_allclose(gradient, (above - below) / (2 * size), rtol=1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
@pytest.mark.parametrize("method", **ids(METHODS))
def test_gradients_of_either_mode_are_those_of_differences(method, description):
    found, size = outcome(*method, steps=4, description=description), 1e-3
    compiled = jax.jit(found)
    difference = (compiled(1 + size) - compiled(1 - size)) / (2 * size)
    np.testing.assert_allclose(jax.jit(jax.grad(found))(1.0), difference, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(found))(1.0), difference, rtol=1e-5)


def test_what_cannot_be_averaged_is_refused():
    grid = mpm.Grid((8, 8), 0.1)
    sand, rubber = mpm.DruckerPrager(1e4, 0.3, friction_angle=0.6), LAWS["neo_hookean"]
    for law in (sand, mpm.Fluid(1e4, tension=True), mpm.Viscous(mpm.Fluid(1e4), 1.0), (rubber, sand)):
        with pytest.raises(ValueError, match="AveragedVolume is for elastic laws"):
            mpm.Scene(grid, law, volume=AVERAGED)
    with pytest.raises(ValueError, match="numbers below 2"):
        mpm.Scene(grid, (rubber, sand), volume=mpm.AveragedVolume(materials=(2,)))
    with pytest.raises(ValueError, match="from 0"):
        mpm.AveragedVolume(materials=())
    chosen = mpm.Scene(grid, (rubber, sand), volume=mpm.AveragedVolume(materials=[0]))
    assert [chosen.volume.covers(number) for number in (0, 1)] == [True, False]


def test_only_the_materials_that_are_named_are_averaged():
    grid = mpm.Grid((10, 10), 0.1, origin=(-3, -3))
    parts = [mpm.fill(mpm.Box((a, 0.0), (a + 0.2, 0.2)), grid, density=1e3) for a in (0.0, 0.2)]
    laws, both = (LAWS["neo_hookean"], mpm.NeoHookean(1e4, 0.3)), mpm.join(*parts)
    some, alone = mpm.Scene(grid, laws, volume=mpm.AveragedVolume((0,))), mpm.Scene(grid, laws[0], volume=AVERAGED)
    ready, part = mpm.prepare(some, both), mpm.prepare(alone, parts[0])
    rng = np.random.default_rng(0)
    field, w = (jnp.asarray(rng.normal(size=size)) for size in (parts[0].count, (grid.size, 2)))

    @jax.jit
    def found():
        (own, other), (single,) = some.material_points(ready), alone.material_points(part)
        assert other.average is None
        potential = start_nodes(some, ready, 0.0, 1e-3, some.stencil(ready)).potential
        whole = jax.jvp(jax.grad(potential.energy), (jnp.zeros_like(w),), (w,))[1]
        fixed = mpm.implicit.AnalyticHessian().at(potential, None)
        return (own.average(field), single.average(field)), (whole, fixed.precomputed()(w))

    (own, single), (whole, precomputed) = found()
    np.testing.assert_allclose(own, single, rtol=1e-13)
    np.testing.assert_allclose(precomputed, whole, atol=1e-12 * np.abs(whole).max())


def test_turned_out_particles_are_named():
    scene, particles = stretched(2, LAWS["fixed_corotated"])
    F = particles.deformations[0].at[3].set(jnp.diag(jnp.array([-1.0, 1.0])))
    with pytest.raises(ValueError, match="particle 3"):
        mpm.prepare(scene, eqx.tree_at(lambda p: p.deformations, particles, (F,)))
