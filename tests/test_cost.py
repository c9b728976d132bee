"""A scene pays for what it uses: operations counted in the program of a step, for scenes that differ in one feature."""

from collections import Counter
from functools import partial
from unittest import mock

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import DESCRIPTIONS, KERNELS, METHODS, SECOND_ORDER, block, ids, thorough

import mpmjax as mpm
from mpmjax.autodiff._custom_derivative import _Call, _values
from mpmjax.boundary._contact import ConstrainedNodes
from mpmjax.checks._values import canonical
from mpmjax.implicit import Projection
from mpmjax.simulation._diffrax import Problem, SegmentAdjoint
from mpmjax.state import state_of
from mpmjax.stepping._nodes import Nodes
from mpmjax.stepping._step import step_unchecked

LAW = mpm.NeoHookean(1e5, 0.3)
SUMS = ("custom_scatter", "custom_average", "custom_gather", "custom_resist")
COUNTED = (*SUMS, "while", "floor", "exp", "log", "rem")


def program(method=mpm.Explicit(), *, d=2, nodes=12, material=LAW, periodic=False, **scene):
    """The step as a function of arrays, as a rollout has it, and the arrays. Each of several materials has as many
    particles as one has alone."""
    grid = mpm.Grid((nodes,) * d, 0.1, origin=(-3,) * d, periodic=periodic)
    block = mpm.fill(mpm.Box((0.0,) * d, (0.4,) * d), grid, particles_per_cell=2**d, density=1e3)
    particles = mpm.join(*[block] * len(material)) if isinstance(material, tuple) else block
    scene, dt, method = canonical((mpm.Scene(grid, material, **scene), 1e-3, method), jnp.float64)
    particles = mpm.prepare(scene, particles)
    problem = Problem(scene, particles, dt, method, scene.stencil(particles) if scene.total else None)
    arrays, rest = eqx.partition(problem, eqx.is_array)

    def step(arrays):
        p = eqx.combine(arrays, rest)
        return step_unchecked(p.scene, p.particles, 0 * p.dt, p.dt, p.method, p.stencil)[0]

    return step, arrays


def operations(jaxpr, times=1):
    """How often each counted primitive or sum runs: loops of known length all their turns, others one."""
    total = Counter()
    for equation in jaxpr.eqns:
        name = name_of(equation)
        if name in COUNTED:
            total[name] += times
        turns = times * equation.params["length"] if equation.primitive.name == "scan" else times
        for inner in inner_programs(equation):
            total += operations(inner, turns)
    return total


def name_of(equation):
    """The name of an equation's primitive, or of its function with a derivative rule or a kernel."""
    call = equation.params.get("call")
    if not isinstance(call, _Call):
        return equation.primitive.name
    return f"custom_{call.function}" if call.function.kernel else f"rule_{call.function}"


def inner_programs(equation):
    """The programs in an equation's parameters: of a function with a rule, a transfer or a solve; not of sums."""
    call = equation.params.get("call")
    if isinstance(call, _Call):
        if call.function.kernel in (None, "p2g", "g2p", "solve"):
            yield jax.make_jaxpr(partial(_values, call=call))(*(a.aval for a in equation.invars)).jaxpr
        return
    for inner in jax.tree.leaves(list(equation.params.values()), is_leaf=lambda a: hasattr(a, "eqns")):
        inner = getattr(inner, "jaxpr", inner)
        if hasattr(inner, "eqns"):
            yield inner


def innermost_loops(jaxpr):
    """The bodies of loops of unknown length that hold no other such loop."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while" and not operations(equation.params["body_jaxpr"].jaxpr)["while"]:
            found.append(equation.params["body_jaxpr"].jaxpr)
        else:
            found += [loop for inner in inner_programs(equation) for loop in innermost_loops(inner)]
    return found


def counted(method=mpm.Explicit(), **scene):
    """Of one step."""
    step, arrays = program(method, **scene)
    return operations(jax.make_jaxpr(step)(arrays).jaxpr)


def compiled(method=mpm.Explicit(), **scene):
    """Floating-point operations, bytes moved and temporary bytes of the compiled step, and its state's arrays."""
    step, arrays = program(method, **scene)
    program_ = jax.jit(step).lower(arrays).compile()
    costs = program_.cost_analysis()
    state = len(jax.tree.leaves(jax.eval_shape(step, arrays)))
    return costs["flops"], costs["bytes accessed"], program_.memory_analysis().temp_size_in_bytes, state


