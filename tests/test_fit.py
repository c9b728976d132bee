"""The main job: rubber's shear modulus from its measured curve."""

import dataclasses
import re
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from shell import refused, shell

import mpmjax as mpm
from mpmjax.cli._scene_file import fit_job, read_job
from mpmjax.fitting._columns import read_columns
from mpmjax.fitting._fit import fit_curve, gauge

RUBBER = Path(__file__).parents[1] / "examples" / "rubber.toml"


@pytest.fixture(scope="module")
def job():
    """The example's job."""
    return read_job(RUBBER)


@pytest.fixture(scope="module")
def coarse(job):
    """The same strip at twice the spacing, for what does not need the figure itself."""
    grid = mpm.Grid((8, 14), 5e-3, origin=(-3, -3))
    particles = mpm.fill(mpm.Box((0.0, 0.0), (0.01, 0.04)), grid, particles_per_cell=4, density=930.0, dtype="float64")
    scene = mpm.Scene(grid, job.scene.material, boundary=job.scene.boundary, description=mpm.TotalLagrangian())
    return job._replace(scene=scene, particles=particles, run=job.run._replace(dt=5e-3))


@pytest.mark.slow
def test_the_fit_finds_rubbers_modulus(tmp_path):
    """`mpmjax fit` prints a modulus within 3 % of 0.339 MPa, the closed form's least-squares answer, and a plot."""
    code, out, err = shell("fit", RUBBER, "--plot", tmp_path / "fit.png")
    assert code == 0, err
    match = re.search(r"shear_modulus = (\S+) ± (\S+)", out)
    assert match is not None, out
    modulus, error = float(match[1]), float(match[2])
    assert abs(modulus / 0.339e6 - 1) < 0.03
    assert 0 < error < 0.02e6
    assert len(re.findall(r"% fitted", out)) == 3
    assert len(re.findall(r"% predicted", out)) == 6
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_the_step_is_far_beyond_the_explicit_limit(job):
    """More than 100 times dx/c."""
    law = job.scene.material
    speed = np.sqrt((law.lame_lambda + 2 * law.shear_modulus) / 930)
    assert job.run.dt / (job.scene.grid.spacing / speed) > 100


@pytest.mark.slow
def test_doubled_stresses_double_the_modulus(coarse):
    """A quasi-static curve is proportional to the modulus."""
    once = fit_job(coarse)
    twice = fit_job(coarse._replace(fit=coarse.fit._replace(stress=2 * coarse.fit.stress)))
    assert float(twice.value / once.value) == pytest.approx(2, rel=1e-4)
    assert float(twice.standard_error / once.standard_error) == pytest.approx(2, rel=1e-3)


def test_the_fit_is_the_least_squares_answer_of_its_own_curve(coarse):
    """At the fit the residual is orthogonal to the curve, stress being proportional to the modulus."""
    result = fit_job(coarse)
    fit = coarse.fit
    model = np.asarray(result.predicted)[fit.fitted]
    assert abs((model * (model - fit.stress[fit.fitted])).sum()) < 1e-4 * (model**2).sum()


@pytest.mark.thorough
def test_an_unreached_stretch_is_an_error_and_not_a_flat_curve(coarse):
    with pytest.raises(ValueError, match="leaves out measured points"):
        fit_job(coarse._replace(run=coarse.run._replace(t1=0.1)))


