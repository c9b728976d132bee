"""The linearisation error of one linear solve a step is computed, reported, and warned of where it is large."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import LAWS, PLASTIC, block

import mpmjax as mpm

EDGE, STRETCH = 0.01, 1.03


def sheet():
    """A cell of nearly incompressible rubber, pulled in two directions by 3 % in a second."""
    grid = mpm.Grid((4, 4, 4), EDGE, origin=(-1, -1, -1))
    particles = mpm.fill(mpm.Box((0.0,) * 3, (EDGE,) * 3), grid, particles_per_cell=8, density=930.0)
    motion = mpm.Motion((0.0, 1.0), ((0.0,) * 3, (EDGE * (STRETCH - 1),) * 2 + (0.0,)))
    grips = []
    for axis in range(2):
        face = mpm.Box(tuple(EDGE if a == axis else -1.0 for a in range(3)), (1.0,) * 3)
        grips.append(mpm.Grip(face, motion, tuple(a == axis for a in range(3))))
    walls = (mpm.SlipBox((0.0,) * 3, (np.inf,) * 3), *grips)
    options = {"boundary": walls, "kernel": mpm.BSpline(1), "description": mpm.TotalLagrangian()}
    return mpm.Scene(grid, mpm.NeoHookean(1e6, 0.49), **options), particles


def pulled(steps, method):
    """The nominal stress of the sheet at the end [Pa], and the run."""
    scene, particles = sheet()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = mpm.simulate(scene, particles, t1=1.0, dt=1 / steps, method=method)
    return float(scene.material.stress(jnp.moveaxis(run.final.F, 0, -1))[0, 0].mean()), run


@pytest.mark.thorough
def test_it_tells_how_wrong_the_stress_is_and_falls_with_the_square_of_the_step():
    """Of rubber in equibiaxial tension, against Newton's method with the same step."""
    parts = {}
    for steps in (3, 10):
        taken, run = pulled(steps, mpm.SemiImplicit())
        exact, newton = pulled(steps, mpm.BackwardEuler())
        assert float(newton.statistics.force_error) == 0
        parts[steps] = float(run.statistics.linearisation_error)
        assert 0.5 * parts[steps] < 1 - taken / exact < parts[steps]
    assert parts[3] > 0.05
    assert parts[3] / parts[10] == pytest.approx((10 / 3) ** 2, rel=0.1)


def test_a_large_one_is_warned_of_and_a_small_one_is_not():
    scene, particles = sheet()
    with pytest.warns(
        UserWarning, match=r"has a linearisation error of up to 11 % of the elastic force.*1\.5 times or more.*Newton"
    ):
        mpm.simulate(scene, particles, t1=1.0, dt=1 / 3, method=mpm.SemiImplicit())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mpm.simulate(scene, particles, t1=0.3, dt=1 / 10, method=mpm.SemiImplicit())


METHODS = {
    "explicit": (mpm.Explicit(), False),
    "semi-implicit": (mpm.SemiImplicit(), True),
    "midpoint": (mpm.ImplicitMidpoint(), True),
    "midpoint by Newton": (mpm.ImplicitMidpoint(solution=mpm.implicit.Newton()), False),
    "TR-BDF2": (mpm.TRBDF2(), True),
    "backward Euler": (mpm.BackwardEuler(), False),
}


@pytest.mark.parametrize(
    ("name", "dtype"),
    [
        pytest.param(name, dtype, marks=[] if (name, dtype) == ("semi-implicit", "float64") else pytest.mark.thorough)
        for name, dtype in [*((name, "float64") for name in METHODS), ("semi-implicit", "float32")]
    ],
)
def test_only_linearised_steps_have_one(name, dtype):
    """A block that is pulled apart. One that flies and turns slowly has none, and rounding is not taken for one."""
    method, linearised = METHODS[name]
    scene, particles = block(2, side=4, gravity=(0.0, -9.81))
    x = particles.x - particles.x.mean(axis=0)

    def error(v):
        moving = jax.tree.map(lambda a: a.astype(dtype), eqx.tree_at(lambda q: q.v, particles, v))
        moving = mpm.rollout(scene, moving, steps=3, dt=2e-2, method=method)
        return float(mpm.step(scene, moving, 6e-2, 2e-2, method=method)[1].linearisation_error)

    assert (error(x * jnp.asarray([10.0, 0.0])) > 1e-4) is linearised
    assert error(jnp.asarray([3.0, -2.0]) + 0.1 * x[:, ::-1] * jnp.asarray([1.0, -1.0])) < 1e-5


@pytest.mark.thorough
def test_a_fluid_is_measured_as_what_is_elastic():
    """The return map of a fluid takes out expansion, which has no stress: the error of a linear solve's force is
    put beside the momentum too, as for a solid, and Newton's method has none."""
    scene, particles = block(2, side=4, material=mpm.Fluid(1e4))
    spread = eqx.tree_at(lambda q: q.v, particles, (particles.x - particles.x.mean(axis=0)) * jnp.asarray([2.0, -3.0]))

    def error(method):
        return mpm.step(scene, spread, 0.0, 2e-2, method=method)[1]

    momentum = float(jnp.linalg.norm(particles.mass[:, None] * spread.v) / 2e-2)
    assert float(error(mpm.SemiImplicit()).force_scale) > momentum / 2
    assert float(error(mpm.BackwardEuler()).force_error) == 0


@pytest.mark.thorough
def test_what_yields_elsewhere_changes_nothing():
    """A block that is pulled apart has the error that it has alone where sand lies beside it at rest."""
    grid = mpm.Grid((20, 9), 0.1, origin=(-3, -3))
    block = mpm.fill(
        mpm.Box((0.0, 0.0), (0.3, 0.3)), grid, density=1e3, velocity=lambda x: jnp.stack([3 * x[0], -3 * x[1]])
    )
    sand = mpm.fill(mpm.Box((1.0, 0.0), (1.3, 0.2)), grid, density=1e3, velocity=lambda x: 0 * x)
    laws = LAWS["neo_hookean"], PLASTIC["drucker_prager"]

    def error(laws, *sets):
        info = mpm.step(mpm.Scene(grid, laws), mpm.join(*sets), 0.0, 2e-2, method=mpm.SemiImplicit())[1]
        return float(info.linearisation_error)

    assert error(laws, block, sand) == pytest.approx(error(laws[0], block), rel=1e-6)


@pytest.mark.thorough
def test_friction_is_not_taken_for_one():
    """A block that slides on a floor: friction slows nodes after the solve, and is no part of its error."""

    def error(friction):
        floor = (mpm.ContactPlane(1, 0.0, friction=friction),)
        scene, particles = block(2, side=4, gravity=(0.0, -9.81), boundary=floor)
        sliding = eqx.tree_at(lambda q: q.v, particles, particles.v + jnp.asarray([2.0, -0.2]))
        return float(mpm.step(scene, sliding, 0.0, 2e-2, method=mpm.SemiImplicit())[1].force_error)

    assert error(0.8) == pytest.approx(error(0.0), rel=1e-6)
    assert error(0.0) > 0
