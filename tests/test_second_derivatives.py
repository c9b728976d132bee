"""Second derivatives of rollouts, nested in every way, against differences of the first."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import DT, UPDATES, Case, cotangent, model, outcome, parameters, quickly_compiled

import mpmjax as mpm

STATES = {"at rest": np.array([0.0, 0.0, 1.0]), "stretched": np.array([0.1, 0.2, 1.0])}
"""F0 − 1, the factors of gravity and of the grip's path, the factor of all moduli. At rest the solver starts with the
solution and does nothing, so that the derivative of its iteration is far from the solution's."""
ALONG = jnp.array([0.3, -1.0, 0.8])


def value(z, case, method, run):
    """A sum over the state after two steps of a block that gravity and a grip pull, evenly stretched at first."""
    q = parameters(case)
    modulus, *others = q["law"]
    q |= {"law": [z[2] * modulus, *others], "v": 0 * q["v"]}
    q |= {name: z[1] * q[name] for name in ("gravity", "displacement")}
    scene, particles, _ = model(q, case)
    stretched = jnp.broadcast_to((1 + z[0]) * jnp.eye(case.d), (len(q["x"]), case.d, case.d))
    particles = eqx.tree_at(lambda p: p.F, particles, stretched, is_leaf=lambda leaf: leaf is None)
    return (cotangent(case) * outcome(run(scene, particles, method))).sum()


def rollout(scene, particles, method):
    return mpm.rollout(scene, particles, steps=2, dt=DT, method=method)


def simulated(scene, particles, method):
    return mpm.simulate(scene, particles, t1=2 * DT, dt=DT, method=method).final


def nests(f, every):
    """The gradient, and the Hessian's action on a direction by forward over reverse mode or by every nest."""

    def directional(z, t):
        return jax.jvp(f, (z,), (t,))[1]

    def evaluate(z, t):
        gradient, action = jax.jvp(jax.grad(f), (z,), (t,))
        if not every:
            return gradient, {"forward over reverse": action}
        return gradient, {
            "forward over reverse": action,
            "of a batch": jax.hessian(f)(z) @ t,
            "reverse over forward": jax.grad(directional)(z, t),
            "reverse over reverse": jax.grad(lambda z: jax.grad(f)(z) @ t)(z),
            "forward over forward": jax.jvp(lambda z: directional(z, t), (z,), (t,))[1] / (t @ action) * action,
        }

    return quickly_compiled(evaluate)


def cases():
    """By default forward over reverse in one dimension by one update."""
    slow = pytest.mark.slow
    yield pytest.param(Case("semi_implicit", "neo_hookean", "updated", 1), simulated, False, marks=slow, id="simulate")
    for update, d in (*((update, 1) for update in UPDATES), ("explicit", 2), ("semi_implicit", 2), ("explicit", 3)):
        yield pytest.param(Case(update, "hencky", "updated", d), rollout, True, marks=slow, id=f"{update}-{d}d")
    yield pytest.param(Case("backward_euler", "fixed_corotated", "total", 2), rollout, True, marks=slow, id="total")
    yield pytest.param(Case("semi_implicit", "neo_hookean", "updated", 1), rollout, False, id="rollout")


@pytest.mark.parametrize(("case", "run", "every"), list(cases()))
def test_second_derivatives_of_a_rollout_are_right(case, run, every):
    f = functools.partial(value, case=case, method=UPDATES[case.update], run=run)
    evaluate = nests(f, every)
    h, weights = 1e-3, {-2: 1 / 12, -1: -2 / 3, 1: 2 / 3, 2: -1 / 12}
    for state, at in STATES.items():
        points = {k: jnp.asarray(at + k * h * ALONG) for k in (0, *weights)}
        exact = sum(w * np.asarray(evaluate(points[k], ALONG)[0]) for k, w in weights.items()) / h
        for nest, found in evaluate(points[0], ALONG)[1].items():
            np.testing.assert_allclose(
                found, exact, rtol=0, atol=1e-7 * np.abs(exact).max(), err_msg=f"{nest}, {state}"
            )
