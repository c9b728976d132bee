"""Laws: stress and tangent derive from the energy, rest is rest, rotations cost nothing, and closed forms hold."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import ELASTIC, LAWS, assert_close, ids, rotation_matrix, thorough

import mpmjax as mpm
from mpmjax import linalg as la

EACH_LAW = pytest.mark.parametrize("law", **ids(ELASTIC))
EACH_DIM = pytest.mark.parametrize("d", [*thorough(1), 2, *thorough(3)])
STRAINED = ELASTIC | {"hencky_transverse": mpm.Hencky(1e4, 0.3, transverse_strain=-0.2)}
EACH_STATE = pytest.mark.parametrize(
    ("name", "d"),
    [
        *thorough(*((name, 3) for name in ELASTIC)),
        *(case for name in STRAINED for case in (*thorough((name, 1)), (name, 2))),
    ],
)
"""Every law in every dimension, and Hencky's with a strain out of the space, which in 3-D there is not."""


@eqx.filter_jit
def response(law, F, dF, dG):
    """Energy, stress, ∂Ψ/∂F, the tangent in two directions, and the jvp of the stress in the first."""
    tangent = law.stress_differential(F)
    gradient = jax.grad(lambda F: law.energy(F).sum())(F)
    return law.energy(F), law.stress(F), gradient, tangent(dF), tangent(dG), jax.jvp(law.stress, (F,), (dF,))[1]


@eqx.filter_jit
def forward(law, F, dF):
    """Energy, stress and the tangent in one direction."""
    return law.energy(F), law.stress(F), law.stress_differential(F)(dF)


def evaluate(f, law, *arrays):
    """A compiled function of a law and arrays; numbers become arrays, so that another value is no compilation."""
    return jax.tree.map(np.asarray, f(*jax.tree.map(jnp.asarray, (law, *arrays))))


def directions(F):
    """Two random δF."""
    return np.random.default_rng(1).normal(size=(2, *F.shape))


def with_lame(law, mu, lam):
    """A law of the same kind with the given Lamé constants."""
    ratio = lam / (2 * (lam + mu))
    return type(law)(youngs_modulus=2 * mu * (1 + ratio), poisson_ratio=ratio)


@EACH_STATE
@pytest.mark.parametrize("family", STRETCHES)
def test_stress_and_tangent_are_derivatives_of_the_energy(name, family, d):
    """P = ∂Ψ/∂F by `jax.grad` and δP by `jax.jvp`, particle by particle, to 1e-12; the tangent is symmetric."""
    law = STRAINED[name]
    F, _ = deformations(family, d)
    if not np.asarray(law.is_admissible(jnp.asarray(F))).all():
        assert family == "inverted"
        assert not isinstance(law, mpm.FixedCorotated)
        return
    dF, dG = directions(F)
    _, P, gradient, A, B, derivative = evaluate(response, law, F, dF, dG)
    # differences of terms as large as the moduli, whatever cancels near rest
    moduli = float(law.shear_modulus + law.lame_lambda)
    for p in range(F.shape[-1]):
        assert_close(P[..., p], gradient[..., p], 1e-12, atol=1e-13 * moduli)
        assert_close(A[..., p], derivative[..., p], 1e-12)
    here, there = np.einsum("ijp,ijp->p", A, dG), np.einsum("ijp,ijp->p", B, dF)
    size = np.linalg.norm(A, axis=(0, 1)) * np.linalg.norm(dG, axis=(0, 1))
    np.testing.assert_allclose((here - there) / size, 0, atol=1e-13)


@EACH_LAW
@EACH_DIM
def test_rest_and_rotations_carry_no_stress_and_no_energy(law, d):
    """Ψ(R) = 0 and P(R) = 0; Ψ(QF) = Ψ(F) and P(QF) = Q P(F)."""
    rng = np.random.default_rng(2)
    moduli = float(law.shear_modulus + law.lame_lambda)
    Q = np.stack([rotation_matrix(d, rng) for _ in range(20)], axis=-1)
    Q[:, :, 0] = np.eye(d)
    energy, P, _ = evaluate(forward, law, Q, Q)
    np.testing.assert_allclose(energy / moduli, 0, atol=1e-14)
    np.testing.assert_allclose(P / moduli, 0, atol=1e-14)
    F, _ = deformations("random", d)
    energy, P, _ = evaluate(forward, law, F, F)
    turned_energy, turned_P, _ = evaluate(forward, law, np.einsum("ikp,kjp->ijp", Q, F), F)
    assert_close(turned_energy, energy, 1e-13)
    assert_close(turned_P, np.einsum("ikp,kjp->ijp", Q, P), 1e-13)
    assert (energy >= 0).all()


