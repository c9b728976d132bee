"""The Hessian action both ways, against each other and against finite differences, and the operator M + χH."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from deformations import STRETCHES, deformations
from helpers import DESCRIPTIONS, DIMS, ELASTIC, GRADIENTS, LAWS, cloud, thorough

import mpmjax as mpm
from mpmjax._types import components
from mpmjax.boundary import combined_conditions, mirror
from mpmjax.discretisation._stencil import make_stencil
from mpmjax.discretisation._transfer import p2g
from mpmjax.implicit import ElasticPotential, ImplicitOperator, Projection
from mpmjax.state._material_points import MaterialPoints

DX = 0.1
CASES = {
    f"{law}-{d}d-{family}-{description}-{gradient}": (law, d, family, description, gradient)
    for law in ELASTIC
    for d in DIMS
    for family in STRETCHES
    for description in DESCRIPTIONS
    for gradient in GRADIENTS
    # the others need det F > 0
    if law == "fixed_corotated" or family != "inverted"
}
HESSIANS = {"analytic": mpm.implicit.AnalyticHessian(), "jvp": mpm.implicit.JvpHessian()}
IN_THREE_DIMENSIONS = [("fixed_corotated", "updated", "spline"), ("neo_hookean", "total", "mls")]
"""Cases of all families of F that are not slow."""
DEFAULT = [
    ("fixed_corotated", 2, "updated", "mls"),
    ("neo_hookean", 1, "total", "mls"),
]
"""Cases of all families of F in the default run."""


def chosen():
    """In three dimensions and of Hencky's law, where each case is dear, the other combinations meet one family of F
    only, and are slow; `benchmarks/hessian_routes.py` runs all of them. Of the others those in `DEFAULT` belong to the
    default run."""
    for name, case in CASES.items():
        law, d, family, description, gradient = case
        dear = d == 3 and (law, description, gradient) not in IN_THREE_DIMENSIONS
        dear |= law == "hencky" and (d, description, gradient) != (2, "updated", "spline")
        if not dear or family == "random":
            further = pytest.mark.slow if dear else pytest.mark.thorough
            yield pytest.param(case, marks=() if (law, d, description, gradient) in DEFAULT else further, id=name)


EACH_CASE = pytest.mark.parametrize("case", list(chosen()))


make = eqx.filter_jit(make_stencil)


@eqx.filter_jit
def linearised(potential, du, u, h):
    """About u: −∂Φ/∂u, the force there and at u ∓ h δu, and H δu, analytic, through the operator without mass, and by
    the derivative of −∂Φ/∂u."""
    H, free = mpm.implicit.AnalyticHessian().at(potential, u), jnp.ones(du.shape, bool)
    analytic = ImplicitOperator(jnp.zeros(len(du)), jnp.asarray(1.0), H, Projection(free)).mv(du)
    place = jnp.zeros_like(du) if u is None else u
    forces = jax.vmap(lambda step: potential.force(place + step * du))(jnp.stack([0 * h, -h, h]))
    slope, derivative = jax.jvp(jax.grad(potential.energy), (place,), (du,))
    return -slope, forces, [analytic, derivative]


@cache
def scene_of(law, d, family, description, gradient):
    """The elastic potential of a random cloud, and a random nodal displacement of about a spacing."""
    grid, particles = cloud(d, dx=DX)
    window = grid.window(particles.x)
    stencil = make(mpm.BSpline(), GRADIENTS[gradient], grid, window, particles.x)
    F = jnp.asarray(deformations(family, d, n=particles.count)[0])
    total = description == "total"
    images = mirror((), grid, window)
    material = jax.tree.map(jnp.asarray, ELASTIC[law])
    points = MaterialPoints(material, particles.volume, F, total, (0, particles.count), None)
    potential = ElasticPotential((points,), stencil, images, grid.size)
    du = jnp.asarray(DX * np.random.default_rng(1).normal(size=(grid.size, d)))
    return potential, du


def relative(a, b):
    """The largest difference over the largest entry."""
    return float(np.abs(np.asarray(a) - np.asarray(b)).max() / np.abs(np.asarray(b)).max())


@cache
def results_of(*case):
    """`linearised` of a case at rest; its steps are small against the smallest stretch. With h."""
    potential, du = scene_of(*case)
    h = 1e-6 * jnp.abs(jnp.linalg.det(potential.deformation(None)[0].transpose(2, 0, 1))).min() ** (1 / du.shape[1])
    return *jax.tree.map(np.asarray, linearised(potential, du, None, h)), float(h)


def route_difference(*case):
    """How far `AnalyticHessian` is from the derivative of the energy's gradient, by the largest entry of H δu."""
    return relative(*results_of(*case)[2])


