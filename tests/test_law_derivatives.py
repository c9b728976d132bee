"""Every law where stretches coincide, nearly coincide and do not, through every nesting of derivatives, against
differences of values."""

import itertools
from math import factorial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ELASTIC, RUBBER, rotation_matrix, thorough

import mpmjax as mpm
from mpmjax.material import SnowHistory, VonMisesHistory

APART = (0.0, 1e-16, 1e-14, 1e-8, 2e-3, 0.3)
"""How far stretches that are equal are moved apart, in shares of a size."""
COINCIDING = ((1.0, 1.0, 1.0), (1.2, 1.2, 1.2), (1.2, 0.9, 0.9), (0.9, 1.2, 1.2))
LAWS = {
    **ELASTIC,
    "von_mises": mpm.VonMises(1e4, 0.3, 400.0).elastic(VonMisesHistory(jnp.zeros(1), jnp.full(1, -0.1))),
    "snow": mpm.Snow(1e4).elastic(SnowHistory(jnp.full(1, 0.9))),
    "tait": mpm.Fluid(1e4, tension=True).elastic(None),
}
"""What is elastic; where a law yields, the elastic part of it."""


def moved_apart(stretches, d, size=1.0):
    """Q diag(s) and Q diag(s) Rᵀ for these stretches moved apart, and a direction for each, (d, d, p)."""
    rng = np.random.default_rng(3)
    found = []
    for s, gap in itertools.product(stretches, APART):
        moved = np.diag(np.array(s[:d]) + size * gap * np.array([0.4, -1.0, 0.7])[:d])
        Q, R = rotation_matrix(d, rng), rotation_matrix(d, rng)
        found += [moved + size * gap * rng.normal(size=(d, d)) / 8, Q @ moved @ R.T]
    F, G = np.stack(found, axis=-1), rng.normal(size=(d, d, len(found)))
    return jnp.asarray(F), jnp.asarray(G / np.linalg.norm(G, axis=(0, 1)))


def differences(value, F, G, orders, reach):
    """Derivatives of these orders of a function of F along G, by values at eleven points within a reach of F."""
    t = np.linspace(-1, 1, 11)
    points = F[..., None, :] + reach * t[:, None] * G[..., None, :]
    values = np.asarray(jax.jit(lambda F: value(F))(points.reshape(*F.shape[:-1], -1)))
    values = values.reshape(*values.shape[:-1], len(t), F.shape[-1])
    weights = np.linalg.inv(np.vander(t, increasing=True))
    return [factorial(n) / reach**n * np.einsum("t,...tp->...p", weights[n], values) for n in orders]


def forward(f, G):
    return lambda F: jax.jvp(f, (F,), (G,))[1]


def reverse(f, W):
    return lambda F: jax.vjp(f, F)[1](W)[0]


def in_scan(f):
    """The function in a loop, of which JAX tells what is known from what is linear."""
    return lambda F: jax.lax.scan(lambda carry, x: (carry, f(x)), None, F[None])[1][0]


def routes(law, G):
    """By order, nests of derivatives that give the stress's along G: of a gradient each is symmetric, so that the
    transpose along G is the same."""
    energy = lambda F: law.energy(F).sum()  # noqa: E731
    looped = in_scan(law.energy)
    force = jax.grad(energy)
    tangent = lambda F: law.stress_differential(F)(G)  # noqa: E731
    automatic, stress = forward(force, G), law.stress
    transposed = in_scan(reverse(in_scan(stress), G))
    return {
        1: {
            "tangent": tangent,
            "forward": forward(stress, G),
            "reverse": reverse(stress, G),
            "energy, forward over reverse": automatic,
            "energy, reverse over forward": jax.grad(forward(energy, G)),
            "energy, reverse over reverse": jax.grad(lambda F: (G * force(F)).sum()),
            "energy, forward over reverse of a loop": forward(jax.grad(lambda F: looped(F).sum()), G),
        },
        2: {
            "tangent, forward": forward(tangent, G),
            "tangent, reverse": reverse(tangent, G),
            "forward over forward": forward(forward(stress, G), G),
            "forward over reverse": forward(reverse(stress, G), G),
            "forward over reverse of a loop": forward(transposed, G),
            "reverse over forward": reverse(forward(stress, G), G),
            "reverse over reverse": reverse(reverse(stress, G), G),
            "energy, forward over forward over reverse": forward(automatic, G),
            "energy, reverse over forward over reverse": reverse(automatic, G),
        },
        3: {
            "tangent, forward over reverse": forward(reverse(tangent, G), G),
            "tangent, reverse over forward": reverse(forward(tangent, G), G),
            "tangent, forward over reverse of a loop": forward(in_scan(reverse(in_scan(tangent), G)), G),
            "energy, all of it": forward(reverse(automatic, G), G),
        },
    }


