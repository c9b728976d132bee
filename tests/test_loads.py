"""Loads: their forces and moments are what was asked for, in every description; springs and dashpots are exact in every
solve; all have derivatives."""

import dataclasses
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, GRADIENTS, TRANSFERS, assert_close, block, explicit_limit, ids, thorough
from test_boundary_forces import METHODS, angular_momentum, axial, shaken

import mpmjax as mpm
from mpmjax.boundary import constrain
from mpmjax.cli._scene_file import read_scene_file
from mpmjax.geometry import Complement, Cylinder, Intersection, Placed, Union, surface_pieces
from mpmjax.io._schema import decode, encode
from mpmjax.stepping import start_nodes

SIDE = 0.3
EACH_DIM = pytest.mark.parametrize("d", [2, *thorough(3)])


def face(axis, d):
    """The far side of the block across an axis."""
    lower, upper = [0.0] * d, [SIDE] * d
    lower[axis], upper[axis] = 0.29, 1.0
    return mpm.Patch(mpm.Box((0.0,) * d, (SIDE,) * d), mpm.Box(tuple(lower), tuple(upper)))


def ramp(d):
    """A traction that grows in direction 0."""
    return mpm.TimeSeries((0.0, 1.0), ((1e3, -2e3, 3e3)[:d], (5e5, -2e3, 3e3)[:d]))


TOP, RIGHT, RAMP = face(1, 2), face(0, 2), ramp(2)
AT = {2: ((0.1, 0.1), (0.2, 0.15)), 3: ((0.1, 0.1, 0.05), (0.2, 0.15, 0.2))}
"""Two points of the block, on a line."""


def loaded(*loads, d=2, **scene):
    """A block with loads on it, at rest."""
    scene, particles = block(d, loads=loads, **scene)
    return mpm.attach(scene, particles), mpm.prepare(mpm.attach(scene, particles), particles)


def gained(scene, particles, method, dt):
    """The change of momentum and of angular momentum in a step, over its length."""
    after, _ = mpm.step(scene, particles, 0.0, dt, method=method)
    mass = np.asarray(particles.mass)
    turn = angular_momentum(scene, after) - angular_momentum(scene, particles)
    return mass @ np.asarray(after.v - particles.v) / dt, turn / dt


@pytest.mark.parametrize(
    ("region", "area", "volume"),
    [
        (mpm.Box((0.0, 0.0), (1.0, 0.5)), 3.0, 0.5),
        (mpm.Ball((0.02, 0.01), 1.0), 2 * np.pi, np.pi),
        (mpm.Box((0.0, 0.0, 0.0), (1.0, 0.5, 0.25)), 1.75, 0.125),
        (mpm.Ball((0.02, 0.01, 0.0), 1.0), 4 * np.pi, 4 / 3 * np.pi),
        (mpm.Box((0.0,), (1.0,)), 2.0, 1.0),
        (mpm.Box((0.013,), (0.871,)), 2.0, 0.858),
        (mpm.Box((0.013, -0.02), (0.871, 0.03)), 1.816, 0.0429),
        (mpm.Box((0.013, 0.1, -0.02), (0.871, 0.4, 0.03)), 0.6306, 0.01287),
        (mpm.geometry.Annulus((0.02, 0.01), 0.8, 1.0), 3.6 * np.pi, 0.36 * np.pi),
        (
            mpm.geometry.Cylinder((0.02, 0.01, 0.0), (0.72, 0.61, 0.4), 1.0),
            2 * np.pi * (1 + 1.01**0.5),
            np.pi * 1.01**0.5,
        ),
    ],
)
def test_surfaces_are_closed_and_have_their_area(region, area, volume):
    """Σ a = 0; Σ |a| is the area and Σ x·a d times the volume, of boxes on any lattice to rounding, of what is round to
    second order."""
    errors = []
    for spacing in (1 / 4, 1 / 8):
        found = surface_pieces(region, spacing)
        middle, areas = found.middle, found.area
        assert np.abs(areas.sum(axis=0)).max() < (1e-12 if not isinstance(region, Cylinder) else 1e-2)
        found = np.sqrt((areas**2).sum(axis=1)).sum() / area, (middle * areas).sum() / region.dim / volume
        errors.append(np.abs(np.array(found) - 1))
    if isinstance(region, mpm.Box):
        assert np.max(errors) < 1e-13
    else:
        assert (errors[1] < 1e-2).all()
        assert (np.log2(errors[0] / errors[1]) > 1.8).all()


