"""The preconditioner of averaged volumes: its inverse, and iterations that do not grow as ν goes to ½."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import DESCRIPTIONS, assert_close, block, ids, thorough

import mpmjax as mpm
from mpmjax.implicit import DiagonalInnerProduct, ImplicitOperator
from mpmjax.stepping import start_nodes

AVERAGED = mpm.AveragedVolume()
CHOICES = mpm.implicit.DiagonalPreconditioner(), mpm.extensions.VolumePreconditioner()


def operator_of(scene, particles, factor=1e-2):
    """M + χH at the particles, with χ such that shear counts a hundred times as much as the mass."""
    return prepared_operator(scene, mpm.prepare(scene, particles), jnp.asarray(factor))


@eqx.filter_jit
def prepared_operator(scene, particles, factor):
    nodes = start_nodes(scene, particles, 0.0, 1e-3, scene.stencil(particles))
    action = mpm.implicit.AnalyticHessian().at(nodes.potential, None)
    return ImplicitOperator(nodes.mass, factor, action, nodes.projection)


def bodies(d, nu, side=2, description=DESCRIPTIONS["updated"]):
    """Two materials side by side, both averaged, beside a plane of symmetry and in a grip."""
    laws = mpm.NeoHookean(1e4, nu), mpm.NeoHookean(5e3, nu)
    one = block(d, side=side)[1]
    other = eqx.tree_at(lambda p: p.x, one, one.x + jnp.array([side * 0.1] + [0.0] * (d - 1)))
    held = mpm.Grip(mpm.Box((0.0,) * d, (1.0,) * (d - 1) + (0.05,)), mpm.Motion((0.0,), ((0.0,) * d,)))
    grid = mpm.Grid((2 * side + 6, *(side + 6,) * (d - 1)), 0.1, origin=(-3,) * d)
    boundary = mpm.SymmetryPlane(0, 0.0), held
    scene = mpm.Scene(grid, laws, volume=AVERAGED, description=description, boundary=boundary)
    return scene, mpm.join(one, other)


@eqx.filter_jit
def matrices(operator, preconditioner):
    """A, and W and W⁻¹ column by column."""
    inner, shape = preconditioner.inner_product(operator), operator.projection.free.shape
    columns = jnp.eye(np.prod(shape)).reshape(-1, *shape)
    maps = operator.mv, inner.apply, inner.solve
    return [jax.vmap(f)(columns).reshape(columns.shape[0], -1) for f in maps]


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS, "updated"))
@pytest.mark.parametrize("extent", [None, 3])
def test_it_is_symmetric_and_definite_and_its_inverse_is_one(extent, description, d):
    """In a box that is too small for the bodies too."""
    choice = mpm.extensions.VolumePreconditioner(extent=None if extent is None else (extent,) * d)
    A, W, inverse = matrices(operator_of(*bodies(d, 0.499, 2 if d == 2 else 1, description)), choice)
    for matrix in (W, inverse):
        assert_close(matrix, matrix.T, 1e-13)
        assert np.linalg.eigvalsh(matrix).min() > 0
    np.testing.assert_allclose(W @ inverse, np.eye(len(W)), atol=1e-9)
    held = np.abs(A - np.eye(len(A))).sum(axis=1) == 0
    assert held.any()
    np.testing.assert_allclose(W[held], np.eye(len(W))[held], atol=0)


@pytest.mark.parametrize("d", thorough(2, 3))
def test_its_eigenvalues_are_between_those_of_shear_and_those_of_lumping_whatever_the_bulk_modulus(d):
    """W⁻¹A is a mean of P⁻¹A0, of shear alone, and of the average's stiffness over the lumped one, which is from 4⁻ᵈ,
    for volumes that alternate from node to node with two particles along a cell's edge, to 1."""
    operator = operator_of(*bodies(d, 0.49999, 2 if d == 2 else 1))
    A, W, _ = matrices(operator, CHOICES[1])
    A0, P, _ = matrices(eqx.tree_at(lambda o: o.hessian.coupled, operator.precomputed(), ()), CHOICES[0])
    shear, own = (scipy.linalg.eigh(*pair, eigvals_only=True) for pair in ((A0, P), (A, W)))
    assert own[0] > min(shear[0], 4.0**-d) * (1 - 1e-6)
    assert own[-1] < max(shear[-1], 1) * (1 + 1e-6)
    assert scipy.linalg.eigh(A, P, eigvals_only=True)[-1] > 100 * own[-1]


