"""A reader of a step meets what the scene has: files and functions of the package that tracing one step enters."""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import mpmjax as mpm
from mpmjax.checks import canonical
from mpmjax.stepping import step_unchecked

ROOT = str(Path(mpm.__file__).parent)
PARTS = ("<lambda>", "<genexpr>", "<listcomp>", "<setcomp>", "<dictcomp>")


def entered(function, *args):
    """The functions of the package that run while a function is traced, as pairs of file and qualified name.

    Lambdas and comprehensions count as part of the function that they stand in, as Python 3.12 has it of the latter.
    """
    functions = set()

    def note(frame, event, _):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(ROOT) and code.co_name not in PARTS:
            functions.add((code.co_filename, code.co_qualname, code.co_firstlineno))

    sys.setprofile(note)
    try:
        jax.make_jaxpr(function)(*args)
    finally:
        sys.setprofile(None)
    return functions


def step_of(width, method, boundary):
    """A step of a block of a width that no other test has, so that nothing of it was traced before; and its arrays."""
    grid = mpm.Grid((12, 12), 0.1, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (width, 0.4)), grid, particles_per_cell=4, density=1e3)
    scene = mpm.Scene(grid, mpm.NeoHookean(1e5, 0.3), boundary=boundary)
    scene, dt, method = canonical((scene, 1e-3, method), jnp.float64)
    arrays, rest = eqx.partition((scene, mpm.prepare(scene, particles), 0 * dt, dt, method), eqx.is_array)
    return lambda arrays: step_unchecked(*eqx.combine(arrays, rest)), arrays


@pytest.mark.parametrize(
    ("method", "boundary", "width", "files", "functions"),
    [
        pytest.param(mpm.Explicit(), (), 0.55, 18, 78, id="explicit free"),
        pytest.param(mpm.SemiImplicit(), mpm.SlipBox((0.0, 0.0), (0.8, 0.8)), 0.65, 27, 142, id="semi-implicit slip"),
        pytest.param(
            mpm.SemiImplicit(), mpm.SeparatingBox((0.0, 0.0), (0.8, 0.8)), 0.75, 34, 200, id="semi-implicit separating"
        ),
    ],
)
def test_a_step_enters_what_its_scene_has(method, boundary, width, files, functions):
    """At most as many files and functions as written here."""
    seen = entered(*step_of(width, method, boundary))
    assert len({file for file, *_ in seen}) <= files
    assert len(seen) <= functions
