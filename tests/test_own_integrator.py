"""An integrator of a user's own, written in one file outside of the package, in all that integrators are used for."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_files_hold

import mpmjax as mpm


@mpm.register
class DampedEuler(mpm.stepping.AbstractIntegrator):
    """Symplectic Euler with mass-proportional damping: M (v^{n+1} − v^n) = Δt (f + M g) − γ Δt M v^{n+1}."""

    damping: float | jax.Array = 0.0
    """γ [1/s]."""
    is_explicit: ClassVar[bool] = True

    def advance(self, nodes, guess):
        del guess
        v = nodes.explicit_velocity() / (1 + self.damping * nodes.dt)
        v = nodes.projection.combine(v, nodes.prescribed)
        return mpm.stepping.NodeMotion(v), mpm.implicit.no_solve(v.dtype)

    def elastic_impulse(self, nodes, motion):
        drag = self.damping * nodes.mass[:, None] * motion.velocity
        return nodes.dt * jnp.where(nodes.occupied, nodes.force - drag, 0)

    def stability_factor(self):
        return 1.0


class Unbounded(DampedEuler):
    """The same, of which no bound on the step is known."""

    def stability_factor(self):
        return None


class ForgetsViscosity(DampedEuler):
    """The same, which claims to treat viscosity and does not."""

    explicit_viscosity: ClassVar[bool] = False


LAW = mpm.NeoHookean(1e4, 0.3)
WALL = mpm.StickyBox((-9.0, 0.0), (9.0, 9.0))


def falling(law=LAW, **choices):
    """A block that hangs on to the floor and moves."""
    grid = mpm.Grid((9, 9), 0.1, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3, velocity=(0.2, 0.0))
    return mpm.Scene(grid, law, gravity=(0.0, -9.81), boundary=WALL, **choices), particles


@pytest.mark.thorough
def test_without_damping_it_is_the_explicit_step():
    """Walls, viscosity and transfers included."""
    for law in (LAW, mpm.Viscous(LAW, 20.0, 5.0)):
        for transfer in (mpm.APIC(), mpm.FLIP()):
            scene, particles = falling(law, transfer=transfer)
            own, explicit = (
                mpm.rollout(scene, particles, steps=5, dt=1e-3, method=m) for m in (DampedEuler(0.0), mpm.Explicit())
            )
            assert_close(own.x, explicit.x, 1e-13)
            assert_close(own.F, explicit.F, 1e-12)


def test_it_simulates_by_its_own_bound_and_damps():
    scene, particles = falling()
    assert float(mpm.stable_dt(scene, particles, method=DampedEuler(5.0))) == float(mpm.stable_dt(scene, particles))
    free, damped = (
        mpm.simulate(scene, particles, t1=0.05, dt="stable", method=DampedEuler(gamma)).final for gamma in (0.0, 50.0)
    )
    assert float(mpm.energy(scene, damped).kinetic) < 0.5 * float(mpm.energy(scene, free).kinetic)


def test_its_parameter_has_a_derivative():
    scene, particles = falling()

    def height(damping):
        return mpm.simulate(scene, particles, t1=0.02, dt=1e-3, method=DampedEuler(damping)).final.x[:, 0].mean()

    (low, _), (_, slope), (high, _) = map(jax.jit(jax.value_and_grad(height)), (5.0 - 1e-4, 5.0, 5.0 + 1e-4))
    assert float(slope) == pytest.approx(float(high - low) / 2e-4, rel=1e-6)


def test_its_budget_closes():
    """Damping counts with the internal force, as dissipated by the integrator."""
    scene, particles = falling()
    _, found = mpm.budget(scene, particles, steps=3, dt=1e-3, method=DampedEuler(5.0))
    assert_close(found.energy.explained, found.energy.change, 1e-9)
    assert_close(found.momentum.explained, found.momentum.change, 1e-9)
    assert (np.asarray(found.energy.implicit) > 0).all()


def test_a_run_by_it_is_saved_and_loaded(tmp_path):
    """Its parameter too. One that is not registered is refused."""
    scene, particles = falling()
    run = mpm.simulate(scene, particles, t1=2e-3, dt=1e-3, method=DampedEuler(5.0))
    assert_files_hold(tmp_path / "run.h5", run, DampedEuler)
    run = eqx.tree_at(lambda r: r.method, run, Unbounded(5.0))
    with pytest.raises(ValueError, match=r"is a Unbounded, which files cannot hold: .* @mpm\.register"):
        mpm.save(tmp_path / "none.h5", run)


def test_without_a_bound_the_step_must_be_given():
    """The message names the integrator; a run with a step that is given goes on, and so does advice on its faults."""
    scene, particles = falling()
    message = "Unbounded gives no bound on its step: give dt."
    with pytest.raises(ValueError, match=message):
        mpm.stable_dt(scene, particles, method=Unbounded())
    with pytest.raises(ValueError, match=message):
        mpm.simulate(scene, particles, t1=0.01, dt="stable", method=Unbounded())
    mpm.simulate(scene, particles, t1=0.01, dt=1e-3, method=Unbounded())
    with pytest.raises(mpm.SimulationError, match="At step"):
        mpm.simulate(scene, particles, t1=1.0, dt=0.1, method=Unbounded())


def test_what_is_forgotten_is_said():
    """Viscosity that nobody treats, and v^n where P2G did not keep it."""
    scene, particles = falling(mpm.Viscous(LAW, 20.0, 5.0))
    with pytest.raises(ValueError, match="ForgetsViscosity has explicit_viscosity = False"):
        mpm.step(scene, particles, 0.0, 1e-3, method=ForgetsViscosity())

    class Hasty(DampedEuler):
        needs_separate_force: ClassVar[bool] = False

        def advance(self, nodes, guess):
            return mpm.stepping.NodeMotion(nodes.velocity), mpm.implicit.no_solve(guess.dtype)

    with pytest.raises(ValueError, match="needs_separate_force = True"):
        mpm.step(*falling(), 0.0, 1e-3, method=Hasty())
    with pytest.raises(ValueError, match="method must be one of"):
        mpm.step(scene, particles, 0.0, 1e-3, method=mpm.APIC())
