"""A nodal force with an energy, of a user's own, written in one file outside of the package, in all that terms are used
for: a spring to the ground that hardens."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, QUICK, assert_close, assert_files_hold, block, thorough

import mpmjax as mpm
from mpmjax._types import Array
from mpmjax.potential import AbstractTerm
from mpmjax.state import LoadedPoints

SPEED, STRETCH, DT = 0.3, 0.05, 0.04
KAPPA = 4e4
"""Stiffness over mass [1/m²/s²]: at the stretch of 0.05 m that of a spring of period 0.36 s."""
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
METHODS = {
    "explicit": mpm.Explicit(),
    "semi_implicit": mpm.SemiImplicit(solver=TIGHT, adjoint_solver=TIGHT),
    "backward_euler": mpm.BackwardEuler(mpm.implicit.Newton(TIGHT, 1e-12), adjoint_solver=TIGHT),
    "implicit_midpoint": mpm.ImplicitMidpoint(mpm.implicit.Newton(TIGHT, 1e-12), adjoint_solver=TIGHT),
}


class Quartic(AbstractTerm):
    """Σ_s ¼ k_s |x_s − X_s|⁴, of which everything but the energy is derived."""

    points: LoadedPoints
    stiffness: Array

    def energy(self, moved):
        stretch = self.points.x - self.points.place + self.points.displacement(moved)
        return (self.stiffness * (stretch**2).sum(axis=0) ** 2).sum() / 4

    def stability_rates(self, mass, steepness):
        """The largest eigenvalue of its Hessian is 3 k |x − X|²."""
        square = ((self.points.x - self.points.place) ** 2).sum(axis=0)
        return self.points.at_particles(2 * 3 * self.stiffness * square, mass, steepness), 0.0


@mpm.register
class HardeningSpring(mpm.state.AbstractLoad):
    """A force k |x − X|² (x − X), k [N/m³] for all points together, towards where they were attached."""

    on: mpm.state.AbstractPlace
    stiffness: float | jax.Array

    def force(self, points, t, dt):
        return None

    def term(self, points, t):
        return Quartic(points, self.stiffness * points.weight)


class Unbounded(Quartic):
    """Says nothing of its stiffness."""

    def stability_rates(self, mass, steepness):
        return None


class UnboundedSpring(HardeningSpring):
    def term(self, points, t):
        return Unbounded(points, self.stiffness * points.weight)


def anchored(kappa=KAPPA, d=2, spring=HardeningSpring, **scene):
    """A block whose particles are all anchored, shifted by the stretch. The force on each is as its mass, so that it
    moves as one mass on the spring."""
    _, free = block(d)
    mass = float(free.mass.sum())
    everywhere = mpm.PointsAt(np.asarray(free.x), np.asarray(free.mass) / mass)
    scene, particles = block(d, loads=spring(everywhere, kappa * mass), **scene)
    scene = mpm.attach(scene, particles)
    x, v = (a.at[:, 0].add(by) for a, by in ((particles.x, STRETCH), (particles.v, SPEED)))
    return scene, dataclasses.replace(particles, x=x, v=v)


def one_step(name, kappa, x, v, dt):
    """A step of a mass with the acceleration −κ x³."""

    def solved(residual, y):
        for _ in range(30):
            y = y - residual(y) / jax.grad(residual)(y)
        return y

    if name == "explicit":
        v = v - dt * kappa * x**3
        return x + dt * v, v
    if name == "semi_implicit":  # the force linear in the displacement
        v = (v - dt * kappa * x**3) / (1 + 3 * dt**2 * kappa * x**2)
        return x + dt * v, v
    stage = dt / 2 if name == "implicit_midpoint" else dt
    w = solved(lambda w: w - v + stage * kappa * (x + stage * w) ** 3, v)
    return x + dt * w, (2 * w - v if name == "implicit_midpoint" else w)


def motion(name, kappa, steps, dt):
    """Place and velocity after some steps."""
    x, v = STRETCH + 0 * kappa, SPEED + 0 * kappa
    for _ in range(steps):
        x, v = one_step(name, kappa, x, v, dt)
    return jnp.stack([x, v])


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
@pytest.mark.parametrize("name", [*QUICK, *thorough(*(name for name in METHODS if name not in QUICK))])
def test_a_term_of_ones_own_acts_in_every_method(name, d):
    """Each method moves the body as its own formula moves a mass on the spring, and the derivative by the stiffness is
    that of the formula; implicit ones in steps of a ninth of the spring's period."""
    steps, dt = 3, 1e-3 if name == "explicit" else DT
    scene, particles = anchored(d=d)

    @eqx.filter_jit
    def end(kappa):
        own = eqx.tree_at(lambda s: s.loads[0].stiffness, scene, kappa * particles.mass.sum())
        new = mpm.rollout(own, particles, steps=steps, dt=dt, method=METHODS[name])
        return jnp.stack([(new.x - particles.x)[:, 0].mean() + STRETCH, new.v[:, 0].mean()]), new.v

    weights = jnp.asarray([1.0, 0.1])

    def both(place_and_speed, *rest):
        return weights @ place_and_speed, (place_and_speed, *rest)

    kappa = jnp.asarray(KAPPA)
    (_, (found, v)), slope = jax.value_and_grad(lambda kappa: both(*end(kappa)), has_aux=True)(kappa)
    (_, (expected,)), true_slope = jax.value_and_grad(lambda kappa: both(motion(name, kappa, steps, dt)), has_aux=True)(
        kappa
    )
    assert_close(found, expected, 1e-9)
    assert_close(v, v[:1] + 0 * v, 1e-9)
    assert_close(slope, true_slope, 1e-7)