def without(body, hole):
    return Intersection((body, Complement(hole)))


PLATE, DISK, HALF = mpm.Box((-0.4, -0.3), (0.4, 0.3)), mpm.Ball((0.33, 0.017), 0.2), np.arccos(0.07 / 0.2)
DISKS = mpm.Ball((0.013, 0.021), 0.3), mpm.Ball((0.293, 0.231), 0.25)  # 0.35 m apart, as the balls are
BALLS = mpm.Ball((0.01, 0.02, 0.03), 0.3), mpm.Ball((0.22, 0.188, 0.254), 0.25)
LARGE, SMALL = (np.arccos((0.35**2 + sign * 0.0275) / (0.7 * radius)) for sign, radius in ((1, 0.3), (-1, 0.25)))
CAPS = 2 * np.pi * 0.09 * (1 - np.cos(LARGE)), 2 * np.pi * 0.0625 * (1 - np.cos(SMALL))
NOTCHED = 2.8 - 0.4 * np.sin(HALF) + 0.4 * (np.pi - HALF)
ROD, NEXT = (Cylinder((0.01, 0.02, z), (0.01, 0.02, z + 0.3), 0.2) for z in (0.0, 0.2))
BOXES = mpm.Box((-0.41, -0.3), (0.11, 0.07)), mpm.Box((-0.05, -0.3), (0.4, 0.31)), mpm.Box((0.4, -0.1), (0.5, 0.1))
HOLES, CORNER = Union((DISK, mpm.Ball((-0.1, 0.02), 0.13))), mpm.Box((-0.45, 0.1), (-0.3, 0.42))


@pytest.mark.parametrize(
    ("region", "area", "error"),
    [
        (Union(BOXES), 3.04, 0.0),
        (Union(DISKS), 0.6 * (np.pi - LARGE) + 0.5 * (np.pi - SMALL), 0.6),
        (Union((DISK, DISK)), 0.4 * np.pi, 0.8),
        (Placed(without(PLATE, DISK), rotation=0.4, displacement=(0.03, 0.02)), NOTCHED, 0.6),
        (Union((without(PLATE, HOLES), CORNER)), NOTCHED + 0.26 * np.pi + 0.34, 0.6),
        *thorough(
            (Union((PLATE, DISK)), 2.8 + 0.4 * (HALF - np.sin(HALF)), 0.6),
            (Union(BALLS), 0.61 * np.pi - sum(CAPS), 2.0),
            (without(*BALLS), 0.36 * np.pi - CAPS[0] + CAPS[1], 2.0),
            (without(mpm.Box((-0.4, -0.3, 0.03), (0.4, 0.3, 0.23)), ROD), 1.52, 2.0),
            (Union((ROD, mpm.Ball((0.01, 0.02, 0.3), 0.2))), 0.24 * np.pi, 2.0),
            (Union((ROD, NEXT)), 0.28 * np.pi, 2.0),
        ),
    ],
)
def test_what_is_composed_has_the_surface_of_its_parts_to_second_order(region, area, error):
    """Also at edges that are not convex, where parts continue each other and where they lie on each other; of boxes to
    rounding. The error is in parts of the area, over the spacing squared [1/m²]."""
    for spacing in (1 / 20, 1 / 40, *([1 / 80] if region.dim == 2 else [])):
        pieces = surface_pieces(region, spacing)
        assert abs(pieces.size.sum() / area - 1) < error * spacing**2 + 1e-12