def worst_difference():
    """The worst difference of the two routes over all cases, and the case."""
    return max((route_difference(*case), name) for name, case in CASES.items())


@EACH_CASE
def test_both_routes_agree(case):
    """The analytic action (eqs. 7 to 12) and the jvp of the energy's gradient are one to 1e-12."""
    assert route_difference(*case) < 1e-12


@EACH_CASE
def test_hessian_agrees_with_central_differences_of_the_force(case):
    """H δu = (f(u − hδu) − f(u + hδu))/2h."""
    _, (_, back, there), actions, h = results_of(*case)
    for H in actions:
        assert relative((back - there) / (2 * h), H) < 1e-7


@EACH_CASE
def test_force_is_minus_the_gradient_of_the_energy(case):
    """f = −∂Φ/∂u at u = 0, to rounding of the moduli."""
    descent, (force, _, _), _, _ = results_of(*case)
    law, volume = ELASTIC[case[0]], scene_of(*case)[0].material_points[0].volume
    moduli = float((law.shear_modulus + law.lame_lambda) * volume.max() / DX)
    np.testing.assert_allclose(force, descent, rtol=0, atol=1e-13 * max(np.abs(force).max(), moduli))


@pytest.mark.thorough
@pytest.mark.parametrize("law", [*LAWS, "hencky"])
@pytest.mark.parametrize("description", ["updated", "total"])
def test_hessian_at_a_displacement_is_the_forces_derivative_there(law, description):
    """Newton's later steps: both routes at u ≠ 0, against each other and central differences; force = −∂Φ/∂u there."""
    case = (law, 2, "repeated", description, "mls")
    potential, du = scene_of(*case)
    u, h = 0.05 * jnp.roll(du, 7, axis=0), jnp.asarray(1e-6)
    descent, (force, back, there), (one, other) = linearised(potential, du, u, h)
    assert relative(force, descent) < 1e-12
    assert relative(one, other) < 1e-12
    assert relative((back - there) / (2 * h), one) < 1e-7
    assert relative(one, results_of(*case)[2][0]) > 1e-2


EACH_CONSTRAINED = pytest.mark.parametrize(
    ("d", "description"),
    [(2, "updated"), *thorough((1, "updated"), (1, "total"), (2, "total"), (3, "updated"))],
)


@eqx.filter_jit
def apply(operator, u):
    return operator.mv(u)


@cache
def constrained(d, description, law="fixed_corotated"):
    """Operators of both routes with a symmetry plane, a sticky wall and empty nodes, their potential and free mask."""
    grid, particles = cloud(d, dx=DX)
    walls = (mpm.SymmetryPlane(0, 0.0), mpm.StickyBox((-np.inf,) * d, (5 * DX,) * d))
    window = grid.window(particles.x)
    stencil = make(mpm.BSpline(), mpm.MLSGradient(), grid, window, particles.x)
    F, images = components(particles.F), mirror(walls, grid, window)
    points = MaterialPoints(
        jax.tree.map(jnp.asarray, LAWS[law]), particles.volume, F, description == "total", (0, particles.count), None
    )
    potential = ElasticPotential((points,), stencil, images, grid.size)
    mass = images.fold_scalar(p2g(stencil, particles.mass, components(particles.v), None, grid.size)[0])
    fixed = combined_conditions(walls, grid.nodes(window), DX, 0.0, 1.0, reference=False).fixed
    free = (mass > 0)[:, None] & ~fixed
    assert {"free", "fixed", "empty"} == {
        kind
        for kind, mask in {"free": free, "fixed": fixed & (mass > 0)[:, None], "empty": mass == 0}.items()
        if mask.any()
    }
    # so that mass and stiffness are alike
    factor = jnp.asarray(1e-3)
    operators = [ImplicitOperator(mass, factor, h.at(potential, None), Projection(free)) for h in HESSIANS.values()]
    return operators, potential, free


