"""The projected Hessian: what it is, its derivative, and where it holds and the plain one does not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import ELASTIC, LAWS, assert_close, block, explicit_limit, ids, rotation_matrix, thorough
from numpy_oracle import grid_update

import mpmjax as mpm
from mpmjax.implicit import ImplicitOperator

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
EACH_LAW = pytest.mark.parametrize("law", **ids(ELASTIC))
EACH_DIM = pytest.mark.parametrize("d", [2, *thorough(1, 3)])
PROJECTED = mpm.implicit.AnalyticHessian(projected=True)


def assembled(tangent, F):
    """A tangent as (d², d², p)."""
    d = F.shape[0]
    units = jnp.eye(d * d).reshape(d * d, d, d, 1)
    return jax.vmap(lambda e: tangent(jnp.broadcast_to(e, F.shape)))(units).reshape(d * d, d * d, -1)


@eqx.filter_jit
def both(law, F):
    return assembled(law.stress_differential(F), F), assembled(law.projected_differential(F), F)


@EACH_LAW
@EACH_DIM
@pytest.mark.parametrize("family", STRETCHES)
def test_projection_keeps_what_is_positive_and_drops_the_rest(law, family, d):
    """A⁺ is that of `numpy.linalg.eigh` with negative eigenvalues set to zero, symmetric, and A itself where A is
    positive semi-definite."""
    law, F = jax.tree.map(jnp.asarray, law), jnp.asarray(deformations(family, d)[0])
    if not np.asarray(law.is_admissible(F)).all():
        assert family == "inverted"
        assert not isinstance(law, mpm.FixedCorotated)
        return
    plain, projected = map(np.asarray, both(law, F))
    positive = 0
    for p in range(F.shape[-1]):
        w, Q = np.linalg.eigh(plain[..., p])
        assert_close(projected[..., p], (Q * np.maximum(w, 0)) @ Q.T, 1e-11)
        assert np.linalg.eigvalsh(projected[..., p])[0] > -1e-13 * w[-1]
        if w[0] > -1e-14 * w[-1]:
            positive += 1
            assert_close(projected[..., p], plain[..., p], 1e-11)
    if family == "compressed" and d > 1:
        assert positive == 0


def projected_matrix(law, F):
    return assembled(law.projected_differential(F), F)


@eqx.filter_jit
def pushed(law, F, d_law, dF):
    """A⁺ and δA⁺ by its rule."""
    return eqx.filter_jvp(projected_matrix, (law, F), (d_law, dF))


@eqx.filter_jit
def pulled(law, F, weights):
    """The gradient of Σ weights A⁺."""
    return eqx.filter_grad(lambda q: (projected_matrix(*q) * weights).sum())((law, F))


DERIVED_AT = {
    "generic": (0.8, 1.1, 0.7),
    "equal": (0.95, 0.95, 0.95),
    "expanded": (1.2, 1.2, 1.2),
    "pair": (0.9, 0.8, 0.8),
}


@pytest.mark.thorough
@EACH_LAW
@pytest.mark.parametrize("stretches", DERIVED_AT.values(), ids=DERIVED_AT)
@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_derivative_of_the_projection_is_that_of_central_differences(law, stretches, d):
    """δA⁺ for δF and δE, δν, to 1e-7 of fourth-order differences, also at repeated stretches; forward = reverse."""
    rng = np.random.default_rng(0)
    s = np.diag(stretches[-d:])
    F = np.stack([rotation_matrix(d, rng) @ s @ rotation_matrix(d, rng) for _ in range(20)], axis=-1)
    F, law = jnp.asarray(F), jax.tree.map(jnp.asarray, law)
    assert np.linalg.eigvalsh(np.asarray(both(law, F)[0])[..., 0])[0] < 0 or min(stretches) > 1
    dF = jnp.asarray(rng.normal(size=F.shape))
    d_law = type(law)(0.5 * law.youngs_modulus, jnp.asarray(0.1))
    A, change = pushed(law, F, d_law, dF)
    h = 1e-3

    def at(t):
        return both(*jax.tree.map(lambda a, b: a + t * b, (law, F), (d_law, dF)))[1]

    difference = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
    assert np.isfinite(np.asarray(change)).all()
    assert_close(change, difference, 1e-7)
    pairs = zip(*map(jax.tree.leaves, (pulled(law, F, A), (d_law, dF))), strict=True)
    assert_close(sum((a * b).sum() for a, b in pairs), (A * change).sum(), 1e-12)


def test_derivative_at_rest_is_the_mean_of_the_two_sides():
    """At F = I a twist is zero and A⁺ has a kink: the derivative is what a central difference tends to."""
    law = jax.tree.map(jnp.asarray, LAWS["fixed_corotated"])
    F = jnp.tile(jnp.eye(2)[..., None], 20)
    dF = jnp.asarray([[1.0, 0.3], [0.3, 0.5]])[..., None] + 0 * F
    A, change = pushed(law, F, jax.tree.map(jnp.zeros_like, law), dF)
    h = 1e-5
    ahead, back = both(law, F + h * dF)[1], both(law, F - h * dF)[1]
    assert_close(change, (ahead - back) / (2 * h), 1e-4)
    assert_close(A, both(law, F)[0], 1e-14)


@pytest.mark.thorough
@pytest.mark.parametrize("looped", [False, True], ids=["plain", "in a loop"])
@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives_are_refused(inner, outer, looped):
    """With an error that says so, in every nest; the first ones are there."""
    law, F = LAWS["fixed_corotated"], jnp.eye(2)[..., None] * 0.95

    def once(F):
        return law.projected_differential(F).matrix[0, 1, 0]

    def entry(F):
        return jax.lax.scan(lambda _, one: (None, once(one)), None, F[None])[1][0] if looped else once(F)

    assert np.isfinite(np.asarray(inner(entry)(F))).all()
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        outer(inner(entry))(F)


def compressed(stretch=(0.9, 0.9), spin=0.0, side=3, noise=0.0, law=LAWS["fixed_corotated"]):
    """A block squeezed by these stretches along the axes, turning at a rate [1/s]."""
    scene, p = block(2, side=side, material=law)
    rng = np.random.default_rng(0)
    G, W = jnp.diag(jnp.asarray(stretch)), spin * jnp.asarray([[0.0, -1.0], [1.0, 0.0]])
    r = (p.x - p.x.mean(axis=0)) @ G
    tile = (p.count, 1, 1)
    F = jnp.tile(G, tile) + noise * jnp.asarray(rng.normal(size=(p.count, 2, 2)))
    v = r @ W.T + noise * jnp.asarray(rng.normal(size=r.shape))
    return scene, mpm.prepare(
        scene, mpm.Particles(p.x.mean(axis=0) + r, v, p.mass, p.volume, deformations=(F,), C=jnp.tile(W, tile))
    )


def stiffness(scene, particles, hessian):
    """H restricted to the free components, and their masses."""
    nodes = grid_update(scene, particles, 1e-3, mpm.Explicit()).nodes
    free = nodes.free
    action = hessian.at(nodes.potential, None)
    operator = ImplicitOperator(jnp.zeros_like(nodes.mass), jnp.asarray(1.0), action, nodes.projection)
    A, keep = np.asarray(eqx.filter_jit(ImplicitOperator.as_matrix)(operator)), np.asarray(free).ravel()
    return A[np.ix_(keep, keep)], np.repeat(np.asarray(nodes.mass), 2)[keep]


@pytest.mark.parametrize("law", **ids(ELASTIC, "neo_hookean"))
def test_projected_hessian_is_symmetric_and_positive_semi_definite(law):
    """Of a whole compressed block, whose plain Hessian is not; the two are one where the block is stretched."""
    squeezed = compressed(law=law)
    H, _ = stiffness(*squeezed, PROJECTED)
    plain, _ = stiffness(*squeezed, mpm.implicit.AnalyticHessian())
    top = np.linalg.eigvalsh(plain)[-1]
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-13 * top)
    assert np.linalg.eigvalsh(H)[0] > -1e-12 * top
    assert np.linalg.eigvalsh(plain)[0] < -1e-4 * top
    stretched = compressed((1.1, 1.05), law=law)
    assert_close(*(stiffness(*stretched, hessian)[0] for hessian in (PROJECTED, mpm.implicit.AnalyticHessian())), 1e-12)


@eqx.filter_jit
def moment(theta, scene, particles, weights, dt, beta):
    """A weighted sum of positions after three projected steps."""
    E, nu, F, v = theta
    moved = eqx.tree_at(lambda s: s.material, scene, mpm.FixedCorotated(E, nu))
    thrown = eqx.tree_at(lambda q: (q.F, q.v), particles, (F, v))
    method = mpm.SemiImplicit(beta=beta, hessian=PROJECTED, solver=TIGHT, adjoint_solver=TIGHT)
    return (weights * mpm.rollout(moved, thrown, steps=3, dt=dt, method=method).x).sum()


moment_gradient = eqx.filter_jit(eqx.filter_grad(moment))


@pytest.mark.thorough
@pytest.mark.parametrize("beta", [1.0, 0.5])
@pytest.mark.parametrize(("stretch", "noise"), [((0.95, 0.95), 0.0), ((0.9, 0.85), 0.02)], ids=["repeated", "generic"])
def test_gradient_through_projected_steps_is_that_of_central_differences(beta, stretch, noise):
    """Three steps of a compressed block: stiffness, Poisson's ratio, F and velocities together, to 1e-6."""
    scene, particles = compressed(stretch, noise=noise, side=2)
    rng = np.random.default_rng(1)
    weights = jnp.asarray(rng.normal(size=particles.x.shape))
    rest = (scene, particles, weights, jnp.asarray(3 * explicit_limit(scene)), jnp.asarray(beta))
    theta = (jnp.asarray(1e4), jnp.asarray(0.3), particles.F, particles.v)
    direction = (jnp.asarray(1e3), jnp.asarray(0.05), *(jnp.asarray(rng.normal(size=a.shape)) for a in theta[2:]))
    exact = sum((a * b).sum() for a, b in zip(moment_gradient(theta, *rest), direction, strict=True))
    h = 1e-5
    ends = [moment(jax.tree.map(lambda a, u, s=s: a + s * h * u, theta, direction), *rest) for s in (1, -1, 2, -2)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
    assert abs(float(exact / difference) - 1) < 1e-6


@pytest.mark.slow
def test_backward_euler_finds_the_same_with_projection_and_has_the_same_derivative():
    """Projection changes Newton's way, not the equation: solution and derivative are those of the true Hessian."""
    scene, particles = compressed((0.9, 0.85), noise=0.02, side=2)
    dt = 2 * explicit_limit(scene)

    def outcome(hessian):
        method = mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-13), hessian=hessian, adjoint_solver=TIGHT)

        def scatter(E):
            moved = eqx.tree_at(lambda s: s.material.youngs_modulus, scene, E)
            return (mpm.rollout(moved, particles, steps=2, dt=dt, method=method).x ** 2).sum()

        return jax.jvp(scatter, (jnp.asarray(1e4),), (jnp.asarray(1.0),))

    (a, da), (b, db) = outcome(mpm.implicit.AnalyticHessian()), outcome(PROJECTED)
    assert_close(a, b, 1e-12)
    assert_close(da, db, 1e-9)
    H, m = stiffness(scene, particles, mpm.implicit.AnalyticHessian())
    assert np.linalg.eigvalsh(H)[0] < -1e-3 * m.max() / dt**2, "the two operators must differ for this to say anything"