@pytest.mark.parametrize(
    ("d", "dx"), [(1, 0.04), (2, 0.05), (2, 0.04), (2, 1 / 24), (3, 0.04), *thorough((3, 0.05), (3, 1 / 24), (3, 0.03))]
)
def test_a_patch_has_its_area_and_first_moments(d, dx):
    """On any grid: the end of a bar, without the sides, which lie on the boundary of what names it, and a part of its
    top; a round patch to second order."""
    body, grid = mpm.Box((0.0,) * d, (0.5, 0.2, 0.2)[:d]), mpm.Grid((30,) * d, dx, origin=(-6,) * d)
    particles = mpm.fill(body, grid, density=1e3)
    end = mpm.Patch(body, mpm.Box((0.49, 0.0, 0.0)[:d], (0.6, 0.2, 0.2)[:d])).attached(particles)
    area, middle = 0.2 ** (d - 1), np.array((0.5, 0.1, 0.1))[:d]
    parts = [(end, area, middle, 1e-12)]
    if d > 1:
        box = mpm.Box((0.111, 0.1, 0.03)[:d], (0.377, 1.0, 0.17)[:d])
        top = mpm.Patch(body, box).attached(particles)
        parts.append((top, 0.266 * 0.14 ** (d - 2), np.array((0.244, 0.2, 0.1))[:d], 1e-12))
    if d == 3:
        ball = mpm.Patch(body, mpm.Ball((0.241, 0.2, 0.1), 0.08)).attached(particles)
        parts.append((ball, np.pi * 0.08**2, np.array((0.241, 0.2, 0.1)), dx**2 / 16 / 0.08**2))
    for found, area, middle, error in parts:
        np.testing.assert_allclose(np.asarray(found.weight).sum(), area, rtol=error)
        np.testing.assert_allclose(found.weight @ found.place, area * middle, rtol=0, atol=error * area)
        np.testing.assert_allclose(np.abs(np.asarray(found.area).sum(axis=0)).max(), area, rtol=error)


def test_a_patch_that_is_not_what_was_meant_is_named():
    """One narrower than two particles; one that leaves most of what lies in it out, or all."""
    body = mpm.Box((0.0, 0.0), (0.5, 0.2))
    particles = mpm.fill(body, mpm.Grid((30, 30), 0.05, origin=(-6, -6)), density=1e3)
    for lower, says in (((0.4, 0.17), "less than two particles"), ((0.2, 0.0), "lie on its boundary and do not count")):
        with pytest.warns(UserWarning, match=says):
            mpm.Patch(body, mpm.Box(lower, (0.6, 0.2))).attached(particles)
    with pytest.raises(ValueError, match="or only on the boundary of `within`"):
        mpm.Patch(body, mpm.Box((0.2, 0.0), (0.5, 0.2))).attached(particles)