@EACH_CONSTRAINED
@pytest.mark.parametrize("route", [0, 1], ids=HESSIANS)
def test_operator_is_symmetric(route, d, description):
    """⟨a, A b⟩ = ⟨A a, b⟩ to 1e-13 with a symmetry plane, fixed components and empty nodes; densely below 3-D."""
    operators, _, free = constrained(d, description)
    operator = operators[route]
    a, b = (jnp.asarray(np.random.default_rng(seed).normal(size=free.shape)) for seed in (5, 6))
    Aa, Ab = np.asarray(apply(operator, a)), np.asarray(apply(operator, b))
    size = np.linalg.norm(Ab) * np.linalg.norm(a)
    np.testing.assert_allclose((np.vdot(a, Ab) - np.vdot(Aa, b)) / size, 0, atol=1e-13)
    assert relative(apply(operators[1 - route], b), Ab) < 1e-12
    if d < 3:
        A = np.asarray(eqx.filter_jit(ImplicitOperator.as_matrix)(operator))
        np.testing.assert_allclose(A, A.T, rtol=0, atol=1e-13 * np.abs(A).max())
        np.testing.assert_allclose(
            (A @ np.asarray(b).ravel()).reshape(b.shape), Ab, rtol=0, atol=1e-12 * np.abs(A).max()
        )
        held = ~np.asarray(free).ravel()
        np.testing.assert_array_equal(A[held], np.eye(len(A))[held])
        np.testing.assert_array_equal(A[:, held], np.eye(len(A))[:, held])


@EACH_CONSTRAINED
@pytest.mark.parametrize("route", [0, 1], ids=HESSIANS)
def test_assembled_it_is_the_same_operator(route, d, description):
    """What the solvers iterate on, one symmetric matrix a particle, against the map through the law."""
    operator = constrained(d, description)[0][route]
    b = jnp.asarray(np.random.default_rng(9).normal(size=operator.projection.free.shape))
    assembled = eqx.filter_jit(ImplicitOperator.precomputed)(operator)
    assert relative(apply(assembled, b), apply(operator, b)) < 1e-13


@pytest.mark.parametrize("d", [2, *thorough(1, 3)])
def test_rows_of_fixed_components_and_empty_nodes_are_the_identity(d):
    """Rows that are held return their entry and pass nothing on; the mass preconditioner's weight is the mass on
    free rows, one elsewhere."""
    (operator, _), _, free = constrained(d, "updated")
    u = jnp.asarray(np.random.default_rng(7).normal(size=free.shape))
    got = np.asarray(apply(operator, u))
    held = ~np.asarray(free)
    np.testing.assert_array_equal(got[held], np.asarray(u)[held])
    np.testing.assert_array_equal(apply(operator, jnp.where(free, 0, u)), jnp.where(free, 0, u))
    weight = mpm.implicit.MassPreconditioner().inner_product(operator).weight
    np.testing.assert_array_equal(weight, jnp.where(free, operator.mass[:, None], 1))
    assert (weight > 0).all()
    without = eqx.tree_at(lambda o: o.factor, operator, jnp.asarray(0.0))
    np.testing.assert_array_equal(apply(without, u), jnp.where(free, operator.mass[:, None] * u, u))


@pytest.mark.parametrize("description", ["updated", *thorough("total")])
@pytest.mark.parametrize("d", [*thorough(1), 2])
def test_mirrored_force_is_minus_the_gradient_of_the_mirrored_energy(d, description):
    """With a symmetry plane the force is folded as the energy's gradient is."""
    _, potential, free = constrained(d, description)
    u = jnp.asarray(1e-3 * DX * np.random.default_rng(8).normal(size=free.shape))
    force, descent = jax.jit(lambda p, u: (p.force(u), -jax.grad(p.energy)(u)))(potential, u)
    assert relative(force, descent) < 1e-12
