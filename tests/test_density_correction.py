"""The correction of a fluid's volume by the density of its particles on the grid."""

import warnings
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, assert_close, thorough

import mpmjax as mpm
from mpmjax.extensions import DensityCorrection

DX = 0.125


def vessel(d, at=0.0, *, correction=None, **parts):
    """A vessel with walls `at` spacings off nodes, and water that fills half of it."""
    lower, upper = (at * DX,) * d, (1.0 + at * DX,) * (d - 1) + (0.5 + at * DX,)
    grid = mpm.Grid((16,) * d, DX, origin=(-4,) * d)
    walls = mpm.SlipBox(lower, (*upper[:-1], np.inf))
    water = mpm.fill(mpm.Box(lower, upper), grid, density=1e3)
    scene = mpm.Scene(grid, mpm.Fluid(1e5), boundary=walls, correction=correction, **parts)
    return scene, mpm.prepare(scene, water)


def room(d, at=0.0):
    return mpm.Box((at * DX,) * d, (1.0 + at * DX,) * d)


def corrected(scene, particles, dt):
    return scene.correction.corrected(scene, particles, scene.stencil(particles), 0.0, dt)


@pytest.mark.parametrize("at", [0.0, 0.25, 0.5])
@pytest.mark.parametrize("d", [1, 2, *thorough(3)])
def test_water_that_fills_a_vessel_has_the_density_one_beside_its_walls(d, at):
    correction = DensityCorrection(room(d, at))
    scene, water = vessel(d, at, correction=correction)
    phi = correction.density(scene, water, scene.stencil(water))
    deep = np.asarray(water.x[:, -1]) < 0.5 + at * DX - 3 * DX  # below what sees the surface
    assert float(jnp.abs(phi[deep] - 1).max()) < 0.02 * d  # the kernel sees the lattice of particles
    alone = DensityCorrection().density(scene, water, scene.stencil(water))
    assert float(alone[deep].min()) < 0.75  # without the room what lies at walls looks thin


@pytest.mark.parametrize("at", [0.0, 0.1, 0.4, 0.6])
def test_the_share_of_a_kernel_beside_a_wall_is_exact(at):
    lower, upper = (at * DX,), (1.0 + at * DX,)
    grid = mpm.Grid((16,), DX, origin=(-4,))
    water = mpm.fill(mpm.Box(lower, upper), grid, particles_per_cell=40, density=1e3)
    scene = mpm.Scene(grid, mpm.Fluid(1e5), correction=DensityCorrection(room(1, at)))
    water = mpm.prepare(scene, water)
    assert_close(
        scene.correction.density(scene, water, scene.stencil(water)), np.ones(water.count), rtol=1e-2
    )  # by the least share


def test_a_room_may_be_made_of_parts():
    scene, water = vessel(2)
    stencil = scene.stencil(water)
    whole = DensityCorrection(room(2)).density(scene, water, stencil)
    overlapping = mpm.geometry.Union((mpm.Box((0.0, 0.0), (0.6, 1.0)), mpm.Box((0.4, 0.0), (1.0, 1.0))))
    beside = mpm.geometry.Union((mpm.Box((0.0, 0.0), (0.5, 1.0)), mpm.Box((0.5, 0.0), (1.0, 1.0))))
    wall = mpm.Box((1.0, -1.0), (3.0, 3.0))
    cut = mpm.geometry.Intersection((mpm.Box((0.0, 0.0), (2.0, 1.0)), mpm.geometry.Complement(wall)))
    for parts in (beside, cut):
        assert_close(DensityCorrection(parts).density(scene, water, stencil), whole, rtol=1e-12)
    # where parts overlap beside a wall the room seems larger, so that nothing seems to crowd that does not
    seen = DensityCorrection(overlapping).density(scene, water, stencil)
    assert (seen <= whole + 1e-12).all()
    high = np.asarray(water.x[:, 1]) > 3.5 * DX
    assert_close(seen[high], whole[high], rtol=0.02)


def test_water_beside_the_axis_of_a_body_of_revolution_has_the_density_one():
    grid = mpm.Grid((16, 16), DX, origin=(-4, -4), axisymmetric=True)
    water = mpm.fill(room(2), grid, density=1e3)
    correction = DensityCorrection(room(2))
    scene = mpm.Scene(grid, mpm.Fluid(1e5), boundary=mpm.SlipBox((-np.inf, 0.0), (1.0, 1.0)), correction=correction)
    water = mpm.prepare(scene, water)
    assert_close(correction.density(scene, water, scene.stencil(water)), np.ones(water.count), rtol=0.04)


