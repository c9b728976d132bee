"""A way of a user's own to solve the stages of implicit steps, written in one file outside of the package."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import assert_close, block

import mpmjax as mpm


@mpm.register
class Chord(mpm.implicit.AbstractStageSolver):
    """Newton's method with the Hessian of its start in all steps."""

    steps: int = eqx.field(static=True, default=8)

    def __call__(self, problem, guess):
        v = problem.apply_dirichlet(guess)
        matrix = problem.operator(v)

        def chord(_, v):
            return v - jax.scipy.sparse.linalg.cg(matrix.mv, problem.residual(v), tol=1e-4)[0]

        return jax.lax.fori_loop(0, self.steps, chord, v), mpm.implicit.no_solve(v.dtype)


def swinging(**scene):
    """A block that is held at one end, and moves."""
    scene, particles = block(2, side=2, gravity=(0.0, -9.81), boundary=mpm.SlipBox((0.0, -9.0), (9.0, 9.0)), **scene)
    return scene, eqx.tree_at(lambda p: p.v, particles, particles.x @ jnp.asarray([[0.5, 1.0], [-2.0, 0.3]]))


@pytest.mark.thorough
@pytest.mark.parametrize("integrator", [mpm.ImplicitMidpoint, mpm.TRBDF2])
def test_it_finds_what_newton_finds_with_its_derivative(integrator):
    def final(solution, stiffness):
        scene, particles = swinging(material=mpm.NeoHookean(stiffness, 0.3))
        method = integrator(solution=solution)
        return mpm.simulate(scene, particles, t1=4e-3, dt=2e-3, method=method).final.x

    assert_close(final(Chord(), 1e4), final(mpm.implicit.Newton(rtol=1e-11), 1e4), 1e-10)
    own, newton = (
        jax.grad(lambda E, solution=solution: (final(solution, E) ** 2).sum())(1e4)
        for solution in (Chord(), mpm.implicit.Newton(rtol=1e-11))
    )
    assert float(own) == pytest.approx(float(newton), rel=1e-6)


def test_its_budget_closes_and_it_is_saved(tmp_path):
    scene, particles = swinging()
    method = mpm.ImplicitMidpoint(solution=Chord())
    _, found = mpm.budget(scene, particles, steps=2, dt=4e-3, method=method)
    assert_close(found.energy.explained, found.energy.change, 1e-8)
    run = mpm.simulate(scene, particles, t1=8e-3, dt=4e-3, method=method, save_every=1)
    mpm.save(tmp_path / "run.h5", run)
    assert mpm.load(tmp_path / "run.h5").method.solution == Chord()
