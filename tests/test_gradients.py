"""Derivatives of whole rollouts, with respect to everything at once."""

import functools

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, LAWS, assert_close

import mpmjax as mpm

TIGHT = mpm.ConjugateResidual(rtol=1e-12)
DX, DT, STEPS = 0.1, 1e-2, 10
OPTIONS = {
    mpm.Explicit: {},
    mpm.SemiImplicit: {"solver": TIGHT, "adjoint_solver": TIGHT},
    mpm.BackwardEuler: {"rtol": 1e-13, "solver": TIGHT, "adjoint_solver": TIGHT},
}
CASES = [(m, d) for m in OPTIONS for d in DESCRIPTIONS]


def parameters(d=2):
    """All that a rollout of a small block is differentiated in, from rest in F: a stiffness per particle, Poisson's
    ratio, places, velocities, gravity, the motion of the grip, β."""
    rng = np.random.default_rng(1)
    place = mpm.fill(mpm.Box((0.0,) * d, (0.2,) * d), mpm.Grid((8,) * d, DX), particles_per_cell=2**d, density=1e3).x
    return {
        "E": jnp.asarray(1e4 * rng.uniform(0.8, 1.2, len(place))),
        "nu": jnp.asarray(0.3),
        "x": place + 0.004,
        "v": jnp.asarray(0.3 * rng.normal(size=place.shape)),
        "gravity": jnp.asarray([1.0, -9.81, 3.0][:d]),
        "displacement": jnp.asarray([[0.0] * d, [-0.4, 0.3, 0.2][:d]]),
        "beta": jnp.asarray(0.8),
    }


def direction(seed=5):
    """A random direction, in units of each parameter."""
    rng = np.random.default_rng(seed)
    unit = {"E": 1e4, "nu": 0.3, "x": 0.03, "v": 0.3, "gravity": 10.0, "displacement": 0.4, "beta": 0.5}
    return {k: jnp.asarray(unit[k] * rng.normal(size=a.shape)) for k, a in parameters().items()}


def model(parameters, method, description="updated", law=mpm.FixedCorotated):
    """Scene, particles and method of the parameters."""
    q, d = parameters, parameters["x"].shape[1]
    grip = mpm.Grip(mpm.Box((-1.0,) * d, (0.05, *(1.0,) * (d - 1))), mpm.Motion((0.0, 1.0), q["displacement"]))
    scene = mpm.Scene(
        mpm.Grid((8,) * d, DX, origin=(-3,) * d),
        law(q["E"], q["nu"]),
        gravity=q["gravity"],
        boundary=grip,
        description=DESCRIPTIONS[description],
    )
    one = jnp.ones(len(q["x"]))
    particles = mpm.Particles(q["x"], q["v"], 1e3 * (DX / 2) ** d * one, (DX / 2) ** d * one)
    beta = {"beta": q["beta"]} if method is mpm.SemiImplicit else {}
    return scene, particles, method(**OPTIONS[method], **beta)


def outcome(particles):
    """A scalar that all of the final state enters, at random."""
    rng = np.random.default_rng(2)
    weigh = lambda a, unit: (jnp.asarray(rng.normal(size=a.shape)) * a / unit).sum()  # noqa: E731
    return weigh(particles.x, 0.1) + weigh(particles.v, 1.0) + weigh(particles.F, 1.0) + weigh(particles.C, 10.0)


def simulated(parameters, method, description="updated", adjoint=None, steps=STEPS, **options):
    """The outcome by `simulate`."""
    scene, particles, method = model(parameters, method, description, **options)
    run = mpm.simulate(scene, particles, t1=steps * DT, dt=DT, method=method, adjoint=adjoint, throw=False)
    return outcome(run.final)


def rolled(parameters, method, description="updated", steps=STEPS):
    """The outcome by the plain rollout."""
    scene, particles, method = model(parameters, method, description)
    return outcome(mpm.rollout(scene, particles, steps=steps, dt=DT, method=method))


@functools.cache
def gradient_of(method, description):
    """Value and gradient with respect to all parameters, compiled."""
    return jax.jit(jax.value_and_grad(lambda q: simulated(q, method, description)))


def along(q, h, t):
    """q + h t."""
    return jax.tree.map(lambda a, b: a + h * b, q, t)


def inner(a, b):
    """⟨a, b⟩ over a pytree."""
    return float(sum(jax.tree.leaves(jax.tree.map(lambda x, y: (x * y).sum(), a, b))))


@pytest.mark.parametrize(("method", "description"), CASES, ids=lambda a: getattr(a, "__name__", a))
def test_gradient_equals_central_differences(method, description):
    """Of ten steps from F = I, in every parameter's random direction, to 1e-6."""
    q, t = parameters(), direction()
    evaluate = gradient_of(method, description)
    gradient = evaluate(q)[1]
    for name in t:
        if name == "beta" and method is not mpm.SemiImplicit:
            assert float(gradient[name]) == 0
            continue
        h = 1e-5
        only = {k: a if k == name else 0 * a for k, a in t.items()}
        difference = (evaluate(along(q, h, only))[0] - evaluate(along(q, -h, only))[0]) / (2 * h)
        assert abs(inner(gradient, only) / float(difference) - 1) < 1e-6, name


