"""Linear solvers, preconditioners and Hessians that are not the package's: lineax's, and a user's own."""

import dataclasses
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
from helpers import LAWS, assert_close, assert_files_hold, block
from test_implicit import jolted

import mpmjax as mpm
from mpmjax.implicit import AbstractInnerProduct, DiagonalInnerProduct, TangentAction

DT = 2e-2
PROJECTED = mpm.implicit.AnalyticHessian(projected=True)
CG = lx.CG(rtol=1e-11, atol=1e-11)
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-12)
WALL = mpm.SlipBox((0.0, 0.0), (1.0, 1.0))


@mpm.register
class MinimalResidual(lx.AbstractLinearSolver):
    """C. C. Paige, M. A. Saunders, SIAM J. Numer. Anal. 12 (1975) 617, in its plainest form: a user's own solver of
    symmetric systems, which takes neither an inner product nor a guess."""

    rtol: float = 1e-11

    def init(self, operator, options):
        del options
        if not lx.is_symmetric(operator):
            raise ValueError("MinimalResidual needs a symmetric operator")
        return operator

    def compute(self, state, vector, options):
        del options
        r, Ar = vector, state.mv(vector)
        start = (0 * vector, r, r, Ar, 0 * r, 0 * r, jnp.asarray(0))

        def step(c):
            x, r, p, s, before, image, k = c
            alpha = (r * s).sum() / (s * s).sum()
            x, r, q = x + alpha * p, r - alpha * s, state.mv(s)
            beta = (q * s).sum() / (s * s).sum()
            gamma = jnp.where(k > 0, (q * image).sum() / jnp.where(k > 0, (image * image).sum(), 1), 0)
            return x, r, s - beta * p - gamma * before, q - beta * s - gamma * image, p, s, k + 1

        small = lambda r: (r**2).sum() <= (self.rtol**2) * (vector**2).sum()  # noqa: E731
        x, *_, k = jax.lax.while_loop(lambda c: ~small(c[1]) & (c[-1] < 1000), step, start)
        return x, lx.RESULTS.where(k < 1000, lx.RESULTS.successful, lx.RESULTS.max_steps_reached), {"num_steps": k}

    def transpose(self, state, options):
        return state, options

    def conj(self, state, options):
        return state, options

    def assume_full_rank(self):
        return True


class BlockJacobi(mpm.implicit.AbstractPreconditioner):
    """The d x d blocks of M + χH on the diagonal, by products with vectors of a colouring: a user's own."""

    def inner_product(self, operator):
        matrix = operator.as_matrix()
        n, d = operator.in_structure().shape
        rows = jnp.arange(n)
        return Blocks(jnp.linalg.cholesky(matrix.reshape(n, d, n, d)[rows, :, rows, :]))


class Blocks(AbstractInnerProduct):
    """One factor a node, (n, d, d). Blocks of an operator commute with its projection, which mixes no nodes, where
    walls alone hold."""

    factor: Any

    def apply(self, v):
        return jnp.einsum("nab,ncb,nc->na", self.factor, self.factor, v)

    def solve_factor(self, r):
        return jax.vmap(lambda L, r: jax.scipy.linalg.solve_triangular(L, r, lower=True))(self.factor, r)

    def solve_factor_transpose(self, v):
        return jax.vmap(lambda L, v: jax.scipy.linalg.solve_triangular(L.T, v))(self.factor, v)


@mpm.register
class ScaledMass(mpm.implicit.AbstractPreconditioner):
    """A multiple of M that is a parameter: of no use, but for tests."""

    scale: float | jax.Array = 3.0

    def inner_product(self, operator):
        return DiagonalInnerProduct(operator.projection.commuting_weight(self.scale * operator.nodal_mass()))


@mpm.register
class UndeformedHessian(mpm.implicit.AbstractHessian):
    """That of the undeformed state, whatever the deformation: linear elasticity, with which Newton's method converges
    linearly, and whose matrix is positive definite."""

    def at(self, potential, u):
        def tangent(law, F):
            return law.stress_differential(jnp.broadcast_to(jnp.eye(F.shape[0])[..., None], F.shape))

        laws = [points.law for points in potential.material_points]
        tangents = tuple(tangent(law, F) for law, F in zip(laws, potential.deformation(u), strict=True))
        return TangentAction(potential, tangents, positive_semidefinite=True)

    def exact(self):
        return mpm.implicit.AnalyticHessian()


def scene_and_particles():
    return jolted(material=LAWS["neo_hookean"], boundary=WALL)


@cache
def outcome(method, steps=2, dt=DT):
    """Final positions, velocities and statistics of a run, and the gradient of a sum of its positions by Young's
    modulus and the scale of the initial velocity."""
    scene, particles = scene_and_particles()

    def end(modulus, scale):
        law = dataclasses.replace(scene.material, youngs_modulus=modulus)
        moved = eqx.tree_at(lambda p: p.v, particles, scale * particles.v)
        run = mpm.simulate(
            dataclasses.replace(scene, material=law), moved, t1=steps * dt, dt=dt, method=method, throw=False
        )
        return (run.final.x**2).sum(), run

    value = jax.value_and_grad(end, argnums=(0, 1), has_aux=True)
    (_, run), gradient = eqx.filter_jit(value)(jnp.asarray(1e4), jnp.asarray(1.0))
    return run.final.x, run.final.v, jnp.stack(gradient), run.statistics