@pytest.mark.parametrize("apart", [1.0, 1.5, 2.0, 2.5])
def test_particles_that_are_drawn_apart_do_not_seem_to_crowd(apart):
    grid = mpm.Grid((40,), DX, origin=(-4,))
    x = apart * DX * (0.3 + jnp.arange(12.0))[:, None]
    rod = mpm.Particles(x, jnp.zeros_like(x), jnp.ones(12), jnp.full(12, apart * DX))
    scene = mpm.Scene(grid, mpm.Fluid(1e5), correction=DensityCorrection())
    rod = mpm.prepare(scene, rod)
    inside = np.asarray(scene.correction.density(scene, rod, scene.stencil(rod)))[3:-3]
    assert inside.max() < 1.051
    assert inside.mean() == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_particles_that_crowd_are_compressed_as_the_formula_says(d):
    rate, slack, dt, squeeze = 2.0, 0.4, 0.01, 2.0
    scene, water = vessel(d, correction=DensityCorrection(room(d), rate, slack))
    C = np.zeros((d, d))
    C[0, -1] = 30.0  # in one dimension an expansion
    sheared = abs(30.0) if d > 1 else 2**0.5 * 30.0
    water = eqx.tree_at(lambda q: (q.volume, q.C), water, (squeeze * water.volume, jnp.tile(C, (water.count, 1, 1))))
    J = 0.97  # by which the density on the grid is no other: volumes are the undeformed ones
    water = eqx.tree_at(lambda q: q.F, water, jnp.full_like(water.F, J))
    phi = scene.correction.density(scene, water, scene.stencil(water))
    expected = J - (1 - np.exp(-rate * dt * sheared)) * np.maximum(J - (1 + slack) / np.asarray(phi), 0)
    assert_close(corrected(scene, water, dt).F, expected)
    assert expected.min() < 0.9
    assert (expected == J).any()
    assert float(phi.max()) == pytest.approx(squeeze, rel=0.02)


def test_what_rests_or_does_not_crowd_stays_as_it_is():
    scene, water = vessel(2, correction=DensityCorrection(room(2)), gravity=(0.0, -9.81))
    crowded = eqx.tree_at(lambda q: q.volume, water, 2 * water.volume)
    assert (corrected(scene, crowded, 1.0).F == water.F).all()  # C is zero
    free, moved = replace(scene, correction=None), eqx.tree_at(lambda q: q.v, water, 0.1 * water.x)
    run, plain = (mpm.rollout(s, moved, steps=10, dt=1e-3) for s in (scene, free))
    assert (run.x == plain.x).all()
    assert (run.F == plain.F).all()


def test_only_the_fluid_is_corrected_and_others_take_their_present_volume():
    law, d = LAWS["neo_hookean"], 2
    correction = DensityCorrection()
    grid = mpm.Grid((16,) * d, DX, origin=(-4,) * d)
    sets = [mpm.fill(mpm.Box((a, 0.0), (a + 0.5, 0.75)), grid, density=1e3) for a in (0.0, 0.5)]
    scene = mpm.Scene(grid, (law, mpm.Viscous(mpm.Fluid(1e5), 1.0)), correction=correction)
    both = mpm.prepare(scene, mpm.join(*sets))
    assert float(correction.density(scene, both, scene.stencil(both)).max()) == pytest.approx(1.0, rel=0.03)
    grown = 1.5**0.5 * jnp.broadcast_to(jnp.eye(2), both.deformations[0].shape)
    swollen = eqx.tree_at(lambda q: q.deformations[0], both, grown)
    swollen = eqx.tree_at(lambda q: q.C, swollen, jnp.ones_like(both.C))
    phi = correction.density(scene, swollen, scene.stencil(swollen))
    assert float(phi.max()) == pytest.approx(1.5, rel=0.03)
    new = corrected(scene, swollen, 1.0)
    assert (new.deformations[0] == grown).all()
    assert float(new.deformations[1].min()) < 0.95