@pytest.mark.parametrize("d", [2, *thorough(3)])
def test_iterations_do_not_grow_and_the_motion_is_the_same(d):
    def stepped(nu, preconditioner):
        scene, particles = block(d, material=mpm.NeoHookean(1e4, nu), volume=AVERAGED)
        turned = particles.x[:, ::-1] - particles.x.mean(axis=0)
        particles = eqx.tree_at(lambda p: p.v, particles, 0.1 * turned)
        solver = mpm.implicit.ConjugateResidual(rtol=1e-8, max_steps=10_000)  # with 1e-9 rounding decides the counts
        method = mpm.SemiImplicit(solver=solver, preconditioner=preconditioner)
        after, info = mpm.step(scene, particles, 0.0, 1e-1, method=method)
        return after.v, info.solve

    one, other = (jax.jit(lambda nu, choice=choice: stepped(nu, choice)) for choice in CHOICES)
    (velocity, plain), (preconditioned, solve) = one(0.4999), other(0.4999)
    plain_stiffer, stiffer = one(0.49999)[1], other(0.49999)[1]
    for report in (plain, solve, plain_stiffer, stiffer):
        assert report.converged
    assert_close(preconditioned, velocity, 1e-6)
    growth = int(stiffer.iterations) / int(solve.iterations)  # by ten times the bulk modulus; the diagonal's is 1.85
    assert growth < (1.2 if d == 2 else 1.7)
    assert int(stiffer.iterations) < int(plain_stiffer.iterations) / (2.5 if d == 2 else 5)


def placed(d, corner, nu, preconditioner, window=16, side=3):
    """A block in a window with much room around it, turning and sheared: its particles, and a function of them that
    takes a step of 5 dx/c_s."""
    grid = mpm.Grid((window,) * d, 0.1)
    place = jnp.asarray(corner) * 0.1
    particles = mpm.fill(mpm.Box((0.0,) * d, (side * 0.1,) * d), grid, particles_per_cell=2**d, density=1e3)
    turned = particles.x[:, ::-1] - particles.x.mean(axis=0)
    particles = eqx.tree_at(lambda p: (p.x, p.v), particles, (particles.x + place, 0.1 * turned))
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, nu), volume=AVERAGED)
    solver = mpm.implicit.ConjugateResidual(rtol=1e-8, max_steps=10_000)  # with 1e-9 rounding decides the counts
    method = mpm.SemiImplicit(solver=solver, preconditioner=preconditioner)
    speed = (1e4 / (2 * (1 + nu)) / 1e3) ** 0.5
    return particles, lambda own: mpm.step(scene, own, 0.0, 5 * 0.1 / speed, method=method)


@pytest.mark.thorough
@pytest.mark.parametrize("d", [2, 3])
def test_a_box_around_the_bodies_is_as_good_as_the_window_wherever_they_are(d):
    """In a batch of bodies at different places."""
    corners = [(3.3,) * d, (9.6, *(4.2,) * (d - 1))]
    whole, box = mpm.extensions.VolumePreconditioner(), mpm.extensions.VolumePreconditioner(extent=(5,) * d)
    several = [placed(d, corner, 0.4999, whole)[0] for corner in corners]
    together = jax.tree.map(lambda *a: jnp.stack(a), *several)
    found, info = jax.jit(jax.vmap(placed(d, corners[0], 0.4999, box)[1]))(together)
    alone = jax.jit(placed(d, corners[0], 0.4999, whole)[1])
    for k, own in enumerate(several):
        expected, one = alone(own)
        assert info.solve.converged[k]
        assert_close(found.v[k], expected.v, 1e-5)
        assert abs(int(info.solve.iterations[k]) - int(one.solve.iterations)) < 0.1 * int(one.solve.iterations)


