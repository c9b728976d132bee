"""Several materials on one grid."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    ELASTIC,
    FLUIDS,
    METHODS,
    PLASTIC,
    QUICK,
    SECOND_ORDER,
    VISCOUS,
    assert_close,
    block,
    ids,
    thorough,
)

import mpmjax as mpm

DX = 0.1
SOFT, HARD = mpm.FixedCorotated(1e4, 0.3), mpm.FixedCorotated(1e6, 0.3)


def halves(d=2, **scene):
    """A soft block on a stiff one, joined: scene and particles for one law with a modulus for each particle, and the
    same as two materials."""
    grid = mpm.Grid((9,) * d, DX, origin=(-3,) * d)
    boxes = [mpm.Box((0.0,) * (d - 1) + (y,), (0.3,) * (d - 1) + (y + 0.1,)) for y in (0.0, 0.1)]
    parts = [mpm.fill(box, grid, particles_per_cell=2**d, density=1e3) for box in boxes]
    particles = mpm.join(*parts)
    moved = jnp.asarray(np.random.default_rng(0).normal(size=particles.x.shape))
    particles = eqx.tree_at(lambda q: q.v, particles, 0.3 * moved)
    moduli = jnp.repeat(jnp.asarray([HARD.youngs_modulus, SOFT.youngs_modulus]), parts[0].count)
    one = mpm.Scene(grid, mpm.FixedCorotated(moduli, 0.3), **scene)
    return one, mpm.Scene(grid, (HARD, SOFT), **scene), particles


@pytest.mark.parametrize(
    "description", [mpm.UpdatedLagrangian(), *thorough(mpm.TotalLagrangian())], ids=["updated", "total"]
)
@pytest.mark.parametrize("method", **ids(METHODS | SECOND_ORDER, "explicit", QUICK))
def test_two_materials_are_one_with_a_modulus_for_each_particle(method, description):
    """The same motion to the solver's tolerance, by every update."""
    one, two, particles = halves(gravity=(0.0, -5.0), description=description)
    ends = [mpm.rollout(scene, particles, steps=3, dt=2e-3, method=method) for scene in (one, two)]
    assert_close(ends[0].x, ends[1].x, 1e-9)
    assert_close(ends[0].F, jnp.concatenate(ends[1].deformations), 1e-7)
    assert float(mpm.energy(one, ends[0]).elastic) == pytest.approx(float(mpm.energy(two, ends[1]).elastic), rel=1e-6)
    assert float(mpm.stable_dt(one, ends[0])) == pytest.approx(float(mpm.stable_dt(two, ends[1])), rel=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "hessian", [mpm.implicit.AnalyticHessian(True), mpm.implicit.JvpHessian()], ids=["projected", "jvp"]
)
@pytest.mark.parametrize(
    "preconditioner",
    [mpm.implicit.DiagonalPreconditioner(), pytest.param(mpm.implicit.MassPreconditioner(), marks=pytest.mark.slow)],
)
def test_hessians_and_preconditioners_of_two_materials_are_those_of_one(preconditioner, hessian):
    one, two, particles = halves()
    method = mpm.SemiImplicit(hessian=hessian, preconditioner=preconditioner)
    ends = [mpm.rollout(scene, particles, steps=2, dt=2e-2, method=method) for scene in (one, two)]
    assert_close(ends[0].x, ends[1].x, 1e-9)


@pytest.mark.parametrize("method", **ids({k: METHODS[k] for k in QUICK}, (), ("explicit",)))
def test_gradients_pass_to_each_material(method):
    """By the two moduli: the sums of one law's over the particles of each."""
    one, two, particles = halves()

    def height(law, scene):
        moved = eqx.tree_at(lambda s: s.material, scene, law)
        return (mpm.rollout(moved, particles, steps=5, dt=2e-3, method=method).x[:, 1] ** 2).sum()

    by_particle = jax.grad(height)(one.material, one).youngs_modulus
    laws = jax.tree.map(jnp.asarray, two.material)
    by_material = jax.grad(height)(laws, two)
    sums = by_particle.reshape(2, -1).sum(axis=1)
    assert_close(jnp.stack([law.youngs_modulus for law in by_material]), sums, 1e-5)


