"""The implicit updates: what they solve, how they relate, and what they report."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import ELASTIC, LAWS, assert_close, block, explicit_limit, ids, thorough
from numpy_oracle import grid_update, stress

import mpmjax as mpm
from mpmjax._types import Array
from mpmjax.implicit import ImplicitOperator, Projection, SolveInfo, StageProblem, no_solve, solve
from mpmjax.implicit._solver import solve_linear
from mpmjax.implicit._stage import MOST_HALVINGS, backtrack

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
NEWTON = mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12))


def jolted(speed=0.3, side=3, dtype="float64", **scene):
    """A block with random velocities and some strain."""
    scene, particles = block(2, side=side, **scene)
    rng = np.random.default_rng(0)
    shape = particles.x.shape
    v, F = speed * rng.normal(size=shape), np.eye(2) + 0.05 * rng.normal(size=(*shape, 2))
    arrays = (particles.x, v, particles.mass, particles.volume, F)
    x, v, mass, volume, F = (jnp.asarray(a, dtype) for a in arrays)
    return scene, mpm.prepare(scene, mpm.Particles(x, v, mass, volume, (F,), X=x))


def stage(nodes, theta=1.0, displacement=None, *, linearised=False):
    """The equation of a stage of the whole step."""
    action = mpm.implicit.AnalyticHessian().at(nodes.potential, None) if linearised else None
    return StageProblem(
        mass=nodes.mass,
        inertial=nodes.inertial_velocity(),
        stage_dt=nodes.dt,
        initial_displacement=displacement,
        force=nodes.force if action is None or displacement is None else nodes.force - action(displacement),
        spacing=nodes.spacing,
        potential=nodes.potential,
        hessian=mpm.implicit.AnalyticHessian(),
        projection=nodes.projection,
        prescribed=nodes.prescribed,
        preconditioner=mpm.implicit.MassPreconditioner(),
        theta=theta,
        action=action,
    )


def squeezed(rate):
    """A neo-Hookean block whose two halves rush at each other, at a rate [1/s] of compression along x."""
    scene, particles = block(2, material=LAWS["neo_hookean"])
    v = -rate * (particles.x - particles.x.mean(axis=0)) * jnp.array([1.0, 0.0])
    return scene, mpm.Particles(particles.x, v, particles.mass, particles.volume)


@pytest.mark.parametrize("law", ["neo_hookean", "fluid", *thorough("fixed_corotated", "in_total")])
def test_beta_zero_from_the_explicit_velocity_is_the_explicit_step(law):
    """To rounding, and without an iteration; what a law gives to P2G in place of its stress is the same."""
    options = {"gravity": (0.0, -9.81)} | ({} if law == "fluid" else {"boundary": mpm.SlipBox((0, 0), (1, 1))})
    if law == "in_total":
        options["description"] = mpm.TotalLagrangian()
    scene, particles = jolted(**options, **({"material": LAWS[law]} if law in LAWS else {}))
    if law == "fluid":
        scene = mpm.Scene(scene.grid, mpm.Fluid(1e4, tension=True), **options)
        F = jnp.linalg.det(particles.F)
        particles = mpm.prepare(scene, mpm.Particles(particles.x, particles.v, particles.mass, particles.volume, (F,)))
    explicit, _ = mpm.step(scene, particles, 0.0, 5e-3)
    method = mpm.SemiImplicit(beta=0.0, guess=mpm.implicit.Guess.EXPLICIT)
    new, info = mpm.step(scene, particles, 0.0, 5e-3, method=method)
    assert info.solve.iterations == 0
    assert info.solve.converged
    for name in ("x", "v", "F", "C"):
        assert_close(getattr(new, name), getattr(explicit, name), 1e-14)


@pytest.mark.thorough
def test_beta_one_is_one_newton_step_of_backward_euler():
    """Newton from rest linearises where the semi-implicit step does."""
    scene, particles = jolted(gravity=(0.0, -9.81), boundary=mpm.StickyBox((0, 0), (1, 1)))
    once = mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, max_steps=1), guess=mpm.implicit.Guess.ZERO)
    a, info = mpm.step(scene, particles, 0.0, 2e-2, method=once)
    b, _ = mpm.step(scene, particles, 0.0, 2e-2, method=mpm.SemiImplicit(beta=1.0, solver=TIGHT))
    assert info.solve.newton == 1
    assert info.solve.line_search == 0
    assert not info.solve.converged
    for name in ("x", "v", "F", "C"):
        assert_close(getattr(a, name), getattr(b, name), 1e-11)


@pytest.mark.parametrize("law", **ids(LAWS, "neo_hookean"))
def test_backward_euler_satisfies_its_equation(law):
    """M (v − v^n) = Δt f(F^{n+1}) + Δt M g on free nodes, the force by NumPy from the particles after the step."""
    gravity = np.array([1.0, -9.81])
    scene, particles = jolted(material=law, gravity=tuple(gravity), boundary=mpm.StickyBox((0, 0), (1, 1)))
    dt = 2e-2
    grid = grid_update(scene, particles, dt, NEWTON)
    assert grid.info.solve.converged
    assert 2 <= grid.info.solve.newton < 10
    assert grid.info.solve.iterations > grid.info.solve.newton
    nodes, stencil = grid.nodes, grid.nodes.potential.stencil
    force = np.zeros(grid.velocity.shape)
    mu, lam = float(law.shear_modulus), float(law.lame_lambda)
    for p, F in enumerate(np.asarray(grid.particles.F)):
        flux = float(particles.volume[p]) * stress(law, mu, lam, F) @ np.asarray(particles.F[p]).T
        for k, i in enumerate(np.asarray(stencil.index[:, p])):
            force[i] -= flux @ np.asarray(stencil.gradient[k, :, p])
    mass, free = np.asarray(nodes.mass)[:, None], np.asarray(nodes.free)
    inertia = mass * np.asarray(grid.velocity - nodes.velocity)
    residual = inertia - dt * (force + mass * gravity)
    assert free.any()
    assert np.abs(residual[free]).max() < 1e-11 * np.abs(inertia[free]).max()


@pytest.mark.thorough
def test_semi_implicit_and_backward_euler_agree_as_the_step_falls():
    """The linearised force misses terms of second order in the displacement: Δt³ in the velocity of one step."""
    scene, particles = jolted(speed=1.0)

    def gap(dt):
        linear, _ = mpm.step(scene, particles, 0.0, dt, method=mpm.SemiImplicit(solver=TIGHT))
        full, info = mpm.step(scene, particles, 0.0, dt, method=NEWTON)
        assert info.solve.converged
        return float(jnp.abs(linear.v - full.v).max())

    gaps = np.array([gap(2e-3 / 2**k) for k in range(3)])
    orders = np.log2(gaps[:-1] / gaps[1:])
    assert (np.abs(orders - 3) < 0.2).all(), orders


@pytest.mark.parametrize(
    "method", [*thorough(mpm.SemiImplicit), pytest.param(mpm.BackwardEuler, marks=pytest.mark.slow)]
)
def test_the_two_hessians_give_the_same_step(method):
    """Analytic differential or jvp of the energy's gradient."""
    scene, particles = jolted(material=LAWS["neo_hookean"])
    options = {"solution": NEWTON.solution} if method is mpm.BackwardEuler else {"solver": TIGHT}
    a, _ = mpm.step(scene, particles, 0.0, 2e-2, method=method(hessian=mpm.implicit.AnalyticHessian(), **options))
    b, _ = mpm.step(scene, particles, 0.0, 2e-2, method=method(hessian=mpm.implicit.JvpHessian(), **options))
    for name in ("x", "v", "F", "C"):
        assert_close(getattr(a, name), getattr(b, name), 1e-11)


