"""Public constructors and functions, each called with one argument after another of a wrong kind.

Run as a script, without the tests' own type checks, it prints what is taken and what ends in another error than a
ValueError: nothing, if all is well.
"""

import inspect
import warnings
from collections.abc import Callable, Iterator
from typing import NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from helpers import block
from test_schema import EXAMPLES

import mpmjax as mpm
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._result import Minimum, fit_result
from mpmjax.fitting._search import Search

SCENE, PARTICLES = block(2)


class Reached(Exception):  # noqa: N818
    """All arguments were taken."""


def reached(*args: object) -> NoReturn:
    raise Reached


SEEN = mpm.Curve([0.05], [0.1], reached, sigma=0.01)
STIFFNESS = mpm.Positive(lambda e: e.scene.material.youngs_modulus)
PICTURE = mpm.fitting.Density(SCENE.grid)
RUN = {"scene": SCENE, "particles": PARTICLES, "t1": 0.1, "dt": 0.01}


def found() -> mpm.fitting.FitResult:
    """A fit, as if it had been made."""
    problem = FitProblem((mpm.Experiment(**RUN, observations=SEEN),), {"E": STIFFNESS})
    seen = mpm.fitting.Evaluation(jnp.zeros(()), jnp.zeros(1), jnp.zeros(1), jnp.ones((1, 1)))
    at = Search(jnp.zeros(1), None, seen, (), converged=True)
    minimum = Minimum(problem, at, [(jnp.ones(()), 1.0, 1.0)], moves=False)
    return fit_result(minimum, mpm.fitting.LevenbergMarquardt(), {}, 0.95)


