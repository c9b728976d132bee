"""A gradient operator of a user's own, written in one file outside of the package, in all that they are used for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, assert_files_hold, thorough

import mpmjax as mpm


@mpm.register
class BlendedGradient(mpm.discretisation.AbstractGradient):
    """The gradient of the spline with a given share, that of moving least squares with the rest."""

    share: float | jax.Array = 0.5

    def derivatives(self, spline, least_squares):
        return self.share * spline + (1 - self.share) * least_squares


class BoundedGradient(BlendedGradient):
    """The same with a bound on the step: Ξ is convex in g, so that of the blend is at most the blend of both."""

    def steepness(self, kernel, spacing, inverse_moment):
        both = [g.steepness(kernel, spacing, inverse_moment) for g in (mpm.SplineGradient(), mpm.MLSGradient())]
        return self.share * both[0] + (1 - self.share) * both[1]


def moving(gradient, **choices):
    """A block that shears and turns."""
    grid = mpm.Grid((9, 9), 0.1, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, particles_per_cell=4, density=1e3)
    v = particles.x @ jnp.asarray([[0.5, 1.0], [-2.0, 0.3]])
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), gradient=gradient, **choices)
    return scene, mpm.Particles(particles.x, v, particles.mass, particles.volume)


EXPLICIT, IMPLICIT, SPLINE, MLS = mpm.Explicit(), mpm.SemiImplicit(), mpm.SplineGradient(), mpm.MLSGradient()


@pytest.mark.parametrize(
    ("method", "share", "package"),
    [(EXPLICIT, 1.0, SPLINE), *thorough((IMPLICIT, 1.0, SPLINE), (EXPLICIT, 0.0, MLS), (IMPLICIT, 0.0, MLS))],
)
def test_at_its_ends_it_is_the_packages(method, share, package):
    own, expected = (
        mpm.rollout(*moving(gradient), steps=3, dt=1e-3, method=method)
        for gradient in (BlendedGradient(share), package)
    )
    for a, b in ((own.x, expected.x), (own.v, expected.v), (own.C, expected.C), (own.F, expected.F)):
        assert_close(a, b, 1e-11)


def test_its_parameter_has_a_derivative():
    def stretch(share):
        return (mpm.rollout(*moving(BlendedGradient(share)), steps=20, dt=1e-3).F ** 2).sum()

    (low, _), (_, slope), (high, _) = map(jax.jit(jax.value_and_grad(stretch)), (0.4 - 1e-4, 0.4, 0.4 + 1e-4))
    assert abs(float(slope)) > 1e-6
    assert float(slope) == pytest.approx(float(high - low) / 2e-4, rel=1e-6)


def test_its_budget_closes():
    _, found = mpm.budget(*moving(BlendedGradient()), steps=3, dt=1e-3)
    assert_close(found.energy.explained, found.energy.change, 1e-9, atol=1e-12)
    assert_close(found.momentum.explained, found.momentum.change, 1e-9, atol=1e-12)


@pytest.mark.thorough
def test_a_bound_on_the_step_is_given_or_said_to_be_missing():
    """In the total description it follows from where the particles are."""
    spline, mls, own = (
        float(mpm.stable_dt(*moving(g))) for g in (mpm.SplineGradient(), mpm.MLSGradient(), BoundedGradient())
    )
    assert spline < own < mls
    scene, particles = moving(BlendedGradient())
    for ask in (lambda: mpm.stable_dt(scene, particles), lambda: mpm.simulate(scene, particles, t1=0.1, dt="stable")):
        with pytest.raises(ValueError, match="BlendedGradient gives no bound on the step: give dt"):
            ask()
    total = moving(BlendedGradient(0.0), description=mpm.TotalLagrangian())
    packages = moving(mpm.MLSGradient(), description=mpm.TotalLagrangian())
    np.testing.assert_allclose(mpm.stable_dt(*total), mpm.stable_dt(*packages), rtol=1e-12)


def test_a_run_with_it_is_saved_and_loaded(tmp_path):
    """Its parameter too. One that is not registered is refused."""
    run = mpm.simulate(*moving(BlendedGradient(0.3)), t1=2e-3, dt=1e-3)
    assert_files_hold(tmp_path / "run.h5", run, BlendedGradient)
    run = eqx.tree_at(lambda r: r.scene.gradient, run, BoundedGradient())
    with pytest.raises(ValueError, match=r"gradient is a BoundedGradient, which files cannot hold: .* @mpm\.register"):
        mpm.save(tmp_path / "none.h5", run)


def test_an_unknown_object_is_an_error():
    for wrong in (mpm.BSpline(), BlendedGradient):
        with pytest.raises(ValueError, match="Scene's gradient must be one of"):
            moving(wrong)
