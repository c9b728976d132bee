"""A law of one's own: its energy alone, in every method and derivative, and in files."""

import json
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import DIMS, ELASTIC, FLUIDS, PLASTIC, RUBBER, VISCOUS, assert_close, cloud, ids, thorough
from shell import refused, shell
from test_cli import SCENE

import mpmjax as mpm
from mpmjax import linalg as la
from mpmjax.io._schema import decode, encode
from mpmjax.verification import check_law

ROOT = Path(__file__).parents[1]


@mpm.register
class Gel(mpm.AbstractMaterial):
    """Neo-Hookean's energy and nothing else."""

    mu: float | jax.Array
    lam: float | jax.Array

    def energy(self, F):
        log_J = jnp.log(la.determinant(F))
        return self.mu / 2 * (la.double_dot(F, F) - len(F)) - self.mu * log_J + self.lam / 2 * log_J**2


class Fibres(Gel):
    """A gel with fibres along the first axis: not isotropic."""

    def energy(self, F):
        return super().energy(F) + self.mu * (la.double_dot(F[:, :1], F[:, :1]) - 1) ** 2


CLOSED = mpm.NeoHookean(1e4, 0.3)
OWN = Gel(CLOSED.shear_modulus, CLOSED.lame_lambda)
TIGHT = mpm.implicit.ConjugateResidual(rtol=1e-13)
NEWTON = mpm.implicit.Newton(TIGHT, 1e-12)
RUNS = {
    "explicit": (1, mpm.UpdatedLagrangian(), mpm.Explicit()),
    "trbdf2": (1, mpm.TotalLagrangian(), mpm.TRBDF2(solution=NEWTON)),
    "midpoint": (2, mpm.UpdatedLagrangian(), mpm.ImplicitMidpoint(NEWTON)),
    "backward_euler": (2, mpm.TotalLagrangian(), mpm.BackwardEuler(NEWTON)),
    "projected": (
        2,
        mpm.UpdatedLagrangian(),
        mpm.SemiImplicit(1.0, TIGHT, hessian=mpm.implicit.AnalyticHessian(projected=True)),
    ),
    "jvp": (3, mpm.TotalLagrangian(), mpm.SemiImplicit(0.5, TIGHT, hessian=mpm.implicit.JvpHessian())),
    "analytic": (3, mpm.UpdatedLagrangian(), mpm.SemiImplicit(1.0, TIGHT, hessian=mpm.implicit.AnalyticHessian())),
}


def strained(d, law, description, family="random"):
    """A scene and particles whose F are of a family, or I."""
    grid, particles = cloud(d, p=20, cells=3)
    F = np.eye(d)[..., None] * np.ones(20) if family == "rest" else deformations(family, d)[0]
    particles = eqx.tree_at(lambda q: q.F, particles, jnp.asarray(np.moveaxis(F, -1, 0)))
    scene = mpm.Scene(grid, law, description=description)
    return scene, mpm.prepare(scene, particles)


@pytest.mark.parametrize("run", **ids(RUNS, "explicit"))
def test_an_energy_alone_moves_as_the_closed_form_does(run):
    """Three steps, to rounding: every method, both Hessians, both descriptions, all dimensions; and the budget."""
    d, description, method = run
    ends = []
    for law in (OWN, CLOSED):
        scene, particles = strained(d, law, description)
        ends.append(mpm.budget(scene, particles, steps=3, dt=2e-4, method=method))
    (own, own_budget), (closed, budget) = ends
    for a, b in zip(jax.tree.leaves(own), jax.tree.leaves(closed), strict=True):
        assert_close(a, b, 1e-10)
    size = max(float(jnp.abs(term).max()) for term in jax.tree.leaves(budget))
    for a, b in zip(jax.tree.leaves(own_budget), jax.tree.leaves(budget), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-10 * size)


