"""Where an implicit solve starts."""

import enum

import jax.numpy as jnp

from mpmjax._types import NodeVector


class Guess(enum.Enum):
    """The initial guess of an implicit update.

    At some hundred times the explicit limit v* is far off, since it is what the explicit step would have done.
    """

    GRID_VELOCITY = "grid velocity"
    """v^n, the velocity of the nodes before the step: the default."""
    EXPLICIT = "explicit"
    """v*, the choice of the derivation."""
    ZERO = "zero"
    """Rest."""

    def velocity(self, before: NodeVector, explicit: NodeVector) -> NodeVector:
        """The guess [m/s], shape (n, d), from v^n and v*."""
        match self:
            case Guess.GRID_VELOCITY:
                return before
            case Guess.EXPLICIT:
                return explicit
            case Guess.ZERO:
                return jnp.zeros_like(before)
