"""Problems with an exact answer: a wave of any amplitude, one particle's oscillation."""

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ids

import mpmjax as mpm

E, NU, DENSITY = 1e4, 0.3, 1e3
LAW = mpm.FixedCorotated(E, NU)
MODULUS = float(LAW.lame_lambda + 2 * LAW.shear_modulus)
C = np.sqrt(MODULUS / DENSITY)


def oscillation(method, number, steps, d=2):
    """|F − I| of one particle that oscillates alone, at Δt c/dx = `number`, after each step.

    A uniform dilation δF I obeys δF' = C, C' = −ω² δF with ω² = a (2μ + dλ)/ρ0, a = 4/dx².
    """
    dx, amplitude = 0.1, 1e-6
    grid = mpm.Grid((6,) * d, dx)
    scene = mpm.Scene(grid, LAW)
    dt = number * dx / C
    one = jnp.ones(1)
    x = jnp.full((1, d), 0.2637)
    start = mpm.Particles(x, 0 * x, DENSITY * 1e-3 * one, 1e-3 * one, F=((1 + amplitude) * jnp.eye(d))[None])
    run = mpm.simulate(scene, start, t1=steps * dt, dt=dt, method=method, save_every=1)
    return (np.asarray(run.frames.F)[:, 0] - np.eye(d))[:, 0, 0] / amplitude, np.asarray(run.frames.C)[
        :, 0, 0, 0
    ] * dt / amplitude


def test_explicit_limit_of_one_particle():
    """Δt c/dx = 0.837 in 2-D: bounded at 0.98 of it, growing at 1.02."""
    lam, mu = float(LAW.lame_lambda), float(LAW.shear_modulus)
    limit = np.sqrt(4 * DENSITY / ((2 * mu + 2 * lam) * 4)) * C
    assert abs(limit - 0.837) < 1e-3
    below, above = (np.abs(oscillation(mpm.Explicit(), f * limit, 60)[0]) for f in (0.98, 1.02))
    assert below.max() < 10
    assert above[-5:].max() > 1e3


AMPLIFICATIONS = {
    "beta 1, z 0.5": (1.0, 0.5, 0.816497),
    "beta 1, z 3.9": (1.0, 3.9, 0.451754),
    "beta 1/2, z 0.5": (0.5, 0.5, 0.894427),
}


@pytest.mark.parametrize(("beta", "z", "expected"), **ids(AMPLIFICATIONS))
def test_amplification_of_the_semi_implicit_step(beta, z, expected):
    """|λ| = (1 + βz)^(−½) of the 2 x 2 map of (δF, Δt C), from two steps: its determinant is |λ|²."""
    lam, mu = float(LAW.lame_lambda), float(LAW.shear_modulus)
    number = np.sqrt(z * DENSITY / (4 * (2 * mu + 2 * lam))) * C
    method = mpm.SemiImplicit(beta=beta, solver=mpm.ConjugateResidual(rtol=1e-13))
    F, D = oscillation(method, number, 3)
    before, after = np.array([F[:2], D[:2]]), np.array([F[1:3], D[1:3]])
    assert abs(np.sqrt(np.linalg.det(after) / np.linalg.det(before)) - expected) < 1e-6