@EACH_DIM
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_loads_have_the_force_and_moment_that_was_asked_for(description, d):
    """Of a traction, a pressure, a force at a point beside the particles' lattice or along a line: the change of
    momentum, linear and angular, of a free body, to rounding."""
    gradient = mpm.MLSGradient()  # of which w + g·r has the right moment
    traction, total, point = ((3e3, -2e3, 1e3)[:d], (50.0, 20.0, -30.0)[:d], (0.13, 0.07, 0.19)[:d])
    middle, area = np.full(d, SIDE / 2), SIDE ** (d - 1)
    top, right = middle.copy(), middle.copy()
    top[1] = right[0] = SIDE
    for load, force, place in (
        (mpm.Traction(face(1, d), traction), area * np.array(traction), top),
        (mpm.Pressure(face(0, d), 4e3), area * np.array((-4e3, 0.0, 0.0)[:d]), right),
        (mpm.PointLoad(mpm.PointsAt((point,)), total), np.array(total), point),
        (mpm.PointLoad(mpm.PointsAt(AT[d]), total), np.array(total), np.mean(AT[d], axis=0)),
    ):
        scene, particles = loaded(load, d=d, description=description, gradient=gradient)
        found = gained(scene, particles, mpm.Explicit(), 1e-5)
        assert_close(found[0], force, 1e-9)
        assert_close(found[1], axial(np.outer(force, place)), 1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize("gradient", [mpm.MLSGradient(), mpm.SplineGradient()])
def test_the_stress_next_to_a_pulled_end_is_that_of_the_bar(gradient):
    """Within 4.5 % at rest, wherever the end lies in a cell: by the particles at the end alone it is up to 50 % off."""
    settings = {"description": mpm.TotalLagrangian(), "gradient": gradient, "boundary": mpm.SymmetryPlane(0, 0.0)}
    grid = mpm.Grid((17,), 0.1, origin=(-3,))
    for length in (0.8, 0.83, 0.86, 0.89):
        body = mpm.Box((0.0,), (length,))
        load = mpm.Traction(mpm.Patch(body, mpm.Box((0.5,), (1.0,))), (1.0,))
        particles = mpm.fill(body, grid, particles_per_cell=2, density=1e3)
        scene = mpm.Scene(grid, mpm.FixedCorotated(1e5, 0.0), loads=load, **settings)
        scene = mpm.attach(scene, particles)
        rest, _ = mpm.step(scene, mpm.prepare(scene, particles), 0.0, 1e4, method=mpm.SemiImplicit())
        np.testing.assert_allclose(mpm.stress(scene, rest)[:, 0, 0], 1, rtol=0, atol=0.045)


@pytest.mark.thorough
@pytest.mark.parametrize("description", DESCRIPTIONS.values(), ids=DESCRIPTIONS)
def test_loads_in_three_dimensions(description):
    """Of a nearly incompressible ball: a pressure all over it has no force and, to second order, no moment; a traction
    on the part of its surface above a plane has the force of that area."""
    ball, grid = mpm.Ball((0.31, 0.3, 0.32), 0.22), mpm.Grid((13,) * 3, 0.1, origin=(-3,) * 3)
    particles = mpm.fill(ball, grid, particles_per_cell=8, density=1e3)
    material, settings = mpm.NeoHookean(1e4, 0.49), {"description": description, "gradient": mpm.MLSGradient()}
    cap = mpm.Patch(ball, mpm.Box((-1.0, -1.0, 0.42), (1.0, 1.0, 1.0)), 0.02)  # of height 0.12
    for load, force in (
        (mpm.Pressure(mpm.Patch(ball), 1e4), 0.0),
        (mpm.Traction(cap, (0.0, 1e3, 2e3)), 2 * np.pi * 0.22 * 0.12),
    ):
        scene = mpm.attach(mpm.Scene(grid, material, loads=load, **settings), particles)
        prepared = mpm.prepare(scene, particles)
        found, moment = gained(scene, prepared, mpm.Explicit(), 1e-5)
        if force == 0:
            size = 1e4 * np.pi * 0.22**2
            np.testing.assert_allclose(found, 0, rtol=0, atol=1e-9 * size)
            np.testing.assert_allclose(moment, 0, rtol=0, atol=1e-3 * size * 0.22)  # of second order
        else:
            np.testing.assert_allclose(found, force * np.array([0, 1e3, 2e3]), rtol=0, atol=0.03 * 2e3 * force)


@EACH_DIM
def test_a_pressure_follows_the_surface_and_a_traction_does_not(d):
    """On a body that is turned and stretched: −p cof(F) A, and A t."""
    F = np.diag((0.0, 0.0, 0.8)[:d])  # by a right angle, and sheared out
    F[0, 1], F[1, 0] = -2.0, 1.5
    right, area, traction = face(0, d), SIDE ** (d - 1) * np.eye(d)[0], np.array((1e3, 2e3, -3e3)[:d])
    cofactor = np.linalg.det(F) * np.linalg.inv(F).T
    for load, expected in (
        (mpm.Pressure(right, 4e3), -4e3 * cofactor @ area),
        (mpm.Pressure(right, 4e3, following=False), -4e3 * area),
        (mpm.Traction(right, tuple(traction)), area[0] * traction),
    ):
        scene, particles = loaded(load, d=d, description=mpm.TotalLagrangian())
        deformations = (jnp.broadcast_to(jnp.asarray(F), particles.F.shape),)
        particles = dataclasses.replace(particles, x=particles.X @ F.T, deformations=deformations)
        force, _ = gained(scene, particles, mpm.Explicit(), 1e-7)
        np.testing.assert_allclose(force, expected, rtol=0, atol=1e-6 * np.abs(expected).max())


def test_loads_change_in_time():
    """A series is taken where each integrator takes body forces: at the start of the step, or in its middle."""
    scene, particles = loaded(mpm.Traction(TOP, RAMP))
    for method in (mpm.Explicit(), mpm.ImplicitMidpoint()):
        dt = 1e-3
        force, _ = gained(scene, particles, method, dt)
        expected = SIDE * (1e3 + method.body_force_at * dt * 499e3)
        assert force[0] == pytest.approx(expected, rel=1e-6)


def oscillator(method, stiffness=4e3, damping=None, steps=3, dt=0.02, *, d=2):
    """Velocity and place of a body held by a spring at all of its particles, which moves as one mass: [[x, v], ...]."""
    _, free = block(d)
    everywhere = mpm.PointsAt(np.asarray(free.x), np.asarray(free.mass) / float(free.mass.sum()))
    scene, particles = loaded(mpm.Spring(everywhere, stiffness, damping), d=d)
    particles = dataclasses.replace(particles, v=particles.v.at[:, 0].set(0.1))
    found = []
    for n in range(steps):
        particles, info = mpm.step(scene, particles, n * dt, dt, method=method)
        assert info.solve.converged
        np.testing.assert_allclose(particles.v, particles.v[:1] + 0 * particles.v, rtol=0, atol=1e-9)
        found.append([float(particles.x[0, 0] - free.x[0, 0]), float(particles.v[0, 0])])
    return np.array(found), float(free.mass.sum())


@EACH_DIM
@pytest.mark.parametrize("method", **ids(METHODS, "implicit_midpoint"))
def test_springs_and_dashpots_are_exact_in_the_solve(method, d):
    """A mass on a spring with a dashpot, far beyond the explicit limit for implicit methods, moves as the integrator's
    own formula says."""
    name = next(key for key, value in METHODS.items() if value == method)
    dt, (k, c) = (2e-3, (4e3, 30.0)) if name == "explicit" else (0.5, (4e3, 30.0))
    found, m = oscillator(method, k, c, dt=dt, d=d)
    expected, (x, v) = [], (0.0, 0.1)
    A = np.array([[0.0, 1.0], [-k / m, -c / m]])
    for _ in found:
        if name == "explicit":
            v = v + dt * (-k * x - c * v) / m
            x = x + dt * v
        elif name in ("semi_implicit", "backward_euler"):
            x, v = np.linalg.solve(np.eye(2) - dt * A, [x, v])
        elif name == "implicit_midpoint":
            x, v = np.linalg.solve(np.eye(2) - dt / 2 * A, (np.eye(2) + dt / 2 * A) @ [x, v])
        else:
            g, q0, q1, q2 = (float(w) for w in method.weights())
            start = np.array([x, v])
            inner = np.linalg.solve(np.eye(2) - g * dt / 2 * A, (np.eye(2) + g * dt / 2 * A) @ start)
            x, v = np.linalg.solve(np.eye(2) - q2 * dt * A, start + dt * A @ (q0 * start + q1 * inner))
        expected.append([x, v])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@EACH_DIM
def test_springs_to_the_ground_and_of_contact_make_one_potential(d):
    """At a symmetry plane, with a floor that pushes: the force is minus the energy's derivative, and the Hessian minus
    the force's, also as matrices; both kinds of springs take part."""
    floor = mpm.SeparatingBox((-np.inf, 0.02, -np.inf)[:d], (np.inf,) * d)
    scene, particles = loaded(mpm.Spring(face(1, d), 5e4), d=d, boundary=(mpm.SymmetryPlane(0, 0.0), floor))

    @eqx.filter_jit
    def start(scene, particles):
        nodes = start_nodes(scene, particles, 0.0, 1e-3, scene.stencil(particles), force_at=1.0)
        shut = tuple(contact.gap < 0 for contact in nodes.contacts)
        return nodes, constrain(nodes, shut).nodes.potential

    nodes, potential = start(scene, particles)
    assert {type(term).__name__ for term in potential.terms} == {"Support", "Springs"}
    u, du = (
        jnp.where(nodes.occupied, a, 0) for a in 1e-3 * np.random.default_rng(0).normal(size=(2, *nodes.force.shape))
    )

    @jax.jit
    def found(u, du):
        action = mpm.implicit.AnalyticHessian().at(potential, None)
        resistance = -jax.jvp(potential.force, (jnp.zeros_like(u),), (du,))[1]
        others = []
        for without in ("Springs", "Support"):
            terms = tuple(term for term in potential.terms if type(term).__name__ != without)
            others.append(dataclasses.replace(potential, terms=terms).force(u))
        energy_slope = jax.grad(potential.energy)(u)
        return potential.force(u), energy_slope, others, resistance, action(du), action.precomputed()(du)

    force, slope, others, resistance, resisted, by_matrices = found(u, du)
    assert_close(force, -slope, 1e-10)
    assert_close(resisted, resistance, 1e-10)
    assert_close(by_matrices, resistance, 1e-10)
    for other in others:
        assert np.abs(np.asarray(other - force)).max() > 1e-3


@EACH_DIM
def test_the_stable_step_knows_springs(d):
    """Springs much stiffer than the body: at the limit that is given nothing grows, at three times of it the velocity
    grows by more than ten a step. A dashpot lowers the limit too."""
    _, free = block(d)
    everywhere = mpm.PointsAt(np.asarray(free.x), np.asarray(free.mass) / float(free.mass.sum()))
    limits = []
    for spring in (None, mpm.Spring(everywhere, 1e8), mpm.Spring(everywhere, 1e8, 1e5)):
        scene, particles = loaded(*([] if spring is None else [spring]), d=d)
        limits.append(float(mpm.stable_dt(scene, particles, safety=1.0)))
    assert limits[2] < limits[1] < limits[0] / 10
    grown = {}
    for factor, steps in ((1.0, 30), (3.0, 4)):
        found, _ = oscillator(mpm.Explicit(), 1e8, steps=steps, dt=factor * limits[1], d=d)
        grown[factor] = np.abs(found[-1, 1]) / 0.1
    assert grown[1.0] < 2
    assert grown[3.0] > 1e3


@pytest.mark.thorough
@pytest.mark.parametrize("description", DESCRIPTIONS.values(), ids=DESCRIPTIONS)
@pytest.mark.parametrize(
    ("gradient", "transfer", "method", "d"),
    [
        ("mls", "apic", "explicit", 2),
        ("spline", "flip", "implicit_midpoint", 2),
        ("spline", "pic", "semi_implicit", 2),
        ("mls", "apic", "implicit_midpoint", 3),
    ],
)
def test_budgets_close_with_loads(description, gradient, transfer, method, d):
    """Energy and momentum, with every kind of load."""
    method, choices = METHODS[method], {"gradient": GRADIENTS[gradient], "transfer": TRANSFERS[transfer]}
    loads = (
        mpm.Traction(face(1, d), ramp(d)),
        mpm.Pressure(face(0, d), 4e3),
        mpm.Spring(mpm.PointsAt(AT[d]), (1e4, 2e4, 3e4)[:d], 30.0),
    )
    gravity = (1.0, -9.81, 0.5)[:d]
    scene, particles = loaded(
        *loads, d=d, description=description, gravity=gravity, boundary=mpm.SymmetryPlane(1, 0.0), **choices
    )
    v = jnp.asarray(np.random.default_rng(3).normal(size=particles.v.shape))
    particles = dataclasses.replace(particles, v=v)
    _, budget = mpm.budget(scene, particles, steps=3, dt=0.3 * explicit_limit(scene), method=method)
    energy, momentum = budget.energy, budget.momentum
    scale = np.abs(energy.kinetic).max() + np.abs(energy.body_force).max() + np.abs(energy.elastic).max()
    np.testing.assert_allclose(energy.change, energy.explained, rtol=0, atol=1e-9 * scale)
    scale = np.abs(momentum.body_force).max() + np.abs(momentum.elastic).max()
    np.testing.assert_allclose(momentum.change, momentum.explained, rtol=0, atol=1e-9 * scale)


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_loads_have_derivatives(d):
    """By traction, pressure, the values of a series, stiffness, damping, the ground's motion and a force along a line,
    through an implicit solve, against central differences."""
    rest = (0.0,) * d
    loads = (
        mpm.Traction(face(1, d), mpm.TimeSeries((0.0, 0.01), (rest, (1e3, -2e3, 3e3)[:d]))),
        mpm.Pressure(face(0, d), 4e3),
        mpm.Spring(mpm.PointsAt(AT[d][:1]), 1e4, 30.0, mpm.Motion((0.0, 0.1), (rest, (0.01, 0.0, 0.0)[:d]))),
        mpm.PointLoad(mpm.PointsAt(AT[d]), (20.0,) * d),
    )
    scene, particles = loaded(*loads, d=d)
    numbers = (2e3, 4e3, 1e4, 30.0, 0.01, 20.0)

    def end(numbers):
        traction, pressure, stiffness, damping, way, force = numbers
        own = eqx.tree_at(
            lambda s: (
                s.loads[0].traction.values[1][0], s.loads[1].pressure, s.loads[2].stiffness, s.loads[2].damping,
                s.loads[2].motion.displacement[1][0], s.loads[3].total[0],
            ),
            scene, (traction, pressure, stiffness, damping, way, force),
        )  # fmt: skip
        run = mpm.simulate(own, particles, t1=0.02, dt=5e-3, method=METHODS["implicit_midpoint"])
        return (run.final.x * jnp.asarray([1.0, 0.3, 0.1])[:d]).sum()

    both = jax.value_and_grad(end)
    for i, (number, slope) in enumerate(zip(numbers, both(numbers)[1], strict=True)):
        ends = [both(tuple(n * (1 + e) if j == i else n for j, n in enumerate(numbers)))[0] for e in (1e-3, -1e-3)]
        assert float(slope) == pytest.approx(float(ends[0] - ends[1]) / (2e-3 * number), rel=1e-4)


@pytest.mark.thorough
def test_loads_forces_and_planes_that_move_in_single_precision():
    """All together keep the particles' precision, explicit and implicit."""
    loads = mpm.Traction(TOP, RAMP), mpm.Pressure(RIGHT, 1.0), mpm.Spring(mpm.PointsAt(((0.1, 0.1),)), 1e3, 1.0)
    plane = mpm.SymmetryPlane(1, 0.0, motion=mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.0, 0.1))))
    scene, particles = block(2, loads=loads, boundary=plane, boundary_forces=True)
    particles = jax.tree.map(lambda a: a.astype(jnp.float32), particles)
    scene = mpm.attach(scene, particles)
    for method in (mpm.Explicit(), mpm.ImplicitMidpoint()):
        after, info = mpm.step(scene, particles, 0.5, 1e-4, method=method)
        assert {a.dtype for a in jax.tree.leaves((after, info.boundaries))} == {jnp.dtype(jnp.float32)}
        assert np.isfinite(after.x).all()
    assert float(mpm.stable_dt(scene, particles)) > 0