def spin_of(particles):
    """Σ m r × v."""
    r = particles.x - particles.x.mean(axis=0)
    return float((particles.mass * (r[:, 0] * particles.v[:, 1] - r[:, 1] * particles.v[:, 0])).sum())


@pytest.mark.thorough
@pytest.mark.parametrize("times", [0.9, 0.999, 1.001, 1.4])
def test_projection_holds_where_the_plain_step_is_near_singular(times):
    """A block compressed by 10 % that turns slowly. M + Δt²H is singular at a certain Δ̂t, for the rotation of the whole
    block (2.6 dx/c at three cells a side, and longer the larger the block). The plain step multiplies the spin by about
    1/(1 − (Δt/Δ̂t)²), so that it explodes there and turns back beyond; with projection it is kept to 1 %, and in twenty
    steps the block returns to its size."""
    scene, particles = compressed(spin=1e-4, side=3)
    K, m = stiffness(scene, particles, mpm.implicit.AnalyticHessian())
    singular = 1 / np.sqrt(-np.linalg.eigvalsh(K / np.sqrt(np.outer(m, m)))[0])
    np.testing.assert_allclose(singular / explicit_limit(scene), 2.621, atol=1e-3)
    dt = times * singular
    plain, info = mpm.step(scene, particles, 0.0, dt, method=mpm.SemiImplicit())
    assert 0.8 < spin_of(plain) / spin_of(particles) * (1 - times**2) < 1
    assert bool(info.solve.converged)
    assert bool(info.solve.indefinite) == (times > 1)
    method = mpm.SemiImplicit(hessian=PROJECTED)
    once, _ = mpm.step(scene, particles, 0.0, dt, method=method)
    assert abs(spin_of(once) / spin_of(particles) - 1) < 0.01
    run = mpm.simulate(scene, particles, t1=20 * dt, dt=dt, method=method)
    assert int(run.statistics.indefinite) == 0
    np.testing.assert_allclose(np.linalg.det(np.asarray(run.final.F)), 1, atol=2e-3)
    np.testing.assert_allclose(run.final.x.std() / particles.x.std(), 1 / 0.9, atol=2e-3)


@pytest.mark.slow
def test_negative_curvature_is_counted_by_steps():
    """In the solver's statistics, a step's report and a run's statistics; not where the material is stretched."""
    scene, particles = compressed(noise=0.1)
    dt = 8 * explicit_limit(scene)
    statistics = mpm.simulate(scene, particles, t1=3 * dt, dt=dt, method=mpm.SemiImplicit(), throw=False).statistics
    state, count = particles, 0
    for _ in range(3):
        state, info = mpm.step(scene, state, 0.0, dt, method=mpm.SemiImplicit())
        count += int(info.solve.indefinite)
    assert 1 <= int(statistics.indefinite) == count
    assert int(statistics.merged(statistics).indefinite) == 2 * count
    for hessian in (mpm.implicit.AnalyticHessian(), PROJECTED):  # Newton's directions are those of the projected one
        _, info = mpm.step(scene, particles, 0.0, dt, method=mpm.BackwardEuler(hessian=hessian))
        assert bool(info.solve.indefinite) == (hessian != PROJECTED)
    _, info = mpm.step(scene, compressed((1.1, 1.1))[1], 0.0, dt, method=mpm.SemiImplicit())
    assert not info.solve.indefinite