TOLERANCE = {1: 1e-11, 2: 1e-9, 3: 1e-6}
"""By order, of the moduli times the largest number in the direction's power: differences lose it to rounding."""


def cases():
    """By default two laws in two dimensions; in three dimensions all but the first order is slow."""
    for name, d, order in itertools.product(LAWS, (3, 2), TOLERANCE):
        if (name, d) in {("von_mises", 3), ("tait", 3)}:  # where no direction is transverse that is Hencky's law
            continue
        default = (name, d, order) in {("neo_hookean", 2, 1), ("snow", 2, 1)}
        further = pytest.mark.slow if d == 3 and order > 1 else pytest.mark.thorough
        yield pytest.param(name, d, order, marks=() if default else further, id=f"{name}-{d}d-{order}")


@pytest.mark.parametrize(("name", "d", "order"), list(cases()))
def test_every_route_to_a_laws_derivative_is_right(name, d, order):
    """The stress's derivative of first, second and third order; those of implicit steps go as far as the third."""
    law = jax.tree.map(jnp.asarray, LAWS[name])
    F, G = moved_apart(COINCIDING, 1 if name == "tait" else d)
    F, G = (F[0, 0], G[0, 0]) if name == "tait" else (F, G)
    (exact,) = differences(law.stress, F, G, [order], 0.05)
    found = jax.jit(lambda law, F: {name: route(F) for name, route in routes(law, G)[order].items()})(law, F)
    for route, value in found.items():
        error = np.abs(np.asarray(value) - exact).max() / np.abs(exact).max()
        assert error < TOLERANCE[order], (route, error)


class Yielding(NamedTuple):
    """A law that yields, with states that it returns and states that it does not, well within either."""

    law: Any
    within: tuple[tuple[float, ...], ...]
    beyond: tuple[tuple[float, ...], ...]
    size: float
    """By how much states may be moved."""


YIELDING = {
    "snow": Yielding(
        mpm.Snow(1e4, 0.2, critical_compression=0.1, critical_stretch=0.1),
        ((1.0, 1.0, 1.0), (1.02, 0.97, 0.97)),
        ((1.25, 1.25, 1.25), (1.25, 0.8, 0.8), (1.25, 1.0, 1.0)),
        0.1,
    ),
    "von_mises": Yielding(
        mpm.VonMises(1e4, 0.3, yield_stress=1000.0, hardening_modulus=1e3),
        ((1.0, 1.0, 1.0), (1.02, 0.99, 0.99)),
        ((1.3, 0.8, 0.8), (0.7, 1.2, 1.2)),
        0.1,
    ),
    "drucker_prager": Yielding(
        mpm.DruckerPrager(1e4, 0.3, friction_angle=0.6),
        ((0.9, 0.9, 0.9), (0.95, 0.85, 0.85)),
        ((1.3, 1.3, 1.3), (1.8, 0.6, 0.6), (1.2, 1.3, 1.3)),
        0.1,
    ),
    "cam_clay": Yielding(
        mpm.CamClay(1e4, 0.3, friction=1.0, preconsolidation=3000.0, cohesion=0.5, hardening=3.0),
        ((1.0, 1.0, 1.0), (0.95, 0.95, 1.0)),
        ((0.75, 0.75, 0.75), (1.3, 1.3, 1.3), (1.5, 0.75, 0.75)),
        0.1,
    ),
    "herschel_bulkley": Yielding(
        mpm.HerschelBulkley(1e4, 0.3, yield_stress=600.0, consistency=5.0, exponent=0.7),
        ((1.0, 1.0, 1.0), (1.02, 0.99, 0.99)),
        ((1.3, 0.8, 0.8), (0.7, 1.2, 1.2)),
        0.1,
    ),
    "fluid": Yielding(mpm.Fluid(1e4), ((0.9,),), ((1.1,),), 0.1),
}