@pytest.mark.thorough
@pytest.mark.parametrize("method", [mpm.Explicit(), mpm.SemiImplicit()])
def test_derivatives_of_a_correction_are_those_of_differences(method):
    scene, water = vessel(2, correction=DensityCorrection(room(2), rate=5.0), gravity=(0.0, -9.81))
    water = eqx.tree_at(lambda q: q.volume, water, 1.3 * water.volume)
    swirl = jnp.stack([jnp.sin(7 * water.x[:, 1]), 0.5 * jnp.cos(5 * water.x[:, 0])], axis=1)

    @jax.jit
    @jax.value_and_grad
    def height(by):
        speed, rate = by
        here = eqx.tree_at(lambda s: s.correction.rate, scene, rate)
        end = mpm.rollout(here, replace(water, v=speed * swirl), steps=5, dt=2e-3, method=method)
        return 1e3 * (end.x[:, 1] ** 2).mean() + end.F.mean()

    at, step = jnp.asarray([0.8, 5.0]), 1e-4
    gradient = height(at)[1]
    differences = [(height(at + e)[0] - height(at - e)[0]) / (2 * step) for e in step * jnp.eye(2)]
    assert_close(gradient, jnp.stack(differences), rtol=1e-5)
    assert float(jnp.abs(gradient).min()) > 1e-3
    assert jnp.isfinite(height(jnp.asarray([0.0, 5.0]))[1]).all()  # at rest, where the shear rate has a kink


@pytest.mark.parametrize("times", [0.5, *thorough(5.0)])
def test_a_dam_that_breaks_keeps_its_level(times):
    dx, load = 1 / 12, 10.0
    grid, law = mpm.Grid((20, 50), dx, origin=(-4, -4)), mpm.Fluid(2e5)
    water = mpm.fill(mpm.Box((0.0, 0.0), (0.5, 1.0)), grid, density=1e3)
    method = mpm.Explicit() if times < 1 else mpm.SemiImplicit()
    dt = 4.0 / round(4.0 / (times * float(mpm.stable_dt(mpm.Scene(grid, law), water, safety=1.0))))

    def level(correction):
        """The centre's height over that of water at rest, less what the sloshing lifts: as much as it moves."""
        walls = mpm.SlipBox((0.0, 0.0), (1.0, np.inf))
        scene = mpm.Scene(grid, law, gravity=(0.0, -load), boundary=walls, correction=correction)
        seen = mpm.simulate(
            scene,
            water,
            t1=4.0,
            dt=dt,
            method=method,
            observe=lambda scene, now: now.x[:, 1].mean() - (now.v**2).sum(axis=1).mean() / (2 * load),
        ).observed
        return float(np.mean(seen[len(seen) // 2 :])) / 0.25

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        assert level(None) < (0.93 if times < 1 else 0.8)
    assert times < 1 or any("correction=extensions.DensityCorrection(room)" in str(w.message) for w in told)
    assert level(DensityCorrection(mpm.Box((0.0, 0.0), (1.0, 9.0)))) == pytest.approx(
        1.0, abs=0.05 if times < 1 else 0.07
    )


def test_where_it_does_not_belong_it_is_refused():
    grid = mpm.Grid((9, 9), DX)
    with pytest.raises(ValueError, match="for fluids that store J, such as Fluid: the scene has none"):
        mpm.Scene(grid, LAWS["neo_hookean"], correction=DensityCorrection())
    with pytest.raises(ValueError, match="velocity gradient C: take the transfer APIC"):
        mpm.Scene(grid, mpm.Fluid(1e5), transfer=mpm.FLIP(), correction=DensityCorrection())
    laws = mpm.Fluid(1e5), LAWS["neo_hookean"]
    with pytest.raises(ValueError, match="drop bodies"):
        mpm.Scene(grid, laws, bodies=mpm.Bodies(), correction=DensityCorrection())
    with pytest.raises(ValueError, match="room must have 2 coordinates"):
        mpm.Scene(grid, mpm.Fluid(1e5), correction=DensityCorrection(mpm.Ball((0.0,) * 3, 1.0)))
    with pytest.raises(ValueError, match="rate"):
        DensityCorrection(rate=-1.0)
    scene, water = vessel(2, correction=DensityCorrection())
    with pytest.raises(ValueError, match="does not know the work of a correction"):
        mpm.budget(scene, water, steps=1, dt=1e-3)