@pytest.mark.parametrize(("window", "side", "extent"), thorough((30, 3, 5), (20, 8, None), (30, 10, 12)))
def test_iterations_do_not_grow_in_large_windows_of_three_dimensions(window, side, extent):
    """From ν = 0.49 to 0.4999: a hundred times the bulk modulus. The diagonal's grow 4 times with 4 cells a side, 8
    times with 8."""
    choice = mpm.extensions.VolumePreconditioner(extent=None if extent is None else (extent,) * 3)

    @jax.jit
    def solved(nu):
        particles, step = placed(3, (6.0,) * 3, nu, choice, window, side)
        return step(particles)[1].solve

    one, other = solved(0.49), solved(0.4999)
    assert one.converged
    assert other.converged
    assert int(other.iterations) < 1.7 * int(one.iterations)


def test_it_is_the_diagonal_where_there_is_no_average_or_no_room():
    scene, particles = block(2, material=mpm.NeoHookean(1e4, 0.49))
    averaged = eqx.tree_at(lambda s: s.volume, scene, AVERAGED, is_leaf=lambda leaf: leaf is None)
    periodic = mpm.Grid((8, 9), 0.1, origin=(0, -3), periodic=(True, False))
    around = mpm.Scene(periodic, mpm.NeoHookean(1e4, 0.49), volume=AVERAGED)

    def kind(scene, preconditioner=CHOICES[1]):
        found = []
        jax.eval_shape(lambda: found.append(type(preconditioner.inner_product(operator_of(scene, particles)))))
        return found[0]

    assert kind(scene) is kind(around) is DiagonalInnerProduct
    assert kind(averaged, mpm.extensions.VolumePreconditioner(largest=10)) is DiagonalInnerProduct
    assert kind(averaged) is not DiagonalInnerProduct
    assert kind(averaged, mpm.extensions.VolumePreconditioner(largest=5_000)) is DiagonalInnerProduct
    assert kind(averaged, mpm.extensions.VolumePreconditioner(largest=5_000, extent=(5, 5))) is not DiagonalInnerProduct


def test_what_it_is_given_is_checked():
    with pytest.raises(ValueError, match="largest"):
        mpm.extensions.VolumePreconditioner(largest=-1)
    with pytest.raises(ValueError, match="extent"):
        mpm.extensions.VolumePreconditioner(extent=(3, 0))
    flat, wrong = block(2, material=mpm.NeoHookean(1e4, 0.49), volume=AVERAGED), (3, 3, 3)
    with pytest.raises(ValueError, match="each of 2 axes"):
        jax.eval_shape(lambda: mpm.extensions.VolumePreconditioner(extent=wrong).inner_product(operator_of(*flat)))


@pytest.mark.thorough
@pytest.mark.parametrize("description", **ids(DESCRIPTIONS))
def test_newtons_method_and_gradients_are_those_of_the_diagonal(description):
    tight = mpm.implicit.ConjugateResidual(rtol=1e-11, max_steps=10_000)
    method = mpm.ImplicitMidpoint(mpm.implicit.Newton(rtol=1e-10, solver=tight), adjoint_solver=tight)

    def outcome(scale, preconditioner):
        law = mpm.NeoHookean(1e4 * scale, 0.499)
        scene, particles = block(2, material=law, volume=AVERAGED, description=description)
        particles = eqx.tree_at(lambda p: p.v, particles, 3 * (particles.x - particles.x.mean(axis=0))[:, ::-1])
        own = dataclasses.replace(method, preconditioner=preconditioner)
        after = mpm.rollout(scene, particles, steps=3, dt=5e-3, method=own)
        return (after.F**2).sum()

    one, other = (jax.jit(jax.value_and_grad(lambda s, c=choice: outcome(s, c)))(1.0) for choice in CHOICES)
    np.testing.assert_allclose(one, other, rtol=1e-6)