@pytest.mark.parametrize(
    ("name", "d"),
    [pytest.param(name, 3, marks=pytest.mark.slow) for name in list(YIELDING)[:-1]]
    + [("fluid", 1), *thorough(*((name, 2) for name in list(YIELDING)[:-1]))],
)
def test_every_route_to_a_return_maps_derivative_is_right(name, d):
    """Of first and second order, by F with a history that is a function of F."""
    law, within, beyond, size = YIELDING[name]
    law = jax.tree.map(jnp.asarray, law)
    states = [moved_apart(stretches, d, size) for stretches in (within, beyond)]
    F, G = (jnp.concatenate(parts, axis=-1) for parts in zip(*states, strict=True))
    F, G = (F[0, 0], G[0, 0]) if name == "fluid" else (F, G)

    def return_map(F):
        history = jax.tree.map(lambda a: a + 1e-3 * F[0, 0], law.initial_history(F))
        F, history = law.return_map(F, history, 1e-3)
        return jnp.concatenate([F.reshape(-1, F.shape[-1]), *(a[None] for a in jax.tree.leaves(history))])

    changed = np.abs(return_map(F)[: d * d] - F.reshape(d * d, -1)).max(axis=0)
    inside = states[0][0].shape[-1]
    assert (changed[:inside] < 5e-4).all()  # sand takes back the volume that its history remembers
    assert (changed[inside:] > 1e-3).all()
    exact = differences(return_map, F, G, (1, 2), 0.01)
    W = jnp.asarray(np.random.default_rng(4).normal(size=exact[0].shape))
    pulled, pushed = reverse(return_map, W), forward(return_map, G)
    looped = in_scan(reverse(in_scan(return_map), W))
    # by route the order, and whether it is the transpose
    along = {
        "forward": (1, False, pushed),
        "reverse": (1, True, pulled),
        "forward over forward": (2, False, forward(pushed, G)),
        "forward over reverse": (2, True, forward(pulled, G)),
        "forward over reverse of a loop": (2, True, forward(looped, G)),
        "reverse over forward": (2, True, reverse(pushed, W)),
    }
    found = jax.jit(lambda F: {route: f(F) for route, (_, _, f) in along.items()})(F)
    for route, value in found.items():
        order, transposed, _ = along[route]
        ours, true = np.asarray(value), exact[order - 1]
        if transposed:
            ours, true = (ours * np.asarray(G)).reshape(-1, ours.shape[-1]).sum(axis=0), np.einsum("rp,rp->p", W, true)
        assert np.abs(ours - true).max() < (1e-10, 1e-7)[order - 1] * max(np.abs(true).max(), 1), route


@pytest.mark.parametrize("name", ELASTIC | RUBBER)
def test_principal_tangents_are_of_the_principal_stresses(name):
    """With P_i = ∂Ψ/∂s_i of F = diag(s): twist (P_i + P_j)/(s_i + s_j), flip (P_i − P_j)/(s_i − s_j), scaling
    ∂P_i/∂s_j, by central differences. Stretches far apart, so that no index stands for another."""
    law, s, h = (ELASTIC | RUBBER)[name], np.array([1.35, 0.8, 1.1]), 1e-5

    at = np.concatenate([[s], s + h * np.eye(3), s - h * np.eye(3)])
    F = jnp.asarray(np.eye(3)[..., None] * at.T)
    stress, found = jax.jit(lambda F, s: (law.stress(F), law.principal_differential(s)))(F, jnp.asarray(s)[:, None])
    P, *beside = np.einsum("iip->pi", stress)
    for k, (i, j) in enumerate([(0, 1), (0, 2), (1, 2)]):
        np.testing.assert_allclose(found.twist[k, 0], (P[i] + P[j]) / (s[i] + s[j]), rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(found.flip[k, 0], (P[i] - P[j]) / (s[i] - s[j]), rtol=1e-9, atol=1e-6)
    slopes = np.transpose(np.subtract(beside[:3], beside[3:])) / (2 * h)
    np.testing.assert_allclose(found.scaling[..., 0], slopes, rtol=1e-7, atol=1e-4)
