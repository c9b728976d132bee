"""Optimisers: methods that search the least sum of squares."""

import abc
from typing import Any, NamedTuple

import equinox as eqx

from mpmjax._types import Array, Float
from mpmjax.fitting._problem import Coordinates, FitProblem


class Evaluation(NamedTuple):
    """Cost and derivatives at the place where an optimiser is."""

    cost: Float[Array, ""]
    """½ Σ r²; NaN where a simulation failed."""
    gradient: Coordinates
    """Its derivative by the coordinates, shape (n,)."""
    residuals: Float[Array, "m"] | None = None
    """r [-], of an optimiser that uses them."""
    jacobian: Float[Array, "m n"] | None = None
    """Their derivative."""
    room: Float[Array, "2 n"] | None = None
    """How far values can change until their bounds, see `FitProblem.room`."""


class AbstractOptimiser(eqx.Module):
    """A method that searches the least Σ r², one iteration at a time.

    One of your own gives `begin`, `iterate` and `has_converged`. Its state is a pytree of arrays that says all it
    remembers, so that a search can be written to a file and continued.
    """

    max_steps: eqx.AbstractVar[int]
    """Most iterations."""

    @abc.abstractmethod
    def begin(self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> Any:
        """The state before the first iteration.

        Args:
            problem: what is minimised.
            z: where the search starts.
            sigmas: the noise of each observation.
        """

    @abc.abstractmethod
    def iterate(
        self, problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...], state: Any
    ) -> tuple[Coordinates, Any, Evaluation]:
        """One iteration: where it is now, the state, and what it knows of that place. The first one evaluates where it
        starts. A step at which a simulation fails must not be taken.

        Args:
            problem: what is minimised.
            z: where it is.
            sigmas: the noise of each observation.
            state: what `begin` or the last iteration returned.
        """

    def directed(self, z: Coordinates, state: Any, seen: Evaluation) -> Any:
        """The state for the next iteration, outside of what is compiled. Default: as it is."""
        del z, seen
        return state

    @abc.abstractmethod
    def has_converged(self, state: Any, seen: Evaluation) -> bool:
        """Whether the search is at a minimum."""

    def distance(self, state: Any, seen: Evaluation) -> float:
        """How far the search is from converged, as a multiple of where it ends; NaN if that is not known, which is the
        default. The time left is estimated from how fast it falls."""
        del state, seen
        return float("nan")

    def has_stalled(self, state: Any) -> bool:
        """Whether the search goes no further, and is not known to be at a minimum."""
        del state
        return False
