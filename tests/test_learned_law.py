"""Laws that hold networks, and the example that learns one."""

import json
import runpy
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import cloud, rotation_matrix

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.io import _schema
from mpmjax.io._schema import decode, encode
from mpmjax.verification import check_law

EXAMPLE = Path(__file__).parents[1] / "examples" / "learned_law.py"


class Perceptron(mpm.AbstractMaterial):
    """A network of equinox beside a neo-Hookean law."""

    modulus: float | jax.Array
    network: eqx.nn.MLP

    def energy(self, F):
        log_J, stretch = jnp.log(la.determinant(F)), la.double_dot(F, F) - len(F)
        learned = jax.vmap(self.network, in_axes=1, out_axes=1)(jnp.stack([stretch, log_J]))[0]
        return self.modulus * (stretch / 2 - log_J + log_J**2 + log_J**2 * jnp.tanh(learned) / 2)


def perceptron():
    return Perceptron(1e4, eqx.nn.MLP(2, 1, 5, 1, jax.nn.softplus, key=jax.random.key(0)))


def test_a_scene_takes_a_law_that_holds_a_network():
    """Whose weights are not one a particle and whose activation is no number."""
    grid, particles = cloud(2, p=20, cells=3)
    after, _ = mpm.step(mpm.Scene(grid, perceptron()), particles, 0.0, 1e-4)
    assert np.isfinite(after.x).all()


@pytest.mark.thorough
@pytest.mark.parametrize("hessian", [mpm.implicit.AnalyticHessian(), mpm.implicit.JvpHessian()])
def test_gradients_by_weights_of_a_network_are_differences(hessian):
    """Through implicit steps."""
    grid, particles = cloud(2, p=20, cells=3)
    scene, solver = mpm.Scene(grid, perceptron()), mpm.implicit.ConjugateResidual(rtol=1e-13)
    method = mpm.SemiImplicit(1.0, solver, hessian=hessian, adjoint_solver=solver)

    @jax.jit
    @jax.value_and_grad
    def moment(bias):
        trial = eqx.tree_at(lambda s: s.material.network.layers[1].bias, scene, bias)
        return (mpm.simulate(trial, particles, t1=2e-4, dt=1e-4, method=method).final.v ** 2).sum()

    bias, h = scene.material.network.layers[1].bias, 1e-3
    difference = (moment(bias + h)[0] - moment(bias - h)[0]) / (2 * h)
    assert abs(float(difference)) > 0
    np.testing.assert_allclose(moment(bias)[1][0], difference, rtol=1e-5)


def test_numbers_of_a_law_itself_are_one_a_particle_beside_a_network():
    grid, particles = cloud(2, p=20, cells=3)
    law = eqx.tree_at(lambda law: law.modulus, perceptron(), jnp.full(7, 1e4))
    with pytest.raises(ValueError, match=r"one for each of its 20 particles, got shapes \[\(7,\)\]\. What has another"):
        mpm.prepare(mpm.Scene(grid, law), particles)


@mpm.register
class Dense(eqx.Module):
    """A layer of one's own."""

    weight: jax.Array


@mpm.register
class Weighted(mpm.AbstractMaterial):
    """Weights as arrays of several shapes, and in layers."""

    weights: tuple[jax.Array, ...]
    layers: tuple[Dense, ...]

    def energy(self, F):
        return sum((w**2).sum() for w in self.weights) * (la.double_dot(F, F) - len(F))


def test_files_hold_weights_of_several_shapes():
    """Few numbers are written out, many stand beside."""
    rng, arrays = np.random.default_rng(0), {}
    weights = tuple(rng.normal(size=shape) for shape in ((3, 2), (5,), (20, 20)))
    law = Weighted(weights, tuple(Dense(weight) for weight in weights))
    again = decode(json.loads(json.dumps(encode(law, arrays))), mpm.AbstractMaterial, "", arrays)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(law), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.thorough
def test_a_run_whose_law_holds_a_network_is_saved_loaded_resumed_and_drawn(tmp_path, monkeypatch):
    """Bit for bit, with functions that have names and that have none; without its class the file is refused."""
    mpm.register(Perceptron)
    monkeypatch.setattr(_schema, "_registered", _schema._registered | {"Perceptron": Perceptron})
    grid, particles = cloud(2, p=20, cells=3)
    for number, activation in enumerate((jnp.tanh, eqx.nn.PReLU(0.25))):
        law = Perceptron(1e4, eqx.nn.MLP(2, 1, 5, 1, activation, key=jax.random.key(0)))
        scene, path = mpm.Scene(grid, law), tmp_path / f"{number}.vtkhdf"
        mpm.record(path, scene, particles, t1=2e-4, dt=1e-4, save_every=1)
        loaded = mpm.load(path).scene.material
        assert jax.tree.structure(loaded) == jax.tree.structure(law)
        jax.tree.map(
            np.testing.assert_array_equal, *(eqx.filter(a, eqx.is_array) for a in (loaded.network, law.network))
        )
    whole = mpm.simulate(scene, particles, t1=4e-4, dt=1e-4)
    mpm.record(path, scene, particles, t1=4e-4, dt=1e-4, save_every=1, resume=True)
    again = mpm.load(path)
    np.testing.assert_array_equal(again.final.F, whole.final.F)
    mpm.render(again, tmp_path / "run.png", frame=-1)
    assert (tmp_path / "run.png").exists()
    other = eqx.tree_at(lambda s: s.material.network.layers[0].bias, scene, jnp.zeros(5))
    with pytest.raises(ValueError, match=r"holds another run: its .*layers\.0\.bias is another array"):
        mpm.record(path, other, particles, t1=6e-4, dt=1e-4, save_every=1, resume=True)
    monkeypatch.delitem(_schema._registered, "Perceptron")
    with pytest.raises(ValueError, match="unknown kind 'Perceptron'"):
        mpm.load(path)