@pytest.mark.parametrize(
    "guess",
    [*thorough(mpm.implicit.Guess.GRID_VELOCITY, mpm.implicit.Guess.EXPLICIT, mpm.implicit.Guess.ZERO)],
    ids=lambda g: g.name.lower(),
)
def test_backward_euler_withstands_a_guess_that_inverts_the_material(guess):
    """A compression that would turn cells inside out in the step ends at an admissible state, whatever the guess."""
    scene, particles = squeezed(rate=50.0)
    new, info = mpm.step(
        scene, particles, 0.0, 0.05, method=mpm.BackwardEuler(mpm.implicit.Newton(max_steps=60), guess=guess)
    )
    assert info.solve.converged
    assert np.isfinite(np.asarray(new.x)).all()
    assert (np.linalg.det(np.asarray(new.F)) > 0).all()


@pytest.mark.thorough
def test_line_search_backtracks_and_saves_what_one_newton_step_would_invert():
    """In a violent compression the full Newton step overshoots; the semi-implicit one inverts the material."""
    scene, particles = squeezed(rate=150.0)
    linear, _ = mpm.step(scene, particles, 0.0, 0.05, method=mpm.SemiImplicit())
    method = mpm.BackwardEuler(guess=mpm.implicit.Guess.ZERO)
    new, info = mpm.step(scene, particles, 0.0, 0.05, method=method)
    assert np.linalg.det(np.asarray(linear.F)).min() < 0
    assert info.solve.line_search > 0
    assert info.solve.converged
    assert (np.linalg.det(np.asarray(new.F)) > 0).all()


