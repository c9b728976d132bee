"""Warnings of what is no error and most likely not meant, and none of what is well."""

import dataclasses
import re
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, PLASTIC, block, thorough
from shell import refused, shell
from test_cli import SCENE

import mpmjax as mpm
from mpmjax.cli._scene_file import read_scene_file
from mpmjax.state import warn_of_crowding

TOTAL = {"description": mpm.TotalLagrangian()}
FAR, HALF, NEAR = mpm.Ball((0.9, 0.9), 0.05), mpm.Ball((0.15, 0.3), 0.12), mpm.Box((-1.0, -1.0), (1.0, 0.0))
BETWEEN = mpm.Ball((0.65, 0.15), 0.04)
STAY, GO = mpm.Motion((0.0,), ((0.0, 0.0),)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (-1.0, 0.0)))
TURN = mpm.RigidMotion((0.0, 1.0), ((0.0, 0.0),) * 2, (0.0, 1.0), (0.0, 0.0))
EDGE = mpm.Box((-0.25, -0.25), (-0.2, -0.2))
"""In the window's first cell, beyond what the block's stencils reach."""
DOUBTFUL = {
    "a wall over the body": ({"boundary": mpm.SlipBox((0.1, -np.inf), (np.inf, np.inf))}, "12 of 36 .* SlipBox"),
    "one of a second box": (
        {"boundary": (mpm.StickyBox((-1.0, 0.0), (1.0, 1.0)), mpm.SeparatingBox((-1.0, -1.0), (1.0, 0.25)))},
        r"6 of 36 .* SeparatingBox \(boundary 2\)",
    ),
    "a sticky collider over the body": ({"boundary": mpm.StickyCollider(HALF)}, "of 36 particles .* StickyCollider"),
    "a floor that is too high": (
        {"boundary": mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.1), (0.0, 1.0)))},
        "12 of 36 .* SeparatingCollider",
    ),
    "a grip beside the body": (
        {"boundary": mpm.Grip(FAR, STAY)},
        "Grip .* touches nothing, since no node that a particle reaches",
    ),
    "a moving one in the total description": ({"boundary": mpm.Grip(EDGE, GO)} | TOTAL, "Grip .* touches nothing"),
    "a collider there": ({"boundary": mpm.StickyCollider(FAR, TURN)} | TOTAL, "StickyCollider .* touches nothing"),
    "a grip that never comes": ({"boundary": mpm.Grip(FAR, GO)}, "Grip .* never comes into the grid's window"),
    "a plane far away": ({"boundary": mpm.SymmetryPlane(0, -50.0)}, "SymmetryPlane .* never comes"),
    "walls far away": ({"boundary": mpm.SlipBox((-9.0, -9.0), (9.0, 9.0))}, "SlipBox .* never comes"),
    "a collider between nodes": ({"boundary": mpm.SlipCollider(BETWEEN)}, "no node of the window lies in it"),
}
WELL = {
    "walls around": {"boundary": mpm.StickyBox((0.0, 0.0), (1.0, 1.0))},
    "walls that come": {
        "boundary": mpm.SlipBox((-9.0, -9.0), (9.0, 9.0), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (8.9, 0.0))))
    },
    "a grip at the end": {"boundary": mpm.Grip(NEAR, GO)},
    "a grip that comes": {"boundary": mpm.Grip(mpm.Ball((0.9, 0.2), 0.05), GO)},
    "a collider that waits": {"boundary": mpm.StickyCollider(mpm.Box((-1.0, -1.0), (1.0, -0.1)))},
    "one between nodes that comes": {"boundary": mpm.SlipCollider(BETWEEN, GO)},
    "one that turns": {"boundary": mpm.SlipCollider(BETWEEN, TURN)},
    "one that holds in the total description": {"boundary": mpm.StickyCollider(HALF, TURN)} | TOTAL,
}