@EACH_LAW
@EACH_DIM
def test_small_strains_follow_lames_law(law, d):
    """At F = I, δP = 2μ ε + λ tr(ε) I, with μ = E/(2(1+ν)) and λ = Eν/((1+ν)(1−2ν)); turning costs nothing."""
    E, nu = float(law.youngs_modulus), float(law.poisson_ratio)
    mu, lam = E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))
    np.testing.assert_allclose([law.shear_modulus, law.lame_lambda], [mu, lam], rtol=1e-15)
    F = np.broadcast_to(np.eye(d)[..., None], (d, d, 20))
    dF, _ = directions(F)
    _, _, A = evaluate(forward, law, F, dF)
    strain = (dF + dF.swapaxes(0, 1)) / 2
    expected = 2 * mu * strain + lam * np.einsum("iip->p", strain) * np.eye(d)[..., None]
    assert_close(A, expected, 1e-14)


@EACH_LAW
@EACH_DIM
def test_parameters_are_scalars_or_one_per_particle(law, d):
    """Equal values per particle give the scalar's answer; different ones give each particle its own law's."""
    F, _ = deformations("random", d)
    p, rng, (dF, _) = F.shape[-1], np.random.default_rng(3), directions(F)
    E, nu = rng.uniform(1e3, 1e5, p), rng.uniform(-0.2, 0.45, p)
    same = type(law)(np.full(p, law.youngs_modulus), np.full(p, law.poisson_ratio))
    for a, b in zip(evaluate(forward, same, F, dF), evaluate(forward, law, F, dF), strict=True):
        assert_close(a, b, 1e-15)
    varied = evaluate(forward, type(law)(E, nu), F, dF)
    for q in (0, p - 1):
        for a, b in zip(varied, evaluate(forward, type(law)(E[q], nu[q]), F, dF), strict=True):
            assert_close(a[..., q], b[..., q], 1e-13)


@EACH_DIM
def test_fixed_corotated_is_linear_in_uniaxial_strain(d):
    """P₁₁ = (λ + 2μ)(F₁₁ − 1) exactly for F₁₁ > 0, of any size (verification 1.1)."""
    law = LAWS["fixed_corotated"]
    F = np.broadcast_to(np.eye(d)[..., None], (d, d, 20)).copy()
    F[0, 0] = np.linspace(0.05, 3, 20)
    _, P, _ = evaluate(forward, law, F, F)
    modulus = float(law.lame_lambda + 2 * law.shear_modulus)
    assert_close(P[0, 0], modulus * (F[0, 0] - 1), 1e-14)


@eqx.filter_jit
def principal_forms(law, F):
    """∂²Ψ/∂F∂F, (d², d², p), as the tangent applies it and as the closed form in the principal frame says."""
    d = F.shape[0]
    U, s, V = la.principal_frame(F)
    units = jnp.eye(d * d).reshape(d * d, d, d, 1)
    tangent = law.stress_differential(F)
    dense = jax.vmap(lambda e: tangent(jnp.broadcast_to(e, F.shape)))(units).reshape(d * d, d * d, -1)
    closed = law.principal_differential(s)
    modes = la.principal_modes(U, V)
    inner = jnp.zeros((d * d, d * d, F.shape[-1]))
    inner = inner.at[:d, :d].set(closed.scaling)
    for k, value in enumerate([*closed.twist, *closed.flip], d):
        inner = inner.at[k, k].set(value)
    modes = modes.reshape(d * d, d * d, -1)
    return dense, jnp.einsum("kap,klp,lbp->abp", modes, inner, modes), closed


