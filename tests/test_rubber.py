"""Laws of rubber: closed forms by NumPy, tension tests, Gent's limit, and simulated tension."""

import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import deformations
from helpers import RUBBER, assert_close, rotation_matrix, thorough
from scipy.optimize import brentq, least_squares

import mpmjax as mpm
from mpmjax.cli._fit_file import read_fit
from mpmjax.fitting._problem import FitProblem
from mpmjax.fitting._search import search
from mpmjax.verification import tension

EACH_LAW = pytest.mark.parametrize("name", RUBBER)
MOSTLY_ONE = pytest.mark.parametrize(
    "name", ["mooney_rivlin", *thorough(*(name for name in RUBBER if name != "mooney_rivlin"))]
)
"""Each law, by default the first."""


def energy_of_stretches(law, s):
    """Ψ of the three principal stretches, shape (3, p), as the publications have it."""
    J = s.prod(axis=0)
    first, second = (s**2).sum(axis=0) * J ** (-2 / 3), (1 / s**2).sum(axis=0) * J ** (2 / 3)
    volumetric = law.bulk_modulus / 4 * (J**2 - 1 - 2 * np.log(J))
    match law:
        case mpm.MooneyRivlin():
            return law.c1 * (first - 3) + law.c2 * (second - 3) + volumetric
        case mpm.Yeoh():
            return law.c1 * (first - 3) + law.c2 * (first - 3) ** 2 + law.c3 * (first - 3) ** 3 + volumetric
        case mpm.Gent():
            return -law.shear_modulus * law.limit / 2 * np.log(1 - (first - 3) / law.limit) + volumetric
        case mpm.Ogden():
            terms = zip(law.moduli, law.exponents, strict=True)
            return sum(m / a * (((s * J ** (-1 / 3)) ** a).sum(axis=0) - 3) for m, a in terms) + volumetric


@eqx.filter_jit
def response(law, F):
    """Energy and stress."""
    return law.energy(F), law.stress(F)


@pytest.mark.parametrize(
    ("name", "d"),
    [
        *((name, 3) for name in RUBBER),
        ("ogden", 2),
        *thorough(*((name, d) for name in RUBBER for d in (1, 2) if (name, d) != ("ogden", 2))),
    ],
)
def test_energy_and_stress_are_those_of_the_principal_stretches(name, d):
    """Ψ by NumPy's singular values, in fewer than three dimensions with stretches of one beside them; P in their frame
    by central differences of that."""
    law = RUBBER[name]
    F, _ = deformations("random", d)
    U, s, Vt = np.linalg.svd(np.moveaxis(F, -1, 0))
    s = np.concatenate([s, np.ones((len(s), 3 - d))], axis=1).T
    energy, stress = response(jax.tree.map(jnp.asarray, law), jnp.asarray(F))
    assert_close(energy, energy_of_stretches(law, s), 1e-12)
    h = 1e-5
    slopes = np.stack(
        [
            (energy_of_stretches(law, s + h * e[:, None]) - energy_of_stretches(law, s - h * e[:, None])) / (2 * h)
            for e in np.eye(3)[:d]
        ]
    )
    P = np.einsum("pik,kp,pkj->ijp", U, slopes, Vt)
    assert_close(stress, P, 1e-8)


@MOSTLY_ONE
@pytest.mark.parametrize("d", [*thorough(1), 2, *thorough(3)])
def test_rest_is_stress_free_and_small_strains_are_hookes(name, d):
    """Ψ(R) = 0 and P(R) = 0; at F = I, δP = 2μ ε + (K − 2/3 μ) tr(ε) I, and turning costs nothing."""
    law, rng = RUBBER[name], np.random.default_rng(0)
    R = jnp.asarray(np.stack([rotation_matrix(d, rng) for _ in range(5)], axis=-1))
    size = law.bulk_modulus
    for value in response(jax.tree.map(jnp.asarray, law), R):
        np.testing.assert_allclose(value / size, 0, atol=1e-15)
    dF = rng.normal(size=(d, d, 5))
    identity = np.broadcast_to(np.eye(d)[..., None], dF.shape)
    strain = (dF + dF.swapaxes(0, 1)) / 2
    lame = law.bulk_modulus - 2 / 3 * law.shear_modulus
    expected = 2 * law.shear_modulus * strain + lame * np.einsum("iip->p", strain) * identity
    found = jax.jit(lambda F, dF: jax.jvp(law.stress, (F,), (dF,))[1])(jnp.asarray(identity), jnp.asarray(dF))
    assert_close(found, expected, 1e-13)


