"""Bodies of revolution: the hoop is exact, forces are derivatives of the energy, budgets close, what is refused. The
problems of a tube, a disk, a cylinder, a bar and a column are in `validation/test_revolved.py`."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import (
    DESCRIPTIONS,
    FLUIDS,
    LAWS,
    METHODS,
    PLASTIC,
    SECOND_ORDER,
    TRANSFERS,
    VISCOUS,
    assert_close,
    ids,
    thorough,
)
from jax.flatten_util import ravel_pytree

import mpmjax as mpm
from mpmjax.checks import canonical
from mpmjax.implicit import AnalyticHessian
from mpmjax.state import state_of, with_state
from mpmjax.stepping import start_nodes, step_unchecked

GRID = mpm.Grid((10, 12), 0.1, origin=(-3, -3), axisymmetric=True)
EVERY = LAWS | PLASTIC | FLUIDS | VISCOUS


def cylinder(velocity=None, grid=GRID, lower=(0.0, 0.0)):
    return mpm.fill(mpm.Box(lower, (0.4, 0.6)), grid, particles_per_cell=4, density=1e3, velocity=velocity)


def swelling(x):
    """A velocity that is odd in r."""
    return jnp.stack([(0.5 + x[1]) * x[0], 0.4 * jnp.sin(3 * x[1])])


def test_masses_are_those_of_the_whole_circle():
    """Of a lattice, of a cut section and of a map; and areas of surfaces."""
    assert_close(cylinder().mass.sum(), 1e3 * np.pi * 0.4**2 * 0.6)
    ball = mpm.fill(mpm.Ball((0.0, 0.3), 0.25), mpm.Grid((12, 12), 0.02, axisymmetric=True), density=1.0)
    assert_close(ball.mass.sum(), 4 / 3 * np.pi * 0.25**3, 2e-3)


def test_a_surface_is_a_ring_around_the_axis():
    """2π a H inside a tube, also where it has swollen before it is attached: its undeformed area."""
    region, inside = mpm.Box((0.2, 0.0), (0.4, 0.6)), mpm.Box((0.1, 0.0), (0.22, 0.6))
    scene = mpm.Scene(GRID, LAWS["neo_hookean"], loads=mpm.Pressure(mpm.Patch(region, within=inside), 1.0))
    on = mpm.attach(scene, cylinder(lower=(0.2, 0.0))).loads[0].on
    assert_close(on.weight.sum(), 2 * np.pi * 0.2 * 0.6)
    assert_close(on.area.sum(axis=0), np.array([-2 * np.pi * 0.2 * 0.6, 0]))


CASES = [
    ("explicit", "updated"),
    ("semi_implicit", "total"),
    *thorough(*[(m, d) for m in METHODS | SECOND_ORDER for d in DESCRIPTIONS][1:]),
]


@pytest.mark.parametrize(("method", "description"), CASES)
def test_the_hoop_stretch_is_the_radius_over_that_at_the_start(method, description):
    """To rounding; and momentum along the axis is kept."""
    scene = mpm.Scene(GRID, LAWS["neo_hookean"], description=DESCRIPTIONS[description])
    start, method = cylinder(swelling), (METHODS | SECOND_ORDER)[method]
    end = mpm.simulate(scene, start, dt=2e-3, t1=1e-2, method=method).final
    stretch = end.x[:, 0] / start.x[:, 0]
    assert float(jnp.abs(stretch - 1).max()) > 1e-3
    assert_close(end.F[:, 2, 2], stretch, 1e-13)
    assert float(jnp.abs(end.F[:, :2, 2]).max()) == float(jnp.abs(end.F[:, 2, :2]).max()) == 0
    lost = mpm.momentum(end)[1] - mpm.momentum(start)[1]
    assert abs(float(lost)) < 1e-5 * float((start.mass * jnp.abs(start.v[:, 1])).sum())


def test_an_even_expansion_is_exact_up_to_the_axis():
    """Of a field linear in r and z, one step has F = 1 + Δt diag(a, b, a) at every particle, by the mirror at the axis
    too, and the hoop strain rate there is no larger than elsewhere."""
    rates, dt = jnp.array([0.3, -0.2]), 1e-3
    scene, start = mpm.Scene(GRID, LAWS["neo_hookean"]), cylinder(lambda x: rates * x)
    end, _ = mpm.step(scene, mpm.prepare(scene, start), 0.0, dt)
    expected = jnp.eye(3) + dt * jnp.diag(jnp.array([rates[0], rates[1], rates[0]]))
    assert_close(end.F, jnp.broadcast_to(expected, end.F.shape), 1e-12)


@pytest.mark.parametrize("law", **ids(EVERY, ("neo_hookean", "viscous_fluid")))
def test_force_and_hessian_are_derivatives_of_the_energy(law):
    """By automatic differentiation of Φ; viscous resistance is the derivative of half its power, and positive."""
    scene, particles = mpm.Scene(GRID, law), cylinder(swelling)
    scene = canonical(scene, particles.x.dtype)
    particles = mpm.prepare(scene, particles)
    rng = np.random.default_rng(0)
    u, w = (jnp.asarray(1e-3 * rng.normal(size=(GRID.size, 2))) for _ in range(2))

    @eqx.filter_jit
    def both(u, w):
        nodes = start_nodes(scene, particles, 0.0, 1e-3, scene.stencil(particles))
        potential = nodes.potential
        action = AnalyticHessian().at(potential, u)
        force, slope = potential.force(u), -jax.grad(potential.energy)(u)
        change = jax.jvp(lambda u: -potential.force(u), (u,), (w,))[1]
        power = jax.grad(potential.power)(w) / 2
        products = action(w), action.precomputed()(w), change
        return (force, slope), products, (potential.viscous_resistance(w), power, potential.power(w))

    forces, products, (resistance, power, lost) = both(u, w)
    assert_close(*forces, 1e-11)
    assert_close(products[0], products[2], 1e-9)
    assert_close(products[1], products[2], 1e-9)
    assert (float(lost) > 0) == (law.viscosity is not None)
    if law.viscosity is not None:
        assert_close(resistance, power, 1e-11)


@pytest.mark.parametrize(
    ("method", "law", "boundary"),
    [
        ("explicit", "viscous_solid", mpm.ContactPlane(1, 0.0, friction=0.3)),
        *thorough(
            ("semi_implicit", "drucker_prager", mpm.SeparatingBox((-np.inf, 0.0), (0.45, np.inf), friction=0.3)),
            ("implicit_midpoint", "von_mises", mpm.StickyBox((-np.inf, 0.0), (np.inf, np.inf))),
            ("backward_euler", "viscous_fluid", mpm.SlipBox((-np.inf, 0.0), (0.4, np.inf))),
        ),
    ],
)
def test_the_budgets_of_energy_and_momentum_close(method, law, boundary):
    """Every term has its own expression, so that all of them know the hoop: to rounding."""
    scene = mpm.Scene(GRID, EVERY[law], boundary=boundary, gravity=(0.0, -9.81))
    start = cylinder(lambda x: swelling(x) - jnp.array([0.0, 0.5]))
    _, budget = mpm.budget(scene, start, steps=4, dt=5e-4, method=(METHODS | SECOND_ORDER)[method])
    energy, momentum = budget.energy, budget.momentum
    size = float(mpm.energy(scene, start).kinetic)
    assert float(jnp.abs(energy.change - energy.explained).max()) < 1e-11 * size
    gap = jnp.abs(momentum.change - momentum.explained)[:, 1].max()
    assert float(gap) < 1e-11 * float((start.mass * jnp.abs(start.v[:, 1])).sum())


@pytest.mark.parametrize("method", ["explicit", *thorough("semi_implicit", "implicit_midpoint")])
def test_gradients_are_those_of_differences(method):
    """By stiffness, velocity and position, through a pressure that follows the surface."""
    region, inside = mpm.Box((0.2, 0.0), (0.4, 0.6)), mpm.Box((0.1, 0.0), (0.22, 0.6))
    start = cylinder(lower=(0.2, 0.0))
    scene = mpm.Scene(GRID, mpm.NeoHookean(1e4, 0.3), loads=mpm.Pressure(mpm.Patch(region, within=inside), 500.0))
    scene, method = mpm.attach(scene, start), (METHODS | SECOND_ORDER)[method]

    @jax.jit
    def outcome(theta):
        law = mpm.NeoHookean(1e4 * theta[0], 0.3)
        q = eqx.tree_at(lambda q: (q.x, q.v), start, (start.x * theta[2], start.v + theta[1]))
        final = mpm.rollout(eqx.tree_at(lambda s: s.material, scene, law), q, dt=2e-3, steps=4, method=method)
        return (final.x[:, 0] ** 2 * final.mass).sum() + 1e-2 * final.x[:, 1].max()

    at, h = jnp.array([1.0, 0.1, 1.0]), 1e-5
    numbers = jnp.stack([(outcome(at + h * e) - outcome(at - h * e)) / (2 * h) for e in jnp.eye(3)])
    assert_close(jax.jit(jax.grad(outcome))(at), numbers, 1e-6)


def test_the_stress_around_the_axis():
    """Of F = diag(a, b, c): that of the law in three dimensions; a viscous one by v_r/r."""
    law = mpm.Viscous(mpm.NeoHookean(1e4, 0.3), 20.0, 5.0)
    scene, particles = mpm.Scene(GRID, law), cylinder(lambda x: jnp.array([0.3, -0.2]) * x)
    F = jnp.diag(jnp.array([1.1, 0.9, 1.2]))
    particles = mpm.prepare(scene, particles)
    particles = eqx.tree_at(lambda q: q.deformations, particles, (jnp.broadcast_to(F, particles.F.shape),))
    law = mpm.NeoHookean(1e4, 0.3)
    elastic = law.stress(F[..., None])[..., 0] @ F.T / jnp.linalg.det(F)
    rate = jnp.diag(jnp.array([0.3, -0.2, 0.3]))
    viscous = 2 * 20 * (rate - jnp.trace(rate) / 3 * jnp.eye(3)) + 5 * jnp.trace(rate) * jnp.eye(3)
    sigma = mpm.stress(scene, particles)
    assert_close(sigma, jnp.broadcast_to(elastic + viscous, sigma.shape), 1e-10)


def test_the_scene_has_a_mirror_at_the_axis():
    """Where the window may reach it, once, after the boundaries of the user; it makes no difference who says so."""
    plane = mpm.SymmetryPlane(0, 0.0)
    scene = mpm.Scene(GRID, LAWS["neo_hookean"], boundary=mpm.SlipBox((-np.inf, 0.0), (np.inf, np.inf)))
    assert [type(b).__name__ for b in scene.boundary] == ["SlipBox", "SymmetryPlane"]
    assert eqx.tree_equal(scene.boundary[1], plane)
    assert len(mpm.Scene(GRID, LAWS["neo_hookean"], boundary=plane).boundary) == 1
    away = mpm.Grid((12, 14), 0.1, origin=(2, -3), axisymmetric=True)
    assert mpm.Scene(away, LAWS["neo_hookean"]).boundary == ()


def test_what_is_refused():
    law = LAWS["neo_hookean"]
    with pytest.raises(ValueError, match=re.escape("two directions, r and z")):
        mpm.Grid((8, 8, 8), 0.1, axisymmetric=True)
    with pytest.raises(ValueError, match=re.escape("no period along r")):
        mpm.Grid((8, 8), 0.1, axisymmetric=True, periodic=(True, False))
    with pytest.raises(ValueError, match="along the axis"):
        mpm.Scene(GRID, law, gravity=(-9.81, 0.0))
    couple = mpm.Couple(mpm.PointsAt(((0.1, 0.1), (0.3, 0.3))), 1.0)
    with pytest.raises(ValueError, match="cannot have Couple"):
        mpm.Scene(GRID, law, loads=couple)
    with pytest.raises(ValueError, match="cannot have Bodies"):
        mpm.Scene(GRID, (law, law), bodies=mpm.Bodies())
    with pytest.raises(ValueError, match="cannot grow"):
        mpm.Scene(GRID, law, boundary=mpm.RigidPart(mpm.Box((0, 0), (1, 0.1))), description=mpm.TotalLagrangian())
    with pytest.raises(ValueError, match="r > 0"):
        mpm.fill(mpm.Box((-0.2, 0.0), (0.4, 0.6)), GRID, density=1e3)


def test_files_and_scene_files_know_it(tmp_path):
    """A scene in TOML, a run in its file and its picture, which shows both sides of the axis."""
    path = tmp_path / "scene.toml"
    path.write_text("""
        gravity = [0.0, -9.81]
        [grid]
        shape = [10, 12]
        spacing = 0.1
        origin = [-3, -3]
        axisymmetric = true
        [material]
        kind = "NeoHookean"
        youngs_modulus = 1e4
        poisson_ratio = 0.3
        [[particles]]
        region = { kind = "Box", lower = [0.0, 0.0], upper = [0.4, 0.6] }
        density = 1e3
        [run]
        t1 = 4e-3
        dt = 1e-3
        """)
    scene, particles, _ = mpm.load_scene(path)
    assert scene.grid.axisymmetric
    run = mpm.simulate(scene, particles, dt=1e-3, t1=4e-3, save_every=2)
    mpm.save(tmp_path / "run.vtkhdf", run)
    again = mpm.load(tmp_path / "run.vtkhdf")
    assert eqx.tree_equal(again.final, run.final)
    assert again.scene.grid.axisymmetric
    mpm.render(run, tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 0


@pytest.mark.parametrize("description", ["updated", *thorough("total")])
@pytest.mark.parametrize("transfer", ["apic", *thorough("pic", "flip")])
def test_the_longest_step_is_stable_at_any_radius(description, transfer):
    """Of a ring alone on the grid the map of a step, by its Jacobian, has no eigenvalue beyond the unit circle at the
    bound, from the axis on; at twice the bound it has, so that the bound costs less than half the step."""
    scene = mpm.Scene(GRID, LAWS["neo_hookean"], transfer=TRANSFERS[transfer], description=DESCRIPTIONS[description])
    scene, one = canonical(scene, jnp.float64), jnp.ones(1)
    ring = mpm.prepare(scene, mpm.Particles(jnp.array([[0.05, 0.23]]), jnp.zeros((1, 2)), one, 1e-3 * one))

    @eqx.filter_jit
    def largest(r, factor):
        at = eqx.tree_at(lambda q: q.x, ring, ring.x.at[0, 0].set(r))
        at = at if at.X is None else eqx.tree_at(lambda q: q.X, at, at.x)
        dt = factor * mpm.stable_dt(scene, at, safety=1.0)
        flat, back = ravel_pytree(state_of(at))

        def step(flat):
            end, _ = step_unchecked(scene, with_state(at, back(flat)), 0.0, dt, mpm.Explicit())
            return ravel_pytree(state_of(end))[0]

        return jnp.abs(jnp.linalg.eigvals(jax.jacfwd(step)(flat))).max()

    for r in jnp.asarray([0.002, 0.025, 0.049, 0.051, 0.075, 0.14, 0.26]):
        assert float(largest(r, jnp.asarray(0.999))) < 1 + 1e-6, r
        assert float(largest(r, jnp.asarray(2.0))) > 1.1, r