@eqx.filter_jit
def moment_gradient(law, scene, particles, method):
    """The derivative of a moment of the positions by F and Lamé's first constant."""

    def moment(F, mu):
        if isinstance(law, Gel):
            own = Gel(mu, law.lam)
        else:
            lam = law.lame_lambda
            ratio = lam / (2 * (lam + mu))
            own = mpm.NeoHookean(2 * mu * (1 + ratio), ratio)
        moved = eqx.tree_at(lambda s: s.material, scene, own)
        final = mpm.rollout(moved, eqx.tree_at(lambda q: q.F, particles, F), steps=2, dt=2e-4, method=method)
        return (final.x**2).sum()

    return jax.grad(moment, argnums=(0, 1))(particles.F, jnp.asarray(CLOSED.shear_modulus))


@pytest.mark.parametrize(
    "hessian", [mpm.implicit.AnalyticHessian(), *thorough(mpm.implicit.AnalyticHessian(projected=True))]
)
def test_gradients_are_those_of_the_closed_form(hessian):
    """Through implicit steps from rest, where all stretches coincide: third derivatives of the energy."""
    method = mpm.SemiImplicit(1.0, TIGHT, hessian=hessian, adjoint_solver=TIGHT)
    found = []
    for law in (OWN, CLOSED):
        scene, particles = strained(2, law, mpm.UpdatedLagrangian(), "rest")
        found.append(moment_gradient(law, scene, particles, method))
    for a, b in zip(*found, strict=True):
        assert np.isfinite(a).all()
        assert_close(a, b, 1e-9)


@pytest.mark.parametrize("d", [1, 2, *thorough(3)])
def test_the_stable_step_and_the_projection_are_those_of_the_closed_form(d):
    """Where stretches coincide, nearly coincide and do not; of a sheared F too."""
    projected = eqx.filter_jit(lambda law, F: law.projected_differential(F).matrix)
    for family in ("rest", *STRETCHES):
        if family == "inverted":
            continue
        own, closed = (strained(d, law, mpm.UpdatedLagrangian(), family) for law in (OWN, CLOSED))
        np.testing.assert_allclose(mpm.stable_dt(*own), mpm.stable_dt(*closed), rtol=1e-12)
        F = jnp.moveaxis(own[1].F, 0, -1)
        A, B = (projected(jax.tree.map(jnp.asarray, law), F) for law in (OWN, CLOSED))
        for p in range(20):
            assert_close(A[..., p], B[..., p], 1e-11)


LAWS = [(law, d) for law in (*ELASTIC.values(), *RUBBER.values()) for d in DIMS]
LAWS += [(law, 2) for law in (*PLASTIC.values(), *VISCOUS.values(), *FLUIDS.values())]
DEAR = (mpm.Yeoh, mpm.Gent, mpm.Ogden)
BY_DEFAULT = [(law, d) for law, d in LAWS if d == 2 and not isinstance(law, DEAR)]
BY_DEFAULT += [(law, d) for law, d in LAWS if d == 3 and type(law) is mpm.FixedCorotated]
CASES = [
    pytest.param(law, d, id=f"{type(law).__name__}-{d}", marks=() if (law, d) in BY_DEFAULT else pytest.mark.thorough)
    for law, d in LAWS
]


@pytest.mark.parametrize(("law", "d"), CASES)
def test_closed_forms_of_the_packages_laws_are_derivatives_of_their_energy(law, d):
    check_law(law, dim=d)


class WrongStress(Gel):
    def stress(self, F):
        return self.mu * F


class WrongNumbers(Gel):
    def kirchhoff_numbers(self, F):
        return self.mu, self.mu


class WrongDifferential(Gel):
    def stress_differential(self, F):
        return Gel(1.1 * self.mu, self.lam).stress_differential(F)


class WrongFrame(Gel):
    def principal_differential(self, s):
        return Gel(1.1 * self.mu, self.lam).principal_differential(s)