@EACH_STATE
@pytest.mark.parametrize("family", STRETCHES)
def test_principal_tangent_is_the_tangents_eigenstructure(name, family, d):
    """The closed form in the principal frame is the assembled tangent to 1e-11 of its largest entry, and its
    eigenvalues are those of `numpy.linalg.eigvalsh`."""
    law = STRAINED[name]
    F, _ = deformations(family, d)
    if not np.asarray(law.is_admissible(jnp.asarray(F))).all():
        assert family == "inverted"
        assert not isinstance(law, mpm.FixedCorotated)
        return
    dense, closed, parts = evaluate(principal_forms, law, F)
    for p in range(F.shape[-1]):
        assert_close(closed[..., p], dense[..., p], 1e-11)
        scaling = np.linalg.eigvalsh(parts.scaling[..., p])
        ours = np.sort([*parts.twist[:, p], *parts.flip[:, p], *scaling])
        assert_close(ours, np.linalg.eigvalsh(dense[..., p]), 1e-11)


@eqx.filter_jit
def matrices(law, F, A, weight):
    """The matrix of G ↦ w (∂²Ψ/∂F∂F : (G A)) Aᵀ, the derivative's direction first, in closed form and by the map."""
    tangent = law.stress_differential(F)

    def flux(slopes):
        return la.transpose(weight * la.matmul(tangent(la.matmul(la.transpose(slopes), A)), la.transpose(A)))

    return tangent.pushed_forward(A, weight), la.upper_triangle(la.matrix_of(flux, F))


@EACH_STATE
@pytest.mark.parametrize("family", STRETCHES)
def test_closed_matrix_of_the_stress_differential_is_that_of_the_map(name, family, d):
    """To 1e-11 of its largest entry, particle by particle, pushed forward by F itself and by other matrices."""
    law = STRAINED[name]
    F, _ = deformations(family, d)
    if not np.asarray(law.is_admissible(jnp.asarray(F))).all():
        assert family == "inverted"
        assert not isinstance(law, mpm.FixedCorotated)
        return
    weight = np.linspace(1, 3, F.shape[-1])
    for A in (F, directions(F)[0]):
        closed, dense = evaluate(matrices, law, F, A, weight)
        for p in range(F.shape[-1]):
            assert_close(closed[..., p], dense[..., p], 1e-11)


@pytest.mark.thorough
def test_fixed_corotated_is_indefinite_under_compression():
    """At F = 0.95 I with μ = 1, λ = 1.5 the smallest eigenvalue, a twist's, is −0.3085."""
    law = with_lame(LAWS["fixed_corotated"], 1.0, 1.5)
    F = 0.95 * np.eye(3)[..., None]
    dense, _, parts = evaluate(principal_forms, law, F)
    expected = 2 * (1 - 1 / 0.95) + 1.5 * (0.95**3 - 1) * 0.95
    np.testing.assert_allclose(expected, -0.3085, atol=5e-5)
    np.testing.assert_allclose(parts.twist, expected, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.eigvalsh(dense[..., 0])[:3], expected, rtol=1e-12)


def sampled(law, d):
    """Lamé's constants, and F, energy and stress at random, the particle first."""
    F, _ = deformations("random", d)
    energy, P, _ = evaluate(forward, law, F, F)
    return float(law.shear_modulus), float(law.lame_lambda), np.moveaxis(F, -1, 0), energy, np.moveaxis(P, -1, 0)


@EACH_DIM
def test_neo_hookean_matches_its_formula(d):
    """P = μ (F − F⁻ᵀ) + λ ln J F⁻ᵀ by NumPy's inverse, and Ψ = μ/2 (F:F − d) − μ ln J + λ/2 (ln J)²."""
    mu, lam, F, energy, P = sampled(ELASTIC["neo_hookean"], d)
    log_J, pull = np.log(np.linalg.det(F)), np.linalg.inv(F).swapaxes(1, 2)
    assert_close(P, mu * (F - pull) + lam * log_J[:, None, None] * pull, 1e-13)
    squares = (F**2).sum(axis=(1, 2)) - d
    assert_close(energy, mu / 2 * squares - mu * log_J + lam / 2 * log_J**2, 1e-13)


