"""Problems with an exact answer: a wave of any amplitude."""

import jax.numpy as jnp
import numpy as np
import pytest

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
