"""Forces per mass that vary in space and time."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import METHODS, SECOND_ORDER, block, ids

import mpmjax as mpm
from mpmjax._types import Array, ParticleVector, Scalar
from mpmjax.stepping._step import step_compiled


class Wind(mpm.state.AbstractBodyForce):
    """b = (1 + rate t) strength, plus slope times x."""

    strength: Array
    rate: Scalar = 0.0
    slope: Scalar = 0.0

    def acceleration(self, x: ParticleVector, t: Scalar) -> ParticleVector:
        return (1 + self.rate * t) * self.strength + self.slope * x


@pytest.mark.parametrize("method", **ids(METHODS, "explicit"))
def test_a_uniform_body_force_is_gravity(method):
    """Also at a symmetry plane, whose normal pull it must not exert."""
    g = jnp.asarray([0.7, -2.0])
    plane = mpm.SymmetryPlane(1, 0.0)
    scene, particles = block(2, gravity=g, boundary=plane)
    forced, _ = block(2, body_force=Wind(g), boundary=plane)
    a, b = (mpm.step(s, particles, 0.0, 5e-3, method=method)[0] for s in (scene, forced))
    np.testing.assert_allclose(a.v, b.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(a.F, b.F, rtol=0, atol=1e-12)


def test_a_body_force_is_that_of_the_start_of_the_step():
    """A lone particle, hence a rigid one, gains Δt b(x, t)."""
    x = jnp.full((1, 1), 0.33)
    one = jnp.ones(1)
    scene = mpm.Scene(mpm.Grid((8,), 0.1), mpm.FixedCorotated(1.0, 0.3), body_force=Wind(jnp.ones(1), 3.0, 2.0))
    after, _ = mpm.step(scene, mpm.Particles(x, 0 * x, one, one), 0.5, 0.01)
    np.testing.assert_allclose(after.v, 0.01 * (1 + 3.0 * 0.5 + 2.0 * 0.33), rtol=1e-13)


@pytest.mark.parametrize("method", **ids(SECOND_ORDER, "trbdf2"))
def test_methods_of_second_order_take_it_half_a_step_on(method):
    """A lone particle gains Δt b(x + ½Δt v, t + ½Δt), and moves with the mean of its velocities."""
    x, one, dt = jnp.full((1, 1), 0.33), jnp.ones(1), 0.01
    scene = mpm.Scene(mpm.Grid((8,), 0.1), mpm.FixedCorotated(1.0, 0.3), body_force=Wind(jnp.ones(1), 3.0, 2.0))
    after, _ = mpm.step(scene, mpm.Particles(x, 2 + 0 * x, one, one), 0.5, dt, method=method)
    gain = dt * (1 + 3.0 * 0.505 + 2.0 * (0.33 + 0.01))
    np.testing.assert_allclose(after.v, 2 + gain, rtol=1e-8)
    np.testing.assert_allclose(after.x, 0.33 + dt * (2 + gain / 2), rtol=1e-8)


def test_a_scene_with_a_body_force_cannot_be_written(tmp_path):
    """Files know the package's own classes only, and say so."""
    scene, particles = block(1, body_force=Wind(jnp.ones(1)))
    run = mpm.simulate(scene, particles, t1=1e-3, dt=1e-3, save_every=1)
    with pytest.raises(ValueError, match="Wind, which files cannot hold"):
        mpm.save(tmp_path / "run.h5", run)
    assert not list(tmp_path.iterdir())


def test_changing_a_body_force_does_not_compile():
    scene, particles = block(1, body_force=Wind(jnp.ones(1)))
    mpm.step(scene, particles, 0.0, 1e-3)
    before = step_compiled._cached._cache_size()
    mpm.step(eqx.tree_at(lambda s: s.body_force.rate, scene, 0.5), particles, 0.0, 1e-3)
    assert step_compiled._cached._cache_size() == before