@EACH_DIM
def test_hencky_matches_its_formula(d):
    """With ε = ½ log FᵀF by NumPy's eigenvectors: P = F⁻ᵀ (2μ ε + λ tr(ε) I) and Ψ = μ ε : ε + λ/2 (tr ε)²."""
    mu, lam, F, energy, P = sampled(ELASTIC["hencky"], d)
    squares, V = np.linalg.eigh(F.swapaxes(1, 2) @ F)
    strain = (V * np.log(squares)[:, None] / 2) @ V.swapaxes(1, 2)
    trace = np.trace(strain, axis1=1, axis2=2)
    kirchhoff = 2 * mu * strain + lam * trace[:, None, None] * np.eye(d)
    assert_close(P, np.linalg.inv(F).swapaxes(1, 2) @ kirchhoff, 1e-13)
    assert_close(energy, mu * (strain**2).sum(axis=(1, 2)) + lam / 2 * trace**2, 1e-13)


@pytest.mark.parametrize("d", [1, 2])
def test_hencky_with_a_transverse_strain_is_the_law_in_three_dimensions(d):
    """Energy and stress are those of F with exp ε_t on the rest of the diagonal, whatever ε_t of each particle."""
    F, _ = deformations("random", d)
    strain = np.random.default_rng(5).normal(size=F.shape[-1]) / 5
    whole = np.repeat(np.eye(3)[..., None], F.shape[-1], axis=-1) * np.exp(strain)
    whole[:d, :d] = F
    energy, P, A = evaluate(forward, mpm.Hencky(1e4, 0.3, transverse_strain=strain), F, np.ones_like(F))
    dF = np.zeros_like(whole)
    dF[:d, :d] = 1
    expected = evaluate(forward, ELASTIC["hencky"], whole, dF)
    for ours, theirs in zip((energy, P, A), (expected[0], expected[1][:d, :d], expected[2][:d, :d]), strict=True):
        assert_close(ours, theirs, 1e-13)


@pytest.mark.thorough
def test_no_strain_is_transverse_in_three_dimensions():
    """A law that holds one says so."""
    law = mpm.Hencky(1e4, 0.3, transverse_strain=0.1)
    with pytest.raises(ValueError, match="In 3-D no direction is transverse"):
        law.energy(jnp.ones((3, 3, 1)))


@EACH_DIM
def test_laws_say_what_they_admit(d):
    """Fixed corotated takes every finite F, neo-Hookean and Hencky those with det F > 0."""
    F = np.repeat(np.eye(d)[..., None], 4, axis=-1)
    F[0, 0] = [1.0, 0.0, -1.0, np.nan]
    F = jnp.asarray(F)
    np.testing.assert_array_equal(LAWS["fixed_corotated"].is_admissible(F), [True, True, True, False])
    for law in ("neo_hookean", "hencky"):
        np.testing.assert_array_equal(ELASTIC[law].is_admissible(F), [True, False, False, False])


@pytest.mark.parametrize("d", [2, 3])
def test_fixed_corotated_resists_collapse_and_inversion(d):
    """At J = 0 and beyond, energy, stress and tangent are finite (no F⁻¹ is formed) and the stress pushes back."""
    F = np.repeat(np.eye(d)[..., None], 20, axis=-1)
    F[-1, -1] = np.linspace(0, -0.9, 20)
    energy, P, A = evaluate(forward, LAWS["fixed_corotated"], F, directions(F)[0])
    assert all(np.isfinite(a).all() for a in (energy, P, A))
    assert (P[-1, -1] < 0).all()


@EACH_LAW
@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"youngs_modulus": 0.0, "poisson_ratio": 0.3}, r"youngs_modulus \[Pa\] must be greater than zero"),
        ({"youngs_modulus": -1.0, "poisson_ratio": 0.3}, "must be greater than zero, got -1.0"),
        ({"youngs_modulus": np.nan, "poisson_ratio": 0.3}, "youngs_modulus.* must be finite"),
        ({"youngs_modulus": 1.0, "poisson_ratio": 0.5}, "poisson_ratio must be strictly between -1 and 0.5"),
        ({"youngs_modulus": 1.0, "poisson_ratio": -1.0}, "poisson_ratio must be strictly between"),
        ({"youngs_modulus": np.array([1.0, -1.0]), "poisson_ratio": 0.3}, "must be greater than zero"),
    ],
)
def test_bad_parameters_are_refused(law, parameters, message):
    """E must be positive and ν strictly between −1 and ½, per particle too."""
    with pytest.raises(ValueError, match=message):
        type(law)(**parameters)