def nominal(law, x, kind):
    """Nominal stress at constant volume, as textbooks have it: of W(I1, I2) by the two slopes of W, of Ogden's by
    powers."""
    if isinstance(law, mpm.Ogden):
        other = {"uniaxial": -0.5, "pure shear": -1, "equibiaxial": -2}[kind]
        terms = zip(law.moduli, law.exponents, strict=True)
        return sum(m * (x ** (a - 1) - x ** (other * a - 1)) for m, a in terms)
    first = {"uniaxial": x**2 + 2 / x, "pure shear": x**2 + 1 + x**-2, "equibiaxial": 2 * x**2 + x**-4}[kind] - 3
    match law:
        case mpm.MooneyRivlin():
            w1, w2 = law.c1, law.c2
        case mpm.Yeoh():
            w1, w2 = law.c1 + 2 * law.c2 * first + 3 * law.c3 * first**2, 0
        case mpm.Gent():
            w1, w2 = law.shear_modulus / 2 * law.limit / (law.limit - first), 0
    return {
        "uniaxial": 2 * (x - x**-2) * (w1 + w2 / x),
        "pure shear": 2 * (x - x**-3) * (w1 + w2),
        "equibiaxial": 2 * (x - x**-5) * (w1 + w2 * x**2),
    }[kind]


@EACH_LAW
@pytest.mark.parametrize("kind", ["uniaxial", "pure shear", "equibiaxial"])
def test_tension_at_constant_volume_is_the_textbooks(name, kind):
    """Whatever the bulk modulus; in pure shear in plane strain too."""
    law, x = RUBBER[name], np.array([0.7, 1.0, 1.1, 1.7, 2.4])
    found = tension(law, jnp.asarray(x), kind)
    np.testing.assert_allclose(found, nominal(law, x, kind), rtol=1e-12, atol=1e-11 * law.bulk_modulus)
    if kind == "pure shear":
        P = law.stress(jnp.asarray(np.stack([x, 0 * x, 0 * x, 1 / x]).reshape(2, 2, -1)))
        np.testing.assert_allclose(P[0, 0] - P[1, 1] / x**2, found, rtol=1e-12, atol=1e-11 * law.bulk_modulus)


def test_tension_asks_for_a_test_that_there_is():
    """And for stretches that are positive."""
    with pytest.raises(ValueError, match="kind must be one of uniaxial, pure shear, equibiaxial, got 'biaxial'"):
        tension(RUBBER["gent"], jnp.ones(1), "biaxial")
    with pytest.raises(ValueError, match="A stretch must be greater than zero"):
        tension(RUBBER["gent"], -jnp.ones(1), "uniaxial")


@pytest.mark.parametrize("name", ["mooney_rivlin", *thorough("yeoh", "gent")])
def test_parameters_are_numbers_or_one_per_particle(name):
    """Particles with parameters of their own have each their own law's energy and stress. Ogden's terms are shared."""
    law, rng = RUBBER[name], np.random.default_rng(1)
    F = jnp.asarray(deformations("random", 2)[0])
    p = F.shape[-1]
    leaves, tree = jax.tree.flatten(law)
    factors = rng.uniform(0.9, 1.1, (len(leaves), p))
    varied = jax.tree.unflatten(tree, [leaf * by for leaf, by in zip(leaves, factors, strict=True)])
    energy, stress = response(jax.tree.map(jnp.asarray, varied), F)
    for q in (0, p - 1):
        own = jax.tree.unflatten(tree, [jnp.asarray(leaf * by[q]) for leaf, by in zip(leaves, factors, strict=True)])
        own_energy, own_stress = response(own, F)
        assert_close(energy[q], own_energy[q], 1e-13)
        assert_close(stress[..., q], own_stress[..., q], 1e-13)


