"""What modules require of their values: of what is known a ValueError, of what is traced a named fault."""

import dataclasses
import pickle
import re
import traceback
from typing import Annotated

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ELASTIC, FLUIDS, METHODS, PLASTIC, RUBBER, SECOND_ORDER, VISCOUS, block, ids

import mpmjax as mpm
from mpmjax._tables import within
from mpmjax.checks import between, checked, finite, positive, require_fields, whole
from mpmjax.checks._values import canonical, first_unmet, requirements
from mpmjax.material._fluid import Tait

MOTION = mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.1)))
TURN = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.1)), (0.0, 1.0), (0.2, 0.2))
BALL = mpm.Ball((0.2, 0.2), 0.1)
MODULES = {
    **(ELASTIC | RUBBER | PLASTIC | FLUIDS | VISCOUS),
    **(METHODS | SECOND_ORDER),
    "tait": Tait(1e4),
    "tolerances": mpm.BackwardEuler(mpm.implicit.Newton(mpm.implicit.ConjugateResidual(1e-3, 1e-6), 1e-8)),
    "flip": mpm.FLIP(0.9),
    "grid": mpm.Grid((8, 8), 0.1),
    "symmetry plane": mpm.SymmetryPlane(0, 0.1),
    "clamp plane": mpm.ClampPlane(0, 0.1, motion=TURN),
    "contact plane": mpm.ContactPlane(0, 0.1, friction=0.3),
    "sticky box": mpm.StickyBox((0.0, 0.0), (1.0, 1.0)),
    "slip box": mpm.SlipBox((0.0, 0.0), (1.0, 1.0)),
    "separating box": mpm.SeparatingBox((0.0, 0.0), (1.0, 1.0), 0.3),
    "grip": mpm.Grip(mpm.Box((0.0, 0.0), (1.0, 1.0)), MOTION),
    "sticky collider": mpm.StickyCollider(mpm.geometry.Capsule((0.0, 0.0), (1.0, 0.0), 0.1), TURN),
    "slip collider": mpm.SlipCollider(mpm.HalfSpace((0.0, 0.0), (0.0, 1.0))),
    "separating collider": mpm.SeparatingCollider(BALL, TURN, 0.3),
    "particles": block(2, side=2)[1],
}
"""One of each module with numbers that it asks something of."""


def spoiled(module):
    """The module with one of its numbers, each in turn, not a number; and the place."""
    leaves, structure = jax.tree.flatten(canonical(module, jnp.float64))
    for i, (path, _) in enumerate(jax.tree_util.tree_leaves_with_path(module)):
        wrong = [jnp.full_like(leaf, jnp.nan) if i == k else leaf for k, leaf in enumerate(leaves)]
        yield jax.tree_util.keystr(path), jax.tree.unflatten(structure, wrong)


@pytest.mark.parametrize("module", **ids(MODULES))
def test_every_number_is_checked_whether_it_is_known_or_traced(module):
    """What is not a number is refused where it is known, and found by the same statement where it is traced."""
    assert requirements(module) == []
    arrays, static = eqx.partition(canonical(module, jnp.float64), eqx.is_array)
    names: list[str] = []

    def unmet(arrays):
        required = requirements(eqx.combine(arrays, static))
        names[:] = [requirement.message for requirement in required]
        return first_unmet(required)

    found = jax.jit(unmet)
    if not jax.tree.leaves(arrays):
        assert requirements(static) == []
        return
    assert int(found(arrays)) == 0
    for place, wrong in spoiled(module):
        if isinstance(module, mpm.Particles) and place not in (".mass", ".volume"):
            continue  # the state, which a run's own faults are about
        with pytest.raises(ValueError, match="must") as caught:
            requirements(wrong)
        told = names[int(found(eqx.filter(wrong, eqx.is_array))) - 1]
        assert told.removesuffix(".") in str(caught.value), place


LIMITS = [
    (mpm.NeoHookean(1e4, 0.3), lambda m: m.poisson_ratio, 0.5, "poisson_ratio must be strictly between -1 and 0.5"),
    (mpm.NeoHookean(1e4, 0.3), lambda m: m.youngs_modulus, -1.0, "youngs_modulus .* must be greater than zero"),
    (mpm.TRBDF2(), lambda m: m.rho, 1.1, "rho must be from 0 to 1"),
    (mpm.SemiImplicit(), lambda m: m.beta, -0.1, "beta must be from 0 to 1"),
    (mpm.ContactPlane(0, 0.0, friction=0.1), lambda m: m.friction, -0.1, "friction must be from 0"),
    (MODULES["particles"], lambda m: m.mass, jnp.array([1.0, -1.0, 1.0, 1.0] * 4), "masses .* must be greater"),
    (MOTION, lambda m: m.times, (1.0, 0.0), "times must increase"),
    (MODULES["slip box"], lambda m: m.lower, (2.0, 0.0), "lower corner must lie below"),
]


