"""The kinds of observation and of parameter that only scene files name: each says of a run what was measured of it."""

import csv

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot as plt

import mpmjax as mpm
from mpmjax.cli._fit_file import read_fit
from mpmjax.cli._scene_file import read_simulation
from mpmjax.fitting import Prediction
from mpmjax.fitting._problem import FitProblem
from mpmjax.state import with_state

SCENE = """
gravity = [0.0, -5.0]
[grid]
shape = [14, 14]
spacing = 0.1
origin = [-3, -3]
[material]
kind = "NeoHookean"
youngs_modulus = 1e4
poisson_ratio = 0.3
[[boundary]]
kind = "StickyCollider"
shape = { kind = "Box", lower = [-0.2, -0.2], upper = [0.7, 0.1] }
motion = { kind = "Motion", times = [0.0, 0.01, 1.0], displacement = [[0.0, 0.0], [0.0, 0.0], [0.0, 0.99]] }
[[particles]]
region = { kind = "Box", lower = [0.1, 0.1], upper = [0.4, 0.4] }
density = 1e3
velocity = [0.2, -0.3]
[run]
t1 = 0.05
dt = 2.5e-3
[fit]
[[fit.parameter]]
path = "scene.material.youngs_modulus"
[[fit.parameter]]
kind = "Velocity"
[[fit.parameter]]
kind = "Spin"
start = 2.0
"""
GRID = "grid = { shape = [9, 9], spacing = 0.1, origin = [-2, -2] }"
KINDS = {
    "Force": 'data = "force.csv"\ntime = "t"\nforce = ["", "fy"]',
    "Torque": 'data = "torque.csv"\ntime = "t"\ntorque = ["mz"]',
    "ForceDisplacement": (
        'data = "curve.csv"\ndisplacement = "u [mm]"\nforce = "load"\naxis = 1\nlength_unit = 1e-3\n'
        "length_scale = -1.0\nscale = -2.0"
    ),
    "Energy": 'data = "energy.csv"\ntime = "t"\nvalue = "e"\npart = "elastic"',
    "Cloud": 'data = "cloud.csv"\ntime = "t"\nplace = ["x", "y"]\n' + GRID,
    "Density": 'data = "pictures.npz"\n' + GRID,
}


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A block on a table that rises, and files with what is seen of it, each figure taken from the frames."""
    folder = tmp_path_factory.mktemp("pushed")
    observations = "".join(f'[[fit.observation]]\nkind = "{kind}"\n{keys}\n' for kind, keys in KINDS.items())
    (folder / "plain.toml").write_text(SCENE)
    (folder / "block.toml").write_text(SCENE + observations)
    made = read_simulation(folder / "plain.toml")
    run = mpm.simulate(made.scene, made.particles, t1=0.05, dt=2.5e-3, save_every=1)
    forces, picture = run.forces(), mpm.fitting.Density(mpm.Grid((9, 9), 0.1, origin=(-2, -2)))
    times, middles, x = (np.asarray(a) for a in (run.times, forces.times, run.frames.x))
    force, torque = (np.asarray(a)[:, 0] for a in (forces.force, forces.torque))
    at = lambda k: with_state(made.particles, jax.tree.map(lambda a: a[k], run.frames))  # noqa: E731
    energies = [float(mpm.energy(made.scene, at(k)).elastic) for k in range(len(run))]
    cloud = [(times[k], *place) for k in (4, 8) for place in x[k]]
    for name, head, rows in (
        ("force", ("t", "fy"), zip(middles, force[:, 1], strict=True)),
        ("torque", ("t", "mz"), zip(middles, torque[:, 0], strict=True)),
        (
            "curve",
            ("u [mm]", "load"),
            [(-1e3 * (t - 0.01), -f / 2) for t, f in zip(middles, force[:, 1], strict=True) if t > 0.01],
        ),
        ("energy", ("t", "e"), zip(times, energies, strict=True)),
        ("cloud", ("t", "x", "y"), cloud),
    ):
        with (folder / f"{name}.csv").open("w", newline="") as file:
            csv.writer(file).writerows([head, *rows])
    mass = float(made.particles.mass.sum())
    np.savez(folder / "pictures.npz", times=times[[3, 6]], density=[picture.of_points(x[k], mass) for k in (3, 6)])
    return folder


def test_each_kind_predicts_what_was_measured_of_the_same_run(pushed):
    """And nothing else does: none is the same on another run. The curve is of half a body, pressed the other way."""
    (experiment,) = read_fit(pushed / "block.toml").experiments
    assert experiment.observations[0].collider == 0
    run = experiment.run()
    for kind, seen, predicted in zip(KINDS, experiment.observations, experiment.predictions(run), strict=True):
        measured = np.isfinite(seen.data)
        assert measured.any(), kind
        size = np.abs(seen.data[measured]).max()
        assert size > 0, kind
        assert np.allclose(np.asarray(predicted)[measured], seen.data[measured], rtol=0, atol=1e-9 * size), kind


def test_a_picture_shows_the_columns_of_the_file(pushed):
    """The curve of force against displacement, in its units and signs, and no component that was not measured."""
    observations = dict(zip(KINDS, read_fit(pushed / "block.toml").experiments[0].observations, strict=True))
    rows = np.genfromtxt(pushed / "curve.csv", delimiter=",", skip_header=1)
    axes = plt.subplots(2, 1)[1]
    for axis, kind in zip(axes, ("ForceDisplacement", "Force"), strict=True):
        data = observations[kind].data
        flat = Prediction(data, data, data, data, None, None, None, 0.95)
        observations[kind].draw(axis, flat, np.inf)
        assert axis.get_legend_handles_labels()[1] == ["95 % of the mean", "fit", "measured"]
    (dots,) = (line for line in axes[0].lines if line.get_label() == "measured")
    np.testing.assert_allclose(np.sort(dots.get_xydata(), axis=0), np.sort(rows, axis=0), atol=1e-12)
    assert [(axis.get_xlabel(), axis.get_ylabel()) for axis in axes] == [("u [mm]", "load [N]"), ("t [s]", "fy [N]")]
    plt.close()


def test_velocity_and_spin_are_those_of_the_body(pushed):
    """The centre of mass has the velocity whatever the spin is; the angular momentum grows by inertia times spin."""
    asked = read_fit(pushed / "block.toml")
    (experiment,) = asked.experiments
    velocity, spin = asked.parameters["velocity"], asked.parameters["spin"]
    assert np.allclose(velocity.start, [0.2, -0.3])
    before, value = experiment.particles, jnp.array([1.0, 2.0])
    for order in ((velocity, spin), (spin, velocity)):
        e = experiment
        for parameter in order:
            e = parameter.put(e, value if parameter is velocity else jnp.asarray(3.0))
        q = e.particles
        arms = np.asarray(q.x - q.mass @ q.x / q.mass.sum())
        assert np.allclose(q.mass @ q.v / q.mass.sum(), value)
        gained = np.asarray(q.v - before.v)
        momentum = (np.asarray(q.mass) * (arms[:, 0] * gained[:, 1] - arms[:, 1] * gained[:, 0])).sum()
        inertia = (np.asarray(q.mass) * (arms**2).sum(axis=1)).sum()
        assert momentum == pytest.approx(3 * inertia)
        assert np.allclose(q.C - before.C, [[[0, -3], [3, 0]]])

    def spun(e, w):  # velocities alone, of which the fit knows the gradient
        x = e.particles.x - e.particles.x.mean(axis=0)
        return eqx.tree_at(lambda e: e.particles.v, e, w * jnp.stack([-x[:, 1], x[:, 0]], axis=1))

    def given(e, w):
        return eqx.tree_at(lambda e: e.particles.C, spun(e, w), 0.5 * before.C + w)

    for update, C in ((spun, [[0, -3], [3, 0]]), (given, [[3, 3], [3, 3]])):
        problem = FitProblem((experiment,), {"w": mpm.Unbounded(update=update, start=3.0)})
        q = problem.put(experiment, jnp.zeros(1), 0).particles
        np.testing.assert_allclose(q.C, np.broadcast_to(C, q.C.shape), atol=1e-5)


def test_a_scene_file_is_refined_with_what_was_measured(pushed):
    asked = read_fit(pushed / "block.toml")
    (fine,), _ = asked.refined(2)
    (coarse,) = asked.experiments
    assert float(fine.scene.grid.spacing) == float(coarse.scene.grid.spacing) / 2
    assert fine.dt == coarse.dt / 2
    assert fine.particles.count == 4 * coarse.particles.count
    assert [type(o).__name__ for o in fine.observations] == [type(o).__name__ for o in coarse.observations]


BAD = {
    "sorted": (
        "cloud.csv",
        "t,x,y\n0.02,0.2,0.2\n0.01,0.2,0.2\n",
        r"cloud\.csv, line 3: t 0\.01 comes after a later one",
    ),
    "outside": ("cloud.csv", "t,x,y\n0.02,0.2,9\n", r"cloud\.csv, line 2: y 9 lies outside of the picture's grid"),
    "not reached": ("curve.csv", "u [mm],load\n-1,2\n-90,2\n", r"curve\.csv, line 3: u \[mm\] -90 is not reached"),
    "back": ("curve.csv", "u [mm],load\n-2,2\n-1,2\n", r"curve\.csv, line 3: u \[mm\] -1 must go on"),
    "no archive": ("pictures.npz", "no archive", r"pictures\.npz"),
}


@pytest.mark.parametrize(("name", "content", "says"), BAD.values(), ids=BAD)
def test_what_is_wrong_is_named(pushed, tmp_path, name, content, says):
    for path in pushed.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=says):
        read_fit(tmp_path / "block.toml")