def test_laws_say_what_they_admit():
    """det F > 0; Gent's stretch below its limit too, and not a number is neither."""
    F = np.repeat(np.eye(2)[..., None], 5, axis=-1)
    F[0, 0] = [1.0, 0.0, -1.0, np.nan, 4.0]
    F[1, 1, 4] = 0.25
    for name, law in RUBBER.items():
        expected = [True, False, False, False, name != "gent"]  # its I1 − 3 = 14 is beyond the limit 10
        np.testing.assert_array_equal(law.is_admissible(jnp.asarray(F)), expected)
    assert np.isfinite(RUBBER["gent"].energy(jnp.asarray(F[..., :1]))).all()


def test_ogdens_terms_have_the_shear_moduli_that_they_are_given():
    """2 c_k/α_k is μ_k. Where an exponent goes to zero, and μ_k is without bound, a term is c (ln λ̄)²."""
    law = mpm.Ogden((6e5, 1e3, -1e4), (1.3, 5.0, -2.0), 2e9)
    again = law.with_shear_moduli(tuple(m * a / 2 for m, a in zip(law.moduli, law.exponents, strict=True)))
    np.testing.assert_allclose(again.moduli, law.moduli, rtol=1e-14)
    assert (again.exponents, again.bulk_modulus) == (law.exponents, law.bulk_modulus)
    x, flat = jnp.asarray([0.7, 1.2, 4.0]), mpm.Ogden((1.0,), (1e-9,), 1.0).with_shear_moduli((3.0,))
    np.testing.assert_allclose(tension(flat, x, "uniaxial"), 9 * np.log(x) / x, rtol=1e-6)
    pulled = jnp.eye(3)[..., None] * jnp.stack([x, x**-0.5, x**-0.5])[:, None]
    np.testing.assert_allclose(flat.energy(pulled), 3 * 1.5 * np.log(x) ** 2, rtol=1e-8)


class Tension(FitProblem):
    """Treloar's uniaxial and pure shear tests against Ogden's law in closed form, of terms that are each stable, the
    last one with an exponent from −10 to 0. The noise is one number a test [Pa]."""

    tests: tuple

    def __init__(self, shear_moduli, exponents):
        self.experiments, self.names, self.memory = (), ("alpha1", "alpha2", "alpha3", "c"), 2**28
        self.starts = (*map(jnp.asarray, exponents), jnp.asarray(shear_moduli))
        third = mpm.Bounded(lambda e: None, -10, 0)
        self.parameters = tuple(mpm.Positive(lambda e: None) if k != 2 else third for k in range(4))
        self.tests = tuple((kind, *treloar(kind)) for kind in ("uniaxial", "pure shear"))
        self.sigmas = (jnp.asarray(1e5),) * 2

    @property
    def dtype(self):
        return jnp.float64

    def law(self, z):
        *exponents, shear_moduli = self.values(z)
        return mpm.Ogden((1.0, 1.0, -1.0), tuple(exponents), 1e9).with_shear_moduli(tuple(shear_moduli))

    def residuals(self, z, adjoint=None):
        law, each = self.law(z), zip(self.tests, self.sigmas, strict=True)
        return jnp.concatenate([(tension(law, x, kind) - stress) / sigma for (kind, x, stress), sigma in each])

    def jacobian(self, z, mode=None):
        return self.residuals(z), jax.jacfwd(self.residuals)(z)


def treloar(kind):
    """Stretch, without one, and nominal stress [Pa]."""
    name = f"treloar_1944_{kind.replace(' ', '_')}.csv"
    path = Path(__file__).parents[1] / "examples" / "data" / name
    x, stress = np.genfromtxt(path, delimiter=",", comments="#")[2:].T
    return x, 1e6 * stress


