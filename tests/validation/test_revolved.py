"""Bodies of revolution against exact solutions, three dimensions and experiments: a tube under pressure, a cylinder
that spins, one that is pressed, a bar that hits a wall, a column of sand."""

from itertools import pairwise

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import DESCRIPTIONS

import mpmjax as mpm
from mpmjax.geometry import Cylinder
from mpmjax.state import AbstractBodyForce

E, NU = 1e6, 0.3
LAW = mpm.NeoHookean(E, NU)


def between_planes(radii, height, cells, force=None, loads=(), description="total", kernel=2):
    """A long cylinder or tube between two planes of symmetry, at rest under its load: scene, particles, r and u."""
    inner, outer = radii
    dx = (outer - inner) / cells
    first = max(-3, round(inner / dx) - 3)
    grid = mpm.Grid((cells + 6, round(height / dx) + 6), dx, origin=(first, -3), axisymmetric=True)
    planes = mpm.SymmetryPlane(1, 0.0), mpm.SymmetryPlane(1, height, keep="below")
    scene = mpm.Scene(
        grid,
        LAW,
        boundary=planes,
        body_force=force,
        loads=loads,
        description=DESCRIPTIONS[description],
        kernel=mpm.BSpline(kernel),
    )
    start = mpm.fill(mpm.Box((inner, 0.0), (outer, height)), grid, particles_per_cell=4, density=1e3)
    scene = mpm.attach(scene, start)
    end = mpm.simulate(scene, start, dt=100.0, t1=300.0, method=mpm.BackwardEuler()).final
    return scene, end, start.x[:, 0], end.x[:, 0] - start.x[:, 0]


def error(particles, a, b):
    """‖a − b‖/‖b‖ over the body."""
    return float(jnp.sqrt((particles.volume * (a - b) ** 2).sum() / (particles.volume * b**2).sum()))


class Spin(AbstractBodyForce):
    rate: float

    def acceleration(self, x, t):
        return self.rate**2 * x * jnp.array([1.0, 0.0])


@pytest.mark.thorough
@pytest.mark.parametrize(("description", "first"), [("total", 4.1e-3), ("updated", 4.3e-3)])
def test_a_spinning_cylinder_is_of_second_order(description, first):
    """u = (1 + ν)(1 − 2ν) ρω²/(8E(1 − ν)) r ((3 − 2ν) b² − r²) (S. P. Timoshenko, J. N. Goodier, Theory of Elasticity,
    3rd ed., section 32, in plane strain), up to the axis."""
    errors, w = [], 0.1
    for cells in (6, 12):
        _, end, r, u = between_planes((0.0, 1.0), 4 / cells, cells, Spin(w), description=description)
        exact = (1 + NU) * (1 - 2 * NU) * 1e3 * w**2 / (8 * E * (1 - NU)) * r * ((3 - 2 * NU) - r**2)
        errors.append(error(end, u, exact))
    assert errors[0] < first
    assert all(np.log2(coarse / fine) > 1.85 for coarse, fine in pairwise(errors)), errors


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("description", "kernel", "most"), [("total", 2, (6e-4, 0.03, 0.005)), ("updated", 2, (6e-4, 0.05, 0.008))]
)
def test_a_tube_under_pressure(description, kernel, most):
    """Lamé's u = p a²/(b² − a²) (1 + ν)/E ((1 − 2ν) r + b²/r), his radial and hoop stress, with eight cells across the
    wall. At twice as many (not run here) displacements are 2.7 to 3.4 times as good, stresses, wrong at the surface,
    1.3 to 1.4 times."""
    a, b, height, p = 0.5, 1.0, 0.25, 10.0
    inside = mpm.Patch(mpm.Box((a, 0.0), (b, height)), within=mpm.Box((a - 0.1, 0.0), (a + 0.02, height)))
    scene, end, r, u = between_planes((a, b), height, 8, None, mpm.Pressure(inside, p), description, kernel)
    scale = p * a**2 / (b**2 - a**2)
    sigma = mpm.stress(scene, end)
    errors = (
        error(end, u, scale * (1 + NU) / E * ((1 - 2 * NU) * r + b**2 / r)),
        error(end, sigma[:, 0, 0], scale * (1 - b**2 / r**2)),
        error(end, sigma[:, 2, 2], scale * (1 + b**2 / r**2)),
    )
    assert all(np.array(errors) < np.array(most)), errors