def crossings(found):
    """Sums to the nodes, and from them; an average is one of the first, a resistance one of each."""
    to_nodes = found["custom_scatter"] + found["custom_average"] + found["custom_resist"]
    return to_nodes, found["custom_gather"] + found["custom_resist"]


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("kernel", **ids(KERNELS, "quadratic"))
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_an_explicit_step_crosses_to_the_grid_and_back_once(description, kernel, d):
    """Momentum with the force's impulse, velocity with its gradient, of moving least squares; no iteration. With the
    linear kernel particles that move may come to lie on nodes, and cross once more to learn which are empty."""
    found = counted(d=d, kernel=kernel, description=description, gradient=mpm.MLSGradient())
    assert crossings(found) == (
        (2, 2) if kernel == KERNELS["linear"] and description == DESCRIPTIONS["updated"] else (1, 1)
    )
    assert found["while"] == 0


@pytest.mark.parametrize(
    ("transfer", "gradient", "expected"),
    [
        (mpm.APIC(), mpm.MLSGradient(), (1, 1)),
        (mpm.PIC(), mpm.MLSGradient(), (1, 1)),
        (mpm.PIC(), mpm.SplineGradient(), (1, 1)),
        (mpm.FLIP(), mpm.SplineGradient(), (2, 2)),
        (mpm.APIC(), mpm.SplineGradient(), (2, 2)),
    ],
)
def test_only_what_needs_it_crosses_again(transfer, gradient, expected):
    """FLIP needs the momentum apart from the force's impulse, and reads two velocities, each by code of its own for
    so many columns; APIC with the spline's gradient has two gradients."""
    assert crossings(counted(transfer=transfer, gradient=gradient)) == expected


def test_an_iteration_of_an_implicit_step_crosses_once_each_way():
    """Whatever stencil, rotations and factors it needs is made before the loop."""
    step, arrays = program(mpm.SemiImplicit())
    (body,) = innermost_loops(jax.make_jaxpr(step)(arrays).jaxpr)
    assert operations(body) == {"custom_resist": 1}


def test_the_diagonal_preconditioner_adds_one_crossing_to_a_solve_and_nothing_to_an_iteration():
    by_mass, by_diagonal = mpm.SemiImplicit(preconditioner=mpm.implicit.MassPreconditioner()), mpm.SemiImplicit()
    (there, back), (more, as_many) = crossings(counted(by_mass)), crossings(counted(by_diagonal))
    assert (more, as_many) == (there + 1, back)
    step, arrays = program(by_diagonal)
    (body,) = innermost_loops(jax.make_jaxpr(step)(arrays).jaxpr)
    assert operations(body) == {"custom_resist": 1}


@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_averaged_volumes_cross_by_hats_and_what_does_not_ask_for_them_does_not(description):
    """The hats' volumes, the sum and the average of J, and of the pressure; in an iteration two averages."""
    law, gradient = mpm.NeoHookean(1e5, 0.49), mpm.MLSGradient()
    choices = {"material": law, "gradient": gradient, "description": description}
    assert crossings(counted(**choices)) == (1, 1)
    assert crossings(counted(**choices, volume=mpm.AveragedVolume())) == (1 + 3, 1 + 2)
    step, arrays = program(mpm.SemiImplicit(), **choices, volume=mpm.AveragedVolume())
    (body,) = innermost_loops(jax.make_jaxpr(step)(arrays).jaxpr)
    assert operations(body) == {"custom_scatter": 1 + 2, "custom_gather": 1 + 2}


HELD = {
    "sticky": mpm.StickyBox((-0.2, -0.2), (0.8, 0.8)),
    "slip": mpm.SlipBox((-0.2, -0.2), (0.8, 0.8)),
    "grip": mpm.Grip(mpm.Box((0.3, -1.0), (1.0, 1.0)), mpm.Motion((0.0, 1.0), ((0.0, 0.0), (0.1, 0.0)))),
    "mirrored": mpm.SymmetryPlane(0, 0.0),
    "clamped": mpm.ClampPlane(0, 0.0),
    "sticky collider": mpm.StickyCollider(mpm.Ball((0.4, 0.4), 0.15)),
    "slip collider": mpm.SlipCollider(mpm.HalfSpace((0.0, 0.0), (1.0, 2.0))),
}


@pytest.mark.parametrize("boundary", **ids(HELD))
def test_walls_that_are_never_left_add_no_crossing_and_no_iteration(boundary):
    found = counted(boundary=boundary)
    assert crossings(found) == (1, 1)
    assert found["while"] == 0


