"""Public constructors and functions, each called with one argument after another of a wrong kind.

Run as a script, without the tests' own type checks, it prints what is taken and what ends in another error than a
ValueError: nothing, if all is well.
"""

import inspect
import warnings
from collections.abc import Iterator
from typing import NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from helpers import block
from test_schema import EXAMPLES

import mpmjax as mpm
from mpmjax.fitting._estimates import fit_result
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._search import Minimum

SCENE, PARTICLES = block(2)


class Reached(Exception):  # noqa: N818
    """All arguments were taken."""


def reached(*args: object) -> NoReturn:
    raise Reached


SEEN = mpm.Curve([0.05], [0.1], reached, sigma=0.01)
STIFFNESS = mpm.Positive(lambda e: e.scene.material.youngs_modulus)
RUN = {"scene": SCENE, "particles": PARTICLES, "t1": 0.1, "dt": 0.01}


def found() -> mpm.FitResult:
    """A fit, as if it had been made."""
    problem = FitProblem((mpm.Experiment(**RUN, observations=SEEN),), {"E": STIFFNESS})
    at = Minimum(jnp.zeros(1), jnp.zeros(1), jnp.ones((1, 1)), True, False, ())
    return fit_result(problem, mpm.LevenbergMarquardt(), at, [1.0], [1.0], (jnp.ones(()),), {}, 0.95)


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
    mpm.sensitivity: RUN,
    mpm.record: RUN | {"path": "never.h5", "save_every": 1},
    mpm.rollout: {"scene": SCENE, "particles": PARTICLES, "steps": 1, "dt": 0.01},
    mpm.budget: {"scene": SCENE, "particles": PARTICLES, "steps": 1, "dt": 0.01},
    mpm.step: {"scene": SCENE, "particles": PARTICLES, "t": 0.0, "dt": 0.01},
    mpm.energy: {"scene": SCENE, "particles": PARTICLES},
    mpm.momentum: {"particles": PARTICLES},
    mpm.pieces: {"scene": SCENE, "particles": PARTICLES},
    mpm.sample_distance: {"region": mpm.Ball((0.1, 0.1), 0.1), "spacing": 0.02},
    mpm.sample_mesh: {"mesh": "nowhere.stl", "spacing": 0.02},
    mpm.save: {"path": "never.h5", "run": None},
    mpm.load: {"path": "never.h5"},
    mpm.render: {"run": None, "path": "never.png"},
    mpm.work_precision: {"build": reached, "t1": 0.1},
    mpm.Experiment: RUN | {"observations": SEEN},
    mpm.fit: {"experiments": mpm.Experiment(**RUN, observations=SEEN), "parameters": {"E": STIFFNESS}},
    mpm.fit_refined: {"build": reached, "parameters": {"E": STIFFNESS}},
    mpm.profile: {"result": FITTED, "label": "E"},
    mpm.predict: {"result": FITTED, "of": reached},
    mpm.predict_observations: {"result": FITTED},
    mpm.fit_multistart: {"experiments": mpm.Experiment(**RUN, observations=SEEN), "parameters": {"E": STIFFNESS}},
    mpm.fit_staged: {"experiments": mpm.Experiment(**RUN, observations=SEEN), "parameters": {"E": STIFFNESS}},
    mpm.fit_ensemble: {"experiments": [mpm.Experiment(**RUN, observations=SEEN)], "parameters": {"E": STIFFNESS}},
    mpm.bootstrap: {"result": None},
}
"""Each public function with arguments; of those the tests replace one at a time."""
PARTICLE_FIELDS = {"x": PARTICLES.x, "v": PARTICLES.v, "mass": PARTICLES.mass, "volume": PARTICLES.volume}


def arguments_of(value: object) -> dict:
    """What an object can be made of anew."""
    parameters = inspect.signature(type(value).__init__).parameters
    return {name: getattr(value, name) for name in parameters if name != "self"}


CALLS = {type(value): arguments_of(value) for value in EXAMPLES.values()} | {mpm.Particles: PARTICLE_FIELDS} | FUNCTIONS
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
}
"""Numbers that constructors are tried with besides."""


MAY = {
    (mpm.save, "path"),
    (mpm.load, "path"),
    (mpm.render, "path"),
    (mpm.record, "path"),
    (mpm.render, "colour"),
    (mpm.sample_mesh, "mesh"),
    (mpm.fill, "dtype"),
    (mpm.fill_mapped, "dtype"),
    (mpm.fill_mapped, "mapping"),
    (mpm.Experiment, "name"),
    (mpm.predict, "of"),
    (mpm.fit, "log"),
    (mpm.fit_refined, "log"),
    *(
        (call, name)
        for call in CALLS
        for name in ("observe", "build", "curve", "parameter", "report", "progress", "say")
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
            for what, value in wrong.items():
                taken = False
                try:
                    call(**good | {name: value})
                    taken = True
                except Reached:
                    taken = True
                except ValueError as error:
                    if "\n" in str(error):
                        yield f"{call.__name__}({name}={what}): several lines"
                except Exception as error:
                    yield f"{call.__name__}({name}={what}): {type(error).__name__}: {error}"
                if taken and what in NO_KIND and (name, what) not in TAKEN:
                    yield f"{call.__name__} takes {name}={what}"


TAKEN = {
    (name, "empty") for name in ("boundary", "loads", "also", "deformations", "histories", "methods", "refinements")
} | {("fitted", "array of words")}
"""What may be none of; and what NumPy takes for true."""

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    print("\n".join(offences()), end="")