def meet(**scene: object) -> list[str]:
    """What is said when a block of 3 x 3 cells meets a scene."""
    made, particles = block(2, **scene)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        prepared = mpm.prepare(made, particles)
        mpm.prepare(made, prepared)  # it is said once
    assert all(Path(w.filename) == Path(__file__) for w in said)
    return [str(w.message) for w in said]


@pytest.mark.parametrize(("scene", "says"), DOUBTFUL.values(), ids=DOUBTFUL)
def test_an_oversight_is_told(scene, says):
    (said,) = meet(**scene)
    assert re.search(says, said), said


@pytest.mark.parametrize("scene", WELL.values(), ids=WELL)
def test_of_what_is_well_nothing_is_told(scene):
    assert meet(**scene) == []


@pytest.mark.parametrize(
    ("upper", "lower", "gap", "scene", "told"),
    [
        (1e4, 2e6, 0.0, {}, True),
        (1e4, 2e6, 0.25, {}, False),  # they share no node
        (1e4, 0.9e6, 0.0, {}, False),
        (1e4, 2e6, 0.0, {"bodies": mpm.Bodies()}, False),
        (1e4, 2e6, 0.0, TOTAL | {"kernel": mpm.BSpline(1)}, False),
    ],
)
def test_stiffness_that_jumps_within_a_cell_is_told_of(upper, lower, gap, scene, told):
    grid = mpm.Grid((9, 15), 0.1, origin=(-3, -3))
    boxes = mpm.Box((0.0, 0.3 + gap), (0.3, 0.6 + gap)), mpm.Box((0.0, 0.0), (0.3, 0.3))
    sets = [mpm.fill(box, grid, density=1e3) for box in boxes]
    stiffness = np.repeat([upper, lower], [q.count for q in sets])
    laws = [tuple(mpm.NeoHookean(E, 0.3) for E in (upper, lower))]
    if told:  # one law whose parameters jump
        laws.append(mpm.NeoHookean(jnp.asarray(stiffness), 0.3))
    for law in laws:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mpm.prepare(mpm.Scene(grid, law, **scene), mpm.join(*sets))
        assert [bool(re.search("Near .* moduli differ 2e.02 times", str(w.message))) for w in said] == [True] * told


@pytest.mark.parametrize("d", [2, 3])
def test_a_fluid_that_its_pressure_stirs_is_told_of(d):
    """On a lattice near nodes and knots of the quadratic kernel, in two directions, by moving least squares."""
    grid, fluid = mpm.Grid((12,) * d, 0.1, origin=(-3,) * d), mpm.Fluid(2e5)
    spline, viscous = {"gradient": mpm.SplineGradient()}, mpm.Viscous(fluid, 10.0)
    for at, each, law, options, told in (
        ((0.25,) * d, 2, fluid, {}, True),
        ((0.1, *[0.25] * (d - 1)), 2, fluid, {}, True),
        ((0.1,) * d, 2, fluid, {}, False),
        ((0.25, *[0.0] * (d - 1)), 2, fluid, {}, False),
        ((0.25,) * d, 2, fluid, spline, False),
        ((0.25,) * d, 2, fluid, {"kernel": mpm.BSpline(3)}, False),
        ((0.25,) * d, 2, viscous, {}, False),
        ((0.25,) * d, 2, LAWS["neo_hookean"], {}, False),
        *(((s,) * d, each, fluid, {}, False) for s in (0.0, 0.125, 0.25) for each in (3, 4)),
    ):
        lower = 0.1 * np.asarray(at)
        water = mpm.fill(mpm.Box(lower, lower + 0.4), grid, particles_per_cell=each**d, density=1e3)
        nothing = 0 * water.mass
        absent = dataclasses.replace(water, x=0 * water.x, mass=nothing, volume=nothing)
        water = mpm.join(water, absent, absent)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mpm.prepare(mpm.Scene(grid, law, **options), water)
        assert [bool(re.search("its pressure stirs it", str(w.message))) for w in said] == [True] * told


