"""Particles that flow are sorted by cell in memory, which changes nothing but the rounding of sums."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import NEEDS_LIBRARY, assert_close, thorough

import mpmjax as mpm
from mpmjax.checks._values import canonical
from mpmjax.simulation import _sorting
from mpmjax.simulation._sorting import by_cell, rearranged
from mpmjax.state import state_of

DT, STEPS = 1e-3, 12


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Few particles, and every four steps."""
    for name, value in {"LEAST": 1, "STEPS": 4, "FEWEST": 3}.items():
        monkeypatch.setattr(_sorting, name, value)
    monkeypatch.delenv(_sorting.VARIABLE, raising=False)
    jax.clear_caches()
    yield
    jax.clear_caches()


def shuffled(particles, seed):
    order = np.random.default_rng(seed).permutation(particles.count)
    return jax.tree.map(lambda a: a[order], particles)


def mixed(d=2):
    """A shuffled fluid below a shuffled elastic body whose stiffness differs from particle to particle, which a force
    pulls at a point."""
    grid = mpm.Grid((14,) * d, 1 / 8)
    low, high = (0.4,) * (d - 1), (0.9,) * (d - 1)
    water = mpm.fill(mpm.Box((*low, 0.375), (*high, 0.625)), grid, particles_per_cell=2**d, density=1e3)
    body = mpm.fill(mpm.Box((*low, 0.625), (*high, 0.875)), grid, particles_per_cell=2**d, density=2e3)
    particles = mpm.join(shuffled(water, 0), shuffled(body, 1))
    stiffness = 1e4 * (1 + np.random.default_rng(2).random(body.count))
    scene = mpm.Scene(
        grid,
        (mpm.Fluid(1e4), mpm.NeoHookean(jnp.asarray(stiffness), 0.3)),
        gravity=(*[0.0] * (d - 1), -9.81),
        boundary=mpm.SlipBox((0.25,) * d, (1.5,) * d),
        loads=mpm.PointLoad(mpm.PointsAt([(*[0.65] * (d - 1), 0.8)]), (50.0, *[0.0] * (d - 1))),
    )
    return mpm.attach(scene, particles), particles


class Still(mpm.state.AbstractBodyForce):
    def acceleration(self, x, t):
        return jnp.zeros_like(x)


def is_sorted(scene, particles, steps=STEPS):
    scene = canonical(scene, particles.x.dtype)
    return _sorting.memory_order(scene, mpm.prepare(scene, particles), steps) is not None


def unsorted(monkeypatch, run):
    """What a run gives of particles that stay as they were given."""
    with monkeypatch.context() as patch:
        patch.setenv(_sorting.VARIABLE, "given")
        jax.clear_caches()
        found = run()
    jax.clear_caches()
    return found


def agree(found, expected, tolerance=1e-11):
    """To rounding, which for a strain is that of F, of size one: a strain of 1e-5 has five digits less."""
    jax.tree.map(lambda a, b: assert_close(a, b, tolerance, 4e-15), found, expected)


@pytest.mark.thorough
@NEEDS_LIBRARY
@pytest.mark.parametrize(("d", "all_kinds"), [(2, False), *thorough((2, True), (3, True))])
def test_frames_and_observations_keep_the_order_given(d, all_kinds, monkeypatch):
    scene, particles = mixed(d)
    assert is_sorted(scene, particles)

    def run():
        seen = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=5, observe=lambda _, q: q.x[:7])
        if not all_kinds:
            return seen.observed, seen.final
        saved = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=5)
        plain = mpm.rollout(scene, particles, steps=STEPS, dt=DT)
        return saved.frames, saved.final, seen.observed, seen.final, plain

    agree(run(), unsorted(monkeypatch, run))


@NEEDS_LIBRARY
@pytest.mark.parametrize(
    "method", [mpm.Explicit(), *thorough(mpm.SemiImplicit())], ids=lambda method: type(method).__name__
)
@pytest.mark.parametrize(
    "law",
    [mpm.Fluid(1e4), *thorough(mpm.Snow(1e4, 0.2), mpm.VonMises(1e4, 0.3, 10.0))],
    ids=lambda law: type(law).__name__,
)
def test_one_material_without_loads(law, method, monkeypatch):
    """With what it remembers of each particle, which flow here by half a spacing; a run goes on from a frame with the
    same bits."""
    grid = mpm.Grid((14, 14), 1 / 8)
    particles = shuffled(mpm.fill(mpm.Box((0.4, 0.4), (0.9, 0.9)), grid, particles_per_cell=4, density=1e3), 0)
    particles = eqx.tree_at(lambda q: q.v, particles, particles.v.at[:, 0].set(5 * (particles.x[:, 1] - 0.65)))
    scene = mpm.Scene(grid, law)
    assert is_sorted(scene, particles)

    def run():
        return mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, method=method, save_every=6)

    whole, given = run(), unsorted(monkeypatch, run)
    agree((whole.frames, whole.final), (given.frames, given.final))
    rest = mpm.simulate(scene, whole.frame(1), t1=STEPS * DT, dt=DT, method=method, start=6, save_every=6)
    jax.tree.map(np.testing.assert_array_equal, rest.final, whole.final)


