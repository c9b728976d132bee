"""The exact problems themselves: their forces by an independent derivation, their bodies at rest at their ends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ids, thorough

import mpmjax as mpm
from mpmjax.verification import (
    AxisAligned,
    Ends,
    HenckyColumn,
    StandingWave,
    TwoDisks,
    VibratingBar,
    Vortex,
    discretise,
)

E, NU, DENSITY = 1e7, 0.3, 1e3
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
POINTS = np.random.default_rng(0).uniform(0.1, 0.9, (5, 3))
TIMES = (0.0, 0.0013, 0.0171)


def aligned_force(law: str, u, stretch, J):
    """Closed forms of the axis-aligned problem, from the laws' stress in principal axes."""
    if law == "neo_hookean":
        factor = (LAMBDA / stretch**2) * (1 - np.log(J)) + MU * (1 + 1 / stretch**2) - E
    else:
        factor = -E + 2 * MU + LAMBDA * (J / stretch) ** 2
    return np.pi**2 * u * factor / DENSITY


@pytest.mark.parametrize(
    "law", thorough(mpm.NeoHookean(E, NU), mpm.FixedCorotated(E, NU)), ids=["neo_hookean", "fixed_corotated"]
)
@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_the_axis_aligned_force_is_the_closed_form(d, law):
    problem = AxisAligned(0.05, d, material=law)
    name = "neo_hookean" if isinstance(law, mpm.NeoHookean) else "fixed_corotated"
    for t in TIMES:
        for X in POINTS[:, :d]:
            u = np.asarray(problem.position(jnp.asarray(X), t)) - X
            stretch = np.diag(np.asarray(problem.deformation(jnp.asarray(X), t)))
            expected = aligned_force(name, u, stretch, stretch.prod())
            np.testing.assert_allclose(problem.body_force(jnp.asarray(X), t), expected, rtol=1e-9, atol=1e-6)


@pytest.mark.thorough
def test_the_vortex_force_is_the_closed_form():
    """b_r = (μ/ρ) R (g h′)² − R (g′ h)², b_t = R g″ h − (μ/ρ)(3 g h′ + R g h″), turned by Θ + g h."""
    amplitude, mu, rho = 0.3, 1e3 / 2.6, 1e3
    problem = Vortex(amplitude)
    for t in (0.0, 0.2, 0.7):
        g, g1, g2 = (
            amplitude * f for f in (np.sin(np.pi * t), np.pi * np.cos(np.pi * t), -(np.pi**2) * np.sin(np.pi * t))
        )
        for R, angle in ((0.8, 0.3), (1.0, 2.0), (1.21, 4.0)):
            s = R - 1
            h, h1, h2 = 1 - 32 * s**2 + 256 * s**4, -64 * s + 1024 * s**3, -64 + 3072 * s**2
            radial = mu / rho * R * (g * h1) ** 2 - R * (g1 * h) ** 2
            around = R * g2 * h - mu / rho * (3 * g * h1 + R * g * h2)
            place = angle + g * h
            expected = radial * np.array([np.cos(place), np.sin(place)]) + around * np.array(
                [-np.sin(place), np.cos(place)]
            )
            X = R * jnp.asarray([np.cos(angle), np.sin(angle)])
            np.testing.assert_allclose(problem.body_force(X, t), expected, rtol=1e-8, atol=1e-9)
            assert float(jnp.linalg.det(problem.deformation(X, t))) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize(
    "problem",
    [*thorough(StandingWave(0.2)), StandingWave(0.2, 2), *thorough(StandingWave(0.1, 3)), VibratingBar(5.0)],
)
def test_what_needs_no_force_has_none(problem):
    """At any amplitude; relative to the motion's own acceleration."""
    assert not problem.forced
    for t in (0.0, 0.1, 0.37):
        X = jnp.asarray(POINTS[0, : problem.dim])
        inertia = jax.jacfwd(lambda s, X=X: problem.velocity(X, s))(t)
        assert float(jnp.abs(problem.body_force(X, t)).max()) < 1e-10 * max(1.0, float(jnp.abs(inertia).max()))


