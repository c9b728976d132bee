"""Finite elements in JAX, as a page of code: bricks with linear shape functions of a neo-Hookean solid (plane strain in
two dimensions), by central differences. It shares nothing with `mpmjax`, and makes motions that fits are held against.

T. Belytschko et al., Nonlinear Finite Elements for Continua and Structures (2014), box 4.1: the forces are the
derivatives of the energy by the nodes' displacements, masses are lumped.
"""

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Mesh(NamedTuple):
    """Elements that are boxes of one size, on a lattice that begins at 0."""

    X: np.ndarray  # places of the nodes before they move [m], shape (n, d)
    elements: np.ndarray  # their nodes, the last axis first, shape (e, 2^d)
    size: np.ndarray  # of an element [m], shape (d,)

    @classmethod
    def box(cls, sides: tuple[float, ...], counts: tuple[int, ...], hole: Any = None) -> "Mesh":
        """A box of so many elements along its sides, without those whose middle is in the hole."""
        lines = [np.linspace(0, side, n + 1) for side, n in zip(sides, counts, strict=True)]
        X = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(sides))
        number = np.arange(len(X)).reshape([n + 1 for n in counts])
        corners = product((0, 1), repeat=len(sides))
        windows = [tuple(slice(c, c + n) for c, n in zip(corner, counts, strict=True)) for corner in corners]
        elements = np.stack([number[window].ravel() for window in windows], axis=1)
        if hole is not None:
            elements = elements[~hole(X[elements].mean(axis=1))]
            there, elements = np.unique(elements, return_inverse=True)
            X = X[there]
        return cls(X, elements.reshape(-1, 2 ** len(sides)), np.divide(sides, counts))

    def shapes(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The values and the gradients [1/m] of an element's shape functions at a place t in it, from 0 to 1."""
        corners = np.array(list(product((0, 1), repeat=len(t))))
        along = np.where(corners, t, 1 - t)
        slopes = np.where(corners, 1, -1) / self.size
        others = [np.delete(along, i, axis=1).prod(axis=1) for i in range(len(t))]
        return along.prod(axis=1), slopes * np.stack(others, axis=1)

    def at(self, u: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Displacements of places [m], shape (m, d), by those of the nodes at several times, shape (t, n, d)."""
        middles = self.X[self.elements].mean(axis=1)
        moved = []
        for place in places:
            e = np.abs((middles - place) / self.size).max(axis=1).argmin()
            values, _ = self.shapes((place - middles[e]) / self.size + 0.5)
            moved.append(np.einsum("a,tad->td", values, u[:, self.elements[e]]))
        return np.stack(moved, axis=1)


def simulate(
    mesh: Mesh,
    youngs_modulus: Any,
    poisson_ratio: float,
    density: float,
    *,
    dt: float,
    steps: int,
    every: int,
    u: np.ndarray | None = None,
    v: np.ndarray | None = None,
    gravity: tuple[float, ...] | None = None,
    held: Callable[[np.ndarray], np.ndarray] | None = None,
    floor: float | None = None,
) -> np.ndarray:
    """Displacements of the nodes [m] after every so many steps, shape (t, n, d).

    Args:
        youngs_modulus: of all elements, or of each [Pa].
        u, v: displacements [m] and velocities [m/s] at the start.
        held: says of places which stay where they are.
        floor: height of a smooth floor, stiff springs on the nodes [m].
    """
    d = mesh.X.shape[1]
    E = jnp.broadcast_to(jnp.asarray(youngs_modulus), len(mesh.elements))[:, None]
    mu, lam = E / 2 / (1 + poisson_ratio), E * poisson_ratio / (1 + poisson_ratio) / (1 - 2 * poisson_ratio)
    points = 0.5 + np.array(list(product((-1, 1), repeat=d))) / np.sqrt(12)
    gradients, weight = np.stack([mesh.shapes(t)[1] for t in points]), mesh.size.prod() / 2**d
    m = np.bincount(mesh.elements.ravel(), minlength=len(mesh.X))[:, None] * density * weight
    stays = jnp.zeros(len(mesh.X), bool) if held is None else jnp.asarray(held(mesh.X))
    rate = 4 * float(E.max()) * mesh.size[0] ** (d - 2)  # of the floor's springs [N/m]

    def energy(u: jax.Array) -> jax.Array:
        F = jnp.eye(d) + jnp.einsum("ead,eqaj->eqdj", u[mesh.elements], jnp.asarray(gradients)[None])
        log = jnp.log(jnp.linalg.det(F))
        return weight * (mu / 2 * ((F**2).sum(axis=(2, 3)) - d) - mu * log + lam / 2 * log**2).sum()

    def step(state: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        u, v = state
        force = -jax.grad(energy)(u) + m * jnp.asarray(gravity or (0.0,) * d)
        if floor is not None:
            force = force.at[:, 1].add(rate * jnp.maximum(floor - (jnp.asarray(mesh.X) + u)[:, 1], 0))
        v = jnp.where(stays[:, None], 0, v + dt * force / m)
        return (u + dt * v, v), None

    def frame(state: Any, _: None) -> tuple[Any, jax.Array]:
        state, _ = jax.lax.scan(step, state, length=every)
        return state, state[0]

    begun = tuple(jnp.zeros(mesh.X.shape) if a is None else jnp.asarray(a) for a in (u, v))
    return np.asarray(jax.jit(lambda s: jax.lax.scan(frame, s, length=steps // every)[1])(begun))
