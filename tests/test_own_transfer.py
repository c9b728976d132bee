"""A transfer of a user's own, written in one file outside of the package, in all that transfers are used for."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, assert_files_hold, thorough

import mpmjax as mpm


@mpm.register
class AFLIP(mpm.discretisation.AbstractTransfer):
    """Affine FLIP: particles keep a share α of what they had, velocity and affine velocity, and take the change of the
    grid's; the rest is APIC."""

    alpha: float | jax.Array = 0.9
    affine: ClassVar[bool] = True
    needs_change: ClassVar[bool] = True

    def velocity(self, v, new, change):
        return self.alpha * (v + change.value) + (1 - self.alpha) * new.value

    def affine_velocity(self, C, new, change):
        return self.alpha * (C + change.affine) + (1 - self.alpha) * new.affine


class BoundedAFLIP(AFLIP):
    """The same with a bound on the step, that of PIC and FLIP."""

    def steepness(self, inverse_moment, gradient_bound):
        return 2 * gradient_bound, 4 * gradient_bound


def moving(transfer, **choices):
    """A block that shears and turns."""
    grid = mpm.Grid((9, 9), 0.1, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3)
    v = particles.x @ jnp.asarray([[0.5, 1.0], [-2.0, 0.3]])
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), transfer=transfer, **choices)
    return scene, mpm.Particles(particles.x, v, particles.mass, particles.volume)


@pytest.mark.parametrize("gradient", thorough(mpm.MLSGradient(), mpm.SplineGradient()))
@pytest.mark.parametrize("method", [mpm.Explicit(), *thorough(mpm.SemiImplicit())])
def test_without_a_share_of_flip_it_is_apic(method, gradient):
    own, apic = (
        mpm.rollout(*moving(transfer, gradient=gradient), steps=4, dt=1e-3, method=method)
        for transfer in (AFLIP(0.0), mpm.APIC())
    )
    for a, b in ((own.x, apic.x), (own.v, apic.v), (own.C, apic.C), (own.F, apic.F)):
        assert_close(a, b, 1e-11)


@pytest.mark.thorough
def test_it_keeps_more_energy_than_apic():
    """Of velocities that differ from particle to particle; APIC loses none of a linear field's."""
    energies, noise = [], jax.random.normal(jax.random.key(0), (36, 2))
    for transfer in (AFLIP(0.95), mpm.APIC()):
        scene, particles = moving(transfer)
        particles = eqx.tree_at(lambda q: q.v, particles, particles.v + 0.2 * noise)
        final = mpm.simulate(scene, particles, t1=0.1, dt=1e-3).final
        energy = mpm.energy(scene, final)
        energies.append(float(energy.kinetic + energy.elastic))
    assert energies[0] > 1.05 * energies[1]


def test_its_parameter_has_a_derivative():
    def speed(alpha):
        return (mpm.simulate(*moving(AFLIP(alpha)), t1=0.02, dt=1e-3).final.v ** 2).sum()

    (low, _), (_, slope), (high, _) = map(jax.jit(jax.value_and_grad(speed)), (0.8 - 1e-5, 0.8, 0.8 + 1e-5))
    assert float(slope) == pytest.approx(float(high - low) / 2e-5, rel=1e-6)


@pytest.mark.parametrize("gradient", [*thorough(mpm.MLSGradient()), mpm.SplineGradient()])
def test_its_budget_closes(gradient):
    scene, particles = moving(AFLIP(0.8), gradient=gradient)
    _, found = mpm.budget(scene, particles, steps=3, dt=1e-3)
    assert_close(found.energy.explained, found.energy.change, 1e-9, atol=1e-12)
    assert_close(found.momentum.explained, found.momentum.change, 1e-9, atol=1e-12)


def test_a_bound_on_the_step_is_given_or_said_to_be_missing():
    bounded, flip = (mpm.stable_dt(*moving(transfer)) for transfer in (BoundedAFLIP(), mpm.FLIP()))
    assert float(bounded) == float(flip)
    scene, particles = moving(AFLIP())
    for ask in (lambda: mpm.stable_dt(scene, particles), lambda: mpm.simulate(scene, particles, t1=0.1, dt="stable")):
        with pytest.raises(ValueError, match="AFLIP gives no bound on the step: give dt"):
            ask()


def test_a_run_with_it_is_saved_and_loaded(tmp_path):
    """Its parameter too. One that is not registered is refused before anything is written."""
    run = mpm.simulate(*moving(AFLIP(0.8)), t1=2e-3, dt=1e-3)
    assert_files_hold(tmp_path / "run.h5", run, AFLIP)
    run = eqx.tree_at(lambda r: r.scene.transfer, run, BoundedAFLIP(0.8))
    with pytest.raises(ValueError, match=r"transfer is a BoundedAFLIP, which files cannot hold: .* @mpm\.register"):
        mpm.save(tmp_path / "none.h5", run)
    assert not (tmp_path / "none.h5").exists()


def test_an_unknown_object_is_an_error():
    for wrong in (mpm.BSpline(), AFLIP):
        with pytest.raises(ValueError, match="Scene's transfer must be one of"):
            moving(wrong)
