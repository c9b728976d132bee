"""A boundary and a body force of one's own, in runs and in files."""

import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import block

import mpmjax as mpm
from mpmjax.io._schema import decode, encode


@mpm.register
class Whirl(mpm.boundary.AbstractBoundary):
    """Nodes beyond a radius turn about the origin at a given rate [1/s]."""

    radius: float | jax.Array
    rate: float | jax.Array

    @property
    def dim(self):
        return 2

    def conditions(self, nodes, spacing, t, dt, *, reference):
        outside = ((nodes**2).sum(axis=1) >= self.radius**2)[:, None]
        v = self.rate * jnp.stack([-nodes[:, 1], nodes[:, 0]], axis=1)
        return mpm.boundary.Conditions(jnp.broadcast_to(outside, nodes.shape), jnp.where(outside, v, 0))


@mpm.register
class Gust(mpm.state.AbstractBodyForce):
    """A constant b [m/s²] that begins at a time [s]."""

    strength: tuple[float, ...]
    start: float = 0.0

    def acceleration(self, x, t):
        return jnp.where(t >= self.start, jnp.stack(self.strength), 0) * jnp.ones_like(x)


def test_a_registered_boundary_and_body_force_are_saved_and_loaded(tmp_path):
    """The run moves by them, and comes back with them to the last bit."""
    scene, particles = block(2, boundary=Whirl(0.25, 3.0), body_force=Gust((0.5, 0.0)))
    run = mpm.simulate(scene, particles, t1=4e-3, dt=2e-3, save_every=1)
    assert float(jnp.abs(run.final.v).max()) > 0.1
    mpm.save(tmp_path / "run.h5", run)
    again = mpm.load(tmp_path / "run.h5")
    assert type(again.scene.boundary[0]) is Whirl
    assert type(again.scene.body_force) is Gust
    for a, b in zip(jax.tree.leaves(again.scene), jax.tree.leaves(run.scene), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(again.final.x, run.final.x)


def test_a_registered_boundary_stands_in_a_scene_file():
    """Beside the package's own, its kind given; faults in its keys are named as ever."""
    text = """
        grid = { shape = [8, 8], spacing = 0.1 }
        material = { kind = "NeoHookean", youngs_modulus = 1e5, poisson_ratio = 0.3 }
        body_force = { kind = "Gust", strength = [1, 0], start = 0.5 }
        boundary = [{ kind = "Whirl", radius = 0.2, rate = 1 }, { kind = "SlipBox", lower = [0, 0], upper = [1, 1] }]
    """
    table = tomllib.loads(text)
    scene = decode(table, mpm.Scene)
    assert [type(b) for b in scene.boundary] == [Whirl, mpm.SlipBox]
    assert scene.body_force == Gust((1.0, 0.0), 0.5)
    assert encode(decode(json.loads(json.dumps(encode(scene))), mpm.Scene)) == encode(scene)
    for boundary, message in (
        ({"kind": "Whirl", "radius": 1.0}, r"^\[\[boundary\]\] 1 needs the key 'rate'\.$"),
        ({"kind": "Whril"}, r"^\[\[boundary\]\] 1: unknown kind 'Whril', did you mean 'Whirl'\?"),
    ):
        with pytest.raises(ValueError, match=message):
            decode({**table, "boundary": [boundary]}, mpm.Scene)
    with pytest.raises(ValueError, match=r"^\[body_force\] needs a kind: Gust\.$"):
        decode({**table, "body_force": {"strength": [1, 0]}}, mpm.Scene)