def test_six_numbers_of_three_stable_terms_are_those_of_scipys_least_squares():
    """Along a curved valley, to where the third exponent is zero and its modulus μ_3 without bound. Equibiaxial tension
    is then predicted within 24 % (14 % on average) to a stretch of 4."""
    problem = Tension((5.6e5, 5.8e3, 2.5e4), (2.9, 8.7, -3.1))
    end = search(problem, mpm.fitting.LevenbergMarquardt(), jnp.zeros(6))
    assert end.converged
    evaluate = jax.jit(lambda z: problem.jacobian(z))
    expected = least_squares(lambda z: evaluate(z)[0], np.zeros(6), jac=lambda z: evaluate(z)[1], max_nfev=2000)
    assert end.cost == pytest.approx(expected.cost, rel=1e-3)
    x, stress = treloar("equibiaxial")
    error = np.asarray(tension(problem.law(end.z), x, "equibiaxial"))[x < 4.1] / stress[x < 4.1] - 1
    assert 0.23 < np.abs(error).max() < 0.25
    assert np.sqrt((error**2).mean()) < 0.145


BAD = [
    (lambda: mpm.Ogden((1.0,), (2.0,), 1.0).with_shear_moduli((1.0, 2.0)), "one shear modulus for each of its 1 terms"),
    (
        lambda: mpm.MooneyRivlin(1.0, -1.0, 1.0),
        r"MooneyRivlin's c1 and c2 \[Pa\] must have a positive sum, got 1.0 and",
    ),
    (lambda: mpm.MooneyRivlin(np.nan, 1.0, 1.0), r"MooneyRivlin's c1 \[Pa\] must be finite"),
    (lambda: mpm.Yeoh(0.0, 1.0, 1.0, 1.0), r"Yeoh's c1 \[Pa\] must be greater than zero"),
    (lambda: mpm.Gent(1.0, 0.0, 1.0), "Gent's limit must be greater than zero"),
    (lambda: mpm.Gent(1.0, 1.0, -1.0), r"Gent's bulk_modulus \[Pa\] must be greater than zero"),
    (lambda: mpm.Ogden((), (), 1.0), "a modulus and an exponent for each of its terms, got 0 and 0"),
    (lambda: mpm.Ogden((1.0,), (1.0, 2.0), 1.0), "a modulus and an exponent for each of its terms, got 1 and 2"),
    (lambda: mpm.Ogden((1.0,), (0.0,), 1.0), "Ogden's exponents must not be zero"),
    (
        lambda: mpm.Ogden((1.0, -1.0), (1.0, 2.0), 1.0),
        "Ogden's moduli .* their exponents must have a positive sum",
    ),
]


@pytest.mark.parametrize(("make", "message"), BAD)
def test_bad_parameters_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def pulled(law, d, ends, steps):
    """One cell of rubber, an eighth (a quarter in plane strain) of a body, pulled along the second axis between planes
    of symmetry, its sides free: the stretch and nominal stress after each step."""
    dx = 0.01
    grid = mpm.Grid((4,) * d, dx, origin=(-1,) * d)
    particles = mpm.fill(mpm.Box((0.0,) * d, (dx,) * d), grid, particles_per_cell=2**d, density=930.0)
    path = np.zeros((2, d))
    path[1, 1] = (ends - 1) * dx
    axes = tuple(axis == 1 for axis in range(d))
    top = mpm.Grip(mpm.Box((-1.0, dx, -1.0)[:d], (1.0,) * d), mpm.Motion((0.0, float(steps)), path), axes)
    planes = (mpm.SymmetryPlane(axis, 0.0) for axis in range(d))
    scene = mpm.Scene(
        grid, law, boundary=(*planes, top), kernel=mpm.BSpline(1), description=mpm.TotalLagrangian(), gravity=(0.0,) * d
    )
    run = mpm.simulate(
        scene,
        particles,
        t1=float(steps),
        dt=1.0,
        method=mpm.BackwardEuler(),
        observe=mpm.fitting.StressStretch.of(mpm.Box((0.0,) * d, (dx,) * d), particles, axis=1),
    )
    return (np.asarray(a)[1:] for a in run.observed)