def test_what_files_do_not_know_of_a_network_is_refused():
    """A function of one's own, fields that are not those of the class, classes and functions that are no network's."""
    key, arrays = jax.random.key(0), {}
    with pytest.raises(ValueError, match=r"layers\.1\.fn is a function, which files cannot hold"):
        encode(eqx.nn.Sequential([eqx.nn.Linear(2, 2, key=key), eqx.nn.Lambda(lambda x: x + 1)]), {})
    data = encode(eqx.nn.Linear(2, 3, key=key), arrays, "linear")
    assert decode(data, eqx.Module, "", arrays).weight.shape == (3, 2)
    with pytest.raises(ValueError, match="only a run's file holds its weights"):
        encode(eqx.nn.Linear(2, 3, key=key))
    for change, message in (
        ({"bias": {"array": "gone"}}, "has lost its array 'gone'"),
        ({"more": 1}, "has other fields than a Linear of this version of equinox"),
        ({"kind": "equinox.nn.inference_mode"}, "cannot be the kind 'equinox.nn.inference_mode'"),
        (
            {"use_bias": {"function": "jax.numpy.save"}},
            "must be a function of jax.nn or jax.numpy, got 'jax.numpy.save'",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            decode(data | change, eqx.Module, "", arrays)
    with pytest.raises(ValueError, match="cannot be the kind 'equinox"):
        decode(data, mpm.AbstractMaterial, "", arrays)


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """What the example, in its small size, leaves: its names, and its files in the folder."""
    # optax promotes numbers
    with pytest.MonkeyPatch.context() as patch, jax.numpy_dtype_promotion("standard"):
        patch.chdir(folder := tmp_path_factory.mktemp("learned"))
        patch.setattr(sys, "argv", [str(EXAMPLE), "--small"])
        return runpy.run_path(str(EXAMPLE)) | {"folder": folder}


def wild(example, seed):
    """A law with large random weights."""
    scattered = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(scattered.normal(size=a.shape) * 2), example["law"])


def deformations(d, count=200):
    """Random ones with J > 0, shape (d, d, count)."""
    rng = np.random.default_rng(d)
    stretches = rng.uniform(0.4, 2.0, (count, d))
    each = [rotation_matrix(d, rng) @ np.diag(s) @ rotation_matrix(d, rng) for s in stretches]
    return jnp.asarray(np.stack(each, axis=-1))


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_the_learned_law_is_a_law_whatever_its_weights_are(example, d):
    """Zero and free of stress at rest, frame-indifferent, isotropic, stiff at rest, elliptic everywhere."""
    rng = np.random.default_rng(5)
    F, rest = deformations(d), jnp.eye(d)[..., None]
    Q = jnp.broadcast_to(rotation_matrix(d, rng)[..., None], F.shape)
    for law in (example["law"], *(wild(example, seed) for seed in range(3))):
        energy, size = law.energy(F), float(jnp.exp(law.shear))
        assert abs(float(law.energy(rest)[0])) < 1e-12 * size
        assert float(jnp.abs(law.stress(rest)).max()) < 1e-12 * size
        assert float(energy.min()) > 0
        np.testing.assert_allclose(law.energy(la.matmul(Q, F)), energy, rtol=1e-10)
        np.testing.assert_allclose(law.energy(la.matmul(F, Q)), energy, rtol=1e-10)
        check_law(law, dim=d)
        shear, stretch = np.zeros((d, d)), np.eye(d)
        shear[0, 1] = 1.0
        for strain in (shear + shear.T, stretch):
            stress = law.stress_differential(rest)(jnp.asarray(strain)[..., None])
            assert float(la.double_dot(stress, jnp.asarray(strain)[..., None])[0]) > 0
        a, n = rng.normal(size=(2, d, F.shape[-1]))
        wave = jnp.asarray(a[:, None] * n[None])
        acoustic = la.double_dot(wave, law.stress_differential(F)(wave))
        assert float((acoustic / la.double_dot(wave, wave)).min()) > 0


@pytest.mark.slow
def test_the_learned_law_fits(example):
    """The motion that it was trained on, better than before; the example asks more of its whole training."""
    history, table = example["history"], example["table"]
    assert np.isfinite(history).all()
    assert min(history) < history[0] / 2
    assert table["network, trained"][0] < table["network, untrained"][0] / 2


@pytest.mark.slow
def test_the_learned_law_is_saved_and_loaded(example):
    run = mpm.load(example["folder"] / "learned_law.vtkhdf")
    law = run.scene.material
    F = deformations(2)
    np.testing.assert_array_equal(law.energy(F), example["law"].energy(F))
    assert (example["folder"] / "learned_law.png").exists()
