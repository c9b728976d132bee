"""Where an implicit solve starts."""

import enum

import jax.numpy as jnp

from mpmjax._types import NodeVector


class Guess(enum.Enum):
    """The initial guess of an implicit solve.

    v*, the result of an explicit step, is far off at a hundred times the explicit limit.
    """

    GRID_VELOCITY = "grid velocity"
    """v^n, the velocity of the nodes before the step. The default."""
    EXPLICIT = "explicit"
    """v*, the explicitly updated velocity (derivation, eq. 4)."""
    ZERO = "zero"
    """Zero velocity."""

    def velocity(self, before: NodeVector, explicit: NodeVector) -> NodeVector:
        """The guess [m/s], shape (n, d), from v^n and v*."""
        match self:
            case Guess.GRID_VELOCITY:
                return before
            case Guess.EXPLICIT:
                return explicit
            case Guess.ZERO:
                return jnp.zeros_like(before)