@pytest.mark.parametrize(
    "method", **ids({k: m for k, m in (METHODS | SECOND_ORDER).items() if k != "explicit"}, "semi_implicit")
)
def test_only_implicit_steps_iterate(method):
    """And only in these do walls that may be left add a search for what they hold, in which the step is solved."""
    free = counted(method)["while"]
    assert counted()["while"] == 0
    assert free > 0
    wall = {"boundary": mpm.SeparatingBox((-0.2, 0.0), (0.8, 0.8))}
    assert counted(**wall)["while"] == 0
    searched = counted(method, **wall)["while"]
    assert searched == free + 1
    collider = {"boundary": mpm.SeparatingCollider(mpm.HalfSpace((0.0, 0.0), (1.0, 2.0)), friction=0.1)}
    assert counted(**collider)["while"] == 0
    assert counted(method, **collider)["while"] == searched


def equations(jaxpr):
    """Of a program and all within it."""
    return len(jaxpr.eqns) + sum(equations(inner) for equation in jaxpr.eqns for inner in inner_programs(equation))


@pytest.mark.thorough
@pytest.mark.parametrize("method", [METHODS["explicit"], METHODS["semi_implicit"]], ids=["explicit", "semi_implicit"])
@pytest.mark.parametrize("boundary", [(), HELD["slip"], mpm.SeparatingBox((-0.2, 0.0), (0.8, 0.8))])
def test_without_colliders_a_constraint_is_a_mask(method, boundary):
    """No operation more: where each projection and what is prescribed are the mask's `where` itself, written out, the
    program of a step has as many equations. No leaf more: nothing of colliders is there, nor reported."""

    def masked(self, a, b):
        return jnp.where(self.free, a, b)

    step, arrays = program(method, boundary=boundary)
    as_is = equations(jax.make_jaxpr(step)(arrays).jaxpr)
    with (
        mock.patch.object(Projection, "combine", masked),
        mock.patch.object(Projection, "identity_rows", lambda self, vector, mass: vector),
        mock.patch.object(Nodes, "projection", property(lambda self: Projection(self.free))),
        mock.patch.object(Nodes, "prescribed", property(lambda self: self.conditions.velocity)),
        mock.patch.object(ConstrainedNodes, "along_normals", return_value=()),
        mock.patch.object(ConstrainedNodes, "without_collider_impulses", lambda self, residual: residual),
    ):
        step, arrays = program(method, boundary=boundary)
        assert equations(jax.make_jaxpr(step)(arrays).jaxpr) == as_is
    info = jax.eval_shape(lambda a: mpm.step(*a, 0.0, 1e-3, method=method)[1], block(2, boundary=boundary))
    assert info.colliders is None


@pytest.mark.parametrize("collider", [mpm.SlipCollider, mpm.StickyCollider, mpm.SeparatingCollider])
def test_a_collider_scatters_nothing_and_adds_no_crossing_to_an_iteration(collider):
    method, boundary = mpm.SemiImplicit(), collider(mpm.HalfSpace((0.0, 0.0), (1.0, 2.0)))
    step, arrays = program(method, boundary=boundary)
    jaxpr = jax.make_jaxpr(step)(arrays).jaxpr
    for body in innermost_loops(jaxpr):
        found = operations(body)
        assert crossings(found) == (1, 1)
        assert set(found) <= {"custom_resist", "custom_scatter", "custom_gather"}
    plain, arrays = program(method, boundary=HELD["slip"])
    if collider is not mpm.SeparatingCollider:
        assert operations(jaxpr) == operations(jax.make_jaxpr(plain)(arrays).jaxpr)


def test_in_the_total_description_a_rollout_builds_no_custom_in_its_steps():
    """The first node is found by rounding down: in each step of the updated description, in none of the total one."""
    assert counted()["floor"] > 0
    assert counted(description=mpm.TotalLagrangian())["floor"] == 0


def test_around_periodic_axes_no_remainders_are_taken():
    """A CPU divides whole numbers one by one: that was two fifths of the gradient of an explicit step."""
    assert not any(counted(periodic=periodic)["rem"] for periodic in (False, (True, False), True))


SNOW = mpm.Snow()


