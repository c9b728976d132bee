"""A constraint on how a body moves, of a user's own, written in one file outside of the package: a body that neither
deforms nor turns."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, thorough

import mpmjax as mpm
from mpmjax.boundary import OwnedCouple
from mpmjax.state import AbstractConstraint, AbstractLayerImage

METHODS = {"explicit": mpm.Explicit(), "semi_implicit": mpm.SemiImplicit()}


class OneVelocity(AbstractLayerImage):
    """All nodes of the layer have the velocity of the first."""

    layer: int = eqx.field(static=True)
    layers: int = eqx.field(static=True)

    def scalar(self, field):
        layer = self.own(field)
        return self.with_own(field, jnp.broadcast_to(layer[0], layer.shape))

    vector = scalar

    def places(self, carrier):
        layer = self.own(carrier)
        return jnp.broadcast_to(layer[0], layer.shape)


class Translating(AbstractConstraint):
    number: int = eqx.field(static=True)
    layer: int = eqx.field(static=True)
    guided = False

    def check(self, scene):
        pass

    def check_particles(self, x, spacing):
        pass

    def at_start(self, scene, particles, nodes, planes):
        rows, image = particles.groups[self.number].rows, OneVelocity(self.layer, scene.grid.layers)
        mass, rest = particles.mass[rows, None], jnp.zeros_like(image.own(nodes.conditions.velocity))
        velocity = (mass * particles.v[rows]).sum(axis=0) / mass.sum()
        return image, rest.at[0].set(velocity), rest != 0, rest

    def moved(self, before, after, image, fixed, new, mean, dt):
        rows, deformations = before.groups[self.number].rows, list(after.deformations)
        deformations[self.number] = before.deformations[self.number]
        return dataclasses.replace(
            after,
            x=after.x.at[rows].set(before.x[rows] + dt * image.own(mean)[0]),
            v=after.v.at[rows].set(image.own(new)[0]),
            C=after.C.at[rows].set(0.0),
            deformations=tuple(deformations),
        )

    def received(self, image, owners, planes, loose, tied, guide):
        return owners, OwnedCouple(jnp.zeros(1), jnp.asarray(-1))

    def kinetic_energy(self, x, v, mass, volume):
        return (mass[:, None] * v**2).sum() / 2


class Pallet(mpm.AbstractMaterial):
    """A body that is pushed without turning; contact has this modulus [Pa]."""

    modulus: float | jax.Array

    def constraint(self, number, layer):
        return Translating(number, layer)

    def energy(self, F):
        return jnp.zeros(F.shape[2:], F.dtype)

    def wave_modulus(self, F):
        return jnp.broadcast_to(jnp.asarray(self.modulus, F.dtype), (1,))


@pytest.mark.parametrize("name", ["semi_implicit", *thorough("explicit")])
def test_a_body_moves_as_its_constraint_lets_it(name):
    """Pushed at a corner it has the acceleration of the force on its mass, and beside it a soft block falls freely."""
    grid, dt, steps = mpm.Grid((14, 12), 0.1, origin=(-3, -3)), 1e-3, 5
    soft = mpm.fill(mpm.Box((0.0, 0.0), (0.2, 0.2)), grid, density=1e3)
    pallet = mpm.fill(mpm.Box((0.5, 0.0), (0.8, 0.3)), grid, density=1e3)
    particles, mass = mpm.join(soft, pallet), float(pallet.mass.sum())
    load = mpm.PointLoad(mpm.PointsAt(((0.79, 0.29),)), (0.2 * mass, 0.0))
    scene = mpm.Scene(
        grid, (mpm.NeoHookean(1e4, 0.3), Pallet(1e5)), bodies=mpm.Bodies(), loads=load, gravity=(0.0, -2.0)
    )
    scene = mpm.attach(scene, particles)
    run = mpm.simulate(scene, particles, t1=steps * dt, dt=dt, method=METHODS[name])
    v, moved = np.asarray(run.final.v), np.asarray(run.final.x - particles.x)
    pushed = slice(soft.count, None)
    assert_close(v[pushed], np.broadcast_to([0.2 * steps * dt, -2.0 * steps * dt], v[pushed].shape), 1e-9)
    assert_close(v[: soft.count], np.broadcast_to([0.0, -2.0 * steps * dt], v[: soft.count].shape), 0, 1e-9)
    assert np.ptp(moved[pushed], axis=0).max() < 1e-15
    assert float(mpm.energy(scene, run.final).kinetic) == pytest.approx(
        float((run.final.mass[:, None] * run.final.v**2).sum()) / 2, rel=1e-9
    )