@pytest.mark.parametrize(
    ("method", "description"),
    [(mpm.Explicit, "updated"), (mpm.SemiImplicit, "updated"), (mpm.BackwardEuler, "total")],
    ids=lambda a: getattr(a, "__name__", a),
)
def test_forward_mode_is_the_transpose_of_reverse_mode(method, description):
    """⟨u, J t⟩ = ⟨Jᵀu, t⟩ to 1e-10, J by ForwardMode and by checkpoints."""
    q, t = parameters(), direction()
    forward = lambda q: simulated(q, method, description, diffrax.ForwardMode())  # noqa: E731
    value, pushed = jax.jit(lambda q, t: jax.jvp(forward, (q,), (t,)))(q, t)
    expected, gradient = gradient_of(method, description)(q)
    assert_close(value, expected, 1e-13)
    assert abs(float(pushed) / inner(gradient, t) - 1) < 1e-10


def test_jacfwd_gives_curves_of_sensitivity():
    """The Jacobian of the final state with respect to gravity, by forward mode, pulled back equals the gradient."""

    def final(gravity):
        q = parameters() | {"gravity": gravity}
        scene, particles, method = model(q, mpm.Explicit)
        run = mpm.simulate(
            scene, particles, t1=STEPS * DT, dt=DT, method=method, adjoint=diffrax.ForwardMode(), throw=False
        )
        return run.final

    q = parameters()
    jacobian = jax.jit(jax.jacfwd(final))(q["gravity"])
    rows = jnp.stack([jax.jvp(outcome, (final(q["gravity"]),), (jax.tree.map(lambda a: a[..., i], jacobian),))[1] for i in (0, 1)])
    assert_close(rows, gradient_of(mpm.Explicit, "updated")(q)[1]["gravity"], 1e-10)


@pytest.mark.parametrize("method", [mpm.Explicit, mpm.SemiImplicit])
def test_checkpointed_gradient_equals_that_of_the_plain_scan(method):
    """To 1e-12, in every parameter."""
    q = parameters()
    plain = jax.jit(jax.value_and_grad(lambda q: rolled(q, method)))(q)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-12), gradient_of(method, "updated")(q), plain)


def test_a_batch_equals_a_loop():
    """vmap over stiffness, of value and gradient through semi-implicit steps."""
    q = parameters()
    evaluate = lambda stiffness: gradient_of(mpm.SemiImplicit, "updated")(q | {"E": stiffness})  # noqa: E731
    stiffness = q["E"] * jnp.array([[0.5], [1.0], [2.0]])
    batch = jax.jit(jax.vmap(evaluate))(stiffness)
    for i, one in enumerate(stiffness):
        jax.tree.map(lambda a, b: assert_close(a[i], b, 1e-9), batch, evaluate(one))  # noqa: B023


@pytest.mark.parametrize("method", [mpm.SemiImplicit, mpm.BackwardEuler])
def test_second_derivative_passes_through_the_implicit_solve(method):
    """The Hessian-vector product, forward over reverse, against differences of the gradient."""
    q, t = parameters(), direction()
    gradient = jax.grad(lambda q: rolled(q, method, steps=2))
    value, product = jax.jit(lambda q, t: jax.jvp(gradient, (q,), (t,)))(q, t)
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(value))
    h, u, zero = 1e-5, direction(6), jax.tree.map(jnp.zeros_like, t)
    at = jax.jit(lambda q: jax.jvp(gradient, (q,), (zero,))[0])
    difference = (inner(at(along(q, h, t)), u) - inner(at(along(q, -h, t)), u)) / (2 * h)
    assert abs(inner(product, u) / difference - 1) < 1e-6


@pytest.mark.parametrize("law", LAWS.values(), ids=list(LAWS))
def test_gradient_is_finite_and_right_at_rest_in_three_dimensions(law):
    """F = I and no motion: where derivatives through an SVD are NaN. Two semi-implicit steps."""
    q = parameters(3)
    q["v"] = jnp.zeros_like(q["v"])

    @jax.jit
    def evaluate(q):
        scene, particles, method = model(q, mpm.SemiImplicit, law=type(law))
        return jax.value_and_grad(lambda a: outcome(mpm.rollout(*a[:2], steps=2, dt=DT, method=a[2])))((scene, particles, method))

    gradient = evaluate(q)[1]
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(gradient))
    h, only = 1e-5, q | {"E": q["E"]}
    rise = [evaluate(only | {"E": q["E"] * (1 + s * h)})[0] for s in (1, -1)]
    expected = (gradient[0].material.youngs_modulus * q["E"]).sum()
    assert abs(float(expected / ((rise[0] - rise[1]) / (2 * h))) - 1) < 1e-6


def test_an_adjoint_that_does_not_converge_gives_nan():
    """Never a wrong number."""
    q = parameters()

    def value(stiffness, adjoint):
        scene, particles, _ = model(q | {"E": stiffness}, mpm.SemiImplicit)
        method = mpm.SemiImplicit(solver=TIGHT, adjoint_solver=adjoint)
        return outcome(mpm.rollout(scene, particles, steps=1, dt=DT, method=method))

    gradient = jax.jit(jax.grad(value), static_argnums=1)
    assert np.isfinite(gradient(q["E"], mpm.ConjugateResidual())).all()
    assert np.isnan(gradient(q["E"], mpm.ConjugateResidual(max_steps=2))).all()