class Kinked(Gel):
    """The size of F − R, a root that has no derivative at rest."""

    def energy(self, F):
        strain = F - la.rotation(F)
        return self.mu * jnp.sqrt(la.double_dot(strain, strain))


class Turning(Gel):
    """Knows which way is up."""

    def energy(self, F):
        return super().energy(F) + self.mu * F[0, 1] ** 2


FAULTS = {
    WrongStress: r"^WrongStress: stress is off by .* of its size at F = \[\[",
    WrongNumbers: r"^WrongNumbers: kirchhoff_numbers is off by .* of its size at F = \[\[",
    WrongDifferential: r"^WrongDifferential: stress_differential is off by 0.0",
    WrongFrame: r"^WrongFrame: principal_differential is off by 0.0",
    Kinked: r"^Kinked: the energy's gradient is not finite at F = \[\[1., 0.\], \[0., 1.\]\]",
    Turning: r"^Turning: the energy after a rotation of space is off by",
}


@pytest.mark.parametrize(("kind", "message"), FAULTS.items(), ids=[c.__name__ for c in FAULTS])
def test_check_law_names_what_is_wrong_and_where(kind, message):
    with pytest.raises(ValueError, match=message):
        check_law(kind(1.0, 2.0), dim=2)


def test_check_law_takes_deformations_of_ones_own():
    """Of which at least one must be admitted."""
    check_law(OWN, dim=1, F=[[[1.3]]])
    with pytest.raises(ValueError, match=r"^Gel admits none of check_law's 1 deformations"):
        check_law(OWN, dim=1, F=[[[-1.0]]])
    with pytest.raises(ValueError, match=r"F must have shape \(p, 1, 1\), got \(1, 1\)"):
        check_law(OWN, dim=1, F=[[1.0]])


def test_an_energy_of_a_wrong_shape_is_refused():
    """Such as that of `jnp.linalg.det`, by luck of the number of particles, or of a sum."""

    class Summed(Gel):
        def energy(self, F):
            return super().energy(F).sum()

    with pytest.raises(
        ValueError, match=r"Summed's energy must be one number a particle, shape \(20,\) for F of shape"
    ):
        mpm.step(*strained(1, Summed(1.0, 1.0), mpm.UpdatedLagrangian()), 0.0, 1e-4)


@pytest.mark.thorough
def test_an_anisotropic_law_moves_and_is_refused_where_its_frame_is_needed():
    """Fibres move implicitly as any law does; the stable step and the projected Hessian say what they lack."""
    law = Fibres(1e4, 1e4)
    check_law(law, dim=2)
    scene, particles = strained(2, law, mpm.UpdatedLagrangian(), "near_identity")
    after, info = mpm.step(scene, particles, 0.0, 1e-4, method=mpm.SemiImplicit())
    assert bool(info.solve.converged)
    assert np.isfinite(after.x).all()
    with pytest.raises(ValueError, match=r"stable_dt needs .* isotropic"):
        mpm.stable_dt(scene, particles)
    with pytest.raises(RuntimeError, match="Fibres is not isotropic, and the projected Hessian needs a law that is"):
        jax.block_until_ready(
            mpm.step(
                scene,
                particles,
                0.0,
                1e-4,
                method=mpm.SemiImplicit(hessian=mpm.implicit.AnalyticHessian(projected=True)),
            )
        )


def test_a_registered_law_is_saved_and_loaded(tmp_path):
    """The run comes back and goes on with it, to the same numbers."""
    scene, particles = strained(1, OWN, mpm.UpdatedLagrangian())
    run = mpm.simulate(scene, particles, t1=2e-4, dt=1e-4, save_every=1)
    mpm.save(tmp_path / "run.h5", run)
    again = mpm.load(tmp_path / "run.h5")
    assert type(again.scene.material) is Gel
    assert float(again.scene.material.mu) == float(OWN.mu)
    np.testing.assert_array_equal(again.final.F, run.final.F)
    per_particle = Gel(np.linspace(1, 2, 70), 1.0)
    arrays: dict = {}
    data = json.loads(json.dumps(encode(per_particle, arrays)))
    np.testing.assert_array_equal(decode(data, mpm.AbstractMaterial, "", arrays).mu, per_particle.mu)


