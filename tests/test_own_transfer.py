"""A transfer of a user's own, written in one file outside of the package, in all that transfers are used for."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close

import mpmjax as mpm


class AFLIP(mpm.AbstractTransfer):
    """Affine FLIP: particles keep a share α of what they had, velocity and affine velocity, and take the change of the
    grid's; the rest is APIC."""

    alpha: float = 0.9
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


GRADIENTS = [mpm.MLSGradient(), mpm.SplineGradient()]


def moving(transfer, **choices):
    """A block that shears and turns."""
    grid = mpm.Grid((9, 9), 0.1, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3)
    v = particles.x @ jnp.asarray([[0.5, 1.0], [-2.0, 0.3]])
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), transfer=transfer, **choices)
    return scene, mpm.Particles(particles.x, v, particles.mass, particles.volume)


@pytest.mark.parametrize("gradient", GRADIENTS)
@pytest.mark.parametrize("method", [mpm.Explicit(), mpm.SemiImplicit()])
def test_without_a_share_of_flip_it_is_apic(method, gradient):
    own, apic = (
        mpm.rollout(*moving(transfer, gradient=gradient), steps=4, dt=1e-3, method=method)
        for transfer in (AFLIP(0.0), mpm.APIC())
    )
    for a, b in ((own.x, apic.x), (own.v, apic.v), (own.C, apic.C), (own.F, apic.F)):
        assert_close(a, b, 1e-11)


def test_it_keeps_more_energy_than_apic():
    energies = []
    for transfer in (AFLIP(0.95), mpm.APIC()):
        scene, particles = moving(transfer)
        final = mpm.simulate(scene, particles, t1=0.1, dt=1e-3).final
        energy = mpm.energy(scene, final)
        energies.append(float(energy.kinetic + energy.elastic))
    assert energies[0] > energies[1]


def test_its_parameter_has_a_derivative():
    def speed(alpha):
        return (mpm.simulate(*moving(AFLIP(alpha)), t1=0.02, dt=1e-3).final.v ** 2).sum()

    difference = (speed(0.8 + 1e-5) - speed(0.8 - 1e-5)) / 2e-5
    assert float(jax.grad(speed)(0.8)) == pytest.approx(float(difference), rel=1e-6)


@pytest.mark.parametrize("gradient", GRADIENTS)
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


def test_an_unknown_object_is_an_error():
    for wrong in (mpm.BSpline(), AFLIP):
        with pytest.raises(ValueError, match="Scene's transfer must be one of"):
            moving(wrong)
