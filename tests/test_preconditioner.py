"""The diagonal inner product: what it is, what it saves where stiffness differs, and that nothing else changes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS, GRADIENTS, LAWS, assert_close, block, cloud, explicit_limit, ids, thorough

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.implicit import ImplicitOperator
from mpmjax.stepping import start_nodes

TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-11)
IMPLICIT = {
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT, adjoint_solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(rtol=1e-11), adjoint_solver=TIGHT),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Linearised(TIGHT), adjoint_solver=TIGHT),
    "trbdf2": mpm.TRBDF2(solution=mpm.implicit.Newton(rtol=1e-11), adjoint_solver=TIGHT),
}


def by_the_mass(method):
    return dataclasses.replace(method, preconditioner=mpm.implicit.MassPreconditioner())


def operator_of(scene, particles, hessian, factor=1e-3):
    """M + χH at the particles, with χ such that mass and stiffness are alike."""
    return prepared_operator(scene, mpm.prepare(scene, particles), hessian, jnp.asarray(factor))


@eqx.filter_jit
def prepared_operator(scene, particles, hessian, factor):
    nodes = start_nodes(scene, particles, 0.0, jnp.asarray(1e-3), scene.stencil(particles))
    action = hessian.at(nodes.potential, None)
    return ImplicitOperator(nodes.mass, factor, action, nodes.projection)


@eqx.filter_jit
def weight_and_matrix(operator):
    return mpm.implicit.DiagonalPreconditioner().inner_product(operator).weight, operator.as_matrix()


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("gradient", **ids(GRADIENTS, "mls"))
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, ()))
def test_undeformed_it_is_the_operators_diagonal(description, gradient, d):
    """An isotropic law at F = I has no products of slopes along different axes."""
    grid, particles = cloud(d, p=6, cells=1 if d == 3 else 2)
    still = mpm.Particles(particles.x, particles.v, particles.mass, particles.volume)
    scene = mpm.Scene(grid, LAWS["neo_hookean"], gradient=gradient, description=description)
    weight, matrix = weight_and_matrix(operator_of(scene, still, mpm.implicit.AnalyticHessian()))
    assert_close(weight.ravel(), jnp.diag(matrix), 1e-13)


@pytest.mark.thorough
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_deformed_it_scales_the_operator_whatever_the_law_and_the_walls(description, law):
    """Positive, one on identity rows, the same from the energy alone, and near the diagonal: without products of
    slopes, and at a symmetry plane without those of a node's with its image's."""
    grid, particles = cloud(2)
    walls = (mpm.SymmetryPlane(0, 0.0), mpm.StickyBox((-np.inf, 0.05), (5.0, 5.0)))
    scene = mpm.Scene(grid, LAWS[law], boundary=walls, description=description)
    both = [
        operator_of(scene, particles, hessian)
        for hessian in (mpm.implicit.AnalyticHessian(), mpm.implicit.JvpHessian())
    ]
    (weight, matrix), (other, _) = map(weight_and_matrix, both)
    assert_close(weight, other, 1e-12)
    free = np.asarray(both[0].projection.free)
    assert (weight[free] >= jnp.broadcast_to(both[0].mass[:, None], free.shape)[free]).all()
    np.testing.assert_array_equal(weight[~free], 1)
    exact = np.diag(matrix).reshape(free.shape)[free]
    assert 0.5 < (exact / weight[free]).min() <= (exact / weight[free]).max() < 2


@pytest.mark.thorough
def test_negative_stiffness_is_left_out():
    """Of a fixed corotated body at a tenth of its volume, whose Hessian is indefinite."""
    scene, particles = block(2)
    F = jnp.broadcast_to(0.3 * jnp.eye(2), (len(particles.x), 2, 2))
    squeezed = mpm.Particles(particles.x, particles.v, particles.mass, particles.volume, (F,))
    operator = operator_of(scene, squeezed, mpm.implicit.AnalyticHessian(), factor=1.0)
    weight, matrix = weight_and_matrix(operator)
    assert np.linalg.eigvalsh(matrix).min() < 0
    stiffness, free = operator.hessian.precomputed(), np.asarray(operator.projection.free)
    matrix = np.asarray(la.symmetric(stiffness.upper))
    K = np.stack([matrix[m, m] for m in range(4)]).reshape(2, 2, -1)  # by slope, then component
    assert (K < 0).any()
    left = np.zeros(free.shape)
    square = np.asarray(stiffness.stencil.gradient) ** 2
    np.add.at(left, np.asarray(stiffness.stencil.index), np.einsum("kbp,bap->kpa", square, np.where(K > 0, K, 0)))
    assert_close(weight[free], (np.asarray(operator.mass)[:, None] + left)[free], 1e-13)


def layered(contrast, multiple, *, side=6, dtype=jnp.float64):
    """A thrown block, its upper half stiffer by the contrast, and a step that is a multiple of that half's limit."""
    scene, particles = block(2, side=side)
    height = particles.x[:, 1]
    E = jnp.where(height > height.mean(), contrast, 1.0) * scene.material.youngs_modulus
    scene = dataclasses.replace(scene, material=mpm.NeoHookean(E.astype(dtype), 0.3))
    v = jnp.stack([0 * height, jnp.sin(5 * height)], axis=1)
    arrays = (a.astype(dtype) for a in (particles.x, v, particles.mass, particles.volume))
    dt = multiple * explicit_limit(block(2)[0]) / np.sqrt(contrast)
    return scene, mpm.prepare(scene, mpm.Particles(*arrays)), dt