OWN_MODULE = """
import jax
import mpmjax as mpm

@mpm.register
class Jelly(mpm.AbstractMaterial):
    stiffness: float

    def energy(self, F):
        C = mpm.linalg.matmul(mpm.linalg.transpose(F), F)
        E = (C - mpm.linalg.identity_like(F)) / 2
        return self.stiffness * mpm.linalg.double_dot(E, E)
"""


@pytest.mark.thorough
def test_the_shell_imports_what_a_scene_file_names(tmp_path, monkeypatch):
    """By a file's path or a module's name; without it, the error says what to do. Loading a run imports nothing."""
    head, law = SCENE.split("[material]")[0], 'kind = "Jelly"\nstiffness = 1e5\n[[boundary]]'
    scene, module, out = tmp_path / "scene.toml", tmp_path / "own_jelly.py", tmp_path / "run.h5"
    scene.write_text(f"{head}[material]\n{law}{SCENE.split('[[boundary]]')[1]}")
    module.write_text(OWN_MODULE)
    said = refused("run", scene, "-o", out)
    assert "[material]: unknown kind 'Jelly'" in said
    assert "when the module is imported that calls mpm.register" in said
    assert "there is no file" in refused("run", scene, "-o", out, "--import", tmp_path / "gone.py")
    assert "no module 'own_jelly'" in refused("run", scene, "-o", out, "--import", "own_jelly")
    code, _, err = shell("run", scene, "-o", out, "--quiet", "--import", module)
    assert code == 0, err
    assert type(mpm.load(out).scene.material).__name__ == "Jelly"
    monkeypatch.syspath_prepend(tmp_path)
    assert shell("run", scene, "-o", out, "--quiet", "--overwrite", "--import", "own_jelly")[0] == 0
    load = f"import jax, mpmjax; jax.config.update('jax_enable_x64', True); mpmjax.load({str(out)!r})"
    ran = subprocess.run([sys.executable, "-c", load], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "unknown kind 'Jelly'" in ran.stderr


def test_registering_is_refused_where_files_could_not_hold_it():
    """A name that is taken, what is no module, arguments that are no fields or of no kind that files know."""
    with pytest.raises(ValueError, match=r"the name 'Snow' is taken by mpmjax\.material\._granular\.Snow"):
        mpm.register(type("Snow", (Gel,), {}))
    with pytest.raises(ValueError, match=r"takes a class, an equinox\.Module"):
        mpm.register(dict)

    class Listening(Gel):
        callback: object

    with pytest.raises(
        ValueError, match="Listening's argument 'callback' is annotated as <class 'object'>, which files"
    ):
        mpm.register(Listening)

    class Hidden(Gel):
        def __init__(self, stiffness: float):
            self.mu = self.lam = stiffness

    with pytest.raises(ValueError, match="Hidden's argument 'stiffness' is not a field of Hidden"):
        mpm.register(Hidden)


def test_a_class_that_is_defined_anew_takes_the_place_of_the_one_before():
    """As when a notebook's cell is run again."""

    def define():
        class Again(Gel):
            """The same each time."""

        return mpm.register(Again)

    first, second = define(), define()
    assert type(decode({"kind": "Again", "mu": 1, "lam": 2}, mpm.AbstractMaterial)) is second
    with pytest.raises(ValueError, match=r"is a Again, which files cannot hold: .* @mpm\.register"):
        encode(first(1.0, 2.0))


@pytest.mark.thorough
def test_the_example_runs(tmp_path):
    """In a fresh program, in single precision as it stands."""
    script = [sys.executable, str(ROOT / "examples" / "own_law.py")]
    ran = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "tissue.vtkhdf").exists()