def test_the_stable_step_knows_a_term_that_states_its_rates():
    """Springs much stiffer than the body leave 4/Δt² = 6 κ x²; a term that states nothing is refused, and a run in
    steps that are given is not."""
    kappa = 1e9
    scene, particles = anchored(kappa)
    free = float(mpm.stable_dt(block(2)[0], particles, safety=1.0))
    limit = float(mpm.stable_dt(scene, particles, safety=1.0))
    assert limit < free / 10
    assert 1 / limit**2 - 1 / free**2 == pytest.approx(6 * kappa * STRETCH**2 / 4, rel=0.01)
    scene, particles = anchored(spring=UnboundedSpring)
    with pytest.raises(ValueError, match="Unbounded gives no bound on the step: give dt"):
        mpm.stable_dt(scene, particles)
    mpm.step(scene, particles, 0.0, 1e-3)


@pytest.mark.parametrize("name", ["explicit", "semi_implicit", *thorough("backward_euler", "implicit_midpoint")])
def test_budgets_close_with_a_term_of_ones_own(name):
    """The change of the elastic energy is that of the springs, of a body that moves as one, and its momentum is what
    they give."""
    dt, mass = 1e-3 if name == "explicit" else DT, float(block(2)[1].mass.sum())
    scene, particles = anchored()
    new, found = mpm.budget(scene, particles, steps=2, dt=dt, method=METHODS[name])
    energy = found.energy
    assert_close(energy.change, energy.explained, 0, 1e-10 * mass * SPEED**2)
    places = [STRETCH, *(float(motion(name, jnp.asarray(KAPPA), n, dt)[0]) for n in (1, 2))]
    assert_close(energy.elastic, np.diff(KAPPA * mass / 4 * np.array(places) ** 4), 1e-6)
    assert_close(found.momentum.change, found.momentum.elastic, 1e-9)
    assert_close(found.momentum.change.sum(axis=0)[0], (particles.mass * (new.v - particles.v)[:, 0]).sum(), 1e-9)


class Barrier(AbstractTerm):
    """−Σ_s k_s log(h − x_s), which is defined for points before a wall at x = h only."""

    points: LoadedPoints
    stiffness: Array
    wall: float

    def room(self, moved):
        return self.wall - (self.points.x + self.points.displacement(moved))[0]

    def energy(self, moved):
        return -(self.stiffness * jnp.log(self.room(moved))).sum()

    def is_admissible(self, moved):
        return (self.room(moved) > 0).all()


@mpm.register
class BarredWall(HardeningSpring):
    """A wall that is never reached."""

    wall: float = 0.4

    def term(self, points, t):
        return Barrier(points, self.stiffness * points.weight, self.wall)


@pytest.mark.thorough
def test_the_line_search_keeps_to_where_a_term_is_defined(tmp_path):
    """A block that would fly beyond the barrier in one step stops before it, in balance with it: the impulse of the
    barrier is what it has lost. A run with it comes back from a file."""
    scene, particles = anchored(1.0, spring=BarredWall, material=LAWS["neo_hookean"])
    particles = dataclasses.replace(particles, v=particles.v.at[:, 0].set(6.0))
    dt, mass = 0.02, particles.mass
    run = mpm.simulate(scene, particles, t1=dt, dt=dt, method=METHODS["backward_euler"])
    x, place = run.final.x[:, 0], particles.x[:, 0]
    assert float((place + dt * 6.0).max()) > 0.44
    assert float(x.max()) < 0.4
    impulse = dt * float((mass / (0.4 - x)).sum())
    assert_close((mass * (6.0 - run.final.v[:, 0])).sum(), impulse, 1e-6)
    assert_files_hold(tmp_path / "run.h5", run, BarredWall)
