"""A contact of a user's own, written in one file outside of the package, in all that contacts are used for: a wall with
glue on it, which holds material until that pulls too hard."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_close, ids, thorough

import mpmjax as mpm
from mpmjax._types import Array


class GlueContact(mpm.boundary.AbstractContact):
    """Each column of nodes along the axis is a place, held at its nodes on and beyond the wall."""

    axis: int = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)
    inward: int = eqx.field(static=True)
    beyond: Array
    bears: Array

    def column(self, values):
        """The sum over each column's nodes on and beyond the wall, at all of its nodes."""
        sums = jnp.where(self.beyond, values, 0).reshape(self.shape).sum(axis=self.axis, keepdims=True)
        return jnp.broadcast_to(sums, self.shape).reshape(-1)

    def gap_velocity(self, held, v):
        return self.column(self.inward * held.mass * v[:, self.axis])

    def likely_held(self, held):
        return self.gap_velocity(held, held.nodes.explicit_velocity()) < self.bears

    def normal_impulse(self, held, residual):
        return self.column(self.inward * held.impulse(residual)[:, self.axis]) + self.bears

    def rounding(self, held, noise):
        return (noise * self.column(held.mass),) * 2

    def fixed(self, active, shape):
        return (active & self.beyond)[:, None] & (jnp.arange(shape[1]) == self.axis)

    @property
    def representative(self):
        first = jnp.arange(self.shape[self.axis]) == 0
        axes = [1] * len(self.shape)
        axes[self.axis] = -1
        return jnp.broadcast_to(first.reshape(axes), self.shape).reshape(-1)


@mpm.register
class GluedWall(mpm.boundary.AbstractBoundary):
    """A wall at right angles to an axis along which material slides, and which it leaves where it pulls harder than the
    glue bears [Pa]."""

    axis: int = eqx.field(static=True)
    position: float | jax.Array
    glue: float | jax.Array
    keep: str = eqx.field(static=True, default="below")

    @property
    def dim(self):
        return None

    @property
    def inward(self):
        return 1 if self.keep == "above" else -1

    def conditions(self, nodes, spacing, t, dt, *, reference):
        return mpm.boundary.Conditions(jnp.zeros(nodes.shape, bool), jnp.zeros_like(nodes))

    def contacts(self, faces, grid, window, t, dt):
        beyond = self.inward * (grid.nodes(window)[:, self.axis] - self.position) <= 1e-3 * grid.spacing
        bears = jnp.asarray(self.glue * grid.spacing ** (grid.dim - 1) * dt)
        return (GlueContact(self.axis, grid.shape, self.inward, beyond, bears),)

    def walls(self):
        return (mpm.boundary.Wall(self.axis, float(self.position), self.inward),)


DENSITY, HEIGHT, G = 1e3, 0.4, 10.0
WEIGHT = DENSITY * G * HEIGHT
"""The tension at the ceiling of a block that hangs [Pa]."""


def hanging(glue, d=1, stiffness=1e7, nu=0.3, **choices):
    """A block under a ceiling at zero, in the last direction, with glue between them: as wide as the period, so that
    it hangs as a column does."""
    grid = mpm.Grid((4,) * (d - 1) + (16,), 0.1, origin=(0,) * (d - 1) + (-13,), periodic=(True,) * (d - 1) + (False,))
    lower, upper = (0.0,) * (d - 1) + (-HEIGHT,), (0.4,) * (d - 1) + (0.0,)
    particles = mpm.fill(mpm.Box(lower, upper), grid, particles_per_cell=2**d, density=DENSITY)
    law, down = mpm.NeoHookean(stiffness, nu), (0.0,) * (d - 1) + (-G,)
    return mpm.Scene(grid, law, gravity=down, boundary=GluedWall(d - 1, 0.0, glue), **choices), particles


TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-12)
METHODS = {"semi_implicit": mpm.SemiImplicit(), "backward_euler": mpm.BackwardEuler(), "trbdf2": mpm.TRBDF2()}


@pytest.mark.parametrize("method", **ids(METHODS, ("semi_implicit",)))
@pytest.mark.parametrize("d", [1, *thorough(2, 3)])
def test_it_hangs_by_more_than_its_weight_and_falls_by_less(method, d):
    """By steps so long that it is loaded as if at rest. Falling, all of it has the velocity −g t and no strain; with
    TR-BDF2 the soft one (ν = 0) is loaded in its first step by less than the glue bears, and its fall lacks that."""
    steps, dt = 4, 0.05
    for nu in (0.0, 0.49):
        for share in (1.1, 0.9):
            run = mpm.simulate(*hanging(share * WEIGHT, d, nu=nu), t1=steps * dt, dt=dt, method=method)
            down = np.zeros(d) if share > 1 else np.asarray([0.0] * (d - 1) + [-G * steps * dt])
            if share < 1 and isinstance(method, mpm.TRBDF2):
                fall = np.asarray(run.final.v)[:, -1]
                assert ((-G * steps * dt - 1e-8 < fall) & (fall < -G * (steps - 1) * dt)).all()
                continue
            np.testing.assert_allclose(
                run.final.v, np.broadcast_to(down, run.final.v.shape), atol=1e-2 * (share > 1) + 1e-8
            )
            assert int(run.statistics.violations) == 0