RUBBER = mpm.NeoHookean(1e4, 0.49)  # whose stress falls from a stretch of about 4 to one of 7


@pytest.mark.thorough
@pytest.mark.parametrize("law", [RUBBER, ELASTIC["hencky"]], ids=["neo_hookean", "hencky"])
def test_newton_goes_downhill_from_where_the_energy_is_concave(law):
    """A bar let go at a stretch at which its law softens, at ten times the explicit limit: Newton's direction leads
    uphill there, and a step along the slope comes to rest undeformed, not beyond an inversion, where Hencky's formula
    has a value and the law has none."""
    scene, particles = block(1, material=law)
    stretched = eqx.tree_at(lambda q: q.F, mpm.prepare(scene, particles), jnp.full((particles.count, 1, 1), 5.0))
    new, info = mpm.step(scene, stretched, 0.0, 10 * explicit_limit(block(1)[0]), method=mpm.BackwardEuler())
    assert info.solve.indefinite
    assert info.solve.converged
    np.testing.assert_allclose(new.F, 1, atol=0.01)


@pytest.mark.thorough
def test_newton_starts_from_the_linearised_system_where_nothing_else_is_admissible():
    """A grip that closes more than the gap to its neighbours in a step inverts them by itself, and so does rest."""
    grip = mpm.Grip(mpm.Box((0.25,), (2.0,)), mpm.Motion((0.0, 1.0), ((0.0,), (-0.5,))))
    scene, particles = block(1, material=LAWS["neo_hookean"], boundary=grip)
    for guess in (mpm.implicit.Guess.GRID_VELOCITY, mpm.implicit.Guess.ZERO):
        new, info = mpm.step(scene, particles, 0.0, 0.5, method=mpm.BackwardEuler(NEWTON.solution, guess=guess))
        assert info.solve.converged
        assert 0.97 < np.asarray(new.F).min() <= np.asarray(new.F).max() < 1
        np.testing.assert_allclose(new.v, -0.5, atol=0.02)


@pytest.mark.thorough
def test_newton_starts_from_rest_where_the_potential_is_lower_there():
    """As from the explicit velocity at 20 times the limit: the same path as from rest, to the last bit. From the grid's
    velocity, where it is not, another one."""
    scene, particles = block(1)  # fixed corotated, whose energy is finite everywhere
    F = 1 + 0.05 * np.random.default_rng(0).normal(size=(particles.count, 1, 1))
    moving = jnp.ones_like(particles.v)
    particles = eqx.tree_at(lambda q: (q.v, q.F), mpm.prepare(scene, particles), (moving, jnp.asarray(F)))
    nodes = grid_update(scene, particles, 20 * explicit_limit(scene), mpm.Explicit()).nodes
    move = eqx.filter_jit(lambda guess: NEWTON.advance(nodes, guess))
    rest, far, near = map(move, (0 * nodes.velocity, nodes.explicit_velocity(), nodes.velocity))
    jax.tree.map(np.testing.assert_array_equal, rest, far)
    for motion, info in (rest, near):
        assert info.converged
        assert_close(motion.velocity, rest[0].velocity, 1e-9)
    assert near[1].residual != rest[1].residual


@pytest.mark.thorough
def test_the_derivative_of_a_newton_step_with_a_projected_hessian_is_the_equations():
    """That of the true Hessian, where it is not positive: a projection changes Newton's way alone."""
    scene, particles = block(1, material=RUBBER)
    stretched = eqx.tree_at(lambda q: q.F, mpm.prepare(scene, particles), jnp.full((particles.count, 1, 1), 5.0))
    dt = 0.05 * explicit_limit(block(1)[0])

    def end(rate, hessian):
        pulled = eqx.tree_at(lambda q: q.v, stretched, rate * stretched.x)
        return mpm.step(scene, pulled, 0.0, dt, method=mpm.BackwardEuler(NEWTON.solution, hessian=hessian))[0].x[-1, 0]

    exact, projected = (
        jax.jvp(lambda rate, h=h: end(rate, h), (jnp.asarray(0.1),), (jnp.asarray(1.0),))
        for h in (mpm.implicit.AnalyticHessian(), mpm.implicit.AnalyticHessian(projected=True))
    )
    assert_close(projected[0], exact[0], 1e-11)
    assert_close(projected[1], exact[1], 1e-7)


