"""Every law where stretches coincide, nearly coincide and do not, through every nesting of derivatives, against
differences of values."""

import itertools
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ELASTIC, rotation_matrix

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
    values = np.asarray(jax.jit(lambda F: value(F))(points.reshape(*F.shape[:2], -1)))
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
    tangent = lambda F: law.tangent(F)(G)  # noqa: E731
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
    """In three dimensions third derivatives are Hencky's and fixed corotated's alone, and slow."""
    for name, d, order in itertools.product(LAWS, (2, 3), TOLERANCE):
        if (name, d) == ("von_mises", 3):  # no direction is transverse: Hencky's law
            continue
        if name == "tait":
            d -= 1  # noqa: PLW2901
            if d == 2:
                continue
        yield pytest.param(name, d, order, marks=[pytest.mark.slow] * ((d, order) == (3, 3)), id=f"{name}-{d}d-{order}")


@pytest.mark.parametrize(("name", "d", "order"), list(cases()))
def test_every_route_to_a_laws_derivative_is_right(name, d, order):
    """The stress's derivative of first, second and third order; those of implicit steps go as far as the third."""
    law = jax.tree.map(jnp.asarray, LAWS[name])
    F, G = moved_apart(COINCIDING, d)
    (exact,) = differences(law.stress, F, G, [order], 0.05)
    found = jax.jit(lambda law, F: {name: route(F) for name, route in routes(law, G)[order].items()})(law, F)
    for route, value in found.items():
        error = np.abs(np.asarray(value) - exact).max() / np.abs(exact).max()
        assert error < TOLERANCE[order], (route, error)