@pytest.mark.parametrize("d", [2, 3])
def test_a_body_thinner_than_two_cells_is_told_of(d):
    """But not one that fills what lies between walls or planes, or the period."""
    thin = [1.9 * 0.1, *[0.3] * (d - 1)]
    walls = mpm.SlipBox((0.0,) + (-np.inf,) * (d - 1), (0.19,) + (np.inf,) * (d - 1))
    for options, told in (
        ({}, True),
        ({"boundary": walls}, False),
        ({"boundary": mpm.SymmetryPlane(0, 0.0)}, False),
        ({"boundary": mpm.SymmetryPlane(1, 0.0)}, True),
        ({"boundary": mpm.SlipBox((-np.inf,) * d, (0.4,) * d)}, True),
    ):
        grid = mpm.Grid((9,) * d, 0.1, origin=(-3,) * d)
        body = mpm.fill(mpm.Box((0.0,) * d, thin), grid, density=1e3)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mpm.prepare(mpm.Scene(grid, LAWS["neo_hookean"], **options), body)
        assert [bool(re.search("The body is 1.9 cells thick in direction 0", str(w.message))) for w in said] == [
            True
        ] * told


@pytest.mark.parametrize(
    ("dtype", "cells", "told"), [("float32", 4096, True), ("float32", 1024, False), ("float64", 4096, False)]
)
def test_positions_that_round_to_parts_of_a_spacing_are_told_of(dtype, cells, told):
    """Far from zero: at 4096 spacings a float32 step loses 5e-4 of one."""
    grid = mpm.Grid((9, 9), 1 / 32, origin=(cells, -cells))
    x = jnp.asarray(np.random.default_rng(0).uniform(3, 6, (20, 2)) + np.array([cells, -cells]), dtype) / 32
    one = jnp.ones(20, dtype)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        mpm.prepare(mpm.Scene(grid, LAWS["neo_hookean"]), mpm.Particles(x, 0 * x, one, one))
    assert sum("float32 rounds positions" in str(w.message) for w in said) == told


