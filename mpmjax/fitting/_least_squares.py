"""Levenberg-Marquardt by optimistix, one iteration at a time."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix

from mpmjax._types import Array, Float
from mpmjax.fitting._problem import Coordinates, FitProblem


class Iteration(NamedTuple):
    """What one iteration did."""

    number: int
    cost: float
    """½ Σ r² where it is now."""
    gradient: float
    """Largest component of Jᵀr there."""
    accepted: bool
    """Whether it moved."""
    z: np.ndarray
    """The coordinates, shape (n,)."""


class Minimum(NamedTuple):
    """Where the search ended."""

    z: Coordinates
    r: Float[Array, "m"]
    """The residuals there [-]."""
    J: Float[Array, "m n"]
    """Their derivative."""
    converged: bool
    history: tuple[Iteration, ...]


class NoDerivativeError(RuntimeError):
    """The residuals are finite, their derivative is not."""


def levenberg_marquardt(
    problem: FitProblem,
    z: Coordinates,
    sigmas: tuple[Array, ...],
    *,
    rtol: float,
    max_steps: int,
    report: Callable[[Iteration], None] | None = None,
) -> Minimum:
    """The least Σ r² near z, by optimistix's Levenberg-Marquardt method.

    One compiled function makes an iteration: it evaluates residuals and Jacobian together, once. A step at which a
    simulation fails has residuals of NaN, is not taken, and the next is shorter. An interruption (Ctrl-C) ends the
    search where it is.

    Args:
        problem: the residuals.
        z: where it starts.
        sigmas: the noise of each observation.
        rtol: relative and absolute tolerance of coordinates and residuals.
        max_steps: most iterations.
        report: called after each.

    Raises:
        NoDerivativeError: a derivative is not finite.
    """
    solver = optimistix.LevenbergMarquardt(rtol=rtol, atol=rtol)
    history: list[Iteration] = []
    converged, r, J = False, jnp.zeros((0,)), jnp.zeros((0, problem.size))
    state = _begin(problem, solver, z, sigmas)
    try:
        for number in range(max_steps):
            z, state, r, J = _iterate(problem, solver, z, sigmas, state)
            cost, slope = float((r**2).sum()) / 2, float(jnp.abs(J.T @ r).max())
            if np.isfinite(cost) and not np.isfinite(slope):
                raise NoDerivativeError
            moved = not history or cost != history[-1].cost
            history.append(Iteration(number, cost, slope, moved, np.asarray(z)))
            if report is not None:
                report(history[-1])
            converged = bool(state.terminate)
            if converged or not np.isfinite(cost):
                break
    except KeyboardInterrupt:
        if not history:
            raise
    return Minimum(z, r, J, converged, tuple(history))


def _residuals(z: Coordinates, args: tuple[FitProblem, tuple[Array, ...]]) -> tuple[Array, None]:
    """The residuals, with a derivative by forward mode in one pass."""
    problem, sigmas = args

    @jax.custom_jvp
    def residuals(z: Coordinates) -> Array:
        return problem.jacobian(z, sigmas)[0]

    @residuals.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        r, J = problem.jacobian(primals[0], sigmas)
        return r, J @ tangents[0]

    return residuals(z), None


@eqx.filter_jit
def _begin(problem: FitProblem, solver: Any, z: Coordinates, sigmas: tuple[Array, ...]) -> Any:
    args = problem, sigmas
    shape, _ = jax.eval_shape(lambda z: _residuals(z, args), z)
    return solver.init(_residuals, z, args, {}, shape, None, frozenset())


@eqx.filter_jit
def _iterate(
    problem: FitProblem, solver: Any, z: Coordinates, sigmas: tuple[Array, ...], state: Any
) -> tuple[Coordinates, Any, Array, Array]:
    z, state, _ = solver.step(_residuals, z, (problem, sigmas), {}, state, frozenset())
    return z, state, state.f_info.residual, state.f_info.jac.as_matrix()