@pytest.mark.parametrize(("module", "where", "value", "words"), LIMITS)
def test_a_value_past_its_limit_is_found_known_or_traced(module, where, value, words):
    """Put there by `equinox.tree_at`, which no constructor sees."""
    wrong = canonical(eqx.tree_at(where, module, value), jnp.float64)
    with pytest.raises(ValueError, match=words):
        requirements(wrong)
    with pytest.raises(ValueError, match=words):  # the constructor's words are the same
        dataclasses.replace(wrong)
    arrays, static = eqx.partition(wrong, eqx.is_array)
    required = []

    def unmet(arrays):
        required[:] = requirements(eqx.combine(arrays, static))
        return first_unmet(required)

    assert re.search(words, required[int(jax.jit(unmet)(arrays)) - 1].message)


def test_what_tree_at_spoils_is_refused_by_every_entry():
    """Before anything is compiled."""
    scene, particles = block(1, side=2)
    soft = eqx.tree_at(lambda s: s.material.poisson_ratio, scene, 0.6)
    massless = eqx.tree_at(lambda p: p.mass, particles, 0 * particles.mass)
    for options in ((soft, particles), (scene, massless)):
        with pytest.raises(ValueError, match="must be"):
            mpm.simulate(*options, t1=0.1, dt=0.1)
        with pytest.raises(ValueError, match="must be"):
            mpm.rollout(*options, steps=1, dt=0.1)
    method = eqx.tree_at(lambda m: m.beta, mpm.SemiImplicit(), np.nan)
    for run in (mpm.simulate, lambda *inputs, t1, **rest: mpm.rollout(*inputs, steps=1, **rest)):
        with pytest.raises(ValueError, match="beta must be"):
            run(scene, particles, t1=0.1, dt=0.1, method=method)


@pytest.mark.parametrize("method", **ids(METHODS, "semi_implicit"))
def test_ranks_may_differ_inside_whatever_is_set_outside(method):
    """Where jax's own arrays must not: in a run and its derivative."""
    scene, particles = block(1)

    def reached(modulus):
        soft = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, modulus)
        return (mpm.rollout(soft, particles, steps=1, dt=1e-3, method=method).x ** 2).sum()

    def both():
        return jax.jit(jax.value_and_grad(reached))(1e4)

    with jax.numpy_rank_promotion("raise"):
        found = both()
        with pytest.raises(ValueError, match="rank_promotion"):
            jnp.ones((2, 3)) + jnp.ones(3)
    np.testing.assert_allclose(found, both(), rtol=1e-13)


SENSELESS = {
    "shares": (lambda: mpm.PointsAt(((0.1, 0.1),) * 3, (1.0, 1.0, 1.0)), "shares of the load and must sum to one"),
    "a prior": (
        lambda: mpm.Positive(lambda e: e.dt, prior=mpm.fitting.Gaussian(-1.0, 2.0)),
        "mean of its prior must too",
    ),
    "one of a bounded": (
        lambda: mpm.Bounded(lambda e: e.dt, 0.0, 0.5, prior=mpm.fitting.Gaussian([0.1, 0.6], 1.0)),
        "between 0 and 0.5, so the mean",
    ),
}


@pytest.mark.parametrize(("make", "says"), SENSELESS.values(), ids=SENSELESS)
def test_what_has_no_sense_is_refused(make, says):
    with pytest.raises(ValueError, match=says):
        make()


def test_a_hidden_measurement_is_none():
    """A masked array keeps its mask, which NumPy drops where it converts one."""
    seen = mpm.Series([0.1, 0.2], np.ma.masked_array([1.0, 99.0], [False, True]), lambda scene, particles: particles.x)
    np.testing.assert_array_equal(seen.data, [1.0, np.nan])


def test_loads_are_attached_within_a_transformation():
    """To particles that are known there; where they are not, the reason is told."""
    load = mpm.Traction(mpm.Patch(mpm.Box((0.0, 0.0), (0.3, 0.3)), mpm.Box((0.0, 0.29), (0.3, 0.31))), (0.0, 1.0))
    scene, particles = block(2, loads=load)

    def areas(factor, particles=particles):
        return factor * mpm.attach(scene, particles).loads[0].on.weight

    np.testing.assert_array_equal(jax.jit(areas)(2.0), areas(2.0))
    np.testing.assert_array_equal(jax.jit(jax.grad(lambda f: areas(f).sum()))(2.0), areas(1.0).sum())
    for where in (lambda q: q.x, lambda q: q.volume):
        with pytest.raises(ValueError, match="call attach outside"):
            jax.jit(lambda a, where=where: areas(1.0, eqx.tree_at(where, particles, a)))(where(particles))


def test_nearly_incompressible_material_is_told_of_averaged_volumes():
    for volume, told in ((None, True), (mpm.AveragedVolume(), False)):
        scene, particles = block(1, material=mpm.NeoHookean(1e4, 0.499), volume=volume)
        fast = eqx.tree_at(lambda q: q.v, particles, -30 * particles.x)
        with pytest.raises(mpm.SimulationError) as caught:
            mpm.simulate(scene, fast, t1=0.1, dt=0.1)
        assert ("give the scene volume=AveragedVolume()" in str(caught.value)) == told