@pytest.mark.thorough
@pytest.mark.parametrize("method", **ids(METHODS | SECOND_ORDER))
def test_yielding_adds_no_crossing_and_one_number_a_particle(method):
    """To an explicit step; what it computes is its own: an eigenvalue problem and an exponential. An implicit step sums
    once more for the linearisation error, which its return map is part of."""
    elastic, yielding = (counted(method, material=law) for law in (mpm.FixedCorotated(1e5, 0.2), SNOW))
    to_nodes, from_nodes = crossings(elastic)
    assert crossings(yielding) == (to_nodes + (not method.is_explicit), from_nodes)
    assert yielding["while"] == elastic["while"]
    if method == METHODS["explicit"]:
        assert (yielding["exp"], elastic["exp"]) == (1, 0)
        assert compiled(material=SNOW)[3] == compiled(material=mpm.FixedCorotated(1e5, 0.2))[3] + 1


@pytest.mark.thorough
@pytest.mark.parametrize("method", **ids(METHODS))
def test_a_second_material_adds_no_crossing_and_no_iteration(method):
    """Both go to the grid and back in one sum. An implicit step sums twice more for its linearisation error: the
    returned stress, and the mass of what does not yield."""
    (to_nodes, from_nodes), two = crossings(counted(method)), counted(method, material=(LAW, SNOW))
    assert crossings(two) == (to_nodes + 2 * (not method.is_explicit), from_nodes)


def logarithms(jaxpr):
    """The shapes of what logarithms are taken of."""
    shapes = {e.invars[0].aval.shape for e in jaxpr.eqns if e.primitive.name == "log"}
    return shapes.union(*(logarithms(inner) for e in jaxpr.eqns for inner in inner_programs(e)))


@pytest.mark.thorough
def test_no_law_is_evaluated_for_particles_of_another(choose):
    """Neo-Hookean's logarithm is taken of its own 64 particles of 128, and F and history are stored by material. What
    both give is joined, for 2 % of what each costs alone, all of it counted where XLA sums."""
    choose("xla")
    step, arrays = program(material=(SNOW, LAW))
    assert logarithms(jax.make_jaxpr(step)(arrays).jaxpr) == {(64,)}
    alone = [compiled(material=(law,)) for law in (SNOW, LAW)]
    both = compiled(material=(SNOW, LAW))
    assert both[0] < 1.03 * sum(costs[0] for costs in alone)
    assert both[3] == compiled(material=(LAW,))[3] + 2  # F and J_P of snow


@pytest.mark.thorough
def test_pic_carries_no_affine_velocity_and_two_dimensions_no_third(choose):
    """Leaves of the state, flops and bytes of the compiled step all fall, and by the dimension its temporaries, all of
    it counted where XLA sums."""
    choose("xla")
    apic, pic, solid = compiled(), compiled(transfer=mpm.PIC()), compiled(d=3)
    assert pic[3] == apic[3] - 1
    assert all(less < more for less, more in zip(pic[:2], apic[:2], strict=True))
    assert all(less < more for less, more in zip(apic[:3], solid[:3], strict=True))


@pytest.mark.thorough
def test_the_cost_of_an_empty_window_is_that_of_its_nodes():
    """Twice the window each way: the same crossings, and at most 40 flops and 400 bytes for each node that is added."""
    small, large = compiled(nodes=12), compiled(nodes=24)
    added = 24**2 - 12**2
    assert counted(nodes=24) == counted(nodes=12)
    assert large[0] - small[0] < 40 * added
    assert large[1] - small[1] < 400 * added


@pytest.mark.parametrize("d", thorough(2, 3))
def test_a_fluid_stores_and_costs_less_than_a_solid(d, choose):
    """One number in the place of F's d²; in flops and bytes of the compiled step, all of it XLA's so that all are
    counted, it is below the cheapest solid, and in bytes that pass between native sums too."""
    fluid, solid = compiled(d=d, material=mpm.Fluid(1e5)), compiled(d=d)
    assert fluid[1] < 0.8 * solid[1]
    choose("xla")
    fluid, solid = compiled(d=d, material=mpm.Fluid(1e5)), compiled(d=d)
    assert fluid[0] < 0.9 * solid[0]
    assert fluid[1] < 0.98 * solid[1]
    assert crossings(counted(d=d, material=mpm.Fluid(1e5))) == (1, 1)
    step, arrays = program(d=d, material=mpm.Fluid(1e5))
    assert jax.eval_shape(step, arrays).F.ndim == 1