@pytest.mark.thorough
def test_newton_gives_up_after_thirty_halvings():
    """Where no velocity is admissible: two grips that pass through each other."""
    ends = ((-2.0, 0.05, 1.0), (0.25, 2.0, -1.0))
    grips = [mpm.Grip(mpm.Box((a,), (b,)), mpm.Motion((0.0, 1.0), ((0.0,), (v,)))) for a, b, v in ends]
    scene, particles = block(1, material=LAWS["neo_hookean"], boundary=tuple(grips))
    _, info = mpm.step(scene, particles, 0.0, 0.5, method=mpm.BackwardEuler())
    assert not info.solve.converged
    assert info.solve.newton == 1
    assert info.solve.line_search == 30


def test_reports_of_two_solves_are_added_up():
    """Costs are summed and negative curvature is remembered; the quality is that of the later, or of the worse one."""
    names = [field.name for field in dataclasses.fields(SolveInfo)]
    one, two = (
        SolveInfo(**dict(zip(names, map(jnp.asarray, values), strict=True)))
        for values in ((5, 2, 1, 0.3, False, True, True, 0.0), (7, 3, 4, 0.1, True, False, False, 0.0))
    )
    for first, second in ((one, two), (two, one)):
        after, both = first.followed_by(second), first.together_with(second)
        for total in (after, both):
            assert (total.iterations, total.newton, total.line_search, total.indefinite) == (12, 5, 5, True)
        assert (after.residual, after.converged) == (second.residual, second.converged)
        assert after.nearly_converged == second.nearly_converged
        assert (both.residual, both.converged, both.nearly_converged) == (0.3, False, True)
    beyond = eqx.tree_at(lambda info: info.nearly_converged, one, jnp.asarray(False))
    assert not beyond.together_with(one).nearly_converged


@pytest.mark.parametrize(("theta", "displacement"), [(0.6, 1e-3), *thorough((1.0, 0.0))])
def test_a_stage_is_the_gradient_of_its_incremental_potential(theta, displacement):
    """And its operator the gradient's derivative, at any share of the displacement, with viscosity. What is linearised
    where nothing is displaced has the same residual and operator there."""
    scene, particles = jolted(material=mpm.Viscous(LAWS["neo_hookean"], 2.0, 1.0))
    nodes = grid_update(scene, particles, 5e-3, mpm.SemiImplicit()).nodes
    rng = np.random.default_rng(1)
    v, along, u = (jnp.where(nodes.free, jnp.asarray(a), 0) for a in rng.normal(size=(3, *nodes.force.shape)))

    @jax.jit
    def differences(v, along, u):
        problem = stage(nodes, theta, u)
        h = 1e-4
        energies = [problem.incremental_potential(v + k * h * along) for k in (-2, -1, 1, 2)]
        slope = (energies[0] - 8 * energies[1] + 8 * energies[2] - energies[3]) / (12 * h)
        change = jax.jvp(problem.residual, (v,), (along,))[1]
        rest = problem.undisplaced_velocity()
        linear = stage(nodes, theta, u, linearised=True)
        return (
            (slope, (problem.residual(v) * along).sum()),
            (change, problem.operator(v).mv(along)),
            (linear.residual(rest), problem.residual(rest)),
            (linear.operator(v).mv(along), problem.operator(rest).mv(along)),
        )

    slopes, *pairs = differences(0.3 * v, along, displacement * u)
    np.testing.assert_allclose(*slopes, rtol=1e-7)
    for one, other in pairs:
        assert_close(one, other, 1e-10)