def assert_same(method, reference, tolerance):
    x, v, gradient, statistics = outcome(method)
    x0, v0, gradient0, statistics0 = outcome(reference)
    assert int(statistics.unconverged) == int(statistics.nearly_converged) == 0
    assert_close(x, x0, tolerance)
    assert_close(v, v0, tolerance)
    assert np.abs(gradient0).min() > 0
    assert_close(gradient, gradient0, 100 * tolerance)
    return statistics, statistics0


OURS = mpm.SemiImplicit(hessian=PROJECTED, solver=TIGHT, adjoint_solver=TIGHT)
NEWTON = mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-11), hessian=PROJECTED, adjoint_solver=TIGHT)


@pytest.mark.thorough
@pytest.mark.parametrize(
    "solver",
    [
        lx.LU(),
        lx.Cholesky(),
        MinimalResidual(),
        CG,
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_a_semi_implicit_run_and_its_gradient_by_any_symmetric_solver(solver):
    """lineax's conjugate gradients, its dense solvers and a user's own, forward and adjoint, are those by
    `ConjugateResidual`."""
    statistics, _ = assert_same(dataclasses.replace(OURS, solver=solver, adjoint_solver=solver), OURS, 1e-9)
    assert (int(statistics.iterations) > 0) == (not isinstance(solver, lx.LU | lx.Cholesky))
    assert float(statistics.worst_residual) < 1e-10


@pytest.mark.thorough
def test_newtons_method_by_conjugate_gradients():
    """In backward Euler, of a projected Hessian; the adjoint is that of the true one, for which it takes a solver of
    matrices that may be indefinite."""
    method = dataclasses.replace(NEWTON, solution=mpm.implicit.Newton(CG, 1e-11), adjoint_solver=MinimalResidual())
    statistics, reference = assert_same(method, NEWTON, 1e-9)
    assert statistics.newton == reference.newton


@pytest.mark.thorough
def test_the_preconditioner_is_that_of_any_solver():
    """A solver that knows of none is given the scaled system: it takes as many iterations as ours, as many fewer with
    the better preconditioner, and ends with the residual that it states."""
    scene, particles = scene_and_particles()
    counts = []
    for preconditioner in (mpm.implicit.MassPreconditioner(), mpm.implicit.DiagonalPreconditioner(), BlockJacobi()):
        method = dataclasses.replace(OURS, preconditioner=preconditioner)
        for solver in (method.solver, MinimalResidual(rtol=1e-12)):
            _, info = mpm.step(scene, particles, 0.0, 5 * DT, method=dataclasses.replace(method, solver=solver))
            assert info.solve.converged
            assert info.solve.residual <= 1e-12
            counts.append(int(info.solve.iterations))
    by_mass, by_diagonal, by_blocks = zip(counts[::2], counts[1::2], strict=True)
    for ours, theirs in (by_mass, by_diagonal, by_blocks):
        assert abs(ours - theirs) <= 2
    assert by_diagonal[1] < by_mass[1]


def test_what_cannot_solve_is_refused_with_what_can():
    """Conjugate gradients of a matrix that may be indefinite, forward, in Newton's method and as its adjoint; solvers
    of matrices of another structure; lineax's componentwise test without an absolute tolerance."""
    scene, particles = scene_and_particles()

    def stepped(method):
        return mpm.step(scene, particles, 0.0, DT, method=method)

    for method in (mpm.SemiImplicit(solver=CG), mpm.BackwardEuler(mpm.implicit.Newton(CG))):
        with pytest.raises(ValueError, match=r"CG refuses .* may be indefinite\. Take .*AnalyticHessian\(projected"):
            stepped(method)
    with pytest.raises(ValueError, match=r"CG refuses .* adjoint_solver of Newton's method"):
        outcome(dataclasses.replace(NEWTON, adjoint_solver=CG))
    with pytest.raises(ValueError, match=r"Tridiagonal refuses .* without other structure\. Take"):
        stepped(mpm.SemiImplicit(hessian=PROJECTED, solver=lx.Tridiagonal()))
    for make in (mpm.implicit.Linearised, mpm.implicit.Newton, lambda solver: mpm.BackwardEuler(adjoint_solver=solver)):
        with pytest.raises(ValueError, match=r"must have an atol above zero"):
            make(solver=lx.CG(rtol=1e-8, atol=0.0))
    identity = lx.IdentityLinearOperator(jax.ShapeDtypeStruct((2,), float))
    with pytest.raises(ValueError, match=r"takes no preconditioner"):
        mpm.implicit.ConjugateResidual().init(identity, {"preconditioner": identity})


class Missing(MinimalResidual):
    """Misses the solution by a share, so that its residual is that share of the right-hand side, and says something."""

    share: float = 0.0
    says: bool = True
    atol: float | None = None

    def compute(self, state, vector, options):
        x = jnp.linalg.solve(state.as_matrix(), vector.reshape(-1)).reshape(vector.shape)
        said = lx.RESULTS.where(self.says, lx.RESULTS.successful, lx.RESULTS.stagnation)
        return (1 + self.share) * x, said, {}


def test_another_solver_has_converged_if_it_says_so_and_its_residual_does():
    """Nearly within ten times its tolerance, whatever it says; and so Newton's method after its last step. An absolute
    tolerance is of each component, of a right-hand side of norm one."""
    scene, particles = block(1, material=LAWS["neo_hookean"])
    particles = mpm.prepare(scene, particles)  # stretched by a half, and at rest
    particles = dataclasses.replace(particles, deformations=(1.5 * particles.F,))

    def ended(method):
        solve = mpm.step(scene, particles, 0.0, DT, method=method)[1].solve
        return bool(solve.converged), bool(solve.nearly_converged), float(solve.residual)

    for times, says, wanted in (
        (0.9, True, (True, False)),
        (0.9, False, (False, True)),
        (1.1, True, (False, True)),
        (9.9, True, (False, True)),
        (10.1, True, (False, False)),
    ):
        *verdict, residual = ended(mpm.SemiImplicit(solver=Missing(1e-6, times * 1e-6, says)))
        assert tuple(verdict) == wanted
        assert residual == pytest.approx(times * 1e-6)
    both = 1e-6 + 3e-7 * np.sqrt(scene.grid.size)
    for times, wanted in ((0.99, (True, False)), (1.01, (False, True))):
        assert ended(mpm.SemiImplicit(solver=Missing(1e-6, times * both, atol=3e-7)))[:2] == wanted
    newton = lambda rtol: ended(mpm.BackwardEuler(mpm.implicit.Newton(rtol=rtol, max_steps=1)))  # noqa: E731
    left = newton(1e-9)[2]
    for times, wanted in ((0.9, (True, False)), (1.1, (False, True)), (9.9, (False, True)), (10.1, (False, False))):
        assert newton(left / times)[:2] == wanted


@pytest.mark.thorough
def test_a_solver_that_does_not_solve_is_found_out():
    """One that returns its right-hand side and calls it a solution: the residual is computed, and the run raises."""

    class Careless(MinimalResidual):
        def compute(self, state, vector, options):
            return vector, lx.RESULTS.successful, {}

    scene, particles = scene_and_particles()
    with pytest.raises(mpm.SimulationError, match=r"did not converge \(worst relative residual 0\.\d"):
        mpm.simulate(scene, particles, t1=DT, dt=DT, method=mpm.SemiImplicit(solver=Careless()))
    gradient = outcome(dataclasses.replace(OURS, adjoint_solver=Careless()), steps=1)[2]
    assert np.isnan(gradient).all()


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("preconditioner", "method"),
    [
        pytest.param(ScaledMass(), OURS, id="diagonal_linear"),
        pytest.param(BlockJacobi(), NEWTON, id="blocks_newton"),
        pytest.param(ScaledMass(), NEWTON, id="diagonal_newton"),
        pytest.param(BlockJacobi(), OURS, id="blocks_linear"),
    ],
)
def test_a_preconditioner_of_ones_own(preconditioner, method):
    """In one linear solve and in Newton's method, forward and adjoint: the same motion and gradient."""
    assert_same(dataclasses.replace(method, preconditioner=preconditioner), method, 1e-9)


@pytest.mark.thorough
def test_a_hessian_of_ones_own():
    """Newton's method converges with it to the same solution, more slowly, and the gradient is that of the true
    Hessian; lineax's conjugate gradients take its word that it is positive definite."""
    method = dataclasses.replace(NEWTON, hessian=UndeformedHessian())
    statistics, reference = assert_same(method, NEWTON, 1e-8)
    assert statistics.newton > reference.newton
    method = dataclasses.replace(OURS, hessian=UndeformedHessian())
    assert_same(dataclasses.replace(method, solver=CG, adjoint_solver=CG), method, 1e-9)


def test_a_run_by_a_solver_preconditioner_and_hessian_of_ones_own_is_saved_and_loaded(tmp_path):
    """In one method, each with its parameters."""
    method = mpm.SemiImplicit(
        0.9,
        MinimalResidual(1e-9),
        hessian=UndeformedHessian(),
        preconditioner=ScaledMass(2.0),
        adjoint_solver=MinimalResidual(1e-8),
    )
    run = mpm.simulate(*block(1, gravity=(-9.81,)), t1=DT, dt=DT, method=method)
    assert_files_hold(tmp_path / "run.h5", run, UndeformedHessian, MinimalResidual, ScaledMass)
