"""The interface of a constraint on how a body moves, which the law of the body brings."""

import abc
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, Int, Mask, NodeVector, ParticleVector, Scalar
from mpmjax.boundary import OwnedCouple
from mpmjax.potential import AbstractImage, Mirror
from mpmjax.state._particles import Particles


class AbstractLayerImage(AbstractImage):
    """The map B of a constrained body, whose layer of nodes moves by fewer numbers q than it has: u = B q. They stand
    at the layer's first nodes, to which Bᵀ brings masses, momenta and forces."""

    layer: eqx.AbstractVar[int]  # the number of the body's layer of m nodes
    layers: eqx.AbstractVar[int]  # how many layers the grid has

    def own(self, field: Array) -> Array:
        """The part of a field of all nodes that is of its layer, shape (m, ...)."""
        return field.reshape(self.layers, -1, *field.shape[1:])[self.layer]

    def with_own(self, field: Array, layer: Array) -> Array:
        """The field with that part replaced."""
        layers = field.reshape(self.layers, *layer.shape)
        # not `.at[].set`: XLA's update in place has overwritten what the new part is computed from (jax 0.10.1)
        return jnp.concatenate([layers[: self.layer], layer[None], layers[self.layer + 1 :]]).reshape(field.shape)

    @abc.abstractmethod
    def places(self, carrier: NodeVector) -> Float[Array, "m d"]:
        """The velocity [m/s], shape (m, d), of the places at which the impulses on its nodes are taken, by the folded
        velocity of all nodes; `AbstractConstraint.received` gives the couple about them."""


class AbstractConstraint(eqx.Module):
    """A constraint on how one body moves, a part of every step, solve and derivative: a linear map of the body's nodes,
    as a mirror is (see `Rigid`). The law brings it, by its method `constraint`."""

    number: eqx.AbstractVar[int]  # index of the body's material in the scene

    @property
    @abc.abstractmethod
    def guided(self) -> bool:
        """Whether it holds the body, so that boundary forces have a row for it, after those of boundaries."""

    @abc.abstractmethod
    def check(self, scene: Any) -> None:
        """Raise a `ValueError` if it cannot stand in a scene."""

    @abc.abstractmethod
    def check_particles(self, x: np.ndarray, spacing: float) -> None:
        """Raise a `ValueError` if it cannot move particles at x [m], shape (q, d)."""

    @abc.abstractmethod
    def at_start(
        self, scene: Any, particles: Particles, nodes: Any, planes: Mirror
    ) -> tuple[AbstractLayerImage, NodeVector, Mask, NodeVector]:
        """The map of the body's nodes in a step; and of its layer the velocity at the start [m/s], the components that
        are held, and their velocity, each (m, d): at the nodes of q, and zero or False elsewhere. All particles are
        prepared, all nodes have what boundaries prescribe, not folded yet, and `planes` are those of symmetry."""

    @abc.abstractmethod
    def moved(
        self,
        before: Particles,
        after: Particles,
        image: Any,
        fixed: Mask,
        new: NodeVector,
        mean: NodeVector,
        dt: Scalar,
    ) -> Particles:
        """The particles after G2P with those of the body moved by q: by the folded velocities after the step and that
        with which positions move [m/s], and the components that were held, all of shape (n, d)."""

    @abc.abstractmethod
    def received(
        self,
        image: Any,
        owners: Int[Array, "n d"],
        planes: list[tuple[int, Any]],
        loose: tuple[Array, NodeVector],
        tied: tuple[Array, NodeVector],
        guide: int | None,
    ) -> tuple[Int[Array, "n d"], OwnedCouple]:
        """Which boundary holds each component of the nodes' velocity (`owners` without the body, −1 for none) once a
        node that is held holds the body; and the couple that the body receives besides the forces on its nodes.
        `planes` are the mirrors of symmetry planes with their boundaries' numbers, `loose` masses of all nodes [kg],
        (n,), and their change of velocity in the solve [m/s], (n, d), `tied` likewise of the folded nodes, and `guide`
        is the number under which its own hold is reported, if it has one."""

    @abc.abstractmethod
    def kinetic_energy(self, x: ParticleVector, v: ParticleVector, mass: Array, volume: Array) -> Float[Array, ""]:
        """The body's kinetic energy [J], from its particles."""