@pytest.mark.parametrize(
    ("name", "d"),
    [
        ("explicit", 2),
        *thorough(*((name, 2) for name in METHODS if name != "explicit"), ("explicit", 3), ("trbdf2", 3)),
    ],
)
def test_loads_and_boundaries_sum_to_the_change_of_momentum(name, d):
    """What the boundaries receive is what loads and gravity give and the body does not keep."""
    wall, traction = mpm.StickyBox((-np.inf, 0.0, -np.inf)[:d], (np.inf,) * d), (3e3, -2e3, 1e3)[:d]
    scene, particles = shaken(d, boundary=(mpm.SymmetryPlane(0, 0.0), wall), loads=mpm.Traction(face(1, d), traction))
    dt = 0.3 * explicit_limit(scene)
    after, info = mpm.step(scene, particles, 0.0, dt, method=METHODS[name])
    mass = np.asarray(particles.mass)
    given = dt * (mass.sum() * np.asarray(scene.gravity) + SIDE ** (d - 1) * np.array(traction))
    lost = given - mass @ np.asarray(after.v - particles.v)
    np.testing.assert_allclose(info.boundaries.impulse.sum(axis=0), lost, rtol=0, atol=1e-10 * np.abs(given).max())


@pytest.mark.thorough
def test_runs_with_loads_go_on_from_files(tmp_path):
    """To the same numbers, bit for bit."""
    scene, particles = block(2, loads=(mpm.Traction(TOP, RAMP), mpm.Spring(mpm.PointsAt(((0.1, 0.1),)), 1e3)))
    run = mpm.simulate(mpm.attach(scene, particles), particles, t1=2e-3, dt=1e-3, save_every=1)
    mpm.save(tmp_path / "run.h5", run)
    again = mpm.load(tmp_path / "run.h5")
    onward = [mpm.simulate(r.scene, r.final, t1=4e-3, dt=1e-3, start=2).final.x for r in (run, again)]
    assert np.array_equal(*onward)


