"""Surfaces of any shape that hold what flows while it presses."""

from collections.abc import Callable

import jax.numpy as jnp

from mpmjax._types import Array, Bool, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes, friction_change
from mpmjax.potential import SurfaceImage


class FlowContact(AbstractContact):
    """A surface that holds the nodes of what flows by its map (see `surface_image`). A place is a node k that others
    follow; a node is held where most of those that it follows are.

    The normal impulse is r_k = Σ τ_ik (1 − ξ_i/ξ_k) n_i·R_i, with R the impulses that are missing at the nodes: what
    they leave on k is the map's. The gap velocity is what r works on, −r of an explicit step that holds the place: so
    much of m (v − B a), with a the folded velocity.
    """

    image: SurfaceImage  # the map where all is held
    coefficient: Scalar  # Coulomb coefficient [-]
    shut: Bool[Array, "n"]  # the places that may be held

    def images(self, active: Array) -> tuple[SurfaceImage, ...]:
        return (self.image.where(active),)

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> NodeScalar:
        """The momentum with which the nodes that follow leave the surface [kg m/s]."""
        mass, image = held.unconstrained.mass, self.image.taking(held.unconstrained.mass > 0)
        v = v if image.velocity is None else v - image.velocity
        speed, height = (image.normal * v).sum(axis=1), image.height
        before = jnp.where(height > 0, height, 1)
        follows = jnp.where(image.follows, mass, 0)
        sums = image.spread(jnp.stack([follows * height * speed, follows * height**2], axis=1)).T
        folded = (mass * speed + sums[0] / before) / jnp.where(mass > 0, mass + sums[1] / before**2, 1)
        lacking = follows * (speed - height * image.mean((folded / before)[:, None])[:, 0])
        return jnp.where(self.shut, self._pressed(image, lacking), 0)

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        image = self.image.taking(held.unconstrained.mass > 0)
        missing = (image.normal * held.without_collider_impulses(residual)).sum(axis=1)
        return self._pressed(image, jnp.where(image.follows, missing, 0))

    @staticmethod
    def _pressed(image: SurfaceImage, impulse: NodeScalar) -> NodeScalar:
        """Σ τ_ik (1 − ξ_i/ξ_k) of impulses along normals, on nodes that follow."""
        plain, arm = image.spread(jnp.stack([impulse, image.height * impulse], axis=1)).T
        return plain - arm / jnp.where(image.height > 0, image.height, 1)

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a place's momentum [kg m/s], for both."""
        least = noise * self.image.spread(jnp.where(self.image.follows, held.unconstrained.mass, 0)[:, None])[:, 0]
        return least, least

    def friction(
        self, held: ConstrainedNodes, active: Array, residual: NodeVector
    ) -> Callable[[NodeVector], NodeVector]:
        limit = self.coefficient * jnp.where(active, jnp.maximum(self.normal_impulse(held, residual), 0), 0)
        moving = 0.0 if self.image.velocity is None else self.image.velocity
        nodes = held.nodes
        return friction_change(nodes.projection, nodes.mass, self.image.normal, moving, limit)