@pytest.mark.slow
def test_a_pressed_cylinder_is_that_of_three_dimensions():
    """Between plates that hold it, by an eighth, four cells a radius: force and energy to 0.5 %, growth to 2 %."""
    radius = height = 0.4
    seen = []
    for d in (2, 3):
        still, moved = (0.0,) * d, (0.0,) * (d - 1) + (-0.05,)
        slab = lambda lower, upper: mpm.Box((-9.0,) * (d - 1) + (lower,), (9.0,) * (d - 1) + (upper,))  # noqa: B023, E731
        plates = (
            mpm.Grip(slab(-9.0, 0.0), mpm.Motion((0.0, 1.0), (still, still))),
            mpm.Grip(slab(height, 9.0), mpm.Motion((0.0, 1.0), (still, moved))),
        )
        across, body = ((10,), mpm.Box((0.0, 0.0), (radius, height)))
        if d == 3:
            across, body = (14, 14), Cylinder((0.0, 0.0, 0.0), (0.0, 0.0, height), radius)
        first = (-3,) if d == 2 else (-7, -7)
        grid = mpm.Grid((*across, 10), 0.1, origin=(*first, -3), axisymmetric=d == 2)
        start = mpm.fill(body, grid, density=1e3)
        law = mpm.NeoHookean(1e5, 0.3)
        scene = mpm.Scene(grid, law, boundary=plates, description=mpm.TotalLagrangian(), boundary_forces=True)
        run = mpm.simulate(scene, start, dt=0.25, t1=1.0, save_every=1, method=mpm.BackwardEuler())
        far = [jnp.sqrt((x[:, : d - 1] ** 2).sum(axis=1)) for x in (start.x, run.final.x)]
        grown = (start.volume * (far[1] - far[0])).sum() / start.volume.sum()
        force = run.boundary_forces().force[-1, 1, -1]
        seen.append(np.array([force, mpm.energy(scene, run.final).elastic, grown]))
    assert (np.abs(seen[0] / seen[1] - 1) < (5e-3, 5e-3, 0.02)).all(), seen


@pytest.mark.slow
def test_the_taylor_bar():
    """Copper at 227 m/s, eight cells a radius: as long and as wide as published (see `test_metal.py`)."""
    length, radius, cells, t1 = 32.4e-3, 3.2e-3, 8, 80e-6
    dx = radius / cells
    grid = mpm.Grid((26, 88), dx, origin=(-3, -3), axisymmetric=True)
    copper = mpm.VonMises(117e9, 0.35, yield_stress=400e6, hardening_modulus=100e6)
    scene = mpm.Scene(grid, copper, boundary=mpm.ContactPlane(1, 0.0))
    body = mpm.Box((0.0, 0.0), (radius, length))
    start = mpm.fill(body, grid, particles_per_cell=4, density=8930.0, velocity=(0.0, -227.0))
    end = mpm.simulate(scene, start, dt="stable", t1=t1).final
    assert float((end.volume * (jnp.linalg.det(end.F) - 1)).sum() / end.volume.sum()) == pytest.approx(0, abs=1e-3)
    columns, rows = (np.unique(np.asarray(start.x[:, a]).round(9)) for a in (0, 1))
    where = [np.asarray(start.x[:, a]).round(9) for a in (0, 1)]
    x = np.asarray(end.x)
    outer, inner = (x[where[0] == columns[k], 0] for k in (-1, -2))
    ends = [x[where[1] == rows[k], 1].mean() for k in (0, 1, -2, -1)]
    assert 6.97e-3 < (outer + (outer - inner) / 2).max() < 7.24e-3
    foot, top = ends[0] - (ends[1] - ends[0]) / 2, ends[3] + (ends[3] - ends[2]) / 2
    assert 21.42e-3 < top - foot < 21.55e-3


@pytest.mark.slow
def test_a_column_of_sand_collapses():
    """Three times as high as its radius: the front at 0.85 of 1.6 √a radii beyond it (G. Lube, H. E. Huppert,
    R. S. J. Sparks, M. A. Hallworth, J. Fluid Mech. 508 (2004) 175, doi 10.1017/S0022112004009036), at rest, with a
    cone of 22 degrees. The thin front is less than a cell high with eight cells a radius; as high as its radius the
    column stops at 0.6 of what is measured."""
    radius, a, cells = 0.1, 3.0, 8
    grid = mpm.Grid((5 * cells + 8, 3 * cells + 9), radius / cells, origin=(-3, -4), axisymmetric=True)
    start = mpm.fill(mpm.Box((0.0, 0.0), (radius, a * radius)), grid, particles_per_cell=4, density=1600.0)
    law = mpm.DruckerPrager(4.7e5, 0.3, friction_angle=np.radians(22.2))
    floor = mpm.ContactPlane(1, 0.0, friction=0.6)
    scene = mpm.Scene(grid, law, boundary=floor, gravity=(0.0, -9.81))
    end = mpm.simulate(scene, start, dt="stable", t1=1.2).final
    beyond = float(end.x[:, 0].max()) / radius - 1
    assert 0.8 * 1.6 * np.sqrt(a) < beyond < 1.2 * 1.6 * np.sqrt(a), beyond
    assert float((end.v**2).sum(axis=1).max()) < (5e-3) ** 2