@pytest.mark.parametrize("times", thorough(1, 20, 100))
def test_single_precision_converges_and_says_how_far(times):
    """The residual it states is the true one, evaluated in double precision; and the iteration does not wander: at 100
    times the limit it starts from 288 times the right-hand side, of which its own residual keeps a rounding. (H is
    indefinite there: one start in sixty wanders to the last step, before and after any change of roundings, and none
    with a projected Hessian.)"""
    scene, particles = jolted(speed=0.9, side=4, dtype="float32")
    method = mpm.SemiImplicit(preconditioner=mpm.implicit.MassPreconditioner())  # whose norm is taken below
    grid = grid_update(scene, particles, times * explicit_limit(scene), method)
    assert grid.velocity.dtype == jnp.float32
    assert grid.info.solve.converged
    assert grid.info.solve.iterations < 300
    widen = lambda a: a.astype(jnp.float64) if a.dtype == jnp.float32 else a  # noqa: E731
    nodes = jax.tree.map(widen, grid.nodes)
    problem = stage(nodes, linearised=True)

    def norm(a):
        return float(jnp.sqrt((a**2 / jnp.where(nodes.occupied, nodes.mass[:, None], 1)).sum()))

    true = norm(problem.residual(widen(grid.velocity))) / norm(
        problem.mass[:, None] * problem.inertial + problem.stage_dt * problem.force
    )
    assert abs(float(grid.info.solve.residual) / true - 1) < 0.05
    assert true < {1: 1e-5, 20: 5e-4, 100: 1e-2}[times]


@pytest.mark.thorough
def test_an_unconverged_solve_is_reported():
    """Too few iterations: converged is false and the residual says by how much."""
    scene, particles = jolted()
    method = mpm.SemiImplicit(solver=mpm.implicit.ConjugateResidual(max_steps=3))
    _, info = mpm.step(scene, particles, 0.0, 0.1, method=method)
    assert not info.solve.converged
    assert info.solve.iterations == 3
    assert info.solve.residual > 1e-8
    _, info = mpm.step(scene, particles, 0.0, 0.1, method=mpm.BackwardEuler(mpm.implicit.Newton(max_steps=1)))
    assert not info.solve.converged


@pytest.mark.thorough
@pytest.mark.parametrize("method", [mpm.SemiImplicit(), mpm.BackwardEuler()], ids=["semi_implicit", "backward_euler"])
def test_an_overflow_is_not_a_solution(method):
    """A velocity whose momentum overflows is seen in the state and in the report; it does not turn into rest."""
    scene, particles = block(1)
    wild = mpm.Particles(particles.x, particles.v.at[0].set(jnp.asarray(1e308)), 10 * particles.mass, particles.volume)
    new, info = mpm.step(scene, wild, 0.0, 1e-2, method=method)
    assert not np.isfinite(new.x).all()
    assert not info.solve.converged


@pytest.mark.parametrize("beta", [-0.1, 1.1, np.nan])
def test_beta_must_lie_between_zero_and_one(beta):
    """Anything else is refused."""
    with pytest.raises(ValueError, match="beta"):
        mpm.SemiImplicit(beta=beta)


def column(d, dtype, gravity):
    """A neo-Hookean column of two cells a side on the floor that holds it, at rest and undeformed."""
    scene, particles = block(
        d,
        side=2,
        material=mpm.NeoHookean(1e6, 0.3),
        gravity=jnp.asarray((0.0,) * (d - 1) + (gravity,), dtype),
        boundary=mpm.StickyBox((-np.inf,) * (d - 1) + (0.05,), (np.inf,) * d),
    )
    arrays = (particles.x, particles.v, particles.mass, particles.volume)
    return scene, mpm.prepare(scene, mpm.Particles(*(a.astype(dtype) for a in arrays)))


AT_REST = [
    ("backward_euler", 1, "float64"),
    ("backward_euler", 2, "float32"),
    ("trbdf2", 1, "float32"),
    pytest.param("trbdf2", 2, "float64", marks=pytest.mark.slow),
    pytest.param("backward_euler", 3, "float32", marks=pytest.mark.slow),
]


@pytest.mark.thorough
@pytest.mark.parametrize(("method", "d", "dtype"), AT_REST)
def test_newton_knows_a_body_at_rest(method, d, dtype):
    """A column that has come to rest under its weight, or without any: forces cancel, and what is left is rounding.
    Every step converges, from the third of them to rest in no more than three Newton steps a solve."""
    newton = {"backward_euler": mpm.BackwardEuler(), "trbdf2": mpm.TRBDF2(solution=mpm.implicit.Newton())}[method]
    most = {"backward_euler": 3, "trbdf2": 6}[method]
    for gravity in (-9.81, 0.0):
        for dt in (1e-2, 1.0, 10.0, 1e4):
            scene, particles = column(d, dtype, gravity)
            for n in range(12):
                particles, info = mpm.step(scene, particles, n * dt, dt, method=newton)
                assert info.solve.converged, (gravity, dt, n)
                if dt >= 1 and n >= 6:
                    assert info.solve.newton <= most
                    assert info.solve.residual < 1e-2
            if gravity and dt >= 1:
                assert np.abs(np.asarray(particles.F) - np.eye(d)).max() > 1e-4


