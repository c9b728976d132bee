"""Public constructors and functions given what they do not take: a ValueError that says what they do."""

import enum
import inspect
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jaxtyping
import pytest
from calls import CALLS, PARTICLES, RUN, SCENE

import mpmjax as mpm


def test_bad_arguments_end_in_value_errors(tmp_path):
    """Of one line, whichever argument it is; and what is of no kind is not taken."""
    script = Path(__file__).parent / "calls.py"
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


MADE_BY_THE_PACKAGE = """Bootstrap EnsembleFit FitResult
Profile RefinedFit Run Screening Markers StressStretch"""
"""Classes of what the package returns, or what a step is made of."""
WITHOUT_ARGUMENTS = "CentreOfMass backend"
BY_THEMSELVES = "register read_columns FitProblem Columns after read_arrays stated_unit"


ROOT = Path(__file__).parents[1]
TOP, FITTING = (
    {name: thing for name in dir(room) if name[0] != "_" and not inspect.ismodule(thing := getattr(room, name))}
    for room in (mpm, mpm.fitting)
)
LISTED = re.findall(r"`([a-z]+)\.(\w+)", (ROOT / "docs" / "features.md").read_text(encoding="utf-8"))
"""Names of sub-packages that the features tell users of."""
IN_ROOMS = {name: getattr(getattr(mpm, room), name) for room, name in LISTED if hasattr(mpm, room)}
PUBLIC = FITTING | IN_ROOMS | TOP


def test_nothing_public_is_left_out_of_these_calls():
    """Abstract classes, enumerations, errors and tuples apart."""
    left = set()
    for name, thing in PUBLIC.items():
        of_a_kind = isinstance(thing, type) and issubclass(thing, (enum.Enum, Exception, tuple))
        if (isinstance(thing, type) or inspect.isfunction(thing)) and not (inspect.isabstract(thing) or of_a_kind):
            left |= set() if thing in CALLS else {name}
    assert left == {*MADE_BY_THE_PACKAGE.split(), *WITHOUT_ARGUMENTS.split(), *BY_THEMSELVES.split()}


def test_each_public_name_is_exposed_once():
    """At the top level or in a sub-package, which has no other thing of that name."""
    assert not [name for name, thing in FITTING.items() if TOP.get(name, thing) is not thing]
    assert not TOP.keys() & IN_ROOMS.keys()
    assert len({id(thing) for thing in PUBLIC.values()}) == len(PUBLIC)
    assert len(TOP) <= 90


def test_each_public_name_is_called_in_one_way():
    """By the tests, examples, benchmarks and documents: what is at the top level is not fetched from below."""
    below = re.compile(rf"\bmpm(?:jax)?\.[a-z]+\.(?:{'|'.join(TOP)})\b(?!\.py)")
    folders = ("mpmjax", "tests", "examples", "benchmarks", "docs")
    paths = [p for kind in ("*.py", "*.md") for folder in folders for p in (ROOT / folder).rglob(kind)]
    texts = {path: path.read_text(encoding="utf-8") for path in [ROOT / "README.md", *paths]}
    assert not {path: calls for path, text in texts.items() if (calls := below.findall(text))}


@pytest.fixture
def as_for_users():
    """Without the type checks of the tests."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


CHOICES = {
    "a name": (
        lambda: mpm.Scene(SCENE.grid, SCENE.material, description="TotalLagrangian"),
        r"Scene's description must be one of TotalLagrangian, UpdatedLagrangian, got 'TotalLagrangian', "
        r"did you mean TotalLagrangian\(\)\?",
    ),
    "a class": (
        lambda: mpm.Scene(SCENE.grid, SCENE.material, transfer=mpm.FLIP),
        r"transfer must be one of .*APIC, FLIP, PIC.*, got the class FLIP, did you mean FLIP\(\)\?",
    ),
    "a class with arguments": (
        lambda: mpm.StickyCollider(mpm.Ball),
        r"shape must be one of .*Annulus, Ball, .*, got the class Ball, did you mean Ball\(\.\.\.\)\?",
    ),
    "part of a name": (lambda: mpm.SemiImplicit(hessian="jvp"), r"did you mean JvpHessian\(\)\?"),
    "of an enumeration": (lambda: mpm.SemiImplicit(guess="explicit"), r"did you mean Guess\.EXPLICIT\?"),
    "of a preconditioner": (
        lambda: mpm.SemiImplicit(preconditioner="diagonal"),
        r"did you mean DiagonalPreconditioner\(\)\?",
    ),
    "a method": (
        lambda: mpm.simulate(**RUN, method="explicit"),
        r"simulate's method must be one of BackwardEuler, .*Explicit, .*, got 'explicit', did you mean Explicit\(\)\?",
    ),
    "of stable_dt": (lambda: mpm.stable_dt(SCENE, PARTICLES, method="fast"), r"stable_dt's method must be one of"),
    "past the constructor": (
        lambda: mpm.prepare(eqx.tree_at(lambda s: s.gradient, SCENE, "mls"), PARTICLES),
        r"Scene's gradient must be one of .*MLSGradient, SplineGradient.*, got 'mls', did you mean MLSGradient\(\)\?",
    ),
    "one of several": (lambda: mpm.join(PARTICLES, "more"), r"join's sets must be Particles, got 'more'"),
    "a list for each particle": (lambda: mpm.NeoHookean([1e5, 2e5], 0.3), r"must be a number or an array of numbers"),
    "a switch": (lambda: mpm.BSpline(True), r"BSpline's order must be a whole number, got True"),
}


@pytest.mark.usefixtures("as_for_users")
@pytest.mark.parametrize(("make", "message"), CHOICES.values(), ids=CHOICES)
def test_a_wrong_choice_is_told_what_there_is(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_choices_of_ones_own_are_taken():
    """Whatever is derived from a class of the package's."""

    class Wood(mpm.NeoHookean):
        grain: float = 0.1

    class Hurried(mpm.Explicit):
        pass

    scene = mpm.Scene(SCENE.grid, Wood(1e4, 0.3))
    assert 0 < mpm.stable_dt(scene, PARTICLES, method=Hurried()) < 1
