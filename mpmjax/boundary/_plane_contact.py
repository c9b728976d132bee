"""Contact with mirrored planes."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp

from mpmjax._types import Array, Bool, Int, Mask, NodeScalar, NodeVector, Scalar
from mpmjax.boundary._contact import AbstractContact, ConstrainedNodes
from mpmjax.boundary._friction import friction_across
from mpmjax.discretisation import Stencil, scatter
from mpmjax.potential import Image, Mirror

SHUT = 1e-2
"""The gap up to which a plane holds what is before it, in spacings."""


class PlaneContact(AbstractContact):
    """A contact plane in the window. Each column of nodes along its normal is a place, described at all of its nodes.

    Holding a column means that its nodes beyond the plane mirror those before it. The normal impulse r is that of the
    column's nodes on the plane and twice that of the images (a node and its image share equally). The gap velocity is
    what r works on: the mean, with weights 2 m m'/(m + m'), of the v + v' of nodes and their images, and of the v of
    nodes on the plane (where the two are one). So an explicit step that holds the column has
    r = −Σ 2 m m'/(m + m') (v* + v*'), and the two conditions exclude each other. Columns that no particle reaches whose
    face is at the plane are not held. Columns that are each other's image in another plane are held together. Friction
    acts on the column's node on the plane, or half a spacing before it.
    """

    image: Image
    """The mirror."""
    inward: int = eqx.field(static=True)
    """The inward normal's component: +1 or −1."""
    before: Int[Array, "m"]
    """How many half spacings each node along the axis lies before the plane, shape (m,)."""
    coefficient: Scalar
    """Coulomb coefficient [-]."""
    shut: Bool[Array, "n"] | None = None
    """The columns that may be held, shape (n,); None for all."""

    def where(self, shut: Bool[Array, "p"], stencil: Stencil) -> "PlaneContact":
        """This contact in the columns that the stencil of some particles reaches.

        Args:
            shut: those particles, shape (p,).
            stencil: stencil of the particles.
        """
        reached = self.image.column(
            scatter(stencil, shut.astype(stencil.weights.dtype)[None], None, self.image.size)[:, 0]
        )
        return replace(self, shut=reached > 0)

    @property
    def mirror_image(self) -> Image:
        return self.image

    @property
    def friction_order(self) -> float:
        return self.image.axis + 0.5

    def gap_velocity(self, held: ConstrainedNodes, v: NodeVector) -> NodeScalar:
        """The momentum with which each column leaves the plane [kg m/s]: its weights times what its velocity lacks of
        the mirror's."""
        lacking = (v - self.image.vector(v))[:, self.image.axis]
        columns = self.inward * self.image.column(self._weight(held.unheld.mass) * lacking)
        return self._tied(held, columns if self.shut is None else jnp.where(self.shut, columns, 0))

    def normal_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        """The normal impulse of each column [kg m/s]."""
        return self._tied(held, self._column_impulse(held, residual))

    def rounding(self, held: ConstrainedNodes, noise: Array) -> tuple[Array, Array]:
        """The rounding of a column's momentum [kg m/s], shape (n,), for both."""
        least = noise * self._tied(held, self.image.column(self._weight(held.unheld.mass)))
        return least, least

    def friction(self, held: ConstrainedNodes, active: Array, v: NodeVector, residual: NodeVector) -> NodeVector:
        impulse = jnp.where(active & self.representative(), self._column_impulse(held, residual), 0)
        limit = self.coefficient * jnp.maximum(held.images.fold_scalar(impulse), 0)
        return friction_across(held, self.image.axis, limit, v)

    def fixed(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """The normal component of the nodes on the plane."""
        on_plane = self.image.along(self.before == 0)
        return (active & on_plane)[:, None] & (jnp.arange(shape[1]) == self.image.axis)

    def reached(self, active: Array, shape: tuple[int, ...]) -> Mask:
        """All components of the columns held."""
        return jnp.broadcast_to(active[:, None], shape)

    def representative(self) -> Bool[Array, "n"]:
        """The node on the plane or, where there is none, half a spacing before it."""
        return self.image.along((self.before == 0) | (self.before == 1))

    def _weight(self, mass: NodeScalar) -> NodeScalar:
        """2 m m'/(m + m') [kg] at nodes beyond the plane, m on it, zero before it, shape (n,)."""
        mirrored = self.image.scalar(mass)
        both = mass + mirrored
        harmonic = 2 * mass * mirrored / jnp.where(both == 0, 1, both)
        return jnp.where(self.image.along(self.before <= 0), harmonic, 0)

    def _column_impulse(self, held: ConstrainedNodes, residual: NodeVector) -> NodeScalar:
        """The normal impulse that holds each column by itself [kg m/s], shape (n,)."""
        impulse = held.beside_colliders(residual)
        share = self.image.along(jnp.where(self.before < 0, 2, jnp.where(self.before == 0, 1, 0)))
        return self.inward * self.image.column(share.astype(impulse.dtype) * impulse[:, self.image.axis])

    def _tied(self, held: ConstrainedNodes, columns: NodeScalar) -> NodeScalar:
        """A quantity of the columns, summed over columns that are each other's image in other planes, shape (n,)."""
        contacts = (image for c in held.unheld.contacts if (image := c.mirror_image) is not None)
        for image in (*contacts, *held.unheld.mirror.images):
            if image.axis != self.image.axis:
                columns = image.scalar(Mirror((image,)).fold_scalar(columns))
        return columns