FITTED = found()
FUNCTIONS = {
    mpm.fill: {"region": mpm.Ball((0.1, 0.1), 0.1), "grid": SCENE.grid, "density": 1e3},
    mpm.attach: {"scene": SCENE, "particles": PARTICLES},
    mpm.fill_mapped: {
        "mapping": reached,
        "box": mpm.Box((0.1, 0.1), (0.2, 0.2)),
        "counts": (2, 2),
        "density": 1e3,
    },
    mpm.prepare: {"scene": SCENE, "particles": PARTICLES},
    mpm.stable_dt: {"scene": SCENE, "particles": PARTICLES},
    mpm.simulate: RUN,
    mpm.analysis.sensitivity: RUN,
    mpm.record: RUN | {"path": "never.h5", "save_every": 1},
    mpm.rollout: {"scene": SCENE, "particles": PARTICLES, "steps": 1, "dt": 0.01},
    mpm.budget: {"scene": SCENE, "particles": PARTICLES, "steps": 1, "dt": 0.01},
    mpm.step: {"scene": SCENE, "particles": PARTICLES, "t": 0.0, "dt": 0.01},
    mpm.energy: {"scene": SCENE, "particles": PARTICLES},
    mpm.momentum: {"particles": PARTICLES},
    mpm.stress: {"scene": SCENE, "particles": PARTICLES},
    mpm.analysis.pressure: {"scene": SCENE, "particles": PARTICLES},
    mpm.analysis.von_mises: {"scene": SCENE, "particles": PARTICLES},
    mpm.analysis.density: {"scene": SCENE, "particles": PARTICLES},
    mpm.analysis.smoothed: {"scene": SCENE, "particles": PARTICLES, "values": PARTICLES.mass},
    mpm.analysis.pieces: {"scene": SCENE, "particles": PARTICLES},
    mpm.geometry.sample_distance: {"region": mpm.Ball((0.1, 0.1), 0.1), "spacing": 0.02},
    mpm.geometry.sample_mesh: {"mesh": "nowhere.stl", "spacing": 0.02},
    mpm.save: {"path": "never.h5", "run": None},
    mpm.load: {"path": "never.h5"},
    mpm.table: {"run": "never.h5"},
    mpm.load_scene: {"path": "never.toml"},
    mpm.save_scene: RUN | {"path": "never/never.toml"},
    mpm.render: {"run": None, "path": "never.png"},
    mpm.analysis.work_precision: {"build": reached, "t1": 0.1},
    mpm.Experiment: RUN | {"observations": SEEN},
    mpm.fit: {"experiments": mpm.Experiment(**RUN, observations=SEEN), "parameters": {"E": STIFFNESS}},
    mpm.fitting.fit_refined: {"build": reached, "parameters": {"E": STIFFNESS}},
    mpm.fitting.profile: {"result": FITTED, "label": "E"},
    mpm.fitting.predict: {"result": FITTED, "of": reached},
    mpm.fitting.predict_observations: {"result": FITTED},
    mpm.fitting.fit_staged: {"experiments": mpm.Experiment(**RUN, observations=SEEN), "parameters": {"E": STIFFNESS}},
    mpm.fitting.fit_ensemble: {
        "experiments": [mpm.Experiment(**RUN, observations=SEEN)],
        "parameters": {"E": STIFFNESS},
    },
    mpm.fitting.bootstrap: {"result": None},
    mpm.join: {"sets": PARTICLES},
    mpm.fitting.Markers.of: {"which": [0]},
    mpm.fitting.Markers.at: {"particles": PARTICLES, "places": [[0.1, 0.1]]},
    mpm.fitting.StressStretch.of: {"region": mpm.Ball((0.1, 0.1), 0.1), "particles": PARTICLES, "axis": 0},
    mpm.fitting.Field.lattice_around: {"particles": PARTICLES, "spacing": 0.1},
    PICTURE.of_points: {"points": PARTICLES.x, "mass": 1.0},
}
"""Each public function with arguments; of those the tests replace one at a time."""
TRUST = {"sigma": 0.1, "weight": 1.0, "robust": None}
PARAMETER = {
    "where": reached,
    "update": None,
    "start": 1.0,
    "prior": mpm.fitting.Gaussian(1.0, 0.1),
    "unit": "Pa",
    "only": (0,),
}
FITTING = {
    mpm.Unbounded: PARAMETER | {"scale": 1.0},
    mpm.Positive: PARAMETER,
    mpm.Bounded: PARAMETER | {"lower": 0.0, "upper": 2.0},
    mpm.fitting.Field: {"of": STIFFNESS, "lattice": SCENE.grid, "kernel": mpm.BSpline(1), "start": None},
    mpm.fitting.Gaussian: {"mean": 1.0, "sigma": 0.1},
    mpm.fitting.Smooth: {"sigma": 0.1, "robust": 3.0},
    mpm.fitting.LevenbergMarquardt: {},
    mpm.fitting.LBFGS: {},
    mpm.fitting.Adam: {},
    mpm.Series: TRUST | {"times": [0.1, 0.2], "data": [1.0, 2.0], "of": reached},
    mpm.Tracks: TRUST | {"times": [0.1], "data": [[[0.1, 0.2]]], "which": [0]},
    mpm.Curve: TRUST | {"x": [0.1, 0.2], "data": [1.0, 2.0], "of": reached},
    mpm.fitting.Force: TRUST | {"times": [0.1], "data": [[1.0, 2.0]]},
    mpm.fitting.Torque: TRUST | {"times": [0.1], "data": [[1.0]]},
    mpm.fitting.Starts: {
        "count": 8,
        "fraction": 0.5,
        "ranges": {},
        "points": (),
        "if_needed": True,
        "seed": 0,
        "batch": 1,
    },
    mpm.fitting.Shown: {"unit": -1.0, "path": [[0.0, 1.0], [0.0, 2.0]]},
    mpm.fitting.Extent: {"axis": 0},
    mpm.fitting.Density: {"grid": SCENE.grid},
}
"""What fits are made of, which files hold by other means."""
GATE = mpm.HalfSpace((0.0, 0.0), (1.0, 0.0))
FLOWS = {
    mpm.extensions.Inlet: {"stock": PARTICLES, "velocity": (1.0, 0.0), "gate": GATE, "length": 0.1, "first": 0},
    mpm.extensions.Outlet: {"region": GATE, "start": 0.0, "rest": (0.0, 0.0)},
    mpm.extensions.Controls: {"parts": (reached,)},
}
"""What controls are made of."""
PARTICLE_FIELDS = {"x": PARTICLES.x, "v": PARTICLES.v, "mass": PARTICLES.mass, "volume": PARTICLES.volume}


def arguments_of(value: object) -> dict:
    """What an object can be made of anew."""
    parameters = inspect.signature(type(value).__init__).parameters
    return {name: getattr(value, name) for name in parameters if name != "self"}