@NEEDS_LIBRARY
def test_particles_are_in_the_order_of_their_cells():
    """Each material's by itself, after a sort; sums would agree in any order."""
    scene, particles = mixed()
    scene = canonical(scene, particles.x.dtype)
    given = mpm.prepare(scene, particles)
    order, state = _sorting.memory_order(scene, given, STEPS), state_of(given)
    state, order = eqx.filter_jit(_sorting.resorted)(order, scene, given, state, 0.0, jnp.asarray(0.0), None)
    cells = np.asarray(_sorting.cells_of(scene.kernel, scene.grid, scene.window(given), state.x))
    for group in given.groups:
        assert (np.diff(cells[group.rows]) >= 0).all()
    assert (np.sort(order.number) == np.arange(given.count)).all()
    np.testing.assert_array_equal(state.x, given.x[order.number])
    own = np.asarray(order.number[given.groups[1].rows]) - given.groups[1].rows.start
    np.testing.assert_array_equal(order.parameters[1].youngs_modulus, scene.laws[1].youngs_modulus[own])
    pulled = int(scene.loads[0].on.particle[0])
    np.testing.assert_array_equal(state.x[int(order.attached[0][0])], given.x[pulled])


@NEEDS_LIBRARY
@pytest.mark.thorough
@pytest.mark.parametrize("run", [mpm.rollout, mpm.simulate])
def test_derivatives_keep_the_order_given(run, monkeypatch):
    """By stiffness, velocity and mass of each particle, in reverse mode, and of a batch."""
    scene, particles = mixed()
    horizon = {"steps": 6} if run is mpm.rollout else {"t1": 6 * DT}

    def height(stiffness, v, mass):
        own = eqx.tree_at(lambda s: s.material[1].youngs_modulus, scene, stiffness)
        end = run(own, eqx.tree_at(lambda q: (q.v, q.mass), particles, (v, mass)), dt=DT, **horizon)
        end = end if run is mpm.rollout else end.final
        return (end.x**2 * jnp.arange(1.0, 1 + end.count)[:, None]).sum()

    given = scene.material[1].youngs_modulus, particles.v, particles.mass
    both = jax.tree.map(lambda a: jnp.stack([a, 1.1 * a]), given)

    def slopes():
        return jax.grad(height, (0, 1, 2))(*given), jax.vmap(jax.grad(height, (0, 1, 2)))(*both)

    found, expected = slopes(), unsorted(monkeypatch, slopes)
    agree(found, expected, 1e-9)
    agree(jax.tree.map(lambda a: a[0], found[1]), expected[0], 1e-9)


@NEEDS_LIBRARY
@pytest.mark.thorough
def test_a_run_of_two_materials_goes_on_from_a_frame_with_the_same_bits():
    scene, particles = mixed()
    whole = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, save_every=6)
    rest = mpm.simulate(scene, whole.frame(1), t1=STEPS * DT, dt=DT, start=6, save_every=6)
    jax.tree.map(np.testing.assert_array_equal, rest.final, whole.final)


@NEEDS_LIBRARY
@pytest.mark.thorough
def test_a_fault_names_the_particle_as_it_was_given(monkeypatch):
    scene, particles = mixed()
    fast = eqx.tree_at(lambda q: q.v, particles, particles.v.at[11, 0].set(4e4))

    def message():
        with pytest.raises(mpm.SimulationError) as error:
            mpm.simulate(scene, fast, t1=STEPS * DT, dt=DT)
        return str(error.value)

    assert message() == unsorted(monkeypatch, message)


@NEEDS_LIBRARY
def test_what_keeps_its_order_is_not_sorted(monkeypatch):
    """Bodies that only deform, what a body force may know one by one, few particles, few steps."""
    scene, particles = mixed()
    body = mpm.Scene(scene.grid, mpm.NeoHookean(1e4, 0.3))
    alone = mpm.fill(mpm.Box((0.5, 0.5), (0.9, 0.9)), scene.grid, particles_per_cell=4, density=1e3)
    assert not is_sorted(body, alone)
    assert not is_sorted(scene, particles, steps=2)
    assert not is_sorted(replace(scene, body_force=Still()), particles)
    monkeypatch.setattr(_sorting, "LEAST", 10_000)
    assert not is_sorted(scene, particles)


def test_another_value_of_the_variable_is_refused(monkeypatch):
    monkeypatch.setenv(_sorting.VARIABLE, "cells")
    scene, particles = mixed()
    with pytest.raises(ValueError, match="MPMJAX_ORDER must be given, or not be set, got 'cells'"):
        mpm.rollout(scene, particles, steps=3, dt=DT)


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_an_order_is_stable(count):
    cells = jnp.asarray(np.random.default_rng(0).integers(-50, 50, count), jnp.int32)
    np.testing.assert_array_equal(by_cell(cells), np.argsort(np.asarray(cells), kind="stable"))
    both = jax.vmap(by_cell)(jnp.stack([cells, -cells]))
    np.testing.assert_array_equal(both[1], np.argsort(-np.asarray(cells), kind="stable"))


@pytest.mark.parametrize("dtype", ["float32", *thorough("float64")])
def test_rearranging_is_linear_and_its_transpose_is_the_other_order(dtype):
    random = np.random.default_rng(0)
    order = jnp.asarray(random.permutation(30), jnp.int32)
    a, b = (jnp.asarray(random.normal(size=(30, 2, 2)), dtype) for _ in range(2))
    for wanted in (True, False):
        given = a[order] if wanted else a
        change = jax.jit(lambda a, wanted=wanted: rearranged(jnp.asarray(wanted), order, a))
        np.testing.assert_array_equal(change(a), given)
        np.testing.assert_array_equal(jax.jvp(change, (b,), (a,))[1], given)
        (back,) = jax.linear_transpose(change, a)(given)
        np.testing.assert_array_equal(back, a)
        np.testing.assert_array_equal(jax.vmap(change)(jnp.stack([b, a]))[1], given)
