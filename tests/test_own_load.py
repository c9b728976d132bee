"""A load of one's own, as a user would write it: the drag of still air on a surface."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import METHODS, assert_files_hold, block, ids

import mpmjax as mpm
from mpmjax._types import Array, Float, Scalar
from mpmjax.state import LoadedPoints


class Drag(mpm.state.AbstractLoad):
    """−½ ρ c ‖v‖ v per area."""

    on: mpm.state.AbstractPlace
    density: Scalar
    coefficient: Scalar = 1.0

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        """At the points' velocity at the start of the step, or in its middle."""
        speed = jnp.sqrt((points.v**2).sum(axis=0))
        return -self.density / 2 * self.coefficient * points.weight * speed * points.v


def test_a_load_of_ones_own_acts_and_is_kept_in_files(tmp_path):
    """It brakes a flying block by the drag on its four sides, and a run with it comes back from a file."""
    mpm.register(Drag)
    side, speed, dt = 0.3, 2.0, 1e-3
    scene, particles = block(2, loads=Drag(mpm.Patch(mpm.Box((0.0, 0.0), (side, side))), 1.2, 1.1))
    particles = dataclasses.replace(particles, v=particles.v + jnp.asarray([speed, 0.0]))
    scene = mpm.attach(scene, particles)
    run = mpm.simulate(scene, particles, t1=dt, dt=dt)
    lost = float(particles.mass.sum()) * speed - float(mpm.momentum(run.final)[0])
    np.testing.assert_allclose(lost, dt * 1.2 / 2 * 1.1 * 4 * side * speed**2, rtol=1e-9)
    assert_files_hold(tmp_path / "run.h5", run, Drag)


class Fixed(mpm.state.AbstractLoad):
    """A force that is not to be differentiated."""

    on: mpm.state.AbstractPlace
    total: Scalar

    def force(self, points: LoadedPoints, t: Scalar, dt: Scalar) -> Float[Array, "d s"]:
        """Along every axis."""
        del t, dt
        return jax.lax.stop_gradient(self.total) * jnp.broadcast_to(points.weight, points.v.shape)


@pytest.mark.parametrize("method", **ids(METHODS, "semi_implicit"))
def test_what_a_solve_does_not_depend_on_has_a_zero_derivative(method):
    """In both modes, by the number of a load that stops it."""
    scene, particles = block(2, loads=Fixed(mpm.PointsAt(((0.1, 0.1),)), jnp.asarray(3.0)))
    scene = mpm.attach(scene, particles)

    def end(total):
        loaded = eqx.tree_at(lambda s: s.loads[0].total, scene, total)
        return mpm.step(loaded, particles, 0.0, 1e-3, method=method)[0].x.sum()

    assert jax.jit(jax.grad(end))(3.0) == 0
    assert jax.jit(lambda total: jax.jvp(end, (total,), (1.0,))[1])(3.0) == 0
