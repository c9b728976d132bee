"""Derivatives of whole rollouts, with respect to everything at once."""

import functools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, assert_close

import mpmjax as mpm

TIGHT = mpm.ConjugateResidual(rtol=1e-12)
DX, DT, STEPS = 0.1, 1e-2, 10
OPTIONS = {
    mpm.Explicit: {},
    mpm.SemiImplicit: {"solver": TIGHT, "adjoint_solver": TIGHT},
    mpm.BackwardEuler: {"rtol": 1e-13, "solver": TIGHT, "adjoint_solver": TIGHT},
}
FEW = diffrax.RecursiveCheckpointAdjoint(checkpoints=3)
CASES = [
    (mpm.Explicit, "updated", 2),
    (mpm.Explicit, "total", 2),
    (mpm.SemiImplicit, "updated", 2),
    (mpm.SemiImplicit, "total", 1),
    (mpm.BackwardEuler, "updated", 1),
    (mpm.BackwardEuler, "total", 2),
]


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


def direction(seed=5, d=2):
    """A random direction, in units of each parameter."""
    rng = np.random.default_rng(seed)
    unit = {"E": 1e4, "nu": 0.3, "x": 0.03, "v": 0.3, "gravity": 10.0, "displacement": 0.4, "beta": 0.5}
    return {k: jnp.asarray(unit[k] * rng.normal(size=a.shape)) for k, a in parameters(d).items()}


def model(parameters, method, description="updated"):
    """Scene, particles and method of the parameters."""
    q, d = parameters, parameters["x"].shape[1]
    grip = mpm.Grip(mpm.Box((-1.0,) * d, (0.05, *(1.0,) * (d - 1))), mpm.Motion((0.0, 1.0), q["displacement"]))
    scene = mpm.Scene(
        mpm.Grid((8,) * d, DX, origin=(-3,) * d),
        mpm.FixedCorotated(q["E"], q["nu"]),
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


def simulated(parameters, method, description="updated", adjoint=None):
    """The outcome by `simulate`."""
    scene, particles, method = model(parameters, method, description)
    run = mpm.simulate(scene, particles, t1=STEPS * DT, dt=DT, method=method, adjoint=adjoint, throw=False)
    return outcome(run.final)


def rolled(parameters, method, description="updated", steps=STEPS):
    """The outcome by the plain rollout."""
    scene, particles, method = model(parameters, method, description)
    return outcome(mpm.rollout(scene, particles, steps=steps, dt=DT, method=method))


@functools.cache
def gradient_of(method, description):
    """Value and gradient with respect to all parameters, compiled, with fewer checkpoints than steps."""
    return jax.jit(jax.value_and_grad(lambda q: simulated(q, method, description, FEW)))


def along(q, h, t):
    """q + h t."""
    return jax.tree.map(lambda a, b: a + h * b, q, t)


def inner(a, b):
    """⟨a, b⟩ over a pytree."""
    return float(sum(jax.tree.leaves(jax.tree.map(lambda x, y: (x * y).sum(), a, b))))


@pytest.mark.parametrize(("method", "description", "d"), CASES, ids=lambda a: getattr(a, "__name__", str(a)))
def test_gradient_equals_central_differences(method, description, d):
    """Of ten steps from F = I, in every parameter's random direction, to 1e-6."""
    q, t = parameters(d), direction(d=d)
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


def test_jacfwd_equals_reverse_mode():
    """With respect to gravity, through `simulate`."""
    q = parameters()
    sensitivity = lambda g: simulated(q | {"gravity": g}, mpm.Explicit, adjoint=diffrax.ForwardMode())  # noqa: E731
    expected = gradient_of(mpm.Explicit, "updated")(q)[1]["gravity"]
    assert_close(jax.jit(jax.jacfwd(sensitivity))(q["gravity"]), expected, 1e-10)


@pytest.mark.parametrize("method", [mpm.Explicit, mpm.SemiImplicit])
def test_checkpointed_gradient_equals_that_of_the_plain_scan(method):
    """To 1e-12, in every parameter."""
    q = parameters(2 if method is mpm.Explicit else 1)
    plain = jax.jit(jax.value_and_grad(lambda q: rolled(q, method)))(q)
    jax.tree.map(lambda a, b: assert_close(a, b, 1e-12), gradient_of(method, "updated")(q), plain)


def test_a_batch_equals_a_loop():
    """vmap over stiffness, of value and gradient through semi-implicit steps."""
    q = parameters(1)
    evaluate = jax.value_and_grad(lambda stiffness: simulated(q | {"E": stiffness}, mpm.SemiImplicit))
    stiffness = q["E"] * jnp.array([[0.5], [1.0], [2.0]])
    batch, loop = jax.jit(jax.vmap(evaluate))(stiffness), jax.jit(evaluate)
    for i, one in enumerate(stiffness):
        jax.tree.map(lambda a, b: assert_close(a[i], b, 1e-9), batch, loop(one))  # noqa: B023


def test_second_derivative_passes_through_the_implicit_solve():
    """In all the stiffnesses' scale, forward over reverse, against differences of the first."""
    q, h = parameters(), 1e-5
    slope = jax.grad(lambda scale: rolled(q | {"E": scale * q["E"]}, mpm.SemiImplicit, steps=3))
    both = jax.jit(lambda scale: jax.jvp(slope, (scale,), (jnp.ones(()),)))
    one = jnp.ones(())
    difference = (both(one + h)[0] - both(one - h)[0]) / (2 * h)
    assert abs(float(both(one)[1] / difference) - 1) < 1e-6


def test_gradient_is_right_at_rest_in_three_dimensions():
    """F = I and no motion, where derivatives through an SVD are NaN: three explicit steps."""
    q, t = parameters(3), direction(d=3)
    q["v"] = jnp.zeros_like(q["v"])
    evaluate = jax.jit(jax.value_and_grad(lambda q: rolled(q, mpm.Explicit, steps=3)))
    gradient, h = evaluate(q)[1], 1e-5
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(gradient))
    difference = (evaluate(along(q, h, t))[0] - evaluate(along(q, -h, t))[0]) / (2 * h)
    assert abs(inner(gradient, t) / float(difference) - 1) < 1e-6


def test_an_adjoint_that_does_not_converge_gives_nan():
    """Never a wrong number."""
    q = parameters(1)

    def value(stiffness, steps):
        scene, particles, _ = model(q | {"E": stiffness}, mpm.SemiImplicit)
        method = mpm.SemiImplicit(solver=TIGHT, adjoint_solver=mpm.ConjugateResidual(max_steps=steps))
        return outcome(mpm.rollout(scene, particles, steps=1, dt=DT, method=method))

    gradient = jax.jit(jax.grad(value), static_argnums=1)
    assert np.isfinite(gradient(q["E"], 100)).all()
    assert np.isnan(gradient(q["E"], 1)).all()
