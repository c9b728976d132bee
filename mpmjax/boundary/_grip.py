"""Grips: regions of nodes with a prescribed velocity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float, NodeVector, Scalar
from mpmjax.boundary._boundary import ON_THE_WALL, AbstractBoundary
from mpmjax.boundary._conditions import Conditions
from mpmjax.checks import as_plain, require, require_fields
from mpmjax.geometry import AbstractMotion, AbstractRegion, Motion


class Grip(AbstractBoundary):
    """A region of nodes with a prescribed motion, which may turn. The region moves with it.

    A node has the velocity of the grip's own point that is there, the chord over the step; where the grip turns,
    material in it follows the circle and not its tangent. In the total description the region is that of the reference
    configuration. In a periodic direction the region does not wrap: it must stay within the window's extent. The region
    only selects nodes, so derivatives by its floats are zero; those by the floats of the motion are not.

    Args:
        region: region at zero displacement.
        motion: how it moves: a `Motion`, or a `RigidMotion`, which turns too.
        axes: the directions in which it holds, one bool each. Default: all of them. They do not turn.
    """

    region: AbstractRegion
    motion: Motion | AbstractMotion  # in files a Motion where no kind is given
    axes: tuple[bool, ...] | None = eqx.field(static=True, default=None, converter=as_plain)

    @property
    def dim(self) -> int:
        return self.motion.dim

    def __check_init__(self):
        require_fields(self)
        d = self.dim
        require(
            self.region.dim == d,
            f"A grip's region and motion must have the same dimension, got {self.region.dim} and {d}.",
        )
        require(
            self.axes is None or (len(self.axes) == d and any(self.axes)),
            f"A grip's axes must be {d} bools, at least one of them true, got {self.axes}.",
        )

    def conditions(self, nodes: NodeVector, spacing: Scalar, t: Scalar, dt: Scalar, *, reference: bool) -> Conditions:
        """v is the velocity of the motion."""
        place = nodes if reference else self.motion.origin(nodes, t)
        held = self.region.contains(place, ON_THE_WALL * spacing)[:, None]
        axes = jnp.ones(nodes.shape[1], dtype=bool) if self.axes is None else jnp.asarray(self.axes)
        fixed = held & axes
        return Conditions(fixed, jnp.where(fixed, self.motion.velocity_of(place, t, dt), 0))

    def carried(self, nodes: NodeVector, t: Scalar) -> NodeVector:
        return nodes + self.motion.place(nodes, t) - self.motion.place(nodes, 0.0)

    def pivot(self, t: Scalar) -> Float[Array, "d"]:
        """The region's middle."""
        return self.motion.pivot(jnp.asarray(self.region.middle()), t)

    def reach(self) -> tuple[np.ndarray, np.ndarray]:
        return self.motion.swept(*self.region.bounds())

    def rests(self, *, total: bool) -> bool:
        return total or self.motion.rests()