@pytest.mark.thorough
@pytest.mark.parametrize("contrast", [1e2, 1e4])
@pytest.mark.parametrize("method", ["explicit", "semi_implicit"])
def test_a_bar_of_two_stiffnesses_carries_one_stress(method, contrast):
    """A soft and a stiff bar in series, pulled by a grip: at rest the stress is the same in both, and that of the soft
    one stretched alone; away from the interface and the grips, where the stress of single particles oscillates."""
    dx, cells = 0.05, 20
    grid = mpm.Grid((2 * cells + 6,), dx, origin=(-3,))
    end = cells * dx
    boxes = mpm.Box((0.0,), (end,)), mpm.Box((end,), (2 * end,))
    particles = mpm.join(*(mpm.fill(box, grid, particles_per_cell=4, density=1e3) for box in boxes))
    held = mpm.Grip(mpm.Box((-1.0,), (0.0,)), mpm.Motion((0.0,), ((0.0,),)))
    pulled = mpm.Grip(mpm.Box((2 * end,), (3.0,)), mpm.Motion((0.0, 0.5), ((0.0,), (0.1,))))
    scene = mpm.Scene(
        grid,
        (mpm.NeoHookean(1e4, 0.0), mpm.NeoHookean(contrast * 1e4, 0.0)),
        boundary=(held, pulled),
        transfer=mpm.PIC(),
        description=mpm.TotalLagrangian(),
    )
    if method == "explicit":
        dt = 0.5 / round(0.5 / float(mpm.stable_dt(scene, particles, safety=0.5)))
        run = mpm.simulate(scene, particles, t1=4.0, dt=dt)
    else:
        solver = mpm.implicit.ConjugateResidual(1e-10)
        update = mpm.SemiImplicit(preconditioner=mpm.implicit.DiagonalPreconditioner(), solver=solver)
        run = mpm.simulate(scene, particles, t1=40.0, dt=0.5, method=update)
    middle = slice(32, 48)
    soft, hard = (
        float(law.stress(jnp.moveaxis(F[middle], 0, -1))[0, 0].mean())
        for law, F in zip(scene.laws, run.final.deformations, strict=True)
    )
    assert soft == pytest.approx(hard, rel=3e-3)
    stretch = 1 + 0.1 / end / (1 + 1 / contrast)
    assert soft == pytest.approx(5e3 * (stretch - 1 / stretch), rel=dx / end)  # the interface is known to a cell


def test_what_does_not_fit_is_refused():
    scene, particles = block(2)
    two = mpm.Scene(scene.grid, (SOFT, HARD))
    with pytest.raises(ValueError, match=r"The scene has 2 laws, so the particles must be 2 sets .* got 1\."):
        mpm.prepare(two, particles)
    with pytest.raises(ValueError, match="All joined particles must have deformations or none: prepare each"):
        mpm.join(mpm.prepare(scene, particles), particles)
    snow = mpm.prepare(mpm.Scene(scene.grid, mpm.Snow()), particles)
    with pytest.raises(ValueError, match="must have been prepared for one law"):
        mpm.prepare(scene, mpm.join(mpm.prepare(scene, particles), snow))
    with pytest.raises(ValueError, match="number of one of the first set's 1 materials"):
        mpm.join(particles, particles, material=1)
    with pytest.raises(ValueError, match="one dimension and precision"):
        mpm.join(particles, block(1)[1])
    with pytest.raises(ValueError, match=r"The total description keeps .* use the updated one for Snow"):
        mpm.Scene(scene.grid, (SOFT, mpm.Snow()), description=mpm.TotalLagrangian())
    with pytest.raises(ValueError, match=r"are of 2 materials, each with its own F: take deformations"):
        _ = mpm.prepare(two, mpm.join(particles, particles)).F


def test_one_law_takes_joined_particles_as_one_set():
    scene, particles = block(2)
    both = mpm.prepare(scene, mpm.join(particles, particles))
    assert both.counts is None
    assert both.F.shape == (2 * particles.count, 2, 2)


@pytest.mark.parametrize("law", **ids(ELASTIC | PLASTIC | FLUIDS | VISCOUS))
def test_prepared_particles_are_joined_with_all_that_they_have(law):
    """In a scene of one law, and as more of one material of several."""
    scene, particles = block(2, material=law)
    one = mpm.prepare(scene, particles)
    one = jax.tree.map(lambda a: a + 0.01 * jnp.linspace(0, 1, a.size).reshape(a.shape), one)  # no two alike
    two = jax.tree.map(lambda a: 1.1 * a, one)
    expected = jax.tree.leaves(jax.tree.map(lambda a, b: jnp.concatenate([a, b]), one, two))
    for both in (mpm.join(one, two, material=0), mpm.join(one, two)):
        joined = mpm.prepare(scene, both)
        assert joined.counts is None
        for a, b in zip(jax.tree.leaves(joined), expected, strict=True):
            np.testing.assert_array_equal(a, b)
    more = mpm.join(mpm.join(one, two), one, material=0)
    assert more.counts == (2 * one.count, two.count)
    several = mpm.prepare(mpm.Scene(scene.grid, (law, law)), more)
    of = (q.groups[k][1:] for q, k in ((several, 0), (several, 1), (one, 0), (two, 0)))
    for a, b, c, d in zip(*map(jax.tree.leaves, of), strict=True):
        np.testing.assert_array_equal(a, jnp.concatenate([c, c]))
        np.testing.assert_array_equal(b, d)
    np.testing.assert_array_equal(several.x, jnp.concatenate([one.x, one.x, two.x]))


def test_a_fault_is_named_by_the_particle_of_the_whole_set():
    """In the second material, the number counts the first's particles too."""
    grid = mpm.Grid((24,), DX, origin=(-2,))
    parts = [mpm.fill(mpm.Box((a,), (a + 0.3,)), grid, particles_per_cell=2, density=1e3) for a in (0.0, 1.0)]
    scene = mpm.Scene(grid, (mpm.NeoHookean(1e4, 0.3), mpm.NeoHookean(1e4, 0.3)))
    particles = mpm.join(*parts)
    F = tuple(jnp.ones((part.count, 1, 1)) for part in parts)
    F = (F[0], F[1].at[2].set(-0.1))
    with pytest.raises(ValueError, match="NeoHookean does not allow the F of particle 8 "):
        mpm.prepare(scene, eqx.tree_at(lambda q: q.deformations, particles, F, is_leaf=lambda a: a is None))