@pytest.mark.parametrize("method", **ids(IMPLICIT, "semi_implicit", ()))
def test_at_a_contrast_of_stiffness_it_takes_a_fraction_of_the_iterations(method):
    """Less than half in a linear solve, less than three quarters over Newton's inexact ones; and every method arrives
    where it does by the mass."""
    scene, particles, dt = layered(1e3, 60.0)
    by_mass, mass = mpm.step(scene, particles, 0.0, dt, method=by_the_mass(method))
    by_diagonal, diagonal = mpm.step(scene, particles, 0.0, dt, method=method)
    assert mass.solve.converged
    assert diagonal.solve.converged
    share = 0.75 if int(mass.solve.newton) else 0.5
    assert int(diagonal.solve.iterations) < share * int(mass.solve.iterations)
    for name in ("x", "v", "F", "C"):
        assert_close(getattr(by_diagonal, name), getattr(by_mass, name), 1e-8)


@pytest.mark.thorough
@pytest.mark.parametrize("second", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_gradients_do_not_depend_on_it(second):
    """Through the tangent and the adjoint solve, which work in it too."""
    scene, particles, dt = layered(100.0, 20.0, side=3)

    def height(stiffer, method):
        harder = dataclasses.replace(scene, material=mpm.NeoHookean(stiffer * scene.material.youngs_modulus, 0.3))
        return mpm.rollout(harder, particles, steps=2, dt=dt, method=method).x[0, 1]

    def curvature(q, method):
        return jax.jvp(lambda q: jax.grad(height)(q, method), (q,), (q,))[1]

    derivative = jax.jit(curvature if second else jax.grad(height), static_argnums=1)
    method = IMPLICIT["semi_implicit"]
    by_mass, by_diagonal = (derivative(jnp.asarray(1.0), m) for m in (by_the_mass(method), method))
    np.testing.assert_allclose(by_diagonal, by_mass, rtol=1e-6)


@pytest.mark.thorough
def test_newton_in_single_precision_knows_its_rounding_in_either():
    """Asked for more than float32 can give, it stops at the same floor, and says that it converged."""
    scene, particles, dt = layered(1e3, 60.0, dtype=jnp.float32)
    ends = {}
    for preconditioner in (mpm.implicit.DiagonalPreconditioner(), mpm.implicit.MassPreconditioner()):
        method = mpm.BackwardEuler(mpm.implicit.Newton(rtol=1e-12), preconditioner=preconditioner)
        ends[preconditioner], info = mpm.step(scene, particles, 0.0, dt, method=method)
        assert info.solve.converged
        assert 1e-12 < info.solve.residual < 1e-3
    assert_close(ends[mpm.implicit.MassPreconditioner()].v, ends[mpm.implicit.DiagonalPreconditioner()].v, 1e-3)