MADE = {type(value): arguments_of(value) for value in EXAMPLES.values()}
CALLS = MADE | {mpm.Particles: PARTICLE_FIELDS} | FITTING | FLOWS | FUNCTIONS
NO_KIND = {
    "nonsense": "nonsense",
    "class": mpm.Scene,
    "object": object(),
    "table": {"kind": "PIC"},
    "complex": 1 + 2j,
    "words": ("a", "b"),
    "array of words": np.array(["a", "b"]),
    "empty": (),
    "ragged": ((0.0,), (1.0, 2.0)),
    "masked": np.ma.masked_array([1.0, 2.0], [True, False]),
}
"""What few arguments take; those that do may."""
NUMBERS = {
    "none": None,
    "switch": True,
    "nan": float("nan"),
    "infinite": float("inf"),
    "negative": -1,
    "huge": 10**400,
    "array": np.ones((2, 2, 2, 2)),
    "many": [10**30, 10**30],
    "list": [0.1, 0.2],
    "counts": np.array([0, 1]),
    "count": jnp.asarray(1.0),
}
"""Numbers that constructors are tried with besides."""
SENSELESS = {
    **dict.fromkeys(("t1", "dt", "safety"), (0.0, -1e-3, float("nan"), float("inf"), 1e-46)),
    "t": (float("nan"), float("inf")),
    "start": (-1, 0.5, float("nan"), float("inf")),
    "steps": (-1, 0.5),
    "save_every": (0, -1),
}
"""Numbers that no function takes for what has this name; 1e-46 is zero in single precision."""
SINGLE = mpm.fill(mpm.Box((0.1, 0.1), (0.2, 0.2)), SCENE.grid, density=1e3, dtype="float32")


MAY = {
    (mpm.save, "path"),
    (mpm.load, "path"),
    (mpm.render, "path"),
    (mpm.record, "path"),
    (mpm.render, "colour"),
    (mpm.geometry.sample_mesh, "mesh"),
    (mpm.fill, "dtype"),
    (mpm.fill_mapped, "dtype"),
    (mpm.fill_mapped, "mapping"),
    (mpm.fill, "velocity"),
    (mpm.fill_mapped, "velocity"),
    (mpm.Experiment, "name"),
    (mpm.fitting.Shown, "x"),
    (mpm.fitting.Shown, "y"),
    (mpm.fitting.Shown, "columns"),
    (mpm.fitting.Adam, "learning_rate"),
    (mpm.fitting.predict, "of"),
    (mpm.fit, "log"),
    (mpm.fitting.fit_refined, "log"),
    *(
        (call, name)
        for call in CALLS
        for name in ("observe", "build", "curve", "parameter", "report", "progress", "say", "control", "memory")
    ),
}
"""Arguments that take words, or any function."""


def offences() -> Iterator[str]:
    """What is taken though it is of no kind, and what ends in an error from somewhere inside."""
    for call, good in CALLS.items():
        wrong = NO_KIND | (NUMBERS if isinstance(call, type) else {})
        for name in inspect.signature(call).parameters:
            if (call, name) in MAY:
                continue
            senseless = {repr(value): value for value in SENSELESS.get(name, ()) if not isinstance(call, type)}
            if "particles" not in good:
                senseless.pop("1e-46", None)
            for what, value in (wrong | senseless).items():
                taken = False
                single = {"particles": SINGLE} if what == "1e-46" else {}
                try:
                    made = given(call, good | single | {name: value})
                    if isinstance(call, type):
                        hash(jax.tree.structure(made))  # as `jax.jit` does
                    taken = True
                except Reached:
                    taken = True
                except ValueError as error:
                    if "\n" in str(error):
                        yield f"{call.__name__}({name}={what}): several lines"
                except Exception as error:
                    yield f"{call.__name__}({name}={what}): {type(error).__name__}: {error}"
                if taken and (what in NO_KIND or what in senseless) and (name, what) not in TAKEN:
                    yield f"{call.__name__} takes {name}={what}"


def given(call: Callable, arguments: dict) -> object:
    """What a call returns; arguments of which it takes several stand as one."""
    several = [p.name for p in inspect.signature(call).parameters.values() if p.kind is p.VAR_POSITIONAL]
    return call(*[arguments[name] for name in several], **{k: v for k, v in arguments.items() if k not in several})


NONE = ("boundary", "loads", "also", "deformations", "histories", "methods", "refinements", "points", "names", "fields")
WHERE_USED = ("start", "only", "mean", "sigma")
TAKEN = {
    *((name, "empty") for name in (*NONE, *WHERE_USED)),
    *((name, "class") for name in ("where", "of")),
    *((name, "nonsense") for name in ("name", "x_name", "unit")),
    *((name, "masked") for name in ("data",)),
    ("fitted", "array of words"),
}
"""What may be none of, or is refused with the parameter's shape; what can be called; what is a word; what may be
measured in part; and what NumPy takes for true."""

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    print("\n".join(offences()), end="")