def test_loads_can_be_written_and_are_refused_with_reasons():
    """Attached and not; what does not fit says so."""
    loads = (mpm.Traction(TOP, RAMP), mpm.Spring(mpm.PointsAt(((0.1, 0.1),)), 1e3))
    scene, particles = block(2, loads=loads)
    for value in (scene, mpm.attach(scene, particles)):
        arrays: dict = {}
        again = decode(json.loads(json.dumps(encode(value, arrays))), mpm.Scene, "", arrays)
        assert encode(again) == encode(value)
    with pytest.raises(ValueError, match=r"not attached to particles yet: call scene = mpmjax\.attach"):
        mpm.step(scene, particles, 0.0, 1e-4)
    with pytest.raises(ValueError, match="off the nearest particle"):
        mpm.attach(
            mpm.Scene(scene.grid, scene.material, loads=mpm.PointLoad(mpm.PointsAt(((0.9, 0.9),)), (1.0, 0.0))),
            particles,
        )
    with pytest.raises(ValueError, match="Traction's traction must have 2 components"):
        mpm.Scene(scene.grid, scene.material, loads=mpm.Traction(TOP, (1.0, 2.0, 3.0)))
    metal = mpm.attach(mpm.Scene(scene.grid, mpm.VonMises(1e4, 0.3, 400.0), loads=mpm.Pressure(TOP, 1.0)), particles)
    with pytest.raises(ValueError, match="following Pressure needs the whole deformation gradient"):
        mpm.prepare(metal, particles)