@pytest.mark.thorough
@pytest.mark.parametrize("preconditioner", [mpm.implicit.DiagonalPreconditioner(), mpm.implicit.MassPreconditioner()])
def test_rounding_alone_accepts_no_guess(preconditioner):
    """Free fall in single precision, of a body so stiff that a step's weight is below the rounding of its forces."""
    scene, particles = block(
        2, side=2, material=mpm.NeoHookean(1e9, 0.3), gravity=jnp.asarray((0.0, -0.5), jnp.float32)
    )
    arrays = (particles.x, particles.v, particles.mass, particles.volume)
    fallen = mpm.prepare(scene, mpm.Particles(*(a.astype(jnp.float32) for a in arrays)))
    dt, method = 1e-2, mpm.BackwardEuler(preconditioner=preconditioner)
    for n in range(4):
        fallen, info = mpm.step(scene, fallen, n * dt, dt, method=method)
        assert info.solve.converged
        np.testing.assert_allclose(
            fallen.mass @ fallen.v / fallen.mass.sum(), [0, -0.5 * (n + 1) * dt], rtol=0.01, atol=1e-4
        )


STEPS_TRIED = {
    "the whole": ([-1.0], 0.0, 0),
    "a quarter, by a decrease of 10⁻⁴ of its own length": ([1.0, 1.0, -1.1e-4 / 4], 0.0, 2),
    "not one below that": ([1.0, -0.9e-4 / 2, 1.0, -1.1e-4 / 8], 0.0, 3),
    "within the slack": ([0.1, 0.04], 0.05, 1),
    "not where it is no number": ([np.nan, np.inf, -1.0], 0.0, 2),
    "none": ([1.0] * MOST_HALVINGS + [2.0], 0.0, MOST_HALVINGS),
}


@pytest.mark.parametrize("name", STEPS_TRIED)
def test_the_line_search_takes_the_first_sufficient_decrease(name):
    """E(0) = 3 and E'(0) = −1, E − E(0) at 1, ½, ¼, ... given."""
    rises, slack, wanted = STEPS_TRIED[name]
    at = jnp.asarray(rises)

    def merit(size):
        return 3 + at[jnp.round(-jnp.log2(size)).astype(int)]

    size, halvings = backtrack(merit, jnp.asarray(3.0), jnp.asarray(-1.0), jnp.asarray(slack))
    assert halvings == wanted
    assert size == 0.5**wanted


class Curvature(ImplicitOperator):
    """A small dense matrix."""

    def precomputed(self):
        return self

    def diagonal(self):
        return jnp.abs(jnp.diag(self.hessian)).reshape(self.projection.free.shape)

    def unconstrained(self, v):
        return (self.hessian @ v.reshape(-1)).reshape(v.shape)


class OneEquation(StageProblem):
    """E'(v) = 0 of a polynomial E that nothing admits outside of an interval, beside an inertial velocity a."""

    polynomial: Array
    admitted: Array

    def __init__(self, polynomial, admitted, a):
        one, every = jnp.ones(()), Projection(jnp.ones((1, 1), bool))
        self.polynomial, self.admitted, self.projection = polynomial, admitted, every
        self.mass, self.inertial, self.stage_dt, self.spacing, self.theta = one[None], a[None, None], one, one, one
        self.initial_displacement = self.force = self.potential = self.prescribed = self.action = self.hessian = None
        self.preconditioner = mpm.implicit.MassPreconditioner()

    def at(self, v, order=0):
        return jnp.polyval(self.polynomial if order == 0 else jnp.polyder(self.polynomial, order), v)

    def incremental_potential(self, v):
        low, high = self.admitted
        return jnp.where((v >= low) & (v <= high), self.at(v), jnp.nan)[0, 0]

    def momentum_residual(self, v):
        return self.at(v, 1)

    def operator(self, v, hessian=None):
        return Curvature(self.mass, 1.0, self.at(v, 2), self.projection)