@pytest.mark.thorough
def test_an_abscissa_that_turns_back_is_refused(coarse):
    """Interpolation in it would not be defined."""
    grip = next(b for b in coarse.scene.boundary if isinstance(b, mpm.Grip))
    end = coarse.run.t1
    back = mpm.Motion((0.0, end / 3, end / 2, end), ((0.0, 0.0), (0.0, 0.06), (0.0, 0.05), (0.0, 0.2)))
    scene = eqx.tree_at(
        lambda s: s.boundary,
        coarse.scene,
        (*(b for b in coarse.scene.boundary if b is not grip), mpm.Grip(grip.region, back, grip.axes)),
    )
    with pytest.raises(ValueError, match="must grow with every step"):
        fit_job(coarse._replace(scene=scene))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"adjoint_solver": mpm.ConjugateResidual(max_steps=1)}, "tangent solve of a step did not converge"),
        ({"beta": 1.0}, "derivative .* that of the simulated curve is not finite"),
    ],
)
def test_a_fit_without_a_derivative_says_why(options, says):
    """A solve that does not converge, or a curve with a vertical tangent."""
    grid = mpm.Grid((9,), 0.1, origin=(-3,))
    particles = mpm.fill(mpm.Box((0.0,), (0.3,)), grid, particles_per_cell=2, density=1e3, dtype="float64")
    pull = mpm.Grip(mpm.Box((0.25,), (1.0,)), mpm.Motion((0.0, 1.0), ((0.0,), (0.1,))))
    walls = mpm.SymmetryPlane(0, 0.0), pull
    scene = mpm.Scene(grid, mpm.NeoHookean(1e4, 0.3), boundary=walls, description=mpm.TotalLagrangian())
    curve = gauge(mpm.Box((0.05,), (0.2,)), particles, 0)

    def steep(scene, particles):
        stretch, stress = curve(scene, particles)
        return stretch, jnp.sqrt(0 * stress)

    with pytest.raises(RuntimeError, match=says):
        fit_curve(
            scene,
            particles,
            t1=0.5,
            dt=0.1,
            method=mpm.SemiImplicit(**options),
            curve=curve if "beta" not in options else steep,
            measured_x=np.array([1.01, 1.02, 1.03]),
            measured_y=np.array([100.0, 200.0, 300.0]),
            fitted=np.ones(3, bool),
            parameter=lambda s: s.material.youngs_modulus,
        )


def test_a_gauge_without_particles_is_refused(job):
    with pytest.raises(ValueError, match="holds no particle"):
        gauge(mpm.Box((1.0, 1.0), (2.0, 2.0)), job.particles, 1)


def test_the_gauge_weighs_by_volume(job):
    curve = gauge(mpm.Box((0.0, 0.0), (0.01, 0.01)), job.particles, 1)
    stretched = dataclasses.replace(job.particles, deformations=(2 * job.particles.F,))
    assert float(curve.weight.sum()) == pytest.approx(1)
    stretch, stress = curve(job.scene, stretched)
    assert float(stretch) == pytest.approx(2)
    assert float(stress) == pytest.approx(float(job.scene.material.stress(2 * jnp.eye(2)[..., None])[1, 1, 0]))


FIT_FAULTS = {
    "no file": ('data = "data/treloar_1944_pure_shear.csv"', 'data = "none.csv"', r"none\.csv"),
    "no column": ('stretch = "stretch"', 'stretch = "lambda"', r"no column 'lambda'"),
    "no parameter": ('"material.youngs_modulus"', '"material.stiffness"', r"no 'stiffness'"),
    "no number": ('"material.youngs_modulus"', '"material"', r"must be one positive number"),
    "derived": ('"material.youngs_modulus"', '"material.lame_lambda"', r"follows from others"),
    "no report": ('"material.shear_modulus"', '"material.bulk"', r"no 'bulk'"),
    "empty range": ("range = [1.1, 2.4]", "range = [1.1, 1.2]", r"holds 0 of"),
    "kind": ('kind = "curve"', 'kind = "surface"', r"must be \"curve\""),
}


@pytest.mark.parametrize(("old", "new", "says"), FIT_FAULTS.values(), ids=FIT_FAULTS)
def test_a_bad_fit_table_gets_one_line(tmp_path, old, new, says):
    text = RUBBER.read_text()
    assert old in text
    data = RUBBER.parent / "data" / "treloar_1944_pure_shear.csv"
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / data.name).write_bytes(data.read_bytes())
    (tmp_path / "bad.toml").write_text(text.replace(old, new, 1))
    line = refused("fit", tmp_path / "bad.toml")
    assert re.search(says, line), line


def test_columns_name_the_row_that_is_no_number(tmp_path):
    (tmp_path / "a.csv").write_text("# comment\nx,y\n1,2\n3,four\n")
    with pytest.raises(ValueError, match="data row 2: y must be a finite number, got 'four'"):
        read_columns(tmp_path / "a.csv", "x", "y")