@pytest.mark.thorough
def test_a_run_that_leads_far_from_zero_tells_of_its_rounding():
    """In float32 and a window that follows; once."""
    x = jnp.asarray(np.random.default_rng(0).uniform(3, 6, (20, 2)), jnp.float32)
    one = jnp.ones(20, jnp.float32)
    scene = mpm.Scene(mpm.Grid((9, 9), 1.0, follow=True), LAWS["neo_hookean"])
    particles = mpm.Particles(x, 0 * x + 5e6, one, 0.1 * one)
    with pytest.warns(UserWarning, match="float32 rounds positions .* to 0.0012 spacings"):
        run = mpm.simulate(scene, particles, t1=2e-3, dt=1e-3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mpm.simulate(scene, run.final, t1=3e-3, dt=1e-3, start=2)


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_two_sets_at_one_place_are_told_of(d):
    """However little they overlap, and none of sets that touch, whatever their lattices: round ones in a box's corner,
    coarse beside fine."""
    grid = mpm.Grid((24,) * d, 0.1, origin=(-4,) * d)
    half, whole, law = (0.54,) + (1.0,) * (d - 1), (1.0,) * d, LAWS["neo_hookean"]

    def filled(lower, upper, each):
        return mpm.fill(mpm.Box(lower, upper), grid, density=1e3, particles_per_cell=each**d)

    left, right = filled((0.0,) * d, half, 2), filled((0.54,) + (0.0,) * (d - 1), whole, 3)
    over = filled((0.46,) + (0.0,) * (d - 1), whole, 2)
    ball = mpm.fill(mpm.Ball((0.33,) * d, 0.31), grid, density=1e3)
    for sets, told in (((left, right), False), ((left, over), True), ((ball,), False), ((ball, ball), True)):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            mpm.prepare(mpm.Scene(grid, law), mpm.join(*sets))
        assert [str(w.message) for w in said if "times the space" not in str(w.message)] == []
        assert len(said) == told


@pytest.mark.parametrize("law", ["fluid", "viscous", "neo_hookean", "snow", "cam_clay"])
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_particles_at_half_the_place_that_their_law_knows_of_are_told_of(law, d):
    """And not those whose law knows it, by what is elastic or by what has yielded."""
    law = {"fluid": mpm.Fluid(1e4), "viscous": mpm.Viscous(mpm.Fluid(1e4), 1.0)}.get(law) or (LAWS | PLASTIC)[law]
    scene, particles = block(d, side=4, material=law)
    upright = mpm.prepare(scene, particles)
    (group,) = upright.groups
    half = eqx.tree_at(lambda p: p.x, upright, upright.x.at[:, -1].mul(0.5))
    stored, history = group.stored, group.history
    if isinstance(law, mpm.Snow):
        history = eqx.tree_at(lambda h: h.plastic_volume, history, history.plastic_volume / 2)
    elif isinstance(law, mpm.CamClay):
        history = eqx.tree_at(lambda h: h.volume_strain, history, history.volume_strain - np.log(2))
    else:
        stored = stored / 2 if stored.ndim == 1 else stored.at[:, -1, -1].mul(0.5)
    known = dataclasses.replace(half, deformations=(stored,), histories=(history,))
    for given, told in ((upright, 0), (known, 0), (half, 1)):
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            warn_of_crowding(scene, given)
        assert [
            bool(re.search("At the end particles take up to .* times the space", str(w.message))) for w in said
        ] == [True] * told


def test_a_run_that_ends_with_water_in_its_lowest_layer_tells_of_it():
    """2.3 times what fits there, at full volume; and nothing of one that ends as it should."""
    scene, particles = block(2, side=8, material=mpm.Fluid(1e4), boundary=mpm.SlipBox((0.0, 0.0), (0.8, np.inf)))
    y = particles.x[:, 1]
    fallen = eqx.tree_at(lambda p: p.x, particles, particles.x.at[:, 1].set(jnp.maximum(y - 0.13, 0.1 * y / 0.23)))
    mpm.simulate(scene, particles, t1=1e-4, dt=1e-4)
    with pytest.warns(UserWarning, match="At the end particles take up to 1.* times the space .* ContactPlane"):
        mpm.simulate(scene, fallen, t1=1e-4, dt=1e-4)


def test_a_tolerance_that_anything_meets_is_told_of():
    for make in (mpm.implicit.ConjugateResidual, lambda rtol: mpm.implicit.Newton(rtol=rtol)):
        with pytest.warns(UserWarning, match=r"rtol is 10\.0: at 1 or more the zero vector already meets it"):
            make(10.0)


def test_nothing_is_told_under_transformations():
    """Where nothing is known yet; and the check of placement is not compiled anew for other numbers."""
    scene, particles = block(2, boundary=mpm.SlipBox((0.1, -np.inf), (np.inf, np.inf)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jax.eval_shape(lambda x: mpm.prepare(scene, eqx.tree_at(lambda p: p.x, particles, x)).x, jnp.zeros((36, 2)))


def test_the_shell_prints_a_warning_in_a_line(tmp_path):
    """Overlapping tables are one; what is refused afterwards still has one line of its own."""
    twice = SCENE[SCENE.index("[[particles]]") : SCENE.index("[output]")]
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.replace("[run]", f"{twice}[run]").replace("[-0.2, 0.0]", "[-0.2, 0.25]"))
    with pytest.warns(
        UserWarning, match=r"36 particles of \[\[particles\]\] 2 lie in the region of \[\[particles\]\] 1"
    ):
        read_scene_file(scene)
    scene.write_text(f"{scene.read_text()}[fit]\n")
    assert "needs an [[fit.observation]]" in refused("fit", scene)
    told = [line for line in shell("fit", scene)[2].splitlines() if "warning" in line]
    assert [line.split(" particles")[0] for line in told] == ["warning: 36", "warning: 36 of 72"]