class Dense(mpm.implicit.AbstractInnerProductSolver):
    """The solution of a dense system, of which it says what it is told to say."""

    converges: Array
    indefinite: Array | bool = False
    nearly: Array | bool = False

    def init(self, operator, options):
        return operator

    def compute(self, state, vector, options):
        x = jnp.linalg.solve(state.as_matrix(), vector.reshape(-1)).reshape(vector.shape)
        result = lx.RESULTS.where(self.converges, lx.RESULTS.successful, lx.RESULTS.stagnation)
        stats = {"num_steps": 1, "residual": 0.5, "spectral_radius": 1.0}
        stats |= {"nearly_converged": self.nearly, "indefinite": self.indefinite}
        return x, result, jax.tree.map(jnp.asarray, stats)

    def transpose(self, state, options):
        return state, options

    conj = transpose

    def assume_full_rank(self):
        return True


WELLS, QUARTIC = (0.25, 0.0, -0.5, 0.3, 0.0), (0.25, 0.0, 0.0, -1.0, 0.0)
PARABOLA, HILL, STEEP = (0.0, 0.0, 0.5, -1.0, 0.5), (0.0, 0.0, -0.5, 1.0, -0.5), (0.0, 0.0, 0.0, np.inf, 0.0)
ANY, LARGE, EXACT = (-np.inf, np.inf), 1e12, 1e-20
"""Beside an inertial velocity of 1e12 a residual of 8e-4 is rounding."""
ENDS = {
    # E, where it is admitted, a, the guess, rtol, whether linear solves converge, and whether one meets a negative
    # curvature; the solution, Newton steps, halvings, whether it converged, and nearly
    "rest is lower, and E falls to its left": (
        (WELLS, ANY, 1.0, 2.0, 1e-12, True, True),
        (-1.12541878, 7, 0, True, False),
    ),
    "rounding": ((QUARTIC, (0.5, 2.0), LARGE, 1.015, EXACT, True, False), (1.000221, 1, 0, True, False)),
    "rounding, where E was concave": ((QUARTIC, (0.5, 2.0), LARGE, 1.015, EXACT, True, True), (1, 2, 0, True, False)),
    "rounding, by a poor step": ((QUARTIC, (0.5, 2.0), LARGE, 1.0002, EXACT, False, True), (1, 3, 0, True, False)),
    "rounding, by half a step": (
        (PARABOLA, (0.5, 1 - 1e-4), LARGE, 1 - 2e-4, EXACT, True, True),
        (0.9999, 2, 31, False, False),
    ),
    "rounding, uphill": ((HILL, (0.5, 2.0), LARGE, 1 + 1e-4, EXACT, True, True), (2, 30, 269, False, False)),
    "where E vanishes but for rounding": ((PARABOLA, ANY, 1.0, 1 - 1e-9, 1e-12, True, False), (1, 1, 0, True, False)),
    "nothing beyond is admitted": ((PARABOLA, (0.0, 0.5), 5.0, 0.5, 1e-9, True, True), (0.5, 1, 30, False, False)),
    "nor is it, within ten times": ((PARABOLA, (0.0, 0.5), 5.0, 0.5, 0.0501, True, True), (0.5, 1, 30, False, True)),
    "nor is it, beyond that": ((PARABOLA, (0.0, 0.5), 5.0, 0.5, 0.0499, True, True), (0.5, 1, 30, False, False)),
    "not finite": ((STEEP, ANY, 1.0, 0.5, 1e-12, True, True), (np.nan, 0, 0, False, False)),
}


@jax.jit
def solved(polynomial, admitted, a, guess, rtol, converges, indefinite):
    newton = mpm.implicit.Newton(Dense(converges, indefinite), rtol)
    v, info = newton(OneEquation(polynomial, admitted, a), guess[None, None])
    return (v[0, 0], info.newton, info.line_search, info.converged, info.nearly_converged), info.residual


