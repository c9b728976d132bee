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
    interrupted: bool
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
    begun: Callable[[Array], None] | None = None,
) -> Minimum:
    """The least Σ r² near z, by optimistix's Levenberg-Marquardt method.

    One compiled function makes an iteration: it evaluates residuals and Jacobian together, once. A step at which a
    simulation fails has residuals of NaN, is not taken, and the next is shorter. An interruption (Ctrl-C) ends the
    search where it is.

    It ends by optimistix's criterion, or where the next Gauss-Newton step would be less than a ten-thousandth of the
    standard error that the misfit gives: in single precision residuals are never still.

    Args:
        problem: the residuals.
        z: where it starts.
        sigmas: the noise of each observation.
        rtol: relative and absolute tolerance of coordinates and residuals.
        max_steps: most iterations.
        report: called after each.
        begun: called with the Jacobian where it starts, shape (m, n).

    Raises:
        NoDerivativeError: a derivative is not finite.
    """
    solver = optimistix.LevenbergMarquardt(rtol=rtol, atol=rtol)
    z = z.astype(float)  # optimistix's own numbers are of JAX's default precision
    history: list[Iteration] = []
    converged, interrupted, r, J = False, False, jnp.zeros((0,)), jnp.zeros((0, problem.size))
    state = _begin(problem, solver, z, sigmas)
    try:
        for number in range(max_steps):
            z, state, r, J = _iterate(problem, solver, z, sigmas, state)
            cost, slope = float((r**2).sum()) / 2, float(jnp.abs(J.T @ r).max())
            if np.isfinite(cost) and not np.isfinite(slope):
                raise NoDerivativeError
            moved = not history or cost != history[-1].cost
            history.append(Iteration(number, cost, slope, moved, np.asarray(z)))
            if number == 0 and begun is not None and np.isfinite(cost):
                begun(J)
            if report is not None:
                report(history[-1])
            converged = bool(state.terminate) or _is_done(np.asarray(r, float), np.asarray(J, float))
            if converged or not np.isfinite(cost):
                break
    except KeyboardInterrupt:
        if not history:
            raise
        interrupted = True
    return Minimum(z.astype(problem.dtype), r, J, converged, interrupted, tuple(history))


def _is_done(r: np.ndarray, J: np.ndarray) -> bool:
    """Whether the next Gauss-Newton step p is far below the standard errors: ‖J p‖ against √(Σ r²/(m − n))."""
    if len(r) <= J.shape[1] or not (np.isfinite(r).all() and np.isfinite(J).all()):
        return False
    U, singular, _ = np.linalg.svd(J, full_matrices=False)
    change = U[:, singular > 1e-10 * singular.max(initial=0)].T @ r
    return bool((change**2).sum() <= _NEGLIGIBLE**2 * (r**2).sum() / (len(r) - J.shape[1]))


_NEGLIGIBLE = 1e-4
"""A step of so many standard errors is none."""


def _residuals(z: Coordinates, args: tuple[FitProblem, tuple[Array, ...]]) -> tuple[Array, None]:
    """The residuals, with a derivative by forward mode in one pass."""
    problem, sigmas = args

    def jacobian(z: Coordinates) -> tuple[Array, Array]:
        r, J = problem.jacobian(z.astype(problem.dtype), sigmas)
        return r.astype(z.dtype), J.astype(z.dtype)

    @jax.custom_jvp
    def residuals(z: Coordinates) -> Array:
        return jacobian(z)[0]

    @residuals.defjvp
    def _(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
        r, J = jacobian(primals[0])
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