def test_what_lies_beyond_a_plane_is_told_of_the_plane():
    """And not to enlarge the grid, as it starts and on the way."""
    plane = mpm.SymmetryPlane(0, 0.0)
    scene, particles = block(1, boundary=plane)
    moved = eqx.tree_at(lambda q: q.x, particles, particles.x - 0.5)
    with pytest.raises(ValueError, match="must lie above the SymmetryPlane"):
        mpm.prepare(scene, moved)
    thrown = eqx.tree_at(lambda q: q.v, particles, jnp.full(particles.v.shape, -1e3))
    with pytest.raises(mpm.SimulationError, match=r"passed boundary 0, SymmetryPlane.* [Rr]educe dt"):
        mpm.simulate(scene, thrown, t1=1e-3, dt=1e-3)


@pytest.mark.parametrize("names", [("a", "a"), ("a", "b")])
def test_names_of_materials_are_one_for_each(names):
    with pytest.raises(ValueError, match="one for each of the scene's 1 materials and differ"):
        mpm.Scene(mpm.Grid((8, 8), 0.1), mpm.NeoHookean(1e4, 0.3), names=names)


class Marked(eqx.Module):
    """Fields with each mark, alone, in a union and on a tuple."""

    modulus: Annotated[float | jax.Array, positive, "Pa"] = 1.0
    share: Annotated[float, between(0, 1, open_ends=True)] | None = None
    count: Annotated[int, whole(2)] = eqx.field(static=True, default=2)
    terms: Annotated[tuple[float, ...], finite] = ()
    __check_init__ = require_fields


@checked
def marked(*, modulus: Annotated[float, positive, "Pa"] = 1.0, share: Annotated[float, between(0, 1)] | None = None):
    """Arguments with marks."""
    return modulus, share


@pytest.mark.parametrize(
    ("make", "values", "says"),
    [
        (Marked, {"modulus": 0.0}, "Marked's modulus [Pa] must be greater than zero, got 0.0."),
        (Marked, {"modulus": "stiff"}, "Marked's modulus must be a number, got 'stiff'."),
        (Marked, {"share": 1.0}, "Marked's share must be strictly between 0 and 1, got 1.0."),
        (Marked, {"count": 1}, "Marked's count must be a whole number of at least 2, got 1."),
        (Marked, {"terms": (1.0, np.inf)}, "Marked's terms must be finite, got (1.0, inf)."),
        (marked, {"modulus": -1.0}, "marked's modulus [Pa] must be greater than zero, got -1.0."),
        (marked, {"share": 1.5}, "marked's share must be from 0 to 1, got 1.5."),
    ],
)
def test_annotations_say_what_must_hold_of_values(make, values, says):
    """Of fields and of arguments, known or not yet; None is not looked at."""
    make(share=None)
    with pytest.raises(ValueError, match=f"^{re.escape(says)}$"):
        make(**values)


@pytest.mark.parametrize(
    "mark",
    [positive, between(0, 1), between(-1, 1, open_ends=True), between(4, np.inf), whole(2)],
    ids=str,
)
def test_the_bounds_of_a_mark_are_what_it_checks(mark):
    """By those a scene file is refused before the class is imported."""
    for value in (-2, -1, 0, 1, 2, 3, 4, 10**9):
        try:
            mark("It", value)
        except ValueError:
            assert not within(value, mark.bounds)
        else:
            assert within(value, mark.bounds)


@pytest.mark.parametrize(("args", "values"), [((2.0,), {}), ((), {"shear": 2.0})])
def test_a_call_that_does_not_fit_names_the_function_and_what_it_takes(args, values):
    with pytest.raises(TypeError, match=r"^marked takes modulus, share: "):
        marked(*args, **values)


def test_a_mark_on_a_traced_field_is_put_off():
    """Until a compiled program can evaluate it."""

    @jax.jit
    def unmet(modulus):
        return first_unmet(requirements(Marked(modulus)))

    assert [int(unmet(modulus)) for modulus in (1.0, -1.0, jnp.nan)] == [0, 2, 1]


@pytest.mark.parametrize("bad", [{"dt": -1e-3}, {"dt": "long"}], ids=["value", "kind"])
def test_a_refusal_within_jit_ends_with_its_own_line(bad):
    """Not with JAX's note on its frames; whatever else is noted of it stays, and it passes between processes."""
    scene = mpm.Scene(mpm.Grid((8,), 0.1), mpm.NeoHookean(1e5, 0.3))
    particles = mpm.fill(mpm.Box((0.2,), (0.4,)), scene.grid, density=1.0)
    step = jax.jit(lambda p: mpm.step(scene, mpm.prepare(scene, p), **{"t": 0.0, "method": mpm.Explicit()} | bad))
    with pytest.raises(ValueError, match=r"got .*\.$|got 'long'") as refused:
        step(particles)
    assert traceback.format_exception(refused.value)[-1].endswith(f"InputError: {refused.value}\n")
    refused.value.add_note("of the tenth run")
    assert refused.value.__notes__ == ["of the tenth run"]
    assert str(pickle.loads(pickle.dumps(refused.value))) == str(refused.value)