@pytest.mark.thorough
@pytest.mark.parametrize("transfer", [mpm.APIC(), mpm.PIC(), mpm.FLIP()])
@pytest.mark.parametrize("law", [LAW, mpm.Fluid(1e5)])
def test_viscosity_adds_no_crossing(law, transfer):
    """To an explicit step, whatever the transfer; nor to an iteration. What it needs kept is the velocity gradient."""
    viscous = mpm.Viscous(law, 1.0)
    assert crossings(counted(material=viscous, transfer=transfer)) == crossings(
        counted(material=law, transfer=transfer)
    )
    step, arrays = program(material=viscous, transfer=transfer)
    assert jax.eval_shape(step, arrays).C is not None
    step, arrays = program(mpm.SemiImplicit(), material=viscous, transfer=transfer)
    (body,) = innermost_loops(jax.make_jaxpr(step)(arrays).jaxpr)
    assert operations(body) == {"custom_resist": 1}


def test_forces_on_boundaries_add_no_crossing_to_an_explicit_step():
    """Sums over the nodes, and nothing between particles and nodes."""
    walls = mpm.StickyBox((0.0, -1.0), (9.0, 9.0)), mpm.Grip(mpm.Box((0.3, -1.0), (1.0, 1.0)), mpm.geometry.still(2))
    assert counted(boundary=walls, boundary_forces=True) == counted(boundary=walls)


def test_a_second_preparation_compiles_nothing(caplog):
    """Of other particles in another scene of the same kind."""
    scene, particles = block(2)
    mpm.prepare(scene, particles)
    softer = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, 50.0)
    faster = eqx.tree_at(lambda p: p.v, particles, particles.v + 1)
    with jax.log_compiles():
        mpm.prepare(softer, faster)
    assert not [record for record in caplog.records if "Compiling" in record.getMessage()]


def reverse(method, **scene):
    """The program of a rollout of three steps and that of its gradient by velocities, and the particles."""
    grid = mpm.Grid((12, 12), 0.1, origin=(-3, -3))
    scene = mpm.Scene(grid, LAW, **scene)
    body = mpm.fill(mpm.Box((0.0, 0.0), (0.4, 0.4)), grid, particles_per_cell=4, density=1e3)
    particles = mpm.prepare(scene, body)

    def moved(v):
        start = eqx.tree_at(lambda p: p.v, particles, v)
        return (mpm.rollout(scene, start, steps=3, dt=1e-3, method=method).x ** 2).sum()

    v = jnp.asarray(particles.v)
    return jax.make_jaxpr(moved)(v).jaxpr, jax.make_jaxpr(jax.grad(moved))(v).jaxpr, particles


def every(jaxpr, name):
    """All equations of a primitive, in inner programs too; the code of a derivative rule is not looked into."""
    own = [e for e in jaxpr.eqns if name_of(e) == name]
    inner = [i for e in jaxpr.eqns if not isinstance(e.params.get("call"), _Call) for i in inner_programs(e)]
    return sum((every(i, name) for i in inner), own)


@pytest.mark.parametrize("boundary", [(), mpm.ContactPlane(1, 0.0)], ids=["free", "contact"])
def test_a_gradient_repeats_no_solve(boundary):
    """Steps are computed again in reverse mode, solutions and active sets are not. Beside contact, which is searched
    without derivatives, the solution is found once more, from itself."""
    forward, gradient, _ = reverse(mpm.SemiImplicit(), boundary=boundary)
    assert len(every(forward, "rule_solve")) == 1
    assert len(every(gradient, "rule_solve")) == (2 if boundary else 1)


def test_a_gradient_stores_no_more_than_the_state_before_each_step():
    _, gradient, particles = reverse(mpm.Explicit())
    (ahead, _) = every(gradient, "scan")
    stored = [out for out in ahead.outvars if out.aval.shape[:1] == (ahead.params["length"],)]
    state = jax.tree.leaves(state_of(particles))
    assert 0 < sum(a.aval.size for a in stored) <= 3 * (sum(a.size for a in state) + 1)


def test_segments_sum_each_step_twice_and_no_third_time():
    """Once on the way, and once more for the segment that is differentiated, which stores its sums."""
    grid = mpm.Grid((12,) * 2, 0.1)
    block = mpm.fill(mpm.Box((0.3,) * 2, (0.7,) * 2), grid, particles_per_cell=4, density=1e3)

    def moved(stiffness):
        scene = mpm.Scene(grid, mpm.NeoHookean(stiffness, 0.3), gravity=(0.0, -9.81))
        adjoint = SegmentAdjoint((2, 3))
        return (mpm.simulate(scene, block, t1=6e-3, dt=1e-3, adjoint=adjoint, throw=False).final.x ** 2).sum()

    found = operations(jax.make_jaxpr(jax.grad(moved))(jnp.asarray(1e5)).jaxpr)
    assert (found["custom_average"], found["custom_gather"]) == (12, 12)