def test_the_bar_is_the_textbooks():
    """n = 1: ω = 0.628319, a largest displacement of 0.159155, centre-of-mass velocity 0.063662, energy 0.0625."""
    bar = VibratingBar()
    assert bar.frequency == pytest.approx(0.628319, abs=1e-6)
    end = bar.position(jnp.asarray([25.0]), bar.duration / 4)
    assert float(end[0]) - 25 == pytest.approx(0.159155, abs=1e-6)
    scene, particles = discretise(bar, 4)
    assert float(mpm.momentum(particles)[0] / particles.mass.sum()) == pytest.approx(0.063662, abs=1e-5)
    assert float(mpm.energy(scene, particles).total) == pytest.approx(0.0625, rel=1e-3)


PROBLEMS = {
    "wave": StandingWave(0.05, 2),
    "wave, periodic": StandingWave(0.05, 2, ends=Ends.PERIODIC),
    "aligned, walls": AxisAligned(0.05, 2, ends=Ends.PLAIN),
    "vortex": Vortex(),
    "bar": VibratingBar(),
}


@pytest.mark.parametrize("problem", **ids(PROBLEMS, "wave"))
def test_a_problem_starts_in_its_exact_state(problem):
    """Position, velocity, F and the velocity gradient in both descriptions, against finite differences in time."""
    for description in (mpm.UpdatedLagrangian(), mpm.TotalLagrangian()):
        scene, particles = discretise(problem, 8, description=description)
        X, h = particles.X, 1e-5 / problem.wave_speed

        def deformation(t, X=X):
            return jax.vmap(lambda Y: problem.deformation(Y, t))(X)

        rate = (deformation(h) - deformation(-h)) / (2 * h)
        gradient = rate if scene.total else rate @ np.linalg.inv(np.asarray(particles.F))
        scale = float(jnp.abs(gradient).max()) + problem.wave_speed
        np.testing.assert_allclose(particles.C, gradient, rtol=0, atol=1e-7 * scale)
        np.testing.assert_allclose(particles.F, deformation(0.0), rtol=1e-14)
        assert mpm.prepare(scene, particles).count == particles.count


def test_a_wave_of_another_law_or_beyond_folding_is_refused():
    with pytest.raises(ValueError, match="FixedCorotated only"):
        StandingWave(0.05, material=mpm.NeoHookean(1e4, 0.3))
    with pytest.raises(ValueError, match="below 1/π"):
        StandingWave(0.5)


@pytest.mark.thorough
@pytest.mark.parametrize("load", [4.0, 0.04])
def test_the_hencky_column_carries_its_weight(load):
    """P = −a (1 − X), x(0) = 0, F = ∂x/∂X with E ln F/F = P, the body force −a, and F = 0.3 at the bottom at a = 4."""
    column = HenckyColumn(load)
    for X in (0.0, 0.3, 0.99):
        place = jnp.asarray([X])
        F = column.deformation(place, column.duration)
        np.testing.assert_allclose(column.material.stress(F)[0, 0], -load * (1 - X), rtol=1e-12)
        np.testing.assert_allclose(jnp.log(F) / F, [[-load * (1 - X)]], rtol=1e-12)
        np.testing.assert_allclose(column.body_force(place, column.duration), [-load], rtol=1e-9)
    assert float(column.position(jnp.zeros(1), column.duration)[0]) == pytest.approx(0, abs=1e-15)
    if load == 4:
        assert float(column.deformation(jnp.zeros(1), column.duration)[0, 0]) == pytest.approx(0.3005, abs=1e-3)
    np.testing.assert_array_equal(column.position(jnp.asarray([0.3]), 0.0), [0.3])


@pytest.mark.thorough
def test_the_disks_touch_when_they_should():
    disks = TwoDisks()
    assert disks.contact_time == pytest.approx(1.5858, abs=1e-4)
    scene, particles = disks.discretise(per_side=12)  # a coarse lattice has a mass of its own
    np.testing.assert_allclose(mpm.momentum(particles), 0, atol=1e-12)
    assert float(mpm.energy(scene, particles).kinetic) == pytest.approx(2.5133, rel=2e-3)
    assert dataclasses.replace(disks, speed=0.2).contact_time == pytest.approx(disks.contact_time / 2)