@pytest.mark.parametrize("name", ENDS)
def test_newton_ends_at_a_solution_or_says_that_it_does_not(name):
    """Where it starts, which way it goes, and what it takes for rounding, of one equation. The residual is relative to
    that of rest or to the inertia."""
    given, wanted = ENDS[name]
    found, residual = solved(*map(jnp.asarray, given))
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    if np.isfinite(wanted[0]):
        slope = np.polyder(given[0])
        size = max(abs(slope[-1]), given[2])
        np.testing.assert_allclose(residual, abs(np.polyval(slope, float(found[0]))) / size, rtol=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_another_solver_tells_whether_it_met_negative_curvature(sign):
    """By the solution: bᵀA⁻¹b < 0."""
    operator = Curvature(jnp.ones(1), 1.0, jnp.diag(jnp.asarray([3.0, sign])), Projection(jnp.ones((1, 2), bool)))
    inner = mpm.implicit.DiagonalInnerProduct(jnp.asarray([[2.0, 0.5]]))
    for rhs, negative in (([[1.0, 3.0]], sign < 0), ([[3.0, 1.0]], False)):
        x, info, _ = solve_linear(lx.LU(), operator, jnp.asarray(rhs), inner)
        assert_close(x, np.asarray(rhs) / [3.0, sign])
        assert info.indefinite == negative
        assert info.converged


class Sliding(StageProblem):
    """A v = f of one node along a surface at an angle to x, across which it has a speed, or none as at rest."""

    A: Array
    f: Array

    def __init__(self, q, rests):
        self.A, (*f, angle, speed), one = jnp.asarray([[3.0, 1.0], [1.0, 2.0]], q.dtype), q, jnp.ones((), q.dtype)
        normal = jnp.stack([-jnp.sin(angle), jnp.cos(angle)])[None]
        self.f, self.projection = jnp.stack(f), Projection(jnp.ones((1, 2), bool), (normal,))
        self.prescribed = None if rests else speed * normal
        self.mass, self.preconditioner = one[None], mpm.implicit.MassPreconditioner()
        self.inertial = self.stage_dt = self.spacing = self.initial_displacement = self.force = self.potential = None
        self.hessian = self.theta = self.action = None

    def momentum_residual(self, v):
        return (self.A @ v[0] - self.f)[None]

    def operator(self, v, hessian=None):
        return Curvature(self.mass, 1.0, self.A, self.projection)

    def exact(self):
        normal = self.projection.normals[0][0]
        along = jnp.stack([normal[1], -normal[0]])
        held = 0 * normal if self.prescribed is None else self.prescribed[0]
        return held + along * (along @ (self.f - self.A @ held)) / (along @ self.A @ along)


def solved_exactly(problem, guess):
    return problem.exact()[None], no_solve(guess.dtype)


def ruled(q, rests, adjoint):
    """The solution, and the report of the tangent solve."""
    v, info = solve(Sliding(q, rests), jnp.zeros((), q.dtype), jnp.zeros((1, 2), q.dtype), solved_exactly, adjoint)
    return v[0], info.report


@partial(jax.jit, static_argnums=0)
def differentiated(rests, q, dq, converges, nearly):
    """The tangent of the solution and of the report by the rule, the pull-back of a cotangent, and the Jacobian."""
    by_rule = lambda q: ruled(q, rests, Dense(converges, nearly=nearly))  # noqa: E731
    pulled = jax.vjp(lambda q: by_rule(q)[0], q)[1](COTANGENT)[0]
    return *jax.jvp(by_rule, (q,), (dq,))[1], pulled, jax.jacfwd(lambda q: Sliding(q, rests).exact())(q)


COTANGENT = jnp.asarray([1.0, -2.0])


@pytest.mark.parametrize("rests", [True, *thorough(False)])
def test_the_derivative_of_a_stage_is_that_of_its_solution_or_none(rests):
    """By force, normal and speed of what holds a node. A tangent solve that ends nearly at its tolerance is taken; of
    one that does not there is NaN and a report, none of those after it."""
    q, dq = jnp.asarray([1.0, -0.5, 0.3, 0.7]), jnp.asarray([0.2, 0.4, -0.3, 0.5])
    for nearly in (False, True):
        change, report, pulled, exact = differentiated(rests, q, dq, jnp.asarray(not nearly), jnp.asarray(nearly))
        assert_close(change, exact @ dq, 1e-13)
        assert_close(pulled, COTANGENT @ exact, 1e-13)
        assert report == 0
    for direction, told in ((dq, 0.5), (jnp.nan * dq, 0.0)):
        change, report, pulled, _ = differentiated(rests, q, direction, jnp.asarray(False), jnp.asarray(False))
        assert np.isnan([*change, *pulled[:2]]).all()
        assert report == told


@pytest.mark.parametrize(("dtype", "rtol"), [("float32", 1e-6), ("float64", 1e-8)])
def test_a_derivative_is_asked_for_to_six_digits_or_more(dtype, rtol):
    asked = []

    class Asked(Dense):
        def compute(self, state, vector, options):
            asked.append(options["rtol"])
            return super().compute(state, vector, options)

    q = jax.ShapeDtypeStruct((4,), dtype)
    jax.eval_shape(lambda q: jax.jvp(lambda q: ruled(q, True, Asked(jnp.asarray(True))), (q,), (q,)), q)
    assert set(asked) == {rtol}
