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


def wave_error(cells, d, ends, amplitude, description=mpm.UpdatedLagrangian()):
    """Largest RMS error of the displacement over half a period, relative to A: u = A sin(kX) cos(kct), explicit APIC.

    Exact at any amplitude: in uniaxial strain P₁₁ = (λ + 2μ)(F₁₁ − 1). Across, the strip is periodic; along, it is
    periodic over a wavelength 1, or half of it lies between two symmetry planes.
    """
    dx, k = 1 / cells, 2 * np.pi
    across = (4,) * (d - 1)
    length = 1.0 if ends == "periodic" else 0.5
    if ends == "periodic":
        grid = mpm.Grid((cells, *across), dx, periodic=True)
        boundary = ()
    else:
        grid = mpm.Grid(
            (cells // 2 + 7, *across), dx, origin=(-3,) + (0,) * (d - 1), periodic=(False,) + (True,) * (d - 1)
        )
        boundary = (mpm.SymmetryPlane(0, 0.0), mpm.SymmetryPlane(0, 0.5, keep="below"))
    X = mpm.fill(mpm.Box((0.0,) * d, (length, *(4 * dx,) * (d - 1))), grid, particles_per_cell=2**d, density=DENSITY)
    steps = 4 * cells
    dt = 0.5 / C / steps
    phase = k * np.asarray(X.x[:, 0])
    x, v, F, gradient = (
        np.array(X.x),
        np.zeros(X.x.shape),
        np.tile(np.eye(d), (X.count, 1, 1)),
        np.zeros((X.count, d, d)),
    )
    x[:, 0] += amplitude * np.sin(phase)
    F[:, 0, 0] += amplitude * k * np.cos(phase)
    # symplectic Euler is leap-frog: its velocity is that of half a step before
    speed = amplitude * k * C * np.sin(k * C * dt / 2)
    v[:, 0] = speed * np.sin(phase)
    gradient[:, 0, 0] = speed * k * np.cos(phase)
    total = isinstance(description, mpm.TotalLagrangian)
    if not total:
        gradient[:, 0, 0] /= F[:, 0, 0]
    x, v, F, gradient = map(jnp.asarray, (x, v, F, gradient))
    start = mpm.Particles(x, v, X.mass, X.volume, F=F, C=gradient, X=X.x if total else None)
    scene = mpm.Scene(grid, LAW, boundary=boundary, description=description)
    run = mpm.simulate(scene, start, t1=steps * dt, dt=dt, save_every=cells // 4)
    exact = np.array(X.x)
    error = []
    for t, frame in zip(np.asarray(run.times), np.asarray(run.frames.x), strict=True):
        exact[:, 0] = np.asarray(X.x[:, 0]) + amplitude * np.sin(phase) * np.cos(k * C * t)
        error.append(np.sqrt((np.sum((frame - exact) ** 2, axis=1)).mean()))
    return max(error) / amplitude


@pytest.mark.parametrize(
    ("d", "ends", "amplitude", "description"),
    [
        (1, "periodic", 1e-3, mpm.UpdatedLagrangian()),
        (1, "mirrored", 0.03, mpm.UpdatedLagrangian()),
        (1, "mirrored", 0.03, mpm.TotalLagrangian()),
        (2, "mirrored", 0.03, mpm.UpdatedLagrangian()),
    ],
)
def test_standing_wave_is_second_order(d, ends, amplitude, description):
    """At a fixed Courant number, over two refinements: order at least 1.8."""
    errors = np.array([wave_error(n, d, ends, amplitude, description) for n in (16, 32, 64)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert (orders > 1.8).all(), (errors, orders)
    assert errors[-1] < 0.02


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