def test_it_tears_off_at_the_tension_it_bears():
    """In explicit steps the tension rises until the glue gives; before that the wall pulls by no more than it bears,
    and from then on not at all. The budgets close with it."""
    glue, dt = 0.5 * WEIGHT, 2e-3
    scene, particles = hanging(glue, d=2, stiffness=1e5)
    _, found = mpm.budget(scene, particles, steps=60, dt=dt)
    pull = np.asarray(found.momentum.boundary)[:, 1] / dt / (glue * 0.4)
    torn = int(np.argmax(pull < 0.1))
    assert 5 < torn < 50
    assert 0.8 < pull[:torn].max() <= 1
    assert np.abs(pull[torn:]).max() < 1e-12
    assert_close(found.momentum.explained, found.momentum.change, 1e-9)
    assert_close(found.energy.explained, found.energy.change, 1e-9)


@pytest.mark.thorough
def test_it_holds_beside_a_plane_of_symmetry():
    """Half a block beside a plane hangs as the whole one, by the same columns."""
    whole, particles = hanging(5 * WEIGHT, d=2, stiffness=1e5)
    grid = mpm.Grid((10, 16), 0.1, origin=(-3, -13))
    whole = eqx.tree_at(lambda s: s.grid, whole, grid)
    half = eqx.tree_at(lambda s: s.boundary, whole, (mpm.SymmetryPlane(0, 0.2), *whole.boundary))
    right = np.flatnonzero(np.asarray(particles.x)[:, 0] > 0.2)
    part = mpm.Particles(*(leaf[right] for leaf in (particles.x, particles.v, particles.mass, particles.volume)))
    ends = [
        mpm.rollout(s, p, steps=10, dt=2e-3, method=mpm.SemiImplicit(solver=TIGHT))
        for s, p in ((whole, particles), (half, part))
    ]
    assert np.abs(np.asarray(ends[0].x - particles.x)).max() > 1e-4
    assert_close(ends[1].x, ends[0].x[right], 1e-9)


@pytest.mark.parametrize("method", thorough(mpm.Explicit(), mpm.SemiImplicit()), ids=["explicit", "semi_implicit"])
def test_what_hangs_has_a_derivative(method):
    def height(stiffness):
        scene, particles = hanging(5 * WEIGHT, stiffness=stiffness)
        return mpm.simulate(scene, particles, t1=0.01, dt=5e-4, method=method).final.x.mean()

    E = 1e5
    (_, slope), (above, _), (below, _) = map(jax.value_and_grad(height), (E, 1.001 * E, 0.999 * E))
    assert float(slope) == pytest.approx(float(above - below) / (2e-3 * E), rel=1e-5)


def test_it_is_saved_and_loaded(tmp_path):
    scene, particles = hanging(2 * WEIGHT)
    run = mpm.simulate(scene, particles, t1=0.1, dt=0.05, method=mpm.SemiImplicit(), save_every=1)
    mpm.save(tmp_path / "run.h5", run)
    again = mpm.load(tmp_path / "run.h5")
    assert jax.tree.structure(again.scene.boundary) == jax.tree.structure(run.scene.boundary)
    assert float(again.scene.boundary[0].glue) == 2 * WEIGHT
    np.testing.assert_array_equal(again.final.x, run.final.x)


@pytest.mark.thorough
def test_it_holds_in_the_total_description_too():
    """Which refuses contacts that are judged by where material is, but not one's own."""
    scene, particles = hanging(1.1 * WEIGHT, description=mpm.TotalLagrangian())
    final = mpm.simulate(scene, particles, t1=0.2, dt=0.05, method=mpm.SemiImplicit()).final
    assert np.abs(np.asarray(final.v)).max() < 1e-2


def test_of_what_lies_beyond_it_is_told():
    """Since it says where its wall is."""
    scene, particles = hanging(WEIGHT)
    moved = eqx.tree_at(lambda p: p.x, particles, particles.x + 0.1)
    with pytest.warns(UserWarning, match=r"2 of 8 particles lie in or beyond the GluedWall \(boundary 1\)"):
        mpm.prepare(scene, moved)