SCENE_FILE = """
boundary_forces = true
[grid]
shape = [9, 9]
spacing = 0.1
origin = [-3, -3]
[material]
kind = "NeoHookean"
youngs_modulus = 1e4
poisson_ratio = 0.3
[[boundary]]
kind = "Grip"
region = { kind = "Box", lower = [-1.0, -1.0], upper = [1.0, 0.0] }
motion = { times = [0.0], displacement = [[0.0, 0.0]] }
[[loads]]
kind = "Traction"
traction = { kind = "TimeSeries", times = [0.0, 1.0], values = [[0.0, 0.0], [0.0, -2e3]] }
on = { kind = "Patch", region = { kind = "Box", lower = [0.0, 0.0], upper = [0.3, 0.3] }, within = { kind = "Box", lower = [0.0, 0.29], upper = [0.3, 1.0] } }
[[loads]]
kind = "Spring"
stiffness = 1e4
on = { kind = "PointsAt", positions = [[0.3, 0.0]] }
[particles]
region = { kind = "Box", lower = [0.0, 0.0], upper = [0.3, 0.3] }
density = 1e3
[run]
t1 = 1e-3
dt = 1e-3
"""  # noqa: E501


def test_a_scene_file_attaches_its_loads(tmp_path):
    """To the particles that it fills, also where it is refined; a grip's motion needs no kind."""
    path = tmp_path / "loaded.toml"
    path.write_text(SCENE_FILE)
    file = read_scene_file(path)
    for (scene, particles), count in (((file.scene, file.particles), 6), (file.build(2), 12)):
        traction, spring = scene.loads
        assert len(traction.on.weight) == count
        assert float(jnp.sum(jnp.asarray(traction.on.weight))) == pytest.approx(SIDE, rel=1e-12)
        place = particles.x[int(spring.on.particle[0])] + jnp.asarray(spring.on.offset)[0]
        np.testing.assert_allclose(place, [0.3, 0.0], rtol=0, atol=1e-12)
    assert isinstance(file.scene.boundary[0].motion, mpm.Motion)