def across(law, stretch, d):
    """The nominal stress at a stretch with the sides free, in three dimensions or in plane strain, of the law as it is:
    the lateral stretch by root finding."""

    def stress(lateral):
        return law.stress(jnp.asarray(np.diag([lateral, stretch, lateral][:d]))[..., None])[..., 0]

    ideal = stretch ** (-1 if d == 2 else -0.5)
    lateral = brentq(lambda lateral: float(stress(lateral)[0, 0]), 0.9 * ideal, 1.1 * ideal, xtol=1e-14)
    return float(stress(lateral)[1, 1])


NEARLY = {
    "neo_hookean": mpm.NeoHookean(1.2e6, 0.499),
    "mooney_rivlin": mpm.MooneyRivlin(1.5e5, 5e4, 2e8),
    "yeoh": mpm.Yeoh(1.7e5, -1e3, 30.0, 2e8),
    "gent": mpm.Gent(4e5, 80.0, 2e8),
    "ogden": mpm.Ogden((5e5, 2e3, -1e4), (1.4, 4.8, -2.0), 2e8),
}
"""At a Poisson's ratio of 0.499."""


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.thorough if n == "mooney_rivlin" else pytest.mark.slow) for n in NEARLY],
)
def test_simulated_tension_is_the_closed_form(name, d):
    """A cell that is pulled to three times its length in ten implicit steps: homogeneous, and so exact to the tolerance
    of the solves; and at constant volume but for p/K."""
    law = NEARLY[name]
    stretch, stress = pulled(law, d, 3.0, 10)
    np.testing.assert_allclose(stretch, np.linspace(1.2, 3, 10), rtol=1e-12)
    np.testing.assert_allclose(stress, [across(law, x, d) for x in stretch], rtol=1e-6)
    ideal = tension(law, jnp.asarray(stretch), "uniaxial" if d == 3 else "pure shear")
    np.testing.assert_allclose(stress, ideal, rtol=0.02)


@pytest.mark.thorough
def test_a_step_beyond_gents_limit_is_reported():
    """By its name, with what helps."""
    with pytest.raises(mpm.SimulationError, match=r"Gent does not allow .* beyond its limit.* raise the limit"):
        list(pulled(mpm.Gent(4e5, 3.0, 2e8), 2, 4.0, 4))


@pytest.mark.slow
def test_the_example_runs(tmp_path):
    """Its first part, in a fresh program: the joint fit of the neo-Hookean law."""
    script = [sys.executable, str(Path(__file__).parents[1] / "examples" / "rubber_laws.py"), "--first"]
    ran = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "uniaxial, nominal stress [Pa]" in ran.stdout


@pytest.mark.slow
def test_the_uniaxial_file_finds_what_the_closed_form_finds():
    """At a fixed Poisson's ratio stresses are E times a function of the stretch, so that E is linear least squares."""
    asked = read_fit(Path(__file__).parents[1] / "examples" / "rubber_uniaxial.toml")
    (curve,) = asked.experiments[0].observations
    law = mpm.NeoHookean(1.0, 0.49)
    of_unit, stress = np.array([across(law, x, 3) for x in curve.against[1]]), curve.data
    expected = of_unit @ stress / (of_unit @ of_unit)
    found = mpm.fit(asked.experiments, asked.parameters)["youngs_modulus"]
    np.testing.assert_allclose(found.value, expected, rtol=5e-4)
    noise = np.sqrt(((stress - expected * of_unit) ** 2).sum() / (len(stress) - 1))
    np.testing.assert_allclose(found.error, noise / np.sqrt(of_unit @ of_unit), rtol=0.02)
