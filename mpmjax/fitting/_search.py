"""The search for the least sum of squares, iteration by iteration."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from mpmjax._types import Array, Float
from mpmjax.fitting._optimiser import AbstractOptimiser, Evaluation
from mpmjax.fitting._problem import Coordinates, FitProblem


class Iteration(NamedTuple):
    """What one iteration did."""

    number: int
    cost: float
    """½ Σ r² where it is now."""
    gradient: float
    """Largest component of its derivative by the coordinates there."""
    accepted: bool
    """Whether it moved."""
    z: np.ndarray
    """The coordinates, shape (n,)."""


class Standing(NamedTuple):
    """Where a search stands after an iteration: all that the next one needs."""

    z: Coordinates
    state: Any
    """What the optimiser remembers."""
    seen: Evaluation
    history: tuple[Iteration, ...]
    """The iterations so far, one at least."""


class Minimum(NamedTuple):
    """Where the search ended."""

    z: Coordinates
    r: Float[Array, "m"]
    """The residuals there [-]."""
    J: Float[Array, "m n"]
    """Their derivative."""
    converged: bool
    interrupted: bool
    history: tuple[Iteration, ...]


class NoDerivativeError(RuntimeError):
    """The residuals are finite, their derivative is not."""


def search(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    z: Coordinates,
    sigmas: tuple[Array, ...],
    *,
    standing: Standing | None = None,
    report: Callable[[Standing], None] | None = None,
    begun: Callable[[Evaluation], None] | None = None,
) -> Minimum:
    """The least Σ r² near z. An interruption (Ctrl-C) ends the search where it is.

    Args:
        problem: the residuals.
        optimiser: the method.
        z: where it starts.
        sigmas: the noise of each observation.
        standing: in the place of z, where an earlier search of the same kind stood; it is continued exactly.
        report: called after each iteration.
        begun: called with what is known where it starts.

    Raises:
        NoDerivativeError: a derivative is not finite.
    """
    converged = interrupted = False
    try:
        while standing is None or not (
            (converged := optimiser.has_converged(standing.state, standing.seen))
            or optimiser.has_stalled(standing.state)
            or not np.isfinite(standing.history[-1].cost)
            or len(standing.history) >= optimiser.max_steps
        ):
            standing = _next(problem, optimiser, z, sigmas, standing)
            if begun is not None and len(standing.history) == 1 and np.isfinite(standing.history[0].cost):
                begun(standing.seen)
            if report is not None:
                report(standing)
    except KeyboardInterrupt:
        if standing is None:
            raise
        interrupted = True
    z = standing.z.astype(problem.dtype)
    r, J = standing.seen.residuals, standing.seen.jacobian
    if r is None or J is None:
        r, J = jacobian(problem, z, sigmas)
        if not jnp.isfinite(J).all():
            raise NoDerivativeError
    return Minimum(z, r, J, converged, interrupted, standing.history)


def _next(
    problem: FitProblem,
    optimiser: AbstractOptimiser,
    z: Coordinates,
    sigmas: tuple[Array, ...],
    standing: Standing | None,
) -> Standing:
    """One iteration, the first one where there is none yet.

    Raises:
        NoDerivativeError: a derivative is not finite.
    """
    if standing is None:
        z = z.astype(float)  # optimistix's own numbers are of JAX's default precision
        state, history = begin(problem, optimiser, z, sigmas), ()
    else:
        z, state, _, history = standing
    z, state, seen = iterate(problem, optimiser, z, sigmas, state)
    state = optimiser.directed(z, state, seen)
    cost, slope = float(seen.cost), float(jnp.abs(seen.gradient).max())
    if np.isfinite(cost) and not np.isfinite(slope):
        raise NoDerivativeError
    moved = not history or cost != history[-1].cost
    return Standing(z, state, seen, (*history, Iteration(len(history), cost, slope, moved, np.asarray(z))))


@eqx.filter_jit
def begin(problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates, sigmas: tuple[Array, ...]) -> Any:
    """An optimiser's `begin`, compiled."""
    return optimiser.begin(problem, z, sigmas)


@eqx.filter_jit
def iterate(
    problem: FitProblem, optimiser: AbstractOptimiser, z: Coordinates, sigmas: tuple[Array, ...], state: Any
) -> tuple[Coordinates, Any, Evaluation]:
    """An optimiser's `iterate`, compiled."""
    return optimiser.iterate(problem, z, sigmas, state)


@eqx.filter_jit
def jacobian(problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> tuple[Array, Array]:
    """The residuals and their Jacobian, compiled."""
    return problem.jacobian(z, sigmas)


def influence(problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> np.ndarray:
    """How much the residuals change with each coordinate, shape (n,), by one pass of reverse mode: |Jᵀw| with random
    numbers w of variance one, whose expected square is that of the length of J's columns."""
    return np.abs(np.asarray(_pulled(problem, z, sigmas)))


@eqx.filter_jit
def _pulled(problem: FitProblem, z: Coordinates, sigmas: tuple[Array, ...]) -> Coordinates:
    r, pull, _ = jax.vjp(lambda z: problem.residuals(z, sigmas, None), z, has_aux=True)
    return pull(jax.random.normal(jax.random.key(0), r.shape, r.dtype))[0]
