"""Finite elements in JAX, as a page of code: linear shape functions on quadrilaterals and bricks of a neo-Hookean solid
(in two dimensions plane strain, or a body of revolution), by central differences. It shares nothing with `mpmjax`, and
makes motions that fits and contact are held against.

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
    """Elements of four or eight corners."""

    X: np.ndarray  # places of the nodes before they move [m], shape (n, d)
    elements: np.ndarray  # their nodes, the last axis first, shape (e, 2^d)

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
        return cls(X, elements.reshape(-1, 2 ** len(sides)))

    @classmethod
    def half_disc(cls, count: int) -> "Mesh":
        """The section of a ball of radius 1 whose axis is the second one, of so many elements along the first."""
        mesh = cls.box((1.0, 2.0), (count, 2 * count))
        x, y = mesh.X[:, 0], mesh.X[:, 1] - 1
        return mesh._replace(X=np.stack([x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)], axis=1))

    def shapes(self, places: np.ndarray, some: Any = slice(None)) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Shape functions at places in some elements, from 0 to 1, shape (q, d): their values, (q, 2^d), their
        gradients [1/m], (e, q, 2^d, d), and the elements' size there [m^d], (e, q)."""
        corners = np.array(list(product((0, 1), repeat=places.shape[1])))
        along = np.where(corners, places[:, None], 1 - places[:, None])
        others = np.stack([np.delete(along, i, axis=2).prod(axis=2) for i in range(places.shape[1])], axis=2)
        slopes = np.where(corners, 1, -1) * others
        jacobians = np.einsum("eai,qaj->eqij", self.X[self.elements[some]], slopes)
        gradients = np.einsum("qaj,eqji->eqai", slopes, np.linalg.inv(jacobians))
        return along.prod(axis=2), gradients, np.abs(np.linalg.det(jacobians))

    def quadrature(self, revolved: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Shape functions and their gradients at Gauss's points, with the points' radii, where the first axis is one,
        and volumes, (e, q)."""
        d = self.X.shape[1]
        values, gradients, sizes = self.shapes(0.5 + np.array(list(product((-1, 1), repeat=d))) / np.sqrt(12))
        radii = np.einsum("qa,ea->eq", values, self.X[self.elements][..., 0])
        return values, gradients, radii, sizes / 2**d * (2 * np.pi * radii if revolved else 1)

    def volumes(self, revolved: bool = False) -> np.ndarray:
        """Volume of each node [m^d, or of revolution m³], shape (n,)."""
        values, _, _, weights = self.quadrature(revolved)
        total = np.zeros(len(self.X))
        np.add.at(total, self.elements, np.einsum("qa,eq->ea", values, weights))
        return total

    def at(self, u: np.ndarray, places: np.ndarray) -> np.ndarray:
        """Displacements of places [m], shape (m, d), by those of the nodes at several times, shape (t, n, d), where
        elements are boxes."""
        low, high = self.X[self.elements].min(axis=1), self.X[self.elements].max(axis=1)
        moved = []
        for place in places:
            e = np.abs((low + high - 2 * place) / (high - low)).max(axis=1).argmin()
            values, *_ = self.shapes(((place - low) / (high - low))[e : e + 1], slice(e, e + 1))
            moved.append(np.einsum("a,tad->td", values[0], u[:, self.elements[e]]))
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
    revolved: bool = False,
) -> np.ndarray:
    """Displacements of the nodes [m] after every so many steps, shape (t, n, d).

    Args:
        youngs_modulus: of all elements, or of each [Pa].
        u, v: displacements [m] and velocities [m/s] at the start.
        held: says of places which stay where they are.
        floor: height of a smooth floor, stiff springs on the nodes [m].
        revolved: whether the first axis is the radius of a body of revolution.
    """
    d = mesh.X.shape[1]
    E = jnp.broadcast_to(jnp.asarray(youngs_modulus), len(mesh.elements))[:, None]
    mu, lam = E / 2 / (1 + poisson_ratio), E * poisson_ratio / (1 + poisson_ratio) / (1 - 2 * poisson_ratio)
    values, gradients, radii, weights = mesh.quadrature(revolved)
    m = density * mesh.volumes(revolved)[:, None]
    fixed = np.zeros(mesh.X.shape, bool) if held is None else np.broadcast_to(held(mesh.X)[:, None], mesh.X.shape)
    fixed = fixed | (revolved & (np.arange(d) == 0) & (mesh.X[:, :1] == 0))
    edge = np.ptp(mesh.X[mesh.elements][..., -1], axis=1).mean()
    rate = jnp.asarray(8 * float(E.max()) / density / edge**2 * m[:, 0])  # of the floor's springs [N/m]

    def energy(u: jax.Array) -> jax.Array:
        F = jnp.eye(d) + jnp.einsum("ead,eqaj->eqdj", u[mesh.elements], jnp.asarray(gradients))
        hoop = 1 + jnp.einsum("qa,ea->eq", values, u[mesh.elements][..., 0]) / radii if revolved else 1.0
        log = jnp.log(hoop * jnp.linalg.det(F))
        squares = (F**2).sum(axis=(2, 3)) + hoop**2 - d - 1
        return (weights * (mu / 2 * squares - mu * log + lam / 2 * log**2)).sum()

    def step(state: tuple[jax.Array, jax.Array], _: None) -> tuple[tuple[jax.Array, jax.Array], None]:
        u, v = state
        force = -jax.grad(energy)(u) + m * jnp.asarray(gravity or (0.0,) * d)
        if floor is not None:
            force = force.at[:, 1].add(rate * jnp.maximum(floor - (jnp.asarray(mesh.X) + u)[:, 1], 0))
        v = jnp.where(fixed, 0, v + dt * force / m)
        return (u + dt * v, v), None

    def frame(state: Any, _: None) -> tuple[Any, jax.Array]:
        state, _ = jax.lax.scan(step, state, length=every)
        return state, state[0]

    begun = tuple(jnp.zeros(mesh.X.shape) if a is None else jnp.asarray(a) for a in (u, v))
    return np.asarray(jax.jit(lambda s: jax.lax.scan(frame, s, length=steps // every)[1])(begun))
